"""The JSON Schemas of what musclefit reads and writes, by name."""

from __future__ import annotations

import re
from typing import Any

from musclefit.errors import InputError
from musclefit.io.rig_names import rigs_folder
from musclefit.report.schema import mesh_report_schema, report_schema
from musclefit.rig.rig_schema import rig_schema

NAMES = ("rig", "report", "check")


def schema(name: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of rig files, or of the report of a run or a check.

    Parameters
    ----------
    name : {"rig", "report", "check"}

    Raises
    ------
    InputError
        There is no schema of that name.
    """
    if name not in NAMES:
        raise InputError(f"found {name!r}; there are schemas of: {', '.join(NAMES)}")
    if name == "rig":
        return rig_schema(_meanings())
    made = report_schema() if name == "report" else mesh_report_schema()
    return {"$id": f"urn:musclefit:{name}", **made}


def _meanings() -> dict[str, str]:
    """What each key of a rig means, from the tables that document them: `drive(cage).source`, `limits.landmark_mm`."""
    meanings, kind = {}, ""
    for line in (rigs_folder() / "README.md").read_text(encoding="utf-8").splitlines():
        if heading := re.match(r'`kind = "(\w+)"`', line):
            kind = heading[1]
        elif row := re.match(r"\| `([\w.]+)` \|[^|]*\|[^|]*\| (.*) \|$", line):
            key = row[1].replace("drive.", f"drive({kind}).") if kind else row[1]
            meanings[key] = row[2].replace("`", "")
    return meanings
