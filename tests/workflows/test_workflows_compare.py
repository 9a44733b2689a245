"""Runs side by side: what differs is told, what is better is starred, a run beside itself is the same."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.io.finished_runs import read_finished_run
from musclefit.progress import Silent
from musclefit.report.html import render_differences
from musclefit.report.run_differences import best_of, differences
from musclefit.workflows.compare import compare, distinct_names
from musclefit.workflows.run import run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same limb, bent by 25 degrees with free bones, and by 20 with rigid ones."""
    home = tmp_path_factory.mktemp("runs")
    drive_by_joints(rig := write_tiny_rig(home / "rig"))
    rigid = ["drive.pose.elbow_deg=20", "deformer.method=rigid-bones"]
    run(rig, out=home / "a" / "out", pictures=False, progress=Silent())
    run(rig, out=home / "b" / "out", overrides=rigid, pictures=False, progress=Silent())
    return home / "a" / "out", home / "b" / "out"


def test_what_differs_is_told(runs: tuple[Path, Path]) -> None:
    found = compare(runs).found
    assert found.runs == ("a/out", "b/out")
    settings = {row.name: row.values for row in found.settings}
    assert settings["bones.rigid"] == ("false", "true")
    assert "elbow 25" in settings["drive.pose"][0]
    assert settings["drive.pose"][0] != settings["drive.pose"][1]
    assert "title" not in settings

    read = [read_finished_run(path) for path in runs]
    told = {row.name: row for row in found.measures}
    for k, one in enumerate(read):
        for check in one.report["checks"]:
            assert told[check["name"]].values[k] == check["value"]
    (rest, first), (_, second) = (one.surfaces() for one in read)
    row = next(row for row in found.tissues if row.name == "bone_distal")
    n = len(rest["bone_distal"].surface.vertices)
    apart = first["bone_distal"].surface.vertices - second["bone_distal"].surface.vertices[:n]
    assert row.apart_mm == (0.0, pytest.approx(np.linalg.norm(apart, axis=1).max(), rel=1e-12, abs=0))
    assert (row.apart_mm[1] or 0.0) > 1.0
    assert row.best == (1,), "the rigid one"
    assert found.tissues[0].apart_mm[1] == max(row.apart_mm[1] or 0.0 for row in found.tissues)


def test_a_run_beside_itself_is_the_same(runs: tuple[Path, Path]) -> None:
    found = compare([runs[1], runs[1]]).found
    assert found.best is None
    assert "the same in all" in found.because
    assert found.settings == ()
    assert not any(row.best for rows in (found.measures, found.tissues, found.pairs) for row in rows)
    assert {row.apart_mm for row in found.tissues} == {(0.0, 0.0)}


