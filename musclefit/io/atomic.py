"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
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
    with partial_file(path) as partial:
        partial.write_bytes(data)
    return path


@contextmanager
def partial_file(path: Path, *, ending: str = "") -> Iterator[Path]:
    """A path beside to write to, which takes the file's place at the end; where the block fails nothing is left of it.

    Parameters
    ----------
    path : Path
        In a folder that is there.
    ending : str
        Of the path beside, where the writer goes by it.
    """
    partial = path.with_name(f".{path.name}.partial-{uuid.uuid4().hex}{ending}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
