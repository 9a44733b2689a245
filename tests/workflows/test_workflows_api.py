"""The functions for Python: what they take, what they give back, and how that shows itself."""

from __future__ import annotations

import importlib.metadata
import inspect
import io
import logging
import re
import runpy
import subprocess
import sys
from inspect import isfunction, signature
from pathlib import Path

import pytest
from tiny_rigs import write_tiny_rig

import musclefit as mf
from musclefit.workflows import progress as watching
from musclefit.workflows.progress import TimedStages, Whole, watched

COMMANDS = (
    "architecture",
    "batch",
    "collect",
    "compare",
    "render",
    "view",
    "febio_model",
    "run",
    "sequence",
    "check",
    "check_mesh",
    "repair",
    "cage",
    "fit_body",
    "fit_joint",
    "fit_measures",
    "from_labels",
    "joint_range",
    "label_surfaces",
    "warp_image",
    "warp_field",
    "warp_deck",
    "export",
    "import_osim",
    "export_motion",
    "export_osim",
    "init",
)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_tiny_rig(tmp_path / "rig")


def test_every_public_name_is_there_and_told() -> None:
    assert set(mf.__all__) == set(dir(mf))
    for name in mf.__all__:
        assert getattr(mf, name) is not None
    with pytest.raises(AttributeError, match=r"^module 'musclefit' has no attribute 'runs'"):
        _ = mf.runs  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_a_documented_function(name: str) -> None:
    made = getattr(mf, name)
    assert made.__name__ == name
    sections = re.findall(r"^(\w+)\n-+$", inspect.getdoc(made) or "", re.MULTILINE)
    assert sections == ["Parameters", "Returns", "Raises"]


def test_every_public_function_says_what_it_takes_and_gives() -> None:
    functions = [made for name in mf.__all__ if isfunction(made := getattr(mf, name))]
    assert len(functions) > len(COMMANDS)
    for made in functions:
        doc = inspect.getdoc(made) or ""
        sections = re.findall(r"^(\w+)\n-+$", doc, re.MULTILINE)
        gives = ["Returns"] if signature(made).return_annotation != "None" else []
        assert [name for name in sections if name != "Raises"] == ["Parameters", *gives], made
        said = doc.partition("Parameters\n")[2].partition("Returns\n")[0]
        named = {name for line in re.findall(r"^([\w, ]+) : ", said, re.MULTILINE) for name in line.split(", ")}
        assert set(signature(made).parameters) - {"progress"} <= named | {"rules", "kinds"}, made


def test_importing_musclefit_imports_no_library() -> None:
    code = "import sys, musclefit; print(sorted({'numpy', 'numba', 'pyvista', 'rich'} & sys.modules.keys()))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "[]\n"


def test_a_checkout_that_is_not_installed_has_a_version_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    told = runpy.run_path(str(Path(mf.__file__).with_name("_version.py")))
    assert told["__version__"] == "0+not-installed"


def test_a_run_shows_itself_in_a_line_a_table_and_frames(rig: Path, tmp_path: Path) -> None:
    done = mf.run(rig, out=tmp_path / "out", tets=False, pictures=False, progress=None)
    assert done.passed
    assert repr(done).startswith("<Run: Four balls, bent: passed; map certified, mesh none; 1 steps, 4 tissues; in ")
    assert len(repr(done)) < 200
    assert (tmp_path / "out" / "report.json").is_file()
    html = done._repr_html_()
    assert html.count("<tr>") == 1 + len(done.report.checks)
    frames = done.to_frames()
    assert list(frames["tissues"]["name"]) == [tissue.name for tissue in done.rest]
    assert frames["checks"]["value"].notna().any()
    assert done.deformation(done.job.handles.source).shape == done.job.handles.source.shape
    assert done.tets is None


def test_without_a_folder_nothing_is_written(rig: Path, tmp_path: Path) -> None:
    before = {path for path in tmp_path.rglob("*") if "rig" not in path.parts}
    done = mf.run(rig, tets=False)
    assert done.folder is None
    assert done.report.timings_s
    assert {path for path in tmp_path.rglob("*") if "rig" not in path.parts} == before


def test_names_are_escaped_in_notebooks() -> None:
    from musclefit.workflows.joint_range import JointRanges

    assert "<script>" not in JointRanges("<script>alert(1)</script>", ())._repr_html_()


