r"""Fits free-form deformations to handle displacements: least squares with minimal bending, from coarse to fine.

The coarsest lattice lies around all handles with a wide margin. Its coefficients c and an affine part minimise

.. math:: |A c + P a - d|^2 + \mu\, c^T C^{-1} c, \qquad C^{-1} = E + \alpha M

where E is the bending energy and M the mean square of the splines, exactly integrated; alpha fades the field out over
the handles' extent, and a window over the margin takes the coefficients to zero at the lattice's edge. It is solved for
m multipliers rather than the coefficients: c = W C W A^T w with (A W C W A^T + mu I) w + P a = d, P^T w = 0. Affine
motions are reproduced exactly. What handles closer than the spacing leave over goes to a lattice of half the spacing,
with coefficients of least (smoothed) norm, and so on until the handles are resolved; there mu = 0 and every handle is
met.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import convolve
from scipy.spatial import cKDTree

from musclefit.errors import FieldError
from musclefit.fields.evaluation import bsplines
from musclefit.fields.ffd import FfdField, Lattice, SplineLevel
from musclefit.fields.fitting.saddle import SaddleFactor
from musclefit.geometry.arrays import Float, Points

RESOLVED = 0.5
"""Handles at least this many spacings apart are told apart by a lattice; the first such lattice meets them exactly."""

TRADE = 1.0
"""Least squares on a coarse lattice: mu, as a fraction of what the spline's variance falls by over one spacing."""

MARGIN_EXTENTS = 0.75
"""Margin of the coarsest lattice around the handles, as a fraction of their longest extent..."""
MARGIN_CELLS = 6
"""... and at least this many of its cells."""

MAX_COEFFICIENTS = 40_000_000
"""Lattice points of one level at most; about 1 GB."""

COINCIDE_MM = 1e-9
"""Handles closer than this are one place, mm."""

MET_MM = 1e-10
"""A fit is finished when every handle is met to this, relative to displacements of up to 100 mm."""

CORRECTIONS = 4
"""Times that the finest level's system is solved for what rounding left over."""

_GRAMS = (
    np.array([2416.0, 1191.0, 120.0, 1.0]) / 5040.0,
    np.array([80.0, -15.0, -24.0, -1.0]) / 120.0,
    np.array([16.0, -9.0, 0.0, 1.0]) / 6.0,
)
"""Integrals of products of cubic B-splines 0, 1, 2, 3 cells apart; of their first and of their second derivatives."""

_SMOOTH = np.array([1.0, 4.0, 1.0]) / 6.0
"""Covariance of neighbouring coefficients of a fine level along one axis."""


@dataclass(frozen=True, slots=True)
class FfdBackend:
    """Interpolates handle displacements by cubic B-splines on lattices.

    Parameters
    ----------
    spacing_mm : float
        Of the coarsest lattice; every further level has half of it.
    max_levels : int
        Lattices at most. Handles closer than half the spacing of the last one make its system badly conditioned.

    Raises
    ------
    FieldError
        The spacing is not a positive number, or there is no level.
    """

    spacing_mm: float = 20.0
    max_levels: int = 6

    def __post_init__(self) -> None:
        if not 0.0 < self.spacing_mm < np.inf:
            raise FieldError(f"the lattice's spacing is {self.spacing_mm} mm; it must be a positive number")
        if self.max_levels < 1:
            raise FieldError(f"the number of lattice levels is {self.max_levels}; it must be at least 1")

    def fit(self, at: Points, displacements: Points) -> FfdField:
        """The field that takes the (m, n) displacements at the (m, n) handles.

        Raises
        ------
        FieldError
            Handles coincide, are too close for the finest lattice, or the lattice would be too large.
        """
        at = np.ascontiguousarray(at, dtype=np.float64)
        wanted = np.ascontiguousarray(displacements, dtype=np.float64)
        apart = nearest_distance(at)
        if apart < COINCIDE_MM:
            raise FieldError(f"two handles are {apart:.2g} mm apart; no field can tell them apart: remove one")
        n = at.shape[1]
        origin = at.mean(axis=0)
        levels: list[SplineLevel] = []
        linear, translation = np.zeros((n, n)), np.zeros(n)
        residual = wanted
        for number in range(self.max_levels):
            spacing = self.spacing_mm * 0.5**number
            last = apart >= RESOLVED * spacing or number == self.max_levels - 1
            system = LevelSystem.coarsest(at, spacing) if number == 0 else LevelSystem.finer(at, spacing)
            polynomials = np.hstack([np.ones((len(at), 1)), at - origin]) if number == 0 else np.zeros((len(at), 0))
            saddle = system.factor(polynomials, exact=last)
            weights, affine = saddle.solve(residual)
            coefficients = system.coefficients(weights)
            if number == 0:
                translation, linear = affine[0], affine[1:].T
            levels.append(SplineLevel(system.lattice, coefficients))
            field = FfdField(tuple(levels), origin, linear, translation)
            residual = wanted - field.displacement(at)
            if last:
                return self._met(field, system, saddle, at, wanted)
        raise AssertionError("the last level returns")

    def _met(self, field: FfdField, system: LevelSystem, saddle: SaddleFactor, at: Points, wanted: Points) -> FfdField:
        """The field with what rounding left over solved for again on the finest lattice."""
        limit = MET_MM * max(1.0, float(np.abs(wanted).max(initial=0.0)) / 100.0)
        for _ in range(CORRECTIONS):
            residual = wanted - field.displacement(at)
            if np.abs(residual).max(initial=0.0) <= limit:
                return field
            more = system.coefficients(saddle.solve(residual)[0])
            if not np.isfinite(more).all():
                break
            finest = field.levels[-1]
            levels = (*field.levels[:-1], SplineLevel(finest.lattice, finest.coefficients + more))
            field = FfdField(levels, field.origin, field.linear, field.translation)
        residual = wanted - field.displacement(at)
        missed = np.abs(residual).max(axis=1)
        worst = int(np.argmax(np.nan_to_num(missed, nan=np.inf)))
        if missed[worst] <= 10.0 * limit:
            return field
        raise FieldError(
            f"the handle at {np.round(at[worst], 3).tolist()} mm is missed by {missed[worst]:.3g} mm on the finest "
            f"lattice, of {system.lattice.spacing[0]:.3g} mm; the closest handles are {nearest_distance(at):.3g} mm "
            "apart: remove close handles, or allow more lattice levels"
        )


