"""Numbers of a muscle's architecture at rest, and after a map carried it; judges nothing.

Each line of `streamlines` stands for the same volume, so that means over lines are means over the volume. The *belly*
is the part of a muscle's length where its cross-section is at least `BELLY_SHARE` of its largest; the rest is taken for
tendon. A *path* is a line from end to end, a *fibre* its part in the belly, or all of it where lines are known to be
fibres. In a pennate muscle true fibres run from tendon sheet to tendon sheet and are shorter than that part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from musclefit.geometry.arrays import Float, Gradients, Int, Points
from musclefit.geometry.measures import area_vectors, enclosed_volume, signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.quantiles import weighted_quantile
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.sections import Lengthwise, Sections
from musclefit.muscles.attachments import Attachment, End, MuscleEnds
from musclefit.muscles.fibres import FibreField
from musclefit.muscles.streamlines import Streamlines

BELLY_SHARE = 0.25
"""Where the cross-section is below this share of its largest, a muscle is taken for tendon."""

CARRIED_EVERY = 3
"""A map is asked where it takes every third point of a line, and all between where it is bent there."""

MOST_BENT = 1.05
"""A line's piece of so many segments is bent if it is longer than this times the distance of its ends."""

DOUBLED = 2.0
"""A fibre that is so many times as long as at rest, or shorter by as much, is no fibre of a muscle at work."""

Mapped = Callable[[Points], tuple[Points, Gradients]]
"""Where a map takes (N, 3) points, mm, and its derivatives (N, 3, 3) there."""


LEAST_ADDED_MM3 = 1e-6
"""What is added to a surface where a neck of it is widened counts from here on; less is rounding, mm³."""


@dataclass(frozen=True, eq=False, slots=True)
class CarriedDirections:
    """Fibre directions after a map: exact at the places asked for, whatever mesh they came from.

    Parameters
    ----------
    places : (N, 3) float64, mm
        Where the map takes the places.
    directions : (N, 3) float64
        Of length 1: the map's Jacobian F times the direction at rest, over its length.
    stretch : (N,) float64
        That length: how much longer the fibre is there than at rest.
    section_ratio : (N,) float64
        Area across the fibre over that at rest: det F over the stretch, where F keeps the section across the fibre.
    """

    places: Points
    directions: Points
    stretch: Float
    section_ratio: Float


def carried_directions(mapped: Mapped, places: Points, directions: Points) -> CarriedDirections:
    r"""Fibre directions where a map takes them: :math:`f' = F f / |F f|`.

    Parameters
    ----------
    mapped : callable
        Such as `Deformation.with_jacobian`.
    places, directions : (N, 3) float64
        At rest; directions of length 1.
    """
    moved, jacobians = mapped(places)
    along = np.einsum("nij,nj->ni", jacobians, directions)
    stretch = np.linalg.norm(along, axis=1)
    return CarriedDirections(
        moved,
        along / np.where(stretch > 0.0, stretch, 1.0)[:, None],
        stretch,
        np.linalg.det(jacobians) / np.where(stretch > 0.0, stretch, 1.0),
    )


@dataclass(frozen=True, slots=True)
class MuscleArchitecture:
    """One muscle at rest; lengths in mm, areas in mm², volume in mm³.

    ``origin`` and ``insertion`` are bones, empty at a free end. ``pcsa_mm2`` is the volume over the mean fibre length.
    ``lines_whole`` of ``lines`` streamlines reached both ends; ``along_edges_share`` of their length runs along edges.
    ``fibres`` says where they come from; ``data_share`` is the share of the volume where data tell the direction, None
    where there are none.
    """

    name: str
    origin: str
    origin_mm2: float
    insertion: str
    insertion_mm2: float
    volume_mm3: float
    path_mm: float
    fibre_mm: float
    fibre_sd_mm: float
    pennation_deg: float
    pcsa_mm2: float
    lines_whole: int
    lines: int
    along_edges_share: float
    tets: int
    pieces: int
    missed_mm: float
    residual: float
    singular_share: float
    left_out_share: float
    fibres: str
    data_share: float | None
    note: str


