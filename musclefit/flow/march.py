"""The one marching loop: a stepper and a rule become a deformation made of steps that the rule allows.

A march may be gone on with: points that join it later are put to every step that was made, and a step that one of them
forbids is made anew, shorter, while those before it stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from musclefit.errors import FieldError, NotConvergedError
from musclefit.fields.protocol import Backend
from musclefit.flow.deformation import Deformation, Ridden, Status, StepRecord
from musclefit.flow.rules import Rule
from musclefit.flow.steppers import Stepper, explicit_step
from musclefit.flow.steps import ExplicitStep, Step, Trial, jacobian_between
from musclefit.geometry.arrays import Gradients, Points
from musclefit.progress import MARCH, Progress, Silent
from musclefit.rig.handles import Path

SHORTEST_REACH = 1e-6
"""A march stalls when the rule leaves less than this fraction of the path for a step."""

RETRY_SHARE = 0.9
"""A rejected stretch is tried again at this share of what the rule left of it (and at most at half)."""

EASY_SHARE, GROWTH = 0.5, 1.5
"""A stretch that a rejection made short is followed by longer ones, by at most this factor, as long as they are
expected to use no more than this share of what they may."""

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
        How much of the rule's limit a step may use, in (0, 1]: 1 less the margin that it keeps at least.
    stops : tuple of float
        Rising moments in (0, 1), such as a path's keyframes, that no stretch passes over.
    """

    max_steps: int
    min_steps: int = 1
    share: float = 1.0
    stops: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Stretch:
    """A part of the path that is done.

    Parameters
    ----------
    steps : tuple of Step
    records : tuple of StepRecord
        One for each step.
    befores : tuple of (N, n) float64, mm
        Where the tested points stood before each step.
    end : float
        Where on the path it ends.
    """

    steps: tuple[Step, ...]
    records: tuple[StepRecord, ...]
    befores: tuple[Points, ...]
    end: float

    @property
    def start(self) -> float:
        """Where on the path it begins."""
        return self.records[0].start


