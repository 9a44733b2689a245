"""The command that carries an OpenSim model by a rig's deformation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.workflows.muscles_compared import MusclesCompared

PASSED = 0
_ARMS = 12
"""Moment arms that are printed."""


def export_osim(
    rig: Annotated[str, Parameter(help="A rig file in the model's ground frame and default pose.")],
    model: Annotated[Path, Parameter(help="The .osim file.")],
    out: Annotated[Path, Parameter(help="New or empty folder for the model and its Geometry.")],
    /,
    *,
    motion: Annotated[
        Path | None,
        Parameter(
            name="--motion",
            help=".mot, .sto, .trc or .c3d of the model, to compare lengths, moment arms and paths in bone over.",
        ),
    ] = None,
    frames: Annotated[int, Parameter(name="--frames", help="Largest number of the motion's times to examine.")] = 20,
    geometry: Annotated[
        tuple[Path, ...],
        Parameter(name="--geometry", help="A further folder to search for meshes. May be repeated."),
    ] = (),
    linear: Annotated[
        tuple[str, ...],
        Parameter(
            name="--linear",
            consume_multiple=True,
            help="Bodies to scale linearly along their own axes, by the factors that fit the map best.",
        ),
    ] = (),
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Deform an OpenSim model by a rig: its points, frames, wrap objects, lengths and geometry."""
    from musclefit.workflows.export_osim import export_osim as carry

    with TimedStages(shown=not quiet) as stages:
        made = carry(
            rig,
            model,
            out,
            overrides=set,
            motion=motion,
            frames=frames,
            geometry=geometry,
            linear=linear,
            progress=stages,
        )
    if json:
        print_json(made.to_json())
    elif not quiet:
        print(f"wrote {made.said()}")
        for name, body in made.linear.items():
            factors = " ".join(f"{factor:.4f}" for factor in body.factors)
            print(
                f"  body {name}: scaled by {factors} along x y z, {body.rms_mm:.3g} mm rms from where the map takes "
                f"it, {body.largest_mm:.3g} mm at most"
            )
        for name, (before, after) in made.muscles.items():
            print(f"  {name}: {before:.4g} -> {after:.4g} mm")
        for name, wrap in made.wraps.items():
            print(f"  wrap object {name}: fitted within {wrap.rms_mm:.3g} mm rms, {wrap.largest_mm:.3g} mm at most")
        if made.compared is not None:
            _print_muscles(made.compared)
        for said in made.left:
            print(f"  left as it is: {said}")
    return PASSED


def _print_muscles(compared: MusclesCompared) -> None:
    """Of each muscle its length and what of its path is in bone; moment arms that change most, or turn round."""
    print(f"over {len(compared.times_s)} times of the motion, before -> after:")
    for row in compared.muscle_rows():
        told = [
            f"{row[f'shortest_{w}_mm']:.4g} to {row[f'longest_{w}_mm']:.4g} mm, {row[f'in_bone_{w}_mm']:.3g} in bone, "
            f"{row[f'depth_{w}_mm']:.3g} deep"
            for w in ("before", "after")
        ]
        print(f"  {row['muscle']}: {told[0]} -> {told[1]}")
    arms = sorted(compared.arm_rows(), key=lambda row: (-row["poses_of_other_sign"], -row["largest_change_mm"]))
    for row in arms[:_ARMS]:
        turned = f", of other sign in {row['poses_of_other_sign']}" if row["poses_of_other_sign"] else ""
        print(
            f"  moment arm of {row['muscle']} about {row['coordinate']}: {row['least_before_mm']:.3g} to "
            f"{row['most_before_mm']:.3g} -> {row['least_after_mm']:.3g} to {row['most_after_mm']:.3g} mm{turned}"
        )
    if len(arms) > _ARMS:
        print(f"  {len(arms) - _ARMS} more moment arms, which change less: moment_arms.csv")
