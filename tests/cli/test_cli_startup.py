"""``musclefit --help`` comes at once: it imports nothing that computes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from musclefit.cli import main

HEAVY = ("numba", "scipy", "trimesh", "pyvista", "vtk", "igl", "manifold3d", "skimage", "jinja2", "PIL")

SAY = f"""
import sys
from musclefit.cli import main
main(["--help"])
sys.stdout.write("|" + ",".join(sorted(set({HEAVY!r}) & set(sys.modules))))
"""


def test_help_imports_nothing_that_computes():
    done = subprocess.run([sys.executable, "-c", SAY], capture_output=True, text=True, check=True)
    shown, imported = done.stdout.rsplit("|", 1)
    assert "sequence" in shown
    assert imported == ""


INTERRUPT_IMPORTS = """
import sys, signal
from importlib.abc import MetaPathFinder
from musclefit.cli import main

class Interrupts(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "cyclopts":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupts())
sys.exit(main(["--help"]))
"""


def test_an_interruption_while_importing_is_told_in_a_line():
    done = subprocess.run([sys.executable, "-c", INTERRUPT_IMPORTS], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == "musclefit: interrupted; nothing was left half-written\n"


@pytest.mark.parametrize("error", [KeyError("a_key"), RuntimeError("two\nlines"), MemoryError(), RecursionError()])
def test_an_unforeseen_error_has_an_exit_code_and_a_log_of_its_own(error, tmp_path, monkeypatch, capsys):
    def fail(*_args, **_options):
        raise error

    monkeypatch.setenv("MUSCLEFIT_LOGS", str(tmp_path / "logs"))
    monkeypatch.setattr("musclefit.workflows.check.check", fail)
    assert main(["check", "somewhere"]) == 3
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert type(error).__name__ in said.err
    assert "please report it" in said.err
    (log,) = (tmp_path / "logs").iterdir()
    assert str(log) in said.err
    text = log.read_text()
    assert "Traceback" in text
    assert "['check', 'somewhere']" in text


def test_an_error_that_cannot_be_logged_is_still_told(tmp_path, monkeypatch, capsys):
    def fail(*_args, **_options):
        raise KeyError("a_key")

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MUSCLEFIT_LOGS", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path / "file"))
    monkeypatch.setattr("musclefit.workflows.check.check", fail)
    assert main(["check", "somewhere"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_the_exit_codes_are_in_help(capsys):
    main(["--help"])
    assert "3: unexpected error" in " ".join(capsys.readouterr().out.replace("│", " ").split())
