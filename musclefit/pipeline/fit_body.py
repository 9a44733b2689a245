"""A template's skin fitted to a scan: aligned, registered, and the map that its cage makes of it measured; no file."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from musclefit.errors import InputError, LandmarkError
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import Marching, Pace
from musclefit.flow.rules import rule_for
from musclefit.flow.steppers import HandleStepper, cayley_step
from musclefit.geometry.arrays import Bool, Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, nearest_places, smooth_normals
from musclefit.geometry.registration import FACING, REACHES, Scan, alignments, faces_out, mismatch, registered, scan_of
from musclefit.geometry.similarity import Similarity
from musclefit.geometry.surfaces.cages import cage_of
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.progress import Progress, Silent, Tick
from musclefit.rig.handles import StraightPath
from musclefit.vocabulary import StepKind, StepRule

KERNEL = "r"
"""Of the map that the cage drives: a scalar one, since the volume changes; as in the built-in rigs of bodies."""

LIKELY = 2.0
"""Alignments that leave so many times the distance of the best are tried too."""

TRIAL_STAGES, TRIAL_ROUNDS, TRIAL_SAMPLES, TRIAL_VERTICES = 4, 12, 1000, 200
"""Stages of the registration that a trial goes through, rounds of each, places that look, vertices of its cage."""

MOST_STEPS = 50
MEASURED = 20_000
"""Places on the scan that its distances are measured at."""


@dataclass(frozen=True, slots=True)
class Distances:
    """Of places spread by area from another surface, mm."""

    median_mm: float
    most_95_mm: float
    max_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class BodyFit:
    """A template's skin on a scan.

    Parameters
    ----------
    cage : TriMesh
        Where it is at rest.
    target : Points
        Where its vertices go, (n, 3) mm, in the template's frame.
    motion : Similarity
        From the template's frame to the scan's: rigid, for sizes stay in the targets.
    size : float
        How much larger the scan is than the template, as a whole.
    turned : bool
        Whether the scan was inside out.
    rival : float or None
        How much worse the template fits where the scan is laid in the second best way, as a ratio; None where only one
        way was likely. Near 1, only landmarks can tell.
    deformation : Deformation
        The map that the cage makes, in the template's frame.
    skin : TriMesh
        Where it takes the skin.
    scan : TriMesh
        In the template's frame.
    scan_distances, skin_distances : (v,) float64, mm
        Of the vertices of scan and skin from the other.
    from_scan, from_skin : Distances
        Of places on the scan from the skin, and of places on the skin that have a counterpart from the scan.
    unmatched : float
        Share of the scan's area that is not part of the skin: far from it, or facing another way.
    uncovered : float
        Share of the skin's area without counterpart on the scan: holes and what was not scanned.
    skin_covered : (v,) bool
        Which vertices of the skin have one.
    crossings : int
        Pairs of triangles of the target cage that cross.
    """

    cage: TriMesh
    target: Points
    motion: Similarity
    size: float
    turned: bool
    rival: float | None
    deformation: Deformation
    skin: TriMesh
    scan: TriMesh
    scan_distances: Float
    skin_distances: Float
    from_scan: Distances
    from_skin: Distances
    unmatched: float
    uncovered: float
    skin_covered: Bool
    crossings: int


def fit_body(
    skin: TriMesh,
    cage: TriMesh,
    scan: TriMesh,
    *,
    rng: np.random.Generator,
    landmarks: tuple[Points, Points] | None = None,
    progress: Progress | None = None,
) -> BodyFit:
    """Fit a template's skin to a scan of any triangles.

    Parameters
    ----------
    skin, cage : TriMesh
        Closed; the cage follows the skin.
    scan : TriMesh
        May have holes and parts that are no skin.
    rng : Generator
    landmarks : pair of (m, 3) float64, or None
        Places on the template and where they are on the scan, mm: three or more lay one on the other.
    progress : Progress, optional

    Raises
    ------
    InputError, LandmarkError
        A scan without area or of another size by far, or landmarks that lie on a line.
    """
    progress = progress or Silent()
    with progress.stage("align the scan") as tick:
        laid = _laid(skin, cage, scan_of(scan, rng=rng), landmarks, rng=rng, tick=tick)
    marks = None if landmarks is None else (landmarks[0], laid.motion.undone(landmarks[1]))
    with progress.stage("register") as tick:
        found = registered(skin, cage, laid.scan, rng=rng, landmarks=marks, told=tick)
    with progress.stage("march"):
        deformation = cage_map(cage, found.cage, skin).require()
    moved = skin.with_vertices(deformation(skin.vertices))
    with progress.stage("measure"):
        return _measured(cage, found.cage, laid, deformation, moved, rng=rng)


@dataclass(frozen=True, eq=False, slots=True)
class _Laid:
    """A scan in the template's frame, and how it came there."""

    scan: Scan
    motion: Similarity
    size: float
    turned: bool
    mismatch_mm: float = 0.0
    rival: float | None = None


