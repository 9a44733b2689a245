"""The tetrahedraliser's process: nothing is left in the current folder, however it ends, and its failure is told."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.errors import MeshError
from musclefit.io import ftetwild

BALL = trimesh.creation.icosphere(subdivisions=1, radius=10.0)
VERTICES, FACES = np.asarray(BALL.vertices, dtype=np.float64), np.asarray(BALL.faces, dtype=np.int64)


@pytest.fixture(autouse=True)
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the process's temporary folders go; the current folder is another, empty one."""
    folder, current = tmp_path / "scratch", tmp_path / "current"
    folder.mkdir()
    current.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.chdir(current)
    return folder


def fill() -> tuple[np.ndarray, np.ndarray]:
    return ftetwild.fill(VERTICES, FACES, edge_length_fraction=0.3, envelope_fraction=5e-3)


def test_it_leaves_nothing_behind(scratch: Path) -> None:
    vertices, tets = fill()
    assert (vertices.dtype, tets.dtype) == (np.float64, np.int64)
    assert len(tets)
    assert [*Path.cwd().iterdir(), *scratch.iterdir()] == []


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("import sys; sys.exit('out of luck')", r"80 triangles \(exit code 1: out of luck\)"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "killed, as happens when memory runs out"),
        ("import os; os.abort()", "signal SIGABRT"),
        ("raise ValueError('bad surface')", "ValueError: bad surface"),
    ],
)
def test_a_process_that_dies_is_a_mesh_error(
    script: str, told: str, scratch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text(script)
    monkeypatch.setattr(ftetwild, "_WORKER", worker)
    with pytest.raises(MeshError, match=told) as failure:
        fill()
    assert "run without tetrahedra" in str(failure.value)
    assert list(scratch.iterdir()) == []


def test_an_interrupt_ends_the_process_and_leaves_nothing(
    scratch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker = tmp_path / "worker.py"
    worker.write_text("import time; time.sleep(600)")
    started: list[subprocess.Popen[str]] = []

    class Interrupted(subprocess.Popen[str]):
        def communicate(self, *_: object, **__: object) -> tuple[str, str]:
            started.append(self)
            raise KeyboardInterrupt

    monkeypatch.setattr(ftetwild, "_WORKER", worker)
    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        fill()
    assert started[0].returncode is not None
    assert list(scratch.iterdir()) == []


def test_the_worker_reads_no_pickle(tmp_path: Path) -> None:
    np.save(tmp_path / "vertices.npy", np.array([{"not": "an array"}], dtype=object))
    ended = subprocess.run(
        [sys.executable, "-P", str(ftetwild._WORKER), "0x1p-2", "0x1p-8", "1", "0x1p+5"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert "allow_pickle" in ended.stderr
