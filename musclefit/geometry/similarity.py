"""Similarities of space: a rotation, one scale and a translation; fitted to point pairs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from scipy.spatial.transform import Rotation

from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion


@dataclass(frozen=True, eq=False, slots=True)
class Similarity:
    """x -> scale rotation x + translation.

    Parameters
    ----------
    scale : float, positive
    rotation : (3, 3) float64, orthonormal with determinant 1
    translation : (3,) float64, mm
    """

    scale: float
    rotation: Float
    translation: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen(self.rotation))
        object.__setattr__(self, "translation", frozen(self.translation))

    @classmethod
    def rigid(cls, motion: RigidMotion) -> Self:
        """A rigid motion, of scale 1."""
        return cls(1.0, motion.rotation, motion.translation)

    @classmethod
    def fitted(cls, source: Points, target: Points) -> Self:
        """Least-squares similarity that takes ``source`` to ``target``, both (m, 3) mm.

        References
        ----------
        S. Umeyama, IEEE Trans. Pattern Anal. Mach. Intell. 13 (1991) 376.
        """
        rotation = RigidMotion.fitted(source, target).rotation
        source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
        turned = (source - source_centre) @ rotation.T
        spread = float((turned**2).sum())
        scale = float((turned * (target - target_centre)).sum()) / spread if spread > 0.0 else 1.0
        return cls(scale, rotation, target_centre - scale * rotation @ source_centre)

    @classmethod
    def identity(cls) -> Self:
        """The motion that moves nothing."""
        return cls.rigid(RigidMotion.identity())

    @property
    def linear(self) -> Float:
        """(3, 3) derivative: the rotation times the scale."""
        whole: Float = self.scale * self.rotation
        return whole

    def towards(self, other: Similarity, share: float, *, centre: Float) -> Similarity:
        """The similarity a share of the way to another.

        It turns at one rate about one axis and grows at one rate, and a point goes straight.

        Parameters
        ----------
        other : Similarity
        share : float
            In [0, 1].
        centre : (3,) float64, mm
            The point, before either.
        """
        scale = self.scale ** (1.0 - share) * other.scale**share
        turn = Rotation.from_matrix(self.rotation.T @ other.rotation).as_rotvec()
        rotation = self.rotation @ Rotation.from_rotvec(share * turn).as_matrix()
        there = (1.0 - share) * self(centre[None])[0] + share * other(centre[None])[0]
        return Similarity(scale, rotation, there - scale * rotation @ centre)

    def undone(self, points: Points) -> Points:
        """Move (N, 3) points back."""
        back: Points = (points - self.translation) @ self.rotation / self.scale
        return back

    def __call__(self, points: Points) -> Points:
        """Move (N, 3) points."""
        moved: Points = self.scale * (points @ self.rotation.T) + self.translation
        return moved
