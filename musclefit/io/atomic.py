"""Files that are there whole or not at all."""

from __future__ import annotations

import uuid
from pathlib import Path


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
