"""What a command reports while it runs: lines of the logger "musclefit" on standard error and in a log file.

The options ``--verbose`` and ``--log-file`` go with every command, so they are taken before commands are read.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from musclefit._version import __version__
from musclefit.errors import InputError
from musclefit.workflows.progress import LOG

VERBOSE, LOG_FILE, QUIET, ENDS_OPTIONS = "--verbose", "--log-file", "--quiet", "--"

HELP = (
    f"Every command takes {VERBOSE}, which reports each stage on standard error as it begins and ends, and "
    f"{LOG_FILE} FILE, which adds the same to a file, with times, errors and the exit code."
)


@dataclass(frozen=True, slots=True)
class Logged:
    """What a command line asks to be told.

    Parameters
    ----------
    arguments : tuple of str
        Those that are left for the command.
    verbose : bool
    file : Path or None
    """

    arguments: tuple[str, ...]
    verbose: bool
    file: Path | None


def log_options(arguments: Sequence[str]) -> Logged:
    """Take the options about logging from a command line.

    Parameters
    ----------
    arguments : sequence of str
        What stands after ``--`` is left as it is.

    Raises
    ------
    InputError
        ``--log-file`` without a file; ``--verbose`` beside ``--quiet``.
    """
    end = arguments.index(ENDS_OPTIONS) if ENDS_OPTIONS in arguments else len(arguments)
    left: list[str] = []
    verbose, file = False, None
    options = iter(arguments[:end])
    for option in options:
        name, equals, value = option.partition("=")
        if option == VERBOSE:
            verbose = True
        elif name == LOG_FILE:
            file = value if equals else next(options, "")
            if not file:
                raise InputError(f"{LOG_FILE}: names no file; write {LOG_FILE} FILE")
        else:
            left.append(option)
    if verbose and QUIET in left:
        raise InputError(f"{VERBOSE} and {QUIET} contradict each other; give one of them")
    return Logged((*left, *arguments[end:]), verbose, Path(file) if file else None)


@contextmanager
def logging_to(asked: Logged) -> Iterator[None]:
    """Tell what is asked for while a command runs.

    Raises
    ------
    InputError
        The log file cannot be written.
    """
    former = LOG.level
    terminal = _StandardError(logging.DEBUG if asked.verbose else logging.INFO)
    handlers: list[logging.Handler] = [terminal, *([_log_file(asked.file)] if asked.file is not None else [])]
    LOG.setLevel(min(handler.level for handler in handlers))
    for handler in handlers:
        LOG.addHandler(handler)
    try:
        if asked.file is not None:
            LOG.debug("musclefit %s: %s", __version__, " ".join(asked.arguments), extra=IN_FILE)
        yield
    except BaseException as error:
        LOG.error("ended by %s", type(error).__name__, exc_info=isinstance(error, Exception), extra=IN_FILE)
        raise
    finally:
        LOG.setLevel(former)
        for handler in handlers:
            LOG.removeHandler(handler)
            handler.close()


IN_FILE = {"in_file_alone": True}
"""Marks what is for the log file alone; the terminal has it in other words, or has no use for it."""


class _StandardError(logging.Handler):
    """Writes to standard error as it is when told."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError, ValueError):
            if not hasattr(record, "in_file_alone"):
                print(f"musclefit: {record.getMessage()}", file=sys.stderr)


def _log_file(path: Path) -> logging.Handler:
    try:
        handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise InputError(f"{LOG_FILE} {path}: {error.strerror}; name a file in a folder that can be written") from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    handler.setLevel(logging.DEBUG)
    return handler
