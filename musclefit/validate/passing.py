"""Does a tissue pass through another between two frames? Two anatomies -> a proof that none does, or pairs and times.

Between the frames every vertex moves straight and evenly. Whether triangles meet on the way is decided by ipctk's
conservative advancement, which may see a touch where there is a hair's breadth between, but misses none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from types import ModuleType

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.solids import ROUNDING_MM3, overlap_volume, solid_of
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
    """Two tissues that meet on the way from one frame to the next.

    ``at`` is when they are first seen to, as a fraction of the way. ``overlap_before_mm3`` and ``overlap_after_mm3``
    are what their given triangles share in the two frames: where one is above 0 they were seen entering or leaving each
    other there; where both are 0 one passed through the other in between, and no frame shows it.
    """

    a: str
    b: str
    at: float
    overlap_before_mm3: float
    overlap_after_mm3: float

    @property
    def hidden(self) -> bool:
        """Whether no frame shows it."""
        return self.overlap_before_mm3 <= ROUNDING_MM3 and self.overlap_after_mm3 <= ROUNDING_MM3


@dataclass(frozen=True, slots=True)
class PassageCheck:
    """What happens between two frames: every meeting pair, and how many pairs of primitives were examined."""

    passages: tuple[Passage, ...]
    pairs_examined: int


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
        Without passages, it is proved that no tissue passed through another.

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
    first: dict[tuple[int, int], float] = {}
    examined = 0
    with progress.stage("between frames") as tick:
        for done, shift, faces in _neighbourhoods(soup):
            seen, meetings = _meetings(ipctk, soup, faces, shift)
            examined += seen
            for pair, at in meetings.items():
                first[pair] = min(at, first.get(pair, np.inf))
            tick(done)
        tick(1.0)
    passages = []
    for (a, b), at in sorted(first.items(), key=lambda item: item[1]):
        one, other = soup.names[a], soup.names[b]
        passages.append(Passage(one, other, at, _overlap(before, one, other), _overlap(after, one, other)))
    return PassageCheck(tuple(passages), examined)


def _ipctk() -> ModuleType:
    try:
        import ipctk
    except ImportError:
        raise InputError(
            "proving that nothing passes through anything between frames needs ipctk, which is not installed: "
            "pip install 'musclefit[motion]'"
        ) from None
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


def _meetings(ipctk: ModuleType, soup: _Soup, faces: Int, shift: Float) -> tuple[int, dict[tuple[int, int], float]]:
    """How many pairs of primitives of some triangles were examined, and when tissues among them first meet."""
    all_together = _Examined(ipctk, soup, faces, shift)
    first: dict[tuple[int, int], float] = {}
    if not all_together.is_free():
        owner = soup.tissue[soup.faces[faces, 0]]
        for a, b in combinations(np.unique(owner).tolist(), 2):
            pair = _Examined(ipctk, soup, faces[(owner == a) | (owner == b)], shift)
            if not pair.is_free():
                first[a, b] = pair.first_meeting()
    return all_together.count, first


class _Examined:
    """Some triangles on their way, with the pairs of primitives of different tissues whose boxes touch."""

    def __init__(self, ipctk: ModuleType, soup: _Soup, faces: Int, shift: Float) -> None:
        self.judge = ipctk.AdditiveCCD(MAX_ITERATIONS, CONSERVATIVE)
        used, corners = np.unique(soup.faces[faces], return_inverse=True)
        origin = soup.before[used].mean(axis=0)
        self.faces = np.asfortranarray(corners.reshape(-1, 3).astype(np.int32))
        self.edges = np.asfortranarray(ipctk.edges(self.faces))
        self.before = np.asfortranarray(soup.before[used] - origin)
        self.after = np.asfortranarray(soup.after[used] - shift - origin)
        self.mesh = ipctk.CollisionMesh(self.before, self.edges, self.faces)
        self.mesh.can_collide = ipctk.make_vertex_patches_filter(soup.tissue[used].astype(np.int32))
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

    def first_meeting(self) -> float:
        """When the first pair meets, at the latest: the search is conservative, and ends a little before."""
        return float(
            self.candidates.compute_collision_free_stepsize(
                self.mesh, self.before, self.after, narrow_phase_ccd=self.judge
            )
        )


def _overlap(anatomy: Anatomy, one: str, other: str) -> float:
    """What the given triangles of two tissues share, mm³; NaN where a surface is no solid."""
    surfaces: list[TriMesh] = [anatomy[one].surface, anatomy[other].surface]
    try:
        return overlap_volume(*(solid_of(surface) for surface in surfaces))
    except MeshError:
        return float("nan")
