"""Label maps -> layered surfaces: one closed surface for each label, a hair apart from its neighbours'; opens no file.

Multi-label surface nets (VTK; ``pyvista.ImageDataFilters.contour_labels``) give neighbours one common interface
instead. On 12 touching cells at 1 mm voxels these are as accurate (0.07 mm from the true cells on average, here 0.09)
and 15 times faster, but smoothing lets triangles cross (35 pairs; here none) and labels that touch along an edge give
surfaces that are no manifolds, which no anatomy may have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.label_voxels import SMOOTHING_VOXELS, DrawnApart, LabelBlock, LabelVoxels, draw_apart, weigh
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Faces, Int, Points
from musclefit.geometry.images.grids import Frame, Grid, in_frame
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.progress import Progress, Silent

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
    stages = progress or Silent()
    with stages.stage("surfaces of labels") as tick:
        inner = [name for name in present if name.kind is not TissueKind.SKIN]
        weigh(maps, [numbers[name.name] for name in inner], tick)
    with stages.stage("labels that fold into each other") as tick:
        drawn = draw_apart(maps, numbers.values(), tick)
        found += _drawn(drawn, numbers, grid)
    for name in present:
        number, mask = numbers[name.name], maps.block_of(name.name)
        made = drawn.surfaces.get(number)
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


def _drawn(drawn: DrawnApart, numbers: Mapping[str, int], grid: Grid) -> list[Finding]:
    """What is told of surfaces that were drawn apart."""
    if not drawn.cubes:
        return []
    names = {number: name for name, number in numbers.items()}
    share = {number: abs(after / before - 1.0) for number, (before, after) in drawn.volumes.items()}
    most = max(share, key=lambda number: share[number])
    size = abs(float(np.linalg.det(grid.affine[:3, :3])))
    moved = size * sum(abs(after - before) for before, after in drawn.volumes.values())
    message = (
        f"{some_of(names[number] for number in sorted(drawn.cubes))}: drawn back in {sum(drawn.cubes.values())} places "
        f"between voxels where they would cross smaller labels, by {moved:.3g} mm³ in all and at most "
        f"{100.0 * share[most]:.2g} % of a label ({names[most]})"
    )
    if drawn.left:
        message += f"; {drawn.left} still cross others"
    return [Finding("labels", "drawn-apart", message)]


def _hollow(name: str, block: LabelBlock) -> list[Finding]:
    """What is told of cavities that no label fills and that the skin was closed over."""
    filled = int((block.inside & (block.labels == 0)).sum())
    if not filled:
        return []
    share = 100.0 * filled / int(block.inside.sum())
    message = f"{name}: {filled} voxels without a label within it ({share:.2g} % of it) count as inside"
    return [Finding(name, "hollow", message)]


def _numbered(labels: NDArray[Any], values: Int) -> NDArray[np.int32]:
    """The labels as numbers from 0 on, slice by slice: an index for each voxel at once would take much memory."""
    numbers = np.empty(labels.shape, dtype=np.int32)
    for place, of in zip(numbers, labels, strict=True):
        place[:] = np.searchsorted(values, of)
    return numbers


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
