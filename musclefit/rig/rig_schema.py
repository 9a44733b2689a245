"""The JSON Schema of rig tables, derived from the records; editors complete and check rig files with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from enum import StrEnum
from typing import Any, get_args, get_type_hints

from musclefit.rig.drive import DRIVES
from musclefit.rig.rig_table import SECTIONS

Schema = dict[str, Any]

_PLAIN: Mapping[Any, Schema] = {
    str: {"type": "string"},
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
}

_WRITTEN_OTHERWISE: Mapping[str, Schema] = {
    "drive.pose": {"type": "object", "patternProperties": {"_deg$": {"type": "number"}}, "additionalProperties": False},
    "drive.keyframes": {"type": "array", "items": {"type": "object", "required": ["at"]}},
}
"""Keys whose values a rig writes in other words than the records hold them."""


def rig_schema(meanings: Mapping[str, str]) -> Schema:
    """JSON Schema (draft 2020-12) of a rig file.

    Parameters
    ----------
    meanings : mapping of dotted key to text
        Descriptions; those of a drive's keys name its kind, as `drive(cage).source`.
    """
    properties: Schema = {"title": {"type": "string", "description": meanings.get("title", "")}}
    for section, record in SECTIONS.items():
        properties[section] = _object(section, record, meanings)
    kinds = [
        {
            **_object(f"drive({kind})", drive, meanings, besides={"kind": {"const": kind}}),
            "title": f'kind = "{kind}"',
        }
        for kind, drive in DRIVES.items()
    ]
    properties["drive"] = {"description": "What moves the handles.", "oneOf": kinds}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": "urn:musclefit:rig",
        "title": "A musclefit rig",
        "type": "object",
        "properties": properties,
        "required": ["title", "anatomy", "drive"],
        "additionalProperties": False,
    }


def _object(
    section: str, record: type, meanings: Mapping[str, str], *, besides: Mapping[str, Schema] | None = None
) -> Schema:
    properties, required = dict(besides or {}), list(besides or {})
    hints = get_type_hints(record)
    for field in fields(record):
        key = f"{section}.{field.name}"
        told = {"description": meanings[key]} if key in meanings else {}
        otherwise = _WRITTEN_OTHERWISE.get(f"{section.partition('(')[0]}.{field.name}")
        properties[field.name] = {**(otherwise or _of(hints[field.name])), **told}
        if field.default is MISSING and field.default_factory is MISSING:
            required.append(field.name)
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def _of(hint: Any) -> Schema:
    """The schema of a value by its type; a choice of the anatomy's (None) is left out of a rig, not written."""
    if hint in _PLAIN:
        return dict(_PLAIN[hint])
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return {"enum": [word.value for word in hint]}
    arguments = [argument for argument in get_args(hint) if argument is not type(None)]
    if len(arguments) == 1:
        return _of(arguments[0])
    item = arguments[0]  # of tuple[X, ...]
    named = get_args(item)
    if len(named) == 2 and named[0] is str and named[1] is not ...:  # pairs of a name and a value are a table
        return {"type": "object", "additionalProperties": _of(named[1])}
    return {"type": "array", "items": _of(item)}
