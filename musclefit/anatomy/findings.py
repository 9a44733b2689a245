"""What was found in the input when reading it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """Something found in the input.

    Parameters
    ----------
    subject : str
        The tissue or file.
    code : str
        A short stable word.
    message : str
        What was found, with numbers.
    next_step : str
        What to do about it; empty where the message says so, or where nothing need be done.
    """

    subject: str
    code: str
    message: str
    next_step: str = ""


def some_of(words: Iterable[str], *, most: int = 8) -> str:
    """Words as a message lists them: the first few, and that there are more.

    >>> some_of(["a", "b", "c"], most=2)
    'a, b, ...'
    """
    listed = list(words)
    return ", ".join(listed[:most]) + (", ..." if len(listed) > most else "")
