"""Bone landmarks where no file gives any: takes surfaces, gives points spread evenly over them; knows no joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Int, Points, frozen
from musclefit.rig.handles import Handles


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


def bone_landmarks(anatomy: Anatomy, bones: Sequence[str], *, per_bone: int) -> Handles:
    """Handles spread over bones: ``bone_humerus_1``, ``bone_humerus_2``, ... owned by ``bone_humerus``.

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
    for bone in bones:
        vertices = anatomy[bone].surface.vertices
        try:
            places.append(vertices[spread_over(vertices, per_bone)])
        except LandmarkError as error:
            raise LandmarkError(f"bone {bone!r}: {error}") from None
        names += [f"{bone}_{k}" for k in range(1, per_bone + 1)]
        owners += [bone] * per_bone
    return Handles(tuple(names), np.concatenate(places), tuple(owners))
