"""The export command: a run's tetrahedra in a solver's file, deformed or at rest, or a clear refusal."""

from __future__ import annotations

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from tet_blocks import two_tissues

from musclefit.cli import main
from musclefit.io.formats.fibre_directions import MuscleFibres, fibre_bytes
from musclefit.io.run_folder import DeformedTets, labelled_tets


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """The parts of a run's folder that the command reads."""
    folder = tmp_path / "run"
    folder.mkdir()
    rest = two_tissues((2, 2, 2))
    labelled_tets(DeformedTets(rest, 2.0 * rest.mesh.vertices)).save(folder / "tets.vtu")
    (folder / "report.json").write_text(json.dumps({"title": "Two tissues"}), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("options", "scale"), [((), 2.0), (("--shape", "rest"), 1.0)])
def test_a_run_is_exported_at_the_shape_asked_for(
    options: tuple[str, ...], scale: float, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run_folder), str(tmp_path / "out.inp"), *options]) == 0
    found = meshio.read(tmp_path / "out.inp")
    rest = two_tissues((2, 2, 2))
    np.testing.assert_array_equal(found.points, scale * rest.mesh.vertices)
    told = capsys.readouterr().out
    assert "27 nodes, 48 tetrahedra in 2 sets, mm" in told
    assert "  bone: 24" in told
    assert "placeholders" in told


def test_quadratic_tetrahedra_and_old_gmsh_files_on_demand(run_folder: Path, tmp_path: Path) -> None:
    assert main(["export", str(run_folder), str(tmp_path / "out.msh"), "--quadratic", "--msh", "2.2", "--quiet"]) == 0
    assert (tmp_path / "out.msh").read_text(encoding="ascii").startswith("$MeshFormat\n2.2 0 8\n")
    assert sum(len(block) for block in meshio.read(tmp_path / "out.msh").cells if block.type == "tetra10") == 48


@pytest.mark.parametrize(
    ("missing", "out", "said"),
    [
        ("tets.vtu", "out.feb", "the run made no tetrahedra"),
        ("report.json", "out.feb", "name the folder that a run wrote"),
        ("", "out.xyz", "is not a known format"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    missing: str, out: str, said: str, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if missing:
        (run_folder / missing).unlink()
    assert main(["export", str(run_folder), str(tmp_path / out)]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / out).exists()


def fibres_folder(folder: Path, *, scale: float | None = 2.0, muscle: str = "muscle") -> Path:
    """What architecture writes of the block's muscle; carried by a scale, or at rest alone."""
    rest = two_tissues((2, 2, 2))
    places = rest.mesh.vertices[rest.mesh.tets[rest.tissue_of_tet == 0]].mean(axis=1)
    along = np.tile([0.6, 0.0, 0.8], (len(places), 1))
    carried = (None, None) if scale is None else (places * scale, along * scale)
    folder.mkdir()
    (folder / "fibres.npz").write_bytes(fibre_bytes({muscle: MuscleFibres(places, along, (), *carried)}))
    return folder


@pytest.mark.parametrize(("shape", "stretch"), [("deformed", 2.0), ("rest", 1.0)])
def test_fibres_go_along_into_the_shape_asked_for(
    shape: str, stretch: float, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fibres = str(fibres_folder(tmp_path / "fibres"))
    assert main(["export", str(run_folder), str(tmp_path / "out.vtu"), "--shape", shape, "--fibres", fibres]) == 0
    found = meshio.read(tmp_path / "out.vtu").cell_data
    muscle = found["tissue"][0] == 0
    np.testing.assert_allclose(found["fibre_stretch"][0], np.where(muscle, stretch, 0.0), rtol=1e-12)
    np.testing.assert_allclose(found["fibre"][0][muscle], np.tile([0.6, 0.0, 0.8], (muscle.sum(), 1)), rtol=1e-12)
    assert not found["fibre"][0][~muscle].any()


@pytest.mark.parametrize(
    ("out", "scale", "muscle", "said"),
    [
        ("out.feb", 2.0, "muscle", "`musclefit febio-model` writes fibres"),
        ("out.inp", None, "muscle", "known at rest alone"),
        ("out.inp", 20.0, "muscle", "into another pose"),
        ("out.inp", 2.0, "biceps", "they are muscle, bone; fibres are known of biceps"),
    ],
)
def test_fibres_that_do_not_belong_to_the_run_are_refused(
    out: str, scale: float | None, muscle: str, said: str, run_folder: Path, tmp_path: Path, capsys
) -> None:
    fibres = str(fibres_folder(tmp_path / "fibres", scale=scale, muscle=muscle))
    assert main(["export", str(run_folder), str(tmp_path / out), "--fibres", fibres]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / out).exists()
