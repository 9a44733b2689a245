"""Muscle architecture of a rig: attachments, fibres and their numbers at rest, and carried by the rig's own map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from musclefit._version import __version__
from musclefit.anatomy.model import Tissue, TissueKind
from musclefit.caches import default_cache_folder
from musclefit.errors import InputError, MeshError
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Points
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.attachments import read_attachments
from musclefit.io.formats.fibre_directions import FIBRES, HeldArea, MuscleFibres, fibre_bytes
from musclefit.io.formats.rows import csv_text
from musclefit.io.formats.vtk_lines import vtk_lines
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import Maker, claimed, write_surfaces
from musclefit.meshing.cache import TetCache, default_limit_mb
from musclefit.meshing.muscle_tets import muscle_tets
from musclefit.muscles.attachments import MuscleEnds, find_ends, usual_distance_mm
from musclefit.muscles.fibres import FibreField, laplace_fibres
from musclefit.muscles.measures import (
    Belly,
    CarriedDirections,
    CarriedMuscle,
    MuscleArchitecture,
    belly_of,
    measure_at_rest,
    measure_carried,
)
from musclefit.muscles.moment_arms import MomentArm, moment_arms
from musclefit.muscles.motion_curves import MotionState, MovingMuscle, motion_curves
from musclefit.muscles.streamlines import Streamlines, streamlines
from musclefit.pipeline.poses import bones_of, refuse_collision
from musclefit.pipeline.refining import deform_finely
from musclefit.progress import Progress
from musclefit.rig.job import Job
from musclefit.rig.joints import JointMotions
from musclefit.rig.paths import KeyframeMotions
from musclefit.rig.table_reader import suggestion
from musclefit.workflows.given import RigGiven, rig_given
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown
from musclefit.workflows.run import Run

LINES = 200
"""Streamlines of each muscle."""

SCHEMA_VERSION = "1.0"

ENVELOPES = 2.0
"""Vertices of a muscle's tetrahedra within so many envelopes of an attachment belong to it."""


