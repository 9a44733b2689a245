"""Surface files: read alike in every format, refused when broken anywhere; folders, kinds, hashes; the real anatomy."""

from __future__ import annotations

import hashlib
import struct

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.io.anatomy import read_anatomy, read_surface
from musclefit.vocabulary import Unit

BALL = trimesh.creation.icosphere(1, radius=10.0)
VERTICES = np.array(BALL.vertices) + [100.0, 200.0, 1000.0] + 1 / 3
FACES = np.array(BALL.faces, dtype=np.int64)


def _ply_header(encoding, number, *, vertices=42, faces=80):
    return (
        f"ply\nformat {encoding} 1.0\ncomment end_header is not here\nelement vertex {vertices}\n"
        f"property {number} x\nproperty {number} y\nproperty {number} z\nelement face {faces}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()


def _ascii_ply():
    rows = [" ".join(repr(float(x)) for x in v) for v in VERTICES] + [f"3 {a} {b} {c}" for a, b, c in FACES]
    return _ply_header("ascii", "double") + "\n".join(rows).encode() + b"\n"


def _binary_ply(order):
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    faces = b"".join(struct.pack(f"{order}B3i", 3, *face) for face in FACES)
    return _ply_header(encoding, "double") + VERTICES.astype(f"{order}f8").tobytes() + faces


def _obj():
    rows = [f"v {float(x)!r} {float(y)!r} {float(z)!r}" for x, y, z in VERTICES]
    return "\n".join(["# a ball", *rows, *(f"f {a}/1 {b}/1 {c}/1" for a, b, c in FACES + 1)]).encode() + b"\n"


def _binary_stl():
    records = [struct.pack("<12fH", 0, 0, 0, *VERTICES[face].ravel(), 0) for face in FACES]
    return b"solid is no sign of text".ljust(80) + struct.pack("<I", len(FACES)) + b"".join(records)


def _ascii_stl():
    facets = []
    for face in FACES:
        corners = [f"      vertex {float(x)!r} {float(y)!r} {float(z)!r}" for x, y, z in VERTICES[face]]
        facets += ["  facet normal 0 0 0", "    outer loop", *corners, "    endloop", "  endfacet"]
    return "\n".join(["solid a facet of a vertex", *facets, "endsolid a facet of a vertex"]).encode() + b"\n"


def _vtp(*, encoding="ascii"):
    if encoding == "ascii":
        points = " ".join(repr(float(x)) for x in VERTICES.ravel())
        corners = " ".join(str(i) for i in FACES.ravel())
        ends = " ".join(str(i) for i in range(3, 3 * len(FACES) + 1, 3))
        return (
            '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian">\n<PolyData>\n'
            f'<Piece NumberOfPoints="{len(VERTICES)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
            f'NumberOfPolys="{len(FACES)}">\n<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">\n'
            f'{points}\n</DataArray></Points>\n<Polys><DataArray type="Int64" Name="connectivity" format="ascii">\n'
            f'{corners}\n</DataArray>\n<DataArray type="Int64" Name="offsets" format="ascii">\n'
            f"{ends}\n</DataArray></Polys>\n"
            "</Piece>\n</PolyData>\n</VTKFile>\n"
        ).encode()
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(pv.PolyData.from_regular_faces(VERTICES, FACES))
    {"appended": writer.SetDataModeToAppended, "binary": writer.SetDataModeToBinary}[encoding]()
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString().encode("utf-8", "surrogateescape")


FORMATS = {
    "ascii.ply": _ascii_ply(),
    "little.ply": _binary_ply("<"),
    "big.ply": _binary_ply(">"),
    "text.obj": _obj(),
    "binary.stl": _binary_stl(),
    "ascii.stl": _ascii_stl(),
    "ascii.vtp": _vtp(),
}
EXACT = [name for name in FORMATS if name != "binary.stl"]


@pytest.fixture
def write(tmp_path):
    def written(name, data):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path

    return written


def _taken_in(raw):
    return take_in("ball", TissueKind.BONE, vertices=raw.vertices, faces=raw.faces, source=str(raw.path))[0].surface


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_reads_the_same_surface(name, write):
    raw = read_surface(write(name, FORMATS[name]))
    rounding = 0 if name in EXACT else np.float32(1e-7)
    np.testing.assert_allclose(raw.vertices[raw.faces], VERTICES[FACES], rtol=rounding, atol=0)
    assert raw.findings == ()
    assert raw.sha256 == hashlib.sha256(FORMATS[name]).hexdigest()
    assert len(_taken_in(raw).vertices) == len(VERTICES)
    assert not raw.vertices.flags.writeable


@pytest.mark.parametrize("encoding", ["binary", "appended"])
def test_vtp_as_vtk_writes_it(encoding, write):
    raw = read_surface(write("ball.vtp", _vtp(encoding=encoding)))
    np.testing.assert_array_equal(raw.vertices[raw.faces], VERTICES[FACES])


@pytest.mark.parametrize("ending", ["ply", "stl", "obj"])
def test_files_that_trimesh_writes(ending, write):
    written = trimesh.Trimesh(VERTICES, FACES, process=False).export(file_type=ending)
    raw = read_surface(write(f"ball.{ending}", written if isinstance(written, bytes) else written.encode()))
    np.testing.assert_allclose(raw.vertices[raw.faces], VERTICES[FACES], rtol=1e-6, atol=0)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("ending", ["ply", "stl", "vtk.obj"])
def test_files_that_meshio_writes(ending, binary, tmp_path):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / f"ball.{ending}"
    kwargs = {} if ending.endswith("obj") else {"binary": binary}
    mesh = meshio.Mesh(
        VERTICES.astype(np.float32 if ending == "stl" else float), [("triangle", FACES.astype(np.int32))]
    )
    meshio.write(path, mesh, **kwargs)
    raw = read_surface(path)
    np.testing.assert_allclose(raw.vertices[raw.faces], VERTICES[FACES], rtol=1e-6, atol=0)


def _same_as_whole(surface):
    return surface.faces.shape == FACES.shape and np.allclose(
        surface.vertices[surface.faces], VERTICES[FACES], rtol=1e-6, atol=0
    )


def _attempt(path):
    """What reading the file says, and the surface or None."""
    try:
        return "", _taken_in(read_surface(path))
    except MeshError as error:
        return str(error), None


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_cut_short_anywhere_never_gives_another_closed_surface(name, write):
    whole = FORMATS[name]
    step = 1 if name.endswith((".ply", ".obj")) else 7
    refused = 0
    for length in [*range(0, len(whole) - 1, step * 11), *range(len(whole) - 150, len(whole))]:
        path = write(f"cut_{name}", whole[:length])
        message, surface = _attempt(path)
        refused += surface is None
        assert str(path) in message if surface is None else _same_as_whole(surface), f"{length} of {len(whole)} bytes"
    assert refused > 100


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.endswith(".obj")])
def test_formats_with_counts_notice_a_missing_last_face_by_themselves(name, write):
    length = len(FORMATS[name]) - {"ply": 18, "stl": 120, "vtp": 60}[name[-3:]]
    with pytest.raises(MeshError, match="the file is damaged or cut short; export it again"):
        read_surface(write(name, FORMATS[name][:length]))


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_bytes_raise_our_errors_and_no_others(name, write, capfd):
    rng = np.random.default_rng(7)
    for _ in range(150):
        data = bytearray(FORMATS[name])
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        message, surface = _attempt(write(f"bad_{name}", bytes(data)))
        assert surface is not None or f"bad_{name}" in message
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("ending", ["ply", "stl", "obj", "vtp"])
@pytest.mark.parametrize("data", [b"", b"\n \n", b"\x00\x01\x02 garbage \xff" * 20, b"<html>not found</html>\n"])
def test_empty_and_foreign_files_are_refused_by_name(ending, data, write, capfd):
    path = write(f"thing.{ending}", data)
    with pytest.raises(MeshError, match=r"thing\."):
        read_surface(path)
    assert capfd.readouterr().err == ""


QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CORNERS = np.array([[x, y, z] for x in (0.0, 10) for y in (0.0, 20) for z in (0.0, 30)])


def _box_ply(encoding, polygons):
    header = _ply_header(encoding, "float", vertices=8, faces=len(polygons))
    if encoding == "ascii":
        rows = [" ".join(map(str, v)) for v in CORNERS] + [" ".join(map(str, [len(p), *p])) for p in polygons]
        return header + "\n".join(rows).encode()
    return (
        header + CORNERS.astype("<f4").tobytes() + b"".join(struct.pack(f"<B{len(p)}i", len(p), *p) for p in polygons)
    )


MIXED = [list(q) for q in QUADS[1:]] + [[0, 1, 3], [0, 3, 2]]


@pytest.mark.parametrize("polygons", [QUADS.tolist(), MIXED], ids=["quads", "mixed"])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_quads_of_a_ply_are_cut_and_reported(encoding, polygons, write):
    raw = read_surface(write("box.ply", _box_ply(encoding, polygons)))
    quads = sum(len(p) == 4 for p in polygons)
    assert [f.code for f in raw.findings] == ["cut-polygons"]
    assert f"box: {quads} faces with more than three corners" in raw.findings[0].message
    assert len(raw.faces) == 12
    assert abs(trimesh.Trimesh(raw.vertices, raw.faces).volume) == pytest.approx(6000.0, rel=1e-12)


