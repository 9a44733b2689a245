"""Attacks on the map certificate: certified maps are searched for folds, refuted ones must fold where it is said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize

from musclefit.certify.maps import certify_map
from musclefit.certify.model import MapCertificate
from musclefit.certify.shells import box_shell, skin_shell
from musclefit.errors import InputError, MeshError
from musclefit.fields.kernels import KERNELS
from musclefit.fields.rbf import RadialBackend, RadialField
from musclefit.flow.steps import CayleyStep, ExplicitStep, Step
from musclefit.geometry.meshes import TriMesh
from musclefit.progress import Tick
from musclefit.rig.model import StepKind
from musclefit.validate.model import MapClaim

E, C = StepKind.EXPLICIT, StepKind.CAYLEY
Steps = Sequence[tuple[StepKind, RadialField]]
SCALES = {
    "gaussian": 40.0,
    "inverse-multiquadric": 40.0,
    "wendland-c2": 90.0,
    "wendland-c4": 90.0,
    "isochoric-r3-mollified": 8.0,
    "isochoric-wendland-c6": 120.0,
}
CAMPAIGN = 60
FULL_CAMPAIGN = 520
MARGINS = (0.5, 0.2, 0.05, 0.01, 0.003, -0.003, -0.01, -0.1, -0.5, -2.0)
"""Sampled margins that the configurations are scaled to: on both sides of the limit, some within 1 % of it."""


def flow_step(kind: StepKind, field: RadialField) -> Step:
    return CayleyStep(field) if kind is C else ExplicitStep(field)


def margins(kind: StepKind, gradients: np.ndarray) -> np.ndarray:
    values = np.linalg.eigvalsh(0.5 * (gradients + gradients.swapaxes(1, 2)))
    return 1.0 + values[:, 0] if kind is E else 1.0 - 0.5 * np.abs(values).max(axis=1)


def affine(linear: np.ndarray) -> RadialField:
    n = len(linear)
    zeros = np.zeros((1, n))
    return RadialField("gaussian", 1.0, zeros, zeros, np.zeros(n), np.asarray(linear, float), np.zeros(n), 0, 0)


def bump(weight: np.ndarray, *, scale: float = 20.0, at: Sequence[float] = (0.0, 0.0, 0.0)) -> RadialField:
    n = len(weight)
    return RadialField(
        "gaussian", scale, np.array([at]), np.array([weight]), np.zeros(n), np.zeros((n, n)), np.zeros(n), 0, 0
    )


def grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
    return np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)


def descended(
    judged: Callable[[np.ndarray], np.ndarray], start: np.ndarray, low: np.ndarray, high: np.ndarray
) -> float:
    """The smallest value that a pattern search of all starts at once finds in the box."""
    n = start.shape[1]
    moves = np.concatenate([np.eye(n), -np.eye(n)])
    here, value = start.copy(), judged(start)
    strides = np.full(len(start), 0.1 * float((high - low).max()))
    for _ in range(18):
        tried = np.clip(here[:, None] + strides[:, None, None] * moves, low, high)
        found = judged(tried.reshape(-1, n)).reshape(len(here), -1)
        best = np.argmin(found, axis=1)
        rows = np.arange(len(here))
        better = found[rows, best] < value
        here[better], value[better] = tried[rows, best][better], found[rows, best][better]
        strides[~better] *= 0.4
    return float(value.min())


def worst_margin(
    kind: StepKind, field: RadialField, low: np.ndarray, high: np.ndarray, rng: np.random.Generator
) -> float:
    """Smallest margin in a box, sampled densely and beside the handles, the worst refined by optimisation."""
    n = len(low)
    near = field.centres[:, None] + rng.normal(size=(len(field.centres), 40, n)) * 10.0 ** rng.uniform(
        -7, 1, (1, 40, 1)
    )
    near = near.reshape(-1, n)
    near = near[((near >= low) & (near <= high)).all(axis=1)]
    places = np.concatenate([rng.uniform(low, high, (3000, n)), grid(low, high, 60 if n == 2 else 14), near])
    found = margins(kind, field.gradient(places))
    start = places[np.argsort(found)[:12]]
    return min(float(found.min()), descended(lambda x: margins(kind, field.gradient(x)), start, low, high))


def configuration(seed: int) -> tuple[list[tuple[StepKind, RadialField]], np.ndarray, float]:
    """Random steps, the points whose box is the body, and the margin that the last step was scaled to."""
    rng = np.random.default_rng(seed)
    name = list(KERNELS)[seed % len(KERNELS)]
    kind = (E, C)[(seed // len(KERNELS)) % 2]
    n = 2 if not KERNELS[name].isochoric and seed % 5 == 0 else 3
    points = rng.uniform(-50.0, 50.0, (40, n)) + rng.uniform(-300, 300, n)
    margin = MARGINS[int(rng.integers(len(MARGINS)))]
    backend = RadialBackend(name, SCALES.get(name, 1.0))
    steps: list[tuple[StepKind, RadialField]] = []
    moved = grid(points.min(axis=0), points.max(axis=0), 30 if n == 2 else 9)
    count = int(rng.integers(1, 4))
    for number in range(count):
        low, high = moved.min(axis=0), moved.max(axis=0)
        handles = rng.uniform(low, high, (int(rng.integers(5, 12)), n))
        field = backend.fit(handles, rng.normal(size=handles.shape))
        target = margin if number == count - 1 else float(rng.uniform(0.4, 0.8))
        field = field.scaled((1.0 - target) / (1.0 - worst_margin(kind, field, low, high, rng)))
        steps.append((kind, field))
        if number < count - 1:
            moved = flow_step(kind, field)(moved)
    return steps, points, margin


def attack(
    steps: Steps, points: np.ndarray, certificate: MapCertificate, rng: np.random.Generator, *, optimise: bool
) -> None:
    """Dense samples, the worst of them refined, and pairs of points driven to a common image."""
    n = points.shape[1]
    low, high = points.min(axis=0), points.max(axis=0)
    start = np.concatenate([rng.uniform(low, high, (2000, n)), grid(low, high, 50 if n == 2 else 11)])
    handles = steps[0][1].centres
    near = (handles[:, None] + rng.normal(size=(len(handles), 20, n)) * 10.0 ** rng.uniform(-6, 1)).reshape(-1, n)
    start = np.concatenate([start, np.clip(near, low, high)])
    moved = start
    assert len(certificate.steps) == len(steps)
    for number, ((kind, field), step) in enumerate(zip(steps, certificate.steps, strict=True)):
        maker = flow_step(kind, field)
        inside = moved if kind is E else 0.5 * (moved + maker(moved))
        assert np.all(inside >= np.array(step.domain_low) - 1e-9)
        assert np.all(inside <= np.array(step.domain_high) + 1e-9)
        found = margins(kind, field.gradient(inside))
        assert found.min() >= step.margin - 1e-9

        def judged(rest: np.ndarray, number: int = number) -> np.ndarray:
            place = rest
            for kind, field in steps[:number]:
                place = flow_step(kind, field)(place)
            kind, field = steps[number]
            if kind is C:
                place = 0.5 * (place + flow_step(kind, field)(place))
            return margins(kind, field.gradient(place))

        assert descended(judged, start[np.argsort(found)[:8]], low, high) >= step.margin - 1e-9
        if optimise:
            best = minimize(
                lambda x, judged=judged: judged(np.clip(x, low, high)[None])[0],
                start[np.argmin(found)],
                method="Nelder-Mead",
                options={"maxfev": 60},
            )
            assert best.fun >= step.margin - 1e-9
        assert np.linalg.det(maker.jacobian(moved)).min() > 0.0
        before, moved = moved, maker(moved)
        _attack_pairs(maker, kind, step.margin, before, rng)


def _attack_pairs(step: Step, kind: StepKind, margin: float, points: np.ndarray, rng: np.random.Generator) -> None:
    """No two points come closer than monotonicity allows: neighbours, far ones, and the worst found by optimisation."""
    n = points.shape[1]
    # For v between two midpoints, c = v.Gv/2 >= margin - 1 and k = |Gv|/2 the squared stretch of a Cayley step is
    # (1 + k² + 2c) / (1 + k² - 2c), smallest at k = |c|.
    least = margin if kind is E else margin / (2.0 - margin)
    pairs = points[rng.integers(len(points), size=(3000, 2))]
    middle = 0.5 * (pairs[:1500, 0] + pairs[:1500, 1])
    pairs[:1500, 1] = pairs[:1500, 0] + 1e-3 * (middle - pairs[:1500, 0])  # within the convex hull
    apart = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1)
    pairs, apart = pairs[apart > 1e-3], apart[apart > 1e-3]
    images = step(pairs.reshape(-1, n)).reshape(-1, 2, n)
    stretch = np.linalg.norm(images[:, 0] - images[:, 1], axis=1) / apart
    assert stretch.min() >= least - 1e-6
    # Drive the worst pairs together and around: both points stay on the line between the two.
    worst = pairs[np.argsort(stretch)[:20]]
    for _ in range(6):
        ends = np.sort(rng.uniform(0.0, 1.0, (len(worst), 2, 1)), axis=1)
        ends[:, 1] += 1e-3
        line = worst[:, :1] + np.minimum(ends, 1.0) * (worst[:, 1:] - worst[:, :1])
        distance = np.linalg.norm(line[:, 0] - line[:, 1], axis=1)
        images = step(line.reshape(-1, n)).reshape(-1, 2, n)
        shrunk = np.linalg.norm(images[:, 0] - images[:, 1], axis=1)
        assert np.all(shrunk >= least * distance - 1e-8)


def verify_fold(steps: Steps, points: np.ndarray, certificate: MapCertificate) -> None:
    """The counterexample, with the steps of `flow` and central differences: inside the body, and reversed there."""
    (fold,) = certificate.fold
    rest = np.array(fold.place)[None]
    assert np.all(rest >= points.min(axis=0))
    assert np.all(rest <= points.max(axis=0))
    place = rest
    for kind, field in steps[: fold.step]:
        place = flow_step(kind, field)(place)
    kind, field = steps[fold.step]
    there = np.array(fold.place_in_step)[None]
    if kind is C:  # a midpoint of the place, by the step's equation
        np.testing.assert_allclose(there - 0.5 * field.displacement(there), place, rtol=0, atol=1e-6)
    else:
        np.testing.assert_allclose(there, place, rtol=0, atol=1e-6)
    assert np.linalg.det(flow_step(kind, field).jacobian(place))[0] < 1e-9
    n = rest.shape[1]
    h = 1e-5
    ends = there + h * np.concatenate([np.eye(n), -np.eye(n)])
    values = field.displacement(ends)
    gradient = ((values[:n] - values[n:]) / (2.0 * h)).T
    eye = np.eye(n)
    if kind is E:
        determinant = np.linalg.det(eye + gradient)
    else:
        determinant = np.linalg.det(eye + 0.5 * gradient) * np.linalg.det(eye - 0.5 * gradient)
    assert determinant < 1e-6
    assert fold.determinant < 0.0
    assert determinant <= fold.determinant + 1e-5 * (1.0 + np.linalg.norm(gradient)) ** (2 * n)


def campaign(seeds: range, *, optimise: bool) -> Counter[tuple[MapClaim, bool]]:
    """Certify, attack, count claims by whether the critical margin is positive."""
    counts: Counter[tuple[MapClaim, bool]] = Counter()
    for seed in seeds:
        steps, points, margin = configuration(seed)
        certificate = certify_map(steps, points, max_boxes=60_000)
        counts[certificate.claim, margin > 0.0] += 1
        rng = np.random.default_rng(seed)
        if certificate.claim is MapClaim.CERTIFIED:
            # Later steps are scaled on a bounding box, which is wider than the domain that is to be proved.
            assert margin > 0.0 or len(steps) > 1
            assert certificate.margin > 0.0
            assert certificate.boxes_left == 0
            attack(steps, points, certificate, rng, optimise=optimise)
        elif certificate.claim is MapClaim.REFUTED:
            verify_fold(steps, points, certificate)
        else:
            assert certificate.steps[-1].note
            assert not certificate.fold
    return counts


def test_a_campaign_of_random_maps_survives_attack() -> None:
    counts = campaign(range(CAMPAIGN), optimise=False)
    assert counts[MapClaim.CERTIFIED, True] >= 0.25 * CAMPAIGN
    assert counts[MapClaim.REFUTED, False] >= 0.15 * CAMPAIGN
    assert counts[MapClaim.REFUTED, True] == 0


@pytest.mark.slow
def test_the_full_campaign_of_random_maps_survives_attack() -> None:
    counts = campaign(range(CAMPAIGN, CAMPAIGN + FULL_CAMPAIGN), optimise=True)
    assert counts[MapClaim.CERTIFIED, True] >= 0.25 * FULL_CAMPAIGN
    assert counts[MapClaim.REFUTED, False] >= 0.15 * FULL_CAMPAIGN


def sphere(radius: float, *, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> TriMesh:
    """A geodesic sphere with outward triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return TriMesh(np.asarray(mesh.vertices) + np.array(centre), np.asarray(mesh.faces, dtype=np.int64))


