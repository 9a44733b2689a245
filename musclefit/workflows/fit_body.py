"""A template's skin fitted to a scan, from surface files to the targets of a cage and a rig that it drives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Points
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.cages import cage_of
from musclefit.io.anatomy import RawSurface, read_surface
from musclefit.io.body_fits import RIG, matrix_of, write_body_fit
from musclefit.io.formats.landmarks import paired, read_landmarks
from musclefit.io.run_folder import require_new_folder
from musclefit.pipeline.fit_body import BodyFit
from musclefit.pipeline.fit_body import fit_body as fitted
from musclefit.progress import Progress
from musclefit.rig.off_bones import off_surface_findings
from musclefit.vocabulary import Unit
from musclefit.workflows.frames import in_frame
from musclefit.workflows.given import word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

VERTICES, MEDIAN_MM, MOST_MM = 800, 2.0, 8.0


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class FittedBody(Shown):
    """A template's skin on a scan.

    Parameters
    ----------
    fit : BodyFit
        Cage and targets, map, surfaces, distances.
    median_limit_mm, most_limit_mm : float
    findings : tuple of Finding
        What was noticed in the files.
    folder : Path or None
        Where it was written.
    """

    fit: BodyFit
    median_limit_mm: float
    most_limit_mm: float
    findings: tuple[Finding, ...]
    folder: Path | None = None

    @property
    def passed(self) -> bool:
        """Whether the scan is as near to the skin as asked for: at the middle, and for 95 % of its area."""
        found = self.fit.from_scan
        return found.median_mm <= self.median_limit_mm and found.most_95_mm <= self.most_limit_mm

    def said(self) -> str:
        """Distances and what is missing in a line."""
        found, verdict = self.fit.from_scan, "passed" if self.passed else "failed"
        return (
            f"{verdict}; the scan is {found.median_mm:.2g} mm from the skin (median; 95 % within "
            f"{found.most_95_mm:.2g}, at most {found.max_mm:.3g}); {100.0 * self.fit.unmatched:.2g} % of it is no part "
            f"of the skin, {100.0 * self.fit.uncovered:.2g} % of the skin has no counterpart"
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The distances, both ways."""
        both = (("scan to skin", self.fit.from_scan), ("skin to scan", self.fit.from_skin))
        return {"distances": [{"of": name, **asdict(found)} for name, found in both], "findings": self.findings}

    def to_json(self) -> dict[str, Any]:
        """All but surfaces."""
        fit = self.fit
        return {
            "verdict": "passed" if self.passed else "failed",
            "scan_to_skin": asdict(fit.from_scan),
            "skin_to_scan": asdict(fit.from_skin),
            "limits": {"median_mm": self.median_limit_mm, "most_95_mm": self.most_limit_mm},
            "scan_unmatched_percent": 100.0 * fit.unmatched,
            "skin_uncovered_percent": 100.0 * fit.uncovered,
            "template_to_scan": matrix_of(fit.motion),
            "size": fit.size,
            "scan_was_inside_out": fit.turned,
            "second_best_way_to_lie": fit.rival,
            "volume_litres": {"scan_fitted": enclosed_volume(fit.skin) / 1e6},
            "cage_vertices": len(fit.cage.vertices),
            "cage_target_crossings": fit.crossings,
            "steps": len(fit.deformation.steps),
            "findings": [finding.message for finding in self.findings],
        }


def fit_body(
    template: str | Path,
    scan: str | Path,
    out: str | Path | None = None,
    *,
    cage: str | Path | None = None,
    vertices: int = VERTICES,
    anatomy: Sequence[str] = (),
    units: Unit | str = Unit.MILLIMETRE,
    scan_units: Unit | str = Unit.MILLIMETRE,
    landmarks: tuple[str | Path, str | Path] | None = None,
    frame: str = "",
    median_mm: float = MEDIAN_MM,
    most_mm: float = MOST_MM,
    progress: Progress | None = None,
) -> FittedBody:
    """Fit a template's skin to a scan of any triangles, and give the targets of a cage that drives the anatomy there.

    Parameters
    ----------
    template : path
        The template's skin, closed: PLY, STL, OBJ, VTP.
    scan : path
        A surface in a similar pose, anywhere in space; it may have holes and parts that are not skin.
    out : path, optional
        New or empty folder for the cage and its targets, the rig that they drive, both surfaces with their distances,
        and the report.
    cage : path, optional
        Cage of the template; without it, one is made.
    vertices : int
        Of the cage that is made.
    anatomy : sequence of str
        Surfaces, or patterns of them, that the rig names beside the template's skin.
    units, scan_units : {"mm", "cm", "m"}
        Of template, cage and template's landmarks; of scan and its landmarks.
    landmarks : pair of path, optional
        Landmarks on the template and on the scan, matched by name.
    frame : str
        Of the template, for the rig; its landmarks are converted where their file states the other one of LPS and RAS.
    median_mm, most_mm : float
        Limits of the scan's distance from the skin: the median, and what 95 % of its area keeps.
    progress : Progress, optional

    Returns
    -------
    FittedBody
        The fit with its distances in mm, and whether it is within its limits (``passed``).

    Raises
    ------
    InputError, MeshError, LandmarkError, NotConvergedError
        Files that cannot be read or written, a template that is not closed, a scan without surface or of another size
        by far, landmarks that do not match, or targets that the map cannot follow.
    """
    for name, limit in (("median_mm", median_mm), ("most_mm", most_mm)):
        if not limit > 0.0:
            raise InputError(f"{name}: found {limit:g}; expected a length above 0")
    if out is not None:
        require_new_folder(Path(out))
    unit, other = word(Unit, units, what="units"), word(Unit, scan_units, what="scan_units")
    with watched(progress) as stages:
        with stages.stage("read the surfaces"):
            tissue, findings = read_template(Path(template), unit)
            target, more = _scan(read_surface(Path(scan), units=other))
            surfaces = tissue.surface, target
            marks = _Landmarks() if landmarks is None else _landmarks(landmarks, (unit, other), frame, surfaces)
        with stages.stage("make the cage"):
            made = cage_around(tissue.surface, cage, vertices=vertices, unit=unit)
        fit = fitted(
            tissue.surface, made, target, rng=np.random.default_rng(0), landmarks=marks.places, progress=stages
        )
        result = FittedBody(
            fit,
            median_mm,
            most_mm,
            (*findings, *more, *marks.findings),
            None if out is None else Path(out),
        )
        if out is not None:
            files = [str(Path(template).resolve()), *anatomy]
            title = f"{Path(template).stem} fitted to {Path(scan).stem}"
            write_body_fit(Path(out), fit, title=title, anatomy=files, frame=frame, report=result.to_json())
    return result


