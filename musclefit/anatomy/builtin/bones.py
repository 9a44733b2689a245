"""Humerus, radius and ulna of the built-in right limb as implicit shapes; the joint surfaces are solids of revolution.

The humero-ulnar joint is a revolved trochlea in a notch cut by the same profile, the humero-radial one a ball in a
cup, the radio-ulnar ones solids of revolution about the forearm axis: turning about the axes changes no gap. The
fossae of the humerus are what the forearm bones sweep when the elbow flexes.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from musclefit.anatomy.builtin.implicit_shapes import (
    Shape,
    ball,
    carved,
    cylinder,
    ellipsoid,
    revolved,
    swept_about_x,
    tube,
    union,
)
from musclefit.anatomy.builtin.joints import (
    CAPITULUM_CENTRE,
    MAX_FLEXION_DEG,
    ULNA_HEAD_CENTRE,
    along_forearm_axis,
    from_forearm,
)

CARTILAGE_GAP_MM = 1.5
"""Between the bones' facing joint surfaces (two layers of cartilage)."""
FOSSA_GAP_MM = 1.2
"""Left between the humerus and whatever flexion sweeps."""
SWEEP_MARGIN_DEG = 4.0
"""How far beyond the feasible flexion the fossae are still wide enough."""
CAPITULUM_RADIUS_MM = 11.0
RADIAL_HEAD_RADIUS_MM = 11.0
ULNA_HEAD_RADIUS_MM = 8.0

TROCHLEA_STATIONS_MM = np.array([-16.0, -15.0, -13.0, -8.5, -3.0, 3.0, 6.0, 9.0])
TROCHLEA_RADII_MM = np.array([9.5, 11.8, 12.9, 10.6, 8.8, 9.5, 9.8, 9.0])
HUMERUS_BOX = ((-42.0, -36.0, -18.0), (36.0, 24.0, 316.0))
ULNA_BOX = ((-20.0, -34.0, -256.0), (42.0, 14.0, 26.0))
RADIUS_BOX = ((0.0, -18.0, -256.0), (74.0, 18.0, -4.0))
"""Opposite corners of boxes that enclose the bones, mm."""
_WIDE = np.array([1.0, 0.0, 0.0])


def _trochlea(margin_mm: float) -> Shape:
    return revolved(TROCHLEA_STATIONS_MM, TROCHLEA_RADII_MM, margin_mm=margin_mm)


def _humerus_shaft() -> Shape:
    shaft = tube(
        np.array([[0, -6, 28], [0, -5, 48], [0, -4, 85], [1, -3, 140], [2, -3, 200], [1, -4, 245], [-2, -5, 275]]),
        np.array([[16, 8], [14, 9], [11, 10], [10.5, 10.8], [11.2, 11.2], [13.5, 13.5], [20, 19]]),
        width_direction=_WIDE,
    )
    deltoid_tuberosity = tube(
        np.array([[9, -2, 190], [11, -1, 168], [9, -1, 146]]), np.array([[2, 2], [4, 4], [2, 2]]), width_direction=_WIDE
    )
    return union(shaft, deltoid_tuberosity, blend_mm=8.0)


def _humerus_head() -> Shape:
    head = ball(np.array([-9.0, -9.0, 288.0]), radius_mm=22.5)
    greater = ellipsoid(np.array([14.0, 0.0, 285.0]), semi_axes_mm=np.array([10.0, 15.0, 18.0]), rotation=np.eye(3))
    lesser = ellipsoid(np.array([-2.0, 13.0, 281.0]), semi_axes_mm=np.array([7.0, 7.0, 13.0]), rotation=np.eye(3))
    groove = tube(
        np.array([[10, 20, 310], [9, 17, 285], [8, 15, 262], [6, 14, 240]]),
        np.array([[4, 4], [3.5, 3.5], [3.5, 3.5], [2, 2]]),
        width_direction=_WIDE,
    )
    tubercles = union(greater, lesser, blend_mm=5.0)
    return carved(union(head, tubercles, blend_mm=7.0), groove, gap_mm=0.0, blend_mm=2.5)


def _humerus_condyle() -> Shape:
    columns = [
        tube(
            np.array([[-4, -5, 72], [-13, -6, 40], [-23, -6, 18], [-31, -6, 7]]),
            np.array([[5, 5], [7, 7.5], [6.5, 6.5], [5.5, 5]]),
            width_direction=_WIDE,
        ),
        tube(
            np.array([[4, -5, 72], [13, -6, 40], [21, -6, 20], [27, -4, 5]]),
            np.array([[5, 5], [7, 7.5], [6, 6.5], [4.5, 5.5]]),
            width_direction=_WIDE,
        ),
    ]
    plate = ellipsoid(np.array([0.0, -5.0, 18.0]), semi_axes_mm=np.array([24.0, 8.0, 24.0]), rotation=np.eye(3))
    medial_base = tube(
        np.array([[-14, -2, 2], [-24, -4, 8]]), np.array([[7, 7], [5, 5]]), width_direction=np.array([0.0, 1.0, 0.0])
    )
    capitulum = ball(CAPITULUM_CENTRE, radius_mm=CAPITULUM_RADIUS_MM)
    rolls = union(_trochlea(0.0), capitulum, blend_mm=2.0)
    return union(union(*columns, plate, medial_base, blend_mm=6.0), rolls, blend_mm=3.0)


