r"""Fibres that are known: streamlines, or directions at places -> those of each muscle; knows no file and no map.

A streamline belongs to the muscle in which the longest part of its length runs, if that is at least `INSIDE_SHARE` of
it, and is cut where it leaves that muscle's surface. A direction at a place belongs to the muscle that the place lies
in; one that lies in no muscle counts for those within reach.

The direction at a place of a muscle is that of the main axis of

.. math:: \sum_i w_i\, f_i f_i^\top, \qquad w_i = 1 / (d_i^2 + (r / 100)^2)

over its `NEAREST` nearest samples that are within reach r (d_i their distances), which does not ask which way round
samples point: axes, as of diffusion tensors, point either way. Samples of a streamline are the middles of its segments.
Where no sample is within reach there is no direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.winding import inside_surface
from musclefit.geometry.surfaces.sections import Sections
from musclefit.muscles.fibres import FibreField
from musclefit.muscles.streamlines import Streamlines, evenly_thinned

INSIDE_SHARE = 0.5
"""A streamline of which less than this share of its length runs in any one muscle belongs to none."""

NEAREST = 8
"""Samples that a direction comes from."""

REACH_SECTIONS = 0.25
"""Samples are in reach within this share of the side of a square as large as the muscle's median section."""

SPACING_MM = 0.5
"""Streamlines are asked at least so often which muscle they run in; where they leave it is found by halving."""

HALVINGS = 12


@dataclass(frozen=True, eq=False, slots=True)
class FibreSamples:
    """What one file says of fibres, mm, in the anatomy's frame.

    Parameters
    ----------
    name : str
        The file's.
    lines : tuple of (p, 3) float64
        Streamlines of at least two points; empty where it has directions.
    places, directions : (n, 3) float64
        Directions of length 1.
    muscle : str
        The muscle that all of it is of; empty where it goes by place.
    """

    name: str
    lines: tuple[Points, ...] = ()
    places: Points = field(default_factory=lambda: np.zeros((0, 3)))
    directions: Points = field(default_factory=lambda: np.zeros((0, 3)))
    muscle: str = ""

    @property
    def all_places(self) -> Points:
        """Every point of it."""
        return np.concatenate([self.places, *self.lines])


@dataclass(frozen=True, slots=True)
class FibreUse:
    """What became of one file: streamlines or directions by whether they are in a muscle; lengths in mm.

    ``cut_share`` is the share of the length of the lines that are in muscles which was cut off because it runs outside.
    """

    file: str
    lines: int
    lines_in_muscles: int
    lines_outside: int
    cut_share: float
    directions: int
    directions_in_muscles: int
    directions_outside: int

    @property
    def nothing_fits(self) -> bool:
        """Whether none of it is in any muscle."""
        return not (self.lines_in_muscles or self.directions_in_muscles)


@dataclass(frozen=True, eq=False, slots=True)
class KnownFibres:
    """What is known of one muscle's fibres.

    Parameters
    ----------
    lines : tuple of (p, 3) float64, mm
        Parts of streamlines inside the muscle.
    places, directions : (n, 3) float64
        Samples that may count for it.
    sources : tuple of str
        The files that have anything of it.
    """

    lines: tuple[Points, ...]
    places: Points
    directions: Points
    sources: tuple[str, ...]


