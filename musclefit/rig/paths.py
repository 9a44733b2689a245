"""Paths beside the straight one: through keyframes, along each bone's screw, joints through poses; knows no file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Points, frozen
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import BoneMotions, Handles
from musclefit.rig.joints import JointSystem
from musclefit.rig.keyframes import PoseKey
from musclefit.vocabulary import PathKind

FLAT_SHARE = 1e-6
"""Landmarks of a bone whose spread across their line is below this share of that along it leave its turn free."""


def turn_left_free(places: Points) -> bool:
    """Whether (k, 3) places of a rigid body leave a turn of it free: fewer than three, or all on one line."""
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return len(places) < 3 or bool(spread[1] <= FLAT_SHARE * spread[0])


@dataclass(frozen=True, eq=False, slots=True)
class KeyframePath:
    """Handles on straight lines from one keyframe to the next.

    Parameters
    ----------
    moments : (k,) tuple of float
        Rising from 0 to 1.
    keyframes : (k, m, n) float64, mm
        Where the handles are at each; the first is the rest, the last the destination.

    Raises
    ------
    LandmarkError
        Moments that do not rise from 0 to 1, or keyframes of another shape or with values that are not finite.
    """

    moments: tuple[float, ...]
    keyframes: Points

    def __post_init__(self) -> None:
        object.__setattr__(self, "keyframes", frozen(self.keyframes))
        if (self.moments[0], self.moments[-1]) != (0.0, 1.0) or any(b <= a for a, b in pairwise(self.moments)):
            raise LandmarkError(f"the keyframes are at {list(self.moments)}; give moments that rise from 0 to 1")
        if self.keyframes.ndim != 3 or len(self.keyframes) != len(self.moments):
            raise LandmarkError(
                f"{len(self.moments)} moments have keyframes of shape {self.keyframes.shape}; give one for each"
            )
        bad = np.argwhere(~np.isfinite(self.keyframes).all(axis=2))
        if bad.size:
            raise LandmarkError(
                f"handle {bad[0][1]} is not finite at {self.moments[bad[0][0]]:g} of the way; correct it"
            )

    def position(self, t: float) -> Points:
        """(m, n) handle positions at ``t``; exactly a keyframe's at its moment, mm."""
        later = next((k for k in range(1, len(self.moments)) if t <= self.moments[k]), len(self.moments) - 1)
        before, after = self.moments[later - 1], self.moments[later]
        share = (t - before) / (after - before)
        places: Points = (1.0 - share) * self.keyframes[later - 1] + share * self.keyframes[later]
        return places


@dataclass(frozen=True, eq=False, slots=True)
class ScrewPath:
    """Handles of a bone on the screw of the rigid motion that fits them best; handles without a bone go straight.

    What the rigid motion misses of a handle's destination grows evenly, in a frame that goes along with the bone.

    Parameters
    ----------
    handles : Handles
        With three or more of each bone, not on one line.
    target : (m, 3) float64, mm

    Raises
    ------
    LandmarkError
        Handles of a bone that leave its turn free.
    """

    handles: Handles
    target: Points

    def __post_init__(self) -> None:
        object.__setattr__(self, "target", frozen(self.target))
        for bone in self.bones():
            places = self.handles.source[self._of(bone)]
            if turn_left_free(places):
                raise LandmarkError(
                    f"the {len(places)} landmarks of bone {bone!r} leave its turn free, so it has no screw: give three "
                    'or more that are not on one line, or write deformer.path = "straight"'
                )

    def bones(self) -> tuple[str, ...]:
        """The bones that own handles."""
        return tuple(bone for bone in dict.fromkeys(self.handles.owner) if bone)

    def motions(self) -> Mapping[str, RigidMotion]:
        """The rigid motion of each bone, as its handles say it."""
        return {
            bone: RigidMotion.fitted(self.handles.source[self._of(bone)], self.target[self._of(bone)])
            for bone in self.bones()
        }

    def position(self, t: float) -> Points:
        """(m, 3) handle positions at ``t``; exactly the source at 0 and the target at 1, mm."""
        moved = (1.0 - t) * self.handles.source + t * self.target
        if t in (0.0, 1.0):
            return moved
        for bone, motion in self.motions().items():
            own = self._of(bone)
            source = self.handles.source[own]
            missed = motion.inverse()(self.target[own]) - source
            moved[own] = motion.fraction(t)(source + t * missed)
        return moved

    def _of(self, bone: str) -> Points:
        mask: Points = np.array([owner == bone for owner in self.handles.owner])
        return mask


@dataclass(frozen=True, eq=False, slots=True)
class ScrewMotions:
    """Each bone on the one screw that takes it from rest to its final motion, whatever joints lie between.

    Parameters
    ----------
    final : mapping of bone name to RigidMotion
    """

    final: Mapping[str, RigidMotion]

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name; exactly the final one at 1."""
        return self.final if t == 1.0 else {bone: motion.fraction(t) for bone, motion in self.final.items()}


@dataclass(frozen=True, eq=False, slots=True)
class KeyframeMotions:
    """A joint system on the way through poses; each joint turns evenly between the keyframes that name it.

    Parameters
    ----------
    joints : JointSystem
    poses : tuple of (moment, pose)
        Keyframes in order, the last at 1; joint names and degrees.

    Raises
    ------
    RigError
        A pose that the joints refuse.
    """

    joints: JointSystem
    poses: tuple[tuple[float, tuple[tuple[str, float], ...]], ...]

    def __post_init__(self) -> None:
        for _, pose in self.poses:
            self.joints.check_pose(dict(pose))

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name."""
        return self.joints.motions(self.pose_at(t))

    def pose_at(self, t: float) -> Mapping[str, float]:
        """The angle of each coordinate at ``t``, degrees."""
        return {name: float(np.interp(t, *line)) for name, line in self._lines().items()}

    def _lines(self) -> dict[str, tuple[Points, Points]]:
        """Moments and degrees of each coordinate's knots."""
        knots: dict[str, list[tuple[float, float]]] = {}
        for moment, pose in self.poses:
            for name, degrees in pose:
                knots.setdefault(name, [(0.0, 0.0)]).append((moment, degrees))
        for line in knots.values():
            if line[-1][0] < 1.0:
                line.append((1.0, 0.0))  # the destination leaves the joint out: it comes back to rest
        return {name: (np.array([m for m, _ in line]), np.array([d for _, d in line])) for name, line in knots.items()}


def motions_of(
    pose: Sequence[tuple[str, float]], joints: JointSystem, *, kind: PathKind, keyframes: Sequence[PoseKey] = ()
) -> BoneMotions:
    """The bones on the way to a pose: by their joints, through keyframes, or each on its screw.

    Parameters
    ----------
    pose : sequence of (str, float)
        Joints with their angles, degrees.
    joints : JointSystem
    kind : PathKind
    keyframes : sequence of PoseKey

    Raises
    ------
    RigError
        A pose that the joints refuse.
    """
    if kind is PathKind.SCREWS:
        return ScrewMotions(joints.motions(dict(pose)))
    if keyframes:
        return KeyframeMotions(joints, (*((key.at, key.pose) for key in keyframes), (1.0, tuple(pose))))
    return joints.along(dict(pose))
