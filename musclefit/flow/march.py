"""The one marching loop: handles on a path and a backend become a deformation made of steps held to a rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musclefit.errors import NotConvergedError
from musclefit.fields.protocol import Backend
from musclefit.flow.deformation import Deformation, Status, StepRecord
from musclefit.flow.rules import Rule
from musclefit.flow.steps import CayleyStep, ExplicitStep, Step
from musclefit.geometry.arrays import Points
from musclefit.progress import Progress, Silent
from musclefit.rig.handles import Path, StraightPath

SHORTEST_REACH = 1e-6
"""A march stalls when the rule leaves less than this fraction of the path for a step."""

RETRY_SHARE = 0.9
"""A rejected step is tried again at this share of what the rule left of it (and at most at half)."""

BESIDE = 1e-6
"""How far from a handle its one-sided gradients are taken, as a fraction of the handles' extent."""

Stepper = Callable[[Backend, Points, Points], Step]


def explicit_step(backend: Backend, start: Points, end: Points) -> ExplicitStep:
    """Fit on the start of the step (Yu et al. 2014)."""
    return ExplicitStep(backend.fit(start, end - start))


def cayley_step(backend: Backend, start: Points, end: Points) -> CayleyStep:
    """Fit on the middle of the step, so that handles arrive exactly and affine motions are reproduced."""
    return CayleyStep(backend.fit(0.5 * (start + end), end - start))


@dataclass(frozen=True, slots=True)
class _Attempt:
    step: Step
    moved: Points
    end: float
    record: StepRecord


def march(
    path: Path,
    backend: Backend,
    *,
    stepper: Stepper,
    rule: Rule,
    tested: Points,
    max_steps: int,
    progress: Progress | None = None,
) -> Deformation:
    """Follow the path to its end in steps that the rule allows at every tested point.

    Explicit steps on straight paths aim at the destination and go exactly as far as the rule allows (the loop of Yu et
    al. 2014: the field is linear in the step's length). Any other step that fails the rule is tried again shorter, at
    most half as long, and the end it failed at is recorded.

    Parameters
    ----------
    path : Path
        Of m handles.
    backend : Backend
        Fits the field of each step.
    stepper : Stepper
        `explicit_step` or `cayley_step`.
    rule : Rule
        Safe fraction of a step at each tested point.
    tested : (N, n) float64, mm
        Points at rest where the rule is tested; they ride along.
    max_steps : int

    Returns
    -------
    Deformation
        With its status: converged, stalled, or out of steps. The claim is *sampled*: the rule held at tested points.
    """
    points, done, reach = np.array(tested), 0.0, 1.0
    steps: list[Step] = []
    records: list[StepRecord] = []
    status = Status.CONVERGED
    with (progress or Silent()).stage("march") as tick:
        while done < 1.0:
            if len(steps) == max_steps:
                status = Status.OUT_OF_STEPS
                break
            attempt = _safe_step(path, backend, stepper=stepper, rule=rule, points=points, start=done, reach=reach)
            records.append(attempt.record)
            if attempt.end - done < SHORTEST_REACH * (1.0 - done):
                status = Status.STALLED
                break
            steps.append(attempt.step)
            points, reach, done = attempt.moved, attempt.end - done, attempt.end
            if isinstance(path, StraightPath) and isinstance(attempt.step, ExplicitStep):
                reach = 1.0
            tick(done)
    return Deformation(tuple(steps), tuple(records), status)


def one_shot(path: Path, backend: Backend, *, rule: Rule, tested: Points) -> Deformation:
    """The baseline: one explicit step from rest to the destination; its margin is recorded, and nothing follows."""
    step = explicit_step(backend, path.position(0.0), path.position(1.0))
    fractions = rule(step.field.gradient(tested))
    worst = int(np.argmin(fractions))
    place = tuple(float(x) for x in tested[worst])
    return Deformation((step,), (StepRecord(0.0, 1.0, 1.0 - 1.0 / float(fractions[worst]), place),), Status.ONE_SHOT)


def points_beside(handles: Points) -> Points:
    """Points close beside each handle along every axis, for kernels that have no gradient at their centre.

    Parameters
    ----------
    handles : (m, n) float64, mm

    Returns
    -------
    (2 n m, n) float64, mm
    """
    offset = BESIDE * float(np.ptp(handles, axis=0).max() or 1.0)
    n = handles.shape[1]
    directions = offset * np.vstack([np.eye(n), -np.eye(n)])
    return (handles[:, None, :] + directions).reshape(-1, n)


def _safe_step(
    path: Path, backend: Backend, *, stepper: Stepper, rule: Rule, points: Points, start: float, reach: float
) -> _Attempt:
    """The longest step tried from ``start`` that passes the rule; one of no length where none is left."""
    rejected: list[float] = []
    end = min(1.0, start + reach)
    while True:
        step = stepper(backend, path.position(start), path.position(end))
        try:
            trial = step.trial(points)
            fractions = rule(trial.gradients)
            worst = int(np.argmin(fractions))
            fraction, moved = float(fractions[worst]), trial.moved
        except NotConvergedError:
            worst, fraction, moved = 0, 0.5, points
        place = tuple(float(x) for x in points[worst])
        if fraction > 1.0:
            return _Attempt(step, moved, end, StepRecord(start, end, 1.0 - 1.0 / fraction, place, tuple(rejected)))
        if isinstance(step, ExplicitStep) and isinstance(path, StraightPath):
            moved = points + fraction * (moved - points)
            end = start + fraction * (end - start)
            shortened = ExplicitStep(step.field.scaled(fraction))
            return _Attempt(shortened, moved, end, StepRecord(start, end, 0.0, place))
        rejected.append(end)
        end = start + (end - start) * min(0.5, RETRY_SHARE * fraction)
        if end - start < SHORTEST_REACH * (1.0 - start):
            return _Attempt(step, points, start, StepRecord(start, start, 0.0, place, tuple(rejected)))
