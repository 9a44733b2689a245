"""Looks for a point of the body at which a step reverses orientation, and proves it when found."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.certify.ball_covers import (
    Cover,
    cayley_image,
    cayley_midpoints,
    displacement_with_error,
    explicit_image,
    solve,
)
from musclefit.certify.jumps import beside_jumps
from musclefit.certify.model import Fold
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Gradients, Points
from musclefit.vocabulary import StepKind

StepOf = tuple[StepKind, Field]
"""A step as certification takes it."""

Inside = Callable[[Points], Bool]
"""Which points at rest belong to the body."""

LARGEST_SIZE = 1e80
"""Of a matrix whose determinant is enclosed: the cube is a number."""

FOLDED_SAMPLES = 16
"""Points of the body, of those that the step turns inside out, that a proof is tried for before any others."""

ROUNDS = 18
"""Of the pattern search; its stride halves in each round without progress."""

FOLLOWED = 512
"""Folded places that are followed back to rest."""

CANDIDATES = 16
"""Of those that come from inside the body: how many a proof is tried for."""

BRANCH_STEPS, BRANCH_NEWTON = 16, 8
"""Strengths that the branch of a midpoint is followed through, and Newton steps at each."""

MIDPOINT_NEWTON, NEWTON_MISSES = 50, 4
"""Newton steps to a midpoint, at most, and those in a row after which the equation is solved no better than before."""

PLACE_SHARE = 1e-8
"""Of the coordinates and of the body's extent: places that are not proved to this are not named as those of a fold."""

ACROSS = tuple(sign * 2.0**k for k in range(-11, 4, 2) for sign in (-1.0, 1.0))
"""Strides across a fold from which a second midpoint is looked for."""

STARTS = 48
"""Points of the body with the smallest determinants, from which the search descends, too."""


@dataclass(frozen=True, eq=False, slots=True)
class Search:
    """Where folds of a step are looked for.

    Parameters
    ----------
    starts : (K, n) float64, mm
        Where the step meets them.
    stride : float
        Of the first moves from there, mm.
    extent : float
        Of the body at rest, mm.
    samples : (N, n) float64, mm
        Points of the body at rest, of which the worst are starts, too.
    inside, surely_inside : Inside
        Which points at rest are in the body: a quick test, and a slow one that counts.
    """

    starts: Points
    stride: float
    extent: float
    samples: Points
    inside: Inside
    surely_inside: Inside


def find_fold(steps: Sequence[StepOf], number: int, search: Search) -> tuple[Fold, ...]:
    """A proved fold of step ``number`` (counted from 0), or nothing.

    Descends to places with a negative determinant. The places found are followed back through the steps before to
    points at rest, which are tried only when they are inside the body, and count only when they surely are. Each is
    then carried forward in proved balls, and the fold is claimed when the determinant is negative on the whole last
    ball.
    """
    stride, samples = search.stride, search.samples
    kind, field = steps[number]
    carried = _carried(steps[:number], kind, field, samples)
    known = np.isfinite(carried).all(axis=1)
    carried, samples = carried[known], samples[known]
    determinants = _deciding(kind, field.gradient(carried))
    order = np.argsort(determinants, kind="stable")
    folded = order[determinants[order] < 0.0][:FOLDED_SAMPLES]
    fold = _first_fold(steps, number, samples[folded], search)
    beside = beside_jumps(field, (1.0,) if kind is StepKind.EXPLICIT else (0.5, -0.5), stride)
    starts = np.concatenate([search.starts, carried[order[:STARTS]], beside.reshape(-1, samples.shape[1])])
    if fold or not len(starts):
        return fold
    places = _descend(kind, field, starts, stride)[:FOLLOWED]
    rest = _back_to_rest(steps[:number], kind, field, places)
    rest = rest[np.isfinite(rest).all(axis=1)]
    return _first_fold(steps, number, rest[search.inside(rest)][:CANDIDATES], search)


def _first_fold(steps: Sequence[StepOf], number: int, candidates: Points, search: Search) -> tuple[Fold, ...]:
    """The fold at the first of some points at rest at which one is proved; nothing where there is none."""
    for candidate in candidates[search.surely_inside(candidates)] if len(candidates) else candidates:
        fold = prove_fold(steps, number, candidate[None], extent=search.extent)
        if fold:
            return fold
    return ()


