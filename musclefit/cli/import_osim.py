"""The command that makes a rig of an OpenSim model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.workflows.progress import TimedStages

PASSED = 0


def import_osim(
    model: Annotated[Path, Parameter(help="The .osim file.")],
    out: Annotated[Path, Parameter(help="New or empty folder for the rig.")],
    /,
    *,
    motion: Annotated[
        Path | None, Parameter(name="--motion", help=".mot, .sto, or markers in a .trc or .c3d, that the rig follows.")
    ] = None,
    markers_up: Annotated[
        Literal["x", "y", "z"] | None,
        Parameter(
            name="--markers-up",
            help="The axis of the markers' file that points up. Without it: y for a .trc; a .c3d must state it.",
        ),
    ] = None,
    markers_shift_mm: Annotated[
        tuple[float, float, float] | None,
        Parameter(name="--markers-shift-mm", help="Shift added to the markers after that: x, y and z, mm."),
    ] = None,
    geometry: Annotated[
        tuple[Path, ...],
        Parameter(name="--geometry", help="A further folder to search for meshes. May be repeated."),
    ] = (),
    skip_missing: Annotated[
        bool, Parameter(name="--skip-missing", negative="", help="Go on without meshes that are not found.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Make a rig from an OpenSim model: bones, joints, muscle paths, markers and wrap objects, in its default pose."""
    from musclefit.workflows.import_osim import import_osim as make

    with TimedStages(shown=not quiet) as stages:
        made = make(
            model,
            out,
            motion=motion,
            markers_up=markers_up,
            markers_shift_mm=markers_shift_mm or (),
            geometry=geometry,
            skip_missing=skip_missing,
            progress=stages,
        )
    if json:
        print_json(made.to_json())
    elif not quiet:
        print(f"wrote {made.folder}: " + ", ".join(f"{n} {what.replace('_', ' ')}" for what, n in made.counts.items()))
        for note in made.notes:
            print(f"  {note}")
        if made.missing:
            print(f"  without {len(made.missing)} meshes that were not found: {', '.join(made.missing)}")
        if made.open:
            print(
                f"  {len(made.open)} meshes are not closed; they are in open/, outside the rig. Repair them with "
                f"`musclefit repair {made.folder / 'open'} MENDED`, put them into bones/: "
                + ", ".join(mesh.name for mesh in made.open)
            )
    return PASSED
