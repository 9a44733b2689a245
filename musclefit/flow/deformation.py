"""A finished deformation as a value: steps in order, what each was judged by, and how the march ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import groupby
from typing import Self

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.flow.steps import Step
from musclefit.geometry.arrays import Gradients, Points


class Status(StrEnum):
    """How a march ended; the value is the message with its remedy."""

    CONVERGED = "every handle is at its destination"
    STALLED = "no safe step is left; the place that blocks is in the last step record"
    OUT_OF_STEPS = "the step budget ran out; raise max_steps"
    UNSOLVED = (
        "the rule fails at places of the finer surfaces, and shorter steps do not help; where surfaces or handles come "
        "too close to each other leave them more room, or choose a smaller pose"
    )
    ONE_SHOT = "one step of full length, not held to any rule"


@dataclass(frozen=True, slots=True)
class StepRecord:
    """What was known when a step was accepted.

    Parameters
    ----------
    start, end : float
        The part of the path it covers, in [0, 1].
    margin : float
        1 minus the used share of the rule's limit over the tested points: 1 at rest, 0 at the limit, negative beyond.
    worst_place : tuple of float, mm
        The tested point with the smallest margin, where it stood before the step.
    rejected : tuple of float
        Path ends that were tried before and failed the rule.
    """

    start: float
    end: float
    margin: float
    worst_place: tuple[float, ...]
    rejected: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Ridden:
    """Points that rode along while a map was made.

    Parameters
    ----------
    rest, moved : (N, n) float64, mm
    jacobians : (N, n, n) float64
        Of the whole map.
    """

    rest: Points
    moved: Points
    jacobians: Gradients

    def holds(self, points: Points) -> bool:
        """True for the first so many of them."""
        return len(points) <= len(self.rest) and np.array_equal(points, self.rest[: len(points)])


NOBODY = Ridden(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0)))


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Deformation:
    """A map of space composed of steps; apply it to any (N, n) points, mm.

    Parameters
    ----------
    steps : tuple of Step
    records : tuple of StepRecord
    status : Status
    ridden : Ridden
        Where these points go is known without asking the steps again.
    """

    steps: tuple[Step, ...]
    records: tuple[StepRecord, ...]
    status: Status
    ridden: Ridden = NOBODY

    def __repr__(self) -> str:
        return f"Deformation({len(self.steps)} steps, {self.status.value})"

    @property
    def stretches(self) -> int:
        """Parts that the path was cut into; each may have several steps."""
        return len({record.start for record in self.records if record.end > record.start})

    def by_stretch(self) -> Iterator[tuple[float, float, Deformation]]:
        """The parts of the path, each with its start, its end and its own steps."""
        made = [record for record in self.records if record.end > record.start]
        for (start, end), part in groupby(zip(made, self.steps, strict=True), key=lambda p: (p[0].start, p[0].end)):
            records, steps = zip(*part, strict=True)
            yield start, end, Deformation(steps, records, self.status)

    @property
    def rejected(self) -> int:
        """Stretches that were tried, failed the rule and were cut shorter."""
        return sum(len(record.rejected) for record in self.records)

    @property
    def margin(self) -> float:
        """Smallest margin of its steps; 1 where there is none."""
        return min((record.margin for record in self.records), default=1.0)

    def __call__(self, points: Points) -> Points:
        """Where the map takes (N, n) points, mm."""
        moved = np.array(points, dtype=np.float64)
        for step in self.steps:
            moved = step(moved)
        return moved

    def jacobian(self, points: Points) -> Gradients:
        """(N, n, n) derivatives of the whole map at (N, n) points, by the chain rule."""
        return self.with_jacobian(points)[1]

    def with_jacobian(self, points: Points) -> tuple[Points, Gradients]:
        """Moved points and derivatives in one pass."""
        if len(points) and self.ridden.holds(points):
            return self.ridden.moved[: len(points)].copy(), self.ridden.jacobians[: len(points)].copy()
        moved = np.array(points, dtype=np.float64)
        whole: Gradients = np.broadcast_to(np.eye(points.shape[1]), (len(points), *(points.shape[1],) * 2)).copy()
        for step in self.steps:
            trial = step.trial(moved)
            moved, whole = trial.moved, step.jacobian_from(trial.gradients) @ whole
        return moved, whole

    def inverse(self) -> Deformation:
        """The map that undoes this one: inverse steps in reverse order."""
        return Deformation(tuple(step.inverse() for step in reversed(self.steps)), (), self.status)

    def require(self) -> Self:
        """Itself, if it converged.

        Raises
        ------
        NotConvergedError
            It ended early; the error carries it.
        """
        if self.status is not Status.CONVERGED:
            raise NotConvergedError(f"the deformation ended early: {self.status.value}", result=self)
        return self
