"""Muscles of an OpenSim model in poses: lengths, moment arms and path points by OpenSim's own library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Float, Points
from musclefit.io.formats.osim import OpenSimModel
from musclefit.io.libraries.process import asked
from musclefit.progress import Tick
from musclefit.rig.multibody import Multibody
from musclefit.vocabulary import Unit


@dataclass(frozen=True, eq=False, slots=True)
class MusclePaths:
    """Muscles in poses.

    Parameters
    ----------
    muscles : tuple of str, length m
    pairs : tuple of (muscle, coordinate), length p
        Coordinates that the muscle crosses.
    lengths_mm : (k, m) float64
    arms_mm : (k, p) float64
        Moment arms, mm (per radian); of a coordinate that is a length they have no unit, and are given a thousandfold.
    lines : tuple of k tuples of m (n, 3) arrays
        Path points in the ground, those on wrap objects included, mm.
    """

    muscles: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    lengths_mm: Float
    arms_mm: Float
    lines: tuple[tuple[Points, ...], ...]


def muscle_paths(
    data: bytes,
    *,
    muscles: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    poses: Sequence[Mapping[str, float]],
    source: str,
    tick: Tick = lambda _: None,
) -> MusclePaths:
    """Ask OpenSim for muscles' lengths, moment arms and paths.

    Parameters
    ----------
    data : bytes
        The model's file; its geometry is not needed.
    muscles : sequence of str
    pairs : sequence of (muscle, coordinate)
    poses : sequence of mapping of coordinate to radians or metres
        Of all coordinates.
    source : str
    tick : function of a fraction

    Raises
    ------
    InputError
        OpenSim is not installed, or cannot open the model.
    """
    given = {
        "muscles": np.array(muscles, dtype=str),
        "pairs": np.array(pairs, dtype=str).reshape(-1, 2),
        "coordinates": np.array(list(poses[0]), dtype=str),
        "values": np.array([list(pose.values()) for pose in poses]),
    }
    answer = asked("muscle_paths", given, {"model.osim": data}, library="opensim", source=source, tick=tick)
    in_mm = Unit.METRE.in_mm
    ends = np.cumsum(answer["counts"].ravel())
    split = np.split(answer["points_m"] * in_mm, ends[:-1])
    lines = tuple(tuple(split[k * len(muscles) : (k + 1) * len(muscles)]) for k in range(len(poses)))
    return MusclePaths(tuple(muscles), tuple(pairs), answer["lengths_m"] * in_mm, answer["arms_m"] * in_mm, lines)


def crossed_coordinates(model: OpenSimModel) -> tuple[tuple[str, str], ...]:
    """Of each muscle the free coordinates of the joints that part the bodies of its path points."""
    bodies: dict[str, set[str]] = {}
    for point in model.points:
        if point.of:
            bodies.setdefault(point.of, set()).add(point.body)
    followed = {coupler.dependent: coupler.independent for coupler in model.multibody.couplers}
    beyond = _beyond(model.multibody)
    pairs: dict[tuple[str, str], None] = {}
    for muscle, on in bodies.items():
        for name, of in model.multibody.coordinates.items():
            if on & beyond[of.joint] and on - beyond[of.joint]:
                lead = followed.get(name, name)
                if not model.multibody.coordinates[lead].locked:
                    pairs[muscle, lead] = None
    return tuple(pairs)


def _beyond(multibody: Multibody) -> dict[str, set[str]]:
    """Of each joint the bodies that hang on it."""
    beyond: dict[str, set[str]] = {joint.name: {joint.child} for joint in multibody.joints}
    for joint in multibody.joints:
        for other in multibody.joints:
            if joint.parent in beyond[other.name]:
                beyond[other.name].add(joint.child)
    return beyond
