"""The command line: reads, calls one pipeline function, writes."""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give the exit code.

    Everything else is imported in here, so that an interruption or error during imports is reported like any other.

    Parameters
    ----------
    arguments : sequence of str, or None for those of the process
    """
    try:
        try:
            from musclefit.cli.commands import main as run_command

            return run_command(arguments)
        except KeyboardInterrupt:
            print("musclefit: interrupted; nothing was left half-written", file=sys.stderr)
            return INTERRUPTED
        except Exception as error:
            from musclefit.cli.unforeseen import tell_unforeseen

            return tell_unforeseen(error, sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:  # a second one, while the first was told
        return INTERRUPTED
