"""What was found in the input when reading it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """Something found in the input: ``code`` is a short stable word, ``message`` says it with numbers."""

    subject: str
    code: str
    message: str
