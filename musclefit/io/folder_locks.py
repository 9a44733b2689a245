"""Output folders -> held by one process at a time, so that no two write into one; knows no content."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import IO

from musclefit.caches import default_cache_folder
from musclefit.errors import InputError

if sys.platform != "win32":
    import fcntl


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold an output folder until the block ends; a process that dies holds nothing any more.

    The lock is a file in the user's folder for caches, named by the folder's real path, so that nothing is left beside
    the results. On Windows, and on file systems that know no locks, all that ask hold it.

    Raises
    ------
    InputError
        Another process holds it.
    """
    name = sha256(os.path.realpath(folder).encode("utf-8", "surrogateescape")).hexdigest()[:32]
    path = default_cache_folder() / "folders" / f"{name}.lock"
    try:
        file = _locked(path, folder)
    except OSError:  # a cache folder that cannot be written to forbids no run
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # before it is let go: who waits for it opens another
            path.parent.rmdir()  # fails where another lock is in it
            path.parent.parent.rmdir()
        file.close()


def _locked(path: Path, folder: Path) -> IO[bytes]:
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            file = path.open("a+b")
        except FileNotFoundError:  # who let go of another lock took the empty folder away
            continue
        if sys.platform == "win32":
            return file
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(20).decode("ascii", "replace").strip()
            file.close()
            raise InputError(
                f"the output folder {folder} is being written by another process{f' ({holder})' if holder else ''}; "
                "wait until that ends, or name another folder"
            ) from None
        except OSError:  # the file system knows no locks
            return file
        with suppress(OSError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.truncate(0)
                file.write(f"{os.getpid()}".encode())
                file.flush()
                return file
        file.close()  # its former holder took the file away just now
