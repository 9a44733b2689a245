"""What a march asks for its steps: one step, or several in a row, for each stretch of the path."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.fields.protocol import Backend
from musclefit.flow.steps import CayleyStep, ExplicitStep, Step, Trial
from musclefit.geometry.arrays import Points
from musclefit.rig.handles import Path, StraightPath

StepMaker = Callable[[Points, Points], Step]
"""Makes a step from where the tested points and the anchors stand now, both (k, n) mm."""

HandleStep = Callable[[Backend, Points, Points], Step]


class Stepper(Protocol):
    """Makes the steps for stretches of a path."""

    @property
    def shortens_exactly(self) -> bool:
        """True when the steps of a part of the path are the whole path's steps, scaled."""
        ...

    def anchors(self, start: float) -> Points:
        """(a, n) points of its own that ride along from the start of a stretch, mm; may be none."""
        ...

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The makers of the steps from ``start`` to ``end`` of the path, in order."""
        ...

    def trial_of_held(self, step: Step, held: Points) -> Trial:
        """Where a step that it made takes the (h, n) points that the march holds for it, mm."""
        ...


def explicit_step(backend: Backend, start: Points, end: Points) -> ExplicitStep:
    """Fit on the start of the step (Yu et al. 2014)."""
    return ExplicitStep(backend.fit(start, end - start))


def cayley_step(backend: Backend, start: Points, end: Points) -> CayleyStep:
    """Fit on the middle of the step, so that handles arrive exactly and affine motions are reproduced."""
    return CayleyStep(backend.fit(0.5 * (start + end), end - start))


@dataclass(frozen=True, eq=False, slots=True)
class HandleStepper:
    """One step per stretch, fitted to where the handles are at its ends."""

    path: Path
    backend: Backend
    make: HandleStep

    @property
    def shortens_exactly(self) -> bool:
        """True for explicit steps on straight lines: the field is linear in the step's length."""
        return self.make is explicit_step and isinstance(self.path, StraightPath)

    def anchors(self, start: float) -> Points:
        """None."""
        return np.zeros((0, self.path.position(start).shape[1]))

    def makers(self, start: float, end: float) -> Iterable[StepMaker]:
        """The one step."""
        return (lambda _tested, _anchors: self.make(self.backend, self.path.position(start), self.path.position(end)),)

    def trial_of_held(self, step: Step, held: Points) -> Trial:
        """As any point."""
        return step.trial(held)
