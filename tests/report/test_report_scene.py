"""Packing of scenes: unpacked here by other code, they are what was given, to within the quantum."""

import base64
import gzip
import json
import math

import numpy as np
import pytest
from tiny_rigs import TISSUES, egg

from musclefit.geometry.meshes import TriMesh
from musclefit.report.html import render_html
from musclefit.report.scene import Scene, SceneField, SceneMark, SceneShape, SceneTissue, packed, quantum_mm

HOSTILE = "</script><img src=x onerror=alert(1)><!-- &"


def tissues(names=tuple(TISSUES)):
    return tuple(SceneTissue(name, name.split("_")[0], "#aa3322") for name in names)


def moved(surface, by):
    return surface.with_vertices(surface.vertices + by)


def scene(*shapes, names=tuple(TISSUES)):
    return Scene(tissues(names), shapes, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def words(data, where, *, running=True):
    """Planes of bytes, least significant first; even is positive; then running sums down the columns, or none."""
    at, rows, columns, planes = where
    planes = np.frombuffer(data, np.uint8, rows * columns * planes, at).reshape(planes, columns, rows).astype(np.int64)
    folded = sum(plane << (8 * k) for k, plane in enumerate(planes))
    steps = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
    return (np.cumsum(steps, axis=1) if running else steps).T


def triangles(data, topologies, number):
    """The triangles of each tissue: those kept of the base, then its own, a corner by the last of the one before."""
    topology, out = topologies[number], []
    first = words(data, topology["first"]).ravel()
    others, runs = (words(data, topology[key], running=False) for key in ("others", "runs"))
    keep = np.repeat(np.arange(len(runs)) % 2 == 0, runs.ravel())
    corners, before = [], None
    for a, (b, c) in zip(first.tolist(), others.tolist(), strict=True):
        corners.append((a, b + (before[2] if before and before[0] == a else a), c + a))
        before = corners[-1]
    base = [] if topology["base"] is None else triangles(data, topologies, topology["base"])
    for t, count in enumerate(topology["triangles"]):
        kept = [f for f, stays in zip(base[t], keep, strict=False) if stays] if base else []
        keep = keep[len(base[t]) :] if base else keep
        assert len(kept) == topology["kept"][t]
        own = count - len(kept)
        out.append([tuple(map(int, f)) for f in [*kept, *corners[:own]]])
        corners = corners[own:]
    assert not corners
    return out


def as_a_set(faces):
    """Triangles whatever their order and their first corner, counted."""
    turns = (tuple(f[k:] + f[:k]) for f in map(tuple, np.asarray(faces).tolist()) for k in [f.index(min(f))])
    return sorted(turns)


def unpacked(text, data):
    """Positions and triangles of every shape."""
    said, data = json.loads(text), gzip.decompress(base64.b64decode(data))
    whole, out = [], []
    for shape in said["shapes"]:
        topology = said["topologies"][shape["topology"]]
        how, *of = shape["guess"]
        if how == "nothing":
            guess = 0
        elif how == "shape":
            guess = whole[of[0]]
        elif how == "line":
            guess = 2 * whole[of[1]] - whole[of[0]]
        else:
            ends = np.cumsum(said["topologies"][said["shapes"][0]["topology"]]["vertices"])
            parts = zip(np.split(whole[0], ends[:-1]), topology["vertices"], strict=True)
            guess = np.concatenate([part[:count] for part, count in parts])
        whole.append((guess + words(data, shape["positions"])) % 65536)
        faces = triangles(data, said["topologies"], shape["topology"])
        out.append((np.array(said["origin"]) + said["quantum"] * whole[-1], faces))
    return out


def test_what_is_unpacked_is_what_was_packed():
    rest = tuple(TISSUES.values())
    fewer = tuple(egg(tuple(s.vertices.mean(axis=0)), (5, 6, 7), subdivisions=1) for s in rest)
    rng = np.random.default_rng(4)
    shapes = [
        SceneShape("Rest", rest),
        SceneShape("Result", tuple(moved(s, rng.normal(0, 9, s.vertices.shape)) for s in rest)),
        SceneShape("Paper's loop", fewer),
        *(
            SceneShape(f"frame {k}", tuple(moved(s, [k * 20.0, -k, k**2]) for s in rest), time_s=k / 9)
            for k in range(5)
        ),
    ]
    found = unpacked(*packed(scene(*shapes)))
    quantum = quantum_mm(scene(*shapes))
    assert quantum < 0.01
    for shape, (positions, faces) in zip(shapes, found, strict=True):
        given = np.concatenate([s.vertices for s in shape.surfaces])
        assert np.abs(positions - given).max() <= 0.5001 * quantum
        for own, surface in zip(faces, shape.surfaces, strict=True):
            assert as_a_set(own) == as_a_set(surface.faces)


def test_values_keep_their_range_and_what_is_no_number():
    surface = egg((0, 0, 0), (1, 1, 1), subdivisions=0)
    values = np.array([-5.0, 0.0, 1.0, 2.0, 9.0, math.nan, math.inf, -math.inf, 0.5, 1.5, 1.0, 1.0])
    shape = SceneShape("Result", (surface,), (SceneField("det J", "", 0.0, 2.0, values),))
    text, data = packed(scene(shape, names=("a",)))
    where = json.loads(text)["shapes"][0]["fields"][0]["values"]
    steps = words(gzip.decompress(base64.b64decode(data)), where).ravel().tolist()
    assert steps == [0, 0, 127, 254, 254, 255, 254, 0, 64, 190, 127, 127]


def test_no_name_closes_a_script():
    mark = SceneMark("overlap", HOSTILE, (HOSTILE,), np.zeros((3, 3)), np.array([[0, 1, 2]]))
    text, _ = packed(scene(SceneShape(HOSTILE, (egg((0, 0, 0), (1, 2, 3)),), (), (mark,)), names=(HOSTILE,)))
    assert not set("<>&") & set(text)
    assert json.loads(text)["tissues"][0]["name"] == HOSTILE


def test_empty_and_single_tissues_are_packed():
    nothing = TriMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    (positions, faces), *_ = unpacked(
        *packed(scene(SceneShape("Rest", (egg((0, 0, 0), (1, 1, 1)), nothing)), names="ab"))
    )
    assert positions.shape[1] == 3
    assert faces[1] == []
    assert max(map(max, faces[0])) == len(positions) - 1


def split(surface, every):
    """Every so many triangles cut in three at their middle; the given vertices stay the first."""
    cut = surface.faces[::every]
    middle = surface.vertices[cut].mean(axis=1)
    new = len(surface.vertices) + np.arange(len(cut))
    parts = [np.stack([cut[:, k], cut[:, (k + 1) % 3], new], axis=1) for k in range(3)]
    left = np.delete(surface.faces, np.s_[::every], axis=0)
    return TriMesh(np.concatenate([surface.vertices, middle]), np.concatenate([*parts, left]))


def test_refined_surfaces_tell_what_they_share_with_the_given_ones():
    given = tuple(TISSUES.values())
    fine, finer = tuple(split(s, 7) for s in given), tuple(split(s, 5) for s in given)
    shapes = [SceneShape("Rest", fine), SceneShape("Loop", given), SceneShape("One shot", finer)]
    text, data = packed(scene(*shapes))
    for shape, (positions, faces) in zip(shapes, unpacked(text, data), strict=True):
        assert len(positions) == sum(len(s.vertices) for s in shape.surfaces)
        for own, surface in zip(faces, shape.surfaces, strict=True):
            assert as_a_set(own) == as_a_set(surface.faces)
    told = json.loads(text)
    assert [t["base"] for t in told["topologies"]] == [None, 0, 0]
    assert [s["topology"] for s in told["shapes"]] == [1, 0, 2]
    for topology, every in zip(told["topologies"][1:], (7, 5), strict=True):
        cut = [len(s.faces[::every]) for s in given]
        assert topology["kept"] == [len(s.faces) - n for s, n in zip(given, cut, strict=True)]
        assert topology["first"][1] == 3 * sum(cut)


@pytest.mark.parametrize("seed", range(6))
def test_any_triangles_come_back(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(9, 3))
    one, other = rng.integers(0, 9, (40, 3)), rng.integers(0, 9, (30, 3))
    both = np.concatenate([one[:35], other, one[:2]])  # some twice, many without a common edge
    shapes = [SceneShape(str(k), (TriMesh(points, faces),)) for k, faces in enumerate((one, both, other))]
    for shape, (_, faces) in zip(shapes, unpacked(*packed(scene(*shapes, names="a"))), strict=True):
        assert as_a_set(faces[0]) == as_a_set(shape.surfaces[0].faces)


def test_a_motion_of_sixty_frames_is_small():
    rest = tuple(TISSUES.values())
    turn = [2 * math.pi * k / 60 for k in range(60)]
    frames = [tuple(moved(s, [30 * math.sin(t), 10 * math.cos(t), 0]) for s in rest) for t in turn]
    shapes = [SceneShape("Rest", rest), *(SceneShape("f", f, time_s=t) for f, t in zip(frames, turn, strict=True))]
    _, data = packed(scene(*shapes))
    assert len(data) < 61 * sum(len(s.vertices) for s in rest) * 3  # under a byte for each coordinate


def test_the_page_without_a_scene_has_no_view(make_report):
    page = render_html(make_report(), pictures={})
    assert 'id="explore"' not in page
    assert 'id="scene"' not in page


@pytest.mark.parametrize("name", ["three.min.js", "viewer.js", "tables.js"])
def test_scripts_ask_no_network(name):
    from importlib.resources import files

    text = files("musclefit.report").joinpath("viewer", name).read_text(encoding="utf-8")
    own = text if name != "three.min.js" else ""
    for word in ("fetch(", "XMLHttpRequest", "import(", "innerHTML", "eval(", "document.write"):
        assert word not in own


def test_the_bundle_comes_with_its_licence():
    from importlib.resources import files

    folder = files("musclefit.report").joinpath("viewer")
    assert "MIT License" in folder.joinpath("three.LICENSE.txt").read_text(encoding="utf-8")
    version = json.loads(folder.joinpath("package.json").read_text(encoding="utf-8"))["devDependencies"]["three"]
    assert version.split(".")[1] in folder.joinpath("three.min.js").read_text(encoding="utf-8")
