"""Folders for what is in the making: gone at the end, held while in use, cleared away after a kill."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from musclefit.scratch import scratch_folder

HOLDER = """
import sys, time
from pathlib import Path
from musclefit.scratch import scratch_folder
with scratch_folder("making-", inside=Path(sys.argv[1])) as folder:
    (folder / "half").write_text("x")
    print(folder, flush=True)
    time.sleep(60)
"""


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_it_is_gone_at_the_end_and_after_an_error(tmp_path: Path) -> None:
    with scratch_folder("making-", inside=tmp_path / "new") as folder:
        (folder / "inside").mkdir()
        (folder / "inside" / "file").write_text("x")
    with pytest.raises(ZeroDivisionError), scratch_folder("making-", inside=tmp_path / "new"):
        raise ZeroDivisionError
    assert _names(tmp_path / "new") == []


def test_what_another_process_holds_stays_and_what_a_killed_one_left_goes(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        held = Path(holder.stdout.readline().strip())
        with scratch_folder("making-", inside=tmp_path) as mine:
            assert _names(tmp_path) == sorted([held.name, mine.name])
        assert (held / "half").read_text() == "x"
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    assert _names(tmp_path) == [held.name]
    with scratch_folder("making-", inside=tmp_path):
        assert not held.exists()
    assert _names(tmp_path) == []


def test_links_files_and_other_names_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "precious").write_text("x")
    (tmp_path / "making-link").symlink_to(tmp_path / "kept")
    (tmp_path / "making-file").write_text("x")
    with scratch_folder("making-", inside=tmp_path):
        pass
    assert _names(tmp_path) == ["kept", "making-file", "making-link"]
    assert (tmp_path / "kept" / "precious").exists()
