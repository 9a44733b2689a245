"""The tetrahedraliser's process: nothing is left in the current folder, however it ends, and its failure is told."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import textwrap
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import trimesh

from musclefit.anatomy.mesh_rules import LayerRules
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.meshing import ftetwild

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
    worker.write_text("import time; print('initializing...', flush=True); time.sleep(600)")
    started: list[subprocess.Popen[str]] = []

    class Watched(subprocess.Popen[str]):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            started.append(self)
            super().__init__(*args, **kwargs)

    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ftetwild, "_WORKER", worker)
    monkeypatch.setattr(subprocess, "Popen", Watched)
    with pytest.raises(KeyboardInterrupt):
        ftetwild.fill(VERTICES, FACES, edge_length_fraction=0.3, envelope_fraction=5e-3, tick=interrupted)
    assert started[0].returncode is not None
    assert list(scratch.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the worker ends when it next prints")
def test_the_worker_dies_with_the_process_that_started_it(tmp_path: Path) -> None:
    """SIGKILL to the parent while fTetWild works."""
    script = textwrap.dedent("""
        import os, signal
        import psutil, trimesh
        from musclefit.meshing import ftetwild
        ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
        def die(_):
            (worker,) = psutil.Process().children()
            print(worker.pid, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        ftetwild.fill(ball.vertices, ball.faces, edge_length_fraction=0.02, envelope_fraction=1e-4, tick=die)
    """)
    ended = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == -9, ended.stderr
    with suppress(psutil.NoSuchProcess):
        worker = psutil.Process(int(ended.stdout))
        worker.wait(timeout=60.0)


def test_progress_rises_to_the_last_words_of_ftetwild() -> None:
    one_pass = [f"edge {what} done!" for what in ("splitting", "collapsing", "swapping")] + ["vertex smoothing done!"]
    said = ["Loading mesh...", "initializing...", "edge collapsing done!", *one_pass, *one_pass]
    done = list(ftetwild.fractions_done([*said, "/// postprocessing ///", "edge collapsing done!"]))
    assert done == sorted(done)
    assert done[0] < 0.2
    assert done[1] < 0.5
    np.testing.assert_allclose(done[-1], 0.9, rtol=0.05)
    half = list(ftetwild.fractions_done([*said[:3], *one_pass, "/// postprocessing ///"], passes=1))
    np.testing.assert_allclose(half[-2:], 0.9, rtol=1e-12)


def test_progress_is_told_while_it_meshes() -> None:
    told: list[float] = []
    ftetwild.fill(VERTICES, FACES, edge_length_fraction=0.3, envelope_fraction=5e-3, tick=told.append)
    assert len(told) > 3
    assert told == sorted(told)


def test_the_estimate_grows_with_the_triangles_and_says_it_in_words() -> None:
    def of(subdivisions: int, edge: float = 0.1) -> ftetwild.Estimate:
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=10.0)
        surface = TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        anatomy = Anatomy((Tissue("ball", TissueKind.BONE, surface),), "test, mm")
        return ftetwild.estimate(anatomy, LayerRules(edge, 1e-3))

    small, large = of(1), of(4)
    assert small.seconds < large.seconds < of(4, edge=0.02).seconds
    assert small.memory_mb < large.memory_mb
    assert ftetwild.Estimate(1200.0, 4321.0).in_words == "about 20 min of one core and 4.3 GB of memory"
    assert ftetwild.Estimate(12.3, 321.0).in_words == "about 12 s of one core and 321 MB of memory"


def test_the_worker_reads_no_pickle(tmp_path: Path) -> None:
    np.save(tmp_path / "sizing_lengths.npy", np.zeros(0))
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
