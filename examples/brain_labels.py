"""The MNI 152 brain as a segmentation in five forms: do they read as the same labels, and what surfaces do these make?

    python examples/brain_labels.py
    python examples/brain_labels.py --resolution-mm 1
    python examples/brain_labels.py --surfaces "whole floats" --tissues white_matter

Brain, grey and white matter are the masks that come with nilearn (extra `examples`; nothing is downloaded). As a label
map, grey and white matter are cut out of the brain; as masks they overlap, and the stated rule cuts them out. Reading
takes seconds; `--surfaces` makes surfaces of a form, as `musclefit from-labels` does.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import nibabel
import nrrd
import numpy as np

import musclefit as mf
from musclefit.io.segmentations import Segmentation, read_segmentation

NAMES = ("brain", "grey_matter", "white_matter")
Masks = Mapping[str, np.ndarray]


def masks(resolution_mm: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Brain, grey and white matter on one grid, and its affine."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nilearn import datasets
        from nilearn.image import resample_to_img

        brain = datasets.load_mni152_brain_mask(resolution=resolution_mm)
        found = [
            datasets.load_mni152_gm_mask(resolution=resolution_mm),
            datasets.load_mni152_wm_mask(resolution=resolution_mm),
        ]
        same = [
            resample_to_img(image, brain, interpolation="nearest", force_resample=True, copy_header=True)
            for image in found
        ]
    arrays = (np.asarray(image.dataobj) > 0 for image in (brain, *same))
    return dict(zip(NAMES, arrays, strict=True)), np.asarray(brain.affine)


def label_map(given: Masks) -> np.ndarray:
    """White matter before grey matter before the rest."""
    labels = np.zeros(next(iter(given.values())).shape, dtype=np.uint8)
    for value, mask in enumerate(given.values(), 1):
        labels[mask] = value
    return labels


def save(array: np.ndarray, affine: np.ndarray, path: Path) -> None:
    """A NIfTI file whose two frames agree."""
    image = nibabel.Nifti1Image(array, affine)
    image.set_qform(affine, code=1)
    image.set_sform(affine, code=1)
    nibabel.save(image, path)


def as_integers(given: Masks, affine: np.ndarray, folder: Path) -> Path:
    save(label_map(given), affine, folder / "labels.nii.gz")
    return folder / "labels.nii.gz"


def as_floats(given: Masks, affine: np.ndarray, folder: Path) -> Path:
    save(label_map(given).astype(np.float32), affine, folder / "floats.nii.gz")
    return folder / "floats.nii.gz"


def as_folder(given: Masks, affine: np.ndarray, folder: Path) -> Path:
    (folder / "masks").mkdir()
    for name, mask in given.items():
        save(mask.astype(np.uint8), affine, folder / "masks" / f"{name}.nii.gz")
    return folder / "masks"


def as_stack(given: Masks, affine: np.ndarray, folder: Path) -> Path:
    save(np.stack(list(given.values()), axis=-1).astype(np.uint8), affine, folder / "stack.nii.gz")
    return folder / "stack.nii.gz"


def as_slicer(given: Masks, affine: np.ndarray, folder: Path) -> Path:
    """3D Slicer's .seg.nrrd, one layer for each segment, in LPS."""
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    header: dict[str, Any] = {
        "type": "unsigned char",
        "encoding": "gzip",
        "space": "left-posterior-superior",
        "space directions": np.vstack([np.full(3, np.nan), lps[:3, :3].T]),
        "space origin": lps[:3, 3],
        "kinds": ["list", "domain", "domain", "domain"],
    }
    for k, name in enumerate(given):
        header |= {f"Segment{k}_ID": f"Segment_{k + 1}", f"Segment{k}_Name": name, f"Segment{k}_LabelValue": "1"}
        header |= {f"Segment{k}_Layer": str(k), f"Segment{k}_Color": "0.5 0.5 0.5"}
    stacked = np.stack(list(given.values())).astype(np.uint8)
    nrrd.write(str(folder / "brain.seg.nrrd"), stacked, header)
    return folder / "brain.seg.nrrd"


FORMS: dict[str, tuple[Callable[[Masks, np.ndarray, Path], Path], bool]] = {
    "integers": (as_integers, True),
    "whole floats": (as_floats, True),
    "folder of masks": (as_folder, False),
    "stack of masks": (as_stack, True),
    ".seg.nrrd": (as_slicer, False),
}
"""How each form is written, and whether it needs a table of names."""


def main() -> None:
    """Write and read every form, compare what was read, and make surfaces of those that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--surfaces", nargs="+", choices=FORMS, default=[], metavar="FORM", help="of these forms")
    parser.add_argument("--tissues", nargs="+", choices=NAMES, default=list(NAMES), metavar="TISSUE")
    parser.add_argument("--resolution-mm", type=int, default=2)
    given = parser.parse_args()
    found, affine = masks(given.resolution_mm)
    found = {name: mask for name, mask in found.items() if name in given.tissues}
    shape = next(iter(found.values())).shape
    print(f"{' x '.join(map(str, shape))} voxels of {given.resolution_mm} mm")
    first: dict[str, np.ndarray] = {}
    middle = np.zeros(3)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        table = folder / "names.csv"
        table.write_text("value,name\n" + "".join(f"{k},{name}\n" for k, name in enumerate(found, 1)), encoding="utf-8")
        for form, (write, needs_names) in FORMS.items():
            source, names = write(found, affine, folder), table if needs_names else None
            began = time.process_time()
            read = read_segmentation(source, names=names)
            seconds = time.process_time() - began
            at = np.asarray(read.grid.affine)[:3] @ [*np.argwhere(read.labels).mean(axis=0), 1.0]
            labels = {one.name: in_ras(read, one.value) for one in read.names}
            first, middle = (first, middle) if first else (labels, at)
            off = sum(np.count_nonzero(labels[name] != mask) for name, mask in first.items())
            counts = ", ".join(f"{name} {np.count_nonzero(mask):,}" for name, mask in sorted(labels.items()))
            print(f"{form}: read as a {read.form} in {seconds:.2f} CPU s: {counts};")
            print(f"  {off} voxels, and {np.linalg.norm(at - middle):.1e} mm of their middle, off the first form")
            for finding in read.findings:
                print(f"  {finding.message}")
            if form in given.surfaces:
                surfaces(source, names)


def in_ras(read: Segmentation, value: int) -> np.ndarray:
    """The voxels of a label along x, y and z to the right, front and top, whichever way the file has them."""
    axes = np.asarray(read.grid.affine)[:3, :3]
    mask = np.asarray(read.labels) == value
    return np.flip(mask, axis=tuple(k for k in range(3) if axes[k, k] < 0.0))


def surfaces(source: Path, names: Path | None) -> None:
    """Make surfaces of a form; print how they follow the voxels, and what was told."""
    began = time.process_time()
    made = mf.from_labels(source, names=names, progress=None)
    print(f"  {made.said()}; {time.process_time() - began:.0f} CPU s")
    for fit in made.fits:
        print(f"  {fit.name}: volume {fit.volume_percent:+.2f} %, vertices within {fit.largest_voxels:.2f} voxels")
    for finding in made.findings:
        print(f"  {finding.message}")


if __name__ == "__main__":
    main()
