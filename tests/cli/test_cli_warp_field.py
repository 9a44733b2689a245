"""`musclefit warp-field`: SimpleITK, given the files, moves points as the deformation does, within the error stated."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel
import numpy as np
import pytest
from tiny_rigs import TISSUES, write_tiny_rig

import musclefit as mf
from musclefit.cli.commands import main
from musclefit.geometry.images.grids import Grid
from musclefit.io.formats.nifti import write_volume

sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed (extra volumes)")

ENDINGS = ("nrrd", "mha", "h5", "nii.gz")
TO_LPS = {"lps": np.ones(3), "ras": np.array([-1.0, -1.0, 1.0])}
FLOAT32 = 1e-5


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    return write_tiny_rig(tmp_path_factory.mktemp("rig") / "rig")


@pytest.fixture(scope="module")
def deformation(rig):
    return mf.run(rig, tets=False).deformation


def opened(path: Path):
    """The file as a transform, as SimpleITK's own users open it."""
    if path.suffix == ".h5":
        return sitk.ReadTransform(str(path))
    return sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))


def moved(transform, points, flip):
    return np.array([transform.TransformPoint((p * flip).tolist()) for p in points]) * flip


@pytest.mark.parametrize("frame", TO_LPS)
@pytest.mark.parametrize("ending", ENDINGS)
def test_simpleitk_moves_points_as_the_deformation_does(rig, deformation, ending, frame, tmp_path, capsys):
    back, forth = tmp_path / f"back.{ending}", tmp_path / f"forth.{ending}"
    arguments = ["--to-rest", str(back), "--to-deformed", str(forth), "--frame", frame, "--spacing-mm", "6"]
    assert main(["warp-field", str(rig), *arguments, "--json", "--quiet"]) == 0
    stated = {field["direction"]: field for field in json.loads(capsys.readouterr().out)["fields"]}
    rest = np.concatenate([surface.vertices for surface in TISSUES.values()])
    there = deformation(rest)
    for path, direction, start, end in (
        (forth, "to deformed", rest, there),
        (back, "to rest", there, rest),
    ):
        off = np.linalg.norm(moved(opened(path), start, TO_LPS[frame]) - end, axis=1)
        error = stated[direction]["sampling_error_mm"]
        assert 0.01 < error["max"] < 1.0
        assert off.max() <= error["max"] + FLOAT32
        assert off.max() >= 0.2 * error["max"]  # the error is not overstated much: it is of the same surfaces
        assert stated[direction]["samples_outside_grid"] == stated[direction]["points_filled"] == 0
        assert stated[direction]["worst_tissue"] in TISSUES
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([back.name, forth.name])


def test_a_finer_grid_is_closer_to_second_order(rig, tmp_path):
    errors = [
        mf.warp_field(rig, to_rest=tmp_path / "x.nrrd", frame="lps", spacing_mm=h).made[0][1].error.max_mm
        for h in (8.0, 4.0)
    ]
    assert errors[1] < 0.4 * errors[0]


def test_an_image_resampled_through_the_file_to_rest_lies_on_the_deformed_body(rig, deformation, tmp_path):
    """ITK leads from the result to what is resampled: a blob at a place at rest lands where the map takes the place."""
    mf.warp_field(rig, to_rest=tmp_path / "back.h5", frame="lps", spacing_mm=4.0)
    at = np.array([30.0, 5.0, 5.0])
    image = sitk.GaussianSource(
        sitk.sitkFloat32, (90, 60, 60), (6.0,) * 3, at.tolist(), 100.0, (-90, -60, -60), (2.0,) * 3
    )
    values = sitk.GetArrayFromImage(sitk.Resample(image, opened(tmp_path / "back.h5"), sitk.sitkLinear))
    found = np.array(np.unravel_index(values.argmax(), values.shape))[::-1] * 2.0 + [-90, -60, -60]
    goes = deformation(at[None])[0]
    assert np.linalg.norm(goes - at) > 8.0
    np.testing.assert_allclose(found, goes, rtol=0, atol=2.0)


def test_nrrd_states_frame_unit_kind_and_direction(rig, tmp_path):
    mf.warp_field(rig, to_deformed=tmp_path / "x.nrrd", frame="ras", spacing_mm=10.0)
    header = (tmp_path / "x.nrrd").read_bytes().split(b"\n\n", 1)[0].decode("ascii").splitlines()
    assert "space: left-posterior-superior" in header
    assert "kinds: vector domain domain domain" in header
    assert "type: float" in header
    assert any("rest to deformed body, mm, LPS+" in line for line in header)


