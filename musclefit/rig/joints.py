"""Joints: takes a table of axes and the bones they move, gives every bone's rigid motion in a pose; knows no file."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from musclefit.errors import RigError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.model import Unit
from musclefit.rig.section import Section, suggestion

_TEXTS = ("units", "source", "order")
"""Top-level keys that are not joints; ``order`` is prose for the reader, the composition follows from the bones."""
_COUPLING = ("follows", "fraction", "bone", "source")
_NO_LIMITS = (-np.inf, np.inf)


@dataclass(frozen=True, eq=False, slots=True)
class Joint:
    """A hinge, stated in the rest pose.

    Parameters
    ----------
    name : str
    centre : (3,) float64, mm
        Any point of the axis.
    axis : (3,) float64
        Direction of the axis; positive angles turn by the right-hand rule. Kept with length 1.
    fixed : tuple of str
        The bones that carry the axis.
    moving : tuple of str
        Every bone that the joint moves, also those beyond the next joint.
    limits_deg : (low, high), degrees
        The range of the joint; infinite where it states none.
    """

    name: str
    centre: Points
    axis: Float
    fixed: tuple[str, ...]
    moving: tuple[str, ...]
    limits_deg: tuple[float, float] = _NO_LIMITS

    def __post_init__(self) -> None:
        axis = np.asarray(self.axis, dtype=np.float64)
        object.__setattr__(self, "centre", frozen(self.centre))
        object.__setattr__(self, "axis", frozen(axis / np.linalg.norm(axis)))

    def motion(self, degrees: float) -> RigidMotion:
        """Rotation by ``degrees`` about the rest-pose axis."""
        return RigidMotion.about_axis(centre=self.centre, axis=self.axis, angle_deg=degrees)


@dataclass(frozen=True, slots=True)
class Coupling:
    """A bone that turns by a fraction of a joint's angle about that joint's axis, as the patella follows the knee.

    The bone rides on whatever carries that axis.
    """

    name: str
    follows: str
    fraction: float
    bone: str


@dataclass(frozen=True, eq=False, slots=True)
class JointSystem:
    """Joints and coupled bones, ordered by the bones they move.

    Joint A is proximal to joint B when A moves every bone that B moves and more, or carries B's axis. Bones move by
    the product of their joints, the proximal joint applied last, all about rest-pose axes.

    Parameters
    ----------
    joints : tuple of Joint
    couplings : tuple of Coupling
    source : str
        The file, for messages.

    Raises
    ------
    RigError
        Joints whose order is ambiguous or cyclic, a bone that a joint both fixes and moves, a coupling that follows
        no joint, or a bone that is moved twice over.
    """

    joints: tuple[Joint, ...]
    couplings: tuple[Coupling, ...]
    source: str

    def __post_init__(self) -> None:
        for first, joint in enumerate(self.joints):
            for other in self.joints[first + 1 :]:
                self._require_order(joint, other)
        for coupling in self.couplings:
            self._require_free(coupling)

    def bones(self) -> tuple[str, ...]:
        """Every bone that a joint fixes or moves, or that follows one, each once."""
        named = [bone for joint in self.joints for bone in (*joint.fixed, *joint.moving)]
        return tuple(dict.fromkeys([*named, *(coupling.bone for coupling in self.couplings)]))

    def check_bones(self, anatomy_names: Collection[str]) -> None:
        """Raise RigError at the first bone that is not among the bones of the anatomy."""
        for joint in self.joints:
            for role in ("fixed", "moving"):
                for bone in getattr(joint, role):
                    if bone not in anatomy_names:
                        raise self._error(
                            f"{joint.name}.{role}",
                            f"the anatomy has no bone {bone!r}; {suggestion(bone, anatomy_names)}",
                        )
        for coupling in self.couplings:
            if coupling.bone not in anatomy_names:
                problem = f"the anatomy has no bone {coupling.bone!r}; {suggestion(coupling.bone, anatomy_names)}"
                raise self._error(f"{coupling.name}.bone", problem)

    def check_pose(self, pose: Mapping[str, float]) -> None:
        """Raise RigError where the pose names no joint of the system, is not finite, or exceeds a joint's limits."""
        joints = {joint.name: joint for joint in self.joints}
        followers = {coupling.name: coupling for coupling in self.couplings}
        for name, degrees in pose.items():
            if name in followers:
                follows = followers[name].follows
                raise RigError(f"pose of {name!r}: it follows joint {follows!r} ({self.source}); pose that joint")
            if name not in joints:
                raise RigError(f"pose of {name!r}: no such joint in {self.source}; {suggestion(name, joints)}")
            low, high = joints[name].limits_deg
            if not np.isfinite(degrees):
                raise RigError(f"pose of {name!r}: found {degrees}; expected a finite angle in degrees")
            if not low <= degrees <= high:
                raise RigError(
                    f"pose of {name!r}: found {degrees:g} degrees, but limits_deg in {self.source} is "
                    f"[{low:g}, {high:g}]; pose it inside"
                )

    def motions(self, pose: Mapping[str, float]) -> Mapping[str, RigidMotion]:
        """The motion of every bone from rest to a pose.

        Parameters
        ----------
        pose : mapping of joint name to angle, degrees
            Joints that it leaves out stay at rest.

        Returns
        -------
        mapping of bone name to RigidMotion
            The identity for bones that no joint moves.

        Raises
        ------
        RigError
            As `check_pose`.
        """
        self.check_pose(pose)
        turned = {joint.name: joint.motion(float(pose.get(joint.name, 0.0))) for joint in self.joints}
        motions: dict[str, RigidMotion] = {}
        for bone in self.bones():
            motions[bone] = _product([turned[joint.name] for joint in self._chain(bone)])
        for coupling in self.couplings:
            joint = self._joint(coupling.follows)
            own = joint.motion(coupling.fraction * float(pose.get(joint.name, 0.0)))
            carriers = [turned[a.name] for a in self._proximal_to(joint)]
            motions[coupling.bone] = _product([*carriers, own])
        return motions

    def along(self, pose: Mapping[str, float]) -> JointMotions:
        """The motions on the way from rest to a pose, every joint turning evenly.

        Raises
        ------
        RigError
            As `check_pose`.
        """
        self.check_pose(pose)
        return JointMotions(self, tuple((name, float(degrees)) for name, degrees in pose.items()))

    def _joint(self, name: str) -> Joint:
        return next(joint for joint in self.joints if joint.name == name)

    def _chain(self, bone: str) -> list[Joint]:
        """The joints that move a bone, the most proximal first: their moving sets are nested."""
        return sorted((j for j in self.joints if bone in j.moving), key=lambda j: -len(j.moving))

    def _proximal_to(self, joint: Joint) -> list[Joint]:
        """The joints that carry a joint's axis, the most proximal first."""
        carriers = (j for j in self.joints if set(j.moving) > set(joint.moving))
        return sorted(carriers, key=lambda j: -len(j.moving))

    def _require_order(self, a: Joint, b: Joint) -> None:
        """Raise RigError unless two joints are nested, or independent of each other."""
        a_carries, b_carries = set(b.fixed) & set(a.moving), set(a.fixed) & set(b.moving)
        shared = set(a.moving) & set(b.moving)
        if a_carries and b_carries:
            raise self._error(
                b.name,
                f"the order is cyclic: joint {a.name!r} moves {min(a_carries)!r}, which {b.name!r} fixes, and "
                f"{b.name!r} moves {min(b_carries)!r}, which {a.name!r} fixes; correct fixed and moving",
            )
        if set(a.moving) == set(b.moving):
            raise self._error(
                b.name,
                f"moves the same bones as joint {a.name!r}, so their order is ambiguous; the proximal joint must "
                "move more bones than the distal one",
            )
        for proximal, distal, carried in ((a, b, a_carries), (b, a, b_carries)):
            left_out = sorted(set(distal.moving) - set(proximal.moving))
            if carried and left_out:
                raise self._error(
                    f"{proximal.name}.moving",
                    f"moves {min(carried)!r}, which carries joint {distal.name!r}, but leaves {left_out[0]!r} behind, "
                    f"which {distal.name!r} moves; list every bone beyond the joint",
                )
            torn = sorted(set(distal.fixed) - set(proximal.moving))
            if carried and torn:
                raise self._error(
                    f"{proximal.name}.moving",
                    f"moves {min(carried)!r} but not {torn[0]!r}, and both carry joint {distal.name!r}; "
                    "list both or neither",
                )
        if shared and not (set(a.moving) < set(b.moving) or set(b.moving) < set(a.moving)):
            raise self._error(
                b.name,
                f"the order is ambiguous: joints {a.name!r} and {b.name!r} both move {min(shared)!r}, but each also "
                "moves bones that the other does not; the bones of one must be among those of the other",
            )

    def _require_free(self, coupling: Coupling) -> None:
        """Raise RigError unless a coupling follows a joint and nothing else turns its bone."""
        names = [joint.name for joint in self.joints]
        if coupling.follows not in names:
            raise self._error(
                f"{coupling.name}.follows",
                f"no joint is named {coupling.follows!r}; {suggestion(coupling.follows, names)}",
            )
        carriers = self._proximal_to(self._joint(coupling.follows))
        for joint in self.joints:
            if coupling.bone in joint.moving and joint not in carriers:
                raise self._error(
                    f"{coupling.name}.bone",
                    f"joint {joint.name!r} moves {coupling.bone!r} already; remove it from one of the two",
                )
            if coupling.bone in joint.fixed:
                raise self._error(
                    f"{coupling.name}.bone",
                    f"{coupling.bone!r} also carries joint {joint.name!r}, which does not move with it; "
                    "make it a joint of its own",
                )
        twins = [other.name for other in self.couplings if other.bone == coupling.bone]
        if len(twins) > 1:
            raise self._error(
                f"{twins[1]}.bone", f"{coupling.bone!r} follows {twins[0]!r} already; remove one of the two"
            )

    def _error(self, key: str, problem: str) -> RigError:
        return RigError(f"{self.source}: {key}: {problem}")


