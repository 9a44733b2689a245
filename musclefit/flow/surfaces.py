"""Surfaces as fine as a map needs: edges that the map bends are split, and every new vertex goes through the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Bool, Float, Gradients, Points
from musclefit.geometry.crossings import self_crossings
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.subdivision import FaceEdges, split_edges
from musclefit.progress import Progress, Silent

MAX_ROUNDS = 8
"""Each round halves edges: from 30 mm to a tenth of a millimetre."""

MAX_CROSSING_ROUNDS = 16
"""Rounds in which triangles that come to cross each other are halved."""

SHORTEST_MM = 1e-4
"""Edges shorter than this are not split for that."""


@dataclass(frozen=True, eq=False, slots=True)
class Carried:
    """An anatomy moved by a map.

    Parameters
    ----------
    rest, deformed : Anatomy
        The same triangles; the vertices that were given come first in each tissue, the middles of split edges after.
    determinants : (N,) float64
        Of the map's Jacobian, in the order of ``rest.vertices()``.
    splits : mapping of tissue to number of split edges
    undecided_edges : int
        Edges still bent beyond the tolerance when the rounds ran out.
    """

    rest: Anatomy
    deformed: Anatomy
    determinants: Float
    splits: dict[str, int]
    undecided_edges: int


@dataclass(slots=True)
class _Work:
    """One tissue on its way: its surface at rest, and position and Jacobian of each vertex."""

    name: str
    surface: TriMesh
    moved: Points
    jacobians: Gradients


def carried(anatomy: Anatomy, deformation: Deformation) -> Carried:
    """Move the given vertices and no others."""
    moved, jacobians = deformation.with_jacobian(anatomy.vertices())
    return Carried(anatomy, anatomy.with_vertices(moved), np.linalg.det(jacobians), {}, 0)


def carried_finely(
    anatomy: Anatomy,
    deformation: Deformation,
    *,
    tolerance_mm: float,
    longest_mm: float,
    whole: frozenset[str],
    progress: Progress,
) -> Carried:
    r"""Move the tissues, splitting edges whose middle would be off the map by more than the tolerance.

    The middle of an edge e is off by about :math:`|(J_1 - J_0)\, e| / 8`, J the Jacobians at its ends; edges longer
    than ``longest_mm`` are split without asking, since a bend may hide between their ends. The map is one-to-one, so
    that fine enough surfaces of disjoint tissues stay disjoint, and those that do not cross themselves come to none:
    where triangles still do, they are cut finer.

    Parameters
    ----------
    anatomy : Anatomy
    deformation : Deformation
    tolerance_mm, longest_mm : float
    whole : frozenset of str
        Tissues that are not split: bones that move rigidly.
    """
    moved, jacobians = deformation.with_jacobian(anatomy.vertices())
    where = anatomy.slices()
    works = [_Work(t.name, t.surface, moved[where[t.name]], jacobians[where[t.name]]) for t in anatomy]
    splits = dict.fromkeys((t.name for t in anatomy), 0)
    bent_left, open_ = 0, [w for w in works if w.name not in whole]
    with (progress or Silent()).stage("refine surfaces") as tick:
        for done in range(MAX_ROUNDS + 1):
            marked = [(w, e, b) for w in open_ for e, b in [_bent(w, tolerance_mm, longest_mm)] if b.any()]
            bent_left = sum(int(bent.sum()) for _, _, bent in marked)
            if not marked or done == MAX_ROUNDS:
                break
            for work, edges, bent in marked:
                work.surface = split_edges(work.surface, edges, bent)
                splits[work.name] += int(bent.sum())
            _move_new(marked, deformation)
            open_ = [work for work, _, _ in marked]
            tick((done + 1) / (MAX_ROUNDS + MAX_CROSSING_ROUNDS))
        open_ = [w for w in works if w.name not in whole]
        for done in range(MAX_CROSSING_ROUNDS):
            marked = [(w, e, b) for w in open_ for e, b in [_crossing(w)] if b.any()]
            if done == 0:  # what crosses itself as given stays
                marked = [m for m in marked if not len(self_crossings(anatomy[m[0].name].surface).pairs)]
            if not marked:
                break
            for work, edges, crossing in marked:
                work.surface = split_edges(work.surface, edges, crossing)
                splits[work.name] += int(crossing.sum())
            _move_new(marked, deformation)
            open_ = [work for work, _, _ in marked]
            tick((MAX_ROUNDS + done + 1) / (MAX_ROUNDS + MAX_CROSSING_ROUNDS))
    tissues = [(anatomy[w.name], w) for w in works]
    rest = Anatomy(tuple(type(t)(t.name, t.kind, w.surface) for t, w in tissues), anatomy.frame)
    deformed = Anatomy(
        tuple(type(t)(t.name, t.kind, w.surface.with_vertices(w.moved)) for t, w in tissues), anatomy.frame
    )
    determinants = np.linalg.det(np.concatenate([w.jacobians for w in works]))
    return Carried(rest, deformed, determinants, {k: n for k, n in splits.items() if n}, bent_left)


def _move_new(marked: list[tuple[_Work, FaceEdges, Bool]], deformation: Deformation) -> None:
    """Move the vertices that the last splits added, of all tissues in one call."""
    fresh = [work.surface.vertices[len(work.moved) :] for work, _, _ in marked]
    moved, jacobians = deformation.with_jacobian(np.concatenate(fresh))
    ends = np.cumsum([len(part) for part in fresh])[:-1]
    for (work, _, _), more, slopes in zip(marked, np.split(moved, ends), np.split(jacobians, ends), strict=True):
        work.moved = np.vstack([work.moved, more])
        work.jacobians = np.concatenate([work.jacobians, slopes])


def _crossing(work: _Work) -> tuple[FaceEdges, Bool]:
    """The edges of a tissue (none where it does not cross itself after the map), and the longest of crossing triangles.

    What crosses are mostly caps, triangles whose apex almost lies on their longest edge: that edge alone is in the way.
    """
    crossing = np.unique(self_crossings(work.surface.with_vertices(work.moved)).pairs)
    if not len(crossing):
        return FaceEdges.of(work.surface.faces[:0]), np.zeros(0, dtype=bool)
    edges = FaceEdges.of(work.surface.faces)
    a, b = edges.ends.T
    lengths = np.linalg.norm(work.surface.vertices[b] - work.surface.vertices[a], axis=1)
    faces = edges.of_face[crossing]
    marked: Bool = np.zeros(len(edges.ends), dtype=bool)
    marked[np.take_along_axis(faces, lengths[faces].argmax(axis=1)[:, None], axis=1)] = True
    marked &= lengths > SHORTEST_MM
    return edges, marked


def _bent(work: _Work, tolerance_mm: float, longest_mm: float) -> tuple[FaceEdges, Bool]:
    """The edges of a tissue, and which of them the map bends beyond the tolerance."""
    edges = FaceEdges.of(work.surface.faces)
    a, b = edges.ends.T
    along = work.surface.vertices[b] - work.surface.vertices[a]
    turned = np.einsum("eij,ej->ei", work.jacobians[b] - work.jacobians[a], along)
    off = np.linalg.norm(turned, axis=1) / 8.0
    return edges, (off > tolerance_mm) | (np.linalg.norm(along, axis=1) > longest_mm)
