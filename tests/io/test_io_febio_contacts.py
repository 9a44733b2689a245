"""What hangs on bone and what slides in a model for FEBio: rules, sections, and how many ways it can still move."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skfem
from febio_assembly import held
from pyfebio import boundary, contact, mesh
from skfem.models.elasticity import lame_parameters, linear_elasticity
from tet_blocks import block

from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import barycentric, nearest_places
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.febio_contacts import ContactPair
from musclefit.io.formats.febio_model import FebioModel, write_febio_model
from musclefit.io.formats.fibre_directions import HeldArea, MuscleFibres
from musclefit.io.formats.solvers import LabelledTets
from musclefit.workflows.tissue_contacts import HANGS, Contacts, with_own_nodes

NAMES = ("held", "loose", "bone", "filler")
BONES = {"bone": 0}
TURN = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 1.0, 0.0]), angle_deg=30.0)


def layers() -> LabelledTets:
    """A bone below, filler of 1 mm on it, and on top two muscles side by side that touch at x = 4."""
    cells = block((6, 2, 3))
    x, _, z = cells.vertices[cells.tets].mean(axis=1).T
    label = np.where(z < 1.0, 2, np.where(z < 2.0, 3, np.where(x < 4.0, 0, 1)))
    return LabelledTets("layers", cells.vertices, cells.tets, label, NAMES)


def floor(length: float) -> TriMesh:
    """The lower side of the muscles for x from 0, seen from outside."""
    corners = np.array([[0.0, 0, 2], [length, 0, 2], [length, 2, 2], [0, 2, 2]])
    steps = np.linspace(0.0, 1.0, 9)
    grid = np.array([[u * length, v * 2.0, 2.0] for u in steps for v in steps])
    k = np.arange(81).reshape(9, 9)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    assert np.ptp(corners, axis=0)[2] == 0.0
    return TriMesh(grid, np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)]))


def fibres(*, bone: str = "bone", length: float = 2.0) -> dict[str, MuscleFibres]:
    nothing = np.zeros((0, 3))
    held = (HeldArea(bone, floor(length)),)
    return {"held": MuscleFibres(nothing, nothing, held), "loose": MuscleFibres(nothing, nothing)}


def contacts(tets: LabelledTets, **said) -> Contacts:
    return Contacts(tets, bones=BONES, muscles=fibres(**said), bone_names={"bone": "bone", "filler": "filler"})


def apart() -> LabelledTets:
    return with_own_nodes(layers(), without=["filler"])


def model(tets: LabelledTets, pairs: tuple[ContactPair, ...]) -> FebioModel:
    along = np.tile([1.0, 0.0, 0.0], (len(tets.tets), 1))
    return FebioModel(tets, along, {"bone": TURN}, frozenset({"held", "loose"}), pairs)


def test_a_muscle_is_tied_by_the_faces_that_its_attachment_covers() -> None:
    tets = layers()
    (pair,) = contacts(tets).attachments()
    assert (pair.name, pair.tied, pair.reason) == ("held_tied_to_bone", True, "attachment")
    assert pair.gap_mm == pytest.approx(1.0)
    corners = tets.vertices[pair.faces]
    assert len(corners) == 8
    np.testing.assert_array_equal(corners[..., 2], 2.0)
    assert corners[..., 0].max() == 2.0
    a, b, c = corners.transpose(1, 0, 2)
    assert (np.cross(b - a, c - a)[:, 2] < 0.0).all()  # seen from outside


def test_an_attachment_smaller_than_a_face_takes_one() -> None:
    assert len(contacts(layers(), length=0.2).attachments()[0].faces) == 1


def test_parts_get_nodes_of_their_own_at_their_places() -> None:
    tets = apart()
    assert set(tets.sets) == {"held", "loose", "bone"}
    nodes = [set(np.unique(tets.tets[own]).tolist()) for own in tets.sets.values()]
    assert sum(map(len, nodes)) == len(tets.vertices) == len(set.union(*nodes))
    before = layers()
    for label, own in tets.sets.items():
        np.testing.assert_array_equal(tets.vertices[tets.tets[own]], before.vertices[before.tets[before.sets[label]]])


def test_tissues_slide_where_they_face_each_other_and_what_hangs_on_nothing_is_tied() -> None:
    tets = apart()
    pairs = {(p.primary, p.secondary, p.tied): p for p in contacts(tets).all_pairs(within_mm=1.2)}
    assert set(pairs) == {
        ("held", "bone", True),
        ("loose", "bone", True),
        ("held", "bone", False),
        ("held", "loose", False),
    }
    assert HANGS in pairs["loose", "bone", True].reason
    sliding = tets.vertices[pairs["held", "bone", False].faces]
    assert len(sliding) == 8
    assert sliding[..., 0].min() == 2.0  # not where it is tied
    beside = tets.vertices[pairs["held", "loose", False].faces]
    assert len(beside) == 4
    np.testing.assert_array_equal(beside[..., 0], 4.0)
    near = {(p.primary, p.secondary, p.tied) for p in contacts(tets).all_pairs(within_mm=0.5)}
    assert near == {("held", "bone", True), ("loose", "held", True)}


def test_what_hangs_on_nothing_and_faces_nothing_is_refused() -> None:
    tets = apart()
    moved = np.array(tets.vertices)
    moved[np.unique(tets.tets[tets.sets["loose"]])] += 50.0
    far = LabelledTets("far", moved, tets.tets, tets.tissue_of_tet, NAMES)
    with pytest.raises(InputError, match="loose hangs on nothing"):
        contacts(far).all_pairs(within_mm=1.2)


def test_an_attachment_on_what_is_no_bone_of_the_model_is_refused() -> None:
    for name in ("ulna", "filler"):
        with pytest.raises(InputError, match=f"held holds on to {name}, which is no bone"):
            contacts(layers(), bone=name).attachments()


def test_febio_s_own_models_take_the_contact_whole(tmp_path: Path) -> None:
    tets = apart()
    made = model(tets, contacts(tets).all_pairs(within_mm=1.2))
    extra = ContactPair("held", "loose", made.contacts[-1].faces, True, 0.5, "told")
    made = model(tets, (*made.contacts, extra))
    write_febio_model(tmp_path / "model.feb", made)
    root = ET.parse(tmp_path / "model.feb").getroot()
    tags = [child.tag for child in root]
    assert tags.index("MeshData") < tags.index("Boundary") < tags.index("Contact") < tags.index("Rigid")
    grid, held, pairs = (root.find(tag) for tag in ("Mesh", "Boundary", "Contact"))
    assert grid is not None
    assert held is not None
    assert pairs is not None
    known: dict[str, Any] = {"sliding-elastic": contact.SlidingElastic, "tied-elastic": contact.TiedElastic}
    assert [one.attrib["type"] for one in pairs] == ["sliding-elastic", "sliding-elastic", "tied-elastic"]
    for one in pairs:  # flags 0 and 1 are written by pyfebio and not read: they are given as numbers
        values = {child.tag: number(child.text or "") for child in one}
        kind = known[one.attrib["type"]]
        assert set(values) <= set(kind.model_fields)
        read = kind(name=one.attrib["name"], surface_pair=one.attrib["surface_pair"], **values)
        assert {key: getattr(read, key) for key in values} == values
    assert [type(one).__name__ for one in boundary.Boundary.from_xml(ET.tostring(held)).all_bcs] == ["BCRigid"] * 2
    assert {one.findtext("rb") for one in held} == {"bone_body"}
    assert len(mesh.Mesh.from_xml(ET.tostring(grid)).surface_pairs) == 3
    surfaces = {s.attrib["name"] for s in grid.iterfind("Surface")}
    named = {s.attrib["name"]: [e.text for e in s] for s in grid.iterfind("SurfacePair")}
    assert all(set(ends) <= surfaces for ends in named.values())
    assert {one.attrib["surface_pair"] for one in pairs} == set(named)
    sets = {s.attrib["name"]: [int(n) for n in (s.text or "").split(",")] for s in grid.iterfind("NodeSet")}
    tied = [sets[one.attrib["node_set"]] for one in held]
    assert not set(tied[0]) & set(tied[1])
    bone = set(sets["bone_nodes"])
    assert all(not bone & set(nodes) for nodes in tied)


def test_the_checker_of_models_sees_a_pair_that_is_not_there_and_a_part_that_may_drift_away(tmp_path: Path) -> None:
    tets, path = apart(), tmp_path / "model.feb"
    write_febio_model(path, model(tets, contacts(tets).all_pairs(within_mm=0.5)))  # one muscle tied to the other
    text = path.read_text(encoding="utf-8")
    assert held(path).holds
    path.write_text(text.replace("<secondary>held_surface", "<secondary>no_surface"), encoding="utf-8")
    assert held(path).undefined == ("no_surface",)
    path.write_text(text.replace('type="tied-elastic"', 'type="sliding-elastic"'), encoding="utf-8")
    assert held(path).loose == ("loose",)
    path.write_text(text.replace('type="rigid">', 'type="zero">'), encoding="utf-8")
    assert held(path).loose == ("held", "loose")


def test_nothing_can_move_without_the_bone(tmp_path: Path) -> None:
    """Linear elasticity by scikit-fem: each part has six rigid modes by itself; with the ties and a held bone none."""
    tets = apart()
    made = model(tets, contacts(tets).all_pairs(within_mm=1.2))
    write_febio_model(tmp_path / "model.feb", made)
    root = ET.parse(tmp_path / "model.feb").getroot()
    points = np.array([[float(x) for x in (n.text or "").split(",")] for n in root.iterfind("Mesh/Nodes/node")])
    corners = np.array([[int(x) for x in (e.text or "").split(",")] for e in root.iterfind("Mesh/Elements/elem")]) - 1
    assert np.linalg.det(points[corners[:, 1:]] - points[corners[:, :1]]).min() > 0.0
    basis = skfem.Basis(skfem.MeshTet(points.T, corners.T), skfem.ElementVector(skfem.ElementTetP1()))
    stiffness = linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis).toarray()
    assert abs(stiffness - stiffness.T).max() < 1e-12
    assert _modes(stiffness) == 6 * 3
    held = [
        int(n) - 1
        for one in root.iterfind("Mesh/NodeSet")
        if one.attrib["name"] in made.attached
        for n in (one.text or "").split(",")
    ]
    (bone,) = (one.text for one in root.iterfind("Mesh/NodeSet[@name='bone_nodes']"))
    fixed = np.unique([*held, *(int(n) - 1 for n in (bone or "").split(","))])
    free = np.setdiff1d(np.arange(len(points)), fixed)
    assert _modes(stiffness[np.ix_(dofs := basis.nodal_dofs[:, free].ravel(), dofs)]) == 0


def test_a_tie_between_tissues_leaves_no_way_to_part() -> None:
    """A penalty on what a tied pair ties, at the faces' middles and corners, joins the two parts' rigid modes."""
    tets = apart()
    pairs = contacts(tets).all_pairs(within_mm=0.5)
    (pair,) = (p for p in pairs if p.primary == "loose")
    basis = skfem.Basis(
        skfem.MeshTet(np.array(tets.vertices.T), np.array(tets.tets.T)), skfem.ElementVector(skfem.ElementTetP1())
    )
    stiffness = linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis).toarray()
    other = np.unique(tets.tets[tets.sets["held"]])
    from musclefit.geometry.tets.topology import tet_faces

    beneath = tet_faces(tets.tets[tets.sets["held"]]).boundary
    for face in pair.faces:
        for weights in (np.full(3, 1 / 3), *np.eye(3)):
            place = weights @ tets.vertices[face]
            at = nearest_places(place[None], TriMesh(tets.vertices, beneath))
            under = beneath[at.faces[0]]
            assert np.isin(under, other).all()
            own = barycentric(at.places, *(tets.vertices[under[None, k]] for k in range(3)))[0]
            for axis in range(3):
                row = np.zeros(len(stiffness))
                row[basis.nodal_dofs[axis, face]] += weights
                row[basis.nodal_dofs[axis, under]] -= own
                stiffness += 10.0 * np.outer(row, row)
    assert _modes(stiffness) == 6 * 2  # the two muscles as one, and the bone


def number(text: str) -> int | float | str:
    """What a text stands for in XML."""
    try:
        return int(text) if text.isdigit() else float(text)
    except ValueError:
        return text


def _modes(stiffness: np.ndarray) -> int:
    values = np.linalg.eigvalsh(stiffness)
    return int((np.abs(values) < 1e-9 * values.max()).sum())
