"""Every command prints JSON for programs where it is asked to, and nothing else on standard output."""

from __future__ import annotations

import json
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.cli.commands import app, main
from musclefit.io.rig_names import builtin_rigs

OTHERWISE = {"schema": "prints JSON already", "init": "writes a rig, and says what to do next"}
"""Commands without the option, and why."""


def commands() -> list[str]:
    return [name for name in app if not name.startswith("-")]


def test_commands_are_found() -> None:
    assert {"run", "sequence", "check", "repair", "cage"} <= set(commands())


@pytest.mark.parametrize("name", sorted(set(commands()) - set(OTHERWISE)))
def test_a_command_has_the_option(name: str) -> None:
    assert "json" in signature(app[name].default_command).parameters


@pytest.mark.parametrize("name", ["run", "demo", "sequence"])
def test_commands_that_draw_can_leave_it(name: str) -> None:
    assert "no_pictures" in signature(app[name].default_command).parameters


def test_a_cage_is_told_in_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    ball.export(tmp_path / "ball.ply")
    out = tmp_path / "cage.ply"
    assert main(["cage", str(tmp_path / "ball.ply"), str(out), "--vertices", "200", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    cage = trimesh.load(out)
    assert (told["vertices"], told["triangles"]) == (len(cage.vertices), len(cage.faces))
    assert told["volume_mm3"] == pytest.approx(cage.volume, rel=1e-6)
    assert told["skin_volume_mm3"] == pytest.approx(ball.volume, rel=1e-6)
    lengths = cage.edges_unique_length
    assert told["edge_median_mm"] == pytest.approx(np.median(lengths), rel=1e-6)
    assert told["skin_off_mean_mm"] <= told["skin_off_max_mm"] < told["edge_median_mm"]


def test_rigs_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rigs", "--json"]) == 0
    listed = {rig["name"]: rig for rig in json.loads(capsys.readouterr().out)["rigs"]}
    assert list(listed) == list(builtin_rigs())
    assert not listed["upper_limb"]["needs_data"]
    assert listed["forearm_rigid"]["needs_data"]
