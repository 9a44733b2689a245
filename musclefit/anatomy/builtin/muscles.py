"""The muscles of the built-in right limb as tables of elliptic sections; bellies yield to bones and to each other.

Each muscle is a tube along its line of pull, thick at the belly and thin at the tendons. Its ends touch or enter the
bone they belong to; the bone, grown by a gap, is carved away, so that every end lies on its bone one gap off it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, reduce

import numpy as np

from musclefit.anatomy.builtin.bones import HUMERUS_BOX, RADIUS_BOX, ULNA_BOX, humerus, radius, ulna
from musclefit.anatomy.builtin.implicit_shapes import Shape, carved, parted, tube, union, within_box
from musclefit.anatomy.builtin.joints import from_forearm
from musclefit.geometry.arrays import Float, Points, frozen

BONE_GAP_MM = 0.9
MUSCLE_GAP_MM = 1.0
EDGE_ROUNDING_MM = 2.0
BOX_MARGIN_MM = 3.0
"""Free space around a belly in its lattice."""
NEIGHBOUR_MARGIN_MM = np.array([[-6.0], [6.0]])
"""How far around its box a neighbour is still evaluated."""


@dataclass(frozen=True, eq=False, slots=True)
class Belly:
    """One muscle's line of pull and sections.

    Parameters
    ----------
    knots : (k, 3) float64, mm
        From origin to insertion.
    semi_axes_mm : (k, 2) float64
        Half width (lateral) and half depth there.
    """

    knots: Points
    semi_axes_mm: Float

    def __post_init__(self) -> None:
        for name in ("knots", "semi_axes_mm"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def shape(self) -> Shape:
        """The belly before it yields to anything."""
        return tube(self.knots, self.semi_axes_mm, width_direction=np.array([1.0, 0.0, 0.0]))

    def box(self) -> Float:
        """(2, 3) corners of a box that encloses the belly, mm."""
        reach = self.semi_axes_mm.max(axis=1)[:, None] + BOX_MARGIN_MM
        return np.stack([(self.knots - reach).min(axis=0), (self.knots + reach).max(axis=0)])


# Rows: centre of the section (x, y, z), half width, half depth; all mm, from origin to insertion.
_BICEPS_LONG_HEAD = np.array(
    [
        [8, 18.5, 286, 2.6, 2.6],
        [9, 19, 262, 2.8, 2.8],
        [11, 23, 238, 6, 5],
        [13, 27, 205, 12, 9.5],
        [13, 29.5, 165, 14, 12],
        [11, 29.5, 125, 13.5, 11.5],
        [8, 28, 90, 10, 8.5],
        [7, 26, 62, 5.5, 4.5],
        [8, 26, 35, 3.8, 3.2],
        [10, 25, 5, 3.1, 2.9],
        [11.5, 18, -15, 3, 3],
        [12, 13, -23, 3.1, 3.1],
        [11.5, 9, -30, 3.2, 3.2],
    ]
)
_BICEPS_SHORT_HEAD = np.array(
    [
        [-22, 24, 288, 3, 3],
        [-19, 25, 262, 4, 3.5],
        [-16, 27, 238, 7.5, 6],
        [-12, 29, 205, 12, 10],
        [-10, 30.5, 165, 13, 12],
        [-8, 30, 125, 12, 11],
        [-4, 28, 90, 9, 8.5],
        [-1, 26, 62, 5.5, 4.5],
        [0, 26, 35, 3.8, 3.2],
        [2.5, 25.5, 5, 3.1, 2.9],
        [5, 20, -15, 3, 3],
        [7, 13, -29, 3.1, 3.1],
        [8, 8.5, -40, 3.2, 3.2],
    ]
)
_BRACHIALIS = np.array(
    [
        [5, 10.5, 174, 4.5, 3.4],
        [3, 10.5, 150, 12, 7],
        [1, 11, 115, 22, 12],
        [0, 12, 80, 26, 13.5],
        [-1, 12.5, 48, 24.5, 12],
        [-3, 14, 20, 18, 7.5],
        [-5, 15.5, 0, 12, 5],
        [-5, 12, -20, 7, 4.5],
        [-3, 4, -36, 5, 3.5],
        [-3, 0, -42, 4.5, 3.5],
    ]
)
_TRICEPS_LONG_HEAD = np.array(
    [
        [-30, -14, 268, 4, 3.6],
        [-26, -21, 245, 9, 8],
        [-21, -29, 210, 16, 14],
        [-17, -32, 165, 19, 16],
        [-13, -32, 125, 16, 13],
        [-10, -30, 90, 12, 8.5],
        [-8, -28, 60, 7.5, 4.5],
        [-8, -28, 38, 5.5, 3.3],
        [-7.5, -26.5, 22, 5, 3.3],
        [-7, -22, 11, 4, 3.5],
    ]
)
_TRICEPS_LATERAL_HEAD = np.array(
    [
        [13, -18.5, 260, 4, 3.6],
        [15, -22, 240, 8.5, 7.5],
        [18, -27, 205, 14, 13],
        [18, -30, 165, 16.5, 15],
        [15, -31, 125, 16, 13],
        [8, -30, 90, 12, 8.5],
        [2, -28, 60, 7.5, 4.5],
        [0, -28, 38, 5.5, 3.3],
        [-0.5, -26.5, 22, 5, 3.3],
        [-1, -22, 11, 4, 3.5],
    ]
)
_TRICEPS_MEDIAL_HEAD = np.array(
    [
        [-4, -16, 196, 4.5, 3.6],
        [-4, -17, 165, 13, 8],
        [-3, -18, 125, 22, 12],
        [-3, -19, 90, 24, 13],
        [-4, -19, 60, 21, 11],
        [-4, -20, 38, 14, 7],
        [-4, -19.5, 25, 9, 4],
        [-4, -17, 15, 7, 3.5],
    ]
)
_BRACHIORADIALIS_ABOVE_ELBOW = np.array(
    [
        [14, -1, 110, 3.5, 4],
        [18, 1, 80, 5, 7],
        [25, 5, 50, 7.5, 10],
        [31, 9, 20, 9, 12.5],
    ]
)
_PRONATOR_TERES_ABOVE_ELBOW = np.array(
    [
        [-28, 0, 14, 4.5, 4],
        [-25, 9, -2, 8, 6.5],
    ]
)
# Rows below the elbow: the same with the centre in forearm coordinates (u, v, w).
_BRACHIORADIALIS_BELOW_ELBOW = np.array(
    [
        [33, 12, 15, 9.5, 13],
        [34, 12, 50, 9, 12],
        [34, 10, 85, 7.5, 9.5],
        [33, 8, 115, 5, 6],
        [33, 6, 145, 3.2, 3.6],
        [34, 4, 180, 2.8, 3.2],
        [35, 0, 230, 2.8, 3],
    ]
)
_PRONATOR_TERES_BELOW_ELBOW = np.array(
    [
        [-17, 14, 24, 11, 8.5],
        [-8, 15, 50, 11.5, 8.5],
        [4, 15, 80, 10, 7],
        [17, 13, 105, 7, 4.5],
        [26, 8, 122, 5.5, 3.2],
        [30, 3, 132, 4, 3],
    ]
)


def _belly(above_elbow: Float, below_elbow: Float) -> Belly:
    knots = np.concatenate([above_elbow[:, :3], from_forearm(below_elbow[:, :3])])
    return Belly(knots, np.concatenate([above_elbow[:, 3:], below_elbow[:, 3:]]))


def bellies() -> Mapping[str, Belly]:
    """Every muscle's table, by tissue name."""
    nothing = np.empty((0, 5))
    return {
        "muscle_biceps_long_head": _belly(_BICEPS_LONG_HEAD, nothing),
        "muscle_biceps_short_head": _belly(_BICEPS_SHORT_HEAD, nothing),
        "muscle_brachialis": _belly(_BRACHIALIS, nothing),
        "muscle_triceps_long_head": _belly(_TRICEPS_LONG_HEAD, nothing),
        "muscle_triceps_lateral_head": _belly(_TRICEPS_LATERAL_HEAD, nothing),
        "muscle_triceps_medial_head": _belly(_TRICEPS_MEDIAL_HEAD, nothing),
        "muscle_brachioradialis": _belly(_BRACHIORADIALIS_ABOVE_ELBOW, _BRACHIORADIALIS_BELOW_ELBOW),
        "muscle_pronator_teres": _belly(_PRONATOR_TERES_ABOVE_ELBOW, _PRONATOR_TERES_BELOW_ELBOW),
    }


