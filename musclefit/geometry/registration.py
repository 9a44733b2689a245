"""Non-rigid registration of a closed surface to a scan of other triangles, by a cage that carries it; knows no body.

Every vertex of the cage has an affine map of its own; a point of the surface goes where the maps of the cage's triangle
nearest to it take it, blended by its place there. Neighbouring maps are held together, first stiffly, so that the whole
moves as one, then ever less. In each round the surface looks for its nearest places on the scan and the scan for its
own on the surface. What faces the wrong way counts for nothing, nor do places on the border of a hole; what is far away
counts the less the finer the fit has become, so that parts that only one of the two has pull at nothing.

The solve is that of Amberg et al.; it is written out here because the implementations at hand look for places from one
side only and take the rims of holes for surface.

References
----------
B. Amberg, S. Romdhani, T. Vetter, Optimal step nonrigid ICP algorithms for surface registration, CVPR 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, barycentric, nearest_places, smooth_normals
from musclefit.geometry.similarity import Similarity
from musclefit.geometry.surfaces.topology import edges_of

STIFFNESSES = (0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5)
"""How strongly neighbouring maps are held together, against data of weight 1 in all: the first lets the whole stretch
and bend as one, the last follows what is as large as a triangle of the cage."""

REACHES = (0.3, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.01)
"""Distance from which a pair of places counts for a quarter, in units of the surface's size, for each stiffness."""

ROUNDS = 40
"""Of new nearest places for each stiffness, at most."""

STILL = 2e-4
"""A stiffness is done when no point moves farther than this in a round, in units of the surface's size."""

FACING = 0.6
"""Cosine between the normals of a pair of places from which it counts: within 53 degrees."""

SAMPLES = 4000
"""Places on the surface, and on the scan, that look for a partner."""

SAME_TURN_DEG = 20.0
"""Alignments that differ by less are one."""

KEPT = 0.6
"""Share of the places on the scan by which it is laid: the nearest, so that what is no skin says nothing."""

LANDMARK_WEIGHT = 1.0
"""Of all landmarks together, against data of weight 1 in all."""

