"""TOML and JSON files: takes their bytes, gives the table they hold; knows nothing of what the tables mean."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from musclefit.errors import RigError


def parse_table(data: bytes, *, source: str) -> dict[str, Any]:
    """The table of a file that the suffix of ``source`` says is TOML or JSON.

    Raises
    ------
    RigError
        Another suffix, or as `parse_toml` and `parse_json`.
    """
    suffix = Path(source).suffix.lower()
    if suffix == ".toml":
        return parse_toml(data, source=source)
    if suffix == ".json":
        return parse_json(data, source=source)
    raise RigError(f"{source}: has suffix {suffix!r}; expected .json or .toml")


def parse_toml(data: bytes, *, source: str) -> dict[str, Any]:
    """The table that a TOML file holds; RigError with the file, line and column where it is broken."""
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise RigError(f"{source}: is not UTF-8 text (byte {error.start} is not valid); save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise RigError(f"{source}: is not valid TOML: {error}") from None
    except RecursionError:
        raise RigError(f"{source}: is nested too deeply to be read") from None
    except ValueError as error:  # a number with more digits than Python converts
        raise RigError(f"{source}: cannot be read: {error}") from None


def parse_json(data: bytes, *, source: str) -> dict[str, Any]:
    """The object that a JSON file holds; RigError where it is broken (with line and column) or says a key twice."""
    try:
        read = json.loads(data.decode("utf-8-sig"), object_pairs_hook=lambda pairs: _unique(pairs, source=source))
    except UnicodeDecodeError as error:
        raise RigError(f"{source}: is not UTF-8 text (byte {error.start} is not valid); save it as UTF-8") from None
    except json.JSONDecodeError as error:
        raise RigError(
            f"{source}: is not valid JSON: {error.msg} (at line {error.lineno}, column {error.colno})"
        ) from None
    except RecursionError:
        raise RigError(f"{source}: is nested too deeply to be read") from None
    except ValueError as error:  # a number with more digits than Python converts
        raise RigError(f"{source}: cannot be read: {error}") from None
    if not isinstance(read, dict):
        raise RigError(f"{source}: holds {type(read).__name__} at its top; expected an object {{...}}")
    return read


def _unique(pairs: list[tuple[str, Any]], *, source: str) -> dict[str, Any]:
    """An object of JSON, which would otherwise silently keep the last of two equal keys."""
    table: dict[str, Any] = {}
    for key, value in pairs:
        if key in table:
            raise RigError(f"{source}: {key}: stands twice in one object; remove one")
        table[key] = value
    return table


def toml_string(text: str) -> str:
    """A text as TOML writes it, in quotes."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