@cache
def ulna() -> Shape:
    """The ulna: olecranon, trochlear notch, coronoid, shaft, head and styloid."""
    olecranon = tube(
        np.array([[-4, -15, 13], [-4, -18.5, 2], [-4, -16, -14], [-4, -10, -32]]),
        np.array([[9.5, 7.5], [11.5, 10.5], [11, 11.5], [8.5, 9.5]]),
        width_direction=_WIDE,
    )
    coronoid = tube(
        np.array([[-4, -10, -22], [-4, -2, -19], [-4, 5, -15]]),
        np.array([[9, 9], [10, 7], [9, 4]]),
        width_direction=_WIDE,
    )
    shaft = tube(
        from_forearm(
            np.array([[-5, -10, 28], [-7, -9, 55], [-9, -9, 100], [-8.5, -8, 150], [-5, -5.5, 195], [-2.5, -3.5, 225]])
        ),
        np.array([[7.5, 9], [6.5, 8], [6, 7], [5.5, 6], [5, 5], [5.5, 5.5]]),
        width_direction=_WIDE,
    )
    head = ellipsoid(
        ULNA_HEAD_CENTRE, semi_axes_mm=np.array([ULNA_HEAD_RADIUS_MM, ULNA_HEAD_RADIUS_MM, 7.5]), rotation=np.eye(3)
    )
    styloid = tube(
        from_forearm(np.array([[-6, -7, 234], [-7, -8, 246]])),
        np.array([[3.5, 3.5], [2.4, 2.4]]),
        width_direction=_WIDE,
    )
    proximal = union(union(olecranon, coronoid, blend_mm=6.0), shaft, blend_mm=6.0)
    notched = carved(proximal, _trochlea(0.0), gap_mm=CARTILAGE_GAP_MM, blend_mm=1.2)
    radial_notch = cylinder(
        start=along_forearm_axis(-5.0),
        end=along_forearm_axis(25.0),
        radius_mm=RADIAL_HEAD_RADIUS_MM,
        rounding_mm=2.0,
    )
    seated = carved(notched, radial_notch, gap_mm=CARTILAGE_GAP_MM, blend_mm=1.2)
    return union(seated, union(head, styloid, blend_mm=4.0), blend_mm=5.0)


@cache
def radius() -> Shape:
    """The radius: head with its cup, neck, tuberosity, bowed shaft, distal end with styloid and ulnar notch."""
    head = cylinder(
        start=along_forearm_axis(10.6),
        end=along_forearm_axis(20.0),
        radius_mm=RADIAL_HEAD_RADIUS_MM,
        rounding_mm=2.5,
    )
    cupped = carved(head, ball(CAPITULUM_CENTRE, radius_mm=CAPITULUM_RADIUS_MM), gap_mm=CARTILAGE_GAP_MM, blend_mm=1.0)
    neck = tube(
        np.array([along_forearm_axis(t) for t in (16.0, 26.0, 34.0)]),
        np.array([[7.0, 7.0], [6.2, 6.2], [6.4, 6.4]]),
        width_direction=_WIDE,
    )
    shaft = tube(
        np.concatenate(
            [
                [along_forearm_axis(t) for t in (30.0, 40.0)],
                from_forearm(
                    np.array(
                        [[17.5, 0, 60], [23, 1, 95], [25.5, 0, 130], [24.5, -1, 165], [22, -2, 200], [21, -2, 224]]
                    )
                ),
            ]
        ),
        np.array([[6.2, 6.2], [6.6, 6.6], [6.8, 6.6], [6.8, 6.5], [7, 6.2], [7.5, 6.2], [9, 7], [13, 9]]),
        width_direction=_WIDE,
    )
    tuberosity = ellipsoid(
        along_forearm_axis(38.0) + np.array([-5.0, 3.0, 0.0]),
        semi_axes_mm=np.array([5.0, 5.0, 11.0]),
        rotation=np.eye(3),
    )
    distal = ellipsoid(
        from_forearm(np.array([21.5, -2, 232])), semi_axes_mm=np.array([15.5, 10.0, 13.0]), rotation=np.eye(3)
    )
    styloid = tube(
        from_forearm(np.array([[30, -1, 230], [34, -1, 246]])), np.array([[5.5, 7], [3.2, 4]]), width_direction=_WIDE
    )
    carpal_face = ellipsoid(
        from_forearm(np.array([18.0, -1, 253])), semi_axes_mm=np.array([19.0, 14.0, 13.0]), rotation=np.eye(3)
    )
    end = carved(union(distal, styloid, blend_mm=6.0), carpal_face, gap_mm=0.0, blend_mm=2.0)
    whole = union(union(union(cupped, neck, blend_mm=4.0), shaft, tuberosity, blend_mm=5.0), end, blend_mm=6.0)
    ulnar_notch = cylinder(
        start=along_forearm_axis(212.0),
        end=along_forearm_axis(270.0),
        radius_mm=ULNA_HEAD_RADIUS_MM,
        rounding_mm=3.0,
    )
    return carved(whole, ulnar_notch, gap_mm=CARTILAGE_GAP_MM, blend_mm=1.5)


@cache
def humerus() -> Shape:
    """The humerus: head, tubercles, groove, shaft, epicondyles, trochlea, capitulum, and the fossae flexion needs."""
    whole = union(union(_humerus_shaft(), _humerus_head(), blend_mm=14.0), _humerus_condyle(), blend_mm=6.0)
    tool = swept_about_x(
        union(ulna(), radius(), blend_mm=0.01),
        turn_deg=(-SWEEP_MARGIN_DEG, MAX_FLEXION_DEG + SWEEP_MARGIN_DEG),
        half_length_mm=36.0,
        radius_mm=36.0,
        spacing_mm=2.0,
    )
    return carved(whole, tool, gap_mm=FOSSA_GAP_MM, blend_mm=1.0)
