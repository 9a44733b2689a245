"""A template changed as little as possible so that its measures become those of a body: targets of its cage; no file.

The whole is stretched along the body's height, so that it has the stature that is asked for. What is changed beyond
that is least (`geometry.least_change`) among all displacements of the cage that give the other measures, found by
Newton steps. Every measure is taken on the skin where the map that the cage drives takes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from musclefit.errors import InputError, NotConvergedError
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.least_change import DependentConditionsError, LeastChange
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.pipeline.body_measures import BodyMeasure, MeasuredBody, MeasureKind, Taken, require_measurable, take
from musclefit.pipeline.fit_body import cage_map
from musclefit.progress import Progress, Silent
from musclefit.vocabulary import Unit

REACH = 0.08
"""Over which a change fades that is asked for at one place, in units of the diagonal of the box around the skin."""

LIKELY = (0.4, 2.5)
"""A measure that is asked to be so many times that of the template, or beyond, is likely in another unit."""

CLOSE_MM = 0.01
"""Measures are met within this."""

NEARLY = 0.01
"""A stature that is off by less than this share of the template's is met by stretching the whole."""

ROUNDS = 20


@dataclass(frozen=True, eq=False, slots=True)
class MeasureFit:
    """A template with the measures of a body.

    Parameters
    ----------
    measures : tuple of BodyMeasure
    before_mm, reached_mm : (m,) float64, mm
        Each on the template, and on the skin where the map takes it.
    cage : TriMesh
        At rest.
    target : (n, 3) float64, mm
        Where its vertices go.
    deformation : Deformation
        The map that the cage makes.
    rest, skin : TriMesh
        The skin at rest, and where the map takes it.
    crossings : int
        Pairs of triangles of the target cage that cross.
    rounds : int
        Newton steps.
    """

    measures: tuple[BodyMeasure, ...]
    before_mm: Float
    reached_mm: Float
    cage: TriMesh
    target: Points
    deformation: Deformation
    rest: TriMesh
    skin: TriMesh
    crossings: int
    rounds: int

    @property
    def wanted_mm(self) -> Float:
        """(m,) what each measure shall be."""
        return np.array([measure.wanted_mm for measure in self.measures])


def fit_measures(
    body: MeasuredBody, cage: TriMesh, measures: Sequence[BodyMeasure], *, progress: Progress | None = None
) -> MeasureFit:
    """Change a template as little as possible so that its measures become what is wanted.

    Parameters
    ----------
    body : MeasuredBody
        The template.
    cage : TriMesh
        Closed; follows the template's skin.
    measures : sequence of BodyMeasure
    progress : Progress, optional

    Returns
    -------
    MeasureFit
        Every measure met within ``CLOSE_MM``.

    Raises
    ------
    InputError, LandmarkError
        Measures that the template does not have, that are likely in another unit, or that contradict each other.
    """
    progress = progress or Silent()
    require_measurable(measures, body)
    before = np.array([take(measure, body, rest=body).value_mm for measure in measures])
    _require_likely(measures, before)
    wanted = np.array([measure.wanted_mm for measure in measures])
    change = LeastChange.of(cage, reach_mm=REACH * float(np.linalg.norm(np.ptp(body.skin.vertices, axis=0))))
    stature = np.array([measure.kind is MeasureKind.STATURE for measure in measures])
    stretch = float(np.prod(wanted[stature] / before[stature]))
    beyond, off = np.zeros_like(cage.vertices), wanted - before
    with progress.stage("meet the measures") as tick:
        for done in range(ROUNDS):
            target = _stretched(body, cage.vertices, stretch) + beyond
            try:
                deformation = cage_map(cage, target, body.skin).require()
            except NotConvergedError as error:
                raise _contradictory(measures, off) from error
            moved = body.moved(deformation(body.points))
            taken = [take(measure, moved, rest=body) for measure in measures]
            reached = np.array([one.value_mm for one in taken])
            off = wanted - reached
            if np.abs(off).max() <= CLOSE_MM:
                return MeasureFit(
                    measures=tuple(measures),
                    before_mm=before,
                    reached_mm=reached,
                    cage=cage,
                    target=target,
                    deformation=deformation,
                    rest=body.skin,
                    skin=moved.skin,
                    crossings=len(self_crossings(cage.with_vertices(target)).pairs),
                    rounds=done,
                )
            slopes, asked, former = _by_the_cage(taken, body, cage.vertices), off.copy(), target - beyond
            if np.abs(off[stature]).max(initial=0.0) < NEARLY * body.stature_mm:
                # the extreme points may change places from step to step: the whole makes up for it
                stretch *= float(np.prod(wanted[stature] / reached[stature]))
                asked -= np.einsum("mnc,nc->m", slopes, _stretched(body, cage.vertices, stretch) - former)
                asked[stature] = 0.0
            try:
                beyond = change.meeting(slopes, asked + np.einsum("mnc,nc->m", slopes, beyond))
            except DependentConditionsError as error:
                among = np.flatnonzero(error.parts > 0.1)
                raise _contradictory([measures[int(k)] for k in among], off[among]) from None
            tick((done + 1) / ROUNDS)
    raise _contradictory(measures, off)