@dataclass(frozen=True, eq=False, slots=True)
class Marching:
    """A march so far: what is done of it, and where the tested points stand.

    Parameters
    ----------
    stepper : Stepper
    rule : Rule
    pace : Pace
    tested : (N, n) float64, mm
        At rest; the last ``held`` of them are the stepper's own and stay last.
    held : int
    moved : (N, n) float64, mm
    jacobians : (N, n, n) float64
        Of the whole map so far.
    reach : float
        How far the next stretch goes, as a fraction of the path.
    stretches : tuple of Stretch
    rejected : tuple of float
        Ends that the next stretch was already tried with.
    status : Status or None
        How it ended; None while something is left of the path.
    blocked : tuple of StepRecord
        What a stalled march stopped at.
    returns : int
        Times that points that joined later took steps back.
    """

    stepper: Stepper
    rule: Rule
    pace: Pace
    tested: Points
    held: int
    moved: Points
    jacobians: Gradients
    reach: float
    stretches: tuple[Stretch, ...] = ()
    rejected: tuple[float, ...] = ()
    status: Status | None = None
    blocked: tuple[StepRecord, ...] = ()
    returns: int = 0

    @classmethod
    def begun(cls, stepper: Stepper, *, rule: Rule, tested: Points, pace: Pace, held: int = 0) -> Marching:
        """Everything at rest."""
        count, n = tested.shape
        eye: Gradients = np.broadcast_to(np.eye(n), (count, n, n)).copy()
        return cls(stepper, rule, pace, np.array(tested), held, np.array(tested), eye, 1.0 / pace.min_steps)

    @property
    def done(self) -> float:
        """How much of the path is covered."""
        return self.stretches[-1].end if self.stretches else 0.0

    @property
    def deformation(self) -> Deformation:
        """The steps so far as a map; a march that is not at its end counts as out of steps."""
        steps = tuple(step for stretch in self.stretches for step in stretch.steps)
        records = tuple(record for stretch in self.stretches for record in stretch.records)
        own = len(self.tested) - self.held
        ridden = Ridden(self.tested[:own], self.moved[:own], self.jacobians[:own])
        return Deformation(steps, records + self.blocked, self.status or Status.OUT_OF_STEPS, ridden)

    def marched(self, progress: Progress | None = None) -> Marching:
        """Gone on with to the end of the path, or to where no step is left."""
        march = self
        with (progress or Silent()).stage(MARCH) as tick:
            while march.status is None:
                march = march._further()
                tick(march.done)
        return march

    def joined(self, points: Points, *, share: float | None = None) -> Marching:
        """With more points tested, which are put to every step so far.

        Where a step has no solution for one of them, or leaves it a smaller margin than it must keep, the march is
        taken back to the start of that stretch, which will be shorter: what came before stays, and all points that
        joined are tested from there on.

        Parameters
        ----------
        points : (k, n) float64, mm
            At rest.
        share : float or None
            How much of the rule's limit the steps may use there; None for what the march's own may.

        Returns
        -------
        Marching
            With ``status`` None where it was taken back.
        """
        limit = self.pace.share if share is None else share
        n = self.tested.shape[1]
        here, whole = np.array(points), np.broadcast_to(np.eye(n), (len(points), n, n)).copy()
        stretches: list[Stretch] = []
        for number, stretch in enumerate(self.stretches):
            start, before = here, whole
            befores, records = [], []
            for step, record in zip(stretch.steps, stretch.records, strict=True):
                judged = _judged(step, here, self.rule)
                if not judged.fraction * limit > 1.0:
                    return self._back_to(number, stretches, points, start, before, left=judged.fraction * limit)
                margin = 1.0 - 1.0 / judged.fraction
                worse = margin < record.margin
                records.append(replace(record, margin=margin, worst_place=judged.place) if worse else record)
                befores.append(here)
                here, whole = judged.moved, judged.jacobians @ whole
            wider = tuple(self._with(old, new) for old, new in zip(stretch.befores, befores, strict=True))
            stretches.append(replace(stretch, records=tuple(records), befores=wider))
        return replace(
            self,
            tested=self._with(self.tested, points),
            moved=self._with(self.moved, here),
            jacobians=self._with(self.jacobians, whole),
            stretches=tuple(stretches),
        )

    def _further(self) -> Marching:
        """One stretch more, or the status that ends it."""
        if self.done >= 1.0:
            return replace(self, status=Status.CONVERGED)
        if len(self.stretches) == self.pace.max_steps:
            return replace(self, status=Status.OUT_OF_STEPS)
        found = _stretch(self)
        if not found.stretch.steps:
            return replace(self, status=Status.STALLED, blocked=found.stretch.records)
        return replace(
            self,
            stretches=(*self.stretches, found.stretch),
            moved=found.moved,
            jacobians=found.jacobians @ self.jacobians,
            reach=self._next_reach(found.stretch),
            rejected=(),
        )

    def _next_reach(self, stretch: Stretch) -> float:
        """As far as this one, or farther where it was shortened by a rejection and then used little of its limit."""
        if self.stepper.shortens_exactly:
            return 1.0
        longest, length = 1.0 / self.pace.min_steps, stretch.end - stretch.start
        if self.reach >= longest and not stretch.records[0].rejected:
            return longest
        used = 1.0 - min(record.margin for record in stretch.records)
        growth = GROWTH if used <= 0.0 else min(GROWTH, EASY_SHARE * self.pace.share / used)
        return min(longest, length * max(1.0, growth))

    def _back_to(
        self, number: int, finished: list[Stretch], points: Points, stand: Points, whole: Gradients, *, left: float
    ) -> Marching:
        """At the start of a stretch again, with points that stand there; ``left`` is what they left of its length."""
        stretch = self.stretches[number]
        start = stretch.start
        shorter = (stretch.end - start) * min(RETRY_SHARE, RETRY_SHARE * left)
        return replace(
            self,
            tested=self._with(self.tested, points),
            moved=self._with(stretch.befores[0], stand),
            jacobians=self._with(self._jacobians_before(number), whole),
            stretches=tuple(finished),
            reach=self.reach if self.stepper.shortens_exactly else max(shorter, SHORTEST_REACH * (1.0 - start)),
            rejected=(*stretch.records[0].rejected, stretch.end),
            status=None,
            blocked=(),
            returns=self.returns + 1,
        )

    def _jacobians_before(self, number: int) -> Gradients:
        """Of the map at the start of a stretch, at the points tested so far; where they stand is not solved anew."""
        count, n = self.tested.shape
        whole: Gradients = np.broadcast_to(np.eye(n), (count, n, n)).copy()
        steps = [step for stretch in self.stretches[:number] for step in stretch.steps]
        stands = [before for stretch in self.stretches for before in stretch.befores]
        for step, before, after in zip(steps, stands, stands[1:], strict=False):
            whole = jacobian_between(step, before, after) @ whole
        return whole

    def _with(self, old: Gradients, new: Gradients) -> Gradients:
        """What belongs to more points, put before what belongs to the stepper's own."""
        own = len(old) - self.held
        return np.concatenate([old[:own], new, old[own:]])


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
    return Marching.begun(stepper, rule=rule, tested=tested, pace=pace).marched(progress).deformation


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


@dataclass(frozen=True, eq=False, slots=True)
class _Found:
    """A stretch and where it takes the tested points; of no step where none is left."""

    stretch: Stretch
    moved: Points
    jacobians: Gradients


