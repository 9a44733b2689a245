"""Image grids as values: shape, affine and the two frames of patients; knows positions, not files or values."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points, frozen


class Frame(StrEnum):
    """Which way the coordinates of a patient run: x to the right or left, y to the front or back, z up."""

    RAS = "ras"
    LPS = "lps"


def stated_frame(words: str) -> Frame | None:
    """The one frame that a description such as "patient (LPS), mm" names; None where it names none, or both."""
    named = set(re.findall(r"\b(?:LPS|RAS)\b", words))
    return Frame(named.pop().lower()) if len(named) == 1 else None


class Interpolation(StrEnum):
    """How an image is read between its voxels; labels may only be read by the nearest one."""

    LINEAR = "linear"
    CUBIC = "cubic"
    NEAREST = "nearest"


def in_frame(points: Points, *, of: Frame, to: Frame) -> Points:
    """(N, 3) positions or vectors of one frame in another: the same, or with x and y reversed."""
    return points if of is to else points * np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False, slots=True)
class Grid:
    """Where the voxels of an image are.

    Parameters
    ----------
    shape : tuple of three int
    affine : (4, 4) float64
        Voxel numbers (i, j, k, 1) to RAS+ positions of voxel centres, mm.

    Raises
    ------
    InputError
        A grid that is empty or flat, or an affine that is not one.
    """

    shape: tuple[int, int, int]
    affine: Float

    def __post_init__(self) -> None:
        affine = frozen(self.affine)
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InputError(f"an image grid has shape {self.shape}; expected three axes of at least one voxel")
        if affine.shape != (4, 4) or not np.isfinite(affine).all() or not np.array_equal(affine[3], [0, 0, 0, 1]):
            raise InputError(f"an image's affine is {affine.tolist()}; expected finite (4, 4) with last row 0 0 0 1")
        if abs(np.linalg.det(affine[:3, :3])) < 1e-12:
            raise InputError(
                f"an image's affine {affine.tolist()} is singular: its voxels have no volume; correct its header"
            )
        object.__setattr__(self, "affine", affine)

    @property
    def count(self) -> int:
        """Number of voxels."""
        return int(np.prod(self.shape))

    @property
    def spacing(self) -> Float:
        """(3,) distance of neighbouring voxels along each axis, mm."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0), dtype=np.float64)

    def positions(self, indices: Points) -> Points:
        """(N, 3) RAS+ positions of (N, 3) voxel numbers, which need not be whole, mm."""
        return np.asarray(np.einsum("pk,ik->pi", indices, self.affine[:3, :3]) + self.affine[:3, 3], dtype=np.float64)

    def indices(self, positions: Points) -> Points:
        """(N, 3) voxel numbers, not whole, of (N, 3) RAS+ positions, mm."""
        inverse = np.linalg.inv(self.affine[:3, :3])
        return np.asarray(np.einsum("pk,ik->pi", positions - self.affine[:3, 3], inverse), dtype=np.float64)

    def voxels(self, start: int, stop: int) -> Points:
        """(n, 3) numbers of the voxels start..stop in C order (the last axis runs fastest)."""
        return np.stack(np.unravel_index(np.arange(start, stop), self.shape), axis=1).astype(np.float64)

    def coarser(self, stride: int, *, margin: int) -> Grid:
        """Every ``stride``-th voxel, continued at least ``margin`` of its own voxels beyond every face."""
        counts = [-(-(n - 1) // stride) + 1 + 2 * margin for n in self.shape]
        affine = self.affine.copy()
        affine[:3, 3] = self.positions(np.full((1, 3), -float(stride * margin)))[0]
        affine[:3, :3] *= stride
        return Grid((counts[0], counts[1], counts[2]), affine)
