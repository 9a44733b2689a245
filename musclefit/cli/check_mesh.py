"""The command that tells the quality of a run's tetrahedra before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json

PASSED, FAILED = 0, 1


def check_mesh(
    run: Annotated[Path, Parameter(help="The folder that a run with tetrahedra wrote.")],
    /,
    *,
    out: Annotated[
        Path | None, Parameter(name="--out", help="Also write the table to this CSV file, replacing it.")
    ] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Report the scaled Jacobians and dihedral angles of a run's tetrahedra; exit code 1 if any is inverted."""
    from musclefit.workflows.check_mesh import check_mesh as examine

    found = examine(run, out=out)
    if json:
        print_json(found.to_json())
    elif not quiet:
        width = max(len(row.tissue) for row in found.rows)
        print(f"{found.title}: {found.said()}")
        print(f"{'':<{width}}  shape        tets    inverted  Jacobian min, 1 %, mean  dihedral min, 1 %, max deg")
        for row in found.rows:
            print(
                f"{row.tissue:<{width}}  {row.shape:<8}  {row.tets:7d}  {row.inside_out:10d}  "
                f"{row.scaled_jacobian_min:8.3f} {row.scaled_jacobian_low:6.3f} {row.scaled_jacobian_mean:6.3f}  "
                f"{row.dihedral_min_deg:8.1f} {row.dihedral_low_deg:6.1f} {row.dihedral_max_deg:6.1f}"
            )
    return FAILED if any(row.inside_out for row in found.rows) else PASSED
