"""Muscle architecture of a rig: attachments, fibres and their numbers at rest, and carried by the rig's own map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from musclefit._version import __version__
from musclefit.anatomy.model import Tissue, TissueKind
from musclefit.caches import default_cache_folder
from musclefit.errors import InputError, MeshError
from musclefit.flow.close_places import moved_together, with_jacobian_together
from musclefit.flow.deformation import Deformation
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.sections import Lengthwise
from musclefit.io.formats.attachments import read_attachments
from musclefit.io.formats.fibre_directions import FIBRES, HeldArea, MuscleFibres, fibre_bytes
from musclefit.io.formats.rows import csv_text
from musclefit.io.formats.vtk_lines import vtk_lines
from musclefit.io.given_fibres import FibreFiles, read_given_fibres
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import REPORT_HTML, Maker, claimed, write_surfaces
from musclefit.meshing.cache import TetCache, default_limit_mb
from musclefit.meshing.muscle_tets import MuscleTets, muscle_tets
from musclefit.muscles.attachments import MuscleEnds, find_ends, usual_distance_mm
from musclefit.muscles.fibres import FibreField, laplace_fibres, sheet_fibres
from musclefit.muscles.given_fibres import (
    FibreUse,
    KnownFibres,
    NearbyDirections,
    by_muscle,
    followed_lines,
    known_field,
    known_lines,
    usual_reach_mm,
)
from musclefit.muscles.measures import (
    Belly,
    CarriedDirections,
    CarriedMuscle,
    Lines,
    MuscleArchitecture,
    belly_of,
    measure_at_rest,
    measure_carried,
)
from musclefit.muscles.moment_arms import MomentArm, moment_arms
from musclefit.muscles.motion_curves import MotionState, MovingMuscle, motion_curves
from musclefit.muscles.streamlines import Streamlines, step_length_mm, streamlines
from musclefit.pipeline.poses import bones_of, refuse_collision
from musclefit.pipeline.refining import deform_finely
from musclefit.progress import Progress
from musclefit.report.architecture_html import render_architecture
from musclefit.rig.job import Job
from musclefit.rig.joints import JointMotions
from musclefit.rig.paths import KeyframeMotions
from musclefit.rig.table_reader import suggestion
from musclefit.worker_processes import usable_processors
from musclefit.workflows.beside import at_once
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown
from musclefit.workflows.run import Run

LINES = 200
"""Streamlines of each muscle."""

MESHED_AT_ONCE = 4
"""Muscles at most, each in a process that takes up to a quarter of a GB."""

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
    carried_lines : tuple of (p, 3) float64
        Where the map takes the lines, mm, by some of their points (`measures.Lines.carried`); empty where nothing was
        deformed.
    pieces : int
        Of the tetrahedra, joined by faces.
    loose_share : float
        Share of their volume in pieces beside the largest.
    missed_mm : float
        How far a place of the surface is from them, at most.
    widened_mm3 : float
        What was added to the surface where its necks are too thin for tetrahedra that hang together.
    source : str
        The files that the fibres are from; empty where they are from the flow.
    data_share : float or None
        In what share of the volume those tell a direction.
    carried : CarriedDirections or None
        The directions of the field after the map, in the middles of the tetrahedra that have one.
    """

    ends: MuscleEnds
    field: FibreField
    lines: Streamlines
    belly: Belly
    pieces: int
    loose_share: float
    missed_mm: float
    widened_mm3: float = 0.0
    source: str = ""
    data_share: float | None = None
    carried_lines: tuple[Points, ...] = ()
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
    fibre_files : tuple of FibreUse
        What became of each file of fibres.
    notes : tuple of str
        What had to be taken for granted of them.
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
    fibre_files: tuple[FibreUse, ...] = ()
    notes: tuple[str, ...] = ()
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
            "fibre_files": self.fibre_files,
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
            "notes": list(self.notes),
            **rows,
        }