def prove_fold(steps: Sequence[StepOf], number: int, rest: Points, *, extent: float) -> tuple[Fold, ...]:
    """The fold of step ``number`` at the image of one point at rest (1, n) of a body of some extent, if it is proved.

    A Cayley step so steep that the point may have several midpoints there is left alone: it takes the point to nowhere
    in particular, so that neither orientation is shown.
    """
    cover = _before(steps[:number], rest)
    kind, field = steps[number]
    if not _names_places(cover, extent):
        return ()
    if kind is StepKind.CAYLEY:
        middle = _agreed_midpoint(field, cover.points)
        if not len(middle):
            return ()
        cover = _midpoint_near(field, cover, middle)
        if not _names_places(cover, extent):
            return ()
    ceiling = _determinant_ceiling(kind, field, cover)
    if not ceiling < 0.0:
        return ()
    return (Fold(tuple(map(float, rest[0])), number, tuple(map(float, cover.points[0])), ceiling),)


def _before(steps: Sequence[StepOf], rest: Points) -> Cover:
    """The ball to which steps take a point (1, n) at rest; of infinite radius where that is not proved."""
    cover = Cover(rest, np.zeros(1))
    for kind, field in steps:
        if kind is StepKind.CAYLEY:
            midpoints = cayley_midpoints(field, cover)
            if not midpoints.found.all():
                return Cover(rest, np.full(1, np.inf))
            cover = cayley_image(field, midpoints)
        else:
            cover = explicit_image(field, cover)
    return cover


def find_second_midpoint(steps: Sequence[StepOf], number: int, search: Search, *, among: Inside) -> tuple[Fold, ...]:
    """A point of the body that has two midpoints under Cayley step ``number``, proved, or nothing.

    id - D/2 folds there: its determinant is negative at one of the two, which lies ``among`` those of the body, and so
    the step is no map of the body.
    """
    kind, field = steps[number]
    if kind is not StepKind.CAYLEY:
        return ()
    before = steps[:number]
    places = _after(before, search.samples)
    places = places[np.isfinite(places).all(axis=1)]
    worst = np.argsort(_reversed_behind(field, places), kind="stable")[:STARTS]
    starts = np.concatenate([search.starts, places[worst]])
    places = np.concatenate([places[worst], _descend(kind, field, starts, search.stride)])
    places = places[among(places)]
    places = places[_reversed_behind(field, places) < 0.0][:FOLLOWED]
    rest = _back_to_rest(before, kind, field, places)
    known = np.isfinite(rest).all(axis=1)
    places, rest = places[known], rest[known]
    known = search.inside(rest)
    places, rest = places[known][:CANDIDATES], rest[known][:CANDIDATES]
    sure = search.surely_inside(rest)
    for place, point in zip(places[sure], rest[sure], strict=True):
        fold = _two_midpoints(steps, number, point[None], place[None], search)
        if fold:
            return fold
    return ()


def _reversed_behind(field: Field, places: Points) -> Float:
    """(N,) below 0 where the first factor of a Cayley step alone reverses orientation."""
    gradients = 0.5 * field.gradient(places)
    eye = np.eye(places.shape[1])
    first, second = np.linalg.det(eye - gradients), np.linalg.det(eye + gradients)
    value: Float = np.nan_to_num(np.where(second > 0.0, first, np.abs(first)), nan=np.inf)
    return value


def _two_midpoints(
    steps: Sequence[StepOf], number: int, rest: Points, place: Points, search: Search
) -> tuple[Fold, ...]:
    """Two midpoints of a point (1, n) at rest, the first near ``place`` (1, n), in proved balls that do not meet.

    The second is looked for from the point itself, from its image, and across the fold: along where id - D/2 is
    flattest.
    """
    field = steps[number][1]
    cover = _before(steps[:number], rest)
    if not _names_places(cover, search.extent):
        return ()
    first = _midpoint_near(field, cover, place)
    if not _names_places(first, search.extent):
        return ()
    ceiling = _determinant_ceiling(StepKind.CAYLEY, field, first)
    if not ceiling < 0.0:
        return ()
    flattest = np.linalg.svd(np.eye(rest.shape[1]) - 0.5 * field.gradient(first.points)[0])[2][-1]
    starts = np.concatenate(
        [
            cover.points,
            cover.points + 0.5 * field.displacement(cover.points),
            first.points + search.stride * np.array(ACROSS)[:, None] * flattest,
        ]
    )
    targets = np.repeat(cover.points, len(starts), axis=0)
    found = solve(field, targets, factor=-0.5, goals=np.zeros(len(starts)), starts=starts)
    apart = np.linalg.norm(found - first.points, axis=1)
    for near in found[np.argsort(-apart, kind="stable")]:
        second = _midpoint_near(field, cover, near[None])
        between = float(np.linalg.norm(second.points - first.points))
        apart_for_sure = between * (1.0 - 1e-9) > float(first.radii[0] + second.radii[0])
        if apart_for_sure and _names_places(second, search.extent):
            other = tuple(map(float, second.points[0]))
            return (Fold(tuple(map(float, rest[0])), number, tuple(map(float, first.points[0])), ceiling, other),)
    return ()


