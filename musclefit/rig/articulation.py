r"""Joints fitted to bones: two surfaces in; axes or centre, and how sure they are, out.

A joint moves one bone so that its surface slides along the other's: the joint's motion carries both surfaces into
themselves. So an axis with direction a through c is sought about which both are, as nearly as can be, surfaces of
revolution: their normals n at p lie in a plane with the axis, that is, :math:`n \cdot (a \times (p - c)) = 0`. No
radius is in that, so a trochlea (a saddle), a roller and a condyle serve alike, and the two bones are fitted
together, each with the same say however large its surface is. A ball's centre is where all normals meet. A condyle or a
saddle with two axes is about a torus, which turns into itself about one of them alone. The other is where the normals
meet in the half-plane that all places are turned into about the first, at right angles to that half-plane as it passes
through the middle of what faces. Bones are none of these: the sines of the angles that are left over count by Geman and
McClure's loss, so that places that fit no axis weigh no more the less they fit.

Of a hinge whose head is set off from its shaft to one side, only what turns past the joint as it bends to that side is
fitted at last (`hinge_heads`).

References: Pottmann and Randrup, Rotational and helical surface approximation for reverse engineering, Computing 60
(1998); Gelfand and Guibas, Shape segmentation using local slippage analysis, SGP 2004.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from musclefit.errors import InputError
from musclefit.geometry.arrays import Bool, Float, Points, frozen
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.quantiles import weighted_quantile
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.rig.hinge_heads import SHAFT, outwardness, overhanging_side, turned_past
from musclefit.rig.joint_kinds import JointKind

WITHIN_MM = 5.0
"""How far beyond the smallest gap between the bones a place may be to count as part of the joint's surface."""

WIDEST_GAP = 3.0
"""Times that distance: bones whose smallest gap is wider do not meet."""

SAMPLES_WITHIN = 5.0
"""The surfaces are cut until their triangles reach no farther from their corners than the widest reach over this and
`WIDEST_GAP`; finer where bones are small (`FINER`)."""

FACING = 0.5
"""Least cosine between the surface's normal and the way to the other bone."""

FEWEST = 30
"""Samples that a fit needs of each bone where they face each other."""

FINER = 3
"""Times that the surfaces are cut twice as fine where bones are too small for so many samples."""

AROUND = 1.5
"""How far the bones' ends reach around the middle of what faces each other, in times its root mean square radius: of a
condyle, only a part faces the other bone in any one pose, and the whole of it turns about the axis."""

WIDER = 2.0
"""The same where the axis that was found is fitted again: what lies farther from where the bones face tells its
direction the better, but may be a part of no joint, so that an axis that was not there before is not looked for."""

FAR = 2.5
"""The same of what turns past the joint as a hinge bends."""

OUTWARD = 0.5
"""A bone is the head of a hinge whose surface points away from the axis: least mean cosine."""

ROUNDS = 8
"""Times that what turns past the joint is chosen about the axis and the axis fitted to it; in a few it stays as it
is."""

CELLS = 10.0
"""Of the joint's size over a cell's: what lies in one and looks the same way counts as one place, so that fits take as
long however finely a bone is cut."""

SLOPE = 0.2
"""Scale of the loss: the sine of the angle between a normal and the plane that it should lie in."""

BLUR = 0.15
"""Share of the joint's size within which a place is too near to an axis to tell its direction."""

ALONG = 0.6
"""Largest cosine between an axis and a bone's length: hinges and condyles swing a long bone, and do not spin it."""

LONG = 1.5
"""A bone is long where its middle is farther than this from the joint's, in times the joint's size."""

FARTHEST = 2.0
"""How far an axis may be from the joint's middle, in times the joint's size."""

DEPTHS = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)
"""How far from the joint's middle a second axis is first looked for, in times the joint's size: towards the first axis
and away from it."""

SAME = 0.1
"""Second axes nearer to each other than this, in times the joint's size, are one."""

MOST_SECONDS = 2
"""Of them so many are sought again when patches are drawn anew: which of two depths is the better one may change."""

