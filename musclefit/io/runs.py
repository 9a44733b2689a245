"""A run's outside: tetrahedra from the cache, pictures, and everything written to one folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.figures.panels import Marks
from musclefit.figures.stills import stills
from musclefit.io.outputs import DeformedTets, write_run
from musclefit.io.provenance import measured
from musclefit.io.tet_cache import TetCache, default_cache_folder
from musclefit.pipeline.retarget import Outcome, Retargeting
from musclefit.progress import Progress, Silent
from musclefit.report.model import Report
from musclefit.rig.job import FurtherPoints, Job


def prepared_tets(job: Job, *, progress: Progress | None = None) -> TetAnatomy | None:
    """The anatomy's tetrahedra, from the cache or made now; None where the rig switches them off.

    Raises
    ------
    InputError, MeshError
        The anatomy cannot be tetrahedralised.
    """
    if not job.rig.tets.enabled:
        return None
    cache = TetCache(default_cache_folder())
    tets, _ = cache.tetrahedralise(job.anatomy, job.rig.tets, progress=progress or Silent())
    return tets


def save(
    result: Retargeting,
    folder: str | Path,
    *,
    seconds: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Report:
    """Write a run whole: report.json, report.html, surfaces, tetrahedra, pictures.

    Parameters
    ----------
    result : Retargeting
    folder : path
        Made, or a former run of ours to replace.
    seconds : mapping of stage to seconds, optional
        As measured by who ran it; read when the pictures are done.

    Returns
    -------
    Report
        The same numbers as in report.json.

    Raises
    ------
    InputError
        The folder holds something else, or cannot be written.
    """
    with (progress or Silent()).stage("pictures"):
        drawn = stills(
            result.job.anatomy,
            result.result.deformed,
            baseline=result.baseline.deformed,
            marks=_marks(result.result),
            baseline_marks=_marks(result.baseline),
        )
    report = result.report
    report = replace(report, **measured(seconds or {}, provenance=report.provenance))
    vertices = result.result.tet_vertices
    write_run(
        Path(folder),
        report,
        rest=result.result.rest,
        deformed=result.result.deformed,
        tets=None if result.tets is None or vertices is None else DeformedTets(result.tets, vertices),
        pictures=drawn.pictures,
        pictures_problem=drawn.problem,
        points={file.name: partial(_moved_points, file, result) for file in result.job.further},
    )
    return report


def _moved_points(file: FurtherPoints, result: Retargeting, path: Path) -> None:
    """Write a file of further points where the result's map takes them."""
    file.rewrite(result.result.deformation(file.points), path)


def _marks(outcome: Outcome) -> Marks:
    where = outcome.deformed.slices()
    return Marks(determinants={name: outcome.determinants[part] for name, part in where.items()})
