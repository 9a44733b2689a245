"""Measures of a body as a tailor takes them (stature, girths, lengths), and how each changes with the body's points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from musclefit.errors import InputError, LandmarkError
from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.measures import distances_from_box
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.tapes import Tape, tapes_across
from musclefit.vocabulary import Unit

FAR_OFF = 0.1
"""A landmark farther outside the box around the skin than this share of its diagonal is in another frame or unit."""


NEAR_THE_END = 0.01
"""A stature is taken to change with all points that are within this share of it from its ends: soles have many."""


class MeasureKind(StrEnum):
    """What is measured."""

    STATURE = "stature"
    GIRTH = "girth"
    LENGTH = "length"


@dataclass(frozen=True, slots=True)
class BodyMeasure:
    """A measure and what it shall be.

    Parameters
    ----------
    name : str
    kind : MeasureKind
        Stature: from the lowest to the highest point of the skin. Girth: of a tape around the skin in a plane, hollows
        spanned. Length: straight, between two landmarks.
    wanted_mm : float
    unit : Unit
        In which it was given.
    height_mm : float or None
        Of a girth's plane above the lowest point of the template; it stays at the same share of the stature.
    at : str
        Of a girth: the landmark its plane goes through, "" for none.
    ends : pair of str, or ()
        Of a length: its landmarks. Of a girth: its plane is perpendicular to the line between them, and halfway where
        no ``at`` is given.
    """

    name: str
    kind: MeasureKind
    wanted_mm: float
    unit: Unit = Unit.MILLIMETRE
    height_mm: float | None = None
    at: str = ""
    ends: tuple[str, str] | tuple[()] = ()

    @property
    def landmarks(self) -> tuple[str, ...]:
        """Those it needs."""
        return (*((self.at,) if self.at else ()), *self.ends)


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredBody:
    """A skin with landmarks, in one shape.

    Parameters
    ----------
    skin : TriMesh
        Closed.
    names : tuple of str, length m
    landmarks : (m, 3) float64, mm
    up : (3,) float64
        Of length 1: the way from feet to head.
    """

    skin: TriMesh
    names: tuple[str, ...]
    landmarks: Points
    up: Float

    @property
    def points(self) -> Points:
        """The vertices of the skin, then the landmarks: (n + m, 3), mm."""
        return np.vstack([self.skin.vertices, self.landmarks])

    @property
    def stature_mm(self) -> float:
        """From the lowest to the highest point."""
        return float(np.ptp(self.skin.vertices @ self.up))

    def moved(self, points: Points) -> MeasuredBody:
        """The body with its points elsewhere."""
        count = len(self.skin.vertices)
        return MeasuredBody(self.skin.with_vertices(points[:count]), self.names, points[count:], self.up)

    def number(self, name: str) -> int:
        """Of a landmark among the points."""
        return len(self.skin.vertices) + self.names.index(name)


@dataclass(frozen=True, eq=False, slots=True)
class Taken:
    """A measure of a body in one shape.

    Parameters
    ----------
    value_mm : float
    points : (k,) int64
        Numbers of the body's points that it depends on.
    slopes : (k, 3) float64
        Its derivatives by them. Of a girth: by what moves with the skin, not by the plane; of a stature: shared by the
        points near its ends.
    """

    value_mm: float
    points: Int
    slopes: Points


def take(measure: BodyMeasure, body: MeasuredBody, *, rest: MeasuredBody) -> Taken:
    """Take a measure.

    Parameters
    ----------
    measure : BodyMeasure
    body : MeasuredBody
    rest : MeasuredBody
        The template, on which heights are stated.

    Raises
    ------
    InputError
        A plane that does not cut the skin.
    """
    if measure.kind is MeasureKind.STATURE:
        heights = body.skin.vertices @ body.up
        stature = body.stature_mm
        top, bottom = (
            np.flatnonzero(off < NEAR_THE_END * stature) for off in (heights.max() - heights, heights - heights.min())
        )
        ends = [np.tile(sign * body.up / len(end), (len(end), 1)) for sign, end in ((1.0, top), (-1.0, bottom))]
        return Taken(stature, np.concatenate([top, bottom]), np.vstack(ends))
    if measure.kind is MeasureKind.LENGTH:
        numbers = np.array([body.number(name) for name in measure.ends])
        apart = np.subtract(*body.points[numbers])
        length = float(np.linalg.norm(apart))
        along = apart / max(length, 1e-300)
        return Taken(length, numbers, np.stack([along, -along]))
    tape = _tape(measure, body, rest)
    first, second = tape.edges.T
    share = tape.weights[:, None]
    slopes = np.vstack([(1.0 - share) * tape.slopes, share * tape.slopes])
    return Taken(tape.length_mm, np.concatenate([first, second]), slopes)


def _tape(measure: BodyMeasure, body: MeasuredBody, rest: MeasuredBody) -> Tape:
    """The tape of a girth: around what is nearest to its landmarks, or, at a height, the longest."""
    place, normal = _plane(measure, body, rest)
    tapes = tapes_across(body.skin, at=place, normal=normal)
    if not tapes:
        raise InputError(
            f"measure {measure.name!r}: its plane through ({', '.join(f'{x:.5g}' for x in place)}) mm does not cut the "
            "skin; correct its height or landmarks"
        )
    return tapes[0] if measure.height_mm is not None else min(tapes, key=lambda tape: tape.distance_mm(place))


def _plane(measure: BodyMeasure, body: MeasuredBody, rest: MeasuredBody) -> tuple[Float, Float]:
    """A place in the plane of a girth, and its normal."""
    if measure.height_mm is not None:
        heights = body.skin.vertices @ body.up
        share = measure.height_mm / rest.stature_mm
        middle = body.skin.vertices.mean(axis=0)
        level = heights.min() + share * body.stature_mm
        return middle + (level - middle @ body.up) * body.up, body.up
    points = body.points
    normal = body.up
    if measure.ends:
        normal = np.subtract(*(points[body.number(name)] for name in measure.ends))
    if measure.at:
        return points[body.number(measure.at)], normal
    return 0.5 * np.add(*(points[body.number(name)] for name in measure.ends)), normal


def require_measurable(measures: Sequence[BodyMeasure], body: MeasuredBody) -> None:
    """Refuse measures that the template does not have.

    Raises
    ------
    InputError
        No measure, two of one name or of one definition, a height above the head.
    LandmarkError
        A landmark that is missing, that is far from the skin, or that stands where the other end is.
    """
    if not measures:
        raise InputError("no measure is given; add one, such as the stature")
    seen: dict[tuple[object, ...], str] = {}
    for measure in measures:
        said = f"measure {measure.name!r}"
        definition = (measure.kind, measure.height_mm, measure.at, frozenset(measure.ends))
        if definition in seen:
            raise InputError(
                f"{said}: measures the same as {seen[definition]!r}; keep one of the two, or correct where it is taken"
            )
        seen[definition] = measure.name
        if measure.height_mm is not None and not 0.0 < measure.height_mm < body.stature_mm:
            raise InputError(
                f"{said}: its height is {measure.height_mm:.6g} mm; the template is {body.stature_mm:.6g} mm from its "
                "lowest to its highest point. Correct the height or its unit, or say which way is up"
            )
        for name in measure.landmarks:
            _require_near(name, body, said)
        if measure.ends and np.ptp(body.points[[body.number(name) for name in measure.ends]], axis=0).max() <= 0.0:
            raise LandmarkError(f"{said}: {' and '.join(measure.ends)} stand at one place; correct one of them")


def _require_near(name: str, body: MeasuredBody, said: str) -> None:
    if name not in body.names:
        known = ", ".join(sorted(body.names)) or "none"
        raise LandmarkError(f"{said}: there is no landmark {name!r} on the template; known: {known}")
    place = body.points[body.number(name)]
    off = float(distances_from_box(place[None], body.skin.vertices)[0])
    if off > FAR_OFF * float(np.linalg.norm(np.ptp(body.skin.vertices, axis=0))):
        raise LandmarkError(
            f"{said}: landmark {name!r} is {off:.4g} mm outside the box around the skin; likely another unit or frame"
        )
