"""Joints of known axes and centres: revolved, toroidal and spherical surfaces with noise, at any fineness and pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.meshes import TriMesh
from musclefit.rig.articulation import FittedJoint
from musclefit.rig.joint_kinds import JointKind

Shape = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class KnownJoint:
    """Two bones, their joint's kind, a point of its first axis (or its centre), and its axes."""

    name: str
    kind: JointKind
    fixed: TriMesh
    moving: TriMesh
    centre: np.ndarray
    axes: np.ndarray


def patch(
    shape: Shape, u: tuple[float, float, int], v: tuple[float, float, int], offset: float, inwards: bool
) -> TriMesh:
    """A sheet over a grid of two parameters, moved along its outward normal by mm; its faces look out or in."""
    grid = np.meshgrid(np.linspace(*u), np.linspace(*v), indexing="ij")
    vertices = np.moveaxis(shape(*grid, offset), 0, -1).reshape(-1, 3)
    at = np.arange(u[2] * v[2]).reshape(u[2], v[2])
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = np.moveaxis(shape(*grid, offset + 1.0), 0, -1).reshape(-1, 3) - vertices
    agree = float(np.einsum("fi,fi->", normals, outwards[faces[:, 0]])) > 0.0
    return TriMesh(vertices, faces if agree is not inwards else faces[:, ::-1])


def revolved(radius: float, waist: float) -> Shape:
    """A surface of revolution about x: a roller of a radius, narrower by ``waist`` in its middle, as a trochlea is."""

    def shape(along: np.ndarray, turn: np.ndarray, offset: float) -> np.ndarray:
        bend = waist * np.cos(np.pi * along / 20.0)
        slope = waist * np.pi / 20.0 * np.sin(np.pi * along / 20.0)
        tilt = np.sqrt(1.0 + slope**2)
        r = radius - bend + offset / tilt
        return np.stack([along - offset * slope / tilt, r * np.sin(turn), -r * np.cos(turn)])

    return shape


def condylar(radius: float, front: float) -> Shape:
    """A trochlea about x whose front, from a quarter of a radian on, turns about another axis with another radius."""
    back = revolved(radius, 2.5)

    def shape(along: np.ndarray, turn: np.ndarray, offset: float) -> np.ndarray:
        more = np.where(turn < -0.25, front - radius, 0.0)
        y, z = (more * (of(turn) - of(-0.25)) for of in (np.sin, lambda angle: -np.cos(angle)))
        places: np.ndarray = back(along, turn, offset) + np.stack([np.zeros_like(y), y, z])
        return places

    return shape


def toroid(large: float, small: float) -> Shape:
    """Part of a torus: about x at the origin, and about y at a distance of large - small (negative: a saddle)."""

    def shape(tilt: np.ndarray, turn: np.ndarray, offset: float) -> np.ndarray:
        r = (large - small) + (small + offset) * np.cos(tilt)
        return np.stack([(small + offset) * np.sin(tilt), r * np.sin(turn), -r * np.cos(turn)])

    return shape


def sphere(radius: float) -> Shape:
    def shape(tilt: np.ndarray, turn: np.ndarray, offset: float) -> np.ndarray:
        r = radius + offset
        return np.stack([r * np.sin(tilt), r * np.cos(tilt) * np.sin(turn), -r * np.cos(tilt) * np.cos(turn)])

    return shape


def shaft(length: float, radius: float, *, start: float, sign: float, cuts: int) -> TriMesh:
    """The rest of a long bone: a tube along z."""
    turns, along = np.meshgrid(np.linspace(0, 2 * np.pi, cuts), np.linspace(0, length, cuts), indexing="ij")
    vertices = np.stack([radius * np.cos(turns), radius * np.sin(turns), sign * (start + along)], axis=-1).reshape(
        -1, 3
    )
    at = np.arange(cuts * cuts).reshape(cuts, cuts)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return TriMesh(vertices, faces if sign > 0 else faces[:, ::-1])


def together(*parts: TriMesh) -> TriMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return TriMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


