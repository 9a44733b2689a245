"""Work that is done beside other work, in threads of its own, and is given up when the other fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event
from typing import Generic, TypeVar

from musclefit.progress import Progress, Silent, Tick

Given = TypeVar("Given")
Done = TypeVar("Done")

LOOKS_EVERY_S = 0.2
"""While it is waited for."""


class GivenUpError(Exception):
    """Raised within work that nobody waits for any more."""


def at_once(
    work: Callable[[Given, Progress], Done], given: Sequence[Given], *, threads: int, tick: Tick
) -> tuple[Done, ...]:
    """The same work on several things, some at a time, each in a thread of its own.

    Parameters
    ----------
    work : callable
        Takes one of the things and a progress, at whose ticks it is given up when other work fails, or the caller is
        interrupted. What any work raises is raised.
    given : sequence
        The longest first, so that no thread is left alone with it at the end.
    threads : int
    tick : function of a fraction
        Told, from the calling thread, what share of the things is done.
    """
    stop = Event()
    with ThreadPoolExecutor(max(1, threads), thread_name_prefix="musclefit-beside") as pool:
        futures = [pool.submit(work, one, _Stopped(Silent(), stop)) for one in given]
        try:
            waiting = set(futures)
            while waiting:
                done, waiting = wait(waiting, timeout=LOOKS_EVERY_S, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
                tick(1.0 - len(waiting) / len(futures))
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return tuple(future.result() for future in futures)


class Beside(Generic[Done]):
    """Work in a thread of its own; to be used as a context, which ends it.

    Parameters
    ----------
    work : callable
        Takes the progress that it tells its stages, and gives what it is wanted for. It is given up at a tick.
    progress : Progress
        Receives the stages of the work, from its thread.
    waiting : Progress
        Told, from the thread that asks for the result, how long it is waited for.
    """

    def __init__(self, work: Callable[[Progress], Done], *, progress: Progress, waiting: Progress) -> None:
        self._stop, self._waiting = Event(), waiting
        self._stopped = _Stopped(progress, self._stop)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="musclefit-beside")
        self._future: Future[Done] = self._pool.submit(work, self._stopped)

    def __enter__(self) -> Beside[Done]:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown(wait=True)

    def __call__(self) -> Done:
        """What the work gives, waited for; whatever it raised is raised."""
        if not self._future.done():
            farthest = 0.0  # of a stage that follows another, the fraction begins anew
            with self._waiting.stage(f"wait: {self._stopped.stage_now}") as tick:
                while not wait([self._future], timeout=LOOKS_EVERY_S).done:
                    farthest = max(farthest, self._stopped.fraction)
                    tick(farthest)
        return self._future.result()

    def while_well(self, progress: Progress) -> Progress:
        """Progress that raises what the work raised as soon as another stage begins."""
        return _WhileWell(progress, self._future)


class _Stopped:
    """Progress that ends the work at the next tick once it is to stop."""

    def __init__(self, progress: Progress, stop: Event) -> None:
        self._progress, self._stop = progress, stop
        self.stage_now, self.fraction = "work beside", 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        self.stage_now = name
        with self._progress.stage(name) as tick:

            def stopping(fraction: float) -> None:
                if self._stop.is_set():
                    raise GivenUpError
                self.fraction = fraction
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
