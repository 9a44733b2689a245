"""Moves parts of a closed surface apart that all but touch each other; knows no tissue.

Where two sheets of a surface, a vertex and a triangle, or two edges are closer than a width, the surface grown or
shrunk by half of it crosses itself. So these places are found by exact predicates, whatever the angle at which the
parts meet; at sharp corners only what is closer still, for growth goes along the normals of vertices. They are moved
against the growth; what has no width even then, as fins and folds have, is taken out and closed anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.booleans import vertex_normals
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.patches import cut_at_non_manifold_vertices
from musclefit.geometry.surfaces.uncrossing import (
    compacted,
    grown,
    parted,
    uncrossed,
    with_holes_filled,
    without_flat_faces,
)

ROUNDS = 12
"""How often places are moved, by a quarter of the width each time."""

NO_WIDTH = 0.1
"""Of the width: places that are closer after they were moved are taken out."""

ATTEMPTS = 6
"""How often such places are taken out; the surroundings that go with them grow."""

MOST_PERCENT = 0.1
"""Of the volume that what is taken out may change."""


@dataclass(frozen=True, eq=False, slots=True)
class Cleared:
    """A surface whose parts keep apart, as far as that went.

    Parameters
    ----------
    mesh : TriMesh
    moved, removed, filled : int
        Vertices that were moved, triangles taken out and put in.
    moved_mm : float
        How far a vertex was moved, at most.
    """

    mesh: TriMesh
    moved: int = 0
    moved_mm: float = 0.0
    removed: int = 0
    filled: int = 0


def with_self_clearance(mesh: TriMesh, *, width_mm: float, most_mm: float) -> Cleared:
    """Move vertices along their normals until the surface grown, or shrunk, by half a width does not cross itself.

    At edges as sharp as a knife that takes no end; there it stops at what a vertex may be moved.

    Parameters
    ----------
    mesh : TriMesh
        Closed, outward oriented, without crossings.
    width_mm : float
    most_mm : float
        How far a vertex may be moved.

    Returns
    -------
    Cleared
        Without faults where there were none; the very same mesh where nothing is too close or nothing helps.
    """
    done = _moved_apart(mesh, width_mm=width_mm, most_mm=most_mm)
    least, before = NO_WIDTH * width_mm, enclosed_volume(mesh)
    for attempt in range(ATTEMPTS):
        close = too_close(done.mesh, width_mm=least)
        if not close.any():
            break
        gone = grown(done.mesh.faces, close, rings=attempt // 2)
        left = cut_at_non_manifold_vertices(compacted(TriMesh(done.mesh.vertices, done.mesh.faces[~gone]))).mesh
        closed = uncrossed(parted(without_flat_faces(with_holes_filled(left))))
        if closed.left or not len(closed.mesh.faces):
            continue
        trial = _moved_apart(closed.mesh, width_mm=width_mm, most_mm=most_mm)
        changed = abs(enclosed_volume(trial.mesh) - before) > 0.01 * MOST_PERCENT * abs(before)
        fewer = too_close(trial.mesh, width_mm=least).sum() < close.sum()
        if fewer and not changed and faults_of(trial.mesh).none:
            done = Cleared(
                trial.mesh,
                done.moved + trial.moved,
                max(done.moved_mm, trial.moved_mm),
                done.removed + int(gone.sum()) + closed.removed,
                done.filled + len(closed.mesh.faces) - len(left.faces) + closed.removed,
            )
    return done


def too_close(mesh: TriMesh, *, width_mm: float) -> Bool:
    """(f,) triangles that cross others when the surface is grown, or shrunk, by half a width."""
    close = np.zeros(len(mesh.faces), dtype=bool)
    normals = vertex_normals(mesh)
    for side in (1.0, -1.0):
        close[_crossing(mesh, normals, grown_mm=side * 0.5 * width_mm)] = True
    return close


def _crossing(mesh: TriMesh, normals: Points, *, grown_mm: float) -> Int:
    """Numbers of the triangles that cross others when the surface is grown."""
    return np.unique(self_crossings(mesh.with_vertices(mesh.vertices + grown_mm * normals)).pairs)


def _moved_apart(mesh: TriMesh, *, width_mm: float, most_mm: float) -> Cleared:
    """Vertices only; triangles that come to cross are left where they last did not."""
    normals = vertex_normals(mesh)
    shift = np.zeros(len(mesh.vertices))
    best, held = mesh, np.zeros(len(mesh.vertices), dtype=bool)
    for _ in range(ROUNDS):
        push = np.zeros(len(shift))
        for side in (1.0, -1.0):
            push[np.unique(mesh.faces[_crossing(best, normals, grown_mm=side * 0.5 * width_mm)])] -= side
        to = np.where(held, shift, np.clip(shift + 0.25 * width_mm * push, -most_mm, most_mm))
        if (to == shift).all():
            break
        trial = mesh.with_vertices(mesh.vertices + to[:, None] * normals)
        crossing = self_crossings(trial).pairs
        if len(crossing):
            held[np.unique(mesh.faces[crossing])] = True
            continue
        best, shift = trial, to
    return Cleared(best, int((shift != 0.0).sum()), float(np.abs(shift).max(initial=0.0)))
