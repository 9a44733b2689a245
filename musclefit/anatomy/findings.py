"""What was found in the input when reading it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """Something found in the input: ``code`` is a short stable word, ``message`` says it with numbers."""

    subject: str
    code: str
    message: str


def some_of(words: Iterable[str], *, most: int = 8) -> str:
    """Words as a message lists them: the first few, and that there are more.

    >>> some_of(["a", "b", "c"], most=2)
    'a, b, ...'
    """
    listed = list(words)
    return ", ".join(listed[:most]) + (", ..." if len(listed) > most else "")