@cache
def muscle_shapes() -> Mapping[str, Shape]:
    """Every muscle as it ends up: off the bones by ``BONE_GAP_MM``, off its neighbours by ``MUSCLE_GAP_MM``."""
    tables = bellies()
    raw = {name: belly.shape() for name, belly in tables.items()}
    boxes = {name: belly.box() for name, belly in tables.items()}
    bones = [
        within_box(shape(), np.array(box) + NEIGHBOUR_MARGIN_MM)
        for shape, box in ((humerus, HUMERUS_BOX), (ulna, ULNA_BOX), (radius, RADIUS_BOX))
    ]

    def finished(name: str) -> Shape:
        neighbours = [
            within_box(raw[other], boxes[other] + NEIGHBOUR_MARGIN_MM)
            for other in raw
            if other != name and _touch(boxes[name], boxes[other])
        ]
        apart = reduce(
            lambda shape, other: parted(shape, other, gap_mm=MUSCLE_GAP_MM, blend_mm=EDGE_ROUNDING_MM),
            neighbours,
            raw[name],
        )
        return carved(apart, union(*bones, blend_mm=0.01), gap_mm=BONE_GAP_MM, blend_mm=EDGE_ROUNDING_MM)

    return {name: finished(name) for name in raw}


def _touch(first: Float, second: Float) -> bool:
    return bool((first[0] <= second[1]).all() and (second[0] <= first[1]).all())
