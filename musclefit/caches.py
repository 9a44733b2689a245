"""Where a user's caches are: one folder for all environments and processes."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path


def default_cache_folder() -> Path:
    """The folder of ``MUSCLEFIT_CACHE``, or else ``musclefit`` in the platform's folder for caches."""
    chosen = os.environ.get("MUSCLEFIT_CACHE")
    return Path(chosen).expanduser() if chosen else user_cache_path("musclefit", appauthor=False)
