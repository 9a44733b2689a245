"""A template's skin given other measures, from files to the targets of a cage and a rig that it drives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.measures import enclosed_volume
from musclefit.io.body_fits import write_measure_fit
from musclefit.io.formats.body_measures import read_body_measures
from musclefit.io.formats.landmarks import read_landmarks
from musclefit.io.run_folder import require_new_folder
from musclefit.pipeline.body_measures import MeasuredBody
from musclefit.pipeline.fit_measures import MeasureFit
from musclefit.pipeline.fit_measures import fit_measures as fitted
from musclefit.progress import Progress
from musclefit.vocabulary import Unit
from musclefit.workflows.fit_body import VERTICES, cage_around, read_template
from musclefit.workflows.frames import in_frame
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class MeasuredFit(Shown):
    """A template with the measures of a body.

    Parameters
    ----------
    fit : MeasureFit
        Measures before and after, cage and targets, map.
    findings : tuple of Finding
        What was noticed in the files.
    folder : Path or None
        Where it was written.
    """

    fit: MeasureFit
    findings: tuple[Finding, ...]
    folder: Path | None = None

    def said(self) -> str:
        """How many measures are met, and how the volume changed."""
        before, after = (enclosed_volume(mesh) / 1e6 for mesh in (self.fit.rest, self.fit.skin))
        off = float(np.abs(self.fit.wanted_mm - self.fit.reached_mm).max())
        return (
            f"{len(self.fit.measures)} measures are met within {off:.1g} mm; the skin encloses {after:.3g} litres, "
            f"before {before:.3g}"
        )

    def measures(self) -> list[dict[str, Any]]:
        """Each measure before, wanted and reached, in the unit in which it was given."""
        fit = self.fit
        rows = zip(fit.measures, fit.before_mm.tolist(), fit.reached_mm.tolist(), strict=True)
        return [
            {
                "name": measure.name,
                "kind": measure.kind.value,
                "unit": measure.unit.value,
                "before": before / measure.unit.in_mm,
                "wanted": measure.wanted_mm / measure.unit.in_mm,
                "reached": reached / measure.unit.in_mm,
            }
            for measure, before, reached in rows
        ]

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The measures."""
        return {"measures": self.measures(), "findings": self.findings}

    def to_json(self) -> dict[str, Any]:
        """All but surfaces."""
        fit = self.fit
        return {
            "measures": self.measures(),
            "volume_litres": {
                "template": enclosed_volume(fit.rest) / 1e6,
                "fitted": enclosed_volume(fit.skin) / 1e6,
            },
            "largest_displacement_mm": float(np.linalg.norm(fit.skin.vertices - fit.rest.vertices, axis=1).max()),
            "cage_vertices": len(fit.cage.vertices),
            "cage_target_crossings": fit.crossings,
            "steps": len(fit.deformation.steps),
            "findings": [finding.message for finding in self.findings],
        }


def fit_measures(
    template: str | Path,
    measures: str | Path,
    out: str | Path | None = None,
    *,
    landmarks: str | Path | None = None,
    up: str = "z",
    cage: str | Path | None = None,
    vertices: int = VERTICES,
    anatomy: Sequence[str] = (),
    units: Unit | str = Unit.MILLIMETRE,
    frame: str = "",
    progress: Progress | None = None,
) -> MeasuredFit:
    """Change a template as little as possible to given measures: targets of a cage that drives the anatomy there.

    Parameters
    ----------
    template : path
        The template's skin, closed: PLY, STL, OBJ, VTP.
    measures : path
        Stature, girths and lengths with their units: TOML, JSON, CSV (`musclefit.io.formats.body_measures`).
    out : path, optional
        New or empty folder for the cage and its targets, the rig that they drive, the skin, and the report.
    landmarks : path, optional
        Landmarks on the template, by whose names measures are taken.
    up : {"x", "y", "z", "-x", "-y", "-z"}
        The way from feet to head.
    cage : path, optional
        Cage of the template; without it, one is made.
    vertices : int
        Of the cage that is made.
    anatomy : sequence of str
        Surfaces, or patterns of them, that the rig names beside the template's skin.
    units : {"mm", "cm", "m"}
        Of template, cage and landmarks.
    frame : str
        Of the template, for the rig.
    progress : Progress, optional

    Returns
    -------
    MeasuredFit
        The measures before and after, the cage and its targets.

    Raises
    ------
    InputError, MeshError, LandmarkError, RigError
        Files that cannot be read or written, a template that is not closed, measures that it does not have, that are
        likely in another unit, or that contradict each other.
    """
    if out is not None:
        require_new_folder(Path(out))
    unit, direction = word(Unit, units, what="units"), _direction(up)
    with watched(progress) as stages:
        with stages.stage("read the files"):
            wanted = read_body_measures(measures)
            tissue, findings = read_template(Path(template), unit)
            names, places, more = _landmarks(landmarks, unit, frame)
            body = MeasuredBody(tissue.surface, names, places, direction)
        with stages.stage("make the cage"):
            made = cage_around(tissue.surface, cage, vertices=vertices, unit=unit)
        fit = fitted(body, made, wanted, progress=stages)
        result = MeasuredFit(fit, (*findings, *more), None if out is None else Path(out))
        if out is not None:
            files = [str(Path(template).resolve()), *anatomy]
            title = f"{Path(template).stem} with the measures of {Path(measures).stem}"
            write_measure_fit(Path(out), fit, title=title, anatomy=files, frame=frame, report=result.to_json())
    return result


def _landmarks(path: str | Path | None, unit: Unit, frame: str) -> tuple[tuple[str, ...], Points, tuple[Finding, ...]]:
    """Names and positions in the template's frame; LPS and RAS are converted where both sides are stated."""
    if path is None:
        return (), np.zeros((0, 3)), ()
    table, findings = in_frame(read_landmarks(path, units=unit), frame, of="template")
    return table.names, table.positions, findings


def _direction(up: str) -> Float:
    axis = "xyz".find(up[-1:])
    if axis < 0 or up not in ("xyz"[axis], f"-{'xyz'[axis]}"):
        raise InputError(f"up: found {up!r}; expected one of x, y, z, -x, -y, -z")
    direction: Float = np.eye(3)[axis] * (-1.0 if up.startswith("-") else 1.0)
    return direction
