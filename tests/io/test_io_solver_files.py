"""What solvers are given: read back by meshio, or held against the documented rules of FEBio's format 4.0."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import gmsh
import meshio
import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.errors import InputError
from musclefit.io.formats.solvers import (
    FORMATS,
    MIDDLES,
    PLACEHOLDER,
    UNITS,
    LabelledTets,
    MshVersion,
    solver_labels,
    with_middle_nodes,
    write_solver_file,
)

NAMES = ("muscle: biceps / brachii", "empty tissue", "bone")


@pytest.fixture
def tets() -> LabelledTets:
    """Two tissues that share an interface, at places that no short decimal holds, and a node that nothing uses."""
    rest = two_tissues((4, 2, 3))
    vertices = np.vstack([rest.mesh.vertices / 3.0 + (1e3, -0.1, 1e-17), [[9.0, 9.0, 9.0]]])
    return LabelledTets(
        "Elbow <75°> -- *bent*", vertices, rest.mesh.tets, np.where(rest.tissue_of_tet == 0, 0, 2), NAMES
    )


def written(path: Path, tets: LabelledTets) -> Path:
    write_solver_file(path, tets)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    return path


def assert_same(tets: LabelledTets, points: np.ndarray, sets: dict[str, np.ndarray]) -> None:
    """The same nodes, bit for bit, and for each tissue the same tets in the same order of corners."""
    np.testing.assert_array_equal(points, tets.vertices)
    assert list(sets) == list(tets.sets)
    for label, own in tets.sets.items():
        np.testing.assert_array_equal(sets[label], tets.tets[own])


def test_gmsh_is_read_back_by_meshio(tets: LabelledTets, tmp_path: Path) -> None:
    found = meshio.read(written(tmp_path / "arm.msh", tets))
    physical = np.concatenate(found.cell_data["gmsh:physical"])
    cells = np.concatenate([block.data for block in found.cells if block.type == "tetra"])
    numbers = {label: int(tag) for label, (tag, dimension) in found.field_data.items() if dimension == 3}
    order = np.argsort(list(numbers.values()))
    sets = {label: cells[physical == numbers[label]] for label in np.array(list(numbers))[order]}
    text = (tmp_path / "arm.msh").read_text(encoding="ascii")
    tags = np.concatenate(
        [np.array(block.split(), dtype=int) for block in re.findall(r"^3 \d+ 0 \d+\n((?:\d+\n)+)", text, re.MULTILINE)]
    )
    # meshio keeps the order of the file, in which the nodes of the first tissue come first
    points = np.empty_like(found.points)
    points[tags - 1] = found.points
    assert_same(tets, points, {str(label): (tags - 1)[own] for label, own in sets.items()})
    assert text.startswith("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n")


def test_abaqus_is_read_back_by_meshio(tets: LabelledTets, tmp_path: Path) -> None:
    path = written(tmp_path / "arm.inp", tets)
    found = meshio.read(path)
    blocks = [block.data for block in found.cells if block.type == "tetra"]
    text = path.read_text(encoding="ascii")
    labels = re.findall(r"^\*ELEMENT, TYPE=C3D4, ELSET=(\w+)$", text, re.MULTILINE)
    assert_same(tets, found.points, dict(zip(labels, blocks, strict=True)))
    sections = re.findall(r"^\*SOLID SECTION, ELSET=(\w+), MATERIAL=(\w+)$", text, re.MULTILINE)
    materials = re.findall(r"^\*MATERIAL, NAME=(\w+)$", text, re.MULTILINE)
    assert [label for label, _ in sections] == labels
    assert [material for _, material in sections] == materials
    assert f"** {UNITS}" in text
    assert PLACEHOLDER in text
    assert max(map(len, text.splitlines())) <= 256


def test_vtu_is_read_back_by_meshio(tets: LabelledTets, tmp_path: Path) -> None:
    found = meshio.read(written(tmp_path / "arm.vtu", tets))
    tissue = found.cell_data["tissue"][0]
    cells = found.cells[0].data
    assert_same(tets, found.points, {label: cells[tissue == k] for k, label in enumerate(tets.sets)})


def test_febio_keeps_the_rules_of_its_format(tets: LabelledTets, tmp_path: Path) -> None:
    """febio_spec 4.0: order of sections, unique ids, one domain and one material by name for every part."""
    path = written(tmp_path / "arm.feb", tets)
    text = path.read_text(encoding="iso-8859-1")
    assert text.splitlines()[0] == '<?xml version="1.0" encoding="ISO-8859-1"?>'
    assert UNITS in text
    assert PLACEHOLDER in text
    root = ET.fromstring(text)
    assert (root.tag, root.attrib) == ("febio_spec", {"version": "4.0"})
    assert [child.tag for child in root] == ["Module", "Globals", "Material", "Mesh", "MeshDomains", "Output"]
    assert root[0].attrib == {"type": "solid"}
    assert {c.tag for c in root.findall("Globals/Constants/*")} == {"T", "P", "R", "Fc"}
    mesh = root.find("Mesh")
    assert mesh is not None
    assert [child.tag for child in mesh] == ["Nodes", *["Elements"] * len(tets.sets)]
    nodes = mesh.findall("Nodes/node")
    assert [int(n.attrib["id"]) for n in nodes] == list(range(1, len(tets.vertices) + 1))
    points = np.array([[float(x) for x in (n.text or "").split(",")] for n in nodes])
    parts = mesh.findall("Elements")
    assert {part.attrib["type"] for part in parts} == {"tet4"}
    elements = mesh.findall("Elements/elem")
    assert sorted(int(e.attrib["id"]) for e in elements) == list(range(1, len(tets.tets) + 1))
    sets = {
        part.attrib["name"]: np.array([[int(x) - 1 for x in (e.text or "").split(",")] for e in part]) for part in parts
    }
    assert_same(tets, points, sets)
    materials = root.findall("Material/material")
    assert [m.attrib["id"] for m in materials] == [str(k + 1) for k in range(len(materials))]
    assert all(m.attrib["type"] == "neo-Hookean" and {c.tag for c in m} == {"density", "E", "v"} for m in materials)
    domains = root.findall("MeshDomains/SolidDomain")
    assert [d.attrib["name"] for d in domains] == list(sets)
    assert [d.attrib["mat"] for d in domains] == [m.attrib["name"] for m in materials]
    corners = points[np.concatenate(list(sets.values()))]
    assert np.linalg.det(corners[:, 1:] - corners[:, :1]).min() > 0.0  # FEBio's tet4 is right-handed


def test_tissues_share_the_nodes_of_their_interface_and_unused_nodes_are_left_out(tets: LabelledTets) -> None:
    one, other = (set(tets.tets[own].ravel().tolist()) for own in tets.sets.values())
    assert len(one & other) == 3 * 4
    assert len(one | other) == len(tets.vertices) == 5 * 3 * 4


def test_labels_suit_every_format_and_differ_without_case() -> None:
    labels = solver_labels(("Biceps", "biceps", "biceps ", "3rd rib", "肱二頭筋", "", "x" * 200, "x" * 201))
    assert len({label.casefold() for label in labels}) == 8
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,79}", label) for label in labels)
    assert labels[0] == "Biceps"


def test_what_cannot_be_written_is_refused_and_leaves_what_was_there(tets: LabelledTets, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the ending '.stl' is not a known format; use one of .feb, .inp, .msh, .vtu"):
        write_solver_file(tmp_path / "arm.stl", tets)
    (tmp_path / "folder.feb").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_solver_file(tmp_path / "folder.feb", tets)
    with pytest.raises(InputError, match="there is no folder"):
        write_solver_file(tmp_path / "none" / "arm.feb", tets)
    with pytest.raises(InputError, match="no tetrahedron"):
        LabelledTets("none", tets.vertices, tets.tets[:0], tets.tissue_of_tet[:0], NAMES)
    with pytest.raises(InputError, match="labelled 0 to 2, but 2 tissues are named"):
        LabelledTets("few", tets.vertices, tets.tets, tets.tissue_of_tet, NAMES[:2])


@pytest.mark.parametrize("ending", FORMATS)
def test_an_interrupted_write_keeps_the_former_file(
    ending: str, tets: LabelledTets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"arm{ending}"
    path.write_text("former", encoding="utf-8")

    def interrupted(self: Path, target: Path) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_solver_file(path, tets)
    assert path.read_text(encoding="utf-8") == "former"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_gmsh_2_is_read_back_with_its_groups(tets: LabelledTets, tmp_path: Path) -> None:
    write_solver_file(tmp_path / "out.msh", tets, msh=MshVersion.V2)
    assert (tmp_path / "out.msh").read_text(encoding="ascii").startswith("$MeshFormat\n2.2 0 8\n")
    found = meshio.read(tmp_path / "out.msh")
    np.testing.assert_array_equal(found.points, tets.vertices)
    groups = np.concatenate(found.cell_data["gmsh:physical"])
    cells = np.concatenate([block.data for block in found.cells])
    assert {name: int(v[0]) for name, v in found.field_data.items()} == {n: k for k, n in enumerate(tets.sets, start=1)}
    for number, own in enumerate(tets.sets.values(), start=1):
        np.testing.assert_array_equal(cells[groups == number], tets.tets[own])


@pytest.mark.parametrize("name", ["out.inp", "out.vtu", "out.msh", "old.msh"])
def test_quadratic_tetrahedra_have_their_nodes_in_the_middles(name: str, tets: LabelledTets, tmp_path: Path) -> None:
    """Read by meshio, which knows each format's order of nodes: every middle node is where its edge's middle is."""
    made = with_middle_nodes(tets)
    assert len(made.vertices) == len(tets.vertices) + len(np.unique(_edges(tets), axis=0))
    write_solver_file(tmp_path / name, made, msh=MshVersion.V2 if name == "old.msh" else MshVersion.V4)
    found = meshio.read(tmp_path / name)
    blocks = [block for block in found.cells if block.type == "tetra10"]
    assert sum(map(len, blocks)) == len(tets.tets)
    for block in blocks:
        for node, (a, b) in enumerate(MIDDLES, start=4):
            middle = 0.5 * (found.points[block.data[:, a]] + found.points[block.data[:, b]])
            np.testing.assert_allclose(found.points[block.data[:, node]], middle, rtol=0.0, atol=1e-9)


def test_febio_calls_quadratic_tetrahedra_tet10(tets: LabelledTets, tmp_path: Path) -> None:
    write_solver_file(tmp_path / "out.feb", with_middle_nodes(tets))
    root = ET.parse(tmp_path / "out.feb").getroot()
    assert {e.attrib["type"] for e in root.iterfind("Mesh/Elements")} == {"tet10"}
    assert {len((e.text or "").split(",")) for e in root.iterfind("Mesh/Elements/elem")} == {10}


def _edges(tets: LabelledTets) -> np.ndarray:
    return np.sort(np.concatenate([tets.tets[:, edge] for edge in MIDDLES]), axis=1)


@pytest.mark.parametrize("msh", MshVersion)
@pytest.mark.parametrize("quadratic", [False, True])
def test_gmsh_itself_opens_both_versions(quadratic: bool, msh: MshVersion, tets: LabelledTets, tmp_path: Path) -> None:
    write_solver_file(tmp_path / "out.msh", with_middle_nodes(tets) if quadratic else tets, msh=msh)
    gmsh.initialize(["gmsh", "-v", "0"], interruptible=False)
    try:
        gmsh.open(str(tmp_path / "out.msh"))
        groups = gmsh.model.getPhysicalGroups(3)
        assert [gmsh.model.getPhysicalName(*group) for group in groups] == list(tets.sets)
        kinds, numbers, _ = gmsh.model.mesh.getElements(3)
        assert set(kinds.tolist()) == {11 if quadratic else 4}
        volumes = gmsh.model.mesh.getElementQualities(np.concatenate(numbers), "volume")
    finally:
        gmsh.finalize()
    corners = tets.vertices[tets.tets]
    np.testing.assert_allclose(
        np.sort(volumes), np.sort(np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0), rtol=1e-6
    )


def with_fibres(tets: LabelledTets) -> tuple[LabelledTets, np.ndarray]:
    """The muscle's tets get directions of random lengths, the bone's none; and these."""
    fibres = np.random.default_rng(3).normal(size=(len(tets.tets), 3))
    fibres[tets.tissue_of_tet == 2] = 0.0
    return replace(tets, fibres=fibres), fibres


def test_abaqus_gets_an_orientation_for_each_element_with_a_fibre(tets: LabelledTets, tmp_path: Path) -> None:
    made, fibres = with_fibres(tets)
    text = written(tmp_path / "arm.inp", made).read_text(encoding="ascii")
    muscle, bone = made.sets
    own = made.sets[muscle]
    start = text.index(f"*DISTRIBUTION, NAME={muscle}_FIBRES, LOCATION=ELEMENT, TABLE=FIBRE_AXES\n")
    _, default, *lines = text[start : text.index("*ORIENTATION")].splitlines()
    assert default == ", 1., 0., 0., 0., 1., 0."
    rows = np.array([[float(x) for x in line.split(",")] for line in lines])
    np.testing.assert_array_equal(rows[:, 0], own + 1)
    along, beside = rows[:, 1:4], rows[:, 4:]
    np.testing.assert_allclose(along * np.linalg.norm(fibres[own], axis=1)[:, None], fibres[own], rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(beside, axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(np.einsum("ki,ki->k", along, beside), 0.0, atol=1e-15)
    assert f"*ORIENTATION, NAME={muscle}_ORIENTATION, SYSTEM=RECTANGULAR\n{muscle}_FIBRES\n3, 0.\n" in text
    assert f"*SOLID SECTION, ELSET={muscle}, MATERIAL={muscle}_MATERIAL, ORIENTATION={muscle}_ORIENTATION\n" in text
    assert f"*SOLID SECTION, ELSET={bone}, MATERIAL={bone}_MATERIAL\n" in text
    assert text.index("*DISTRIBUTION TABLE, NAME=FIBRE_AXES\nCOORD3D, COORD3D\n") < start
    assert max(map(len, text.splitlines())) <= 256
    assert len(meshio.read(tmp_path / "arm.inp").points) == len(made.vertices)


@pytest.mark.parametrize("quadratic", [False, True])
def test_vtu_holds_the_fibres(quadratic: bool, tets: LabelledTets, tmp_path: Path) -> None:
    made, fibres = with_fibres(tets)
    given = with_middle_nodes(made) if quadratic else made
    found = meshio.read(written(tmp_path / "arm.vtu", given)).cell_data
    stretch = np.linalg.norm(fibres, axis=1)
    np.testing.assert_allclose(found["fibre_stretch"][0], stretch, rtol=1e-15)
    np.testing.assert_allclose(found["fibre"][0] * stretch[:, None], fibres, rtol=1e-14)


@pytest.mark.parametrize("version", list(MshVersion))
def test_gmsh_opens_the_fibres_as_a_view(version: MshVersion, tets: LabelledTets, tmp_path: Path) -> None:
    made, _ = with_fibres(tets)
    write_solver_file(tmp_path / "arm.msh", made, msh=version)
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.merge(str(tmp_path / "arm.msh"))
        (view,) = gmsh.view.getTags()
        kind, numbers, values, _, parts = gmsh.view.getModelData(view, 0)
    finally:
        gmsh.finalize()
    assert (kind, parts) == ("ElementData", 3)
    own = np.flatnonzero(made.tissue_of_tet == 0)
    np.testing.assert_array_equal(np.sort(numbers), own + 1)
    directions = made.fibre_axes[0][np.asarray(numbers, dtype=int) - 1]
    np.testing.assert_allclose(np.array(values), directions, rtol=1e-14)


def test_fibres_of_another_number_than_the_tets_are_refused(tets: LabelledTets) -> None:
    with pytest.raises(InputError, match=r"fibres of shape \(3, 3\)"):
        replace(tets, fibres=np.zeros((3, 3)))
