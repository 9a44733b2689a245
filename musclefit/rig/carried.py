"""Bones that move with another: a rig's names and patterns in, the carrier of each bone out; knows no file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatchcase

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import RigError
from musclefit.rig.table_reader import suggestion


def carriers(
    anatomy: Anatomy, carried: Sequence[tuple[str, Sequence[str]]], *, moving: Collection[str]
) -> Mapping[str, str]:
    """Which bone carries each bone that has no motion of its own.

    Parameters
    ----------
    anatomy : Anatomy
    carried : sequence of (carrier, bones or shell-style patterns for them)
    moving : collection of str
        Bones with a motion of their own, which keep it where a pattern fits them.

    Raises
    ------
    RigError
        A carrier without a motion, a pattern that fits no bone, or a bone with two carriers.
    """
    bones = [tissue.name for tissue in anatomy.of_kind(TissueKind.BONE)]
    found: dict[str, str] = {}
    for carrier, patterns in carried:
        if carrier not in moving:
            raise RigError(
                f"{carrier!r} has no motion of its own that others could follow; {suggestion(carrier, moving)}"
            )
        for pattern in patterns:
            fits = [bone for bone in bones if fnmatchcase(bone, pattern)]
            if not fits:
                raise RigError(f"{carrier}: {pattern!r} fits no bone; {suggestion(pattern, bones)}")
            for bone in fits:
                if bone in moving:
                    continue
                if found.setdefault(bone, carrier) != carrier:
                    raise RigError(f"bone {bone!r} moves with {found[bone]!r} and with {carrier!r}; name one carrier")
    return found
