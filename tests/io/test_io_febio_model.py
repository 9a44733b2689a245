"""Models for FEBio: the rules of febio_spec 4.0, the ends of the bones' ways, an independent assembly of the mesh."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import skfem
from febio_assembly import held
from pyfebio import control, loaddata, material, mesh, meshdomains, output, rigid
from scipy.spatial.transform import Rotation
from skfem.models.elasticity import lame_parameters, linear_elasticity
from tet_blocks import two_tissues

import musclefit as mf
from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.febio_model import MUSCLE, STEPS, FebioModel, write_febio_model
from musclefit.io.formats.fibre_directions import HeldArea, MuscleFibres, fibre_bytes, read_fibres
from musclefit.io.formats.solvers import LabelledTets
from musclefit.io.run_folder import DeformedTets, labelled_tets

TURN = RigidMotion.about_axis(centre=np.array([4.0, -3.0, 1.0]), axis=np.array([0.2, 0.1, 1.0]), angle_deg=70.0)


def tets() -> LabelledTets:
    """A bone, a muscle and some filler in a row, with names that XML must escape."""
    rest = two_tissues((6, 2, 2))
    label = np.array(rest.tissue_of_tet)
    label[rest.mesh.vertices[rest.mesh.tets].mean(axis=1)[:, 0] > 5.0] = 2
    return LabelledTets("A -- <model>", rest.mesh.vertices, rest.mesh.tets, label, ("muscle", "bone", "filler"))


def model(*, motion: RigidMotion = TURN) -> FebioModel:
    labelled = tets()
    fibres = np.zeros((len(labelled.tets), 3))
    fibres[labelled.tissue_of_tet == 0] = [0.6, 0.0, 0.8]
    return FebioModel(labelled, fibres, {"bone": motion}, frozenset({"muscle"}))


def written(tmp_path: Path, made: FebioModel) -> ET.Element:
    write_febio_model(tmp_path / "model.feb", made)
    assert [path.name for path in tmp_path.iterdir()] == ["model.feb"]
    return ET.parse(tmp_path / "model.feb").getroot()


def numbers(text: str | None) -> np.ndarray:
    return np.array([float(x) for x in (text or "").split(",")])


def test_sections_stand_in_order_and_every_name_is_defined(tmp_path: Path) -> None:
    root = written(tmp_path, model())
    assert root.attrib == {"version": "4.0"}
    sections = ["Module", "Control", "Globals", "Material", "Mesh", "MeshDomains", "MeshData", "Rigid", "LoadData"]
    assert [child.tag for child in root] == [*sections, "Output"]
    materials = {m.attrib["name"]: m.attrib["type"] for m in root.iterfind("Material/material")}
    assert materials == {"bone_body": "rigid body", "muscle": "muscle material", "filler": "neo-Hookean"}
    assert {m.attrib["id"] for m in root.iterfind("Material/material")} == {"1", "2", "3"}
    parts = [part.attrib["name"] for part in root.iterfind("Mesh/Elements")]
    domains = {d.attrib["name"]: d.attrib["mat"] for d in root.iterfind("MeshDomains/SolidDomain")}
    assert domains == {"muscle": "muscle", "bone": "bone_body", "filler": "filler"}
    assert sorted(domains) == sorted(parts)
    muscle = root.find("Material/material[@name='muscle']")
    assert muscle is not None
    assert {child.tag for child in muscle} == {*MUSCLE, "fiber"}
    curves = {c.attrib["id"] for c in root.iterfind("LoadData/load_controller")}
    assert {e.attrib["lc"] for e in root.find("Rigid").iter() if "lc" in e.attrib} <= curves  # type: ignore[union-attr]
    assert {e.text for e in root.iterfind("Rigid/rigid_bc/rb")} == {"bone_body"}
    assert float(root.findtext("Control/time_steps", "")) * float(root.findtext("Control/step_size", "")) == 1.0


def test_every_muscle_element_has_its_own_axes(tmp_path: Path) -> None:
    made = model()
    root = written(tmp_path, made)
    (data,) = root.iterfind("MeshData/ElementData")
    assert data.attrib == {"type": "mat_axis", "elem_set": "muscle"}
    elements = [e.attrib["id"] for e in root.iterfind("Mesh/Elements[@name='muscle']/elem")]
    assert [e.attrib["lid"] for e in data] == [str(k + 1) for k in range(len(elements))]
    for element in data:
        along, beside = numbers(element.findtext("a")), numbers(element.findtext("d"))
        np.testing.assert_array_equal(along, [0.6, 0.0, 0.8])
        assert np.linalg.norm(np.cross(along, beside)) > 0.5


def test_febio_s_own_models_of_the_sections_take_them_whole(tmp_path: Path) -> None:
    """pyfebio, of FEBio's makers, knows types, keys and ranges of every section but axes; what it read must be all."""
    root = written(tmp_path, model())

    def section(tag: str) -> bytes:
        (found,) = root.iterfind(tag)
        return ET.tostring(found)

    steps = control.Control.from_xml(section("Control"))
    assert (steps.time_steps, steps.step_size) == (STEPS, 1 / STEPS)
    assert (steps.solver.qn_method.type, steps.solver.max_refs) == ("full Newton", 25)
    assert (steps.time_stepper.max_retries, steps.time_stepper.dtmax.text) == (10, 1 / STEPS)
    materials = material.Material.from_xml(section("Material"))  # refuses keys that a material does not have
    assert [type(one).__name__ for one in materials.all_materials] == ["RigidBody", "MuscleUC", "NeoHookean"]
    muscle = ET.fromstring(materials.all_materials[1].to_xml())
    assert {child.tag: float(child.text or "") for child in muscle if child.tag != "fiber"} == {
        key: float(value) for key, value in MUSCLE.items()
    }
    grid = mesh.Mesh.from_xml(section("Mesh"))
    counts = [len(list(root.iterfind(f"Mesh/{tag}"))) for tag in ("Elements", "Surface", "NodeSet")]
    assert [len(grid.elements), len(grid.surfaces), len(grid.node_sets)] == counts
    assert len(grid.nodes[0].all_nodes) == len(model().tets.vertices)
    assert len(meshdomains.MeshDomains.from_xml(section("MeshDomains")).solid_domains) == counts[0]
    bones = rigid.Rigid.from_xml(section("Rigid"))
    assert len(bones.all_rigid_bcs) == len(list(root.iterfind("Rigid/rigid_bc")))
    curves = loaddata.LoadData.from_xml(section("LoadData"))
    assert len(curves.load_controllers) == len(list(root.iterfind("LoadData/load_controller")))
    (plot,) = output.Output.from_xml(section("Output")).plotfile
    assert len(plot.all_vars) == len(list(root.iterfind("Output/plotfile/var")))


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_the_curves_lead_the_bone_along_its_screw(share: float, tmp_path: Path) -> None:
    made = model()
    root = written(tmp_path, made)
    at = {
        c.attrib["id"]: numbers(c.findall("points/point")[round(share * STEPS)].text)[1]
        for c in root.iterfind("LoadData/load_controller")
    }
    moved = [
        float(bc.findtext("value", "")) * at[bc.find("value").attrib["lc"]]  # type: ignore[union-attr]
        for axis in "xyz"
        for bc in root.iterfind("Rigid/rigid_bc[@type='rigid_displacement']")
        if bc.findtext("dof") == axis
    ]
    turned = root.find("Rigid/rigid_bc[@type='rigid_rotation_vector']")
    assert turned is not None
    vector = [float(turned.findtext(f"v{axis}", "")) * at[turned.find(f"v{axis}").attrib["lc"]] for axis in "xyz"]  # type: ignore[union-attr]
    centre = numbers(root.findtext("Material/material[@type='rigid body']/center_of_mass"))
    nodes = made.tets.vertices[np.unique(made.tets.tets[made.tets.tissue_of_tet == 1])]
    arrived = Rotation.from_rotvec(vector).apply(nodes - centre) + centre + moved
    np.testing.assert_allclose(arrived, TURN.fraction(share)(nodes), atol=1e-9)