TURNS = (np.diag([1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0]))
"""The ways in which one set of principal axes lies on another."""


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """A scan ready to be asked.

    Parameters
    ----------
    surface : TriMesh
    border : (f,) bool
        Triangles at a border: a nearest place there may be the rim of a hole.
    samples : (s, 3) float64, mm
        Places on it, spread by area.
    normals : (s, 3) float64
        Of length 1, there.
    vertex_normals : (v, 3) float64
        Of length 1.
    tree : DistanceTree
        Of the surface.
    """

    surface: TriMesh
    border: Bool
    samples: Points
    normals: Points
    vertex_normals: Points
    tree: DistanceTree

    def normals_at(self, faces: Int) -> Points:
        """(k, 3) normals of length 1 about triangles: the middle of their corners' normals."""
        return _unit(self.vertex_normals[self.surface.faces[faces]].sum(axis=1))

    def thinned(self, count: int) -> Scan:
        """With about so many of its samples."""
        step = max(1, len(self.samples) // count)
        return replace(self, samples=self.samples[::step], normals=self.normals[::step])

    @property
    def turned(self) -> Scan:
        """The same scan inside out."""
        surface = TriMesh(self.surface.vertices, self.surface.faces[:, ::-1])
        return replace(
            self,
            surface=surface,
            normals=-self.normals,
            vertex_normals=-self.vertex_normals,
            tree=DistanceTree(surface),
        )

    def moved_back(self, motion: Similarity) -> Scan:
        """The scan where the motion would have to start, for it to lie as it does; sizes stay."""

        def back(points: Points) -> Points:
            return motion.undone(points) * motion.scale

        surface = self.surface.with_vertices(back(self.surface.vertices))
        return replace(
            self,
            surface=surface,
            samples=back(self.samples),
            normals=self.normals @ motion.rotation,
            vertex_normals=self.vertex_normals @ motion.rotation,
            tree=DistanceTree(surface),
        )


@dataclass(frozen=True, eq=False, slots=True)
class Registered:
    """Where the registration took cage and surface, mm."""

    cage: Points
    surface: Points
    rounds: int


def scan_of(surface: TriMesh, *, rng: np.random.Generator, samples: int = SAMPLES) -> Scan:
    """A scan with its border found and places spread on it."""
    edges = edges_of(surface.faces)
    border = np.zeros(len(surface.faces), dtype=bool)
    at_rim = np.zeros(len(surface.vertices), dtype=bool)
    at_rim[edges.boundary.ravel()] = True
    border[at_rim[surface.faces].any(axis=1)] = True
    faces, places = spread_places(surface, count=samples, rng=rng)
    at_vertices = np.zeros((len(surface.vertices), 3))
    for corner in range(3):
        np.add.at(at_vertices, surface.faces[:, corner], area_vectors(surface))
    at_vertices = _unit(at_vertices)
    normals = _unit(at_vertices[surface.faces[faces]].sum(axis=1))
    return Scan(surface, border, places, normals, at_vertices, DistanceTree(surface))


def spread_places(surface: TriMesh, *, count: int, rng: np.random.Generator) -> tuple[Int, Points]:
    """Random places on a surface, as many on each part as its area asks for: (n,) triangles and (n, 3) places, mm."""
    areas = np.linalg.norm(area_vectors(surface), axis=1)
    ends = np.cumsum(areas)
    faces = np.searchsorted(ends, (np.arange(count) + rng.random(count)) / count * ends[-1], side="right")
    faces = np.minimum(faces, len(areas) - 1)
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (surface.vertices[surface.faces[faces, k]] for k in range(3))
    return faces.astype(np.int64), np.asarray(a + u * (b - a) + v * (c - a), dtype=np.float64)


def alignments(surface: TriMesh, scan: Scan, *, scaled: bool = True) -> list[tuple[Similarity, float]]:
    """Ways in which a surface may lie on a scan, by iterated nearest places from several starts, the nearest first.

    The starts are: as they lie; with their middles together; and with their principal axes together, in all four ways.
    Those that end in the same place are one.

    Parameters
    ----------
    surface : TriMesh
    scan : Scan
    scaled : bool
        Whether sizes may differ.

    Returns
    -------
    list of (Similarity, float)
        With the mean distance that is left, without the farthest, mm.
    """
    starts = _starts(surface.vertices, scan.samples, scaled=scaled)
    ends = sorted((_iterated(surface, scan, start, scaled=scaled) for start in starts), key=lambda found: found[1])
    distinct: list[tuple[Similarity, float]] = []
    for motion, left in ends:
        if all(_turn_deg(motion, other) > SAME_TURN_DEG for other, _ in distinct):
            distinct.append((motion, left))
    return distinct


def _turn_deg(one: Similarity, other: Similarity) -> float:
    """Angle between the rotations of two motions, degrees."""
    cosine = (np.trace(one.rotation.T @ other.rotation) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def mismatch(surface: TriMesh, scan: Scan, *, reach_mm: float) -> float:
    """How little a surface and a scan have in common: the mean distance over both, mm.

    A place without counterpart (farther than the reach, or facing another way) counts as the reach; rims of holes are
    left out.
    """
    theirs = _pairs_from_scan(surface, scan, reach_mm)
    far = np.linalg.norm(theirs.targets - theirs.places, axis=1)
    here = np.where(theirs.weights > 0.0, np.minimum(far, reach_mm), reach_mm)
    faces, places = spread_places(surface, count=len(scan.samples), rng=np.random.default_rng(0))
    near = scan.tree.places(places)
    facing = np.einsum("ki,ki->k", _unit(area_vectors(surface)[faces]), scan.normals_at(near.faces)) > FACING
    there = np.where(facing, np.minimum(near.distances, reach_mm), reach_mm)[~scan.border[near.faces]]
    return float(0.5 * (here.mean() + (there.mean() if len(there) else reach_mm)))


def _starts(points: Points, places: Points, *, scaled: bool) -> list[Similarity]:
    middle, there = points.mean(axis=0), places.mean(axis=0)
    own, theirs = points - middle, places - there
    starts = [Similarity.identity(), Similarity(1.0, np.eye(3), there - middle)]
    axes, other = (np.linalg.svd(p.T @ p)[0] for p in (own, theirs))
    axes, other = (frame * [1.0, 1.0, np.sign(np.linalg.det(frame))] for frame in (axes, other))
    size = float(np.sqrt((theirs**2).sum(axis=1).mean() / (own**2).sum(axis=1).mean())) if scaled else 1.0
    for turn in TURNS:
        rotation = other @ turn @ axes.T
        starts.append(Similarity(size, rotation, there - size * rotation @ middle))
    return starts


def _iterated(surface: TriMesh, scan: Scan, start: Similarity, *, scaled: bool) -> tuple[Similarity, float]:
    """Iterated nearest vertices, from the scan to the surface, the farthest left out."""
    tree, places = cKDTree(surface.vertices), scan.samples
    keep = max(4, int(KEPT * len(places)))
    now, left = start, np.inf
    for _ in range(60):
        found = tree.query(now.undone(places))
        distances, numbers = now.scale * np.asarray(found[0]), np.asarray(found[1])
        near = np.argsort(distances)[:keep]
        mean = float(distances[near].mean())
        if mean > 0.999 * left:
            break
        left = mean
        fitted = Similarity.fitted(surface.vertices[numbers[near]], places[near])
        scale = fitted.scale if scaled else 1.0
        middle = surface.vertices[numbers[near]].mean(axis=0)
        now = Similarity(scale, fitted.rotation, places[near].mean(axis=0) - scale * fitted.rotation @ middle)
    return now, left


def faces_out(surface: TriMesh, scan: Scan) -> bool:
    """Whether a scan that lies about where a surface is faces the same way, on most of its area."""
    near = nearest_places(scan.samples, surface)
    cosines = np.einsum("ki,ki->k", scan.normals, smooth_normals(surface, near))
    return bool(np.median(cosines) >= 0.0)


def registered(
    surface: TriMesh,
    cage: TriMesh,
    scan: Scan,
    *,
    rng: np.random.Generator,
    landmarks: tuple[Points, Points] | None = None,
    stages: int = len(STIFFNESSES),
    rounds: int = ROUNDS,
    samples: int = SAMPLES,
    told: Callable[[float], None] = lambda _: None,
) -> Registered:
    """Carry a surface to a scan that lies about where it is.

    Parameters
    ----------
    surface, cage : TriMesh
        Closed; the cage follows the surface.
    scan : Scan
    rng : Generator
        Places on the surface are spread at random.
    landmarks : pair of (m, 3) float64, or None
        Places on the surface and where they are on the scan, mm.
    stages : int
        How many of ``STIFFNESSES`` are gone through.
    rounds : int
        For each of them, at most.
    samples : int
        Places on the surface that look for a partner.
    told : callable
        Told the share that is done.
    """
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    middle = surface.vertices.mean(axis=0)
    graph = _Graph(cage, middle, size)
    of_vertices = graph.rows(surface.vertices)
    faces, places = spread_places(surface, count=samples, rng=rng)
    of_places = _blended(of_vertices, surface, faces, places)
    marks = None if landmarks is None else (graph.rows(landmarks[0]), (landmarks[1] - middle) / size)
    moved, unknown, done = surface.vertices, graph.at_rest(), 0
    for k, (stiffness, reach) in enumerate(zip(STIFFNESSES[:stages], REACHES[:stages], strict=True)):
        for _ in range(rounds):
            now = surface.with_vertices(moved)
            pairs = (
                _pairs_from_surface(now, faces, of_places @ unknown * size + middle, scan, reach * size),
                _pairs_from_scan(now, scan, reach * size),
            )
            theirs = _blended(of_vertices, now, pairs[1].faces, pairs[1].places)
            rows = sparse.csr_matrix(sparse.vstack([of_places, theirs]))
            targets = (np.vstack([pairs[0].targets, pairs[1].targets]) - middle) / size
            weights = np.concatenate([pairs[0].weights, pairs[1].weights])
            unknown = graph.solved(rows, targets, weights, stiffness=stiffness, marks=marks)
            before, moved = moved, of_vertices @ unknown * size + middle
            done += 1
            if np.linalg.norm(moved - before, axis=1).max() < STILL * size:
                break
        told((k + 1) / stages)
    return Registered(graph.corners @ unknown * size + middle, moved, done)


@dataclass(frozen=True, eq=False, slots=True)
class _Pairs:
    """Places on the surface (triangles and positions), where they should go, and how much each counts."""

    faces: Int
    places: Points
    targets: Points
    weights: Float


def _pairs_from_surface(now: TriMesh, faces: Int, places: Points, scan: Scan, reach: float) -> _Pairs:
    near = scan.tree.places(places)
    cosines = np.einsum("ki,ki->k", _unit(area_vectors(now)[faces]), scan.normals_at(near.faces))
    counts = (cosines > FACING) & ~scan.border[near.faces]
    return _Pairs(faces, places, near.places, counts * _robust(near.distances, reach))


def _pairs_from_scan(now: TriMesh, scan: Scan, reach: float) -> _Pairs:
    near = nearest_places(scan.samples, now)
    cosines = np.einsum("ki,ki->k", scan.normals, smooth_normals(now, near))
    return _Pairs(near.faces, near.places, scan.samples, (cosines > FACING) * _robust(near.distances, reach))


def _robust(distances: Float, reach: float) -> Float:
    """Weights that fall from 1 to a quarter at the reach (Geman and McClure)."""
    return np.asarray((reach**2 / (reach**2 + distances**2)) ** 2, dtype=np.float64)


def _unit(vectors: Points) -> Points:
    unit: Points = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
    return unit


class _Graph:
    """The maps at a cage's vertices, held together along its edges."""

    def __init__(self, cage: TriMesh, middle: Float, size: float) -> None:
        self.cage, self._middle, self._size = cage, middle, size
        count = len(cage.vertices)
        ends = edges_of(cage.faces).ends
        number = np.arange(len(ends))
        signs = np.concatenate([-np.ones(len(ends)), np.ones(len(ends))])
        across = sparse.csr_matrix((signs, (np.tile(number, 2), ends.T.ravel())), shape=(len(ends), count))
        self._held = sparse.kron(across.T @ across, sparse.eye(4)).tocsc()
        self.corners = self._rows(np.arange(count)[:, None], np.ones((count, 1)), cage.vertices)

    def at_rest(self) -> Float:
        """The unknowns of maps that move nothing: (4 n, 3)."""
        one = np.vstack([np.eye(3), np.zeros(3)])
        return np.tile(one, (len(self.cage.vertices), 1))

    def rows(self, points: Points) -> sparse.csr_matrix:
        """What takes the unknowns to where (k, 3) points go, in units of the size from the middle."""
        near = nearest_places(points, self.cage)
        corners = self.cage.faces[near.faces]
        a, b, c = (self.cage.vertices[corners[:, k]] for k in range(3))
        return self._rows(corners, barycentric(near.places, a, b, c), points)

    def _rows(self, corners: Int, shares: Float, points: Points) -> sparse.csr_matrix:
        count, each = corners.shape
        local = np.column_stack([(points - self._middle) / self._size, np.ones(count)])
        values = shares[:, :, None] * local[:, None, :]
        columns = 4 * corners[:, :, None] + np.arange(4)
        numbers = np.repeat(np.arange(count), 4 * each)
        shape = (count, 4 * len(self.cage.vertices))
        return sparse.csr_matrix((values.ravel(), (numbers, columns.ravel())), shape=shape)

    def solved(
        self,
        rows: sparse.csr_matrix,
        targets: Points,
        weights: Float,
        *,
        stiffness: float,
        marks: tuple[sparse.csr_matrix, Points] | None,
    ) -> Float:
        """(4 n, 3) maps that take rows to targets by weights, held together."""
        share = weights / max(float(weights.sum()), 1e-300)
        weighted = sparse.diags(share) @ rows
        system, right = rows.T @ weighted + stiffness * self._held, weighted.T @ targets
        if marks is not None:
            each = LANDMARK_WEIGHT / len(marks[1])
            system, right = system + each * (marks[0].T @ marks[0]), right + each * (marks[0].T @ marks[1])
        rest = 1e-9 * sparse.eye(system.shape[0])  # where nothing pulls, the maps at rest
        system, right = system + rest, right + 1e-9 * self.at_rest()
        factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(factors.solve(np.asarray(right)), dtype=np.float64)


def _blended(rows: sparse.csr_matrix, surface: TriMesh, faces: Int, places: Points) -> sparse.csr_matrix:
    """The rows of places on triangles, from those of the vertices."""
    corners = surface.faces[faces]
    a, b, c = (surface.vertices[corners[:, k]] for k in range(3))
    shares = barycentric(places, a, b, c)
    numbers = np.repeat(np.arange(len(faces)), 3)
    blend = sparse.csr_matrix((shares.ravel(), (numbers, corners.ravel())), shape=(len(faces), rows.shape[0]))
    return sparse.csr_matrix(blend @ rows)
