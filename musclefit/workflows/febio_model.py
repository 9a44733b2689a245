"""A model for FEBio, from a run with tetrahedra and the fibres of its muscles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.mesh_rules import FILLER
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.febio_contacts import ContactPair
from musclefit.io.formats.febio_model import FebioModel, write_febio_model
from musclefit.io.formats.fibre_directions import FIBRES, read_fibres
from musclefit.io.formats.tables import parse_json
from musclefit.io.formats.texts import read_bytes
from musclefit.io.run_folder import REPORT_JSON, file_names
from musclefit.io.run_tets import Shape, read_run_tets
from musclefit.workflows.results import Shown
from musclefit.workflows.tet_fibres import by_tissue, fibres_at_rest
from musclefit.workflows.tissue_contacts import HANGS, Contacts, with_own_nodes


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
    facing_mm : float or None
        How far apart tissues may be that slide on each other; None where they share their nodes.
    """

    path: Path
    model: FebioModel
    bones_off_mm: Mapping[str, float]
    fibres_off_mm: Mapping[str, float]
    without_fibres: tuple[str, ...]
    facing_mm: float | None = None

    @property
    def ties(self) -> tuple[ContactPair, ...]:
        """Pairs of tissues that are tied by contact."""
        return tuple(pair for pair in self.model.contacts if pair.tied)

    @property
    def told(self) -> tuple[str, ...]:
        """What stands in the model otherwise than in the anatomy, a line each."""
        tied = [
            f"{pair.reason}: tied to {pair.secondary}, which it faces most"
            for pair in self.ties
            if HANGS in pair.reason
        ]
        return (*(f"{name}: no fibres, written as soft tissue" for name in self.without_fibres), *tied)

    def said(self) -> str:
        """Parts and what is worst, in a line."""
        return (
            f"{self.path}: {len(self.model.tets.tets)} tetrahedra, {len(self.model.bodies)} rigid bodies, "
            f"{len(self.model.muscles)} muscles with fibres, {len(self.ties)} ties, "
            f"{len(self.model.contacts) - len(self.ties)} sliding pairs; bones off the run by "
            f"{max(self.bones_off_mm.values()):.2g} mm at most"
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Bones, muscles and contacts."""
        return {
            "bones": [{"name": name, "off_mm": off} for name, off in self.bones_off_mm.items()],
            "muscles": [{"name": name, "fibres_off_mm": off} for name, off in self.fibres_off_mm.items()],
            "contacts": [
                {
                    "primary": pair.primary,
                    "secondary": pair.secondary,
                    "tied": pair.tied,
                    "faces": len(pair.faces),
                    "gap_mm": pair.gap_mm,
                    "reason": pair.reason,
                }
                for pair in self.model.contacts
            ],
        }

    def to_json(self) -> dict[str, Any]:
        """What was written and how well it stands for the run."""
        return {
            "file": str(self.path),
            "tetrahedra": len(self.model.tets.tets),
            "rigid_bodies": len(self.model.bodies),
            "muscles_without_fibres": list(self.without_fibres),
            "facing_mm": self.facing_mm,
            **self.tables(),
        }


def febio_model(
    run: str | Path,
    architecture: str | Path,
    out: str | Path,
    *,
    sliding: bool = False,
    facing_mm: float | None = None,
) -> FebioWritten:
    """Write a model for FEBio 4: bones prescribed from rest into the run's pose, muscles with fibres, soft filler.

    Parameters
    ----------
    run : path
        The folder that a run with tetrahedra wrote.
    architecture : path
        The folder that `architecture` wrote for the same anatomy.
    out : path
        The .feb file; replaced.
    sliding : bool
        Whether to leave the filler out, so that tissues have nodes of their own and slide where they face each other;
        otherwise neighbours share nodes. Muscles are tied to the bones that they attach to either way.
    facing_mm : float, optional
        How far apart tissues may be that face each other; the mean edge of their triangles without it. Only with
        ``sliding``.

    Returns
    -------
    FebioWritten
        The model, and how far it is from the run, mm.

    Raises
    ------
    InputError
        No run, a run without tetrahedra, no fibres, no bones, bones that touch and move apart, or a tissue that would
        hang on nothing.
    """
    if facing_mm is not None and not (sliding and 0.0 < facing_mm < np.inf):
        raise InputError(f"facing_mm: found {facing_mm}; expected a finite length above 0, mm, and tissues that slide")
    fibres = read_fibres(Path(architecture) / FIBRES)
    rest = read_run_tets(Path(run), shape=Shape.REST)
    posed = read_run_tets(Path(run), shape=Shape.DEFORMED)
    kinds = _kinds(Path(run))
    motions: dict[str, RigidMotion] = {}
    bones_off: dict[str, float] = {}
    along, found = fibres_at_rest(rest, fibres)
    present = np.unique(rest.tissue_of_tet)
    for number in present:
        name, own = rest.names[number], rest.tissue_of_tet == number
        nodes = np.unique(rest.tets[own])
        if kinds.get(name) == TissueKind.BONE:
            motions[name] = RigidMotion.fitted(rest.vertices[nodes], posed.vertices[nodes])
            off = np.linalg.norm(motions[name](rest.vertices[nodes]) - posed.vertices[nodes], axis=1)
            bones_off[name] = float(off.max())
    fibres_off = {name: off for name, off in found.items() if kinds.get(name) == TissueKind.MUSCLE}
    muscles = frozenset(fibres_off)
    tets = replace(rest, fibres=along)
    tets = with_own_nodes(tets, without=[FILLER]) if sliding else tets
    model = FebioModel(tets, tets.fibre_axes[0], motions, muscles)
    contacts = Contacts(
        tets,
        bones={label: number for number, group in enumerate(model.bodies) for label in group},
        muscles={label: by_tissue(fibres)[name] for label, name in model.names.items() if name in muscles},
        bone_names=_labels(model.names, kinds),
    )
    reach = (contacts.edge_mm if facing_mm is None else facing_mm) if sliding else None
    pairs = contacts.attachments() if reach is None else contacts.all_pairs(within_mm=reach)
    model = replace(model, contacts=pairs)
    write_febio_model(Path(out), model)
    without = [rest.names[k] for k in present if kinds.get(rest.names[k]) == TissueKind.MUSCLE]
    lacking = tuple(name for name in without if name not in muscles)
    return FebioWritten(Path(out), model, bones_off, fibres_off, lacking, reach)


def _labels(names: Mapping[str, str], kinds: Mapping[str, str]) -> Mapping[str, str]:
    """The label of each tissue's part, by the tissue's name in the anatomy and in the tetrahedra."""
    label_of = {name: label for label, name in names.items()}
    safe = file_names([name for name in kinds if name != FILLER])
    return {name: label_of[safe[name]] for name in safe if safe[name] in label_of} | label_of


def _kinds(run: Path) -> Mapping[str, str]:
    """The kind of each tissue, by the name that the run's tetrahedra have it under."""
    report = parse_json(read_bytes(run / REPORT_JSON), source=str(run / REPORT_JSON))
    try:
        kinds = {str(row["name"]): str(row["kind"]) for row in report["tissues"]}
    except (KeyError, TypeError):
        raise InputError(f"{run / REPORT_JSON}: tells no tissues and kinds; run the rig again") from None
    safe = file_names([*kinds])
    return {safe[name]: kind for name, kind in kinds.items() if name != FILLER} | kinds
