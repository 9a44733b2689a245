"""Closed surfaces from implicit shapes: shapes are array functions, negative inside; they know lengths, not anatomy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import TypeAlias

import numpy as np
from scipy import sparse
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Float, Points
from musclefit.geometry.meshes import TriMesh

Shape: TypeAlias = Callable[[Points], Float]
"""(N, 3) points, mm -> (N,) values, mm: negative inside, close to the signed distance near the surface."""

SAMPLE_SPACING_MM = 0.5
"""Distance of the samples along a tube's centreline; the seam between two samples is below spacing²·curvature/8."""

REACH_MM = 8.0
"""How far outside a shape what is taken away from it is still evaluated; beyond two cells of any lattice in use."""

NEVER = 1e3
"""Value (mm) of a shape where it was not evaluated because the answer cannot matter."""


def smooth_minimum(first: Float, second: Float, *, blend_mm: float) -> Float:
    """Minimum of two fields, rounded over ``blend_mm``; never above the sharp minimum, at most ``blend_mm/4`` below.

    References
    ----------
    I. Quilez, "Smooth minimum" (2013), the quadratic polynomial.
    """
    overlap = np.maximum(blend_mm - np.abs(first - second), 0.0)
    rounded: Float = np.minimum(first, second) - overlap**2 / (4.0 * blend_mm)
    return rounded


def smooth_maximum(first: Float, second: Float, *, blend_mm: float) -> Float:
    """Maximum of two fields, rounded over ``blend_mm``; never below the sharp maximum."""
    return -smooth_minimum(-first, -second, blend_mm=blend_mm)


def union(*shapes: Shape, blend_mm: float) -> Shape:
    """The shapes joined, with fillets ``blend_mm`` wide."""

    def field(points: Points) -> Float:
        return reduce(lambda a, b: smooth_minimum(a, b, blend_mm=blend_mm), (shape(points) for shape in shapes))

    return field


def offset(shape: Shape, *, by_mm: float) -> Shape:
    """The shape grown by ``by_mm`` (shrunk when negative)."""
    return lambda points: shape(points) - by_mm


def carved(shape: Shape, tool: Shape, *, gap_mm: float, blend_mm: float) -> Shape:
    """The shape less everything closer than ``gap_mm`` to the tool, edges rounded over ``blend_mm``.

    The tool is evaluated only where it can matter: up to ``REACH_MM`` outside the shape.
    """

    def field(points: Points) -> Float:
        values = shape(points)
        near = values < REACH_MM
        if near.any():
            cut = gap_mm - tool(points[near])
            values = values.copy()
            values[near] = smooth_maximum(values[near], cut, blend_mm=blend_mm)
        return values

    return field


def parted(shape: Shape, other: Shape, *, gap_mm: float, blend_mm: float) -> Shape:
    r"""The part of a shape that is deeper in it than in ``other``, half a gap short of the border.

    .. math:: f' = \max\bigl(f,\; \tfrac{1}{2}(f - g + \text{gap})\bigr)

    ``parted(a, b)`` and ``parted(b, a)`` share no point, and where both fields are distances they lie ``gap_mm`` apart.
    """

    def field(points: Points) -> Float:
        values = shape(points)
        near = values < REACH_MM
        if near.any():
            border = 0.5 * (values[near] - other(points[near]) + gap_mm)
            values = values.copy()
            values[near] = smooth_maximum(values[near], border, blend_mm=blend_mm)
        return values

    return field


