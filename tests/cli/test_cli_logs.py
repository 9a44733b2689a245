"""What is told of stages: lines on standard error, all of them with --verbose, and a log file."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest
from tiny_rigs import write_tiny_rig

from musclefit import __version__
from musclefit.cli import main

LINE = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (DEBUG|INFO|ERROR) .+"


@pytest.fixture
def surfaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    folder = write_tiny_rig(tmp_path / "rig").parent
    return next(path for path in folder.iterdir() if path.is_dir())


def test_verbose_tells_every_stage_on_standard_error(surfaces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = main(["check", str(surfaces)])
    said, told = capsys.readouterr()
    assert "begins" not in told
    assert main(["--verbose", "check", str(surfaces)]) == plain
    verbosely = capsys.readouterr()
    assert verbosely.out == said
    begins_and_ends = r"^musclefit: (read and check the surfaces): begins\nmusclefit: \1: \d+\.\d s$"
    assert re.search(begins_and_ends, verbosely.err, re.MULTILINE)
    assert main(["check", str(surfaces), "--verbose"]) == plain
    assert capsys.readouterr().err.count(": begins\n") == verbosely.err.count(": begins\n")
    main(["check", str(surfaces)])
    assert "begins" not in capsys.readouterr().err, "one run's options are not the next one's"


@pytest.mark.parametrize("given", [["--log-file", "run.log"], ["--log-file=run.log"]])
def test_a_log_file_holds_every_stage_and_how_it_ended(
    given: list[str], surfaces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["check", str(surfaces), *given, "--quiet"])
    assert capsys.readouterr() == ("", "")
    lines = Path("run.log").read_text(encoding="utf-8").splitlines()
    assert all(re.fullmatch(LINE, line) for line in lines), lines
    assert f"musclefit {__version__}: check {surfaces}" in lines[0]
    assert sum(": begins" in line for line in lines) >= 2
    assert lines[-1].endswith(f"ended with exit code {code}")
    assert logging.getLogger("musclefit").handlers == []


def test_a_log_file_is_continued_and_holds_refusals(surfaces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["check", str(surfaces), "--log-file", "run.log"])
    before = Path("run.log").read_text(encoding="utf-8")
    assert main(["check", "nowhere", "--log-file", "run.log"]) == 2
    refusal = capsys.readouterr().err.splitlines()[-1].removeprefix("musclefit: ")
    after = Path("run.log").read_text(encoding="utf-8")
    assert after.startswith(before)
    assert f" ERROR {refusal}\n" in after
    assert after.endswith("ended with exit code 2\n")


def test_a_log_file_holds_what_nobody_foresaw(
    surfaces: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of a workflow")

    monkeypatch.setattr("musclefit.workflows.check.check", fails)
    monkeypatch.setattr("musclefit.cli.unforeseen.default_log_folder", lambda: Path("logs").absolute())
    assert main(["check", str(surfaces), "--log-file", "run.log"]) == 3
    held = Path("run.log").read_text(encoding="utf-8")
    assert "ERROR ended by ZeroDivisionError\nTraceback (most recent call last):\n" in held
    assert capsys.readouterr().err.startswith("musclefit: stopped by an unexpected error (ZeroDivisionError: of a work")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["check", "a", "--log-file"], "--log-file: names no file; write --log-file FILE"),
        (["check", "a", "--log-file", "no/run.log"], "--log-file no/run.log: No such file or directory; name a file"),
        (["check", "a", "--verbose", "--quiet"], "--verbose and --quiet contradict each other; give one of them"),
    ],
)
def test_what_cannot_be_logged_is_refused(
    arguments: list[str], message: str, surfaces: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr().err.startswith(f"musclefit: {message}")


def test_help_tells_of_both(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--help"], ["check", "--help"]):
        assert main(arguments) == 0
        said = capsys.readouterr().out
        assert "--verbose" in said
        assert "--log-file" in said