def test_a_pentagon_and_negative_numbers_in_obj(write):
    text = (
        b"v 0 0 0\nv 2 0 0\nv 3 1 0 1 0 0\nv 1 2 0\nv -1 1 0\nvt 0 0\nvn 0 0 1\ng a\nusemtl b\n"
        b"f -5/1/1 -4//1 -3 -2 \\\n -1\n"
    )
    raw = read_surface(write("five.obj", text))
    assert raw.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


def test_further_ply_elements_and_properties_are_read_past(write):
    header = (
        "ply\nformat ascii 1.0\nelement camera 1\nproperty float fov\nelement vertex 4\nproperty float nx\n"
        "property double x\nproperty double y\nproperty double z\nproperty uchar red\nelement face 4\n"
        "property uchar flags\n"
        "property list uchar uint vertex_index\nproperty list uchar float texcoord\nelement edge 1\n"
        "property int vertex1\n"
        "end_header\n60\n"
    )
    vertices = "9 0 0 0 255\n9 10 0 0 255\n9 0 10 0 255\n9 0 0 10 255\n"
    faces = "7 3 0 2 1 2 .5 .5\n7 3 0 1 3 0\n7 3 1 2 3 1 .5\n7 3 2 0 3 0\n5\n"
    raw = read_surface(write("odd.ply", (header + vertices + faces).encode()))
    assert raw.vertices.tolist() == [[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]]
    assert raw.faces.tolist() == [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.ply", _ply_header("ascii", "half"), "'property half x' cannot be read as PLY header"),
        ("a.ply", _ply_header("binary_middle_endian", "float"), "'format binary_middle_endian 1.0' cannot be read"),
        ("a.ply", FORMATS["little.ply"] + b"more", "has 4 bytes more than its PLY header states"),
        ("a.ply", FORMATS["ascii.ply"] + b"3 1 2 3\n", "has 4 values more than its PLY header states"),
        (
            "a.ply",
            FORMATS["ascii.ply"].replace(b"vertex_indices", b"corners"),
            "it needs vertex_indices or vertex_index",
        ),
        ("a.ply", FORMATS["ascii.ply"].replace(b"\n3 ", b"\nx ", 1), "has a value that is not a number"),
        ("a.ply", FORMATS["ascii.ply"].replace(b"\n3 ", b"\n3 .5", 1), "index that is not a whole number"),
        ("a.ply", _ply_header("ascii", "float", faces=10**15), "ends within its"),
        ("a.obj", b"v 1 2\n", "line 1: a vertex with 2 of 3 coordinates"),
        ("a.obj", b"v 1 2 x\nf 1 1 1\n", "a vertex is not a number"),
        ("a.obj", b"v 1 2 3\nf 0 1 1\n", "line 2: a face refers to vertex 0, but OBJ counts from 1"),
        ("a.obj", b"v 1 2 3\nf 1 1\n", r"face 0 \(0-based\) has 2 corners"),
        ("a.obj", b"v 1 2 3\nsurf 0 1 0 1 1\n", "line 2: 'surf' is not a statement of a polygonal OBJ"),
        ("a.stl", FORMATS["binary.stl"][:-50], "with 80 triangles, which take 4084 bytes, but the file has 4034 bytes"),
        (
            "a.stl",
            FORMATS["ascii.stl"].replace(b"endloop", b"end_loop", 1),
            "facet 1 has 'end_loop' instead of 'endloop'",
        ),
        (
            "a.vtp",
            FORMATS["ascii.vtp"].replace(b'Points="42"', b'Points="43"'),
            "states 43 points, but holds 126 coordinates of points",
        ),
        ("a.vtp", FORMATS["ascii.vtp"].replace(b"</Points>", b"</Dots>"), r"is no XML \(mismatched tag: line 7"),
    ],
)
def test_damage_is_named(name, data, message, write, capfd):
    with pytest.raises(MeshError, match=message):
        read_surface(write(name, data))
    assert capfd.readouterr().err == ""


