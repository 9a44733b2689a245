"""Where a user's caches are: one folder for all environments and processes."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def default_cache_folder() -> Path:
    """The folder of ``MUSCLEFIT_CACHE``, or else ``musclefit`` in the platform's folder for caches."""
    chosen = os.environ.get("MUSCLEFIT_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "musclefit" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "musclefit"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "musclefit"
