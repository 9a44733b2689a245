"""The command that writes a run's tetrahedra for a solver."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.io.run_tets import Shape

PASSED = 0


def export(
    run: Annotated[Path, Parameter(help="The folder that a run wrote.")],
    out: Annotated[
        Path, Parameter(help="The file to write: .feb (FEBio 4.0), .inp (Abaqus), .msh (Gmsh) or .vtu; replaced.")
    ],
    /,
    *,
    shape: Annotated[
        Shape, Parameter(name="--shape", help="Positions after or before the deformation.", show_default=True)
    ] = Shape.DEFORMED,
    quadratic: Annotated[bool, Parameter(name="--quadratic", negative="", help="Add mid-edge nodes: tet10.")] = False,
    msh: Annotated[
        Literal["4.1", "2.2"], Parameter(name="--msh", help="Version of a .msh file.", show_default=True)
    ] = "4.1",
    fibres: Annotated[
        Path | None,
        Parameter(
            name="--fibres",
            help="The folder that musclefit architecture wrote for the same anatomy and pose: orientations in .inp, "
            "directions in .msh and .vtu.",
        ),
    ] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Write a run's tetrahedra for a solver: one element set per tissue, shared nodes, placeholder materials, in mm."""
    from musclefit.io.formats.solvers import PLACEHOLDER
    from musclefit.workflows.export import export as write

    tets = write(run, out, shape=shape, quadratic=quadratic, msh=msh, fibres=fibres)
    sets = tets.sets
    if json:
        told = {"file": str(out), "nodes": len(tets.vertices), "tetrahedra": len(tets.tets)}
        print_json({**told, "sets": {label: len(own) for label, own in sets.items()}})
    elif not quiet:
        print(f"wrote {out}: {len(tets.vertices)} nodes, {len(tets.tets)} tetrahedra in {len(sets)} sets, mm")
        for label, own in sets.items():
            print(f"  {label}: {len(own)}")
        if out.suffix.lower() in (".feb", ".inp"):
            print(PLACEHOLDER)
    return PASSED