def _stretch(march: Marching) -> _Found:
    """The longest stretch tried from where the march is whose steps all pass the rule; of no length where none does."""
    stepper, pace, points, start = march.stepper, march.pace, march.moved, march.done
    rejected, share = list(march.rejected), pace.share
    end = _first_end(start, march.reach, pace.stops)
    while True:
        tried = _try(march, start=start, end=end)
        if isinstance(tried, _Success):
            first = StepRecord(start, end, tried.margins[0], tried.places[0], tuple(rejected))
            more = (StepRecord(start, end, m, p) for m, p in zip(tried.margins[1:], tried.places[1:], strict=True))
            return _Found(Stretch(tried.steps, (first, *more), tried.befores, end), tried.moved, tried.jacobians)
        if stepper.shortens_exactly:
            used = share * STRICTLY_BELOW
            factor = tried.fraction * used
            end = start + factor * (end - start)
            if end - start >= SHORTEST_REACH * (1.0 - start):
                shortened = ExplicitStep(tried.steps[0].field.scaled(factor))
                record = StepRecord(start, end, 1.0 - used, tried.place, tuple(rejected))
                stretch = Stretch((shortened,), (record,), (points,), end)
                return _Found(stretch, shortened(points), shortened.jacobian_from(factor * tried.gradients))
        else:
            rejected.append(end)
            end = start + (end - start) * min(0.5, RETRY_SHARE * tried.fraction * share)
        if end - start < SHORTEST_REACH * (1.0 - start):
            blocked = StepRecord(start, start, 0.0, tried.place, tuple(rejected))
            return _Found(Stretch((), (blocked,), (), start), points, np.zeros((0, 0, 0)))


def _first_end(start: float, reach: float, stops: tuple[float, ...]) -> float:
    """Where the next stretch may end: what is left up to the next stop is cut into equal parts within the reach."""
    stop = next((moment for moment in stops if moment > start), 1.0)
    # What floating point leaves of a path cut into equal parts is not part of its own.
    parts = math.ceil((stop - start - SHORTEST_REACH) / reach)
    return stop if parts <= 1 else start + (stop - start) / parts


@dataclass(frozen=True, slots=True)
class _Success:
    steps: tuple[Step, ...]
    margins: tuple[float, ...]
    places: tuple[tuple[float, ...], ...]
    befores: tuple[Points, ...]
    moved: Points
    jacobians: Gradients


@dataclass(frozen=True, slots=True)
class _Failure:
    steps: tuple[Step, ...]
    fraction: float
    place: tuple[float, ...]
    gradients: Gradients


def _try(march: Marching, *, start: float, end: float) -> _Success | _Failure:
    """Make and test the steps of one stretch; ends at the first that uses more of its limit than its share."""
    stepper, points = march.stepper, march.moved
    count = len(points)
    moved = np.vstack([points, stepper.anchors(start)])
    steps: list[Step] = []
    margins: list[float] = []
    places: list[tuple[float, ...]] = []
    befores: list[Points] = []
    jacobians: list[Gradients] = []
    for make in stepper.makers(start, end):
        try:
            step = make(moved[:count], moved[count:])
            trial = _trial(march, step, moved)
        except (FieldError, NotConvergedError):
            # Too long for a field at its middle (handles that meet there), or for a solution: half as long may do.
            if stepper.shortens_exactly:
                raise
            return _Failure((), 0.5, tuple(float(x) for x in moved[0]), np.zeros((0, 0, 0)))
        fractions = march.rule(trial.gradients)
        worst = int(np.argmin(fractions))
        fraction, place = float(fractions[worst]), tuple(float(x) for x in moved[worst])
        if not fraction * march.pace.share > 1.0:
            return _Failure((step,), fraction, place, trial.gradients[:count])
        steps.append(step)
        margins.append(1.0 - 1.0 / fraction)
        places.append(place)
        befores.append(moved[:count])
        moved = trial.moved
        jacobians.append(step.jacobian_from(trial.gradients[:count]))
    whole = reduce(lambda before, after: after @ before, jacobians)
    return _Success(tuple(steps), tuple(margins), tuple(places), tuple(befores), moved[:count], whole)


def _trial(march: Marching, step: Step, moved: Points) -> Trial:
    """A step tried on the tested points and the anchors behind them; the stepper moves its own, which are between."""
    end = len(march.moved)
    start = end - march.held
    free = step.trial(np.concatenate([moved[:start], moved[end:]]))
    held = march.stepper.trial_of_held(step, moved[start:end])
    return Trial(
        np.concatenate([free.moved[:start], held.moved, free.moved[start:]]),
        np.concatenate([free.gradients[:start], held.gradients, free.gradients[start:]]),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Judged:
    """What a step does to points, and the least fraction of it that its rule allows there."""

    fraction: float
    place: tuple[float, ...]
    moved: Points
    jacobians: Gradients


def _judged(step: Step, points: Points, rule: Rule) -> _Judged:
    """A step put to points; where it has no solution for one, half of it is said to be allowed."""
    try:
        trial = step.trial(points)
    except NotConvergedError:
        return _Judged(0.5, tuple(float(x) for x in points[0]), points, np.zeros((0, 0, 0)))
    fractions = rule(trial.gradients)
    worst = int(np.argmin(fractions))
    place = tuple(float(x) for x in points[worst])
    return _Judged(float(fractions[worst]), place, trial.moved, step.jacobian_from(trial.gradients))
