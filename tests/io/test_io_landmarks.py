"""Landmark files: read alike from CSV and Slicer, refused by line, column and name when they cannot be right."""

from __future__ import annotations

import json

import numpy as np
import pytest

from musclefit.errors import InputError, LandmarkError
from musclefit.io.formats.landmarks import COINCIDENT_MM, paired, read_landmarks
from musclefit.io.formats.points import read_points
from musclefit.vocabulary import Unit

CSV = "name,bone,x_mm,y_mm,z_mm\nelbow,humerus,1,2,3\nwrist,radius,-4.5,5e1,6\ntip,,7,8,9\n"
POSITIONS = [[1, 2, 3], [-4.5, 50, 6], [7, 8, 9]]
FCSV = (
    "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    '1,1,2,3,0,0,0,1,1,1,0,elbow,,\n2,-4.5,50,6,0,0,0,1,1,1,0,wrist,"at rest, dorsal",\n3,7,8,9,0,0,0,1,1,1,0,tip,,\n'
)


def _markups(**changes):
    points = [
        {"id": str(i), "label": n, "position": p}
        for i, (n, p) in enumerate(zip(("elbow", "wrist", "tip"), POSITIONS, strict=True))
    ]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points} | changes
    return json.dumps({"@schema": "markups-schema-v1.0.3.json", "markups": [markup]})


