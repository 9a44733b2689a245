"""Studies of tiny rigs as files, and their results as what must not differ between two ways of running them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from tiny_rigs import drive_by_joints, write_tiny_rig

OF_THE_WAY = ("cost.json", "costs.csv", "slurm.sh", "cases.txt")
"""Files that tell what a study took, or how it was run."""

STUDY = """
title = "Elbows"
[subjects]
table = "subjects.csv"
[rigs]
bent = "rig/tiny.toml"
[run]
pictures = false
"""


def write_study(folder: Path, angles: Sequence[object], *, extra: str = "") -> Path:
    """A study of one tiny rig that joints drive, in which each subject bends the elbow by an angle of its own."""
    drive_by_joints(write_tiny_rig(folder / "rig"))
    write_subjects(folder, angles)
    study = folder / "study.toml"
    study.write_text(STUDY + extra, encoding="utf-8")
    return study


def write_subjects(folder: Path, angles: Sequence[object]) -> None:
    """The table of subjects s00, s01, ... with their angles and a fact."""
    rows = [f"s{k:02d},{angle},{20 + k}" for k, angle in enumerate(angles)]
    (folder / "subjects.csv").write_text(
        "\n".join(["subject,drive.pose.elbow_deg,age", *rows]) + "\n", encoding="utf-8"
    )


def contents_but_for_times(out: Path) -> dict[str, bytes]:
    """The bytes of every file that a study wrote, by path; reports without the lines that tell times and memory."""
    found = {}
    for path in sorted(out.rglob("*")):
        if (
            not path.is_file()
            or path.name in ("cost.json", "costs.csv", "slurm.sh", "cases.txt")
            or "logs" in path.parts
        ):
            continue
        data = path.read_bytes()
        if path.name == "report.json":
            read = json.loads(data)
            for key in ("timings_s", "peak_memory_mb", "certificate_cost"):
                read.pop(key, None)
            data = json.dumps(read, sort_keys=True).encode()
        elif path.name == "report.html":
            data = re.sub(rb"<section[^>]*>\s*<h2>(The run|Run|This run).*", b"", data, flags=re.S)
        found[path.relative_to(out).as_posix()] = data
    return found
