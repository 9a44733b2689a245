"""Whole commands on a tiny rig: exit codes, what is written, what is printed, and what an interrupt leaves behind."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from tiny_rigs import LANDMARKS, TISSUES, egg, exchanged_rows, write_landmarks, write_tiny_rig

from musclefit.cli import main
from musclefit.figures.stills import Stills
from musclefit.geometry.meshes import TriMesh
from musclefit.io import run_folder as outputs
from musclefit.io.run_folder import ply_bytes
from musclefit.report.schema import mesh_report_schema, report_schema
from musclefit.workflows import run as runs

NO_PICTURES = "pictures are switched off in this test"


@pytest.fixture(autouse=True)
def surroundings(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, a cache that the tests share, and no pictures, which take seconds each."""
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path_factory.getbasetemp() / "tet-cache"))
    monkeypatch.setattr(runs, "stills", lambda *_, **__: Stills(problem=NO_PICTURES))
    current = tmp_path / "current"
    current.mkdir()
    monkeypatch.chdir(current)
    return current


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    return write_tiny_rig(tmp_path / "rig")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out" / "result"


def read(folder: Path) -> dict[str, Any]:
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(report_schema() if "status" in report else mesh_report_schema()).validate(report)
    return report


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def besides_stages(err: str) -> list[str]:
    """What was told but how long stages took, which is told of slow ones."""
    return [
        line for line in err.splitlines() if not re.fullmatch(r"musclefit: [a-z' ]+: [\d.]+ (s|% after [\d.]+ s)", line)
    ]


# --- run


def test_a_run_writes_its_folder_and_passes(
    rig: Path, out: Path, surroundings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(rig), "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert besides_stages(told.err) == []
    assert told.out.startswith("PASSED  Four balls, bent")
    assert f"written to {out}: report.html, report.json, surfaces\n" in told.out
    report = read(out)
    assert (report["verdict"], report["status"], report["mesh"]) == ("passed", "converged", None)
    assert report["landmarks"]["count"] == LANDMARKS
    assert report["landmarks"]["max_error_mm"] <= 1e-6
    assert [t["name"] for t in report["tissues"]] == ["skin", "muscle_flexor", "bone_distal", "bone_proximal"]
    assert report["baseline"]["status"] != "converged"
    assert set(report["files"]) == files_in(out)
    assert {f"surfaces/{name}.{ending}" for name in TISSUES for ending in ("ply", "vtp")} < files_in(out)
    assert NO_PICTURES in (out / "report.html").read_text(encoding="utf-8")
    assert set(report["provenance"]["input_sha256"]) >= {"tiny.toml", "landmarks.csv", "anatomy/skin.ply"}
    assert list(surroundings.iterdir()) == []
    assert [path.name for path in out.parent.iterdir()] == ["result"]


def test_a_run_with_tetrahedra_writes_them_and_leaves_nothing_in_the_current_folder(
    rig: Path, out: Path, surroundings: Path
) -> None:
    assert main(["run", str(rig), "--out", str(out), "--quiet", "--set", "tets.enabled=true"]) == 0
    mesh = read(out)["mesh"]
    assert mesh["tets"] > 100
    assert (mesh["inverted"], mesh["claim"]) == (0, "certified")
    assert 0 < mesh["min_volume_ratio"] <= 1 <= mesh["max_volume_ratio"]
    assert "tets.vtu" in files_in(out)
    assert list(surroundings.iterdir()) == []


def test_no_tets_wins_over_the_rig(rig: Path, out: Path) -> None:
    main(["run", str(rig), "--out", str(out), "--quiet", "--no-tets", "--set", "tets.enabled=true"])
    assert read(out)["mesh"] is None
    assert "tets.vtu" not in files_in(out)


def test_tets_are_made_when_asked_for_and_not_otherwise(rig: Path, out: Path) -> None:
    rig.write_text(rig.read_text().replace("enabled = false\n", ""))
    main(["run", str(rig), "--out", str(out), "--quiet"])
    assert read(out)["mesh"] is None
    main(["run", str(rig), "--out", str(out), "--quiet", "--tets"])
    assert read(out)["mesh"]["tets"] > 100


def test_a_limit_that_fails_gives_1_and_the_report(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(rig), "--out", str(out), "--set", "limits.muscle_volume_percent=0.001"]) == 1
    told = capsys.readouterr().out
    assert told.startswith("FAILED")
    assert re.search(r"failed: muscle volume change \S+ %, limit 0.001 \(muscle_flexor\)\n  next: Set deformer", told)
    assert "limits for another body, because landmarks drive by a field that may change volume\n" in told
    report = read(out)
    assert report["verdict"] == "failed"
    assert [check["name"] for check in report["checks"] if not check["passed"]] == ["muscle volume change"]


