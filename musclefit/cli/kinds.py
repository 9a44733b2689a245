"""What a tissue is, as written on the command line: name=kind."""

from __future__ import annotations

from collections.abc import Sequence

from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError


def parse_kinds(given: Sequence[str]) -> tuple[tuple[str, TissueKind], ...]:
    """Patterns and kinds of ``name=kind`` texts.

    Raises
    ------
    InputError
        A text is not of that form, or its kind is not known.
    """
    kinds = []
    for text in given:
        pattern, _, kind = text.partition("=")
        if not pattern or kind not in set(TissueKind):
            known = ", ".join(TissueKind)
            raise InputError(f"--kind {text!r}: write name=kind, for example femur=bone; known kinds: {known}")
        kinds.append((pattern, TissueKind(kind)))
    return tuple(kinds)
