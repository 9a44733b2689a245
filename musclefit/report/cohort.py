"""Turns the outcomes of a study into a table and one self-contained page; reads no file and judges no run."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from musclefit.report.html import TOLD_FIRST, amount, render_page

OUTLIER_SCORE, OUTLIERS_FROM = 3.5, 8
"""Modified z-score beyond which a value is an outlier, and how many values of a measure it takes to say so."""

_MAD_TO_SIGMA, _MEAN_TO_SIGMA = 1.4826, 1.2533


class Outcome(Protocol):
    """What came of a case."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def subject(self) -> str: ...  # noqa: D102
    @property
    def rig(self) -> str: ...  # noqa: D102
    @property
    def motion(self) -> str: ...  # noqa: D102
    @property
    def facts(self) -> Mapping[str, str]: ...  # noqa: D102
    @property
    def status(self) -> str: ...  # noqa: D102
    @property
    def reason(self) -> str: ...  # noqa: D102
    @property
    def values(self) -> Mapping[str, float | str | None]: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class Outlier:
    """A measure of a case that lies far from those of the others in the same rig and motion.

    Parameters
    ----------
    name : str
        Of the case.
    measure : str
    value, median : float
    score : float
        The modified z-score.
    """

    name: str
    measure: str
    value: float
    median: float
    score: float


def cohort_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row per case: who and how, status and reason, facts about the subject, and measures; None where there is none.

    A fact of the subjects' table that is named like another column gets "subject: " in front.
    """
    facts = list(dict.fromkeys(key for outcome in outcomes for key in outcome.facts))
    measures = list(dict.fromkeys(key for outcome in outcomes for key in outcome.values))
    taken = {"case", "subject", "rig", "motion", "status", "reason", *measures}
    named = {fact: f"subject: {fact}" if fact in taken else fact for fact in facts}
    return [
        {
            "case": outcome.name,
            "subject": outcome.subject,
            "rig": outcome.rig,
            "motion": outcome.motion,
            "status": outcome.status,
            "reason": outcome.reason,
            **{named[fact]: outcome.facts.get(fact) for fact in facts},
            **{measure: outcome.values.get(measure) for measure in measures},
        }
        for outcome in outcomes
    ]


def outliers(outcomes: Sequence[Outcome]) -> tuple[Outlier, ...]:
    """Measures far from the median of their rig and motion, by the modified z-score, the farthest first.

    The score is (x - median) / (1.4826 MAD); where more than half of the values are equal, 1.2533 times the mean
    absolute deviation stands for the MAD (Iglewicz & Hoaglin, How to detect and handle outliers, 1993).
    """
    found = []
    for group in dict.fromkeys((outcome.rig, outcome.motion) for outcome in outcomes):
        members = [outcome for outcome in outcomes if (outcome.rig, outcome.motion) == group]
        for measure in dict.fromkeys(key for outcome in members for key in outcome.values):
            known = [(o.name, v) for o in members if isinstance(v := o.values.get(measure), int | float)]
            if len(known) < OUTLIERS_FROM:
                continue
            values = np.array([value for _, value in known], dtype=float)
            median = float(np.median(values))
            away = np.abs(values - median)
            sigma = _MAD_TO_SIGMA * float(np.median(away)) or _MEAN_TO_SIGMA * float(away.mean())
            if sigma <= 1e-9 * max(1.0, abs(median)):
                continue
            found += [
                Outlier(name, measure, value, median, float(abs(value - median) / sigma))
                for name, value in known
                if abs(value - median) > OUTLIER_SCORE * sigma
            ]
    return tuple(sorted(found, key=lambda outlier: -outlier.score))


def render_cohort(
    title: str,
    outcomes: Sequence[Outcome],
    *,
    thumbnails: Mapping[str, bytes],
    links: Mapping[str, str],
) -> str:
    """One page of a study that needs no other file and no network; every name and text is escaped.

    Parameters
    ----------
    title : str
    outcomes : sequence of Outcome
    thumbnails : mapping of case to JPEG bytes
    links : mapping of case to the address of its own report, from the page
    """
    rows = cohort_rows(outcomes)
    columns = _columns(rows, measures={key for outcome in outcomes for key in outcome.values})
    numeric = {key for key in columns if any(isinstance(row[key], int | float) for row in rows)}
    far = outliers(outcomes)
    counts = Counter(outcome.status for outcome in outcomes)
    passed = counts.get("passed", 0) == len(outcomes)
    return render_page(
        "cohort.html.jinja",
        {
            "report": {"title": title},
            "verdict": "passed" if passed else "failed",
            "counts": counts.most_common(),
            "cases": len(outcomes),
            "subjects": len({outcome.subject for outcome in outcomes}),
            "columns": columns,
            "rows": rows,
            "headings": {key: _heading(key) for key in columns},
            "numeric": numeric,
            "story": _story(rows, [key for key in columns if key in numeric and _told_first(key) < len(TOLD_FIRST)]),
            "far": {(outlier.name, outlier.measure) for outlier in far},
            "outliers": far,
            "failed": [row for row in rows if row["status"] != "passed"],
            "thumbnails": {name: base64.b64encode(data).decode("ascii") for name, data in thumbnails.items()},
            "links": links,
            "outlier_score": OUTLIER_SCORE,
            "outliers_from": OUTLIERS_FROM,
        },
    )


def _heading(column: str) -> tuple[str, str]:
    """The name and the unit of a column."""
    name, _, unit = column.removesuffix("]").partition(" [")
    return name, unit


def _told_first(column: str) -> int:
    """Where a measure stands among those that a page tells first."""
    name = _heading(column)[0]
    return TOLD_FIRST.index(name) if name in TOLD_FIRST else len(TOLD_FIRST)


def _columns(rows: Sequence[Mapping[str, Any]], *, measures: set[str]) -> list[str]:
    """The columns of the page: status, what tells most, other measures, facts; rig and motion where there are several.

    Who it is and which rig and motion is in the name of the case; all columns are in outcomes.csv.
    """
    every = [key for key in (rows[0] if rows else ()) if key not in ("case", "reason", "status", "subject")]
    several = [key for key in ("rig", "motion") if len({row[key] for row in rows}) > 1]
    own = sorted((key for key in every if key in measures), key=lambda key: (_told_first(key), " [" not in key))
    facts = [key for key in every if key not in measures and key not in ("rig", "motion")]
    return ["status", *own, *facts, *several] if rows else []


def _story(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[dict[str, Any]]:
    """How many cases passed, and the worst of the two measures that tell most, those that are 0 throughout last."""
    passed = sum(row["status"] == "passed" for row in rows)
    told = {"name": "Cases passed", "value": f"{passed} of {len(rows)}", "passed": passed == len(rows), "lines": []}
    found: list[tuple[bool, dict[str, Any]]] = []
    for column in columns:
        name, unit = _heading(column)
        known = [(abs(float(row[column])), row["case"]) for row in rows if isinstance(row[column], int | float)]
        known = [(value, case) for value, case in known if np.isfinite(value)]
        if not known:
            continue
        worst, case = max(known)
        median = float(np.median([value for value, _ in known]))
        lines = [case] if worst else []
        lines.append(f"median {amount(median, unit)}, of {len(known)} cases")
        found.append(
            (not worst, {"name": f"Largest {name}", "value": amount(worst, unit), "passed": None, "lines": lines})
        )
    return [told, *(one for _, one in sorted(found, key=lambda pair: pair[0])[:2])]
