"""Points that a map carries and that more may join: put to its steps where a march made it, only moved where not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Marching
from musclefit.geometry.arrays import Gradients, Points
from musclefit.progress import Progress, Silent

MAX_RETURNS = 8
"""Times that points which join later may take a march back."""


class Riders(Protocol):
    """A map and the points that it carries, in the order in which they joined."""

    @property
    def deformation(self) -> Deformation:
        """The map."""
        ...

    @property
    def moved(self) -> Points:
        """(N, 3) places of all that joined, mm."""
        ...

    @property
    def jacobians(self) -> Gradients:
        """(N, 3, 3) derivatives of the map there."""
        ...

    @property
    def returns(self) -> int:
        """Times that the map was changed for points that joined."""
        ...

    def joined(self, points: Points) -> Self | None:
        """With more points, and the map changed where they need it; None where that does not help.

        Parameters
        ----------
        points : (k, 3) float64, mm
            At rest.
        """
        ...


@dataclass(frozen=True, eq=False, slots=True)
class PlainRiders:
    """Points that a finished map moves, whatever it does to them.

    Parameters
    ----------
    deformation : Deformation
    moved, jacobians
        Of all that joined.
    """

    deformation: Deformation
    moved: Points
    jacobians: Gradients

    @classmethod
    def of(cls, deformation: Deformation, points: Points) -> Self:
        """The map and its first (N, 3) points, mm."""
        return cls(deformation, *deformation.with_jacobian(points))

    @property
    def returns(self) -> int:
        """None: the map stays as it is."""
        return 0

    def joined(self, points: Points) -> Self | None:
        """With more points; None where a step has no solution for one of them."""
        try:
            moved, jacobians = self.deformation.with_jacobian(points)
        except NotConvergedError:
            return None
        return replace(
            self, moved=np.vstack([self.moved, moved]), jacobians=np.concatenate([self.jacobians, jacobians])
        )


@dataclass(frozen=True, eq=False, slots=True)
class MarchRiders:
    """Points that a march is tested at; those that join may take it back, and it goes on from there with them.

    Parameters
    ----------
    march : Marching
        At its end.
    progress : Progress
    max_returns : int
        Times that it may be taken back; from then on points may leave its steps a smaller margin than the march's own,
        but none at which the rule fails.
    """

    march: Marching
    progress: Progress
    max_returns: int = MAX_RETURNS

    @property
    def deformation(self) -> Deformation:
        """The map."""
        return self.march.deformation

    @property
    def moved(self) -> Points:
        """Of all that joined."""
        return self.march.moved[: len(self.march.moved) - self.march.held]

    @property
    def jacobians(self) -> Gradients:
        """Of all that joined."""
        return self.march.jacobians[: len(self.march.moved) - self.march.held]

    @property
    def returns(self) -> int:
        """Times that the march was taken back."""
        return self.march.returns

    def joined(self, points: Points) -> Self | None:
        """With more points; None where the rule fails at one of them and shorter steps do not help.

        A march that has converged is not given up for one that has not.
        """
        if self.march.returns < self.max_returns:
            found = self.march.joined(points)
            if found.status is None:
                found = found.marched(self.progress)
            if found.status is Status.CONVERGED:
                return replace(self, march=found)
        found = self.march.joined(points, share=1.0)
        return None if found.status is None else replace(self, march=found)


def riders_of(made: Deformation | Marching, points: Points, *, progress: Progress | None = None) -> Riders:
    """The riders of a map: a march that has converged may be taken back, any other map stays as it is.

    Parameters
    ----------
    made : Deformation or Marching
    points : (N, 3) float64, mm
        The first that it carries; of a march, those it was tested at.
    """
    if isinstance(made, Deformation):
        return PlainRiders.of(made, points)
    if made.status is Status.CONVERGED:
        return MarchRiders(made, progress or Silent())
    return PlainRiders.of(made.deformation, points)
