"""What a proof comes upon goes back to the march: the place at rest, once more, and no longer than it helps."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from musclefit.certify.model import MapCertificate, StepCertificate
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.steps import CayleyStep, ExplicitStep
from musclefit.geometry.meshes import TriMesh
from musclefit.pipeline import proving
from musclefit.pipeline.proving import PROOFS, place_at_rest, proved
from musclefit.progress import Silent
from musclefit.vocabulary import Claim, StepKind

HANDLES = np.array([[x, y, z] for x in (0.0, 40.0) for y in (0.0, 40.0) for z in (0.0, 40.0)])


def two_steps(kind: type) -> Deformation:
    rng = np.random.default_rng(11)
    backend = RadialBackend("r3")
    fields = [backend.fit(HANDLES, rng.normal(size=HANDLES.shape)) for _ in range(2)]
    return Deformation(tuple(kind(field) for field in fields), (), Status.CONVERGED)


def undecided(
    number: int, place: np.ndarray, *, margin: float = -0.1, claim: Claim = Claim.UNDECIDED
) -> MapCertificate:
    """A proof that ended at one of two steps, at a place."""
    worst = tuple(float(x) for x in place)
    steps = tuple(
        StepCertificate(
            kind=StepKind.CAYLEY,
            claim=claim if k == number else Claim.CERTIFIED,
            margin=margin,
            sampled_margin=margin,
            worst_place=worst,
            boxes_examined=1,
            boxes_left=1,
            domain_low=worst,
            domain_high=worst,
            note="",
        )
        for k in range(number + 1)
    )
    return MapCertificate(claim, margin, number, worst, 1, 1, 1, steps)


@pytest.mark.parametrize("kind", [CayleyStep, ExplicitStep])
@pytest.mark.parametrize("number", [0, 1])
def test_the_place_is_told_at_rest(kind: type, number: int) -> None:
    """A Cayley step is judged at midpoints, an explicit one where the body stands before it."""
    whole = two_steps(kind)
    at_rest = np.array([[13.0, 22.0, 31.0]])
    stands = [at_rest, *(replace(whole, steps=whole.steps[:k])(at_rest) for k in (1, 2))]
    judged = 0.5 * (stands[number] + stands[number + 1]) if kind is CayleyStep else stands[number]
    found = place_at_rest(whole, undecided(number, judged[0]))
    assert found is not None
    np.testing.assert_allclose(found, at_rest, atol=1e-9)


def test_proofs_that_came_upon_no_such_place_name_none() -> None:
    whole, place = two_steps(CayleyStep), np.zeros(3)
    assert place_at_rest(whole, undecided(0, place, claim=Claim.CERTIFIED, margin=0.3)) is None
    assert place_at_rest(whole, undecided(0, place, margin=0.05)) is None  # the budget of boxes alone was spent
    assert place_at_rest(whole, undecided(0, place, margin=float("nan"))) is None


class March:
    """Stands for what is made of a job: every place that it is tested at brings another proof nearer."""

    def __init__(self, log: list[Any], proofs: list[MapCertificate], *, helps: bool = True) -> None:
        self.log, self.proofs, self.helps = log, proofs, helps
        self.deformed = SimpleNamespace(deformation=two_steps(CayleyStep))

    def tested_too(self, places: np.ndarray) -> March | None:
        self.log.append(places)
        return March(self.log, self.proofs[1:]) if self.helps else None


@pytest.mark.parametrize("needed", [0, 1, 3, PROOFS + 5])
def test_the_march_goes_back_until_it_is_proved_or_too_often(needed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    place = np.array([20.0, 20.0, 20.0])
    certified = undecided(1, place, claim=Claim.CERTIFIED, margin=0.3)
    log: list[Any] = []
    first = March(log, [undecided(1, place)] * needed + [certified])
    monkeypatch.setattr(proving, "_proof", lambda made, *_: made.proofs[0])
    made, proof = proved(first, None, progress=Silent())  # type: ignore[arg-type]
    assert len(log) == min(needed, PROOFS)
    assert proof is made.proofs[0]  # type: ignore[attr-defined]
    assert (proof.claim is Claim.CERTIFIED) == (needed <= PROOFS)


def test_a_march_that_nothing_shortens_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[Any] = []
    only = March(log, [undecided(0, np.full(3, 20.0))], helps=False)
    monkeypatch.setattr(proving, "_proof", lambda made, *_: made.proofs[0])
    made, _ = proved(only, None, progress=Silent())  # type: ignore[arg-type]
    assert made is only
    assert len(log) == 1


FAR = np.array([[900.0, 0.0, 0.0]])


@pytest.mark.parametrize(("reaches", "points", "asks"), [(True, FAR, 1), (False, FAR, 2), (False, FAR / 100.0, 1)])
def test_a_proof_is_asked_of_tissues_and_attached_points(
    reaches: bool, points: np.ndarray, asks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it does not reach points outside the skin, it is made of the body, and says what it leaves out."""
    asked: list[Any] = []

    def certified(*_: Any, tissues: Any, points: Any = None, **__: Any) -> MapCertificate:
        asked.append((tissues, points))
        claim = Claim.CERTIFIED if reaches or points is None else Claim.UNDECIDED
        return undecided(1, np.zeros(3), claim=claim, margin=0.3)

    monkeypatch.setattr(proving, "certify_map", certified)
    ball = trimesh.creation.icosphere(2, radius=50.0)
    surface = TriMesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64))
    skin, muscle = (SimpleNamespace(name=name, surface=surface) for name in ("skin", "muscle"))
    job = SimpleNamespace(
        rig=SimpleNamespace(certificate=SimpleNamespace(enabled=True, max_boxes=10)),
        anatomy=SimpleNamespace(skin=skin, tissues=(skin, muscle)),
        further=(SimpleNamespace(name="markers.trc", points=points),),
    )
    made = SimpleNamespace(deformed=SimpleNamespace(deformation=two_steps(CayleyStep)))
    proof = proving._proof(made, job, Silent())  # type: ignore[arg-type]
    assert proof is not None
    assert (proof.claim is Claim.CERTIFIED) == (reaches or asks == 2)
    assert proof.not_covered == (("markers.trc",) if asks == 2 else ())
    assert len(asked) == asks
    assert all(list(tissues) == [muscle.surface] for tissues, _ in asked)
    np.testing.assert_array_equal(asked[0][1], points)
