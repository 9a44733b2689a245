"""A Python file run in a process of its own, which tells how far it is; knows not what it does."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from musclefit.progress import Tick


def run_worker(
    worker: Path,
    arguments: Iterable[str],
    *,
    folder: Path,
    fractions: Callable[[Iterable[str]], Iterable[float]],
    tick: Tick,
    options: Iterable[str] = (),
) -> tuple[int, str]:
    """Run a file to its end; it is killed when we are interrupted.

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

    Returns
    -------
    int
        Exit code; minus a signal's number where one ended it.
    str
        What it complained of.
    """
    complaints = folder / "stderr.txt"
    with (
        complaints.open("w", encoding="utf-8") as stderr,
        subprocess.Popen(
            [sys.executable, "-P", *options, str(worker), *arguments],
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
    return code, complaints.read_text(encoding="utf-8", errors="replace")
