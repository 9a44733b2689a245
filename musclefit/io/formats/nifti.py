"""NIfTI files <-> images with their grid; knows headers and intents, not anatomy. Needs nibabel (extra ``volumes``).

NIfTI affines and everything inside musclefit's grids are RAS+; ITK, SimpleITK and 3D Slicer's transforms are LPS+.
Displacement fields are written as those programs read them: five axes (x, y, z, 1, component), vector intent, and
**LPS+ components** in mm, which is also ANTs' convention; the grid keeps its RAS+ affine, as every NIfTI does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid, in_frame
from musclefit.io.atomic import check_file_writable
from musclefit.io.formats.texts import read_bytes

_ENDINGS = (".nii", ".nii.gz")
UNITS_MM = {"mm": 1.0, "unknown": 1.0, "meter": 1000.0, "micron": 0.001}
MOST_SWOLLEN = 1100
"""How many times larger than a compressed file its content may be; gzip reaches 1032."""


class HeaderForm(StrEnum):
    """Which of a NIfTI header's two transforms is meant where they disagree."""

    AGREED = "agreed"
    SFORM = "sform"
    QFORM = "qform"


MOST_DISAGREEMENT_VOXELS = 0.1
"""qform and sform that put a corner of the image farther apart are refused until one is chosen."""


@dataclass(frozen=True, eq=False, slots=True)
class Volume:
    """An image file: voxel values as stored (scaled to numbers where the header says so), grid, and SHA-256."""

    values: NDArray[Any]
    grid: Grid
    sha256: str

    @property
    def holds_labels(self) -> bool:
        """True where the values are whole numbers."""
        return np.issubdtype(self.values.dtype, np.integer)


def read_volume(path: Path) -> Volume:
    """Read a NIfTI image of three axes.

    Values stay whole numbers where they are stored so and unscaled; others become float32.

    Raises
    ------
    InputError
        No such file, no NIfTI, another number of axes, no orientation in its header or two, or nibabel is missing.
    """
    image, data, sha = load_checked(path, floats=np.float32)
    unit = image.header.get_xyzt_units()[0]
    if data.ndim > 3 and data.shape[3:] == (1,) * (data.ndim - 3):
        data = data.reshape(data.shape[:3])
    if data.ndim != 3:
        raise InputError(f"{path}: an image of shape {data.shape}; expected three axes, one value for each voxel")
    if unit not in UNITS_MM:
        raise InputError(f"{path}: its voxels are measured in {unit!r}; known are {', '.join(UNITS_MM)}")
    scale = UNITS_MM[unit]
    with np.errstate(all="ignore"):  # the grid refuses what is not finite
        affine = np.diag([scale, scale, scale, 1.0]) @ stated_affine(path, image.header, data.shape)
    shape = (int(data.shape[0]), int(data.shape[1]), int(data.shape[2]))
    return Volume(np.ascontiguousarray(data), Grid(shape, affine), sha)


def load_checked(path: Path, *, floats: type[np.floating[Any]]) -> tuple[Any, NDArray[Any], str]:
    """A nibabel image whose file holds all that its header states, its values and its SHA-256.

    Parameters
    ----------
    path : Path
    floats : type
        What values become that are not stored as unscaled whole numbers.

    Raises
    ------
    InputError
        No such file, no NIfTI, damaged or cut short, or nibabel is not installed.
    """
    nibabel = _nibabel()
    _require_ending(path)
    if not path.exists():
        raise InputError(f"{path}: no such image; correct the path")
    stored = read_bytes(path)
    try:
        image = nibabel.load(path)
        _require_data(image, len(stored), path)
        unscaled = (image.dataobj.slope, image.dataobj.inter) == (1.0, 0.0)
        whole = np.issubdtype(image.get_data_dtype(), np.integer) and unscaled
        data = np.asanyarray(image.dataobj) if whole else image.get_fdata(dtype=floats, caching="unchanged")
        image.header.get_xyzt_units()
    except (InputError, KeyboardInterrupt):
        raise
    except Exception as error:  # nibabel raises zlib's, mmap's, its own and those of dictionaries
        said = f"{type(error).__name__}: {error}"[:200]
        raise InputError(f"{path}: cannot be read as NIfTI ({said}); export it again") from None
    return image, data, sha256(stored).hexdigest()


