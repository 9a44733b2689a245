"""Bone landmarks where no file gives any: takes surfaces, gives points spread evenly over them; knows no joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Bool, Int, Points, frozen
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.handles import BoneMotions, Handles

APART_SHARE = 0.02
"""Of a bone's size: closer to another bone no landmark is put. Where bones meet they share room in a pose, and no map
brings both to their places."""


def spread_over(vertices: Points, count: int) -> Int:
    """Choose ``count`` vertices far from each other: farthest-point sampling, the same every time.

    The first is the vertex farthest from the centroid of the vertices, each next one the vertex farthest from those
    chosen so far; of equals, the one with the lowest number.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    count : int
        At least 1.

    Returns
    -------
    (count,) int64
        Vertex numbers in the order chosen; the first k are what ``count = k`` gives.

    Raises
    ------
    LandmarkError
        Fewer than ``count`` distinct positions, or ``count`` below 1.

    References
    ----------
    T. F. Gonzalez, Theor. Comput. Sci. 38 (1985) 293: within a factor of two of the best possible spread.
    """
    if count < 1:
        raise LandmarkError(f"found a count of {count} landmarks to spread; expected at least 1")
    if not len(vertices):
        raise LandmarkError(f"no vertices to spread {count} landmarks over; give a surface that is not empty")
    if count > len(vertices):
        raise LandmarkError(
            f"{count} landmarks do not fit on a surface with {len(vertices)} vertices; ask for at most that many"
        )
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = np.argmax(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1))
    nearest = np.linalg.norm(vertices - vertices[chosen[0]], axis=1)
    for k in range(1, count):
        chosen[k] = np.argmax(nearest)
        if nearest[chosen[k]] == 0.0:
            raise LandmarkError(
                f"{count} landmarks do not fit on a surface with {k} distinct vertices; ask for at most {k}"
            )
        nearest = np.minimum(nearest, np.linalg.norm(vertices - vertices[chosen[k]], axis=1))
    numbers: Int = frozen(chosen, np.int64)
    return numbers


def bone_landmarks(
    anatomy: Anatomy, bones: Sequence[str], *, per_bone: int, motions: BoneMotions | None = None
) -> Handles:
    """Handles spread over bones: ``bone_humerus_1``, ``bone_humerus_2``, ... owned by ``bone_humerus``.

    None is where a bone all but meets another one, at rest or where motions put them, unless the bone has too few
    other vertices.

    Parameters
    ----------
    anatomy : Anatomy
    bones : sequence of str
    per_bone : int
    motions : BoneMotions or None
        From rest to the pose; bones that they do not name stay.

    Raises
    ------
    LandmarkError
        A bone with fewer distinct vertices than landmarks asked for.
    InputError
        A bone that the anatomy does not have.
    """
    names: list[str] = []
    owners: list[str] = []
    places: list[Points] = []
    posed = {} if motions is None else motions.at(1.0)
    for bone in bones:
        vertices = _away_from_others(anatomy, bone, at_least=per_bone, posed=posed)
        try:
            places.append(vertices[spread_over(vertices, per_bone)])
        except LandmarkError as error:
            raise LandmarkError(f"bone {bone!r}: {error}") from None
        names += [f"{bone}_{k}" for k in range(1, per_bone + 1)]
        owners += [bone] * per_bone
    return Handles(tuple(names), np.concatenate(places), tuple(owners))


def _away_from_others(anatomy: Anatomy, bone: str, *, at_least: int, posed: Mapping[str, RigidMotion]) -> Points:
    """The vertices of a bone that keep a distance from all other bones; all of them where too few do."""
    vertices = anatomy[bone].surface.vertices
    if not len(vertices):
        return vertices
    apart = APART_SHARE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    far = np.ones(len(vertices), dtype=bool)
    still = RigidMotion.identity()
    back = posed.get(bone, still).inverse()
    for other in anatomy.of_kind(TissueKind.BONE):
        if other.name == bone:
            continue
        stands = [other.surface]
        if posed:
            motion = back @ posed.get(other.name, still)
            stands.append(other.surface.with_vertices(motion(other.surface.vertices)))
        for surface in stands:
            far[far] = _is_apart(vertices[far], surface, apart)
    kept = vertices[far]
    return kept if len(np.unique(kept, axis=0)) >= at_least else vertices


def _is_apart(points: Points, surface: TriMesh, apart: float) -> Bool:
    """(N,) points outside a surface that are farther from it than so much."""
    low, high = surface.vertices.min(axis=0) - apart, surface.vertices.max(axis=0) + apart
    near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    found: Bool = np.ones(len(points), dtype=bool)
    if near.size:
        within = winding_numbers(surface, points[near]) > 0.5
        found[near] = ~within & (nearest_places(points[near], surface).distances > apart)
    return found