@pytest.fixture
def write(tmp_path):
    def written(text, name="points.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return written


@pytest.mark.parametrize(
    ("text", "name", "bones", "system"),
    [
        (CSV, "a.csv", ("humerus", "radius", ""), ""),
        (b"\xef\xbb\xbf" + CSV.replace("\n", "\r\n").encode(), "a.CSV", ("humerus", "radius", ""), ""),
        (CSV.replace(",", ";"), "a.csv", ("humerus", "radius", ""), ""),
        (CSV.replace(",", "\t") + "\n\t\t\t\t\n", "a.csv", ("humerus", "radius", ""), ""),
        (CSV.replace("x_mm,y_mm,z_mm", " X_mm, y_MM ,z_mm"), "a.csv", ("humerus", "radius", ""), ""),
        (FCSV, "a.fcsv", ("", "", ""), "LPS"),
        (FCSV.replace("= LPS", "= 1"), "a.fcsv", ("", "", ""), "LPS"),
        (FCSV.replace("= LPS", "= 0"), "a.fcsv", ("", "", ""), "RAS"),
        (_markups(), "a.mrk.json", ("", "", ""), "LPS"),
        (_markups(coordinateSystem="RAS", coordinateUnits=["mm", "mm", "mm"]), "a.mrk.json", ("", "", ""), "RAS"),
    ],
)
def test_every_format_reads_the_same_landmarks(text, name, bones, system, write):
    table = read_landmarks(write(text, name))
    assert table.names == ("elbow", "wrist", "tip")
    np.testing.assert_array_equal(table.positions, POSITIONS)
    assert (table.bones, table.coordinate_system, table.targets) == (bones, system, None)
    assert not table.positions.flags.writeable
    assert table.findings == ()


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
def test_units_of_the_file_count_and_else_the_units_given(unit, factor, write):
    expected = np.array(POSITIONS) * factor
    stated = read_landmarks(write(CSV.replace("_mm", f"_{unit}")), units=Unit.CENTIMETRE)
    np.testing.assert_allclose(stated.positions, expected, rtol=1e-15)
    unstated = read_landmarks(write(CSV.replace("_mm", "")), units=Unit(unit))
    np.testing.assert_allclose(unstated.positions, expected, rtol=1e-15)
    markups = read_landmarks(write(_markups(coordinateUnits=unit), "a.mrk.json"))
    np.testing.assert_allclose(markups.positions, expected, rtol=1e-15)


TARGETS = "name,x_mm,y_mm,z_mm,target_x_cm,target_y_cm,target_z_cm\na,1,2,3,10,20,30\nb,4,5,6,11,20,30\n"


def test_targets_may_be_in_another_unit(write):
    table = read_landmarks(write(TARGETS))
    np.testing.assert_allclose(table.targets, [[100, 200, 300], [110, 200, 300]], rtol=1e-15)
    assert table.bones == ("", "")


def test_prefixes_choose_the_columns(write):
    text = TARGETS.replace(",x_mm,y_mm,z_mm", ",child_x_mm,child_y_mm,child_z_mm").replace("target_", "adult_")
    table = read_landmarks(write(text), source_prefix="child_", target_prefix="adult_")
    np.testing.assert_allclose(table.positions, [[1, 2, 3], [4, 5, 6]], rtol=0)
    np.testing.assert_allclose(table.targets[1], [110, 200, 300], rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "an empty file"),
        (" \n\n", "an empty file"),
        ("name,x_mm,y_mm,z_mm\n", "no landmark; add one row per landmark"),
        (CSV.replace("name", "label"), "no column name; found are: label, bone, x_mm, y_mm, z_mm"),
        (CSV.replace("y_mm", "why"), "no column y_mm beside x_mm; found are: name, bone, x_mm, why, z_mm"),
        (CSV.replace("x_mm,y_mm,z_mm", "a,b,c"), "no columns x_mm, y_mm, z_mm; found are: name, bone, a, b, c"),
        (CSV.replace("z_mm", "z_cm"), "the columns x_mm, y_mm, z_cm are in different units"),
        (CSV.replace("_mm", "_inch"), "column x_inch is in 'inch', an unknown unit; known are mm, cm, m"),
        (CSV.replace("bone", "x_cm"), "both x_cm and x_mm give x; remove one"),
        (CSV.replace("bone", "name"), "two columns are named name"),
        (CSV.replace("5e1", "fifty"), "line 3: y_mm is 'fifty', which is not a number"),
        (CSV.replace("5e1", ""), "line 3: y_mm is '', which is not a number"),
        (CSV.replace("5e1", "nan"), "line 3: y_mm is nan, not finite"),
        (CSV.replace("5e1", "-inf"), "line 3: y_mm is -inf, not finite"),
        (CSV.replace("5e1", "5,1"), "line 3 has 6 values for 5 columns; correct it .numbers are written with a point"),
        (CSV.replace(",6\n", "\n"), "line 3 has 4 values for 5 columns"),
        (CSV.replace("wrist", " "), "line 3 has no name; name the landmark"),
        (CSV.replace("wrist", "elbow"), "two landmarks are named 'elbow'; rename one"),
        (CSV.replace("7,8,9", "1,2,3"), r"landmarks 'elbow' and 'tip' stand at one place, \(1, 2, 3\) mm"),
        (CSV.replace("wrist", '"wrist'), "line .: unexpected end of data"),
        (TARGETS.replace(",target_z_cm", ",z"), "both z_mm and z give z"),
        (TARGETS.replace("target_z_cm", "height"), "no column target_z_cm beside target_x_cm"),
        (
            TARGETS.replace("11,20,30", "10,20,30"),
            r"landmarks 'a' and 'b' are sent to one place, \(100, 200, 300\) mm; no one-to-one map",
        ),
        (CSV.encode().replace(b"wrist", b"h\xf6he"), "not UTF-8 text \\(byte 46"),
    ],
)
def test_what_is_wrong_with_a_csv_is_named(text, message, write):
    path = write(text)
    with pytest.raises(LandmarkError, match=message) as caught:
        read_landmarks(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("apart", "refused"), [(0.5 * COINCIDENT_MM, True), (2 * COINCIDENT_MM, False)])
