"""Studies under attack: killed, on a cluster, as an array; in the end the bytes of a serial run but for times.

``python tests/study_campaign.py --subjects 24`` makes subjects of the built-in limb, each with its own pose, and
runs them

- ``killed``: with two workers; the main process is killed three times and started again, then a worker twice;
- ``array``: by the lines of the SLURM script, one task after the other, some of them twice;
- ``cluster``: on a local Dask cluster of one worker and of two, and of two of which one is killed twice;
- ``many``: 500 tiny subjects in this process, for what a subject costs beyond its work, and for memory.

It prints a line for each and gives exit code 1 where a case is missing or differs from the serial run, or where a
number is not kept. Two workers are compared with one in wall time, which tells nothing while the machine has other
work, and in CPU time: that of the one worker over that of the busier of the two is what they gain on a machine of
their own.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from studies import contents_but_for_times, write_limb_study, write_study

from musclefit.io.case_folders import MISSING
from musclefit.progress import Silent
from musclefit.workflows.batch import batch, slurm
from musclefit.workflows.collect import collect

SPEED_UP, OVERHEAD_S, GROWTH = 1.8, 0.2, 1.05
"""Two workers over one; CPU seconds of a subject beyond its work; memory at the end over that after a tenth."""

COMPLETED = (0, 1)
"""Exit codes of a study that ran to its end: all passed, or some broke their limits."""

PATIENCE_S = 7200.0


@dataclass(frozen=True)
class Serial:
    """A study, the number of its cases, and what one process makes of it."""

    study: Path
    cases: int
    contents: dict[str, bytes]


def made_serially(study: Path) -> Serial:
    """Run a study in this process."""
    out = study.parent / "serial"
    cohort = batch(study, out=out, progress=Silent())
    return Serial(study, len(cohort.outcomes), contents_but_for_times(out))


def problems(serial: Serial, out: Path) -> list[str]:
    """What a study made otherwise lacks, or has in other bytes than the serial run."""
    missing = [f"{o.name} is missing" for o in collect(out).outcomes if o.status == MISSING]
    got = contents_but_for_times(out)
    names = sorted(got.keys() | serial.contents.keys())
    return missing + [f"{name} differs" for name in names if got.get(name) != serial.contents.get(name)]


def killed(serial: Serial, *, mains: int = 3, workers: int = 2) -> list[str]:
    """Kill the main process some times and start it again, then a worker some times."""
    out = serial.study.parent / "killed"
    moments = [round((k + 1) * serial.cases / (mains + workers + 1)) for k in range(mains + workers)]
    for number in moments[:mains]:
        with _started(serial.study, out, "--workers", "2") as main:
            _wait_for(out, number, main)
            main.send_signal(signal.SIGKILL)
    with _started(serial.study, out, "--workers", "2") as main:
        for number in moments[mains:]:
            _wait_for(out, number, main)
            _a_worker_of(main).kill()
        code = main.wait()
    return problems(serial, out) + ([] if code in COMPLETED else [f"exit code {code}"])


def array(serial: Serial) -> list[str]:
    """Run the lines of the script, as the tasks of an array would, and two of them again."""
    out = serial.study.parent / "an array's folder"
    script = slurm(serial.study, out=out)
    found = []
    if f"#SBATCH --array=1-{serial.cases}\n" not in script.read_text(encoding="utf-8"):
        found.append("the array has another number of tasks")
    with tempfile.TemporaryDirectory() as place:
        command = Path(place) / "musclefit"
        command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m musclefit "$@"\n', encoding="utf-8")
        command.chmod(0o755)
        environment = os.environ | {"PATH": f"{place}:{os.environ['PATH']}"}
        for task in [*range(1, serial.cases + 1), 2, 1]:
            done = subprocess.run(
                ["bash", script], env=environment | {"SLURM_ARRAY_TASK_ID": str(task)}, cwd=place, check=False
            )
            if done.returncode not in COMPLETED:
                found.append(f"task {task}: exit code {done.returncode}")
    collect(out)
    return found + problems(serial, out)


@dataclass(frozen=True)
class OnCluster:
    """What a study took on a cluster: wall seconds, and CPU seconds of each worker."""

    wall_s: float
    worker_cpu_s: tuple[float, ...]
    problems: list[str]


def on_cluster(serial: Serial, *, workers: int, kills: int = 0) -> OnCluster:
    """Run a study on a local Dask cluster of so many workers, and kill one of them some times."""
    from distributed import LocalCluster

    out = serial.study.parent / f"cluster-{workers}-{kills}"
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        start = time.monotonic()
        with _started(serial.study, out, "--scheduler", cluster.scheduler_address) as main:
            for k in range(kills):
                _wait_for(out, round((k + 1) * serial.cases / (kills + 2)), main)
                os.kill(next(iter(cluster.workers.values())).process.pid, signal.SIGKILL)
            code = main.wait()
        wall_s = time.monotonic() - start
        cpu_s = tuple(_cpu_s(worker.process.pid) for worker in cluster.workers.values())
    return OnCluster(wall_s, cpu_s, problems(serial, out) + ([] if code in COMPLETED else [f"exit code {code}"]))


@dataclass(frozen=True)
class Many:
    """What many tiny subjects took: CPU seconds of each beyond its work; memory after a tenth and at the end."""

    overhead_s: float
    early_mb: float
    late_mb: float


def many(folder: Path, *, subjects: int) -> Many:
    """Run tiny subjects in this process."""
    study, out = write_study(folder, [round(1.0 + 25.0 * k / subjects, 3) for k in range(subjects)]), folder / "out"
    process, resident_mb = psutil.Process(), list[float]()

    class Watch(Silent):
        def stage(self, name: str) -> Any:
            if name != "cases":
                return super().stage(name)
            return nullcontext(lambda _: resident_mb.append(process.memory_info().rss / 1e6))

    start = time.process_time()
    batch(study, out=out, progress=Watch())
    all_s = time.process_time() - start
    work_s = sum(json.loads(path.read_text(encoding="utf-8"))["cpu_s"] for path in out.glob("subjects/*/*/cost.json"))
    return Many((all_s - work_s) / subjects, resident_mb[subjects // 10], resident_mb[-1])


@contextmanager
def _started(study: Path, out: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "musclefit", "batch", str(study), "--out", str(out), "--quiet", *options]
    with subprocess.Popen(command) as main:
        try:
            yield main
        finally:
            if main.poll() is None:
                main.kill()


def _wait_for(out: Path, cases: int, main: subprocess.Popen[bytes]) -> None:
    """Wait until so many cases are done."""
    deadline = time.monotonic() + PATIENCE_S
    while len(list(out.glob("subjects/*/*/case.json"))) < cases:
        if main.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"the study ended, or took too long, before {cases} cases were done")
        time.sleep(0.02)


def _a_worker_of(main: subprocess.Popen[bytes]) -> psutil.Process:
    children = psutil.Process(main.pid).children()
    return next(child for child in children if "spawn_main" in " ".join(child.cmdline()))


def _cpu_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)


def _told(name: str, found: list[str], more: str = "") -> bool:
    print(f"{name}: {'all cases are there, in the same bytes' if not found else 'FAILED'}{more}", flush=True)
    for problem in found[:10]:
        print(f"    {problem}", flush=True)
    return not found


def _cluster(serial: Serial) -> bool:
    one, two = on_cluster(serial, workers=1), on_cluster(serial, workers=2)
    gain = one.worker_cpu_s[0] / max(two.worker_cpu_s)
    said = (
        f"; wall {one.wall_s:.0f} s by one worker, {two.wall_s:.0f} s by two ({one.wall_s / two.wall_s:.2f} times); "
        f"CPU of a worker {one.worker_cpu_s[0]:.0f} s, of two {', '.join(f'{s:.0f} s' for s in two.worker_cpu_s)} "
        f"({gain:.2f} times)"
    )
    fine = _told("cluster", one.problems + two.problems, said) and max(gain, one.wall_s / two.wall_s) >= SPEED_UP
    return _told("cluster, a worker killed twice", on_cluster(serial, workers=2, kills=2).problems) and fine


def _many(home: Path, subjects: int) -> bool:
    found = many(home, subjects=subjects)
    print(
        f"many: {subjects} subjects, {found.overhead_s:.3f} CPU s each beyond its work; "
        f"{found.early_mb:.0f} MB after a tenth of them, {found.late_mb:.0f} MB at the end",
        flush=True,
    )
    return found.overhead_s <= OVERHEAD_S and found.late_mb <= GROWTH * found.early_mb


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=24, help="of the built-in limb")
    parser.add_argument("--tiny", type=int, default=500, help="tiny subjects")
    parser.add_argument("--part", default="", help="only this one: killed, array, cluster or many")
    given = parser.parse_args()
    fine = True
    with tempfile.TemporaryDirectory(prefix="musclefit-study-") as place:
        if given.part != "many":
            start = time.process_time()
            serial = made_serially(write_limb_study(Path(place), given.subjects))
            print(f"serial: {serial.cases} cases, {time.process_time() - start:.0f} CPU s", flush=True)
            parts: dict[str, Callable[[], bool]] = {
                "killed": lambda: _told("main process killed 3 times, workers twice", killed(serial)),
                "array": lambda: _told("lines of the array's script", array(serial)),
                "cluster": lambda: _cluster(serial),
            }
            for name, part in parts.items():
                fine = (given.part not in ("", name) or part()) and fine
        if given.part in ("", "many"):
            fine = _many(Path(place) / "many", given.tiny) and fine
    return int(not fine)


if __name__ == "__main__":
    sys.exit(main())
