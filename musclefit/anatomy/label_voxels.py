r"""Voxels of labels -> level sets, in numbers of voxels: as large as their labels, and none crossing another.

Each label's mask is smoothed by a Gaussian, G_l, and its surface is the level set of
:math:`F_l = w_l G_l - \max_{k \ne l} w_k G_k` at a small positive level, background (of weight 1) included. Where
:math:`F_l` is positive no other label's F can be, so tissues that touch in the image are left a hair apart, and stairs
of voxels become smooth. The weights, near 1, are set so that each surface encloses the volume of its label's voxels,
which smoothing alone would shrink: by :math:`3 \sigma^2 / r^2` for a ball of radius r.

The triangles between voxels follow F only nearly: where labels fold into each other, or three of them meet, surfaces
of two labels can cross in a cube between eight voxels, each of them joined through its middle. The larger label's level
is raised at the corners of such cubes until they no longer do (for the skin, which is around all labels, lowered). That
ends: a cube whose corners are all on one side of the level has no triangle.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, gaussian_filter, label
from skimage.measure import marching_cubes

from musclefit.geometry.arrays import Faces, Float, Int, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import candidate_pairs
from musclefit.geometry.surfaces.crossings import crossings_between

SMOOTHING_VOXELS = 0.6
"""Standard deviation of the Gaussian that takes the stairs away, in voxels: with more, edges of boxes are rounded by
more than half a voxel."""

LEVEL = 0.02
"""Of F, whose slope across a flat boundary is about 1.3 per voxel: tissues that touch end 0.03 voxels apart."""

PADDING = 4
"""Voxels around a label that its smoothed mask may reach."""

VOLUME_SHARE = 0.003
"""Weights are sought until a surface's volume is this near to its voxels', relatively."""

ROUNDS = 6
"""Of that search."""

MOST_WEIGHT = 2.5
"""And least one over it: a gap of one voxel between labels stays open below 3."""

SHIFT_PER_LOG_WEIGHT = 0.5 * SMOOTHING_VOXELS * np.sqrt(np.pi / 2.0)
"""By how many voxels a flat boundary moves as the logarithm of a label's weight grows by 1."""

FIRST_RAISE, RAISE_GROWTH = 0.05, 1.2
"""Of the level where two surfaces cross, and by how much more it is raised each time they still do."""

RAISES = 16
"""With these, levels are raised by more than the largest weight, which is above all that F can be."""

_CORNERS = np.array(list(product((0, 1), repeat=3)))
"""(8, 3) of a cube between voxels."""

Surface = tuple[Points, Faces]
"""Vertices, in numbers of voxels, and faces."""


@dataclass(frozen=True, eq=False, slots=True)
class LabelBlock:
    """Labels around one label, padded with background beyond the image; ``start`` is its first voxel's number."""

    labels: NDArray[np.int32]
    inside: NDArray[np.bool_]
    start: Int


@dataclass(frozen=True, eq=False, slots=True)
class LabelLevel:
    """What is above 0 within a label, by voxels from ``start`` on; drawn back it gives room, the skin ``outwards``."""

    values: NDArray[np.float32]
    start: Int
    outwards: bool = False

    def surface(self) -> Surface | None:
        """Where it is 0; None where it is nowhere above."""
        if not (self.values > 0.0).any():
            return None
        vertices, faces, _, _ = marching_cubes(self.values, 0.0)
        return vertices.astype(np.float64) + self.start, faces[:, ::-1].astype(np.int64)

    def draw_back(self, cubes: Int, by: float) -> None:
        """Change the values, in place, at the corners of cubes, (m, 3) their first voxels."""
        corners = np.unique((cubes[:, None] + _CORNERS).reshape(-1, 3), axis=0) - self.start
        self.values[tuple(corners.T)] += np.float32(by if self.outwards else -by)


