"""Halves what two surfaces share where they are equally deep; takes surfaces, gives a tool to cut each with."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt
from skimage.measure import marching_cubes

from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.booleans import as_manifold, as_mesh, grown_by
from musclefit.geometry.surfaces.uncrossing import compacted

FINEST_MM = 0.5
"""Spacing of the lattice that the depths are compared on, unless the overlap is too large for it, mm."""
SAME_MM = 1e-6
"""Places of an overlap's surface whose distances from both surfaces differ by less are of both, mm."""
MOST_NODES = 2_000_000
"""Nodes of the lattice at most; a larger overlap gets a wider spacing."""


def own_sides(a: TriMesh, b: TriMesh, common: TriMesh) -> tuple[TriMesh, TriMesh]:
    """The parts of an overlap's surface that are of ``a`` or ``b`` alone; one is empty where one lies in the other."""
    middles = common.corners().mean(axis=1)
    to_a, to_b = nearest_places(middles, a).distances, nearest_places(middles, b).distances
    apart = np.abs(to_a - to_b) > SAME_MM
    return tuple(  # type: ignore[return-value]
        compacted(TriMesh(common.vertices, common.faces[apart & nearer])) for nearer in (to_a < to_b, to_b < to_a)
    )


def halves(sides: tuple[TriMesh, TriMesh], common: TriMesh, *, clearance_mm: float) -> tuple[TriMesh, TriMesh]:
    r"""What to take from ``a`` and what from ``b``, so that they part their overlap where they are equally deep.

    With the distances :math:`u_a, u_b` from the own sides of the overlap, ``a`` loses where
    :math:`u_b - u_a \ge -c` and ``b`` where :math:`u_b - u_a \le c`, both within the overlap grown by c. The two tools
    cover the overlap whatever the lattice.

    Parameters
    ----------
    sides : tuple of TriMesh
        As `own_sides` gives them, neither empty.
    common : TriMesh
        The surface of what the two share.
    clearance_mm : float
        c: where one distance grows as the other falls, a gap of this width.

    Returns
    -------
    tuple of TriMesh
        One tool for each; without triangles where it takes nothing.
    """
    region = as_manifold(grown_by(common, distance_mm=clearance_mm))
    low, spacing, shape = _lattice(common, clearance_mm)
    near = _near_nodes(common, low, spacing, shape)
    points = low + spacing * np.argwhere(near)
    depths = np.zeros(shape)
    depths[near] = nearest_places(points, sides[1]).distances - nearest_places(points, sides[0]).distances
    depths = depths[tuple(distance_transform_edt(~near, return_distances=False, return_indices=True))]
    tools = []
    for values in (depths, -depths):
        half = _above(values, -clearance_mm, low=low, spacing=spacing)
        tools.append(as_mesh(region ^ as_manifold(half)) if len(half.faces) else half)
    return tools[0], tools[1]


def _lattice(common: TriMesh, clearance_mm: float) -> tuple[Points, float, tuple[int, ...]]:
    low, high = common.vertices.min(axis=0), common.vertices.max(axis=0)
    spacing = max(FINEST_MM, float(np.prod(high - low + 4.0 * FINEST_MM) / MOST_NODES) ** (1.0 / 3.0))
    margin = 2.0 * spacing + clearance_mm
    count = np.ceil((high - low + 2.0 * margin) / spacing).astype(int) + 1
    return low - margin, spacing, tuple(int(n) for n in count)


def _near_nodes(common: TriMesh, low: Points, spacing: float, shape: tuple[int, ...]) -> Bool:
    """(nx, ny, nz) nodes within two cells of the overlap's surface or inside it, where the depths are needed."""
    marked = np.zeros(shape, dtype=bool)
    corners = common.corners()
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    steps = max(int(np.ceil(longest / spacing)), 1)
    weights = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    for part in np.array_split(corners, max(len(corners) * len(weights) // 2_000_000, 1)):
        at: Int = np.rint((np.einsum("wk,fki->fwi", weights, part).reshape(-1, 3) - low) / spacing).astype(np.int64)
        marked[tuple(at.T)] = True
    return np.asarray(binary_fill_holes(binary_dilation(marked, iterations=2)), dtype=bool)


def _above(values: Float, level: float, *, low: Points, spacing: float) -> TriMesh:
    """The closed surface around where the values are above a level; closed along the lattice's border."""
    padded = np.pad(values, 1, constant_values=level - 10.0 * spacing)
    if not (padded > level).any():
        return TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    vertices, faces, _, _ = marching_cubes(padded, level)
    around = TriMesh(low + spacing * (vertices.astype(np.float64) - 1.0), faces.astype(np.int64))
    return around if enclosed_volume(around) > 0.0 else TriMesh(around.vertices, around.faces[:, ::-1])
