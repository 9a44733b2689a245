"""A finished run, read back from its folder: its report, and its surfaces at rest and deformed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.io.formats.tables import parse_json
from musclefit.io.formats.texts import read_bytes
from musclefit.io.formats.vtk_xml import VtkFile
from musclefit.io.run_folder import REPORT_JSON
from musclefit.report.model import SCHEMA_VERSION
from musclefit.report.reading import wrong_in_run_report

_KEYS = ("title", "verdict", "status", "method", "map", "tissues", "overlaps", "checks", "limits", "provenance")
"""What every report of a run has."""


@dataclass(frozen=True, eq=False, slots=True)
class FinishedRun:
    """A run that was written.

    Parameters
    ----------
    folder : Path
    report : mapping
        As report.json holds it.
    """

    folder: Path
    report: Mapping[str, Any]

    @property
    def title(self) -> str:
        """The title of the run."""
        return str(self.report["title"])

    def surfaces(self) -> tuple[Anatomy, Anatomy]:
        """The tissues at rest and deformed, on the same triangles, mm.

        Raises
        ------
        InputError, MeshError
            A surface is missing or not as a run writes it.
        """
        kinds = {tissue["name"]: tissue["kind"] for tissue in self.report["tissues"]}
        frame = str(self.report["provenance"]["settings"]["anatomy"]["frame"])
        rest, deformed = [], []
        for told in self.report.get("surfaces", ()):
            if told["name"] not in kinds:
                raise InputError(
                    f"{self.folder / REPORT_JSON} names a surface of {told['name']!r}, which is no tissue of it; run "
                    "the rig again"
                )
            before, after = _surface(self._inside(str(told["vtp"])))
            kind = TissueKind(kinds[told["name"]])
            rest.append(Tissue(told["name"], kind, before))
            deformed.append(Tissue(told["name"], kind, after))
        return Anatomy(tuple(rest), frame), Anatomy(tuple(deformed), frame)

    def _inside(self, name: str) -> Path:
        """A file of the run; a report may name none outside of its folder."""
        path = self.folder / name
        try:
            inside, there = path.resolve().is_relative_to(self.folder.resolve()), path.is_file()
        except (OSError, ValueError):  # too long, or with characters that no name may have
            inside = there = False
        if not inside:
            raise InputError(
                f"{self.folder / REPORT_JSON} names {name!r}, which is not in its folder; run the rig again"
            )
        if not there:
            raise InputError(f"{path} is missing, though {REPORT_JSON} names it; run the rig again")
        return path


def read_finished_run(folder: str | Path) -> FinishedRun:
    """Read the report of a run.

    Parameters
    ----------
    folder : path
        That `musclefit run` wrote, or report.json in it.

    Raises
    ------
    InputError
        The folder holds no report, or that of another command or version.
    """
    place = Path(folder)
    place = place.parent if place.name == REPORT_JSON and place.is_file() else place
    path = place / REPORT_JSON
    if not path.is_file():
        what = "holds" if place.is_dir() else "is not a folder that holds"
        raise InputError(f"{place} {what} no {REPORT_JSON}; name a folder that musclefit run wrote")
    report = parse_json(read_bytes(path), source=str(path))
    if not isinstance(report, dict) or "baseline" not in report or any(key not in report for key in _KEYS):
        raise InputError(f"{path} is not the report of a run; name a folder that musclefit run wrote")
    if report.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path}: found schema version {report.get('schema_version')!r}; expected {SCHEMA_VERSION}: run the rig "
            "again with this version of musclefit"
        )
    problem = wrong_in_run_report(report)
    if problem:
        raise InputError(f"{path} is not as a run writes it ({problem}); run the rig again")
    return FinishedRun(place, report)


def _surface(path: Path) -> tuple[TriMesh, TriMesh]:
    """The surface of a file at rest and deformed."""
    file = VtkFile(read_bytes(path), str(path), kind="PolyData")
    polys = file.cells("Polys", count="NumberOfPolys")
    rest = file.point_data("rest_position_mm", components=3)
    if rest is None or (polys.sizes != 3).any():
        raise InputError(f"{path} is not as a run writes it (triangles with positions at rest); run the rig again")
    faces = polys.corners.reshape(-1, 3)
    return TriMesh(np.asarray(rest, dtype=np.float64), faces), TriMesh(file.points(), faces)
