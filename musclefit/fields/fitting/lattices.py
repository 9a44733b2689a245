r"""Fits free-form deformations to very many displacements: least squares on several lattices at once, local and cheap.

All levels are solved for by conjugate gradients, from zero. Each coefficient is scaled by the root of its lattice's
spacing, downwards, which makes the sum of squares about the energy :math:`\int |\nabla D|^2` level by level, so that
what is smooth goes to the wide lattices, and by what its spline contributes at the data (see `solenoidal_fit`, which
does the same for fields without divergence).

References
----------
A. Bjorck, Numerical Methods for Least Squares Problems (1996), section 7.4 (CGLS); J. Bramble, J. Pasciak, J. Xu, Math.
Comp. 55 (1990) 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array

from musclefit.errors import FieldError
from musclefit.fields.evaluation import bsplines
from musclefit.fields.ffd import FfdField, Lattice, SplineLevel
from musclefit.geometry.arrays import Float, Points

SEEN_SHARE = 0.9
"""Quantile of the contributions of a level's splines that counts as whole..."""

FLOOR = 0.1
"""... and the share of it that is added to all of them, so that hardly seen splines stay small."""

ROUNDING = 1e-28
"""Of the gradient's square, as a share of its first: below it there is nothing left to go down."""

MAX_LATTICE_POINTS = 20_000_000
"""Lattice points of one level at most; about 3 GB while a field is fitted."""


@dataclass(frozen=True, slots=True)
class LatticeBackend:
    """Least squares fits of local fields on several lattices.

    Parameters
    ----------
    spacings_mm : tuple of float
        Of the lattices, wide to narrow.
    tolerance_mm : float
        Root mean square of what may be missed, at which the iteration ends.
    iterations : int
        At most so many.

    Raises
    ------
    FieldError
        A spacing is not positive or there is none, the tolerance is negative, or no iteration is allowed.
    """

    spacings_mm: tuple[float, ...]
    tolerance_mm: float
    iterations: int

    def __post_init__(self) -> None:
        if not self.spacings_mm or not all(0.0 < h < np.inf for h in self.spacings_mm):
            raise FieldError(f"the lattices' spacings are {self.spacings_mm} mm; give at least one, each positive")
        if not 0.0 <= self.tolerance_mm < np.inf or self.iterations < 1:
            raise FieldError(
                f"the tolerance is {self.tolerance_mm} mm and the iterations {self.iterations}; they must be a number "
                "of at least 0, and at least 1"
            )

    def fit(self, at: Points, displacements: Points, *, around: Points) -> FfdField:
        """The field that takes about (m, 3) displacements at (m, 3) points, mm.

        Parameters
        ----------
        at, displacements : (m, 3) float64, mm
        around : (k, 3) float64, mm
            The lattices lie around these; beyond them the field fades to zero within two cells.

        Raises
        ------
        FieldError
            A lattice would be too large.
        """
        lattices = [_lattice_around(around, spacing) for spacing in self.spacings_mm]
        problem = _Problem.of(np.ascontiguousarray(at, dtype=np.float64), lattices)
        found = [np.zeros((*lattice.shape, 3)) for lattice in lattices]
        residual = np.array(displacements, dtype=np.float64)
        slope = problem.backward(residual)
        direction, size = slope, _square(slope)
        least = ROUNDING * size
        for _ in range(self.iterations):
            if np.linalg.norm(residual) <= self.tolerance_mm * np.sqrt(len(at)) or size <= least:
                break
            image = problem.forward(direction)
            length = size / float(np.vdot(image, image))
            for part, along in zip(found, direction, strict=True):
                part += length * along
            residual -= length * image
            slope = problem.backward(residual)
            before, size = size, _square(slope)
            direction = [s + (size / before) * d for s, d in zip(slope, direction, strict=True)]
        return problem.field(found)


def met_exactly(field: FfdField, at: Points, displacements: Points) -> FfdField:
    """A field with the least change of its splines that adds displacements at a few points exactly.

    Parameters
    ----------
    field : FfdField
        In space.
    at, displacements : (m, 3) float64, mm
        Points that no spline sees cannot be met. All pairs are looked at: no more than thousands should be given.

    Returns
    -------
    FfdField
        On the same lattices. A lattice's splines share by the inverse of its spacing, as in `LatticeBackend`.
    """
    seen = [_seen_by(level.lattice, at) for level in field.levels]
    shares = [1.0 / float(level.lattice.spacing[0]) for level in field.levels]
    pairs = sum(share * (rows @ rows.T) for rows, share in zip(seen, shares, strict=True)).toarray()
    weights = np.linalg.lstsq(pairs, displacements, rcond=1e-13)[0]
    levels = tuple(
        replace(level, coefficients=level.coefficients + share * (rows.T @ weights).reshape(level.coefficients.shape))
        for level, rows, share in zip(field.levels, seen, shares, strict=True)
    )
    return replace(field, levels=levels)


