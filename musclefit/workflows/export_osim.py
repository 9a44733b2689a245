"""An OpenSim model through a rig's deformation: the user's own file with its places moved, geometry beside it."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
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
from musclefit.io.formats.osim import WRAP_SIZES, BodyPoint, OpenSimModel, WrapObject, parse_osim
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
from musclefit.rig.linear_fits import AxisFactors, axis_factors
from musclefit.rig.multibody import GROUND, BodyJoint
from musclefit.rig.place_curves import PlaceCurve, stated_values
from musclefit.rig.wrap_fits import FittedWrap, fitted_wrap, wrap_samples
from musclefit.vocabulary import Unit
from musclefit.workflows.import_osim import read_osim
from musclefit.workflows.muscles_compared import MusclesCompared, Surfaces, muscles_compared
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown

Move = Callable[[Points], Points]
_M = Unit.METRE.in_mm
AGREED_MM = 1e-6
"""How far bodies may be from where they are meant, and joints may differ on a frame that they share."""

LENGTHS = ("optimal_fiber_length", "tendon_slack_length")


@dataclass(frozen=True, eq=False, slots=True)
class LinearBody:
    """A body scaled by (3,) factors along its own axes; how far its vertices are from where the map takes them, mm."""

    factors: Float
    rms_mm: float
    largest_mm: float

    def row(self, body: str) -> dict[str, Any]:
        """A row of a table."""
        x, y, z = self.factors.tolist()
        return {"body": body, "x": x, "y": y, "z": z, "rms_mm": self.rms_mm, "largest_mm": self.largest_mm}


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
    linear : mapping of body to LinearBody
        Bodies that were scaled linearly instead.
    """

    path: Path
    points: int
    muscles: Mapping[str, tuple[float, float]]
    wraps: Mapping[str, FittedWrap]
    left: tuple[str, ...]
    compared: MusclesCompared | None = None
    linear: Mapping[str, LinearBody] = field(default_factory=dict)

    def said(self) -> str:
        """Counts in a line."""
        return f"{self.path}: {self.points} points, {len(self.wraps)} wrap objects, {len(self.muscles)} muscles carried"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Muscles, wrap objects, bodies scaled linearly; of muscles over a motion their ranges and moment arms."""
        muscles = [
            {"name": name, "length_before_mm": before, "length_after_mm": after}
            for name, (before, after) in self.muscles.items()
        ]
        wraps = [{"name": n, "rms_mm": w.rms_mm, "largest_mm": w.largest_mm} for n, w in self.wraps.items()]
        found = self.compared
        over = {} if found is None else {"muscles_over_motion": found.muscle_rows(), "moment_arms": found.arm_rows()}
        scaled = {"linear_bodies": [one.row(body) for body, one in self.linear.items()]} if self.linear else {}
        return {"muscles": muscles, "wraps": wraps, **scaled, **over}

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
    linear: Sequence[str] = (),
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
    linear : sequence of str
        Bodies that are scaled along their own axes instead, by the factors that fit best to where the map takes their
        meshes: meshes, path points, markers, wrap objects, mass centre and joint frames. They keep their orientation
        and stand where their joint has them; one that a joint fixes to the ground stands where it fits best.
    progress : Progress, optional

    Returns
    -------
    ExportedModel
        Lengths before and after, the fitted wraps, and what was left as it is.

    Raises
    ------
    InputError, MeshError, RigError, NotConvergedError
        A model that cannot be read or is not where the anatomy is, a rig that does not reach its destination, or a
        body in ``linear`` that the model does not have, that has no mesh, or that the map turns too far.
    """
    source, folder = Path(model), Path(out)
    require_new_folder(folder)
    if frames < 1:
        raise InputError(f"found {frames} frames; expected at least 1")
    with watched(progress) as stages:
        read = read_osim(source)
        poses = None if motion is None else _poses(Path(motion), read, frames)
        files, missing = find_geometry(read, [Path(place) for place in geometry])
        _require_scalable(read, files, linear)
        job = read_rig(rig, overrides=overrides, progress=stages)
        _require_near(read, job.anatomy.vertices())
        move = deform(job, job.anatomy.vertices(), progress=stages).deformation.require()
        with stages.stage("carry the model"):
            placed = placed_meshes(read, files) if linear or poses is not None else ()
            carrier = _Carrier(read, move, _fits(read, placed, move=move, linear=linear))
            edits = carrier.edits()
            meshes = carrier.meshes(files)
        edits += [(element, name) for element, (name, _) in zip(_named(read, files), meshes, strict=True)]
        contents = {source.name: replaced(read.data, edits)} | {f"Geometry/{name}": data for name, data in meshes}
        left = carrier.left + [f"mesh {name}: is nowhere, not written" for name in missing]
        compared = None
        if poses is not None:
            before, after, open_ = carrier.bones(placed)
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
    return ExportedModel(
        folder / source.name,
        carrier.count,
        carrier.muscles,
        carrier.wraps,
        tuple(left),
        compared,
        carrier.scaled(placed),
    )


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


