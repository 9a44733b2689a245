"""Runs open in 3D Slicer: a scene with names, colours and frame, and surfaces that state it as its reader looks for."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
import vtk
from tiny_rigs import TISSUES, write_tiny_rig

import musclefit as mf
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, stated_frame
from musclefit.io.formats.mrml import SceneModel, scene_text


@pytest.fixture(scope="module", params=["patient (RAS), mm", "LPS", "laboratory"])
def folder(request, tmp_path_factory):
    home = tmp_path_factory.mktemp("scene")
    out = home / "out"
    mf.run(
        write_tiny_rig(home / "rig"), out=out, tets=False, pictures=False, overrides=[f"anatomy.frame={request.param}"]
    )
    return out, request.param


def test_a_scene_names_every_tissue_once_with_its_file_colour_and_frame(folder):
    out, frame = folder
    scene = ElementTree.parse(out / "scene.mrml").getroot()
    by_id = {node.get("id"): node for node in scene}
    assert len(by_id) == len(scene) == 3 * len(TISSUES)
    models = scene.findall("Model")
    assert sorted(node.get("name", "") for node in models) == sorted(TISSUES)
    for model in models:
        display, storage = (by_id[part.split(":")[1]] for part in model.get("references").rstrip(";").split(";"))
        assert storage.get("coordinateSystem") == ("RAS" if "RAS" in frame else "LPS")
        assert (out / unquote(storage.get("fileName"))).is_file()
        colour = [float(part) for part in display.get("color").split()]
        assert len(colour) == 3
        assert all(0.0 <= part <= 1.0 for part in colour)
        assert (float(display.get("opacity")) < 1.0) == (model.get("name") == "skin")


def test_surfaces_state_their_frame_as_slicer_looks_for_it(folder):
    """In VTP a string array SPACE of the field data, in PLY a comment that holds SPACE=: as vtkMRMLModelStorageNode."""
    out, frame = folder
    wanted = stated_frame(frame)
    for name in TISSUES:
        vtp, ply = vtk.vtkXMLPolyDataReader(), vtk.vtkPLYReader()
        for reader, ending in ((vtp, "vtp"), (ply, "ply")):
            reader.SetFileName(str(out / "surfaces" / f"{name}.{ending}"))
            reader.Update()
        space = vtp.GetOutput().GetFieldData().GetAbstractArray("SPACE")
        comments = ply.GetComments()
        said = [comments.GetValue(k) for k in range(comments.GetNumberOfValues())]
        assert any("SPACE=" in comment for comment in said) == (wanted is not None)
        if wanted is None:
            assert space is None
        else:
            assert space.GetValue(0) == wanted.value.upper()
            assert f"SPACE={wanted.value.upper()}" in said
        assert vtp.GetOutput().GetNumberOfPoints() == ply.GetOutput().GetNumberOfPoints() == len(TISSUES[name].vertices)


def test_names_of_any_kind_make_a_scene_that_can_be_read():
    names = ['m. "biceps" <long> & co', "尺骨", "tab\tline\nbell\x07", "50 % off;storage:x"]
    models = [SceneModel(name, f"surfaces/{k} 100%.vtp", (0.1, 0.2, 0.3)) for k, name in enumerate(names)]
    scene = ElementTree.fromstring(scene_text(models, frame=Frame.RAS).encode())
    found = [node.get("name") for node in scene.findall("Model")]
    assert found[:2] == names[:2]
    assert "\x07" not in found[2]
    assert [unquote(node.get("fileName")) for node in scene.findall("ModelStorage")] == [m.file for m in models]
    with pytest.raises(InputError, match="without a model"):
        scene_text([], frame=Frame.LPS)


@pytest.mark.parametrize(
    ("words", "frame"),
    [("patient (LPS), mm", Frame.LPS), ("RAS", Frame.RAS), ("", None), ("LPS or RAS", None), ("laps", None)],
)
def test_a_frame_is_stated_or_not(words, frame):
    assert stated_frame(words) is frame


def test_the_example_folder_is_read_back_as_it_was_written(folder):
    out, _ = folder
    again = mf.read_anatomy([out / "surfaces" / f"{name}.ply" for name in TISSUES], units=mf.Unit.MILLIMETRE).anatomy
    assert sorted(t.name for t in again) == sorted(TISSUES)
    assert all(np.isfinite(t.surface.vertices).all() for t in again)
    assert isinstance(out, Path)
