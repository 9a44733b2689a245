"""A run's tetrahedra, from its folder to a file that a solver opens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from musclefit.errors import InputError
from musclefit.io.formats.fibre_directions import FIBRES, read_fibres
from musclefit.io.formats.solvers import (
    LabelledTets,
    MshVersion,
    check_solver_path,
    with_middle_nodes,
    write_solver_file,
)
from musclefit.io.run_tets import Shape, read_run_tets
from musclefit.workflows.given import word
from musclefit.workflows.tet_fibres import fibres_at_rest, fibres_carried


def export(
    run: str | Path,
    out: str | Path,
    *,
    shape: Shape | str = Shape.DEFORMED,
    quadratic: bool = False,
    msh: MshVersion | str = MshVersion.V4,
    fibres: str | Path | None = None,
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
    fibres : path, optional
        The folder that `architecture` wrote for the same anatomy, and into the same pose for the deformed shape: .inp
        gets an orientation for each element, .vtu and .msh the directions.

    Returns
    -------
    LabelledTets
        What was written, in mm.

    Raises
    ------
    InputError
        No run, a run without tetrahedra, or a file of another ending; fibres for a .feb file, which `febio_model`
        writes, of none of these tissues, or of another pose.
    """
    check_solver_path(Path(out))
    version = word(MshVersion, msh, what="msh")
    asked = word(Shape, shape, what="shape")
    if fibres is not None and Path(out).suffix.lower() == ".feb":
        raise InputError(
            f"{out}: `musclefit febio-model` writes fibres into a .feb file; export takes .inp, .msh and .vtu"
        )
    known = None if fibres is None else read_fibres(Path(fibres) / FIBRES)
    tets = read_run_tets(Path(run), shape=asked)
    if known is not None:
        rest = tets if asked is Shape.REST else read_run_tets(Path(run), shape=Shape.REST)
        along = fibres_at_rest(rest, known)[0] if asked is Shape.REST else fibres_carried(rest, tets, known)
        tets = replace(tets, fibres=along)
    tets = with_middle_nodes(tets) if quadratic else tets
    write_solver_file(Path(out), tets, msh=version)
    return tets