DIRECTIONS = 60
"""Of axes that are tried, over half of the sphere."""

STARTS = 10
"""The best of what is tried, which are refined: each with another direction, as places next to each other lead to one
axis."""

MOST_STARTS = 25
"""So many where none of those leads to an axis that may be."""

CLOSE = 1e-5
"""A fit ends where a step changes the axis (in radians and joint's sizes) or the loss relatively by less than this."""

NEARLY = 1.1
"""An axis whose loss is up to this many times the best one's fits nearly as well."""

APART_DEG = 15.0
"""Axes nearer to each other are the same one."""

DRAWS = 40
"""Of the patches of the surfaces, with replacement, that the fit is made again from."""

PATCH = 0.5
"""Size of these patches, in times the joint's size."""


@dataclass(frozen=True, eq=False, slots=True)
class Side:
    """What one of the bones says of the joint.

    Parameters
    ----------
    of : str
        "fixed" or "moving".
    facing_mm2 : float
        Area that faces the other bone.
    radius_mm : float
        Median distance of that area from the first axis, or from the centre.
    slope_deg : float
        Median angle by which the bone's end, as far as it counts, is off a surface that slides along itself.
    alone_deg, alone_mm : float
        How far the joint that is fitted to this bone alone is from the joint: the angle of the first axis, which is 0
        for a ball, and the distance.
    """

    of: str
    facing_mm2: float
    radius_mm: float
    slope_deg: float
    alone_deg: float
    alone_mm: float


@dataclass(frozen=True, eq=False, slots=True)
class FittedJoint:
    """A joint fitted to two bones.

    Parameters
    ----------
    kind : JointKind
    centre : (3,) float64, mm
        Of an axis, the point nearest to the middle of what faces; of two that do not meet, the middle between them.
    axes : (n, 3) float64
        One of a hinge, two of a universal joint, none of a ball.
    apart_mm : float
        Distance of two axes from each other, 0 where there is one or none: of a saddle they lie on either side of it.
    gap_mm : float
        Smallest gap between the bones.
    sides : tuple of Side
        Of the fixed bone and of the moving one.
    uncertain_deg, uncertain_mm : float
        Of the first axis' direction, and of the place of a hinge's axis or another joint's centre: root of the sum of
        squares of the standard deviation when the surfaces' patches are drawn anew, of half of how far apart the
        joints near this one are that each bone alone would give, and of how far the axis of what turns past a hinge is
        from that of all that is around it.
    redrawn_deg, redrawn_mm : float
        The first of them alone.
    other_deg : float
        Angle of the next best axis with another direction where it is nearly as good, else 0.
    """

    kind: JointKind
    centre: Points
    axes: Float
    apart_mm: float
    gap_mm: float
    sides: tuple[Side, ...]
    uncertain_deg: float
    uncertain_mm: float
    redrawn_deg: float
    redrawn_mm: float
    other_deg: float


@dataclass(frozen=True, eq=False, slots=True)
class _End:
    """Samples of a bone's end: places, outward normals, area each, and whether it faces the other bone.

    ``moments`` are places x normals, and ``shares`` the roots of the areas' shares.
    """

    points: Points
    normals: Points
    areas: Float
    facing: Bool
    moments: Points = field(init=False)
    shares: Float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "moments", np.cross(self.points, self.normals))
        object.__setattr__(self, "shares", np.sqrt(self.areas / max(self.areas.sum(), 1e-300)))

    def part(self, there: Bool) -> _End:
        return _End(self.points[there], self.normals[there], self.areas[there], self.facing[there])


@dataclass(frozen=True, eq=False, slots=True)
class _Line:
    """An axis and the loss that is left over."""

    at: Points
    along: Float
    loss: float


@dataclass(frozen=True, eq=False, slots=True)
class _Region:
    """Where the joint is: the middle of what faces, its size, and directions that no axis is along."""

    middle: Points
    size: float
    lengths: Float

    def allows(self, line: _Line) -> bool:
        away = np.linalg.norm(np.cross(line.at - self.middle, line.along))
        return bool(away <= FARTHEST * self.size and not self.spins(line.along[None])[0])

    def spins(self, directions: Float) -> Bool:
        along: Bool = np.any(np.abs(directions @ self.lengths.T) > ALONG, axis=1)
        return along


