"""Commands killed at many moments and started again: each restart completes, keeps what was finished, leaves nothing.

``python tests/kill_campaign.py --moments 50 --seed 1`` kills ``run``, ``sequence``, ``tets`` (a run with tetrahedra)
and ``repair`` on a small limb with SIGKILL, and prints a line for each; exit code 1 where a restart failed, a finished
frame or mesh was made again, or a half-written file, a temporary file, a lock or a process was left. Every other moment
is a share of the processor time that the command takes, the ones between are spread over its changes of files, killed
just before each. At random the command dies with all its workers, as when the machine goes down, or alone.
"""

from __future__ import annotations

import argparse
import atexit
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import psutil
from tiny_rigs import drive_by_joints, write_tiny_rig

LEFT_OVER = (".partial-", ".former-", ".trial-", ".unfinished-", ".tmp", ".lock")
FINISHED = (0, 1)
"""Exit codes of a command that completed: passed, or a limit failed."""
TRIAL = b"blat"
"""What Python's `tempfile` writes into the place for temporary files and removes at once, to see whether it can."""
ORPHANS_S = 60.0
"""How long workers may take to notice that their command is gone, seconds."""

HOOK = """
import os, signal, sys

FILES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
inside, last, log = os.environ["KILLED_INSIDE"], int(os.environ["KILLED_AT"]), os.environ["KILLED_LOG"]
alone, count = os.environ["KILLED_ALONE"] == "1", 0

def watch(event, told):
    global count
    if event not in FILES or not isinstance(told[0], str) or not told[0].startswith(inside):
        return
    if event == "open" and not told[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        return
    count += 1
    if log:
        os.write(2, f"change {count} {event}\\n".encode())
    if count == last:
        os.kill(os.getpid(), signal.SIGKILL) if alone else os.killpg(os.getpgrp(), signal.SIGKILL)

sys.addaudithook(watch)
"""
"""Run when a Python process starts: counts its changes of files below a folder and kills it before the one asked."""


SERVER = """
import json, os, sys, tempfile
import musclefit.cli.commands, musclefit.workflows.repair, musclefit.workflows.run, musclefit.workflows.sequence

for line in sys.stdin:
    asked = json.loads(line)
    pid = os.fork()
    if not pid:
        os.setsid()
        os.environ.update(asked["environment"])
        for number, path, how in ((0, os.devnull, "r"), (1, os.devnull, "w"), (2, asked["said"], "w")):
            with open(path, how) as file:
                os.dup2(file.fileno(), number)
        tempfile.tempdir = None
        sys.argv = ["musclefit", *asked["arguments"]]
        exec(asked["hook"])
        sys.exit(musclefit.cli.main())
    print(pid, flush=True)
    _, status, used = os.wait4(pid, 0)
    print(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, flush=True)
"""
"""A process that has imported musclefit, and forks for each line: a command in a group of its own, then its end."""


@dataclass(frozen=True)
class Command:
    """A command line that writes into ``out``, below the folder that it is given, and what makes its input."""

    name: str
    prepare: Callable[[Path], list[str]]


@dataclass(frozen=True)
class Moment:
    """When a command is killed: after so much processor time, or before one of its changes of files; how."""

    cpu_s: float = 0.0
    change: int = 0
    alone: bool = False

    def __str__(self) -> str:
        when = f"before change {self.change}" if self.change else f"after {self.cpu_s:.2f} CPU s"
        return f"{when}, {'alone' if self.alone else 'with its workers'}"


def _rig(folder: Path) -> Path:
    return write_tiny_rig(folder / "rig")


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


