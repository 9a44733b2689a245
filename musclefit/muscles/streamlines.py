"""Streamlines through a muscle's tetrahedra: takes a fibre field, gives polylines from end to end; knows no muscle.

Directions are averaged to the vertices (by volume; on the free surface without their part along its normal) and
interpolated linearly; a line that meets the free surface slides along it. Where a line gains no potential any more, in
a corner or a neck of few tetrahedra, it goes on along edges, each to the neighbour with the steepest gain, until it
runs freely again; how much of its length that is, is told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from musclefit.compiling import njit
from musclefit.geometry.arrays import Bool, Float, Int, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.tets.topology import tet_faces
from musclefit.muscles.fibres import FibreField, shape_gradients

STEPS_PER_EDGE = 4.0
"""Steps of a line over the cube root of a tet's mean volume."""

MOST_STEPS = 20_000

STALLED = 0.05
"""A line does not run freely where the interpolated directions, of length 1 each, cancel out to less than this."""

GAIN = 0.02
"""Nor where it gains less than this share of the potential that its way along the gradient would give."""

PATIENCE = 12
"""Crossings of tetrahedra in a row without that gain, before it takes an edge."""

ARRIVED = 0.001
"""A line that gains no more this close to an end's potential has arrived: behind it there is nothing but that end."""

MOST_POINTS = 101
"""A line of more points is given by as many, evenly spaced."""


@dataclass(frozen=True, eq=False, slots=True)
class Streamlines:
    """Lines along the fibres, each of which stands for the same volume.

    Parameters
    ----------
    points : tuple of (p, 3) float64, mm
        From origin to insertion.
    complete : (s,) bool
        Whether the line reached both ends.
    along_edges : (s,) float64
        The share of the line's length that runs along edges.
    are_fibres : bool
        Whether all of each line is muscle fibre; otherwise only its part in the belly is (`measures`).
    """

    points: tuple[Points, ...]
    complete: Bool
    along_edges: Float
    are_fibres: bool = False

    @classmethod
    def none(cls) -> Streamlines:
        """No line."""
        return cls((), np.zeros(0, dtype=bool), np.zeros(0))

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
    step = step_length_mm(field)
    steady = (
        mesh.vertices,
        mesh.tets,
        shape_gradients(mesh.vertices, mesh.tets),
        neighbours,
        ends,
        vertex_directions(field, volumes),
        field.potential,
        np.where(field.origin, 1, np.where(field.insertion, 2, 0)),
        *_incident(mesh.tets, len(mesh.vertices)),
    )
    lines, complete, along = [], [], []
    for seed in seeds:
        forward, arrived, ahead = _traced(*steady, seed, 1.0, step, MOST_STEPS)
        backward, begun, behind = _traced(*steady, seed, -1.0, step, MOST_STEPS)
        line = np.concatenate([backward[:0:-1], forward])
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        lines.append(evenly_thinned(line))
        complete.append(arrived == 2 and begun == 1)
        along.append((ahead + behind) / length if length > 0.0 else 0.0)
    whole = np.array(complete, dtype=bool)
    return Streamlines(tuple(lines), whole, np.array(along), are_fibres=all(field.sheets))


def step_length_mm(field: FibreField) -> float:
    """The steps of lines, mm."""
    return float(np.cbrt(signed_volumes(field.mesh.vertices, field.mesh.tets).mean())) / STEPS_PER_EDGE


def evenly_thinned(line: Points) -> Points:
    """A line by at most `MOST_POINTS` points, its ends among them."""
    if len(line) <= MOST_POINTS:
        return line
    covered = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, covered[-1], MOST_POINTS)
    return np.stack([np.interp(at, covered, line[:, k]) for k in range(3)], axis=1)


_ACROSS = np.array([0.61, 0.53, 0.59])
"""Some direction, by which tets of the same potential are put in order."""


def vertex_directions(field: FibreField, volumes: Float) -> Points:
    """(n, 3) directions at the vertices, of length 1 or 0: 0 on tendon sheets, whose two sides' would cancel out."""
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
    for end, sheet in zip((field.origin, field.insertion), field.sheets, strict=True):
        sums[end & sheet] = 0.0
    lengths = np.linalg.norm(sums, axis=1)
    directions: Points = sums / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    return directions


def _around(field: FibreField) -> tuple[Int, Int]:
    """Opposite each corner of each tet: the neighbour (-1: none), and the end that the face is of (1, 2; 0: none).

    A face inside the muscle is of an end only where that is a tendon sheet, which may lie inside.
    """
    tets = field.mesh.tets
    faces = tet_faces(tets)
    neighbours = np.full((len(tets), 4), -1, dtype=np.int64)
    ends = np.zeros((len(tets), 4), dtype=np.int64)
    end_of = np.zeros(len(faces.corners), dtype=np.int64)
    outer = (faces.tets < 0).any(axis=1)
    for number, end, sheet in ((1, field.origin, field.sheets[0]), (2, field.insertion, field.sheets[1])):
        end_of[end[faces.corners].all(axis=1) & (outer | sheet)] = number
    for side in (0, 1):
        own, other = faces.tets[:, side], faces.tets[:, 1 - side]
        there = own >= 0
        opposite = (tets[own[there]][:, :, None] != faces.corners[there][:, None, :]).all(axis=2).argmax(axis=1)
        neighbours[own[there], opposite] = other[there]
        ends[own[there], opposite] = end_of[there]
    return neighbours, ends


