"""Studies under attack, small; ``python tests/study_campaign.py`` does the same to many subjects."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from studies import write_study
from study_campaign import OVERHEAD_S, Serial, array, killed, made_serially, many, on_cluster

from musclefit.progress import Silent
from musclefit.workflows.batch import batch
from musclefit.workflows.collect import collect


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> Serial:
    return made_serially(write_study(tmp_path_factory.mktemp("study"), [2.0, 5.0, 400.0, 8.0]))


def test_a_killed_study_goes_on_and_makes_the_same(serial: Serial) -> None:
    assert killed(serial, mains=1, workers=0) == []


@pytest.mark.slow
def test_an_array_makes_the_same(serial: Serial) -> None:
    assert array(serial) == []


@pytest.mark.slow
def test_a_cluster_makes_the_same_though_a_worker_is_killed(serial: Serial) -> None:
    assert on_cluster(serial, workers=2, kills=1).problems == []


def test_a_subject_costs_little_beyond_its_work(tmp_path: Path) -> None:
    assert many(tmp_path, subjects=10).overhead_s <= OVERHEAD_S


@pytest.mark.slow
def test_a_case_that_kills_its_process_is_told_and_the_others_are_made(tmp_path: Path) -> None:
    study = write_study(tmp_path, [2.0, 5.0, 8.0])
    script = (
        "import os, sys\n"
        "from musclefit.workflows import batch_tasks\n"
        "make = batch_tasks._made\n"
        "def killed(study, case, result, sizes):\n"
        "    if case.subject == 's01':\n"
        "        os._exit(9)\n"
        "    return make(study, case, result, sizes)\n"
        "batch_tasks._made = killed\n"
        "if __name__ == '__main__':\n"
        "    from musclefit.workflows.batch import batch\n"
        "    batch(sys.argv[1], out=sys.argv[2], workers=2)\n"
    )
    (tmp_path / "main.py").write_text(script, encoding="utf-8")
    subprocess.run([sys.executable, tmp_path / "main.py", study, tmp_path / "out"], check=True)
    outcomes = collect(tmp_path / "out").outcomes
    assert [outcome.status for outcome in outcomes] == ["passed", "broke off", "passed"]
    assert "ended 3 times without a word" in outcomes[1].reason
    assert not batch(study, out=tmp_path / "out", progress=Silent()).outcomes[1].reason, "what broke off is tried again"