def swept_about_x(
    shape: Shape, *, turn_deg: tuple[float, float], half_length_mm: float, radius_mm: float, spacing_mm: float
) -> Shape:
    """What a shape sweeps when it turns about the x axis (right-hand rule) through a range of angles.

    The shape is sampled once on a cylindrical lattice about the axis (``spacing_mm`` along and across, as fine around
    at the rim), where a sweep is a running minimum over the angle; between the nodes values are trilinear.

    Parameters
    ----------
    shape : Shape
    turn_deg : first and last angle
    half_length_mm, radius_mm
        The sweep is known in |x| < ``half_length_mm`` within ``radius_mm`` of the axis and is ``NEVER`` elsewhere.
    spacing_mm : float
    """
    x = np.linspace(-half_length_mm, half_length_mm, int(np.ceil(2.0 * half_length_mm / spacing_mm)) + 1)
    rho = np.linspace(0.0, radius_mm, int(np.ceil(radius_mm / spacing_mm)) + 1)
    n_angles = int(np.ceil(2.0 * np.pi * radius_mm / spacing_mm))
    angle = np.arange(n_angles) * (2.0 * np.pi / n_angles)
    xs, rhos, angles = np.meshgrid(x, rho, angle, indexing="ij")
    nodes = np.stack([xs, rhos * np.cos(angles), rhos * np.sin(angles)], axis=-1)
    values = shape(nodes.reshape(-1, 3)).reshape(xs.shape)
    first, last = (round(turn * n_angles / 360.0) for turn in turn_deg)
    turned = reduce(np.minimum, (np.roll(values, k, axis=2) for k in range(first, last + 1)))
    closed = np.concatenate([turned, turned[:, :, :1]], axis=2)

    def field(points: Points) -> Float:
        distance = np.hypot(points[:, 1], points[:, 2])
        around = np.mod(np.arctan2(points[:, 2], points[:, 1]), 2.0 * np.pi) / (2.0 * np.pi) * n_angles
        along = (points[:, 0] + half_length_mm) / (x[1] - x[0])
        found: Float = map_coordinates(closed, [along, distance / (rho[1] - rho[0]), around], order=1, cval=NEVER)
        return found

    return field


def within_box(shape: Shape, box: Float) -> Shape:
    """The shape's field inside a box given by its (2, 3) corners, mm, and ``NEVER`` outside.

    For neighbours and tools: what is far away need not be evaluated, since ``carved`` and ``parted`` ignore it.
    """

    def field(points: Points) -> Float:
        values = np.full(len(points), NEVER)
        near = np.logical_and.reduce([(points[:, k] > box[0, k]) & (points[:, k] < box[1, k]) for k in range(3)])
        if near.any():
            values[near] = shape(points[near])
        return values

    return field


def ball(centre: Points, *, radius_mm: float) -> Shape:
    """A ball; the field is the exact distance."""
    return lambda points: _lengths(points - centre) - radius_mm


def ellipsoid(centre: Points, *, semi_axes_mm: Points, rotation: Float) -> Shape:
    """An ellipsoid whose axes are the columns of ``rotation``; see ``ellipsoid_distance``."""
    return lambda points: ellipsoid_distance((points - centre) @ rotation, np.asarray(semi_axes_mm, dtype=np.float64))


