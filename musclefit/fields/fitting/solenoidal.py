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

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import FieldError
from musclefit.fields.evaluation import potentials
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
        found = [np.zeros((3, len(level.coefficients))) for level in on]
        residual = problem.seen(displacements)
        slope = problem.backward(residual)
        direction, size = slope, _square(slope)
        least, missed = ROUNDING * size, [float(np.linalg.norm(residual))]
        while len(missed) <= iterations and not self._is_done(missed, count=len(at)) and size > least:
            image = problem.forward(direction)
            length = size / float(np.vdot(image, image))
            for part, along in zip(found, direction, strict=True):
                part += length * along
            residual = residual - length * image
            missed.append(float(np.linalg.norm(residual)))
            slope = problem.backward(residual)
            before, size = size, _square(slope)
            direction = [s + (size / before) * d for s, d in zip(slope, direction, strict=True)]
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
    scale : (K,) float64
        Of its coefficients.
    whole : (w,) int64
        Points that see 64 splines each ...
    places : (w, 3) float64, mm
        ... and where they are.
    rows : (w, 16) int32
        `potentials.runs_seen` of them.
    others : (o,) int64
        All other points: at a border of the lattice, or away from it.
    """

    level: PotentialLevel
    scale: Float
    whole: Int
    places: Points
    rows: NDArray[np.int32]
    others: Int

    @classmethod
    def of(cls, level: PotentialLevel, at: Points, *, smoothness: float) -> _Seen:
        squares = np.zeros(len(level.coefficients))
        potentials.spread_squares(level.low, level.spacing_mm, level.numbers, at, squares)
        most = float(np.quantile(squares, SEEN_SHARE)) if len(squares) else 1.0
        scale = level.spacing_mm**smoothness / np.sqrt(squares / (most or 1.0) + FLOOR)
        rows = np.zeros((len(at), 16), np.int32)
        potentials.runs_seen(level.low, level.spacing_mm, level.numbers, at, rows)
        whole, others = np.flatnonzero(rows[:, 0] >= 0), np.flatnonzero(rows[:, 0] < 0)
        return cls(level, scale, whole, at[whole], rows[whole], others)

    def add_curl(self, part: Float, at: Points, out: Points) -> None:
        """Add the curl of (3, K) scaled coefficients, at all points."""
        low, h, coefficients = self.level.low, self.level.spacing_mm, self.scale * part
        values = np.zeros((len(self.whole), 3))
        potentials.curl_sum_of_runs(low, h, self.rows, *coefficients, self.places, values)
        out[self.whole] += values
        if len(self.others):
            values = np.zeros((len(self.others), 3))
            held = np.ascontiguousarray(coefficients.T)
            potentials.curl_sum(low, h, self.level.numbers, held, at[self.others], values)
            out[self.others] += values

    def spread(self, at: Points, values: Points) -> Float:
        """(3, K) what the points' values give to the scaled coefficients."""
        low, h, found = self.level.low, self.level.spacing_mm, np.zeros((3, len(self.scale)))
        potentials.curl_spread_to_runs(low, h, self.rows, self.places, values[self.whole], *found)
        if len(self.others):
            out = np.zeros((len(self.scale), 3))
            potentials.curl_spread(low, h, self.level.numbers, at[self.others], values[self.others], out)
            found += out.T
        spread: Float = self.scale * found
        return spread


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    """The linear map from scaled coefficients, (3, K) a level, to what is seen of displacements; and its transpose."""

    at: Points
    normals: Points
    levels: tuple[_Seen, ...]

    @classmethod
    def of(cls, at: Points, normals: Points, levels: tuple[PotentialLevel, ...], *, smoothness: float) -> _Problem:
        at = np.ascontiguousarray(at, dtype=np.float64)
        return cls(at, normals, tuple(_Seen.of(level, at, smoothness=smoothness) for level in levels))

    def seen(self, values: Points) -> Points:
        held = len(values) - len(self.normals)
        along = np.einsum("si,si->s", values[held:], self.normals)
        return np.vstack([values[:held], along[:, None] * self.normals])

    def forward(self, parts: list[Float]) -> Points:
        values = np.zeros_like(self.at)
        for level, part in zip(self.levels, parts, strict=True):
            level.add_curl(part, self.at, values)
        return self.seen(values)

    def backward(self, values: Points) -> list[Float]:
        return [level.spread(self.at, values) for level in self.levels]

    def field(self, parts: list[Float]) -> SolenoidalField:
        scaled = (
            (seen.level, np.ascontiguousarray((seen.scale * part).T))
            for seen, part in zip(self.levels, parts, strict=True)
        )
        return SolenoidalField(tuple(replace(level, coefficients=held) for level, held in scaled))


def _square(parts: list[Float]) -> float:
    return sum(float(np.vdot(part, part)) for part in parts)
