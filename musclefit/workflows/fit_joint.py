"""A joint fitted to two bones, from their files to an axis or a centre and what the fit leaves over."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Float
from musclefit.geometry.fitting import CylinderFit
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.tables import toml_string
from musclefit.rig.articulation import FittedJoint, fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.vocabulary import Unit
from musclefit.workflows.given import word
from musclefit.workflows.results import Shown

WITHIN_MM = 5.0

SURE_DEG = 60.0
"""An axis of less of a cylinder is uncertain."""


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class JointFit(Shown):
    """A joint fitted to two bones: the fit to each of them, the better one first."""

    fixed: str
    moving: str
    kind: JointKind
    fits: tuple[FittedJoint, ...]

    @property
    def centre_mm(self) -> Float:
        """(3,) a point of the axis, or the centre, mm."""
        return self.fits[0].fit.centre

    @property
    def axis(self) -> Float | None:
        """(3,) of length 1; None of a ball."""
        best = self.fits[0].fit
        return best.axis if isinstance(best, CylinderFit) else None

    @property
    def apart_mm(self) -> float:
        """How far the axes, or the centres, of the two bones are from each other."""
        apart = self.fits[1].fit.centre - self.centre_mm
        if self.axis is not None:
            apart = apart - (apart @ self.axis) * self.axis
        return float(np.linalg.norm(apart))

    @property
    def turned_deg(self) -> float | None:
        """By how much the axes of the two bones differ; None of a ball."""
        other = self.fits[1].fit
        if self.axis is None or not isinstance(other, CylinderFit):
            return None
        return float(np.degrees(np.arccos(np.clip(abs(self.axis @ other.axis), 0.0, 1.0))))

    def said(self) -> str:
        """Centre and axis in a line."""
        axis = "" if self.axis is None else f", axis {_listed(self.axis, 6)}"
        return f"{self.kind.value} of {self.fixed} and {self.moving}: centre {_listed(self.centre_mm, 3)} mm{axis}"

    def agreement(self) -> str:
        """How far the fits to the two bones agree, in words."""
        if self.turned_deg is None:
            return f"the centres of the two bones are {self.apart_mm:.2f} mm apart"
        return f"the axes of the two bones differ by {self.turned_deg:.1f} deg and {self.apart_mm:.2f} mm"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The fits."""
        return {"fits": [self._row(found) for found in self.fits]}

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON values, lengths in mm, angles in degrees."""
        return {
            "kind": self.kind.value,
            "fixed": self.fixed,
            "moving": self.moving,
            "centre_mm": [float(v) for v in self.centre_mm],
            "axis": None if self.axis is None else [float(v) for v in self.axis],
            "apart_mm": self.apart_mm,
            "turned_deg": self.turned_deg,
            "fits": [self._row(found) for found in self.fits],
        }

    def to_toml(self) -> str:
        """As it stands in a table of joints, with what the fits leave over as comments."""
        lines = [
            'units = "mm, degrees"',
            "",
            "[joint]                  # name it, and add the other bones that it moves",
        ]
        if self.axis is None:
            axes, names = np.eye(3).tolist(), '["joint_x", "joint_y", "joint_z"]'
            lines += ['kind = "ball"', f"axes = {axes}", f"coordinates = {names}"]
        else:
            lines.append(f"axis = {_listed(self.axis, 6)}")
        lines += [
            f"centre_mm = {_listed(self.centre_mm, 3)}",
            f"fixed = [{toml_string(self.fixed)}]",
            f"moving = [{toml_string(self.moving)}]",
            "",
        ]
        for found in self.fits:
            fit = found.fit
            most = np.abs(fit.residuals).max()
            lines.append(
                f"# {found.of} bone: radius {fit.radius:.2f} mm, off by {fit.rms:.2f} mm rms and {most:.2f} mm at most "
                f"on {found.used_mm2:.0f} mm², {found.left_out_mm2:.0f} mm² left out"
            )
            if isinstance(fit, CylinderFit):
                uncertain = ", too little to be sure of it" if fit.spread < SURE_DEG else ""
                lines[-1] += f", which reach {fit.spread:.0f} deg around the axis{uncertain}"
        lines.append(f"# {self.agreement()}")
        return "\n".join(lines)

    @staticmethod
    def _row(found: FittedJoint) -> dict[str, Any]:
        fit = found.fit
        return {
            "bone": found.of,
            "radius_mm": fit.radius,
            "rms_mm": fit.rms,
            "largest_mm": float(np.abs(fit.residuals).max()),
            "used_mm2": found.used_mm2,
            "left_out_mm2": found.left_out_mm2,
            "around_axis_deg": fit.spread if isinstance(fit, CylinderFit) else None,
        }


def fit_joint(
    fixed: str | Path,
    moving: str | Path,
    *,
    kind: JointKind | str = JointKind.HINGE,
    within_mm: float = WITHIN_MM,
    units: Unit | str = Unit.MILLIMETRE,
) -> JointFit:
    """Fit a joint's axis, or a ball's centre, where two bones face each other.

    Parameters
    ----------
    fixed, moving : path
        Surfaces of the bone that carries the joint and of the one that it moves.
    kind : {"hinge", "ball"}
    within_mm : float
        Surfaces of the two within this distance count.
    units : {"mm", "cm", "m"}
        Of the files.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, or bones that face each other nowhere.
    """
    unit, joint = word(Unit, units, what="units"), word(JointKind, kind, what="kind")
    first, second = (read_surface(Path(path), units=unit).mesh() for path in (fixed, moving))
    fits = fitted_joint(first, second, kind=joint, within_mm=within_mm)
    return JointFit(Path(fixed).stem, Path(moving).stem, joint, tuple(fits))


def _listed(values: Float, decimals: int) -> str:
    return str([round(float(v), decimals) for v in values])
