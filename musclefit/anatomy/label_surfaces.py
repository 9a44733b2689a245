r"""Label maps -> layered surfaces: one closed surface for each label, a hair apart from its neighbours'; opens no file.

Each label's mask is smoothed by a Gaussian, G_l, and its surface is the level set of
:math:`F_l = w_l G_l - \max_{k \ne l} w_k G_k` at a small positive level, background (of weight 1) included. Where
:math:`F_l` is positive no other label's F can be, so tissues that touch in the image are left a hair apart, and stairs
of voxels become smooth. The weights, near 1, are set so that each surface encloses the volume of its label's voxels,
which smoothing alone would shrink: by :math:`3 \sigma^2 / r^2` for a ball of radius r. The triangles between voxels
follow F only nearly: where three labels meet, surfaces can still share about a millionth of their volume.

Multi-label surface nets (VTK; ``pyvista.ImageDataFilters.contour_labels``) give neighbours one common interface
instead. On 12 touching cells at 1 mm voxels these are as accurate (0.07 mm from the true cells on average, here 0.09)
and 15 times faster, but smoothing lets triangles cross (35 pairs; here none) and labels that touch along an edge give
surfaces that are no manifolds, which no anatomy may have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, gaussian_filter, label
from skimage.measure import marching_cubes

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Faces, Float, Int, Points
from musclefit.geometry.images.grids import Frame, Grid, in_frame
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.progress import Progress, Silent

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

FOLLOWS_PERCENT = 1.0
"""A surface whose volume differs from its voxels' by more is told."""

FOLLOWS_VOXELS = 0.5
"""A surface farther from its voxels' faces is told."""

MOST_LABELS = 20_000
"""A map of more is taken for an image of something else."""


@dataclass(frozen=True, slots=True)
class LabelName:
    """What a label means: its value in the image, the tissue's name and kind."""

    value: int
    name: str
    kind: TissueKind


@dataclass(frozen=True, slots=True)
class LabelFit:
    """How a surface follows the voxels of its label.

    Parameters
    ----------
    name : str
    voxels : int
    voxels_mm3, surface_mm3 : float
        Volume of the voxels, and what the surface encloses.
    largest_voxels : float
        Largest distance of a vertex from the faces of the voxels, in voxels along each axis.
    """

    name: str
    voxels: int
    voxels_mm3: float
    surface_mm3: float
    largest_voxels: float

    @property
    def volume_percent(self) -> float:
        """By how much the surface encloses more than the voxels."""
        return 100.0 * (self.surface_mm3 / self.voxels_mm3 - 1.0)


@dataclass(frozen=True, eq=False, slots=True)
class LabelledAnatomy:
    """The anatomy of a segmentation, what was found on the way, and the labels' voxels by the tissues' names."""

    anatomy: Anatomy
    findings: tuple[Finding, ...]
    voxels: LabelVoxels


def label_anatomy(
    labels: NDArray[Any],
    grid: Grid,
    *,
    names: Sequence[LabelName],
    frame: Frame,
    source: str,
    progress: Progress | None = None,
) -> LabelledAnatomy:
    """The anatomy of a segmentation.

    A label that has no voxel, or that makes no surface, is left out with a finding, and so are labels without a name.
    Labels at the image's border are closed there, with a finding.

    Parameters
    ----------
    labels : (nx, ny, nz) array of whole numbers
        0 is background.
    grid : Grid
    names : sequence of LabelName
        The skin, if named, is the surface of all labels together, named or not.
    frame : Frame
        Of the surfaces.
    source : str
        The image, for messages.

    Raises
    ------
    InputError
        Fractions, negative values, no label, thousands of labels, two labels of one value, or none that makes a
        surface.
    """
    values = _require_labels(labels, grid, names, source)
    found = list(_without_name(values, names, source))
    compact = _numbered(labels, values)
    present: list[LabelName] = []
    absent: list[LabelName] = []
    for name in names:
        there = name.kind is TissueKind.SKIN or name.value in values
        (present if there else absent).append(name)
    if absent:
        message = f"{source}: {len(absent)} named labels have no voxel: {some_of(n.name for n in absent)}"
        found.append(Finding(source, "absent-labels", message))
    where = {int(value): number for number, value in enumerate(values)}
    numbers = {name.name: 0 if name.kind is TissueKind.SKIN else where[name.value] for name in present}
    maps = LabelVoxels(compact, np.zeros(len(values)), numbers)
    tissues: list[Tissue] = []
    with (progress or Silent()).stage("surfaces of labels") as tick:
        inner = [name for name in present if name.kind is not TissueKind.SKIN]
        _weigh(maps, [numbers[name.name] for name in inner], tick)
        for name in present:
            number, mask = numbers[name.name], maps.block_of(name.name)
            made = maps.surface(number) if number else maps.whole(mask)
            if not number:
                found += _hollow(name.name, mask)
            if made is None:
                found.append(_too_thin(name, int((compact == number).sum()), source))
                continue
            try:
                tissue, notes = _tissue(*made, name, grid=grid, frame=frame, source=source)
            except MeshError as error:
                found.append(Finding(name.name, "left-out", f"{name.name}: is left out: {error}"))
                continue
            tissues.append(tissue)
            found += [*notes, *_cut(name.name, mask, compact.shape)]
    if not tissues:
        said = "; ".join(one.message for one in found[:4])
        raise InputError(f"{source}: no label makes a surface ({said}); give finer voxels or other labels")
    anatomy = Anatomy(tuple(tissues), f"patient ({frame.value.upper()}), mm")
    return LabelledAnatomy(anatomy, tuple(found), maps)