def test_a_bad_vertex_number_is_named_with_file_and_vertex(write):
    path = write("muscle_a.ply", FORMATS["ascii.ply"].replace(repr(float(VERTICES[2, 1])).encode(), b"nan"))
    with pytest.raises(
        MeshError, match=r"muscle_a\.ply: .* vertices are not finite, the first is number \d+ \(0-based\)"
    ):
        read_anatomy([path])
    path = write("muscle_a.obj", FORMATS["text.obj"] + b"f 1 2 99\n")
    with pytest.raises(MeshError, match=r"muscle_a\.obj: face 80 \(0-based\) uses vertex 98, but there are 42"):
        read_anatomy([path])


@pytest.mark.parametrize(("unit", "factor"), [(Unit.MILLIMETRE, 1.0), (Unit.CENTIMETRE, 10.0), (Unit.METRE, 1000.0)])
def test_units_become_mm(unit, factor, write):
    raw = read_surface(write("ball.ply", FORMATS["little.ply"]), units=unit)
    np.testing.assert_allclose(raw.vertices, VERTICES * factor, rtol=1e-15)


def test_metres_taken_for_millimetres_are_refused(write):
    data = FORMATS["ascii.stl"]
    small = trimesh.Trimesh(VERTICES * 1e-3, FACES, process=False).export(file_type="stl")
    path = write("bone_a.stl", small)
    with pytest.raises(
        InputError, match=r'the anatomy is 0\.0346 mm across; the files look like metres, set units = "m"'
    ):
        read_anatomy([path])
    assert read_anatomy([path], units=Unit.METRE).anatomy["bone_a"].surface.vertices.max() > 1000.0
    with pytest.raises(InputError, match=r"the anatomy is 346\d\d mm across; the files look like millimetres"):
        read_anatomy([write("bone_b.stl", data)], units=Unit.METRE)


def test_a_folder_with_subfolders_by_kind(write, tmp_path):
    write("skin.PLY", FORMATS["little.ply"])
    write("bones/humerus.stl", FORMATS["binary.stl"])
    write("muscles/muscle_biceps.obj", FORMATS["text.obj"])
    write("other/tract.vtp", FORMATS["ascii.vtp"])
    write("README.md", b"words")
    write("drafts/bone_old.ply", FORMATS["little.ply"])
    write(".hidden.ply", b"")
    read = read_anatomy(tmp_path)
    kinds = {t.name: t.kind.value for t in read.anatomy}
    assert kinds == {"skin": "skin", "tract": "other", "muscle_biceps": "muscle", "humerus": "bone"}
    assert set(read.hashes) == {"skin.PLY", "bones/humerus.stl", "muscles/muscle_biceps.obj", "other/tract.vtp"}
    assert read.hashes["skin.PLY"] == hashlib.sha256(FORMATS["little.ply"]).hexdigest()
    assert [f.code for f in read.findings] == ["not-read", "merged-vertices"]
    assert (
        "2 files and folders were not read: README.md, drafts/"
        in {f.code: f.message for f in read.findings}["not-read"]
    )
    assert read.anatomy.frame == "as in the files"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("skin", "skin"),
        ("skin_of_arm", "skin"),
        ("Bone-Humerus", "bone"),
        ("muscle_of_bone", "muscle"),
        ("right_humerus_bone_2", "bone"),
        ("first metacarpal bone", "bone"),
        ("other_tract", "other"),
    ],
)
def test_kinds_from_names(name, kind, write):
    read = read_anatomy([write(f"{name}.ply", FORMATS["little.ply"])])
    assert read.anatomy[name].kind.value == kind
    assert read.findings == ()


