"""The command that carries an OpenSim model by a rig's deformation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.workflows.progress import TimedStages

PASSED = 0


def export_osim(
    rig: Annotated[str, Parameter(help="A rig file in the model's ground frame and default pose.")],
    model: Annotated[Path, Parameter(help="The .osim file.")],
    out: Annotated[Path, Parameter(help="New or empty folder for the model and its Geometry.")],
    /,
    *,
    geometry: Annotated[
        tuple[Path, ...],
        Parameter(name="--geometry", help="A further folder to search for meshes. May be repeated."),
    ] = (),
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Deform an OpenSim model by a rig: its points, frames, wrap objects, lengths and geometry."""
    from musclefit.workflows.export_osim import export_osim as carry

    with TimedStages(shown=not quiet) as stages:
        made = carry(rig, model, out, overrides=set, geometry=geometry, progress=stages)
    if json:
        print_json(made.to_json())
    elif not quiet:
        print(f"wrote {made.said()}")
        for name, (before, after) in made.muscles.items():
            print(f"  {name}: {before:.4g} -> {after:.4g} mm")
        for name, wrap in made.wraps.items():
            print(f"  wrap object {name}: fitted within {wrap.rms_mm:.3g} mm rms, {wrap.largest_mm:.3g} mm at most")
        for said in made.left:
            print(f"  left as it is: {said}")
    return PASSED
