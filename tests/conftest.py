"""What all tests share: where the real anatomy is, and one thread for each of the processes that run them."""

from __future__ import annotations

import os
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # before numpy is imported, which reads them once
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")

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