SHAPES: dict[str, tuple[JointKind, Shape, tuple[float, float], tuple[float, float], np.ndarray, np.ndarray]] = {
    "roller": (JointKind.HINGE, revolved(10, 0), (-10, 10), (-10, 10), np.zeros(3), np.eye(3)[:1]),
    "trochlea": (JointKind.HINGE, revolved(11, 2.5), (-10, 10), (-10, 10), np.zeros(3), np.eye(3)[:1]),
    "condyles": (JointKind.HINGE, condylar(11, 25), (-10, 10), (-10, 10), np.zeros(3), np.eye(3)[:1]),
    "condyle": (JointKind.UNIVERSAL, toroid(14, 8), (-0.9, 0.9), (-0.7, 0.7), np.array([0, 0, -3.0]), np.eye(3)[:2]),
    "saddle": (JointKind.UNIVERSAL, toroid(10, -9), (-0.8, 0.8), (-0.7, 0.7), np.array([0, 0, -9.5]), np.eye(3)[:2]),
    "ball": (JointKind.BALL, sphere(24), (-1.3, 1.3), (-1.1, 1.1), np.zeros(3), np.zeros((0, 3))),
}
"""Kind, surface, its reach over the first parameter on the convex and on the hollow bone, centre and axes."""

TURNS = {"roller": (-2.0, 2.0), "trochlea": (-2.0, 2.0), "condyles": (-1.5, 2.2)}
"""Reach of the convex bone over the second parameter; of the others +-1.2."""

BEDS = {"roller": 1.2, "trochlea": 1.2, "condyles": 0.6}
"""The same of the hollow bone, to either side; of the others 0.9."""

SET_OFF_MM = {"condyles": -12.0}
"""Where the shaft of the convex bone is along y; of the others at 0."""


def known_joint(
    name: str,
    *,
    seed: int = 0,
    noise_mm: float = 0.2,
    cuts: tuple[int, int] = (40, 40),
    gap_mm: float = 2.0,
    scale: float = 1.0,
    mirrored: bool = False,
    moved: bool = True,
) -> KnownJoint:
    """A joint between two long bones; each is cut into so many parts each way, and lies anywhere."""
    kind, shape, reach, hollow, centre, axes = SHAPES[name]
    rng = np.random.default_rng(seed)
    bed = BEDS.get(name, 0.9)
    convex = patch(shape, (*reach, cuts[0]), (*TURNS.get(name, (-1.2, 1.2)), cuts[0]), 0.0, inwards=False)
    cup = patch(shape, (*hollow, cuts[1]), (-bed, bed, cuts[1]), gap_mm, inwards=True)
    moving = together(cup, shaft(150, 9, start=30, sign=-1.0, cuts=cuts[1]))
    rest = shaft(150, 9, start=14, sign=1.0, cuts=cuts[0])
    rest = TriMesh(rest.vertices + np.array([0.0, SET_OFF_MM.get(name, 0.0), 0.0]), rest.faces)
    fixed = together(convex, rest)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0] if moved else np.eye(3)
    rotation *= np.sign(np.linalg.det(rotation)) * (-1.0 if mirrored else 1.0)
    shift = rng.normal(size=3) * 200.0 if moved else np.zeros(3)

    def placed(mesh: TriMesh) -> TriMesh:
        rough = mesh.vertices + noise(mesh.vertices, noise_mm, rng)
        return TriMesh(scale * rough @ rotation.T + shift, mesh.faces[:, ::-1] if mirrored else mesh.faces)

    return KnownJoint(name, kind, placed(fixed), placed(moving), scale * rotation @ centre + shift, axes @ rotation.T)


@dataclass(frozen=True)
class Missed:
    """How far a fit is from what is known: the angle to the nearest axis, and the distance of axis or centre.

    Of two axes that were found the first counts; either where one alone is known.
    """

    degrees: float
    mm: float


def missed(found: FittedJoint, known: KnownJoint) -> Missed:
    off = found.centre - known.centre
    if known.kind is JointKind.BALL and not len(found.axes):
        return Missed(0.0, float(np.linalg.norm(off)))
    axis = found.axes[0]
    counting = found.axes[: len(found.axes) // len(known.axes)]
    degrees = min(float(np.degrees(np.arccos(min(1.0, abs(a @ own))))) for own in known.axes for a in counting)
    if known.kind is JointKind.HINGE:
        off = off - (off @ axis) * axis
    return Missed(degrees, float(np.linalg.norm(off)))


def noise(vertices: np.ndarray, rms_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Waves of 6 mm and more in all directions, as of a segmentation that is off here and there."""
    total = np.zeros_like(vertices)
    count = 24
    for _ in range(count):
        way = rng.normal(size=3)
        way *= 2.0 * np.pi / (rng.uniform(6.0, 20.0) * np.linalg.norm(way))
        total += rng.normal(size=3) * np.sin(vertices @ way + rng.uniform(0, 2 * np.pi))[:, None]
    waves: np.ndarray = rms_mm * total / np.sqrt(0.5 * count)
    return waves