def architecture(
    rig: RigGiven | Run,
    *,
    out: str | Path | None = None,
    overrides: Sequence[str] = (),
    attachments: str | Path | None = None,
    within_mm: float | None = None,
    fibres: str | Path | FibreFiles | None = None,
    muscles: Sequence[str] = (),
    deform: bool = True,
    curves: bool = False,
    progress: Progress | None = None,
) -> Architecture:
    """Find where muscles attach to bone and how their fibres run, and map both by the rig's deformation.

    Parameters
    ----------
    rig : str, path, mapping or Run
        See `musclefit.run`; of a finished run, its own map is taken, with what is proved of it.
    out : path, optional
        Folder for tables and fibres; a former one there is replaced. Without it nothing is written.
    overrides : sequence of str
        ``key=value`` each; not with a finished run.
    attachments : path, optional
        CSV of known attachments (`io.formats.attachments`); all others are found by distance.
    within_mm : float, optional
        Largest distance of an attachment from its bone; without it, chosen from clearances and thicknesses.
    fibres : path or FibreFiles, optional
        Known streamlines or directions (`io.given_fibres`); they replace the flow in the muscles that contain them.
    muscles : sequence of str
        Names or shell-style patterns of the muscles to analyse; empty for all.
    deform : bool
        Whether to deform the anatomy, or to analyse it at rest only.
    curves : bool
        Whether to measure fibres after each substep too, and their moment arms about the joint that turns.
    progress : Progress, optional

    Returns
    -------
    Architecture
        Attachments, fibres and moment arms; its ``carried`` is empty where nothing is deformed.

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
        with watched(progress) as stages:
            job = rig.job if isinstance(rig, Run) else read_rig(rig, overrides=overrides, progress=stages)
            tissues = {tissue.name: tissue.surface for tissue in job.anatomy}
            stated = () if attachments is None else read_attachments(attachments, tissues=tissues)
            motions = {} if job.motions is None else dict(job.motions.at(1.0))
            with stages.stage("attachments"):
                wanted = _wanted(job, muscles)
                needed = [m for m in job.anatomy.of_kind(TissueKind.MUSCLE) if within_mm is None or m.name in wanted]
                lengths = {muscle.name: Lengthwise.of(muscle.surface) for muscle in needed}
                within = usual_distance_mm(job.anatomy, lengthwise=lengths) if within_mm is None else within_mm
                travel = _travel(job, motions)
                ends = find_ends(
                    job.anatomy, within_mm=within, stated=stated, travel=travel, lengthwise=lengths, muscles=wanted
                )
            known, uses, notes = _known(job, fibres)
            deformation = _map_of(rig, job, progress=stages) if deform else None
            reach = fibres.reach_mm if isinstance(fibres, FibreFiles) else None
            fibred, left_out = _fibres(job, ends, known, lengths, within_mm=within, reach_mm=reach, progress=stages)
            at_rest = tuple(_measured(job, one) for one in fibred.values())
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
            fibre_files=uses,
            notes=notes,
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
            row, fibres, lines = measure_carried(
                job.anatomy[name].surface,
                one.ends,
                one.field,
                one.lines,
                belly=one.belly,
                mapped=partial(with_jacobian_together, deformation),
                placed=partial(moved_together, deformation),
                motions=motions,
            )
            carried.append(row)
            fibred[name] = replace(one, carried_lines=tuple(lines), carried=fibres)
            tick(done / len(fibred))
    return tuple(carried)


def _curves(job: Job, fibred: Mapping[str, FibredMuscle], deformation: Deformation) -> tuple[MotionState, ...]:
    moving = [MovingMuscle(one.ends, job.anatomy[name].surface, one.lines, one.belly) for name, one in fibred.items()]
    stretches = [(start, end, partial(moved_together, part)) for start, end, part in deformation.by_stretch()]
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


def _known(
    job: Job, given: str | Path | FibreFiles | None
) -> tuple[dict[str, KnownFibres], tuple[FibreUse, ...], tuple[str, ...]]:
    """What files tell of each muscle's fibres, what became of each, and what was taken for granted."""
    if given is None:
        return {}, (), ()
    files = given if isinstance(given, FibreFiles) else FibreFiles(given)
    surfaces = {muscle.name: muscle.surface for muscle in job.anatomy.of_kind(TissueKind.MUSCLE)}
    samples, notes = read_given_fibres(files, anatomy_frame=job.anatomy.frame, muscles=surfaces)
    known, uses = by_muscle(samples, surfaces)
    if all(use.nothing_fits for use in uses):
        low, high = _box(np.concatenate([one.all_places for one in samples]))
        below, above = _box(np.concatenate([surface.vertices for surface in surfaces.values()]))
        raise InputError(
            f"{files.path}: none of its fibres is in a muscle: they lie between {low} and {high} mm, the muscles "
            f"between {below} and {above} mm; state their units or frame, or move them to the anatomy"
        )
    return known, uses, notes


def _box(places: Points) -> tuple[str, str]:
    low, high = (" ".join(f"{x:.4g}" for x in side) for side in (places.min(axis=0), places.max(axis=0)))
    return low, high


def _fibres(
    job: Job,
    ends: Sequence[MuscleEnds],
    known: Mapping[str, KnownFibres],
    lengthwise: Mapping[str, Lengthwise],
    *,
    within_mm: float,
    reach_mm: float | None,
    progress: Progress,
) -> tuple[dict[str, FibredMuscle], dict[str, str]]:
    """The muscles with fibres, and those without and why."""
    tets_of = _tetrahedra(job, ends, lengthwise, progress=progress)
    fibred: dict[str, FibredMuscle] = {}
    left_out: dict[str, str] = {}
    with progress.stage("fibres") as tick:
        for done, one in enumerate(ends, start=1):
            muscle: Tissue = job.anatomy[one.muscle]
            along = lengthwise[one.muscle]
            try:
                tets = tets_of[one.muscle]
                if isinstance(tets, MeshError):
                    raise tets
                field = _flow(one, tets, reach_mm=within_mm)
                made = FibredMuscle(
                    one,
                    field,
                    Streamlines.none(),
                    belly_of(muscle.surface, along),
                    tets.pieces,
                    tets.loose_share,
                    tets.missed_mm,
                    tets.widened_mm3,
                )
                if one.muscle in known:
                    fibred[one.muscle] = _of_data(made, muscle.surface, known[one.muscle], reach_mm=reach_mm)
                else:
                    fibred[one.muscle] = replace(made, lines=streamlines(field, count=LINES))
            except MeshError as error:
                left_out[one.muscle] = str(error)
            tick(done / len(ends))
    return fibred, left_out


