"""The command that makes a cage of a skin."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json

PASSED = 0


def cage(
    skin: Annotated[Path, Parameter(help="The closed surface to follow: PLY, STL, OBJ, VTP.")],
    out: Annotated[Path, Parameter(help="The cage to write: PLY, in mm.")],
    /,
    *,
    vertices: Annotated[
        int, Parameter(name="--vertices", help="How many vertices the cage has.", show_default=True)
    ] = 500,
    units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--units", help="Length unit of the skin's file.", show_default=True)
    ] = "mm",
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Make a cage around a skin: even triangles, none of which cross. Its moved vertices drive a body."""
    from musclefit.workflows.cage import cage as make

    made = make(skin, out, vertices=vertices, units=units)
    if not quiet:
        for finding in made.findings:
            print(finding.message, file=sys.stderr)
    if json:
        print_json({"cage": str(out), **made.measures(), "findings": [asdict(finding) for finding in made.findings]})
    elif not quiet:
        print(f"wrote {out}: {made.said()}")
    return PASSED
