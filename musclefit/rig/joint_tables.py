"""Tables of single joints: takes a section, gives a `Joint` or a `Coupling`, or an error that names the key."""

from __future__ import annotations

import numpy as np

from musclefit.geometry.arrays import Float
from musclefit.rig.joint_kinds import AXES, CoordinateCoupling, Coupling, Joint, JointKind
from musclefit.rig.table_reader import Section
from musclefit.vocabulary import Unit

_COUPLING = ("follows", "fraction", "bone", "source")
_NO_LIMITS = (-np.inf, np.inf)
_PARALLEL = 1e-6
"""Axes of one joint must span a volume (an area) larger than this, all of length 1."""
_LONGEST_AXIS = 1e9
"""Longer axes, and shorter ones than its inverse, are mistakes rather than directions; units do not matter here."""


def read_joint(name: str, section: Section, *, unit: Unit) -> Joint:
    """A joint of its table; RigError names the key that is wrong."""
    kind = section.choice("kind", JointKind) if "kind" in section else JointKind.HINGE
    centre_key, pitch_key = f"centre_{unit.value}", f"pitch_{unit.value}_per_turn"
    single = AXES[kind] == 1
    for other in Unit:
        if other is not unit:
            for key, ours in ((f"centre_{other.value}", centre_key), (f"pitch_{other.value}_per_turn", pitch_key)):
                if key in section:
                    raise section.error(key, f'the file\'s units are "{unit.value}": write {ours}')
    own = ["axis", "couple"] if single else ["axes", "coordinates"]
    required = [centre_key, own[0], "fixed", "moving", *(own[1:] if not single else [])]
    if kind is JointKind.SCREW:
        required.append(pitch_key)
    texts = ("positive", "order", "source")
    section.refuse_unknown(("kind", *required, *own, *texts, "limits_deg"))
    section.require(required)
    for key in texts:
        if key in section:
            section.text(key)
    axes = _axis(section, "axis")[None] if single else _axes(section, AXES[kind])
    coordinates = (name,) if single else section.texts("coordinates")
    if len(coordinates) != len(axes):
        raise section.error("coordinates", f"found {len(coordinates)}; a {kind} joint has {len(axes)}, one for an axis")
    fixed, moving = section.texts("fixed"), section.texts("moving")
    if not moving:
        raise section.error("moving", "is empty; list every bone that the joint moves")
    both = sorted(set(fixed) & set(moving))
    if both:
        raise section.error("moving", f"{both[0]!r} is listed in fixed too; remove it from one of the two")
    return Joint(
        name=name,
        kind=kind,
        centre=section.vector(centre_key, length=3) * unit.in_mm,
        axes=axes,
        coordinates=coordinates,
        fixed=fixed,
        moving=moving,
        limits_deg=_limits(section, single=single, count=len(axes)),
        pitch_mm_per_turn=section.number(pitch_key) * unit.in_mm if kind is JointKind.SCREW else 0.0,
        coupled=_couple(section.section("couple")) if "couple" in section else None,
    )


def read_coupling(name: str, section: Section) -> Coupling:
    """A bone that follows a coordinate, of its table."""
    section.refuse_unknown(_COUPLING)
    section.require(("follows", "fraction", "bone"))
    return Coupling(name, section.text("follows"), section.number("fraction"), section.text("bone"))


def _couple(section: Section) -> CoordinateCoupling:
    section.refuse_unknown(("to", "fraction", "points_deg"))
    section.require(("to",))
    if ("fraction" in section) == ("points_deg" in section):
        raise section.error("fraction", "give one of fraction and points_deg, and not both")
    if "fraction" in section:
        return CoordinateCoupling(section.text("to"), section.number("fraction"), np.zeros((0, 2)))
    points = _rows(section, "points_deg", columns=2)
    if len(points) < 2 or not (np.diff(points[:, 0]) > 0.0).all():
        raise section.error(
            "points_deg", "expected at least two pairs [angle of the other, own angle], rising in the first"
        )
    if not (points == 0.0).all(axis=1).any():
        raise section.error("points_deg", "leaves out the rest pose; add [0, 0]")
    return CoordinateCoupling(section.text("to"), 0.0, points)


def _axis(section: Section, key: str) -> Float:
    axis = section.vector(key, length=3)
    largest = float(np.abs(axis).max())
    if not 1.0 / _LONGEST_AXIS < largest < _LONGEST_AXIS:
        raise section.error(
            key, f"found {axis.tolist()}, which is too short or too long to give a direction; scale it to length 1"
        )
    return axis


def _axes(section: Section, count: int) -> Float:
    """Axes that point in really different directions."""
    rows = section.table["axes"]
    if not isinstance(rows, list | tuple) or len(rows) != count:
        raise section.error("axes", f"expected a list of {count} axes, [[x, y, z], ...]")
    axes = np.stack([_axis(_row(section, "axes", row), "axes") for row in rows])
    unit = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    if float(np.linalg.svd(unit, compute_uv=False)[-1]) < _PARALLEL:
        lie = "are parallel" if count == 2 else "lie in a plane"
        raise section.error("axes", f"the {count} axes {lie}; the joint would not move as its kind says, turn one")
    directions: Float = unit
    return directions


def _limits(section: Section, *, single: bool, count: int) -> tuple[tuple[float, float], ...]:
    if "limits_deg" not in section:
        return (_NO_LIMITS,) * count
    rows = section.vector("limits_deg", length=2)[None] if single else _rows(section, "limits_deg", columns=2)
    if len(rows) != count:
        raise section.error("limits_deg", f"found {len(rows)} ranges; expected one [low, high] for each coordinate")
    for low, high in rows.tolist():
        if not low <= 0.0 <= high or low == high:
            raise section.error(
                "limits_deg", f"found [{low:g}, {high:g}]; expected [low, high] with the rest pose, 0 degrees, inside"
            )
    return tuple((float(low), float(high)) for low, high in rows)


def _rows(section: Section, key: str, *, columns: int) -> Float:
    """A list of lists of numbers."""
    rows = section.table[key]
    if not isinstance(rows, list | tuple):
        raise section.error(key, f"expected a list of lists of {columns} numbers")
    return np.array([_row(section, key, row).vector(key, length=columns) for row in rows]).reshape(-1, columns)


def _row(section: Section, key: str, row: object) -> Section:
    """One row as a table of its own, so that it is read as strictly as everything else."""
    return Section({key: row}, section.source, section.key)
