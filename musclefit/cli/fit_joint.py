"""The command that fits a joint's axis or centre to two bones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import print_json

PASSED = 0


def fit_joint(
    fixed: Annotated[Path, Parameter(help="Surface of the bone that carries the joint: PLY, STL, OBJ, VTP.")],
    moving: Annotated[Path, Parameter(help="Surface of the bone that the joint moves.")],
    /,
    *others: Annotated[
        Path, Parameter(help="Further bones that move with it and face the first too, such as the lunate.")
    ],
    kind: Annotated[
        Literal["hinge", "universal", "saddle", "ball", "named"],
        Parameter(name="--kind", help='"named": the kind that the names of the files say.', show_default=True),
    ] = "hinge",
    within_mm: Annotated[
        float,
        Parameter(
            name="--within-mm",
            help="Surfaces face each other where their gap exceeds the smallest gap by at most this.",
            show_default=True,
        ),
    ] = 5.0,
    units: Annotated[Literal["mm", "cm", "m"], Parameter(name="--units", show_default=True)] = "mm",
    json: Annotated[bool, Parameter(name="--json", negative="", help="Print JSON, not a table of joints.")] = False,
) -> int:
    """Fit a joint's axes or centre to the facing surfaces of bones, and print an entry for a table of joints."""
    from musclefit.workflows.fit_joint import fit_joint as fitted

    found = fitted(fixed, [moving, *others], kind=kind, within_mm=within_mm, units=units)
    if json:
        print_json(found.to_json())
    else:
        print(found.to_toml())
    return PASSED
