"""Every script of examples/: the quick ones run, the others start, and none is forgotten."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from running_scripts import Ended, run_script

from musclefit.figures.rendering import rendering_problem

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
STARTED_ONLY = {
    "fig5_gyrus.py": "--out",
    "fig7_bodies.py": "--no-overlaps",
    "fig6_child_adult.py": "--out",
    "forearm_backends.py": "--no-certificate",
}
STARTED_ONLY |= {"regions.py": "--prepare-only", "fig8_forearm_motion.py": "--frames", "fig9_jump.py": "--workers"}
STARTED_ONLY |= {"opensim_models.py": "--frames", "brain_labels.py": "--surfaces", "label_maps.py": "--voxel-mm"}
STARTED_ONLY |= {"cost_model.py": "--write", "forearm_architecture.py": "--report", "measure.py": "take"}
STARTED_ONLY |= {"forearm_moment_arms.py": "--plot", "control_points.py": "--count", "scan_fits.py": "--only"}
"""Examples that run for minutes or need data: they must import, and tell their options (one of each)."""


def run(script: str, *arguments: str, folder: Path) -> Ended:
    """Run an example as its first lines say, in a folder of its own."""
    return run_script(EXAMPLES / script, *arguments, folder=folder)


def test_every_example_is_tested() -> None:
    found = {path.name for path in EXAMPLES.glob("*.py")}
    assert found <= {"retarget_script.py", "built_in_limb.py", "fig1_subdivision.py", "fig4_bar.py", *STARTED_ONLY}


@pytest.mark.parametrize("script", STARTED_ONLY)
def test_longer_examples_start(script: str, tmp_path: Path) -> None:
    if not (EXAMPLES / script).is_file():
        pytest.skip(f"there is no examples/{script}")
    ended = run(script, "--help", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert STARTED_ONLY[script] in ended.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_varied_study_is_run_beside_its_forecasts(tmp_path: Path) -> None:
    ended = run("cost_model.py", "--hold-out", "6", "--limbs", "2", "--pilots", "1", folder=tmp_path)
    assert ended.returncode in (0, 1), ended.stderr
    first, second, before, after = ended.stdout.splitlines()
    assert re.fullmatch(r"6 ellipsoids: [\d.]+ CPU s, each [\d.]+ to [\d.]+", first)
    assert re.fullmatch(r"2 built-in limbs: [\d.]+ CPU s, each [\d.]+ to [\d.]+", second)
    assert before.startswith("forecast before the first, for 8: ")
    said = re.fullmatch(r"forecast after the first 1 of each, for 6: .* \(([-+]\d+) %\); .* \(([-+]\d+) %\)", after)
    assert said is not None
    assert (max(abs(int(off)) for off in said.groups()) <= 25) == (ended.returncode == 0)


def test_the_retargeting_script_writes_its_report(tmp_path: Path) -> None:
    ended = run("retarget_script.py", "out", folder=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["landmarks"]["max_error_mm"] <= 1e-6
    assert report["provenance"]["settings"]["overrides"] == ["drive.pose.elbow_deg=60", "deformer.method=yu2014"]
    first, *checks = ended.stdout.splitlines()
    assert first.startswith(f"{report['verdict']} {report['status']} landmarks within")
    said = [re.fullmatch(r"(ok|FAIL) +(.+): \S+ .*", line) for line in checks]
    assert [(m[2], m[1] == "ok") for m in said if m] == [(c["name"], c["passed"]) for c in report["checks"]]
    assert len((EXAMPLES / "retarget_script.py").read_text(encoding="utf-8").splitlines()) <= 20


def table_rows(printed: str) -> list[list[str]]:
    """The cells of a printed table's lines, without its heads."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed.splitlines() if line[:1] == "|"]
    return [cells for cells in lines if cells[0] not in ("case", "method") and not cells[0].startswith("---")]


