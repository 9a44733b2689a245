"""Segmentations in all their forms are one label map; what is wrong with one is named, with the way out."""

from __future__ import annotations

from pathlib import Path

import label_forms as forms
import nibabel
import nrrd
import numpy as np
import pytest

from musclefit.anatomy.kind_words import kind_by_name
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.io.formats.label_images import read_label_image
from musclefit.io.formats.nifti import HeaderForm, read_volume
from musclefit.io.label_names import read_names
from musclefit.io.segmentations import Segmentation, read_segmentation


def read_all(folder: Path) -> dict[str, Segmentation]:
    """The same hip read from each form."""
    table = forms.write_table(folder / "names.csv")
    labels = forms.hip_labels()
    whole = forms.write_nifti(folder / "map.nii.gz", labels)
    floats = forms.write_nifti(folder / "floats.nii", labels.astype(np.float32))
    named = forms.write_nifti(folder / "named.nii.gz", labels, names=forms.NAMES)
    return {
        "map": read_segmentation(whole, names=table),
        "floats": read_segmentation(floats, names=table),
        "header": read_segmentation(named),
        "folder": read_segmentation(forms.write_folder(folder / "masks")),
        "stack": read_segmentation(forms.write_stack(folder / "stack.nii.gz"), names=table),
        "slicer": read_segmentation(forms.write_seg_nrrd(folder / "hip.seg.nrrd")),
    }


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Segmentation]:
    return read_all(tmp_path_factory.mktemp("forms"))


@pytest.mark.parametrize("form", ["map", "floats", "header", "folder", "stack", "slicer"])
def test_every_form_is_the_same_label_map(read: dict[str, Segmentation], form: str) -> None:
    one = read[form]
    np.testing.assert_allclose(one.grid.affine, forms.AFFINE, rtol=0, atol=1e-9)
    assert {name.name: name.kind.value for name in one.names} == {
        "skin": "skin",
        "gluteus_maximus_left": "muscle",
        "hip_left": "bone",
        "femur_left": "bone",
    }
    expected = forms.hip_labels()
    for name in one.names:
        value = next(v for v, n in forms.NAMES.items() if n == name.name)
        np.testing.assert_array_equal(one.labels == name.value, expected == value)


@pytest.mark.parametrize("form", ["folder", "stack", "slicer"])
def test_shared_voxels_go_to_the_inner_kind_and_are_told(read: dict[str, Segmentation], form: str) -> None:
    (shared,) = read[form].shared
    assert (shared.kept_by, shared.lost_by, shared.voxels) == ("hip_left", "gluteus_maximus_left", 24)
    assert shared.volume_mm3 == pytest.approx(24 * 1.5**3)
    assert any("a voxel goes to the innermost kind" in finding.message for finding in read[form].findings)


def test_within_a_kind_the_smaller_tissue_keeps_what_two_claim(tmp_path: Path) -> None:
    large, small = np.zeros((2, 10, 10, 10), dtype=np.uint8)
    large[1:9, 1:9, 1:9], small[3:6, 3:6, 3:6] = 1, 1
    (tmp_path / "masks").mkdir()
    for name, mask in (("soleus", large), ("plantaris", small)):
        forms.write_nifti(tmp_path / "masks" / f"{name}.nii", mask)
    made = read_segmentation(tmp_path / "masks")
    kept = next(name for name in made.names if name.name == "plantaris")
    assert (made.labels == kept.value).sum() == 27


