"""Segmentations in any of their forms -> one label map with names and kinds; knows files, not how surfaces are made.

Where masks overlap, a voxel goes to the innermost kind that claims it (bone, then muscle, other, skin), and within a
kind to the tissue of fewer voxels: what is small or deep is not swallowed by what surrounds it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.kind_words import kind_by_name
from musclefit.anatomy.label_surfaces import MOST_LABELS, LabelName
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Grid
from musclefit.io.formats.label_images import (
    ENDINGS,
    LabelImage,
    is_label_image,
    read_label_image,
    stem_of,
)
from musclefit.io.formats.nifti import HeaderForm
from musclefit.io.label_names import NamedValue, read_names

RULE = "a voxel goes to the innermost kind (bone, muscle, other, skin), then to the tissue of fewer voxels"

SAME_GRID_VOXELS = 0.05
"""Masks whose voxels are farther apart are of different images."""

KindPatterns = Sequence[tuple[str, TissueKind]]


@dataclass(frozen=True, slots=True)
class SharedVoxels:
    """Voxels that two masks claimed: who kept them, who lost them, and their volume."""

    kept_by: str
    lost_by: str
    voxels: int
    volume_mm3: float


@dataclass(frozen=True, eq=False, slots=True)
class Segmentation:
    """A segmentation as one label map.

    Parameters
    ----------
    labels : (nx, ny, nz) array of whole numbers
    grid : Grid
    names : tuple of LabelName
    form : str
        What was read, in words.
    shared : tuple of SharedVoxels
        Most voxels first.
    findings : tuple of Finding
    hashes : mapping of file name to SHA-256
    """

    labels: NDArray[Any]
    grid: Grid
    names: tuple[LabelName, ...]
    form: str
    shared: tuple[SharedVoxels, ...]
    findings: tuple[Finding, ...]
    hashes: Mapping[str, str]


@dataclass(frozen=True, eq=False, slots=True)
class _Mask:
    """One mask that may share voxels with others: its part of the image, and where that is."""

    name: str
    inside: NDArray[np.bool_]
    place: tuple[slice, slice, slice]

    @classmethod
    def of(cls, name: str, inside: NDArray[np.bool_]) -> _Mask:
        """What is kept is the part of the image that the mask reaches: an image of each of 100 tissues is too much."""
        reached = [np.flatnonzero(inside.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
        low, high = ([int(r[end]) if r.size else 0 for r in reached] for end in (0, -1))
        i, j, k = (slice(a, b + 1) for a, b in zip(low, high, strict=True))
        return cls(name, inside[i, j, k].copy(), (i, j, k))


def read_segmentation(
    source: Path,
    *,
    names: Path | None = None,
    kinds: KindPatterns = (),
    header: HeaderForm = HeaderForm.AGREED,
) -> Segmentation:
    """Read a label map, a 4-D stack of masks, a .seg.nrrd or a folder of one mask per tissue.

    Names come from the table, else from the file's header or the masks' file names, else from the values; kinds from
    the patterns, else the table, else the names' words, else they are other, with a finding.

    Parameters
    ----------
    source : Path
        An image, or a folder.
    names : Path, optional
        See `musclefit.io.label_names.read_names`; of a stack, the value counts volumes from 1; of a folder, the name
        is a file's without its ending.
    kinds : sequence of (pattern, TissueKind)
    header : HeaderForm

    Raises
    ------
    InputError
        A file, or all of a folder, that cannot be read, no grid that most masks share, values that are no labels, names
        without labels, a pattern that fits none, or two skins.
    """
    table = () if names is None else read_names(names)
    hashes = {} if names is None else {names.name: sha256(names.read_bytes()).hexdigest()}
    if source.is_dir():
        return _from_folder(source, table, kinds, header, hashes)
    image = read_label_image(source, form=header)
    hashes[source.name] = image.sha256
    if len(image.layers) == 1:
        return _from_map(source, image, table, kinds, hashes)
    return _from_layers(source, image, table, kinds, hashes)


def _from_map(
    source: Path, image: LabelImage, table: Sequence[NamedValue], kinds: KindPatterns, hashes: Mapping[str, str]
) -> Segmentation:
    labels = image.layers[0]
    present = _values(labels, source)
    given = {row.value: row for row in table} or {s.value: NamedValue(s.value, s.name, None) for s in image.segments}
    if table and not set(given) & set(present):
        raise InputError(
            f"{source}: none of the {len(given)} values in the table of names is in the image, which holds "
            f"{some_of(str(v) for v in present)}; give the table of this segmentation"
        )
    rows = list(given.values()) or [NamedValue(value, f"label_{value}", None) for value in present]
    found: list[Finding] = []
    if not given:
        message = f"{source.name}: nothing names its {len(rows)} labels, so they are named by their values; use --names"
        found.append(Finding(source.name, "no-names", message))
    rows = _own_names(rows, found)
    known, told = _kinds_of({row.name: row.kind for row in rows}, kinds)
    values = set(present)
    chosen = tuple(LabelName(row.value, row.name, known[row.name]) for row in rows if row.value in values)
    absent = [row.name for row in rows if row.value not in values]
    if absent:
        said = f"{source.name}: {len(absent)} of the names have no voxel: {some_of(absent)}"
        found.append(Finding(source.name, "absent-labels", said))
    _require_one_skin(chosen)
    return Segmentation(labels, image.grid, chosen, "label map", (), (*found, *told), hashes)


def _from_layers(
    source: Path, image: LabelImage, table: Sequence[NamedValue], kinds: KindPatterns, hashes: Mapping[str, str]
) -> Segmentation:
    found: list[Finding] = []
    masks: list[_Mask] = []
    if image.segments:
        form = f"segmentation of {len(image.layers)} layers"
        renamed = {row.value: row.name for row in table}
        often = Counter(segment.name for segment in image.segments)
        for segment in image.segments:
            if not 0 <= segment.layer < len(image.layers):
                raise InputError(
                    f"{source}: segment {segment.name!r} is in layer {segment.layer} of {len(image.layers)}; save the "
                    "segmentation again"
                )
            own = segment.name if often[segment.name] == 1 else f"{segment.name}_{segment.layer}_{segment.value}"
            name = renamed.get(segment.value, own)
            masks.append(_Mask.of(name, image.layers[segment.layer] == segment.value))
    else:
        form = f"stack of {len(image.layers)} masks"
        named = {row.value: row.name for row in table}
        beyond = [value for value in named if value > len(image.layers)]
        if beyond:
            raise InputError(
                f"{source}: the table names volume {beyond[0]}, but there are {len(image.layers)}; number them from 1"
            )
        for number, layer in enumerate(image.layers, start=1):
            _require_mask(layer, f"{source}: volume {number}")
            masks.append(_Mask.of(named.get(number, f"mask_{number}"), layer != 0))
    return _painted(source, masks, image.grid, table, kinds, form, found, hashes)


def _from_folder(
    folder: Path, table: Sequence[NamedValue], kinds: KindPatterns, header: HeaderForm, hashes: Mapping[str, str]
) -> Segmentation:
    files = [path for path in sorted(folder.iterdir()) if is_label_image(path) and not path.name.startswith(".")]
    if not files:
        raise InputError(f"{folder}: holds no mask; expected one {', '.join(ENDINGS)} file for each tissue")
    masks: dict[Path, tuple[_Mask, Grid]] = {}
    left_out: dict[Path, str] = {}
    known = dict(hashes)
    for path in files:
        try:
            image = read_label_image(path, form=header)
            if len(image.layers) != 1:
                raise InputError(f"{path}: holds {len(image.layers)} volumes; a mask of a folder is one")
            _require_mask(image.layers[0], f"{path}")
        except InputError as error:
            left_out[path] = str(error)
            continue
        known[path.name] = image.sha256
        masks[path] = _Mask.of(stem_of(path), image.layers[0] != 0), image.grid
    if not masks:
        raise InputError(f"{folder}: none of its {len(files)} files is a mask; the first: {left_out[files[0]]}")
    first = _most_common({path: grid for path, (_, grid) in masks.items()}, folder)
    grid = masks[first][1]
    for path, (_, own) in masks.items():
        apart = _other_grid(first, grid, path, own)
        if apart:
            left_out[path] = apart
    found = [Finding(stem_of(path), "left-out", f"left out: {said}") for path, said in left_out.items()]
    kept = [mask for path, (mask, _) in masks.items() if path not in left_out]
    return _painted(folder, kept, grid, table, kinds, f"folder of {len(kept)} masks", found, known)


def _most_common(grids: Mapping[Path, Grid], folder: Path) -> Path:
    """The first of most files that share a grid; refused where no grid is that of more than half of them."""
    shared: dict[Path, int] = {}
    for path, grid in grids.items():
        like = next((first for first in shared if not _other_grid(first, grids[first], path, grid)), path)
        shared[like] = shared.get(like, 0) + 1
    most = max(shared, key=lambda first: shared[first])
    if 2 * shared[most] <= len(grids) and len(shared) > 1:
        other = next(path for path in shared if path != most)
        said = _other_grid(most, grids[most], other, grids[other])
        raise InputError(f"{folder}: its {len(grids)} masks are of {len(shared)} different images; {said}")
    return most


def _painted(
    source: Path,
    masks: Sequence[_Mask],
    grid: Grid,
    table: Sequence[NamedValue],
    kinds: KindPatterns,
    form: str,
    found: list[Finding],
    hashes: Mapping[str, str],
) -> Segmentation:
    """One label map of masks by the rule, and who lost what to whom."""
    doubled = [name for name, count in Counter(mask.name for mask in masks).items() if count > 1]
    if doubled:
        raise InputError(f"{source}: {len(doubled)} names stand for several masks, such as {doubled[0]!r}; rename one")
    stated = {row.name: row.kind for row in table}
    strange = [name for name in stated if name not in {mask.name for mask in masks}]
    if len(strange) == len(stated) and stated:
        raise InputError(
            f"{source}: no mask has a name of the table; it names {some_of(strange)}, the masks are "
            f"{some_of(mask.name for mask in masks)}"
        )
    known, told = _kinds_of({mask.name: stated.get(mask.name) for mask in masks}, kinds)
    found += told
    counts = {mask.name: int(mask.inside.sum()) for mask in masks}
    empty = [name for name, count in counts.items() if not count]
    if empty:
        found.append(
            Finding(source.name, "absent-labels", f"{source.name}: {len(empty)} masks are empty: {some_of(empty)}")
        )
    order = list(TissueKind)
    there = sorted(
        (mask for mask in masks if counts[mask.name]),
        key=lambda mask: (order.index(known[mask.name]), -counts[mask.name], mask.name),
    )
    if not there:
        raise InputError(f"{source}: all {len(masks)} masks are empty; give a segmentation that holds tissue")
    names = tuple(LabelName(number, mask.name, known[mask.name]) for number, mask in enumerate(there, start=1))
    _require_one_skin(names)
    labels = np.zeros(grid.shape, dtype=np.int32)
    each = abs(float(np.linalg.det(grid.affine[:3, :3])))
    shared = []
    for name, mask in zip(names, there, strict=True):
        part = labels[mask.place]
        taken = np.bincount(part[mask.inside], minlength=len(names) + 1)
        part[mask.inside] = name.value
        shared += [
            SharedVoxels(name.name, names[loser - 1].name, int(taken[loser]), int(taken[loser]) * each)
            for loser in np.flatnonzero(taken[1:]) + 1
            if names[loser - 1].kind is not TissueKind.SKIN
        ]
    shared.sort(key=lambda pair: -pair.voxels)
    if shared:
        most = shared[0]
        message = (
            f"{source.name}: {len(shared)} pairs of masks share voxels, most {most.kept_by} and {most.lost_by} "
            f"({most.voxels} voxels, {most.volume_mm3:.4g} mm³): {RULE}"
        )
        found.append(Finding(source.name, "shared-voxels", message))
    left = np.bincount(labels.ravel(), minlength=len(names) + 1)
    swallowed = [name.name for name in names if not left[name.value] and name.kind is not TissueKind.SKIN]
    if swallowed:
        said = (
            f"{source.name}: {len(swallowed)} masks lie wholly within others that keep the voxels: {some_of(swallowed)}"
        )
        found.append(Finding(source.name, "swallowed", said))
    kept = tuple(name for name in names if name.name not in swallowed)
    return Segmentation(labels, grid, kept, form, tuple(shared), tuple(found), hashes)


def _own_names(rows: Sequence[NamedValue], found: list[Finding]) -> list[NamedValue]:
    """Rows whose names differ: the value is added to a name that several have."""
    often = Counter(row.name for row in rows)
    doubled = sorted(name for name, count in often.items() if count > 1)
    if doubled:
        said = f"{len(doubled)} names stand for several labels, to which their value is added: {some_of(doubled)}"
        found.append(Finding(doubled[0], "repeated-names", said))
    return [NamedValue(r.value, f"{r.name}_{r.value}" if often[r.name] > 1 else r.name, r.kind) for r in rows]


def _kinds_of(
    stated: Mapping[str, TissueKind | None], kinds: KindPatterns
) -> tuple[dict[str, TissueKind], list[Finding]]:
    for pattern, kind in kinds:
        if not any(fnmatchcase(name, pattern) for name in stated):
            raise InputError(
                f"kind {kind.value} is set for {pattern!r}, which no label is named; there are: {some_of(stated)}"
            )
    chosen: dict[str, TissueKind] = {}
    by_words: list[str] = []
    unknown: list[str] = []
    for name, own in stated.items():
        said = next((kind for pattern, kind in kinds if fnmatchcase(name, pattern)), own)
        if said is None:
            said = kind_by_name(name)
            (unknown if said is None else by_words).append(name)
        chosen[name] = said or TissueKind.OTHER
    told = []
    if by_words:
        parts = [
            f"{kind.value}: {some_of(n for n in by_words if chosen[n] is kind)}"
            for kind in TissueKind
            if any(chosen[n] is kind for n in by_words)
        ]
        told.append(Finding("kinds", "kinds-by-name", f"kinds by their names: {'; '.join(parts)}"))
    if unknown:
        message = (
            f"{len(unknown)} labels whose names say no kind are other: {some_of(unknown)}; set it by --kind or a table"
        )
        told.append(Finding("kinds", "unknown-kind", message))
    return chosen, told


def _values(labels: NDArray[Any], source: Path) -> list[int]:
    """The values above 0, most of them if the image is none of labels, which is refused when surfaces are made."""
    values = np.unique(labels)
    low, high = (int(values[0]), int(values[-1])) if values.size else (0, 0)
    if low < 0 or len(values) > MOST_LABELS:
        raise InputError(
            f"{source}: holds {len(values)} different values from {low} to {high}; a segmentation holds 0 (background) "
            f"and at most {MOST_LABELS} labels above it: give the segmentation, not the image it was made of"
        )
    if high == 0:
        raise InputError(f"{source}: every voxel is 0, background; give a segmentation that holds labels")
    return [int(value) for value in values if value > 0]


def _require_mask(layer: NDArray[Any], what: str) -> None:
    values = np.unique(layer)
    values = values[values != 0]
    if len(values) > 1:
        raise InputError(
            f"{what} holds {len(values)} different labels ({some_of(str(v) for v in values)}); a mask holds one: give "
            "a label map as one image of three axes"
        )


def _other_grid(first: Path, expected: Grid, path: Path, found: Grid) -> str:
    """How the grid of a file differs from that of the first one, and what to do; empty where it does not."""
    if found.shape != expected.shape:
        return (
            f"{path}: has {' x '.join(map(str, found.shape))} voxels, {first.name} "
            f"{' x '.join(map(str, expected.shape))}; masks of one folder are of one image: resample them on one grid"
        )
    ends = np.array([[i, j, k] for i in (0, found.shape[0]) for j in (0, found.shape[1]) for k in (0, found.shape[2])])
    there, here = expected.positions(ends.astype(float)), found.positions(ends.astype(float))
    apart = float(np.linalg.norm(there - here, axis=1).max())
    if apart <= SAME_GRID_VOXELS * float(expected.spacing.min()):
        return ""
    turned = float(np.linalg.norm(there - here * [-1.0, -1.0, 1.0], axis=1).max())
    like = ", as if one were LPS and the other RAS" if turned < 0.1 * apart else ""
    return (
        f"{path}: its voxels are up to {apart:.4g} mm from those of {first.name}{like}; masks of one folder are of one "
        "image: export them together, or correct the header"
    )


def _require_one_skin(names: Sequence[LabelName]) -> None:
    skins = [name.name for name in names if name.kind is TissueKind.SKIN]
    if len(skins) > 1:
        raise InputError(
            f"{len(skins)} labels are skin ({some_of(skins)}); at most one may be: set the others' by --kind"
        )
