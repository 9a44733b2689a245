"""Compiled loops: kept on disk for all environments and processes of a user, and run in threads; knows no formula.

Compiling the loops of a run takes half a minute, hence three rules. What is compiled is kept in one folder,
``compiled`` in the user's cache (`musclefit.caches`) or that of ``NUMBA_CACHE_DIR``, under the hash of the sources that
it was made from: its own module and all of musclefit that this imports, which Numba's own caches leave out. While one
process compiles a function the others wait for it rather than compile it too. And loops run in Python's threads instead
of Numba's, which compile every loop three times over.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, wraps
from hashlib import sha256
from inspect import getfile, signature
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba import config
from numba.core import caching

from musclefit.caches import default_cache_folder

if sys.platform != "win32":
    import fcntl

KEPT_SOURCES = 8
"""Of so many versions of its sources what was compiled of a function stays in the folder."""

WAIT_S = 120.0
"""So long a process waits for another that compiles the same function, before it does so itself."""

SHARES = 8
"""Each thread's part of the tasks is done in so many calls, so that none waits long for another."""

_PACKAGE = Path(__file__).resolve().parent
_IMPORTS = re.compile(r"^\s*from musclefit((?:\.\w+)*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As Numba's own, but where ``cache`` is true kept in the folder that all processes share.

    A function that is made within another is named by what it is made of: Numba tells two of one name apart by
    counting, and what another process compiled of the one may have the number that this process gives the other.
    """
    kept = options.pop("cache", False)

    def compiled(function: Callable[..., Any]) -> Any:
        if "<locals>" in function.__qualname__:  # its machine code is linked by this name
            function.__qualname__ += f"_{fingerprint(function)[:16]}"
        made = numba.njit(no_cfunc_wrapper=True, **options)(function)
        if kept:
            made._cache = SharedCache(function)
        return made

    return compiled


def threaded(
    *, over: str, axis: int = 0, each: int = 1, least: int = 4, **options: Any
) -> Callable[[Callable[..., None]], Any]:
    """Compile a loop over tasks and run it in as many threads as ``NUMBA_NUM_THREADS`` says.

    Parameters
    ----------
    over : str
        The array parameter whose length along ``axis`` is what the tasks share out.
    axis : int
    each : int
        Entries of one task.
    least : int
        Tasks that a thread must have for it to be worth while.
    **options
        Of `njit`.

    Returns
    -------
    callable
        Takes a function of ``begin``, ``end`` and its own parameters, which does the tasks from ``begin`` on and
        before ``end``, each without regard to the others; gives one of its own parameters alone, which does all.
        The compiled one is its attribute ``loop``.
    """

    def shared(function: Callable[..., None]) -> Any:
        loop = njit(cache=True, nogil=True, **options)(function)
        place = list(signature(function).parameters).index(over) - 2

        @wraps(function)
        def run(*arguments: Any) -> None:
            _run(loop, -(-arguments[place].shape[axis] // each), least, arguments)

        run.loop = loop  # type: ignore[attr-defined]
        return run

    return shared


_pool: list[ThreadPoolExecutor] = []
"""The threads beside the one that calls, once they are needed."""

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.clear)  # threads are not copied


_alone: list[None] = []
"""One entry for each `one_thread` that lasts."""


@contextmanager
def one_thread() -> Iterator[None]:
    """While it lasts, the loops of this process run in the thread that calls them alone."""
    _alone.append(None)
    try:
        yield
    finally:
        _alone.pop()


def _run(loop: Callable[..., None], count: int, least: int, arguments: tuple[Any, ...]) -> None:
    threads = 1 if _alone else min(config.NUMBA_NUM_THREADS, count // least)
    if threads < 2:
        loop(0, count, *arguments)
        return
    step = max(1, count // (SHARES * threads))
    firsts = iter(range(0, count, step))  # each thread takes the next when it is done with one

    def work() -> None:
        for first in firsts:
            loop(first, min(first + step, count), *arguments)

    if not _pool:
        _pool.append(ThreadPoolExecutor(config.NUMBA_NUM_THREADS - 1, thread_name_prefix="musclefit"))
    others = [_pool[0].submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        for other in others:
            other.result()


def compiled_folder() -> Path:
    """Where compiled loops are kept."""
    return Path(config.CACHE_DIR) if config.CACHE_DIR else default_cache_folder() / "compiled"


@cache
def sources_of(path: Path) -> frozenset[Path]:
    """The files of musclefit that one of them imports, directly or not; itself among them."""
    found, waiting = set(), [path]
    while waiting:
        file = waiting.pop()
        if file not in found and file.is_file():
            found.add(file)
            waiting += _imported(file)
    return frozenset(found)


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    return tuple(_named_in(path.read_text(encoding="utf-8")))


def _named_in(text: str) -> Iterator[Path]:
    for dotted, names in _IMPORTS.findall(text):
        module = _PACKAGE.joinpath(*dotted.split(".")[1:])
        yield module.with_suffix(".py") if dotted else module / "__init__.py"
        for name in re.findall(r"\w+", names):
            yield module / f"{name}.py"


@cache
def source_stamp(path: Path) -> str:
    """The hash of `sources_of` a file."""
    told = sha256()
    for file in sorted(sources_of(path)):
        told.update(str(file.relative_to(_PACKAGE)).encode() + b"\0" + file.read_bytes() + b"\0")
    return told.hexdigest()


def fingerprint(value: Any) -> str:
    """What a function is made of, the same in every process: its name and source, and all that its closure holds.

    Of sources outside musclefit the file alone counts, not what it imports.
    """
    function = getattr(value, "py_func", value)
    if not isinstance(function, FunctionType):
        return sha256(repr(value).encode()).hexdigest()
    path = Path(getfile(function)).resolve()
    code = function.__code__
    told = sha256(f"{function.__module__}.{function.__qualname__}:{code.co_firstlineno}".encode() + code.co_code)
    told.update((source_stamp(path) if path.is_relative_to(_PACKAGE) else _file_stamp(path)).encode())
    for cell in function.__closure__ or ():
        told.update(fingerprint(cell.cell_contents).encode())
    return told.hexdigest()


@cache
def _file_stamp(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest() if path.is_file() else str(path)


class _Place(caching._CacheLocator):  # type: ignore[misc]
    """Where one function's code is kept; needs no folder beside its source, nor the time when that was written."""

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._py_file = path  # named by Numba's warnings
        self._path = Path(path).resolve()
        self._line = function.__code__.co_firstlineno
        self._told = fingerprint(function)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Place | None:
        place = cls(py_func, py_file)
        return place if place._path.is_relative_to(_PACKAGE) else None

    def get_cache_path(self) -> str:
        room = self._path.parent.relative_to(_PACKAGE).parts
        return str(compiled_folder().joinpath(*(room or ("musclefit",))))

    def get_source_stamp(self) -> str:
        return source_stamp(self._path)

    def get_disambiguator(self) -> str:
        return f"{self._line}-{self._told[:24]}"


class _Code(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_Place, *caching.CacheImpl._locator_classes)

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._told = fingerprint(py_func)

    def reduce(self, cres: Any) -> Any:
        """With what it was made of, for an index names its file before that is written."""
        return self._told, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Refuse what was made of anything else."""
        told, own = payload
        if told != self._told:
            raise ValueError("what was compiled is of another function")
        return super().rebuild(target_context, own)


class _Kept(caching.FunctionCache):  # type: ignore[misc]
    _impl_class = _Code

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """As Numba's, which knows compiled functions in a closure by an identity that no other process shares."""
        told = sha256(self._py_func.__code__.co_code).hexdigest(), fingerprint(self._py_func)
        return sig, codegen.magic_tuple(), told


class SharedCache(caching._Cache):  # type: ignore[misc]
    """What was compiled of one function, in the folder of all processes; hashes sources when first asked.

    A process that finds nothing locks the function and compiles; another that looks for it meanwhile waits. A folder
    that cannot be written or read is done without.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._kept: _Kept | None = None
        self._lock: _Lock | None = None
        self._enabled = True

    @property
    def cache_path(self) -> str:
        """The folder."""
        return str(self._files().cache_path)

    def enable(self) -> None:
        """Look there, and keep."""
        self._enabled = True

    def disable(self) -> None:
        """Neither look there nor keep."""
        self._enabled = False

    def flush(self) -> None:
        """Forget what is kept."""
        self._files().flush()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for a signature; None where this process is to compile it."""
        if not self._enabled:
            return None
        self._release()
        found = self._load(sig, target_context)
        if found is None:
            with suppress(OSError):
                files = self._files()
                files._impl.locator.ensure_cache_path()
                lock = _Lock(Path(files.cache_path) / f"{files._impl.filename_base}.lock")
                if lock.waited:
                    found = self._load(sig, target_context)
                if found is None:
                    self._lock = lock
                else:
                    lock.release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, and let others have it."""
        try:
            if self._enabled:
                with suppress(OSError):
                    self._files().save_overload(sig, data)
                    self._make_room()
        finally:
            self._release()

    def _load(self, sig: Any, target_context: Any) -> Any:
        try:
            found = self._files().load_overload(sig, target_context)
            if found is not None and isinstance(sig, tuple) and tuple(found.signature.args) != sig:
                raise ValueError("what was compiled is of other arguments")
            return found
        except Exception:  # whatever a damaged file raises when it is unpickled
            with suppress(OSError):
                self._files().flush()
            return None

    def _files(self) -> _Kept:
        if self._kept is None:
            self._kept = _Kept(self._function)
        return self._kept

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _make_room(self) -> None:
        """Remove what was compiled from sources older than the latest few."""
        files = self._files()
        qualified = self._function.__qualname__.replace("<", "").replace(">", "")
        name = f"{Path(getfile(self._function)).stem}.{qualified}"
        indices = sorted(Path(files.cache_path).glob(f"{name}-*.nbi"), key=lambda path: path.stat().st_mtime)
        for index in indices[:-KEPT_SOURCES]:
            for file in index.parent.glob(f"{index.stem}.*"):
                file.unlink(missing_ok=True)


class _Lock:
    """Held by one process at a time, and by none that has ended; on Windows by all that ask."""

    def __init__(self, path: Path) -> None:
        self.waited = False
        self._file = path.open("ab")
        if sys.platform == "win32":
            return
        end = time.monotonic() + WAIT_S
        while True:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:  # another holds it
                self.waited = True
                if time.monotonic() > end:
                    return
                time.sleep(0.02)
            except OSError:  # the file system knows no locks
                return

    def release(self) -> None:
        self._file.close()
