r"""Fits curls of B-spline potentials to very many displacements, some of which only count along a direction.

All levels are solved for at once by conjugate gradients on the least squares problem, from zero. Each coefficient is
scaled by a power of its lattice's spacing, 3/2, which makes the sum of squares about the energy
:math:`\int |\nabla^2 D|^2` level by level (as in the multilevel preconditioner of Bramble, Pasciak and Xu), and by
what its spline contributes at the data (Jacobi). The power decides what the field does between the data: by the energy
:math:`\int |\nabla D|^2`, power 1/2, points weigh nothing in space: the field would come to each of them in a spike.

References
----------
A. Bjorck, Numerical Methods for Least Squares Problems (1996), section 7.4 (CGLS); J. Bramble, J. Pasciak, J. Xu, Math.
Comp. 55 (1990) 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import FieldError
from musclefit.fields.evaluation import potential_runs, potentials
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.geometry.arrays import Float, Int, Points

SMOOTHNESS = 1.5
"""Power of a lattice's spacing by which its coefficients are scaled, unless another is asked for."""

SEEN_SHARE = 0.9
"""Quantile of the contributions of a level's splines that counts as whole..."""

FLOOR = 0.1
"""... and the share of it that is added to all of them, so that hardly seen splines stay small."""


PATIENCE = 5
"""Iterations that are judged together."""

ROUNDING = 1e-28
"""Of the gradient's square, as a share of its first: below it there is nothing left to go down."""


@dataclass(frozen=True, slots=True)
class SolenoidalBackend:
    """Least squares fits of fields without divergence.

    Parameters
    ----------
    tolerance_mm : float
        Root mean square of what may be missed, at which the iteration ends.
    smoothness : float
        Power of a lattice's spacing by which its coefficients are scaled.
    least_gain : float
        The iteration ends, too, where ``PATIENCE`` iterations lowered what is missed by less than this share of it.

    Raises
    ------
    FieldError
        The tolerance is negative or not finite.
    """

    tolerance_mm: float
    smoothness: float = SMOOTHNESS
    least_gain: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance_mm < np.inf:
            raise FieldError(f"the tolerance is {self.tolerance_mm} mm; it must be a number of at least 0")

    def at_rest(self, levels: Sequence[tuple[float, Points]]) -> SolenoidalField:
        """The zero field on lattices, each of a spacing, mm, and around (N, 3) points, mm."""
        return SolenoidalField(tuple(PotentialLevel.around(points, spacing_mm=h) for h, points in levels))

    def fit(
        self,
        at: Points,
        displacements: Points,
        *,
        slip_normals: Points,
        on: tuple[PotentialLevel, ...],
        iterations: int,
    ) -> SolenoidalField:
        """The field that takes displacements at points, the last of them only along their normals.

        Parameters
        ----------
        at, displacements : (m, 3) float64, mm
        slip_normals : (s, 3) float64
            Unit normals of the last s points.
        on : tuple of PotentialLevel
            The lattices; their coefficients are not looked at.
        iterations : int
            At most so many: what is missed shows in the displacements.
        """
        problem = _Problem.of(at, slip_normals, on, smoothness=self.smoothness)
        residual = problem.seen(displacements)
        slope = problem.backward(residual)
        found, direction = np.zeros_like(slope), problem.weights[:, None] * slope
        size = potential_runs.weighted_square(problem.weights, slope)
        least, missed = ROUNDING * size, [float(np.linalg.norm(residual))]
        while len(missed) <= iterations and not self._is_done(missed, count=len(at)) and size > least:
            image = problem.forward(direction)
            length = size / float(np.vdot(image, image))
            potential_runs.advance(found, direction, length)
            potential_runs.advance(residual, image, -length)
            missed.append(float(np.linalg.norm(residual)))
            slope = problem.backward(residual)
            before, size = size, potential_runs.weighted_square(problem.weights, slope)
            potential_runs.turn(direction, problem.weights, slope, size / before)
        return problem.field(found)

    def _is_done(self, missed: list[float], *, count: int) -> bool:
        """Whether the norms of what was missed so far end the iteration."""
        stalled = len(missed) > PATIENCE and missed[-1] > (1.0 - self.least_gain) * missed[-1 - PATIENCE]
        return stalled or missed[-1] <= self.tolerance_mm * np.sqrt(count)