def test_a_bone_that_stays_is_fixed(tmp_path: Path) -> None:
    (held,) = written(tmp_path, model(motion=RigidMotion.identity())).iterfind("Rigid/rigid_bc")
    assert held.attrib["type"] == "rigid_fixed"
    assert {child.tag: child.text for child in held} == {"rb": "bone_body"} | {f"R{x}_dof": "1" for x in "xyzuvw"}


def test_an_independent_assembly_takes_the_mesh(tmp_path: Path) -> None:
    """Linear elasticity by scikit-fem on what stands in the file: positive Jacobians, symmetry, six rigid modes."""
    root = written(tmp_path, model())
    points = np.array([numbers(node.text) for node in root.iterfind("Mesh/Nodes/node")])
    corners = np.array([numbers(e.text) for e in root.iterfind("Mesh/Elements/elem")]).astype(int) - 1
    assert np.linalg.det(points[corners[:, 1:]] - points[corners[:, :1]]).min() > 0.0
    basis = skfem.Basis(skfem.MeshTet(points.T, corners.T), skfem.ElementVector(skfem.ElementTetP1()))
    stiffness = linear_elasticity(*lame_parameters(1.0, 0.3)).assemble(basis)
    assert abs(stiffness - stiffness.T).max() < 1e-12
    values = np.linalg.eigvalsh(stiffness.toarray())
    assert (np.abs(values) < 1e-10 * values.max()).sum() == 6
    assert values.min() > -1e-10 * values.max()
    boundary = [f.text for f in root.iterfind("Mesh/Surface[@name='bone_surface']/tri3")]
    faces = np.array([numbers(text) for text in boundary]).astype(int) - 1
    a, b, c = (points[faces[:, k]] for k in range(3))
    volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(3 * 2 * 2)  # closed, and seen from outside


