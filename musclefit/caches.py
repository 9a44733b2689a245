"""Where a user's caches and logs are: one folder each for all environments and processes."""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path, user_log_path


def default_cache_folder() -> Path:
    """The folder of ``MUSCLEFIT_CACHE``, or else ``musclefit`` in the platform's folder for caches."""
    chosen = os.environ.get("MUSCLEFIT_CACHE")
    return Path(chosen).expanduser() if chosen else user_cache_path("musclefit", appauthor=False)


def default_log_folder() -> Path:
    """The folder of ``MUSCLEFIT_LOGS``, or else ``musclefit`` in the platform's folder for logs."""
    chosen = os.environ.get("MUSCLEFIT_LOGS")
    return Path(chosen).expanduser() if chosen else user_log_path("musclefit", appauthor=False)
