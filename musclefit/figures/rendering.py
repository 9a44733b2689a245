"""Says whether off-screen rendering works here, and why not; knows no anatomy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import cache

_TRIAL = """
import pyvista
with pyvista.vtk_verbosity("off"):
    plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32))
    plotter.set_background("white")
    plotter.add_mesh(pyvista.Sphere(), color="black", lighting=False)
    image = plotter.screenshot(return_img=True)
    raise SystemExit(0 if int(image.min()) < 128 else "the picture stays empty")
"""

_REMEDY = "install a software OpenGL (Debian, Ubuntu: libegl1 and libgl1-mesa-dri) and unset VTK_DEFAULT_OPENGL_WINDOW"


@cache
def rendering_problem() -> str:
    """Why off-screen rendering does not work here, or "" where it does.

    A small picture is drawn in a process of its own, since a missing OpenGL library may abort the process that asks for
    it. The answer is kept for as long as the program runs.
    """
    return try_rendering((sys.executable, "-c", _TRIAL), timeout_s=120.0)


def try_rendering(command: tuple[str, ...], *, timeout_s: float) -> str:
    """Run a command that draws something: "" when it ends well, else what went wrong and the way out."""
    try:
        trial = subprocess.run(command, capture_output=True, timeout=timeout_s, env=dict(os.environ), check=False)
    except subprocess.TimeoutExpired:
        return f"off-screen rendering gave no picture within {timeout_s:g} s; {_REMEDY}"
    except OSError as error:
        return f"off-screen rendering could not be tried ({error})"
    if trial.returncode == 0:
        return ""
    lines = trial.stderr.decode("utf-8", "replace").strip().splitlines()
    cause = lines[-1].strip() if lines else "without a message"
    return f"off-screen rendering fails ({_ending(trial.returncode)}: {cause}); {_REMEDY}"


def _ending(code: int) -> str:
    """How a process ended, in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
