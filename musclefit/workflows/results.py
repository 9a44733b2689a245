"""What workflows give back: records with a line for a prompt, a table for a notebook, and data frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any, Protocol

from musclefit.report.frames import frames_of
from musclefit.validate.model import Check

if TYPE_CHECKING:
    from pandas import DataFrame


class Shown(ABC):
    """A result that a prompt shows in a line and a notebook as a table."""

    @abstractmethod
    def said(self) -> str:
        """What it is, in a line."""

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Its records by name."""
        return {}

    def to_frames(self) -> dict[str, DataFrame]:
        """Its tables as pandas data frames, by name.

        Raises
        ------
        InputError
            pandas is not installed.
        """
        return frames_of(self.tables())

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.said()}>"

    def _repr_html_(self) -> str:
        return f"<p><b>{escape(type(self).__name__)}</b>: {escape(self.said())}</p>"


class Report(Protocol):
    """What has checks and a verdict of them."""

    @property
    def verdict(self) -> str:
        """Passed or failed."""
        ...

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every check with its limit."""
        ...


class Judged(Shown):
    """A result whose report keeps limits, or does not."""

    report: Report

    @property
    def passed(self) -> bool:
        """Whether all limits are kept."""
        return self.report.verdict == "passed"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{'ok' if check.passed else '<b>FAILED</b>'}</td><td>{escape(check.name)}</td>"
            f"<td style='text-align:right'>{check.value:.4g}</td>"
            f"<td style='text-align:right'>{f'{check.limit:.4g}' if check.limited else 'none'}</td>"
            f"<td>{escape(check.unit)}</td><td>{escape(check.place)}</td></tr>"
            for check in self.report.checks
        )
        head = "<tr><th></th><th>check</th><th>value</th><th>limit</th><th>unit</th><th>where</th></tr>"
        return super()._repr_html_() + (f"<table>{head}{rows}</table>" if rows else "")
