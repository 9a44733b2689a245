"""The command that makes a cage: a file that a rig can use, and refusals that write nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_rigs import egg

from musclefit.cli import main
from musclefit.io.anatomy import read_surface
from musclefit.io.run_folder import ply_bytes


def test_a_cage_is_written_and_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    skin, out = tmp_path / "skin.ply", tmp_path / "made" / "cage.ply"
    skin.write_bytes(ply_bytes(egg((0.0, 0.0, 0.0), (50.0, 30.0, 20.0), subdivisions=3)))
    assert main(["cage", str(skin), str(out), "--vertices", "60"]) == 0
    assert len(read_surface(out).vertices) == 60
    said = capsys.readouterr().out
    assert said.startswith(f"wrote {out}: 60 vertices, 116 triangles, closed, none cross; edges ")
    assert main(["cage", str(skin), str(tmp_path / "cage.stl")]) == 2
    assert "name a file that ends in .ply" in capsys.readouterr().err
    assert main(["cage", str(skin), str(tmp_path / "c.ply"), "--vertices", "9000"]) == 2
    assert "a cage of 9000 vertices is asked for" in capsys.readouterr().err
    assert not (tmp_path / "c.ply").exists()


def test_a_cage_that_cannot_be_written_whole_leaves_the_former_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    skin, out = tmp_path / "skin.ply", tmp_path / "cage.ply"
    skin.write_bytes(ply_bytes(egg((0.0, 0.0, 0.0), (50.0, 30.0, 20.0), subdivisions=3)))
    out.write_bytes(b"the former one")
    whole = Path.write_bytes

    def half(path: Path, data: bytes) -> int:
        whole(path, data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    assert main(["cage", str(skin), str(out), "--vertices", "60"]) != 0
    assert "No space left on device" in capsys.readouterr().err
    assert out.read_bytes() == b"the former one"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cage.ply", "skin.ply"]
