"""Draws anatomies side by side from one view and gives the plotter unshown; knows no file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

import numpy as np
import pyvista as pv
from PIL import Image

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.figures.camera import View
from musclefit.figures.colours import FOLD, OVERLAP, Colour
from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh

DETERMINANT_LIMITS = (0.0, 2.0)
"""Fixed limits of the determinant's colours: white at 1, where volume is kept."""

SKIN_OPACITY = 0.2

_FOLDED = -1.0
"""What a determinant of zero, below zero or NaN is drawn as: below the limits, whatever it is."""
_IN_FRONT = -66000.0
"""Depth offset that draws a mark in front of everything."""


@dataclass(frozen=True, eq=False, slots=True)
class Marks:
    """What to point out in one panel.

    ``determinants`` holds det J (n,) at the vertices of tissues by name; ``overlaps`` are solids shared by two.
    """

    determinants: Mapping[str, Float] = field(default_factory=dict)
    overlaps: tuple[TriMesh, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Panel:
    """One anatomy with its title and what to point out in it.

    Raises
    ------
    InputError
        There is not one determinant for each vertex of a tissue.
    """

    title: str
    anatomy: Anatomy
    marks: Marks = field(default_factory=Marks)

    def __post_init__(self) -> None:
        for name, determinants in self.marks.determinants.items():
            count = len(self.anatomy[name].surface.vertices)
            if np.shape(determinants) != (count,):
                raise InputError(
                    f"the determinants of {name!r} have shape {np.shape(determinants)}; give one for each "
                    f"of its {count} vertices"
                )


def tissue_panels(
    panels: tuple[Panel, ...], view: View, *, colours: Mapping[str, Colour], height_px: int, off_screen: bool = True
) -> Any:
    """Panels side by side: skin translucent, every other tissue in its colour, folds and overlaps in front of all.

    Parameters
    ----------
    panels : tuple of Panel
    view : View
        The same for every panel.
    colours : mapping of tissue name to colour
    height_px : int
        Height of the picture; the width follows from the view.
    off_screen : bool
        Whether it is drawn without a window.

    Returns
    -------
    pyvista.Plotter
        Unshown; the caller shows or closes it.
    """
    plotter = _plotter(len(panels), view, height_px, off_screen=off_screen)
    for column, panel in enumerate(panels):
        plotter.subplot(0, column)
        for tissue in panel.anatomy:
            add_tissue(plotter, tissue, colours[tissue.name])
        _add_marks(plotter, panel)
        _finish(plotter, panel.title, view)
    return plotter


def determinant_panels(panels: tuple[Panel, ...], view: View, *, height_px: int) -> Any:
    """Panels coloured by det J between fixed limits; what is zero or below is in the fold colour.

    Tissues without determinants are left out, but for the skin, which is drawn translucent.

    Parameters
    ----------
    panels : tuple of Panel
    view : View
    height_px : int

    Returns
    -------
    pyvista.Plotter
        Unshown; the caller shows or closes it.
    """
    plotter = _plotter(len(panels), view, height_px)
    for column, panel in enumerate(panels):
        plotter.subplot(0, column)
        for tissue in panel.anatomy:
            determinants = panel.marks.determinants.get(tissue.name)
            if tissue.kind is TissueKind.SKIN:
                add_tissue(plotter, tissue, (0.75, 0.75, 0.75))
            elif determinants is not None:
                _add_determinants(plotter, tissue, determinants)
        _add_marks(plotter, panel)
        _finish(plotter, panel.title, view)
    return plotter


def screenshot(plotter: Any) -> bytes:
    """PNG of an unshown plotter, which is closed."""
    picture = BytesIO()
    try:
        plotter.screenshot(picture, return_img=False)
    finally:
        plotter.close()
    return picture.getvalue()


def screenshots_beside(plotters: Iterable[Any]) -> bytes:
    """PNG of unshown plotters of one height beside each other; each is closed before the next is asked for."""
    pictures = []
    for plotter in plotters:
        try:
            pictures.append(plotter.screenshot(return_img=True))
        finally:
            plotter.close()
    joined = BytesIO()
    Image.fromarray(np.hstack(pictures)).save(joined, format="PNG")
    return joined.getvalue()


def surface(mesh: TriMesh) -> Any:
    """The triangles as PolyData."""
    return pv.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.faces))


