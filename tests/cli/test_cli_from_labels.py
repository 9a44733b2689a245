"""A segmentation becomes surfaces, a joint and a rig that runs; what is wrong gets exit 2 and a remedy."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import label_forms as forms
import numpy as np
import pytest

import musclefit as mf
from musclefit.cli.commands import main
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.solids import moved_solid, overlap_volume, solid_of


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the command makes of masks in a folder."""
    folder = tmp_path_factory.mktemp("hip")
    assert main(["from-labels", str(forms.write_folder(folder / "masks")), str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


def test_the_rig_is_of_the_image(made: Path) -> None:
    """Anatomy and joint where the voxels are, in LPS, which has x and y of the images turned about."""
    anatomy = mf.read_anatomy(made / "surfaces").anatomy
    assert {t.name: t.kind.value for t in anatomy} == {
        "skin": "skin",
        "gluteus_maximus_left": "muscle",
        "hip_left": "bone",
        "femur_left": "bone",
    }
    job = mf.read_rig(made / "rig.toml")
    assert job.anatomy.frame == "patient (LPS), mm"
    centre = forms.AFFINE[:3] @ [*(forms.CENTRE / forms.SPACING_MM), 1.0] * [-1.0, -1.0, 1.0]
    report = json.loads((made / "report.json").read_text())
    (joint,) = report["joints"]
    assert (joint["name"], joint["fixed"], joint["moves"]) == ("hip_left", "hip_left", ["femur_left"])
    np.testing.assert_allclose(joint["centre_mm"], centre, rtol=0, atol=0.3)


def test_the_report_says_how_surfaces_follow_the_voxels(made: Path) -> None:
    report = json.loads((made / "report.json").read_text())
    assert report["verdict"] == "passed"
    anatomy = mf.read_anatomy(made / "surfaces").anatomy
    labels = forms.hip_labels()
    for fit in report["fits"]:
        value = next(v for v, name in forms.NAMES.items() if name == fit["name"])
        voxels = int((labels > 0).sum() if value == 1 else (labels == value).sum())
        assert fit["voxels"] == voxels
        volume = enclosed_volume(anatomy[fit["name"]].surface)
        assert volume == pytest.approx(fit["surface_mm3"], rel=1e-9)
        assert volume == pytest.approx(voxels * forms.SPACING_MM**3, rel=0.01)
        assert fit["largest_voxels"] <= 0.5
    codes = {finding["code"] for finding in report["findings"]}
    assert {"kinds-by-name", "shared-voxels", "cut-by-image"} <= codes
    assert report["shared_voxels"][0]["voxels"] == 24


def test_ball_and_cup_stay_apart(made: Path) -> None:
    anatomy = mf.read_anatomy(made / "surfaces").anatomy
    gap = nearest_places(anatomy["hip_left"].surface.vertices, anatomy["femur_left"].surface).distances
    assert gap.min() > 1.0  # of 2 mm, at voxels of 1.5 mm
    assert np.median(gap[gap < 4.0]) == pytest.approx(2.0, abs=0.4)


def test_masks_that_cannot_be_used_fail_with_all_others_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = forms.write_folder(tmp_path / "masks")
    (folder / "liver.nii.gz").write_bytes(b"damaged")
    assert main(["from-labels", str(folder), str(tmp_path / "out"), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "failed"
    assert next(f for f in told["findings"] if f["code"] == "left-out")["subject"] == "liver"
    assert len(list((tmp_path / "out" / "surfaces").rglob("*.ply"))) == 4
    assert (tmp_path / "out" / "rig.toml").is_file()


def test_bad_input_is_refused_before_anything_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = forms.write_nifti(tmp_path / "hip.nii.gz", forms.hip_labels())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "masks").mkdir()
    (tmp_path / "cut.nii.gz").write_bytes(image.read_bytes()[:-200])
    for arguments, message in (
        (["none.nii.gz", "out"], "no such"),
        (["cut.nii.gz", "out"], "cannot be read as NIfTI"),
        (["masks", "out"], "holds no mask"),
        (["hip.nii.gz", "full"], "is not an empty folder"),
        (["hip.nii.gz", "out", "--names", "none.csv"], "cannot be read"),
        (["hip.nii.gz", "out", "--kind", "femur*=bone"], "which no label is named"),
        (["hip.nii.gz", "out", "--within-mm", "-1"], "within_mm"),
    ):
        given = [str(tmp_path / a) if i < 2 or a.endswith(".csv") else a for i, a in enumerate(arguments)]
        assert main(["from-labels", *given, "--quiet"]) == 2, arguments
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"]


def test_python_users_get_records(tmp_path: Path) -> None:
    image = forms.write_nifti(tmp_path / "hip.nii.gz", forms.hip_labels(), names=forms.NAMES)
    done = mf.from_labels(image, frame="ras", progress=None)
    assert done.passed
    assert done.written == ()
    assert repr(done).startswith("<FromLabels: passed; 4 surfaces of a label map in patient (RAS), mm, 1 joints")
    frames = done.to_frames()
    assert list(frames["fits"]["name"]) == [tissue.name for tissue in done.anatomy]
    assert (frames["fits"]["volume_percent"].abs() < 1.0).all()


@pytest.mark.parametrize("side", [-1.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_rig_turns_to_the_side_that_is_free(side: float, tmp_path: Path) -> None:
    """An olecranon stops the elbow within 10 degrees to one side: the first pose goes to the other one."""
    names = {1: "humerus_left", 2: "ulna_left"}
    image = forms.write_nifti(tmp_path / "elbow.nii.gz", forms.elbow_labels(side), names=names)
    assert main(["from-labels", str(image), str(tmp_path / "out"), "--quiet"]) == 0
    job = mf.read_rig(tmp_path / "out" / "rig.toml")
    (angle,) = tomllib.loads((tmp_path / "out" / "rig.toml").read_text())["drive"]["pose"].values()
    assert abs(angle) == 10.0
    solids = {tissue.name: solid_of(tissue.surface) for tissue in job.anatomy}
    assert job.joints is not None
    shared = [
        overlap_volume(
            solids["humerus_left"],
            moved_solid(solids["ulna_left"], job.joints.motions({"elbow_left": degrees})["ulna_left"]),
        )
        for degrees in (angle, -angle)
    ]
    assert shared[0] < 1.0
    assert shared[1] > 10.0


def test_a_hollow_that_holds_another_tissue_is_no_stray(tmp_path: Path) -> None:
    """Eight voxels of bone in a ball of muscle: both the hollow and the piece of bone are below a share of strays."""
    at = np.stack(np.meshgrid(*[np.arange(56)] * 3, indexing="ij"), axis=-1)
    labels = np.zeros((56, 56, 56), dtype=np.uint8)
    labels[np.linalg.norm(at - 27.5, axis=-1) < 25] = 1
    labels[27:29, 27:29, 27:29] = 2
    labels[1:4, 1:12, 1:12] = 2
    forms.write_nifti(tmp_path / "ball.nii.gz", labels)
    (tmp_path / "names.csv").write_text("value,name\n1,muscle_ball\n2,bone_plate\n")
    made = mf.from_labels(tmp_path / "ball.nii.gz", names=tmp_path / "names.csv", progress=None)
    ball, plate = (made.anatomy[name].surface for name in ("muscle_ball", "bone_plate"))
    assert overlap_volume(solid_of(ball), solid_of(plate)) == 0.0
    assert made.passed
    assert made.repair.resolved is None  # nothing was cut
    assert all(abs(fit.volume_percent) < 1.0 for fit in made.fits)
    assert [f.message for f in made.findings if f.code == "strays-kept"]
