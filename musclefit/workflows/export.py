"""A run's tetrahedra, from its folder to a file that a solver opens."""

from __future__ import annotations

from pathlib import Path

from musclefit.io.formats.solvers import (
    LabelledTets,
    MshVersion,
    check_solver_path,
    with_middle_nodes,
    write_solver_file,
)
from musclefit.io.run_tets import Shape, read_run_tets
from musclefit.workflows.given import word


def export(
    run: str | Path,
    out: str | Path,
    *,
    shape: Shape | str = Shape.DEFORMED,
    quadratic: bool = False,
    msh: MshVersion | str = MshVersion.V4,
) -> LabelledTets:
    """Write a run's tetrahedra for a solver: one element set per tissue, shared nodes, placeholder materials, mm.

    Parameters
    ----------
    run : path
        The folder that a run wrote.
    out : path
        .feb (FEBio 4.0), .inp (Abaqus), .msh (Gmsh) or .vtu; replaced.
    shape : {"deformed", "rest"}
        Positions after the deformation or before it.
    quadratic : bool
        Whether each tetrahedron gets nodes in the middles of its straight edges too: tet10 instead of tet4.
    msh : {"4.1", "2.2"}
        Version of a .msh file.

    Raises
    ------
    InputError
        No run, a run without tetrahedra, or a file of another ending.
    """
    check_solver_path(Path(out))
    version = word(MshVersion, msh, what="msh")
    tets = read_run_tets(Path(run), shape=word(Shape, shape, what="shape"))
    tets = with_middle_nodes(tets) if quadratic else tets
    write_solver_file(Path(out), tets, msh=version)
    return tets
