"""The command that writes a sequence's motion as one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.workflows.progress import TimedStages

PASSED = 0


def export_motion(
    sequence: Annotated[Path, Parameter(help="The folder that musclefit sequence wrote.")],
    out: Annotated[Path, Parameter(help="The .vtkhdf file to write; replaced.")],
    /,
    *,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Write a sequence as one VTKHDF file for ParaView: triangles once, their points at each time."""
    from musclefit.workflows.export_motion import export_motion as write

    with TimedStages(shown=not quiet) as stages:
        made = write(sequence, out, progress=stages)
    if json:
        print_json(made.to_json())
    elif not quiet:
        print(f"wrote {made.path}: {made.steps} frames of {made.tissues} tissues, {made.points} points each")
        for time_s in made.not_made:
            print(f"the frame at {time_s:g} s was not made and is not in it")
    return PASSED