@dataclass(frozen=True, eq=False, slots=True)
class JointMotions:
    """The motions of a joint system on the way from rest to ``pose`` (joint names and degrees): `BoneMotions`."""

    joints: JointSystem
    pose: tuple[tuple[str, float], ...]

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name: the pose with every angle multiplied by ``t``."""
        return self.joints.motions({name: t * degrees for name, degrees in self.pose})


def parse_joints(table: Mapping[str, Any], *, source: str) -> JointSystem:
    """Read a table of joints.

    Parameters
    ----------
    table : mapping
        As json or tomllib give it: ``units`` ("mm", or "mm, degrees"), optional texts ``source`` and ``order``, and
        per joint either ``centre_mm`` (``centre_cm``, ``centre_m``: the unit of ``units``), ``axis``, ``fixed``,
        ``moving`` and optionally ``limits_deg = [low, high]``, ``positive`` and ``order`` (texts), or, for a bone
        that follows a joint, ``follows``, ``fraction`` and ``bone``.
    source : str
        The file, for messages.

    Raises
    ------
    RigError
        A key that is missing, unknown or of another type, a centre or axis that is not three finite numbers, an axis
        of length zero, limits that leave out the rest pose, or what `JointSystem` refuses.
    """
    root = Section(table, source)
    root.require(("units",))
    unit = _unit(root)
    for key in ("source", "order"):
        if key in root:
            root.text(key)
    joints: list[Joint] = []
    couplings: list[Coupling] = []
    for name in table:
        if name in _TEXTS:
            continue
        if not isinstance(table[name], Mapping):
            known = ", ".join(_TEXTS)
            raise root.error(name, f"unknown key; known: {known}, and joints, which are tables")
        section = root.section(name)
        if "follows" in section:
            couplings.append(_coupling(name, section))
        else:
            joints.append(_joint(name, section, unit=unit))
    if not joints:
        raise RigError(f"{source}: holds no joint; add a table with axis, centre_{unit}, fixed and moving")
    return JointSystem(tuple(joints), tuple(couplings), source)


def _unit(root: Section) -> Unit:
    words = [word.strip() for word in root.text("units").split(",")]
    lengths = [unit.value for unit in Unit]
    if words[0] not in lengths or words[1:] not in ([], ["degrees"]):
        raise root.error(
            "units",
            f"found {root.text('units')!r}; expected a length unit ({', '.join(lengths)}), alone or followed by "
            '", degrees"',
        )
    return Unit(words[0])


def _joint(name: str, section: Section, *, unit: Unit) -> Joint:
    centre_key = f"centre_{unit.value}"
    for other in Unit:
        if other is not unit and f"centre_{other.value}" in section:
            raise section.error(f"centre_{other.value}", f'the file\'s units are "{unit.value}": write {centre_key}')
    section.refuse_unknown((centre_key, "axis", "fixed", "moving", "positive", "order", "source", "limits_deg"))
    section.require((centre_key, "axis", "fixed", "moving"))
    for key in ("positive", "order", "source"):
        if key in section:
            section.text(key)
    axis = section.vector("axis", length=3)
    largest = float(np.abs(axis).max())
    if not 1.0 / _LONGEST_AXIS < largest < _LONGEST_AXIS:
        raise section.error(
            "axis", f"found {axis.tolist()}, which is too short or too long to give a direction; scale it to length 1"
        )
    fixed, moving = section.texts("fixed"), section.texts("moving")
    if not moving:
        raise section.error("moving", "is empty; list every bone that the joint moves")
    both = sorted(set(fixed) & set(moving))
    if both:
        raise section.error("moving", f"{both[0]!r} is listed in fixed too; remove it from one of the two")
    return Joint(name, section.vector(centre_key, length=3) * unit.in_mm, axis, fixed, moving, _limits(section))


_LONGEST_AXIS = 1e9
"""Longer axes, and shorter ones than its inverse, are slips rather than directions; units do not matter here."""


def _limits(section: Section) -> tuple[float, float]:
    if "limits_deg" not in section:
        return _NO_LIMITS
    low, high = (float(value) for value in section.vector("limits_deg", length=2))
    if not low <= 0.0 <= high or low == high:
        raise section.error(
            "limits_deg", f"found [{low:g}, {high:g}]; expected [low, high] with the rest pose, 0 degrees, inside"
        )
    return low, high


def _coupling(name: str, section: Section) -> Coupling:
    section.refuse_unknown(_COUPLING)
    section.require(("follows", "fraction", "bone"))
    return Coupling(name, section.text("follows"), section.number("fraction"), section.text("bone"))


def _product(motions: list[RigidMotion]) -> RigidMotion:
    """The motions multiplied in order: the last is done first."""
    whole = RigidMotion.identity()
    for motion in motions:
        whole = whole @ motion
    return whole
