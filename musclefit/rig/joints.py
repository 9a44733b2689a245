"""Joints: takes a table of axes and the bones they move, gives every bone's rigid motion in a pose; knows no file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from musclefit.errors import RigError
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.joint_kinds import Coupling, Joint
from musclefit.rig.joint_tables import read_coupling, read_joint
from musclefit.rig.table_reader import Section, suggestion
from musclefit.vocabulary import Unit

_TEXTS = ("units", "source", "order")
"""Top-level keys that are not joints; ``order`` is prose for the reader, the composition follows from the bones."""

MOST_TURN_DEG = 360.0
"""How far a coordinate without limits turns: a pose beyond it is a slip or another unit, and takes long to walk to."""


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
    still : tuple of str
        Bones that no joint knows, and that stay where they are.

    Raises
    ------
    RigError
        Joints whose order is ambiguous or cyclic, a bone that a joint both fixes and moves, a coupling that follows
        no joint, or a bone that is moved twice over.
    """

    joints: tuple[Joint, ...]
    couplings: tuple[Coupling, ...]
    source: str
    still: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for first, joint in enumerate(self.joints):
            for other in self.joints[first + 1 :]:
                self._require_order(joint, other)
        self._require_coordinates()
        for coupling in self.couplings:
            self._require_free(coupling)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """What a pose may set: every coordinate that no other one sets."""
        return tuple(name for joint in self.joints if joint.coupled is None for name in joint.coordinates)

    def bones(self) -> tuple[str, ...]:
        """Every bone that a joint fixes or moves, or that follows one, and those that stay still, each once."""
        named = [bone for joint in self.joints for bone in (*joint.fixed, *joint.moving)]
        return tuple(dict.fromkeys([*named, *(coupling.bone for coupling in self.couplings), *self.still]))

    def with_still(self, bones: Iterable[str]) -> JointSystem:
        """With bones that stay where they are, of those that no joint knows."""
        known = self.bones()
        return replace(self, still=(*self.still, *(bone for bone in bones if bone not in known)))

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
        limits = {
            name: low_high for j in self.joints for name, low_high in zip(j.coordinates, j.limits_deg, strict=True)
        }
        set_by = {coupling.name: coupling.follows for coupling in self.couplings}
        set_by |= {joint.name: joint.coupled.to for joint in self.joints if joint.coupled is not None}
        for name, degrees in pose.items():
            if name in set_by:
                raise RigError(f"pose of {name!r}: it follows joint {set_by[name]!r} ({self.source}); pose that joint")
            if name not in limits:
                raise RigError(f"pose of {name!r}: no such joint in {self.source}; {suggestion(name, limits)}")
            if not np.isfinite(degrees):
                raise RigError(f"pose of {name!r}: found {degrees}; expected a finite angle in degrees")
        for name, degrees in self._angles(pose).items():
            low, high = limits[name]
            if not low <= degrees <= high:
                raise RigError(
                    f"pose of {name!r}: found {degrees:g} degrees, but limits_deg in {self.source} is "
                    f"[{low:g}, {high:g}]; pose it inside"
                )
            if abs(degrees) > MOST_TURN_DEG and not np.isfinite([low, high]).all():
                raise RigError(
                    f"pose of {name!r}: found {degrees:g} degrees, and {self.source} gives it no limits_deg; a joint "
                    f"without limits turns at most {MOST_TURN_DEG:g} degrees either way: correct the pose or add limits"
                )

    def motions(self, pose: Mapping[str, float]) -> Mapping[str, RigidMotion]:
        """The motion of every bone from rest to a pose.

        Parameters
        ----------
        pose : mapping of coordinate to angle, degrees
            A hinge's coordinate is its name. Those left out stay at rest.

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
        angles = self._angles(pose)
        turned = {joint.name: joint.motion(angles) for joint in self.joints}
        motions: dict[str, RigidMotion] = {}
        for bone in self.bones():
            motions[bone] = _product([turned[joint.name] for joint in self._chain(bone)])
        for coupling in self.couplings:
            joint = self._owner(coupling.follows)
            own = joint.motion({coupling.follows: coupling.fraction * angles[coupling.follows]})
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

    def _owner(self, coordinate: str) -> Joint:
        return next(joint for joint in self.joints if coordinate in joint.coordinates)

    def _angles(self, pose: Mapping[str, float]) -> dict[str, float]:
        """Every coordinate's angle, those that follow another one included."""
        angles = {name: float(pose.get(name, 0.0)) for name in self.coordinates}
        for joint in self.joints:
            if joint.coupled is not None:
                angles[joint.name] = joint.coupled.angle(angles[joint.coupled.to])
        return angles

    def _require_coordinates(self) -> None:
        """Raise RigError where two joints share a coordinate, or one follows a coordinate that no pose sets."""
        seen: dict[str, str] = {}
        for joint in self.joints:
            for name in joint.coordinates:
                if name in seen:
                    raise self._error(
                        f"{joint.name}.coordinates", f"joint {seen[name]!r} has a coordinate {name!r} too; rename one"
                    )
                seen[name] = joint.name
        for joint in self.joints:
            if joint.coupled is not None and joint.coupled.to not in self.coordinates:
                raise self._error(
                    f"{joint.name}.couple.to",
                    f"no pose sets a coordinate {joint.coupled.to!r}; {suggestion(joint.coupled.to, self.coordinates)}",
                )

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
        names = [name for joint in self.joints for name in joint.coordinates]
        if coupling.follows not in names:
            raise self._error(
                f"{coupling.name}.follows",
                f"no joint is named {coupling.follows!r}; {suggestion(coupling.follows, names)}",
            )
        carriers = self._proximal_to(self._owner(coupling.follows))
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
    """The motions of a joint system on the way from rest to ``pose`` (coordinates and degrees): `BoneMotions`."""

    joints: JointSystem
    pose: tuple[tuple[str, float], ...]

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name: the pose with every angle multiplied by ``t``."""
        return self.joints.motions(self.pose_at(t))

    def pose_at(self, t: float) -> Mapping[str, float]:
        """The angle of each coordinate at ``t``, degrees."""
        return {name: t * degrees for name, degrees in self.pose}


def parse_joints(table: Mapping[str, Any], *, source: str) -> JointSystem:
    """Read a table of joints.

    Parameters
    ----------
    table : mapping
        As json or tomllib give it: ``units`` ("mm", or "mm, degrees"), optional texts ``source`` and ``order``, and
        per joint ``kind`` ("hinge", which it is without one, "universal", "ball" or "screw"), ``centre_mm``
        (``centre_cm``, ``centre_m``: the unit of ``units``), ``axis`` (or ``axes`` and ``coordinates``), ``fixed``,
        ``moving`` and optionally ``limits_deg``, ``couple``, ``positive`` and ``order`` (texts); or, for a bone that
        follows a coordinate, ``follows``, ``fraction`` and ``bone``.
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
            couplings.append(read_coupling(name, section))
        else:
            joints.append(read_joint(name, section, unit=unit))
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


def _product(motions: list[RigidMotion]) -> RigidMotion:
    """The motions multiplied in order: the last is done first."""
    whole = RigidMotion.identity()
    for motion in motions:
        whole = whole @ motion
    return whole
