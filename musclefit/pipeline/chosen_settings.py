"""What a rig leaves open of rigid bones and of surfaces, and why, for the report.

It is chosen from the sizes of the bones that meet and from the gaps between tissues.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.fields.locked import Fade
from musclefit.flow.bones import moving_together, poses_on_the_way
from musclefit.flow.locks import LockSettings, with_zone
from musclefit.geometry.arrays import Float
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, nearest_places
from musclefit.geometry.surfaces.edge_lengths import EdgeLengths
from musclefit.geometry.surfaces.subdivision import with_short_edges
from musclefit.rig.handles import BoneMotions
from musclefit.rig.job import Job

MEETING = 0.5
"""Bones of two groups meet where they come closer than this, in units of the thickness of the thinner one."""

HANDLES, NARROWEST, SAMPLES, LOCKED_SAMPLES = 1.25, 0.155, 0.31, 0.5
"""Spacing of handles, of the narrowest lattice of the part that holds bones, and of the places that it is held at,
without locks and with them, in units of the size of the bones that meet."""

WIDER = (4.0, 2.0, 1.0)
"""Spacings of its lattices in units of the narrowest: by powers of two, so that lattices share their knots, at which a
proof cuts its boxes. They are shared to the last digit where no multiple of the narrowest is rounded."""

LOCK, FADE, APART = 0.1, 0.17, 0.42
"""Spacing of the lattice of smooth distances, where locks fade, and how far apart bones must be for both to be locked,
in units of the thickness of a group's thinnest bone that meets another, or of the typical one if that is less: a wider
fade changes the volume of more muscle, a narrower one and bones that are locked closer to each other shear it more."""


EDGES, GROWTH, LONGEST = 2.0, 0.5, 4.0
"""The longest edges of soft tissue: beside moving bones in units of the narrowest lattice, how much longer they may be
per mm of distance from these, and how much longer at most. Far from bones the field is as smooth as its widest part."""

EVEN_MM, CHORD_MM = 3.0, 0.02
"""The longest edge and the chord tolerance where no bones are held."""

CHORD, CHORDS = 0.5, (0.0025, 0.01)
"""The chord tolerance in units of the gap between tissues that all but ``TIGHT`` of their surfaces exceed, and its
bounds in units of the size of the bones that meet."""

TIGHT, LOOKED_AT = 0.05, 400
"""Share of the tissues' surfaces that may be closer to the next tissue than the gap that counts, and vertices of each
tissue that gaps are measured at, at most."""

LOCKED_ITERATIONS, FREE_ITERATIONS = 15, 40
"""Of least squares, with locks and without: these make up for what the field leaves."""


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceChoices:
    """How finely surfaces are cut, given or chosen.

    Parameters
    ----------
    chord_mm : float
    longest : EdgeLengths
    findings : tuple of Finding
        What was chosen, and why.
    """

    chord_mm: float
    longest: EdgeLengths
    findings: tuple[Finding, ...]


@dataclass(frozen=True, eq=False, slots=True)
class BoneChoices:
    """All lengths that rigid bones need, given or chosen.

    Parameters
    ----------
    groups : tuple of tuple of str
        Bones that move as one.
    handle_spacing_mm, sampled_mm : float
    lattices_mm : tuple of float
    iterations : int
    locks : tuple of LockSettings
        Of each group.
    zones_mm : (K, K) float64
        How close two groups come where each may slip along the other.
    findings : tuple of Finding
        What was chosen, and why.
    """

    groups: tuple[tuple[str, ...], ...]
    handle_spacing_mm: float
    sampled_mm: float
    lattices_mm: tuple[float, ...]
    iterations: int
    locks: tuple[LockSettings, ...]
    zones_mm: Float
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class BoneSizes:
    """Thicknesses, 3 V / A, the radius of a ball and three halves of that of a long cylinder.

    Parameters
    ----------
    groups : tuple of tuple of str
    thinnest : tuple of tuple of (str, float)
        Of each group the thinnest bone that meets one of another group, and its thickness, mm.
    typical_mm : float
        The median over all bones that meet.
    """

    groups: tuple[tuple[str, ...], ...]
    thinnest: tuple[tuple[str, float], ...]
    typical_mm: float


@lru_cache(maxsize=2)
def bone_choices(job: Job) -> BoneChoices:
    """The lengths of a job with rigid bones; what its rig gives stands.

    Parameters
    ----------
    job : Job
        With ``bones.rigid``.
    """
    assert job.motions is not None  # a rig with rigid bones says how they move
    given, sizes = job.rig.bones, bone_sizes(job.anatomy, job.motions)
    size, findings = sizes.typical_mm, []
    why = f"the bones that meet are {size:.3g} mm thick (median of 3 V / A)"
    spacing = given.handle_spacing_mm
    if spacing is None:
        spacing = HANDLES * size
        findings.append(chosen_setting("bones.handle_spacing_mm", f"{spacing:.3g} mm", why))
    lattices = given.lattices_mm
    if lattices is None:
        narrowest = _of_few_digits(NARROWEST * size)
        lattices = tuple(times * narrowest for times in WIDER)
        findings.append(chosen_setting("bones.lattices_mm", ", ".join(f"{h:.3g}" for h in lattices) + " mm", why))
    locks = tuple(
        LockSettings(LOCK * width, Fade(FADE * width, APART * width))
        for width in (min(thickness, size) for _, thickness in sizes.thinnest)
    )
    if given.contact_zone_mm is not None:
        locks = tuple(with_zone([lock], given.contact_zone_mm)[0] for lock in locks)
        zones = np.full((len(locks), len(locks)), given.contact_zone_mm)
    else:
        zones = np.array([[min(a.zone_mm, b.zone_mm) for a in locks] for b in locks])
        findings += [
            chosen_setting("bones.contact_zone_mm", f"{lock.zone_mm:.3g} mm", f"{bone} is {thickness:.3g} mm thick")
            for lock, (bone, thickness) in zip(locks, sizes.thinnest, strict=True)
        ]
    iterations = given.iterations
    if iterations is None:
        iterations = LOCKED_ITERATIONS if given.lock else FREE_ITERATIONS
        findings.append(
            chosen_setting("bones.iterations", f"{iterations}", f"bones are {'locked' if given.lock else 'not locked'}")
        )
    samples = (LOCKED_SAMPLES if given.lock else SAMPLES) * size
    return BoneChoices(sizes.groups, spacing, samples, lattices, iterations, locks, zones, tuple(findings))


@lru_cache(maxsize=2)
def surface_choices(job: Job) -> SurfaceChoices:
    """The chord tolerance and the longest edges of a job; what its rig gives stands.

    Parameters
    ----------
    job : Job
    """
    given, findings = job.rig.surfaces, []
    chord, longest = given.chord_tolerance_mm, given.longest_edge_mm
    if not (job.rig.bones.rigid and given.refine):
        return SurfaceChoices(
            CHORD_MM if chord is None else chord, _even_edges(EVEN_MM if longest is None else longest), ()
        )
    assert job.motions is not None  # a rig with rigid bones says how they move
    if longest is not None:
        edges = _even_edges(longest)
    else:
        near = EDGES * min(bone_choices(job).lattices_mm)
        moving = sorted(set(job.motions.at(1.0)) & {tissue.name for tissue in job.anatomy})
        edges = _edges_beside(job.anatomy, tuple(moving), near)
        value = f"{near:.3g} mm beside moving bones to {edges.most_mm:.3g} mm far from them"
        findings.append(
            chosen_setting("surfaces.longest_edge_mm", value, f"the narrowest lattice is {near / EDGES:.3g} mm wide")
        )
    if chord is None:
        size = bone_sizes(job.anatomy, job.motions).typical_mm
        least, most = (bound * size for bound in CHORDS)
        gap = tight_gap(job.anatomy, within_mm=most / CHORD)
        chord = min(max(CHORD * gap, least), most)
        tight = f"{gap:.2g} mm" if gap < most / CHORD else f"at least {most / CHORD:.2g} mm"
        why = f"all but {TIGHT:.0%} of the tissues' surfaces are {tight} from the next, and bones {size:.3g} mm thick"
        findings.append(chosen_setting("surfaces.chord_tolerance_mm", f"{chord:.2g} mm", why))
    return SurfaceChoices(chord, edges, tuple(findings))


@lru_cache(maxsize=4)
def _even_edges(length_mm: float) -> EdgeLengths:
    """The same length everywhere; the same for every pose."""
    return EdgeLengths.even(length_mm)


@lru_cache(maxsize=4)
def _edges_beside(anatomy: Anatomy, bones: tuple[str, ...], near_mm: float) -> EdgeLengths:
    """Short beside some bones; the same for every pose that the same anatomy is sent to."""
    places = [with_short_edges(anatomy[bone].surface, longest_mm=near_mm).vertices for bone in bones]
    return EdgeLengths(near_mm, np.concatenate(places), GROWTH, LONGEST * near_mm)


@lru_cache(maxsize=4)
def tight_gap(anatomy: Anatomy, *, within_mm: float) -> float:
    """The distance from the next tissue that all but ``TIGHT`` of the tissues' surfaces, skin apart, exceed, mm.

    Parameters
    ----------
    anatomy : Anatomy
    within_mm : float
        Gaps above this count as this.
    """
    tissues = [tissue.surface for tissue in anatomy if tissue.kind is not TissueKind.SKIN]
    trees = [DistanceTree(surface) for surface in tissues]
    found = []
    for k, surface in enumerate(tissues):
        points = surface.vertices[:: math.ceil(len(surface.vertices) / LOOKED_AT)]
        gaps = np.full(len(points), within_mm)
        for j, other in enumerate(tissues):
            low, high = other.vertices.min(axis=0) - within_mm, other.vertices.max(axis=0) + within_mm
            near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
            if j != k and near.size:
                gaps[near] = np.minimum(gaps[near], trees[j](points[near]))
        found.append(gaps)
    return float(np.quantile(np.concatenate(found), TIGHT)) if found else within_mm


def bone_sizes(anatomy: Anatomy, motions: BoneMotions) -> BoneSizes:
    """How thick the bones are that meet others, which move otherwise, somewhere on the way; all where none meet."""
    poses = poses_on_the_way(motions)
    groups = moving_together(anatomy, poses)
    thick = {bone: thickness(anatomy[bone].surface) for group in groups for bone in group}
    meeting: set[str] = set()
    for pose in (poses[0], poses[len(poses) // 2], poses[-1]):
        there = {
            bone: anatomy[bone].surface.with_vertices(pose[bone](anatomy[bone].surface.vertices)) for bone in thick
        }
        for k, group in enumerate(groups):
            others = [bone for j, other in enumerate(groups) if j != k for bone in other]
            meeting |= {
                a for a in group if a not in meeting and any(_meet(there[a], there[b], thick, a, b) for b in others)
            }
    counted = meeting or set(thick)
    thinnest = []
    for group in groups:
        bone = min((b for b in group if b in counted), key=thick.__getitem__, default=min(group, key=thick.__getitem__))
        thinnest.append((bone, thick[bone]))
    return BoneSizes(groups, tuple(thinnest), float(np.median([thick[bone] for bone in counted])))


def thickness(surface: TriMesh) -> float:
    """3 V / A of a closed surface, mm."""
    return 3.0 * abs(enclosed_volume(surface)) / float(np.linalg.norm(area_vectors(surface), axis=1).sum())


def _meet(a: TriMesh, b: TriMesh, thick: dict[str, float], name: str, other: str) -> bool:
    near = MEETING * min(thick[name], thick[other])
    low, high = b.vertices.min(axis=0) - near, b.vertices.max(axis=0) + near
    inside = a.vertices[((a.vertices > low) & (a.vertices < high)).all(axis=1)]
    return len(inside) > 0 and float(nearest_places(inside, b).distances.min()) < near


def _of_few_digits(length: float) -> float:
    """A length near another whose multiples are exact numbers: of ten binary digits."""
    mantissa, exponent = math.frexp(length)
    return math.ldexp(round(mantissa * 1024.0), exponent - 10)


def chosen_setting(key: str, value: str, why: str) -> Finding:
    """What was chosen for a key that the rig leaves open, and why."""
    return Finding(key, "chosen-setting", f"{key}: {value}, because {why}")
