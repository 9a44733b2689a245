"""A path is marched anew, held closer to the bones, where a muscle would change its volume by more than it may.

What that gains is tested on a real forearm (`test_pipeline_ffd.py`); here, when it is tried and what is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

import musclefit
from musclefit.flow.deformation import Status
from musclefit.pipeline import refining
from musclefit.pipeline.refining import Made, _worst_volume_change, deform_finely
from musclefit.progress import Progress, Silent
from musclefit.rig.job import Job


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = write_tiny_rig(tmp_path_factory.mktemp("volumes") / "rig")
    drive_by_joints(rig)
    rig.write_text(rig.read_text(encoding="utf-8").replace('kernel = "r3"\n', ""), encoding="utf-8")
    return rig


@pytest.fixture(scope="module")
def plain(rig: Path) -> Made:
    return deform_finely(musclefit.read_rig(rig), progress=Silent())


Tried = Callable[[Sequence[float], Sequence[Status]], list[int | None]]


@pytest.fixture
def tried(plain: Made, monkeypatch: pytest.MonkeyPatch) -> Tried:
    """Marches that end with a status and whose worst muscle changes by some percent: what iterations are asked for."""

    def marches(changes: Sequence[float], statuses: Sequence[Status]) -> list[int | None]:
        asked: list[int | None] = []
        changed: dict[int, float] = {}

        def once(job: Job, *, progress: Progress) -> Made:
            number = len(asked)
            asked.append(job.rig.bones.iterations)
            deformation = replace(plain.deformed.deformation, status=statuses[number])
            made = replace(
                plain, deformed=replace(plain.deformed, deformation=deformation), carried=replace(plain.carried)
            )
            changed[id(made.carried)] = changes[number]
            kept.append(made)  # so that no other object takes its place
            return made

        kept: list[Made] = []
        monkeypatch.setattr(refining, "_deform_once", once)
        monkeypatch.setattr(refining, "_worst_volume_change", lambda carried: (changed[id(carried)], "muscle_flexor"))
        return asked

    return marches


ONE_PERCENT = "limits.muscle_volume_percent=1.0"
ENDED = (Status.CONVERGED,) * 3


@pytest.mark.parametrize(
    ("changes", "asked", "kept"),
    [
        ((0.9,), [None], 0),
        ((1.05, 0.6), [None, 30], 1),
        ((3.0, 2.0, 1.5), [None, 30, 60], 2),
        ((1.05, 1.2), [None, 30], 0),
        ((3.0, 2.0, 2.5), [None, 30, 60], 1),
    ],
)
def test_a_muscle_beyond_its_limit_has_the_field_held_closer_to_the_bones(
    rig: Path, tried: Tried, changes: tuple[float, ...], asked: list[int | None], kept: int
) -> None:
    found = tried(changes, ENDED)
    made = deform_finely(musclefit.read_rig(rig, overrides=(ONE_PERCENT,)), progress=Silent())
    assert found == asked
    assert made.returns == len(made.findings) == kept
    for finding, iterations, change in zip(made.findings, asked[1:], changes, strict=False):
        assert (finding.subject, finding.code) == ("muscle_flexor", "more-iterations")
        assert f"changed by {change:.3g} %, more than 1 %" in finding.message
        assert f"with {iterations} iterations" in finding.message


def test_a_march_that_does_not_end_is_not_taken(rig: Path, tried: Tried) -> None:
    found = tried((1.5, 0.1), (Status.CONVERGED, Status.STALLED))
    made = deform_finely(musclefit.read_rig(rig, overrides=(ONE_PERCENT,)), progress=Silent())
    assert found == [None, 30]
    assert (made.deformed.deformation.status, made.findings) == (Status.CONVERGED, ())


@pytest.mark.parametrize("override", ["bones.iterations=7", "limits.muscle_volume_percent=2"])
def test_what_a_rig_says_stays_as_it_is(rig: Path, tried: Tried, override: str) -> None:
    found = tried((1.5,), ENDED)
    made = deform_finely(musclefit.read_rig(rig, overrides=(ONE_PERCENT, override)), progress=Silent())
    assert len(found) == 1
    assert made.findings == ()


def test_the_worst_change_is_that_of_the_volumes(plain: Made) -> None:
    change, muscle = _worst_volume_change(plain.carried)
    before, after = (side[muscle].surface for side in (plain.carried.rest, plain.carried.deformed))
    volumes = [float(np.linalg.det(s.vertices[s.faces]).sum()) / 6.0 for s in (before, after)]
    assert change == pytest.approx(100.0 * abs(volumes[1] / volumes[0] - 1.0), rel=1e-6)
    assert 0.01 < change < 1.0


def test_what_was_given_up_is_said_of_what_a_proof_asks_for_later(plain: Made) -> None:
    later = replace(plain, returns=1, tested_too=lambda _: None)
    first = replace(plain, tested_too=lambda _: later)
    again = first.after(2, ()).tested_too(np.zeros((1, 3)))
    assert again is not None
    assert again.returns == 3
    assert again.tested_too(np.zeros((1, 3))) is None
