"""Options that commands share, and how they print JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any

from cyclopts import Parameter

JsonOption = Annotated[
    bool, Parameter(name="--json", negative="", help="Print JSON on standard output instead of a summary.")
]


def print_json(told: Mapping[str, Any]) -> None:
    """Print what a command did, for programs."""
    print(json.dumps(told, indent=2, ensure_ascii=False))
