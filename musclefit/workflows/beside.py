"""Work that is done beside other work, in a thread of its own, and is given up when the other fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event
from typing import Generic, TypeVar

from musclefit.progress import Progress, Tick

Done = TypeVar("Done")


class GivenUpError(Exception):
    """Raised within work that nobody waits for any more."""


class Beside(Generic[Done]):
    """Work in a thread of its own; to be used as a context, which ends it.

    Parameters
    ----------
    work : callable
        Takes the progress that it tells its stages, and gives what it is wanted for. It is given up at a tick.
    progress : Progress
        Told of the work's stages, from its thread.
    """

    def __init__(self, work: Callable[[Progress], Done], *, progress: Progress) -> None:
        self._stop = Event()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="musclefit-beside")
        self._future: Future[Done] = self._pool.submit(work, _Stopped(progress, self._stop))

    def __enter__(self) -> Beside[Done]:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown(wait=True)

    def __call__(self) -> Done:
        """What the work gives, waited for; whatever it raised is raised."""
        return self._future.result()

    def while_well(self, progress: Progress) -> Progress:
        """Progress that raises what the work raised as soon as another stage begins."""
        return _WhileWell(progress, self._future)


class _Stopped:
    """Progress that ends the work at the next tick once it is to stop."""

    def __init__(self, progress: Progress, stop: Event) -> None:
        self._progress, self._stop = progress, stop

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        with self._progress.stage(name) as tick:

            def stopping(fraction: float) -> None:
                if self._stop.is_set():
                    raise GivenUpError
                tick(fraction)

            stopping(0.0)
            yield stopping


class _WhileWell:
    """Progress of the other work."""

    def __init__(self, progress: Progress, beside: Future[Done]) -> None:
        self._progress, self._beside = progress, beside

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        if self._beside.done():
            self._beside.result()
        with self._progress.stage(name) as tick:
            yield tick
