"""Decks on disk: read by their ending, with lengths in mm; written whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from musclefit.errors import InputError
from musclefit.io.formats.decks.abaqus import parse_abaqus
from musclefit.io.formats.decks.febio import parse_febio
from musclefit.io.formats.decks.lsdyna import parse_lsdyna
from musclefit.io.formats.decks.model import Deck
from musclefit.io.formats.texts import read_bytes


class _Parser(Protocol):
    def __call__(self, data: bytes, *, source: str) -> Deck: ...


PARSERS: Mapping[str, _Parser] = MappingProxyType(
    {
        **dict.fromkeys((".k", ".key", ".dyn"), parse_lsdyna),
        ".inp": parse_abaqus,
        ".feb": parse_febio,
    }
)
"""Ending of a deck to what reads it."""


def read_deck(path: Path) -> Deck:
    """Read a deck of LS-DYNA (.k, .key, .dyn), Abaqus (.inp) or FEBio (.feb).

    Raises
    ------
    InputError
        Another ending, no such file, or what its parser refuses.
    """
    require_deck(path)
    return PARSERS[path.suffix.lower()](read_bytes(path), source=str(path))


def require_deck(path: Path) -> None:
    """InputError where the ending is that of no deck."""
    if path.suffix.lower() not in PARSERS:
        raise InputError(f"{path}: decks are read and written as {', '.join(PARSERS)} files; rename or convert it")
