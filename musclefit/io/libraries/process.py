"""Starts a library's process on files and arrays, and gives its arrays, or its failure in words."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.progress import Tick
from musclefit.scratch import scratch_folder
from musclefit.worker_processes import run_worker

_WORKER = Path(__file__).with_name("worker.py")
_LINES = 3
"""Of what a library says at its end, lines that a message repeats."""


def asked(
    task: str,
    given: Mapping[str, Any],
    files: Mapping[str, bytes],
    *,
    library: str,
    source: str,
    tick: Tick = lambda _: None,
    cpu_s: float = float("inf"),
    memory_bytes: float = float("inf"),
) -> dict[str, Any]:
    """Have a task of `musclefit.io.libraries.worker` done.

    Parameters
    ----------
    task : str
    given : mapping of name to array
    files : mapping of name to bytes
        Laid beside it.
    library : str
        Its name, which is that of the extra that installs it.
    source : str
        The user's file, for messages.
    tick : function of a fraction
    cpu_s, memory_bytes : float
        The most that it may take, as of `run_worker`.

    Returns
    -------
    dict of name to array

    Raises
    ------
    InputError
        The library is not installed, says why it cannot do it, ended, or came to no end within its limits.
    """
    with scratch_folder("musclefit-library-") as folder:
        arrays: dict[str, Any] = {key: np.asarray(value) for key, value in given.items()}
        np.savez(folder / "given.npz", **arrays)
        for file, data in files.items():
            (folder / file).write_bytes(data)
        code, said = run_worker(
            _WORKER,
            [task],
            folder=folder,
            fractions=_fractions_done,
            tick=tick,
            options=("-W", "ignore"),
            cpu_s=cpu_s,
            memory_bytes=memory_bytes,
        )
        if code == 0:
            with np.load(folder / "answer.npz", allow_pickle=False) as stored:
                return dict(stored)
        problem = _problem(folder)
    if "missing" in problem:
        raise InputError(
            f"{source}: needs the library {library}, which is not there ({problem['missing']}); install it with "
            f"`pip install 'musclefit[{_EXTRAS[library]}]'`"
        )
    told = problem.get("said") or " ".join(said.strip().splitlines()[-_LINES:]) or "it said nothing"
    raise InputError(
        f"{source}: {library} cannot use it ({told}; exit code {code}); correct the file or export it again"
    )


_EXTRAS = {"opensim": "opensim", "ezc3d": "c3d"}


def _fractions_done(lines: Iterable[str]) -> Iterator[float]:
    """Of the lines "done/of all" that a worker prints."""
    for line in lines:
        done, _, of = line.strip().partition("/")
        if done.isdecimal() and of.isdecimal() and int(of) > 0:
            yield int(done) / int(of)


def _problem(folder: Path) -> dict[str, str]:
    path = folder / "problem.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