def _seen_by(lattice: Lattice, at: Points) -> Any:
    """What each spline of a lattice contributes at points: a sparse matrix (m, lattice points)."""
    places = (at - lattice.low) / lattice.spacing
    cells = np.floor(places).astype(np.int64)
    t = places - cells
    s = 1.0 - t
    along = np.stack([s**3, 4.0 + t * t * (3.0 * t - 6.0), 4.0 + s * s * (3.0 * s - 6.0), t**3], axis=2) / 6.0
    nodes = cells[:, :, None] + np.arange(-1, 3)
    here = (nodes >= 0) & (nodes < np.array(lattice.shape)[:, None])
    along, nodes = np.where(here, along, 0.0), np.where(here, nodes, 0)
    values = np.einsum("mi,mj,mk->mijk", along[:, 0], along[:, 1], along[:, 2]).reshape(len(at), -1)
    i, j, k = nodes[:, 0, :, None, None], nodes[:, 1, None, :, None], nodes[:, 2, None, None, :]
    numbers = ((i * lattice.shape[1] + j) * lattice.shape[2] + k).reshape(len(at), -1)
    rows = np.repeat(np.arange(len(at)), values.shape[1])
    size = (len(at), int(np.prod(lattice.shape)))
    return coo_array((values.ravel(), (rows, numbers.ravel())), shape=size).tocsr()


@dataclass(frozen=True, eq=False, slots=True)
class _Problem:
    """The linear map from scaled coefficients to displacements, and its transpose."""

    at: Points
    lattices: Sequence[Lattice]
    scales: Sequence[Float]

    @classmethod
    def of(cls, at: Points, lattices: Sequence[Lattice]) -> _Problem:
        scales = []
        for lattice in lattices:
            seen = np.zeros((*lattice.shape, 1))
            bsplines.spread(lattice.low, lattice.spacing, at, np.ones((len(at), 1)), seen)
            some = seen[seen > 0.0]
            whole = float(np.quantile(some, SEEN_SHARE)) if len(some) else 1.0  # of a level that no point sees
            scales.append(1.0 / np.sqrt(lattice.spacing[0] * (seen / whole + FLOOR)))
        return cls(at, lattices, scales)

    def forward(self, parts: Sequence[Float]) -> Points:
        return self.field(parts).displacement(self.at)

    def backward(self, values: Points) -> list[Float]:
        parts = []
        for lattice, scale in zip(self.lattices, self.scales, strict=True):
            out = np.zeros((*lattice.shape, 3))
            bsplines.spread(lattice.low, lattice.spacing, self.at, values, out)
            out *= scale
            parts.append(out)
        return parts

    def field(self, parts: Sequence[Float]) -> FfdField:
        scaled = zip(self.lattices, self.scales, parts, strict=True)
        levels = tuple(SplineLevel(lattice, scale * part) for lattice, scale, part in scaled)
        return FfdField(levels, np.zeros(3), np.zeros((3, 3)), np.zeros(3))


def _lattice_around(at: Points, spacing: float) -> Lattice:
    """The points of a lattice through the origin whose splines are not zero somewhere in a box around points."""
    first = np.floor(at.min(axis=0) / spacing) - 1.0
    counts = np.ceil(at.max(axis=0) / spacing) + 2.0 - first
    if not counts.prod() <= MAX_LATTICE_POINTS:
        raise FieldError(
            f"a lattice of {spacing:.3g} mm around points that span {np.round(np.ptp(at, axis=0), 1)} mm would "
            f"have {counts.prod():.3g} points, more than {MAX_LATTICE_POINTS:.3g}; widen the spacing"
        )
    return Lattice(first * spacing, np.full(3, spacing), (int(counts[0]), int(counts[1]), int(counts[2])))


def _square(parts: Sequence[Float]) -> float:
    return sum(float(np.vdot(part, part)) for part in parts)
