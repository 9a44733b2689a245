"""`musclefit warp-image` end to end on a small limb and a made-up image."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nibabel", reason="nibabel is not installed (extra volumes)")

from tiny_rigs import TISSUES, exchanged_rows, write_landmarks, write_tiny_rig

from musclefit.cli.commands import main
from musclefit.cli.warp_image import warp_image
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid, Interpolation
from musclefit.io.formats.nifti import read_volume, write_volume


@pytest.fixture
def rig(tmp_path_factory):
    return write_tiny_rig(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Labels over the box of the limb."""
    vertices = np.concatenate([surface.vertices for surface in TISSUES.values()])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = low
    shape = tuple(int(n) for n in np.ceil((high - low) / 4.0) + 1)
    path = tmp_path_factory.mktemp("image") / "labels.nii.gz"
    labels = np.random.default_rng(0).integers(0, 5, shape).astype(np.uint8)
    write_volume(path, labels, Grid(shape, affine), description="labels")
    return path


def test_labels_are_warped_and_fields_written(rig, image, tmp_path, capsys):
    code = warp_image(
        rig,
        image,
        frame=Frame.RAS,
        out=tmp_path / "warped.nii.gz",
        interpolation=Interpolation.NEAREST,
        jacobian=tmp_path / "jacobian.nii.gz",
        displacements=tmp_path / "field.nii.gz",
        set=("deformer.backend=ffd",),
        quiet=True,
    )
    assert code == 0
    warped, jacobian = read_volume(tmp_path / "warped.nii.gz"), read_volume(tmp_path / "jacobian.nii.gz")
    assert warped.values.dtype == np.uint8
    assert set(np.unique(warped.values)) <= set(range(5))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["field.nii.gz", "jacobian.nii.gz", "warped.nii.gz"]
    assert np.median(jacobian.values) == pytest.approx(1.0, abs=0.2)


def test_slips_are_told_before_the_long_work(rig, image, tmp_path):
    with pytest.raises(InputError, match="no such image"):
        warp_image(rig, tmp_path / "x.nii", frame=Frame.RAS, out=tmp_path / "o.nii", quiet=True)
    floats = tmp_path / "floats.nii"
    write_volume(floats, np.full((3, 3, 3), 0.5, dtype=np.float32), Grid((3, 3, 3), np.eye(4)), description="")
    with pytest.raises(InputError, match="holds fractions, so it is not a label map"):
        warp_image(
            rig,
            floats,
            frame=Frame.RAS,
            out=tmp_path / "o.nii",
            interpolation=Interpolation.NEAREST,
            quiet=True,
        )


def test_nothing_is_written_where_one_of_the_files_cannot_be(rig, image, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    warped = tmp_path / "warped.nii.gz"
    write_landmarks(rig.with_name("landmarks.csv"), exchanged_rows())  # one step cannot exchange them
    for arguments, message in (
        (["--out", str(tmp_path / "warped.mha")], "are read and written as .nii or .nii.gz"),
        (["--out", str(warped), "--jacobian", str(warped)], "is named twice"),
        (["--out", str(image)], "is the image that is read"),
        (["--out", str(warped), "--displacements", str(tmp_path / "file" / "x.nii")], "cannot be written"),
        (["--out", str(warped), "--set", "deformer.max_steps=1"], "ended early: the step budget ran out"),
    ):
        assert main(["warp-image", str(rig), str(image), "--frame", "ras", "--quiet", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
