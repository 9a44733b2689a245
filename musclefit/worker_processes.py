"""A Python file run in a process of its own, which tells how far it is; knows not what it does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from musclefit.progress import Tick

_START = Path(__file__).with_name("worker_start.py")


def run_worker(
    worker: Path,
    arguments: Iterable[str],
    *,
    folder: Path,
    fractions: Callable[[Iterable[str]], Iterable[float]],
    tick: Tick,
    options: Iterable[str] = (),
    cpu_s: float = float("inf"),
    memory_bytes: float = float("inf"),
) -> tuple[int, str]:
    """Run a file to its end; it is killed when we are interrupted or die.

    Parameters
    ----------
    worker : Path
    arguments : iterable of str
    folder : Path
        Its current folder; ``stderr.txt`` is written there.
    fractions : function
        From the lines that it prints to how far it is, 0 to 1.
    tick : function of a fraction
    options : iterable of str
        Of the interpreter, beside ``-P``.
    cpu_s, memory_bytes : float
        The most processor time, and the most memory that it may ask for; not limited on Windows.

    Returns
    -------
    int
        Exit code; minus a signal's number where one ended it.
    str
        What it complained of; or that the processor time was used up.
    """
    complaints = folder / "stderr.txt"
    limits = (str(os.getpid()), str(cpu_s), str(memory_bytes))
    with (
        complaints.open("w", encoding="utf-8") as stderr,
        subprocess.Popen(
            [sys.executable, "-P", *options, str(_START), *limits, str(worker), *arguments],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            encoding="utf-8",
            errors="replace",
        ) as process,
    ):
        try:
            assert process.stdout is not None  # it is a pipe
            for fraction in fractions(process.stdout):
                tick(fraction)
            code = process.wait()
        except BaseException:
            process.kill()
            raise
    if sys.platform != "win32" and code == -signal.SIGXCPU:
        return code, f"no end within {cpu_s:g} s of processor time"
    return code, complaints.read_text(encoding="utf-8", errors="replace")


def usable_processors() -> int:
    """Of this machine, those that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
