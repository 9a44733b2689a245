"""Reports as tables of pandas: records in, data frames out. Needs pandas (extra ``notebook``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

from musclefit.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame


def frames_of(tables: Mapping[str, Iterable[Any]]) -> dict[str, DataFrame]:
    """A data frame for each named table of records: a row per record, a column per field, units in the names.

    Raises
    ------
    InputError
        pandas is not installed.
    """
    try:
        from pandas import DataFrame
    except ImportError:
        raise InputError("data frames need pandas; install it: pip install 'musclefit[notebook]'") from None
    return {name: DataFrame([_row(record) for record in records]) for name, records in tables.items()}


def _row(record: Any) -> dict[str, Any]:
    values = asdict(record) if is_dataclass(record) and not isinstance(record, type) else dict(record)
    return {key: value.value if isinstance(value, Enum) else value for key, value in values.items()}
