"""The command that says how far each joint of a rig can turn before bones collide."""

from __future__ import annotations

import json as json_text
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import SetOption
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.validate.joint_ranges import JointRange, RangeEnd

PASSED = 0


def joint_range(
    rig: Annotated[str, Parameter(help="A rig file that joints drive, or the name of a built-in rig.")],
    /,
    *,
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: Annotated[bool, Parameter(name="--quiet", negative="", help="Print no progress.")] = False,
    json: Annotated[bool, Parameter(name="--json", negative="", help="Print JSON instead of a table.")] = False,
) -> int:
    """Report how far each joint can turn either way before bones collide, with the other joints at rest."""
    from musclefit.workflows.joint_range import joint_range as measure

    with TimedStages(shown=not quiet) as stages:
        found = measure(rig, overrides=set, progress=stages)
    title, ranges = found.title, found.ranges
    if json:
        from musclefit.report.schema import joint_ranges_to_json

        print(json_text.dumps({"title": title, "joint_ranges": joint_ranges_to_json(ranges)}, indent=2))
    else:
        _print(title, ranges)
    return PASSED


def _print(title: str, ranges: Sequence[JointRange]) -> None:
    from rich.console import Console
    from rich.text import Text

    from musclefit.validate.bones import RESOLUTION_DEG, STEP_DEG

    console = Console(highlight=False, soft_wrap=True)
    console.print(Text(f"{title}: how far each joint can turn, the others at rest", style="bold"))
    width = max((len(found.coordinate) for found in ranges), default=0)
    for found in ranges:
        for side, end in (("from", found.low), ("to", found.high)):
            name = found.coordinate if side == "from" else ""
            console.print(Text(f"{name:<{width}}  {side:<4} {end.degrees:7.1f} deg  {_ended(end)}"))
    console.print(
        Text(
            f"Tested at least every {STEP_DEG:g} deg; ends found to {RESOLUTION_DEG:g} deg; contacts are listed "
            f"{STEP_DEG:g} deg beyond the end."
        )
    )
    if ranges and ranges[0].untested:
        console.print(Text(f"Not tested, because they are not closed solids: {', '.join(ranges[0].untested)}"))


def _ended(end: RangeEnd) -> str:
    if end.beyond is None:
        return {"limit": "its limit", "not met": "nothing so far"}[end.ended_by]
    shared = f"overlapping by {end.beyond.beyond_mm3:.3g} mm³"
    return f"{end.beyond.a} / {end.beyond.b}, {end.beyond.depth_mm:.2g} mm deep, {shared}"