@pytest.mark.parametrize(
    ("name", "reason"),
    [("humerus", "says no kind"), ("skinny_boneless", "says no kind"), ("a_muscle_bone", "says both bone and muscle")],
)
def test_an_unknown_kind_is_other_with_a_finding(name, reason, write):
    read = read_anatomy([write(f"{name}.ply", FORMATS["little.ply"])])
    assert read.anatomy[name].kind is TissueKind.OTHER
    assert [f.code for f in read.findings] == ["unknown-kind"]
    assert reason in read.findings[0].message


def test_the_table_of_kinds_comes_first_and_its_first_fit_counts(write):
    paths = [write(f"{name}.ply", FORMATS["little.ply"]) for name in ("bone_a", "bone_b", "x")]
    table = (("bone_a", TissueKind.OTHER), ("bone_*", TissueKind.MUSCLE), ("[xy]", TissueKind.SKIN))
    read = read_anatomy(paths, kinds=table)
    assert {t.name: t.kind.value for t in read.anatomy} == {"bone_a": "other", "bone_b": "muscle", "x": "skin"}
    with pytest.raises(
        InputError, match="kind bone is set for 'hum\\*', which no tissue is named; there are: bone_a, bone_b, x"
    ):
        read_anatomy(paths, kinds=(("hum*", TissueKind.BONE),))


def test_patterns_and_odd_file_names(write, tmp_path):
    for name in ("bones/bone_b.ply", "bones/bone_a.ply", "bone_[1].ply"):
        write(name, FORMATS["little.ply"])
    read = read_anatomy([tmp_path / "*" / "bone_?.ply", tmp_path / "bone_[1].ply", tmp_path / "bones" / "bone_a.ply"])
    assert [t.name for t in read.anatomy] == ["bone_[1]", "bone_a", "bone_b"]
    assert (tmp_path / "bones" / "bone_a.ply").as_posix() in read.hashes


def test_what_is_not_there_is_named(write, tmp_path):
    path = write("bone_a.ply", FORMATS["little.ply"])
    for source, message in [
        (tmp_path / "none", "the anatomy's folder .*none is not there"),
        (path, "is a file, not a folder: name it under files"),
        ([tmp_path / "bone_?.stl"], r"no file fits .*bone_\?\.stl"),
        ([tmp_path], "is a folder; name the files in it"),
        ([], "names no file"),
        ([path, write("b/bone_a.stl", FORMATS["binary.stl"])], "would both be the tissue 'bone_a'; rename one"),
        ([write("bone.vtk", b"x")], r"surfaces are read from .stl, .obj, .ply, .vtp files, not .vtk"),
        ([write("bone", b"x")], "not files without ending"),
    ]:
        with pytest.raises(InputError, match=message):
            read_anatomy(source)
    (tmp_path / "bones").mkdir()
    with pytest.raises(InputError, match=r"bones has no surface file; read are .stl, .obj, .ply, .vtp"):
        read_anatomy(tmp_path / "bones")


def test_an_unreadable_file_is_named(tmp_path):
    (tmp_path / "bone_a.ply").symlink_to(tmp_path / "gone.ply")
    with pytest.raises(InputError, match=r"bone_a.ply: cannot be read \(No such file or directory\)"):
        read_surface(tmp_path / "bone_a.ply")


def test_an_open_surface_stops_the_reading_and_names_the_file(write):
    data = trimesh.Trimesh(VERTICES, FACES[:-1], process=False).export(file_type="ply")
    path = write("muscle_open.ply", data)
    with pytest.raises(
        MeshError, match=r"muscle_open\.ply: tissue 'muscle_open' is not closed: 3 boundary edges around 1 hole"
    ):
        read_anatomy([path])


