"""Volumes through a deformation: warped images and label maps, displacement fields and Jacobian maps; opens no file.

Everything is done in blocks of voxels, so that beside the input and the output only a few MB are held. An image on
the deformed body takes at each voxel the value of where that voxel comes from; its origin is solved for until the map
takes it back to the voxel within ``TOLERANCE_MM``. Voxels whose origin is not found lie where the map is not one-to-one
(far outside the body) and are counted, never guessed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from musclefit.errors import InputError
from musclefit.flow.deformation import Deformation
from musclefit.flow.inverses import Guess, Origins, origins, origins_near
from musclefit.geometry.arrays import Points
from musclefit.geometry.images.grids import Frame, Grid, Interpolation, in_frame
from musclefit.geometry.images.sampling import prefiltered, sample
from musclefit.progress import Progress, Silent, Tick

TOLERANCE_MM = 1e-6
"""The map takes the origin of a voxel back to the voxel within this."""

BLOCK = 1 << 16
"""Voxels that are worked on at once."""

STRIDE = 3
"""Every so many voxels along each axis an origin is solved for without a guess."""

GUESS_MARGIN = 3
"""Voxels of the guess's grid beyond the image, so that its spline is good up to the edge."""


@dataclass(frozen=True, eq=False, slots=True)
class WarpedImage:
    """An image on the deformed body.

    Parameters
    ----------
    values : array of the grid's shape
        float32, or the type of the labels.
    grid : Grid
    unsolved : int
        Voxels whose origin was not found; they hold the value for outside.
    """

    values: NDArray[Any]
    grid: Grid
    unsolved: int


def warp_image(
    values: NDArray[Any],
    grid: Grid,
    *,
    deformation: Deformation,
    frame: Frame,
    onto: Grid,
    interpolation: Interpolation,
    outside: float,
    displacements: NDArray[np.float32] | None = None,
    progress: Progress | None = None,
) -> WarpedImage:
    """Take an image along with a deformation.

    Parameters
    ----------
    values : (nx, ny, nz) array
        Of the image at rest.
    grid : Grid
        Where its voxels are.
    deformation : Deformation
        From rest to the deformed body, mm.
    frame : Frame
        Which the deformation is in; grids are RAS+.
    onto : Grid
        Of the result, often the same.
    interpolation : Interpolation
        Linear and cubic are for intensities; label maps need nearest.
    outside : float
        Value of what comes from beyond the image.
    displacements : (nx, ny, nz, 3) float32, or None
        To be filled, where they are wanted too, with what `inverse_displacements` gives on ``onto``.

    Raises
    ------
    InputError
        Values that do not fit their grid.
    """
    if values.shape != grid.shape:
        raise InputError(f"an image has shape {values.shape}, its grid {grid.shape}; give one value for each voxel")
    labels = interpolation is Interpolation.NEAREST
    source = prefiltered(values, interpolation)
    out = np.empty(onto.count, dtype=values.dtype if labels else np.float32)
    vectors = None if displacements is None else displacements.reshape(-1, 3)
    unsolved = 0
    with (progress or Silent()).stage("warp the image") as tick:
        for part, found in _origins(deformation, onto, frame, tick):
            if vectors is not None:
                vectors[part] = _vectors(found, onto, part)
            sample(source, grid.indices(found.points), interpolation=interpolation, outside=outside, out=out[part])
            missing = ~found.found
            out[part][missing] = outside
            unsolved += int(missing.sum())
    return WarpedImage(out.reshape(onto.shape), onto, unsolved)


def inverse_displacements(
    deformation: Deformation, onto: Grid, *, frame: Frame, progress: Progress | None = None
) -> tuple[NDArray[np.float32], int]:
    """Where each voxel of the deformed body comes from, minus where it is: RAS+ vectors, mm.

    This is what resampling an image needs.

    Returns
    -------
    (nx, ny, nz, 3) float32
        Not a number where the origin was not found.
    int
        How many those are.
    """
    out, unsolved = np.empty((onto.count, 3), dtype=np.float32), 0
    with (progress or Silent()).stage("inverse displacements") as tick:
        for part, found in _origins(deformation, onto, frame, tick):
            out[part] = _vectors(found, onto, part)
            unsolved += int((~found.found).sum())
    return out.reshape(*onto.shape, 3), unsolved


