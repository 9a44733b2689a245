"""Control points of a B-spline lattice, moved one by one, as the paper drives free-form deformation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import ClassVar

import numpy as np

from musclefit.errors import InputError, LandmarkError, RigError
from musclefit.io.drives.pairs import Pairs
from musclefit.io.formats.control_points import read_displacements
from musclefit.rig.drive import Drive, Files, register_drive
from musclefit.rig.lattice import ControlLattice
from musclefit.vocabulary import PathKind, Unit

MOST_CONTROL_POINTS = 1_000_000
"""Of a lattice; at 100 along each axis."""


@register_drive
@dataclass(frozen=True, slots=True)
class LatticeDrive(Drive):
    """Control points of a cubic B-spline lattice, moved one by one.

    The outermost of ``shape`` control points lie on the faces of the box from ``low_mm`` to ``high_mm``. ``units`` is
    the length unit of a file that states none.

    Raises
    ------
    RigError
        Corners or a shape that are not of three numbers.
    """

    kind: ClassVar[str] = "lattice"
    by_control_points: ClassVar[bool] = True
    drives: ClassVar[str] = "a lattice drives"

    displacements: str
    low_mm: tuple[float, ...]
    high_mm: tuple[float, ...]
    shape: tuple[int, ...]
    units: Unit = Unit.MILLIMETRE

    def __post_init__(self) -> None:
        for key in ("low_mm", "high_mm", "shape"):
            if len(getattr(self, key)) != 3:
                raise RigError(f"drive.{key}: found {list(getattr(self, key))}; expected 3 numbers, for x, y and z")
        if min(self.shape) < 2 or prod(self.shape) > MOST_CONTROL_POINTS:
            raise RigError(
                f"drive.shape: found {list(self.shape)}; expected at least 2 control points along every axis, and at "
                f"most {MOST_CONTROL_POINTS} together"
            )

    def resolved(self, files: Files) -> LatticeDrive:
        """With absolute paths."""
        return replace(self, displacements=files.find(self.displacements, key="drive.displacements"))

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> Pairs:  # noqa: ARG002
        """The control points, and where their splines take them."""
        file, shape = Path(self.displacements), (self.shape[0], self.shape[1], self.shape[2])
        files.read(file, key="drive.displacements")
        try:
            moved = read_displacements(file, shape=shape, units=self.units)
            lattice = ControlLattice(np.array(self.low_mm), np.array(self.high_mm), shape, moved)
        except InputError as error:
            raise files.named("drive.displacements" if isinstance(error, LandmarkError) else "drive", error) from None
        return Pairs(lattice.handles(), lattice.arrivals(), path, lattice=lattice)