def _laid(
    skin: TriMesh,
    cage: TriMesh,
    scan: Scan,
    landmarks: tuple[Points, Points] | None,
    *,
    rng: np.random.Generator,
    tick: Tick,
) -> _Laid:
    """The scan where the template is: by three landmarks or more, else as the template fits it best when it may bend.

    A body seen from behind is nearly a body, so that nearest places alone do not tell; the first stages of the
    registration do.
    """
    if landmarks is not None and len(landmarks[0]) >= 3:
        spread = np.linalg.svd(landmarks[0] - landmarks[0].mean(axis=0), compute_uv=False)
        if spread[1] < 1e-3 * spread[0]:
            raise LandmarkError(
                f"the {len(landmarks[0])} landmarks lie on a line, so they do not say how the scan is turned; add one "
                "beside it"
            )
        whole = Similarity.fitted(*landmarks)
        _require_likely(whole, skin, scan.surface)
        return _back(skin, scan, whole)
    found = alignments(skin, scan)
    _require_likely(found[0][0], skin, scan.surface)
    likely = [_back(skin, scan, whole) for whole, left in found if left < LIKELY * found[0][1] + 1e-9]
    if len(likely) == 1:
        return likely[0]
    reach = REACHES[TRIAL_STAGES] * float(np.linalg.norm(np.ptp(skin.vertices, axis=0)))
    coarse = cage if len(cage.vertices) <= TRIAL_VERTICES else cage_of(skin, vertices=TRIAL_VERTICES)
    tried = []
    for k, one in enumerate(likely):
        tick(k / len(likely))
        trial = registered(
            skin,
            coarse,
            one.scan.thinned(TRIAL_SAMPLES),
            rng=rng,
            stages=TRIAL_STAGES,
            rounds=TRIAL_ROUNDS,
            samples=TRIAL_SAMPLES,
        )
        tried.append(replace(one, mismatch_mm=mismatch(skin.with_vertices(trial.surface), one.scan, reach_mm=reach)))
    best, second = sorted(tried, key=lambda one: one.mismatch_mm)[:2]
    return replace(best, rival=second.mismatch_mm / max(best.mismatch_mm, 1e-12))


def _back(skin: TriMesh, scan: Scan, whole: Similarity) -> _Laid:
    """The scan laid by the rigid part of a similarity: sizes stay, and the template's middle goes where it takes it."""
    middle = skin.vertices.mean(axis=0)
    motion = Similarity(1.0, whole.rotation, whole(middle[None])[0] - whole.rotation @ middle)
    laid = scan.moved_back(motion)
    grown = Similarity(whole.scale, np.eye(3), (1.0 - whole.scale) * middle)
    turned = not faces_out(skin.with_vertices(grown(skin.vertices)), laid)
    return _Laid(laid.turned if turned else laid, motion, whole.scale, turned)


def _require_likely(whole: Similarity, skin: TriMesh, scan: TriMesh) -> None:
    if not 0.4 < whole.scale < 2.5:
        spans = (float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh in (skin, scan))
        template, other = spans
        raise InputError(
            f"the scan would be {whole.scale:.3g} times the template (they span {other:.4g} and {template:.4g} mm); "
            "likely wrong units: state those of the scan and of the template"
        )


def cage_map(cage: TriMesh, target: Points, skin: TriMesh) -> Deformation:
    """The map that a rig of this cage makes."""
    stepper = HandleStepper(StraightPath(cage.vertices, target), RadialBackend(KERNEL), cayley_step)
    rule = rule_for(StepKind.CAYLEY, StepRule.ROW_NORM)
    return (
        Marching.begun(stepper, rule=rule, tested=skin.vertices, pace=Pace(MOST_STEPS, 1)).marched(Silent()).deformation
    )


def _measured(
    cage: TriMesh,
    target: Points,
    laid: _Laid,
    deformation: Deformation,
    skin: TriMesh,
    *,
    rng: np.random.Generator,
) -> BodyFit:
    scan, spread = laid.scan, scan_of(laid.scan.surface, rng=rng, samples=MEASURED)
    reach = REACHES[-1] * float(np.linalg.norm(np.ptp(skin.vertices, axis=0)))
    near = nearest_places(spread.samples, skin)
    facing = np.einsum("ki,ki->k", spread.normals, smooth_normals(skin, near)) > FACING
    matched = facing & (near.distances < reach)
    own = scan_of(skin, rng=np.random.default_rng(0), samples=MEASURED)
    covered, distances = _covered(own.samples, own.normals, scan, reach)
    at_vertices, from_vertices = _covered(skin.vertices, own.vertex_normals, scan, reach)
    return BodyFit(
        cage=cage,
        target=target,
        motion=laid.motion,
        size=laid.size,
        turned=laid.turned,
        rival=laid.rival,
        deformation=deformation,
        skin=skin,
        scan=scan.surface,
        scan_distances=DistanceTree(skin)(scan.surface.vertices),
        skin_distances=from_vertices,
        from_scan=_distances(near.distances),
        from_skin=_distances(distances[covered] if covered.any() else distances),
        unmatched=float(1.0 - matched.mean()),
        uncovered=float(1.0 - covered.mean()),
        skin_covered=at_vertices,
        crossings=len(self_crossings(cage.with_vertices(target)).pairs),
    )


def _covered(points: Points, normals: Points, scan: Scan, reach: float) -> tuple[Bool, Float]:
    """Which points of the skin have a counterpart on the scan, and how far the scan is from each, mm."""
    near = scan.tree.places(points)
    facing = np.einsum("ki,ki->k", normals, scan.normals_at(near.faces)) > 0.0
    return np.asarray(facing & (near.distances < reach) & ~scan.border[near.faces]), near.distances


def _distances(lengths: Float) -> Distances:
    median, most = np.percentile(lengths, [50, 95])
    return Distances(float(median), float(most), float(lengths.max()))
