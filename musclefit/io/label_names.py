"""Tables of labels -> values, names and kinds: CSV, TSV, JSON and 3D Slicer's colour tables; knows no image."""

from __future__ import annotations

import csv
import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.io.formats.texts import read_text

VALUE = ("value", "index", "label", "id", "key")
NAME = ("name", "structure", "tissue", "roi")
KIND = "kind"


@dataclass(frozen=True, slots=True)
class NamedValue:
    """One row of a table: ``kind`` is None where the table has none."""

    value: int
    name: str
    kind: TissueKind | None


def read_names(path: Path) -> tuple[NamedValue, ...]:
    """Read a table of labels.

    Read are CSV and TSV with the columns value (index, label, id) and name, and kind if there is one (skin, other,
    muscle, bone); JSON of {"1": "femur"}, {"femur": 1} or nnU-Net's {"labels": {...}}; and 3D Slicer's .ctbl.

    Raises
    ------
    InputError
        No such file, another form, a value that is not a whole number above 0 or is given twice, or a kind that is not
        known.
    """
    text = read_text(path)
    ending = path.suffix.lower()
    if ending == ".json":
        rows = _from_json(text, path)
    elif ending in (".ctbl", ".txt"):
        rows = _from_colours(text, path)
    else:
        rows = _from_columns(text, path, "\t" if ending == ".tsv" else ",")
    named = [_row(place, *row, path=path) for place, row in rows]
    kept = tuple(row for row in named if row.value != 0)
    if not kept:
        raise InputError(f"{path}: names no label above 0, which is background; give a row for each label")
    doubled = {row.value for row in kept if sum(other.value == row.value for other in kept) > 1}
    if doubled:
        raise InputError(f"{path}: the value {min(doubled)} is named twice; give each label one name")
    return kept


def _from_columns(text: str, path: Path, delimiter: str) -> list[tuple[str, tuple[str, str, str]]]:
    reader = csv.DictReader(StringIO(text), delimiter=delimiter, strict=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a table of labels ({error}); correct the file") from None
    columns = {(column or "").strip().lower(): column for column in reader.fieldnames or ()}
    value = next((columns[name] for name in VALUE if name in columns), None)
    name = next((columns[name] for name in NAME if name in columns), None)
    if value is None or name is None:
        missing = "value" if value is None else "name"
        raise InputError(f"{path}: has no column {missing!r}; a table of labels has the columns value, name and kind")
    kind = columns.get(KIND)
    return [
        (f"line {number}", (row[value] or "", row[name] or "", (row[kind] or "") if kind is not None else ""))
        for number, row in enumerate(rows, start=2)
    ]


def _from_json(text: str, path: Path) -> list[tuple[str, tuple[str, str, str]]]:
    try:
        table = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); correct it") from None
    if isinstance(table, Mapping) and isinstance(table.get("labels"), Mapping):
        table = table["labels"]
    if not isinstance(table, Mapping):
        raise InputError(f'{path}: expected {{"1": "femur", ...}}, {{"femur": 1, ...}} or {{"labels": {{...}}}}')
    rows = []
    for key, value in table.items():
        turned = isinstance(value, str) and not value.lstrip("-").isdigit()
        rows.append((f"entry {key!r}", (key, value, "") if turned else (str(value), key, "")))
    return rows


def _from_colours(text: str, path: Path) -> list[tuple[str, tuple[str, str, str]]]:
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            words = shlex.split(line)
        except ValueError:
            words = line.split()
        if len(words) < 2:
            raise InputError(f"{path}: line {number}: {line.strip()!r}; expected value, name and colours")
        rows.append((f"line {number}", (words[0], words[1], "")))
    return rows


def _row(place: str, value: str, name: str, kind: str, *, path: Path) -> NamedValue:
    try:
        number = int(value.strip())
    except ValueError:
        raise InputError(f"{path}: {place}: value is {value!r}; expected a whole number") from None
    if number < 0:
        raise InputError(f"{path}: {place}: value is {number}; labels are above 0, which is background")
    known = kind.strip().lower()
    if known and known not in list(TissueKind):
        raise InputError(f"{path}: {place}: kind is {kind!r}; known are {', '.join(TissueKind)}")
    if not name.strip() and number:
        raise InputError(f"{path}: {place}: label {number} has no name; name it")
    return NamedValue(number, name.strip(), TissueKind(known) if known else None)