def stated_affine(
    path: Path, header: Any, shape: tuple[int, ...], *, form: HeaderForm = HeaderForm.AGREED
) -> NDArray[np.float64]:
    """The (4, 4) transform that a NIfTI header states, in its own unit.

    Raises
    ------
    InputError
        It states none, or two that disagree and neither is chosen, or not the one that is chosen.
    """
    forms = {}
    try:
        if int(header["sform_code"]):
            forms[HeaderForm.SFORM] = np.array(header.get_sform(), dtype=np.float64)
        if int(header["qform_code"]):
            forms[HeaderForm.QFORM] = np.array(header.get_qform(), dtype=np.float64)
    except Exception as error:  # nibabel's own, of quaternions that are none
        raise InputError(f"{path}: its header's orientation cannot be read ({error}); export it again") from None
    if not forms:
        raise InputError(
            f"{path}: its header states no orientation (qform and sform codes are 0), so where its voxels are is "
            "unknown; set one with the program it comes from"
        )
    if form in forms:
        return forms[form]
    if form is not HeaderForm.AGREED:
        raise InputError(
            f"{path}: its header has no {form.value}; leave --header-form out, or give {next(iter(forms))}"
        )
    first = next(iter(forms.values()))
    if len(forms) == 2:
        ends = np.array([*product(*((0.0, float(n)) for n in shape))])
        with np.errstate(all="ignore"):
            turned, moved = (first - forms[HeaderForm.QFORM])[:3, :3], (first - forms[HeaderForm.QFORM])[:3, 3]
            apart = float(np.linalg.norm(ends @ turned.T + moved, axis=1).max())
            voxel = float(np.linalg.norm(first[:3, :3], axis=0).min())
        if not apart <= MOST_DISAGREEMENT_VOXELS * voxel:
            raise InputError(
                f"{path}: its header's sform and qform put the image up to {apart:.3g} mm apart, so programs differ in "
                "where it is; correct the header (or, with from-labels, say which is right by --header-form sform or "
                "qform)"
            )
    return first


def _require_data(image: Any, n_bytes: int, path: Path) -> None:
    """Raise InputError where a file is too short for the voxels that its header states, before any are asked for."""
    voxels = math.prod(int(n) for n in image.dataobj.shape)
    needed = voxels * image.get_data_dtype().itemsize
    most = n_bytes * (MOST_SWOLLEN if path.name.lower().endswith(".gz") else 1)
    if min(image.dataobj.shape, default=0) < 1 or needed > most:
        raise InputError(
            f"{path}: its header states an image of shape {tuple(image.dataobj.shape)}, which takes {needed} bytes; "
            f"the file holds at most {most}: it is cut short, export it again"
        )


def check_images_writable(paths: Sequence[Path], *, given: Sequence[Path]) -> None:
    """Raise InputError unless all images can be written, so that long work is not lost.

    Parameters
    ----------
    paths : sequence of Path
        To be written.
    given : sequence of Path
        Images that are read, which are not to be overwritten.

    Raises
    ------
    InputError
        nibabel is not installed; a name that does not end in .nii or .nii.gz; one file named twice, or that is read; a
        folder that cannot be made or written to.
    """
    _nibabel()
    taken = {path.resolve(): path for path in given}
    for path in paths:
        _require_ending(path)
        if path.resolve() in taken:
            raise InputError(
                f"{path}: is named twice, or is the image that is read; give each result a file of its own"
            )
        taken[path.resolve()] = path
        check_file_writable(path)


def write_volume(path: Path, values: NDArray[Any], grid: Grid, *, description: str) -> None:
    """Write one value for each voxel, with the grid's affine as qform and sform (scanner coordinates, mm).

    Raises
    ------
    InputError
        The file name does not end in .nii or .nii.gz, or nibabel is not installed.
    """
    _write(path, values, grid, description=description, intent="none")


def write_displacements(path: Path, vectors: NDArray[Any], grid: Grid, *, description: str) -> None:
    """Write a displacement field that SimpleITK, ITK, ANTs and 3D Slicer read as a transform.

    Parameters
    ----------
    vectors : (nx, ny, nz, 3) array, mm
        RAS+; written with LPS+ components. Those programs move a *point* p to p + vector(p), and fetch an image's voxel
        at p from there: an image is warped by the inverse displacements of `musclefit.pipeline.images`.

    Raises
    ------
    InputError
        As for `write_volume`; or a vector that is not finite.
    """
    flat = vectors.reshape(-1, 3)
    bad = int((~np.isfinite(flat)).any(axis=1).sum())
    if bad:
        raise InputError(
            f"{path}: {bad} of {len(flat)} displacements are not finite: the map is not one-to-one there; "
            "choose a grid closer to the body"
        )
    lps = in_frame(flat, of=Frame.RAS, to=Frame.LPS).reshape(*grid.shape, 1, 3).astype(np.float32)
    _write(path, lps, grid, description=description, intent="vector")


def _write(path: Path, values: NDArray[Any], grid: Grid, *, description: str, intent: str) -> None:
    nibabel = _nibabel()
    _require_ending(path)
    image = nibabel.Nifti1Image(values, grid.affine)
    image.set_qform(grid.affine, code=1)
    image.set_sform(grid.affine, code=1)
    image.header.set_xyzt_units("mm")
    image.header.set_intent(intent)
    image.header["descrip"] = description.encode("ascii", "replace")[:79]
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        nibabel.save(image, unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _require_ending(path: Path) -> None:
    if not path.name.lower().endswith(_ENDINGS):
        raise InputError(f"{path}: images are read and written as {' or '.join(_ENDINGS)} files")


def require_nibabel() -> None:
    """Raise InputError where nibabel is not installed."""
    _nibabel()


def _nibabel() -> Any:
    try:
        import nibabel
    except ImportError:
        raise InputError("images need nibabel, which is not installed; pip install 'musclefit[volumes]'") from None
    return nibabel