def _incident(tets: Tets, count: int) -> tuple[Int, Int]:
    """The tets around each vertex: those of vertex v are ``second[first[v]:first[v + 1]]``."""
    order = np.argsort(tets.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(tets.ravel(), minlength=count))])
    return first.astype(np.int64), (order // 4).astype(np.int64)


@njit(cache=True)
def _traced(
    vertices, tets, gradients, neighbours, ends, directions, potential, end_of, first, around, seed, sense, step, most
):
    """One line from a tet's middle: its points, the end that it reached (0: none), and its length along edges."""
    points = np.empty((most + 1, 3))
    place = np.zeros(3)
    for corner in range(4):
        place += 0.25 * vertices[tets[seed, corner]]
    points[0] = place
    count, tet, left, wall, idle, edges = 1, seed, step, -1, 0, 0.0
    arriving = 2 if sense > 0.0 else 1
    weights = np.empty(4)
    while count < most:
        if idle > PATIENCE:
            highest = tets[tet, 0]
            for corner in range(1, 4):
                if sense * potential[tets[tet, corner]] > sense * potential[highest]:
                    highest = tets[tet, corner]
            reached = 0.0
            for corner in range(4):
                weights[corner] = np.sum(gradients[tet, corner] * (place - vertices[tets[tet, (corner + 1) % 4]]))
                reached += weights[corner] * potential[tets[tet, corner]]
            if sense * potential[highest] <= sense * reached + 1e-15 and end_of[highest] != arriving:
                highest = _steepest(vertices, tets, potential, first, around, highest, sense)
            if highest < 0:
                height = reached if sense > 0.0 else 1.0 - reached
                return points[:count], arriving if height > 1.0 - ARRIVED else 0, edges
            edges += np.linalg.norm(vertices[highest] - place)
            place = vertices[highest].copy()
            points[count] = place
            count += 1
            if end_of[highest] == arriving:
                return points[:count], arriving, edges
            following = _steepest(vertices, tets, potential, first, around, highest, sense)
            if following < 0:
                height = potential[highest] if sense > 0.0 else 1.0 - potential[highest]
                return points[:count], arriving if height > 1.0 - ARRIVED else 0, edges
            edges += np.linalg.norm(vertices[following] - place)
            place = vertices[following].copy()
            points[count] = place
            count += 1
            if end_of[following] == arriving:
                return points[:count], arriving, edges
            tet, gain = around[first[following]], -np.inf
            for k in range(first[following], first[following + 1]):
                mean = 0.0
                for corner in range(4):
                    mean += sense * potential[tets[around[k], corner]]
                if mean > gain:
                    tet, gain = around[k], mean
            left, wall, idle = step, -1, 0
            continue
        total, height = 0.0, 0.0
        for corner in range(4):
            weights[corner] = max(0.0, np.sum(gradients[tet, corner] * (place - vertices[tets[tet, (corner + 1) % 4]])))
            total += weights[corner]
        velocity, slope = np.zeros(3), np.zeros(3)
        for corner in range(4):
            weights[corner] /= total
            velocity += sense * weights[corner] * directions[tets[tet, corner]]
            slope += sense * potential[tets[tet, corner]] * gradients[tet, corner]
        steepness = np.linalg.norm(slope)
        speed = np.linalg.norm(velocity)
        if speed < STALLED or np.sum(velocity * slope) < GAIN * speed * steepness:
            velocity, speed = slope / steepness if steepness > 0.0 else slope, 1.0 if steepness > 0.0 else 0.0
        if wall >= 0 and speed > 0.0:
            weights[wall] = 0.0
            normal = gradients[tet, wall] / np.linalg.norm(gradients[tet, wall])
            velocity = velocity - min(0.0, np.sum(velocity * normal)) * normal
            speed = np.linalg.norm(velocity)
        if speed < STALLED:
            idle = PATIENCE + 1
            continue
        velocity = velocity / speed
        reach, leaving = left, -1
        for corner in range(4):
            falling = np.sum(gradients[tet, corner] * velocity)
            if corner != wall and falling < -1e-14 and -weights[corner] / falling < reach:
                reach, leaving = -weights[corner] / falling, corner
        height = np.sum(velocity * slope) * reach
        idle = 0 if height > GAIN * steepness * reach and reach > 1e-9 * step else idle + 1
        place = place + reach * velocity
        left -= reach
        if leaving < 0:
            points[count] = place
            count += 1
            left = step
            continue
        wall = -1
        if ends[tet, leaving] == arriving:
            points[count] = place
            return points[: count + 1], arriving, edges
        if neighbours[tet, leaving] >= 0:
            tet = neighbours[tet, leaving]
            continue
        wall = leaving
    return points[:count], 0, edges


@njit(cache=True)
def _steepest(vertices, tets, potential, first, around, vertex, sense):
    """The neighbour of a vertex to which the potential gains most over the distance; -1 where it gains to none."""
    best, most = -1, 0.0
    for k in range(first[vertex], first[vertex + 1]):
        for corner in range(4):
            other = tets[around[k], corner]
            if other != vertex:
                gain = sense * (potential[other] - potential[vertex])
                over = gain / np.linalg.norm(vertices[other] - vertices[vertex])
                if over > most:
                    best, most = other, over
    return best