def rig_of(folder: Path) -> Path:
    """The rig that a fit wrote."""
    return folder / RIG


def _scan(raw: RawSurface) -> tuple[TriMesh, tuple[Finding, ...]]:
    """The scan with vertices at one place made one, and without triangles that have no area."""
    mesh = raw.mesh()
    if not len(mesh.faces):
        raise MeshError(f"{raw.path}: has points and no triangles; make a surface of them first (3D Slicer, MeshLab)")
    vertices, numbers = np.unique(mesh.vertices, axis=0, return_inverse=True)
    joined = TriMesh(vertices, numbers.reshape(-1)[mesh.faces])
    flat = np.linalg.norm(area_vectors(joined), axis=1) <= 0.0
    found = list(raw.findings)
    name = raw.path.name
    if len(vertices) < len(mesh.vertices):
        more = len(mesh.vertices) - len(vertices)
        found.append(Finding(name, "merged-vertices", f"{name}: {more} vertices stood where another one is"))
    if flat.any():
        found.append(Finding(name, "zero-area", f"{name}: {int(flat.sum())} triangles without area were left out"))
    if flat.all():
        raise MeshError(f"{raw.path}: none of its {len(flat)} triangles has an area; export the scan again")
    return TriMesh(joined.vertices, joined.faces[~flat]), tuple(found)


def read_template(path: Path, unit: Unit) -> tuple[Tissue, tuple[Finding, ...]]:
    """A template's skin, taken in as every anatomy is, and what was noticed in its file."""
    raw = read_surface(path, units=unit)
    tissue, findings = take_in(
        raw.path.stem, TissueKind.SKIN, vertices=raw.vertices, faces=raw.faces, source=str(raw.path)
    )
    return tissue, (*raw.findings, *findings)


def cage_around(skin: TriMesh, given: str | Path | None, *, vertices: int, unit: Unit) -> TriMesh:
    """The cage of a file, or one that is made; MeshError where the file's format does not share vertices."""
    if given is None:
        return cage_of(skin, vertices=vertices)
    path = Path(given)
    if path.suffix.lower() == ".stl":
        raise MeshError(f"{path}: in STL every triangle has its own vertices; give the cage as PLY or OBJ")
    return read_surface(path, units=unit).mesh()


@dataclass(frozen=True, eq=False, slots=True)
class _Landmarks:
    """Places on the template and on the scan, (m, 3) each, mm, and what was found of them."""

    places: tuple[Points, Points] | None = None
    findings: tuple[Finding, ...] = ()


def _landmarks(
    files: tuple[str | Path, str | Path], units: tuple[Unit, Unit], frame: str, surfaces: tuple[TriMesh, TriMesh]
) -> _Landmarks:
    """Landmarks of template and scan by name; each lie on their own surface, so that their frames may differ."""
    own, more = in_frame(read_landmarks(files[0], units=units[0]), frame, of="template")
    scanned = read_landmarks(files[1], units=units[1])
    table = paired(*(replace(each, coordinate_system="", findings=()) for each in (own, scanned)))
    assert table.targets is not None  # paired tables have them
    places = table.positions, table.targets
    findings = [*more, *scanned.findings, *table.findings]
    for file, found, surface in zip(files, places, surfaces, strict=True):
        findings += off_surface_findings(table.names, found, surface, subject=Path(file).name)
    return _Landmarks(places, tuple(findings))