@dataclass(frozen=True, eq=False, slots=True)
class LevelSystem:
    """One lattice around handles, and how its coefficients vary together before the handles are seen.

    Parameters
    ----------
    at : (m, n) float64, mm
    lattice : Lattice
    windows : tuple of three 1-D float64
        Factor of the coefficients along each axis: zero beyond the lattice.
    covariance : (2 r0 + 1, 2 r1 + 1, 2 r2 + 1) float64
        Of two coefficients by their offset.
    """

    at: Points
    lattice: Lattice
    windows: tuple[Float, Float, Float]
    covariance: Float

    @classmethod
    def coarsest(cls, at: Points, spacing: float) -> LevelSystem:
        """With minimal bending, and a margin over which the field fades out.

        Raises
        ------
        FieldError
            The lattice would be too large.
        """
        low, high = at.min(axis=0), at.max(axis=0)
        extent = max(float((high - low).max()), spacing)
        margin = max(MARGIN_EXTENTS * extent, MARGIN_CELLS * spacing)
        lattice = _lattice_around(low, high, margin=margin, spacing=spacing)
        windows = [
            _window(lattice, axis, low[axis] - 2.0 * spacing, high[axis] + 2.0 * spacing) for axis in range(at.shape[1])
        ]
        windows += [np.ones(1)] * (3 - at.shape[1])
        return cls(at, lattice, (windows[0], windows[1], windows[2]), _bending_covariance(lattice, fades_over=extent))

    @classmethod
    def finer(cls, at: Points, spacing: float) -> LevelSystem:
        """With smoothed coefficients of least norm; its splines reach four cells from the handles.

        Raises
        ------
        FieldError
            The lattice would be too large.
        """
        lattice = _lattice_around(at.min(axis=0), at.max(axis=0), margin=4.0 * spacing, spacing=spacing)
        rows = [_SMOOTH] * at.shape[1] + [np.ones(1)] * (3 - at.shape[1])
        shape = [*lattice.shape, 1][:3]
        table = np.einsum("i,j,k->ijk", *rows)
        return cls(at, lattice, (np.ones(shape[0]), np.ones(shape[1]), np.ones(shape[2])), table)

    def factor(self, polynomials: Float, *, exact: bool) -> SaddleFactor:
        """The factorised system of multipliers; least squares unless ``exact``.

        Raises
        ------
        FieldError
            The handles are too close for this lattice.
        """
        gram = self.gram()
        if not exact:
            gram[np.diag_indices(len(gram))] += TRADE * self._fall()
        return SaddleFactor.of(gram, polynomials)

    def gram(self) -> Float:
        """(m, m) covariance of the values that the coefficients give at the handles."""
        low, spacing = self._in_space()
        gram = np.empty((len(self.at), len(self.at)))
        bsplines.spline_gram(low, spacing, *self.windows, self.covariance, self.at, gram)
        return gram

    def coefficients(self, weights: Float) -> Float:
        """Coefficients, an array of the lattice's shape and n more, for (m, n) multipliers."""
        low, spacing = self._in_space()
        n = weights.shape[1]
        shape = tuple(len(window) for window in self.windows)
        spread = np.zeros((*shape, n))
        bsplines.spread(low, spacing, self.at, np.ascontiguousarray(weights), spread)
        windowed = _windowed(spread, self.windows)
        return _windowed(_correlated(windowed, self.covariance), self.windows).reshape(*self.lattice.shape, n)

    def _fall(self) -> float:
        """How much the variance of the spline in mid-lattice falls over one spacing."""
        low, spacing = self._in_space()
        middle = self.at.mean(axis=0)
        pair = np.stack([middle, middle])
        pair[1, 0] += spacing[0]
        gram = np.empty((2, 2))
        bsplines.spline_gram(low, spacing, *self.windows, self.covariance, pair, gram)
        return float(0.5 * (gram[0, 0] + gram[1, 1]) - gram[0, 1])

    def _in_space(self) -> tuple[Float, Float]:
        missing = 3 - self.lattice.dimension
        return (
            np.concatenate([self.lattice.low, np.zeros(missing)]),
            np.concatenate([self.lattice.spacing, np.ones(missing)]),
        )


