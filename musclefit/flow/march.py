"""The one marching loop: a stepper and a rule become a deformation made of steps that the rule allows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from musclefit.errors import FieldError, NotConvergedError
from musclefit.fields.protocol import Backend
from musclefit.flow.deformation import Deformation, Ridden, Status, StepRecord
from musclefit.flow.rules import Rule
from musclefit.flow.steppers import Stepper, explicit_step
from musclefit.flow.steps import ExplicitStep, Step
from musclefit.geometry.arrays import Gradients, Points
from musclefit.progress import MARCH, Progress, Silent
from musclefit.rig.handles import Path

SHORTEST_REACH = 1e-6
"""A march stalls when the rule leaves less than this fraction of the path for a step."""

RETRY_SHARE = 0.9
"""A rejected stretch is tried again at this share of what the rule left of it (and at most at half)."""

STRICTLY_BELOW = 1.0 - 1e-6
"""The rules are strict: a step shortened to its limit stays this share below it, where det may still be 0 at it."""

BESIDE = 1e-6
"""How far from a handle its one-sided gradients are taken, as a fraction of the handles' extent."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast a march may go.

    Parameters
    ----------
    max_steps : int
        Stretches of the path before it gives up.
    min_steps : int
        The path is cut into at least so many stretches: the volume that an isochoric implicit step does not keep falls
        with their square.
    share : float
        How much of the rule's limit a step may use, in (0, 1].
    stops : tuple of float
        Rising moments in (0, 1), such as a path's keyframes, that no stretch passes over.
    """

    max_steps: int
    min_steps: int = 1
    share: float = 1.0
    stops: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class _Stretch:
    steps: tuple[Step, ...]
    records: tuple[StepRecord, ...]
    moved: Points
    jacobians: Gradients
    end: float


def march(stepper: Stepper, *, rule: Rule, tested: Points, pace: Pace, progress: Progress | None = None) -> Deformation:
    """Follow the path to its end in stretches whose steps the rule allows at every tested point.

    Where the stepper's steps shorten exactly (explicit steps on straight lines), each stretch aims at the destination
    and goes exactly as far as the rule allows: the loop of Yu et al. 2014. Any other stretch that fails the rule is
    tried again shorter, at most half as long, and the end it failed at is recorded.

    Parameters
    ----------
    stepper : Stepper
    rule : Rule
        Safe fraction of a step at each tested point.
    tested : (N, n) float64, mm
        Points at rest where the rule is tested; they ride along.
    pace : Pace

    Returns
    -------
    Deformation
        With its status: converged, stalled, or out of steps. The claim is *sampled*: the rule held at tested points.
    """
    points, done, reach = np.array(tested), 0.0, 1.0 / pace.min_steps
    n = points.shape[1]
    whole: Gradients = np.broadcast_to(np.eye(n), (len(points), n, n)).copy()
    steps: list[Step] = []
    records: list[StepRecord] = []
    stretches = 0
    status = Status.CONVERGED
    with (progress or Silent()).stage(MARCH) as tick:
        while done < 1.0:
            if stretches == pace.max_steps:
                status = Status.OUT_OF_STEPS
                break
            stretch = _stretch(stepper, rule=rule, points=points, start=done, reach=reach, pace=pace)
            records.extend(stretch.records)
            if stretch.end - done < SHORTEST_REACH * (1.0 - done):
                status = Status.STALLED
                break
            stretches += 1
            steps.extend(stretch.steps)
            if stepper.shortens_exactly:
                reach = 1.0
            elif stretch.records[0].rejected:
                reach = stretch.end - done
            points, done, whole = stretch.moved, stretch.end, stretch.jacobians @ whole
            tick(done)
    return Deformation(tuple(steps), tuple(records), status, Ridden(tested, points, whole))


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


def _stretch(stepper: Stepper, *, rule: Rule, points: Points, start: float, reach: float, pace: Pace) -> _Stretch:
    """The longest stretch tried from ``start`` whose steps all pass the rule; one of no length where none is left."""
    rejected: list[float] = []
    share = pace.share
    stop = next((moment for moment in pace.stops if moment > start), 1.0)
    # What floating point leaves of a path cut into equal parts belongs to the last of them.
    end = stop if start + reach > stop - SHORTEST_REACH else start + reach
    while True:
        tried = _try(stepper, rule, points, start=start, end=end, share=share)
        if not isinstance(tried, _Failure):
            first = StepRecord(start, end, tried.margins[0], tried.places[0], tuple(rejected))
            more = (StepRecord(start, end, m, p) for m, p in zip(tried.margins[1:], tried.places[1:], strict=True))
            return _Stretch(tried.steps, (first, *more), tried.moved, tried.jacobians, end)
        if stepper.shortens_exactly:
            used = share * STRICTLY_BELOW
            factor = tried.fraction * used
            shortened = ExplicitStep(tried.steps[0].field.scaled(factor))
            end = start + factor * (end - start)
            record = StepRecord(start, end, 1.0 - used, tried.place)
            jacobians = shortened.jacobian_from(factor * tried.gradients)
            return _Stretch((shortened,), (record,), shortened(points), jacobians, end)
        rejected.append(end)
        end = start + (end - start) * min(0.5, RETRY_SHARE * tried.fraction * share)
        if end - start < SHORTEST_REACH * (1.0 - start):
            blocked = StepRecord(start, start, 0.0, tried.place, tuple(rejected))
            return _Stretch((), (blocked,), points, np.zeros((0, 0, 0)), start)


@dataclass(frozen=True, slots=True)
class _Success:
    steps: tuple[Step, ...]
    margins: tuple[float, ...]
    places: tuple[tuple[float, ...], ...]
    moved: Points
    jacobians: Gradients


@dataclass(frozen=True, slots=True)
class _Failure:
    steps: tuple[Step, ...]
    fraction: float
    place: tuple[float, ...]
    gradients: Gradients


def _try(
    stepper: Stepper, rule: Rule, points: Points, *, start: float, end: float, share: float
) -> _Success | _Failure:
    """Make and test the steps of one stretch; ends at the first that uses more of its limit than its share."""
    count = len(points)
    moved = np.vstack([points, stepper.anchors(start)])
    steps: list[Step] = []
    margins: list[float] = []
    places: list[tuple[float, ...]] = []
    jacobians: list[Gradients] = []
    for make in stepper.makers(start, end):
        try:
            step = make(moved[:count], moved[count:])
            trial = step.trial(moved)
        except (FieldError, NotConvergedError):
            # Too long for a field at its middle (handles that meet there), or for a solution: half as long may do.
            if stepper.shortens_exactly:
                raise
            return _Failure((), 0.5, tuple(float(x) for x in moved[0]), np.zeros((0, 0, 0)))
        fractions = rule(trial.gradients)
        worst = int(np.argmin(fractions))
        fraction, place = float(fractions[worst]), tuple(float(x) for x in moved[worst])
        if not fraction * share > 1.0:
            return _Failure((step,), fraction, place, trial.gradients[:count])
        steps.append(step)
        margins.append(1.0 - 1.0 / fraction)
        places.append(place)
        moved = trial.moved
        jacobians.append(step.jacobian_from(trial.gradients[:count]))
    whole = reduce(lambda before, after: after @ before, jacobians)
    return _Success(tuple(steps), tuple(margins), tuple(places), moved[:count], whole)
