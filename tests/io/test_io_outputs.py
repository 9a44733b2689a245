"""Output folders: what is read back is what was written; whole or not at all; inside the folder whatever the names."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista as pv
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import InputError
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.io import run_folder as outputs
from musclefit.io.anatomy import read_anatomy
from musclefit.io.run_folder import (
    DeformedTets,
    Maker,
    check_writable,
    file_names,
    ply_bytes,
    write_inspection,
    write_run,
)
from musclefit.report.html import PNG_SIGNATURE
from musclefit.report.model import CONVERGED, MeshReport, Report, Side, TissueSummary
from musclefit.report.schema import report_schema
from musclefit.rig.settings import Limits
from musclefit.validate.model import LandmarkCheck, MapCheck, OverlapCheck, TissueCheck
from musclefit.vocabulary import Claim

HOSTILE = ("../../x<script>", "/etc/passwd", "a/b", "a\\b", "A b", "a b", "..", "", "nul.txt", "sehne_ß_腱", "x" * 300)
NAMED = 'outer <&> "x"'
PNG = PNG_SIGNATURE + b"pixels"


def _ball(name, kind=TissueKind.MUSCLE, centre=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=7.3)
    return Tissue(name, kind, TriMesh(np.asarray(ball.vertices) + centre, np.asarray(ball.faces)))


def _anatomy(names=("biceps", "triceps")):
    return Anatomy(tuple(_ball(name, centre=(1000 / 3 + 20.0 * i, 0, 0)) for i, name in enumerate(names)), "test, mm")


def _moved(anatomy):
    return anatomy.with_vertices(anatomy.vertices() @ np.diag([1.0, 1.1, 0.9]) + np.pi)


def _report(anatomy, title="Test"):
    side = Side(
        "method",
        CONVERGED,
        3,
        LandmarkCheck(4, 0.0, "a"),
        MapCheck(Claim.SAMPLED, "rule", 0.5, 10, 0, 0.9, (0.0, 0.0, 0.0)),
        None,
        tuple(TissueCheck(t.name, t.kind.value, 1.0, 1.0, 0.0, None, None, None, None, None) for t in anatomy),
        OverlapCheck((), 1, ()),
    )
    return Report(title, side, None, (), Limits(), {}, 1.0, {})


def _tets():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float) * 10
    mesh = TetMesh(vertices, np.array([[0, 1, 2, 3], [1, 2, 3, 4]]))
    rest = TetAnatomy(
        anatomy=_anatomy(("inner", NAMED)), mesh=mesh, tissue_of_tet=np.array([0, 1]), dropped=0, findings=()
    )
    return DeformedTets(rest, vertices * [1.0, 1.0, 2.0])


def _write(folder, names=("biceps", "triceps"), **changed):
    rest = _anatomy(names)
    arguments = {"rest": rest, "deformed": _moved(rest), "tets": None, "pictures": {"Front: all": PNG}}
    return write_run(folder, _report(rest), **(arguments | changed))


def _listing(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_a_run_is_written_with_all_its_files_listed(tmp_path):
    folder = tmp_path / "new" / "out"
    written = _write(folder, tets=_tets())
    found = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert sorted(found["files"]) == _listing(folder) == sorted(p.relative_to(folder).as_posix() for p in written)
    assert set(found["files"]) >= {"report.json", "report.html", "tets.vtu", "pictures/01-Front.png"}
    assert (folder / "pictures" / "01-Front.png").read_bytes() == PNG
    assert list(tmp_path.iterdir()) == [tmp_path / "new"]
    assert list((tmp_path / "new").iterdir()) == [folder]
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator(report_schema()).validate(found)


def test_surfaces_read_back_exactly_by_every_reader(tmp_path):
    rest = _anatomy()
    deformed = _moved(rest)
    _write(tmp_path / "out")
    for tissue in deformed:
        surface, start = tissue.surface, rest[tissue.name].surface.vertices
        ply = tmp_path / "out" / "surfaces" / f"{tissue.name}.ply"
        by_meshio = meshio.read(ply)
        np.testing.assert_array_equal(by_meshio.points, surface.vertices)
        np.testing.assert_array_equal(by_meshio.cells_dict["triangle"], surface.faces)
        by_trimesh = trimesh.load(ply, process=False)
        np.testing.assert_array_equal(by_trimesh.vertices, surface.vertices)
        np.testing.assert_array_equal(by_trimesh.faces, surface.faces)
        by_vtk = pv.read(ply)  # VTK reads PLY positions as float32
        np.testing.assert_array_equal(by_vtk.points, surface.vertices.astype(np.float32))
        vtp = pv.read(ply.with_suffix(".vtp"))
        np.testing.assert_array_equal(vtp.points, surface.vertices)
        np.testing.assert_array_equal(vtp.regular_faces, surface.faces)
        np.testing.assert_array_equal(vtp.point_data["rest_position_mm"], start)
        np.testing.assert_array_equal(vtp.point_data["displacement_mm"], surface.vertices - start)
        assert (vtp.field_data["name"][0], vtp.field_data["kind"][0]) == (tissue.name, "muscle")
        assert not vtp.cell_data.keys()


def test_our_own_reader_takes_our_surfaces(tmp_path):
    _write(tmp_path / "out")
    files = sorted((tmp_path / "out" / "surfaces").glob("*.ply"))
    read = read_anatomy(files, kinds=(("*", TissueKind.MUSCLE),))
    np.testing.assert_array_equal(read.anatomy.vertices(), _moved(_anatomy()).vertices())


def test_tets_read_back_with_labels_and_volume_ratios(tmp_path):
    tets = _tets()
    _write(tmp_path / "out", tets=tets)
    grid = pv.read(tmp_path / "out" / "tets.vtu")
    np.testing.assert_array_equal(grid.points, tets.vertices)
    np.testing.assert_array_equal(grid.cells_dict[pv.CellType.TETRA], tets.rest.mesh.tets)
    np.testing.assert_array_equal(grid.cell_data["tissue"], [0, 1])
    np.testing.assert_allclose(grid.cell_data["volume_ratio"], 2.0, rtol=1e-14, atol=0)
    np.testing.assert_array_equal(grid.point_data["rest_position_mm"], tets.rest.mesh.vertices)
    assert {name: list(values) for name, values in grid.field_data.items()} == {"inner": [0, 3], "outer_x": [1, 3]}
    by_meshio = meshio.read(tmp_path / "out" / "tets.vtu")
    np.testing.assert_array_equal(by_meshio.points, tets.vertices)
    np.testing.assert_array_equal(by_meshio.cells_dict["tetra"], tets.rest.mesh.tets)
    np.testing.assert_array_equal(by_meshio.cell_data["tissue"][0], [0, 1])
    assert {name: values.ravel().tolist() for name, values in by_meshio.field_data.items()} == {
        "inner": [0, 3],
        "outer_x": [1, 3],
    }


def test_inverted_tets_have_a_negative_volume_ratio():
    tets = _tets()
    grid = outputs.labelled_tets(replace(tets, vertices=tets.vertices * [1, 1, -0.5]))
    np.testing.assert_allclose(grid.cell_data["volume_ratio"], -1.0, rtol=1e-14, atol=0)


def test_hostile_names_stay_inside_and_apart(tmp_path):
    rest = _anatomy(HOSTILE)
    _write(tmp_path / "deep" / "out", HOSTILE)
    folder = tmp_path / "deep" / "out"
    assert list(tmp_path.rglob("*.ply")) == list((folder / "surfaces").glob("*.ply"))
    assert len(list((folder / "surfaces").glob("*.ply"))) == len(HOSTILE)
    found = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert {s["name"] for s in found["surfaces"]} == set(HOSTILE)
    for entry in found["surfaces"]:
        vtp = pv.read(folder / entry["vtp"])
        np.testing.assert_array_equal(vtp.point_data["rest_position_mm"], rest[entry["name"]].surface.vertices)
        assert vtp.field_data["name"][0].encode("ascii").decode("unicode_escape") == entry["name"]
    page = (folder / "report.html").read_text(encoding="utf-8")
    own = f"<script>{files('musclefit.report').joinpath('viewer', 'tables.js').read_text(encoding='utf-8')}</script>"
    assert page.count(own) == 1
    assert "<script>" not in page.replace(own, "")


def test_tets_of_hostile_names_can_be_read_by_every_reader(tmp_path):
    base = _tets()
    anatomy = _anatomy(HOSTILE)
    _write(tmp_path / "out", tets=replace(base, rest=replace(base.rest, anatomy=anatomy)))
    in_order = [tissue.name for tissue in anatomy]
    for fields in (
        pv.read(tmp_path / "out" / "tets.vtu").field_data,
        meshio.read(tmp_path / "out" / "tets.vtu").field_data,
    ):
        by_index = sorted((int(np.ravel(values)[0]), name) for name, values in fields.items())
        stems = [name.encode("ascii").decode("unicode_escape") for _, name in by_index]
        assert stems == [file_names(in_order)[name] for name in in_order]


def test_file_names_are_plain_different_and_stable():
    safe = file_names(list(HOSTILE))
    assert safe == file_names(list(HOSTILE))
    assert len({name.casefold() for name in safe.values()}) == len(HOSTILE)
    for name in safe.values():
        assert name == Path(name).name
        assert not set(name) & set('/\\<>:"|?* \0\n')
        assert 0 < len(name.encode()) <= 110
        assert name.strip(".") == name
        assert name.split(".")[0].upper() != "NUL"
    assert file_names(["right_biceps"]) == {"right_biceps": "right_biceps"}
    assert list(file_names(["x", "X", "x-2", "x "]).values()) == ["x", "X-2", "x-2-2", "x-3"]


def test_a_second_run_replaces_the_first_and_keeps_what_is_not_ours(tmp_path):
    folder = tmp_path / "out"
    _write(folder, ("biceps", "triceps"), tets=_tets())
    (folder / "notes.txt").write_text("mine")
    (folder / "surfaces" / "view.pvsm").write_text("mine too")
    (folder / "empty").mkdir()
    _write(folder, ("deltoid",), pictures={})
    assert _listing(folder) == [
        "methods.md",
        "notes.txt",
        "report.html",
        "report.json",
        "scene.mrml",
        "surfaces/deltoid.ply",
        "surfaces/deltoid.vtp",
        "surfaces/view.pvsm",
    ]
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "empty").is_dir()
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("broken", ["save_whole", "render_html", "to_json", "ply_bytes"])
@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path, monkeypatch, broken, error):
    def fail(*arguments, **named):
        raise error("disk full")

    monkeypatch.setattr(outputs, broken, fail)
    with pytest.raises(error, match="disk full"):
        _write(tmp_path / "parent" / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_in_the_middle_leaves_the_former_run(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    _write(folder)
    before = {name: (folder / name).read_bytes() for name in _listing(folder)}
    real = Path.rename

    def fail_into_place(self, target):
        if ".partial-" in self.name:
            raise OSError("no")
        return real(self, target)

    monkeypatch.setattr(Path, "rename", fail_into_place)
    with pytest.raises(OSError, match="no"):
        _write(folder, ("deltoid",))
    assert {name: (folder / name).read_bytes() for name in _listing(folder)} == before
    assert list(tmp_path.iterdir()) == [folder]


def test_a_report_that_json_cannot_hold_leaves_nothing(tmp_path):
    rest = _anatomy()
    report = replace(_report(rest), provenance={"array": np.zeros(2)})
    with pytest.raises(TypeError, match=r"provenance\.array"):
        write_run(tmp_path / "out", report, rest=rest, deformed=rest, tets=None, pictures={})
    assert list(tmp_path.iterdir()) == []


def test_a_cut_off_vtk_file_is_noticed(tmp_path):
    class Cut:
        def save(self, path, **_how):
            path.write_bytes(b"<VTKFile> and then the disk was full")

    with pytest.raises(OSError, match=r"a\.vtp was not written whole"):
        outputs.save_whole(Cut(), tmp_path / "a.vtp")


@pytest.mark.parametrize("content", [None, "{}", "not json", '{"schema_version": 1}', "[]"])
def test_a_folder_of_somebody_else_is_refused_and_untouched(tmp_path, content):
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter.txt").write_text("years of work")
    if content is not None:
        (folder / "report.json").write_text(content)
    for attempt in (lambda: check_writable(folder, by=Maker.RUN), lambda: _write(folder)):
        with pytest.raises(InputError, match=r"thesis is not empty .* name another folder"):
            attempt()
    assert (folder / "chapter.txt").read_text() == "years of work"
    assert list(tmp_path.iterdir()) == [folder]


def test_a_former_list_of_files_cannot_reach_outside(tmp_path):
    folder, victim = tmp_path / "out", tmp_path / "victim.txt"
    _write(folder)
    victim.write_text("keep")
    found = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    found["files"] += ["../victim.txt", str(victim)]
    (folder / "report.json").write_text(json.dumps(found), encoding="utf-8")
    _write(folder)
    assert victim.read_text() == "keep"


def test_folders_that_cannot_be_are_refused_at_once(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("x")
    with pytest.raises(InputError, match="is a file"):
        check_writable(file, by=Maker.RUN)
    with pytest.raises(InputError, match="cannot be written"):
        check_writable(file / "under" / "it", by=Maker.RUN)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="current folder"):
        check_writable(Path(), by=Maker.RUN)
    with pytest.raises(InputError, match="mount point"):
        check_writable(Path("/"), by=Maker.RUN)


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX users")
def test_a_folder_without_permission_is_refused(tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir()
    locked.chmod(0o500)
    code = (
        "import os, sys; from pathlib import Path\n"
        "from musclefit.io.run_folder import Maker, check_writable\n"
        "from musclefit.errors import InputError\n"
        "os.geteuid() == 0 and os.seteuid(65534)\n"
        "try:\n    check_writable(Path(sys.argv[1]), by=Maker.RUN)\n"
        "except InputError as error:\n    print(error)\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(locked / "out")], capture_output=True, text=True, check=False, timeout=120
    )
    locked.chmod(0o700)
    assert "Permission denied" in ran.stdout, ran.stderr
    assert "name another" in ran.stdout


def test_fitting_folders_are_left_as_they_are(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    _write(tmp_path / "former")
    for folder in (tmp_path / "new", tmp_path / "a" / "b" / "c", empty, tmp_path / "former"):
        check_writable(folder, by=Maker.RUN)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "former"]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real", target_is_directory=True)
    _write(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "report.json").is_file()


def test_inspections_are_written_and_replace_one_another(tmp_path):
    tissues = (TissueSummary("b", "bone", 8, 12, math.nan, None),)
    report = MeshReport("arm", "mm", tissues, (), OverlapCheck((), 0, ()))
    for _ in range(2):
        write_inspection(tmp_path / "out", report)
    assert _listing(tmp_path / "out") == ["report.html", "report.json", "report.junit.xml"]


def test_ply_states_what_it_holds():
    data = ply_bytes(_ball("x").surface)
    assert data.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert len(data) == data.index(b"end_header\n") + 11 + 42 * 24 + 80 * 13