BODY = np.array([[-30.0, -30.0, -30.0], [30.0, 30.0, 30.0]])


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99, 0.999])
def test_a_bump_is_certified_up_to_its_fold(share: float) -> None:
    """D = w exp(-r²/s²) folds at |w| = s sqrt(e / 2): there det = 1 - |w| max |d exp(-r²/s²)/dr| = 0."""
    limit = 20.0 * np.sqrt(np.e / 2.0)
    certificate = certify_map([(E, bump(np.array([0.0, share * limit, 0.0])))], BODY)
    assert certificate.claim is MapClaim.CERTIFIED
    assert 0.5 * (1.0 - share) - 1e-9 <= certificate.margin <= 1.0 - share + 1e-9
    assert certificate.steps[0].sampled_margin >= 1.0 - share - 1e-9


@pytest.mark.parametrize("excess", [1.001, 1.01, 2.0])
def test_a_bump_beyond_its_fold_is_refuted_where_it_folds(excess: float) -> None:
    field = bump(np.array([0.0, excess * 20.0 * np.sqrt(np.e / 2.0), 0.0]))
    certificate = certify_map([(E, field)], BODY)
    assert certificate.claim is MapClaim.REFUTED
    verify_fold([(E, field)], BODY, certificate)
    np.testing.assert_allclose(certificate.fold[0].place, (0.0, 20.0 / np.sqrt(2.0), 0.0), rtol=0, atol=12.0)