@dataclass(frozen=True, eq=False, slots=True)
class LabelVoxels:
    """Labels numbered from 0 (background) on, the logarithm of each one's weight, and tissues' numbers (skin: 0)."""

    labels: NDArray[np.int32]
    log_weights: Float
    numbers: Mapping[str, int]
    boxes: list[Any] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", find_objects(self.labels))

    def block_of(self, name: str) -> LabelBlock:
        """The voxels of a tissue: its label's, or of a skin, all labels' without cavities."""
        return self.block(self.numbers[name], whole=not self.numbers[name])

    def block(self, number: int, *, whole: bool = False) -> LabelBlock:
        """The voxels of a label, or of all."""
        box = find_objects((self.labels != 0).astype(np.uint8))[0] if whole else self.boxes[number - 1]
        start = [max(s.start - PADDING, 0) for s in box]
        stop = [min(s.stop + PADDING, n) for s, n in zip(box, self.labels.shape, strict=True)]
        widths = [(PADDING - s.start + a, PADDING - b + s.stop) for s, a, b in zip(box, start, stop, strict=True)]
        crop = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        around = np.pad(self.labels[crop], widths)
        first = np.array([s.start - PADDING for s in box])
        if not whole:
            return LabelBlock(around, around == number, first)
        cut = [(axis, PADDING) for axis, s in enumerate(box) if s.start == 0]
        cut += [(axis, -PADDING - 1) for axis, s in enumerate(box) if s.stop == self.labels.shape[axis]]
        return LabelBlock(around, _filled(around != 0, cut), first)

    def surface(self, number: int) -> Surface | None:
        """That of a label, or of all together (0); None where it leads nowhere."""
        return self.level(number).surface()

    def level(self, number: int) -> LabelLevel:
        """F of a label, less the level; of all together (0) around all surfaces, and without cavities."""
        if not number:
            return self._whole(self.block(0, whole=True))
        block = self.block(number)
        own = self._smoothed(block.inside, number)
        best = self._smoothed(block.labels == 0, 0)
        for value, box in enumerate(find_objects(block.labels), start=1):
            if box is None or value == number:
                continue
            part = tuple(slice(max(s.start - PADDING, 0), s.stop + PADDING) for s in box)
            np.maximum(best[part], self._smoothed(block.labels[part] == value, value), out=best[part])
        return LabelLevel(own - best - LEVEL, block.start)

    def _whole(self, block: LabelBlock) -> LabelLevel:
        best = _smooth(block.inside)
        for number, box in enumerate(self.boxes, start=1):
            if box is None or self.log_weights[number] <= 0.0:
                continue  # no more than its share of all labels
            own = self.block(number)
            corner = own.start - block.start
            part = tuple(slice(int(a), int(a) + n) for a, n in zip(corner, own.inside.shape, strict=True))
            best[part] = np.maximum(best[part], self._smoothed(own.inside, number))
        return LabelLevel(best - _smooth(~block.inside) + LEVEL, block.start, outwards=True)

    def _smoothed(self, mask: NDArray[np.bool_], number: int) -> NDArray[np.float32]:
        return _smooth(mask) * np.float32(np.exp(self.log_weights[number]))


