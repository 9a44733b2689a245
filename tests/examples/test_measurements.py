"""The page of measurements says what was kept, and what is kept comes from reports and scripts."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def measure() -> ModuleType:
    spec = importlib.util.spec_from_file_location("measure", EXAMPLES / "measure.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["measure"] = module
    spec.loader.exec_module(module)
    return module


def outcome(**more: object) -> dict[str, object]:
    tissues = [
        {"kind": "muscle", "volume_change_percent": change, "rigidity_mm": None} for change in (-0.5, 0.125, 0.25)
    ]
    bone = {"kind": "bone", "volume_change_percent": 9.0, "rigidity_mm": 0.0}
    return {
        "verdict": "passed",
        "map": {"claim": "certified", "margin": 0.25, "folded_points": 0, "min_jacobian_determinant": 0.391},
        "steps": 4,
        "landmarks": {"max_error_mm": 7.04e-12},
        "overlap_total": {"introduced_mm3": 5.436},
        "tissues": [*tissues, bone],
        "bones": {"field_residual_mm": {"max": 2e-12}, "exposed_samples": 61150},
        "paper_loop": None,
        "baseline": None,
        "peak_memory_mb": 1234.0,
    } | more


def test_the_page_says_what_is_kept(measure):
    text = measure.PAGE.read_text(encoding="utf-8")
    assert measure.page(text, measure.kept()) == text, "run: python examples/measure.py write"


def test_a_number_changed_by_hand_is_found(measure):
    record = measure.record_of("finger", outcome(), {"cpu_s": 1.0, "wall_s": 1.0}, {"date": "d", "commit": "c"})
    text = measure.page(measure.PAGE.read_text(encoding="utf-8"), {"finger": record})
    assert "| 0.25 / 0.5 % |" in text
    typed = text.replace("| 0.25 / 0.5 % |", "| 0.2 / 0.4 % |")
    assert measure.page(typed, {"finger": record}) == text != typed


def test_a_report_becomes_a_column(measure, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    other = outcome(bones=None, steps=1)
    (run / "report.json").write_text(json.dumps(outcome(baseline=other)), encoding="utf-8")
    log = tmp_path / "time.txt"
    log.write_text(
        "\tUser time (seconds): 200.50\n\tSystem time (seconds): 20.25\n"
        "\tElapsed (wall clock) time (h:mm:ss or m:ss): 1:02:03\n",
        encoding="utf-8",
    )
    record = measure.taken("left_arm", run, commit="abc", log=log)
    assert record["cpu_s"] == 220.8  # four digits
    assert record["wall_s"] == 3723.0
    rows = dict(line.strip("| ").split(" | ") for line in measure.table("rigid", {"left_arm": record}).splitlines()[2:])
    assert rows["verdict, map"] == "passed, certified"
    assert rows["folded vertices / smallest det J"] == "0 / 0.39"
    assert rows["landmark error"] == "7.0e-12 mm"
    assert rows["muscle volume change, median / worst"] == "0.25 / 0.5 %"
    assert rows["field off the bones' exposed surface, worst"] == "2.0e-12 mm of 61,150 samples"
    assert rows["the paper's loop: bones off rigid; muscle volume, worst; introduced overlap"] == "not run"
    assert rows["one shot: the same"] == "0; 0.5 %; 5.4 mm³"
    assert rows["CPU time, proof included; by the clock"] == "221 s; 3,723 s"
    assert rows["measured"].endswith(", abc")


def test_what_is_kept_replaces_the_former(measure, tmp_path):
    path = tmp_path / "kept.jsonl"
    for name, steps in (("wrist", 1), ("finger", 2), ("wrist", 3)):
        measure.keep({"name": name, "steps": steps}, path)
    assert [(r["name"], r["steps"]) for r in measure.kept(path).values()] == [("finger", 2), ("wrist", 3)]


def test_tables_and_lines_of_scripts(measure):
    lines = measure.printed(
        "| a | b |\n|---|---|\n| x | 1 |\n\nCPU s per frame: 3\nwrote pictures to here\n.\n1 passed in 2 s\n"
    )
    record = {"name": "backends", "lines": lines, "date": "d", "commit": "c"}
    said = measure.table("scripts", {"backends": record})
    assert said.split("\n\n")[1:] == ["| a | b |\n|---|---|\n| x | 1 |", "```text\nCPU s per frame: 3\n```"]


def test_the_commands_name_files_that_are_there(measure, tmp_path, monkeypatch):
    root = EXAMPLES.parent
    monkeypatch.setenv("MUSCLEFIT_DATA", str(tmp_path / "data"))
    for script in measure.SCRIPTS.values():
        assert [word for word in script.command if word.endswith(".py") and not (root / word).is_file()] == []
    for run in measure.RUNS.values():
        assert run.table in measure.TABLES
        rig = Path(run.commands(tmp_path)[-1][4])
        named = (root / "rigs" / f"{rig}.toml").is_file()
        assert named or rig.is_relative_to(tmp_path)


def test_bad_input_is_refused(measure, tmp_path):
    with pytest.raises(SystemExit, match=r"report\.json: not there; give the folder of a run"):
        measure.taken("finger", tmp_path, commit="c")
    (tmp_path / "report.json").write_text(json.dumps(outcome()), encoding="utf-8")
    log = tmp_path / "log"
    log.write_text("nothing", encoding="utf-8")
    with pytest.raises(SystemExit, match="found no times"):
        measure.taken("finger", tmp_path, commit="c", log=log)
    with pytest.raises(ValueError, match="found 0 places of 'landmarks'"):
        measure.page("# no markers", {})
