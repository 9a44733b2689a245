"""Cages that cross themselves: named face by face before the run, and used only when the rig says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import egg

from musclefit.errors import MeshError
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import ply_bytes

RIG = """
title = "a ball in a cage"
[anatomy]
files = ["bone_a.ply"]
[drive]
kind = "cage"
source = "cage.ply"
target = "crossed.ply"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A ball in a larger one; the target has one vertex pulled out through the opposite side."""
    inner, cage = (egg((0.0, 0.0, 0.0), (r, r, r), subdivisions=1) for r in (10.0, 15.0))
    crossed = np.array(cage.vertices)
    crossed[0] *= -1.5
    crossed[0] += (1.0, 2.0, 3.0)
    for name, mesh in (("bone_a", inner), ("cage", cage), ("crossed", cage.with_vertices(crossed))):
        (tmp_path / f"{name}.ply").write_bytes(ply_bytes(mesh))
    (tmp_path / "cage.toml").write_text(RIG, encoding="utf-8")
    return tmp_path


def test_each_crossing_pair_of_a_cage_is_named_and_refused(folder: Path) -> None:
    with pytest.raises(MeshError, match=r"cage.toml: drive: \d+ pairs of triangles of the cages cross") as caught:
        read_rig(folder / "cage.toml")
    said = str(caught.value)
    accepted = read_rig(folder / "cage.toml", overrides=["drive.crossings=accept"])
    crossings = [f for f in accepted.findings if f.code == "cage-crossing"]
    assert len(crossings) >= 1
    assert all(f.subject == "crossed" and f.message in said for f in crossings)
    assert said.startswith(f"{folder / 'cage.toml'}: drive: {len(crossings)} pairs")
    assert 'drive.crossings = "accept"' in said
    assert len(accepted.handles) == 42


def test_the_cages_of_the_body_are_named(anatomy_data: Path) -> None:
    from musclefit.io.anatomy import read_surface
    from musclefit.rig.job import cage_crossings

    counts = {}
    for name in ("skin_cage", "skin_cage_heavy", "skin_cage_very_heavy"):
        cage = read_surface(anatomy_data / "body" / f"{name}.ply").mesh()
        counts[name] = len(cage_crossings(cage, name=name))
    assert counts == {"skin_cage": 1, "skin_cage_heavy": 1, "skin_cage_very_heavy": 8}
    found = cage_crossings(cage, name="very_heavy")
    assert found[1].message.startswith(f"very_heavy: triangles 526 {cage.faces[526].tolist()} and 563 ")
    assert np.isfinite(cage.vertices).all()
