"""Turns what was found of muscle architecture into one self-contained page; measures nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from markupsafe import Markup

from musclefit.report.curves import curves
from musclefit.report.html import render_page

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Curve:
    title: str
    unit: str
    key: str


_CURVES = (
    _Curve("Mean fibre length", "mm", "fibre_mm"),
    _Curve("Fibre length over that at rest", "", "stretch"),
    _Curve("Pennation", "degrees", "pennation_deg"),
    _Curve("Moment arm by the streamlines", "mm", "moment_arm_path_mm"),
    _Curve("Moment arm by the straight line", "mm", "moment_arm_line_mm"),
)

WAY = "share of the way"


def render_architecture(told: Mapping[str, Any]) -> str:
    """One page that needs no other file and no network; every name and text is escaped.

    Parameters
    ----------
    told : mapping
        As report.json of `musclefit architecture` holds it.
    """
    carried = {row["name"]: row for row in told["carried"]}
    page: dict[str, Any] = {
        "report": told,
        "verdict": "muscle architecture",
        "schema_version": told["schema_version"],
        "muscles": [(row, carried.get(row["name"])) for row in told["muscles"]],
        "attachments": [(row, _off_bone(row, carried.get(row["muscle"]))) for row in told["attachments"]],
        "pieces": [row for row in told["muscles"] if row["pieces"] > 1],
        "count": len({row["muscle"] for row in told["attachments"]}),
        "curves": fibre_curves(told["curves"]),
    }
    return render_page("architecture.html.jinja", page)


def _off_bone(end: Row, carried: Row | None) -> tuple[float | None, float | None]:
    """Area over that at rest, and how far off its bone the map takes an attachment, mm."""
    if carried is None:
        return None, None
    return carried[f"{end['end']}_area_ratio"], carried[f"{end['end']}_off_bone_mm"]


def fibre_curves(states: Sequence[Row]) -> dict[str, Markup]:
    """The fibres' numbers on the way as SVG by title: over a joint's angle where one alone turns, or the way itself.

    Parameters
    ----------
    states : sequence of mapping
        Rows of curves.csv, those of a muscle together and in their order.
    """
    by_muscle: dict[str, list[Row]] = {}
    for state in states:
        by_muscle.setdefault(state["muscle"].removeprefix("muscle_"), []).append(state)
    if not by_muscle:
        return {}
    first = next(iter(by_muscle.values()))
    angles = [key for key in first[0] if key.endswith("_deg") and key != "pennation_deg"]
    turning = [key for key in angles if len({state[key] for state in first}) > 1]
    along = [state["at"] for state in first]
    said = WAY
    if len(turning) == 1:
        found = [state[turning[0]] for state in first]
        turned = found if found[-1] > found[0] else found[::-1]
        if all(a < b for a, b in pairwise(turned)):
            along, said = turned, f"{turning[0].removesuffix('_deg').replace('_', ' ')}, degrees"
            by_muscle = {m: rows if turned is found else rows[::-1] for m, rows in by_muscle.items()}
    drawn = {}
    for curve in _CURVES:
        lines = {muscle: [row[curve.key] for row in rows] for muscle, rows in by_muscle.items()}
        svg = curves(along, lines, unit=curve.unit, along=said)
        if svg:
            drawn[curve.title] = Markup(svg)
    return drawn