def by_muscle(
    samples: Sequence[FibreSamples], muscles: Mapping[str, TriMesh]
) -> tuple[dict[str, KnownFibres], tuple[FibreUse, ...]]:
    """What is known of each muscle, and what became of each file.

    Parameters
    ----------
    samples : sequence of FibreSamples
    muscles : mapping of name to closed surface
        All of the anatomy.

    Returns
    -------
    mapping of name to KnownFibres
        Of those muscles that anything lies in.
    tuple of FibreUse
    """
    lines: dict[str, list[Points]] = {name: [] for name in muscles}
    near: dict[str, list[tuple[Points, Points]]] = {name: [] for name in muscles}
    sources: dict[str, list[str]] = {name: [] for name in muscles}
    uses = []
    for one in samples:
        may = {one.muscle: muscles[one.muscle]} if one.muscle else dict(muscles)
        owned, cut = _lines_inside(one.lines, may)
        for name, own in owned.items():
            lines[name] += own
        within = {name: inside_surface(surface, one.places) for name, surface in may.items()}
        nowhere = ~np.any([np.zeros(len(one.places), dtype=bool), *within.values()], axis=0)
        for name, inside in within.items():
            chosen = inside | nowhere
            near[name].append((one.places[chosen], one.directions[chosen]))
            if inside.any() or owned.get(name):
                sources[name].append(one.name)
        used = sum(map(len, owned.values()))
        uses.append(
            FibreUse(
                file=one.name,
                lines=len(one.lines),
                lines_in_muscles=used,
                lines_outside=len(one.lines) - used,
                cut_share=cut,
                directions=len(one.places),
                directions_in_muscles=int((~nowhere).sum()),
                directions_outside=int(nowhere.sum()),
            )
        )
    known = {}
    for name in muscles:
        if sources[name]:
            along = [_segments(line) for line in lines[name]] + near[name]
            known[name] = KnownFibres(
                tuple(lines[name]),
                np.concatenate([p for p, _ in along]),
                np.concatenate([f for _, f in along]),
                tuple(sources[name]),
            )
    return known, tuple(uses)


def usual_reach_mm(surface: TriMesh, sections: Sections) -> float:
    """How far from a sample its direction holds in a muscle, mm, where nothing else is said."""
    areas = sections.measure(surface.vertices).areas
    return REACH_SECTIONS * float(np.sqrt(np.median(areas)))


@dataclass(frozen=True, eq=False, slots=True)
class NearbyDirections:
    """Directions at any place, from samples near it by the rule above."""

    places: cKDTree
    directions: Points
    reach_mm: float

    @classmethod
    def of(cls, known: KnownFibres, *, reach_mm: float) -> NearbyDirections:
        """From what is known of a muscle."""
        return cls(cKDTree(known.places), known.directions, reach_mm)

    def at(self, places: Points) -> Points:
        """(N, 3) directions of length 1, either way round; 0 where no sample is within reach."""
        count = min(NEAREST, len(self.directions))
        found = self.places.query(places, k=count, distance_upper_bound=self.reach_mm)
        distances, nearest = (np.asarray(part).reshape(-1, count) for part in found)
        there = np.isfinite(distances)
        along = self.directions[np.where(there, nearest, 0)]
        weights = np.where(there, 1.0 / (np.where(there, distances, 0.0) ** 2 + (0.01 * self.reach_mm) ** 2), 0.0)
        dyads = np.einsum("nk,nki,nkj->nij", weights, along, along)
        main: Points = np.linalg.eigh(dyads)[1][:, :, -1]
        return np.where(there[:, :1], main, 0.0)


def known_field(flow: FibreField, near: NearbyDirections) -> tuple[FibreField, float]:
    """The directions that are known in a muscle's tetrahedra, and in what share of its volume any is.

    Parameters
    ----------
    flow : FibreField
        From origin to insertion: tells which way round the directions are.
    near : NearbyDirections

    Returns
    -------
    FibreField
        The same, with the directions at the tetrahedra's middles; 0 where none is known.
    float
    """
    mesh = flow.mesh
    found = near.at(mesh.vertices[mesh.tets].mean(axis=1))
    back = np.einsum("ki,ki->k", found, flow.directions) < 0.0
    found[back] *= -1.0
    volumes = signed_volumes(mesh.vertices, mesh.tets)
    there = np.linalg.norm(found, axis=1) > 0.0
    return replace(flow, directions=found), float(volumes[there].sum() / volumes.sum())


