"""Where each muscle holds on to bone, found from distances by one stated rule; knows no fibre and no map.

A place of a muscle's surface is *close* to a bone when that bone is the nearest, no farther than ``within_mm``, and on
the side that the surface faces: the far side of a thin sheet is not. Each bone's close area covers a part of the
muscle's length (`geometry.surfaces.sections.position_along`, 0 to 1 by area). At each end of the muscle the attachment
is the close area of the one bone that comes nearest to that end, if the area reaches into that half of the muscle and
is at least `LEAST_SHARE` of the muscle's thin sections. A bone that comes nearest to both ends is taken at the end that
its area's median is nearer to. Other bones that are touched are named.
Distance cannot tell an attachment from a tendon that passes close by: what is known better goes into a file.

Measured is the surface, not the vertices that a file happens to have: it is cut until no place of it is farther from a
sample than the distance that counts as close, and for clearances than `CLEARANCE_SECTIONS` says.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Bool, Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, SampledDistances
from musclefit.geometry.surfaces.samples import EDGES_PER_SPACING, surface_samples
from musclefit.geometry.surfaces.sections import Lengthwise, position_along, position_by
from musclefit.geometry.surfaces.subdivision import with_short_edges

LEAST_SHARE = 0.5
"""An attachment is at least this share of the muscle's thin sections (the lowest tenth of them) in area."""

WITHIN_SECTIONS = 0.1
"""Close is closer than the usual clearance and this share of the side of a square as large as the median section."""

CLEARANCE_SECTIONS = 0.05
"""Clearances are measured at samples this share of the side of a square as large as the median section apart."""

FREE_SHARE = 0.01
"""Of a free end, this share of the muscle's surface stands for what is not there: a cut, or an end in soft tissue."""

REACHES = 0.05
"""An area reaches as far along the muscle as all of it but this share."""

_UNMEASURED: Mapping[str, Lengthwise] = MappingProxyType({})


class End(StrEnum):
    """Of a muscle; the origin is the end whose bone moves less."""

    ORIGIN = "origin"
    INSERTION = "insertion"


@dataclass(frozen=True, eq=False, slots=True)
class Attachment:
    """The area with which a muscle holds on to a bone; or a free end, whose ``bone`` is empty.

    Parameters
    ----------
    muscle, bone : str
    surface : TriMesh
        The muscle's triangles, cut small, that make up the area.
    feet : (v, 3) float64, mm
        For each of its vertices the nearest place of the bone; empty at a free end.
    area_mm2 : float
    centroid_mm : (3,) float64
    distance_mm : float
        Mean distance from the bone, by area; NaN at a free end.
    reason : str
        Why it is free; empty where it is not.
    nearest : str
        The bone nearest to a free end.
    sheet : TriMesh or None
        The tendon sheet on which the fibres of this end begin, where one is stated.
    """

    muscle: str
    bone: str
    surface: TriMesh
    feet: Points
    area_mm2: float
    centroid_mm: Float
    distance_mm: float
    reason: str = ""
    nearest: str = ""
    sheet: TriMesh | None = None


@dataclass(frozen=True, eq=False, slots=True)
class MuscleEnds:
    """The two ends of a muscle, and bones that it touches besides.

    Parameters
    ----------
    muscle : str
    origin, insertion : Attachment
    touched : tuple of (bone, mm²)
        Close areas of other bones, largest first.
    """

    muscle: str
    origin: Attachment
    insertion: Attachment
    touched: tuple[tuple[str, float], ...] = ()

    @property
    def attached(self) -> bool:
        """Whether both ends are on bone."""
        return bool(self.origin.bone and self.insertion.bone)

    @property
    def ends(self) -> tuple[tuple[End, Attachment], ...]:
        """Both, named."""
        return (End.ORIGIN, self.origin), (End.INSERTION, self.insertion)

    def turned(self) -> MuscleEnds:
        """The same with origin and insertion exchanged."""
        return replace(self, origin=self.insertion, insertion=self.origin)


@dataclass(frozen=True, slots=True)
class StatedEnd:
    """What the user says of one end of a muscle.

    Parameters
    ----------
    muscle : str
    end : End
    bones : tuple of str
        The attachment is the area close to any of them; none for a free end, or, with a sheet, for what is found.
    within_mm : float or None
        How close; None for the anatomy's own distance.
    vertices : tuple of int
        Of the muscle's surface as given: the attachment is the triangles all of whose corners are among them.
    sheet : TriMesh or None
        A tendon sheet in or along the muscle, mm: fibres begin on it in place of the attachment.
    """

    muscle: str
    end: End
    bones: tuple[str, ...]
    within_mm: float | None = None
    vertices: tuple[int, ...] = ()
    sheet: TriMesh | None = None