def fitted_joint(fixed: TriMesh, moving: TriMesh, *, kind: JointKind, within_mm: float = WITHIN_MM) -> FittedJoint:
    """Fit a hinge, a universal joint (a saddle is one) or a ball to two bones where they face each other.

    Every place counts by its area, however finely the surfaces are cut, and each bone as much as the other.

    Parameters
    ----------
    fixed, moving : TriMesh
        At rest, mm.
    kind : JointKind
    within_mm : float
        See `WITHIN_MM`.

    Raises
    ------
    InputError
        Another kind, a distance that is none, or bones that do not face each other within it.
    """
    if kind not in (JointKind.HINGE, JointKind.UNIVERSAL, JointKind.BALL):
        raise InputError(
            f"found kind {str(kind)!r}; only a hinge, a universal joint and a ball can be fitted to two bones"
        )
    if not 0.0 < within_mm < np.inf:
        raise InputError(f"within_mm is {within_mm:g}; give a distance in mm above 0")
    found, region, gap = _where_they_face(fixed, moving, within_mm)
    ends = _ends((fixed, moving), found, region, around=AROUND)
    if kind is JointKind.BALL:
        return _ball(ends, region, gap)
    return _axes((fixed, moving), found, ends, region, gap, kind)


# Where the bones face each other


_Near = tuple[Points, Points, Float, Float, Float]


def _near_each_other(fixed: TriMesh, moving: TriMesh, within_mm: float, spacing_mm: float) -> list[_Near]:
    return [
        _near_triangles(own, other, within_mm=within_mm, spacing_mm=spacing_mm)
        for own, other in ((fixed, moving), (moving, fixed))
    ]


def _facing(near: _Near, nearer_mm: float) -> Bool:
    """Which of the triangles are so near to the other bone and look towards it."""
    facing: Bool = (near[3] < nearer_mm) & (near[4] > FACING)
    return facing


def _near_triangles(own: TriMesh, other: TriMesh, *, within_mm: float, spacing_mm: float) -> _Near:
    """Middles, outward normals and areas of a surface's small triangles near another one, distance and cosine to it.

    The surface is cut to samples (`surface_samples`) first, so that they are alike whatever triangles it has.
    """
    low, high = other.vertices.min(axis=0) - within_mm, other.vertices.max(axis=0) + within_mm
    middles, normals, areas = _triangles(own, low, high, spacing_mm=spacing_mm)
    if not len(middles):
        return middles, normals, areas, areas, areas
    places = nearest_places(middles, other)
    way = (places.places - middles) / np.maximum(places.distances, 1e-12)[:, None]
    return middles, normals, areas, places.distances, np.einsum("ti,ti->t", way, normals)


def _triangles(own: TriMesh, low: Points, high: Points, *, spacing_mm: float) -> tuple[Points, Points, Float]:
    corners = own.corners()
    near = ((corners.max(axis=1) > low) & (corners.min(axis=1) < high)).all(axis=1)
    if not near.any():
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    part = surface_samples(TriMesh(own.vertices, own.faces[near]), spacing_mm=spacing_mm).mesh
    vectors = area_vectors(part)
    areas = np.linalg.norm(vectors, axis=1)
    middles = part.corners().mean(axis=1)
    inside = ((middles > low) & (middles < high)).all(axis=1) & (areas > 0.0)
    return middles[inside], vectors[inside] / areas[inside, None], areas[inside]


_Facing = tuple[Points, Points, Float]
"""Middles, normals and areas of a bone's small triangles that face the other bone."""