@dataclass(frozen=True, slots=True)
class CarriedMuscle:
    """One muscle after a map; ratios are over rest.

    ``stretch_p1`` and ``stretch_p99`` are not exceeded in 1 and 99 hundredths of the volume, ``doubled_share`` is the
    share of the volume where fibres are more than twice as long as at rest, or less than half. ``off_bone`` is None
    where no rigid motion of the bone is known.
    """

    name: str
    path_mm: float
    fibre_mm: float
    pennation_deg: float
    stretch_mean: float
    stretch_min: float
    stretch_p1: float
    stretch_p99: float
    stretch_max: float
    doubled_share: float
    section_ratio_mean: float
    origin_area_ratio: float
    origin_off_bone_mm: float | None
    insertion_area_ratio: float
    insertion_off_bone_mm: float | None
    centroid_line_mm: float
    centroid_line_rest_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class Belly:
    """A muscle's length by cross-sections that ride along.

    Parameters
    ----------
    sections : Sections
    places : cKDTree
        Of the surface's vertices at rest.
    along : (n,) float64
        The share of the surface's area that lies before each of them.
    low, high : float
        Where the belly begins and ends, as such shares.
    """

    sections: Sections
    places: cKDTree
    along: Float
    low: float
    high: float

    def position(self, points: Points) -> Float:
        """(N,) where points at rest lie along the muscle, 0 to 1."""
        found: Float = self.along[self.places.query(points)[1]]
        return found

    def directions(self, vertices: Points, position: Float) -> Points:
        """(N, 3) directions of the centreline, with the surface's vertices at their places, at positions along it."""
        line = self.sections.measure(vertices).centreline
        at = np.concatenate([[0.0], (np.arange(len(line) - 2) + 0.5) / (len(line) - 2), [1.0]])
        tangents = np.gradient(line, at, axis=0)
        found = np.stack([np.interp(position, at, tangents[:, k]) for k in range(3)], axis=1)
        unit: Points = found / np.linalg.norm(found, axis=1, keepdims=True)
        return unit


def belly_of(surface: TriMesh, lengthwise: Lengthwise) -> Belly:
    """The belly of a muscle from the areas of its sections, around the largest."""
    sections = lengthwise.sections
    areas = sections.measure(surface.vertices).areas
    thick = areas >= BELLY_SHARE * areas.max()
    first = last = int(areas.argmax())
    while first > 0 and thick[first - 1]:
        first -= 1
    while last < len(areas) - 1 and thick[last + 1]:
        last += 1
    return Belly(
        sections,
        cKDTree(surface.vertices),
        lengthwise.position,
        first / len(areas),
        (last + 1) / len(areas),
    )


@dataclass(frozen=True, eq=False, slots=True)
class Lines:
    """Streamlines as one array of pieces, each with its line and its position along the muscle at rest.

    ``inside`` is the share of a piece's length that is in the belly, ``bend`` its length at rest over its chord's:
    where its ends are taken by a map, its length is their distance times that.
    """

    points: Points
    starts: Int
    line: Int
    position: Float
    inside: Float
    bend: Float

    @classmethod
    def of(cls, lines: Streamlines, belly: Belly) -> Lines:
        """The segments of all lines, and which are in the belly."""
        counts = np.array([len(line) for line in lines.points])
        points = np.concatenate(lines.points)
        last = np.cumsum(counts) - 1
        starts = np.setdiff1d(np.arange(len(points)), last)
        line = np.repeat(np.arange(len(counts)), counts - 1)
        position = belly.position(0.5 * (points[starts] + points[starts + 1]))
        inside = (position >= belly.low) & (position <= belly.high) | lines.are_fibres
        return cls(points, starts, line, position, inside.astype(np.float64), np.ones(len(starts)))

    @classmethod
    def carried(cls, lines: Streamlines, belly: Belly) -> Lines:
        """Pieces of ``CARRIED_EVERY`` segments, or of one where those are bent, so that a map is asked less often."""
        fine = cls.of(lines, belly)
        last = np.cumsum([len(line) for line in lines.points]) - 1
        first = np.concatenate([[0], last[:-1] + 1])
        of_line = np.repeat(np.arange(len(last)), last - first + 1)
        lengths = np.linalg.norm(np.diff(fine.points, axis=0), axis=1)
        inside = np.zeros(len(lengths))
        inside[fine.starts] = fine.inside
        along, within = (np.concatenate([[0.0], np.cumsum(part)]) for part in (lengths, lengths * inside))
        kept = (np.arange(len(of_line)) - first[of_line]) % CARRIED_EVERY == 0
        kept[last] = True
        at = np.flatnonzero(kept)
        chords = np.linalg.norm(np.diff(fine.points[at], axis=0), axis=1)
        bent = np.append(np.diff(along[at]) > MOST_BENT * chords, False)
        kept |= bent[np.cumsum(kept) - 1]
        at = np.flatnonzero(kept)
        starts = np.flatnonzero(of_line[at[1:]] == of_line[at[:-1]])
        low, high = at[starts], at[starts + 1]
        chords, arcs = np.linalg.norm(fine.points[high] - fine.points[low], axis=1), along[high] - along[low]
        return cls(
            points=fine.points[at],
            starts=starts,
            line=of_line[low],
            position=belly.position(0.5 * (fine.points[low] + fine.points[high])),
            inside=(within[high] - within[low]) / np.where(arcs > 0.0, arcs, 1.0),
            bend=arcs / np.where(chords > 0.0, chords, 1.0),
        )

    def split(self, points: Points) -> list[Points]:
        """Where the lines' points went, line by line."""
        ends = np.setdiff1d(np.arange(len(self.points)), self.starts)
        return np.split(points, ends[:-1] + 1)

    def measure(self, points: Points, tangents: Points, *, count: int) -> tuple[Float, Float, Float]:
        """(count,) lengths of paths and of fibres, mm, and the fibres' mean angle with the centreline, degrees."""
        way = points[self.starts + 1] - points[self.starts]
        chords = np.linalg.norm(way, axis=1)
        lengths = chords * self.bend
        paths: Float = np.bincount(self.line, lengths, minlength=count).astype(np.float64)
        fibres: Float = np.bincount(self.line, lengths * self.inside, minlength=count).astype(np.float64)
        cosines = np.abs(np.einsum("si,si->s", way, tangents)) / np.where(chords > 0.0, chords, 1.0)
        angles = np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))) * lengths * self.inside
        turned = np.bincount(self.line, angles, minlength=count) / np.where(fibres > 0.0, fibres, 1.0)
        return paths, fibres, turned