def _tetrahedra(
    job: Job, ends: Sequence[MuscleEnds], lengthwise: Mapping[str, Lengthwise], *, progress: Progress
) -> Mapping[str, MuscleTets | MeshError]:
    """Each muscle's tetrahedra, from the cache or made, some at once; or why there are none."""
    cache = TetCache(default_cache_folder(), limit_mb=default_limit_mb())
    muscles = sorted((job.anatomy[one.muscle] for one in ends), key=lambda muscle: -len(muscle.surface.faces))

    def fill(muscle: Tissue, stages: Progress) -> MuscleTets | MeshError:
        try:
            return muscle_tets(muscle, cache, sections=lengthwise[muscle.name].sections, progress=stages)
        except MeshError as error:
            return error

    with progress.stage("muscles' tetrahedra") as tick:
        made = at_once(fill, muscles, threads=min(usable_processors(), MESHED_AT_ONCE), tick=tick)
    return {muscle.name: tets for muscle, tets in zip(muscles, made, strict=True)}


def _flow(ends: MuscleEnds, tets: MuscleTets, *, reach_mm: float) -> FibreField:
    """The flow between a muscle's areas on bone, or its tendon sheets where these are stated."""
    sheets = (ends.origin.sheet, ends.insertion.sheet)
    areas = {"origin": ends.origin.surface, "insertion": ends.insertion.surface}
    within = ENVELOPES * tets.envelope_mm
    if sheets == (None, None):
        return laplace_fibres(tets.mesh, **areas, within_mm=within)
    return sheet_fibres(tets.mesh, **areas, sheets=sheets, within_mm=within, reach_mm=max(reach_mm, within))


def _of_data(made: FibredMuscle, surface: TriMesh, known: KnownFibres, *, reach_mm: float | None) -> FibredMuscle:
    """The same with known fibres: their directions, and known streamlines, or else lines along the directions."""
    near = NearbyDirections.of(
        known, reach_mm=usual_reach_mm(surface, made.belly.sections) if reach_mm is None else reach_mm
    )
    field, share = known_field(made.field, near)
    if not share:
        raise MeshError("its known fibres reach the middle of none of its tetrahedra; state a larger reach")
    lines = (
        known_lines(made.field, known.lines)
        if known.lines
        else followed_lines(field, near, surface, count=LINES, step_mm=step_length_mm(field))
    )
    if not lines.points:
        raise MeshError("no line runs along its known fibres; state a larger reach")
    what = "streamlines" if known.lines else "directions"
    return replace(made, field=field, lines=lines, source=f"{what} of {', '.join(known.sources)}", data_share=share)


def _measured(job: Job, one: FibredMuscle) -> MuscleArchitecture:
    return measure_at_rest(
        job.anatomy[one.ends.muscle].surface,
        one.ends,
        one.field,
        one.lines,
        belly=one.belly,
        pieces=one.pieces,
        loose_share=one.loose_share,
        missed_mm=one.missed_mm,
        widened_mm3=one.widened_mm3,
        source=one.source,
        data_share=one.data_share,
    )


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
    if report["fibre_files"]:
        headings["fibre_files"] = list(report["fibre_files"][0])
    if report["curves"]:
        headings["curves"] = list(report["curves"][0])
    files = {
        f"{name}.csv": csv_text([h, *(row.values() for row in report[name])]).encode() for name, h in headings.items()
    }
    files[FIBRES] = fibre_bytes({name: _stored(one) for name, one in found.fibred.items()})
    files["fibres.vtk"] = _fibres_vtk(found, carried=False)
    if found.carried:
        files["fibres_carried.vtk"] = _fibres_vtk(found, carried=True)
    files[REPORT_HTML] = render_architecture(report).encode()
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
        own = one.carried_lines if carried else _asked(one)
        lines += own
        numbers += [number] * len(own)
    names = ", ".join(f"{number} {name}" for number, name in enumerate(found.fibred))
    return vtk_lines(lines, title=f"fibres in mm; muscles: {names}", line_data={"muscle": np.array(numbers, float)})


def _asked(one: FibredMuscle) -> Sequence[Points]:
    """The lines at rest, with the same points as where they are carried, if they are."""
    if not one.carried_lines:
        return one.lines.points
    at_rest = Lines.carried(one.lines, one.belly)
    return at_rest.split(at_rest.points)


def _row(record: Any) -> dict[str, Any]:
    """A record, or a mapping, with None for what is not a finite number."""
    values = asdict(record) if is_dataclass(record) and not isinstance(record, type) else dict(record)
    return {key: None if isinstance(v, float) and not np.isfinite(v) else v for key, v in values.items()}