def ellipsoid_distance(local: Points, semi_axes: Float) -> Float:
    r"""First-order distance to an axis-aligned ellipsoid: :math:`k_0 (k_0 - 1) / k_1`.

    Exact for spheres and on the surface; :math:`k_0 = |x / s|`, :math:`k_1 = |x / s^2|` element by element.
    At the centre, where the formula has no value, it is minus the smallest semi-axis.
    """
    scaled = local / semi_axes
    level, slope = _lengths(scaled), _lengths(scaled / semi_axes)
    smallest = np.broadcast_to(np.min(semi_axes, axis=-1), level.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance: Float = np.where(level > 1e-9, level * (level - 1.0) / slope, -smallest)
    return distance


def _lengths(vectors: Points) -> Float:
    """Of (n, 3) vectors; several times faster than numpy's norm along so short an axis."""
    lengths: Float = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths


def cylinder(*, start: Points, end: Points, radius_mm: float, rounding_mm: float) -> Shape:
    """A solid cylinder with rounded rims; the field is the exact distance."""
    axis = np.asarray(end) - np.asarray(start)
    half = 0.5 * float(np.linalg.norm(axis))
    axis = axis / (2.0 * half)
    middle = 0.5 * (np.asarray(start) + np.asarray(end))

    def field(points: Points) -> Float:
        relative = points - middle
        along = relative @ axis
        across = np.linalg.norm(relative - along[:, None] * axis, axis=1)
        excess = np.column_stack([across - radius_mm + rounding_mm, np.abs(along) - half + rounding_mm])
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
        distance: Float = outside + np.minimum(excess.max(axis=1), 0.0) - rounding_mm
        return distance

    return field


def revolved(stations: Float, radii: Float, *, margin_mm: float) -> Shape:
    """A solid of revolution about the x axis: radius by a monotone cubic through (station, radius), flat ends.

    ``margin_mm`` widens the solid on every side without moving the profile's stations.
    """
    profile = PchipInterpolator(stations, radii)
    slope = profile.derivative()
    low, high = float(stations[0]), float(stations[-1])

    def field(points: Points) -> Float:
        x = np.clip(points[:, 0], low, high)
        radial = (np.hypot(points[:, 1], points[:, 2]) - profile(x)) / np.hypot(1.0, slope(x))
        axial = np.abs(points[:, 0] - 0.5 * (low + high)) - 0.5 * (high - low)
        distance: Float = np.maximum(radial, axial) - margin_mm
        return distance

    return field


def tube(knots: Points, semi_axes_mm: Points, *, width_direction: Points) -> Shape:
    """A tube of elliptic sections along a smooth curve, with rounded ends.

    Parameters
    ----------
    knots : (k, 3) float64, mm
        The curve passes through them (natural cubic spline over chord length).
    semi_axes_mm : (k, 2) float64
        Half width and half depth at the knots; monotone cubics between them.
    width_direction : (3,) or (k, 3) float64
        The direction of the width (made perpendicular to the curve), for all knots or each.

    Returns
    -------
    Shape
        The first-order distance of ``ellipsoid_distance`` from the nearest point of the curve. The ends are half
        ellipsoids as long as the section's smaller semi-axis.
    """
    knots = np.asarray(knots, dtype=np.float64)
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    stations = np.linspace(0.0, chords[-1], int(np.ceil(chords[-1] / SAMPLE_SPACING_MM)) + 1)
    curve = CubicSpline(chords, knots, bc_type="natural")
    centres = curve(stations)
    tangents = curve(stations, 1)
    speeds = np.linalg.norm(tangents, axis=1)
    tangents = tangents / speeds[:, None]
    sections = PchipInterpolator(chords, np.asarray(semi_axes_mm, dtype=np.float64))
    widths = PchipInterpolator(chords, np.broadcast_to(np.asarray(width_direction, dtype=np.float64), knots.shape))
    across = widths(stations)
    across = across - np.sum(across * tangents, axis=1)[:, None] * tangents
    across = across / np.linalg.norm(across, axis=1)[:, None]
    frames = np.stack([across, np.cross(tangents, across), tangents], axis=1)
    tree = cKDTree(centres)

    def field(points: Points) -> Float:
        nearest = tree.query(points)[1]
        relative = np.einsum("pij,pj->pi", frames[nearest], points - centres[nearest])
        station = stations[nearest] + relative[:, 2] / speeds[nearest]
        inside = np.clip(station, 0.0, chords[-1])
        relative[:, 2] -= (inside - stations[nearest]) * speeds[nearest]
        section = sections(inside)
        return ellipsoid_distance(relative, np.column_stack([section, np.minimum(*section.T)]))

    return field


def graded_axis(*stretches: tuple[float, float, float]) -> Float:
    """Lattice coordinates over adjoining stretches (start, end, largest spacing), mm, each evenly divided."""
    pieces = [np.linspace(a, b, int(np.ceil((b - a) / spacing)) + 1) for a, b, spacing in stretches]
    axis: Float = np.unique(np.concatenate(pieces))
    return axis


def polygonised(shape: Shape, *, axes: Sequence[Float], relaxations: int) -> TriMesh:
    """The surface of a shape, by marching cubes on a rectilinear lattice, relaxed and put back on the shape.

    Parameters
    ----------
    shape : Shape
    axes : three increasing arrays of lattice coordinates, mm
        They need not be evenly spaced: finer where the shape is.
    relaxations : int
        Rounds of tangential smoothing and projection, which turn marching cubes' slivers into even triangles.

    Returns
    -------
    TriMesh
        Closed and oriented outward.

    Raises
    ------
    MeshError
        The shape reaches the lattice's border, misses it, or is in several pieces.

    References
    ----------
    T. Lewiner et al., "Efficient implementation of marching cubes' cases with topological guarantees", JGT 2003.
    """
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = shape(lattice.reshape(-1, 3)).reshape(lattice.shape[:3])
    border = min(float(np.take(values, end, axis=k).min()) for k in range(3) for end in (0, -1))
    if border <= 0.0 or values.min() >= 0.0:
        raise MeshError(
            f"the shape's smallest value is {values.min():.3g} mm on the lattice and {border:.3g} mm on its border; "
            "it must be negative inside and positive on the border: widen the axes or move the shape"
        )
    indices, faces, _, _ = marching_cubes(values, level=0.0, gradient_direction="descent")
    vertices = np.column_stack([np.interp(indices[:, k], np.arange(len(axes[k])), axes[k]) for k in range(3)])
    faces = faces.astype(np.int64)
    pieces, piece_of = sparse.csgraph.connected_components(_adjacency(faces, len(vertices)), directed=False)
    if pieces != 1:
        sizes = np.bincount(piece_of)
        where = vertices[piece_of == sizes.argmin()].mean(axis=0).round(1)
        raise MeshError(
            f"the shape is in {pieces} pieces on this lattice, the smallest ({sizes.min()} vertices) near {where} mm; "
            "one is needed: refine the axes or thicken the shape there"
        )
    normals_at = _lattice_gradient(values, axes)
    return TriMesh(_relaxed(vertices, faces, shape, normals_at, rounds=relaxations), faces)


def _adjacency(faces: Faces, n_vertices: int) -> sparse.csr_array:
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([ends, ends[:, ::-1]])
    matrix = sparse.csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n_vertices, n_vertices))
    matrix.data[:] = 1.0
    return matrix