def measure_at_rest(
    surface: TriMesh,
    ends: MuscleEnds,
    field: FibreField,
    found: Streamlines,
    *,
    belly: Belly,
    pieces: int,
    missed_mm: float,
    loose_share: float = 0.0,
    widened_mm3: float = 0.0,
    source: str = "",
    data_share: float | None = None,
) -> MuscleArchitecture:
    """The numbers of one muscle at rest; fibres that never run in the belly count for the paths alone.

    ``source`` says where known fibres come from; empty: from the flow. ``data_share`` is the share of the volume where
    a direction is known, ``loose_share`` that in pieces beside the largest, ``widened_mm3`` what was added to necks.
    """
    lines = Lines.of(found, belly)
    paths, fibres, angles = lines.measure(
        lines.points, belly.directions(surface.vertices, lines.position), count=len(found.points)
    )
    whole = found.complete
    used = whole & (fibres > 0.0)
    volume = enclosed_volume(surface)
    mean = float(fibres[used].mean()) if used.any() else float("nan")
    reasons = [f"{end.value} is free: {at.reason}" for end, at in ends.ends if not at.bone]
    if field.left_out_share > 0.0:
        reasons.append(f"{100.0 * field.left_out_share:.2g} % of its volume is in pieces that do not reach both ends")
    if pieces > 1:
        loose = f"{100.0 * loose_share:.2g} % of its volume is joined to the rest at no face"
        reasons.append(f"its tetrahedra are in {pieces} pieces: {loose}")
    if widened_mm3 > LEAST_ADDED_MM3:
        reasons.append(f"{widened_mm3:.2g} mm³ were added at necks too thin for tetrahedra that hang together")
    if field.even_flux and not any(field.sheets):
        reasons.append("its flow is driven by an even flux: held potentials leave too much of it without direction")
    return MuscleArchitecture(
        name=ends.muscle,
        origin=ends.origin.bone,
        origin_mm2=ends.origin.area_mm2,
        insertion=ends.insertion.bone,
        insertion_mm2=ends.insertion.area_mm2,
        volume_mm3=volume,
        path_mm=float(paths[whole].mean()) if whole.any() else float("nan"),
        fibre_mm=mean,
        fibre_sd_mm=float(fibres[used].std()) if used.any() else float("nan"),
        pennation_deg=float(angles[used].mean()) if used.any() else float("nan"),
        pcsa_mm2=volume / mean,
        lines_whole=int(whole.sum()),
        lines=len(found.points),
        along_edges_share=float(np.average(found.along_edges, weights=np.maximum(paths, 1e-300))),
        tets=len(field.mesh.tets),
        pieces=pieces,
        missed_mm=missed_mm,
        residual=field.residual,
        singular_share=field.singular_share,
        left_out_share=field.left_out_share,
        fibres=source or _flow(field),
        data_share=data_share,
        note="; ".join(reasons),
    )


