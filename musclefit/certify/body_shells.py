"""Closed shells of squares around a body: what is carried through the steps in place of its skin.

A shell may stand off the skin: everything inside the skin is inside it, so what is proved inside the shell holds there.
It is coarser than the skin and further from sources inside the body, where a field is steep.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from musclefit.certify.cell_counts import counts_before, counts_between
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.meshes import TriMesh

UP = 1.0 + 1e-12
"""Rounds radii up, far more than their own rounding."""

FACE_CELLS = 12
"""Squares along the longest side of a box."""

STANDOFF = 0.25
"""Of a voxel's edge: at least so far a shell stands off the skin."""


GRID_ROUNDING = 1e-3
"""Of a voxel's edge: how far boxes must stay within voxels to count as inside a shell."""


@dataclass(frozen=True, eq=False, slots=True)
class Patches:
    """Pieces of a shell at rest: rectangles, in the plane segments.

    Parameters
    ----------
    centres : (P, n) float64, mm
    halves : (P, n) float64, mm
        Half widths along the axes, one of them 0.
    """

    centres: Points
    halves: Float

    def __len__(self) -> int:
        return len(self.centres)

    def radii(self) -> Float:
        """(P,) of balls around the centres that hold the pieces, mm."""
        size: Float = np.sqrt(np.einsum("pk,pk->p", self.halves, self.halves))
        radii: Float = size * UP + 1e-15 * np.einsum("pk->p", np.abs(self.centres))
        return radii

    def only(self, kept: Bool) -> Patches:
        """Some of them."""
        return Patches(self.centres[kept], self.halves[kept])

    def joined(self, other: Patches) -> Patches:
        """These and then the others."""
        return Patches(np.concatenate([self.centres, other.centres]), np.concatenate([self.halves, other.halves]))

    def split(self) -> tuple[Patches, Int]:
        """Each in four (in the plane in two), and (C,) the numbers of those that the children are of."""
        n = self.centres.shape[1]
        signs = np.array(list(np.ndindex(*(2,) * n)), dtype=np.float64) * 2.0 - 1.0
        children, parents = [], []
        half = 0.5 * self.halves
        for k in range(n):  # pieces normal to axis k: one child for each pair of signs along the others
            normal = np.flatnonzero(np.argmin(self.halves, axis=1) == k)
            flat, own = self.centres[normal], half[normal]
            children += [Patches(flat + sign * own, own) for sign in signs[signs[:, k] > 0.0]]
            parents += [normal] * int((signs[:, k] > 0.0).sum())
        whole = children[0]
        for more in children[1:]:
            whole = whole.joined(more)
        return whole, np.concatenate(parents)


def box_shell(points: Points) -> Patches:
    """The surface of the axis-aligned box around (N, n) points, a little enlarged."""
    n = points.shape[1]
    low, high = points.min(axis=0), points.max(axis=0)
    slack = 1e-9 * (1.0 + np.abs([low, high]).max())
    low, high = low - slack, high + slack
    pieces = np.maximum(np.ceil((high - low) / (high - low).max() * FACE_CELLS), 1).astype(int)
    half = 0.5 * (high - low) / pieces
    middles = [low[k] + half[k] * (2 * np.arange(pieces[k]) + 1) for k in range(n)]
    centres, halves = [], []
    for k in range(n):
        for end in (low[k], high[k]):
            axes = [*middles[:k], np.array([end]), *middles[k + 1 :]]
            centres.append(np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1))
            halves.append(np.tile(np.where(np.arange(n) == k, 0.0, half * (1.0 + 1e-9)), (len(centres[-1]), 1)))
    return Patches(np.concatenate(centres), np.concatenate(halves))


def point_patches(points: Points) -> Patches:
    """Single points, (N, n), as pieces without extent."""
    return Patches(points, np.zeros_like(points))


