"""Options that commands share, and how they print JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any

from cyclopts import Parameter

QuietOption = Annotated[bool, Parameter(name="--quiet", negative="", help="Print errors only.")]
JsonOption = Annotated[
    bool, Parameter(name="--json", negative="", help="Print JSON on standard output instead of a summary.")
]
SetOption = Annotated[
    tuple[str, ...],
    Parameter(name="--set", help="key=value: replace one value of the rig file. May be repeated."),
]


def print_json(told: Mapping[str, Any]) -> None:
    """Print what a command did, for programs; ValueError at a number that is not finite, which JSON does not know."""
    print(json.dumps(told, indent=2, allow_nan=False))
