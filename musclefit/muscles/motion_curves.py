"""Fibres on the way of a motion: takes where a map takes a muscle stretch by stretch, gives curves; knows no file.

A moment arm is -dL/dθ of a length over a joint's angle, by differences of second order between the states, where no
other joint turns; L is the mean length of the streamlines, which follow the muscle around bone, or the straight line
between the middles of the two ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.muscles.attachments import MuscleEnds
from musclefit.muscles.measures import Belly, Lines
from musclefit.muscles.streamlines import Streamlines


@dataclass(frozen=True, slots=True)
class MotionState:
    """One muscle at one moment of the way; lengths in mm, moment arms in mm per radian.

    ``at`` is the share of the way, 0 at rest; ``angles_deg`` the joints' angles there. ``stretch`` is the mean fibre
    length over that at rest. Moment arms are None where more than one joint turns, or none.
    """

    muscle: str
    at: float
    angles_deg: Mapping[str, float]
    path_mm: float
    fibre_mm: float
    stretch: float
    pennation_deg: float
    line_mm: float
    moment_arm_path_mm: float | None = None
    moment_arm_line_mm: float | None = None


@dataclass(frozen=True, eq=False, slots=True)
class MovingMuscle:
    """What of a muscle goes along: its ends, its streamlines and its surface, all at rest."""

    ends: MuscleEnds
    surface: TriMesh
    lines: Streamlines
    belly: Belly


def motion_curves(
    muscles: Sequence[MovingMuscle],
    stretches: Iterable[tuple[float, float, Callable[[Points], Points]]],
    *,
    angles_at: Mapping[float, Mapping[str, float]],
) -> tuple[MotionState, ...]:
    """Each muscle at rest and after each stretch of the way.

    Parameters
    ----------
    muscles : sequence of MovingMuscle
    stretches : iterable of (start, end, map of that stretch)
        Such as of `Deformation.by_stretch`.
    angles_at : mapping of share of the way to joints' angles, degrees
        At 0 and at every stretch's end; empty where no joint drives.
    """
    cuts = [m.surface.vertices[m.belly.sections.vertices] for m in muscles]
    lines = [Lines.carried(muscle.lines, muscle.belly) for muscle in muscles]
    parts = [
        np.concatenate([own.points, cut, _middles(muscle.ends)])
        for muscle, own, cut in zip(muscles, lines, cuts, strict=True)
    ]
    bounds = np.cumsum([len(part) for part in parts])[:-1]
    places = np.concatenate(parts)
    states: list[list[MotionState]] = [[] for _ in muscles]
    for at, part in ((0.0, None), *((end, stretch) for _, end, stretch in stretches)):
        places = places if part is None else part(places)
        for muscle, of, own, found in zip(muscles, lines, np.split(places, bounds), states, strict=True):
            found.append(_state(muscle, of, own, at=at, angles=angles_at.get(at, {}), before=found))
    return tuple(state for found in states for state in _with_arms(found))


def _middles(ends: MuscleEnds) -> Points:
    return np.stack([ends.origin.centroid_mm, ends.insertion.centroid_mm])


def _state(
    muscle: MovingMuscle,
    lines: Lines,
    own: Points,
    *,
    at: float,
    angles: Mapping[str, float],
    before: Sequence[MotionState],
) -> MotionState:
    count = len(lines.points)
    points, middles, vertices = own[:count], own[-2:], muscle.surface.vertices.copy()
    vertices[muscle.belly.sections.vertices] = own[count:-2]
    tangents = muscle.belly.directions(vertices, lines.position)
    paths, fibres, turned = lines.measure(points, tangents, count=len(muscle.lines.points))
    whole = muscle.lines.complete & (fibres > 0.0)
    path, fibre, angle = (float(v[whole].mean()) if whole.any() else float("nan") for v in (paths, fibres, turned))
    return MotionState(
        muscle=muscle.ends.muscle,
        at=at,
        angles_deg=dict(angles),
        path_mm=path,
        fibre_mm=fibre,
        stretch=fibre / before[0].fibre_mm if before else 1.0,
        pennation_deg=angle,
        line_mm=float(np.linalg.norm(middles[1] - middles[0])),
    )


def _with_arms(states: Sequence[MotionState]) -> list[MotionState]:
    """The states of one muscle with moment arms, if one joint alone turns, and always on."""
    turning = [name for name in states[-1].angles_deg if len({state.angles_deg.get(name) for state in states}) > 1]
    if len(turning) != 1 or len(states) < 3:
        return list(states)
    angle = np.radians([state.angles_deg[turning[0]] for state in states])
    if not (np.diff(angle) > 0.0).all() and not (np.diff(angle) < 0.0).all():
        return list(states)
    path, line = (_arm(np.array([getattr(s, name) for s in states]), angle) for name in ("path_mm", "line_mm"))
    return [
        replace(state, moment_arm_path_mm=float(p), moment_arm_line_mm=float(q))
        for state, p, q in zip(states, path, line, strict=True)
    ]


def _arm(lengths: Float, angle: Float) -> Float:
    found: Float = -np.gradient(lengths, angle, edge_order=2)
    return found
