"""The command line: reads, calls one pipeline function, writes."""

from musclefit.cli.commands import main

__all__ = ["main"]
