"""A run's outside: tetrahedra from the cache, pictures, and everything written to one folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from musclefit.anatomy.joint_space import SlidingBones, without_joint_space
from musclefit.anatomy.mesh_rules import LayerRules
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.caches import default_cache_folder
from musclefit.figures.panels import Marks
from musclefit.figures.stills import stills
from musclefit.flow.bones import moving_together, poses_on_the_way
from musclefit.io.provenance import measured
from musclefit.io.run_folder import DeformedTets, write_run
from musclefit.meshing.cache import TetCache, TetPlan, default_limit_mb
from musclefit.pipeline.intermediate_states import states
from musclefit.pipeline.retarget import Outcome, Retargeting
from musclefit.progress import Progress, Silent
from musclefit.report.model import Report
from musclefit.rig.job import FurtherPoints, Job
from musclefit.rig.settings import TetSettings


def planned_tets(job: Job) -> TetPlan | None:
    """What `prepared_tets` will take, before it starts; None where the rig switches the tetrahedra off."""
    return _cache().plan(job.anatomy, layer_rules(job.rig.tets)) if job.rig.tets.enabled else None


def prepared_tets(job: Job, *, progress: Progress | None = None) -> TetAnatomy | None:
    """The anatomy's tetrahedra, from the cache or made now; None where the rig switches them off.

    Joint space between bones that the job holds rigid and slides past each other is left out.

    Raises
    ------
    InputError, MeshError
        The anatomy cannot be tetrahedralised.
    """
    settings = job.rig.tets
    if not settings.enabled:
        return None
    progress = progress or Silent()
    tets, _ = _cache().tetrahedralise(job.anatomy, layer_rules(settings), progress=progress)
    if not job.rig.bones.rigid or job.motions is None or not settings.joint_space_mm:
        return tets
    with progress.stage("joint space"):
        poses = poses_on_the_way(job.motions)
        sliding = SlidingBones(moving_together(job.anatomy, poses), poses)
        return without_joint_space(tets, sliding, zone_mm=settings.joint_space_mm)


def layer_rules(settings: TetSettings) -> LayerRules:
    """What the settings of a rig ask of a mesh."""
    return LayerRules(**{field.name: getattr(settings, field.name) for field in fields(LayerRules)})


def _cache() -> TetCache:
    return TetCache(default_cache_folder(), limit_mb=default_limit_mb())


def save(
    result: Retargeting,
    folder: str | Path,
    *,
    seconds: Mapping[str, float] | None = None,
    intermediate: bool = False,
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
    intermediate : bool
        Whether to write the surfaces after each stretch of the way too, to ``intermediate/01``, ...

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
            beside={
                title: (outcome.deformed, _marks(outcome))
                for title, outcome in (("One shot", result.baseline), ("Paper's loop", result.paper_loop))
                if outcome is not None
            },
            marks=_marks(result.result),
        )
    report = result.report
    report = replace(report, **measured(seconds or {}, provenance=report.provenance))
    tets, vertices = result.result.tets, result.result.tet_vertices
    write_run(
        Path(folder),
        report,
        rest=result.result.rest,
        deformed=result.result.deformed,
        tets=None if tets is None or vertices is None else DeformedTets(tets, vertices),
        pictures=drawn.pictures,
        pictures_problem=drawn.problem,
        points={file.name: partial(_moved_points, file, result) for file in result.job.further},
        states=states(result) if intermediate else (),
    )
    return report


def _moved_points(file: FurtherPoints, result: Retargeting, path: Path) -> None:
    """Write a file of further points where the result's map takes them."""
    file.rewrite(result.result.deformation(file.points), path)


def _marks(outcome: Outcome) -> Marks:
    where = outcome.deformed.slices()
    return Marks(determinants={name: outcome.determinants[part] for name, part in where.items()})
