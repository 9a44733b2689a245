"""Fits to very many handles: a radial sum through some of them, then compact sums of ever shorter support.

Each level takes in handles that are farther apart than a share of its support, so that its system is sparse and well
conditioned however close other handles are; conjugate gradients solve it to the last digits. Handles that earlier
levels met are held where they are, as far as a chain of supports joins them to a new one. Every handle belongs to some
level, so that the sum meets all of them; where handles are far apart, the fine levels are empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from musclefit.compiling import threaded
from musclefit.errors import FieldError
from musclefit.fields.evaluation.neighbours import Cells
from musclefit.fields.kernels import kernel_named
from musclefit.fields.layered import LayeredField
from musclefit.fields.radial import RadialBackend, RadialField
from musclefit.geometry.arrays import Bool, Float, Int, Points

BASE = 4000
"""Handles that the radial sum goes through at most, about: its system is dense."""

FEW = 1000
"""It goes through all of so many, and of more through half of them at most: the others may be very close to these."""

SUPPORT = 4.0
"""Of a level, in units of its spacing."""

APART = 0.7
"""No two handles of a level are closer than this, in units of its spacing."""

LEVEL_KERNEL = "wendland-c2"

TOLERANCE = 1e-12
"""Residual at which a level ends, in units of the largest displacement."""

MOST_ITERATIONS = 3000


@dataclass(frozen=True, slots=True)
class MultilevelBackend:
    """Interpolates the displacements of very many handles, in memory that grows as their number.

    Parameters
    ----------
    kernel : str
        Of the radial sum that reaches everywhere: a scalar one that is not compact.
    scale : float, mm
        The kernel's own length, where it has one.

    Raises
    ------
    FieldError
        The kernel is isochoric or compact.

    References
    ----------
    M. Floater and A. Iske, "Multistep scattered data interpolation using compactly supported radial basis functions",
    J. Comput. Appl. Math. 73 (1996) 65.
    """

    kernel: str
    scale: float = 1.0

    def __post_init__(self) -> None:
        kernel = kernel_named(self.kernel)
        if kernel.isochoric or kernel.compact:
            raise FieldError(
                f"kernel {self.kernel!r} is {'isochoric' if kernel.isochoric else 'compact'}; very many handles need a "
                "scalar kernel that reaches everywhere, such as r or r3"
            )

    def fit(self, at: Points, displacements: Points) -> LayeredField:
        """The field that takes the (m, n) displacements at the (m, n) handles.

        Raises
        ------
        FieldError
            Handles coincide.
        """
        at, data = np.ascontiguousarray(at, dtype=np.float64), np.ascontiguousarray(displacements, dtype=np.float64)
        spacing, first = _coarse(at)
        layers = [RadialBackend(self.kernel, self.scale).fit(at[first], data[first])]
        left = data - layers[0].displacement(at)
        tolerance = TOLERANCE * max(float(np.abs(data).max(initial=0.0)), 1e-300)
        met = np.zeros(len(at), dtype=bool)
        if len(first) == len(at):  # the radial sum goes through all
            return LayeredField(tuple(layers))
        while not met.all():
            spacing *= 0.5
            if spacing < 1e-12 * float(np.abs(at).max()):
                raise FieldError(f"{int((~met).sum())} handles coincide with others; remove or merge them")
            new = _apart(at, met, spacing, before=first)
            if not len(new):
                continue
            layer = _level(at, left, new=new, met=met, support=SUPPORT * spacing, tolerance=tolerance)
            met[new] = True
            if len(layer.centres):
                left = left - layer.displacement(at)
                layers.append(layer)
        return LayeredField(tuple(layers))


def _coarse(at: Points) -> tuple[float, Int]:
    """A spacing at which about ``BASE`` handles are apart, or half of them, and these; all where there are few."""
    extent = float(np.linalg.norm(np.ptp(at, axis=0))) or 1.0
    if len(at) <= min(FEW, BASE):
        return extent, np.arange(len(at))
    spacing, nobody, enough = extent / 4.0, np.zeros(len(at), dtype=bool), min(BASE, len(at) // 2)
    while True:
        candidates = _one_each(at, np.arange(len(at)), spacing)
        if len(candidates) >= enough:  # no more than these are apart
            found = _alone(at, candidates, nobody, spacing)
            if len(found) >= enough:
                return spacing, found
        spacing /= 1.2


def _apart(at: Points, met: Bool, spacing: float, *, before: Int) -> Int:
    """Handles not met yet, at most one for each cell of a grid, none too close to one that is met or to another.

    Those of ``before`` come first.
    """
    others = ~met
    others[before] = False
    waiting = np.concatenate([before[~met[before]], np.flatnonzero(others)])
    return _alone(at, _one_each(at, waiting, spacing), met, spacing)


def _one_each(at: Points, waiting: Int, spacing: float) -> Int:
    """The first of those waiting in each cell of a grid, in their order."""
    cells = np.floor((at[waiting] - at.min(axis=0)) / spacing)
    order = np.lexsort(cells.T)  # keeps the order of those in one cell
    firsts = np.ones(len(order), dtype=bool)
    firsts[1:] = (cells[order[1:]] != cells[order[:-1]]).any(axis=1)
    found: Int = waiting[np.sort(order[firsts])]
    return found


def _alone(at: Points, candidates: Int, met: Bool, spacing: float) -> Int:
    """Candidates that are too close to none that is met, and to none of the candidates before them."""
    fixed = np.flatnonzero(met)
    both = np.concatenate([fixed, candidates])
    pairs = cKDTree(at[both]).query_pairs(APART * spacing, output_type="ndarray")
    beaten = np.zeros(len(both), dtype=bool)
    beaten[pairs.max(axis=1)] = True
    found: Int = candidates[~beaten[len(fixed) :]]
    return found


def _level(at: Points, left: Points, *, new: Int, met: Bool, support: float, tolerance: float) -> RadialField:
    """The compact sum that takes new handles what is left for them, and leaves those where they are that are met."""
    here = np.concatenate([new, np.flatnonzero(met)])
    matrix = _matrix(at[here], support)
    # What no chain of supports joins to a new handle stays as it is.
    _, group = connected_components(matrix, directed=False)
    joined = np.isin(group, group[: len(new)])
    if not joined.all():
        here, matrix = here[joined], sparse.csr_matrix(matrix[joined][:, joined])
    weights = _solved(matrix, left[here], tolerance=tolerance)
    counts = np.flatnonzero(np.abs(weights).max(axis=1) > 1e-3 * tolerance)
    n = at.shape[1]
    if len(counts):  # sorted as sums look them up, which is quicker then
        counts = counts[Cells.of(np.pad(at[here][counts], ((0, 0), (0, 3 - n))), width=support).order]
    return RadialField(
        kernel=LEVEL_KERNEL,
        scale=support,
        centres=at[here][counts],
        weights=weights[counts],
        origin=at.mean(axis=0),
        linear=np.zeros((n, n)),
        translation=np.zeros(n),
        polynomial_rank=0,
        polynomial_terms=0,
    )


def _solved(matrix: sparse.csr_matrix, data: Points, *, tolerance: float) -> Float:
    """Weights of a compact sum with these values at its centres: conjugate gradients, each column by itself."""
    weights, left, image = np.zeros_like(data), data.copy(), np.empty_like(data)
    ahead, square = left.copy(), _dots(left, left)
    for _ in range(MOST_ITERATIONS):
        if np.abs(left).max() <= tolerance:
            break
        multiply_rows(matrix.indptr, matrix.indices, matrix.data, ahead, image)
        step = square / np.maximum(_dots(ahead, image), 1e-300)
        weights += step * ahead
        image *= step
        left -= image
        before, square = square, _dots(left, left)
        ahead *= square / np.maximum(before, 1e-300)
        ahead += left
    return weights


def _dots(a: Points, b: Points) -> Float:
    """Column by column."""
    found: Float = np.einsum("ij,ij->j", a, b)
    return found


@threaded(over="image", least=4096)
def multiply_rows(
    begin: int, end: int, starts: Int, columns: Int, entries: Float, vectors: Points, image: Points
) -> None:
    """Write the product of a sparse matrix, by rows, and vectors (N, n) to ``image`` (N, n)."""
    for i in range(begin, end):
        image[i] = 0.0
        for at in range(starts[i], starts[i + 1]):
            for k in range(vectors.shape[1]):
                image[i, k] += entries[at] * vectors[columns[at], k]


def _matrix(at: Points, support: float) -> sparse.csr_matrix:
    """Wendland's C2 function of the distances between centres, where they see each other."""
    a, b = cKDTree(at).query_pairs(support, output_type="ndarray").astype(np.int32).T
    entries = _wendland_c2(at[a] - at[b], support)
    every = np.arange(len(at), dtype=np.int32)
    rows, columns = np.concatenate([a, b, every]), np.concatenate([b, a, every])
    return sparse.csr_matrix((np.concatenate([entries, entries, np.ones(len(at))]), (rows, columns)))


def _wendland_c2(apart: Points, support: float) -> Float:
    q = np.sqrt(np.einsum("ij,ij->i", apart, apart)) / support
    values: Float = (1.0 - q) ** 4 * (4.0 * q + 1.0)
    return values
