"""Skeleton handles: takes a curve of landmarks, gives it cross-sections and a path that bends and twists them along.

A curve alone says nothing of the rotation about itself, and its landmarks may be collinear. Each of its landmarks
(a *station*) therefore gets a frame, transported along the curve without twist, and carries a section of derived
landmarks in it. Between two poses of the curve the *bend of each segment* is interpolated, not the positions: the
motion from one station's frame to the next is a screw, and the screws' rotation and translation vectors grow linearly.
A bar bends through ever stronger circular arcs and no chord is ever cut short. Twist is an angle that is added to the
frames afterwards, so that it may exceed half a turn.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import Handles

SHORTEST_SHARE = 1e-9
"""Neighbouring stations closer than this share of the curve's extent are one place."""

STRAIGHT_BACK = 1e-9
"""A turn from one direction to another whose cosine is closer to -1 than this has no axis."""

ALONG = 1e-6
"""A normal whose part across the curve is less than this share of its length says nothing of a section's direction."""


@dataclass(frozen=True, eq=False, slots=True)
class Skeleton:
    """A curve of landmarks at rest and the section that each of them carries.

    Parameters
    ----------
    curve : (k, 3) float64, mm
        Landmarks in order along the curve, at least two.
    normal : (3,) float64
        A direction that is not along the curve's beginning: the first axis of the first section.
    section : (q, 2) float64, mm
        Derived landmarks in each station's frame, along its normal and binormal; for example `ring`. At least two that
        do not lie on one line with the station.

    Raises
    ------
    LandmarkError
        Fewer than two landmarks, two neighbours at one place, a curve that turns straight back, values that are not
        finite, a normal along the curve, or a section that leaves the rotation about the curve free.
    """

    curve: Points
    normal: Points
    section: Points

    def __post_init__(self) -> None:
        for name in ("curve", "normal", "section"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        _require_curve(self.curve)
        if self.normal.shape != (3,) or not np.isfinite(self.normal).all():
            raise LandmarkError(f"the skeleton's normal is {self.normal}; give a direction of 3 numbers")
        if self.section.ndim != 2 or self.section.shape[1] != 2 or not np.isfinite(self.section).all():
            raise LandmarkError(f"the section has shape {self.section.shape}; give finite (q, 2) offsets in mm")
        sizes = np.linalg.svd(self.section, compute_uv=False)
        if len(sizes) < 2 or sizes[1] <= SHORTEST_SHARE * sizes[0]:
            raise LandmarkError(
                f"the section of {len(self.section)} points does not fix the rotation about the curve; give at least 2 "
                "points that are not in line with the station, for example a ring of 4"
            )
        _first_normal(tangents(self.curve)[0], self.normal)

    def frames(self) -> Float:
        """(k, 3, 3) frames at rest; the columns are normal, binormal and tangent."""
        return rotation_minimising_frames(self.curve, normal=self.normal)

    def handles(self, name: str) -> Handles:
        """The landmarks (``name_0``, ``name_1``, ...) and, after all of them, their sections (``name_0_section_0``)."""
        names = [f"{name}_{k}" for k in range(len(self.curve))]
        names += [f"{name}_{k}_section_{j}" for k in range(len(self.curve)) for j in range(len(self.section))]
        return Handles(tuple(names), _placed(self.curve, self.frames(), self.section), ("",) * len(names))


@dataclass(frozen=True, eq=False, slots=True)
class SkeletonPose:
    """Where the landmarks of a skeleton are at one moment of a path.

    Parameters
    ----------
    at : float
        The moment, in (0, 1].
    curve : (k, 3) float64, mm
    twist_deg : (k,) float64, degrees
        How far each station is turned about the curve, by the right-hand rule about its direction, against frames
        without twist. Any number of turns.

    Raises
    ------
    LandmarkError
        A curve as `Skeleton` refuses it, or not one finite angle for each station.
    """

    at: float
    curve: Points
    twist_deg: Float

    def __post_init__(self) -> None:
        for name in ("curve", "twist_deg"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        _require_curve(self.curve)
        if self.twist_deg.shape != (len(self.curve),) or not np.isfinite(self.twist_deg).all():
            raise LandmarkError(
                f"the twist has shape {self.twist_deg.shape}; give one finite angle for each of the "
                f"{len(self.curve)} stations"
            )


@dataclass(frozen=True, eq=False, slots=True)
class SkeletonPath:
    """The handles of a skeleton on the way from rest through its poses.

    At a pose the landmarks are exactly where it states. Its first frame is that of the pose before, turned by the
    smallest rotation that takes one curve's beginning to the other's; state a twist where that is not meant.

    Parameters
    ----------
    skeleton : Skeleton
        At rest: the pose at 0, without twist.
    poses : tuple of SkeletonPose
        In order; the last is at 1.

    Raises
    ------
    LandmarkError
        No poses, moments that do not rise to 1, another number of stations than the skeleton, or a curve whose
        beginning turns straight back from one pose to the next.
    """

    skeleton: Skeleton
    poses: tuple[SkeletonPose, ...]
    _keys: tuple[_Key, ...] = field(init=False, repr=False)
    """Rest and poses with their frames, computed once."""

    def __post_init__(self) -> None:
        moments = [0.0, *(pose.at for pose in self.poses)]
        if moments[-1] != 1.0 or any(b <= a for a, b in itertools.pairwise(moments)):
            raise LandmarkError(f"the poses are at {moments[1:]}; give at least one, rising from above 0 to exactly 1")
        for pose in self.poses:
            if pose.curve.shape != self.skeleton.curve.shape:
                raise LandmarkError(
                    f"the pose at {pose.at:g} has {len(pose.curve)} stations, the skeleton "
                    f"{len(self.skeleton.curve)}; every pose moves every station"
                )
        object.__setattr__(self, "_keys", self._with_frames())

    def position(self, t: float) -> Points:
        """(k + k q, 3) landmarks, then their sections, at ``t`` in [0, 1], mm."""
        keys = self._keys
        later = next((j for j in range(1, len(keys)) if t <= keys[j].at), len(keys) - 1)
        before, after = keys[later - 1], keys[later]
        share = (t - before.at) / (after.at - before.at)
        if share in (0.0, 1.0):
            key = before if share == 0.0 else after
            curve, frames = key.curve, key.frames
        else:
            curve, frames = _between(before, after, share)
        twist = (1.0 - share) * before.twist + share * after.twist
        return _placed(curve, _twisted(frames, twist), self.skeleton.section)

    def _with_frames(self) -> tuple[_Key, ...]:
        """Rest and poses with their frames."""
        skeleton = self.skeleton
        keys = [_Key(0.0, skeleton.curve, skeleton.frames(), np.zeros(len(skeleton.curve)))]
        for pose in self.poses:
            first = keys[-1].frames[0]
            normal = smallest_rotation(first[:, 2], tangents(pose.curve)[0]) @ first[:, 0]
            frames = rotation_minimising_frames(pose.curve, normal=normal)
            keys.append(_Key(pose.at, pose.curve, frames, np.deg2rad(pose.twist_deg)))
        return tuple(keys)


@dataclass(frozen=True, eq=False, slots=True)
class _Key:
    """A pose with the frames of its stations, before twist (radians)."""

    at: float
    curve: Points
    frames: Float
    twist: Float


def ring(count: int, *, radius_mm: float) -> Points:
    """A section of ``count`` points, (count, 2) mm, evenly on a circle; the first on the normal.

    Raises
    ------
    LandmarkError
        Fewer than three points, or a radius that is not positive.
    """
    if count < 3 or not radius_mm > 0.0 or not np.isfinite(radius_mm):
        raise LandmarkError(f"a ring of {count} points of radius {radius_mm} mm; give at least 3 and a positive radius")
    angles = 2.0 * np.pi * np.arange(count) / count
    return radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def tangents(curve: Points) -> Points:
    r"""(k, 3) unit directions of a curve at its (k, 3) landmarks.

    Each is that of the circle through the landmark and its neighbours (at an end: the next two), so that landmarks on
    a line or a circle give its exact directions. Inversion in the landmark takes the circle to a line along
    :math:`d_-/|d_-|^2 + d_+/|d_+|^2`, d the steps to and from it.

    Raises
    ------
    LandmarkError
        The curve turns straight back at a landmark.
    """
    if len(curve) == 2:
        along = np.repeat(curve[1:] - curve[:1], 2, axis=0)
    else:
        inverse = np.diff(curve, axis=0)
        inverse /= (inverse**2).sum(axis=1, keepdims=True)
        skips = curve[[2, -1]] - curve[[0, -3]]
        squares = (skips**2).sum(axis=1, keepdims=True)
        if (squares == 0.0).any():
            raise LandmarkError("the curve turns straight back on itself; add landmarks that show its turn")
        skips = skips / squares
        along = np.vstack([inverse[0] - skips[0], inverse[:-1] + inverse[1:], inverse[-1] - skips[1]])
    lengths = np.linalg.norm(along, axis=1)
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    back = np.flatnonzero(lengths * np.append(steps, steps[-1]) < STRAIGHT_BACK)
    if back.size:
        raise LandmarkError(
            f"the curve turns straight back at its landmark {back[0]}; add landmarks that show its turn"
        )
    unit: Points = along / lengths[:, None]
    return unit


def rotation_minimising_frames(curve: Points, *, normal: Points) -> Float:
    """Frames along a curve that do not turn about it: double reflection.

    Parameters
    ----------
    curve : (k, 3) float64, mm
    normal : (3,) float64
        Direction of the first frame's normal; its part along the curve is taken off.

    Returns
    -------
    (k, 3, 3) float64
        Columns: normal, binormal, tangent; right-handed. The twist left between stations is of fourth order in their
        distance, and none on lines and circles.

    Raises
    ------
    LandmarkError
        The curve turns straight back at a landmark, or ``normal`` is along its beginning.

    References
    ----------
    W. Wang, B. Jüttler, D. Zheng and Y. Liu, "Computation of rotation minimizing frames", ACM Trans. Graph. 27 (2008).
    """
    directions = tangents(curve)
    normals = [_first_normal(directions[0], normal)]
    for here, there, step in zip(directions, directions[1:], np.diff(curve, axis=0), strict=False):
        reflected_normal = _reflected(normals[-1], step)
        across = there - _reflected(here, step)
        turned = reflected_normal if np.linalg.norm(across) == 0.0 else _reflected(reflected_normal, across)
        turned = turned - (turned @ there) * there
        normals.append(turned / np.linalg.norm(turned))
    first = np.array(normals)
    frames: Float = np.stack([first, np.cross(directions, first), directions], axis=2)
    return frames


def smallest_rotation(start: Points, end: Points) -> Float:
    """The (3, 3) rotation about their common normal that takes one unit direction to another.

    Raises
    ------
    LandmarkError
        They are opposite, so that no axis is better than another.
    """
    cosine = float(start @ end)
    if cosine < -1.0 + STRAIGHT_BACK:
        raise LandmarkError(
            "the curve's beginning turns straight back between two poses, about no axis in particular; "
            "state a pose between them"
        )
    axis = np.cross(start, end)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation: Float = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation


def _between(before: _Key, after: _Key, share: float) -> tuple[Points, Float]:
    """Landmarks and frames between two poses: the first frame on its screw, each segment's screw blended."""
    start = RigidMotion(before.frames[0], before.curve[0])
    whole = RigidMotion(after.frames[0], after.curve[0]) @ start.inverse()
    motion = whole.fraction(share) @ start
    points, frames = [motion.translation], [motion.rotation]
    for k in range(len(before.curve) - 1):
        (turn_a, slide_a), (turn_b, slide_b) = _segment_screw(before, k), _segment_screw(after, k)
        turn, slide = (1.0 - share) * turn_a + share * turn_b, (1.0 - share) * slide_a + share * slide_b
        motion = motion @ RigidMotion(Rotation.from_rotvec(turn).as_matrix(), _chord_of(turn) @ slide)
        points.append(motion.translation)
        frames.append(motion.rotation)
    return np.array(points), np.array(frames)


def _segment_screw(key: _Key, k: int) -> tuple[Float, Float]:
    """Rotation vector and velocity of the screw from station k's frame to the next."""
    here, there = (RigidMotion(key.frames[j], key.curve[j]) for j in (k, k + 1))
    step = here.inverse() @ there
    turn = Rotation.from_matrix(step.rotation).as_rotvec()
    slide: Float = np.linalg.solve(_chord_of(turn), step.translation).astype(np.float64)
    return turn, slide


def _chord_of(turn: Float) -> Float:
    """The matrix that takes a screw's velocity to its translation: the mean of exp(s [turn]) over s in [0, 1].

    It is the half turn times what the turns from -1/2 to 1/2 leave: all along the axis, sin(a/2)/(a/2) across it.
    """
    angle = float(np.linalg.norm(turn))
    across = float(np.sinc(0.5 * angle / np.pi))
    axis = turn / max(angle, np.finfo(np.float64).tiny)
    chord: Float = Rotation.from_rotvec(0.5 * turn).as_matrix() @ (
        across * np.eye(3) + (1.0 - across) * np.outer(axis, axis)
    )
    return chord


def _twisted(frames: Float, angles: Float) -> Float:
    """The frames turned about their tangents by (k,) radians."""
    turned: Float = frames @ Rotation.from_rotvec(angles[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    return turned


def _placed(curve: Points, frames: Float, section: Points) -> Points:
    """The landmarks, then the section in every frame."""
    derived = curve[:, None, :] + np.einsum("kia,qa->kqi", frames[:, :, :2], section)
    return np.vstack([curve, derived.reshape(-1, 3)])


def _first_normal(tangent: Points, normal: Points) -> Points:
    across: Points = normal - (normal @ tangent) * tangent
    size = float(np.linalg.norm(across))
    if not size > ALONG * float(np.linalg.norm(normal)):
        raise LandmarkError(
            f"the skeleton's normal {np.round(normal, 6).tolist()} is along the curve, whose beginning has direction "
            f"{np.round(tangent, 6).tolist()}; give a direction across it"
        )
    return across / size


def _reflected(vector: Points, mirror: Points) -> Points:
    """The vector reflected in the plane across ``mirror``."""
    reflected: Points = vector - (2.0 * (vector @ mirror) / (mirror @ mirror)) * mirror
    return reflected


def _require_curve(curve: Points) -> None:
    if curve.ndim != 2 or curve.shape[1] != 3 or len(curve) < 2:
        raise LandmarkError(f"the curve has shape {curve.shape}; give (k, 3) landmarks in mm, at least 2")
    bad = np.flatnonzero(~np.isfinite(curve).all(axis=1))
    if bad.size:
        raise LandmarkError(f"landmark {bad[0]} of the curve is not finite: {curve[bad[0]]}; correct it")
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    close = np.flatnonzero(steps <= SHORTEST_SHARE * float(np.ptp(curve, axis=0).max()))
    if close.size:
        raise LandmarkError(f"landmarks {close[0]} and {close[0] + 1} of the curve are at one place; remove one")
    tangents(curve)
