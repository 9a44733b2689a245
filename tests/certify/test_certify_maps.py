"""Attacks on the map certificate: certified maps are searched for folds, refuted ones must fold where it is said."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from attacks import (
    MARGINS,
    C,
    Configuration,
    E,
    attack,
    campaign,
    flow_step,
    grid,
    verify_fold,
    worst_margin,
)

from musclefit.certify.body_shells import box_shell, skin_shell
from musclefit.certify.domains import Hull
from musclefit.certify.maps import _Body, certify_map
from musclefit.certify.model import Fold
from musclefit.errors import InputError, MeshError, NotConvergedError
from musclefit.fields.kernels import KERNELS
from musclefit.fields.radial import RadialBackend, RadialField
from musclefit.geometry.meshes import TriMesh
from musclefit.progress import Tick
from musclefit.vocabulary import Claim, Proof, StepKind

SCALES = {
    "gaussian": 40.0,
    "inverse-multiquadric": 40.0,
    "wendland-c2": 90.0,
    "wendland-c4": 90.0,
    "isochoric-r3-mollified": 8.0,
    "isochoric-wendland-c6": 120.0,
}
CAMPAIGN = 22
"""Every kernel with both kinds of last step."""
FULL_CAMPAIGN = range(CAMPAIGN, 556)


def affine(linear: np.ndarray) -> RadialField:
    n = len(linear)
    zeros = np.zeros((1, n))
    return RadialField("gaussian", 1.0, zeros, zeros, np.zeros(n), np.asarray(linear, float), np.zeros(n), 0, 0)


def bump(weight: np.ndarray, *, scale: float = 20.0, at: Sequence[float] = (0.0, 0.0, 0.0)) -> RadialField:
    n = len(weight)
    return RadialField(
        "gaussian", scale, np.array([at]), np.array([weight]), np.zeros(n), np.zeros((n, n)), np.zeros(n), 0, 0
    )


def configuration(seed: int) -> Configuration:
    """Random radial fields in one to three steps; earlier steps of either kind."""
    rng = np.random.default_rng(seed)
    name = list(KERNELS)[seed % len(KERNELS)]
    last = (E, C)[(seed // len(KERNELS)) % 2]
    n = 2 if not KERNELS[name].isochoric and seed % 5 == 0 else 3
    points = rng.uniform(-50.0, 50.0, (40, n)) + rng.uniform(-300, 300, n)
    margin = MARGINS[int(rng.integers(len(MARGINS)))]
    backend = RadialBackend(name, SCALES.get(name, 1.0))
    steps: list[tuple[StepKind, RadialField]] = []
    moved = grid(points.min(axis=0), points.max(axis=0), 30 if n == 2 else 9)
    count = int(rng.integers(1, 4))
    for number in range(count):
        kind = last if number == count - 1 else (E, C)[int(rng.integers(2))]
        low, high = moved.min(axis=0), moved.max(axis=0)
        handles = rng.uniform(low, high, (int(rng.integers(5, 12)), n))
        field = backend.fit(handles, rng.normal(size=handles.shape))
        target = margin if number == count - 1 else float(rng.uniform(0.4, 0.8))
        field = field.scaled((1.0 - target) / (1.0 - worst_margin(kind, field, low, high, rng, beside=field.centres)))
        steps.append((kind, field))
        if number < count - 1:
            moved = flow_step(kind, field)(moved)
    return Configuration(steps, points, margin, steps[0][1].centres)


def test_a_campaign_of_random_maps_survives_attack() -> None:
    tally = campaign(map(configuration, range(CAMPAIGN)), max_boxes=20_000, optimise=False)
    assert tally.claims[Claim.CERTIFIED, True] >= 0.25 * CAMPAIGN
    assert tally.claims[Claim.REFUTED, False] >= 0.15 * CAMPAIGN
    assert tally.claims[Claim.REFUTED, True] == 0


@pytest.mark.slow
def test_the_full_campaign_of_random_maps_survives_attack(capsys: pytest.CaptureFixture[str]) -> None:
    tally = campaign(map(configuration, FULL_CAMPAIGN), max_boxes=60_000, optimise=True)
    with capsys.disabled():
        print(f"\nradial fields, {tally}")
    tally.require_a_sound_mixture(len(FULL_CAMPAIGN))


@pytest.mark.parametrize("kind", [E, C])
def test_the_attack_tells_true_claims_from_forged_ones(kind: StepKind) -> None:
    """A margin or a fold that is not there, or a fold that goes unsaid, does not survive: the campaign can fail."""
    steps = [(kind, bump(np.array([0.0, 14.0, 0.0]))), (kind, bump(np.array([9.0, 0.0, 0.0]), at=(5.0, 5.0, 0.0)))]
    config = Configuration(steps, BODY, 0.3, BODY)
    true = certify_map(steps, BODY)
    attack(config, true, np.random.default_rng(0), optimise=True)
    raised = replace(true, steps=tuple(replace(s, margin=s.sampled_margin + 1e-3) for s in true.steps))
    with pytest.raises(AssertionError):
        attack(config, raised, np.random.default_rng(0), optimise=True)
    with pytest.raises(AssertionError):
        verify_fold(steps, BODY, replace(true, fold=(Fold((0.0, 14.0, 0.0), 1, (0.0, 14.0, 0.0), -0.1),)))
    folded = [(kind, bump(np.array([0.0, 60.0, 0.0])))]
    silent = replace(true, steps=(replace(true.steps[0], margin=0.0),))
    with pytest.raises((AssertionError, NotConvergedError)):
        attack(Configuration(folded, BODY, 0.3, BODY), silent, np.random.default_rng(0), optimise=False)


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
    assert certificate.claim is Claim.CERTIFIED
    assert 0.5 * (1.0 - share) - 1e-9 <= certificate.margin <= 1.0 - share + 1e-9
    assert certificate.steps[0].sampled_margin >= 1.0 - share - 1e-9


@pytest.mark.parametrize("excess", [1.001, 1.01, 2.0])
def test_a_bump_beyond_its_fold_is_refuted_where_it_folds(excess: float) -> None:
    field = bump(np.array([0.0, excess * 20.0 * np.sqrt(np.e / 2.0), 0.0]))
    certificate = certify_map([(E, field)], BODY)
    assert certificate.claim is Claim.REFUTED
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
    assert near.claim is Claim.CERTIFIED
    np.testing.assert_allclose(near.margin, 0.01, rtol=0, atol=1e-9)
    linear = np.zeros((n, n))
    linear[0, 0] = -1.01
    beyond = certify_map([(E, affine(linear))], body)
    assert beyond.claim is Claim.REFUTED
    verify_fold([(E, affine(linear))], body, beyond)
    assert certify_map([(E, affine(-np.eye(n)))], body).claim is Claim.UNDECIDED  # collapse itself: det is 0


def test_rotation_costs_a_cayley_step_nothing() -> None:
    """A turn by 100 degrees is the skew field 2 tan(50 degrees) omega x."""
    skew = 2.0 * np.tan(np.radians(50.0)) * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    certificate = certify_map([(C, affine(skew))] * 3, sphere(40.0))
    assert certificate.claim is Claim.CERTIFIED
    np.testing.assert_allclose(certificate.margin, 1.0, rtol=0, atol=1e-9)


def test_a_large_explicit_rotation_is_certified_by_pairs() -> None:
    """Monotonicity is sufficient only: a turn by 120 degrees is one-to-one, as its singular values tell."""
    angle = np.radians(120.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    alone = certify_map([(E, affine(turn - np.eye(3)))], BODY, pairs_share=0.0)
    assert alone.claim is Claim.UNDECIDED
    assert "sufficient condition" in alone.steps[0].note
    np.testing.assert_allclose(alone.margin, np.cos(angle), rtol=0, atol=1e-9)
    certificate = certify_map([(E, affine(turn - np.eye(3)))], BODY)
    assert certificate.claim is Claim.CERTIFIED
    assert certificate.steps[0].proof is Proof.PAIRS
    np.testing.assert_allclose(certificate.margin, 1.0, rtol=0, atol=1e-9)


def test_a_fold_outside_the_skin_refutes_nothing() -> None:
    field = bump(np.array([0.0, 60.0, 0.0]), at=(100.0, 0.0, 0.0))
    inside = certify_map([(E, field)], sphere(40.0))
    assert inside.claim is Claim.CERTIFIED
    # Two spheres with the fold between them: their hull holds it, the body does not, nor a region around it.
    left, right = sphere(20.0, centre=(30.0, 0.0, 0.0)), sphere(20.0, centre=(170.0, 0.0, 0.0))
    both = TriMesh(
        np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + len(left.vertices)])
    )
    on_hull = certify_map([(E, field)], both, pairs_share=0.0)
    assert on_hull.claim is Claim.UNDECIDED
    assert not on_hull.fold
    assert certify_map([(E, field)], both).claim is Claim.CERTIFIED


@pytest.mark.parametrize("kind", [E, C])
def test_a_fold_in_a_later_step_is_traced_back_to_rest(kind: StepKind) -> None:
    first = affine(np.diag([0.4, -0.2, 0.1]))
    second = bump(np.array([0.0, 60.0 if kind is E else 90.0, 0.0]), at=(20.0, 5.0, 0.0))
    steps = [(kind, first), (kind, second)]
    skin = sphere(40.0)
    certificate = certify_map(steps, skin)
    assert certificate.claim is Claim.REFUTED
    assert [step.claim for step in certificate.steps] == [Claim.CERTIFIED, Claim.REFUTED]
    assert certificate.fold[0].step == certificate.worst_step == 1
    verify_fold(steps, skin.vertices, certificate)
    assert np.linalg.norm(certificate.fold[0].place) < 40.0


def test_steep_cayley_steps_fold_where_they_are_said_to() -> None:
    """id + D/2 folds at |w| = 2 s sqrt(e / 2), away from where id - D/2 does."""
    limit = 2.0 * 20.0 * np.sqrt(np.e / 2.0)
    below = certify_map([(C, bump(np.array([0.0, 0.99 * limit, 0.0])))], 3.0 * BODY)
    assert below.claim is Claim.CERTIFIED
    assert 0.005 - 1e-9 <= below.margin <= 0.01 + 1e-9
    steps = [(C, bump(np.array([0.0, 1.05 * limit, 0.0])))]
    above = certify_map(steps, 3.0 * BODY)
    assert above.claim is Claim.REFUTED
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
    assert certificate.claim is Claim.CERTIFIED
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
    assert certificate.claim is Claim.UNDECIDED
    assert certificate.boxes_examined <= 1500 == certificate.max_boxes
    assert certificate.boxes_left > 0
    assert "budget" in certificate.steps[0].note


def test_no_steps_are_the_identity() -> None:
    certificate = certify_map([], BODY)
    assert (certificate.claim, certificate.margin, certificate.steps) == (Claim.CERTIFIED, 1.0, ())


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
    with pytest.raises(MeshError, match="3 boundary edges, the first between vertices"):
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
    shell = skin_shell(skin, voxels=20).patches
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
        children, _ = shell.split()
        n = shell.centres.shape[1]
        assert len(children) == 2 ** (n - 1) * len(shell)
        points = shell.centres + rng.uniform(-1.0, 1.0, shell.centres.shape) * shell.halves
        apart = np.abs(points[:, None] - children.centres[None]) - children.halves[None]
        assert np.all(apart.max(axis=2).min(axis=1) <= 1e-9)
        np.testing.assert_allclose(children.radii().max(), 0.5 * shell.radii().max(), rtol=1e-9, atol=0)


# --- what is delivered outside the skin


def far_fold(kind: StepKind = E) -> list[tuple[StepKind, RadialField]]:
    """A step that folds within some 30 mm of a place 200 mm from the body, and nowhere else."""
    return [(kind, bump(np.array([0.0, 60.0 if kind is E else 90.0, 0.0]), at=(200.0, 0.0, 0.0)))]


@pytest.mark.parametrize("kind", [E, C])
@pytest.mark.parametrize("centre", [200.0, 45.0])
def test_a_tissue_outside_the_skin_is_part_of_the_claim(kind: StepKind, centre: float) -> None:
    """Far away, and partly within the skin, where the fold is not."""
    field = bump(np.array([0.0, 60.0 if kind is E else 49.0, 0.0]), at=(centre, 0.0, 0.0))
    skin, muscle = sphere(40.0), sphere(30.0, centre=(centre, 0.0, 0.0))
    certificate = certify_map([(kind, field)], skin, tissues=[muscle])
    assert certificate.claim is Claim.REFUTED
    verify_fold([(kind, field)], np.concatenate([skin.vertices, muscle.vertices]), certificate)
    assert np.linalg.norm(np.array(certificate.fold[0].place) - (centre, 0.0, 0.0)) < 30.0


@pytest.mark.parametrize("kind", [E, C])
def test_a_single_point_outside_the_skin_is_part_of_the_claim(kind: StepKind) -> None:
    steps, skin = far_fold(kind), sphere(40.0)
    assert certify_map(steps, skin).claim is Claim.CERTIFIED
    folded = np.array([[200.0, 20.0 / np.sqrt(2.0), 0.0]])
    certificate = certify_map(steps, skin, points=folded)
    assert certificate.claim is not Claim.CERTIFIED
    if kind is E:
        assert certificate.claim is Claim.REFUTED
        assert certificate.fold[0].place == tuple(folded[0])
    inside = certify_map(steps, skin, points=skin.vertices[::40] * 0.5)
    assert inside.claim is Claim.CERTIFIED
    assert inside.steps[0].domain_high == certify_map(steps, skin).steps[0].domain_high


def test_the_domain_holds_tissues_and_points_outside_through_every_step() -> None:
    rng = np.random.default_rng(8)
    skin, muscle = sphere(40.0), sphere(12.0, centre=(70.0, 10.0, 0.0))
    single = rng.uniform(-90.0, 90.0, (20, 3))
    everything = np.concatenate([skin.vertices, muscle.vertices, single])
    handles = rng.uniform(-90.0, 90.0, (10, 3))
    steps = [(kind, RadialBackend("r3").fit(handles, 2.0 * rng.normal(size=handles.shape))) for kind in (C, E, C)]
    certificate = certify_map(steps, skin, tissues=[muscle], points=single)
    assert certificate.claim is Claim.CERTIFIED
    moved = everything
    for (kind, field), step in zip(steps, certificate.steps, strict=True):
        after = flow_step(kind, field)(moved)
        judged = moved if kind is E else 0.5 * (moved + after)
        assert np.all(judged >= np.array(step.domain_low))
        assert np.all(judged <= np.array(step.domain_high))
        moved = after


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_fold_is_claimed_of_points_inside_only_however_far_from_the_origin(offset: float) -> None:
    """A body of 1.3 mm: places beside it once counted as inside, since winding numbers lost all digits."""
    at = offset + np.array([0.0, 1.9, 0.0])
    field = bump(np.array([0.0, 1.5, 0.0]), scale=0.3, at=at)
    left = sphere(0.65, centre=offset + np.zeros(3))
    right = sphere(0.65, centre=offset + np.array([0.0, 3.8, 0.0]))
    both = TriMesh(
        np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + len(left.vertices)])
    )
    assert certify_map([(E, field)], both).claim is not Claim.REFUTED
    within = certify_map([(E, bump(np.array([0.0, 1.5, 0.0]), scale=0.3, at=offset + np.zeros(3)))], both)
    assert within.claim is Claim.REFUTED
    assert np.linalg.norm(np.array(within.fold[0].place) - offset) < 0.65


def test_boxes_inside_a_shell_are_told_from_those_that_reach_out_of_it() -> None:
    skin = sphere(33.0, centre=(5.0, -7.0, 100.0))
    shell = skin_shell(skin, voxels=20)
    assert shell.holds(skin.vertices, skin.vertices).all()
    rng = np.random.default_rng(1)
    low = np.array([5.0, -7.0, 100.0]) + rng.uniform(-50.0, 50.0, (500, 3))
    high = low + rng.uniform(0.0, 20.0, (500, 3))
    held = shell.holds(low, high)
    steps = np.linspace(0.0, 1.0, 9)
    for box in range(500):
        samples = low[box] + np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3) * (high - low)[box]
        cells = np.floor((samples - shell.low) / shell.edge).astype(int)
        known = ((cells >= 0) & (cells < shell.outside.shape)).all(axis=1)
        out = ~known.all() or shell.outside[tuple(cells[known].T)].any()
        assert held[box] == (not out)
    assert 0.05 < held.mean() < 0.95


# --- fields beyond all numbers, reasons, branches


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kind", [E, C])
@pytest.mark.parametrize("size", [1e100, 1e154, 1e200, 1e300, np.inf, np.nan])
def test_fields_beyond_all_numbers_are_undecided(kind: StepKind, size: float) -> None:
    certificate = certify_map([(kind, bump(np.array([0.0, size, 0.0])))] * 2, BODY, max_boxes=5000)
    assert certificate.claim is not Claim.CERTIFIED
    assert certificate.claim is Claim.REFUTED or certificate.steps[-1].note


def test_the_reason_of_an_open_claim_is_the_true_one() -> None:
    short = certify_map([(E, bump(np.array([0.0, 23.0, 0.0])))], BODY, max_boxes=1500)
    assert "the budget of boxes is spent" in short.steps[0].note
    collapse = certify_map([(E, affine(-np.eye(3)))], BODY)
    assert collapse.claim is Claim.UNDECIDED
    assert collapse.boxes_examined < collapse.max_boxes
    assert "budget" not in collapse.steps[0].note


def test_midpoints_of_pieces_count_only_in_the_hull_of_their_step() -> None:
    """The hull that a step was proved on holds whole balls, or the piece has no proved image."""
    hull = Hull.around(np.zeros((1, 3)), np.array([10.0]))
    centres = np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [9.5, 0.0, 0.0], [6.5, 6.5, 6.5]])
    assert hull.holds_balls(centres, np.ones(4)).tolist() == [True, True, False, False]
    body = _Body.of(BODY, voxels=40, tissues=(), points=None)
    field = bump(np.array([0.0, 5.0, 0.0]))
    midpoints = body.midpoints(field)
    elsewhere = Hull.around(np.full((1, 3), 500.0), np.ones(1))
    body.move(C, field, midpoints, elsewhere)
    assert np.isinf(body._carried(body.patches).radii).all()
