"""What all tests share: where the real anatomy is."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def anatomy_data() -> Path:
    """The folder of real anatomy; its tests skip where it is absent, but fail under CI."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("MUSCLEFIT_DATA", root.parent / "shared" / "data"))
    if not (folder / "arm" / "joints.json").is_file():
        reason = f"no real anatomy in {folder}; set MUSCLEFIT_DATA to its folder"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
    return folder
