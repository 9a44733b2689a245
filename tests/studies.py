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


LIMB_STUDY = """
title = "Limbs"
[subjects]
table = "subjects.csv"
[rigs]
limb = "upper_limb"
[set]
deformer.method = "yu2014"
compare.methods = []
[run]
pictures = false
tets = false
"""


def write_study(folder: Path, angles: Sequence[object], *, extra: str = "") -> Path:
    """A study of one tiny rig that joints drive, in which each subject bends the elbow by an angle of its own."""
    drive_by_joints(write_tiny_rig(folder / "rig"))
    write_subjects(folder, angles)
    study = folder / "study.toml"
    study.write_text(STUDY + extra, encoding="utf-8")
    return study


def write_limb_study(folder: Path, subjects: int) -> Path:
    """A study of the built-in limb, in which each subject has a pose of its own."""
    angles = [(10.0 + 50.0 * k / subjects, 40.0 * (7 * k % subjects) / subjects) for k in range(subjects)]
    rows = [f"s{k:02d},{elbow:.1f},{forearm:.1f}" for k, (elbow, forearm) in enumerate(angles)]
    headings = "subject,drive.pose.elbow_deg,drive.pose.forearm_deg"
    (folder / "subjects.csv").write_text("\n".join([headings, *rows]) + "\n", encoding="utf-8")
    study = folder / "study.toml"
    study.write_text(LIMB_STUDY, encoding="utf-8")
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
        if not path.is_file() or path.name in OF_THE_WAY or "logs" in path.parts:
            continue
        data = path.read_bytes()
        if path.name == "report.json":
            read = json.loads(data)
            for key in ("timings_s", "peak_memory_mb", "certificate_cost"):
                read.pop(key, None)
            data = json.dumps(read, sort_keys=True).encode()
        elif path.name == "report.html":
            data, cut = re.subn(rb"<h3>Time and memory</h3>.*?</table>", b"", data, flags=re.S)
            assert cut == 1
        found[path.relative_to(out).as_posix()] = data
    return found