def test_progress_is_told_of_each_file(write):
    ticks = []

    class Watching:
        def stage(self, name):
            from contextlib import nullcontext

            ticks.append(name)
            return nullcontext(ticks.append)

    read_anatomy([write(f"bone_{i}.ply", FORMATS["little.ply"]) for i in range(4)], progress=Watching())
    assert ticks == ["read and check the surfaces", 0.25, 0.5, 0.75, 1.0]


@pytest.mark.anatomy
def test_the_disjoint_arm_reads_without_a_finding(anatomy_data):
    read = read_anatomy(anatomy_data / "arm" / "disjoint")
    assert len(read.anatomy) == len(read.hashes) == 70
    assert read.findings == ()
    counts = {kind.value: len(read.anatomy.of_kind(kind)) for kind in TissueKind}
    assert counts == {"skin": 1, "other": 0, "muscle": 39, "bone": 30}


@pytest.mark.anatomy
def test_the_arm_as_segmented_crosses_and_touches_itself(anatomy_data):
    read = read_anatomy(anatomy_data / "arm" / "as_segmented")
    assert len(read.anatomy) == 71
    crossing = {f.subject for f in read.findings if f.code == "self-crossing"}
    touching = {f.subject for f in read.findings if f.code == "self-touching"}
    assert (len(crossing), len(touching)) == (8, 15)
    assert crossing < touching
    assert {f.code for f in read.findings} == {"self-crossing", "self-touching"}


@pytest.mark.anatomy
@pytest.mark.parametrize(("cage", "pairs"), [("skin_cage", 1), ("skin_cage_very_heavy", 8)])
def test_cages_cross_themselves_as_often_as_their_makers_say(anatomy_data, cage, pairs):
    assert len(self_crossings(read_surface(anatomy_data / "body" / f"{cage}.ply").mesh())) == pairs


@pytest.mark.anatomy
@pytest.mark.slow
def test_the_whole_body_reads(anatomy_data):
    body = anatomy_data / "body"
    read = read_anatomy(
        [body / "skin.ply", body / "bones" / "*.ply", body / "muscles" / "*.ply", body / "other" / "*.ply"]
    )
    assert len(read.anatomy) == len(list(body.glob("*/*.ply"))) + 1
    assert {f.code for f in read.findings} <= {"self-crossing", "self-touching"}


def test_triangle_strips_of_ply_are_read(write):
    head = (
        "ply\nformat {} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
        "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    )
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], dtype="<f4")
    strips = np.array([8, 0, 1, 2, 3, -1, 2, 3, 4], dtype="<i4")
    text = "\n".join(" ".join(map(str, row)) for row in points.tolist()) + "\n" + " ".join(map(str, strips)) + "\n"
    binary = head.format("binary_little_endian").encode() + points.tobytes() + strips.tobytes()
    for data in (head.format("ascii").encode() + text.encode(), binary):
        raw = read_surface(write("a.ply", data))
        np.testing.assert_array_equal(raw.vertices, points)
        assert raw.faces.tolist() == [[0, 1, 2], [1, 3, 2], [2, 3, 4]]
    short = text.replace("8 0 1 2 3 -1 2 3 4", "7 0 1 2 3 -1 2 3")
    with pytest.raises(MeshError, match="a triangle strip has 2 corners"):
        read_surface(write("a.ply", head.format("ascii").encode() + short.encode()))


def _l_shaped(ending, first):
    """An L of one hexagon that begins at one of its corners."""
    corners = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    order = [(first + k) % 6 for k in range(6)]
    if ending == "ply":
        rows = [f"{x} {y} 7" for x, y in corners] + [" ".join(map(str, [6, *order]))]
        return _ply_header("ascii", "float", vertices=6, faces=1) + "\n".join(rows).encode()
    rows = ["mg 1 0.5", *(f"v {x} {y} 7" for x, y in corners)]
    return "\n".join([*rows, "f " + " ".join(str(1 + k) for k in order)]).encode()


@pytest.mark.parametrize("ending", ["obj", "ply"])
@pytest.mark.parametrize("first", range(6))
def test_a_polygon_that_is_not_convex_is_cut_without_folds(ending, first, write):
    raw = read_surface(write(f"l.{ending}", _l_shaped(ending, first)))
    a, b, c = (raw.vertices[raw.faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(3.0)