def test_a_run_that_ends_early_gives_1_and_the_report(rig: Path, out: Path) -> None:
    arguments = ["run", str(rig), "--out", str(out), "--quiet", "--set", "deformer.max_steps=1"]
    write_landmarks(rig.with_name("landmarks.csv"), exchanged_rows())
    assert main(arguments) == 1
    report = read(out)
    assert report["verdict"] == "failed"
    assert "max_steps" in report["status"]


def test_the_default_folder_is_named_after_the_rig(rig: Path, surroundings: Path) -> None:
    assert main(["run", str(rig), "--quiet"]) == 0
    assert read(surroundings / "musclefit-out" / "tiny")["title"] == "Four balls, bent"


def test_settings_can_be_replaced(rig: Path, out: Path) -> None:
    more = ["--set", "deformer.kernel=r", "--backend", "rbf", "--set", 'title="Renamed"']
    main(["run", str(rig), "--out", str(out), "--quiet", *more])
    report = read(out)
    assert report["title"] == "Renamed"
    assert "kernel r " in report["method"]
    assert report["provenance"]["settings"]["overrides"] == [
        "deformer.kernel=r",
        'title="Renamed"',
        "deformer.backend=rbf",
    ]


def test_json_is_the_written_report(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(rig), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == read(out)


def test_json_and_quiet_go_together(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["run", str(rig), "--out", str(out), "--json", "--quiet"])
    told = capsys.readouterr()
    assert (json.loads(told.out), told.err) == (read(out), "")


def test_quiet_is_silent(rig: Path, out: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(rig), "--out", str(out), "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")


def test_a_second_run_replaces_the_first_and_keeps_other_files(rig: Path, out: Path) -> None:
    main(["run", str(rig), "--out", str(out), "--quiet", "--set", "tets.enabled=true"])
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    (rig.parent / "anatomy" / "muscle_flexor.ply").rename(rig.parent / "anatomy" / "muscle_extensor.ply")
    assert main(["run", str(rig), "--out", str(out), "--quiet"]) == 0
    found = files_in(out)
    assert set(read(out)["files"]) == found - {"notes.txt"}
    assert "surfaces/muscle_extensor.ply" in found
    assert not {"surfaces/muscle_flexor.ply", "tets.vtu"} & found
    assert (out / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in out.parent.iterdir()] == ["result"]


# --- what is odd but no mistake


def test_an_inside_out_bone_is_turned_and_told(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bone = TISSUES["bone_distal"]
    (rig.parent / "anatomy" / "bone_distal.ply").write_bytes(ply_bytes(TriMesh(bone.vertices, bone.faces[:, ::-1])))
    for arguments in (["run", str(rig)], ["check", str(rig.parent / "anatomy")]):
        assert main([*arguments, "--out", str(out), "--quiet"]) == 0
        (finding,) = read(out)["findings"]
        assert (finding["subject"], finding["code"]) == ("bone_distal", "inside-out")
        assert "now faces outwards" in finding["message"]
        assert "now faces outwards" in (out / "report.html").read_text(encoding="utf-8")
        shutil.rmtree(out)
    main(["check", str(rig.parent / "anatomy")])
    assert "inside-out" in capsys.readouterr().out


HOSTILE = (
    "muscle_<script>alert(1)<",
    "muscle &amp; 'quoted'",
    "muscle_двуглавая мышца 二頭筋",
    "muscle_[red]{{ 7 * 7 }}",
)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such file names")
def test_hostile_names_work_and_are_escaped(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k, name in enumerate(HOSTILE):
        surface = egg((8.0 * k - 12.0, -14, 0), (3, 3, 3), subdivisions=1)
        (rig.parent / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(surface))
    assert main(["run", str(rig), "--out", str(out)]) == 0
    assert main(["check", str(rig.parent / "anatomy"), "--out", str(out.with_name("check"))]) == 0
    assert besides_stages(capsys.readouterr().err) == []
    report = read(out)
    assert set(HOSTILE) < {tissue["name"] for tissue in report["tissues"]}
    assert len({entry["ply"] for entry in report["surfaces"]}) == len(report["tissues"])
    assert all((out / entry["vtp"]).is_file() for entry in report["surfaces"])
    for folder in (out, out.with_name("check")):
        page = (folder / "report.html").read_text(encoding="utf-8")
        assert "<script>alert" not in page
        assert "&lt;script&gt;alert(1)&lt;" in page
        assert "{{ 7 * 7 }}" in page
        assert "&amp;amp;" in page


def test_a_terminal_that_cannot_show_a_name_gets_it_escaped(
    rig: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    muscle = rig.parent / "anatomy" / "muscle_flexor.ply"
    muscle.rename(muscle.with_name("muscle_локоть.ply"))
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="ascii"))
    assert main(["run", str(rig), "--out", str(out), "--set", "limits.muscle_volume_percent=0.001"]) == 1
    assert b"muscle_\\u043b" in shown.getvalue()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere every path is text")
def test_a_folder_whose_name_is_no_text_is_escaped(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = rig.parent.with_name(os.fsdecode(b"l\xf6sung"))
    rig.parent.rename(folder)
    assert main(["run", str(folder / "tiny.toml"), "--out", str(out)]) == 0
    assert "l\udcf6sung" in read(out)["provenance"]["settings"]["anatomy"]["folder"]
    shutil.rmtree(out)
    assert main(["check", str(folder / "anatomy"), "--out", str(out)]) == 0
    assert "l\\udcf6sung" in (out / "report.html").read_text(encoding="utf-8")
    assert "l\udcf6sung" in read(out)["title"]
    assert main(["check", str(folder / "anatomy"), "--json"]) == 0
    assert besides_stages(capsys.readouterr().err) == []


# --- check


def test_check_passes_what_is_in_order(rig: Path, surroundings: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(rig.parent / "anatomy")]) == 0
    told = capsys.readouterr()
    assert besides_stages(told.err) == []
    assert "PASSED" in told.out
    assert "4 tissues, 1280 triangles, 0 findings" in told.out
    assert list(surroundings.iterdir()) == []


def test_check_fails_overlaps_and_names_the_pair(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surface = egg((20, 0, 0), (10, 10, 10))
    (rig.parent / "anatomy" / "muscle_stray.ply").write_bytes(ply_bytes(surface))
    assert main(["check", str(rig.parent / "anatomy"), "--out", str(out)]) == 1
    told = capsys.readouterr().out
    assert "bone_distal / muscle_stray" in told or "muscle_stray / bone_distal" in told
    report = read(out)
    assert report["verdict"] == "failed"
    assert {"bone_distal", "muscle_stray"} in [{pair["a"], pair["b"]} for pair in report["overlaps"]]
    assert files_in(out) == {"report.json", "report.html", "report.junit.xml"}


def test_check_of_files_in_metres_with_kinds(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("skin", "bone_distal"):
        metres = TriMesh(TISSUES[name].vertices / 1000, TISSUES[name].faces)
        (rig.parent / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(metres))
    files = [str(rig.parent / "anatomy" / f"{name}.ply") for name in ("skin", "bone_distal")]
    assert main(["check", *files, "--units", "m", "--kind", "bone_*=muscle", "--json"]) == 0
    tissues = json.loads(capsys.readouterr().out)["tissues"]
    assert [tissue["kind"] for tissue in tissues] == ["skin", "muscle"]
    volume = np.pi * 4 / 3 * 18 * 6 * 6
    assert tissues[1]["volume_mm3"] == pytest.approx(volume, rel=0.1)


def test_check_prints_the_report_it_writes(rig: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["check", str(rig.parent / "anatomy"), "--json", "--out", str(out)])
    written = json.loads(capsys.readouterr().out)
    assert written == read(out)
    main(["check", str(rig.parent / "anatomy"), "--json"])
    printed = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator(mesh_report_schema()).validate(printed)
    measured = ("timings_s", "certificate_cost", "peak_memory_mb")
    assert {k: v for k, v in printed.items() if k not in measured} == {
        k: v for k, v in written.items() if k not in (*measured, "files")
    }


def test_check_quiet_is_silent(rig: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(rig.parent / "anatomy"), "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")


# --- interrupts and failing disks


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device", "tets.vtu")


STAGES = {
    "read": "musclefit.workflows.run.read_rig",
    "tetrahedralise": "musclefit.meshing.ftetwild.fill",
    "march": "musclefit.pipeline.retarget.deform_finely",
    "draw": "musclefit.workflows.run.stills",
    "surfaces": "musclefit.io.run_folder.surface_with_displacements",
    "page": "musclefit.io.run_folder.render_html",
}


@pytest.mark.parametrize("stage", STAGES)
def test_an_interrupt_leaves_nothing(
    stage: str, rig: Path, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(out.parent.with_name("cache")))
    monkeypatch.setattr(STAGES[stage], interrupt)
    assert main(["run", str(rig), "--out", str(out), "--set", "tets.enabled=true"]) == 130
    told = capsys.readouterr()
    assert (told.out, "interrupted" in told.err, "Traceback" in told.err) == ("", True, False)
    assert not out.parent.exists()
    assert {path.name for path in rig.parent.parent.iterdir()} <= {"rig", "current", "cache"}


@pytest.mark.parametrize(("failure", "code"), [(interrupt, 130), (full, 2)])
def test_a_run_that_cannot_be_written_keeps_the_former_one(
    failure: object,
    code: int,
    rig: Path,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["run", str(rig), "--out", str(out), "--quiet"])
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr(outputs, "save_whole", failure)
    assert main(["run", str(rig), "--out", str(out), "--quiet", "--set", "deformer.kernel=r"]) == code
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert [path.name for path in out.parent.iterdir()] == ["result"]
    if code == 2:
        assert "No space left on device (tets.vtu); check the path" in capsys.readouterr().err


# --- the command line itself


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ((), ("demo", "run", "check", "warp-image", "Exit code 0")),
        (("demo",), ("--out", "--no-tets", "--quiet", "--json", "elbow 75")),
        (("run",), ("RIG", "upper_limb", "--out", "--backend", "--set", "--tets", "--no-tets", "--quiet", "--json")),
        (("check",), ("PATHS", "--out", "--units", "mm, cm, m", "--kind", "--quiet", "--json")),
    ],
)
def test_help_names_every_option(
    command: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--help"]) == 0
    told = capsys.readouterr()
    assert besides_stages(told.err) == []
    assert [word for word in words if word not in told.out] == []
    assert "--empty" not in told.out
    assert "--no-quiet" not in told.out


def installed() -> str:
    script = shutil.which("musclefit", path=str(Path(sys.executable).parent))
    assert script, "the script musclefit is not installed beside this Python; pip install -e ."
    return script


def test_the_installed_script_runs_and_leaves_the_current_folder_empty(
    rig: Path, out: Path, surroundings: Path
) -> None:
    arguments = [installed(), "run", str(rig), "--out", str(out), "--set", "tets.enabled=true"]
    ended = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert [line.split(":")[0] for line in besides_stages(ended.stderr)] == ["tetrahedra"]
    assert ended.stdout.startswith("PASSED")
    assert read(out)["mesh"]["inverted"] == 0
    assert list(surroundings.iterdir()) == []
    refused = subprocess.run([installed(), "run", "gone"], capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stdout) == (2, "")
    assert re.fullmatch(r"musclefit: no rig is named 'gone'; known: .*upper_limb.*\n", refused.stderr)


def test_a_reader_that_leaves_early_sees_no_traceback(rig: Path) -> None:
    arguments = [sys.executable, "-m", "musclefit", "check", str(rig.parent / "anatomy"), "--json"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        told = process.stderr.read()
    assert (process.returncode, told) == (141, "")


# --- demo


def test_the_demo_runs_the_best_method_on_the_built_in_limb(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []

    def run(rig: Path, overrides: tuple[str, ...], **options: object) -> int:
        asked.append((rig.name, overrides, options["out"]))
        return 0

    monkeypatch.setattr("musclefit.cli.commands._run", run)
    assert main(["demo", "--out", str(out)]) == 0
    assert asked == [("upper_limb.toml", (), out)]


def test_the_built_in_limb_arrives_by_the_papers_loop(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = ["--set", "deformer.method=yu2014", "--set", "compare.methods=[]", "--no-tets", "--json"]
    assert main(["run", "upper_limb", "--out", str(out), *loop]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report == read(out)
    assert (report["status"], report["title"]) == (
        "converged",
        "Built-in upper limb: elbow 75°, forearm 70°",
    )
    assert report["landmarks"]["max_error_mm"] <= 1e-6
    assert report["map"]["folded_points"] == 0
    assert len(report["tissues"]) == 12
    failed = {check["name"]: check["next_step"] for check in report["checks"] if not check["passed"]}
    assert set(failed) == {"bone off rigid", "muscle volume change"}
    assert all('deformer.method = "rigid-bones"' in step for step in failed.values())


@pytest.mark.slow
def test_the_demo_passes_beside_the_papers_loop_and_one_shot(out: Path) -> None:
    assert main(["demo", "--out", str(out), "--quiet"]) == 0
    report = read(out)
    assert report["verdict"] == "passed"
    assert (report["map"]["claim"], report["mesh"]["claim"]) == ("certified", "certified")
    beside = report["paper_loop"], report["baseline"]
    assert [side["verdict"] for side in beside] == ["failed", "failed"]
    assert (beside[0]["status"], beside[0]["map"]["folded_points"]) == ("converged", 0)
    assert beside[1]["map"]["folded_points"] > 0
    assert max(tissue["rigidity_mm"] or 0.0 for tissue in report["tissues"]) <= 0.01
