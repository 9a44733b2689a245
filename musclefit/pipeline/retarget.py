"""One run in order: march, move every tissue, check, the same for what it is shown beside; a job in, records out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.certify.model import MapCertificate
from musclefit.errors import MeshError
from musclefit.flow.bones import contact_residuals
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.kept_bones import KeptBone, kept_residuals
from musclefit.flow.residuals import surface_residuals
from musclefit.flow.surface_refinement import Carried
from musclefit.flow.tet_refinement import CarriedTets, HeldBones, carried_tets, mended_tets, moved_tets
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.quantiles import weighted_quantile
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.crossings import TOUCHING_MM
from musclefit.pipeline.chosen_settings import bone_choices, surface_choices
from musclefit.pipeline.comparisons import LoopProgress, papers_loop
from musclefit.pipeline.deformers import (
    Deformed,
    baseline_in_words,
    deform_in_one_shot,
    method_in_words,
    rule_in_words,
)
from musclefit.pipeline.kept_bones import bone_limits, kept_choices
from musclefit.pipeline.poses import bones_of, ranges_of, refuse_collision, shared_in_the_pose
from musclefit.pipeline.proving import proved
from musclefit.pipeline.refining import Made, Sampled, deform_finely, move_finely
from musclefit.progress import Progress, Silent
from musclefit.report.model import CONVERGED, Report, Side, TetSummary
from musclefit.report.next_steps import with_next_steps
from musclefit.rig.job import Job
from musclefit.rig.settings import MeshSettings
from musclefit.validate.joint_ranges import JointRange
from musclefit.validate.landmarks import check_landmarks
from musclefit.validate.maps import check_map
from musclefit.validate.model import BoneFieldCheck, BoneOverlap, MapCheck, MeshCheck, MeshRefinement, OverlapCheck
from musclefit.validate.overlaps import SolidAnatomy, check_outside_skin, check_overlaps, solid_anatomy
from musclefit.validate.tets import check_tets, rest_findings
from musclefit.validate.tissues import Motion, check_tissues
from musclefit.vocabulary import BoneLimit, Claim, Compared


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Outcome:
    """What one method made of the anatomy, and what was measured of it.

    Parameters
    ----------
    deformation : Deformation
    rest, deformed : Anatomy
        The same triangles; where surfaces were refined, the given vertices come first in each tissue.
    determinants : (N,) float64
        Of the map's Jacobian at the vertices of the anatomy at rest, in the order of ``Anatomy.vertices``.
    tets : TetAnatomy or None
        At rest; where tets came out wrong, cut finer than those given. None where there are none.
    tet_vertices : (n, 3) float64, mm, or None
        Of ``tets``, moved.
    side : Side
    solid : SolidAnatomy
        ``deformed``, prepared for booleans; of a finished `Retargeting`, only tissues that overlap.
    """

    deformation: Deformation
    rest: Anatomy
    deformed: Anatomy
    determinants: Float
    tets: TetAnatomy | None
    tet_vertices: Points | None
    side: Side
    solid: SolidAnatomy

    def __repr__(self) -> str:
        return f"Outcome({self.side.method}; {self.deformation!r})"

    def with_overlapping_solids(self) -> Outcome:
        """The same, with no more solids than are needed to show what overlaps."""
        overlapping = {name for pair in self.side.overlaps.pairs for name in (pair.a, pair.b)}
        return replace(self, solid=self.solid.only(overlapping))


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Retargeting:
    """One finished run.

    Parameters
    ----------
    job : Job
    tets : TetAnatomy or None
        At rest, as given.
    result : Outcome
        By the job's method.
    baseline : Outcome or None
        The same handles in one shot; None where the rig does not want it.
    findings : tuple of Finding
        Of the input.
    joint_ranges : tuple of JointRange
        Of the joints that the pose turns.
    paper_loop : Outcome or None
        The same handles by the loop of Yu et al. 2014; None where that is the job's method, or not wanted.
    """

    job: Job
    tets: TetAnatomy | None
    result: Outcome
    baseline: Outcome | None
    findings: tuple[Finding, ...]
    joint_ranges: tuple[JointRange, ...] = ()
    paper_loop: Outcome | None = None

    def __repr__(self) -> str:
        return f"Retargeting({self.job!r}: {self.report.verdict})"

    @property
    def report(self) -> Report:
        """The run summed up; timings, memory and versions are known only to who runs it."""
        return Report(
            title=self.job.title,
            result=self.result.side,
            baseline=None if self.baseline is None else self.baseline.side,
            findings=self.findings,
            limits=self.job.rig.limits,
            timings_s={},
            peak_memory_mb=float("nan"),
            provenance={"input_sha256": dict(self.job.hashes), "settings": settings_of(self.job)},
            tets=None if self.tets is None else tet_summary(self.tets),
            joint_ranges=self.joint_ranges,
            purpose_because=self.job.rig.purpose_because,
            paper_loop=None if self.paper_loop is None else self.paper_loop.side,
        )


def tet_summary(tets: TetAnatomy) -> TetSummary:
    """What the report says of the tets at rest."""
    return TetSummary(
        tets=len(tets.mesh.tets),
        vertices=len(tets.mesh.vertices),
        left_out=tets.dropped,
        turned=tets.turned,
        joint_space_tets=tets.joint_space_tets,
        joint_space_mm3=tets.joint_space_mm3,
        tissues=tets.fits,
    )


def settings_of(job: Job) -> Mapping[str, Any]:
    """Every setting of the run, as plain values."""
    return {"rig": job.name, "overrides": list(job.overrides), **asdict(job.rig)}


COMPARED_SHARE = 0.05
"""Of the rig's budget of boxes: what the proof of a one shot, or of the paper's loop beside a result, may use."""

TetsLater = Callable[[], TetAnatomy | None]
"""Gives the tetrahedra once they are needed: they may be made while the map is."""


def retarget(job: Job, *, tets: TetAnatomy | TetsLater | None, progress: Progress | None = None) -> Retargeting:
    """Run a job: deform by its method, by the paper's loop and in one shot, and check them all.

    Parameters
    ----------
    job : Job
    tets : TetAnatomy, callable or None
        The anatomy's tetrahedra, or what gives them once they are needed; None leaves the mesh checks out.

    Returns
    -------
    Retargeting
        Whatever the march's status is: a run that ended early is reported, not raised.

    Raises
    ------
    InputError
        The handles cannot drive a field, or rigid bones collide on the way; the message names them, the
        pose and the depth.
    """
    progress = progress or Silent()
    bone_limits(job)  # refuses names that fit no bone before the long work
    shared = _tested_bones(job, progress)
    ranges, unknown = _joint_ranges(job, progress)
    solids = solid_anatomy(job.anatomy, progress=progress)
    made = deform_finely(job, progress=progress)
    later = cache(tets if callable(tets) else partial(_given, tets))
    finish = _Finisher(job, solids, later, job.rig.mesh, progress, progress, shared)
    kept = (*made.findings, *_kept_findings(made.deformed))
    result = finish(made, method=method_in_words(job), stage="check result").with_overlapping_solids()
    del made  # what was tested at every step is needed no more, and takes as much memory as the anatomy
    filled = later()
    of_tets = () if filled is None else (*filled.findings, *rest_findings(filled, sliver_deg=job.rig.mesh.sliver_deg))
    return Retargeting(
        job=job,
        tets=filled,
        result=result,
        baseline=_one_shot(finish),
        findings=with_next_steps(
            (*job.findings, *_chosen(job), *unknown, *kept, *_touching(result.side.overlaps), *of_tets)
        ),
        joint_ranges=ranges,
        paper_loop=_papers_loop(finish),
    )


def _given(tets: TetAnatomy | None) -> TetAnatomy | None:
    return tets


def _one_shot(finish: _Finisher) -> Outcome | None:
    """The same handles in one shot, on surfaces as fine as the result's; None where the rig does not want it."""
    job = finish.job
    if Compared.ONE_SHOT not in job.rig.compare.methods:
        return None
    made = move_finely(job, deform_in_one_shot(job, job.anatomy.vertices()), progress=finish.progress)
    outcome = finish.as_given(job)(made, method=baseline_in_words(job), stage="check baseline")
    return outcome.with_overlapping_solids()


