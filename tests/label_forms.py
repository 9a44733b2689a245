"""A small hip as a segmentation, in every form that is read: a ball in a cup, a muscle beside it, all in skin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SPACING_MM = 1.5
SHAPE = (40, 36, 44)
NAMES = {1: "skin", 2: "gluteus_maximus_left", 3: "hip_left", 4: "femur_left"}
CENTRE = np.array([30.0, 27.0, 36.0])
"""Of the ball and the cup, mm from the first voxel."""
AFFINE = np.array([[-1.5, 0, 0, 10.0], [0, 1.5, 0, -20.0], [0, 0, 1.5, 300.0], [0, 0, 0, 1.0]])
"""Voxels run to the left, as images of a lying patient often do."""


def hip_labels() -> np.ndarray:
    """(40, 36, 44) uint8: a ball of radius 12 mm on a shaft, in a cup with a gap of 2 mm, and a muscle."""
    at = SPACING_MM * np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1) - CENTRE
    far, (x, y, z) = np.linalg.norm(at, axis=-1), np.moveaxis(at, -1, 0)
    labels = np.zeros(SHAPE, dtype=np.uint8)
    labels[(np.hypot(x, y) < 24.0) & (np.abs(z) < 30.0)] = 1
    labels[(np.hypot(x - 17.0, y) < 5.0) & (np.abs(z) < 20.0)] = 2
    labels[(far > 14.0) & (far < 19.0) & (z > 2.0) & (x < 10.0)] = 3
    labels[(far < 12.0) | ((np.hypot(x, y) < 5.0) & (z < 0.0) & (z > -26.0))] = 4
    return labels


def elbow_labels(side: float) -> np.ndarray:
    """(28, 30, 60) uint8: humerus (1) and ulna (2), whose olecranon stops the turn to one side (1 or -1 along j)."""
    at = SPACING_MM * np.stack(np.meshgrid(*map(np.arange, (28, 30, 60)), indexing="ij"), axis=-1) - [20.0, 21.75, 46.0]
    x, y, z = np.moveaxis(at, -1, 0)
    away = np.hypot(y, z)
    labels = np.zeros(x.shape, dtype=np.uint8)
    labels[((away < 8) & (np.abs(x) < 14)) | ((np.abs(x) < 5) & (np.abs(y) < 4) & (z > 0) & (z < 38))] = 1
    labels[(away > 10) & (away < 15) & (z < 4) & (np.abs(x) < 12)] = 2
    labels[(np.abs(x) < 5) & (np.abs(y) < 4) & (z < -12) & (z > -42)] = 2
    labels[(np.abs(x) < 5) & (side * y > 10) & (side * y < 14) & (z > -4) & (z < 26)] = 2
    labels[(np.abs(x) < 5) & (side * y > 6.5) & (side * y < 14) & (z > 20) & (z < 26)] = 2
    return labels


def hip_masks() -> dict[str, np.ndarray]:
    """A mask for each tissue; the skin's holds all others, and the muscle's 24 voxels of the cup."""
    labels = hip_labels()
    masks = {name: labels == value for value, name in NAMES.items()}
    masks["skin"] = labels > 0
    cup = np.argwhere(labels == 3)[:24]
    masks["gluteus_maximus_left"][tuple(cup.T)] = True
    return masks


def write_nifti(path: Path, values: np.ndarray, *, affine: np.ndarray = AFFINE, names: dict[int, str] | None = None):
    """Write an image as most programs do, with the names in a Caret label table where they are given."""
    import nibabel

    image = nibabel.Nifti1Image(values, affine)
    image.set_qform(affine, code=1)
    image.set_sform(affine, code=1)
    image.header.set_xyzt_units("mm")
    if names:
        labels = "".join(f'<Label Key="{k}" Red="1" Green="0" Blue="0" Alpha="1">{n}</Label>' for k, n in names.items())
        text = f'<?xml version="1.0"?><CaretExtension><VolumeInformation><LabelTable>{labels}</LabelTable>'
        extension = nibabel.nifti1.Nifti1Extension(0, f"{text}</VolumeInformation></CaretExtension>".encode())
        image.header.extensions.append(extension)
    nibabel.save(image, path)
    return path


def write_table(path: Path) -> Path:
    path.write_text("value,name\n" + "".join(f"{value},{name}\n" for value, name in NAMES.items()))
    return path


def write_folder(folder: Path) -> Path:
    folder.mkdir()
    for name, mask in hip_masks().items():
        write_nifti(folder / f"{name}.nii.gz", mask.astype(np.uint8))
    return folder


def write_stack(path: Path) -> Path:
    return write_nifti(path, np.stack(list(hip_masks().values()), axis=-1).astype(np.uint8))


def write_seg_nrrd(path: Path) -> Path:
    """As 3D Slicer writes it, LPS: skin and cup in the first layer, what may overlap them in the second."""
    import nrrd

    masks = hip_masks()
    layers = np.zeros((2, *SHAPE), dtype=np.uint8)
    header = {}
    for number, (name, layer, value) in enumerate(
        (
            ("skin", 0, 1),
            ("hip_left", 1, 1),
            ("gluteus_maximus_left", 2, 1),
            ("femur_left", 1, 2),
        )
    ):
        if layer == len(layers):
            layers = np.concatenate([layers, np.zeros((1, *SHAPE), dtype=np.uint8)])
        layers[layer][masks[name]] = value
        said = {"ID": f"Segment_{number + 1}", "Name": name, "Layer": str(layer), "LabelValue": str(value)}
        header |= {f"Segment{number}_{key}": text for key, text in said.items()}
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ AFFINE
    header |= {
        "type": "unsigned char",
        "space": "left-posterior-superior",
        "kinds": ["list", "domain", "domain", "domain"],
        "space directions": np.vstack([[np.nan] * 3, lps[:3, :3].T]),
        "space origin": lps[:3, 3],
        "encoding": "gzip",
    }
    nrrd.write(str(path), layers, header)
    return path
