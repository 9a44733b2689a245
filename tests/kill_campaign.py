"""Commands killed at many moments and started again: each restart completes, keeps what was finished, leaves nothing.

``python tests/kill_campaign.py --moments 50 --seed 1`` kills ``run``, ``sequence``, ``tets`` (a run with tetrahedra)
and ``repair`` on a small limb with SIGKILL at moments spread over the time that each takes, and prints a line for each;
exit code 1 where a restart failed, a finished frame was made again, or something half-written was left.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tiny_rigs import drive_by_joints, write_tiny_rig

LEFT_OVER = (".partial-", ".former-", ".trial-", ".unfinished-")
FINISHED = (0, 1)
"""Exit codes of a command that completed: passed, or a limit failed."""


@dataclass(frozen=True)
class Command:
    """A command line that writes into ``out``, below the folder that it is given, and what makes its input."""

    name: str
    prepare: Callable[[Path], list[str]]


def _rig(folder: Path) -> Path:
    return write_tiny_rig(folder)


def _run(folder: Path) -> list[str]:
    return ["run", str(_rig(folder)), "--out", str(folder / "out"), "--no-pictures", "--quiet"]


def _tets(folder: Path) -> list[str]:
    return [*_run(folder), "--tets"]


def _repair(folder: Path) -> list[str]:
    rig = _rig(folder)
    return ["repair", str(rig.parent / "anatomy"), str(folder / "out"), "--resolve", "priority", "--quiet"]


def _sequence(folder: Path) -> list[str]:
    rig = _rig(folder)
    drive_by_joints(rig)
    motion = rig.parent / "motion.csv"
    motion.write_text("time_s,elbow_deg\n0,0\n1,10\n2,20\n")
    return ["sequence", str(rig), str(motion), "--out", str(folder / "out"), "--workers", "1", "--quiet", "--no-film"]


COMMANDS = (
    Command("run", _run),
    Command("sequence", _sequence),
    Command("tets", _tets),
    Command("repair", _repair),
)


def _start(arguments: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "musclefit", *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def _complete(arguments: list[str]) -> str:
    """Run a command to its end; "" where it completed, else what it said."""
    with _start(arguments) as process:
        _, said = process.communicate()
        return "" if process.returncode in FINISHED else f"exit code {process.returncode}: {said.strip()[-300:]}"


def _frames(folder: Path) -> dict[Path, int]:
    """When each finished frame of a sequence was written."""
    return {path: path.stat().st_mtime_ns for path in folder.glob("out/frames/[0-9]*/frame.json")}


def _left_over(folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if any(word in path.name for word in LEFT_OVER)]


def kill_at(command: Command, folder: Path, *, after_s: float) -> str:
    """Kill a command, start it again, and say what went wrong; "" where nothing did."""
    arguments = command.prepare(folder)
    with _start(arguments) as process:
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # with its workers, as when the machine goes down
    before = _frames(folder)
    problem = _complete(arguments)
    if problem:
        return problem
    again = [str(path) for path, when in _frames(folder).items() if before.get(path, when) != when]
    left = _left_over(folder)
    return "; ".join([*(f"made again: {path}" for path in again), *(f"left over: {path}" for path in left)])


def campaign(command: Command, *, moments: int, seed: int) -> dict[float, str]:
    """Kill a command at moments spread over the time that it takes; what went wrong, by the moment."""
    chance = random.Random(f"{seed}/{command.name}")
    problems: dict[float, str] = {}
    with tempfile.TemporaryDirectory(prefix="musclefit-kill-") as place:
        began = time.perf_counter()
        first = Path(place) / "first"
        first.mkdir()
        problem = _complete(command.prepare(first))
        if problem:
            raise RuntimeError(f"{command.name}: {problem}")
        took = time.perf_counter() - began
        for number in range(moments):
            folder = Path(place) / str(number)
            folder.mkdir()
            after_s = took * (number + chance.random()) / moments
            said = kill_at(command, folder, after_s=after_s)
            if said:
                problems[after_s] = said
            shutil.rmtree(folder)
    return problems


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=10, help="for each command")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--command", default="", help="only this one")
    given = parser.parse_args()
    failed = 0
    for command in COMMANDS:
        if given.command in ("", command.name):
            problems = campaign(command, moments=given.moments, seed=given.seed)
            failed += len(problems)
            print(f"{command.name}: killed at {given.moments} moments, {len(problems)} restarts failed", flush=True)
            for after_s, problem in problems.items():
                print(f"    after {after_s:.2f} s: {problem}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