def label_fits(
    anatomy: Anatomy, made: LabelledAnatomy, grid: Grid, *, frame: Frame
) -> tuple[tuple[LabelFit, ...], tuple[Finding, ...]]:
    """How surfaces follow the voxels of their labels, and a finding for each that does not follow closely.

    Parameters
    ----------
    anatomy : Anatomy
        That of ``made``, or what a repair made of it.
    made : LabelledAnatomy
    grid : Grid
    frame : Frame
        Of the anatomy.
    """
    fits = []
    for tissue in anatomy:
        indices = grid.indices(in_frame(tissue.surface.vertices, of=frame, to=Frame.RAS))
        fits.append(_fit(tissue, indices, made.voxels.block_of(tissue.name), grid))
    return tuple(fits), tuple(finding for fit in fits for finding in _off(fit))


@dataclass(frozen=True, eq=False, slots=True)
class LabelBlock:
    """Labels around one label, padded with background beyond the image; ``start`` is its first voxel's number."""

    labels: NDArray[np.int32]
    inside: NDArray[np.bool_]
    start: Int


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

    def surface(self, number: int) -> tuple[Points, Faces] | None:
        """Vertices, in voxel numbers, and faces of a label; None where it leads nowhere."""
        block = self.block(number)
        own = self._smoothed(block.inside, number)
        best = self._smoothed(block.labels == 0, 0)
        for value, box in enumerate(find_objects(block.labels), start=1):
            if box is None or value == number:
                continue
            part = tuple(slice(max(s.start - PADDING, 0), s.stop + PADDING) for s in box)
            np.maximum(best[part], self._smoothed(block.labels[part] == value, value), out=best[part])
        return _level_set(own - best, LEVEL, block.start)

    def whole(self, block: LabelBlock) -> tuple[Points, Faces] | None:
        """The same of all labels together, around the surfaces of each of them and without cavities."""
        best = _smooth(block.inside)
        for number, box in enumerate(self.boxes, start=1):
            if box is None or self.log_weights[number] <= 0.0:
                continue  # no more than its share of all labels
            own = self.block(number)
            corner = own.start - block.start
            part = tuple(slice(int(a), int(a) + n) for a, n in zip(corner, own.inside.shape, strict=True))
            best[part] = np.maximum(best[part], self._smoothed(own.inside, number))
        return _level_set(best - _smooth(~block.inside), -LEVEL, block.start)

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


def _hollow(name: str, block: LabelBlock) -> list[Finding]:
    """What is told of cavities that no label fills and that the skin was closed over."""
    filled = int((block.inside & (block.labels == 0)).sum())
    if not filled:
        return []
    share = 100.0 * filled / int(block.inside.sum())
    message = f"{name}: {filled} voxels without a label within it ({share:.2g} % of it) count as inside"
    return [Finding(name, "hollow", message)]


def _level_set(values: NDArray[np.float32], level: float, start: Int) -> tuple[Points, Faces] | None:
    if not (values > level).any():
        return None
    vertices, faces, _, _ = marching_cubes(values, level)
    return vertices.astype(np.float64) + start, faces[:, ::-1].astype(np.int64)


def _numbered(labels: NDArray[Any], values: Int) -> NDArray[np.int32]:
    """The labels as numbers from 0 on, slice by slice: an index for each voxel at once would take much memory."""
    numbers = np.empty(labels.shape, dtype=np.int32)
    for place, of in zip(numbers, labels, strict=True):
        place[:] = np.searchsorted(values, of)
    return numbers


def _weigh(maps: LabelVoxels, numbers: Sequence[int], tick: Any) -> None:
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


def _tissue(
    indices: Points, faces: Faces, name: LabelName, *, grid: Grid, frame: Frame, source: str
) -> tuple[Tissue, tuple[Finding, ...]]:
    positions = in_frame(grid.positions(indices), of=Frame.RAS, to=frame)
    outwards = enclosed_volume(TriMesh(positions, faces)) > 0.0
    turned = faces if outwards else faces[:, ::-1]
    return take_in(name.name, name.kind, vertices=positions, faces=turned, source=source)


