"""How long work tells its caller how far it is; the work itself knows neither clock nor screen."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

Tick = Callable[[float], None]
"""Called with the fraction of the stage done so far, 0 to 1; never decreasing."""


MARCH, CERTIFY = "march", "certify the map"
"""Stages whose seconds the report compares."""


class Progress(Protocol):
    """Receives the stages of a long run, one after the other or nested."""

    def stage(self, name: str) -> AbstractContextManager[Tick]:
        """Open a named stage; the context gives the function to tick it with."""
        ...


class Silent:
    """Progress that nobody watches."""

    def stage(self, name: str) -> AbstractContextManager[Tick]:  # noqa: ARG002
        """Open a stage that tells nobody."""
        return nullcontext(_ignore)


def _ignore(fraction: float) -> None:
    """Drop a tick."""