def _vectors(found: Origins, onto: Grid, part: slice) -> Points:
    """Origins minus voxels; not a number where there is none."""
    return np.where(found.found[:, None], found.points - onto.positions(onto.voxels(part.start, part.stop)), np.nan)


def forward_displacements(
    deformation: Deformation, at: Grid, *, frame: Frame, progress: Progress | None = None
) -> NDArray[np.float32]:
    """Where each voxel at rest goes, minus where it is: (nx, ny, nz, 3) RAS+ vectors, mm. Moves points, not images."""
    out = np.empty((at.count, 3), dtype=np.float32)
    with (progress or Silent()).stage("displacements") as tick:
        for part in _parts(at, tick):
            here = at.positions(at.voxels(part.start, part.stop))
            moved = deformation(in_frame(here, of=Frame.RAS, to=frame))
            out[part] = in_frame(moved, of=frame, to=Frame.RAS) - here
    return out.reshape(*at.shape, 3)


def jacobian_map(
    deformation: Deformation, at: Grid, *, frame: Frame, progress: Progress | None = None
) -> NDArray[np.float32]:
    """Jacobian determinant of the deformation at each voxel at rest: 1 where volume is kept, 0 or less at folds."""
    out = np.empty(at.count, dtype=np.float32)
    with (progress or Silent()).stage("Jacobian map") as tick:
        for part in _parts(at, tick):
            here = in_frame(at.positions(at.voxels(part.start, part.stop)), of=Frame.RAS, to=frame)
            out[part] = np.linalg.det(deformation.jacobian(here))
    return out.reshape(at.shape)


def _parts(grid: Grid, tick: Tick) -> Iterator[slice]:
    for start in range(0, grid.count, BLOCK):
        stop = min(start + BLOCK, grid.count)
        yield slice(start, stop)
        tick(stop / grid.count)


def _origins(deformation: Deformation, onto: Grid, frame: Frame, tick: Tick) -> Iterator[tuple[slice, Origins]]:
    """RAS+ origins of all voxels, block by block."""
    guess = _guess(deformation, onto, frame)
    for part in _parts(onto, tick):
        targets = in_frame(onto.positions(onto.voxels(part.start, part.stop)), of=Frame.RAS, to=frame)
        found = origins_near(deformation, targets, guess=guess, tolerance_mm=TOLERANCE_MM)
        yield part, Origins(in_frame(found.points, of=frame, to=Frame.RAS), found.found)


def _guess(deformation: Deformation, onto: Grid, frame: Frame) -> Guess:
    """Origins solved for on a coarse grid, as a spline; where one is not found, it is guessed to be its target."""
    coarse = onto.coarser(STRIDE, margin=GUESS_MARGIN)
    differences = np.empty((coarse.count, 3))
    for start in range(0, coarse.count, BLOCK):
        part = slice(start, min(start + BLOCK, coarse.count))
        targets = in_frame(coarse.positions(coarse.voxels(part.start, part.stop)), of=Frame.RAS, to=frame)
        found = origins(deformation, targets, tolerance_mm=TOLERANCE_MM)
        differences[part] = np.where(found.found[:, None], found.points - targets, 0.0)
    coefficients = differences.reshape(*coarse.shape, 3)
    for axis in range(3):
        coefficients = spline_filter1d(coefficients, order=3, axis=axis, mode="mirror")
    linear = np.linalg.inv(coarse.affine[:3, :3])
    reversed_axes = in_frame(np.ones((1, 3)), of=frame, to=Frame.RAS)[0]
    return Guess(np.ascontiguousarray(coefficients), linear * reversed_axes, -linear @ coarse.affine[:3, 3])
