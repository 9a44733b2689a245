"""An OpenSim model through a rig's deformation: the user's own file with its places moved, geometry beside it."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.measures import distances_from_box
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.anatomy import read_surface
from musclefit.io.drives.opensim import coordinate_motion
from musclefit.io.formats.osim import WRAP_SIZES, BodyPoint, OpenSimModel, WrapObject
from musclefit.io.formats.rows import csv_of
from musclefit.io.formats.texts import read_bytes
from musclefit.io.formats.xml_in_place import Element, replaced
from musclefit.io.opensim_geometry import PlacedMesh, find_geometry, placed_meshes
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import require_new_folder, write_new_folder
from musclefit.pipeline.deformers import deform
from musclefit.progress import Progress
from musclefit.rig.job import FAR_DIAGONALS
from musclefit.rig.multibody import GROUND, BodyJoint
from musclefit.rig.wrap_fits import FittedWrap, fitted_wrap, wrap_samples
from musclefit.vocabulary import Unit
from musclefit.workflows.import_osim import read_osim
from musclefit.workflows.muscles_compared import MusclesCompared, Surfaces, muscles_compared
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

Move = Callable[[Points], Points]
_M = Unit.METRE.in_mm
LENGTHS = ("optimal_fiber_length", "tendon_slack_length")


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class ExportedModel(Shown):
    """An OpenSim model that was carried to another body.

    Parameters
    ----------
    path : Path
    points : int
        Path points, markers and mass centres that were moved.
    muscles : mapping of muscle to two lengths
        Straight through its path points, default pose, before and after, mm.
    wraps : mapping of wrap object to FittedWrap
    left : tuple of str
        What was left as it is, in words.
    compared : MusclesCompared or None
        Lengths, moment arms and paths in bone before and after; None where they were not measured.
    """

    path: Path
    points: int
    muscles: Mapping[str, tuple[float, float]]
    wraps: Mapping[str, FittedWrap]
    left: tuple[str, ...]
    compared: MusclesCompared | None = None

    def said(self) -> str:
        """Counts in a line."""
        return f"{self.path}: {self.points} points, {len(self.wraps)} wrap objects, {len(self.muscles)} muscles carried"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Muscles and wrap objects; of muscles over a motion their ranges and moment arms."""
        muscles = [
            {"name": name, "length_before_mm": before, "length_after_mm": after}
            for name, (before, after) in self.muscles.items()
        ]
        wraps = [{"name": n, "rms_mm": w.rms_mm, "largest_mm": w.largest_mm} for n, w in self.wraps.items()]
        found = self.compared
        over = {} if found is None else {"muscles_over_motion": found.muscle_rows(), "moment_arms": found.arm_rows()}
        return {"muscles": muscles, "wraps": wraps, **over}

    def to_json(self) -> dict[str, Any]:
        """All of it."""
        tables = {name: list(rows) for name, rows in self.tables().items()}
        return {"file": str(self.path), "points": self.points, **tables, "left_as_it_is": list(self.left)}


def export_osim(
    rig: RigGiven,
    model: str | Path,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
    motion: str | Path | None = None,
    frames: int = 20,
    geometry: Sequence[str | Path] = (),
    progress: Progress | None = None,
) -> ExportedModel:
    """Deform an OpenSim model by a rig; whatever does not move stays byte for byte as in the file.

    In the default pose every path point, marker, mass centre and mesh vertex is where the map takes it. Frames of
    bodies and joints go where the map takes their origins and keep their orientation; wraps are fitted anew; fibre and
    tendon slack lengths keep their ratio to the muscle's straight path. Over a motion OpenSim's own library (extra
    ``opensim``) then gives each muscle's length and moment arms before and after, and how much of its path is in bone.

    Parameters
    ----------
    rig : str, path or mapping
        In the model's ground frame and default pose, as `import_osim` writes it; see `musclefit.run`.
    model : path
    out : path
        New or empty folder for the model, of the same name, and ``Geometry/``.
    overrides : sequence of str
        ``key=value`` each.
    motion : path, optional
        .mot, .sto, .trc or .c3d of the model; without it muscles are not measured.
    frames : int
        At most this many of the motion's own times, evenly spread, the first and the last included.
    geometry : sequence of path
        Further folders to look for meshes in.
    progress : Progress, optional

    Returns
    -------
    ExportedModel
        Lengths before and after, the fitted wraps, and what was left as it is.

    Raises
    ------
    InputError, MeshError, RigError, NotConvergedError
        A model that cannot be read or is not where the anatomy is, or a rig that does not reach its destination.
    """
    source, folder = Path(model), Path(out)
    require_new_folder(folder)
    if frames < 1:
        raise InputError(f"found {frames} frames; expected at least 1")
    with watched(progress) as stages:
        read = read_osim(source)
        poses = None if motion is None else _poses(Path(motion), read, frames)
        files, missing = find_geometry(read, [Path(place) for place in geometry])
        job = read_rig(rig, overrides=overrides, progress=stages)
        _require_near(read, job.anatomy.vertices())
        move = deform(job, job.anatomy.vertices(), progress=stages).deformation.require()
        with stages.stage("carry the model"):
            carrier = _Carrier(read, move)
            edits = carrier.edits()
            meshes = carrier.meshes(files)
        edits += [(element, name) for element, (name, _) in zip(_named(read, files), meshes, strict=True)]
        contents = {source.name: replaced(read.data, edits)} | {f"Geometry/{name}": data for name, data in meshes}
        left = carrier.left + [f"mesh {name}: is nowhere, not written" for name in missing]
        compared = None
        if poses is not None:
            before, after, open_ = carrier.bones(placed_meshes(read, files))
            left += poses.told + [f"mesh {name}: is not closed; inside is where it winds by a half" for name in open_]
            compared = muscles_compared(
                read,
                contents[source.name],
                times_s=poses.times_s,
                poses=poses.values,
                bones=(before, after),
                progress=stages,
            )
            contents["muscles.csv"] = csv_of(compared.pose_rows()).encode()
            contents["moment_arms.csv"] = csv_of(compared.pose_arm_rows()).encode()
        write_new_folder(folder, contents)
    return ExportedModel(folder / source.name, carrier.count, carrier.muscles, carrier.wraps, tuple(left), compared)


