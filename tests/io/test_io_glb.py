"""Animated GLB: a valid container that other readers open, whose shape keys put vertices where the frames have them."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import trimesh
from vtkmodules.vtkIOGeometry import vtkGLTFReader

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.io.formats.glb import animated_glb, thinned_surface

COLOURS = {"skin": (0.9, 0.7, 0.6), "muscle_a": (0.7, 0.2, 0.2)}


def anatomy(shift: float) -> Anatomy:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    vertices = np.asarray(ball.vertices)
    bent = vertices + shift * np.column_stack([np.zeros(len(vertices)), vertices[:, 0] ** 2 / 20.0, vertices[:, 2]])
    faces = np.asarray(ball.faces)
    muscle = Tissue("muscle_a", TissueKind.MUSCLE, TriMesh(0.5 * bent, faces))
    return Anatomy((Tissue("skin", TissueKind.SKIN, TriMesh(bent, faces)), muscle), "test")


FRAMES = [anatomy(shift) for shift in (0.0, 0.2, 0.5)]
TIMES = [0.5, 0.75, 1.0]


def opened(data: bytes) -> tuple[dict, bytes]:
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON"
    rest = data[20 + size :]
    assert struct.unpack("<I4s", rest[:8]) == (len(rest) - 8, b"BIN\0")
    return json.loads(data[20 : 20 + size]), rest[8:]


def values(document: dict, data: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
    flat = np.frombuffer(data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], dtype=kind)
    return flat.reshape(accessor["count"], -1)


@pytest.mark.parametrize("triangles", [10**6, 800])
def test_shape_keys_are_the_frames(triangles: int) -> None:
    document, data = opened(animated_glb(FRAMES, TIMES, colours=COLOURS, triangles=triangles))
    assert [mesh["name"] for mesh in document["meshes"]] == ["skin", "muscle_a"]
    for number, mesh in enumerate(document["meshes"]):
        (primitive,) = mesh["primitives"]
        base = values(document, data, primitive["attributes"]["POSITION"])
        share = triangles if triangles > 10**5 else round(triangles / 2)
        kept, faces = thinned_surface(FRAMES[0].tissues[number], triangles=share)
        np.testing.assert_array_equal(values(document, data, primitive["indices"]).ravel(), faces.ravel())
        for frame, target in zip(FRAMES, primitive["targets"], strict=True):
            expected = 1e-3 * frame.tissues[number].surface.vertices[kept][:, [0, 2, 1]] * (1, 1, -1)
            np.testing.assert_allclose(base + values(document, data, target["POSITION"]), expected, rtol=0, atol=1e-8)


def test_the_animation_shows_each_frame_at_its_time() -> None:
    document, data = opened(animated_glb(FRAMES, TIMES, colours=COLOURS))
    (animation,) = document["animations"]
    (sampler,) = animation["samplers"]
    np.testing.assert_allclose(values(document, data, sampler["input"]).ravel(), [0.0, 0.25, 0.5], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(values(document, data, sampler["output"]).reshape(3, 3), np.eye(3))
    assert {channel["target"]["path"] for channel in animation["channels"]} == {"weights"}
    assert document["meshes"][0]["weights"] == [1.0, 0.0, 0.0]


def test_other_readers_open_it() -> None:
    scene = trimesh.load(io.BytesIO(animated_glb(FRAMES, TIMES, colours=COLOURS)), file_type="glb")
    assert {geometry.is_watertight for geometry in scene.geometry.values()} == {True}
    expected = FRAMES[0].vertices()[:, [0, 2, 1]] * (1e-3, 1e-3, -1e-3)
    np.testing.assert_allclose(scene.bounds, [expected.min(axis=0), expected.max(axis=0)], rtol=0, atol=1e-7)


def test_vtk_plays_it(tmp_path: Path) -> None:
    """An independent reader, at each frame's time and between two: shape keys blend evenly."""
    path = tmp_path / "motion.glb"
    path.write_bytes(animated_glb(FRAMES, TIMES, colours=COLOURS))
    reader = vtkGLTFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.EnableAnimation(0)
    reader.ApplyDeformationsToGeometryOn()
    reader.UpdateInformation()
    expected = {time - 0.5: frame.tissues[0].surface.vertices for time, frame in zip(TIMES, FRAMES, strict=True)}
    expected[0.125] = 0.5 * (expected[0.0] + expected[0.25])
    for time, vertices in expected.items():
        reader.UpdateTimeStep(time)
        points = pv.wrap(reader.GetOutput()).combine().points[: len(vertices)]
        np.testing.assert_allclose(points, 1e-3 * vertices[:, [0, 2, 1]] * (1, 1, -1), rtol=0, atol=1e-7)


def test_frames_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="3 frames have 2 times"):
        animated_glb(FRAMES, TIMES[:2], colours=COLOURS)
    ball = trimesh.creation.icosphere(subdivisions=2)
    other = Anatomy(
        tuple(Tissue(t.name, t.kind, TriMesh(np.asarray(ball.vertices), np.asarray(ball.faces))) for t in FRAMES[0]),
        "test",
    )
    with pytest.raises(InputError, match="frame 1 has other tissues or triangles than frame 0"):
        animated_glb([FRAMES[0], other], TIMES[:2], colours=COLOURS)