def test_one_place_is_decided_by_the_named_distance(apart, refused, write):
    path = write(f"name,x_mm,y_mm,z_mm\na,0,0,0\nb,{apart!r},0,0\n")
    if refused:
        with pytest.raises(LandmarkError, match="'a' and 'b' stand at one place"):
            read_landmarks(path)
    else:
        assert len(read_landmarks(path)) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"broken JSON at line 1, column 2"),
        ("[]", "no Slicer markups file: it has no list 'markups'"),
        ('{"markups": 3}', "no Slicer markups file"),
        ('{"markups": []}', "0 markups in one file; save one point list by itself"),
        ('{"markups": [{}]}', "the markup has no list 'controlPoints'"),
        (_markups(controlPoints=[]), "no landmark"),
        (_markups(coordinateSystem="scanner"), "coordinateSystem is 'SCANNER'; known are LPS and RAS"),
        (_markups(coordinateUnits="um"), "coordinateUnits is 'um'; known are mm, cm, m"),
        (_markups(coordinateUnits=["mm", "mm", "s"]), "coordinateUnits is .*; known are"),
        (
            _markups(controlPoints=[{"label": "a", "position": [1, 2]}]),
            r"landmark 'a' has the position \[1, 2\], not 3 numbers",
        ),
        (_markups(controlPoints=[{"label": "a", "position": ["1", 2, 3]}]), "landmark 'a' has the position"),
        (_markups(controlPoints=[{"label": "a", "position": [1, 2, float("nan")]}]), "landmark 'a' is not finite"),
        (_markups(controlPoints=[{"position": [1, 2, 3]}]), "control point 1 has no label"),
        (_markups(controlPoints=[4]), "control point 1 has no label"),
        (
            _markups(controlPoints=[{"label": "a", "positionStatus": "undefined"}]),
            "landmark 'a' is undefined; place it",
        ),
    ],
)
def test_what_is_wrong_with_markups_is_named(text, message, write):
    with pytest.raises(LandmarkError, match=message):
        read_landmarks(write(text, "a.mrk.json"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("CoordinateSystem = LPS", "CoordinateSystem = 2"), "CoordinateSystem is '2'; known are LPS, RAS, 0, 1"),
        (("id,x,y,z,", "id,x,y,w,"), "no column z; found are: id, x, y, w"),
        (("1,1,2,3,0", "1,1,2,3"), "line 4 has 13 values for 14 columns"),
        (("elbow", ""), "line 4 has no label"),
        (("1,1,2,3,", "1,1,two,3,"), "line 4: y is 'two', which is not a number"),
    ],
)
def test_what_is_wrong_with_fcsv_is_named(change, message, write):
    with pytest.raises(LandmarkError, match=message):
        read_landmarks(write(FCSV.replace(*change), "a.fcsv"))


def test_fcsv_without_a_line_of_columns_has_the_usual_ones(write):
    text = "\n".join(line for line in FCSV.splitlines() if "columns" not in line)
    assert read_landmarks(write(text, "a.fcsv")).names == ("elbow", "wrist", "tip")


def test_other_files_are_refused(write, tmp_path):
    with pytest.raises(InputError, match=r"landmarks are read from .csv, .fcsv, .mrk.json and .trc files"):
        read_landmarks(write("{}", "a.json"))
    with pytest.raises(InputError, match=r"gone.csv: cannot be read \(No such file or directory\)"):
        read_landmarks(tmp_path / "gone.csv")


def test_markups_without_a_coordinate_system_are_taken_as_slicer_takes_them(write):
    silent = json.loads(_markups())
    del silent["markups"][0]["coordinateSystem"]
    table = read_landmarks(write(json.dumps(silent), "a.mrk.json"))
    assert table.coordinate_system == "LPS"
    (finding,) = table.findings
    assert finding.code == "assumed-frame"
    assert "states no coordinateSystem; taken to be in LPS" in finding.message
    with pytest.raises(LandmarkError, match="in RAS: x and y have opposite signs"):
        paired(table, read_landmarks(write(FCSV.replace("LPS", "RAS"), "a.fcsv")))


def test_a_point_list_is_found_among_lines_and_planes(write):
    alone = json.loads(_markups())["markups"][0]
    ends = [{"label": "l-1", "position": [0, 0, 0]}, {"label": "l-2", "position": [9, 9, 9]}]
    line, plane = ({"type": kind, "coordinateSystem": "LPS", "controlPoints": ends} for kind in ("Line", "Plane"))
    path = write(json.dumps({"markups": [plane, {**alone, "type": "Fiducial"}, line]}), "a.mrk.json")
    table, wanted = read_landmarks(path), read_landmarks(write(_markups(), "b.mrk.json"))
    assert table.names == wanted.names
    np.testing.assert_array_equal(table.positions, wanted.positions)
    (finding,) = table.findings
    assert finding.code == "markups-passed-over"
    assert "2 other markups were passed over: Plane, Line" in finding.message
    # moved points go back to their own markup, the others stay
    points = read_points(path, units=Unit.MILLIMETRE)
    points.rewrite(points.points + np.array([1.0, 0.0, 0.0]), path.with_name("moved.mrk.json"))
    moved = json.loads(path.with_name("moved.mrk.json").read_text())["markups"]
    assert moved[0] == plane
    assert moved[2] == line
    np.testing.assert_allclose(
        [p["position"] for p in moved[1]["controlPoints"]],
        np.array([p["position"] for p in alone["controlPoints"]]) + np.array([1.0, 0.0, 0.0]),
        rtol=0,
        atol=1e-12,
    )


