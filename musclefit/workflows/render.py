"""Pictures for print of a finished run: stills from all round, and a turntable, drawn without a screen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.figures.camera import View, views_around
from musclefit.figures.films import gif, mp4, mp4_problem
from musclefit.figures.rendering import rendering_problem
from musclefit.figures.renders import Look, Size, still, turntable
from musclefit.io.finished_runs import FinishedRun, read_finished_run
from musclefit.io.run_folder import require_new_folder, write_new_folder
from musclefit.progress import Progress
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

PICTURES_JSON = "pictures.json"
SIDES = ("broad", "quarter", "back", "three-quarters")
"""Stills are named after how far they are turned from the broad side."""

FILM_S, FILM_PX = 8.0, 1080
"""A turn of the turntable, and the longer side of its pictures."""


class Shown3d(StrEnum):
    """Which positions are drawn."""

    RESULT = "result"
    REST = "rest"


class Colouring(StrEnum):
    """What colours the tissues: their kind and name, or how far each place moved."""

    TISSUE = "tissue"
    DISPLACEMENT = "displacement"


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Rendered(Shown):
    """Pictures that were written.

    Parameters
    ----------
    folder : Path
    pictures : mapping of file name to what it shows
        Caption, view, mm of the body per pixel and length of the scale bar, as in pictures.json.
    note : str
        What was made in place of what was asked for; "" for nothing.
    """

    folder: Path
    pictures: Mapping[str, Mapping[str, Any]]
    note: str = ""

    def said(self) -> str:
        """What was written, in a line."""
        return f"{', '.join(self.pictures)} in {self.folder}" + (f"; {self.note}" if self.note else "")


def render(
    run: str | Path,
    out: str | Path,
    *,
    state: Shown3d | str = Shown3d.RESULT,
    only: tuple[str, ...] = (),
    colour: Colouring | str = Colouring.TISSUE,
    width_mm: float = 90.0,
    height_mm: float = 120.0,
    dpi: float = 300.0,
    skin_opacity: float = 0.2,
    transparent: bool = False,
    scale_bar: bool = True,
    turns: int = 0,
    progress: Progress | None = None,
) -> Rendered:
    """Draw a finished run for print: four stills a quarter turn apart, of one scale, and a turntable.

    Parameters
    ----------
    run : path
        The folder that `musclefit run` wrote.
    out : path
        New folder.
    state : {"result", "rest"}
    only : sequence of str
        Patterns of tissue names, such as ``"bone_*"``; empty for all.
    colour : {"tissue", "displacement"}
    width_mm, height_mm, dpi : float
        Of a printed still.
    skin_opacity : float
        From 0, which leaves the skin out, to 1.
    transparent : bool
        No background, in place of a white one.
    scale_bar : bool
    turns : int
        Pictures of the turntable; 0 for none. It is an MP4 where imageio-ffmpeg is installed, else a GIF.
    progress : Progress, optional

    Returns
    -------
    Rendered

    Raises
    ------
    InputError, MeshError
        No run, no tissue of a pattern, a size that cannot be drawn, or a system that cannot draw.
    """
    size = Size(width_mm, height_mm, dpi)
    if not 0 <= skin_opacity <= 1:
        raise InputError(f"found skin_opacity = {skin_opacity:g}; expected 0 to 1")
    if turns < 0 or turns == 1:
        raise InputError(f"found {turns} pictures of a turntable; expected at least 2, or 0 for none")
    state, colour = word(Shown3d, state, what="state"), word(Colouring, colour, what="colour")
    require_new_folder(Path(out))
    finished = read_finished_run(run)
    rest, deformed = finished.surfaces()
    drawn = _chosen(deformed if state is Shown3d.RESULT else rest, only)
    problem = rendering_problem()
    if problem:
        raise InputError(problem)
    look = Look(skin_opacity=skin_opacity, transparent=transparent, scale_bar=scale_bar)
    if colour is Colouring.DISPLACEMENT:
        far = {
            t.name: np.linalg.norm(deformed[t.name].surface.vertices - rest[t.name].surface.vertices, axis=1)
            for t in drawn
        }
        look = replace(look, values=far, values_name="displacement, mm")
    files: dict[str, bytes] = {}
    told: dict[str, dict[str, Any]] = {}
    points = drawn.vertices()
    with watched(progress) as stages:
        with stages.stage("stills") as tick:
            for number, view in enumerate(views_around(points, count=len(SIDES))):
                picture = still(drawn, view, size=size, look=look)
                name = f"{SIDES[number]}.png"
                files[name] = picture.png
                told[name] = {
                    "caption": _caption(finished, state, colour, SIDES[number], picture.bar_mm),
                    **_direction(view),
                    "mm_per_px": picture.mm_per_px,
                    "scale_bar_mm": picture.bar_mm,
                }
                tick((number + 1) / len(SIDES))
        note = ""
        if turns:
            with stages.stage("turntable") as tick:
                small = _film_size(size)
                pictures = []
                film_look = replace(look, transparent=False, scale_bar=False)
                for turned in turntable(drawn, views_around(points, count=turns), size=small, look=film_look):
                    pictures.append(turned)
                    tick(len(pictures) / turns)
                note = mp4_problem()
                name = "turntable.gif" if note else "turntable.mp4"
                files[name] = (gif if note else mp4)(pictures, seconds_each=FILM_S / turns)
                told[name] = {"caption": f"{finished.title}: {state.value}, all round in {turns} pictures"}
        text = json.dumps(
            {"run": str(finished.folder), "pictures": told}, indent=1, allow_nan=False, ensure_ascii=False
        )
        write_new_folder(Path(out), {**files, PICTURES_JSON: (text + "\n").encode("utf-8", "backslashreplace")})
    return Rendered(Path(out), told, f"a GIF was made: {note}" if note else "")


def _chosen(anatomy: Anatomy, only: tuple[str, ...]) -> Anatomy:
    """The tissues whose names fit a pattern."""
    for pattern in only:
        if not any(fnmatchcase(tissue.name, pattern) for tissue in anatomy):
            raise InputError(
                f"no tissue is named like {pattern!r}; there are: {', '.join(tissue.name for tissue in anatomy)}"
            )
    chosen = [t for t in anatomy if not only or any(fnmatchcase(t.name, pattern) for pattern in only)]
    return replace(anatomy, tissues=tuple(chosen))


def _film_size(size: Size) -> Size:
    """The shape of the stills, with as many pixels as a film has."""
    return replace(size, dpi=size.dpi * min(1.0, FILM_PX / max(size.pixels)))


def _direction(view: View) -> dict[str, list[float]]:
    return {"towards_the_eye": [float(x) for x in view.towards], "up": [float(x) for x in view.up]}


def _caption(run: FinishedRun, state: Shown3d, colour: Colouring, side: str, bar_mm: float) -> str:
    what = "coloured by displacement" if colour is Colouring.DISPLACEMENT else "tissues in colours of their own"
    bar = f" Scale bar {bar_mm:g} mm." if bar_mm else ""
    turned = {"broad": "from the broad side", "back": "from behind that"}.get(
        side, f"a {side.replace('-', ' ')} turn on"
    )
    return f"{run.title}: {state.value}, {turned}, {what}; parallel projection.{bar}"
