"""Rigid motions of space: compose, invert, take a fraction along the screw, fit to point pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.geometry.arrays import Float, Points, frozen


@dataclass(frozen=True, eq=False, slots=True)
class RigidMotion:
    """x -> rotation x + translation.

    Parameters
    ----------
    rotation : (3, 3) float64, orthonormal with determinant 1
    translation : (3,) float64, mm
    """

    rotation: Float
    translation: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen(self.rotation))
        object.__setattr__(self, "translation", frozen(self.translation))

    @classmethod
    def identity(cls) -> Self:
        """The motion that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def about_axis(cls, *, centre: Points, axis: Points, angle_deg: float) -> Self:
        """Rotation by ``angle_deg`` (right-hand rule) about the line through ``centre`` along ``axis``."""
        unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
        rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * unit).as_matrix()
        return cls(rotation, centre - rotation @ centre)

    @classmethod
    def fitted(cls, source: Points, target: Points, *, weights: Float | None = None) -> Self:
        """Least-squares rigid motion that takes ``source`` to ``target``, both (m, 3) mm, by (m,) weights if given.

        References
        ----------
        W. Kabsch, Acta Cryst. A32 (1976) 922.
        """
        share = np.ones(len(source)) if weights is None else weights
        source_centre, target_centre = (np.average(points, axis=0, weights=share) for points in (source, target))
        u, _, vt = np.linalg.svd((share[:, None] * (target - target_centre)).T @ (source - source_centre))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
        rotation = u @ flip @ vt
        return cls(rotation, target_centre - rotation @ source_centre)

    def __call__(self, points: Points) -> Points:
        """Move (N, 3) points."""
        moved: Points = points @ self.rotation.T + self.translation
        return moved

    def __matmul__(self, first: RigidMotion) -> RigidMotion:
        """The motion that does ``first``, then this one."""
        return RigidMotion(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def inverse(self) -> RigidMotion:
        """The motion that undoes this one."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def turn_deg(self) -> float:
        """The angle that it turns about its screw, from 0 to 180 degrees."""
        return float(np.rad2deg(Rotation.from_matrix(self.rotation).magnitude()))

    @property
    def slide_mm(self) -> float:
        """How far it goes along its screw, mm; the whole way where it does not turn."""
        turn = Rotation.from_matrix(self.rotation).as_rotvec()
        angle = float(np.linalg.norm(turn))
        if angle < 1e-9:
            return float(np.linalg.norm(self.translation))
        return abs(float(self.translation @ turn)) / angle

    def fraction(self, t: float) -> RigidMotion:
        """The motion a fraction ``t`` along this one's screw: 0 is the identity, 1 is this motion.

        The screw of (R, d) has rotation vector w = log R and linear velocity V(w)^-1 d (Chasles' theorem).
        """
        w = Rotation.from_matrix(self.rotation).as_rotvec()
        velocity = np.linalg.solve(_left_jacobian(w), self.translation)
        return RigidMotion(Rotation.from_rotvec(t * w).as_matrix(), t * (_left_jacobian(t * w) @ velocity))


def _left_jacobian(w: Float) -> Float:
    """The matrix V(w) of SE(3): integral of exp(s [w]) over s in [0, 1]."""
    angle = float(np.linalg.norm(w))
    skew = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    if angle < 1e-4:
        first, second = 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    else:
        first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    jacobian: Float = np.eye(3) + first * skew + second * (skew @ skew)
    return jacobian