@dataclass(frozen=True, eq=False, slots=True)
class _CloseArea:
    """The triangles of a muscle that are close to one bone (or to several that the user names together)."""

    bone: str
    faces: Int
    area: float
    reach: tuple[float, float, float]  # along the muscle: nearly its lowest, median and nearly its highest place


@dataclass(frozen=True, eq=False, slots=True)
class _Looked:
    """A muscle's surface, cut small, and how far its triangles are from each bone."""

    surface: TriMesh
    areas: Float
    along: Float
    distances: Float  # (bones, faces)


@dataclass(frozen=True, eq=False, slots=True)
class _Bone:
    """A bone with what distances from it are measured by."""

    name: str
    surface: TriMesh
    tree: DistanceTree
    box: Float  # (2, 3): its lowest and its highest corner

    @classmethod
    def all_of(cls, anatomy: Anatomy) -> tuple[_Bone, ...]:
        return tuple(
            cls(bone.name, bone.surface, DistanceTree(bone.surface), _box(bone.surface))
            for bone in anatomy.of_kind(TissueKind.BONE)
        )

    def gap_mm(self, box: Float) -> float:
        """How far its box is from another, mm; 0 where they overlap."""
        return float(np.linalg.norm(np.maximum(np.maximum(box[0] - self.box[1], self.box[0] - box[1]), 0.0)))


def usual_distance_mm(anatomy: Anatomy, *, lengthwise: Mapping[str, Lengthwise] = _UNMEASURED) -> float:
    """How close is close: the median over muscles of their clearance from bone, and a tenth of how thick they are.

    Parameters
    ----------
    anatomy : Anatomy
        At rest.
    lengthwise : mapping of muscle to Lengthwise
        Of muscles whose sections are known already.

    Raises
    ------
    InputError
        No muscle or no bone.
    """
    muscles, bones = anatomy.of_kind(TissueKind.MUSCLE), _Bone.all_of(anatomy)
    if not muscles or not bones:
        raise InputError(
            f"attachments need muscles and bones; found {len(muscles)} muscles and {len(bones)} bones: name the kinds "
            "in [anatomy.kinds]"
        )
    thickness = float(np.median([np.sqrt(np.median(_section_areas(muscle, lengthwise))) for muscle in muscles]))
    spacing = CLEARANCE_SECTIONS * thickness
    clearances = [_clearance(muscle.surface, bones, spacing_mm=spacing) for muscle in muscles]
    return float(np.median(clearances)) + WITHIN_SECTIONS * thickness


def find_ends(
    anatomy: Anatomy,
    *,
    within_mm: float,
    stated: Sequence[StatedEnd] = (),
    travel: Mapping[str, float] | None = None,
    lengthwise: Mapping[str, Lengthwise] = _UNMEASURED,
    muscles: Collection[str] = (),
) -> tuple[MuscleEnds, ...]:
    """Both ends of the muscles of an anatomy at rest.

    Parameters
    ----------
    anatomy : Anatomy
    within_mm : float
        How close a muscle's surface is to the bone it holds on to.
    stated : sequence of StatedEnd
        What is known better than by distance.
    travel : mapping of bone to number, optional
        How far each bone moves; the origin is the end on the bone that moves less (of a free end the bone nearest to
        it), or else the one nearer to the bones that move least. Where that does not tell either, the larger area is
        the origin.
    lengthwise : mapping of muscle to Lengthwise
        Of muscles whose sections are known already.
    muscles : collection of str
        Names of those to look at; all without any. What is stated of the others is checked against the anatomy alone.

    Raises
    ------
    InputError
        A stated end names a muscle, a bone or a vertex that is not there, or has no area within its distance.
    """
    bones = _Bone.all_of(anatomy)
    by_muscle: dict[str, dict[End, StatedEnd]] = {}
    there = {muscle.name: muscle for muscle in anatomy.of_kind(TissueKind.MUSCLE)}
    for said in stated:
        _require_known(said, muscles=there, bones=[bone.name for bone in bones])
        if by_muscle.setdefault(said.muscle, {}).setdefault(said.end, said) is not said:
            raise InputError(f"{said.muscle}: its {said.end.value} is stated twice; remove one")
    return tuple(
        _ends_of(
            muscle,
            bones,
            within_mm=within_mm,
            stated=by_muscle.get(name, {}),
            travel=travel or {},
            lengthwise=lengthwise,
        )
        for name, muscle in there.items()
        if not muscles or name in muscles
    )