def test_the_command_prints_and_writes(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = map(str, runs)
    out = tmp_path / "beside"
    assert main(["compare", first, second, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "A: a/out" in said
    assert "bones.rigid" in said
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert "b/out" in page
    assert 'id="scene"' in page
    assert main(["compare", first, second, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert main(["compare", first, second, "--out", str(out)]) == 2
    assert "not an empty folder" in capsys.readouterr().err


def test_folders_without_a_run_are_refused(runs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 2"):
        compare([runs[0]])
    with pytest.raises(InputError, match=r"holds no report\.json"):
        compare([runs[0], tmp_path])
    (tmp_path / "report.json").write_text('{"title": "inspection"}', encoding="utf-8")
    with pytest.raises(InputError, match="is not the report of a run"):
        compare([runs[0], tmp_path])
    report = json.loads((runs[0] / "report.json").read_text(encoding="utf-8"))
    (tmp_path / "report.json").write_text(json.dumps({**report, "schema_version": 99}), encoding="utf-8")
    with pytest.raises(InputError, match="found schema version 99"):
        compare([runs[0], tmp_path])
    report["surfaces"][0]["vtp"] = "../../rig/anatomy/skin.vtp"
    (tmp_path / "report.json").write_text(json.dumps(report), encoding="utf-8")
    with pytest.raises(InputError, match="not in its folder"):
        compare([runs[0], tmp_path])


def _reports(runs: tuple[Path, Path]) -> tuple[dict[str, Any], dict[str, Any]]:
    one, other = (json.loads((runs[1] / "report.json").read_text(encoding="utf-8")) for _ in range(2))
    return one, other


def _check(report: dict[str, Any], name: str) -> dict[str, Any]:
    return next(check for check in report["checks"] if check["name"] == name)


def test_the_better_run_fails_fewer_checks_then_has_the_stronger_claim_then_is_never_worse(
    runs: tuple[Path, Path],
) -> None:
    one, other = _reports(runs)
    _check(other, "landmark error")["value"] = 1e-3
    found = differences({"x": one, "y": other}, apart_mm={})
    assert (found.best, found.because) == (
        0,
        "as many checks fail and the claims are the same, and no check of it is worse",
    )

    _check(one, "muscle volume change")["value"] *= 2.0
    found = differences({"x": one, "y": other}, apart_mm={})
    assert found.best is None
    assert "each better in something" in found.because

    one["map"]["claim"], other["map"]["claim"] = "sampled", "certified"
    assert differences({"x": one, "y": other}, apart_mm={}).best == 1

    _check(other, "landmark error")["passed"] = False
    assert differences({"x": one, "y": other}, apart_mm={}).best == 0
    assert differences({"x": one, "y": other, "z": one}, apart_mm={}).best is None, "two are as good"


def test_values_are_the_same_within_a_thousandth_or_far_below_their_limit() -> None:
    assert best_of((1.0, 1.0005), (None, None)) == ()
    assert best_of((1.0, -1.1), (None, None)) == (0,)
    assert best_of((1e-12, 5e-12), (1e-6, 1e-6)) == ()
    assert best_of((1e-12, 5e-12), (1e-6, None)) == (0,)
    assert best_of((0.0, 0.0, 2.0), (0.0, 0.0, 0.0)) == (0, 1)
    assert best_of((None, 3.0), (1.0, 1.0)) == (1,), "what was not measured is worse"
    assert best_of((None, None), (1.0, 1.0)) == ()


def test_other_bodies_and_pairs_that_one_run_lacks_are_told(runs: tuple[Path, Path]) -> None:
    one, other = _reports(runs)
    other["tissues"][0]["rest_volume_mm3"] *= 1.2
    pair = {"a": "bone_distal", "b": "muscle_flexor", "rest_mm3": 0.0, "deformed_mm3": 5.0, "introduced_mm3": 5.0}
    other["overlaps"] = [pair]
    found = differences({"x": one, "y": other}, apart_mm={})
    assert any("of other bodies" in note for note in found.notes)
    (row,) = found.pairs
    assert row.introduced_mm3 == (0.0, 5.0)
    assert row.best == (0,)
    one["not_checked"] = [{"what": "bone_distal / muscle_flexor", "reason": "no solids"}]
    assert differences({"x": one, "y": other}, apart_mm={}).pairs[0].introduced_mm3 == (None, 5.0)
    one["not_checked"] = [{"what": "muscle_flexor_longus / bone", "reason": "another tissue, whose name begins so"}]
    assert differences({"x": one, "y": other}, apart_mm={}).pairs[0].introduced_mm3 == (0.0, 5.0)
    one["tissues"] = [tissue for tissue in one["tissues"] if tissue["name"] != "muscle_flexor"]
    found = differences({"x": one, "y": other}, apart_mm={})
    assert found.pairs[0].introduced_mm3 == (None, 5.0)
    assert any("do not have the same tissues" in note for note in found.notes)


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.counts: dict[str, int] = {}
        self.handlers = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.handlers += sum(name.startswith("on") for name, _ in attrs)


def _tags(page: str) -> _Tags:
    tags = _Tags()
    tags.feed(page)
    return tags


def test_hostile_names_do_no_harm_in_the_page(runs: tuple[Path, Path]) -> None:
    one, other = _reports(runs)
    hostile = "<script>alert(1)</script>\" onmouseover='x' {{7*7}}"
    plain = render_differences(differences({"x": one, "y": other}, apart_mm={}), links=["", ""], scene=None)
    for report in (one, other):
        report["title"] = hostile
        report["tissues"][0]["name"] = hostile
        report["provenance"]["settings"]["anatomy"]["folder"] = hostile + report["verdict"]
    found = differences({hostile: one, "y": other}, apart_mm={})
    page = render_differences(found, links=["", ""], scene=None)
    assert _tags(page).handlers == 0
    assert _tags(page).counts.get("script") == _tags(plain).counts.get("script")
    assert "{{7*7}}" in page


def test_names_tell_folders_apart() -> None:
    assert distinct_names([Path("/s/left"), Path("/s/right")]) == ["left", "right"]
    assert distinct_names([Path("/s/left/out"), Path("/s/right/out")]) == ["left/out", "right/out"]
    assert distinct_names([Path("/s/out"), Path("/s/out")]) == ["out (1)", "out (2)"]
