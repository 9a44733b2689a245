"""What a report says of the run itself: versions, peak memory, the seconds of each stage."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from musclefit._version import __version__

LIBRARIES = ("numpy", "scipy", "numba", "trimesh", "manifold3d", "pytetwild", "pyvista", "vtk", "libigl")


def versions() -> dict[str, str]:
    """Versions of musclefit, Python and the libraries that made the numbers."""
    found = {"musclefit": __version__, "python": platform.python_version()}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            found[library] = "not installed"
    return found


def peak_memory_mb() -> float:
    """Largest resident memory of this process, or of one it ran, so far, MB (10⁶ bytes); NaN where nothing tells it."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return float(peak) * (1e-6 if sys.platform == "darwin" else 1.024e-3)


def cpu_seconds() -> float:
    """CPU seconds of this process and of the processes that it ran and waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def measured(seconds: Mapping[str, float], *, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a report that only the run itself knows, for `dataclasses.replace`."""
    return {
        "timings_s": {name: round(value, 4) for name, value in seconds.items()},
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "provenance": {"versions": versions(), "platform": platform.platform(), **provenance},
    }
