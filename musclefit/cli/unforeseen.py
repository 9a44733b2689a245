"""Errors that nobody foresaw: one line on the terminal with what to do, the whole of it in a log file."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from musclefit._version import __version__
from musclefit.caches import default_log_folder

UNFORESEEN = 3
"""Exit code that no limit, no bad input and no interruption gives."""


def tell_unforeseen(error: Exception, arguments: Sequence[str]) -> int:
    """Say that musclefit has a fault, where its log is and where to report it; the exit code.

    Parameters
    ----------
    error : Exception
    arguments : sequence of str
        Those of the command line, which the log repeats.
    """
    said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    log = _write_log(error, arguments)
    kept = f"The details are in {log}" if log is not None else "".join(traceback.format_exception(error))
    if isinstance(error, MemoryError):
        problem = f"out of memory ({said}); nothing was left half-written. Give smaller input or free memory."
    else:
        problem = (
            f"stopped by an unexpected error ({said}); nothing was left half-written. This is a fault of "
            "musclefit: it says nothing about whether your input is good or a limit is kept."
        )
    with suppress(OSError, ValueError):
        print(f"musclefit: {problem} {kept}; please report it with that file {_where()}", file=sys.stderr)
    return UNFORESEEN


def _write_log(error: Exception, arguments: Sequence[str]) -> Path | None:
    """The log file, in the platform's folder for logs or else a temporary one; None where neither takes it."""
    name = f"error-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.log"
    text = "\n".join(
        [
            f"musclefit {__version__}, Python {sys.version.split()[0]}, {platform.platform()}",
            f"arguments: {list(arguments)!r}",
            f"folder: {_current_folder()}",
            "",
            "".join(traceback.format_exception(error)),
            "Packages:",
            *_packages(),
            "",
        ]
    )
    for folder in (default_log_folder(), Path(tempfile.gettempdir())):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / name
            path.write_text(text, encoding="utf-8", errors="backslashreplace")
            return path
    return None


def _current_folder() -> str:
    try:
        return str(Path.cwd())
    except OSError as error:
        return f"gone ({error})"


def _packages() -> list[str]:
    """The packages that musclefit asks for, with their versions."""
    with suppress(metadata.PackageNotFoundError):
        asked = [line for line in metadata.requires("musclefit") or [] if "extra ==" not in line]
        names = sorted({line.split(">")[0].split("=")[0].split(";")[0].strip() for line in asked})
        return [f"  {name} {_version_of(name)}" for name in names]
    return ["  musclefit runs from its source"]


def _version_of(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


def _where() -> str:
    """Where to report faults: the address that the package itself states."""
    with suppress(metadata.PackageNotFoundError):
        urls = dict(entry.split(", ", 1) for entry in metadata.metadata("musclefit").get_all("Project-URL") or [])
        for label in ("Issues", "Bug Tracker", "Repository", "Homepage"):
            if label in urls:
                return f"at {urls[label]}"
    return "to its authors"