def _papers_loop(finish: _Finisher) -> Outcome | None:
    """The same handles by the paper's loop, on the given surfaces; None where that is the job's, or not wanted."""
    loop = papers_loop(finish.job)
    if loop is None:
        return None
    made = deform_finely(loop, progress=LoopProgress(finish.progress))
    outcome = finish.as_given(loop)(made, method=method_in_words(loop), stage="check the paper's loop")
    return outcome.with_overlapping_solids()


def outcome_of(job: Job, *, rest: SolidAnatomy, shared: Sequence[BoneOverlap] = (), progress: Progress) -> Outcome:
    """The job's method alone, checked as `retarget` does, without baseline and tetrahedra.

    Parameters
    ----------
    job : Job
    rest : SolidAnatomy
        The job's anatomy, prepared once for many poses.
    shared : sequence of BoneOverlap
        What bones share in the pose by their motions alone.
    """
    finish = _Finisher(job, rest, lambda: None, job.rig.mesh, progress, progress, tuple(shared))
    return finish(deform_finely(job, progress=progress), method=method_in_words(job), stage="check result")


@dataclass(frozen=True, slots=True)
class _Finisher:
    """Moves the tissues by a deformation and measures everything the report needs."""

    job: Job
    rest: SolidAnatomy
    tets: TetsLater
    mesh: MeshSettings
    progress: Progress
    proving: Progress
    """Receives the progress of the proof: the seconds of the job's own are compared with those of its march."""
    shared: tuple[BoneOverlap, ...]
    """What bones share in the pose by their motions alone: no part of what a deformation that holds them introduces."""
    by_pairs: bool = True
    """Whether what the proof leaves open is tried pair by pair."""

    def as_given(self, job: Job) -> _Finisher:
        """For what a result is compared with: its tets are moved as they are, its proof is a short one."""
        boxes = max(1, round(COMPARED_SHARE * job.rig.certificate.max_boxes))
        rig = replace(job.rig, certificate=replace(job.rig.certificate, max_boxes=boxes))
        mesh = replace(job.rig.mesh, refine=False)
        return replace(self, job=replace(job, rig=rig), mesh=mesh, proving=Silent(), by_pairs=False)

    def __call__(self, made: Made, *, method: str, stage: str) -> Outcome:
        made, proof = proved(made, self.job, by_pairs=self.by_pairs, progress=self.proving)
        job, deformed, deformation = self.job, made.deformed, made.deformed.deformation
        moved = self._moved(made)
        with self.progress.stage(stage) as tick:
            of_map = self._map(deformation, made.sampled, proof, rule_in_words(job.rig.deformer))
            tets = self._tets(deformed, of_map)
            tick(0.2)
            landmarks = check_landmarks(
                job.handles.names, arrived=deformation(job.handles.source), targets=job.path.position(1.0)
            )
            after = solid_anatomy(moved.deformed, progress=self.progress)
            outside = check_outside_skin(self.rest, after, mapped=deformation.with_jacobian, progress=self.progress)
            tick(0.6)
            overlaps = check_overlaps(
                self.rest,
                after,
                mapped=deformation.with_jacobian,
                by_motions=self._shared_by_held_bones(deformed),
                progress=self.progress,
            )
            tick(0.9)
            side = Side(
                method=method,
                status=CONVERGED if deformation.status is Status.CONVERGED else deformation.status.value,
                steps=deformation.stretches,
                landmarks=landmarks,
                map=of_map,
                mesh=None if tets is None else _mesh(tets),
                tissues=check_tissues(moved.rest, moved.deformed, motions=_motions(job, deformed), outside=outside),
                overlaps=replace(overlaps, not_checked=(*overlaps.not_checked, *outside.not_checked)),
                steps_rejected=deformation.rejected,
                edges_split=sum(moved.splits.values()),
                edges_left_bent=moved.undecided_edges,
                crossings_left=moved.crossings_left,
                steps_returned=made.returns,
                bones=self._bone_field(made),
            )
            tick(1.0)
        return Outcome(
            deformation,
            moved.rest,
            moved.deformed,
            moved.determinants,
            None if tets is None else tets.rest,
            None if tets is None else tets.vertices,
            side,
            after,
        )

    def _shared_by_held_bones(self, deformed: Deformed) -> tuple[BoneOverlap, ...]:
        held = {name for group in deformed.groups for name in group.bones}
        return tuple(overlap for overlap in self.shared if {overlap.a, overlap.b} <= held)

    def _moved(self, made: Made) -> Carried:
        """The tissues moved by the map; bones that are held, by their rigid motions."""
        moved, motions = made.carried, motions_of_held_bones(self.job, made.deformed)
        if not motions:
            return moved
        tissues = tuple(
            moved.rest[t.name].with_vertices(motions[t.name](moved.rest[t.name].surface.vertices))
            if t.name in motions
            else t
            for t in moved.deformed
        )
        return replace(moved, deformed=Anatomy(tissues, moved.deformed.frame))

    def _tets(self, deformed: Deformed, of_map: MapCheck) -> CarriedTets | None:
        """The tets moved, and mended where that is asked for and the map is not the one to blame.

        Where bones are held, no edge is split: what is wrong there is that tissue slips along bone, however small the
        tets.
        """
        tets = self.tets()
        if tets is None:
            return None
        deformation, mesh, held = deformed.deformation, self.mesh, _held_bones(self.job, deformed)
        if not mesh.refine or of_map.claim is Claim.REFUTED:
            return moved_tets(tets, deformation)
        if held:
            moved = replace(moved_tets(tets, deformation), stopped="")
        else:
            moved = carried_tets(
                tets,
                deformation,
                max_rounds=mesh.max_rounds,
                max_growth=mesh.max_growth,
                progress=self.progress,
            )
        if mesh.move_vertices and (held or moved.stopped):
            moved = mended_tets(moved, held, progress=self.progress)
        return moved

    def _map(self, deformation: Deformation, looked_at: Sampled, proof: MapCertificate | None, rule: str) -> MapCheck:
        """The sampled check, and above it the proof where the rig asks for one."""
        points = looked_at.points
        sampled = check_map(
            looked_at.determinants, points=points, rule=rule, margin=deformation.margin, gap_mm=looked_at.gap_mm
        )
        if proof is None:
            return sampled
        refuted = Claim.REFUTED in (sampled.claim, proof.claim)
        return replace(
            sampled,
            claim=Claim.REFUTED if refuted else proof.claim,
            margin=proof.margin,
            boxes_examined=proof.boxes_examined,
            boxes_left=proof.boxes_left,
            not_covered=proof.not_covered,
        )

    def _bone_field(self, made: Made) -> BoneFieldCheck | None:
        deformed = made.deformed
        if deformed.kept:
            return _kept_field(self.job, deformed)
        if not deformed.groups:
            return None
        assert self.job.motions is not None  # a rig with rigid bones says how they move
        motions = _final_motions(self.job)
        between = surface_residuals(deformed.groups, deformed.deformation, motions)
        contact = contact_residuals(deformed.groups, deformed.deformation, self.job.motions)
        own = _own_residuals(made, motions)
        p99 = weighted_quantile(between.distances, between.areas, 0.99) if len(between.areas) else 0.0
        return BoneFieldCheck(
            contact_zone_mm=float(bone_choices(self.job).zones_mm.max()),
            exposed_vertices=len(own),
            contact_vertices=len(contact),
            residual_p99_mm=p99,
            residual_max_mm=float(max(own.max(initial=0.0), between.distances.max(initial=0.0))),
            contact_residual_max_mm=float(contact.max(initial=0.0)),
            exposed_samples=len(between.distances),
            gap_mm=between.gap_mm,
        )


