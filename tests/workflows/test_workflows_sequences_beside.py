"""Finished sequences read back without their rig, put side by side, and drawn."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence
from tiny_rigs import drive_by_joints, write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.figures import scenes
from musclefit.figures.rendering import rendering_problem
from musclefit.io.finished_sequences import read_finished_sequence
from musclefit.progress import Silent
from musclefit.report.html import render_differences
from musclefit.report.run_differences import FrameRow
from musclefit.workflows.compare import compare
from musclefit.workflows.render import drawn_of, render
from musclefit.workflows.run import run
from musclefit.workflows.sequence import FollowedMotion, sequence

QUICK = ["certificate.enabled=false"]


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[FollowedMotion, FollowedMotion]:
    """The same bend with free bones in three frames, and with rigid ones in two of them."""
    home = tmp_path_factory.mktemp("sequences")
    drive_by_joints(rig := write_tiny_rig(home / "rig"))
    bend = rig.with_name("bend.csv")
    bend.write_text("time_s,elbow_deg\n0,0\n1,20\n", encoding="utf-8")

    def follow(name: str, frames: int, *more: str) -> FollowedMotion:
        sets = [*QUICK, *more]
        return sequence(
            rig, bend, out=home / name, frames=frames, overrides=sets, between=False, pictures=False, progress=Silent()
        )

    return follow("free", 3), follow("rigid", 2, "deformer.method=rigid-bones")


@pytest.fixture(scope="module")
def folders(followed: tuple[FollowedMotion, FollowedMotion]) -> tuple[Path, Path]:
    return followed[0].folder, followed[1].folder


def test_a_sequence_is_read_back_without_its_rig(followed: tuple[FollowedMotion, FollowedMotion]) -> None:
    for done in followed:
        given = done.plan.job.anatomy
        read = read_finished_sequence(done.folder)
        assert read.rest.frame == given.frame
        assert [(t.name, t.kind) for t in read.rest] == [(t.name, t.kind) for t in given]
        for mine, theirs in zip(read.rest, given, strict=True):
            assert np.array_equal(mine.surface.vertices, theirs.surface.vertices)
            assert np.array_equal(mine.surface.faces, theirs.surface.faces)
        for frame, known in zip(read.frames, done.frames(), strict=True):
            assert np.array_equal(read.anatomy(frame).vertices(), known.anatomy().vertices())
            rest, posed = read.surfaces(frame)
            for measured, before, exact in zip(posed, rest, known.anatomy(), strict=True):
                count = len(exact.surface.vertices)
                assert len(measured.surface.vertices) >= count
                assert np.allclose(measured.surface.vertices[:count], exact.surface.vertices, rtol=0, atol=1e-4)
                assert np.allclose(
                    before.surface.vertices[:count], given[exact.name].surface.vertices, rtol=0, atol=1e-4
                )


def test_what_differs_is_told_by_tissue_and_by_frame(folders: tuple[Path, Path]) -> None:
    found = compare(folders).found
    assert found.runs == ("free", "rigid")
    assert found.claims == ("0 of 3 frames certified", "0 of 2 frames certified")
    assert "bones.rigid" in {row.name for row in found.settings}
    assert any("3 frames and rigid 2, 2 of them at the same times" in note for note in found.notes)
    assert [row.time_s for row in found.frames] == [0.0, 0.5, 1.0]
    assert [row.outcomes for row in found.frames] == [("made", "made"), ("made", ""), ("made", "made")]

    a, b = (read_finished_sequence(folder) for folder in folders)
    apart = np.linalg.norm(a.anatomy(a.frames[2]).vertices() - b.anatomy(b.frames[1]).vertices(), axis=1)
    assert [row.apart_mm[1] for row in found.frames] == [0.0, None, pytest.approx(apart.max(), rel=1e-12, abs=0)]
    row = next(row for row in found.tissues if row.name == "bone_distal")
    own = apart[a.rest.slices()["bone_distal"]]
    assert row.apart_mm[1] == pytest.approx(own.max(), rel=1e-12, abs=0)
    assert row.rigidity_mm == tuple(_worst(one, "bone_distal", "rigidity_mm") for one in (a, b))
    assert row.best == (1,)
    muscle = next(row for row in found.tissues if row.kind == "muscle")
    assert muscle.volume_change_percent == tuple(_worst(one, muscle.name, "volume_change_percent") for one in (a, b))


def _worst(read: Any, tissue: str, key: str) -> float:
    values = [t[key] for f in read.frames for t in f.result["tissues"] if t["name"] == tissue]
    return max(values, key=abs)  # type: ignore[no-any-return]


def test_a_sequence_beside_itself_is_the_same(folders: tuple[Path, Path]) -> None:
    found = compare([folders[0], folders[0]]).found
    assert found.best is None
    assert found.settings == ()
    assert found.notes == ()
    assert {row.apart_mm for row in found.tissues} | {row.apart_mm for row in found.frames} == {(0.0, 0.0)}


def test_the_page_plays_both_motions(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = map(str, folders)
    out = tmp_path / "beside"
    assert main(["compare", first, second, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "A: free: " in said
    assert "0 of 3 frames certified" in said
    assert "Frames" in said
    page = (out / "comparison.html").read_text(encoding="utf-8")
    start = page.index('id="scene">') + len('id="scene">')
    scene = json.loads(page[start : page.index("</script>", start)])
    assert [shape["motion"] for shape in scene["shapes"]] == ["", *["free"] * 3, *["rigid"] * 2]
    assert "Sequences side by side" in page
    assert 'href="../' in page
    assert main(["compare", first, second, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["frames"]) == 3


def test_hostile_names_of_sequences_are_escaped(folders: tuple[Path, Path]) -> None:
    from dataclasses import replace

    hostile = "<img src=x onerror=alert(1)>"
    found = compare(folders).found
    row = FrameRow(0.5, (hostile, "made"), (1.0, 2.0), (0.0, 0.0), (0.0, 1.0))
    page = render_differences(replace(found, runs=(hostile, "b"), frames=(row,)), links=["", ""], scene=None)
    assert "<img src=x" not in page


def test_runs_and_sequences_are_not_mixed_and_old_folders_told_how_to_go_on(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    run(write_tiny_rig(tmp_path / "rig"), out=tmp_path / "run", pictures=False, progress=Silent())
    with pytest.raises(InputError, match=r"is a sequence and .*run is none"):
        compare([folders[0], tmp_path / "run"])
    with pytest.raises(InputError, match="which has no frames, so not frame 1; name a sequence's folder"):
        drawn_of(tmp_path / "run", frame=1)
    with pytest.raises(InputError, match="not a film of the motion"):
        drawn_of(tmp_path / "run", film=True)
    old = tmp_path / "old"
    old.mkdir()
    for name in ("sequence.json", "report.json"):
        (old / name).write_bytes((folders[0] / name).read_bytes())
    with pytest.raises(InputError, match=r"no anatomy at rest \(rest.vtp\).*same folder.*keeps its frames"):
        read_finished_sequence(old)
    (old / "rest.vtp").write_bytes((folders[0] / "rest.vtp").read_bytes())
    with pytest.raises(InputError, match="frame 0: not made yet"):
        read_finished_sequence(old)


def test_long_motions_are_thinned_evenly_and_told(
    followed: tuple[FollowedMotion, FollowedMotion], monkeypatch: pytest.MonkeyPatch
) -> None:
    rest = followed[0].plan.job.anatomy
    frames = [(f"{k} s", float(k), rest) for k in range(12)]
    coordinates = 3 * len(rest.vertices())
    assert scenes.motion_scene(rest, frames).left_out == ()
    monkeypatch.setattr(scenes, "DRAWN_COORDINATES", 4 * coordinates)
    drawn = scenes.motion_scene(rest, frames)
    assert [shape.time_s for shape in drawn.shapes[1:]] == [0.0, 3.0, 6.0, 9.0]
    assert drawn.left_out[0].startswith("one of 3 frames is shown")


def test_frames_and_films_are_drawn(folders: tuple[Path, Path], tmp_path: Path) -> None:
    if rendering_problem():
        pytest.skip(rendering_problem())
    small = {"width_mm": 15.0, "height_mm": 15.0, "dpi": 100.0}
    done = render(folders[0], tmp_path / "out", **small, film=True, colour="displacement", progress=Silent())  # type: ignore[arg-type]
    assert "frame 2 at 1 s, elbow 20°: result" in done.pictures["broad.png"]["caption"]
    (film,) = (tmp_path / "out").glob("motion.*")
    assert "3 frames from the broad side" in done.pictures[film.name]["caption"]
    if film.suffix == ".gif":
        assert len(ImageSequence.all_frames(Image.open(BytesIO(film.read_bytes())))) == 3
    first = render(folders[0], tmp_path / "first", **small, frame=0, progress=Silent())  # type: ignore[arg-type]
    assert "frame 0 at 0 s" in first.pictures["broad.png"]["caption"]
    assert (tmp_path / "first" / "broad.png").read_bytes() != (tmp_path / "out" / "broad.png").read_bytes()
    with pytest.raises(InputError, match="found frame 3; expected 0 to 2"):
        render(folders[0], tmp_path / "none", frame=3, progress=Silent())
    assert not (tmp_path / "none").exists()


def test_a_sequence_becomes_one_file_that_vtk_reads(
    followed: tuple[FollowedMotion, FollowedMotion], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyvista as pv

    folder, out = followed[0].folder, tmp_path / "new" / "bend.vtkhdf"
    assert main(["export-motion", str(folder), str(out)]) == 0
    assert "3 frames of 4 tissues" in capsys.readouterr().out
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    read = read_finished_sequence(folder)
    reader = pv.get_reader(out).reader  # vtkHDFReader
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == len(read.made) == 3
    rest = read.rest.vertices()
    for number, frame in enumerate(read.made):
        reader.SetStep(number)
        reader.Update()
        found = pv.wrap(reader.GetOutput())
        vertices = frame.stored.vertices()
        assert reader.GetTimeValue() == frame.summary.time_s
        np.testing.assert_array_equal(found.points, vertices.astype(np.float32))
        np.testing.assert_array_equal(found.point_data["displacement_mm"], (vertices - rest).astype(np.float32))
        assert list(found.field_data["tissue_names"]) == [tissue.name for tissue in read.rest]
        triangles = found.regular_faces
        for tissue, (name, place) in enumerate(read.rest.slices().items()):
            own = triangles[found.cell_data["tissue"] == tissue] - place.start
            np.testing.assert_array_equal(own, read.rest[name].surface.faces)


@pytest.mark.parametrize(("out", "said"), [("bend.vtp", "is no known format"), ("there.vtkhdf", "cannot be written")])
def test_a_motion_goes_into_no_other_file(
    out: str, said: str, folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there.vtkhdf").mkdir()
    assert main(["export-motion", str(folders[0]), str(tmp_path / out)]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["there.vtkhdf"]