def test_bones_that_touch_and_move_apart_are_refused() -> None:
    labelled = tets()
    motions = {"bone": TURN, "muscle": RigidMotion.identity()}
    with pytest.raises(InputError, match=r"move apart but share node \d+"):
        FebioModel(labelled, np.zeros((len(labelled.tets), 3)), motions, frozenset())
    with pytest.raises(InputError, match="no tissue is a rigid bone"):
        FebioModel(labelled, np.zeros((len(labelled.tets), 3)), {}, frozenset())


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """The parts of a run and of an architecture folder that the command reads."""
    run, fibres = tmp_path / "run", tmp_path / "fibres"
    run.mkdir()
    fibres.mkdir()
    rest = two_tissues((4, 2, 2))
    labelled_tets(DeformedTets(rest, TURN(rest.mesh.vertices))).save(run / "tets.vtu")
    tissues = [{"name": tissue.name, "kind": tissue.kind.value} for tissue in rest.anatomy]
    report = {"title": "Two", "tissues": tissues}
    (run / "report.json").write_text(json.dumps(report), encoding="utf-8")
    places = rest.mesh.vertices[rest.mesh.tets[rest.tissue_of_tet == 0]].mean(axis=1)
    held = HeldArea("bone", rest.anatomy["muscle"].surface)
    along = MuscleFibres(places, np.tile([1.0, 0.0, 0.0], (len(places), 1)), (held,))
    (fibres / "fibres.npz").write_bytes(fibre_bytes({"muscle": along}))
    return run, fibres


