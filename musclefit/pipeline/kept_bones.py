"""Which bones a rig keeps, and what it leaves open of them: where the field may slip between two, where locks fade."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import TissueKind
from musclefit.errors import RigError
from musclefit.fields.locked import Fade
from musclefit.flow.locks import ZONE, LockSettings, with_zone
from musclefit.geometry.arrays import Float
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.pipeline.chosen_settings import chosen_setting, thickness
from musclefit.rig.job import Job
from musclefit.rig.table_reader import suggestion
from musclefit.vocabulary import BoneLimit

ZONE_MM = 4.0
"""How close a kept bone comes to another where the field may slip along it, without locks, unless the rig says so."""

LOCK, FADE, APART = 0.2, 0.4, 0.5
"""Spacing of the lattice of smooth distances, where locks fade, and how far apart bones must be for both to be locked,
in units of a bone's thickness, or of the median one if that is less. Wider than for bones that joints move: no muscle
must keep its volume on another body, and there may be two hundred bones."""


@dataclass(frozen=True, eq=False, slots=True)
class KeptChoices:
    """All lengths that kept bones need, given or chosen.

    Parameters
    ----------
    zones_mm : (K, K) float64
        How close two of the K bones come where each may slip along the other.
    locks : tuple of LockSettings
        Of each bone; none where the rig does not lock them.
    locked : tuple of int
        Numbers of the bones that are locked.
    findings : tuple of Finding
        What was chosen, and which bones cannot be locked.
    """

    zones_mm: Float
    locks: tuple[LockSettings, ...]
    locked: tuple[int, ...]
    findings: tuple[Finding, ...]


def bone_limits(job: Job) -> Mapping[str, BoneLimit]:
    """The bones that the rig keeps from deforming freely; the stricter limit counts.

    Raises
    ------
    RigError
        A name or pattern that fits no bone.
    """
    bones = [tissue.name for tissue in job.anatomy.of_kind(TissueKind.BONE)]
    found: dict[str, BoneLimit] = {}
    for limit, key in ((BoneLimit.SIMILAR, "keep_similar"), (BoneLimit.RIGID, "keep_rigid")):
        for pattern in getattr(job.rig.bones, key):
            fits = [bone for bone in bones if fnmatchcase(bone, pattern)]
            if not fits:
                raise RigError(f"{job.source}: bones.{key}: {pattern!r} fits no bone; {suggestion(pattern, bones)}")
            found.update(dict.fromkeys(fits, limit))
    return found


@lru_cache(maxsize=2)
def kept_choices(job: Job) -> KeptChoices:
    """The lengths of a job with kept bones; what its rig gives stands.

    Parameters
    ----------
    job : Job

    Raises
    ------
    RigError
        As `bone_limits`.
    """
    given, limits = job.rig.bones, bone_limits(job)
    count = len(limits)
    if not (given.lock and limits):
        zone = ZONE_MM if given.contact_zone_mm is None else given.contact_zone_mm
        return KeptChoices(np.full((count, count), zone), (), (), ())
    thick = [thickness(job.anatomy[name].surface) for name in limits]
    widths = [min(width, float(np.median(thick))) for width in thick]
    locks = tuple(LockSettings(LOCK * width, Fade(FADE * width, APART * width)) for width in widths)
    if given.contact_zone_mm is not None:
        locks = with_zone(locks, given.contact_zone_mm)
    zones = np.array([[_zone(a, b) for a in locks] for b in locks])
    findings = []
    if given.contact_zone_mm is None:
        findings.append(
            chosen_setting(
                "bones.contact_zone_mm",
                f"{zones.min():.3g} to {zones.max():.3g} mm",
                f"the bones that are kept are {min(thick):.3g} to {max(thick):.3g} mm thick (3 V / A, median "
                f"{np.median(thick):.3g})",
            )
        )
    locked = []
    for k, (name, lock) in enumerate(zip(limits, locks, strict=True)):
        nearest = _nearest_handle(job, name)
        if nearest > lock.fade.over_mm + lock.spacing_mm:
            locked.append(k)
            continue
        findings.append(
            Finding(
                name,
                "bone-not-locked",
                f"{name}: kept {limits[name].value}, but not locked, because a handle is {nearest:.3g} mm from it and "
                "must arrive, whatever the bone does; move handles off the bones that bones.lock is to hold exactly",
            )
        )
    return KeptChoices(zones, locks, tuple(locked), tuple(findings))


def _zone(a: LockSettings, b: LockSettings) -> float:
    """Places of two bones that are farther apart than this move exactly with their own."""
    return min(a.fade.apart_mm, b.fade.apart_mm) + ZONE * max(a.spacing_mm, b.spacing_mm)


def _nearest_handle(job: Job, bone: str) -> float:
    return float(DistanceTree(job.anatomy[bone].surface)(job.handles.source).min(initial=np.inf))