def _lattice_gradient(values: Float, axes: Sequence[Float]) -> Callable[[Points], Points]:
    slopes: list[Float] = list(np.gradient(values, *axes))

    def gradient(points: Points) -> Points:
        where = [np.interp(points[:, k], axes[k], np.arange(len(axes[k]))) for k in range(3)]
        return np.column_stack([map_coordinates(slope, where, order=1, mode="nearest") for slope in slopes])

    return gradient


def _gradient(points: Points, shape: Shape, *, step_mm: float = 0.02) -> Points:
    shifts = step_mm * np.eye(3)
    both = np.concatenate([points + s for s in shifts] + [points - s for s in shifts])
    ahead, behind = shape(both).reshape(2, 3, len(points))
    gradient: Points = (ahead - behind).T / (2.0 * step_mm)
    return gradient


def _relaxed(
    vertices: Points,
    faces: Faces,
    shape: Shape,
    normals_at: Callable[[Points], Points],
    *,
    rounds: int,
) -> Points:
    adjacency = _adjacency(faces, len(vertices))
    mean = sparse.diags_array(1.0 / adjacency.sum(axis=1)) @ adjacency
    for _ in range(rounds):
        gradient = normals_at(vertices)
        squared = np.maximum(np.sum(gradient**2, axis=1), 0.05)[:, None]
        towards = mean @ vertices - vertices
        towards -= np.sum(towards * gradient, axis=1)[:, None] * gradient / squared
        vertices = vertices + 0.5 * towards
        vertices = vertices - _bounded(shape(vertices)) * gradient / squared
    gradient = _gradient(vertices, shape)
    squared = np.maximum(np.sum(gradient**2, axis=1), 0.25)[:, None]
    for _ in range(2):
        vertices = vertices - _bounded(shape(vertices)) * gradient / squared
    return vertices


def _bounded(values: Float, *, reach_mm: float = 0.5) -> Float:
    bounded: Float = np.clip(values, -reach_mm, reach_mm)[:, None]
    return bounded
