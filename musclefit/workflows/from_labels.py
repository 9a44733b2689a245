"""A segmentation in any of its forms -> surfaces, joints, a rig that runs, and a report of all of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.anatomy.findings import Finding, some_of
from musclefit.anatomy.label_surfaces import LabelFit, label_anatomy, label_fits
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Rule
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.solids import moved_solid, overlap_volume, solid_of
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.folder_locks import held
from musclefit.io.formats.nifti import HeaderForm
from musclefit.io.formats.tables import toml_string
from musclefit.io.provenance import measured
from musclefit.io.run_folder import file_names, ply_bytes, require_new_folder, write_new_folder
from musclefit.io.segmentations import RULE, Segmentation, read_segmentation
from musclefit.pipeline.repair import RawTissue, RepairResult, without_overlaps
from musclefit.pipeline.repair import repair as repaired
from musclefit.progress import Progress
from musclefit.report.repairs import RepairReport, repair_json
from musclefit.rig.articulation import WITHIN_MM, fitted_joint
from musclefit.rig.named_joints import NamedJoint, named_joints
from musclefit.validate.overlaps import rest_overlaps
from musclefit.workflows.fit_joint import JointFit
from musclefit.workflows.given import KindsGiven, kinds_given, word
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

FIRST_DEG = 10.0
"""How far the rig's pose turns the first joint."""

LEFT_OUT = ("left-out", "too-thin")
"""Codes of findings on a mask or label that no surface was made of."""

SURFACES, JOINTS, RIG, REPORT = "surfaces", "joints.toml", "rig.toml", "report.json"


