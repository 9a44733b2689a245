"""The command that writes a rig's deformation as grid transforms for ITK and 3D Slicer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.geometry.images.grids import Frame
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.pipeline.displacement_grids import DisplacementGrid

PASSED = 0


def warp_field(
    rig: Annotated[str, Parameter(help="A rig file, or the name of a built-in rig.")],
    /,
    *,
    to_rest: Annotated[
        Path | None,
        Parameter(
            name="--to-rest",
            help="Transform from the deformed body to rest: warps images in ITK and Slicer, and surfaces in Slicer. "
            ".nrrd, .mha, .h5, .nii or .nii.gz.",
        ),
    ] = None,
    to_deformed: Annotated[
        Path | None,
        Parameter(name="--to-deformed", help="Transform from rest to the deformed body: moves points in ITK."),
    ] = None,
    frame: Annotated[
        Frame | None,
        Parameter(help="Frame of the rig's coordinates; without it, the one that anatomy.frame states."),
    ] = None,
    spacing_mm: Annotated[float | None, Parameter(name="--spacing-mm", help="Grid spacing.")] = None,
    like: Annotated[Path | None, Parameter(name="--like", help="NIfTI image whose grid is used instead.")] = None,
    margin_mm: Annotated[
        float | None,
        Parameter(name="--margin-mm", help="How far the grid extends beyond the body; without it, twice the spacing."),
    ] = None,
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Write a rig's deformation as grid transforms that ITK, SimpleITK, ANTs and 3D Slicer open."""
    from musclefit.workflows.warp_field import warp_field as write

    with TimedStages(shown=not quiet) as stages:
        written = write(
            rig,
            to_rest=to_rest,
            to_deformed=to_deformed,
            frame=frame,
            spacing_mm=spacing_mm,
            like=like,
            margin_mm=margin_mm,
            overrides=set,
            progress=stages,
        )
    if json:
        print_json(written.to_json())
    elif not quiet:
        for path, made in written.made:
            _print(path, made)
    return PASSED


def _print(path: Path, made: DisplacementGrid) -> None:
    error = made.error
    shape = " x ".join(str(n) for n in made.grid.shape)
    spacing = ", ".join(f"{h:.4g}" for h in made.grid.spacing)
    print(f"wrote {path}: {made.direction}, {shape} points, spacing {spacing} mm, LPS")
    print(
        f"  sampling error on {error.samples} places of all surfaces: median {error.median_mm:.2g} mm, 95 % within "
        f"{error.most_95_mm:.2g} mm, largest {error.max_mm:.2g} mm ({error.tissue})"
    )
    if error.outside:
        print(f"  {error.outside} of these places lie beyond the grid, which does not move them")
    if made.filled:
        print(
            f"  {made.filled} points far from all tissues have no preimage and were given the displacement "
            "of the nearest point that has one"
        )
