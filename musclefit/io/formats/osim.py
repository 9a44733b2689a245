"""OpenSim models (.osim, versions 2 to 4): bytes -> bodies, joints, meshes, muscle paths, markers, wraps."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.texts import LARGEST_MM
from musclefit.io.formats.xml_in_place import Element, parse_xml
from musclefit.rig.multibody import (
    GROUND,
    BodyJoint,
    Coordinate,
    CoordinateFunction,
    CoordinateKind,
    Coupler,
    JointAxis,
    Linear,
    Multibody,
    Multiple,
    PiecewiseLinear,
    Polynomial,
    SimmSpline,
)
from musclefit.rig.place_curves import PlaceCurve
from musclefit.vocabulary import Unit

UNLIMITED = ("range", "coefficients")
"""What may hold numbers of any size: ranges without an end, factors of powers."""

OLDEST, NEWEST, NEW_LAYOUT = 20302, 49999, 40000
"""Versions of the file that are read; from the last one on, joints stand in a set of their own and name frames."""

_X, _Y, _Z = np.eye(3)
_TURNS = {
    "PinJoint": (_Z,),
    "UniversalJoint": (_X, _Y),
    "GimbalJoint": (_X, _Y, _Z),
    "BallJoint": (_X, _Y, _Z),
    "FreeJoint": (_X, _Y, _Z),
    "PlanarJoint": (_Z,),
    "SliderJoint": (),
    "WeldJoint": (),
    "CustomJoint": (),
}
_SLIDES = {"FreeJoint": (_X, _Y, _Z), "PlanarJoint": (_X, _Y), "SliderJoint": (_X,)}
WRAP_SIZES = {
    "WrapCylinder": ("radius", "length"),
    "WrapEllipsoid": ("dimensions",),
    "WrapSphere": ("radius",),
    "WrapTorus": ("inner_radius", "outer_radius"),
}
"""Wrap objects that are read, and the elements that hold their sizes."""
_KNOTTED = ("Constant", "SimmSpline", "NaturalCubicSpline", "PiecewiseLinearFunction")
"""Functions that are stated by their values."""

_POINTS = ("PathPoint", "ConditionalPathPoint", "MovingPathPoint")


@dataclass(frozen=True, eq=False, slots=True)
class BodyMesh:
    """A file of geometry on a body: its place there (mm), factors of its three axes before that, where it is named."""

    body: str
    file: str
    place: RigidMotion
    factors: Float
    element: Element


@dataclass(frozen=True, eq=False, slots=True)
class BodyPoint:
    """A point fixed to a body: of a muscle's path (``of`` is the muscle), a marker (``of`` is ""), or a mass centre.

    ``at`` (3,) is in the body's frame, in the default pose, mm; ``element`` is where its numbers stand. A point that
    coordinates move has a curve in ``frame``, and ``functions`` are where the numbers of its three functions stand.
    """

    of: str
    name: str
    kind: str
    body: str
    at: Points
    element: Element
    frame: RigidMotion
    """Of the numbers, in the body's, mm."""
    curve: PlaceCurve | None = None
    functions: tuple[Element | None, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class WrapObject:
    """A surface that muscle paths wrap over, in its body's frame, mm."""

    name: str
    kind: str
    body: str
    place: RigidMotion
    sizes_mm: Float
    element: Element
    frame: RigidMotion
    """Of the numbers, in the body's, mm."""


@dataclass(frozen=True, eq=False, slots=True)
class FramePlace:
    """Where the place of a joint's frame stands in the file, and the frame that its numbers are in, in the body's."""

    element: Element
    frame: RigidMotion


@dataclass(frozen=True, eq=False, slots=True)
class OpenSimModel:
    """What a model holds.

    Parameters
    ----------
    name, source : str
    version : int
    multibody : Multibody
    meshes : tuple of BodyMesh
    points : tuple of BodyPoint
    wraps : tuple of WrapObject
    not_followed : tuple of str
        What the kinematics leave out, in words.
    joint_places : mapping of joint to two FramePlaces or None
        Where the places of its frames in parent and child stand; None where they are the bodies' own, or those of
        frames that no joint holds.
    slides : mapping of joint to tuple of Element or None
        Where the numbers of the functions stand that slide a custom joint along its three axes.
    data : bytes
    root : Element
    """

    name: str
    source: str
    version: int
    multibody: Multibody
    meshes: tuple[BodyMesh, ...]
    points: tuple[BodyPoint, ...]
    wraps: tuple[WrapObject, ...]
    not_followed: tuple[str, ...]
    joint_places: Mapping[str, tuple[FramePlace | None, FramePlace | None]]
    slides: Mapping[str, tuple[Element | None, ...]]
    data: bytes
    root: Element


_LONGEST_VERSION = 9
"""Digits of a file version: no version has more, and Python refuses to convert thousands."""


def parse_osim(data: bytes, *, source: str) -> OpenSimModel:
    """Read an OpenSim model.

    Raises
    ------
    InputError
        No valid XML, no OpenSim model, a version that is not read, joints or functions of a kind that is not read, or
        a name that nothing has; the message names the line and the way out.
    """
    root = parse_xml(data, source=source)
    model = root.child("Model")
    if root.tag != "OpenSimDocument" or model is None:
        raise InputError(f"{source}: holds <{root.tag}>; expected an OpenSim model, <OpenSimDocument> with a <Model>")
    stated = root.attributes.get("Version", "")
    if not stated.isdecimal() or len(stated) > _LONGEST_VERSION or not OLDEST <= int(stated) <= NEWEST:
        raise InputError(
            f"{source}: file version {stated[:20] or 'none'}; {OLDEST} to {NEWEST} are read: save it in OpenSim 4"
        )
    return _Reader(source, int(stated), model, data, root).read()


@dataclass(slots=True)
class _Reader:
    """One file on its way from elements to a model."""

    source: str
    version: int
    model: Element
    data: bytes
    root: Element
    bodies: Mapping[str, Element] | None = None
    joint_places: dict[str, tuple[FramePlace | None, FramePlace | None]] = field(default_factory=dict)
    slides: dict[str, tuple[Element | None, ...]] = field(default_factory=dict)
    length_mm: float = 1000.0
    paths: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """Of each component, by the id of its element."""
    frames: dict[tuple[str, ...], Element] = field(default_factory=dict)
    """The offset frames, by their paths."""
    of_joints: set[int] = field(default_factory=set)
    """Ids of the offset frames that joints hold."""

    def read(self) -> OpenSimModel:
        unit = self.model.words("length_units") or "meters"
        if unit not in ("meters", "m"):
            raise InputError(f"{self.source}: length_units is {unit!r}; expected meters, as OpenSim computes")
        self.length_mm = Unit.METRE.in_mm
        bodies = {body.name: body for body in self.model.objects("BodySet") if body.tag == "Body"}
        if not bodies:
            raise InputError(f"{self.source}: the model has no body; expected a <BodySet> with bodies")
        self.bodies = bodies
        self._index(self.model, ())
        coordinates: dict[str, Coordinate] = {}
        joints = [self._joint(element, child, coordinates) for element, child in self._joints()]
        multibody = Multibody.of(joints, coordinates, self._couplers(coordinates), source=self.source)
        for body in bodies:
            if body not in (GROUND, *multibody.bodies):
                raise InputError(f"{self.source}: body {body!r} has no joint; give it one")
        return OpenSimModel(
            name=self.model.name,
            source=self.source,
            version=self.version,
            multibody=multibody,
            meshes=tuple(self._meshes()),
            points=(*self._path_points(multibody.values({})), *self._markers(), *self._mass_centres()),
            wraps=tuple(self._wraps()),
            not_followed=self._not_followed(),
            joint_places=self.joint_places,
            slides=self.slides,
            data=self.data,
            root=self.root,
        )

    # --- joints

    def _joints(self) -> Iterator[tuple[Element, str]]:
        """Joints, each with the body that it stands in where the layout is the old one."""
        own = self.model.objects("JointSet")
        yield from ((joint, "") for joint in own)
        if not own:
            for body in (self.bodies or {}).values():
                holder = body.child("Joint")
                for joint in holder.children if holder else ():
                    yield joint, body.name

    def _joint(self, joint: Element, child: str, coordinates: dict[str, Coordinate]) -> BodyJoint:
        if joint.tag not in _TURNS:
            raise self._error(
                joint, f"joint {joint.name!r} is a {joint.tag}; read are {', '.join(_TURNS)}: model it as a CustomJoint"
            )
        if joint.words("reverse") == "true":
            raise self._error(joint, f"joint {joint.name!r} is reversed; swap its parent and child in OpenSim")
        if child:
            parent = joint.words("parent_body")
            in_parent = self._frame_of(joint, "location_in_parent", "orientation_in_parent")
            in_child = self._frame_of(joint, "location", "orientation")
            at_parent, at_child = (
                _place(joint.child(tag), RigidMotion.identity()) for tag in ("location_in_parent", "location")
            )
        else:
            parent, in_parent, at_parent = self._joined(joint, "parent_frame")
            child, in_child, at_child = self._joined(joint, "child_frame")
        self.joint_places[joint.name] = at_parent, at_child
        listed = list(joint.all("Coordinate"))
        turns, slides = self._axes(joint, [element.name for element in listed])
        for element in listed:
            coordinates[element.name] = self._coordinate(element, joint.name, turns, slides)
        for axis in (*turns, *slides):
            if axis.coordinate and axis.coordinate not in [element.name for element in listed]:
                raise self._error(joint, f"joint {joint.name!r} has no coordinate {axis.coordinate!r}")
        return BodyJoint(joint.name, parent, child, in_parent, in_child, turns, slides, self.length_mm)

    def _axes(self, joint: Element, names: list[str]) -> tuple[tuple[JointAxis, ...], tuple[JointAxis, ...]]:
        if joint.tag == "CustomJoint":
            transform = joint.child("SpatialTransform")
            if transform is None:
                raise self._error(joint, f"joint {joint.name!r} has no SpatialTransform; save the model in OpenSim 4")
            found = [axis for axis in transform.children if axis.tag == "TransformAxis"]
            axes = [self._transform_axis(axis) for axis in found]
            if len(axes) != 6:
                raise self._error(transform, f"joint {joint.name!r} has {len(axes)} transform axes; expected 6")
            self.slides[joint.name] = tuple(_numbers_of(_function_of(axis)) for axis in found[3:])
            return tuple(axes[:3]), tuple(axes[3:])
        turning, sliding = _TURNS[joint.tag], _SLIDES.get(joint.tag, ())
        if len(names) != len(turning) + len(sliding):
            count = len(turning) + len(sliding)
            raise self._error(joint, f"joint {joint.name!r} has {len(names)} coordinates; a {joint.tag} has {count}")
        turns = tuple(JointAxis(axis, name, Linear()) for axis, name in zip(turning, names, strict=False))
        slides = zip(sliding, names[len(turning) :], strict=True)
        return turns, tuple(JointAxis(axis, name, Linear()) for axis, name in slides)

    def _transform_axis(self, axis: Element) -> JointAxis:
        names = axis.words("coordinates").split()
        if len(names) > 1:
            raise self._error(axis, f"axis {axis.name!r} depends on {len(names)} coordinates; at most one is read")
        direction = self._numbers(axis, "axis", 3)
        if not np.linalg.norm(direction) > 0.0:
            raise self._error(axis, f"axis {axis.name!r} has length 0; give it a direction")
        function = _function_of(axis)
        made: CoordinateFunction = Linear(1.0 if names else 0.0) if function is None else self._function(function)
        return JointAxis(direction, names[0] if names else "", made)

    def _function(self, element: Element) -> CoordinateFunction:
        makers: dict[str, Callable[[Element], CoordinateFunction]] = {
            "Constant": lambda e: Linear(0.0, float(self._numbers(e, "value", 1)[0])),
            "LinearFunction": lambda e: Linear(*self._numbers(e, "coefficients", 2).tolist()),
            "PolynomialFunction": lambda e: Polynomial(tuple(self._numbers(e, "coefficients").tolist())),
            "SimmSpline": lambda e: SimmSpline.through(*self._knots(e)),
            "NaturalCubicSpline": lambda e: SimmSpline.through(*self._knots(e)),
            "PiecewiseLinearFunction": lambda e: PiecewiseLinear(*self._knots(e)),
            "MultiplierFunction": self._multiple,
        }
        if element.tag not in makers:
            raise self._error(element, f"function {element.tag} is not read; known are {', '.join(makers)}")
        return makers[element.tag](element)

    def _multiple(self, element: Element) -> CoordinateFunction:
        holder = element.child("function")
        if holder is None or not holder.children:
            raise self._error(element, "a MultiplierFunction without a function; correct it")
        factor = float(self._numbers(element, "scale", 1)[0]) if element.child("scale") else 1.0
        return Multiple(factor, self._function(holder.children[0]))

    def _knots(self, element: Element) -> tuple[Float, Float]:
        x, y = self._numbers(element, "x"), self._numbers(element, "y")
        if len(x) != len(y) or len(x) < 2 or not (np.diff(x) > 0.0).all():
            raise self._error(element, f"{len(x)} x and {len(y)} y; expected at least two of each, x rising")
        return x, y

    def _coordinate(
        self, element: Element, joint: str, turns: tuple[JointAxis, ...], slides: tuple[JointAxis, ...]
    ) -> Coordinate:
        kind = CoordinateKind.COUPLED
        for axes, of in ((slides, CoordinateKind.TRANSLATIONAL), (turns, CoordinateKind.ROTATIONAL)):
            for axis in axes:
                if axis.coordinate == element.name and isinstance(axis.function, Linear) and axis.function.slope:
                    kind = of
        low, high = self._numbers(element, "range", 2) if element.child("range") else (-np.inf, np.inf)
        default = float(self._numbers(element, "default_value", 1)[0]) if element.child("default_value") else 0.0
        clamped, locked = (element.words(tag) == "true" for tag in ("clamped", "locked"))
        return Coordinate(element.name, joint, kind, default, float(low), float(high), clamped, locked)

    def _couplers(self, coordinates: Mapping[str, Coordinate]) -> list[Coupler]:
        couplers = []
        for element in self.model.objects("ConstraintSet"):
            if element.tag != "CoordinateCouplerConstraint" or _off(element):
                continue
            independent = element.words("independent_coordinate_names").split()
            dependent = element.words("dependent_coordinate_name")
            if len(independent) != 1:
                raise self._error(element, f"{element.name!r} follows {len(independent)} coordinates; one is read")
            for name in (*independent, dependent):
                if name not in coordinates:
                    raise self._error(element, f"{element.name!r} names coordinate {name!r}, which no joint has")
            holder = element.child("coupled_coordinates_function")
            if holder is None or not holder.children:
                raise self._error(element, f"{element.name!r} has no function; correct it")
            function = self._function(holder.children[0])
            if element.child("scale_factor"):
                function = Multiple(float(self._numbers(element, "scale_factor", 1)[0]), function)
            couplers.append(Coupler(element.name, dependent, independent[0], function))
        return couplers

    def _not_followed(self) -> tuple[str, ...]:
        return tuple(
            f"{element.tag} {element.name!r}: kinematics of the joints alone do not keep it"
            for element in self.model.objects("ConstraintSet")
            if element.tag != "CoordinateCouplerConstraint" and not _off(element)
        )

    # --- frames

    def _index(self, element: Element, path: tuple[str, ...]) -> None:
        """The paths of the components below an element, and the offset frames by them."""
        for child in element.children:
            name = child.name or (child.tag.lower() if child.tag.endswith("Set") and not path else "")
            there = (*path, name) if name else path
            self.paths[id(child)] = there
            if child.tag == "PhysicalOffsetFrame":
                self.frames.setdefault(there, child)
            if child.tag in _TURNS:
                self.of_joints.update(id(frame) for frame in child.objects("frames"))
            self._index(child, there)

    def _joined(self, joint: Element, socket: str) -> tuple[str, RigidMotion, FramePlace | None]:
        """The body that a joint's frame is on, its place there, and where that stands if a joint holds it."""
        said = _socket(joint, socket)
        if not said:
            raise self._error(joint, f"joint {joint.name!r} names no {socket}; save the model in OpenSim 4")
        body, place = self._resolve(said, joint)
        frame = self._offset_frame(said, joint)
        if frame is None or id(frame) not in self.of_joints:
            return body, place, None
        return body, place, _place(frame.child("translation"), self._resolve(_socket(frame, "parent"), frame)[1])

    def _offset_frame(self, path: str, of: Element) -> Element | None:
        """The offset frame that a path names as ``of`` states it, by its last word alone where that is enough."""
        words = [] if path.startswith("/") else list(self.paths[id(of)])
        for word in path.split("/"):
            if word == "..":
                words = words[:-1]
            elif word not in ("", "."):
                words.append(word)
        if tuple(words) in self.frames:
            return self.frames[tuple(words)]
        called = [found for found in self.frames.values() if words and found.name == words[-1]]
        if len(called) > 1:
            lines = ", ".join(str(found.line) for found in called)
            raise self._error(
                of,
                f"{of.tag} {of.name!r} names frame {path!r}, and {len(called)} frames have that name (lines {lines}); "
                "state the whole path, such as /jointset/knee/femur_offset",
            )
        return called[0] if called else None

    def _resolve(self, path: str, of: Element, *, deeper: int = 0) -> tuple[str, RigidMotion]:
        """The body of a frame by its path, and the frame's place there."""
        name = path.rstrip("/").rpartition("/")[2]
        bodies = self.bodies or {}
        if name == GROUND or name in bodies:
            return name, RigidMotion.identity()
        frame = self._offset_frame(path, of)
        parent = "" if frame is None else _socket(frame, "parent")
        if frame is not None and parent and deeper < len(self.frames):
            body, place = self._resolve(parent, frame, deeper=deeper + 1)
            return body, place @ self._frame_of(frame, "translation", "orientation")
        known = ", ".join(sorted(bodies)[:8])
        raise self._error(of, f"{of.tag} {of.name!r} names frame {path!r}, which is not there ({known}, ...)")

    def _frame_of(self, element: Element, location: str, orientation: str) -> RigidMotion:
        at = self._numbers(element, location, 3) if element.child(location) else np.zeros(3)
        turn = self._numbers(element, orientation, 3) if element.child(orientation) else np.zeros(3)
        return RigidMotion(body_fixed_xyz(turn), at * self.length_mm)

    # --- what stands on bodies

    def _standing(self, *tags: str) -> Iterator[tuple[Element, Element, str, RigidMotion]]:
        """Elements on the ground, on bodies and in their offset frames: owner, element, body and the frame's place."""
        ground = self.model.child("Ground")
        if ground is not None:
            yield from self._below(ground, tags, (ground, GROUND, RigidMotion.identity()))
        for name, body in (self.bodies or {}).items():
            yield from self._below(body, tags, (body, name, RigidMotion.identity()))
        for frame in self.frames.values():
            if id(frame) in self.of_joints:
                yield from self._below(frame, tags, (frame, *self._own_place(frame)))

    def _below(
        self, element: Element, tags: Sequence[str], on: tuple[Element, str, RigidMotion]
    ) -> Iterator[tuple[Element, Element, str, RigidMotion]]:
        for child in element.children:
            if child.tag in tags:
                yield on[0], child, on[1], on[2]
            within = child.tag == "PhysicalOffsetFrame"
            if not (within and id(child) in self.of_joints):
                yield from self._below(child, tags, (child, *self._own_place(child)) if within else on)

    def _own_place(self, frame: Element) -> tuple[str, RigidMotion]:
        return self._resolve("/" + "/".join(self.paths[id(frame)]), frame)

    def _meshes(self) -> Iterator[BodyMesh]:
        for owner, mesh, body, frame in self._standing("Mesh", "DisplayGeometry"):
            file = mesh.words("mesh_file") or mesh.words("geometry_file")
            if not file:
                continue
            factors = self._numbers(mesh, "scale_factors", 3) if mesh.child("scale_factors") else np.ones(3)
            name, place = body, frame
            if mesh.tag == "DisplayGeometry":
                visible = owner.child("VisibleObject")
                if visible is not None and visible.child("scale_factors"):
                    factors = factors * self._numbers(visible, "scale_factors", 3)
                if mesh.child("transform"):
                    six = self._numbers(mesh, "transform", 6)
                    place = RigidMotion(body_fixed_xyz(six[:3]), six[3:] * self.length_mm)
            elif (socket := _socket(mesh, "frame")) not in ("", ".."):
                name, place = self._resolve(socket, mesh)
            where = mesh.child("mesh_file") or mesh.child("geometry_file")
            assert where is not None
            yield BodyMesh(name, file, place, factors, where)

    def _point(self, element: Element, tag: str, *, of: str, kind: str, body: str | None = None) -> BodyPoint:
        path = body or _socket(element, "parent_frame") or element.words("body")
        if not path:
            raise self._error(element, f"{element.tag} {element.name!r} names no body; give it one")
        on, frame = self._resolve(path, element)
        at = element.child(tag)
        if at is None:
            raise self._error(element, f"{element.tag} {element.name!r} has no {tag}; give it one")
        place = frame(self._numbers(element, tag, 3)[None] * self.length_mm)[0]
        return BodyPoint(of, element.name, kind, on, place, at, frame)

    def _path_points(self, values: Mapping[str, float]) -> Iterator[BodyPoint]:
        for holder in self.model.all("ForceSet", "ComponentSet"):
            for force in holder.objects("objects") or holder.children:
                for points in force.all("PathPointSet"):
                    for point in points.all(*_POINTS):
                        if point.tag != "MovingPathPoint":
                            yield self._point(point, "location", of=force.name, kind=point.tag)
                        elif self._followed(point, values):
                            yield self._moving(point, values, of=force.name)

    def _followed(self, point: Element, values: Mapping[str, float]) -> bool:
        """Whether a moving point's functions and coordinates are all of a kind that is read."""
        functions = [_held(point, f"{axis}_location") for axis in "xyz"]
        return all(function is not None and _innermost(function).tag in _KNOTTED for function in functions) and all(
            self._moved_by(point, axis) in values for axis in "xyz"
        )

    def _moved_by(self, point: Element, axis: str) -> str:
        path = _socket(point, f"{axis}_coordinate") or point.words(f"{axis}_coordinate")
        return path.rpartition("/")[2]

    def _moving(self, point: Element, values: Mapping[str, float], *, of: str) -> BodyPoint:
        on, frame = self._resolve(_socket(point, "parent_frame") or point.words("body"), point)
        axes, functions = [], []
        for direction, axis in zip(np.eye(3), "xyz", strict=True):
            function = _held(point, f"{axis}_location")
            assert function is not None
            axes.append(JointAxis(direction, self._moved_by(point, axis), self._function(function)))
            functions.append(_numbers_of(function))
        curve = PlaceCurve(tuple(axes), self.length_mm)
        at = frame(curve.at(values)[None])[0]
        return BodyPoint(of, point.name, point.tag, on, at, point, frame, curve, tuple(functions))

    def _markers(self) -> Iterator[BodyPoint]:
        for marker in self.model.all("Marker"):
            yield self._point(marker, "location", of="", kind="Marker")

    def _mass_centres(self) -> Iterator[BodyPoint]:
        for name, body in (self.bodies or {}).items():
            if body.child("mass_center") is not None:
                yield self._point(body, "mass_center", of="", kind="mass_center", body=name)

    def _wraps(self) -> Iterator[WrapObject]:
        for _, wrap, body, frame in self._standing(*WRAP_SIZES):
            sizes = np.concatenate([self._numbers(wrap, tag) for tag in WRAP_SIZES[wrap.tag]]) * self.length_mm
            place = frame @ self._frame_of(wrap, "translation", "xyz_body_rotation")
            yield WrapObject(wrap.name, wrap.tag, body, place, sizes, wrap, frame)

    def _numbers(self, element: Element, tag: str, count: int | None = None) -> Float:
        child = element.child(tag)
        words = child.text.split() if child else []
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise self._error(child or element, f"{tag} of {element.tag} {element.name!r}: {error}") from None
        if (count is not None and len(values) != count) or not len(values) or not np.isfinite(values).all():
            expected = f"{count} finite numbers" if count else "finite numbers"
            found = child.text.strip()[:60] if child else "nothing"
            raise self._error(
                child or element, f"{tag} of {element.tag} {element.name!r} is {found!r}; expected {expected}"
            )
        largest = float(np.abs(values).max())
        if largest > LARGEST_MM and tag not in UNLIMITED:
            raise self._error(
                child or element,
                f"{tag} of {element.tag} {element.name!r} holds {largest:.6g}, which is no length or angle of a body "
                f"(at most {LARGEST_MM:.0e}); the file is damaged",
            )
        return values

    def _error(self, element: Element, message: str) -> InputError:
        return InputError(f"{self.source}: line {element.line}: {message}")


def _function_of(axis: Element) -> Element | None:
    """The function of a transform's axis, which stands in it or in a holder."""
    holder = axis.child("function")
    return next(iter(holder.children if holder else axis.children[2:]), None)


def _held(point: Element, holder: str) -> Element | None:
    """The function in a holder."""
    found = point.child(holder)
    return next(iter(found.children), None) if found else None


def _innermost(function: Element) -> Element:
    """The function that others multiply."""
    while function.tag == "MultiplierFunction" and (holder := function.child("function")) and holder.children:
        function = holder.children[0]
    return function


def _numbers_of(function: Element | None) -> Element | None:
    """Where the numbers of a function stand that may be replaced by others: a constant, or values at knots."""
    if function is None or _innermost(function).tag not in _KNOTTED:
        return None
    inner = _innermost(function)
    return inner.child("value" if inner.tag == "Constant" else "y")


def body_fixed_xyz(angles: Float) -> Float:
    """The rotation by angles (3,), radians, about x, then the new y, then the new z."""
    return np.asarray(Rotation.from_euler("XYZ", angles).as_matrix())


def _place(element: Element | None, frame: RigidMotion) -> FramePlace | None:
    return None if element is None else FramePlace(element, frame)


def _off(constraint: Element) -> bool:
    return constraint.words("isEnforced") == "false" or constraint.words("isDisabled") == "true"


def _socket(element: Element, name: str) -> str:
    """The path that a socket states; also in the spelling of file versions 30500 to 39999."""
    said = element.words(f"socket_{name}")
    if said:
        return said
    holder = element.child("connectors")
    for connector in holder.children if holder else ():
        if connector.name == name or re.fullmatch(rf"{name}(_frame)?", connector.name):
            return connector.words("connectee_name")
    return ""