@dataclass(frozen=True, eq=False, slots=True)
class LabelledJoint:
    """A joint that the bones' names say, and its fit."""

    joint: NamedJoint
    fit: JointFit


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class FromLabels(Shown):
    """What was made of a segmentation.

    Parameters
    ----------
    anatomy : Anatomy
    segmentation : Segmentation
        The label map that the surfaces are of, who lost shared voxels, and hashes.
    fits : tuple of LabelFit
        How each surface follows its voxels.
    repair : RepairReport
    joints : tuple of LabelledJoint
    findings : tuple of Finding
        All of them, from the files to the joints.
    written : tuple of Path
    """

    anatomy: Anatomy
    segmentation: Segmentation
    fits: tuple[LabelFit, ...]
    repair: RepairReport
    joints: tuple[LabelledJoint, ...]
    findings: tuple[Finding, ...]
    written: tuple[Path, ...] = ()

    @property
    def verdict(self) -> str:
        """Passed where every surface bounds a solid, none overlap, and no mask or label was left out."""
        left_out = any(finding.code in LEFT_OUT for finding in self.findings)
        return "failed" if left_out else self.repair.verdict

    @property
    def passed(self) -> bool:
        """Whether the verdict is passed."""
        return self.verdict == "passed"

    def said(self) -> str:
        """What came of what, in a line."""
        return (
            f"{self.verdict}; {len(self.anatomy)} surfaces of a {self.segmentation.form} in "
            f"{self.anatomy.frame}, {len(self.joints)} joints"
        )

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Fits to voxels, shared voxels, joints and findings."""
        return {
            "fits": [{**asdict(fit), "volume_percent": fit.volume_percent} for fit in self.fits],
            "shared": self.segmentation.shared,
            "joints": [one.fit.to_json() for one in self.joints],
            "findings": self.findings,
        }

    def to_json(self) -> dict[str, Any]:
        """All but surfaces and voxels."""
        return {
            "verdict": self.verdict,
            "form": self.segmentation.form,
            "frame": self.anatomy.frame,
            "shared_voxels_rule": RULE,
            "shared_voxels": [asdict(pair) for pair in self.segmentation.shared],
            "fits": [{**asdict(fit), "volume_percent": fit.volume_percent} for fit in self.fits],
            "joints": [{"name": one.joint.name, "moves": one.joint.moves, **one.fit.to_json()} for one in self.joints],
            "findings": [asdict(finding) for finding in self.findings],
            "repair": repair_json(self.repair),
        }


def from_labels(
    source: str | Path,
    out: str | Path | None = None,
    *,
    names: str | Path | None = None,
    kinds: KindsGiven = (),
    frame: Frame | str = Frame.LPS,
    header_form: HeaderForm | str = HeaderForm.AGREED,
    within_mm: float = WITHIN_MM,
    progress: Progress | None = None,
) -> FromLabels:
    """Make layered surfaces, joints and a rig of a segmentation.

    Parameters
    ----------
    source : path
        A label map or stack of masks (.nii, .nii.gz, .nrrd), a .seg.nrrd, or a folder of one mask for each tissue.
    out : path, optional
        New or empty folder for surfaces, joints.toml, rig.toml and report.json.
    names : path, optional
        Table of values, names and kinds; without it, the file's header or the masks' names say them.
    kinds : mapping of name or pattern to kind
    frame : {"lps", "ras"}
        Of the surfaces; 3D Slicer's own are LPS.
    header_form : {"agreed", "sform", "qform"}
        Which one counts where a NIfTI header's two disagree.
    within_mm : float
        Surfaces of two bones within this distance are those of their joint.
    progress : Progress, optional

    Returns
    -------
    FromLabels
        Surfaces (mm), how each follows its voxels, and the joints found.

    Raises
    ------
    InputError, MeshError
        Files that cannot be read, or that hold no segmentation; a folder that is not empty.
    """
    into, form = word(Frame, frame, what="frame"), word(HeaderForm, header_form, what="header_form")
    table = None if names is None else Path(names)
    if not 0.0 < within_mm < math.inf:
        raise InputError(f"within_mm is {within_mm:g}; give a distance in mm above 0")
    if out is not None:
        require_new_folder(Path(out))
        _require_apart(Path(source), Path(out))
    with nullcontext() if out is None else held(Path(out)):
        with watched(progress) as stages:
            with stages.stage("read"):
                read = read_segmentation(Path(source), names=table, kinds=kinds_given(kinds), header=form)
            made = label_anatomy(
                read.labels, read.grid, names=read.names, frame=into, source=Path(source).name, progress=stages
            )
            anatomy, report, kept = _without_overlaps(made.anatomy, title=str(source), progress=stages)
            fits, off = label_fits(anatomy, made, read.grid, frame=into)
            with stages.stage("joints"):
                joints, told = _joints(anatomy, within_mm)
        findings = (*read.findings, *made.findings, *kept, *off, *told)
        report = replace(
            report, findings=findings, **measured(stages.seconds, provenance={"input_sha256": dict(read.hashes)})
        )
        result = FromLabels(anatomy, read, fits, report, joints, findings)
        if out is None:
            return result
        files = _files(result, frame=into, title=Path(source).name)
        write_new_folder(Path(out), files)
    return replace(result, written=tuple(Path(out) / name for name in files))


def _require_apart(source: Path, out: Path) -> None:
    given, target = source.resolve(), out.resolve()
    if target == given or given.is_relative_to(target) or (given.is_dir() and target.is_relative_to(given)):
        raise InputError(f"{out} is, holds or lies in the segmentation ({source}); name another folder")


def _without_overlaps(
    anatomy: Anatomy, *, title: str, progress: Progress
) -> tuple[Anatomy, RepairReport, list[Finding]]:
    """Repaired surfaces; where some still share volume, the inner kind keeps it.

    Pieces that are stray are taken out, hollows too; where one of these holds another tissue, so that the two come to
    overlap, strays are kept.
    """
    plain, told = _repaired(anatomy, RepairSettings(), title=title, progress=progress), []
    if _overlaps(plain):
        changes = (change for surface in plain.report.surfaces for change in surface.changes)
        strays = any(change.code == "stray-pieces" for change in changes)
        kept = RepairSettings(stray_percent=0.0)
        whole = _repaired(anatomy, kept, title=title, progress=progress) if strays else plain
        if not _overlaps(whole):
            message = "stray pieces and hollows are kept: without them, tissues would lie in each other"
            told.append(Finding("labels", "strays-kept", message))
            plain = whole
        elif all(surface.after.none for surface in plain.report.surfaces):
            plain = without_overlaps(plain, rule=Rule.PRIORITY, progress=progress)
    return replace(plain.anatomy, frame=anatomy.frame), plain.report, told


def _overlaps(done: RepairResult) -> bool:
    return done.report.overlaps is not None and bool(done.report.overlaps.pairs)


def _repaired(anatomy: Anatomy, settings: RepairSettings, *, title: str, progress: Progress) -> RepairResult:
    """Each surface repaired by itself, and the overlaps that are left."""
    raw = [RawTissue(tissue.name, tissue.kind, tissue.surface, tissue.name) for tissue in anatomy]
    done = repaired(raw, settings=settings, rule=Rule.NONE, filler=None, title=title, progress=progress)
    return replace(done, report=replace(done.report, overlaps=rest_overlaps(done.anatomy, progress=progress)))


def _joints(anatomy: Anatomy, within_mm: float) -> tuple[tuple[LabelledJoint, ...], list[Finding]]:
    """Fits of the joints that the bones' names say, and what could not be fitted."""
    bones = anatomy.of_kind(TissueKind.BONE)
    meeting = _meeting(bones, within_mm)
    fitted, told = [], []
    for joint in named_joints([bone.name for bone in bones], meeting=meeting):
        fixed = anatomy[joint.fixed].surface
        moving = TriMesh.together([anatomy[name].surface for name in (joint.moving, *joint.also_moving)])
        try:
            found = fitted_joint(fixed, moving, kind=joint.kind, within_mm=within_mm)
        except InputError as error:
            told.append(Finding(joint.name, "joint-not-fitted", f"{joint.name}: could not be fitted: {error}"))
            continue
        fitted.append(LabelledJoint(joint, JointFit(joint.fixed, joint.moving, found, joint.also_moving)))
        if not fitted[-1].fit.believable:
            told.append(Finding(joint.name, "uncertain-joint", f"{joint.name}: {fitted[-1].fit.agreement()}"))
    joined = {
        frozenset((one.joint.fixed, moving)) for one in fitted for moving in (one.joint.moving, *one.joint.also_moving)
    }
    left = sorted({tuple(sorted((a, b))) for a, others in meeting.items() for b in others if {a, b} not in joined})
    if left:
        some = some_of((" and ".join(pair) for pair in left), most=4)
        message = (
            f"{len(left)} pairs of bones meet and were given no joint: {some}; fit one by musclefit fit-joint, and add "
            f"it to {JOINTS}"
        )
        told.append(Finding("joints", "no-joint", message))
    return tuple(fitted), told