def _where_they_face(fixed: TriMesh, moving: TriMesh, within_mm: float) -> tuple[list[_Facing], _Region, float]:
    reach = (1.0 + WIDEST_GAP) * within_mm
    spacing = reach / WIDEST_GAP / SAMPLES_WITHIN
    near = _near_each_other(fixed, moving, reach, spacing)
    gap = min((float(found[3].min()) for found in near if len(found[3])), default=np.inf)
    if not gap <= WIDEST_GAP * within_mm:
        said = f"{gap:.3g} mm" if np.isfinite(gap) else f"more than {reach:g} mm"
        raise InputError(
            f"the two bones are {said} apart where they are closest, more than {WIDEST_GAP * within_mm:g} mm; give "
            "bones that meet in a joint, or a larger distance"
        )
    facing = [_facing(found, gap + within_mm) for found in near]
    for _ in range(FINER):
        if min(there.sum() for there in facing) >= FEWEST:
            break
        spacing /= 2.0
        near = _near_each_other(fixed, moving, reach, spacing)
        facing = [_facing(found, gap + within_mm) for found in near]
    for of, found, there in zip(("fixed", "moving"), near, facing, strict=True):
        if there.sum() < FEWEST:
            raise InputError(
                f"{found[2][there].sum():.3g} mm² of the {of} bone face the other within {within_mm:g} mm of the "
                f"smallest gap, {gap:.3g} mm ({there.sum()} samples; a fit needs {FEWEST}): give bones that meet in a "
                "joint, or a larger distance"
            )
    middle = np.mean([np.average(f[0][t], axis=0, weights=f[2][t]) for f, t in zip(near, facing, strict=True)], axis=0)
    off = [
        np.average(((f[0][t] - middle) ** 2).sum(axis=1), weights=f[2][t]) for f, t in zip(near, facing, strict=True)
    ]
    size = float(np.sqrt(np.mean(off)))
    lengths = [own.vertices.mean(axis=0) - middle for own in (fixed, moving)]
    far = [way / np.linalg.norm(way) for way in lengths if np.linalg.norm(way) > LONG * size]
    faces: list[_Facing] = [
        (own[0][there], own[1][there], own[2][there]) for own, there in zip(near, facing, strict=True)
    ]
    return faces, _Region(middle, size, np.array(far).reshape(-1, 3)), gap


def _ends(bones: Sequence[TriMesh], facing: Sequence[_Facing], region: _Region, *, around: float) -> list[_End]:
    """The ends of the bones, so many times the joint's size around its middle."""
    ends = []
    radius = around * region.size
    for own, found in zip(bones, facing, strict=True):
        low, high = region.middle - radius, region.middle + radius
        triangles = _triangles(own, low, high, spacing_mm=region.size / CELLS)
        near = np.linalg.norm(triangles[0] - region.middle, axis=1) < radius
        there, facing_up, sizes = (of[near] for of in triangles)
        all_of_it = _in_cells(there, facing_up, sizes, region)
        facing_it = _in_cells(*found, region)
        points, normals, areas = (np.concatenate(both) for both in zip(all_of_it, facing_it, strict=True))
        ends.append(_End(points, normals, areas, np.arange(len(areas)) >= len(all_of_it[2])))
    return ends


def _in_cells(points: Points, normals: Points, areas: Float, region: _Region) -> tuple[Points, Points, Float]:
    """Triangles that lie in one cell and look into one octant as one: mean place, mean normal, all of the area."""
    cells = np.floor((points - region.middle) * (CELLS / region.size)).astype(np.int64)
    _, of = np.unique(np.column_stack([cells, normals > 0.0]), axis=0, return_inverse=True)
    of = of.ravel()
    total: Float = np.bincount(of, areas).astype(np.float64)
    place, normal = (
        np.column_stack([np.bincount(of, areas * values[:, k]) for k in range(3)]) for values in (points, normals)
    )
    unit: Points = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return place / total[:, None], unit, total


# Axes