def test_fig1_folds_in_one_shot_and_not_after_subdivision(tmp_path: Path) -> None:
    if rendering_problem():
        pytest.skip(rendering_problem())
    ended = run("fig1_subdivision.py", "--out", "out", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    rows = {cells[0]: cells for cells in table_rows(ended.stdout)}
    for target in ("near", "far", "farther"):
        assert rows[f"{target} targets, one shot"][7] == "refuted"
        assert rows[f"{target} targets, iterative"][1::6] == ["converged", "certified"]
    assert int(rows["far targets, one shot"][4]) > 0
    assert int(rows["far targets, iterative"][4]) == 0
    assert int(rows["farther targets, iterative"][4]) > 0
    assert int(rows["farther targets, iterative, subdivided"][4]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["fig1_subdivision.md", "fig1_subdivision.png"]
    written = (tmp_path / "out" / "fig1_subdivision.md").read_text(encoding="utf-8")
    assert table_rows(written) == table_rows(ended.stdout)


@pytest.mark.slow
def test_a_brain_is_the_same_in_five_forms(tmp_path: Path) -> None:
    pytest.importorskip("nilearn", reason="nilearn is not installed (extra examples)")
    ended = run("brain_labels.py", "--surfaces", "integers", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("white_matter 138,625;") == 5
    assert ended.stdout.count("\n  0 voxels, and 0.0e+00 mm of their middle, off the first form") == 5
    assert "  passed; 3 surfaces of a label map in patient (LPS), mm, 0 joints;" in ended.stdout
    for name in ("grey_matter", "white_matter"):
        fit = re.search(rf"  {name}: volume (\S+) %, vertices within (\S+) voxels", ended.stdout)
        assert fit is not None
        assert abs(float(fit[1])) < 1.0
        assert float(fit[2]) <= 0.6


@pytest.mark.slow
def test_a_limb_comes_back_from_its_labels(tmp_path: Path) -> None:
    ended = run("label_maps.py", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    said = re.search(
        r"passed; 12 surfaces .*\nvolumes off .* (\S+) % at most\nvertices within (\S+) voxels .*\n"
        r"vertices off the true surfaces by (\S+) voxels \(95 %\), (\S+) at most",
        ended.stdout,
    )
    assert said is not None, ended.stdout
    limits = (0.5, 0.5, 0.4, 0.7)
    assert all(float(value) <= limit for value, limit in zip(said.groups(), limits, strict=True)), said.groups()


@pytest.mark.slow
@pytest.mark.anatomy
def test_an_opensim_model_is_carried_over_its_motion(tmp_path: Path) -> None:
    ended = run("opensim_models.py", "--model", "arm26", "--frames", "4", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "subject: passed; map certified" in ended.stdout
    places = re.findall(r"bodies within (\S+) mm of OpenSim's places, rotations within (\S+)", ended.stdout)
    assert len(places) == 2
    assert all(float(mm) < 1e-9 and float(turn) < 1e-12 for mm, turn in places)
    points = re.search(r"38 points at rest within (\S+) mm of where the map takes them", ended.stdout)
    assert points is not None
    assert float(points[1]) < 1e-9
    assert "r_humerus scaled linearly by 1.07" in ended.stdout


@pytest.mark.slow
def test_fig4_reaches_its_marks(tmp_path: Path) -> None:
    if rendering_problem():
        pytest.skip(rendering_problem())
    ended = run("fig4_bar.py", "--out", "out", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    best = [cells for cells in table_rows(ended.stdout) if cells[0] == "Cayley steps, isochoric r^5"]
    assert len(best) == 2
    for _, ended_as, steps, inverted, ratio, _, volume, error, claim in best:
        assert (ended_as, inverted, claim) == ("converged", "0", "certified")
        assert int(steps) <= 6
        assert float(ratio) >= 0.7
        assert abs(float(volume)) <= 0.5
        assert float(error) <= 1e-9
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".md", ".md", ".png", ".png"]


def test_fig4_tells_its_options(tmp_path: Path) -> None:
    ended = run("fig4_bar.py", "--help", folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "--out" in ended.stdout
    assert list(tmp_path.iterdir()) == []


def test_the_notebook_goes_from_the_limb_to_a_checked_pose(tmp_path: Path) -> None:
    done = run("built_in_limb.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "elbow -5.0 to 150.0 deg" in done.stdout
    assert "map certified" in done.stdout
    assert "FAIL bone off rigid" in done.stdout  # as the notebook says of the paper's loop
    assert "'report.html', 'report.json', 'scene.mrml', 'surfaces'" in done.stdout