def _smooth(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    smoothed: NDArray[np.float32] = gaussian_filter(mask.astype(np.float32), SMOOTHING_VOXELS, mode="nearest")
    return smoothed


def _filled(inside: NDArray[np.bool_], cut: Sequence[tuple[int, int]]) -> NDArray[np.bool_]:
    """The mask and its cavities; in a slice that the image cuts (axis, number), what the mask surrounds is one.

    A skin may be given as a shell, which the image cuts open where it ends.
    """
    closed = inside.copy()
    for axis, number in cut:
        side = np.moveaxis(closed, axis, 0)[number]
        side |= _surrounded(side)
    return closed | _surrounded(closed)


def _surrounded(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What is not in a mask and not joined to the corner of its box, which is outside."""
    outside, _ = label(~mask)
    surrounded: NDArray[np.bool_] = ~mask & (outside != outside[(0,) * mask.ndim])
    return surrounded


def weigh(maps: LabelVoxels, numbers: Sequence[int], tick: Any) -> None:
    """Set the labels' weights so that surfaces enclose what their voxels do."""
    counts = np.bincount(maps.labels.ravel(), minlength=len(maps.log_weights))
    around = {number: np.unique(maps.block(number).labels) for number in numbers}
    most = np.log(MOST_WEIGHT)
    moved = np.ones(len(maps.log_weights), dtype=bool)
    for turn in range(ROUNDS):
        changes = np.zeros(len(maps.log_weights))
        for number in numbers:
            if not moved[around[number]].any():
                continue  # its surface is what it was
            made = maps.surface(number)
            if made is None:
                changes[number] = 0.5 * most
                continue
            mesh = TriMesh(*made)
            missing = counts[number] - abs(enclosed_volume(mesh))
            if abs(missing) > VOLUME_SHARE * counts[number]:
                area = float(np.linalg.norm(area_vectors(mesh), axis=1).sum())
                changes[number] = np.clip(missing / area / SHIFT_PER_LOG_WEIGHT, -0.5 * most, 0.5 * most)
        before = maps.log_weights.copy()
        maps.log_weights[:] = np.clip(before + changes, -most, most)
        tick((turn + 1) / (ROUNDS + 1))
        moved = maps.log_weights != before
        if not moved.any():
            return


@dataclass(frozen=True, eq=False, slots=True)
class DrawnApart:
    """Surfaces of labels, and what was drawn in of them where they crossed.

    Parameters
    ----------
    surfaces : mapping of label number to surface
        Of those that lead anywhere.
    cubes : mapping of label number to int
        Cubes between voxels at whose corners its level was raised; 0 is all labels together.
    volumes : mapping of label number to tuple of float
        What its surface enclosed before and after, in voxels.
    left : int
        Pairs of labels that still cross.
    """

    surfaces: Mapping[int, Surface]
    cubes: Mapping[int, int]
    volumes: Mapping[int, tuple[float, float]]
    left: int


def draw_apart(maps: LabelVoxels, numbers: Iterable[int], tick: Any) -> DrawnApart:
    """Raise the larger label's level where surfaces of two cross, until none do."""
    given = {number: made for number in numbers if (made := maps.surface(number)) is not None}
    now = {number: _InCubes.of(surface) for number, surface in given.items()}
    levels: dict[int, LabelLevel] = {}
    cubes: dict[int, list[Int]] = {}
    before: dict[int, float] = {}
    changed: Collection[int] = set(now)
    for turn in range(RAISES + 1):
        crossing = _crossing_cubes(now, changed)
        if not crossing or turn == RAISES:
            break
        for number, found in crossing.items():
            if number not in levels:
                levels[number], before[number] = maps.level(number), now[number].enclosed
            cubes.setdefault(number, []).append(found)
            levels[number].draw_back(found, FIRST_RAISE * RAISE_GROWTH**turn)
            made = levels[number].surface()
            if made is None:
                del now[number]
            else:
                now[number] = _InCubes.of(made)
        changed = set(crossing)
        tick((turn + 1) / (RAISES + 1))
    return DrawnApart(
        {number: own.surface for number, own in now.items()},
        {number: len(np.unique(np.concatenate(found), axis=0)) for number, found in cubes.items()},
        {number: (was, now[number].enclosed if number in now else 0.0) for number, was in before.items()},
        len(crossing),
    )


def _crossing_cubes(now: Mapping[int, _InCubes], changed: Collection[int]) -> dict[int, Int]:
    """(m, 3) the cubes, by their first voxels, in which a label's triangles cross those of a smaller one.

    A triangle lies in one cube, and on the sides of cubes no two surfaces meet, so triangles are tried cube by cube, of
    pairs one of which has changed.
    """
    numbers = list(now)
    found: dict[int, list[Int]] = {}
    for i, j in candidate_pairs([now[number].box for number in numbers]):
        pair = numbers[i], numbers[j]
        if not set(pair) & set(changed):
            continue
        a, b = (now[number] for number in pair)
        common: Int = np.intersect1d(a.keys, b.keys)
        if not len(common):
            continue
        faces = a.faces_in(common)
        crossing = crossings_between(a.part(faces), b.part(b.faces_in(common))).pairs
        if len(crossing):
            larger = pair[0] if a.enclosed >= b.enclosed else pair[1]
            found.setdefault(larger, []).append(a.cubes[faces[crossing[:, 0]]])
    return {number: np.unique(np.concatenate(cubes), axis=0) for number, cubes in found.items()}


@dataclass(frozen=True, eq=False, slots=True)
class _InCubes:
    """A surface, what it encloses in voxels, and the cube of each triangle: its first voxel, and that as one number."""

    surface: Surface
    enclosed: float
    cubes: Int
    keys: Int

    @classmethod
    def of(cls, surface: Surface) -> _InCubes:
        vertices, faces = surface
        cubes = np.floor(vertices[faces].mean(axis=1)).astype(np.int64)
        shifted = cubes + PADDING + 1
        keys = (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]
        return cls(surface, abs(enclosed_volume(TriMesh(*surface))), cubes, keys)

    @property
    def box(self) -> Float:
        """(2, 3) first and last cube."""
        return np.stack([self.cubes.min(axis=0), self.cubes.max(axis=0)]).astype(np.float64)

    def faces_in(self, keys: Int) -> Int:
        """(f,) triangles in some of the cubes."""
        faces: Int = np.flatnonzero(np.isin(self.keys, keys))
        return faces

    def part(self, faces: Int) -> TriMesh:
        """Some of the triangles."""
        return TriMesh(self.surface[0], self.surface[1][faces])
