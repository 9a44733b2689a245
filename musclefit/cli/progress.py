"""Progress on a terminal: a bar with time left per stage, and the seconds that each took."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from musclefit.progress import Tick


class TimedStages:
    """Progress that keeps the seconds of each stage; shows bars on standard error unless told to be quiet."""

    def __init__(self, *, shown: bool) -> None:
        self.seconds: dict[str, float] = {}
        self._shown = shown
        self._bars = Bars(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr),
            transient=True,
            disable=not shown or not sys.stderr.isatty(),
        )

    def __enter__(self) -> TimedStages:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """Print a line above the bars, on standard error, unless told to be quiet."""
        if self._shown:
            self._bars.console.print(text, markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        """Open a named stage; its seconds add up when the name comes again."""
        task = self._bars.add_task(name, total=1.0)
        start = time.perf_counter()

        def tick(fraction: float) -> None:
            self._bars.update(task, completed=fraction)

        try:
            yield tick
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            self._bars.update(task, completed=1.0)
            self._bars.stop_task(task)