def nearest_distance(points: Points) -> float:
    """Smallest distance of two points, mm; infinite for one point."""
    if len(points) < 2:
        return np.inf
    return float(np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1].min())


def _lattice_around(low: Float, high: Float, *, margin: float, spacing: float) -> Lattice:
    """A lattice whose middle is that of the box, with points up to the margin around it."""
    counts = np.ceil((high - low + 2.0 * margin) / spacing) + 1.0
    if counts.prod() > MAX_COEFFICIENTS:
        raise FieldError(
            f"a lattice of {spacing:.3g} mm over {np.round(high - low, 1).tolist()} mm would have {counts.prod():.3g} "
            f"points, more than {MAX_COEFFICIENTS:.3g}; widen the spacing or allow fewer levels"
        )
    start = 0.5 * (low + high) - 0.5 * spacing * (counts - 1.0)
    return Lattice(start, np.full(len(low), spacing), tuple(int(c) for c in counts))


def _window(lattice: Lattice, axis: int, low: float, high: float) -> Float:
    """1 between two places, falling smoothly to 0 one cell beyond the lattice's ends."""
    where = lattice.low[axis] + lattice.spacing[axis] * np.arange(lattice.shape[axis])
    end = where[-1] + lattice.spacing[axis] - high
    beyond = np.clip(np.maximum(low - where, where - high) / end, 0.0, 1.0)
    return np.asarray(np.cos(0.5 * np.pi * beyond) ** 2, dtype=np.float64)


def _bending_covariance(lattice: Lattice, *, fades_over: float) -> Float:
    """Table of (E + alpha M)^-1 over offsets, from its spectrum on a torus twice as wide as the lattice."""
    n = lattice.dimension
    sizes = [next_fast_len(2 * count, real=True) for count in lattice.shape]
    symbols = []
    for axis, (size, h) in enumerate(zip(sizes, lattice.spacing, strict=True)):
        frequencies = 2.0 * np.pi * np.arange(size if axis < n - 1 else size // 2 + 1) / size
        cosines = np.cos(np.outer(np.arange(4), frequencies)) * np.array([1.0, 2.0, 2.0, 2.0])[:, None]
        shape = [-1 if other == axis else 1 for other in range(n)]
        symbols.append([(h ** (1 - 2 * order) * gram @ cosines).reshape(shape) for order, gram in enumerate(_GRAMS)])
    orders = np.array([order for order in np.ndindex(*(3,) * n) if sum(order) == 2])
    mass = np.prod(np.array([s[0] for s in symbols], dtype=object))
    energy = fades_over**-4.0 * mass
    for order in orders:
        times = 1.0 if order.max() == 2 else 2.0
        energy = energy + times * np.prod(np.array([s[o] for s, o in zip(symbols, order, strict=True)], dtype=object))
    table = np.fft.fftshift(irfftn(1.0 / energy, s=sizes))
    middle = [size // 2 for size in sizes]
    reach = [count - 1 for count in lattice.shape]
    kept = table[tuple(slice(c - r, c + r + 1) for c, r in zip(middle, reach, strict=True))]
    return np.ascontiguousarray(kept.reshape([*kept.shape, 1][:3]) / kept.max())


def _correlated(values: Float, covariance: Float) -> Float:
    """Sum over offsets of the covariance times the values, per component; same shape."""
    if max(covariance.shape) <= len(_SMOOTH):
        sums = [convolve(values[..., c], covariance, mode="constant") for c in range(values.shape[3])]
        return np.asarray(np.stack(sums, axis=-1), dtype=np.float64)
    sizes = [
        next_fast_len(count + reach // 2, real=True)
        for count, reach in zip(values.shape[:3], covariance.shape, strict=True)
    ]
    spectrum = rfftn(covariance, s=sizes)
    out = np.empty_like(values)
    starts = [reach // 2 for reach in covariance.shape]
    where = tuple(slice(start, start + count) for start, count in zip(starts, values.shape[:3], strict=True))
    for c in range(values.shape[3]):
        out[..., c] = irfftn(spectrum * rfftn(values[..., c], s=sizes), s=sizes)[where]
    return out


def _windowed(values: Float, windows: tuple[Float, Float, Float]) -> Float:
    return np.asarray(np.einsum("ijkc,i,j,k->ijkc", values, *windows), dtype=np.float64)
