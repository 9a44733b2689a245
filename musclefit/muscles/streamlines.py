"""Streamlines through a muscle's tetrahedra: takes a fibre field, gives polylines from end to end; knows no muscle.

Directions are averaged to the vertices (by volume; on the free surface without their part along its normal) and
interpolated linearly; a line that meets the free surface slides along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.compiling import njit
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.fibres import FibreField, shape_gradients

STEPS_PER_EDGE = 4.0
"""Steps of a line over the cube root of a tet's mean volume."""

MOST_STEPS = 20_000

STALLED = 0.05
"""A line stops where the interpolated directions, of length 1 each, cancel out to less than this."""

ARRIVED = 0.02
"""A line that stops within this of an end's potential has arrived: behind it there is nothing but that end."""

RIM = 2
"""Marks faces at the rim of an end: the potential pulls lines there too, and they have arrived where they stop."""


@dataclass(frozen=True, eq=False, slots=True)
class Streamlines:
    """Lines along the fibres, each of which stands for the same volume.

    Parameters
    ----------
    points : tuple of (p, 3) float64, mm
        From origin to insertion.
    complete : (s,) bool
        Whether the line reached both ends.
    """

    points: tuple[Points, ...]
    complete: Bool

    def lengths(self) -> Float:
        """(s,) mm."""
        return np.array([np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in self.points])


def streamlines(field: FibreField, *, count: int) -> Streamlines:
    """Lines through places that are spread evenly over the volume.

    Parameters
    ----------
    field : FibreField
    count : int
        Lines; the places are the middles of tets at even steps of the volume, in the order of the potential.
    """
    mesh = field.mesh
    volumes = signed_volumes(mesh.vertices, mesh.tets)
    usable = np.flatnonzero(np.linalg.norm(field.directions, axis=1) > 0.0)
    potential = field.potential[mesh.tets[usable]].mean(axis=1)
    order = usable[np.lexsort((mesh.vertices[mesh.tets[usable, 0]] @ _ACROSS, np.round(potential * np.sqrt(count))))]
    covered = np.cumsum(volumes[order])
    seeds = order[np.searchsorted(covered, (np.arange(count) + 0.5) / count * covered[-1])]
    neighbours, ends = _around(field)
    step = float(np.cbrt(volumes.mean())) / STEPS_PER_EDGE
    steady = (
        mesh.vertices,
        mesh.tets,
        shape_gradients(mesh.vertices, mesh.tets),
        neighbours,
        ends,
        vertex_directions(field, volumes),
        field.potential,
    )
    lines, complete = [], []
    for seed in seeds:
        forward, arrived = _traced(*steady, seed, 1.0, step, MOST_STEPS)
        backward, begun = _traced(*steady, seed, -1.0, step, MOST_STEPS)
        lines.append(np.concatenate([backward[:0:-1], forward]))
        complete.append(arrived == 2 and begun == 1)
    return Streamlines(tuple(lines), np.array(complete, dtype=bool))


_ACROSS = np.array([0.61, 0.53, 0.59])
"""Some direction, by which tets of the same potential are put in order."""


def vertex_directions(field: FibreField, volumes: Float) -> Points:
    """(n, 3) directions at the vertices, of length 1 or 0."""
    mesh = field.mesh
    sums = np.zeros((len(mesh.vertices), 3))
    np.add.at(sums, mesh.tets, (volumes[:, None] * field.directions)[:, None])
    boundary = tet_faces(mesh.tets).boundary
    a, b, c = (mesh.vertices[boundary[:, k]] for k in range(3))
    normals = np.zeros((len(mesh.vertices), 3))
    np.add.at(normals, boundary, np.cross(b - a, c - a)[:, None])
    free = ~(field.origin | field.insertion)
    sizes = np.linalg.norm(normals, axis=1)
    unit = normals / np.where(sizes > 0.0, sizes, 1.0)[:, None]
    sums[free] -= (np.einsum("ni,ni->n", sums, unit)[:, None] * unit)[free]
    lengths = np.linalg.norm(sums, axis=1)
    directions: Points = sums / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    return directions


def _around(field: FibreField) -> tuple[Int, Int]:
    """For each tet the neighbour opposite each corner (-1: none), and of which end the face there is (1, 2; 0: none).

    Faces of which only some corners are of an end have `RIM` added.
    """
    tets = field.mesh.tets
    faces = tet_faces(tets)
    neighbours = np.full((len(tets), 4), -1, dtype=np.int64)
    ends = np.zeros((len(tets), 4), dtype=np.int64)
    end_of = np.zeros(len(faces.corners), dtype=np.int64)
    for number, corners in ((1, field.origin[faces.corners]), (2, field.insertion[faces.corners])):
        end_of[corners.any(axis=1)] = number + RIM
        end_of[corners.all(axis=1)] = number
    for side in (0, 1):
        own, other = faces.tets[:, side], faces.tets[:, 1 - side]
        there = own >= 0
        opposite = (tets[own[there]][:, :, None] != faces.corners[there][:, None, :]).all(axis=2).argmax(axis=1)
        neighbours[own[there], opposite] = other[there]
        ends[own[there], opposite] = np.where(other[there] < 0, end_of[there], 0)
    return neighbours, ends


@njit(cache=True)
def _traced(vertices, tets, gradients, neighbours, ends, directions, potential, seed, sense, step, most):
    """One line from the middle of a tet: its points, and the end where it left (0: it got stuck)."""
    points = np.empty((most + 1, 3))
    place = np.zeros(3)
    for corner in range(4):
        place += 0.25 * vertices[tets[seed, corner]]
    points[0] = place
    count, tet, left, wall = 1, seed, step, -1
    arriving = 2 if sense > 0.0 else 1
    weights, slopes = np.empty(4), np.empty(4)
    for _ in range(4 * most):
        if count > most:
            break
        total = 0.0
        for corner in range(4):
            weights[corner] = max(0.0, np.sum(gradients[tet, corner] * (place - vertices[tets[tet, (corner + 1) % 4]])))
            total += weights[corner]
        velocity = np.zeros(3)
        for corner in range(4):
            weights[corner] /= total
            velocity += sense * weights[corner] * directions[tets[tet, corner]]
        if wall >= 0:
            weights[wall] = 0.0
            normal = gradients[tet, wall] / np.linalg.norm(gradients[tet, wall])
            velocity -= min(0.0, np.sum(velocity * normal)) * normal
        speed = np.linalg.norm(velocity)
        if speed < STALLED:
            height = 0.0
            for corner in range(4):
                height += weights[corner] * potential[tets[tet, corner]]
            near = height > 1.0 - ARRIVED if sense > 0.0 else height < ARRIVED
            for corner in range(4):
                near = near or ends[tet, corner] == arriving + RIM
            return points[:count], arriving if near else 0
        velocity /= speed
        reach, leaving = left, -1
        for corner in range(4):
            slopes[corner] = np.sum(gradients[tet, corner] * velocity)
            if corner != wall and slopes[corner] < -1e-14 and -weights[corner] / slopes[corner] < reach:
                reach, leaving = -weights[corner] / slopes[corner], corner
        place = place + reach * velocity
        left -= reach
        if leaving < 0:
            points[count] = place
            count += 1
            left = step
            continue
        wall = -1
        if neighbours[tet, leaving] >= 0:
            tet = neighbours[tet, leaving]
            continue
        if ends[tet, leaving] == arriving:
            points[count] = place
            return points[: count + 1], ends[tet, leaving]
        wall = leaving
    return points[:count], 0
