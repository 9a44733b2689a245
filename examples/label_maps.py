"""Known anatomies as label maps: do `from-labels`' surfaces come back to them?

    python examples/label_maps.py
    python examples/label_maps.py ../shared/data/arm/disjoint --voxel-mm 2

A voxel belongs to the tissue that its middle lies in. Without a folder the built-in limb is taken. Printed for all
tissues together: volumes against those of the voxels, vertices against the voxels' faces and the true surfaces, and
what was told.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from pathlib import Path

import nibabel
import numpy as np

import musclefit as mf
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers

MARGIN_VOXELS = 3


def label_map(anatomy: mf.Anatomy, voxel_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of tissues from 1 in their order on a grid around them, the skin under the others; and its affine."""
    low = anatomy.vertices().min(axis=0) - MARGIN_VOXELS * voxel_mm
    counts = np.ceil((anatomy.vertices().max(axis=0) - low) / voxel_mm).astype(int) + MARGIN_VOXELS
    labels = np.zeros(counts, dtype=np.int16)
    numbered = sorted(enumerate(anatomy, start=1), key=lambda one: one[1].kind is not mf.TissueKind.SKIN)
    for number, tissue in numbered:
        vertices = (tissue.surface.vertices - low) / voxel_mm
        start, stop = np.floor(vertices.min(axis=0)).astype(int), np.ceil(vertices.max(axis=0)).astype(int) + 1
        block = np.stack(np.meshgrid(*map(np.arange, start, stop), indexing="ij"), axis=-1)
        inside = winding_numbers(tissue.surface, block.reshape(-1, 3) * voxel_mm + low) > 0.5
        part = labels[tuple(map(slice, start, stop))]
        part[inside.reshape(part.shape)] = number
    affine = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
    affine[:3, 3] = low
    return labels, affine


def main() -> None:
    """Make the label map, give it to `musclefit.from_labels`, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("anatomy", nargs="?", type=Path, help="folder of surfaces, mm")
    parser.add_argument("--voxel-mm", type=float, default=2.0)
    given = parser.parse_args()
    anatomy = mf.upper_limb() if given.anatomy is None else mf.read_anatomy(given.anatomy).anatomy
    labels, affine = label_map(anatomy, given.voxel_mm)
    print(f"{len(anatomy)} tissues in {' x '.join(map(str, labels.shape))} voxels of {given.voxel_mm:g} mm")
    with tempfile.TemporaryDirectory() as made:
        image = nibabel.Nifti1Image(labels, affine)
        image.set_qform(affine, code=1)
        image.set_sform(affine, code=1)
        nibabel.save(image, Path(made) / "labels.nii.gz")
        table = Path(made) / "names.csv"
        with table.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["value", "name", "kind"])
            rows.writerows((number, tissue.name, tissue.kind.value) for number, tissue in enumerate(anatomy, start=1))
        began = time.process_time()
        found = mf.from_labels(Path(made) / "labels.nii.gz", names=table, frame="ras", progress=None)
    print(f"{found.said()}; {time.process_time() - began:.0f} CPU s")
    percent = np.abs([fit.volume_percent for fit in found.fits])
    voxels = max(fit.largest_voxels for fit in found.fits)
    print(f"volumes off the voxels' by {np.median(percent):.2f} % in the median, {percent.max():.2f} % at most")
    print(f"vertices within {voxels:.2f} voxels of the voxels' faces")
    off = np.concatenate(
        [nearest_places(tissue.surface.vertices, anatomy[tissue.name].surface).distances for tissue in found.anatomy]
    )
    off95, most = np.quantile(off, 0.95) / given.voxel_mm, off.max() / given.voxel_mm
    print(f"vertices off the true surfaces by {off95:.2f} voxels (95 %), {most:.2f} at most")
    for finding in found.findings:
        print(finding.message)


if __name__ == "__main__":
    main()
