"""What a page shows of a run or a motion in 3-D: its states, coloured values and places to look at; draws nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.figures.camera import principal_axis, principal_views
from musclefit.figures.colours import Colour, tissue_colours
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import ROUNDING_MM3, overlap_mesh
from musclefit.pipeline.retarget import Outcome, Retargeting
from musclefit.report.scene import Scene, SceneField, SceneMark, SceneShape, SceneTissue

DRAWN_OF_A_KIND = 60
"""Places of one kind that are drawn of one state: the largest; the page says how many are not."""

DRAWN_COORDINATES = 45_000_000
"""Of all frames of a page, which take 0.5 to 0.7 bytes each: 80 frames of a leg with 187,000 vertices, about 30 MB."""

GAP_SHARE = 1.0 / 50.0
"""Gaps are coloured up to this share of the body's largest extent."""

STRETCH, STRETCH_RANGE = "stretch along muscles", (0.5, 1.5)
"""What a page calls the stretch, and from where to where it is coloured."""

LEAST_LENGTHWISE = 0.5
"""A triangle runs along an axis whose part in the triangle's plane is at least this long: 30 degrees off its normal."""

SLIVER = 1e-6
"""Twice the area over the square of the longest edge, below which a triangle has no part in that."""

_TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def run_scene(made: Retargeting) -> Scene:
    """Rest, result, the paper's loop and one shot of a run, with what is wrong in each.

    Parameters
    ----------
    made : Retargeting

    Returns
    -------
    Scene
    """
    result = made.result
    left_out: list[str] = []
    compared = (("Result", result), ("Paper's loop", made.paper_loop), ("One shot", made.baseline))
    shapes = [SceneShape("Rest", _surfaces(result.rest), (_gaps(result.rest),), _contact(result))]
    for title, outcome in compared:
        if outcome is None:
            continue
        marks, missing = _marks(outcome)
        left_out += [f"{title}: {words}" for words in missing]
        volumes = SceneField("det J", "", 0.0, 2.0, outcome.determinants)
        values = (volumes, _gaps(outcome.deformed), lengthwise_stretch(outcome.rest, outcome.deformed))
        shapes.append(SceneShape(title, _surfaces(outcome.deformed), values, marks))
    return _scene(result.rest, shapes, left_out)


MotionFrame = tuple[str, float, Anatomy]
"""A frame of a motion: title, time in s, and anatomy."""


def motion_scene(rest: Anatomy, frames: Sequence[MotionFrame]) -> Scene:
    """A motion, frame by frame, from the anatomy at rest; evenly thinned where it is too long for a page.

    It is first shown where it is farthest from rest on average.

    Parameters
    ----------
    rest : Anatomy
    frames : sequence of title, time in s, and anatomy
        In order of time, on the triangles of ``rest``.
    """
    return motions_scene(rest, {"": frames})


def motions_scene(rest: Anatomy, motions: Mapping[str, Sequence[MotionFrame]]) -> Scene:
    """Motions beside each other, each as `motion_scene` shows it.

    Parameters
    ----------
    rest : Anatomy
        Of the first.
    motions : mapping of name to frames
        Of the same tissues.
    """
    coordinates = 3 * sum(len(a.vertices()) for frames in motions.values() for _, _, a in frames)
    every = max(1, math.ceil(coordinates / DRAWN_COORDINATES))
    shapes = [SceneShape("Rest", _surfaces(rest))]
    for name, frames in motions.items():
        shapes += [
            SceneShape(title, _surfaces(anatomy), time_s=time_s, motion=name)
            for title, time_s, anatomy in frames[::every]
        ]
    thinned = f"one of {every} frames is shown, so that the page stays small enough to open; all are in the tables"
    drawn = [shape for shape in shapes if shape.time_s is not None and shape.motion == next(iter(motions))]
    first = max(drawn, key=lambda shape: _mean_distance(shapes[0], shape), default=None)
    scene = _scene(rest, shapes, [thinned] if every > 1 else [])
    return replace(scene, first_time_s=None if first is None else first.time_s)


def _mean_distance(one: SceneShape, other: SceneShape) -> float:
    """Mean distance of the vertices of two shapes; 0 where they do not have the same number."""
    pairs = list(zip(one.surfaces, other.surfaces, strict=True))
    if any(len(a.vertices) != len(b.vertices) for a, b in pairs):
        return 0.0
    return float(np.concatenate([np.linalg.norm(a.vertices - b.vertices, axis=1) for a, b in pairs]).mean())


