"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import uuid
from pathlib import Path

from musclefit.errors import InputError


def check_file_writable(path: Path) -> None:
    """Raise InputError, before long work, unless a file can be written at a path, whose folders may have to be made."""
    folder = next(parent for parent in path.resolve().parents if parent.exists())
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"{path}: cannot be written; choose a file in a folder that can")


def write_atomically(path: Path, text: str) -> Path:
    """Write a text file beside, then put it in place."""
    return write_bytes_atomically(path, text.encode("utf-8", errors="backslashreplace"))


def write_bytes_atomically(path: Path, data: bytes) -> Path:
    """Write a file beside, then put it in place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    build = path.with_name(f".{path.name}.partial-{uuid.uuid4().hex}")
    try:
        build.write_bytes(data)
        return build.replace(path)
    except BaseException:
        build.unlink(missing_ok=True)
        raise
