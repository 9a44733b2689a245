"""Output folders: one command's and one process's at a time; what a killed process left is brought to its end."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import pytest
from tiny_rigs import write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.io.folder_locks import held
from musclefit.io.formats.rows import plain_cell
from musclefit.io.run_folder import REPORT_JSON, Maker, claimed

HOLD = """
import sys, time
from pathlib import Path
from musclefit.io.folder_locks import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
REPORTS = {
    Maker.RUN: {"schema_version": 1, "files": [REPORT_JSON, "ours.ply"], "baseline": None, "tissues": []},
    Maker.CHECK: {"schema_version": 1, "files": [REPORT_JSON], "tissues": []},
    Maker.ARCHITECTURE: {"schema_version": 1, "files": [REPORT_JSON], "without_fibres": {}},
    Maker.REPAIR: {"schema_version": 1, "files": [REPORT_JSON], "overlaps_resolved": []},
}


def _result(folder: Path, by: Maker) -> Path:
    folder.mkdir(parents=True)
    (folder / REPORT_JSON).write_text(json.dumps(REPORTS[by]))
    (folder / "ours.ply").write_text("ply")
    (folder / "notes.txt").write_text("kept")
    return folder


@pytest.mark.parametrize("by", Maker)
@pytest.mark.parametrize("of", Maker)
def test_a_folder_of_another_command_is_refused(by, of, tmp_path):
    folder = _result(tmp_path / "out", of)
    if by is of:
        with claimed(folder, by=by):
            pass
    else:
        with pytest.raises(InputError, match=f"holds the results of musclefit {of}"), claimed(folder, by=by):
            pass
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "ours.ply", REPORT_JSON]


def test_check_does_not_delete_a_run(tmp_path, capsys):
    rig = write_tiny_rig(tmp_path)
    out = tmp_path / "out"
    assert main(["run", str(rig), "--out", str(out), "--no-pictures", "--quiet"]) in (0, 1)
    before = sorted(path for path in out.rglob("*"))
    assert main(["check", str(rig.parent / "anatomy"), "--out", str(out), "--quiet"]) == 2
    assert "holds the results of musclefit run" in capsys.readouterr().err
    assert sorted(path for path in out.rglob("*")) == before


def test_a_folder_is_held_by_one_process_and_by_none_that_was_killed(tmp_path):
    folder = tmp_path / "out"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=rf"is being written by another process \({other.pid}\)"), held(folder):
            pass
        with held(tmp_path / "another"):
            pass
        other.kill()
    with held(folder):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_cleared_and_a_run_put_aside_comes_back(tmp_path):
    out = tmp_path / "out"
    (tmp_path / f".out.partial-{uuid4().hex}").mkdir()
    (tmp_path / f".out.trial-{uuid4().hex}").mkdir()
    foreign = tmp_path / ".out.partial-of-mine"
    foreign.mkdir()
    _result(tmp_path / f".out.former-{uuid4().hex}", Maker.RUN)  # killed between its two renamings
    with claimed(out, by=Maker.RUN):
        assert (out / "notes.txt").read_text() == "kept"
    assert sorted(tmp_path.iterdir()) == [foreign, out]
    (out / "notes.txt").unlink()
    _result(tmp_path / f".out.former-{uuid4().hex}", Maker.RUN)  # killed while it carried over what is not ours
    (tmp_path / f".out.former-{uuid4().hex}").mkdir()  # killed while it removed the former run
    with claimed(out, by=Maker.RUN):
        assert (out / "notes.txt").read_text() == "kept"
    assert sorted(tmp_path.iterdir()) == [foreign, out]


@pytest.mark.parametrize(
    ("cell", "safe"),
    [
        ("biceps", "biceps"),
        ("=1+1", "'=1+1"),
        ("-1.5e-3", "-1.5e-3"),
        ("a\nb\x1b[31m", "a\\nb\\x1b[31m"),
        ("@x", "'@x"),
        (-2.5, -2.5),
    ],
)
def test_names_in_tables_run_nothing(cell, safe):
    assert plain_cell(cell) == safe
