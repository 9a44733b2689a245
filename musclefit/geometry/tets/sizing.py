"""A field of edge lengths over a box, finest at given places and growing away from them; knows no tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Float, Points, Tets, frozen

MOST_NODES = 200_000
"""Nodes of the grid that carries the field; a larger box gets a coarser grid."""

CELLS_PER_LENGTH = 2.0
"""Grid cells that should fit into four of the shortest edges asked for: the grid need not be finer than the mesh."""

OCTAVE = 1.1
"""Places whose lengths differ by less than this factor are handled as if they all asked for the shortest."""

_CELL = np.array([[0, 3, 1, 7], [0, 2, 3, 7], [0, 6, 2, 7], [0, 4, 6, 7], [0, 5, 4, 7], [0, 1, 5, 7]])
"""Six tets of a cell, all round its diagonal from corner 0 to corner 7, so that neighbouring cells share faces."""


@dataclass(frozen=True, eq=False, slots=True)
class SizingField:
    """Edge lengths at the vertices of a background mesh, linear in between; outside of it nothing is asked for.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (m, 4) int64, right-handed
    lengths : (n,) float64, mm
    """

    vertices: Points
    tets: Tets
    lengths: Float


NO_SIZING = SizingField(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 4)), np.int64), frozen(np.zeros(0)))
"""One edge length everywhere."""


def sizing_field(places: Points, lengths: Float, *, coarsest_mm: float, growth: float) -> SizingField:
    r"""The field :math:`\min_i (l_i + g |x - p_i|)` where it is below the coarsest length, on a grid of tets.

    Each node takes the least value that occurs within a cell of it, so that the linear field between nodes asks for no
    longer edges than the formula.

    Parameters
    ----------
    places : (n, 3) float64, mm
    lengths : (n,) float64, mm
        Asked for at the places; those of the coarsest length or more count for nothing.
    coarsest_mm : float
    growth : float, > 0
        g: how much longer edges may be per mm away from a place.
    """
    asked = lengths < coarsest_mm
    places, lengths = places[asked], lengths[asked]
    if not len(places):
        return NO_SIZING
    reach = (coarsest_mm - float(lengths.min())) / growth
    low, high = places.min(axis=0) - reach, places.max(axis=0) + reach
    width = max(4.0 * float(lengths.min()) / CELLS_PER_LENGTH, float(np.cbrt(np.prod(high - low) / MOST_NODES)))
    counts = np.maximum(np.ceil((high - low) / width).astype(np.int64), 1)
    axes = [low[k] + width * np.arange(counts[k] + 1) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = _least(nodes, places, lengths, coarsest_mm=coarsest_mm, growth=growth, within=width * np.sqrt(3.0))
    cells = _corners(counts)
    used = (values[cells] < coarsest_mm).any(axis=1)
    tets = cells[used][:, _CELL].reshape(-1, 4)
    kept = np.unique(tets)
    return SizingField(frozen(nodes[kept]), frozen(np.searchsorted(kept, tets), np.int64), frozen(values[kept]))


def _least(nodes: Points, places: Points, lengths: Float, *, coarsest_mm: float, growth: float, within: float) -> Float:
    """The formula at the nodes, with distances shortened by ``within``."""
    values = np.full(len(nodes), coarsest_mm)
    octaves = np.floor(np.log(lengths / lengths.min()) / np.log(OCTAVE)).astype(np.int64)
    for octave in np.unique(octaves):
        chosen = octaves == octave
        length = float(lengths[chosen].min())
        farthest = (coarsest_mm - length) / growth + within
        distances = np.asarray(cKDTree(places[chosen]).query(nodes, distance_upper_bound=farthest)[0])
        near = np.isfinite(distances)
        asked = length + growth * np.maximum(distances[near] - within, 0.0)
        values[near] = np.minimum(values[near], asked)
    return values


def _corners(counts: np.ndarray) -> np.ndarray:
    """(cells, 8) nodes of each cell; corner number 4 x + 2 y + z."""
    strides = np.array([(counts[1] + 1) * (counts[2] + 1), counts[2] + 1, 1])
    starts = np.stack(np.meshgrid(*(np.arange(c) for c in counts), indexing="ij"), axis=-1).reshape(-1, 3) @ strides
    steps = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ strides
    corners: np.ndarray = starts[:, None] + steps
    return corners
