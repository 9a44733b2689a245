"""Decks: nodes read as they stand, rewritten in place, every other byte kept; what cannot be followed is refused."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from decks import abaqus, febio, grid_hexes, grid_nodes, lsdyna, lsdyna_by_commas

from musclefit.errors import InputError
from musclefit.geometry.elements import CellKind, scaled_jacobians
from musclefit.io.decks import read_deck
from musclefit.io.formats.decks.abaqus import parse_abaqus
from musclefit.io.formats.decks.febio import parse_febio
from musclefit.io.formats.decks.lsdyna import parse_lsdyna
from musclefit.io.formats.decks.model import number_in, number_within

DECKS = {
    **{
        f"lsdyna {c} {name}": (parse_lsdyna, lsdyna(ending=e, columns=c))
        for c in ("standard", "long", "i10")
        for name, e in (("unix", "\n"), ("dos", "\r\n"))
    },
    "lsdyna commas": (parse_lsdyna, lsdyna_by_commas()),
    "abaqus": (parse_abaqus, abaqus()),
    "abaqus dos part": (parse_abaqus, abaqus(ending="\r\n", part=True)),
    "febio 4": (parse_febio, febio()),
    "febio 2.5 dos": (parse_febio, febio(ending="\r\n", version="2.5")),
}
each_deck = pytest.mark.parametrize("name", DECKS)


def read(name):
    parse, data = DECKS[name]
    return parse(data, source="deck"), data


def skeleton(data: bytes) -> bytes:
    """The deck with every line of a node's coordinates taken out: what must stay byte for byte."""
    lines = data.split(b"\n")
    number = rb"[-+\d.eE]+"
    return b"\n".join(
        b"" if len(re.findall(number, line)) >= 4 and re.search(rb"\d\.\d", line) else line for line in lines
    )


@each_deck
def test_nodes_are_read_and_hexahedra_too(name):
    deck, _ = read(name)
    np.testing.assert_allclose(deck.nodes[:36], grid_nodes(), rtol=0, atol=1e-7)
    hexes = next(block for block in deck.elements if block.kind is CellKind.HEX)
    assert [row.tolist() for row in hexes.corners] == grid_hexes()
    assert scaled_jacobians(deck.nodes, hexes.corners, kind=CellKind.HEX).min() > 0.98


@each_deck
def test_moved_nodes_are_read_back_and_all_else_is_kept_byte_for_byte(name):
    deck, data = read(name)
    moved = deck.nodes * [1.5, -2.0, 1.0] + [0.1234567890123, 1234.5678901234567, -1e-7]
    written = deck.rewritten(moved)
    assert skeleton(written) == skeleton(data)
    assert written.count(b"\r\n") == data.count(b"\r\n")
    assert len(written.split(b"\n")) == len(data.split(b"\n"))
    again = DECKS[name][0](written, source="again")
    columns = "lsdyna" in name and "commas" not in name
    np.testing.assert_allclose(again.nodes, moved, rtol=0, atol=1e-8 if columns else 0.0)
    assert again.names == deck.names
    # Nodes that stay are written to the same numbers: nothing drifts when a deck goes through twice.
    np.testing.assert_allclose(
        DECKS[name][0](again.rewritten(again.nodes), source="x").nodes, again.nodes, rtol=0, atol=0
    )


@pytest.mark.parametrize("columns", ["standard", "long", "i10"])
def test_lsdyna_columns_stay_columns_and_what_follows_them(columns):
    deck = parse_lsdyna(lsdyna(columns=columns), source="d")
    written = deck.rewritten(-3.0 * deck.nodes).split(b"\n")
    number, place = {"standard": (8, 16), "long": (20, 20), "i10": (10, 16)}[columns]
    rows = [line for line in written if line[:number].strip().isdigit() and b"." in line[number : number + 3 * place]]
    assert len(rows) == 37
    found = [[float(line[number + k * place : number + (k + 1) * place]) for k in range(3)] for line in rows]
    np.testing.assert_allclose(found, -3.0 * deck.nodes, rtol=0, atol=1e-8)
    assert sum(line.endswith(b"       0       7") for line in rows) == 1