def _axes(
    bones: Sequence[TriMesh],
    facing: Sequence[_Facing],
    ends: Sequence[_End],
    region: _Region,
    gap: float,
    kind: JointKind,
) -> FittedJoint:
    hinge = kind is JointKind.HINGE
    lines = _best_lines(ends, region)
    alone = [_best_lines([end], region)[0] for end in ends]
    fitted_to, first = ends, lines[0]
    wider = _ends(bones, facing, region, around=WIDER)
    refined = _refined(wider, first, region)
    if region.allows(refined):
        fitted_to, first = wider, refined
    chosen_deg, chosen_mm = 0.0, 0.0
    turning = _turning(bones, facing, first, region) if hinge else None
    if turning is not None:
        chosen_deg, chosen_mm = _Pair(first, None).off(_Pair(turning[1], None), region)
        fitted_to, first = turning
    seconds = [] if hinge else _seconds(fitted_to, first, region, starts=[(depth, 0.0) for depth in DEPTHS])
    second = seconds[0].line if seconds else None
    fitted, starts = _Pair(first, second), [found.start for found in seconds[:MOST_SECONDS]]
    centre = fitted.centre(region)
    axes, apart = first.along[None], 0.0
    if second is not None:
        axes = np.array([first.along, second.along])
        apart = abs(float((second.at - first.at) @ np.cross(first.along, second.along)))
    others = [line for line in lines[1:] if line.loss < NEARLY * lines[0].loss]
    if second is not None:
        others = [line for line in others if _angle(line.along, second.along) > APART_DEG]
    draws = [_near(sample, fitted, region, starts) for sample in _redrawn(fitted_to, region)]
    off = np.array([fitted.off(pair, region) for pair in draws])
    redrawn_deg, redrawn_mm = (float(v) for v in np.sqrt((off**2).mean(axis=0)))
    one, other = (_near([end], fitted, region, starts) for end in fitted_to)
    # Half of the difference of two estimates of one thing that err alike is the standard deviation of their mean.
    # They are sought from the joint of both, as one bone alone may have another axis that the other bone rules out.
    bones_deg, bones_mm = (0.5 * v for v in one.off(other, region, near=centre))
    sides = tuple(
        _side(of, end, used, first, _angle(line.along, first.along), _line_distance(line, first, centre))
        for of, end, used, line in zip(("fixed", "moving"), ends, fitted_to, alone, strict=True)
    )
    return FittedJoint(
        kind,
        frozen(centre),
        frozen(axes),
        apart,
        gap,
        sides,
        float(np.sqrt(redrawn_deg**2 + bones_deg**2 + chosen_deg**2)),
        float(np.sqrt(redrawn_mm**2 + bones_mm**2 + chosen_mm**2)),
        redrawn_deg,
        redrawn_mm,
        max((_angle(line.along, first.along) for line in others), default=0.0),
    )


def _turning(
    bones: Sequence[TriMesh], facing: Sequence[_Facing], first: _Line, region: _Region
) -> tuple[list[_End], _Line] | None:
    """Samples of what turns past a hinge, and the axis of it; None where no head is set off from a shaft."""
    outward = [outwardness(*found, at=first.at, along=first.along) for found in facing]
    head = int(np.argmax(outward))
    if outward[head] < OUTWARD:
        return None
    reach = SHAFT[1] * region.size
    points, _, areas = _triangles(
        bones[head], region.middle - reach, region.middle + reach, spacing_mm=region.size / 3.0
    )
    side = overhanging_side(points, areas, middle=region.middle, along=first.along, size=region.size)
    if side is None:
        return None
    ends = _ends(bones, facing, region, around=FAR)
    line, parts = first, list[_End]()
    for _ in range(ROUNDS):
        parts.clear()
        for number, (end, (places, _, areas)) in enumerate(zip(ends, facing, strict=True)):
            there = turned_past(
                end.points,
                places,
                areas,
                at=line.at,
                along=line.along,
                middle=region.middle,
                side=side if number == head else None,
            )
            parts.append(end.part(there & ~end.facing))  # what faces is in the ends twice
        if min(len(part.areas) for part in parts) < FEWEST:
            return None
        line = _refined(parts, line, region)
        if not region.allows(line):
            return None
    return parts, line