def _require_scalable(model: OpenSimModel, files: Sequence[Path | None], linear: Sequence[str]) -> None:
    """Refuse bodies that cannot be scaled, before the work."""
    with_mesh = {mesh.body for mesh, path in zip(model.meshes, files, strict=True) if path is not None}
    for body in linear:
        if body not in model.multibody.bodies:
            raise InputError(
                f"{model.source}: body {body!r}, which is to be scaled linearly, is not in the model; it has "
                f"{', '.join(model.multibody.bodies)}"
            )
        if body not in with_mesh:
            raise InputError(
                f"{model.source}: body {body!r} has no mesh that was found, and linear factors are fitted to meshes; "
                "leave it to the map, or name the folder of its geometry"
            )


def _fits(
    model: OpenSimModel, placed: Sequence[PlacedMesh], *, move: Move, linear: Sequence[str]
) -> dict[str, AxisFactors]:
    """The factors of each body that is scaled, in its own frame."""
    rest = model.multibody.places({})
    fits = {}
    for body in dict.fromkeys(linear):
        bone = TriMesh.together([one.mesh for one in placed if one.body == body])
        to_body = rest[body].inverse()
        local = TriMesh(to_body(bone.vertices), bone.faces)
        fits[body] = axis_factors(local, to_body(move(bone.vertices)), name=body)
    return fits


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

    def __init__(self, model: OpenSimModel, move: Move, fits: Mapping[str, AxisFactors]) -> None:
        self.model, self.move, self.fits = model, move, fits
        self.before = model.multibody.places({})
        self.after: dict[str, RigidMotion] = {GROUND: RigidMotion.identity()}
        self.muscles: dict[str, tuple[float, float]] = {}
        self.wraps: dict[str, FittedWrap] = {}
        self.left: list[str] = []
        self.count = 0
        self.jointed = model

    def edits(self) -> list[tuple[Element, str]]:
        edits = self._joints()
        moved = {
            id(point): self.after[point.body].inverse()(self._gone(point.body, point.at[None]))[0]
            for point in self.model.points
        }
        for point, now in zip(self.model.points, self.jointed.points, strict=True):
            if point.body == GROUND:
                self.left.append(f"{point.kind} {point.name!r}: stands on the ground")
                continue
            self.count += 1
            if point.curve is not None:
                edits += self._moving(point, now.frame)
                continue
            edits.append((point.element, _text(now.frame.inverse()(moved[id(point)][None])[0] / _M)))
        for wrap, there in zip(self.model.wraps, self.jointed.wraps, strict=True):
            if wrap.body == GROUND:
                self.left.append(f"{wrap.kind} {wrap.name!r}: stands on the ground")
                continue
            edits += self._wrap(wrap, there.frame)
        edits += self._lengths(moved)
        read = {id(point.element) for point in self.model.points}
        self.left += [
            f"MovingPathPoint {found.name!r}: its functions are kept"
            for found in self.model.root.all("MovingPathPoint")
            if id(found) not in read
        ]
        return edits

    def _moving(self, point: BodyPoint, frame: RigidMotion) -> list[tuple[Element, str]]:
        """The functions of a point that coordinates move, its frame being there in the body now."""
        assert point.curve is not None
        to_frame = (self.after[point.body] @ frame).inverse()
        return self._curve(
            f"{point.kind} {point.name!r}",
            point.curve,
            point.functions,
            lambda local: to_frame(self._gone(point.body, point.frame(local))),
        )[1]

    def _curve(
        self, what: str, curve: PlaceCurve, functions: Sequence[Element | None], move: Move
    ) -> tuple[PlaceCurve, list[tuple[Element, str]]]:
        """A place that coordinates move, carried; what of it is not at its knots, or stays, is told."""
        values = self.model.multibody.values({})
        made = curve.carried(move, values, editable=[element is not None for element in functions])
        edits = [
            (element, _text(stated_values(axis.function)))
            for axis, element, changed in zip(made.curve.axes, functions, made.changed, strict=True)
            if changed and element is not None
        ]
        if made.off_mm > AGREED_MM:
            said = "a function of it that is constant, linear or a polynomial keeps it"
            self.left.append(f"{what}: {said} up to {made.off_mm:.2g} mm off the map where its coordinates move it")
        return made.curve, edits

    def _gone(self, body: str, local: Points) -> Points:
        """Where (n, 3) places of a body's frame go, in the ground's, mm; on the ground nothing moves."""
        if body in self.fits:
            return self.after[body](self.fits[body].factors * local)
        ground = self.before[body](local)
        return ground if body == GROUND else self.move(ground)

    def _joints(self) -> list[tuple[Element, str]]:
        """The places of all joints' frames; the model with them alone shows where else frames have gone by that."""
        edits: dict[int, tuple[Element, str]] = {}
        for joint in self.model.multibody.joints:
            for element, text in self._joint(joint):
                _, said = edits.setdefault(id(element), (element, text))
                self._require_agreed(joint.name, element.line, _M * _apart(said, text))
        self.jointed = parse_osim(replaced(self.model.data, list(edits.values())), source=self.model.source)
        for body, place in self.jointed.multibody.places({}).items():
            off = np.linalg.norm(place.translation - self.after[body].translation)
            if not off < AGREED_MM:
                raise InputError(
                    f"{self.model.source}: body {body!r} would stand {off:.3g} mm from where it is meant to: its joint "
                    "is in a frame that another joint moves; give it frames of its own"
                )
        return list(edits.values())

    def _require_agreed(self, joint: str, line: int, off_mm: float) -> None:
        if not off_mm < AGREED_MM:
            raise InputError(
                f"{self.model.source}: line {line}: joint {joint!r} shares this place of a frame with another joint, "
                f"and the two take it {off_mm:.3g} mm apart; give each joint frames of its own"
            )

    def _joint(self, joint: BodyJoint) -> list[tuple[Element, str]]:
        """The places of a joint's frames, and by them that of the child."""
        values = self.model.multibody.values({})
        in_parent, in_child = self.model.joint_places[joint.name]
        turn = self.before[joint.child].rotation
        parent = self.after[joint.parent]
        frame = self.before[joint.parent] @ joint.in_parent
        new_frame = frame
        if joint.parent != GROUND:
            local = joint.in_parent.translation[None]
            at = self._gone(joint.parent, local) if in_parent is not None else parent(local)
            new_frame = RigidMotion(frame.rotation, at[0])
        motion = joint.in_parent.inverse() @ joint.place(values) @ joint.in_child
        edits: list[tuple[Element, str]] = []
        way = motion.translation
        if joint.parent != GROUND and any(self.model.slides.get(joint.name, ())):
            slides, edits = self._curve(
                f"joint {joint.name!r}",
                PlaceCurve(joint.slides, joint.length_mm),
                self.model.slides[joint.name],
                lambda local: new_frame.inverse()(self._gone(joint.parent, joint.in_parent(local))),
            )
            way = slides.at(values)
        middle = new_frame @ RigidMotion(motion.rotation, way)
        for body, told, place in (
            (joint.parent, in_parent, joint.in_parent),
            (joint.child, in_child, joint.in_child),
        ):
            if told is None and body != GROUND and place.translation.any():
                self.left.append(
                    f"joint {joint.name!r}: its frame on {body!r} is none of its own, and stays in the body"
                )
        if in_parent is not None:
            at = (parent @ in_parent.frame).inverse()(new_frame.translation[None])
            edits.append((in_parent.element, _text(at[0] / _M)))
        origin = (middle @ joint.in_child.inverse()).translation
        if in_child is not None:
            origin = self._origin(joint, middle)
            place = RigidMotion(turn, origin)
            at = (place @ in_child.frame).inverse()(middle.translation[None])
            edits.append((in_child.element, _text(at[0] / _M)))
        self.after[joint.child] = RigidMotion(turn, origin)
        return edits

    def _origin(self, joint: BodyJoint, middle: RigidMotion) -> Points:
        """Where the origin of a joint's child goes, the joint's frame in the child being at ``middle``."""
        place = self.before[joint.child]
        if joint.child not in self.fits:
            there: Points = self.move(place.translation[None])[0]
            return there
        fit = self.fits[joint.child]
        if joint.parent == GROUND:
            at: Points = place(fit.offset[None])[0]
            return at
        return middle.translation - place.rotation @ (fit.factors * joint.in_child.translation)

    def _wrap(self, wrap: WrapObject, frame: RigidMotion) -> list[tuple[Element, str]]:
        samples = wrap_samples(wrap.kind, wrap.sizes_mm)
        moved = self._gone(wrap.body, wrap.place(samples))
        fit = fitted_wrap(wrap.kind, wrap.sizes_mm, samples=samples, moved=moved)
        self.wraps[f"{wrap.body}/{wrap.name}"] = fit
        place = (self.after[wrap.body] @ frame).inverse() @ fit.place
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

    def scaled(self, placed: Sequence[PlacedMesh]) -> dict[str, LinearBody]:
        """The bodies that were scaled, held against the map."""
        found = {}
        for body, fit in self.fits.items():
            rest = np.concatenate([one.mesh.vertices for one in placed if one.body == body])
            off = np.linalg.norm(self._gone(body, self.before[body].inverse()(rest)) - self.move(rest), axis=1)
            found[body] = LinearBody(fit.factors, float(np.sqrt((off**2).mean())), float(off.max()))
        return found

    def bones(self, placed: Sequence[PlacedMesh]) -> tuple[Surfaces, Surfaces, list[str]]:
        """The meshes in their bodies' frames before and after, and the names of those that are not closed."""
        before: list[tuple[str, str, TriMesh]] = []
        after: list[tuple[str, str, TriMesh]] = []
        for mesh in placed:
            rest = mesh.mesh.vertices
            gone = self._gone(mesh.body, self.before[mesh.body].inverse()(rest))
            for kept, places, vertices in ((before, self.before, rest), (after, self.after, gone)):
                local = places[mesh.body].inverse()(vertices)
                kept.append((mesh.name, mesh.body, TriMesh(local, mesh.mesh.faces)))
        return before, after, [mesh.name for mesh in placed if mesh.fault]

    def meshes(self, files: Sequence[Path | None]) -> list[tuple[str, bytes]]:
        """The meshes where the map takes them, in their own frames, and their names."""
        written: list[tuple[str, bytes]] = []
        for mesh, now, path in zip(self.model.meshes, self.jointed.meshes, files, strict=True):
            if path is None:
                continue
            raw = read_surface(path, units=Unit.METRE)
            gone = self._gone(mesh.body, mesh.place(raw.vertices * mesh.factors))
            local = (self.after[mesh.body] @ now.place).inverse()(gone) / mesh.factors / _M
            name = f"{mesh.body}__{path.stem}"
            taken = [stem.rpartition(".")[0] for stem, _ in written]
            while name in taken:
                name += "_"
            written.append((f"{name}.obj", _obj(local, raw.faces)))
        return written


def _length(places: Sequence[Points]) -> float:
    return float(np.linalg.norm(np.diff(np.array(places), axis=0), axis=1).sum())


def _apart(text: str, other: str) -> float:
    """How far two places are that a file states."""
    return float(np.linalg.norm(np.subtract(*(np.array(said.split(), dtype=float) for said in (text, other)))))


def _text(values: Float) -> str:
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


def _obj(vertices: Points, faces: Any) -> bytes:
    buffer = io.StringIO()
    np.savetxt(buffer, vertices, fmt="v %.9g %.9g %.9g")
    np.savetxt(buffer, np.asarray(faces) + 1, fmt="f %d %d %d")
    return buffer.getvalue().encode()
