"""The command that finds attachments, fibres and moment arms of a rig's muscles, and carries them by its map."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame
from musclefit.vocabulary import Unit
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.muscles.given_fibres import FibreUse
    from musclefit.workflows.architecture import Architecture

PASSED = 0

SHARE_TOLD = 0.01
"""A muscle is named where fibres are more than doubled, or halved, in a larger share of its volume."""


def architecture(
    rig: Annotated[str, Parameter(help="A rig file, or the name of a built-in rig.")],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name="--out",
            help="Folder for the results; a former one there is replaced. Without it: musclefit-out/ and the "
            "rig's name with -architecture.",
        ),
    ] = None,
    attachments: Annotated[
        Path | None,
        Parameter(
            name="--attachments",
            help="CSV of known attachments: muscle, end (origin or insertion), bone; optionally within_mm, vertices, "
            "sheet.",
        ),
    ] = None,
    within_mm: Annotated[
        float | None,
        Parameter(
            name="--within-mm",
            help="Largest distance of an attachment from its bone. Without it: chosen from the anatomy.",
        ),
    ] = None,
    fibres: Annotated[
        Path | None,
        Parameter(
            name="--fibres",
            help="A file of known fibres, or a folder of such files: streamlines (.tck, .trk, .vtk, .vtp) or "
            "directions (.vtk, .vtp, .vtu). They replace the computed directions in the muscles that contain them.",
        ),
    ] = None,
    fibre_frame: Annotated[
        Frame | None,
        Parameter(name="--fibre-frame", help="Frame of fibres in VTK files. Without it: the anatomy's."),
    ] = None,
    fibre_units: Annotated[
        Literal["mm", "cm", "m"] | None,
        Parameter(name="--fibre-units", help="Unit of fibres in VTK files. Without it: mm."),
    ] = None,
    fibre_array: Annotated[
        str, Parameter(name="--fibre-array", help="The array of vectors to read, where a file has several.")
    ] = "",
    fibre_reach_mm: Annotated[
        float | None,
        Parameter(
            name="--fibre-reach-mm",
            help="How far from a known place its direction holds. Without it: a quarter of the muscle's thickness.",
        ),
    ] = None,
    muscles: Annotated[
        tuple[str, ...],
        Parameter(name="--muscles", help="Name or shell-style pattern of the muscles to analyse. May be repeated."),
    ] = (),
    rest: Annotated[
        bool, Parameter(name="--rest", negative="", help="Analyse the anatomy at rest, without deforming it.")
    ] = False,
    curves: Annotated[
        bool,
        Parameter(
            name="--curves",
            negative="",
            help="Also measure fibres and moment arms after each substep: curves.csv.",
        ),
    ] = False,
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Find muscle attachments, fibre directions and moment arms, and map them by the rig's deformation."""
    from musclefit.io.given_fibres import FibreFiles
    from musclefit.workflows.architecture import architecture as find

    stated = {
        "--fibre-frame": fibre_frame,
        "--fibre-units": fibre_units,
        "--fibre-array": fibre_array,
        "--fibre-reach-mm": fibre_reach_mm,
    }
    if fibres is None and any(stated.values()):
        said = ", ".join(option for option, value in stated.items() if value)
        raise InputError(f"{said}: found no --fibres; name the file that it is said of, or leave it out")
    given = None
    if fibres is not None:
        given = FibreFiles(fibres, fibre_frame, Unit(fibre_units) if fibre_units else None, fibre_array, fibre_reach_mm)
    folder = out or Path("musclefit-out") / f"{Path(rig).stem}-architecture"
    with TimedStages(shown=not quiet) as stages:
        found = find(
            rig,
            out=folder,
            overrides=set,
            attachments=attachments,
            within_mm=within_mm,
            fibres=given,
            muscles=muscles,
            deform=not rest,
            curves=curves,
            progress=stages,
        )
    if json:
        print_json({"folder": str(folder), **found.to_json()})
    elif not quiet:
        _print(found)
    return PASSED


def _print(found: Architecture) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    console.print(Text(found.said(), style="bold"))
    console.print(Text(f"Attachments: within {found.within_mm:.3g} mm of bone. {found.claim}."))
    carried = {row.name: row for row in found.carried}
    width = max((len(row.name) for row in found.muscles), default=0)
    console.print(Text(f"{'':<{width}}  fibre mm  path mm  pennation deg  PCSA mm2  stretch (1 %, mean, 99 %, max)"))
    for row in found.muscles:
        after = carried.get(row.name)
        stretch = ""
        if after:
            stretch = f"{after.stretch_p1:.2f} {after.stretch_mean:.3f} {after.stretch_p99:.2f} {after.stretch_max:.2f}"
        console.print(
            Text(
                f"{row.name:<{width}}  {row.fibre_mm:8.1f} {row.path_mm:8.1f}  {row.pennation_deg:13.1f}  "
                f"{row.pcsa_mm2:8.0f}  {stretch}"
            )
        )
    for use in found.fibre_files:
        console.print(Text(_used(use)))
    for note in found.notes:
        console.print(Text(note))
    for row in found.muscles:
        if row.data_share is not None:
            known = f"known in {100.0 * row.data_share:.3g} % of its volume"
            console.print(Text(f"{row.name}: {row.lines} {row.fibres}, {known}"))
        if row.note:
            console.print(Text(f"{row.name}: {row.note}"))
    for after in found.carried:
        if after.doubled_share > SHARE_TOLD:
            share = 100.0 * after.doubled_share
            console.print(Text(f"{after.name}: fibres are more than doubled or halved in {share:.2g} % of its volume"))
    for name, reason in found.left_out.items():
        console.print(Text(f"{name}: no fibres: {reason}"))


def _used(use: FibreUse) -> str:
    """What became of a file of fibres."""
    told = []
    if use.lines:
        told.append(
            f"{use.lines_in_muscles} of {use.lines} streamlines are in muscles, {use.lines_outside} are left out; "
            f"{100.0 * use.cut_share:.2g} % of their length is cut off outside"
        )
    if use.directions:
        told.append(
            f"{use.directions_in_muscles} of {use.directions} directions are in muscles, {use.directions_outside} not"
        )
    return f"{use.file}: {'; '.join(told)}"
