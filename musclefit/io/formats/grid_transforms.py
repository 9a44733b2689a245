"""Displacements on a grid -> files that ITK, SimpleITK, ANTs and 3D Slicer open as a transform.

NRRD, MetaImage and HDF5 need SimpleITK, NIfTI nibabel (both in the extra ``volumes``). All hold LPS+ vectors in mm on a
grid in LPS+ (NIfTI keeps its RAS+ affine, as every NIfTI does): a *point* p goes to p + vector(p), linear between the
grid's points, and stays where it is outside the grid. An image is resampled through the transform that leads from the
result back to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid, in_frame
from musclefit.io.atomic import check_file_writable, partial_file
from musclefit.io.formats.nifti import require_nibabel, write_displacements

IMAGES, TRANSFORMS, NIFTI = (".nrrd", ".mha"), (".h5",), (".nii.gz", ".nii")
ENDINGS = (*IMAGES, *TRANSFORMS, *NIFTI)

ORTHOGONAL = 1e-6
"""Axes of a grid may be so far from orthogonal, as cosines: ITK's images have orthogonal axes."""


def check_grid_transforms_writable(paths: Sequence[Path]) -> None:
    """Raise InputError unless all can be written, so that long work is not lost.

    Raises
    ------
    InputError
        An ending that is none of ``ENDINGS``, a library that is not installed, one file named twice, or a folder that
        cannot be made or written to.
    """
    for k, path in enumerate(paths):
        ending = _ending(path)
        if ending in NIFTI:
            require_nibabel()
        else:
            _simpleitk(path)
        if path.resolve() in {other.resolve() for other in paths[:k]}:
            raise InputError(f"{path}: is named twice; give each transform a file of its own")
        check_file_writable(path)


def write_grid_transform(path: Path, vectors: NDArray[Any], grid: Grid, *, description: str) -> None:
    """Write displacements as a transform, whole or not at all.

    Parameters
    ----------
    path : Path
        .nrrd and .mha hold an image of float32 vectors, .h5 ITK's own ``DisplacementFieldTransform`` in double
        precision, .nii and .nii.gz an image of float32 vectors with NIfTI's vector intent.
    vectors : (nx, ny, nz, 3) array, mm
        RAS+.
    grid : Grid
    description : str
        Kept where the format has a place for it: NRRD, MetaImage, NIfTI.

    Raises
    ------
    InputError
        Another ending, a vector that is not finite, a grid whose axes are not orthogonal, or a missing library.
    """
    ending = _ending(path)
    if ending in NIFTI:
        write_displacements(path, vectors, grid, description=description)
        return
    sitk = _simpleitk(path)
    if not np.isfinite(vectors).all():
        raise InputError(
            f"{path}: displacements that are not finite make no transform; choose a grid closer to the body"
        )
    image = _image(sitk, path, vectors, grid, dtype=np.float64 if ending in TRANSFORMS else np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with partial_file(path, ending=ending) as unfinished:
            if ending in TRANSFORMS:
                sitk.WriteTransform(sitk.DisplacementFieldTransform(image), str(unfinished))
            else:
                image.SetMetaData("Comment", description.encode("ascii", "replace").decode("ascii"))
                sitk.WriteImage(image, str(unfinished), useCompression=True)
    except RuntimeError as error:
        raise InputError(f"{path}: cannot be written ({error}); check the free space") from None


def require_orthogonal(grid: Grid, *, source: Path) -> None:
    """Raise InputError where the axes of a grid are not orthogonal."""
    directions = grid.affine[:3, :3] / grid.spacing
    off = float(np.abs(directions.T @ directions - np.eye(3)).max())
    if off > ORTHOGONAL:
        raise InputError(
            f"{source}: its axes are not orthogonal (cosine {off:.3g}), which ITK's grids must be; give a spacing "
            "instead, or resample the image"
        )


def _image(sitk: Any, path: Path, vectors: NDArray[Any], grid: Grid, *, dtype: Any) -> Any:
    """An ITK image of LPS+ vectors; its grid is that of ``grid`` in LPS+."""
    require_orthogonal(grid, source=path)
    lps = in_frame(vectors.reshape(-1, 3), of=Frame.RAS, to=Frame.LPS).reshape(vectors.shape).astype(dtype)
    image = sitk.GetImageFromArray(np.ascontiguousarray(lps.swapaxes(0, 2)), isVector=True)
    affine = np.diag([-1.0, -1.0, 1.0]) @ grid.affine[:3]
    image.SetOrigin(affine[:, 3].tolist())
    image.SetSpacing(grid.spacing.tolist())
    image.SetDirection((affine[:, :3] / grid.spacing).ravel().tolist())
    return image


def _ending(path: Path) -> str:
    ending = next((e for e in ENDINGS if path.name.lower().endswith(e)), None)
    if ending is None:
        raise InputError(f"{path}: transforms are written as {', '.join(ENDINGS)} files; choose one of these endings")
    return ending


def _simpleitk(path: Path) -> Any:
    try:
        import SimpleITK
    except ImportError:
        raise InputError(
            f"{path}: needs SimpleITK, which is not installed; pip install 'musclefit[volumes]', or write .nii.gz"
        ) from None
    return SimpleITK
