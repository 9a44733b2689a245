"""`musclefit warp-deck`: the user's own decks with their nodes where the map takes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from decks import abaqus, febio, lsdyna
from tiny_rigs import write_tiny_rig

import musclefit as mf
from musclefit.cli.commands import main
from musclefit.io.decks import read_deck

DECKS = {".k": lsdyna(), ".inp": abaqus(), ".feb": febio()}


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    return write_tiny_rig(tmp_path_factory.mktemp("rig") / "rig")


@pytest.fixture(scope="module")
def deformation(rig):
    return mf.run(rig, tets=False).deformation


@pytest.mark.parametrize("ending", DECKS)
def test_nodes_go_where_the_map_takes_them_and_elements_are_judged(rig, deformation, ending, tmp_path, capsys):
    given, out = tmp_path / f"given{ending}", tmp_path / f"moved{ending}"
    given.write_bytes(DECKS[ending])
    assert main(["warp-deck", str(rig), str(given), str(out), "--quiet", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    before, after = read_deck(given), read_deck(out)
    np.testing.assert_allclose(after.nodes, deformation(before.nodes), rtol=0, atol=1e-8)
    assert said["largest_move_mm"] > 3.0
    hexes = next(block for block in said["elements"] if block["kind"] == "hexahedron")
    assert hexes["count"] == 12
    assert hexes["inverted_after"] == hexes["introduced"] == 0
    assert 0.3 < hexes["jacobian_after"] < hexes["jacobian_before"]
    assert said["nodes_outside_skin"] == 0
    assert given.read_bytes() == DECKS[ending]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([given.name, out.name])


def test_joint_nodes_that_share_a_place_share_it_after_digit_for_digit(rig, tmp_path, capsys):
    (tmp_path / "a.k").write_bytes(lsdyna())
    assert main(["warp-deck", str(rig), str(tmp_path / "a.k"), str(tmp_path / "b.k")]) == 0
    out = capsys.readouterr().out
    assert "1 places shared by several nodes stay shared" in out
    assert "left as it is: 1 *DEFINE_BOX" in out
    assert "not measured: 1 cards of *ELEMENT_BEAM" in out
    written = (tmp_path / "b.k").read_bytes().split(b"\n")
    lines = {line[:8].strip(): line[8:56] for line in written if b"." in line[8:56]}
    assert lines[b"114"] == lines[b"900"]


def test_a_deck_in_metres_stays_in_metres(rig, deformation, tmp_path):
    deck = read_deck(_written(tmp_path / "mm.inp", abaqus()))
    (tmp_path / "m.inp").write_bytes(deck.rewritten(deck.nodes / 1000.0))
    warped = mf.warp_deck(rig, tmp_path / "m.inp", tmp_path / "out.inp", units="m")
    np.testing.assert_allclose(
        1000.0 * read_deck(tmp_path / "out.inp").nodes, deformation(deck.nodes), atol=1e-9, rtol=0
    )
    assert warped.passed
    assert "36 nodes moved, 13 elements measured, 0 newly inverted" in repr(warped)
    assert len(warped.to_frames()["elements"]) == 2


def test_an_element_that_the_map_turns_inside_out_fails_and_is_written(rig, tmp_path, capsys):
    """A flat tetrahedron, its corners far apart in a bend: the map is one-to-one and the element is not."""
    nodes = ((-50.0, 0.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 20.0), (0.0, 0.05, 5.0))
    lines = ["*NODE", *(f"{k + 1}, {x}, {y}, {z}" for k, (x, y, z) in enumerate(nodes))]
    for order in ("1, 2, 3, 4", "2, 1, 3, 4"):
        text = "\n".join([*lines, "*ELEMENT, TYPE=C3D4", f"1, {order}", ""])
        given = _written(tmp_path / "a.inp", text.encode())
        code = main(["warp-deck", str(rig), str(given), str(tmp_path / "b.inp")])
        out = capsys.readouterr().out
        if code == 1:
            break
    assert code == 1
    assert "FAILED: 1 elements are newly inverted" in out
    assert "inverted 0 -> 1" in out
    assert (tmp_path / "b.inp").is_file()


def test_decks_elsewhere_of_another_ending_or_onto_themselves_are_refused(rig, tmp_path, capsys):
    given = _written(tmp_path / "a.inp", abaqus())
    far = read_deck(given)
    _written(tmp_path / "far.inp", far.rewritten(far.nodes + 5000.0))
    before = sorted(tmp_path.iterdir())
    for arguments, message in (
        ([given, tmp_path / "b.k"], "a deck keeps its format"),
        ([given, given], "is the deck itself"),
        ([given, tmp_path / "none" / "b.inp"], "in a folder that is there"),
        ([tmp_path / "none.inp", tmp_path / "b.inp"], "cannot be read"),
        ([given, tmp_path / "b.inp", "--units", "m"], "likely other units"),
        ([tmp_path / "far.inp", tmp_path / "b.inp"], "likely other units"),
        ([given, tmp_path / "b.inp", "--set", "deformer.max_steps=0"], "max_steps"),
    ):
        assert main(["warp-deck", str(rig), *map(str, arguments), "--quiet"]) == 2
        assert message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
