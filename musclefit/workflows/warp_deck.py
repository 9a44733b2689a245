"""A solver's deck through a rig's deformation: its nodes moved in the user's own file, its elements judged."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.measures import distances_from_box
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.io.atomic import write_bytes_atomically
from musclefit.io.decks import read_deck, require_deck
from musclefit.io.formats.points import INSIDE
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.progress import Progress
from musclefit.rig.job import FAR_DIAGONALS, Job
from musclefit.validate.elements import ElementCheck, check_elements
from musclefit.vocabulary import Unit
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class WarpedDeck(Shown):
    """A deck whose nodes were moved.

    Parameters
    ----------
    path : Path
    nodes : int
    largest_move_mm : float
    outside_skin : int or None
        Nodes outside the skin, which the map's checks do not cover; None where the anatomy has no skin.
    coincident : int
        Places that several nodes share; they share the place after, too.
    elements : tuple of ElementCheck
    unmeasured : mapping of str to int
        Elements whose shape was not measured, by type.
    kept : mapping of str to int
        What else in the deck holds places or directions, and was left as it is.
    includes : tuple of str
        Files that the deck includes, whose nodes were not moved.
    """

    path: Path
    nodes: int
    largest_move_mm: float
    outside_skin: int | None
    coincident: int
    elements: tuple[ElementCheck, ...]
    unmeasured: Mapping[str, int]
    kept: Mapping[str, int]
    includes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether no element was turned inside out that was not before."""
        return not any(check.introduced for check in self.elements)

    def said(self) -> str:
        """Nodes, elements and the verdict in a line."""
        count = sum(check.count for check in self.elements)
        turned = sum(check.introduced for check in self.elements)
        return f"{self.path}: {self.nodes} nodes moved, {count} elements measured, {turned} newly inverted"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The elements by shape."""
        return {"elements": [asdict(check) for check in self.elements]}

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "file": str(self.path),
            "verdict": "passed" if self.passed else "failed",
            "nodes": self.nodes,
            "largest_move_mm": self.largest_move_mm,
            "nodes_outside_skin": self.outside_skin,
            "coincident_places": self.coincident,
            "elements": [asdict(check) for check in self.elements],
            "elements_not_measured": dict(self.unmeasured),
            "left_as_it_is": dict(self.kept),
            "files_not_followed": list(self.includes),
        }


def warp_deck(
    rig: RigGiven,
    deck: str | Path,
    out: str | Path,
    *,
    units: Unit | str = Unit.MILLIMETRE,
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
) -> WarpedDeck:
    """Move the nodes of a solver's deck by a rig's deformation; every other byte of the deck stays as it is.

    Parameters
    ----------
    rig : str, path or mapping
        See `musclefit.run`.
    deck, out : path
        LS-DYNA (.k, .key, .dyn), Abaqus (.inp) or FEBio (.feb), both of one ending; in the rig's coordinates.
    units : {"mm", "cm", "m"}
        Length unit of the deck.
    overrides : sequence of str
        ``key=value`` each.
    progress : Progress, optional

    Returns
    -------
    WarpedDeck
        With the elements' scaled Jacobians and warpage before and after, and what was left as it is.

    Raises
    ------
    InputError, RigError, NotConvergedError
        A deck that cannot be read or whose nodes are not where the anatomy is, an output that is the deck itself or of
        another ending, or a rig that does not reach its destination.
    """
    deck, out = Path(deck), Path(out)
    require_deck(out)
    if deck.suffix.lower() != out.suffix.lower():
        raise InputError(f"{out}: a deck keeps its format; name a file that ends in {deck.suffix}")
    if out.exists() and deck.exists() and out.samefile(deck):
        raise InputError(f"{out}: is the deck itself; name another file, so that the original stays")
    if out.is_dir() or not out.parent.is_dir():
        raise InputError(f"{out}: cannot be written; name a file in a folder that is there")
    unit = word(Unit, units, what="units").in_mm
    with watched(progress) as stages:
        with stages.stage("read the deck"):
            read = read_deck(deck)
        rest = read.nodes * unit
        job = read_rig(rig, overrides=overrides, progress=stages)
        _require_near(rest, job, deck=deck)
        deformation = deform(job, job.anatomy.vertices(), progress=stages).deformation.require()
        # Nodes at one place go to one place, digit for digit: each place is moved once.
        places, first, shared = np.unique(rest, axis=0, return_inverse=True, return_counts=True)
        with stages.stage("move the nodes"):
            moved = deformation(places)[first.ravel()]
        with stages.stage("judge the elements"):
            checks = tuple(
                check_elements(block.kind, block.names, block.corners, rest=rest, moved=moved)
                for block in read.elements
            )
        write_bytes_atomically(out, read.rewritten(moved / unit))
    skin = job.anatomy.skin
    return WarpedDeck(
        path=out,
        nodes=len(rest),
        largest_move_mm=float(np.linalg.norm(moved - rest, axis=1).max()),
        outside_skin=None if skin is None else int((winding_numbers(skin.surface, rest) < INSIDE).sum()),
        coincident=int((shared > 1).sum()),
        elements=checks,
        unmeasured=read.unmeasured,
        kept=read.kept,
        includes=read.includes,
    )


def _require_near(nodes: Points, job: Job, *, deck: Path) -> None:
    """InputError where not one node is near the anatomy: other units or another frame."""
    vertices = job.anatomy.vertices()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    reach = FAR_DIAGONALS * float(np.linalg.norm(high - low))
    off = distances_from_box(nodes, vertices)
    span, body = float(np.linalg.norm(np.ptp(nodes, axis=0))), float(np.linalg.norm(high - low))
    if off.min() > reach or (len(nodes) > 3 and span < body / 300.0):
        raise InputError(
            f"{deck}: its nodes span {span:.4g} mm from ({_place(nodes.min(axis=0))}) to "
            f"({_place(nodes.max(axis=0))}), the anatomy {body:.4g} mm from ({_place(low)}) to ({_place(high)}); "
            "likely other units (--units) or another frame"
        )


def _place(point: Points) -> str:
    return ", ".join(f"{x:.4g}" for x in point)
