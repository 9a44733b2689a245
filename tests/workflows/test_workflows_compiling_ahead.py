"""What is compiled beside a first run is what the run needs, and only where it is needed and not there yet."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from musclefit.io.folder_locks import held
from musclefit.rig.settings import BoneSettings, CertificateSettings
from musclefit.vocabulary import Claim
from musclefit.workflows import compiling_ahead

COMPILED = """
import sys
from numba.core import event
import musclefit as mf

class Names(event.Listener):
    def on_start(self, e):
        function = e.data["dispatcher"].py_func
        if function.__module__.startswith("musclefit"):
            print("compiled", function.__module__, function.__qualname__)
    def on_end(self, e):
        pass

event.register("numba:compile", Names())
done = mf.run(sys.argv[1], pictures=False)
print("claim", done.report.result.map.claim.value)
"""
"""Runs a rig and prints which functions it had to compile."""


def test_the_small_proofs_end() -> None:
    assert [proof.claim for proof in compiling_ahead.small_march_and_proof()] == [Claim.CERTIFIED] * 2


@pytest.mark.parametrize("of", ["a first run", "a later run", "one processor", "no rigid bones", "no proof"])
def test_a_process_is_begun_only_where_it_gains_something(tmp_path: Path, monkeypatch: Any, of: str) -> None:
    bones, proof = BoneSettings(rigid=of != "no rigid bones"), CertificateSettings(enabled=of != "no proof")
    job: Any = SimpleNamespace(rig=SimpleNamespace(bones=bones, certificate=proof))
    begun: list[list[str]] = []
    ended: list[str] = []
    process = SimpleNamespace(terminate=lambda: ended.append("told"), wait=lambda _: ended.append("gone"))

    def begin(command: list[str], **_: Any) -> SimpleNamespace:
        begun.append(command)
        return process

    monkeypatch.setattr(subprocess, "Popen", begin)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0} if of == "one processor" else {0, 1}, raising=False)
    monkeypatch.setattr(compiling_ahead, "_mark", lambda: tmp_path / "mark")
    if of == "a later run":
        (tmp_path / "mark").touch()
    with pytest.raises(KeyError), compiling_ahead.compiled_ahead(job):
        raise KeyError
    expected = [[sys.executable, "-m", compiling_ahead.MODULE]] if of == "a first run" else []
    assert begun == expected
    assert ended == (["told", "gone"] if expected else [])


def test_one_process_at_a_time_compiles(tmp_path: Path, monkeypatch: Any) -> None:
    """Workers that begin together would each take the memory of one more."""
    done: list[str] = []
    monkeypatch.setattr(compiling_ahead, "_mark", lambda: tmp_path / "mark")
    monkeypatch.setattr(compiling_ahead, "small_march_and_proof", lambda: done.append("compiled"))
    with held(tmp_path / "mark"):
        compiling_ahead.compile_ahead()
    assert (done, (tmp_path / "mark").exists()) == ([], False)
    compiling_ahead.compile_ahead()
    assert (done, (tmp_path / "mark").exists()) == (["compiled"], True)


@pytest.mark.slow
def test_a_run_finds_nearly_all_that_it_needs(tmp_path: Path) -> None:
    """Fields' evaluation, fits and bounds, so that a run after it waits for next to nothing."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CACHE")}
    environment["MUSCLEFIT_CACHE"] = str(tmp_path / "cache")
    subprocess.run([sys.executable, "-m", compiling_ahead.MODULE], env=environment, check=True)
    said = subprocess.run(
        [sys.executable, "-c", COMPILED, "upper_limb"], env=environment, check=True, capture_output=True, text=True
    ).stdout
    assert "claim certified" in said
    compiled = [line.split()[1:] for line in said.splitlines() if line.startswith("compiled")]
    assert not [name for module, name in compiled if module.startswith("musclefit.fields.fitting")], compiled
    missing = [f"{module}.{name}" for module, name in compiled if "r2logr" not in f"{module}{name}"]
    assert len(missing) <= 12, missing
