"""Do given triangles meet between two frames? Two anatomies -> a proof that none do, or pairs and times.

Between the frames every vertex moves straight and evenly. Whether triangles meet on the way is decided by ipctk's
conservative advancement, which may see a touch where there is a hair's breadth between, but misses none. That given
triangles meet does not say that the tissues do: `musclefit.validate.close_meetings` looks at them with finer ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from types import ModuleType
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import ROUNDING_MM3, overlap_volume, solid_of
from musclefit.geometry.surfaces.crossings import crossings_between
from musclefit.progress import Progress

CELL_MM = 24.0
"""Edge of the cells that are examined one by one, each in the frame that moves with it."""

CONSERVATIVE = 0.999
"""Two primitives that come closer than what this leaves of their distance in the first frame are taken to meet."""

MAX_ITERATIONS = 10_000
"""A pair that is not decided by then is taken to meet."""

MARGIN_MM = 1e-6
"""Boxes are grown by this much before they are held apart: far more than rounding, far less than any gap."""


@dataclass(frozen=True, slots=True)
class Passage:
    """Two tissues whose triangles meet on the way from one frame to the next.

    Parameters
    ----------
    a, b : str
    at : float
        When they are first seen to, as a fraction of the way; 0 where they touch in the first frame and come to meet
        nowhere else.
    overlap_before_mm3, overlap_after_mm3 : float
        What their triangles share in the two frames.
    touching : bool
        Triangles of the two touch or cross in the first frame already.
    further : bool
        Others than those, and those around them, come to meet on the way.
    """

    a: str
    b: str
    at: float
    overlap_before_mm3: float
    overlap_after_mm3: float
    touching: bool = False
    further: bool = True

    @property
    def hidden(self) -> bool:
        """Whether no frame shows it."""
        return self.overlap_before_mm3 <= ROUNDING_MM3 and self.overlap_after_mm3 <= ROUNDING_MM3


@dataclass(frozen=True, slots=True)
class PassageCheck:
    """What happens between two frames: every meeting pair, and how many pairs of primitives were examined."""

    passages: tuple[Passage, ...]
    pairs_examined: int


@dataclass(frozen=True, slots=True)
class _Meeting:
    """Triangles of two tissues that meet: when first, and whether they touch at the start."""

    at: float
    touching: bool
    further: bool

    def and_also(self, other: _Meeting) -> _Meeting:
        """What is seen of the same two tissues in two places."""
        first = min(self, other, key=lambda meeting: (not meeting.further, meeting.at))
        return _Meeting(first.at, self.touching or other.touching, self.further or other.further)


@dataclass(frozen=True, eq=False, slots=True)
class _Soup:
    """All triangles of an anatomy as one mesh, at both frames; ``tissue`` (n,) says whose each vertex is."""

    before: Points
    after: Points
    faces: Int
    tissue: Int
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False, slots=True)
class _Boxes:
    """Lowest and highest corners (n, 3) before and after; swept in a frame that moves, they become one box each."""

    low: tuple[Float, Float]
    high: tuple[Float, Float]

    def swept(self, shift: Float, which: Int | slice) -> tuple[Float, Float]:
        """(k, 3) lowest and highest corners on the way, seen from a frame that moves by ``shift``."""
        low = np.minimum(self.low[0][which], self.low[1][which] - shift) - MARGIN_MM
        high = np.maximum(self.high[0][which], self.high[1][which] - shift) + MARGIN_MM
        return low, high


def check_passages(before: Anatomy, after: Anatomy, *, progress: Progress) -> PassageCheck:
    """Every pair of tissues that meet between two frames; the skin is left out, as in overlaps.

    Parameters
    ----------
    before, after : Anatomy
        The same triangles in two consecutive frames.

    Returns
    -------
    PassageCheck
        Without passages, it is proved that no tissue passed through another, its triangles moving straight.

    Raises
    ------
    InputError
        The anatomies have different tissues or triangles, or ipctk is not installed.

    Notes
    -----
    Space is cut into cells, and each is looked at from a frame that moves with its mean displacement: that changes no
    meeting, and makes the boxes of a fast but common motion small. A cell owns triangles; they are held against all
    triangles whose way touches theirs, so that no pair is left out.

    References
    ----------
    M. Li, D. M. Kaufman and C. Jiang, Codimensional incremental potential contact, ACM Trans. Graph. 40 (2021) 170
    (additive continuous collision detection); Z. Ferguson et al., IPC Toolkit (ipctk).
    """
    ipctk = _ipctk()
    soup = _soup(before, after)
    found: dict[tuple[int, int], _Meeting] = {}
    examined = 0
    with progress.stage("between frames") as tick:
        for done, shift, faces in _neighbourhoods(soup):
            seen, meetings = _meetings(ipctk, soup, faces, shift)
            examined += seen
            for pair, meeting in meetings.items():
                found[pair] = found[pair].and_also(meeting) if pair in found else meeting
            tick(done)
        tick(1.0)
    passages = []
    for (a, b), meeting in sorted(found.items(), key=lambda item: (item[1].at, item[0])):
        one, other = soup.names[a], soup.names[b]
        shared = shared_volume(before, one, other), shared_volume(after, one, other)
        passages.append(Passage(one, other, meeting.at, *shared, meeting.touching, meeting.further))
    return PassageCheck(tuple(passages), examined)


def shared_volume(anatomy: Anatomy, one: str, other: str) -> float:
    """What the triangles of two tissues share, mm³; NaN where a surface is not a solid."""
    surfaces: list[TriMesh] = [anatomy[one].surface, anatomy[other].surface]
    try:
        return overlap_volume(*(solid_of(surface) for surface in surfaces))
    except MeshError:
        return float("nan")


def _ipctk() -> ModuleType:
    try:
        import ipctk
    except ImportError:
        raise InputError(
            "proving that nothing passes through anything between frames needs ipctk, which is not installed: "
            "pip install 'musclefit[motion]'"
        ) from None
    ipctk.set_logger_level(ipctk.LoggerLevel.error)  # it warns of every pair that touches at the start
    return ipctk  # type: ignore[no-any-return]


def _soup(before: Anatomy, after: Anatomy) -> _Soup:
    if tuple(t.name for t in before) != tuple(t.name for t in after):
        raise InputError("the two frames have different tissues; give two frames of one sequence")
    inner = [(before[t.name], after[t.name]) for t in before if t.kind is not TissueKind.SKIN]
    if len(inner) < 2:
        raise InputError(f"{len(inner)} tissues beside the skin have nothing to pass through; give at least 2")
    faces, tissue, start = [], [], 0
    for number, (one, other) in enumerate(inner):
        if not np.array_equal(one.surface.faces, other.surface.faces):
            raise InputError(f"{one.name} has other triangles in the two frames; give two frames of one sequence")
        faces.append(one.surface.faces + start)
        tissue.append(np.full(len(one.surface.vertices), number))
        start += len(one.surface.vertices)
    places = [np.concatenate([pair[k].surface.vertices for pair in inner]) for k in (0, 1)]
    names = tuple(one.name for one, _ in inner)
    return _Soup(places[0], places[1], np.concatenate(faces), np.concatenate(tissue), names)


def _neighbourhoods(soup: _Soup) -> Iterator[tuple[float, Float, Int]]:
    """For each cell: the share of cells done, its mean displacement, and the triangles it owns or that reach them."""
    corners = soup.before[soup.faces], soup.after[soup.faces]
    triangles = _Boxes((corners[0].min(1), corners[1].min(1)), (corners[0].max(1), corners[1].max(1)))
    keys = np.floor(corners[0].mean(axis=1) / CELL_MM).astype(np.int64)
    _, cell = np.unique(keys, axis=0, return_inverse=True)
    cell = cell.ravel()
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(cell.max() + 2))
    moved = (corners[1] - corners[0]).mean(axis=1)
    shifts = np.add.reduceat(moved[order], starts[:-1]) / np.diff(starts)[:, None]
    cells = _Boxes(
        tuple(np.minimum.reduceat(low[order], starts[:-1]) for low in triangles.low),  # type: ignore[arg-type]
        tuple(np.maximum.reduceat(high[order], starts[:-1]) for high in triangles.high),  # type: ignore[arg-type]
    )
    of_face = soup.tissue[soup.faces[:, 0]]
    for number, shift in enumerate(shifts):
        low, high = cells.swept(shift, slice(None))
        own_low, own_high = low[number], high[number]
        touching = np.flatnonzero(((low <= own_high) & (own_low <= high)).all(axis=1))
        near = np.concatenate([order[starts[k] : starts[k + 1]] for k in touching])
        low, high = triangles.swept(shift, near)
        near = near[((low <= own_high) & (own_low <= high)).all(axis=1)]
        if len(near) and (of_face[near] != of_face[near[0]]).any():
            yield (number + 1) / len(shifts), shift, near


def _meetings(ipctk: ModuleType, soup: _Soup, faces: Int, shift: Float) -> tuple[int, dict[tuple[int, int], _Meeting]]:
    """How many pairs of primitives of some triangles were examined, and which tissues among them meet."""
    all_together = _Examined(ipctk, soup, faces, shift)
    found: dict[tuple[int, int], _Meeting] = {}
    if not all_together.is_free():
        owner = soup.tissue[soup.faces[faces, 0]]
        for a, b in combinations(np.unique(owner).tolist(), 2):
            pair = _Examined(ipctk, soup, faces[(owner == a) | (owner == b)], shift)
            if not pair.is_free():
                found[a, b] = pair.meeting()
    return all_together.count, found


class _Examined:
    """Some triangles on their way, with the pairs of primitives of different tissues whose boxes touch."""

    def __init__(self, ipctk: ModuleType, soup: _Soup, faces: Int, shift: Float) -> None:
        self.ipctk = ipctk
        self.judge = ipctk.AdditiveCCD(MAX_ITERATIONS, CONSERVATIVE)
        used, corners = np.unique(soup.faces[faces], return_inverse=True)
        origin = soup.before[used].mean(axis=0)
        self.tissue = soup.tissue[used]
        self.faces = np.asfortranarray(corners.reshape(-1, 3).astype(np.int32))
        self.edges = np.asfortranarray(ipctk.edges(self.faces))
        self.before = np.asfortranarray(soup.before[used] - origin)
        self.after = np.asfortranarray(soup.after[used] - shift - origin)
        self.mesh = ipctk.CollisionMesh(self.before, self.edges, self.faces)
        self.mesh.can_collide = ipctk.make_vertex_patches_filter(self.tissue.astype(np.int32))
        self.candidates = ipctk.Candidates()
        self.candidates.build(self.mesh, self.before, self.after, broad_phase=ipctk.LBVH())
        self.count = len(self.candidates)

    def is_free(self) -> bool:
        """Whether no pair meets."""
        return not self.count or self._free()

    def _free(self) -> bool:
        return bool(
            self.candidates.is_step_collision_free(self.mesh, self.before, self.after, narrow_phase_ccd=self.judge)
        )

    def meeting(self) -> _Meeting:
        """What is seen of two tissues that are not free; the search is conservative, and ends a little before."""
        at_start = self._touching()
        if not at_start.any() and (at := self._first(self.candidates)) > 0.0:
            return _Meeting(at, touching=False, further=True)
        others = self.ipctk.Candidates()
        others.fv_candidates = [c for c in self.candidates.fv_candidates if not self._by_touch(c, at_start)]
        others.ee_candidates = [c for c in self.candidates.ee_candidates if not self._by_touch(c, at_start)]
        at = self._first(others)
        if at == 0.0:  # triangles that touch in a point or an edge and cross nowhere
            kept = [self._meets(c) for c in [*others.fv_candidates, *others.ee_candidates]]
            at = min((when for when in kept if when > 0.0), default=1.0)
        return _Meeting(at if at < 1.0 else 0.0, touching=True, further=at < 1.0)

    def _first(self, candidates: Any) -> float:
        """When the first of some pairs meets; 1 where none does."""
        if not len(candidates):
            return 1.0
        return float(
            candidates.compute_collision_free_stepsize(self.mesh, self.before, self.after, narrow_phase_ccd=self.judge)
        )

    def _meets(self, candidate: Any) -> float:
        """When a pair meets; 1 where it does not."""
        ends = (candidate.dof(places, self.edges, self.faces) for places in (self.before, self.after))
        met, at = candidate.ccd(*ends, 0.0, 1.0, self.judge)
        return float(at) if met else 1.0

    def _by_touch(self, candidate: Any, at_start: Bool) -> bool:
        """Whether a pair lies where the tissues touch at the start: on both it has vertices of triangles that do."""
        vertices = np.array(candidate.vertex_ids(self.edges, self.faces))
        return len(np.unique(self.tissue[vertices[at_start[vertices]]])) == 2

    def _touching(self) -> Bool:
        """(n,) which vertices belong to triangles that touch the other tissue's at the start."""
        owner = self.tissue[self.faces[:, 0]]
        parts = [self.faces[owner == tissue] for tissue in np.unique(owner)]
        pairs = crossings_between(*(TriMesh(self.before, part.astype(np.int64)) for part in parts)).pairs
        touching: Bool = np.zeros(len(self.before), dtype=bool)
        for part, side in zip(parts, pairs.T, strict=True):
            touching[part[side]] = True
        return touching