def _own_residuals(made: Made, motions: Mapping[str, RigidMotion]) -> Float:
    """Distances of the map from the rigid motions at the bones' own vertices outside their contact zones, mm."""
    found = [np.zeros(0)]
    for group in made.deformed.groups:
        given = [made.carried.rest[bone].surface.vertices for bone in group.bones]
        moved = np.concatenate([made.carried.deformed[bone].surface.vertices for bone in group.bones])
        off = np.linalg.norm(moved - motions[group.bones[0]](np.concatenate(given)), axis=1)
        found.append(off[~group.contact[: group.given]])
    return np.concatenate(found)


def _mesh(tets: CarriedTets) -> MeshCheck:
    """The moved tets judged, with what was done to them."""
    check = check_tets(tets.rest, tets.vertices)
    if not (tets.rounds or tets.moving_rounds):
        return check
    refinement = MeshRefinement(
        rounds=tets.rounds,
        edges_split=tets.edges_split,
        tets_before=tets.given,
        inverted_before=tets.inverted_before,
        crossings_before=tets.crossings_before,
        cut_by_tissue=tets.cut_by_tissue,
        stopped=tets.stopped,
        moving_rounds=tets.moving_rounds,
        moved_aside=tuple((aside.tissue, aside.vertices, aside.farthest_mm) for aside in tets.moved_aside),
        left_out=tets.left_out,
        left_out_mm3=tets.left_out_mm3,
    )
    return replace(check, refinement=refinement)