def _agreed_midpoint(field: Field, point: Points) -> Points:
    """The midpoint of a point (1, n) if several ways agree on it, else none.

    Newton's method from the point itself and from its usual start, and the branch that begins at the point as the field
    grows from nothing to its full strength.
    """
    exact = np.zeros(1)
    usual = solve(field, point, factor=-0.5, goals=exact)
    branch, start = point, point
    for number in range(1, BRANCH_STEPS + 1):
        part = field.scaled(number / BRANCH_STEPS)
        for _ in range(BRANCH_NEWTON):
            values, gradients = part.displacement_and_gradient(branch)
            matrix = np.eye(point.shape[1]) - 0.5 * gradients[0]
            if not np.linalg.det(matrix) > 1e-6:  # the branch ends in a fold of id - D/2
                return np.zeros((0, point.shape[1]))
            branch = branch - np.linalg.solve(matrix, branch[0] - 0.5 * values[0] - point[0])[None]
    for _ in range(BRANCH_NEWTON):
        values, gradients = field.displacement_and_gradient(start)
        matrix = np.eye(point.shape[1]) - 0.5 * gradients[0]
        if not abs(np.linalg.det(matrix)) > 1e-6:
            return np.zeros((0, point.shape[1]))
        start = start - np.linalg.solve(matrix, start[0] - 0.5 * values[0] - point[0])[None]
    reach = 1e-6 * float(np.abs(usual - point).max()) + 1e-11 * float(np.abs(point).max())
    agreed = np.abs(branch - usual).max() < reach and np.abs(start - usual).max() < reach
    return usual if agreed else np.zeros((0, point.shape[1]))


def _names_places(cover: Cover, extent: float) -> bool:
    """Whether balls are so small that their centres tell where the places in them are."""
    return bool((cover.radii <= PLACE_SHARE * (extent + np.abs(cover.points).max(axis=1))).all())


def _midpoint_near(field: Field, cover: Cover, near: Points) -> Cover:
    """A ball that holds a midpoint of every point of a ball, found near ``near`` (1, n); of infinite radius if none is.

    With F = id - D/2, A about the inverse of I - grad D/2, and k = |A| sup |A^-1 - grad F| over a ball of radius s
    around y, the map a -> a - A (F(a) - x) contracts by k < 1 and keeps the ball when |A| |F(y) - x| <= (1 - k) s.
    Monotonicity is not needed: the midpoint need not be the only one, but it is one.
    """
    n = near.shape[1]
    middle = _solved_from(field, cover.points, near)
    values, errors = displacement_with_error(field, middle)
    reach = float(np.linalg.norm(middle - 0.5 * values - cover.points) + errors[0] + cover.radii[0])
    reach = (reach + 1e-15 * float(np.abs(middle).sum() + np.abs(values).sum() + np.abs(cover.points).sum())) * 1.001
    gradients, _ = field.gradient_bounds(middle, np.zeros_like(middle))
    matrix = np.eye(n) - 0.5 * gradients[0]
    if not (np.isfinite(matrix).all() and np.isfinite(reach) and abs(np.linalg.det(matrix)) > 1e-9):
        return Cover(middle, np.array([np.inf]))
    inverse = np.linalg.inv(matrix)
    size = float(np.linalg.norm(inverse, "fro")) * 1.001
    radius = 2.0 * size * reach
    enclosed, spread = field.gradient_bounds(middle, np.full_like(middle, radius))
    # |A^-1 - grad F| is taken as its two parts: the rounded inverse, and the gradient over the ball.
    apart = float(np.linalg.norm(inverse @ (np.eye(n) - 0.5 * enclosed[0]) - np.eye(n), "fro")) + 1e-12 * size
    contraction = (apart + 0.5 * size * float(spread[0])) * 1.001
    return Cover(middle, np.array([radius if contraction <= 0.5 else np.inf]))


def _solved_from(field: Field, point: Points, near: Points) -> Points:
    """About the midpoint of a point (1, n) to which Newton's method leads from ``near`` (1, n): the best on its way."""
    middle, best, least, misses = near, near, np.inf, 0
    for _ in range(MIDPOINT_NEWTON):
        values, gradients = field.displacement_and_gradient(middle)
        off = middle[0] - 0.5 * values[0] - point[0]
        residual = float(np.linalg.norm(off))
        if residual < least:
            best, least, misses = middle, residual, 0
        else:
            misses += 1
        matrix = np.eye(point.shape[1]) - 0.5 * gradients[0]
        if misses > NEWTON_MISSES or not abs(np.linalg.det(matrix)) > 1e-9:
            break
        middle = middle - np.linalg.solve(matrix, off)[None]
    return best