def test_a_rig_may_be_a_mapping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    joints = mf.find_rig("upper_limb").parent / "upper_limb_joints.json"
    given = {
        "title": "a mapping",
        "anatomy": {"builtin": "upper_limb"},
        "drive": {"kind": "joints", "joints": joints, "pose": {"elbow_deg": 20}},
        "deformer": {"method": "yu2014"},
    }
    job = mf.read_rig(given, overrides=["drive.pose.elbow_deg=25"])
    assert dict(job.rig.drive.pose) == {"elbow": 25.0}  # type: ignore[attr-defined]
    assert set(job.hashes) == {"rig", str(joints)}
    with pytest.raises(mf.RigError, match=r"^rig: drive.pose: pose of 'knee': no such joint"):
        mf.read_rig({**given, "drive": {"kind": "joints", "joints": joints, "pose": {"knee_deg": 20}}})
    with pytest.raises(mf.RigError, match="Object of type object is not JSON serializable; give text, numbers"):
        mf.read_rig({**given, "title": object()})


def test_units_and_kinds_may_be_words(rig: Path) -> None:
    folder = rig.parent / "surfaces"
    surfaces = folder if folder.is_dir() else next(p for p in rig.parent.iterdir() if p.is_dir())
    found = mf.check(surfaces, units="mm", kinds={"*": "other"})
    assert {tissue.kind for tissue in found.report.tissues} == {"other"}
    assert set(found.to_frames()) == {"checks", "tissues", "overlaps", "findings"}
    with pytest.raises(mf.InputError, match="units: found 'inch'; expected one of mm, cm, m"):
        mf.check(surfaces, units="inch")
    with pytest.raises(mf.InputError, match="the kind of 'a': found 'organ'; expected one of"):
        mf.check(surfaces, kinds={"a": "organ"})


def test_off_a_terminal_long_stages_are_lines_of_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = iter([0.0, 40.0, 75.0, 0.0, 0.1])
    monkeypatch.setattr(watching.time, "perf_counter", lambda: next(now))
    with caplog.at_level(logging.INFO, logger="musclefit"), watched(None) as stages:
        with stages.stage("march") as tick:
            tick(0.5)
        with stages.stage("quick"):
            pass
    assert [record.message for record in caplog.records] == ["march: 50 % after 40 s", "march: 75.0 s"]
    assert stages.seconds == {"march": 75.0, "quick": 0.1}


def test_the_whole_never_goes_back_and_counts_stages_that_do_not_come() -> None:
    whole = Whole((("read", 1.0), ("march", 6.0), ("prove", 2.0), ("draw", 1.0)))
    ticks = ("march", 0.0), ("march", 0.5), ("prove", 1.0), ("march", 0.1), ("tets", 1.0), ("draw", 1.0)
    told = [whole.tick(name, share) for name, share in ticks]
    assert told == pytest.approx([0.1, 0.4, 0.9, 0.9, 0.9, 1.0])


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bars_tell_elapsed_from_remaining_time_and_show_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with TimedStages(shown=True, shares=(("march", 3.0), ("prove", 1.0))) as stages, stages.stage("march") as tick:
        tick(0.5)
        stages._bars.refresh()
    rows = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", screen.getvalue()).splitlines()
    times = r"elapsed 0:00:0\d left about (-:--:--|0:00:0\d)"
    assert any(re.search(rf"in all +\S+ +38% {times}", row) for row in rows), rows
    assert any(re.search(rf"march +\S+ +50% {times}", row) for row in rows), rows


def test_lines_of_stages_say_how_much_of_the_whole_is_done(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = iter([0.0, 9.0])
    monkeypatch.setattr("musclefit.workflows.progress.time.perf_counter", lambda: next(clock))
    shares = (("march", 3.0), ("prove", 1.0))
    with (
        caplog.at_level(logging.INFO, logger="musclefit"),
        watched(None, shares=shares) as stages,
        stages.stage("march"),
    ):
        pass
    assert [record.message for record in caplog.records] == ["march: 9.0 s (about 75 % in all)"]


def test_a_given_progress_is_told_and_bars_are_not_shown() -> None:
    class Noting:
        def __init__(self) -> None:
            self.told: list[object] = []

        def stage(self, name: str):  # type: ignore[no-untyped-def]
            from contextlib import contextmanager

            @contextmanager
            def opened():  # type: ignore[no-untyped-def]
                self.told.append(name)
                yield self.told.append

            return opened()

    noting = Noting()
    with watched(noting) as stages, stages.stage("march") as tick:
        tick(0.25)
    assert noting.told == ["march", 0.25]
    with TimedStages(shown=False) as own, watched(own) as same:
        assert same is own


def test_records_with_arrays_show_their_sizes_not_their_numbers(rig: Path) -> None:
    job = mf.read_rig(rig)
    made = mf.retarget(job, tets=None)
    for record in (job, job.anatomy, job.anatomy.tissues[0].surface, made, made.result, made.result.deformation):
        assert len(repr(record)) < 200
        assert "array" not in repr(record)
