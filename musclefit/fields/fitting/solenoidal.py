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

from musclefit.errors import FieldError
from musclefit.fields.evaluation import potentials
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.geometry.arrays import Float, Points

SMOOTHNESS = 1.5
"""Power of a lattice's spacing by which its coefficients are scaled, unless another is asked for."""

SEEN_SHARE = 0.9
"""Quantile of the contributions of a level's splines that counts as whole..."""

FLOOR = 0.1
"""... and the share of it that is added to all of them, so that hardly seen splines stay small."""


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
    """

    tolerance_mm: float
    smoothness: float = SMOOTHNESS

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
        found = [np.zeros_like(level.coefficients) for level in on]
        residual = problem.seen(displacements)
        slope = problem.backward(residual)
        direction, size = slope, _square(slope)
        least = ROUNDING * size
        for _ in range(iterations):
            if np.linalg.norm(residual) <= self.tolerance_mm * np.sqrt(len(at)) or size <= least:
                break
            image = problem.forward(direction)
            length = size / float(np.vdot(image, image))
            for part, along in zip(found, direction, strict=True):
                part += length * along
            residual = residual - length * image
            slope = problem.backward(residual)
            before, size = size, _square(slope)
            direction = [s + (size / before) * d for s, d in zip(slope, direction, strict=True)]
        return problem.field(found)


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    """The linear map from scaled coefficients to what is seen of the displacements, and its transpose."""

    at: Points
    normals: Points
    levels: tuple[PotentialLevel, ...]
    scales: list[Float]

    @classmethod
    def of(cls, at: Points, normals: Points, levels: tuple[PotentialLevel, ...], *, smoothness: float) -> _Problem:
        at, scales = np.ascontiguousarray(at, dtype=np.float64), []
        for level in levels:
            squares = np.zeros(len(level.coefficients))
            potentials.spread_squares(level.low, level.spacing_mm, level.numbers, at, squares)
            whole = float(np.quantile(squares, SEEN_SHARE)) if len(squares) else 1.0
            scales.append((level.spacing_mm**smoothness / np.sqrt(squares / (whole or 1.0) + FLOOR))[:, None])
        return cls(at, normals, levels, scales)

    def seen(self, values: Points) -> Points:
        held = len(values) - len(self.normals)
        along = np.einsum("si,si->s", values[held:], self.normals)
        return np.vstack([values[:held], along[:, None] * self.normals])

    def forward(self, parts: list[Float]) -> Points:
        return self.seen(self.field(parts).displacement(self.at))

    def backward(self, values: Points) -> list[Float]:
        parts = []
        for level, scale in zip(self.levels, self.scales, strict=True):
            out = np.zeros_like(level.coefficients)
            potentials.curl_spread(level.low, level.spacing_mm, level.numbers, self.at, values, out)
            parts.append(scale * out)
        return parts

    def field(self, parts: list[Float]) -> SolenoidalField:
        scaled = zip(self.levels, self.scales, parts, strict=True)
        return SolenoidalField(tuple(replace(level, coefficients=scale * part) for level, scale, part in scaled))


def _square(parts: list[Float]) -> float:
    return sum(float(np.vdot(part, part)) for part in parts)
