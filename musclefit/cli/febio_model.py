"""The command that writes a model for FEBio from a run and its muscles' fibres."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json

PASSED = 0


def febio_model(
    run: Annotated[Path, Parameter(help="The folder that a run with tetrahedra wrote.")],
    architecture: Annotated[Path, Parameter(help="The folder that musclefit architecture wrote for the same anatomy.")],
    out: Annotated[Path, Parameter(help="The .feb file to write; replaced.")],
    /,
    *,
    sliding: Annotated[
        bool,
        Parameter(
            name="--sliding",
            negative="",
            help="Leave the filler out: tissues have nodes of their own and slide where they face each other.",
        ),
    ] = False,
    facing_mm: Annotated[
        float | None,
        Parameter(
            name="--facing-mm",
            help="How far apart tissues may be that slide on each other; the mean edge of their triangles without it.",
        ),
    ] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Write an FEBio 4 model: bones moved from rest into the run's pose, muscles with fibres, soft filler between."""
    from musclefit.workflows.febio_model import febio_model as write

    made = write(run, architecture, out, sliding=sliding, facing_mm=facing_mm)
    if json:
        print_json(made.to_json())
    elif not quiet:
        print(made.said())
        for line in made.told:
            print(line)
    return PASSED