def _ends_of(
    muscle: Tissue,
    bones: Sequence[_Bone],
    *,
    within_mm: float,
    stated: Mapping[End, StatedEnd],
    travel: Mapping[str, float],
    lengthwise: Mapping[str, Lengthwise],
) -> MuscleEnds:
    known = lengthwise[muscle.name] if muscle.name in lengthwise else Lengthwise.of(muscle.surface)
    samples = surface_samples(muscle.surface, spacing_mm=within_mm)
    surface = samples.mesh
    middles = surface.corners().mean(axis=1)
    areas = np.linalg.norm(area_vectors(surface), axis=1)
    looked = _Looked(
        surface,
        areas,
        position_by(surface, samples.interpolated(known.along))[surface.faces].mean(axis=1),
        _distances(middles, surface, bones, within_mm=within_mm),
    )
    close = _close_areas(looked, bones, within_mm=within_mm)
    least = LEAST_SHARE * float(np.quantile(known.sections.measure(muscle.surface.vertices).areas, 0.1))
    low, high = _by_rule([area for area in close if area.area >= least])
    found = [
        _attachment(muscle.name, looked, area, bones)
        if area is not None
        else _free_end(muscle.name, looked, bones, far=far, within_mm=within_mm)
        for area, far in ((low, False), (high, True))
    ]
    ends = MuscleEnds(muscle.name, found[0], found[1])
    if _turn(ends, travel, _root(bones, travel)):
        ends = ends.turned()
    for end, said in stated.items():
        at = ends.origin if end is End.ORIGIN else ends.insertion
        if said.bones or said.sheet is None:
            at = _as_stated(muscle, said, looked, bones, within_mm=within_mm, before=ends)
        at = replace(at, sheet=said.sheet)
        ends = replace(ends, origin=at) if end is End.ORIGIN else replace(ends, insertion=at)
    taken = {ends.origin.bone, ends.insertion.bone}
    touched = sorted(((area.bone, area.area) for area in close if area.bone not in taken), key=lambda t: -t[1])
    return replace(ends, touched=tuple(touched))


def _close_areas(looked: _Looked, bones: Sequence[_Bone], *, within_mm: float) -> list[_CloseArea]:
    nearest = looked.distances.argmin(axis=0)
    found = []
    for number, bone in enumerate(bones):
        faces = np.flatnonzero((nearest == number) & (looked.distances[number] <= within_mm))
        faces = faces[_facing(looked.surface, faces, bone.tree)] if len(faces) else faces
        if len(faces):
            found.append(_close_area(bone.name, looked, faces))
    return found


def _facing(surface: TriMesh, faces: Int, bone: DistanceTree) -> Bool:
    """Which of some triangles have the bone's nearest place in front of them."""
    corners = surface.corners()[faces]
    middles = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    found: Bool = np.einsum("fi,fi->f", normals, bone.places(middles).places - middles) > 0.0
    return found


def _close_area(bone: str, looked: _Looked, faces: Int) -> _CloseArea:
    order = faces[np.argsort(looked.along[faces])]
    covered = np.cumsum(looked.areas[order])
    shares = np.array([REACHES, 0.5, 1.0 - REACHES]) * covered[-1]
    low, middle, high = looked.along[order[np.minimum(np.searchsorted(covered, shares), len(order) - 1)]]
    return _CloseArea(bone, faces, float(covered[-1]), (float(low), float(middle), float(high)))


def _by_rule(close: Sequence[_CloseArea]) -> tuple[_CloseArea | None, _CloseArea | None]:
    """The areas at the low and at the high end of a muscle."""
    low = min((area for area in close if area.reach[0] < 0.5), key=lambda area: area.reach[0], default=None)
    high = max((area for area in close if area.reach[2] > 0.5), key=lambda area: area.reach[2], default=None)
    if low is None or low is not high:
        return low, high
    others = [area for area in close if area is not low]
    if low.reach[1] <= 0.5:
        return low, max((a for a in others if a.reach[2] > 0.5), key=lambda area: area.reach[2], default=None)
    return min((a for a in others if a.reach[0] < 0.5), key=lambda area: area.reach[0], default=None), high


