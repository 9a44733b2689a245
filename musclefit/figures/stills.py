"""The pictures of a report as PNG bytes: rest, other methods and result side by side; or why there are none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pyvista as pv

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError
from musclefit.figures.camera import View, principal_views
from musclefit.figures.colours import tissue_colours
from musclefit.figures.panels import Marks, Panel, determinant_panels, screenshots_beside, tissue_panels
from musclefit.figures.rendering import rendering_problem

PANELS_AT_FULL_HEIGHT = 3

__all__ = ["Marks", "Stills", "stills"]


@dataclass(frozen=True, eq=False, slots=True)
class Stills:
    """PNG bytes by caption, in reading order, and why there are none ("" when there are)."""

    pictures: Mapping[str, bytes] = field(default_factory=dict)
    problem: str = ""


def stills(
    rest: Anatomy,
    deformed: Anatomy,
    *,
    beside: Mapping[str, tuple[Anatomy, Marks]] = MappingProxyType({}),
    rest_marks: Marks = Marks(),  # noqa: B008 (a frozen value)
    marks: Marks = Marks(),  # noqa: B008
    height_px: int = 1000,
) -> Stills:
    """Pictures of one run, all from the same view.

    Parameters
    ----------
    rest, deformed : Anatomy
        The same tissues before and after.
    beside : mapping of title to anatomy and marks
        After the methods compared with, in order, between rest and result.
    rest_marks, marks : Marks
        Determinants and overlaps to point out at rest and in the result.
    height_px : int
        Of pictures of up to three panels; those of more have as many pixels as three, for the time that each takes.

    Returns
    -------
    Stills
        Never fails for want of a screen: where off-screen rendering does not work, ``problem`` says why.

    Raises
    ------
    InputError
        The anatomies have different tissues, or determinants do not fit their tissue.
    """
    panels = [Panel("Rest", rest, rest_marks)]
    panels += [Panel(title, anatomy, of_it) for title, (anatomy, of_it) in beside.items()]
    panels.append(Panel("Result", deformed, marks))
    _require_same_tissues(panels)
    problem = rendering_problem()
    if problem:
        return Stills(problem=problem)
    drawings = _drawings(tuple(panels), height_px)
    with pv.vtk_verbosity("off"):
        return Stills(
            {caption: screenshots_beside(draw(panel) for panel in of) for caption, (of, draw) in drawings.items()}
        )


_Drawing = tuple[tuple[Panel, ...], Callable[[Panel], Any]]
"""Panels that stand beside each other, and what makes the plotter of one: each is drawn alone, in less memory."""


def _drawings(panels: tuple[Panel, ...], height_px: int) -> dict[str, _Drawing]:
    """What to draw, by caption."""
    front, side = principal_views(_seen(panels))
    colours = tissue_colours(panels[0].anatomy)
    who = ", ".join(panel.title.lower() for panel in panels)
    notes = [
        *(["folded places in magenta"] if any(p.marks.determinants for p in panels) else []),
        *(["overlaps in blue"] if any(p.marks.overlaps for p in panels) else []),
    ]
    tail = f" ({'; '.join(notes)})" if notes else ""
    height = round(height_px * min(1.0, math.sqrt(PANELS_AT_FULL_HEIGHT / len(panels))))

    def tissues(view: View) -> Callable[[Panel], Any]:
        return lambda panel: tissue_panels((panel,), view, colours=colours, height_px=height)

    drawings: dict[str, _Drawing] = {
        f"All tissues, from the broad side: {who}{tail}": (panels, tissues(front)),
        f"All tissues, a quarter turn on: {who}{tail}": (panels, tissues(side)),
    }
    bones = tuple(_only(panel, TissueKind.BONE) for panel in panels if panel.anatomy.of_kind(TissueKind.BONE))
    if len(bones) == len(panels) and len(bones[0].anatomy) < len(panels[0].anatomy):
        drawings[f"Bones alone: {who}"] = (bones, tissues(front))
    measured = tuple(panel for panel in panels if panel.marks.determinants)
    if measured:
        names = ", ".join(panel.title.lower() for panel in measured)
        caption = f"Local volume ratio det J: {names} (white 1, brown 2 or more, violet towards 0, folded in magenta)"
        drawings[caption] = (measured, lambda panel: determinant_panels((panel,), front, height_px=height_px))
    return drawings


def _seen(panels: tuple[Panel, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """What the view must show: every vertex of every panel."""
    return np.concatenate([panel.anatomy.vertices() for panel in panels])


def _only(panel: Panel, kind: TissueKind) -> Panel:
    """The panel with the tissues of one kind, without marks."""
    return Panel(panel.title, replace(panel.anatomy, tissues=panel.anatomy.of_kind(kind)))


def _require_same_tissues(panels: list[Panel]) -> None:
    names = [t.name for t in panels[0].anatomy]
    for panel in panels[1:]:
        others = [t.name for t in panel.anatomy]
        if others != names:
            differing = sorted(set(names) ^ set(others))[:4]
            raise InputError(
                f"{panel.title} and rest have different tissues ({', '.join(differing)}); "
                "pictures compare the same tissues"
            )