def test_larger_shares_prove_more_of_the_margin_with_more_boxes() -> None:
    steps = [(E, bump(np.array([0.0, 12.0, 0.0])))]
    low, high = (certify_map(steps, BODY, margin_share=share) for share in (0.1, 0.95))
    assert low.margin < high.margin <= high.steps[0].sampled_margin
    assert high.margin >= 0.95 * high.steps[0].sampled_margin
    assert low.boxes_examined < high.boxes_examined


@pytest.mark.parametrize("n", [2, 3])
def test_linear_compression_is_certified_up_to_collapse(n: int) -> None:
    body = BODY[:, :n]
    near = certify_map([(E, affine(-0.99 * np.eye(n)))], body)
    assert near.claim is MapClaim.CERTIFIED
    np.testing.assert_allclose(near.margin, 0.01, rtol=0, atol=1e-9)
    linear = np.zeros((n, n))
    linear[0, 0] = -1.01
    beyond = certify_map([(E, affine(linear))], body)
    assert beyond.claim is MapClaim.REFUTED
    verify_fold([(E, affine(linear))], body, beyond)
    assert certify_map([(E, affine(-np.eye(n)))], body).claim is MapClaim.UNDECIDED  # collapse itself: det is 0


def test_rotation_costs_a_cayley_step_nothing() -> None:
    """A turn by 100 degrees is the skew field 2 tan(50 degrees) omega x."""
    skew = 2.0 * np.tan(np.radians(50.0)) * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    certificate = certify_map([(C, affine(skew))] * 3, sphere(40.0))
    assert certificate.claim is MapClaim.CERTIFIED
    np.testing.assert_allclose(certificate.margin, 1.0, rtol=0, atol=1e-9)