def _flow(field: FibreField) -> str:
    """What drives the flow."""
    if any(field.sheets):
        ends = " and ".join(end.value for end, sheet in zip(End, field.sheets, strict=True) if sheet)
        return f"flow by the tendon sheets of {ends}"
    return "flow driven by an even flux" if field.even_flux else "flow"


def measure_carried(
    surface: TriMesh,
    ends: MuscleEnds,
    field: FibreField,
    found: Streamlines,
    *,
    belly: Belly,
    mapped: Mapped,
    placed: Callable[[Points], Points],
    motions: Mapping[str, RigidMotion],
) -> tuple[CarriedMuscle, CarriedDirections, list[Points]]:
    """The numbers of one muscle after a map, its fibres there, and where it takes its streamlines, mm.

    Parameters
    ----------
    mapped, placed : callable
        The map with its derivatives, and without.
    motions : mapping of bone to RigidMotion
        Of bones that move rigidly.
    """
    lines = Lines.carried(found, belly)
    volumes = signed_volumes(field.mesh.vertices, field.mesh.tets)
    used = field.used
    fibres = carried_directions(mapped, *field.placed_directions())
    cut, vertices = belly.sections.vertices, surface.vertices.copy()
    at_rest = [lines.points, surface.vertices[cut], *(part for _, end in ends.ends for part in _of_end(end))]
    bounds = np.cumsum([len(part) for part in at_rest])[:-1]
    points, vertices[cut], *held = np.split(placed(np.concatenate(at_rest)), bounds)
    paths, lengths, angles = lines.measure(points, belly.directions(vertices, lines.position), count=len(found.points))
    whole = found.complete & (lengths > 0.0)
    low, high = (weighted_quantile(fibres.stretch, volumes[used], share) for share in (0.01, 0.99))
    beyond = (fibres.stretch > DOUBLED) | (fibres.stretch < 1.0 / DOUBLED)
    parts = zip(ends.ends, held[::2], held[1::2], strict=True)
    areas, off, middle = zip(*(_carried_end(end, own, feet, motions) for (_, end), own, feet in parts), strict=True)
    return (
        CarriedMuscle(
            name=ends.muscle,
            path_mm=_mean(paths[found.complete]),
            fibre_mm=_mean(lengths[whole]),
            pennation_deg=_mean(angles[whole]),
            stretch_mean=float(np.average(fibres.stretch, weights=volumes[used])),
            stretch_min=float(fibres.stretch.min()),
            stretch_p1=low,
            stretch_p99=high,
            doubled_share=float(volumes[used][beyond].sum() / volumes[used].sum()),
            stretch_max=float(fibres.stretch.max()),
            section_ratio_mean=float(np.average(fibres.section_ratio, weights=volumes[used])),
            origin_area_ratio=areas[0],
            origin_off_bone_mm=off[0],
            insertion_area_ratio=areas[1],
            insertion_off_bone_mm=off[1],
            centroid_line_mm=float(np.linalg.norm(middle[1] - middle[0])),
            centroid_line_rest_mm=float(np.linalg.norm(ends.insertion.centroid_mm - ends.origin.centroid_mm)),
        ),
        fibres,
        lines.split(points),
    )


def _of_end(end: Attachment) -> tuple[Points, Points]:
    """The places of an attachment that are carried, at rest."""
    return end.surface.vertices, end.feet


def _carried_end(
    end: Attachment, vertices: Points, feet: Points, motions: Mapping[str, RigidMotion]
) -> tuple[float, float | None, Points]:
    """Area over that at rest, how far the map leaves the bone beneath at most, and where the centroid goes."""
    moved = end.surface.with_vertices(vertices)
    areas = np.linalg.norm(area_vectors(moved), axis=1)
    ratio = float(areas.sum()) / end.area_mm2
    middle = np.average(moved.corners().mean(axis=1), axis=0, weights=areas)
    if end.bone not in motions:
        return ratio, None, middle
    off = np.linalg.norm(feet - motions[end.bone](end.feet), axis=1)
    return ratio, float(off.max()), middle


def _mean(values: Float) -> float:
    return float(values.mean()) if len(values) else float("nan")
