"""A joint fitted to two bones, from their files to an axis or a centre and what the fit leaves over."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.tables import toml_string
from musclefit.rig.articulation import WITHIN_MM, FittedJoint, fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.rig.named_joints import named_joints
from musclefit.vocabulary import Unit
from musclefit.workflows.given import word
from musclefit.workflows.results import Shown

SADDLE = "saddle"
"""Another word for a universal joint: its two axes lie on either side of the surfaces."""

NAMED = "named"
"""The kind of the joint that the bones' names say."""

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
    also_moving : tuple of str
        Further bones whose surfaces were fitted as one with the moving bone's.
    """

    fixed: str
    moving: str
    found: FittedJoint
    also_moving: tuple[str, ...] = ()

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
        moving = ", ".join((self.moving, *self.also_moving))
        return f"{self.kind.value} of {self.fixed} and {moving}: centre {_listed(self.centre_mm, 3)} mm{axes}"

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
            "also_moving": list(self.also_moving),
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
            f"moving = [{', '.join(toml_string(name) for name in (self.moving, *self.also_moving))}]",
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
    moving: str | Path | Sequence[str | Path],
    *,
    kind: JointKind | str = JointKind.HINGE,
    within_mm: float = WITHIN_MM,
    units: Unit | str = Unit.MILLIMETRE,
) -> JointFit:
    """Fit a joint's axes, or a ball's centre, where bones face each other.

    Parameters
    ----------
    fixed : path
        Surface of the bone that carries the joint.
    moving : path, or several
        Surface of the bone that it moves; of several, such as scaphoid and lunate, all that face the fixed one.
    kind : {"hinge", "universal", "saddle", "ball", "named"}
        A saddle is a universal joint whose axes lie on either side of the surfaces; "named" is the kind that the files'
        names say, as those of radius and scaphoid do.
    within_mm : float
        Surfaces of the two that are within this distance more than their smallest gap face each other.
    units : {"mm", "cm", "m"}
        Of the files.

    Returns
    -------
    JointFit
        Centre (mm) and axes with their uncertainty, and whether they are to be believed (``believable``).

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, bones that face each other nowhere, or a kind that their names do not say.
    """
    unit = word(Unit, units, what="units")
    paths = [Path(fixed), *map(Path, [moving] if isinstance(moving, str | Path) else moving)]
    if len(paths) < 2:
        raise InputError("no moving bone is given; give the surface of at least one")
    names = [path.stem for path in paths]
    joint = _named_kind(names) if kind == NAMED else JointKind.UNIVERSAL if kind == SADDLE else _kind(kind)
    first, *others = (read_surface(path, units=unit).mesh() for path in paths)
    found = fitted_joint(first, TriMesh.together(others), kind=joint, within_mm=within_mm)
    return JointFit(names[0], names[1], found, tuple(names[2:]))


def _kind(kind: JointKind | str) -> JointKind:
    return word(JointKind, kind, what="kind")


def _named_kind(names: Sequence[str]) -> JointKind:
    """The kind of the joint that the names of bones say, the one that carries it first."""
    found = named_joints(names, meeting={names[0]: names[1:]})
    kinds = {one.kind for one in found}
    if len(kinds) != 1:
        raise InputError(
            f"the names {', '.join(map(repr, names))} say no joint that is known, the bone that carries it first (such "
            "as femur and tibia, radius and scaphoid, trapezium and first metacarpal); name the kind: hinge, "
            "universal, saddle or ball"
        )
    return kinds.pop()


def _listed(values: Float, decimals: int) -> str:
    return str([round(float(v), decimals) for v in values])