def test_a_large_explicit_rotation_is_undecided_not_refuted() -> None:
    """Monotonicity is sufficient only: a turn by 120 degrees is one-to-one, but nothing here proves it."""
    angle = np.radians(120.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    certificate = certify_map([(E, affine(turn - np.eye(3)))], BODY)
    assert certificate.claim is MapClaim.UNDECIDED
    assert "sufficient condition" in certificate.steps[0].note
    np.testing.assert_allclose(certificate.margin, np.cos(angle), rtol=0, atol=1e-9)


def test_a_fold_outside_the_skin_refutes_nothing() -> None:
    field = bump(np.array([0.0, 60.0, 0.0]), at=(100.0, 0.0, 0.0))
    inside = certify_map([(E, field)], sphere(40.0))
    assert inside.claim is MapClaim.CERTIFIED
    # Two spheres with the fold between them: their hull holds it, the body does not.
    left, right = sphere(20.0, centre=(30.0, 0.0, 0.0)), sphere(20.0, centre=(170.0, 0.0, 0.0))
    both = TriMesh(
        np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + len(left.vertices)])
    )
    between = certify_map([(E, field)], both)
    assert between.claim is MapClaim.UNDECIDED
    assert not between.fold


@pytest.mark.parametrize("kind", [E, C])
def test_a_fold_in_a_later_step_is_traced_back_to_rest(kind: StepKind) -> None:
    first = affine(np.diag([0.4, -0.2, 0.1]))
    second = bump(np.array([0.0, 60.0 if kind is E else 90.0, 0.0]), at=(20.0, 5.0, 0.0))
    steps = [(kind, first), (kind, second)]
    skin = sphere(40.0)
    certificate = certify_map(steps, skin)
    assert certificate.claim is MapClaim.REFUTED
    assert [step.claim for step in certificate.steps] == [MapClaim.CERTIFIED, MapClaim.REFUTED]
    assert certificate.fold[0].step == certificate.worst_step == 1
    verify_fold(steps, skin.vertices, certificate)
    assert np.linalg.norm(certificate.fold[0].place) < 40.0


