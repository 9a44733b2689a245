"""What users of Python give, made what the rest takes: units, kinds and paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TypeAlias, TypeVar

from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError

Word = TypeVar("Word", bound=StrEnum)


def word(kind: type[Word], value: Word | str, *, what: str) -> Word:
    """One of a few words.

    Raises
    ------
    InputError
        It is none of them.
    """
    try:
        return kind(value)
    except ValueError:
        raise InputError(f"{what}: found {value!r}; expected one of {', '.join(kind)}") from None


KindsGiven: TypeAlias = Mapping[str, TissueKind | str] | Sequence[tuple[str, TissueKind | str]]
"""What tissues are, by name or shell-style pattern: the first that fits counts."""


def kinds_given(kinds: KindsGiven) -> tuple[tuple[str, TissueKind], ...]:
    """Kinds of tissues by name or shell-style pattern, in the order given.

    Raises
    ------
    InputError
        A kind that is none.
    """
    pairs = kinds.items() if isinstance(kinds, Mapping) else kinds
    return tuple((name, word(TissueKind, kind, what=f"the kind of {name!r}")) for name, kind in pairs)


def paths_given(paths: str | Path | Sequence[str | Path]) -> tuple[Path, ...]:
    """One path or several."""
    return (Path(paths),) if isinstance(paths, str | Path) else tuple(Path(path) for path in paths)
