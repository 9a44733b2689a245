"""A segmentation on disk becomes a folder of surfaces that reads back as the same anatomy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nibabel", reason="nibabel is not installed (extra volumes)")

from musclefit.cli.label_surfaces import label_surfaces
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid
from musclefit.geometry.measures import enclosed_volume
from musclefit.io.anatomy import read_anatomy
from musclefit.io.formats.nifti import write_volume
from musclefit.io.label_maps import read_label_names


def test_a_segmentation_is_an_anatomy(tmp_path, capsys):
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[4:20, 4:20, 4:20], labels[8:16, 8:16, 8:16] = 3, 7
    write_volume(tmp_path / "seg.nii.gz", labels, Grid((24, 24, 24), np.diag([2.0, 2.0, 2.0, 1.0])), description="")
    (tmp_path / "names.csv").write_text("value,name,kind\n3,skin,skin\n7,bone_core,bone\n")
    assert label_surfaces(tmp_path / "seg.nii.gz", tmp_path / "names.csv", out=tmp_path / "out", frame=Frame.LPS) == 0
    assert "wrote 2 surfaces" in capsys.readouterr().out
    with pytest.raises(InputError, match="is not an empty folder"):
        label_surfaces(tmp_path / "seg.nii.gz", tmp_path / "names.csv", out=tmp_path / "out", frame=Frame.LPS)
    anatomy = read_anatomy(tmp_path / "out").anatomy
    assert [(t.name, t.kind.value) for t in anatomy] == [("skin", "skin"), ("bone_core", "bone")]
    assert enclosed_volume(anatomy["bone_core"].surface) == pytest.approx(16.0**3, rel=0.12)  # corners are rounded
    assert (anatomy["skin"].surface.vertices[:, 0] < 0.0).all()  # RAS x from 8 to 38 mm is LPS x below 0


def test_surfaces_that_cannot_be_written_whole_leave_nothing(tmp_path, monkeypatch):
    labels = np.zeros((12, 12, 12), dtype=np.uint8)
    labels[2:10, 2:10, 2:10], labels[4:8, 4:8, 4:8] = 3, 7
    write_volume(tmp_path / "seg.nii.gz", labels, Grid((12, 12, 12), np.diag([2.0, 2.0, 2.0, 1.0])), description="")
    (tmp_path / "names.csv").write_text("value,name,kind\n3,skin,skin\n7,bone_core,bone\n")
    whole, written = Path.write_bytes, []

    def once(path, data):
        if written:
            raise OSError(28, "No space left on device")
        written.append(path)
        return whole(path, data)

    monkeypatch.setattr(Path, "write_bytes", once)
    with pytest.raises(OSError, match="No space left"):
        label_surfaces(tmp_path / "seg.nii.gz", tmp_path / "names.csv", out=tmp_path / "out", frame=Frame.LPS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["names.csv", "seg.nii.gz"]


def test_tables_of_labels_are_read_strictly(tmp_path):
    table = tmp_path / "names.csv"
    for text, message in (
        ("value,name\n1,a\n", r"label 1 \('a'\) has no kind; add the column kind"),
        ("value,kind\n1,bone\n", "has no column 'name'"),
        ("value,name,kind\n1,a,bone\n1,b,bone\n", "the value 1 is named twice"),
        ("value,name,kind\nx,a,bone\n", "value is 'x'; expected a whole number"),
        ("value,name,kind\n1,a,liver\n", "kind is 'liver'; known are skin, other, muscle, bone"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=message):
            read_label_names(table)
    with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
        read_label_names(tmp_path / "none.csv")
