"""A finished run drawn and shown, from its folder."""

from __future__ import annotations

import json
import webbrowser
from io import BytesIO
from pathlib import Path

import pytest
from PIL import Image
from tiny_rigs import write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError
from musclefit.progress import Silent
from musclefit.workflows.render import render
from musclefit.workflows.run import run
from musclefit.workflows.view import view_in_window


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("done")
    run(write_tiny_rig(home / "rig"), out=home / "out", pictures=False, progress=Silent())
    return home / "out"


def test_stills_and_a_turntable_are_written_with_captions(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pictures"
    small = ["--width-mm", "20", "--height-mm", "20", "--dpi", "100"]
    assert main(["render", str(done), str(out), *small, "--colour", "displacement", "--turntable", "3", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pictures"] == json.loads((out / "pictures.json").read_text(encoding="utf-8"))["pictures"]
    stills = [name for name in told["pictures"] if name.endswith(".png")]
    assert len(stills) == 4
    for name in stills:
        assert Image.open(BytesIO((out / name).read_bytes())).size == (79, 79)
        assert "displacement" in told["pictures"][name]["caption"]
        assert f"Scale bar {told['pictures'][name]['scale_bar_mm']:g} mm" in told["pictures"][name]["caption"]
    (film,) = out.glob("turntable.*")
    assert film.stat().st_size > 500
    assert len({(out / name).read_bytes() for name in stills}) == 4


def test_what_cannot_be_drawn_is_refused_before_anything_is_written(done: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="no tissue is named like 'tendon"):
        render(done, out, only=("tendon*",), progress=Silent())
    with pytest.raises(InputError, match="skin_opacity = 2"):
        render(done, out, skin_opacity=2.0, progress=Silent())
    with pytest.raises(InputError, match="found 1 pictures"):
        render(done, out, turns=1, progress=Silent())
    with pytest.raises(InputError, match=r"holds no report\.json"):
        render(tmp_path, out, progress=Silent())
    assert not out.exists()


def test_the_page_is_opened(
    done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []

    def open_there(address: str) -> bool:
        opened.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", open_there)
    assert main(["view", str(done)]) == 0
    assert opened == [(done / "report.html").as_uri()]
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert main(["view", str(done / "report.html"), "--json"]) == 0
    told = capsys.readouterr().out
    assert json.loads(told[told.index("{") :]) == {"page": str(done / "report.html"), "window": False, "opened": False}
    assert main(["view", str(tmp_path)]) == 2
    assert "holds none of report.html" in capsys.readouterr().err


@pytest.mark.skipif("sys.platform in ('win32', 'darwin')", reason="there, a screen needs no variable")
def test_a_window_without_a_screen_is_refused(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="there is no screen"):
        view_in_window(done)