@dataclass(frozen=True, eq=False, slots=True)
class _Seen:
    """A level and the points that see it.

    Parameters
    ----------
    level : PotentialLevel
    weights : (K,) float64
        Squares of the scales of its coefficients.
    whole : (w,) int64
        Points that see 64 splines each ...
    rows : (w, 16) int32
        ... and `potential_runs.runs_seen` of them.
    partly : (o,) int64
        Points at a border of the lattice.
    places : (o, 3) float64, mm
        Where they are.
    """

    level: PotentialLevel
    weights: Float
    whole: Int
    rows: NDArray[np.int32]
    partly: Int
    places: Points

    @classmethod
    def of(cls, level: PotentialLevel, at: Points, *, smoothness: float) -> _Seen:
        squares = np.zeros(len(level.coefficients))
        potentials.spread_squares(level.low, level.spacing_mm, level.numbers, at, squares)
        most = float(np.quantile(squares, SEEN_SHARE)) if len(squares) else 1.0
        weights = level.spacing_mm ** (2.0 * smoothness) / (squares / (most or 1.0) + FLOOR)
        rows = np.zeros((len(at), 16), np.int32)
        potential_runs.runs_seen(level.low, level.spacing_mm, level.numbers, at, rows)
        whole, partly = np.flatnonzero(rows[:, 0] >= 0), np.flatnonzero(rows[:, 0] == potential_runs.PARTLY)
        return cls(level, weights, whole, rows[whole], partly, at[partly])

    def add_curl(self, coefficients: Float, at: Points, out: Points) -> None:
        """Add the curl of (K, 4) coefficients, at all points."""
        low, h = self.level.low, self.level.spacing_mm
        potential_runs.curl_sum_of_runs(low, h, self.rows, self.whole, at, coefficients, out)
        if len(self.partly):
            values = np.zeros_like(self.places)
            potentials.curl_sum(low, h, self.level.numbers, coefficients, self.places, values)
            out[self.partly] += values

    def add_spread(self, at: Points, values: Points, out: Float) -> None:
        """Add what the points' values give to (K, 4) coefficients."""
        low, h = self.level.low, self.level.spacing_mm
        potential_runs.curl_spread_to_runs(low, h, self.rows, self.whole, at, values, out)
        if len(self.partly):
            potentials.curl_spread(low, h, self.level.numbers, self.places, values[self.partly], out)


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    """The linear map from the coefficients of all levels, (K, 4), to what is seen of displacements; and its transpose.

    Parameters
    ----------
    at : (m, 3) float64, mm
        Points in the order of the narrowest level's cells, the slipping ones last.
    order : (m,) int64
        Which of the given points each is.
    normals : (s, 3) float64
        Of the last s points.
    levels : tuple of _Seen
    weights : (K,) float64
        Squares of the coefficients' scales.
    """

    at: Points
    order: Int
    normals: Points
    levels: tuple[_Seen, ...]
    weights: Float

    @classmethod
    def of(cls, at: Points, normals: Points, levels: tuple[PotentialLevel, ...], *, smoothness: float) -> _Problem:
        narrowest = min((level.spacing_mm for level in levels), default=1.0)
        slips = np.arange(len(at)) >= len(at) - len(normals)
        order = np.lexsort((*np.floor(at / narrowest).T[::-1], slips))  # neighbours are in the cache, then
        turned = normals[order[len(at) - len(normals) :] - (len(at) - len(normals))]
        at = np.ascontiguousarray(at[order], dtype=np.float64)
        seen = tuple(_Seen.of(level, at, smoothness=smoothness) for level in levels)
        weights = np.concatenate([np.zeros(0), *(level.weights for level in seen)])
        return cls(at, order, turned, seen, weights)

    def seen(self, displacements: Points) -> Points:
        """What of the given points' displacements counts, in the problem's own order."""
        return self._across_slip(displacements[self.order])

    def _across_slip(self, values: Points) -> Points:
        slipping = values[len(values) - len(self.normals) :]
        slipping[:] = np.einsum("si,si->s", slipping, self.normals)[:, None] * self.normals
        return values

    def forward(self, coefficients: Float) -> Points:
        """(m, 3) what is seen of (K, 4) coefficients' displacements."""
        values = np.zeros_like(self.at)
        for level, own in zip(self.levels, self._by_level(coefficients), strict=True):
            level.add_curl(own, self.at, values)
        return self._across_slip(values)

    def backward(self, values: Points) -> Float:
        """(K, 4) the transpose of `forward`."""
        found = np.zeros((len(self.weights), 4))
        for level, own in zip(self.levels, self._by_level(found), strict=True):
            level.add_spread(self.at, values, own)
        return found

    def field(self, coefficients: Float) -> SolenoidalField:
        """Of (K, 4) coefficients."""
        return SolenoidalField(
            tuple(
                replace(seen.level, coefficients=np.ascontiguousarray(own[:, :3]))
                for seen, own in zip(self.levels, self._by_level(coefficients), strict=True)
            )
        )

    def _by_level(self, coefficients: Float) -> list[Float]:
        ends = np.cumsum([0, *(len(level.weights) for level in self.levels)])
        return [coefficients[start:end] for start, end in pairwise(ends)]
