"""One run, from a rig to a folder: read it, tetrahedra from the cache, deform and check, pictures, all written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from musclefit.anatomy.joint_space import SlidingBones, without_joint_space
from musclefit.anatomy.mesh_rules import LayerRules
from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.caches import default_cache_folder
from musclefit.figures.panels import Marks
from musclefit.figures.scenes import run_scene
from musclefit.figures.stills import Stills, stills
from musclefit.flow.bones import moving_together, poses_on_the_way
from musclefit.flow.deformation import Deformation
from musclefit.io.provenance import measured
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import DeformedTets, Maker, claimed, write_run
from musclefit.meshing.cache import CACHE_FINDING, TetCache, TetPlan, default_limit_mb
from musclefit.pipeline.comparisons import LOOP_MARCH
from musclefit.pipeline.intermediate_states import states
from musclefit.pipeline.retarget import Outcome, Retargeting, retarget
from musclefit.progress import CERTIFY, MARCH, Progress, Silent
from musclefit.report.model import Report
from musclefit.rig.job import AttachedPoints, Job
from musclefit.rig.off_bones import OFF_BONES
from musclefit.rig.settings import TetSettings
from musclefit.workflows.beside import Beside
from musclefit.workflows.compiling_ahead import compiled_ahead
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Judged

SHARES = (
    ("test the bones' way", 1.0),
    ("joint ranges", 2.0),
    (MARCH, 40.0),
    ("refine surfaces", 4.0),
    (CERTIFY, 25.0),
    ("check result", 18.0),
    ("check baseline", 1.0),
    (LOOP_MARCH, 1.0),
    ("check the paper's loop", 1.0),
    ("pictures", 6.0),
    ("3-D view", 1.0),
)
"""What part of the time each stage of a run with rigid bones takes, about."""

TOLD_BEFORE = (
    "cage-crossing",
    "frame-not-stated",
    "one-frame",
    "unmatched-landmarks",
    "averaged-frames",
    "lost-marker",
    "markups-passed-over",
    "assumed-frame",
    "half-turn",
    "points-outside-skin",
    OFF_BONES,
)
"""Findings that are told before the long work; the report lists them all."""


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Run(Judged):
    """A run that is done.

    Parameters
    ----------
    made : Retargeting
        Result and what it is compared with: maps, surfaces, tetrahedra.
    report : Report
        As in report.json.
    folder : Path or None
        Where it was written.
    """

    made: Retargeting
    report: Report
    folder: Path | None = None

    @property
    def job(self) -> Job:
        """The rig with all that its files hold."""
        return self.made.job

    @property
    def deformation(self) -> Deformation:
        """The map: takes (N, 3) points in mm, gives where they go; with Jacobian and inverse."""
        return self.made.result.deformation

    @property
    def rest(self) -> Anatomy:
        """The tissues before, on the triangles of ``deformed``."""
        return self.made.result.rest

    @property
    def deformed(self) -> Anatomy:
        """The tissues after."""
        return self.made.result.deformed

    @property
    def tets(self) -> DeformedTets | None:
        """The tetrahedra at rest and where their vertices go; None where none were made."""
        tets, vertices = self.made.result.tets, self.made.result.tet_vertices
        return None if tets is None or vertices is None else DeformedTets(tets, vertices)

    def said(self) -> str:
        """Verdict, claims and size in a line."""
        side = self.report.result
        mesh = "none" if side.mesh is None else side.mesh.claim.value
        return (
            f"{self.report.title}: {self.report.verdict}; map {side.map.claim.value}, mesh {mesh}; {side.steps} steps, "
            f"{len(side.tissues)} tissues" + (f"; in {self.folder}" if self.folder is not None else "")
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Checks, tissues, overlapping pairs and findings."""
        side = self.report.result
        return {
            "checks": self.report.checks,
            "tissues": side.tissues,
            "overlaps": side.overlaps.pairs,
            "findings": self.report.findings,
        }

    def plot(self) -> Any:
        """A pyvista plotter with the tissues before and after, side by side: call its ``show``."""
        from musclefit.workflows.view import side_by_side

        return side_by_side(self.rest, self.deformed)