def _meeting(bones: Sequence[Tissue], within_mm: float) -> dict[str, list[str]]:
    """Bones that come within the distance of each other."""
    meeting: dict[str, list[str]] = {bone.name: [] for bone in bones}
    boxes = [(b.surface.vertices.min(axis=0) - within_mm, b.surface.vertices.max(axis=0) + within_mm) for b in bones]
    for i, one in enumerate(bones):
        for j in range(i + 1, len(bones)):
            low, high = boxes[j]
            near = one.surface.vertices
            near = near[((near > low) & (near < high)).all(axis=1)]
            if len(near) and nearest_places(near, bones[j].surface).distances.min() < within_mm:
                meeting[one.name].append(bones[j].name)
                meeting[bones[j].name].append(one.name)
    return meeting


def _files(result: FromLabels, *, frame: Frame, title: str) -> dict[str, bytes]:
    called = file_names([tissue.name for tissue in result.anatomy])
    files = {
        f"{SURFACES}/{t.kind.value}/{called[t.name]}.ply": ply_bytes(t.surface, space=frame) for t in result.anatomy
    }
    if result.joints:
        files[JOINTS] = _joints_toml(result.joints, called).encode()
        files[RIG] = _rig_toml(result.joints, title, frame, first_deg=_free_way(result)).encode()
    files[REPORT] = (json.dumps(result.to_json(), indent=2, allow_nan=False, ensure_ascii=False) + "\n").encode(
        "utf-8", "backslashreplace"
    )
    return files


def _free_way(result: FromLabels) -> float:
    """An angle of the first joint that the rig is posed by, to the side where its two bones share less volume."""
    one = result.joints[0]
    fixed, *moving = (
        solid_of(result.anatomy[name].surface) for name in (one.joint.fixed, one.joint.moving, *one.joint.also_moving)
    )
    axis = one.fit.axis if one.fit.axis is not None else np.array([1.0, 0.0, 0.0])

    def shared(angle_deg: float) -> float:
        turn = RigidMotion.about_axis(centre=one.fit.centre_mm, axis=axis, angle_deg=angle_deg)
        return sum(overlap_volume(fixed, moved_solid(bone, turn)) for bone in moving)

    return min((FIRST_DEG, -FIRST_DEG), key=shared)


def _joints_toml(joints: Sequence[LabelledJoint], called: Mapping[str, str]) -> str:
    lines = ['units = "mm, degrees"']
    for one in joints:
        lines += ["", f"[{one.joint.name}]", *one.fit.entry(one.joint.name)]
        lines.append(f"fixed = [{toml_string(called[one.joint.fixed])}]")
        lines.append(f"moving = [{', '.join(toml_string(called[name]) for name in one.joint.moves)}]")
        lines.append(f"# {one.fit.agreement()}")
    return "\n".join(lines) + "\n"


def _rig_toml(joints: Sequence[LabelledJoint], title: str, frame: Frame, *, first_deg: float) -> str:
    names = [name for one in joints for name in one.fit.coordinates(one.joint.name)]
    pose = ", ".join(f"{name}_deg = {0 if number else first_deg:g}" for number, name in enumerate(names))
    return (
        f"title = {toml_string(title)}\n[anatomy]\nfolder = {toml_string(SURFACES)}\n"
        f'units = "mm"\nframe = "patient ({frame.value.upper()}), mm"\n'
        f'[drive]\nkind = "joints"\njoints = {toml_string(JOINTS)}\npose = {{ {pose} }}\n'
    )
