"""Tasks in worker processes whose numeric libraries keep to their share of the processors; knows no task."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from musclefit.errors import MusclefitError

PINNED = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Environment variables that say how many threads numeric libraries use; each is 1 in every worker."""


class Died:
    """In place of a result: the process that worked on it ended without a word."""


class Pool:
    """Worker processes, started when first needed and gone when left.

    Each does one task at a time and is a pool of its own, so that one that ends takes no other's work along.

    Parameters
    ----------
    workers : int
        0 runs the tasks in this process, one after the other, with the threads it has.
    prepare : callable
        Run once in each worker, with ``given``; it and the tasks must be importable.
    given : sequence
    """

    def __init__(self, workers: int, *, prepare: Callable[..., None], given: Sequence[Any]) -> None:
        self._workers, self._prepare, self._given = workers, prepare, tuple(given)
        self._executors: dict[int, ProcessPoolExecutor] = {}
        self._before: set[multiprocessing.process.BaseProcess] = set()

    def __enter__(self) -> Pool:
        self._before = set(multiprocessing.active_children())
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        children = set(multiprocessing.active_children()) - self._before if self._executors else set()
        for executor in self._executors.values():
            executor.shutdown(wait=kind is None, cancel_futures=True)
        if kind is not None:
            for child in children:
                child.terminate()
            for child in children:
                child.join()

    def run(self, task: Callable[[int], Any], numbers: Sequence[int]) -> Iterator[tuple[int, Any]]:
        """The results of a task for each number, as they are done.

        Raises
        ------
        MusclefitError
            A worker died, as it does when memory runs out.
        """
        for number, result in self.run_all(task, numbers):
            if isinstance(result, Died):
                raise MusclefitError(
                    "a worker process ended without a word, as when memory runs out, or when a script starts "
                    'work outside of if __name__ == "__main__":; what is finished is kept: run it again with '
                    "fewer workers"
                )
            yield number, result

    def run_all(self, task: Callable[[int], Any], numbers: Sequence[int]) -> Iterator[tuple[int, Any]]:
        """As `run`, but a worker that dies is replaced, and the number that it worked on comes with `Died`."""
        if not self._workers:
            if numbers:
                self._prepare(*self._given)
            for number in numbers:
                yield number, task(number)
            return
        left, waiting = list(reversed(numbers)), dict[Future[Any], tuple[int, int]]()
        with _pinned():
            for slot in range(min(self._workers, len(left))):
                number = left.pop()
                waiting[self._submit(slot, task, number)] = slot, number
            while waiting:
                done, _ = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    slot, number = waiting.pop(future)
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        self._executors.pop(slot).shutdown(wait=True)
                        result = Died()
                    if left:
                        following = left.pop()
                        waiting[self._submit(slot, task, following)] = slot, following
                    yield number, result

    def _submit(self, slot: int, task: Callable[[int], Any], number: int) -> Future[Any]:
        if slot not in self._executors:
            self._executors[slot] = ProcessPoolExecutor(
                1,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_begin,
                initargs=(slot, self._workers, self._prepare, self._given),
            )
        try:
            return self._executors[slot].submit(task, number)
        except BrokenProcessPool:  # it ended while it had nothing to do
            self._executors.pop(slot).shutdown(wait=True)
            return self._submit(slot, task, number)


def _begin(slot: int, workers: int, prepare: Callable[..., None], given: tuple[Any, ...]) -> None:
    """Leave interrupts to the parent, end when it ends, keep to a share of the processors, and prepare."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if hasattr(os, "sched_setaffinity"):  # booleans use all processors they may run on, whatever the environment says
        mine = sorted(os.sched_getaffinity(0))
        share = len(mine) // workers
        if share:
            os.sched_setaffinity(0, mine[slot::workers][:share])
    prepare(*given)


def _end_with_parent() -> None:
    """Wait for the parent to end, as when it is killed, and end at once: what tasks write, they write atomically."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # this runs in a worker
    parent.join()
    os._exit(1)


@contextmanager
def _pinned() -> Iterator[None]:
    """Processes started meanwhile use one thread each in their numeric libraries."""
    before = {name: os.environ.get(name) for name in PINNED}
    os.environ.update(dict.fromkeys(PINNED, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