def _determinant_ceiling(kind: StepKind, field: Field, cover: Cover) -> float:
    """A proved upper bound over one ball of the determinant (for Cayley steps: of the product of both) that decides."""
    if not np.isfinite(cover.radii).all():
        return np.inf
    gradients, spread = field.gradient_bounds(
        cover.points, np.repeat(cover.radii[:, None], cover.points.shape[1], axis=1)
    )
    eye, gradient, radius = np.eye(cover.points.shape[1]), gradients[0], float(spread[0])
    if kind is StepKind.EXPLICIT:
        return _determinant_range(eye + gradient, radius)[1]
    a = _determinant_range(eye + 0.5 * gradient, 0.5 * radius)
    b = _determinant_range(eye - 0.5 * gradient, 0.5 * radius)
    products = [x * y for x in a for y in b]
    return max(products) * (1.0 - 1e-12) if max(products) < 0.0 else np.inf


def _determinant_range(matrix: Float, radius: float) -> tuple[float, float]:
    """Proved range of the determinant of matrix + E over |E| <= radius.

    It is off by at most n |E| (|matrix| + |E|)^(n-1).
    """
    n = len(matrix)
    size = float(np.linalg.norm(matrix, "fro")) * (1.0 + 1e-12) + radius
    if not size < LARGEST_SIZE:
        return -np.inf, np.inf
    off = (n * radius * size ** (n - 1) + 1e-13 * size**n) * (1.0 + 1e-12)
    value = float(np.linalg.det(matrix))
    return value - off, value + off


def _descend(kind: StepKind, field: Field, starts: Points, stride: float) -> Points:
    """Places with negative determinants that a pattern search from the starts came across."""
    n = starts.shape[1]
    moves = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=n) if any(d)])
    here, strides = starts.copy(), np.full(len(starts), stride)
    value = _deciding(kind, field.gradient(here))
    folded, depths = [here[value < 0.0]], [value[value < 0.0]]
    for _ in range(ROUNDS):
        tried = (here[:, None] + strides[:, None, None] * moves).reshape(-1, n)
        found = _deciding(kind, field.gradient(tried)).reshape(len(here), -1)
        best = np.argmin(found, axis=1)
        rows = np.arange(len(here))
        better = found[rows, best] < value
        here = np.where(better[:, None], tried.reshape(len(here), -1, n)[rows, best], here)
        value = np.where(better, found[rows, best], value)
        strides = np.where(better, strides, 0.5 * strides)
        flat = found.ravel()
        folded.append(tried[flat < 0.0])
        depths.append(flat[flat < 0.0])
    places, depth = np.concatenate(folded), np.concatenate(depths)
    # Most of the places found first, nearest to where the search began, and the deepest: every other one.
    deepest = np.argsort(depth, kind="stable")
    both = np.stack([np.arange(len(places)), deepest], axis=1).ravel()
    first_seen = np.unique(both, return_index=True)[1]
    order: Points = places[both[np.sort(first_seen)]]
    return order


def _deciding(kind: StepKind, gradients: Gradients) -> Float:
    """The sampled determinant whose sign is that of the step's Jacobian."""
    eye = np.eye(gradients.shape[-1])
    if kind is StepKind.EXPLICIT:
        value: Float = np.linalg.det(eye + gradients)
    else:
        value = np.linalg.det(eye + 0.5 * gradients) * np.linalg.det(eye - 0.5 * gradients)
    return np.nan_to_num(value, nan=np.inf)


def _after(before: Sequence[StepOf], points: Points) -> Points:
    """About where steps take points at rest."""
    for earlier, earlier_field in before:
        if earlier is StepKind.CAYLEY:
            points = 2.0 * solve(earlier_field, points, factor=-0.5, goals=np.zeros(len(points))) - points
        else:
            points = points + earlier_field.displacement(points)
    return points


def _carried(before: Sequence[StepOf], kind: StepKind, field: Field, points: Points) -> Points:
    """About the places of a step (for a Cayley step: the midpoints) to which earlier steps take points at rest."""
    points = _after(before, points)
    return solve(field, points, factor=-0.5, goals=np.zeros(len(points))) if kind is StepKind.CAYLEY else points


def _back_to_rest(before: Sequence[StepOf], kind: StepKind, field: Field, place: Points) -> Points:
    """About the point at rest that earlier steps take to a place of a step (for a Cayley step: to its midpoint)."""
    points = place - 0.5 * field.displacement(place) if kind is StepKind.CAYLEY else place
    for earlier, earlier_field in reversed(before):
        if earlier is StepKind.CAYLEY:
            points = 2.0 * solve(earlier_field, points, factor=0.5, goals=np.zeros(len(points))) - points
        else:
            points = solve(earlier_field, points, factor=1.0, goals=np.zeros(len(points)))
    return points