def test_steep_cayley_steps_fold_where_they_are_said_to() -> None:
    """id + D/2 folds at |w| = 2 s sqrt(e / 2), away from where id - D/2 does."""
    limit = 2.0 * 20.0 * np.sqrt(np.e / 2.0)
    below = certify_map([(C, bump(np.array([0.0, 0.99 * limit, 0.0])))], 3.0 * BODY)
    assert below.claim is MapClaim.CERTIFIED
    assert 0.005 - 1e-9 <= below.margin <= 0.01 + 1e-9
    steps = [(C, bump(np.array([0.0, 1.05 * limit, 0.0])))]
    above = certify_map(steps, 3.0 * BODY)
    assert above.claim is MapClaim.REFUTED
    verify_fold(steps, 3.0 * BODY, above)


def test_the_domain_of_every_step_holds_the_moved_body() -> None:
    rng = np.random.default_rng(4)
    handles = rng.uniform(-50.0, 50.0, (12, 3))
    steps = []
    skin = sphere(45.0)
    inside = rng.normal(size=(20000, 3))
    inside *= 45.0 * rng.uniform(0.0, 1.0, (20000, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    for k in range(5):
        handles_next = handles + rng.normal(size=handles.shape) * 2.0
        kind = (C, E)[k % 2]
        at = handles if kind is E else 0.5 * (handles + handles_next)
        steps.append((kind, RadialBackend("isochoric-r3" if k < 3 else "r2logr").fit(at, handles_next - handles)))
        handles = handles_next
    certificate = certify_map(steps, skin)
    assert certificate.claim is MapClaim.CERTIFIED
    moved = np.concatenate([inside, skin.vertices])
    for (kind, field), step in zip(steps, certificate.steps, strict=True):
        after = flow_step(kind, field)(moved)
        judged = moved if kind is E else 0.5 * (moved + after)
        assert np.all(judged >= np.array(step.domain_low))
        assert np.all(judged <= np.array(step.domain_high))
        # and is not much wider
        assert np.all(np.array(step.domain_high) <= judged.max(axis=0) + 12.0)
        moved = after


def test_a_spent_budget_leaves_the_claim_open() -> None:
    field = bump(np.array([0.0, 23.0, 0.0]))
    certificate = certify_map([(E, field)], BODY, max_boxes=1500)
    assert certificate.claim is MapClaim.UNDECIDED
    assert certificate.boxes_examined <= 1500 == certificate.max_boxes
    assert certificate.boxes_left > 0
    assert "budget" in certificate.steps[0].note


def test_no_steps_are_the_identity() -> None:
    certificate = certify_map([], BODY)
    assert (certificate.claim, certificate.margin, certificate.steps) == (MapClaim.CERTIFIED, 1.0, ())


def test_progress_never_runs_back() -> None:
    class Watched:
        def __init__(self) -> None:
            self.seen: list[float] = []

        @contextmanager
        def stage(self, name: str) -> Iterator[Tick]:  # noqa: ARG002
            yield self.seen.append

    watched = Watched()
    certify_map([(E, affine(-0.1 * np.eye(3))), (E, bump(np.array([0.0, 60.0, 0.0])))], sphere(40.0), progress=watched)
    assert watched.seen == sorted(watched.seen)
    assert all(0.0 <= done <= 1.0 for done in watched.seen)


class _Unbounded:
    """A field with enclosed gradients, but values that nobody vouches for."""

    def gradient_bounds(self, centres: np.ndarray, half_widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((len(centres), 3, 3)), np.zeros_like(half_widths[:, 0])


def test_what_cannot_be_certified_is_named() -> None:
    whole = sphere(10.0)
    with pytest.raises(MeshError, match="3 open edges, the first between vertices"):
        certify_map([(E, affine(np.zeros((3, 3))))], TriMesh(whole.vertices, whole.faces[1:]))
    with pytest.raises(MeshError, match="no triangles"):
        certify_map([(E, affine(np.zeros((3, 3))))], TriMesh(whole.vertices, whole.faces[:0]))
    with pytest.raises(InputError, match=r"shape \(0, 3\)"):
        certify_map([], np.zeros((0, 3)))
    with pytest.raises(InputError, match="_Unbounded gives no displacement_bounds"):
        certify_map([(E, _Unbounded())] * 2, BODY)  # type: ignore[list-item]
    with pytest.raises(InputError, match="margin_share"):
        certify_map([], BODY, margin_share=1.0)


def test_a_shell_holds_its_skin_and_is_closed() -> None:
    """Every point of the skin is further from the shell than the standoff; the shell separates it from far away."""
    skin = sphere(33.0, centre=(5.0, -7.0, 100.0))
    shell = skin_shell(skin, voxels=20)
    edge = 2.0 * shell.halves.max()
    apart = np.abs(shell.centres[:, None] - skin.vertices[None]) - shell.halves[:, None]
    distance = np.linalg.norm(np.maximum(apart, 0.0), axis=2).min(axis=0)
    assert distance.min() >= 0.25 * edge - 1e-9
    assert distance.max() <= 4.0 * edge
    # Rays from inside cross an odd number of squares along each axis.
    axis_of = np.argmin(shell.halves, axis=1)
    for point in skin.vertices[::50] * [0.999, 1.001, 0.998]:
        for axis in range(3):
            across = [k for k in range(3) if k != axis]
            ahead = (axis_of == axis) & (shell.centres[:, axis] > point[axis])
            hit = (np.abs(shell.centres[:, across] - point[across]) <= shell.halves[:, across]).all(axis=1)
            assert np.sum(ahead & hit) % 2 == 1


def test_pieces_of_a_shell_are_covered_by_their_children() -> None:
    rng = np.random.default_rng(0)
    for shell in (box_shell(BODY), box_shell(BODY[:, :2])):
        children = shell.split()
        n = shell.centres.shape[1]
        assert len(children) == 2 ** (n - 1) * len(shell)
        points = shell.centres + rng.uniform(-1.0, 1.0, shell.centres.shape) * shell.halves
        apart = np.abs(points[:, None] - children.centres[None]) - children.halves[None]
        assert np.all(apart.max(axis=2).min(axis=1) <= 1e-9)
        np.testing.assert_allclose(children.radii().max(), 0.5 * shell.radii().max(), rtol=1e-9, atol=0)
