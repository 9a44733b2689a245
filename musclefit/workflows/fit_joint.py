"""A joint fitted to two bones, from their files to an axis or a centre and what the fit leaves over."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Float
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.tables import toml_string
from musclefit.rig.articulation import WITHIN_MM, FittedJoint, fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.vocabulary import Unit
from musclefit.workflows.given import word
from musclefit.workflows.results import Shown

SADDLE = "saddle"
"""Another word for a universal joint: its two axes lie on either side of the surfaces."""

SURE_DEG, SURE_MM = 10.0, 5.0
"""A joint whose standard deviations are beyond these is not to be believed without a look."""


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class JointFit(Shown):
    """A joint fitted to two bones.

    Parameters
    ----------
    fixed, moving : str
        The bones' names.
    found : FittedJoint
    """

    fixed: str
    moving: str
    found: FittedJoint

    @property
    def kind(self) -> JointKind:
        """Hinge, universal or ball."""
        return self.found.kind

    @property
    def centre_mm(self) -> Float:
        """(3,) a point of the axis, or the centre, mm."""
        return self.found.centre

    @property
    def axis(self) -> Float | None:
        """(3,) of length 1, of a hinge; the first of a universal joint; None of a ball."""
        return self.found.axes[0] if len(self.found.axes) else None

    @property
    def believable(self) -> bool:
        """Whether the fit is sure within 10 degrees and 5 mm, and no other axis fits nearly as well."""
        found = self.found
        return found.uncertain_deg <= SURE_DEG and found.uncertain_mm <= SURE_MM and not found.other_deg

    def said(self) -> str:
        """Centre and axes in a line."""
        axes = "".join(f", axis {_listed(axis, 6)}" for axis in self.found.axes)
        return f"{self.kind.value} of {self.fixed} and {self.moving}: centre {_listed(self.centre_mm, 3)} mm{axes}"

    def agreement(self) -> str:
        """How sure the fit is, in words."""
        found = self.found
        turned = f"{found.uncertain_deg:.1f} deg and " if len(found.axes) else ""
        said = f"uncertain by {turned}{found.uncertain_mm:.2f} mm (patches drawn anew, and what the bones disagree)"
        if found.other_deg:
            said += f"; an axis {found.other_deg:.0f} deg from it fits nearly as well"
        return said if self.believable else f"{said}: look at it before you believe it"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """What each bone says."""
        return {"sides": [asdict(side) for side in self.found.sides]}

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON values, lengths in mm, angles in degrees."""
        found = self.found
        return {
            "kind": self.kind.value,
            "fixed": self.fixed,
            "moving": self.moving,
            "centre_mm": [float(v) for v in self.centre_mm],
            "axes": [[float(v) for v in axis] for axis in found.axes],
            "axes_apart_mm": found.apart_mm,
            "gap_mm": found.gap_mm,
            "believable": self.believable,
            "uncertain_deg": found.uncertain_deg,
            "uncertain_mm": found.uncertain_mm,
            "redrawn_deg": found.redrawn_deg,
            "redrawn_mm": found.redrawn_mm,
            "other_deg": found.other_deg,
            "sides": [asdict(side) for side in found.sides],
        }

    def to_toml(self) -> str:
        """As it stands in a table of joints, with how sure it is as comments."""
        lines = [
            'units = "mm, degrees"',
            "",
            "[joint]                  # name it, and add the other bones that it moves",
            *self.entry("joint"),
            f"fixed = [{toml_string(self.fixed)}]",
            f"moving = [{toml_string(self.moving)}]",
            "",
            f"# {self.agreement()}",
        ]
        if self.kind is JointKind.UNIVERSAL:
            lines.append(
                f"# its two axes are {self.found.apart_mm:.1f} mm apart; a universal joint has them meet between"
            )
        for side in self.found.sides:
            turned = f"{side.alone_deg:.1f} deg and " if len(self.found.axes) else ""
            lines.append(
                f"# {side.of} bone: {side.facing_mm2:.0f} mm² face the other, {side.radius_mm:.2f} mm from the "
                f"{'axis' if len(self.found.axes) else 'centre'}; its end is {side.slope_deg:.0f} deg off a surface "
                f"that slides along itself; alone it gives a joint {turned}{side.alone_mm:.2f} mm from this one"
            )
        return "\n".join(lines)

    def entry(self, name: str) -> list[str]:
        """The lines of a table of joints that say centre, kind and axes; coordinates begin with a name."""
        centre = f"centre_mm = {_listed(self.centre_mm, 3)}"
        if self.kind is JointKind.HINGE:
            return [centre, f"axis = {_listed(self.found.axes[0], 6)}"]
        axes = np.eye(3) if self.kind is JointKind.BALL else self.found.axes
        coordinates = ", ".join(toml_string(coordinate) for coordinate in self.coordinates(name))
        listed = ", ".join(str(_listed(axis, 6)) for axis in axes)
        return [centre, f'kind = "{self.kind.value}"', f"axes = [{listed}]", f"coordinates = [{coordinates}]"]

    def coordinates(self, name: str) -> list[str]:
        """What a pose calls the joint's angles."""
        if self.kind is JointKind.HINGE:
            return [name]
        return [f"{name}_{letter}" for letter in ("xyz" if self.kind is JointKind.BALL else "ab")]


def fit_joint(
    fixed: str | Path,
    moving: str | Path,
    *,
    kind: JointKind | str = JointKind.HINGE,
    within_mm: float = WITHIN_MM,
    units: Unit | str = Unit.MILLIMETRE,
) -> JointFit:
    """Fit a joint's axes, or a ball's centre, where two bones face each other.

    Parameters
    ----------
    fixed, moving : path
        Surfaces of the bone that carries the joint and of the one that it moves.
    kind : {"hinge", "universal", "saddle", "ball"}
        A saddle is a universal joint whose axes lie on either side of the surfaces.
    within_mm : float
        Surfaces of the two that are within this distance more than their smallest gap face each other.
    units : {"mm", "cm", "m"}
        Of the files.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, or bones that face each other nowhere.
    """
    unit = word(Unit, units, what="units")
    joint = JointKind.UNIVERSAL if kind == SADDLE else word(JointKind, kind, what="kind")
    first, second = (read_surface(Path(path), units=unit).mesh() for path in (fixed, moving))
    return JointFit(Path(fixed).stem, Path(moving).stem, fitted_joint(first, second, kind=joint, within_mm=within_mm))


def _listed(values: Float, decimals: int) -> str:
    return str([round(float(v), decimals) for v in values])