def _fit(tissue: Tissue, indices: Points, block: LabelBlock, grid: Grid) -> LabelFit:
    voxels = int(block.inside.sum())
    each = abs(float(np.linalg.det(grid.affine[:3, :3])))
    largest = _distance_from_voxel_faces(indices - block.start, block.inside)
    return LabelFit(tissue.name, voxels, voxels * each, abs(enclosed_volume(tissue.surface)), largest)


def _distance_from_voxel_faces(indices: Points, inside: NDArray[np.bool_]) -> float:
    """Largest distance of points from the faces between voxels inside and outside, in voxels; 1 where none is near."""
    home = np.clip(np.rint(indices).astype(int), 1, np.array(inside.shape) - 2)
    within = inside[tuple(home.T)]
    nearest = np.ones(len(indices))
    for offset in product((-1, 0, 1), repeat=3):
        there = home + offset
        away = np.linalg.norm(np.maximum(np.abs(indices - there) - 0.5, 0.0), axis=1)
        other = inside[tuple(there.T)] != within
        nearest[other] = np.minimum(nearest[other], away[other])
    return float(nearest.max())


def _cut(name: str, block: LabelBlock, shape: tuple[int, ...]) -> list[Finding]:
    """What is told of a label that reaches the image's border."""
    at = np.argwhere(block.inside) + block.start
    sides = [
        f"{'first' if end == 0 else 'last'} {'ijk'[axis]}"
        for axis in range(3)
        for end, number in enumerate((0, shape[axis] - 1))
        if (at[:, axis] == number).any()
    ]
    if not sides:
        return []
    message = f"{name}: is cut by the image (its {' and '.join(sides)} slice), and closed there"
    return [Finding(name, "cut-by-image", message)]


def _off(fit: LabelFit) -> list[Finding]:
    said = []
    if abs(fit.volume_percent) > FOLLOWS_PERCENT:
        said.append(f"encloses {fit.volume_percent:+.1f} % of its voxels' volume ({fit.voxels} voxels)")
    if fit.largest_voxels > FOLLOWS_VOXELS:
        said.append(f"is up to {fit.largest_voxels:.2f} voxels from their faces")
    if not said:
        return []
    message = f"{fit.name}: its surface {' and '.join(said)}: it is thin for these voxels; finer ones would follow it"
    return [Finding(fit.name, "off-its-voxels", message)]


def _too_thin(name: LabelName, voxels: int, source: str) -> Finding:
    message = (
        f"{source}: label {name.value} ({name.name!r}, {voxels} voxels) is thinner than the smoothing of "
        f"{SMOOTHING_VOXELS} voxels, and left out; resample the label map to finer voxels to keep it"
    )
    return Finding(name.name, "too-thin", message)


def _without_name(values: Int, names: Sequence[LabelName], source: str) -> list[Finding]:
    unnamed = sorted({int(value) for value in values} - {0} - {name.value for name in names})
    if not unnamed:
        return []
    message = f"{source}: {len(unnamed)} labels without a name were left out: {some_of(str(v) for v in unnamed)}"
    return [Finding(source, "unnamed-labels", message)]


def _require_labels(labels: NDArray[Any], grid: Grid, names: Sequence[LabelName], source: str) -> Int:
    """The values of the image, 0 first."""
    if not np.issubdtype(labels.dtype, np.integer):
        raise InputError(
            f"{source}: holds {labels.dtype} values; a label map holds whole numbers, store it as integers"
        )
    if labels.shape != grid.shape:
        raise InputError(
            f"{source}: labels of shape {labels.shape} on a grid of shape {grid.shape}; give one per voxel"
        )
    if not names:
        raise InputError(f"{source}: no label is named; name at least one")
    for what, given in (("value", [n.value for n in names]), ("name", [n.name for n in names])):
        doubled = [v for v, count in Counter(given).items() if count > 1]
        if doubled:
            raise InputError(f"{source}: two labels have the {what} {doubled[0]!r}; give each its own")
    values = np.union1d(np.unique(labels), [0]).astype(np.int64)
    if values[0] < 0:
        raise InputError(
            f"{source}: holds values from {values[0]} to {values[-1]}; labels are 0 (background) and above: "
            "give the segmentation, not the image it was made of"
        )
    if len(values) == 1:
        raise InputError(f"{source}: every voxel is 0, background; give a segmentation that holds labels")
    if len(values) > MOST_LABELS:
        raise InputError(
            f"{source}: holds {len(values)} different values up to {values[-1]}, more than {MOST_LABELS} labels; "
            "give the segmentation, not the image it was made of"
        )
    return values