def test_lsdyna_solids_that_name_nodes_twice_have_their_shapes():
    deck = parse_lsdyna(lsdyna(), source="d")
    kinds = {block.kind: block for block in deck.elements}
    assert {kind: len(block.names) for kind, block in kinds.items()} == {
        CellKind.HEX: 12,
        CellKind.WEDGE: 1,
        CellKind.TET: 1,
        CellKind.QUAD: 1,
    }
    for kind in (CellKind.WEDGE, CellKind.TET):
        assert scaled_jacobians(deck.nodes, kinds[kind].corners, kind=kind)[0] > 0.2
    assert deck.unmeasured == {"cards of *ELEMENT_BEAM": 1}
    assert deck.kept == {"*DEFINE_BOX": 1}


def test_lsdyna_solids_on_two_cards_and_signs_behind_keywords():
    nodes = "\n".join(
        f"{k + 1:8d}{x:16g}{y:16g}{z:16g}" for k, (x, y, z) in enumerate(((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)))
    )
    long = f"{5:20d}{1.0:20g}{1.0:20g}{1.0:20g}"
    text = (
        f"*KEYWORD\n*NODE\n{nodes}\n*NODE +\n{long}\n*ELEMENT_SOLID\n{7:8d}{1:8d}\n"
        + "".join(f"{n:8d}" for n in (1, 2, 3, 4, 4, 4, 4, 4))
        + f"\n{8:8d}{1:8d}\n"
        + "".join(f"{n:8d}" for n in (2, 3, 4, 5, 5, 5, 5, 5, 0, 0))
        + "\n*INCLUDE\nmore.k\n*INCLUDE_TRANSFORM\nother.k\n       0       0\n"
    )
    deck = parse_lsdyna(text.encode(), source="d")
    assert deck.nodes[4].tolist() == [1.0, 1.0, 1.0]
    assert [(block.kind, block.names) for block in deck.elements] == [(CellKind.TET, ("7", "8"))]
    assert deck.includes == ("more.k", "other.k")


def test_abaqus_shapes_parts_and_what_is_left():
    deck = parse_abaqus(abaqus(part=True), source="d")
    assert deck.names[0] == "BLOCK.1"
    assert [(block.kind, len(block.names)) for block in deck.elements] == [(CellKind.HEX, 12), (CellKind.QUAD, 1)]
    assert deck.unmeasured == {"of type T3D2": 1}
    assert deck.kept == {"*ORIENTATION": 1}


def test_an_abaqus_deck_is_read_alike_by_meshio(tmp_path):
    meshio = pytest.importorskip("meshio")
    deck = parse_abaqus(abaqus(), source="d")
    path = tmp_path / "moved.inp"
    text = deck.rewritten(deck.nodes + 1.25).decode("latin-1").replace("\xe9", "")
    path.write_text(text[: text.index("*ELEMENT, TYPE=S4R")], encoding="ascii")
    path.write_text(path.read_text().replace("type=C3D8R,\n   elset=SOLID", "type=C3D8R"), encoding="ascii")
    theirs = meshio.read(path)
    np.testing.assert_allclose(theirs.points, grid_nodes() + 1.25, rtol=0, atol=1e-12)
    assert theirs.cells_dict["hexahedron"].tolist() == grid_hexes()


def test_a_febio_file_is_read_alike_by_an_xml_library():
    deck = parse_febio(febio(), source="d")
    root = ElementTree.fromstring(deck.rewritten(deck.nodes - 0.5))
    found = [[float(x) for x in node.text.split(",")] for node in root.findall("Mesh/Nodes/node")]
    np.testing.assert_allclose(found, grid_nodes() - 0.5, rtol=0, atol=1e-12)
    assert deck.kept == {"<ElementData>": 1}
    assert root.find("MeshData/ElementData/elem").text == "1,0,0"


@pytest.mark.parametrize(
    ("text", "value"),
    [("1.5", 1.5), (" -.5E2 ", -50.0), ("1.5-3", 0.0015), ("2+1", 20.0), ("1d2", 100.0), ("1.D-1", 0.1), ("", 0.0)],
)
def test_numbers_as_fortran_writes_them(text, value):
    assert number_in(text) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("text", ["&x", "nan", "inf", "1e999", "1_0", "0x1", "1,5", "1 5", "--1", "e5"])
def test_what_is_no_number_is_refused(text):
    with pytest.raises(ValueError, match=r".*"):
        number_in(text)


def test_numbers_fit_their_columns_with_a_blank_in_front():
    for value in (0.0, -0.1, 1 / 3, -1234.5678901234567, 99999.123456789, -1e-7, 1e-300, 123456.0):
        text = number_within(value, 16)
        assert len(text) == 16
        assert text[0] == " "
        assert abs(float(text) - value) <= 1e-6
    with pytest.raises(ValueError, match="does not fit into 8 columns"):
        number_within(-123.456789, 8)