def known_lines(flow: FibreField, lines: Sequence[Points]) -> Streamlines:
    """Streamlines that are known, each from origin to insertion by the potential of the flow nearest to its ends."""
    at = cKDTree(flow.mesh.vertices)
    turned = []
    for line in lines:
        first, last = flow.potential[at.query(line[[0, -1]])[1]]
        turned.append(evenly_thinned(line[::-1] if last < first else line))
    return Streamlines(tuple(turned), np.ones(len(turned), dtype=bool), np.zeros(len(turned)), are_fibres=True)


def followed_lines(
    flow: FibreField, near: NearbyDirections, surface: TriMesh, *, count: int, step_mm: float
) -> Streamlines:
    """Lines along known directions through places spread evenly over the volume where any is known, by midpoint steps.

    A line ends where it leaves the muscle's surface, and is whole if both of its ends do; where directions are no
    longer known, or it is longer than the muscle is large, it ends and is not.

    Parameters
    ----------
    flow : FibreField
        With the known directions (`known_field`).
    near : NearbyDirections
    surface : TriMesh
        The muscle's.
    count : int
    step_mm : float
    """
    mesh, used = flow.mesh, flow.used
    volumes = np.cumsum(signed_volumes(mesh.vertices, mesh.tets)[used])
    seeds = used[np.searchsorted(volumes, (np.arange(count) + 0.5) / count * volumes[-1])]
    starts = mesh.vertices[mesh.tets[seeds]].mean(axis=1)
    low, high = surface.vertices.min(axis=0) - step_mm, surface.vertices.max(axis=0) + step_mm
    steps = int(np.ceil(np.linalg.norm(high - low) / step_mm))
    ways = [
        _followed(near, starts, sense * flow.directions[seeds], box=(low, high), step_mm=step_mm, steps=steps)
        for sense in (1.0, -1.0)
    ]
    lines = [np.concatenate([backward[:0:-1], forward]) for forward, backward in zip(*ways, strict=True)]
    inside = _split_as(inside_surface(surface, np.concatenate(lines)), lines)
    runs = [_run(line, own, at=len(way) - 1) for line, own, way in zip(lines, inside, ways[1], strict=True)]
    cut = _cut(lines, runs, surface)
    whole = [run[0] > 0 and run[1] < len(line) - 1 for run, line in zip(runs, lines, strict=True)]
    kept = [number for number, line in enumerate(cut) if len(line) > 1]
    return Streamlines(
        tuple(evenly_thinned(cut[number]) for number in kept),
        np.array([whole[number] for number in kept], dtype=bool),
        np.zeros(len(kept)),
        are_fibres=True,
    )


def _followed(
    near: NearbyDirections, starts: Points, along: Points, *, box: tuple[Points, Points], step_mm: float, steps: int
) -> list[Points]:
    """From each start the points of a line that sets out ``along``."""
    places, heading = starts.copy(), along.copy()
    found = [[start] for start in starts]
    going = np.arange(len(starts))
    for _ in range(steps):
        if not len(going):
            break
        first = _turned(near.at(places[going]), heading[going])
        middle = _turned(near.at(places[going] + 0.5 * step_mm * first), first)
        known = np.linalg.norm(middle, axis=1) > 0.0
        going, middle = going[known], middle[known]
        places[going] += step_mm * middle
        heading[going] = middle
        for number in going:
            found[number].append(places[number].copy())
        going = going[((places[going] >= box[0]) & (places[going] <= box[1])).all(axis=1)]
    return [np.stack(line) for line in found]


def _turned(axes: Points, heading: Points) -> Points:
    back = np.einsum("ni,ni->n", axes, heading) < 0.0
    return np.where(back[:, None], -axes, axes)


