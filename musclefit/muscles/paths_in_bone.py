"""How much of a muscle's path lies within bone: lines and surfaces in, lengths and depths out; knows no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.rigid import RigidMotion

SPACING_MM = 1.0
"""Lines are looked at in pieces no longer than this, each by its middle."""

_INSIDE = 0.5


@dataclass(frozen=True, slots=True)
class InBone:
    """What of a line lies within bone: its length, mm, how deep its deepest place lies, mm, and in which bone ("")."""

    length_mm: float
    depth_mm: float
    bone: str


class Bones:
    """Surfaces fixed to bodies; inside is where they wind around a place by more than a half, closed or not.

    Parameters
    ----------
    surfaces : sequence of (bone, body, surface)
        In the body's frame, mm.
    """

    def __init__(self, surfaces: Sequence[tuple[str, str, TriMesh]]) -> None:
        self._bones = [
            (name, body, surface, surface.vertices.min(axis=0), surface.vertices.max(axis=0))
            for name, body, surface in surfaces
        ]
        self._trees: dict[str, DistanceTree] = {}

    def along(self, lines: Sequence[Points], places: Mapping[str, RigidMotion]) -> list[InBone]:
        """What of each line, (n, 3) mm in the ground, lies within bone where bodies are at ``places``."""
        middles, weights, owners = _pieces(lines)
        inside = np.zeros(len(middles), dtype=bool)
        deepest = [InBone(0.0, 0.0, "") for _ in lines]
        for name, body, surface, low, high in self._bones:
            local = places[body].inverse()(middles)
            near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
            within = near[np.abs(winding_numbers(surface, local[near])) > _INSIDE]
            if not within.size:
                continue
            inside[within] = True
            tree = self._trees.setdefault(name, DistanceTree(surface))
            depths = tree(local[within])
            for line in np.unique(owners[within]).tolist():
                depth = float(depths[owners[within] == line].max())
                if depth > deepest[line].depth_mm:
                    deepest[line] = InBone(0.0, depth, name)
        lengths = np.bincount(owners[inside], weights=weights[inside], minlength=len(lines))
        return [InBone(float(w), d.depth_mm, d.bone) for w, d in zip(lengths, deepest, strict=True)]


def _pieces(lines: Sequence[Points]) -> tuple[Points, Float, Int]:
    """Middles of pieces of all lines, their lengths, and whose they are."""
    middles, weights, owners = [np.empty((0, 3))], [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for number, line in enumerate(lines):
        for start, end in pairwise(line):
            length = float(np.linalg.norm(end - start))
            count = max(int(np.ceil(length / SPACING_MM)), 1)
            at = (np.arange(count)[:, None] + 0.5) / count
            middles.append(start + at * (end - start))
            weights.append(np.full(count, length / count))
            owners.append(np.full(count, number, dtype=np.int64))
    return np.concatenate(middles), np.concatenate(weights), np.concatenate(owners)
