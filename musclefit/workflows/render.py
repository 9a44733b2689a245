"""Pictures for print of a finished run or sequence: stills from all round, a turntable, a film; without a screen."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import InputError
from musclefit.figures.camera import View, views_around
from musclefit.figures.films import film_pace, gif, mp4, mp4_problem
from musclefit.figures.rendering import rendering_problem
from musclefit.figures.renders import Look, Size, still, turntable
from musclefit.geometry.arrays import Float
from musclefit.io.finished_runs import read_finished_run
from musclefit.io.finished_sequences import FinishedFrame, FinishedSequence, is_sequence, read_finished_sequence
from musclefit.io.run_folder import require_new_folder, write_new_folder
from musclefit.progress import Progress, Tick
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
    frame: int | None = None,
    only: tuple[str, ...] = (),
    colour: Colouring | str = Colouring.TISSUE,
    width_mm: float = 90.0,
    height_mm: float = 120.0,
    dpi: float = 300.0,
    skin_opacity: float = 0.2,
    transparent: bool = False,
    scale_bar: bool = True,
    turns: int = 0,
    film: bool = False,
    progress: Progress | None = None,
) -> Rendered:
    """Draw a finished run, or a frame of a sequence, for print: four stills a quarter turn apart, of one scale.

    Parameters
    ----------
    run : path
        The folder that `musclefit run` wrote, or `musclefit sequence`.
    out : path
        New folder.
    state : {"result", "rest"}
    frame : int, optional
        Of a sequence: the number of the frame that is drawn; without it the one farthest from rest on average.
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
    film : bool
        Of a sequence: the whole motion from the broad side, on the given triangles, in the same form as the turntable.
    progress : Progress, optional

    Returns
    -------
    Rendered

    Raises
    ------
    InputError, MeshError
        No run, no such frame, a frame or a film of what is no sequence, no tissue of a pattern, a size that cannot be
        drawn, or a system that cannot draw.
    """
    size = Size(width_mm, height_mm, dpi)
    if not 0 <= skin_opacity <= 1:
        raise InputError(f"found skin_opacity = {skin_opacity:g}; expected 0 to 1")
    if turns < 0 or turns == 1:
        raise InputError(f"found {turns} pictures of a turntable; expected at least 2, or 0 for none")
    state, colour = word(Shown3d, state, what="state"), word(Colouring, colour, what="colour")
    require_new_folder(Path(out))
    shown = drawn_of(run, frame=frame, film=film)
    rest, deformed = shown.rest, shown.posed
    drawn = _chosen(deformed if state is Shown3d.RESULT else rest, only)
    problem = rendering_problem()
    if problem:
        raise InputError(problem)
    look = Look(skin_opacity=skin_opacity, transparent=transparent, scale_bar=scale_bar)
    if colour is Colouring.DISPLACEMENT:
        far = _moved(_chosen(rest, only), deformed)
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
                    "caption": _caption(shown.title, state, colour, SIDES[number], picture.bar_mm),
                    **_direction(view),
                    "mm_per_px": picture.mm_per_px,
                    "scale_bar_mm": picture.bar_mm,
                }
                tick((number + 1) / len(SIDES))
        note = mp4_problem() if turns or film else ""
        ending = "gif" if note else "mp4"
        make: Any = gif if note else mp4
        small, film_look = _film_size(size), replace(look, transparent=False, scale_bar=False)
        if turns:
            with stages.stage("turntable") as tick:
                pictures = []
                for turned in turntable(drawn, views_around(points, count=turns), size=small, look=film_look):
                    pictures.append(turned)
                    tick(len(pictures) / turns)
                name = f"turntable.{ending}"
                files[name] = make(pictures, seconds_each=FILM_S / turns)
                told[name] = {"caption": f"{shown.title}: {state.value}, all round in {turns} pictures"}
        if film and shown.sequence is not None:
            with stages.stage("film") as tick:
                pictures = list(_film(shown.sequence, only, small, film_look, tick))
                seconds_each, slower = film_pace([frame.summary.time_s for frame in shown.sequence.made])
                files[f"motion.{ending}"] = make(pictures, seconds_each=seconds_each)
                told[f"motion.{ending}"] = {
                    "caption": f"{shown.sequence.title}: {len(pictures)} frames from the broad side{slower}"
                }
        text = json.dumps({"run": str(run), "pictures": told}, indent=1, allow_nan=False, ensure_ascii=False)
        write_new_folder(Path(out), {**files, PICTURES_JSON: (text + "\n").encode("utf-8", "backslashreplace")})
    return Rendered(Path(out), told, f"a GIF was made: {note}" if note else "")


@dataclass(frozen=True, eq=False, slots=True)
class Drawn:
    """What is drawn: its title, its surfaces at rest and as they came out, and the sequence that it is a frame of."""

    title: str
    rest: Anatomy
    posed: Anatomy
    sequence: FinishedSequence | None = None


def drawn_of(run: str | Path, *, frame: int | None = None, film: bool = False) -> Drawn:
    """What is drawn of a folder: a run, or a frame of a sequence.

    Parameters
    ----------
    run : path
    frame : int, optional
        Of a sequence; without it the one farthest from rest on average.
    film : bool
        Whether the whole motion is asked for, too.

    Raises
    ------
    InputError, MeshError
        The folder holds neither, or a run of which a frame or a film is asked for, or no such frame.
    """
    if not is_sequence(run):
        finished = read_finished_run(run)
        if frame is not None or film:
            asked = f"frame {frame}" if frame is not None else "a film of the motion"
            raise InputError(f"found a run in {run}, which has no frames, so not {asked}; name a sequence's folder")
        return Drawn(finished.title, *finished.surfaces())
    sequence = read_finished_sequence(run)
    if not sequence.made:
        raise InputError(f"the sequence in {run} has no frame that was made, so that there is nothing to draw")
    chosen = _farthest(sequence) if frame is None else _numbered(sequence, frame)
    summary = chosen.summary
    pose = "".join(f", {name} {angle:.3g}°" for name, angle in summary.pose_deg.items())
    title = f"{sequence.title}, frame {summary.number} at {summary.time_s:.4g} s{pose}"
    return Drawn(title, *sequence.surfaces(chosen), sequence)


def _numbered(sequence: FinishedSequence, number: int) -> FinishedFrame:
    if not 0 <= number < len(sequence.frames):
        raise InputError(f"found frame {number}; expected 0 to {len(sequence.frames) - 1}")
    if not sequence.frames[number].made:
        summary = sequence.frames[number].summary
        raise InputError(f"frame {number} was {summary.outcome}: {summary.problem}; name another frame")
    return sequence.frames[number]


def _farthest(sequence: FinishedSequence) -> FinishedFrame:
    """The frame whose given vertices are farthest from rest on average."""
    rest = sequence.rest.vertices()
    return max(sequence.made, key=lambda f: float(np.linalg.norm(f.stored.vertices() - rest, axis=1).mean()))


def _film(sequence: FinishedSequence, only: tuple[str, ...], size: Size, look: Look, tick: Tick) -> Iterator[bytes]:
    """A PNG of each frame that was made, all from one view that shows the whole motion."""
    frames, rest = sequence.made, _chosen(sequence.rest, only)
    every = np.concatenate([_chosen(sequence.anatomy(frame), only).vertices()[::7] for frame in frames])
    view = views_around(every, count=1)[0]
    if look.values is not None:
        far = [max(map(np.max, _moved(rest, sequence.anatomy(frame)).values())) for frame in frames]
        look = replace(look, values_top=float(max(far)))
    for number, frame in enumerate(frames):
        posed = _chosen(sequence.anatomy(frame), only)
        own = look if look.values is None else replace(look, values=_moved(rest, posed))
        yield still(posed, view, size=size, look=own).png
        tick((number + 1) / len(frames))


def _moved(rest: Anatomy, posed: Anatomy) -> dict[str, Float]:
    """How far each vertex of the tissues at rest moved, mm, by tissue."""
    return {t.name: np.linalg.norm(posed[t.name].surface.vertices - t.surface.vertices, axis=1) for t in rest}


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


def _caption(title: str, state: Shown3d, colour: Colouring, side: str, bar_mm: float) -> str:
    what = "coloured by displacement" if colour is Colouring.DISPLACEMENT else "tissues in colours of their own"
    bar = f" Scale bar {bar_mm:g} mm." if bar_mm else ""
    turned = {"broad": "from the broad side", "back": "from behind that"}.get(
        side, f"a {side.replace('-', ' ')} turn on"
    )
    return f"{title}: {state.value}, {turned}, {what}; parallel projection.{bar}"
