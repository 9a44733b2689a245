"""The command that moves the nodes of a solver's deck by a rig's deformation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, SetOption, print_json
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.validate.elements import ElementCheck
    from musclefit.workflows.warp_deck import WarpedDeck

PASSED, FAILED = 0, 1


def warp_deck(
    rig: Annotated[str, Parameter(help="A rig file, or the name of a built-in rig.")],
    deck: Annotated[Path, Parameter(help="LS-DYNA (.k, .key, .dyn), Abaqus (.inp) or FEBio (.feb).")],
    out: Annotated[Path, Parameter(help="The deck to write, of the same ending; replaced.")],
    /,
    *,
    units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--units", help="Length unit of the deck.", show_default=True)
    ] = "mm",
    set: SetOption = (),  # noqa: A002 (the option's name)
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Move the nodes of a solver's deck by a rig's deformation; every other byte of the deck is kept.

    Exit code 1: the deck is written, and an element is inverted that was not inverted before.
    """
    from musclefit.workflows.warp_deck import warp_deck as warp

    with TimedStages(shown=not quiet) as stages:
        warped = warp(rig, deck, out, units=units, overrides=set, progress=stages)
    if json:
        print_json(warped.to_json())
    elif not quiet:
        _print(warped)
    return PASSED if warped.passed else FAILED


def _print(warped: WarpedDeck) -> None:
    shared = f"; {warped.coincident} places shared by several nodes stay shared" if warped.coincident else ""
    print(f"wrote {warped.path}: {warped.nodes} nodes moved, {warped.largest_move_mm:.4g} mm at most{shared}")
    for check in warped.elements:
        print(f"  {check.count} x {check.kind}{_judged(check)}")
    for title, counts in (("not measured", warped.unmeasured), ("left as it is", warped.kept)):
        if counts:
            print(f"  {title}: " + ", ".join(f"{count} {name}" for name, count in counts.items()))
    if warped.includes:
        print(f"  included files, not read; warp each that holds nodes separately: {', '.join(warped.includes)}")
    if warped.outside_skin:
        print(
            f"  {warped.outside_skin} nodes are outside the skin; they were moved, but the map is checked only inside"
        )
    if not warped.passed:
        turned = sum(check.introduced for check in warped.elements)
        print(
            f"FAILED: {turned} elements are newly inverted. Refine the elements where the map "
            "bends them; `musclefit run` says whether the map itself is certified"
        )


def _judged(check: ElementCheck) -> str:
    if check.jacobian_after is not None:
        return (
            f": smallest scaled Jacobian {check.jacobian_before:.3g} -> {check.jacobian_after:.3g} (element "
            f"{check.worst}), inverted {check.inverted_before} -> {check.inverted_after}"
        )
    if check.warpage_after_deg is not None:
        return (
            f": largest warpage {check.warpage_before_deg:.3g} -> {check.warpage_after_deg:.3g} degrees (element "
            f"{check.worst})"
        )
    return ""
