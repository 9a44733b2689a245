"""Every script of examples/: the quick ones run, the others start, and none is forgotten."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
STARTED_ONLY = ("fig5_gyrus.py", "fig6_child_adult.py")
"""Examples that run for minutes or need data: they must import, and tell their options."""


def run(script: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run an example as its first lines say, in a folder of its own."""
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_every_example_is_tested() -> None:
    found = {path.name for path in EXAMPLES.glob("*.py")}
    assert found <= {"retarget_script.py", *STARTED_ONLY}


@pytest.mark.parametrize("script", STARTED_ONLY)
def test_longer_examples_start(script: str, tmp_path: Path) -> None:
    if not (EXAMPLES / script).is_file():
        pytest.skip(f"there is no examples/{script}")
    ended = run(script, "--help", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "--out" in ended.stdout
    assert list(tmp_path.iterdir()) == []


def test_the_retargeting_script_writes_its_report(tmp_path: Path) -> None:
    ended = run("retarget_script.py", "out", folder=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["landmarks"]["max_error_mm"] <= 1e-6
    assert report["provenance"]["settings"]["overrides"] == ["drive.pose.elbow_deg=60"]
    first, *checks = ended.stdout.splitlines()
    assert first.startswith(f"{report['verdict']} {report['status']} landmarks within")
    said = [re.fullmatch(r"(ok|FAIL) +(.+): \S+ .*", line) for line in checks]
    assert [(m[2], m[1] == "ok") for m in said if m] == [(c["name"], c["passed"]) for c in report["checks"]]
    assert len((EXAMPLES / "retarget_script.py").read_text(encoding="utf-8").splitlines()) <= 20