def _lines_inside(lines: Sequence[Points], muscles: Mapping[str, TriMesh]) -> tuple[dict[str, list[Points]], float]:
    """Parts of lines by the muscle they run in, and the share of those lines' length that was cut off."""
    fine = [_subdivided(line) for line in lines]
    if not fine:
        return {}, 0.0
    points = np.concatenate(fine)
    longest = [("", (0, -1), 0.0) for _ in fine]
    for name, surface in muscles.items():
        for number, inside in enumerate(_split_as(inside_surface(surface, points), fine)):
            run = _run(fine[number], inside)
            length = _length(fine[number][run[0] : run[1] + 1])
            if length > longest[number][2]:
                longest[number] = (name, run, length)
    lengths = [_length(line) for line in fine]
    held = [k for k, (_, _, inner) in enumerate(longest) if inner >= INSIDE_SHARE * lengths[k] > 0.0]
    found: dict[str, list[Points]] = {}
    for name in dict.fromkeys(longest[k][0] for k in held):
        own = [k for k in held if longest[k][0] == name]
        found[name] = _cut([fine[k] for k in own], [longest[k][1] for k in own], muscles[name])
    whole, kept = sum(lengths[k] for k in held), sum(_length(line) for own in found.values() for line in own)
    return found, max(1.0 - kept / whole, 0.0) if whole > 0.0 else 0.0


def _run(line: Points, inside: Bool, *, at: int | None = None) -> tuple[int, int]:
    """First and last point of the longest part of a line inside (or of that through ``at``); (0, -1): none."""
    if not inside.any():
        return 0, -1
    first, last = _runs(inside)
    if at is not None:
        chosen = (first <= at) & (at <= last)
        first, last = first[chosen], last[chosen]
        if not len(first):
            return 0, -1
    covered = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    k = int(np.argmax(covered[last] - covered[first]))
    return int(first[k]), int(last[k])


def _cut(lines: Sequence[Points], runs: Sequence[tuple[int, int]], surface: TriMesh) -> list[Points]:
    """Parts of lines with the places where they cross the surface, found by halving."""
    pairs = []
    for line, (begin, end) in zip(lines, runs, strict=True):
        if end >= begin:
            pairs += [(line[begin], line[max(begin - 1, 0)]), (line[end], line[min(end + 1, len(line) - 1)])]
    inner, outer = (np.array([pair[k] for pair in pairs]).reshape(-1, 3) for k in (0, 1))
    for _ in range(HALVINGS):
        middle = 0.5 * (inner + outer)
        within = inside_surface(surface, middle)[:, None]
        inner, outer = np.where(within, middle, inner), np.where(within, outer, middle)
    crossings, found = iter(inner), []
    for line, (begin, end) in zip(lines, runs, strict=True):
        if end < begin:
            found.append(np.zeros((0, 3)))
            continue
        before, after = next(crossings), next(crossings)
        parts = [before[None]] * (begin > 0) + [line[begin : end + 1]] + [after[None]] * (end < len(line) - 1)
        found.append(np.concatenate(parts))
    return found


def _split_as(values: Bool, lines: Sequence[Points]) -> list[Bool]:
    return np.split(values, np.cumsum([len(line) for line in lines])[:-1])


def _runs(inside: Bool) -> tuple[Int, Int]:
    """First and last numbers of runs of points that are inside."""
    changes = np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8))
    return np.flatnonzero(changes == 1), np.flatnonzero(changes == -1) - 1


def _subdivided(line: Points) -> Points:
    """The same line with points no farther apart than `SPACING_MM`."""
    counts = np.maximum(np.ceil(np.linalg.norm(np.diff(line, axis=0), axis=1) / SPACING_MM).astype(np.int64), 1)
    starts = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(starts)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[starts]
    return np.concatenate([line[starts] + share[:, None] * (line[starts + 1] - line[starts]), line[-1:]])


def _segments(line: Points) -> tuple[Points, Points]:
    """Middles and directions of a line's segments that have a length."""
    ways = np.diff(line, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    there = lengths > 0.0
    return (0.5 * (line[1:] + line[:-1]))[there], ways[there] / lengths[there, None]


def _length(line: Points) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