@dataclass(frozen=True, eq=False, slots=True)
class _Poses:
    """Some of a motion's times, the coordinates there, and what was found in its file."""

    times_s: Float
    values: list[dict[str, float]]
    told: list[str]


def _poses(path: Path, model: OpenSimModel, frames: int) -> _Poses:
    motion = coordinate_motion(read_bytes(path), model, source=str(path))
    rows = sorted({round(k) for k in np.linspace(0, len(motion.times_s) - 1, frames).tolist()})
    told = [f"motion: {found.message}" for found in motion.findings]
    return _Poses(motion.times_s[rows], [motion.at(row) for row in rows], told)


def _named(model: OpenSimModel, files: Sequence[Path | None]) -> list[Element]:
    return [mesh.element for mesh, path in zip(model.meshes, files, strict=True) if path is not None]


def _require_near(model: OpenSimModel, vertices: Points) -> None:
    places = model.multibody.places({})
    origins = np.array([places[body].translation for body in model.multibody.bodies])
    off = distances_from_box(origins, vertices)
    if off.min() > FAR_DIAGONALS * float(np.linalg.norm(np.ptp(vertices, axis=0))):
        raise InputError(
            f"{model.source}: the nearest of its bodies, {model.multibody.bodies[int(off.argmin())]!r}, is "
            f"{off.min():.4g} mm from the rig's anatomy; the rig must stand in the model's ground frame and default "
            "pose, mm: make it with `musclefit import-osim`, or register it to that"
        )


