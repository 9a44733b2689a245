"""A driver of pairs: handles and where they go."""

from __future__ import annotations

from dataclasses import dataclass

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.geometry.arrays import Points
from musclefit.rig.drive import Driver, JobParts
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import path_by_pairs
from musclefit.rig.lattice import ControlLattice
from musclefit.vocabulary import PathKind


@dataclass(frozen=True, eq=False)
class Pairs(Driver):
    """Handles and where they go, (m, 3) mm, through keyframes."""

    handles: Handles
    target: Points
    path: PathKind
    findings: tuple[Finding, ...] = ()
    frame: str = ""
    lattice: ControlLattice | None = None
    keyframes: tuple[tuple[float, Points], ...] = ()

    def parts(self) -> JobParts:
        """The control points, where they drive."""
        return JobParts(lattice=self.lattice)

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:  # noqa: ARG002
        """Straight, through the keyframes, or with their bones on screws."""
        return self.handles, path_by_pairs(self.handles, self.target, kind=self.path, keyframes=self.keyframes)