def test_pynrrd_reads_the_same_vectors_and_frame_as_simpleitk(rig, tmp_path):
    import nrrd

    mf.warp_field(rig, to_deformed=tmp_path / "x.nrrd", frame="ras", spacing_mm=10.0)
    vectors, header = nrrd.read(str(tmp_path / "x.nrrd"))
    image = sitk.ReadImage(str(tmp_path / "x.nrrd"), sitk.sitkVectorFloat64)
    assert header["space"] == "left-posterior-superior"
    np.testing.assert_allclose(header["space origin"], image.GetOrigin(), rtol=0, atol=1e-9)
    axes = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    np.testing.assert_allclose(header["space directions"][1:].T, axes, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(vectors.transpose(3, 2, 1, 0), sitk.GetArrayFromImage(image))
    assert np.abs(vectors).max() > 1.0


def test_the_grid_of_an_image_is_taken_and_places_beyond_it_are_told(rig, tmp_path, capsys):
    turn = np.linalg.qr(np.array([[0.9, 0.1, 0.2], [-0.1, 1.0, 0.1], [-0.2, 0.0, 1.0]]))[0]
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn * [4.0, 5.0, 6.0] * np.sign(np.diag(turn)), (-30.0, -40.0, -40.0)
    like = tmp_path / "like.nii"
    write_volume(like, np.zeros((16, 16, 14), dtype=np.uint8), Grid((16, 16, 14), affine), description="")
    path = tmp_path / "x.nrrd"
    assert main(["warp-field", str(rig), "--to-deformed", str(path), "--frame", "ras", "--like", str(like)]) == 0
    assert "lie beyond the grid, which does not move them" in capsys.readouterr().out
    read = sitk.ReadImage(str(path))
    assert read.GetSize() == (16, 16, 14)
    np.testing.assert_allclose(read.GetSpacing(), (4.0, 5.0, 6.0))
    np.testing.assert_allclose(read.GetOrigin(), (30.0, 40.0, -40.0), atol=1e-4)


def test_a_rig_that_states_its_frame_needs_none(rig, tmp_path):
    given = ["anatomy.frame=patient (RAS), mm"]
    made = mf.warp_field(rig, to_rest=tmp_path / "x.nrrd", spacing_mm=10.0, overrides=given)
    assert made.frame == "ras"
    assert "off by" in repr(made)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frame", "lps", "--spacing-mm", "5"], "no file to write"),
        (["--to-rest", "x.nii", "--spacing-mm", "5"], "names not one of LPS and RAS"),
        (["--to-rest", "x.nii", "--spacing-mm", "5", "--frame", "ras", "--set", "anatomy.frame=LPS"], "correct one of"),
        (["--to-rest", "x.vtk", "--frame", "lps", "--spacing-mm", "5"], "choose one of these endings"),
        (["--to-rest", "x.nii", "--to-deformed", "x.nii", "--frame", "lps", "--spacing-mm", "5"], "is named twice"),
        (["--to-rest", "x.nii", "--frame", "lps"], "either a spacing in mm"),
        (["--to-rest", "x.nii", "--frame", "lps", "--spacing-mm", "0"], "expected a length above 0"),
        (["--to-rest", "x.nii", "--frame", "lps", "--spacing-mm", "nan"], "expected a length above 0"),
        (["--to-rest", "x.nii", "--frame", "lps", "--spacing-mm", "0.01"], "mm or more"),
        (["--to-rest", "x.nii", "--frame", "lps", "--spacing-mm", "5", "--margin-mm", "-1"], "expected 0 or more"),
        (["--to-rest", "x.nii", "--frame", "lps", "--like", "none.nii"], "no such image"),
        (["--to-rest", "x.nii", "--frame", "lps", "--like", "far.nii"], "holds no part of the body"),
        (["--to-rest", "x.nii", "--frame", "lps", "--like", "sheared.nii"], "are not orthogonal"),
        (["--to-rest", "rig/x.nii", "--frame", "lps", "--spacing-mm", "5"], "cannot be written"),
    ],
)
def test_what_cannot_be_done_is_refused_and_nothing_is_written(rig, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig").write_text("a file")
    for name, affine in (("far", np.eye(4)), ("sheared", np.eye(4))):
        affine[:2, 3] = 1000.0 if name == "far" else -5.0
        affine[0, 1] = 0.3 if name == "sheared" else 0.0
        grid = Grid((10, 10, 10), affine)
        write_volume(tmp_path / f"{name}.nii", np.zeros(grid.shape, dtype=np.uint8), grid, description="")
    image = nibabel.load(tmp_path / "sheared.nii")
    image.set_qform(None, code=0)  # no shear can be told in it
    nibabel.save(image, tmp_path / "sheared.nii")
    before = sorted(tmp_path.iterdir())
    assert main(["warp-field", str(rig), "--quiet", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before