def _turn(ends: MuscleEnds, travel: Mapping[str, float], root: Points | None) -> bool:
    """Whether the two ends are the wrong way round."""
    one, other = ends.origin, ends.insertion
    moves = [travel.get(end.bone or end.nearest, 0.0) for end in (one, other)]
    if moves[0] != moves[1]:
        return moves[0] > moves[1]
    if root is None:
        return other.area_mm2 > one.area_mm2
    return bool(np.linalg.norm(other.centroid_mm - root) < np.linalg.norm(one.centroid_mm - root))


def _root(bones: Sequence[_Bone], travel: Mapping[str, float]) -> Points | None:
    """The middle of the bones that move least; None where all move alike, or nothing is known."""
    moves = [travel.get(bone.name, 0.0) for bone in bones]
    if not travel or min(moves) == max(moves):
        return None
    still = [bone.surface.vertices for bone, move in zip(bones, moves, strict=True) if move == min(moves)]
    middle: Points = np.concatenate(still).mean(axis=0)
    return middle


def _attachment(muscle: str, looked: _Looked, area: _CloseArea, bones: Sequence[_Bone]) -> Attachment:
    part = _part(looked.surface, area.faces)
    of = _tree_of([bone for bone in bones if bone.name in area.bone.split(" + ")])
    shares = looked.areas[area.faces]
    middles = looked.surface.corners()[area.faces].mean(axis=1)
    at = of.places(middles)
    return Attachment(
        muscle,
        area.bone,
        part,
        of.places(part.vertices).places,
        area.area,
        np.average(middles, axis=0, weights=shares),
        float(np.average(at.distances, weights=shares)),
    )


def _free_end(
    muscle: str, looked: _Looked, bones: Sequence[_Bone], *, far: bool, within_mm: float, said: str = ""
) -> Attachment:
    """The last of the muscle's surface at one end, with the reason why no bone is there."""
    along = _along_samples(looked)
    faces = np.flatnonzero(along > 1.0 - FREE_SHARE if far else along < FREE_SHARE)
    if not len(faces):
        faces = np.array([along.argmax() if far else along.argmin()])
    middles = looked.surface.corners()[faces].mean(axis=1)
    nearest = np.array([bone.tree(middles).min() for bone in bones])
    bone = bones[int(nearest.argmin())].name
    reason = said or (
        f"no bone comes within {within_mm:.3g} mm of this end over an area that counts; the nearest is {bone}, "
        f"{nearest.min():.3g} mm off"
    )
    areas = looked.areas[faces]
    return Attachment(
        muscle,
        "",
        _part(looked.surface, faces),
        np.zeros((0, 3)),
        float(areas.sum()),
        np.average(middles, axis=0, weights=areas),
        float("nan"),
        reason,
        bone,
    )


def _along_samples(looked: _Looked) -> Float:
    """(faces,) how far along the muscle, found on the small triangles: those of a cut may be too large for its end."""
    found: Float = position_along(looked.surface)[looked.surface.faces].mean(axis=1)
    return found if (found - 0.5) @ (looked.along - 0.5) > 0.0 else 1.0 - found


def _as_stated(
    muscle: Tissue,
    said: StatedEnd,
    looked: _Looked,
    bones: Sequence[_Bone],
    *,
    within_mm: float,
    before: MuscleEnds,
) -> Attachment:
    where = f"{muscle.name}: {said.end.value}"
    if said.vertices:
        chosen = np.zeros(len(muscle.surface.vertices), dtype=bool)
        chosen[list(said.vertices)] = True
        faces = np.flatnonzero(chosen[muscle.surface.faces].all(axis=1))
        if not len(faces):
            raise InputError(f"{where}: the {len(said.vertices)} vertices make up no whole triangle; name all corners")
        own = _Looked(muscle.surface, np.linalg.norm(area_vectors(muscle.surface), axis=1), np.zeros(0), np.zeros(0))
        area = _CloseArea(" + ".join(said.bones), faces, float(own.areas[faces].sum()), (0.0, 0.0, 0.0))
        return _attachment(muscle.name, own, area, bones)
    if not said.bones:
        other = before.insertion if said.end is End.ORIGIN else before.origin
        places = looked.surface.corners().mean(axis=1)
        far = looked.along[np.linalg.norm(places - other.centroid_mm, axis=1).argmin()] < 0.5
        return _free_end(muscle.name, looked, bones, far=bool(far), within_mm=within_mm, said="stated to be free")
    named = _tree_of([bone for bone in bones if bone.name in said.bones])
    reach = within_mm if said.within_mm is None else said.within_mm
    nearest = named(looked.surface.corners().mean(axis=1))
    faces = np.flatnonzero(nearest <= reach)
    if not len(faces):
        raise InputError(
            f"{where}: no part of it comes within {reach:.3g} mm of {' + '.join(said.bones)} (the nearest is "
            f"{nearest.min():.3g} mm off); state a larger within_mm, or another bone"
        )
    return _attachment(muscle.name, looked, _close_area(" + ".join(said.bones), looked, faces), bones)