def test_two_point_lists_and_a_plane_alone_are_refused(write):
    alone = json.loads(_markups())["markups"][0]
    two = json.dumps({"markups": [{**alone, "type": "Fiducial"}, {**alone, "type": "Fiducial"}]})
    with pytest.raises(LandmarkError, match=r"2 markups in one file; .* found are: Fiducial, Fiducial"):
        read_landmarks(write(two, "a.mrk.json"))
    with pytest.raises(LandmarkError, match="its markup is a Plane, whose control points are not landmarks"):
        read_landmarks(write(json.dumps({"markups": [{**alone, "type": "Plane"}]}), "a.mrk.json"))
    line = read_landmarks(write(json.dumps({"markups": [{**alone, "type": "Line"}]}), "a.mrk.json"))
    assert len(line) == len(alone["controlPoints"])


def test_pairs_are_matched_by_name_not_by_row(write):
    source = read_landmarks(write(CSV))
    target = read_landmarks(write("name,x_mm,y_mm,z_mm\ntip,70,80,90\nelbow,10,20,30\nthumb,0,0,0\n", "b.csv"))
    pairs = paired(source, target)
    assert pairs.names == ("elbow", "tip")
    np.testing.assert_array_equal(pairs.positions, [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(pairs.targets, [[10, 20, 30], [70, 80, 90]])
    assert pairs.bones == ("humerus", "")
    assert [(f.subject, f.code) for f in pairs.findings] == [
        ("points.csv", "unmatched-landmarks"),
        ("b.csv", "unmatched-landmarks"),
    ]
    assert "wrist" in pairs.findings[0].message
    assert "thumb" in pairs.findings[1].message


def test_pairs_that_cannot_be(write):
    source = read_landmarks(write(CSV))
    with pytest.raises(LandmarkError, match="have no landmark name in common"):
        paired(source, read_landmarks(write(CSV.replace("\n", "\nright_").rsplit("right_", 1)[0], "b.csv")))
    with pytest.raises(LandmarkError, match=r"'elbow' is on bone 'humerus' in .*points\.csv, on 'ulna' in .*b\.csv"):
        paired(source, read_landmarks(write(CSV.replace("humerus", "ulna"), "b.csv")))
    with pytest.raises(LandmarkError, match="has target columns and is paired with a second file"):
        paired(read_landmarks(write(TARGETS, "c.csv")), source)


def test_frames_that_differ_are_refused_and_one_unstated_is_reported(write):
    lps, ras = (
        read_landmarks(write(_markups(), "a.mrk.json")),
        read_landmarks(write(FCSV.replace("LPS", "RAS"), "a.fcsv")),
    )
    with pytest.raises(LandmarkError, match=r"a.mrk.json is in LPS, but .*a.fcsv in RAS: x and y have opposite signs"):
        paired(lps, ras)
    pairs = paired(read_landmarks(write(CSV)), ras)
    assert [f.code for f in pairs.findings] == ["one-frame"]
    assert "a.fcsv is in RAS, points.csv states no coordinate system" in pairs.findings[0].message
    assert pairs.coordinate_system == "RAS"
    assert paired(lps, lps).findings == ()


@pytest.mark.anatomy
def test_the_landmarks_of_the_real_anatomy(anatomy_data):
    arm = read_landmarks(anatomy_data / "arm" / "landmarks_35.csv")
    counts = {bone: arm.bones.count(bone) for bone in dict.fromkeys(arm.bones)}
    assert list(counts.values()) == [10, 10, 10, 5]
    assert len(read_landmarks(anatomy_data / "leg" / "landmarks_20.csv")) == 20
    brain = read_landmarks(anatomy_data / "brain" / "landmarks_40.csv", source_prefix="child_", target_prefix="adult_")
    assert brain.targets.shape == brain.positions.shape == (40, 3)