@dataclass(frozen=True, eq=False, slots=True)
class _Pair:
    """A joint's first axis, and its second if it has two."""

    first: _Line
    second: _Line | None

    def centre(self, region: _Region) -> Points:
        """Of two axes halfway between them, of one what is nearest to the middle of what faces."""
        return _nearest_on(self.first, region.middle) if self.second is None else _between(self.first, self.second)

    def off(self, other: _Pair, region: _Region, *, near: Points | None = None) -> tuple[float, float]:
        """Degrees between first axes, and distance of the centres or, near a point, of single axes.

        An axis beyond where it may be (`FARTHEST`) counts as there: a draw may have lost it altogether.
        """
        if self.second is None or other.second is None:
            away = _line_distance(self.first, other.first, self.centre(region) if near is None else near)
        else:
            away = float(np.linalg.norm(self.centre(region) - other.centre(region)))
        return _angle(self.first.along, other.first.along), min(away, FARTHEST * region.size)


def _near(ends: Sequence[_End], fitted: _Pair, region: _Region, starts: Sequence[tuple[float, float]]) -> _Pair:
    """The joint of other samples near one; its second axis is the best of those found from some starts."""
    first = _refined(ends, fitted.first, region)
    return _Pair(first, _seconds(ends, first, region, starts=starts)[0].line if starts else None)


@dataclass(frozen=True, eq=False, slots=True)
class _Second:
    """A second axis, and what it is found again from: how far it is from the joint's middle, in times its size."""

    line: _Line
    start: tuple[float, float]


def _seconds(
    ends: Sequence[_End], first: _Line, region: _Region, *, starts: Sequence[tuple[float, float]]
) -> list[_Second]:
    """Axes at right angles to the first about which the profile is bent that turns about the first, the best first."""
    blur = BLUR * region.size
    profiles = [_profile(end, first, blur) for end in ends]
    middle = region.middle - _nearest_on(first, region.middle)
    radius = float(np.linalg.norm(middle))
    outwards = middle / radius if radius > 1e-9 * region.size else _across(first.along)[0]
    along_first = float((region.middle - first.at) @ first.along)

    def roots(x: Float) -> Float:
        at = np.array([radius + region.size * x[0], along_first + region.size * x[1]])
        return np.concatenate(
            [_roots(end, profile.sines(at, blur)) for end, profile in zip(ends, profiles, strict=True)]
        )

    found: list[_Second] = []
    for start in starts:
        fit = least_squares(roots, np.array(start), method="lm", xtol=CLOSE, ftol=CLOSE, max_nfev=200)
        x = np.clip(fit.x, -FARTHEST, FARTHEST)
        if any(np.abs(x - other.start).max() < SAME for other in found):
            continue
        at = _nearest_on(first, region.middle) + region.size * x[1] * first.along
        at = at + (radius + region.size * x[0]) * outwards
        loss = float((roots(x) ** 2).sum()) / len(ends)
        found.append(_Second(_Line(at, np.cross(first.along, outwards), loss), (float(x[0]), float(x[1]))))
    return sorted(found, key=lambda second: second.line.loss)


@dataclass(frozen=True, eq=False, slots=True)
class _Profile:
    """Places and normals turned about an axis into a half-plane: away from the axis and along it, and a share each."""

    points: Float
    normals: Float
    counts: Float

    def sines(self, at: Float, blur: float) -> Float:
        """Of the angles between normals and the ways to a place of the half-plane; small where the place is near it."""
        way = self.points - at
        crossed = self.normals[:, 0] * way[:, 1] - self.normals[:, 1] * way[:, 0]
        sines: Float = self.counts * crossed / np.sqrt((way**2).sum(axis=1) + blur**2)
        return sines


def _profile(end: _End, axis: _Line, blur: float) -> _Profile:
    """Near the axis the way from it is not told, and places count less."""
    way = end.points - axis.at
    height = way @ axis.along
    way = way - height[:, None] * axis.along
    radius = np.linalg.norm(way, axis=1)
    outwards = np.einsum("ni,ni->n", end.normals, way) / np.maximum(radius, 1e-12)
    return _Profile(
        np.column_stack([radius, height]),
        np.column_stack([outwards, end.normals @ axis.along]),
        radius / np.sqrt(radius**2 + blur**2),
    )


