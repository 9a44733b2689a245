"""A deformation sampled on a grid, both ways, with what the sampling costs; opens no file.

What reads such a grid takes it as linear between its points. How far that is from the deformation is measured on the
surfaces of all tissues, sampled at least as finely as the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.images.grids import Frame, Grid, Interpolation, in_frame
from musclefit.geometry.images.sampling import sample
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.pipeline.images import forward_displacements, inverse_displacements
from musclefit.progress import Progress, Silent

MOST_POINTS = 100_000_000
"""Points of a grid: 1.2 GB of vectors."""

MARGIN = 2.0
"""How far a grid reaches beyond the body, in units of its spacing."""


class Direction(StrEnum):
    """Which way the points of a grid go."""

    TO_DEFORMED = "to deformed"
    TO_REST = "to rest"


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Places on the surfaces of an anatomy at rest, and where they go, mm, with the tissue that each is of."""

    rest: Points
    deformed: Points
    tissue: tuple[str, ...]
    counts: tuple[int, ...]
    spacing_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class SamplingError:
    """How far linear interpolation on the grid is from the deformation, on the surfaces of all tissues, mm.

    Parameters
    ----------
    median_mm, most_95_mm, max_mm : float
    tissue : str
        Where it is largest.
    place_mm : tuple of three float
        In the rig's frame, before the move.
    samples : int
    outside : int
        Samples beyond the grid, which it does not move; they are not counted in the lengths.
    by_tissue : tuple of (str, float)
        The largest of each tissue, largest first; tissues wholly beyond the grid are left out.
    """

    median_mm: float
    most_95_mm: float
    max_mm: float
    tissue: str
    place_mm: tuple[float, float, float]
    samples: int
    outside: int
    by_tissue: tuple[tuple[str, float], ...]


@dataclass(frozen=True, eq=False, slots=True)
class DisplacementGrid:
    """Displacements on a grid.

    Parameters
    ----------
    vectors : (nx, ny, nz, 3) float32, RAS+, mm
    grid : Grid
    direction : Direction
    error : SamplingError
    filled : int
        Points without origin, away from every tissue, that took the displacement of the nearest point that has one.
    """

    vectors: NDArray[np.float32]
    grid: Grid
    direction: Direction
    error: SamplingError
    filled: int


def grid_around(points: Points, *, frame: Frame, spacing_mm: float, margin_mm: float) -> Grid:
    """The grid along the axes of the body that holds (N, 3) points with a margin.

    Raises
    ------
    InputError
        A spacing that is not positive, a margin below 0, or more than ``MOST_POINTS`` points.
    """
    if not 0.0 < spacing_mm < np.inf:
        raise InputError(f"spacing: found {spacing_mm:g} mm; expected a length above 0")
    if not 0.0 <= margin_mm < np.inf:
        raise InputError(f"margin: found {margin_mm:g} mm; expected 0 or more")
    ras = in_frame(points, of=frame, to=Frame.RAS)
    low, high = ras.min(axis=0) - margin_mm, ras.max(axis=0) + margin_mm
    counts = np.ceil((high - low) / spacing_mm) + 1
    if float(np.prod(counts)) > MOST_POINTS:
        least = float(np.cbrt(np.prod(high - low) / MOST_POINTS))
        raise InputError(
            f"a spacing of {spacing_mm:g} mm makes a grid of {np.prod(counts):.3g} points around this body; choose "
            f"{1.1 * least:.2g} mm or more"
        )
    affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    affine[:3, 3] = 0.5 * (low + high - (counts - 1) * spacing_mm)
    return Grid((int(counts[0]), int(counts[1]), int(counts[2])), affine)


def samples_of(anatomy: Anatomy, deformation: Deformation, *, spacing_mm: float) -> Samples:
    """Places no farther apart than the spacing on the surfaces of all tissues, and where the map takes them."""
    parts = [surface_samples(tissue.surface, spacing_mm=spacing_mm).points for tissue in anatomy]
    rest = np.concatenate(parts)
    names = tuple(tissue.name for tissue in anatomy)
    return Samples(rest, deformation(rest), names, tuple(len(part) for part in parts), spacing_mm)