def _stretched(body: MeasuredBody, points: Points, factor: float) -> Points:
    """Points where the whole is stretched along its height."""
    heights = (points - body.skin.vertices.mean(axis=0)) @ body.up
    stretched: Points = points + (factor - 1.0) * heights[:, None] * body.up
    return stretched


def _by_the_cage(taken: Sequence[Taken], body: MeasuredBody, cage: Points) -> Float:
    """(m, n, 3) derivatives of measures by the cage's vertices, of the sum that goes there in one step."""
    numbers = np.unique(np.concatenate([one.points for one in taken]))
    shares = _shares(cage, body.points[numbers])
    slopes = []
    for one in taken:
        each = np.zeros((len(numbers), 3))
        np.add.at(each, np.searchsorted(numbers, one.points), one.slopes)
        slopes.append(shares.T @ each)
    return np.array(slopes)


def _shares(cage: Points, points: Points) -> Float:
    """(N, n) how far each point goes where one of the cage's vertices goes by 1 and the others stay (kernel r)."""
    count = len(cage)
    affine = np.hstack([np.ones((count, 1)), cage])
    system = np.block([[cdist(cage, cage), affine], [affine.T, np.zeros((4, 4))]])
    at_points = np.hstack([cdist(points, cage), np.ones((len(points), 1)), points])
    shares: Float = np.linalg.solve(system, at_points.T)[:count].T
    return shares


def _require_likely(measures: Sequence[BodyMeasure], before: Float) -> None:
    for measure, template in zip(measures, before, strict=True):
        low, high = LIKELY
        if not low * template < measure.wanted_mm < high * template:
            given = measure.wanted_mm / measure.unit.in_mm
            others = [u for u in Unit if low * template < given * u.in_mm < high * template]
            meant = f'; did you mean unit = "{others[0]}"?' if len(others) == 1 else "; correct the value or its unit"
            raise InputError(
                f"measure {measure.name!r}: {given:g} {measure.unit} is asked for, and the template has "
                f"{template / measure.unit.in_mm:.5g} {measure.unit}: {measure.wanted_mm / template:.3g} times as "
                f"much{meant}"
            )


def _contradictory(measures: Sequence[BodyMeasure], off: Float) -> InputError:
    """The error for measures that no change meets, with how far each is off."""
    said = ", ".join(f"{m.name!r} by {one:+.4g} mm" for m, one in zip(measures, off, strict=True))
    return InputError(
        f"these measures cannot be met together; the nearest that was found misses {said}. They contradict each other, "
        "or are too far from the template: correct or leave out one of them"
    )