def _sines(end: _End, at: Points, along: Float, blur: float) -> Float:
    """Of the angles between normals and the planes through the axis; small where the place is near the axis."""
    way = end.points - at
    height = way @ along
    away = np.maximum(np.einsum("ni,ni->n", way, way) - height**2, 0.0)
    moments = end.moments @ along - end.normals @ np.cross(along, at)
    sines: Float = moments / np.sqrt(away + blur**2)
    return sines


def _loss_roots(end: _End, at: Points, along: Float, blur: float) -> Float:
    """Roots of Geman and McClure's loss, whose squares' mean is the loss."""
    return _roots(end, _sines(end, at, along, blur))


def _roots(end: _End, sines: Float) -> Float:
    """Of Geman and McClure's loss of the sines of angles, by area."""
    roots: Float = end.shares * sines / np.sqrt(sines**2 + SLOPE**2)
    return roots


def _best_lines(ends: Sequence[_End], region: _Region) -> list[_Line]:
    """The best axes with directions apart from each other, the best first."""
    blur = BLUR * region.size
    directions = _directions()
    if len(region.lengths):
        directions = directions[~region.spins(directions)]
    tried = []
    for along in directions:
        u, v = _across(along)
        places = []
        for x, y in ((0, 0), (0.7, 0), (-0.7, 0), (0, 0.7), (0, -0.7), (1.3, 0), (-1.3, 0), (0, 1.3), (0, -1.3)):
            at = region.middle + region.size * (x * u + y * v)
            loss = float(np.mean([(_loss_roots(end, at, along, blur) ** 2).sum() for end in ends]))
            places.append(_Line(at, along, loss))
        tried.append(min(places, key=lambda line: line.loss))
    tried.sort(key=lambda line: line.loss)
    found: list[_Line] = []
    for number, line in enumerate(tried[:MOST_STARTS]):
        if number >= STARTS and found:
            break
        fine = _refined(ends, line, region)
        if region.allows(fine):
            found.append(fine)
    if not found:
        found = [next(line for line in tried if region.allows(line))]
    found.sort(key=lambda line: line.loss)
    apart: list[_Line] = []
    for line in found:
        if all(_angle(line.along, other.along) > APART_DEG for other in apart):
            apart.append(line)
    return apart


def _refined(ends: Sequence[_End], start: _Line, region: _Region) -> _Line:
    """The best line near a start."""
    u, v = _across(start.along)
    turns = np.array([u, v])
    blur = BLUR * region.size

    def line(x: Float) -> tuple[Points, Float]:
        along = start.along + x[2:] @ turns
        return start.at + region.size * (x[0] * u + x[1] * v), along / np.linalg.norm(along)

    def roots(x: Float) -> Float:
        at, along = line(x)
        return np.concatenate([_loss_roots(end, at, along, blur) for end in ends])

    found = least_squares(roots, np.zeros(4), method="lm", xtol=CLOSE, ftol=CLOSE, max_nfev=200)
    at, along = line(found.x)
    return _Line(at, along, 2.0 * float(found.cost) / len(ends))


def _directions() -> Float:
    """Directions evenly over half of the sphere."""
    number = np.arange(2 * DIRECTIONS) + 0.5
    z, turn = 1.0 - number / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * number
    all_of_them = np.column_stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z])
    half: Float = all_of_them[z > 0.0]
    return half


# Balls


def _ball(ends: Sequence[_End], region: _Region, gap: float) -> FittedJoint:
    centre = _best_centre(ends, region)
    alone = [_best_centre([end], region) for end in ends]
    draws = [_refined_centre(sample, centre, region)[0] for sample in _redrawn(ends, region)]
    off = np.linalg.norm(np.array(draws) - centre, axis=1)
    sides = tuple(
        _side(of, end, end, centre, 0.0, float(np.linalg.norm(own - centre)))
        for of, end, own in zip(("fixed", "moving"), ends, alone, strict=True)
    )
    redrawn = float(np.sqrt((off**2).mean()))
    spread = float(np.hypot(redrawn, 0.5 * np.linalg.norm(alone[0] - alone[1])))
    return FittedJoint(
        JointKind.BALL, frozen(centre), np.zeros((0, 3)), 0.0, gap, sides, 0.0, spread, 0.0, redrawn, 0.0
    )