def test_the_command_writes_a_model_at_rest(folders: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    assert main(["febio-model", *map(str, folders), str(tmp_path / "arm.feb")]) == 0
    assert "1 muscles with fibres, 1 ties, 0 sliding pairs; bones off the run by" in capsys.readouterr().out
    root = ET.parse(tmp_path / "arm.feb").getroot()
    points = np.array([numbers(node.text) for node in root.iterfind("Mesh/Nodes/node")])
    np.testing.assert_array_equal(points, two_tissues((4, 2, 2)).mesh.vertices)


@pytest.mark.slow
def test_a_run_of_the_built_in_limb_becomes_a_model(tmp_path: Path) -> None:
    """Every bone is a rigid body that ends where the run has it, every muscle has fibres, elements are right-handed."""
    run = mf.run("upper_limb", out=tmp_path / "run", pictures=False, overrides=("compare.methods=[]",))
    mf.architecture("upper_limb", deform=False, out=tmp_path / "fibres")
    made = mf.febio_model(tmp_path / "run", tmp_path / "fibres", tmp_path / "limb.feb")
    of_kind = {kind: {t.name for t in run.report.result.tissues if t.kind == kind} for kind in ("bone", "muscle")}
    assert set(made.model.motions) == of_kind["bone"]
    assert made.model.muscles == of_kind["muscle"]
    attached = {pair.primary for pair in made.ties}
    assert attached <= of_kind["muscle"]
    assert len(attached) >= 7  # the long head of triceps comes near bone, over no area that counts
    slid = mf.febio_model(tmp_path / "run", tmp_path / "fibres", tmp_path / "sliding.feb", sliding=True)
    assert slid.facing_mm is not None
    assert {pair.primary for pair in slid.ties} == of_kind["muscle"]
    assert len(slid.model.contacts) > len(slid.ties)
    assert max(made.bones_off_mm.values()) < 1e-6
    corners = made.model.tets.vertices[made.model.tets.tets]
    assert (np.linalg.det(corners[:, 1:] - corners[:, :1]) > 0.0).all()
    root = ET.parse(tmp_path / "limb.feb").getroot()
    assert len(list(root.iterfind("Mesh/Elements/elem"))) == len(corners)


def test_what_is_no_fibres_or_no_feb_is_refused(folders: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    run, fibres = folders
    assert main(["febio-model", str(run), str(fibres), str(tmp_path / "arm.inp")]) == 2
    assert "ends in .feb" in capsys.readouterr().err
    (fibres / "fibres.npz").write_bytes(b"PK broken")
    assert main(["febio-model", str(run), str(fibres), str(tmp_path / "arm.feb")]) == 2
    assert "holds no fibres" in capsys.readouterr().err
    assert not (tmp_path / "arm.feb").exists()


@pytest.mark.parametrize("damaged", ['{"tissues": [', '{"title": "Two"}', "[]"])
def test_a_damaged_report_is_refused(damaged: str, folders: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    (folders[0] / "report.json").write_text(damaged, encoding="utf-8")
    assert main(["febio-model", *map(str, folders), str(tmp_path / "arm.feb")]) == 2
    assert "report.json" in capsys.readouterr().err
    assert not (tmp_path / "arm.feb").exists()


def test_fibres_are_read_back(tmp_path: Path) -> None:
    places = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    area = HeldArea("bone + other", two_tissues((2, 2, 2)).anatomy["muscle"].surface)
    given = {
        "a": MuscleFibres(places[:1], places[1:], (), places[:1] + 1.0, places[1:] * 2.0),
        "b": MuscleFibres(places[1:], places[:1], (area, area), places[1:] + 1.0, places[:1] * 2.0),
    }
    (tmp_path / "fibres.npz").write_bytes(fibre_bytes(given))
    found = read_fibres(tmp_path / "fibres.npz")
    assert list(found) == ["a", "b"]
    for name, one in given.items():
        for kind in ("places", "directions", "moved", "carried"):
            np.testing.assert_array_equal(getattr(found[name], kind), getattr(one, kind))
    assert (len(found["a"].held), [held.bone for held in found["b"].held]) == (0, ["bone + other"] * 2)
    np.testing.assert_array_equal(found["b"].held[1].surface.corners(), area.surface.corners())


@pytest.mark.parametrize("options", [["--facing-mm", "1"], ["--sliding", "--facing-mm", "0"]])
def test_a_distance_that_says_nothing_is_refused(options, folders: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    assert main(["febio-model", *map(str, folders), str(tmp_path / "arm.feb"), *options]) == 2
    assert "expected a finite length above 0, mm, and tissues that slide" in " ".join(capsys.readouterr().err.split())


def test_sliding_tissues_have_nodes_of_their_own(folders: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    assert main(["febio-model", *map(str, folders), str(tmp_path / "arm.feb"), "--sliding", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["facing_mm"] > 0.0
    assert {(pair["primary"], pair["secondary"], pair["tied"]) for pair in told["contacts"]} >= {
        ("muscle", "bone", True)
    }
    root = ET.parse(tmp_path / "arm.feb").getroot()
    rest = two_tissues((4, 2, 2))
    shared = len(rest.mesh.vertices)
    assert len(list(root.iterfind("Mesh/Nodes/node"))) == shared + 9
    (attached,) = root.iterfind("Boundary/bc")
    assert (attached.attrib["type"], attached.findtext("rb")) == ("rigid", "bone_body")


def test_the_checker_of_models_takes_a_good_one_and_sees_what_is_wrong(tmp_path: Path) -> None:
    written(tmp_path, model())
    path = tmp_path / "model.feb"
    good = held(path)
    assert good.holds
    text = path.read_text(encoding="utf-8")
    first = ET.parse(path).getroot().find("Mesh/Elements/elem")
    assert first is not None
    assert first.text is not None
    a, b, *rest = first.text.split(",")
    wrong = {
        first.text: ",".join([b, a, *rest]),  # inside out
        '<SolidDomain name="muscle"': '<SolidDomain name="nothing"',
        "lam_max>": "lam_most>",
    }
    for was, now in wrong.items():
        assert was in text
        path.write_text(text.replace(was, now, 2 if "lam" in was else 1), encoding="utf-8")
        assert not held(path).holds, now
