"""The command that draws a finished run, or a sequence, for print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.workflows.progress import TimedStages


def render(
    run: Annotated[Path, Parameter(help="The folder that musclefit run or musclefit sequence wrote.")],
    out: Annotated[Path, Parameter(help="New folder for the pictures and pictures.json, which has their captions.")],
    /,
    *,
    state: Annotated[
        Literal["result", "rest"], Parameter(name="--state", help="Which positions to draw.", show_default=True)
    ] = "result",
    frame: Annotated[
        int | None,
        Parameter(name="--frame", help="Frame of a sequence; without it, the one farthest from rest."),
    ] = None,
    only: Annotated[
        tuple[str, ...],
        Parameter(name="--only", help="A pattern of tissue names, such as bone_*. May be repeated."),
    ] = (),
    colour: Annotated[
        Literal["tissue", "displacement"], Parameter(name="--colour", help="What the colours show.", show_default=True)
    ] = "tissue",
    width_mm: Annotated[
        float, Parameter(name="--width-mm", help="Width of a printed picture.", show_default=True)
    ] = 90.0,
    height_mm: Annotated[
        float, Parameter(name="--height-mm", help="Height of a printed picture.", show_default=True)
    ] = 120.0,
    dpi: Annotated[
        float, Parameter(name="--dpi", help="Pixels per inch of a printed picture.", show_default=True)
    ] = 300.0,
    skin_opacity: Annotated[
        float, Parameter(name="--skin-opacity", help="From 0, which leaves the skin out, to 1.", show_default=True)
    ] = 0.2,
    transparent: Annotated[
        bool, Parameter(name="--transparent", negative="", help="A transparent background instead of a white one.")
    ] = False,
    no_scale_bar: Annotated[bool, Parameter(name="--no-scale-bar", negative="", help="Omit the scale bar.")] = False,
    turntable: Annotated[
        int,
        Parameter(
            name="--turntable",
            help="Pictures of a turntable film, such as 120: MP4 (extra motion) or else GIF. Without it: no film.",
        ),
    ] = 0,
    film: Annotated[
        bool,
        Parameter(name="--film", negative="", help="Draw a film of the motion as well (sequences)."),
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Draw a run, or a frame of a sequence, for print: four stills with a common scale bar, a turntable, a film."""
    from musclefit.workflows.render import render as draw

    with TimedStages(shown=not quiet) as stages:
        made = draw(
            run,
            out,
            state=state,
            frame=frame,
            only=only,
            colour=colour,
            width_mm=width_mm,
            height_mm=height_mm,
            dpi=dpi,
            skin_opacity=skin_opacity,
            transparent=transparent,
            scale_bar=not no_scale_bar,
            turns=turntable,
            film=film,
            progress=stages,
        )
    if json:
        print_json({"folder": str(made.folder), "pictures": made.pictures, "note": made.note})
    elif not quiet:
        print(f"written: {made.said()}")
    return 0
