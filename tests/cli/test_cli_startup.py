"""``musclefit --help`` comes at once: it imports nothing that computes."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("numba", "scipy", "trimesh", "pyvista", "vtk", "igl", "manifold3d", "skimage", "jinja2", "PIL")

SAY = f"""
import sys
from musclefit.cli import main
main(["--help"])
sys.stdout.write("|" + ",".join(sorted(set({HEAVY!r}) & set(sys.modules))))
"""


def test_help_imports_nothing_that_computes():
    done = subprocess.run([sys.executable, "-c", SAY], capture_output=True, text=True, check=True)
    shown, imported = done.stdout.rsplit("|", 1)
    assert "sequence" in shown
    assert imported == ""