@dataclass(frozen=True, eq=False)
class Shell:
    """A shell of voxels' faces, and the voxels that are outside of it.

    Parameters
    ----------
    patches : Patches
        The faces.
    low : (3,) float64, mm
        Corner of the grid of voxels.
    edge : float, mm
    outside : (i, j, k) bool
        Voxels that are joined to infinity through voxels that hold no surface.
    """

    patches: Patches
    low: Float
    edge: float
    outside: Bool

    def holds(self, low: Points, high: Points) -> Bool:
        """(N,) which boxes, (N, 3) their corners, lie inside; a box that touches a voxel outside does not."""
        counts = np.array(self.outside.shape)
        first = np.floor((low - self.low) / self.edge - GRID_ROUNDING)
        last = np.floor((high - self.low) / self.edge + GRID_ROUNDING)
        within: Bool = np.asarray(np.concatenate([first >= 0, last < counts], axis=1).all(axis=1), dtype=bool)
        met = counts_between(self._outside_before, first[within].astype(int), last[within].astype(int))
        within[within] = met == 0
        return within

    @cached_property
    def _outside_before(self) -> Int:
        return counts_before(self.outside)


def skin_shell(skin: TriMesh, *, voxels: int) -> Shell:
    """The outer surface of all voxels that the skin comes near, ``voxels`` of them along its longest side.

    The skin lies in filled voxels. From inside the skin every path to infinity meets the skin, hence a filled voxel,
    and leaves the last one through a face to empty voxels that are joined to infinity: those faces are the shell.

    Raises
    ------
    MeshError
        An edge without its partner, so that the skin has no inside; or no triangles.
    """
    _require_closed(skin)
    corners = skin.corners()
    return voxel_shell(corners, edge=float(np.ptp(corners.reshape(-1, 3), axis=0).max()) / voxels)


def voxel_shell(corners: Float, *, edge: float) -> Shell:
    """The outer surface of all voxels with sides ``edge``, mm, that triangles, (T, 3, 3), come near."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    corners = _small_triangles(corners, 0.5 * edge)
    low = low - (1.5 + STANDOFF) * edge
    counts = np.ceil((high - low) / edge + 1.5 + STANDOFF).astype(int)
    lowest, highest = _boxes_around(corners)
    first = np.floor((lowest - low) / edge - STANDOFF).astype(int)
    last = np.floor((highest - low) / edge + STANDOFF).astype(int)
    filled = np.zeros(counts, dtype=bool)
    for offset in np.ndindex(*((last - first).max(axis=0) + 1)):
        cell = np.minimum(first + np.array(offset), last)
        filled[tuple(cell.T)] = True
    regions, _ = ndimage.label(~filled)
    outside: Bool = regions == regions[0, 0, 0]
    centres, halves = [], []
    for axis in range(3):
        ahead = np.diff(outside.astype(np.int8), axis=axis) != 0
        place = np.argwhere(ahead).astype(np.float64) + 0.5
        place[:, axis] += 0.5
        centres.append(low + edge * place)
        halves.append(np.tile(np.where(np.arange(3) == axis, 0.0, 0.5 * edge * (1.0 + 1e-9)), (len(place), 1)))
    return Shell(Patches(np.concatenate(centres), np.concatenate(halves)), low, edge, outside)


def _small_triangles(corners: Float, size: float) -> Float:
    """Cut triangles in four until their sides are at most ``size`` along every axis."""
    done = []
    while len(corners):
        lowest, highest = _boxes_around(corners)
        small = ((highest - lowest) <= size).all(axis=1)
        done.append(corners[small])
        c = corners[~small]
        a, b, d = 0.5 * (c[:, 0] + c[:, 1]), 0.5 * (c[:, 1] + c[:, 2]), 0.5 * (c[:, 2] + c[:, 0])
        parts = [(c[:, 0], a, d), (a, c[:, 1], b), (d, b, c[:, 2]), (a, b, d)]
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    return np.concatenate(done)


def _boxes_around(corners: Float) -> tuple[Points, Points]:
    """Lowest and highest corners, (T, 3), of boxes around triangles; faster than reductions along a short axis."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _require_closed(skin: TriMesh) -> None:
    if not len(skin.faces):
        raise MeshError("the skin has no triangles, so nothing is inside it; give a closed surface")
    edges = np.sort(skin.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    boundary = int(np.sum(counts % 2))
    if boundary:
        first = unique[counts % 2 == 1][0].tolist()
        raise MeshError(
            f"the skin has {boundary} boundary edges, the first between vertices {first[0]} and {first[1]}, so "
            "nothing is inside it; close it before the map is certified"
        )
