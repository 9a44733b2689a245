"""Segmentation files -> voxels, grid and what the file says of its segments; knows NIfTI and NRRD headers, not tissues.

NIfTI by nibabel and NRRD by pynrrd (extra ``volumes``). Grids are RAS+, as everywhere within musclefit.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float
from musclefit.geometry.images.grids import Grid
from musclefit.io.formats.nifti import MOST_SWOLLEN, UNITS_MM, HeaderForm, load_checked, stated_affine
from musclefit.io.formats.texts import LARGEST_MM, read_bytes

ENDINGS = (".nii", ".nii.gz", ".nrrd")

MOST_SHEAR_DEG = 0.5
"""Axes of voxels farther from a right angle are refused: many programs cannot say such grids, and misplace them."""

_SPACES: Mapping[str, tuple[float, float, float]] = {
    "right-anterior-superior": (1, 1, 1),
    "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "las": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "lps": (-1, -1, 1),
}

_UNITS = {"mm": 1.0, "millimeter": 1.0, "millimetre": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "": 1.0}

_SWOLLEN = {"raw": 1, "gzip": MOST_SWOLLEN, "gz": MOST_SWOLLEN, "ascii": 1, "text": 1, "txt": 1}
"""How many voxels a byte of an NRRD file may hold, by its encoding."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One segment that a file names: its layer (0 in most files), value there and name."""

    layer: int
    value: int
    name: str


@dataclass(frozen=True, eq=False, slots=True)
class LabelImage:
    """A segmentation file.

    Parameters
    ----------
    layers : (c, nx, ny, nz) array of whole numbers
        One layer, or several whose labels may share voxels.
    grid : Grid
    segments : tuple of Segment
        What the file itself names; empty where it names nothing.
    sha256 : str
    """

    layers: NDArray[Any]
    grid: Grid
    segments: tuple[Segment, ...]
    sha256: str


def is_label_image(path: Path) -> bool:
    """Whether a file's ending is one that is read."""
    return path.name.lower().endswith(ENDINGS)


def stem_of(path: Path) -> str:
    """A file's name without its ending, which may be .nii.gz or .seg.nrrd."""
    return re.sub(r"(\.seg)?(\.nii\.gz|\.nii|\.nrrd)$", "", path.name, flags=re.IGNORECASE)


def read_label_image(path: Path, *, form: HeaderForm = HeaderForm.AGREED) -> LabelImage:
    """Read a NIfTI (.nii, .nii.gz) or NRRD (.nrrd, .seg.nrrd) segmentation of three or four axes.

    Parameters
    ----------
    path : Path
    form : HeaderForm
        Where a NIfTI header's qform and sform disagree.

    Raises
    ------
    InputError
        No such file, damaged, fractions, no place in space, sheared, two places in space, or a library is missing.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; correct the path")
    if not is_label_image(path):
        raise InputError(f"{path}: segmentations are read from {', '.join(ENDINGS)} files; export it as one of them")
    if path.name.lower().endswith(".nrrd"):
        return _read_nrrd(path)
    return _read_nifti(path, form)


def _read_nifti(path: Path, form: HeaderForm) -> LabelImage:
    image, data, sha = load_checked(path, floats=np.float64)
    header = image.header
    unit = header.get_xyzt_units()[0]
    if unit not in UNITS_MM:
        raise InputError(f"{path}: its voxels are measured in {unit!r}; known are {', '.join(UNITS_MM)}")
    affine = stated_affine(path, header, data.shape[:3], form=form)
    scale = UNITS_MM[unit]
    contents = [extension.get_content() for extension in getattr(header, "extensions", ())]
    segments = tuple(Segment(0, value, name) for text in contents for value, name in _label_table(_text(text)).items())
    layers = _layers(path, np.moveaxis(_squeezed(path, data), -1, 0))
    with np.errstate(all="ignore"):  # the grid refuses what is not finite
        placed = np.diag([scale, scale, scale, 1.0]) @ affine
    return _image(path, layers, placed, segments, sha)


def _text(content: Any) -> str:
    return content.decode("utf-8", "replace") if isinstance(content, bytes) else str(content)


def _label_table(text: str) -> dict[int, str]:
    """Names by value of a Caret label table, which TotalSegmentator writes into the header's extension."""
    if "<Label" not in text or "<!ENTITY" in text or "<!DOCTYPE" in text:
        return {}
    try:
        labels = ElementTree.fromstring(text[text.index("<") : text.rindex(">") + 1]).iter("Label")
        named = [(int(label.attrib["Key"]), (label.text or "").strip()) for label in labels]
    except (ElementTree.ParseError, KeyError, ValueError):
        return {}
    return {value: name for value, name in named if value > 0 and name}


def _squeezed(path: Path, data: NDArray[Any]) -> NDArray[Any]:
    """(nx, ny, nz, c)."""
    if data.ndim == 5 and data.shape[3] == 1:
        data = data[:, :, :, 0]
    if data.ndim == 3:
        data = data[..., None]
    if data.ndim != 4:
        raise InputError(f"{path}: an image of shape {data.shape}; expected three axes, or four for a stack of masks")
    return data


