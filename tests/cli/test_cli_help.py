"""What the help of every command says: keys, options and commands that there are, in the field's words."""

from __future__ import annotations

import re

import pytest

from musclefit.cli.commands import app, main
from musclefit.cli.logs import LOG_FILE, VERBOSE
from musclefit.rig.rig_table import known_keys

COMMANDS = sorted(name for name in app if not name.startswith("-"))
SECTIONS = "anatomy|drive|deformer|bones|surfaces|certificate|tets|mesh|limits|compare|motion"
HOUSE_WORDS = r"\b(crowded|open edges?|pinched|disagreeing|slips?|further points|is no|shall have)\b"


@pytest.fixture
def help_of(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setenv("COLUMNS", "400")

    def said(command: str) -> str:
        assert main([command, "--help"]) == 0
        return capsys.readouterr().out

    return said


@pytest.mark.parametrize("command", COMMANDS)
def test_what_help_names_exists(command: str, help_of) -> None:
    text = help_of(command)
    assert f"musclefit {command}" in text
    keys = set(re.findall(rf"\b(?:{SECTIONS})\.[a-z_]+\b(?!\.)", text)) - set(known_keys())
    assert {key for key in keys if not key.endswith((".toml", ".csv", ".json", ".ply"))} == set()
    options = {name for argument in app[command].assemble_argument_collection() for name in argument.names}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= options | {"--help", "--version", VERBOSE, LOG_FILE}
    assert set(re.findall(r"\bmusclefit ([a-z][a-z-]+)\b", text)) <= set(COMMANDS)
    assert re.findall(HOUSE_WORDS, text) == []
    assert re.findall(r"[ ,]_[a-z]+", text) == [], "what stands in angle brackets is taken for markup"