BAD = [
    (".k", b"", "an empty deck"),
    (".k", b"hello\n", "holds no keyword"),
    (".k", b"*KEYWORD\n*END\n", "defines no node"),
    (".k", b"*KEYWORD\n*INCLUDE\nnodes.k\n", "it includes nodes.k"),
    (".k", b"\0\0*NODE", "so it is not text"),
    (
        ".k",
        b"*NODE\n       1           &len             0.0             0.0\n",
        "line 2: node 1: a coordinate is '&len'",
    ),
    (".k", b"*NODE\n       1             nan             0.0             0.0\n", "expected a number"),
    (".k", b"*NODE\n1 0.0 0.0 0.0\n", "a node's number is '1 0.0 0.'"),
    (".k", b"*NODE\n1,0,0\n", "expected number, x, y, z"),
    (".k", b"*NODE\n1,0,0,0\n1,1,1,1\n", "node 1 is defined twice"),
    (".k", b"*NODE\n1,0,0,0\n*NODE_TRANSFORM\n1,1\n", "line 3: *NODE_TRANSFORM moves nodes"),
    (".k", b"*NODE\n1,0,0,0\n*ELEMENT_SOLID\n1,1,x,2\n", "expected whole numbers"),
    (".inp", b"", "an empty deck"),
    (".inp", b"1, 2, 3\n", "holds no keyword"),
    (".inp", b"*NODE\n1, a, 0, 0\n", "line 2: node 1: a coordinate is 'a'"),
    (".inp", b"*NODE\nx, 1, 0, 0\n", "a node's number is 'x'"),
    (".inp", b"*NODE, SYSTEM=C\n1, 1, 0, 0\n", "not rectangular"),
    (".inp", b"*NODE, INPUT=n.inp\n", "it includes n.inp"),
    (".inp", b"*NODE\n1, 1, 0, 0\n*NGEN\n1, 2, 1\n", "line 3: *NGEN generates nodes"),
    (".inp", b"*SYSTEM\n1, 1, 1\n*NODE\n1, 1, 0, 0\n", "*SYSTEM places the nodes"),
    (".inp", abaqus(part=True).replace(b"part=BLOCK\n", b"part=BLOCK\n1., 0., 0.\n"), "instance 'BLOCK-1' is moved"),
    (
        ".inp",
        abaqus(part=True).replace(b"*End Assembly", b"*Instance, name=B, part=BLOCK\n*End Instance\n*End Assembly"),
        "has 2 instances",
    ),
    (".inp", b"*NODE\n1, 1, 0, 0\n*ELEMENT, TYPE=C3D8\n1, 1, 1, 1,\n", "the last element has 3 nodes"),
    (".feb", b"", "an empty deck"),
    (".feb", b"<febio_spec><Mesh>", "is not valid XML"),
    (".feb", b"<a/>", "its first element is <a>"),
    (".feb", b"<febio_spec/>", "defines no node"),
    (".feb", febio().replace(b"-20.0", b"a", 1), "expected"),
    (".feb", febio().replace(b'<node id="7"> ', b'<node id="7"> <!-- x -->'), "hold a comment or an entity"),
    (".feb", b'<!DOCTYPE x [<!ENTITY a "b">]><febio_spec>&a;</febio_spec>', "declares an entity"),
    (".feb", febio().replace(b"<Elements", b'<Instance part="x"/><Elements', 1), "an Instance places a Part"),
    (".bdf", b"x", "decks are read and written as"),
]


@pytest.mark.parametrize(
    ("ending", "data", "message"), BAD, ids=[f"{k}{ending}" for k, (ending, _, _) in enumerate(BAD)]
)
def test_what_is_wrong_with_a_deck_is_said(tmp_path, ending, data, message):
    path = tmp_path / f"deck{ending}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=re.escape(message)):
        read_deck(path)


def test_cut_decks_never_end_in_anything_but_an_answer():
    """Cut anywhere, or with bytes changed: a deck, or an error that says what is wrong."""
    rng = np.random.default_rng(0)
    for parse, data in DECKS.values():
        for _ in range(60):
            damaged = bytearray(data[: rng.integers(1, len(data))])
            for _ in range(int(rng.integers(0, 4))):
                damaged[rng.integers(len(damaged))] = rng.integers(256)
            try:
                deck = parse(bytes(damaged), source="damaged")
            except InputError:
                continue
            assert len(deck.rewritten(deck.nodes)) >= 1
