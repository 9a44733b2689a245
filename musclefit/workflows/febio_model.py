"""A model for FEBio, from a run with tetrahedra and the fibres of its muscles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.mesh_rules import FILLER
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.febio_model import FebioModel, write_febio_model
from musclefit.io.formats.fibre_directions import FIBRES, read_fibres
from musclefit.io.formats.tables import parse_json
from musclefit.io.formats.texts import read_bytes
from musclefit.io.run_folder import REPORT_JSON, file_names
from musclefit.io.run_tets import Shape, read_run_tets
from musclefit.workflows.results import Shown


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class FebioWritten(Shown):
    """A model that was written, and how well it stands for the run.

    Parameters
    ----------
    path : Path
    model : FebioModel
    bones_off_mm : mapping of name to float
        How far nodes of each rigid bone are, at most, from where the run has them.
    fibres_off_mm : mapping of name to float
        How far the middle of a tetrahedron is, at most, from the place whose direction it takes.
    without_fibres : tuple of str
        Muscles that are written as soft tissue, because the folder has no fibres of them.
    """

    path: Path
    model: FebioModel
    bones_off_mm: Mapping[str, float]
    fibres_off_mm: Mapping[str, float]
    without_fibres: tuple[str, ...]

    def said(self) -> str:
        """Parts and what is worst, in a line."""
        return (
            f"{self.path}: {len(self.model.tets.tets)} tetrahedra, {len(self.model.bodies)} rigid bodies, "
            f"{len(self.model.muscles)} muscles with fibres; bones off the run by "
            f"{max(self.bones_off_mm.values()):.2g} mm at most"
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Bones and muscles."""
        return {
            "bones": [{"name": name, "off_mm": off} for name, off in self.bones_off_mm.items()],
            "muscles": [{"name": name, "fibres_off_mm": off} for name, off in self.fibres_off_mm.items()],
        }

    def to_json(self) -> dict[str, Any]:
        """What was written and how well it stands for the run."""
        return {
            "file": str(self.path),
            "tetrahedra": len(self.model.tets.tets),
            "rigid_bodies": len(self.model.bodies),
            "muscles_without_fibres": list(self.without_fibres),
            **self.tables(),
        }


def febio_model(run: str | Path, architecture: str | Path, out: str | Path) -> FebioWritten:
    """Write a model for FEBio 4: bones prescribed from rest into the run's pose, muscles with fibres, soft filler.

    Parameters
    ----------
    run : path
        The folder that a run with tetrahedra wrote.
    architecture : path
        The folder that `architecture` wrote for the same anatomy.
    out : path
        The .feb file; replaced.

    Raises
    ------
    InputError
        No run, a run without tetrahedra, no fibres, no bones, or bones that touch and move apart.
    """
    fibres = read_fibres(Path(architecture) / FIBRES)
    rest = read_run_tets(Path(run), shape=Shape.REST)
    posed = read_run_tets(Path(run), shape=Shape.DEFORMED)
    kinds = _kinds(Path(run))
    motions: dict[str, RigidMotion] = {}
    bones_off: dict[str, float] = {}
    fibres_off: dict[str, float] = {}
    along = np.zeros((len(rest.tets), 3))
    present = np.unique(rest.tissue_of_tet)
    for number in present:
        name, own = rest.names[number], rest.tissue_of_tet == number
        nodes = np.unique(rest.tets[own])
        if kinds.get(name) == TissueKind.BONE:
            motions[name] = RigidMotion.fitted(rest.vertices[nodes], posed.vertices[nodes])
            off = np.linalg.norm(motions[name](rest.vertices[nodes]) - posed.vertices[nodes], axis=1)
            bones_off[name] = float(off.max())
        elif kinds.get(name) == TissueKind.MUSCLE and name in fibres:
            places, directions = fibres[name]
            found = cKDTree(places).query(rest.vertices[rest.tets[own]].mean(axis=1))
            along[own], fibres_off[name] = directions[found[1]], float(np.max(found[0]))
    muscles = frozenset(fibres_off)
    model = FebioModel(rest, along, motions, muscles)
    write_febio_model(Path(out), model)
    without = [rest.names[k] for k in present if kinds.get(rest.names[k]) == TissueKind.MUSCLE]
    return FebioWritten(Path(out), model, bones_off, fibres_off, tuple(name for name in without if name not in muscles))


def _kinds(run: Path) -> Mapping[str, str]:
    """The kind of each tissue, by the name that the run's tetrahedra have it under."""
    report = parse_json(read_bytes(run / REPORT_JSON), source=str(run / REPORT_JSON))
    try:
        kinds = {str(row["name"]): str(row["kind"]) for row in report["tissues"]}
    except (KeyError, TypeError):
        raise InputError(f"{run / REPORT_JSON}: tells no tissues and kinds; run the rig again") from None
    safe = file_names([*kinds])
    return {safe[name]: kind for name, kind in kinds.items() if name != FILLER} | kinds
