"""Who watches long work: bars on a terminal and in notebooks, a line per stage elsewhere; keeps their seconds."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from copy import copy

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from musclefit.progress import Progress, Tick

LOG = logging.getLogger("musclefit")
"""Receives every stage: at level INFO what takes long where no bars are shown, at level DEBUG the rest."""

Shares = tuple[tuple[str, float], ...]
"""Stages in the order in which they come, and what part of the time each usually takes; some may not come at all."""

ALL = "in all"

TOLD_FROM_S, TOLD_EVERY_S = 1.0, 30.0
"""Off a terminal a stage is told when it has taken so long, and how far it is every so often."""


class Whole:
    """How much of the whole is done; never less than before.

    Parameters
    ----------
    shares : Shares
        A stage that does not come counts as done when a later one begins; one that is not part of them counts nothing.
    """

    def __init__(self, shares: Shares) -> None:
        total, before = sum(share for _, share in shares), 0.0
        self.done = 0.0
        self._parts: dict[str, tuple[float, float]] = {}
        for name, share in shares:
            self._parts[name] = before / total, share / total
            before += share

    def tick(self, name: str, fraction: float) -> float:
        """The part of the whole that is done when so much of a stage is."""
        before, share = self._parts.get(name, (0.0, 0.0))
        self.done = max(self.done, before + share * fraction)
        return self.done


class TimedStages:
    """Progress that keeps the seconds of each stage.

    Parameters
    ----------
    shown : bool
        Whether to show it: as bars on standard error or in a notebook, or, where there is neither, as lines of the
        logger "musclefit".
    beside : Progress or None
        Receives the same stages.
    shares : Shares
        Of a whole that has a bar of its own.
    """

    def __init__(self, *, shown: bool, beside: Progress | None = None, shares: Shares = ()) -> None:
        self.seconds: dict[str, float] = {}
        self._whole = Whole(shares) if shares else None
        self._shown, self._beside = shown, beside
        self._console = Console(file=None if in_notebook() else sys.stderr)
        self._bars = Bars(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("elapsed"),
            TimeElapsedColumn(),
            TextColumn("left about"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            disable=not shown or not (sys.stderr.isatty() or in_notebook()),
        )
        self._all = self._bars.add_task(ALL, total=1.0) if self._whole is not None else None

    def __enter__(self) -> TimedStages:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """Print a line above the bars, on standard error, unless told to be quiet."""
        if self._shown:
            self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def in_another_thread(self) -> TimedStages:
        """The same, for stages beside those that are told to ``beside``, which knows only one after the other."""
        apart = copy(self)
        apart._beside = None
        return apart

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        """Open a named stage; its seconds add up when the name comes again."""
        task = self._bars.add_task(name, total=1.0)
        LOG.debug("%s: begins", name)
        start = last = time.perf_counter()
        with ExitStack() as stack:
            other = stack.enter_context(self._beside.stage(name)) if self._beside is not None else None

            def tick(fraction: float) -> None:
                nonlocal last
                self._bars.update(task, completed=fraction)
                self._count(name, fraction)
                if other is not None:
                    other(fraction)
                now = time.perf_counter()
                if now - last > TOLD_EVERY_S:
                    last = now
                    level = logging.INFO if self._told else logging.DEBUG
                    LOG.log(level, "%s: %.0f %% after %.0f s%s", name, 100.0 * fraction, now - start, self._so_far)

            try:
                yield tick
            finally:
                took = time.perf_counter() - start
                self.seconds[name] = self.seconds.get(name, 0.0) + took
                self._bars.update(task, completed=1.0)
                self._bars.stop_task(task)
                self._count(name, 1.0)
                level = logging.INFO if self._told and took >= TOLD_FROM_S else logging.DEBUG
                LOG.log(level, "%s: %.1f s%s", name, took, self._so_far)

    def _count(self, name: str, fraction: float) -> None:
        if self._whole is not None and self._all is not None:
            self._bars.update(self._all, completed=self._whole.tick(name, fraction))

    @property
    def _so_far(self) -> str:
        return "" if self._whole is None else f" (about {100.0 * self._whole.done:.0f} % in all)"

    @property
    def _told(self) -> bool:
        return self._shown and bool(self._bars.disable)


def in_notebook() -> bool:
    """Whether this runs in a notebook's kernel."""
    shell = sys.modules.get("IPython")
    return shell is not None and type(shell.get_ipython()).__name__ == "ZMQInteractiveShell"


@contextmanager
def watched(progress: Progress | None, *, shares: Shares = ()) -> Iterator[TimedStages]:
    """Timed stages: those given, or new ones that are shown, or that tell a given progress; with the shares of each."""
    if isinstance(progress, TimedStages):
        yield progress
        return
    with TimedStages(shown=progress is None, beside=progress, shares=shares) as stages:
        yield stages
