"""Pictures of one anatomy for print and talks, with an exact scale bar, and turntables; knows no file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import pyvista as pv
from PIL import Image, ImageDraw, ImageFont

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.figures.camera import View
from musclefit.figures.colours import tissue_colours
from musclefit.figures.panels import SKIN_OPACITY, add_tissue, aim, surface
from musclefit.geometry.arrays import Float

MOST_PX = 4096
"""Of a side: pictures are drawn four times as large and made smaller, and software renderers end at 16384."""

_MM_PER_INCH = 25.4
_COLOUR_MAP = "viridis"
_INK = (29, 35, 39, 255)
_BAR_SHARE, _MARGIN_SHARE, _TEXT_SHARE = 0.22, 0.03, 0.022
"""Of the picture: the longest scale bar over the width, the margin and the text over the longer side."""


@dataclass(frozen=True, slots=True)
class Size:
    """The size of a printed picture.

    Parameters
    ----------
    width_mm, height_mm, dpi : float

    Raises
    ------
    InputError
        A side is not positive, or has more pixels than can be drawn.
    """

    width_mm: float
    height_mm: float
    dpi: float

    def __post_init__(self) -> None:
        for name, value in (("width_mm", self.width_mm), ("height_mm", self.height_mm), ("dpi", self.dpi)):
            if not 0 < value < math.inf:
                raise InputError(f"found {name} = {value:g}; expected a number above 0")
        if not 1 <= min(self.pixels) <= max(self.pixels) <= MOST_PX:
            raise InputError(
                f"found {self.width_mm:g} x {self.height_mm:g} mm at {self.dpi:g} dpi, which is {self.pixels[0]} x "
                f"{self.pixels[1]} pixels; expected 1 to {MOST_PX} a side: ask for a smaller picture or fewer dpi"
            )

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return round(self.width_mm * self.dpi / _MM_PER_INCH), round(self.height_mm * self.dpi / _MM_PER_INCH)


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """How tissues are drawn.

    Parameters
    ----------
    skin_opacity : float
        0 leaves the skin out.
    transparent : bool
        No background, in place of a white one.
    scale_bar : bool
    values : mapping of tissue name to (n,) float64
        Colours its vertices in place of its own colour; tissues without are drawn in theirs.
    values_name : str
        What the values are, with unit.
    values_top : float
        The value of the last colour; 0 for the largest value.
    """

    skin_opacity: float = SKIN_OPACITY
    transparent: bool = False
    scale_bar: bool = True
    values: Mapping[str, Float] | None = None
    values_name: str = ""
    values_top: float = 0.0

    @property
    def top(self) -> float:
        """The value of the last colour."""
        return self.values_top or _top(self.values or {})


@dataclass(frozen=True, slots=True)
class Still:
    """A picture: PNG bytes, how many mm of the body a pixel is, and the scale bar's length, 0 for none."""

    png: bytes
    mm_per_px: float
    bar_mm: float


def still(anatomy: Anatomy, view: View, *, size: Size, look: Look) -> Still:
    """Draw an anatomy in parallel projection, so that the scale is the same all over the picture."""
    image, mm_per_px = _drawn(anatomy, view, size=size, look=look)
    bar_mm = 0.0
    if look.scale_bar:
        bar_mm = round_length_mm(_BAR_SHARE * image.width * mm_per_px)
        _draw_bar(image, bar_mm, mm_per_px)
    if look.values:
        _draw_colours(image, look.top, look.values_name)
    data = BytesIO()
    picture = image if look.transparent else image.convert("RGB")
    picture.save(data, "PNG", dpi=(size.dpi, size.dpi), optimize=False)
    return Still(data.getvalue(), mm_per_px, bar_mm)


def turntable(anatomy: Anatomy, views: tuple[View, ...], *, size: Size, look: Look) -> Iterator[bytes]:
    """A PNG from each view."""
    for view in views:
        yield still(anatomy, view, size=size, look=look).png


def round_length_mm(most_mm: float) -> float:
    """The longest of 1, 2 and 5 times a power of ten that is not above a length.

    >>> round_length_mm(73.0), round_length_mm(0.4)
    (50.0, 0.2)
    """
    power = 10.0 ** math.floor(math.log10(most_mm))
    return next(factor * power for factor in (5.0, 2.0, 1.0) if factor * power <= most_mm)


def _drawn(anatomy: Anatomy, view: View, *, size: Size, look: Look) -> tuple[Any, float]:
    width, height = size.pixels
    colours = tissue_colours(anatomy)
    values = look.values or {}
    top = look.top
    with pv.vtk_verbosity("off"):
        plotter = pv.Plotter(off_screen=True, border=False, window_size=[width, height])
        plotter.set_background("white")
        for tissue in anatomy:
            if tissue.kind is TissueKind.SKIN and not look.skin_opacity:
                continue
            if tissue.name in values and tissue.kind is not TissueKind.SKIN:
                _add_coloured(plotter, tissue, values[tissue.name], top)
            else:
                add_tissue(plotter, tissue, colours[tissue.name], skin_opacity=look.skin_opacity)
        half_height_mm = aim(plotter, view)
        data = BytesIO()
        try:
            plotter.screenshot(data, transparent_background=look.transparent, return_img=False)
        finally:
            plotter.close()
    return Image.open(data).convert("RGBA"), 2.0 * half_height_mm / height


def _add_coloured(plotter: Any, tissue: Tissue, values: Float, top: float) -> None:
    mesh = surface(tissue.surface)
    mesh.point_data["value"] = values
    plotter.add_mesh(
        mesh,
        scalars="value",
        cmap=_COLOUR_MAP,
        clim=(0.0, top),
        smooth_shading=True,
        show_scalar_bar=False,
        ambient=0.25,
    )


def _top(values: Mapping[str, Float]) -> float:
    """The largest value; 1 where all are 0."""
    return max((float(np.nanmax(own)) for own in values.values() if len(own)), default=0.0) or 1.0


def _draw_colours(image: Any, top: float, name: str) -> None:
    """A strip of the colours from 0 to the largest value in the upper right corner."""
    margin, text = _margin_and_text(image)
    font = ImageFont.load_default(text)
    high, wide = image.height // 5, max(4, text)
    shades = pv.LookupTable(_COLOUR_MAP, n_values=high).values[::-1]
    left, upper = image.width - margin - wide, margin + 2 * text
    image.paste(Image.fromarray(np.repeat(shades[:, None, :3], wide, axis=1).astype(np.uint8)), (left, upper))
    draw = ImageDraw.Draw(image)
    draw.text((image.width - margin, margin), name, fill=_INK, font=font, anchor="ra")
    draw.text((left - text // 2, upper), f"{top:.3g}", fill=_INK, font=font, anchor="ra")
    draw.text((left - text // 2, upper + high), "0", fill=_INK, font=font, anchor="rs")


def _margin_and_text(image: Any) -> tuple[int, int]:
    long = max(image.size)
    return round(_MARGIN_SHARE * long), max(8, round(_TEXT_SHARE * long))


def _draw_bar(image: Any, bar_mm: float, mm_per_px: float) -> None:
    """A bar with its length in the lower left corner."""
    margin, text = _margin_and_text(image)
    thick = max(2, round(text / 5))
    left, bottom = margin, image.height - margin
    draw = ImageDraw.Draw(image)
    draw.rectangle((left, bottom - thick, left + round(bar_mm / mm_per_px), bottom), fill=_INK)
    draw.text((left, bottom - 2 * thick), f"{bar_mm:g} mm", fill=_INK, font=ImageFont.load_default(text), anchor="ls")