def _tested_bones(job: Job, progress: Progress) -> tuple[BoneOverlap, ...]:
    """What rigid bones share in the pose; raises before the soft tissue is touched when they collide on the way."""
    if not job.rig.bones.rigid:
        return ()
    with progress.stage("test the bones' way"):
        bones = bones_of(job)
        refuse_collision(job, bones)
        return shared_in_the_pose(job, bones)


def _joint_ranges(job: Job, progress: Progress) -> tuple[tuple[JointRange, ...], tuple[Finding, ...]]:
    """How far the posed joints can turn, or the finding that says why that is not known."""
    if job.joints is None:
        return (), ()
    with progress.stage("joint ranges"):
        try:
            return ranges_of(job, posed_only=True), ()
        except MeshError as error:
            return (), (Finding("joints", "joint-range-unknown", f"the joints' free ranges are not known: {error}"),)


def motions_of_held_bones(job: Job, deformed: Deformed) -> Mapping[str, Motion]:
    """Where the bones of the anatomy go that are held: by motions of their own, and not by the map."""
    held = {*(b for group in deformed.groups for b in group.bones), *(bone.name for bone in deformed.kept)}
    return {name: motion for name, motion in _motions(job, deformed).items() if name in held} if held else {}


def _held_bones(job: Job, deformed: Deformed) -> tuple[HeldBones, ...]:
    """The bones that the tets must follow exactly, those of one motion together."""
    motions = _final_motions(job)
    together = tuple(HeldBones(group.bones, motions[group.bones[0]]) for group in deformed.groups)
    return together + tuple(HeldBones((bone.name,), bone.motion) for bone in deformed.kept)