def displacement_grid(
    deformation: Deformation,
    grid: Grid,
    *,
    frame: Frame,
    direction: Direction,
    samples: Samples,
    progress: Progress | None = None,
) -> DisplacementGrid:
    """Sample a deformation, or its inverse, on a grid.

    Parameters
    ----------
    deformation : Deformation
        From rest to the deformed body, mm.
    grid : Grid
    frame : Frame
        Which the deformation is in.
    direction : Direction
        To rest: each point's exact origin, which resampling an image needs. To deformed: where each point goes.
    samples : Samples
    progress : Progress, optional

    Raises
    ------
    InputError
        Points beside a tissue have no origin, or the grid holds no part of the body.
    """
    progress = progress or Silent()
    back = direction is Direction.TO_REST
    filled = 0
    here, there = (samples.deformed, samples.rest) if back else (samples.rest, samples.deformed)
    places = grid.indices(in_frame(here, of=frame, to=Frame.RAS))
    if back:
        vectors, unsolved = inverse_displacements(deformation, grid, frame=frame, progress=progress)
        if unsolved:
            filled = _fill(vectors, places)
    else:
        vectors = forward_displacements(deformation, grid, frame=frame, progress=progress)
    with progress.stage("sampling error"):
        moves = in_frame(there - here, of=frame, to=Frame.RAS)
        error = _error(vectors, places, moves, samples, here)
    return DisplacementGrid(vectors, grid, direction, error, filled)


def _fill(vectors: NDArray[np.float32], places: Points) -> int:
    """Give points without origin the displacement of the nearest that has one, unless a tissue is beside them."""
    missing = np.isnan(vectors[..., 0])
    used = np.zeros(missing.shape, dtype=bool)
    base = np.floor(places[_inside(places, missing.shape)]).astype(np.int64)
    for corner in np.ndindex(2, 2, 2):
        used[tuple(np.minimum(base + corner, np.array(missing.shape) - 1).T)] = True
    bad = int((missing & used).sum())
    if bad:
        raise InputError(
            f"{bad} points of the grid beside a tissue have no origin: the map is not one-to-one there; choose a "
            "smaller spacing, or a rig whose map is certified"
        )
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    vectors[missing] = vectors[tuple(axis[missing] for axis in nearest)]
    return int(missing.sum())


def _inside(places: Points, shape: tuple[int, ...]) -> Bool:
    return np.asarray(((places >= 0.0) & (places <= np.array(shape) - 1.0)).all(axis=1))


def _error(
    vectors: NDArray[np.float32], places: Points, moves: Points, samples: Samples, here: Points
) -> SamplingError:
    inside = _inside(places, vectors.shape[:3])
    if not inside.any():
        raise InputError("the grid holds no part of the body; choose another image for --like, or give a spacing")
    read = np.empty((len(places), 3), dtype=np.float32)
    for axis in range(3):
        component, one = np.ascontiguousarray(vectors[..., axis]), np.empty(len(places), dtype=np.float32)
        sample(component, places, interpolation=Interpolation.LINEAR, outside=0.0, out=one)
        read[:, axis] = one
    lengths: Float = np.where(inside, np.linalg.norm(read - moves, axis=1), -1.0)
    worst = int(np.argmax(lengths))
    ends = np.cumsum(samples.counts)
    largest = [float(part.max()) for part in np.split(lengths, ends[:-1])]
    by_tissue = sorted(zip(samples.tissue, largest, strict=True), key=lambda pair: -pair[1])
    median, most = np.percentile(lengths[inside], [50, 95])
    x, y, z = here[worst].tolist()
    return SamplingError(
        median_mm=float(median),
        most_95_mm=float(most),
        max_mm=float(lengths[worst]),
        tissue=by_tissue[0][0],
        place_mm=(x, y, z),
        samples=len(places),
        outside=int((~inside).sum()),
        by_tissue=tuple(pair for pair in by_tissue if pair[1] >= 0.0),
    )
