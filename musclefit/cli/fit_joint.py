"""The command that fits a joint's axis or centre to two bones."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

PASSED = 0


def fit_joint(
    fixed: Annotated[Path, Parameter(help="Surface of the bone that carries the joint: PLY, STL, OBJ, VTP.")],
    moving: Annotated[Path, Parameter(help="Surface of the bone that the joint moves.")],
    /,
    *,
    kind: Annotated[Literal["hinge", "ball"], Parameter(name="--kind", show_default=True)] = "hinge",
    within_mm: Annotated[
        float, Parameter(name="--within-mm", help="Surfaces of the two within this distance count.", show_default=True)
    ] = 5.0,
    units: Annotated[Literal["mm", "cm", "m"], Parameter(name="--units", show_default=True)] = "mm",
    json: Annotated[bool, Parameter(name="--json", negative="", help="Print JSON, not a table of joints.")] = False,
) -> int:
    """Fit a joint's axis or centre where two bones face each other, and print it for a table of joints."""
    from musclefit.workflows.fit_joint import fit_joint as fitted

    found = fitted(fixed, moving, kind=kind, within_mm=within_mm, units=units)
    print(json_text.dumps(found.to_json(), indent=2) if json else found.to_toml())
    return PASSED