def test_one_bad_mask_never_refuses_the_rest(tmp_path: Path) -> None:
    folder = forms.write_folder(tmp_path / "masks")
    whole = (folder / "skin.nii.gz").read_bytes()
    (folder / "a_truncated.nii.gz").write_bytes(whole[: len(whole) // 2])
    forms.write_nifti(folder / "b_other_image.nii.gz", np.ones((4, 4, 4), dtype=np.uint8))
    turned = np.diag([-1.0, -1.0, 1.0, 1.0]) @ forms.AFFINE
    forms.write_nifti(folder / "c_lps.nii.gz", forms.hip_labels(), affine=turned)
    forms.write_nifti(folder / "d_lps.nii.gz", (forms.hip_labels() == 4).astype(np.uint8), affine=turned)
    forms.write_nifti(folder / "e_probability.nii.gz", (forms.hip_labels() / 7.0).astype(np.float32))
    made = read_segmentation(folder)
    assert {name.name for name in made.names} == set(forms.NAMES.values())
    told = {finding.subject: finding.message for finding in made.findings if finding.code == "left-out"}
    assert set(told) == {"a_truncated", "b_other_image", "c_lps", "d_lps", "e_probability"}
    assert "has 4 x 4 x 4 voxels" in told["b_other_image"]
    assert "4 different labels" in told["c_lps"]
    assert "as if one were LPS and the other RAS" in told["d_lps"]
    assert "are not whole numbers" in told["e_probability"]


def test_masks_of_different_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for number in range(3):
        affine = forms.AFFINE.copy()
        affine[0, 3] += 5.0 * number
        forms.write_nifti(tmp_path / "masks" / f"m{number}.nii", np.ones((3, 3, 3), dtype=np.uint8), affine=affine)
    with pytest.raises(InputError, match=r"its 3 masks are of 3 different images; .* up to 5 mm from"):
        read_segmentation(tmp_path / "masks")


def two_places(path: Path, *, apart_mm: float) -> Path:
    image = nibabel.Nifti1Image(forms.hip_labels(), forms.AFFINE)
    image.set_qform(forms.AFFINE, code=1)
    other = forms.AFFINE.copy()
    other[2, 3] += apart_mm
    image.set_sform(other, code=2)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    return path


def test_a_header_with_two_places_is_refused_until_one_is_chosen(tmp_path: Path) -> None:
    path = two_places(tmp_path / "two.nii.gz", apart_mm=4.0)
    for reader in (read_label_image, read_volume):
        with pytest.raises(InputError, match=r"sform and qform put the image up to 4 mm apart.*--header-form"):
            reader(path)
    by_qform = read_label_image(path, form=HeaderForm.QFORM)
    assert by_qform.grid.affine[2, 3] == pytest.approx(300.0)
    assert read_label_image(path, form=HeaderForm.SFORM).grid.affine[2, 3] == pytest.approx(304.0)
    assert read_label_image(two_places(tmp_path / "one.nii.gz", apart_mm=1e-4)).grid.affine[2, 3] == pytest.approx(
        300.0
    )


def bad_nrrd(path: Path, **fields: object) -> Path:
    header = {
        "space": "left-posterior-superior",
        "space directions": np.eye(3),
        "space origin": np.zeros(3),
        "encoding": "raw",
    }
    nrrd.write(
        str(path), np.ones((4, 5, 6), dtype=np.uint8), {k: v for k, v in (header | fields).items() if v is not None}
    )
    return path


def test_bad_images_are_refused_in_words(tmp_path: Path) -> None:
    shear = np.eye(3)
    shear[0, 1] = 0.2
    cut = bad_nrrd(tmp_path / "cut.nrrd")
    cut.write_bytes(cut.read_bytes()[:-40])
    detached = tmp_path / "apart.nrrd"
    detached.write_bytes(cut.read_bytes().replace(b"encoding: raw", b"encoding: raw\ndata file: /etc/hostname"))
    unknown = nibabel.Nifti1Image(np.ones((4, 4, 4), dtype=np.uint8), None)
    nibabel.save(unknown, tmp_path / "nowhere.nii")
    (tmp_path / "text.nii.gz").write_text("no image")
    for name, message in (
        ("none.nii", "no such"),
        ("a.mha", "no such file"),
        ("text.nii.gz", "cannot be read as NIfTI"),
        ("nowhere.nii", "states no orientation"),
        ("cut.nrrd", "cut short|cannot be read as NRRD"),
        ("apart.nrrd", "voxels are in another file"),
        (bad_nrrd(tmp_path / "space.nrrd", space="scanner-xyz").name, "which is not a patient frame"),
        (bad_nrrd(tmp_path / "shear.nrrd", **{"space directions": shear}).name, "axes are 78.7 degrees apart"),
        (bad_nrrd(tmp_path / "units.nrrd", **{"space units": ["inch"] * 3}).name, "write mm"),
        (forms.write_nifti(tmp_path / "parts.nii", np.full((3, 3, 3), 0.5, np.float32)).name, "27 of 27 voxels are no"),
        (forms.write_nifti(tmp_path / "nan.nii", np.full((3, 3, 3), np.nan, np.float32)).name, "not whole numbers"),
    ):
        with pytest.raises(InputError, match=message):
            read_label_image(tmp_path / name)
    (tmp_path / "a.mha").write_text("")
    with pytest.raises(InputError, match=r"segmentations are read from \.nii, \.nii\.gz, \.nrrd files"):
        read_label_image(tmp_path / "a.mha")


def test_what_is_no_segmentation_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    million = np.arange(64**3, dtype=np.int32).reshape(64, 64, 64)
    for source, message in (
        (tmp_path / "empty", "holds no mask; expected one"),
        (forms.write_nifti(tmp_path / "blank.nii.gz", np.zeros((4, 4, 4), np.uint8)), "every voxel is 0"),
        (forms.write_nifti(tmp_path / "ct.nii.gz", million - 1000), "different values from -1000"),
        (forms.write_nifti(tmp_path / "many.nii.gz", million), "at most 20000 labels"),
    ):
        with pytest.raises(InputError, match=message):
            read_segmentation(source)


def test_wrong_names_are_refused_with_what_there_is(tmp_path: Path) -> None:
    image = forms.write_nifti(tmp_path / "map.nii.gz", forms.hip_labels())
    (tmp_path / "other.csv").write_text("value,name\n70,liver\n")
    with pytest.raises(
        InputError, match="none of the 1 values in the table of names is in the image, which holds 1, 2, 3"
    ):
        read_segmentation(image, names=tmp_path / "other.csv")
    table = forms.write_table(tmp_path / "names.csv")
    with pytest.raises(InputError, match=r"set for 'fibula\*', which no label is named; there are: skin"):
        read_segmentation(image, names=table, kinds=[("fibula*", TissueKind.BONE)])
    with pytest.raises(InputError, match=r"2 labels are skin \(skin, hip_left\)"):
        read_segmentation(image, names=table, kinds=[("hip*", TissueKind.SKIN)])
    stack = forms.write_stack(tmp_path / "stack.nii.gz")
    (tmp_path / "five.csv").write_text("value,name\n5,liver\n")
    with pytest.raises(InputError, match="the table names volume 5, but there are 4"):
        read_segmentation(stack, names=tmp_path / "five.csv")


def test_labels_without_names_are_named_by_their_values_and_told(tmp_path: Path) -> None:
    made = read_segmentation(forms.write_nifti(tmp_path / "map.nii.gz", forms.hip_labels()))
    assert [(name.name, name.kind.value) for name in made.names] == [(f"label_{k}", "other") for k in (1, 2, 3, 4)]
    assert any("use --names" in finding.message for finding in made.findings)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "Index,Structure,Kind\n0,background,\n7,femur_left,Bone\n9,psoas,\n"),
        ("a.tsv", "label\tname\n7\tfemur_left\n9\tpsoas\n"),
        ("a.json", '{"7": "femur_left", "9": "psoas"}'),
        ("b.json", '{"labels": {"background": 0, "femur_left": 7, "psoas": 9}}'),
        ("a.ctbl", '# Color table\n0 background 0 0 0 0\n7 "femur_left" 1 2 3 255\n9 psoas 1 2 3 255\n'),
    ],
)
def test_tables_of_names_are_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert [(row.value, row.name) for row in read_names(tmp_path / name)] == [(7, "femur_left"), (9, "psoas")]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "a,b\n1,2\n", "has no column 'value'"),
        ("a.csv", "", "has no column 'value'"),
        ("a.csv", "value,name\n1.5,x\n", "line 2: value is '1.5'; expected a whole number"),
        ("a.csv", "value,name\n1,x\n1,y\n", "the value 1 is named twice"),
        ("a.csv", "value,name\n1,\n", "label 1 has no name"),
        pytest.param("a.csv", f"value,name\n1,{'x' * 131_073}\n", "field larger than field limit", id="long name"),
        ("a.csv", "value,name\n0,background\n", "names no label above 0"),
        ("a.csv", "value,name,kind\n1,x,liver\n", "kind is 'liver'; known are skin"),
        ("a.json", "{", "is no JSON"),
        ("a.json", "[1]", "expected"),
        ("a.ctbl", "7\n", "expected value, name and colours"),
    ],
)
def test_bad_tables_of_names_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_names(tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (
            "bone",
            "femur_left hip_right rib_left_1 vertebrae_L1 clavicula_left sacrum skull bone_core patella scapula_left",
        ),
        (
            "muscle",
            "gluteus_maximus_left iliopsoas_right autochthon_left tibialis_anterior muscle_x flexor_hallucis",
        ),
        (
            "other",
            "costal_cartilages spinal_cord heart_atrium_left liver intermuscular_fat small_bowel aorta",
        ),
        ("skin", "skin body"),
    ],
)
def test_names_say_kinds(kind: str, names: str) -> None:
    for name in names.split():
        found = kind_by_name(name)
        assert found is not None
        assert found.value == kind, name


def test_words_that_say_nothing_say_no_kind() -> None:
    assert kind_by_name("label_7") is None
    assert kind_by_name("region_of_interest") is None
