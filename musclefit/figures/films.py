"""A motion as pictures from one view, and as a film: GIF, or MP4 where imageio-ffmpeg is installed; knows no file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from io import BytesIO
from typing import Any

import numpy as np
import pyvista as pv
from PIL import Image

from musclefit.anatomy.model import Anatomy
from musclefit.figures.camera import principal_views
from musclefit.figures.colours import tissue_colours
from musclefit.figures.panels import Panel, screenshot, tissue_panels

FILM_HEIGHT_PX = 540

FILM_FRAME_S = 0.08
"""Shortest time that a film shows a frame; quick motions are shown slower than they are."""

_COLOURS = 128
"""Of a GIF."""
_TITLE_ROOM = 0.08
"""Share of the half height that is left above for the title."""


def motion_pictures(
    frames: Sequence[Anatomy], titles: Sequence[str], *, height_px: int = FILM_HEIGHT_PX, quarter_turn: bool = False
) -> Iterator[bytes]:
    """A PNG of each frame, all from one view that shows the whole motion.

    Parameters
    ----------
    frames : sequence of Anatomy
    titles : sequence of str
    height_px : int
    quarter_turn : bool
        The narrow side in place of the broad one.
    """
    every = np.concatenate([frame.vertices()[::7] for frame in frames])
    seen = principal_views(every)[int(quarter_turn)]
    room = _TITLE_ROOM * seen.half_height_mm
    view = replace(seen, centre=seen.centre + room * seen.up, half_height_mm=seen.half_height_mm + room)
    colours = tissue_colours(frames[0])
    with pv.vtk_verbosity("off"):
        for frame, title in zip(frames, titles, strict=True):
            yield screenshot(tissue_panels((Panel(title, frame),), view, colours=colours, height_px=height_px))


def film_pace(times_s: Sequence[float]) -> tuple[float, str]:
    """How long a film shows each frame, s, and in words how much slower than it is; "" where it is not.

    >>> film_pace([0.0, 0.5, 1.0]), film_pace([0.0, 0.02, 0.04])
    ((0.5, ''), (0.08, ', 4 times slower than it is'))
    """
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    each_s = max(FILM_FRAME_S, step_s)
    return each_s, "" if each_s < 1.05 * step_s else f", {each_s / step_s:.3g} times slower than it is"


def gif(pictures: Sequence[bytes], *, seconds_each: float) -> bytes:
    """An animated GIF of PNGs that starts over at its end."""
    images = [Image.open(BytesIO(picture)).convert("RGB") for picture in pictures]
    palette = images[len(images) // 2].quantize(_COLOURS)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    data = BytesIO()
    indexed[0].save(
        data,
        format="GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=max(20, round(1000.0 * seconds_each)),
        loop=0,
    )
    return data.getvalue()


def mp4_problem() -> str:
    """Why no MP4 can be made here, or "" where it can."""
    missing = [name for name in ("imageio", "imageio_ffmpeg") if find_spec(name) is None]
    return f"no MP4 without {missing[0]}: pip install 'musclefit[motion]'" if missing else ""


def mp4(pictures: Sequence[bytes], *, seconds_each: float) -> bytes:
    """An MP4 (H.264) of PNGs; see `mp4_problem`."""
    import imageio.v3 as imageio

    images: list[Any] = [np.asarray(Image.open(BytesIO(picture)).convert("RGB")) for picture in pictures]
    even = [image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2] for image in images]
    return imageio.imwrite(
        "<bytes>", even, extension=".mp4", fps=1.0 / seconds_each, codec="libx264", macro_block_size=2
    )


def contact_sheet(pictures: Sequence[bytes], *, columns: int, width_px: int) -> bytes:
    """PNGs beside and below each other in one PNG, each that wide."""
    images = [Image.open(BytesIO(picture)).convert("RGB") for picture in pictures]
    height = round(images[0].height * width_px / images[0].width)
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * width_px, rows * height), "white")
    for number, image in enumerate(images):
        small = image.resize((width_px, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (number % columns * width_px, number // columns * height))
    data = BytesIO()
    sheet.save(data, format="PNG")
    return data.getvalue()
