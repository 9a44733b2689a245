"""A rig's deformation as grid transforms for ITK and 3D Slicer, both ways."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid
from musclefit.io.formats.grid_transforms import (
    check_grid_transforms_writable,
    require_orthogonal,
    write_grid_transform,
)
from musclefit.io.formats.nifti import read_volume
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.pipeline.displacement_grids import (
    MARGIN,
    Direction,
    DisplacementGrid,
    displacement_grid,
    grid_around,
    samples_of,
)
from musclefit.progress import Progress
from musclefit.workflows.frames import frame_of
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class WarpFields(Shown):
    """Grid transforms that were written, with what sampling them costs.

    Parameters
    ----------
    title : str
    frame : Frame
        Of the rig; the files are in LPS, as ITK's are.
    made : tuple of (Path, DisplacementGrid)
    """

    title: str
    frame: Frame
    made: tuple[tuple[Path, DisplacementGrid], ...]

    def said(self) -> str:
        """Each file in a few words."""
        return f"{self.title}: " + "; ".join(
            f"{path} ({made.direction}, {made.grid.count} points, off by {made.error.max_mm:.3g} mm at most)"
            for path, made in self.made
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The files."""
        return {"fields": self.to_json()["fields"]}

    def to_json(self) -> dict[str, Any]:
        """All of it but the vectors."""
        return {"title": self.title, "frame": self.frame.value, "fields": [_field(*pair) for pair in self.made]}


def warp_field(
    rig: RigGiven,
    *,
    to_rest: str | Path | None = None,
    to_deformed: str | Path | None = None,
    frame: Frame | str | None = None,
    spacing_mm: float | None = None,
    like: str | Path | None = None,
    margin_mm: float | None = None,
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
) -> WarpFields:
    """Write a rig's deformation as grid transforms that ITK, SimpleITK, ANTs and 3D Slicer open.

    ITK's transforms lead from the result to what is resampled. So the file *to rest* warps images of the body at rest
    onto the deformed body, in ITK and in Slicer, where it also takes surfaces and markups from rest to deformed. The
    file *to deformed* moves points in ITK from rest to deformed.

    Parameters
    ----------
    rig : str, path or mapping
        See `musclefit.run`.
    to_rest, to_deformed : path, optional
        .nrrd, .mha, .h5, .nii or .nii.gz; at least one of the two.
    frame : {"lps", "ras"}, optional
        Of the rig's coordinates; without it, that which ``anatomy.frame`` states.
    spacing_mm : float, optional
        Of grids along the axes of the body that hold it, at rest for ``to_deformed``, deformed for ``to_rest``.
    like : path, optional
        NIfTI image whose grid both have instead.
    margin_mm : float, optional
        How far grids reach beyond the body; without it, twice the spacing.
    overrides : sequence of str
        ``key=value`` each.
    progress : Progress, optional

    Returns
    -------
    WarpFields
        With the sampling error of each, measured on the surfaces of all tissues.

    Raises
    ------
    InputError, RigError, NotConvergedError
        No file to write or one that cannot be, no frame, neither or both of spacing and image, a grid that is too
        large, or a rig that does not reach its destination.
    """
    wanted = {
        direction: Path(path)
        for direction, path in ((Direction.TO_REST, to_rest), (Direction.TO_DEFORMED, to_deformed))
        if path is not None
    }
    if not wanted:
        raise InputError("no file to write; name one with --to-rest, --to-deformed, or both")
    check_grid_transforms_writable(list(wanted.values()))
    if (spacing_mm is None) == (like is None):
        raise InputError("expected either a spacing in mm (--spacing-mm) or an image whose grid is taken (--like)")
    if like is not None and margin_mm is not None:
        raise InputError("--margin-mm has no effect with --like, whose grid is taken as it is; remove one of them")
    with watched(progress) as stages:
        grid = None if like is None else _grid_of(Path(like))
        job = read_rig(rig, overrides=overrides, progress=stages)
        into = frame_of(job.anatomy.frame, frame)
        vertices = job.anatomy.vertices()
        if spacing_mm is not None:  # what is wrong with it is told before the march
            grid_around(vertices, frame=into, spacing_mm=spacing_mm, margin_mm=_margin(margin_mm, spacing_mm))
        deformation = deform(job, vertices, progress=stages).deformation.require()
        between = spacing_mm if spacing_mm is not None else float(grid.spacing.min()) if grid is not None else 0.0
        with stages.stage("sample the surfaces"):
            samples = samples_of(job.anatomy, deformation, spacing_mm=between)
        made = []
        for direction, path in wanted.items():
            body = samples.deformed if direction is Direction.TO_REST else samples.rest
            onto = grid or grid_around(body, frame=into, spacing_mm=between, margin_mm=_margin(margin_mm, between))
            field = displacement_grid(
                deformation, onto, frame=into, direction=direction, samples=samples, progress=stages
            )
            made.append((path, field))
        for path, field in made:  # all that can fail is done
            write_grid_transform(path, field.vectors, field.grid, description=_description(job.title, field.direction))
    return WarpFields(job.title, into, tuple(made))


def _margin(margin_mm: float | None, spacing_mm: float) -> float:
    return MARGIN * spacing_mm if margin_mm is None else margin_mm


def _grid_of(path: Path) -> Grid:
    grid = read_volume(path).grid
    require_orthogonal(grid, source=path)
    return grid


def _description(title: str, direction: Direction) -> str:
    leads = "deformed body to rest" if direction is Direction.TO_REST else "rest to deformed body"
    return f"{leads}, mm, LPS+ ({title})"


def _field(path: Path, made: DisplacementGrid) -> dict[str, Any]:
    error = made.error
    return {
        "file": str(path),
        "direction": made.direction.value,
        "grid": list(made.grid.shape),
        "spacing_mm": made.grid.spacing.tolist(),
        "sampling_error_mm": {"median": error.median_mm, "most_95": error.most_95_mm, "max": error.max_mm},
        "worst_tissue": error.tissue,
        "worst_place_mm": list(error.place_mm),
        "surface_samples": error.samples,
        "samples_outside_grid": error.outside,
        "points_filled": made.filled,
    }