class _Carrier:
    """One model on its way."""

    def __init__(self, model: OpenSimModel, move: Move) -> None:
        self.model, self.move = model, move
        self.before = model.multibody.places({})
        self.after: dict[str, RigidMotion] = {GROUND: RigidMotion.identity()}
        self.muscles: dict[str, tuple[float, float]] = {}
        self.wraps: dict[str, FittedWrap] = {}
        self.left: list[str] = []
        self.count = 0

    def edits(self) -> list[tuple[Element, str]]:
        edits = [edit for joint in self.model.multibody.joints for edit in self._joint(joint)]
        moved = {
            id(point): self._at(point.body, self.before[point.body](point.at[None])[0]) for point in self.model.points
        }
        for point in self.model.points:
            if point.body == GROUND:
                self.left.append(f"{point.kind} {point.name!r}: stands on the ground")
                continue
            edits.append((point.element, _text(point.frame.inverse()(moved[id(point)][None])[0] / _M)))
            self.count += 1
        edits += [edit for wrap in self.model.wraps if wrap.body != GROUND for edit in self._wrap(wrap)]
        edits += self._lengths(moved)
        self.left += [
            f"MovingPathPoint {found.name!r}: its functions are kept"
            for found in self.model.root.all("MovingPathPoint")
        ]
        return edits

    def _at(self, body: str, ground: Points) -> Points:
        """Where a place of the ground goes, in the body's new frame, mm."""
        if body == GROUND:
            return ground
        local: Points = self.after[body].inverse()(self.move(ground[None]))[0]
        return local

    def _joint(self, joint: BodyJoint) -> list[tuple[Element, str]]:
        """The places of a joint's frames, and by them that of the child."""
        values = self.model.multibody.values({})
        in_parent, in_child = self.model.joint_places[joint.name]
        turn = self.before[joint.child].rotation
        parent = self.after[joint.parent]
        frame = self.before[joint.parent] @ joint.in_parent
        new_frame = frame
        if joint.parent != GROUND:
            at = self.move(frame.translation[None])[0] if in_parent is not None else parent.translation
            new_frame = RigidMotion(frame.rotation, at)
        motion = joint.in_parent.inverse() @ joint.place(values) @ joint.in_child
        middle = new_frame @ motion
        edits = []
        if in_parent is not None:
            edits.append((in_parent, _text(parent.inverse()(new_frame.translation[None])[0] / _M)))
        origin = middle.translation
        if in_child is not None:
            origin = self.move(self.before[joint.child].translation[None])[0]
            place = RigidMotion(turn, origin)
            edits.append((in_child, _text(place.inverse()(middle.translation[None])[0] / _M)))
        self.after[joint.child] = RigidMotion(turn, origin)
        return edits

    def _wrap(self, wrap: WrapObject) -> list[tuple[Element, str]]:
        samples = wrap_samples(wrap.kind, wrap.sizes_mm)
        moved = self.move((self.before[wrap.body] @ wrap.place)(samples))
        fit = fitted_wrap(wrap.kind, wrap.sizes_mm, samples=samples, moved=moved)
        self.wraps[f"{wrap.body}/{wrap.name}"] = fit
        place = self.after[wrap.body].inverse() @ fit.place
        turn = Rotation.from_matrix(place.rotation).as_euler("XYZ")
        texts = {"xyz_body_rotation": _text(turn), "translation": _text(place.translation / _M)}
        sizes = fit.sizes_mm / _M
        tags = WRAP_SIZES[wrap.kind]
        texts |= {tags[0]: _text(sizes)} if len(tags) == 1 else {t: _text(sizes[[k]]) for k, t in enumerate(tags)}
        return [(child, texts[child.tag]) for child in wrap.element.children if child.tag in texts]

    def _lengths(self, moved: Mapping[int, Points]) -> list[tuple[Element, str]]:
        edits = []
        by_muscle: dict[str, list[BodyPoint]] = {}
        for point in self.model.points:
            if point.of:
                by_muscle.setdefault(point.of, []).append(point)
        elements = {e.name: e for holder in self.model.root.all("ForceSet") for e in holder.objects("objects")}
        elements |= {
            e.name: e for holder in self.model.root.all("ForceSet") for o in holder.children for e in o.children
        }
        for name, points in by_muscle.items():
            before = _length([self.before[point.body](point.at[None])[0] for point in points])
            after = _length([self.after[point.body](moved[id(point)][None])[0] for point in points])
            self.muscles[name] = before, after
            for tag in LENGTHS:
                child = elements[name].child(tag) if name in elements else None
                if child is not None and before > 0.0:
                    edits.append((child, repr(float(child.text) * after / before)))
        return edits

    def bones(self, placed: Sequence[PlacedMesh]) -> tuple[Surfaces, Surfaces, list[str]]:
        """The meshes in their bodies' frames before and after, and the names of those that are not closed."""
        before: list[tuple[str, str, TriMesh]] = []
        after: list[tuple[str, str, TriMesh]] = []
        for mesh in placed:
            rest = mesh.mesh.vertices
            gone = rest if mesh.body == GROUND else self.move(rest)
            for kept, places, vertices in ((before, self.before, rest), (after, self.after, gone)):
                local = places[mesh.body].inverse()(vertices)
                kept.append((mesh.name, mesh.body, TriMesh(local, mesh.mesh.faces)))
        return before, after, [mesh.name for mesh in placed if mesh.fault]

    def meshes(self, files: Sequence[Path | None]) -> list[tuple[str, bytes]]:
        """The meshes where the map takes them, in their own frames, and their names."""
        written: list[tuple[str, bytes]] = []
        for mesh, path in zip(self.model.meshes, files, strict=True):
            if path is None:
                continue
            raw = read_surface(path, units=Unit.METRE)
            rest = (self.before[mesh.body] @ mesh.place)(raw.vertices * mesh.factors)
            gone = rest if mesh.body == GROUND else self.move(rest)
            local = (self.after[mesh.body] @ mesh.place).inverse()(gone) / mesh.factors / _M
            name = f"{mesh.body}__{path.stem}"
            taken = [stem.rpartition(".")[0] for stem, _ in written]
            while name in taken:
                name += "_"
            written.append((f"{name}.obj", _obj(local, raw.faces)))
        return written


def _length(places: Sequence[Points]) -> float:
    return float(np.linalg.norm(np.diff(np.array(places), axis=0), axis=1).sum())


def _text(values: Float) -> str:
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


def _obj(vertices: Points, faces: Any) -> bytes:
    buffer = io.StringIO()
    np.savetxt(buffer, vertices, fmt="v %.9g %.9g %.9g")
    np.savetxt(buffer, np.asarray(faces) + 1, fmt="f %d %d %d")
    return buffer.getvalue().encode()