@cache
def _server() -> subprocess.Popen[str]:
    """The process that forks."""
    from musclefit.compiling import compiled_folder

    environment = os.environ | {"NUMBA_CACHE_DIR": str(compiled_folder())}
    started = subprocess.Popen(
        [sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )

    def end() -> None:
        assert started.stdin is not None
        started.stdin.close()
        started.wait()

    atexit.register(end)
    return started


class _Started:
    """A command that was started: its number, which is that of its group, and what it says."""

    def __init__(self, arguments: list[str], folder: Path, *, moment: Moment, log: bool = False) -> None:
        """With its caches and temporary files below the folder."""
        for name in ("hook", "cache", "temporary"):
            (folder / name).mkdir(exist_ok=True)
        (folder / "hook" / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
        path = os.pathsep.join([str(folder / "hook"), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {
            "PYTHONPATH": path,
            "MUSCLEFIT_CACHE": str(folder / "cache"),
            "TMPDIR": str(folder / "temporary"),
            "KILLED_INSIDE": str(folder),
            "KILLED_AT": str(moment.change),
            "KILLED_ALONE": str(int(moment.alone)),
            "KILLED_LOG": "1" if log else "",
        }
        self._said = folder / "hook" / "said.txt"
        asked = {"arguments": arguments, "environment": environment, "said": str(self._said), "hook": HOOK}
        server = _server()
        assert server.stdin is not None
        assert server.stdout is not None
        self._lines = server.stdout
        server.stdin.write(json.dumps(asked) + "\n")
        server.stdin.flush()
        self.pid = int(self._lines.readline())
        self._ended: tuple[int, float] | None = None

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._ended is None and not select.select([self._lines], [], [], 0.0)[0]

    def wait(self) -> tuple[int, float]:
        """Its exit code, and the processor time that it and its workers took, seconds."""
        if self._ended is None:
            code, cpu_s = self._lines.readline().split()
            self._ended = int(code), float(cpu_s)
        return self._ended

    def said(self) -> str:
        """What it wrote to standard error."""
        return self._said.read_text(encoding="utf-8", errors="replace")


def _of_group(group: int) -> Iterator[psutil.Process]:
    """The living processes of a group."""
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                yield process


def _cpu_s(group: int) -> float:
    """What the processes of a group and those that they waited for have used, seconds."""
    total = 0.0
    for process in _of_group(group):
        with suppress(psutil.Error):
            total += sum(process.cpu_times()[:4])
    return total


def _complete(arguments: list[str], folder: Path, *, log: bool = False) -> tuple[str, str, float]:
    """Run a command to its end: "" where it completed, else what went wrong; what it said, and its CPU seconds."""
    started = _Started(arguments, folder, moment=Moment(), log=log)
    code, cpu_s = started.wait()
    said = started.said()
    return "" if code in FINISHED else f"exit code {code}: {said.strip()[-300:]}", said, cpu_s


def _kill(arguments: list[str], folder: Path, *, moment: Moment) -> str:
    """Start a command and have it killed; what went wrong with that."""
    started = _Started(arguments, folder, moment=moment)
    while moment.cpu_s and started.running and _cpu_s(started.pid) < moment.cpu_s:
        time.sleep(0.02)
    if moment.cpu_s and started.running:
        os.kill(started.pid, signal.SIGKILL) if moment.alone else os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    until = time.monotonic() + ORPHANS_S
    while (left := list(_of_group(started.pid))) and time.monotonic() < until:
        time.sleep(0.1)
    with suppress(ProcessLookupError):
        os.killpg(started.pid, signal.SIGKILL)
    return f"left running: {', '.join(' '.join(p.cmdline()) for p in left)}" if left else ""


def _finished(folder: Path) -> dict[Path, int]:
    """Each finished frame of a sequence and each mesh, with the number of its file, another one if it is made again."""
    found = [*folder.glob("out/frames/[0-9]*/frame.json"), *folder.glob("cache/tets-*.npz")]
    return {path: path.stat().st_ino for path in found}


def _left_over(folder: Path) -> list[str]:
    named = [path for path in folder.rglob("*") if any(word in path.name for word in LEFT_OVER)]
    temporary = [path for path in (folder / "temporary").iterdir() if not _is_trial(path)]
    return [str(path.relative_to(folder)) for path in (*named, *temporary)]


def _is_trial(path: Path) -> bool:
    return path.is_file() and TRIAL.startswith(path.read_bytes())  # killed within it, nothing of it may be written


def kill_at(command: Command, folder: Path, *, moment: Moment) -> str:
    """Kill a command, start it again, and say what went wrong; "" where nothing did."""
    arguments = command.prepare(folder)
    orphans = _kill(arguments, folder, moment=moment)
    before = _finished(folder)
    problem, _, _ = _complete(arguments, folder)
    if problem:
        return problem
    written = _finished(folder)
    again = [str(path) for path, number in before.items() if written.get(path) != number]
    told = [*(f"made again: {path}" for path in again), *(f"left over: {path}" for path in _left_over(folder))]
    return "; ".join(filter(None, [orphans, *told]))


def _moments(command: Command, place: Path, *, moments: int, seed: int) -> Iterator[Moment]:
    """The moments, spread over the processor time and the changes of files of a command that is let alone."""
    chance = random.Random(f"{seed}/{command.name}")
    first = place / "first"
    first.mkdir()
    problem, said, took = _complete(command.prepare(first), first, log=True)
    if problem:
        raise RuntimeError(f"{command.name}: {problem}")
    changes = max(int(line.split()[1]) for line in said.splitlines() if line.startswith("change "))
    for number in range(moments):
        share = (number + chance.random()) / moments
        alone = chance.random() < 0.5
        by_change = Moment(change=1 + int(share * changes), alone=alone)
        yield by_change if number % 2 else Moment(cpu_s=share * took, alone=alone)


def campaign(command: Command, *, moments: int, seed: int) -> dict[Moment, str]:
    """Kill a command at many moments; what went wrong, by the moment."""
    problems: dict[Moment, str] = {}
    with tempfile.TemporaryDirectory(prefix="musclefit-kill-") as name:
        place = Path(name).resolve()
        for number, moment in enumerate(_moments(command, place, moments=moments, seed=seed)):
            folder = place / str(number)
            folder.mkdir()
            said = kill_at(command, folder, moment=moment)
            if said:
                problems[moment] = said
            shutil.rmtree(folder)
            print(f"    {command.name} {number}: {moment}: {said or 'well'}", file=sys.stderr, flush=True)
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
            for moment, problem in problems.items():
                print(f"    {moment}: {problem}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
