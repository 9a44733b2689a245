"""Handles and the paths they follow: what cages, landmarks and bone landmarks all become."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Points, frozen
from musclefit.geometry.rigid import RigidMotion


@dataclass(frozen=True, eq=False, slots=True)
class Handles:
    """Named points that drive a deformation.

    Parameters
    ----------
    names : (m,) tuple of str, unique
    source : (m, 3) float64, mm
        Where they stand at rest.
    owner : (m,) tuple of str
        The bone that carries each handle, or "" for a free one.

    Raises
    ------
    LandmarkError
        No handle, wrong shapes, not finite, or a name that stands twice.
    """

    names: tuple[str, ...]
    source: Points
    owner: tuple[str, ...]

    def __post_init__(self) -> None:
        source = frozen(self.source)
        if source.ndim != 2 or source.shape[1] not in (2, 3) or not len(source):
            raise LandmarkError(f"handles have shape {source.shape}; expected (m, 2) or (m, 3) with m at least 1")
        if not len(self.names) == len(self.owner) == len(source):
            raise LandmarkError(f"{len(source)} handles have {len(self.names)} names and {len(self.owner)} owners")
        bad = np.flatnonzero(~np.isfinite(source).all(axis=1))
        if bad.size:
            raise LandmarkError(f"handle {self.names[bad[0]]!r} is not finite: {source[bad[0]]}; correct the file")
        seen: set[str] = set()
        for name in self.names:
            if name in seen:
                raise LandmarkError(f"two handles are named {name!r}; names must be unique, rename one")
            seen.add(name)
        object.__setattr__(self, "source", source)

    def __len__(self) -> int:
        return len(self.names)


class Path(Protocol):
    """Where the handles are on their way from rest (t = 0) to their destinations (t = 1)."""

    def position(self, t: float) -> Points:
        """(m, n) handle positions at ``t`` in [0, 1], mm."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class StraightPath:
    """Every handle moves on the straight line from ``source`` to ``target``, both (m, n) mm."""

    source: Points
    target: Points

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", frozen(self.source))
        object.__setattr__(self, "target", frozen(self.target))

    def position(self, t: float) -> Points:
        """(m, n) handle positions at ``t``; exactly ``source`` at 0 and ``target`` at 1."""
        return (1.0 - t) * self.source + t * self.target


class BoneMotions(Protocol):
    """The rigid motion of every bone on the way from rest to the pose."""

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name, t in [0, 1]."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class JoinedPath:
    """The handles of one path, then those of another."""

    first: Path
    second: Path

    def position(self, t: float) -> Points:
        """(m, n) handle positions at ``t``, mm."""
        return np.concatenate([self.first.position(t), self.second.position(t)])


@dataclass(frozen=True, eq=False, slots=True)
class BonePath:
    """Every handle is carried by the bone that owns it."""

    handles: Handles
    motions: BoneMotions

    def position(self, t: float) -> Points:
        """(m, 3) handle positions at ``t``, mm.

        Raises
        ------
        LandmarkError
            A handle is on a bone that no joint moves or fixes.
        """
        motions = self.motions.at(t)
        moved = self.handles.source.copy()
        owners = np.asarray(self.handles.owner)
        for bone in dict.fromkeys(self.handles.owner):
            if bone not in motions:
                raise LandmarkError(
                    f"handle {self.handles.names[self.handles.owner.index(bone)]!r} belongs to bone {bone!r}, "
                    f"which no joint moves or fixes; bones known to the joints: {', '.join(sorted(motions)[:8])}, ..."
                )
            carried = owners == bone
            moved[carried] = motions[bone](self.handles.source[carried])
        return moved