def _require_known(said: StatedEnd, *, muscles: Mapping[str, Tissue], bones: Sequence[str]) -> None:
    if said.muscle not in muscles:
        raise InputError(f"attachments: no muscle is named {said.muscle!r}; there are: {', '.join(muscles)}")
    for bone in said.bones:
        if bone not in bones:
            raise InputError(f"{said.muscle}: no bone is named {bone!r}; there are: {', '.join(bones)}")
    count = len(muscles[said.muscle].surface.vertices)
    wrong = [v for v in said.vertices if not 0 <= v < count]
    if wrong:
        raise InputError(f"{said.muscle}: vertex {wrong[0]} is not among its {count} (they count from 0)")
    if said.vertices and not said.bones:
        raise InputError(f"{said.muscle}: its {said.end.value} is given by vertices; name the bone too")


def _clearance(surface: TriMesh, bones: Sequence[_Bone], *, spacing_mm: float) -> float:
    """The smallest distance of a surface from any bone at samples, mm; too large by the spacing at most.

    Of the samples those alone are made that lie in triangles which can be nearer than the nearest vertex is.
    """
    box, given, smallest = _box(surface), SampledDistances(surface.vertices), np.inf
    by_gap = sorted(((bone.gap_mm(box), k) for k, bone in enumerate(bones)))
    for gap, number in by_gap:
        if gap < smallest:
            smallest = given.smallest(bones[number].tree, up_to_mm=smallest)
    corners = surface.corners()
    reach = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1) / EDGES_PER_SPACING
    for gap, number in by_gap:
        if gap >= smallest:
            break
        tree = bones[number].tree
        nearest = given.at_least(tree)
        near = nearest[surface.faces].min(axis=1) - reach < smallest
        used = np.unique(surface.faces[near])
        nearest[used] = tree(surface.vertices[used])
        near = np.flatnonzero(nearest[surface.faces].min(axis=1) - reach < smallest)
        if len(near):
            cut = with_short_edges(_part(surface, near), longest_mm=EDGES_PER_SPACING * spacing_mm)
            smallest = min(smallest, float(tree(cut.vertices).min()))
    return float(smallest)


def _distances(places: Points, surface: TriMesh, bones: Sequence[_Bone], *, within_mm: float) -> Float:
    """(bones, places) distances that count as close; infinite elsewhere."""
    distances = np.full((len(bones), len(places)), np.inf)
    sampled, box = SampledDistances(places), _box(surface)
    for number, bone in enumerate(bones):
        if bone.gap_mm(box) <= within_mm:
            distances[number] = sampled.distances(bone.tree, up_to_mm=within_mm)
    return distances


def _tree_of(bones: Sequence[_Bone]) -> DistanceTree:
    """Distances from some bones together."""
    return bones[0].tree if len(bones) == 1 else DistanceTree(TriMesh.together([bone.surface for bone in bones]))


def _box(surface: TriMesh) -> Float:
    box: Float = np.array([surface.vertices.min(axis=0), surface.vertices.max(axis=0)])
    return box


def _section_areas(muscle: Tissue, lengthwise: Mapping[str, Lengthwise]) -> Float:
    known = lengthwise[muscle.name] if muscle.name in lengthwise else Lengthwise.of(muscle.surface)
    return known.sections.measure(muscle.surface.vertices).areas


def _part(surface: TriMesh, faces: Int) -> TriMesh:
    used, corners = np.unique(surface.faces[faces], return_inverse=True)
    return TriMesh(surface.vertices[used], corners.reshape(-1, 3))
