"""A mannequin and scans of a fatter one in another pose: other triangles, noise, holes, another place, a floor."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from musclefit.geometry.meshes import TriMesh

PLACE = Rotation.from_euler("zyx", [150, 20, -10], degrees=True).as_matrix()
SHIFT = np.array([300.0, -900.0, 80.0])

LIMBS = {
    "trunk": ((0, 0, -90), (0, 0, 90), 70.0),
    "head": ((0, 0, 190), (0, 8, 215), 42.0),
    "nose": ((0, 35, 195), (0, 62, 190), 12.0),
    "left arm": ((75, 0, 85), (150, 0, -90), 26.0),
    "right arm": ((-75, 0, 85), (-150, 0, -90), 26.0),
    "left leg": ((40, 0, -120), (60, 0, -380), 34.0),
    "right leg": ((-40, 0, -120), (-60, 0, -380), 34.0),
    "left foot": ((60, 0, -385), (60, 70, -395), 24.0),
    "right foot": ((-60, 0, -385), (-60, 70, -395), 24.0),
}
"""Ends and radius of each capsule, mm; x to the left, y to the front, z up."""


def mannequin(*, fatter: float = 1.0, arms_deg: float = 0.0, voxel_mm: float = 11.0) -> TriMesh:
    """A closed skin around the limbs; the arms are raised about the shoulders by so many degrees."""
    raised = {
        1.0: Rotation.from_euler("y", -arms_deg, degrees=True),
        -1.0: Rotation.from_euler("y", arms_deg, degrees=True),
    }
    low, high = np.array([-330.0, -140.0, -460.0]), np.array([330.0, 150.0, 300.0])
    counts = np.ceil((high - low) / voxel_mm).astype(int)
    places = np.stack(
        np.meshgrid(*(low[k] + voxel_mm * np.arange(counts[k]) for k in range(3)), indexing="ij"), axis=-1
    )
    near = np.zeros(places.shape[:3])
    for name, (start, end, radius) in LIMBS.items():
        a, b = np.array(start, dtype=float), np.array(end, dtype=float)
        if "arm" in name:
            b = a + raised[np.sign(a[0])].apply(b - a)
        along = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        wide = radius * (fatter if name == "trunk" else np.sqrt(fatter))
        near += np.exp(-(np.linalg.norm(places - a - along[..., None] * (b - a), axis=-1) - wide) / 6.0)
    vertices, faces, _, _ = marching_cubes(-6.0 * np.log(near + 1e-300), 0.0)
    return TriMesh(vertices * voxel_mm + low, faces.astype(np.int64))


def scan(
    *, voxel_mm: float = 9.0, noise_mm: float = 0.0, holes: int = 0, moved: bool = False, seed: int = 0
) -> TriMesh:
    """The other body with triangles of its own, as asked for."""
    rng = np.random.default_rng(seed)
    body = mannequin(fatter=1.2, arms_deg=14.0, voxel_mm=voxel_mm)
    vertices, faces = body.vertices, body.faces
    for centre in vertices[rng.choice(len(vertices), holes, replace=False)]:
        faces = faces[(np.linalg.norm(vertices[faces] - centre, axis=2) > 25.0).all(axis=1)]
    used, numbers = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used] + rng.normal(scale=noise_mm, size=(len(used), 3)), numbers.reshape(-1, 3)
    return TriMesh(vertices @ PLACE.T + SHIFT if moved else vertices, faces)


def with_floor(mesh: TriMesh) -> TriMesh:
    """The scan with a plate below its feet."""
    plate = trimesh.creation.box(extents=[260.0, 260.0, 4.0])
    corners = np.asarray(plate.vertices) + np.array([0.0, 0.0, mesh.vertices[:, 2].min() - 30.0])
    return TriMesh(
        np.vstack([mesh.vertices, corners]), np.vstack([mesh.faces, np.asarray(plate.faces) + len(mesh.vertices)])
    )