def compared_scene(rest: Anatomy, results: Mapping[str, Anatomy]) -> Scene:
    """The results of several runs, from the anatomy at rest of the first.

    Parameters
    ----------
    rest : Anatomy
    results : mapping of title to anatomy
        Each of the same tissues.
    """
    shapes = [SceneShape("Rest", _surfaces(rest))]
    shapes += [SceneShape(title, _surfaces(result), (_gaps(result),)) for title, result in results.items()]
    return _scene(rest, shapes, [])


def hex_colour(colour: Colour) -> str:
    """A colour as pages write it."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)


def _scene(rest: Anatomy, shapes: list[SceneShape], left_out: list[str]) -> Scene:
    colours = tissue_colours(rest)
    tissues = tuple(SceneTissue(t.name, t.kind.value, hex_colour(colours[t.name])) for t in rest)
    view = principal_views(rest.vertices())[0]
    return Scene(tissues, tuple(shapes), view.up, view.towards, tuple(left_out))


def _surfaces(anatomy: Anatomy) -> tuple[TriMesh, ...]:
    return tuple(tissue.surface for tissue in anatomy)


def _gaps(anatomy: Anatomy) -> SceneField:
    """Distance of every vertex to the nearest vertex of another tissue, the skin left out; NaN where none is near."""
    points = anatomy.vertices()
    far = GAP_SHARE * float(np.ptp(points, axis=0).max()) or 1.0
    found = np.full(len(points), np.nan)
    inside = np.ones(len(points), dtype=bool)
    slices = anatomy.slices().values()
    for tissue, where in zip(anatomy, slices, strict=True):
        inside[where] = tissue.kind is not TissueKind.SKIN
    for tissue, where in zip(anatomy, slices, strict=True):
        own = tissue.surface.vertices
        if tissue.kind is TissueKind.SKIN or not len(own):
            continue
        near = inside & ((points >= own.min(axis=0) - far) & (points <= own.max(axis=0) + far)).all(axis=1)
        near[where] = False
        tree = cKDTree(points[near], balanced_tree=False, compact_nodes=False)  # quick to build
        apart = tree.query(own, distance_upper_bound=far)[0] if tree.n else np.full(len(own), np.inf)
        found[where] = np.where(np.isfinite(apart), apart, np.nan)
    return SceneField("gap", "mm", 0.0, far, found)


def lengthwise_stretch(rest: Anatomy, posed: Anatomy) -> SceneField:
    """How many times as long lines on the surface of muscles became that ran along their longest axis at rest.

    At each vertex the mean over the triangles around it, by their area at rest; NaN where none of them runs along the
    axis, as at the ends of a muscle, and in all other tissues. It stands for the stretch of fibres where these run
    lengthwise.

    Parameters
    ----------
    rest, posed : Anatomy
        The same triangles.
    """
    found = np.full(len(rest.vertices()), np.nan)
    for tissue, where in zip(rest, rest.slices().values(), strict=True):
        if tissue.kind is TissueKind.MUSCLE and len(tissue.surface.faces):
            found[where] = _stretch_of(tissue.surface, posed[tissue.name].surface.vertices)
    return SceneField(STRETCH, "", *STRETCH_RANGE, found)


def _stretch_of(surface: TriMesh, moved: Points) -> Float:
    corners, after = surface.vertices[surface.faces], moved[surface.faces]
    axis = principal_axis(surface.vertices)
    edges, edges_after = (c[:, 1:] - c[:, :1] for c in (corners, after))
    normals = np.cross(edges[:, 0], edges[:, 1])
    doubled = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(doubled > 0, doubled, 1.0)[:, None]
    lines = axis - (normals @ axis)[:, None] * normals
    lengths = np.linalg.norm(lines, axis=1)
    sizes = (edges**2).sum(axis=2).max(axis=1)
    runs = (doubled > SLIVER * sizes) & (lengths >= LEAST_LENGTHWISE)
    # a line l in the triangle's plane is x e + y f of its edges e and f, with x and y by areas; then the edges' images
    e, f = edges[:, 0], edges[:, 1]
    spans = np.stack([np.cross(lines, f), np.cross(e, lines)], axis=1)
    shares = np.einsum("tik,tk->ti", spans, normals) / np.where(runs, doubled, 1.0)[:, None]
    stretched = np.linalg.norm(np.einsum("ti,tik->tk", shares, edges_after), axis=1) / np.where(runs, lengths, 1.0)
    weights = np.where(runs, doubled, 0.0)
    rows = surface.faces.ravel()
    total = np.bincount(rows, np.repeat(weights, 3), minlength=len(moved))
    summed = np.bincount(rows, np.repeat(weights * stretched, 3), minlength=len(moved))
    return np.where(total > 0, summed / np.where(total > 0, total, 1.0), np.nan)


def _contact(outcome: Outcome) -> tuple[SceneMark, ...]:
    """Vertices of bones, at rest, nearer to a vertex of another bone than the contact zone of the report is wide."""
    if outcome.side.bones is None or not outcome.side.bones.contact_zone_mm > 0:
        return ()
    zone = outcome.side.bones.contact_zone_mm
    bones = [(bone.name, cKDTree(bone.surface.vertices)) for bone in outcome.rest.of_kind(TissueKind.BONE)]
    marks = []
    for (one, a), (other, b) in combinations(bones, 2):
        near = [_vertices_near(b, a, zone), _vertices_near(a, b, zone)]
        if len(near[0]):
            title = f"bones within the contact zone of {zone:.3g} mm"
            marks.append(SceneMark("contact zone", title, (one, other), np.concatenate(near)))
    return tuple(marks)


def _vertices_near(of: cKDTree, other: cKDTree, far: float) -> Points:
    """The places of one tree that are nearer than ``far`` to some of another, mm."""
    own: Points = of.data
    boxed = own[((own >= other.mins - far) & (own <= other.maxes + far)).all(axis=1)]
    near: Points = boxed[np.isfinite(other.query(boxed, distance_upper_bound=far)[0])]
    return near


def _marks(outcome: Outcome) -> tuple[tuple[SceneMark, ...], list[str]]:
    """What is wrong in a state, the worst of each kind, and how many places of each kind are not drawn."""
    drawn: list[SceneMark] = []
    missing: list[str] = []
    for kind, found in (
        ("fold", _folds(outcome)),
        ("inverted tet", _inverted(outcome)),
        ("overlap", _overlaps(outcome)),
    ):
        marks = list(found)
        drawn += marks[:DRAWN_OF_A_KIND]
        if len(marks) > DRAWN_OF_A_KIND:
            missing.append(f"{len(marks) - DRAWN_OF_A_KIND} smaller ones of kind {kind} are not drawn")
    return tuple(drawn), missing


def _folds(outcome: Outcome) -> Iterator[SceneMark]:
    """Folded vertices of each tissue, most first."""
    folded = {
        tissue: np.flatnonzero(~(outcome.determinants[where] > 0))
        for tissue, where in zip(outcome.deformed, outcome.deformed.slices().values(), strict=True)
    }
    for tissue, rows in sorted(folded.items(), key=lambda item: (-len(item[1]), item[0].name)):
        if len(rows):
            title = f"{len(rows)} vertices where det J is not above 0"
            yield SceneMark("fold", title, (tissue.name,), tissue.surface.vertices[rows])


def _inverted(outcome: Outcome) -> Iterator[SceneMark]:
    """Inverted tetrahedra of each tissue, most first."""
    if outcome.tets is None or outcome.tet_vertices is None:
        return
    corners = outcome.tets.mesh.tets
    bad = np.flatnonzero(~(signed_volumes(outcome.tet_vertices, corners) > 0))
    owners = outcome.tets.tissue_of_tet[bad]
    counts = {int(owner): int((owners == owner).sum()) for owner in np.unique(owners)}
    for owner, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        own = corners[bad[owners == owner]]
        vertices = outcome.tet_vertices[own].reshape(-1, 3)
        faces = (_TET_FACES[None] + 4 * np.arange(len(own))[:, None, None]).reshape(-1, 3)
        yield SceneMark("inverted tet", f"{count} inverted tetrahedra", (outcome.tets.names[owner],), vertices, faces)


def _overlaps(outcome: Outcome) -> Iterator[SceneMark]:
    """What pairs share, the largest introduced first."""
    solids = outcome.solid.solids

    def rank(volume: float) -> float:
        return -math.inf if math.isnan(volume) else -volume

    pairs = sorted(outcome.side.overlaps.pairs, key=lambda p: (rank(p.introduced_mm3), rank(p.deformed_mm3)))
    for number, pair in enumerate(p for p in pairs if p.deformed_mm3 > ROUNDING_MM3):
        if pair.a not in solids or pair.b not in solids:
            continue
        title = f"{pair.deformed_mm3:.4g} mm³ shared, {pair.introduced_mm3:.4g} mm³ of it introduced"
        if number >= DRAWN_OF_A_KIND:
            yield SceneMark("overlap", title, (pair.a, pair.b), _NO_PLACE)
            continue
        shared = overlap_mesh(solids[pair.a], solids[pair.b])
        if len(shared.faces):
            yield SceneMark("overlap", title, (pair.a, pair.b), shared.vertices, shared.faces)


_NO_PLACE: Float = np.zeros((0, 3))