def _motions(job: Job, deformed: Deformed) -> Mapping[str, Motion]:
    """Where each held bone goes: as the drive moves it, or as it is kept."""
    kept = {bone.name: bone.motion for bone in deformed.kept}
    return {**_final_motions(job), **kept}


def _kept_field(job: Job, deformed: Deformed) -> BoneFieldCheck:
    exposed, contact = kept_residuals(deformed.kept, deformed.deformation)
    return BoneFieldCheck(
        contact_zone_mm=float(kept_choices(job).zones_mm.max()),
        exposed_vertices=len(exposed),
        contact_vertices=len(contact),
        residual_p99_mm=float(np.quantile(exposed, 0.99)) if len(exposed) else 0.0,
        residual_max_mm=float(exposed.max(initial=0.0)),
        contact_residual_max_mm=float(contact.max(initial=0.0)),
    )


def _chosen(job: Job) -> tuple[Finding, ...]:
    """What the rig leaves open of rigid and of kept bones, and of surfaces."""
    rigid = job.rig.bones.rigid
    of_bones = bone_choices(job).findings if rigid else kept_choices(job).findings
    return (*of_bones, *surface_choices(job).findings) if job.rig.surfaces.refine else of_bones


def _touching(overlaps: OverlapCheck) -> tuple[Finding, ...]:
    """Tissues that come to touch themselves, which is no crossing."""
    return tuple(
        Finding(
            name,
            "touches-itself",
            f"{name}: comes to touch itself: {count} pairs of its triangles reach into each other, but by no more than "
            f"{TOUCHING_MM:g} mm, which is rounding",
        )
        for name, count in overlaps.touching
    )


def _kept_findings(deformed: Deformed) -> tuple[Finding, ...]:
    """What each kept bone was kept from."""
    return tuple(
        Finding(
            bone.name,
            "kept-bone",
            f"{bone.name}: kept {bone.limit.value}; the map would have bent it by up to {bone.bent_mm:.3g} mm"
            + (f", and its size changes by {_percent(bone)}" if bone.limit is BoneLimit.SIMILAR else ""),
        )
        for bone in deformed.kept
    )


def _percent(bone: KeptBone) -> str:
    return f"{100.0 * (bone.motion.scale - 1.0):+.3g} %"


def _final_motions(job: Job) -> Mapping[str, RigidMotion]:
    """Where the drive takes the bones of the anatomy; nothing where it says no motion of theirs."""
    return {} if job.motions is None else job.motions.at(1.0)
