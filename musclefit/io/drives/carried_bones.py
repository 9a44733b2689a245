"""Bones that move with others, as a drive's ``carried`` names them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import RigError
from musclefit.rig.carried import carriers
from musclefit.rig.chain import ChainMotions, chain_findings
from musclefit.rig.drive import Files
from musclefit.rig.paths import ScrewMotions
from musclefit.rig.transforms import still_findings

Carried = tuple[tuple[str, tuple[str, ...]], ...]
"""Carriers, each with names or shell-style patterns of the bones that move with it."""


def carriers_named(carried: Carried, anatomy: Anatomy, files: Files, *, moving: Collection[str]) -> Mapping[str, str]:
    """The carrier of each bone that is carried.

    Raises
    ------
    RigError
        What `carriers` refuses.
    """
    try:
        return carriers(anatomy, carried, moving=moving)
    except RigError as error:
        raise files.named("drive.carried", error) from None


def motion_findings(
    motions: ScrewMotions | ChainMotions, anatomy: Anatomy, *, subject: str, said: str, code: str
) -> tuple[Finding, ...]:
    """Bones that have no motion, and which hang on which."""
    found = still_findings(anatomy, tuple(motions.final), subject=subject, said=said, code=code)
    if isinstance(motions, ChainMotions):
        found += chain_findings(motions, subject=subject)
    return found
