"""A finished result shown: its page in the browser, or its surfaces in a window."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.io.run_folder import REPORT_HTML
from musclefit.workflows.collect import COHORT_HTML
from musclefit.workflows.compare import COMPARISON_HTML

PAGES = (REPORT_HTML, COHORT_HTML, COMPARISON_HTML)
"""What commands call their pages."""


def page_of(folder: str | Path) -> Path:
    """The page of a result.

    Parameters
    ----------
    folder : path
        Of a run, an inspection, a sequence, a study or a comparison; or the page itself.

    Raises
    ------
    InputError
        There is none.
    """
    place = Path(folder)
    if place.is_file() and place.suffix == ".html":
        return place.absolute()
    for name in PAGES:
        if (place / name).is_file():
            return (place / name).absolute()
    raise InputError(f"{place} holds none of {', '.join(PAGES)}; name a folder that a musclefit command wrote")


def view(folder: str | Path) -> bool:
    """Open the page of a result in the system's browser; says whether one was found.

    Parameters
    ----------
    folder : path
        As for `page_of`.

    Returns
    -------
    bool
        Whether a browser was found.

    Raises
    ------
    InputError
        There is no page.
    """
    return webbrowser.open(page_of(folder).as_uri())


def view_in_window(run: str | Path) -> None:
    """Show a run, or a sequence's frame farthest from rest, beside the rest, in a window, until that is closed.

    Raises
    ------
    InputError, MeshError
        The folder holds no run and no sequence, or there is no screen.
    """
    from musclefit.workflows.render import drawn_of

    shown = drawn_of(run)
    if sys.platform not in ("win32", "darwin") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "there is no screen for a window (DISPLAY is not set); leave --window for the page, or use musclefit render"
        )
    side_by_side(shown.rest, shown.posed).show()


def side_by_side(rest: Anatomy, deformed: Anatomy) -> Any:
    """A pyvista plotter with the tissues before and after, which turn together: call its ``show``."""
    from musclefit.figures.camera import principal_views
    from musclefit.figures.colours import tissue_colours
    from musclefit.figures.panels import Panel, tissue_panels

    panels = (Panel("At rest", rest), Panel("Result", deformed))
    seen = principal_views(np.concatenate([rest.vertices(), deformed.vertices()]))[0]
    plotter = tissue_panels(panels, seen, colours=tissue_colours(rest), height_px=800, off_screen=False)
    plotter.link_views()
    return plotter