def _plotter(count: int, view: View, height_px: int, *, off_screen: bool = True) -> Any:
    aspect = min(max(view.aspect, 0.42), 1.6)
    plotter = pv.Plotter(
        off_screen=off_screen,
        shape=(1, count),
        border=False,
        window_size=[count * round(aspect * height_px), height_px],
    )
    plotter.set_background("white")
    return plotter


def add_tissue(plotter: Any, tissue: Tissue, colour: Colour, *, skin_opacity: float = SKIN_OPACITY) -> None:
    """Draw a tissue in its colour into the current panel, the skin translucent."""
    if not len(tissue.surface.faces):
        return
    look: dict[str, Any] = {"smooth_shading": True, "split_sharp_edges": False, "color": colour}
    if tissue.kind is TissueKind.SKIN:
        plotter.add_mesh(surface(tissue.surface), opacity=skin_opacity, specular=0.0, ambient=0.25, **look)
    else:
        plotter.add_mesh(surface(tissue.surface), specular=0.15, specular_power=12, ambient=0.22, diffuse=0.85, **look)


def _add_determinants(plotter: Any, tissue: Tissue, determinants: Float) -> None:
    mesh = surface(tissue.surface)
    mesh.point_data["det J"] = np.where(_folds(determinants), _FOLDED, determinants)
    plotter.add_mesh(
        mesh,
        scalars="det J",
        cmap="PuOr_r",
        clim=DETERMINANT_LIMITS,
        below_color=FOLD,
        nan_color=FOLD,
        smooth_shading=True,
        split_sharp_edges=False,
        show_scalar_bar=False,
        ambient=0.25,
    )


def _add_marks(plotter: Any, panel: Panel) -> None:
    """Overlaps as solids and folded vertices as dots, in front of everything."""
    folded = [
        panel.anatomy[name].surface.vertices[_folds(determinants)]
        for name, determinants in panel.marks.determinants.items()
    ]
    dots = np.concatenate(folded) if folded else np.zeros((0, 3))
    actors = []
    if len(dots):
        actors.append(plotter.add_points(dots, color=FOLD, point_size=7, render_points_as_spheres=True, lighting=False))
    actors += [
        plotter.add_mesh(surface(solid), color=OVERLAP, lighting=False)
        for solid in panel.marks.overlaps
        if len(solid.faces)
    ]
    for actor in actors:
        mapper = actor.mapper
        mapper.SetResolveCoincidentTopologyToPolygonOffset()
        mapper.SetRelativeCoincidentTopologyPolygonOffsetParameters(0.0, _IN_FRONT)
        mapper.SetRelativeCoincidentTopologyPointOffsetParameter(_IN_FRONT)


_TITLE, _LEAST_TITLE = 13, 5
"""Font size of a title, and of one that is long for its panel."""
_PX_PER_SIZE, _CHARACTER = 2.0, 0.68
"""Pixels of a title's letters for its font size, and how wide a character is of them at most on average."""


def _finish(plotter: Any, title: str, view: View) -> None:
    """Title and camera of the current panel."""
    longest = max(map(len, title.split("\n")))
    wide_px = plotter.window_size[0] / plotter.shape[1]
    fits = wide_px / (_CHARACTER * max(longest, 1)) / _PX_PER_SIZE
    size = max(_LEAST_TITLE, min(_TITLE, int(fits)))
    words = plotter.add_text(title, position="upper_edge", font_size=size, color="#1d2327", font="arial")
    words.GetTextProperty().SetBackgroundColor(1.0, 1.0, 1.0)  # to be read in front of tissue, too
    words.GetTextProperty().SetBackgroundOpacity(0.85)
    aim(plotter, view)


def aim(plotter: Any, view: View) -> float:
    """Point the camera of the current panel; gives half the height that it sees, mm."""
    width, height = plotter.window_size
    panel_aspect = width / plotter.shape[1] / height
    scale = view.parallel_scale_mm(panel_aspect)
    camera = plotter.camera
    camera.focal_point = view.centre
    camera.position = view.centre + view.towards * (4.0 * scale + 2.0 * view.half_depth_mm)
    camera.up = view.up
    camera.enable_parallel_projection()
    camera.parallel_scale = scale
    plotter.renderer.ResetCameraClippingRange()
    plotter.enable_depth_peeling(8)
    plotter.enable_anti_aliasing("ssaa", all_renderers=False)
    return scale


def _folds(determinants: Float) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where det J is zero, negative or not a number."""
    return ~(np.asarray(determinants) > 0)