def _read_nrrd(path: Path) -> LabelImage:
    try:
        import nrrd
    except ImportError:
        raise InputError("NRRD needs pynrrd, which is not installed; pip install 'musclefit[volumes]'") from None
    stored = read_bytes(path)
    try:
        with BytesIO(stored) as file:
            header = nrrd.read_header(file)
            _require_voxels(path, header, len(stored))
            data = np.asarray(nrrd.read_data(header, file, index_order="F"))
        directions = np.atleast_2d(np.asarray(header.get("space directions", []), dtype=np.float64))
        origin = np.asarray(header.get("space origin", []), dtype=np.float64)
    except (InputError, KeyboardInterrupt):
        raise
    except Exception as error:  # pynrrd raises its own, zlib's, numpy's and those of texts and dictionaries
        said = f"{type(error).__name__}: {error}"[:200]
        raise InputError(f"{path}: cannot be read as NRRD ({said}); export it again") from None
    space = str(header.get("space", "")).lower()
    if space not in _SPACES:
        raise InputError(
            f"{path}: its header says space {space or 'nothing'!r}, which is not a patient frame; save it from 3D "
            "Slicer, or write space: left-posterior-superior or right-anterior-superior"
        )
    spatial = np.isfinite(directions).all(axis=1) if directions.size else np.zeros(0, dtype=bool)
    if directions.shape != (data.ndim, 3) or spatial.sum() != 3 or origin.shape != (3,) or data.ndim > 4:
        raise InputError(
            f"{path}: an image of shape {data.shape} with {int(spatial.sum())} axes in space; expected three, and at "
            "most one of layers"
        )
    units = list(header.get("space units", ["mm"] * 3))
    scales = [_UNITS.get(str(unit).strip('"').lower()) for unit in units]
    if len(set(scales)) != 1 or scales[0] is None:
        raise InputError(f"{path}: its header's space units are {units}; write mm")
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = directions[spatial].T, origin
    signs = np.array([*_SPACES[space], 1.0])
    with np.errstate(all="ignore"):
        affine = np.diag([scales[0]] * 3 + [1.0]) @ (signs[:, None] * affine)
    layers = data[None] if data.ndim == 3 else np.moveaxis(data, int(np.flatnonzero(~spatial)[0]), 0)
    sha = sha256(stored).hexdigest()
    return _image(path, _layers(path, layers), affine, _segments(path, header), sha)


def _require_voxels(path: Path, header: Mapping[str, Any], n_bytes: int) -> None:
    """Raise InputError where a file is too short for the voxels that its header states, before any are read."""
    encoding = str(header.get("encoding", ""))
    if encoding not in _SWOLLEN:
        raise InputError(f"{path}: its voxels are encoded as {encoding!r}; save it as raw or gzip")
    if "data file" in header or "datafile" in header:
        raise InputError(f"{path}: its voxels are in another file; save it as one file (.nrrd)")
    sizes = [int(size) for size in header["sizes"]]
    if min(sizes, default=0) < 1 or math.prod(sizes) > n_bytes * _SWOLLEN[encoding]:
        raise InputError(
            f"{path}: its header states an image of shape {tuple(sizes)}, and the file holds {n_bytes} bytes: it is "
            "cut short, export it again"
        )


def _segments(path: Path, header: Mapping[str, Any]) -> tuple[Segment, ...]:
    """The segments that 3D Slicer's header fields name."""
    found = []
    for key in header:
        match = re.fullmatch(r"Segment(\d+)_(?:Name|ID)", key)
        if match is None or (key.endswith("ID") and f"Segment{match[1]}_Name" in header):
            continue
        start = f"Segment{match[1]}_"
        try:
            layer, value = int(header.get(f"{start}Layer", 0)), int(header[f"{start}LabelValue"])
        except (KeyError, ValueError):
            raise InputError(
                f"{path}: {key} has no whole {start}LabelValue or {start}Layer; save the segmentation from 3D Slicer"
            ) from None
        found.append(Segment(layer, value, str(header[key]).strip()))
    return tuple(found)


def _layers(path: Path, data: NDArray[Any]) -> NDArray[Any]:
    """Voxels as whole numbers, whatever type holds them."""
    if data.dtype.kind in "biu":
        return data.astype(np.uint8) if data.dtype.kind == "b" else data
    if data.dtype.kind != "f":
        raise InputError(f"{path}: holds {data.dtype} values; a segmentation holds whole numbers")
    wrong = ~np.isfinite(data) | (data != np.rint(data))
    if wrong.any():
        some = ", ".join(f"{value:g}" for value in data[wrong].ravel()[:3])
        raise InputError(
            f"{path}: {int(wrong.sum())} of {data.size} voxels are not whole numbers, such as {some}; labels are whole "
            "numbers: take each voxel's label (of probabilities, those above one half), or resample by nearest voxel"
        )
    if np.abs(data).max(initial=0) > 2**53:
        raise InputError(
            f"{path}: holds values up to {np.abs(data).max():g}, which floats do not hold as whole numbers"
        )
    return data.astype(np.int64)


def _image(
    path: Path,
    layers: NDArray[Any],
    affine: Float,
    segments: tuple[Segment, ...],
    sha: str,
) -> LabelImage:
    if not np.abs(affine).max() <= LARGEST_MM:
        raise InputError(f"{path}: its header puts voxels up to {np.abs(affine).max():g} mm away; correct it")
    try:
        shape = layers.shape[1:]
        grid = Grid((int(shape[0]), int(shape[1]), int(shape[2])), affine)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    cosines = np.abs((axes.T @ axes)[np.triu_indices(3, 1)])
    shear = float(np.degrees(np.arcsin(min(1.0, cosines.max()))))
    if shear > MOST_SHEAR_DEG:
        raise InputError(
            f"{path}: its voxels are sheared: two axes are {90.0 - shear:.1f} degrees apart; resample it on a grid of "
            "right angles (3D Slicer: Resample Scalar/Vector/DWI Volume, nearest voxel)"
        )
    return LabelImage(np.ascontiguousarray(layers), grid, segments, sha)