def _best_centre(ends: Sequence[_End], region: _Region) -> Points:
    steps = np.linspace(-1.5, 1.5, 5)
    starts = [region.middle + region.size * np.array([x, y, z]) for x in steps for y in steps for z in steps]
    losses = [np.mean([(_centre_roots(end, at, BLUR * region.size) ** 2).sum() for end in ends]) for at in starts]
    best = np.argsort(losses)[:STARTS]
    return min((_refined_centre(ends, starts[k], region) for k in best), key=lambda found: found[1])[0]


def _centre_sines(end: _End, at: Points, blur: float) -> Float:
    """Of the angles between normals and the ways to a centre; small where the place is near it."""
    way = end.points - at
    sines: Float = np.linalg.norm(np.cross(end.normals, way), axis=1) / np.sqrt((way**2).sum(axis=1) + blur**2)
    return sines


def _centre_roots(end: _End, at: Points, blur: float) -> Float:
    return _roots(end, _centre_sines(end, at, blur))


def _refined_centre(ends: Sequence[_End], start: Points, region: _Region) -> tuple[Points, float]:
    blur = BLUR * region.size

    def roots(x: Float) -> Float:
        return np.concatenate([_centre_roots(end, start + region.size * x, blur) for end in ends])

    found = least_squares(roots, np.zeros(3), method="lm", xtol=CLOSE, ftol=CLOSE, max_nfev=200)
    return start + region.size * found.x, 2.0 * float(found.cost) / len(ends)


# How sure


def _redrawn(ends: Sequence[_End], region: _Region) -> Iterator[list[_End]]:
    """The ends with their patches drawn anew, with replacement: neighbours err together, so samples are not."""
    rng = np.random.default_rng(0)
    patches = [
        np.unique(np.floor(end.points / (PATCH * region.size)), axis=0, return_inverse=True)[1].ravel() for end in ends
    ]
    for _ in range(DRAWS):
        sample = []
        for end, patch in zip(ends, patches, strict=True):
            count = int(patch.max()) + 1
            times = np.bincount(rng.integers(0, count, count), minlength=count)[patch]
            sample.append(replace(end, areas=end.areas * times))
        yield sample


def _side(of: str, end: _End, used: _End, joint: _Line | Points, turned: float, apart: float) -> Side:
    facing = end.points[end.facing]
    if isinstance(joint, _Line):
        radii = np.linalg.norm(np.cross(facing - joint.at, joint.along), axis=1)
        sines = np.abs(_sines(used, joint.at, joint.along, 1e-9))
    else:
        radii = np.linalg.norm(facing - joint, axis=1)
        sines = _centre_sines(used, joint, 1e-9)
    areas = end.areas[end.facing]
    slope = float(np.degrees(np.arcsin(min(1.0, weighted_quantile(sines, used.areas, 0.5)))))
    return Side(of, float(areas.sum()), weighted_quantile(radii, areas, 0.5), slope, turned, apart)


def _angle(a: Float, b: Float) -> float:
    return float(np.degrees(np.arccos(np.clip(abs(a @ b), 0.0, 1.0))))


def _nearest_on(line: _Line, point: Points) -> Points:
    nearest: Points = line.at + ((point - line.at) @ line.along) * line.along
    return nearest


def _line_distance(line: _Line, other: _Line, near: Points) -> float:
    """How far a line is from another one where that is nearest to a point."""
    place = _nearest_on(other, near)
    return float(np.linalg.norm(_nearest_on(line, place) - place))


def _between(first: _Line, second: _Line) -> Points:
    """The middle of the shortest way between two lines that are at right angles."""
    on_first = first.at + ((second.at - first.at) @ first.along) * first.along
    on_second = second.at + ((first.at - second.at) @ second.along) * second.along
    return 0.5 * (on_first + on_second)


def _across(axis: Float) -> tuple[Float, Float]:
    """Two directions at right angles to an axis and to each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(axis, helper)
    u = u / np.linalg.norm(u)
    return u, np.cross(axis, u)
