"""One strict reader of tables: takes a mapping and where it stands, gives typed values or an error that names the key.

It knows neither rigs nor joints, and it opens no file.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np

from musclefit.errors import RigError
from musclefit.geometry.arrays import Float, frozen

Choice = TypeVar("Choice", bound=StrEnum)


@dataclass(frozen=True, slots=True)
class Section:
    """A table with its place: ``source`` is the file, ``key`` the dotted key of the table ("" for the whole file).

    Every reader raises RigError, which starts with the file and the dotted key, when the value has another type than
    asked for. A boolean is not a number, a number is not a boolean, and nothing is converted from text.
    """

    table: Mapping[str, Any]
    source: str
    key: str = ""

    def __contains__(self, key: str) -> bool:
        return key in self.table

    def dotted(self, key: str) -> str:
        """The key as seen from the whole file."""
        return ".".join(part for part in (self.key, key) if part)

    def error(self, key: str, problem: str) -> RigError:
        """The error for one key of this table."""
        return RigError(f"{self.source}: {self.dotted(key)}: {problem}")

    def refuse_unknown(self, known: Collection[str]) -> None:
        """Raise RigError at the first key that is not in ``known``, with the closest known one."""
        for key in self.table:
            if key not in known:
                what = "unknown section" if isinstance(self.table[key], Mapping) else "unknown key"
                raise self.error(key, f"{what}; {suggestion(key, known)}")

    def require(self, keys: Iterable[str]) -> None:
        """Raise RigError when one of ``keys`` is missing."""
        for key in keys:
            if key not in self.table:
                raise self.error(key, "is missing; add it")

    def section(self, key: str) -> Section:
        """The table under ``key``."""
        value = self.table[key]
        if not isinstance(value, Mapping):
            raise self._wrong(key, "a table")
        return Section(value, self.source, self.dotted(key))

    def sections(self, key: str) -> tuple[Section, ...]:
        """The tables listed under ``key``, numbered from 0 in messages."""
        values = self.table[key]
        if not isinstance(values, list | tuple) or not all(isinstance(value, Mapping) for value in values):
            raise self._wrong(key, "a list of tables, such as [{ at = 0.5 }]")
        return tuple(Section(value, self.source, f"{self.dotted(key)}[{k}]") for k, value in enumerate(values))

    def text(self, key: str) -> str:
        """Text that is not empty."""
        value = self.table[key]
        if not isinstance(value, str):
            raise self._wrong(key, "text in quotes")
        if not value.strip():
            raise self.error(key, "is empty; write a value or leave the key out")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts, none of them empty or listed twice."""
        values = self.table[key]
        if not isinstance(values, list | tuple) or not all(isinstance(v, str) for v in values):
            raise self._wrong(key, 'a list of texts, such as ["a", "b"]')
        for value in values:
            if not value.strip():
                raise self.error(key, "holds an empty text; remove it")
            if values.count(value) > 1:
                raise self.error(key, f"lists {value!r} twice; remove one")
        return tuple(values)

    def number(self, key: str) -> float:
        """A finite number."""
        value = self.table[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._wrong(key, "a number")
        number = _as_float(value)
        if not math.isfinite(number):
            raise self.error(key, f"found {_shown(value)}; expected a finite number")
        return number

    def whole(self, key: str) -> int:
        """A whole number, written without a decimal point."""
        value = self.table[key]
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._wrong(key, "a whole number")
        return value

    def flag(self, key: str) -> bool:
        """True or false."""
        value = self.table[key]
        if not isinstance(value, bool):
            raise self._wrong(key, "true or false")
        return value

    def choice(self, key: str, among: type[Choice]) -> Choice:
        """One of the values of ``among``."""
        value = self.table[key]
        if not isinstance(value, str):
            raise self._wrong(key, "one of " + ", ".join(f'"{c.value}"' for c in among))
        try:
            return among(value)
        except ValueError:
            raise self.error(key, f"found {value!r}; {suggestion(value, [c.value for c in among])}") from None

    def choices(self, key: str, among: type[Choice]) -> tuple[Choice, ...]:
        """A list of values of ``among``, none of them listed twice; may be empty."""
        texts = self.texts(key)
        try:
            return tuple(among(text) for text in texts)
        except ValueError:
            wrong = next(text for text in texts if text not in list(among))
            raise self.error(key, f"holds {wrong!r}; {suggestion(wrong, [c.value for c in among])}") from None

    def wholes(self, key: str) -> tuple[int, ...]:
        """A list of whole numbers, written without a decimal point."""
        values = self.table[key]
        if not isinstance(values, list | tuple):
            raise self._wrong(key, "a list of whole numbers, such as [7, 10, 5]")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int):
                raise self.error(key, f"holds {_described(value)}; expected a list of whole numbers")
        return tuple(values)

    def numbers(self, key: str) -> tuple[float, ...]:
        """A list of finite numbers."""
        values = self.table[key]
        if not isinstance(values, list | tuple):
            raise self._wrong(key, "a list of numbers, such as [50, 20, 10]")
        return self._finite(key, values, expected="numbers")

    def vector(self, key: str, *, length: int) -> Float:
        """``length`` finite numbers as a read-only array."""
        values = self.table[key]
        if not isinstance(values, list | tuple):
            raise self._wrong(key, f"a list of {length} numbers")
        if len(values) != length:
            raise self.error(key, f"has {len(values)} entries; expected a list of {length} numbers")
        array: Float = frozen(np.array(self._finite(key, values, expected=f"{length} numbers")))
        return array

    def _finite(self, key: str, values: Sequence[Any], *, expected: str) -> tuple[float, ...]:
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self.error(key, f"holds {_described(value)}; expected a list of {expected}")
            if not math.isfinite(_as_float(value)):
                finite = expected.replace("numbers", "finite numbers")
                raise self.error(key, f"holds {_shown(value)}; expected {finite}")
        return tuple(float(value) for value in values)

    def _wrong(self, key: str, expected: str) -> RigError:
        return self.error(key, f"found {_described(self.table[key])}; expected {expected}")


def suggestion(word: str, known: Iterable[str]) -> str:
    """What to write instead of ``word``: the closest of ``known`` if one is close, and all of them."""
    names = sorted(set(known))
    close = difflib.get_close_matches(word, names, n=1)
    shown = ", ".join(names[:_LISTED]) + (f", ... ({len(names)} in all)" if len(names) > _LISTED else "")
    meant = f"did you mean {close[0]!r}? " if close else ""
    return f"{meant}known: {shown or 'none'}"


_LISTED = 40
"""How many known names a message lists."""


def _as_float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _shown(value: object) -> str:
    text = "a number of more than 20 digits" if _is_huge(value) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_huge(value: object) -> bool:
    """Whether a whole number has too many digits to show (Python refuses to print some)."""
    return isinstance(value, int) and abs(value) >= 10**20


def _described(value: object) -> str:
    if isinstance(value, bool):
        return f"the boolean {str(value).lower()}"
    if isinstance(value, str):
        return f"the text {_shown(value)}"
    if isinstance(value, int | float):
        return _shown(value) if _is_huge(value) else f"the number {_shown(value)}"
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple):
        return f"the list {_shown(list(value))}"
    return "nothing" if value is None else f"{type(value).__name__} {_shown(value)}"
