"""Studies under attack: processes killed, a cluster, an array; in the end the bytes of a serial run but for times."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from studies import contents_but_for_times, write_study

from musclefit.progress import Silent
from musclefit.workflows.batch import batch, slurm
from musclefit.workflows.collect import collect

SUBJECTS = 24
ANGLES = [round(2.0 + 1.5 * k, 1) for k in range(SUBJECTS)]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A study, and what one process makes of it."""
    home = tmp_path_factory.mktemp("study")
    study = write_study(home, ANGLES)
    assert batch(study, out=home / "serial", progress=Silent()).passed
    return study, contents_but_for_times(home / "serial")


def start(study: Path, out: Path, *options: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "musclefit", "batch", str(study), "--out", str(out), *options])


def done(out: Path) -> int:
    return len(list(out.glob("subjects/*/*/case.json")))


def wait_for(what: Callable[[], bool], main: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 600.0
    while not what():
        assert main.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)


def a_worker_of(main: subprocess.Popen[bytes]) -> psutil.Process:
    workers = [child for child in psutil.Process(main.pid).children() if "spawn_main" in " ".join(child.cmdline())]
    return workers[0]


def test_killed_workers_and_killed_main_processes_lose_nothing(serial: tuple[Path, dict[str, bytes]]) -> None:
    study, expected = serial
    out = study.parent / "killed"
    for number in (2, 6, 10):
        main = start(study, out, "--workers", "2", "--quiet")
        wait_for(lambda least=number: done(out) >= least, main)  # type: ignore[misc]
        main.send_signal(signal.SIGKILL)
        main.wait()
        time.sleep(1.0)
    main = start(study, out, "--workers", "2", "--quiet")
    for number in (13, 17):
        wait_for(lambda least=number: done(out) >= least, main)  # type: ignore[misc]
        a_worker_of(main).kill()
    assert main.wait() == 0
    assert contents_but_for_times(out) == expected


def test_a_case_that_kills_its_process_is_told_and_the_others_are_made(tmp_path: Path) -> None:
    study = write_study(tmp_path, ANGLES[:3])
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


def test_the_lines_of_the_array_script_make_the_same(serial: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    study, expected = serial
    out = study.parent / "an array's folder"
    script = slurm(study, out=out)
    text = script.read_text(encoding="utf-8")
    assert f"#SBATCH --array=1-{SUBJECTS}\n" in text
    command = tmp_path / "musclefit"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m musclefit "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    for task in [*range(1, SUBJECTS + 1), 3, 3]:  # tasks that are started again do no harm
        subprocess.run(["bash", script], env=environment | {"SLURM_ARRAY_TASK_ID": str(task)}, check=True, cwd=tmp_path)
    assert collect(out).passed
    assert contents_but_for_times(out) == expected


def test_a_cluster_of_two_workers_makes_the_same_though_one_is_killed_twice(
    serial: tuple[Path, dict[str, bytes]],
) -> None:
    from distributed import LocalCluster

    study, expected = serial
    out = study.parent / "cluster"
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        main = start(study, out, "--scheduler", cluster.scheduler_address, "--quiet")
        for number in (3, 9):
            wait_for(lambda least=number: done(out) >= least, main)  # type: ignore[misc]
            os.kill(next(iter(cluster.workers.values())).process.pid, signal.SIGKILL)
        assert main.wait() == 0
    assert contents_but_for_times(out) == expected


def test_five_hundred_subjects_cost_little_beyond_their_work_and_memory_stays_flat(tmp_path: Path) -> None:
    study, out = write_study(tmp_path, [round(1.0 + 0.05 * k, 2) for k in range(500)]), tmp_path / "out"
    process = psutil.Process()
    resident: list[float] = []

    class Watch(Silent):
        def stage(self, name: str):  # type: ignore[no-untyped-def]
            if name != "cases":
                return super().stage(name)
            from contextlib import nullcontext

            return nullcontext(lambda _: resident.append(process.memory_info().rss / 1e6))

    start_s = time.process_time()
    assert batch(study, out=out, progress=Watch()).passed
    all_s = time.process_time() - start_s
    work_s = sum(json.loads(path.read_text())["cpu_s"] for path in out.glob("subjects/*/*/cost.json"))
    memory = f"memory after 50: {resident[50]:.0f} MB, at the end {resident[-1]:.0f} MB"
    print(f"CPU: {all_s:.1f} s in all, {work_s:.1f} s of cases; {memory}")
    assert (all_s - work_s) / 500 <= 0.2
    assert resident[-1] <= 1.05 * resident[50]