def run(
    rig: RigGiven,
    *,
    out: str | Path | None = None,
    overrides: Sequence[str] = (),
    points: Sequence[str | Path] = (),
    tets: bool | None = None,
    intermediate: bool = False,
    pictures: bool = True,
    progress: Progress | None = None,
) -> Run:
    """Run a rig: deform its anatomy, check the result, write surfaces, tetrahedra and report.

    Parameters
    ----------
    rig : str, path or mapping
        The name of a built-in rig, a rig file, or what such a file would hold, with paths that start at the current
        folder.
    out : path, optional
        Folder for the results, as `musclefit run` writes them; a former run there is replaced. Without it nothing is
        written.
    overrides : sequence of str
        ``key=value`` each, such as ``"drive.pose.elbow_deg=60"``.
    points : sequence of path
        Files of attached points to deform too.
    tets : bool, optional
        Whether to make tetrahedra, whatever the rig says.
    intermediate : bool
        Whether to write the surfaces after each step too.
    pictures : bool
        Whether to draw what is written.
    progress : Progress, optional
        Told how far the work is; without it that is shown on terminals and in notebooks.

    Returns
    -------
    Run

    Raises
    ------
    RigError, LandmarkError, MeshError, InputError
        Input that cannot be used, before long work; the message names it, the value found and the way out.
    """
    with claimed(None if out is None else Path(out), by=Maker.RUN):
        overrides = (*overrides, *([] if tets is None else [f"tets.enabled={str(tets).lower()}"]))
        with watched(progress, shares=SHARES) as stages:
            job = read_rig(rig, overrides=overrides, points=[Path(path) for path in points], progress=stages)
            for finding in job.findings:
                if finding.code in TOLD_BEFORE:
                    stages.say(finding.message)
            plan = planned_tets(job)
            if plan is not None:
                stages.say(plan.in_words)

            def fill(progress: Progress) -> TetAnatomy | None:
                tets = prepared_tets(job, progress=progress)
                for finding in tets.findings if tets is not None else ():
                    if finding.code == CACHE_FINDING:
                        stages.say(finding.message)
                return tets

            beside = Beside(fill, progress=stages.in_another_thread(), waiting=stages)
            with compiled_ahead(job), beside as tets_beside:
                made = retarget(job, tets=tets_beside, progress=tets_beside.while_well(stages))
            if out is None:
                known = measured(stages.seconds, provenance=made.report.provenance)
                return Run(made, replace(made.report, **known))
            report = save(
                made, out, seconds=stages.seconds, intermediate=intermediate, pictures=pictures, progress=stages
            )
    return Run(made, report, Path(out))


def planned_tets(job: Job) -> TetPlan | None:
    """What `prepared_tets` will take, before it starts; None where the rig switches the tetrahedra off."""
    return _cache().plan(job.anatomy, layer_rules(job.rig.tets)) if job.rig.tets.enabled else None


def prepared_tets(job: Job, *, progress: Progress | None = None) -> TetAnatomy | None:
    """The anatomy's tetrahedra, from the cache or made now; None where the rig switches them off.

    Joint space between bones that the job holds rigid and slides past each other is left out.

    Parameters
    ----------
    job : Job
    progress : Progress, optional

    Returns
    -------
    TetAnatomy or None

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
    pictures: bool = True,
    progress: Progress | None = None,
) -> Report:
    """Write a run whole: report.json, report.html, surfaces, tetrahedra, pictures.

    Parameters
    ----------
    result : Retargeting
    folder : path
        Made, or a former run of ours to replace.
    seconds : mapping of stage to seconds, optional
        As measured by the caller; read when the pictures are done.
    intermediate : bool
        Whether to write the surfaces after each step too, to ``intermediate/01``, ...
    pictures : bool
        Whether to draw it, which takes seconds.

    Returns
    -------
    Report
        The same numbers as in report.json.

    Raises
    ------
    InputError
        The folder holds something else, or cannot be written.
    """
    progress = progress or Silent()
    drawn = _drawn(result, progress) if pictures else Stills(problem="Pictures were not asked for.")
    with progress.stage("3-D view"):
        scene = run_scene(result)
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
        scene=scene,
        points={file.name: partial(_moved_points, file, result) for file in result.job.further},
        states=states(result) if intermediate else (),
    )
    return report


def _drawn(result: Retargeting, progress: Progress) -> Stills:
    with progress.stage("pictures"):
        return stills(
            result.job.anatomy,
            result.result.deformed,
            beside={
                title: (outcome.deformed, _marks(outcome))
                for title, outcome in (("One shot", result.baseline), ("Paper's loop", result.paper_loop))
                if outcome is not None
            },
            marks=_marks(result.result),
        )


def _moved_points(file: AttachedPoints, result: Retargeting, path: Path) -> None:
    """Write a file of attached points where the result's map takes them."""
    file.rewrite(result.result.deformation(file.points), path)


def _marks(outcome: Outcome) -> Marks:
    where = outcome.deformed.slices()
    return Marks(determinants={name: outcome.determinants[part] for name, part in where.items()})
