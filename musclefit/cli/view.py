"""The command that shows a finished result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json


def view(
    folder: Annotated[Path, Parameter(help="A folder that run, check, sequence, batch or compare wrote.")],
    /,
    *,
    window: Annotated[
        bool,
        Parameter(name="--window", negative="", help="Show a run or a frame in a window instead of the page."),
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Open the report page of a result in the browser, or show a run in a 3-D window."""
    from musclefit.workflows.view import page_of, view_in_window
    from musclefit.workflows.view import view as open_page

    if window:
        view_in_window(folder)
        shown = True
    else:
        shown = open_page(folder)
    page = "" if window else str(page_of(folder))
    if json:
        print_json({"page": page, "window": window, "opened": shown})
    elif not quiet and not window:
        print(f"opened {page}" if shown else f"no browser was found; open {page}")
    return 0
