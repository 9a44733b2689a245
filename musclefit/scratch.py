"""Folders for what is in the making: gone when it is done, and cleared away by the next where a process was killed."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":
    import fcntl

ABANDONED_S = 24 * 3600.0
"""Where the system knows no locks on folders, one older than this is taken for left by a process that was killed."""


@contextmanager
def scratch_folder(prefix: str, *, inside: Path | None = None) -> Iterator[Path]:
    """A new folder that is removed at the end; those of this prefix that killed processes left are removed first.

    The process holds a lock on the folder, which the system lets go when the process ends, however it ends.

    Parameters
    ----------
    prefix : str
        What the folder's name begins with; what lies beside it under such a name is nobody else's.
    inside : Path, optional
        Made where it does not exist; without it the system's place for temporary files.

    Yields
    ------
    Path
    """
    place = Path(tempfile.gettempdir()) if inside is None else inside
    place.mkdir(parents=True, exist_ok=True)
    for left in place.glob(f"{prefix}*"):
        _clear(left)
    folder, lock = _held(place, prefix)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _held(place: Path, prefix: str) -> tuple[Path, int | None]:
    """A new folder and the lock on it."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        if sys.platform == "win32":
            return folder, None
        try:
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:  # another process took it for left over, before it was held
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:  # the file system knows no locks
            os.close(lock)
            return folder, None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(lock), folder.stat()):
                return folder, lock
        os.close(lock)


def _clear(folder: Path) -> None:
    """Remove a folder of this user that no process holds."""
    with suppress(OSError):  # another's, or gone meanwhile
        if sys.platform == "win32":
            if time.time() - folder.stat().st_mtime > ABANDONED_S:
                shutil.rmtree(folder, ignore_errors=True)
            return
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            if os.fstat(lock).st_uid != os.geteuid():
                return
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return
            except OSError:
                if time.time() - os.fstat(lock).st_mtime <= ABANDONED_S:
                    return
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