@dataclass(frozen=True, eq=False, slots=True)
class FibredMuscle:
    """One muscle with its fibres.

    Parameters
    ----------
    ends : MuscleEnds
    field : FibreField
        Directions in the muscle's own tetrahedra at rest.
    lines : Streamlines
        At rest.
    belly : Belly
    carried_points : (p, 3) float64 or None
        Where the map takes the points of all lines, mm; None where nothing was deformed.
    carried : CarriedDirections or None
        The directions of the field after the map, in the middles of the tetrahedra that have one.
    """

    ends: MuscleEnds
    field: FibreField
    lines: Streamlines
    belly: Belly
    carried_points: Points | None = None
    carried: CarriedDirections | None = None


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Architecture(Shown):
    """Attachments, fibres and moment arms of a rig's muscles.

    Parameters
    ----------
    title : str
    within_mm : float
        How close a muscle is to the bone it holds on to.
    ends : tuple of MuscleEnds
    muscles : tuple of MuscleArchitecture
        At rest.
    carried : tuple of CarriedMuscle
        After the rig's map; empty where nothing was deformed.
    moment_arms : tuple of MomentArm
        In the rig's pose; empty where no joint drives.
    fibred : mapping of name to FibredMuscle
    left_out : mapping of name to str
        Muscles without fibres, and why.
    claim : str
        What is known of the map.
    curves : tuple of MotionState
        Each muscle after each stretch of the way; empty where they were not asked for.
    folder : Path or None
        Where it was written.
    """

    title: str
    within_mm: float
    ends: tuple[MuscleEnds, ...]
    muscles: tuple[MuscleArchitecture, ...]
    carried: tuple[CarriedMuscle, ...]
    moment_arms: tuple[MomentArm, ...]
    fibred: Mapping[str, FibredMuscle]
    left_out: Mapping[str, str]
    claim: str
    curves: tuple[MotionState, ...] = ()
    folder: Path | None = None

    @property
    def without_two_attachments(self) -> tuple[str, ...]:
        """Muscles of which an end is on no bone."""
        return tuple(ends.muscle for ends in self.ends if not ends.attached)

    def said(self) -> str:
        """How many muscles have what, in a line."""
        return (
            f"{self.title}: fibres in {len(self.muscles)} of {len(self.ends)} muscles, two attachments on bone in "
            f"{len(self.ends) - len(self.without_two_attachments)}" + (f"; in {self.folder}" if self.folder else "")
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Muscles at rest, carried muscles, attachments and moment arms."""
        return {
            "muscles": self.muscles,
            "carried": self.carried,
            "attachments": _attachment_rows(self.ends),
            "moment_arms": self.moment_arms,
            "curves": _curve_rows(self.curves),
        }

    def to_json(self) -> dict[str, Any]:
        """All but meshes and lines; None stands for what is not a finite number."""
        rows = {name: [_row(record) for record in records] for name, records in self.tables().items()}
        return {
            "schema_version": SCHEMA_VERSION,
            "musclefit_version": __version__,
            "title": self.title,
            "claim": self.claim,
            "within_mm": self.within_mm,
            "without_two_attachments": list(self.without_two_attachments),
            "without_fibres": dict(self.left_out),
            **rows,
        }


def architecture(
    rig: RigGiven | Run,
    *,
    out: str | Path | None = None,
    overrides: Sequence[str] = (),
    attachments: str | Path | None = None,
    within_mm: float | None = None,
    muscles: Sequence[str] = (),
    deform: bool = True,
    curves: bool = False,
    progress: Progress | None = None,
) -> Architecture:
    """Find where muscles hold on to bone and how their fibres run, and carry both by the rig's map.

    Parameters
    ----------
    rig : str, path, mapping or Run
        See `musclefit.run`; of a finished run, its own map is taken, with what is proved of it.
    out : path, optional
        Folder for tables and fibres; a former one there is replaced. Without it nothing is written.
    overrides : sequence of str
        ``key=value`` each; not with a finished run.
    attachments : path, optional
        CSV of ends that are known (`io.formats.attachments`); all others are found by distance.
    within_mm : float, optional
        How close a muscle is to the bone it holds on to; chosen from clearances and thicknesses without it.
    muscles : sequence of str
        Names or shell-style patterns of the muscles to look at; all without any.
    deform : bool
        Whether to deform at all, or to stay at rest.
    curves : bool
        Whether to measure the fibres after each stretch of the way, and their moment arms by the joint that turns.
    progress : Progress, optional

    Raises
    ------
    RigError, LandmarkError, MeshError, InputError
        Input that cannot be used, before long work; or another process writes into the folder.
    NotConvergedError
        The rig does not reach its pose, so that there is no map to carry by.
    """
    folder = None if out is None else Path(out)
    with claimed(folder, by=Maker.ARCHITECTURE):
        if within_mm is not None and not 0.0 < within_mm < np.inf:
            raise InputError(f"within_mm: found {within_mm}; expected a finite length above 0, mm")
        if curves and not deform:
            raise InputError("curves need a motion; found that nothing is to be deformed: leave out one of the two")
        stated = () if attachments is None else read_attachments(attachments)
        with watched(progress) as stages:
            job = rig.job if isinstance(rig, Run) else read_rig(rig_given(rig), overrides=overrides, progress=stages)
            motions = {} if job.motions is None else dict(job.motions.at(1.0))
            with stages.stage("attachments"):
                wanted = _wanted(job, muscles)
                within = usual_distance_mm(job.anatomy) if within_mm is None else within_mm
                ends = find_ends(job.anatomy, within_mm=within, stated=stated, travel=_travel(job, motions))
                ends = tuple(one for one in ends if one.muscle in wanted)
            deformation = _map_of(rig, job, progress=stages) if deform else None
            fibred, left_out, whole = _fibres(job, ends, progress=stages)
            at_rest = tuple(
                measure_at_rest(
                    job.anatomy[name].surface, one.ends, one.field, one.lines, belly=one.belly, pieces=p, missed_mm=m
                )
                for (name, one), (p, m) in zip(fibred.items(), whole, strict=True)
            )
            carried = () if deformation is None else _carry(job, fibred, deformation, motions, progress=stages)
            states: tuple[MotionState, ...] = ()
            if curves and deformation is not None:
                with stages.stage("curves"):
                    states = _curves(job, fibred, deformation)
        arms: tuple[MomentArm, ...] = ()
        if job.joints is not None:
            arms = moment_arms(ends, job.joints, pose=dict(job.pose), coordinates=[name for name, _ in job.pose])
        found = Architecture(
            title=job.title,
            within_mm=within,
            ends=ends,
            muscles=at_rest,
            carried=carried,
            moment_arms=arms,
            fibred=fibred,
            left_out=left_out,
            claim=_claim(rig, deformed=deformation is not None),
            curves=states,
            folder=folder,
        )
        if folder is not None:
            _write(found, folder)
    return found


def _carry(
    job: Job,
    fibred: dict[str, FibredMuscle],
    deformation: Deformation,
    motions: Mapping[str, RigidMotion],
    *,
    progress: Progress,
) -> tuple[CarriedMuscle, ...]:
    """The muscles' numbers after the map; ``fibred`` gets where it takes their lines."""
    carried = []
    with progress.stage("carry fibres") as tick:
        for done, (name, one) in enumerate(fibred.items(), start=1):
            row, fibres, points = measure_carried(
                job.anatomy[name].surface,
                one.ends,
                one.field,
                one.lines,
                belly=one.belly,
                mapped=deformation.with_jacobian,
                placed=deformation,
                motions=motions,
            )
            carried.append(row)
            fibred[name] = replace(one, carried_points=points, carried=fibres)
            tick(done / len(fibred))
    return tuple(carried)


def _curves(job: Job, fibred: Mapping[str, FibredMuscle], deformation: Deformation) -> tuple[MotionState, ...]:
    moving = [MovingMuscle(one.ends, job.anatomy[name].surface, one.lines, one.belly) for name, one in fibred.items()]
    stretches = list(deformation.by_stretch())
    moments = [0.0, *(end for _, end, _ in stretches)]
    angles = (
        {t: job.motions.pose_at(t) for t in moments} if isinstance(job.motions, (JointMotions, KeyframeMotions)) else {}
    )
    return motion_curves(moving, stretches, angles_at=angles)


def _curve_rows(curves: Sequence[MotionState]) -> list[dict[str, Any]]:
    """A row for each state, the joints' angles in columns of their own."""
    rows = []
    for state in curves:
        row = asdict(state)
        angles = row.pop("angles_deg")
        rows.append(
            {"muscle": row.pop("muscle"), "at": row.pop("at"), **{f"{k}_deg": v for k, v in angles.items()}, **row}
        )
    return rows


def _fibres(
    job: Job, ends: Sequence[MuscleEnds], *, progress: Progress
) -> tuple[dict[str, FibredMuscle], dict[str, str], list[tuple[int, float]]]:
    """The muscles with fibres, those without and why, and of the former the pieces and what is missing of them."""
    cache = TetCache(default_cache_folder(), limit_mb=default_limit_mb())
    fibred: dict[str, FibredMuscle] = {}
    left_out: dict[str, str] = {}
    whole: list[tuple[int, float]] = []
    with progress.stage("fibres") as tick:
        for done, one in enumerate(ends, start=1):
            muscle: Tissue = job.anatomy[one.muscle]
            try:
                tets = muscle_tets(muscle, cache, progress=progress)
                field = laplace_fibres(
                    tets.mesh,
                    origin=one.origin.surface,
                    insertion=one.insertion.surface,
                    within_mm=ENVELOPES * tets.envelope_mm,
                )
                lines = streamlines(field, count=LINES)
                fibred[one.muscle] = FibredMuscle(one, field, lines, belly_of(muscle.surface))
                whole.append((tets.pieces, tets.missed_mm))
            except MeshError as error:
                left_out[one.muscle] = str(error)
            tick(done / len(ends))
    return fibred, left_out, whole


def _wanted(job: Job, patterns: Sequence[str]) -> frozenset[str]:
    """Names of the muscles that fit any of the patterns; InputError at a pattern that none fits."""
    names = [muscle.name for muscle in job.anatomy.of_kind(TissueKind.MUSCLE)]
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise InputError(f"no muscle fits {pattern!r}; {suggestion(pattern, names)}")
    return frozenset(n for n in names if not patterns or any(fnmatchcase(n, pattern) for pattern in patterns))


def _map_of(rig: RigGiven | Run, job: Job, *, progress: Progress) -> Deformation:
    if isinstance(rig, Run):
        return rig.deformation
    if job.rig.bones.rigid:
        refuse_collision(job, bones_of(job))
    return deform_finely(job, progress=progress).deformed.deformation.require()


def _travel(job: Job, motions: Mapping[str, RigidMotion]) -> Mapping[str, float]:
    """How far each bone's vertices move in the mean, mm, to a thousandth."""
    return {
        bone.name: round(
            float(np.linalg.norm(motions[bone.name](bone.surface.vertices) - bone.surface.vertices, axis=1).mean()),
            3,
        )
        for bone in job.anatomy.of_kind(TissueKind.BONE)
        if bone.name in motions
    }


def _claim(rig: RigGiven | Run, *, deformed: bool) -> str:
    if not deformed:
        return "at rest"
    if isinstance(rig, Run):
        return f"map {rig.report.result.map.claim.value}"
    return "map sampled: its rule held at every tested point; `musclefit run` tries to prove it"


def _attachment_rows(ends: Sequence[MuscleEnds]) -> list[dict[str, Any]]:
    return [
        {
            "muscle": one.muscle,
            "end": end.value,
            "bone": at.bone,
            "area_mm2": at.area_mm2,
            "x_mm": float(at.centroid_mm[0]),
            "y_mm": float(at.centroid_mm[1]),
            "z_mm": float(at.centroid_mm[2]),
            "distance_mm": None if np.isnan(at.distance_mm) else at.distance_mm,
            "reason": at.reason,
            "also_touches": "; ".join(f"{bone} {area:.0f} mm2" for bone, area in one.touched),
        }
        for one in ends
        for end, at in one.ends
    ]


def _write(found: Architecture, folder: Path) -> None:
    report = found.to_json()
    headings = {
        "attachments": list(report["attachments"][0]) if report["attachments"] else [],
        "muscles": [field.name for field in fields(MuscleArchitecture)],
        "carried": [field.name for field in fields(CarriedMuscle)],
        "moment_arms": [field.name for field in fields(MomentArm)],
    }
    if report["curves"]:
        headings["curves"] = list(report["curves"][0])
    files = {
        f"{name}.csv": csv_text([h, *(row.values() for row in report[name])]).encode() for name, h in headings.items()
    }
    files[FIBRES] = fibre_bytes({name: _stored(one) for name, one in found.fibred.items()})
    files["fibres.vtk"] = _fibres_vtk(found, carried=False)
    if found.carried:
        files["fibres_carried.vtk"] = _fibres_vtk(found, carried=True)
    write_surfaces(folder, files, report=report, by=Maker.ARCHITECTURE)


def _stored(one: FibredMuscle) -> MuscleFibres:
    """The directions in the middles of the tetrahedra that have one, at rest and carried, and the areas on bone."""
    places, directions = one.field.placed_directions()
    held = tuple(HeldArea(at.bone, at.surface) for _, at in one.ends.ends if at.bone)
    if one.carried is None:
        return MuscleFibres(places, directions, held)
    along = one.carried.stretch[:, None] * one.carried.directions
    return MuscleFibres(places, directions, held, one.carried.places, along)


def _fibres_vtk(found: Architecture, *, carried: bool) -> bytes:
    lines: list[Points] = []
    numbers: list[int] = []
    for number, one in enumerate(found.fibred.values()):
        points = list(one.lines.points)
        if carried and one.carried_points is not None:
            points = np.split(one.carried_points, np.cumsum([len(line) for line in points])[:-1])
        lines += points
        numbers += [number] * len(points)
    names = ", ".join(f"{number} {name}" for number, name in enumerate(found.fibred))
    return vtk_lines(lines, title=f"fibres in mm; muscles: {names}", line_data={"muscle": np.array(numbers, float)})


def _row(record: Any) -> dict[str, Any]:
    """A record, or a mapping, with None for what is not a finite number."""
    values = asdict(record) if is_dataclass(record) and not isinstance(record, type) else dict(record)
    return {key: None if isinstance(v, float) and not np.isfinite(v) else v for key, v in values.items()}
