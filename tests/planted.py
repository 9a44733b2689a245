"""Small shapes to plant faults in."""

from __future__ import annotations

import numpy as np
import trimesh

from musclefit.geometry.meshes import TriMesh


def ball(subdivisions=2, *, radius=10.0, at=(0.0, 0.0, 0.0)) -> TriMesh:
    """An icosphere."""
    shape = trimesh.creation.icosphere(subdivisions, radius=radius)
    return TriMesh(np.array(shape.vertices) + np.array(at), np.array(shape.faces, dtype=np.int64))


def box(size, *, at=(0.0, 0.0, 0.0)) -> TriMesh:
    """A box from ``at`` on."""
    shape = trimesh.creation.box(size)
    return TriMesh(np.array(shape.vertices) + np.array(size) / 2 + np.array(at), np.array(shape.faces, dtype=np.int64))


def joined(*meshes: TriMesh) -> TriMesh:
    """Several surfaces as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    return TriMesh(np.concatenate([m.vertices for m in meshes]), faces)


def moebius(n=12, *, radius=10.0, width=4.0) -> tuple[np.ndarray, np.ndarray]:
    """A Möbius band of 2 n triangles."""
    angle = 2.0 * np.pi * np.arange(n) / n
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    vertices = np.stack([middle - width * across, middle + width * across], axis=1).reshape(-1, 3)
    index = np.arange(2 * n).reshape(n, 2)
    after = np.vstack([index[1:], index[:1, ::-1]])
    first = np.stack([index[:, 0], index[:, 1], after[:, 0]], axis=1)
    second = np.stack([index[:, 1], after[:, 1], after[:, 0]], axis=1)
    return vertices, np.concatenate([first, second])


def voxels(cells) -> TriMesh:
    """The border of unit cubes, each given by its lowest corner; vertices at one place are one."""
    filled = {tuple(cell) for cell in cells}
    quads = []
    for cell in filled:
        for axis in range(3):
            for side in (0, 1):
                step = np.eye(3, dtype=int)[axis] * (1 if side else -1)
                if tuple(np.array(cell) + step) in filled:
                    continue
                u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
                start = np.array(cell) + side * np.eye(3, dtype=int)[axis]
                quad = [start, start + u, start + u + v, start + v]
                quads.append(quad if side else quad[::-1])
    corners, index = np.unique(np.array(quads).reshape(-1, 3), axis=0, return_inverse=True)
    q = index.reshape(-1, 4)
    return TriMesh(corners.astype(float), np.vstack([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]))
