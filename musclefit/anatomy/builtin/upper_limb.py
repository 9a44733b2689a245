"""The built-in right upper limb: bones, muscles and skin as closed surfaces, made from implicit shapes alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from musclefit.anatomy.builtin.bones import humerus, radius, ulna
from musclefit.anatomy.builtin.implicit_shapes import Shape, graded_axis, offset, polygonised, tube, union
from musclefit.anatomy.builtin.joints import from_forearm
from musclefit.anatomy.builtin.muscles import bellies, muscle_shapes
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh

FRAME = "right upper limb, x lateral, y anterior, z proximal, origin on the elbow's hinge, mm"

SKIN_THICKNESS_MM = 4.5
"""Least depth of bones and muscles below the skin, before triangles cut corners."""

DECIMALS = 4
"""Vertices are rounded to 1e-4 mm, so that the last bits of a machine's arithmetic do not change them."""

RELAXATIONS = 6

MUSCLE_SPACING_MM = (2.8, 2.8, 3.3)
"""Lattice for the muscles: their thinnest tendons are 6 mm across."""

# Rows: centre of the section (x, y, z), half width, half depth; all mm.
_OUTLINE_ABOVE_ELBOW = np.array(
    [
        [-2, -2, 286, 38, 38.5],
        [-1, -1.5, 272, 39.5, 41],
        [1, 0, 250, 42, 45],
        [1, 0, 225, 42, 47],
        [1, -1, 180, 40, 48],
        [1, -1, 130, 38, 46],
        [0, -1, 80, 37, 40],
        [-1, -1, 40, 40, 36],
        [-1, 0, 10, 43, 35],
    ]
)
# The same with the centre in forearm coordinates (u, v, w).
_OUTLINE_BELOW_ELBOW = np.array(
    [
        [2.5, 1, 35, 44, 35],
        [4.5, 1, 70, 43, 34],
        [6.5, 1, 110, 39, 31],
        [8.5, -0.5, 160, 33, 25],
        [11, -2, 205, 29, 20],
        [13.5, -2.5, 240, 29, 18.5],
    ]
)


@cache  # some seconds of work for records that nobody can change
def upper_limb() -> Anatomy:
    """A right upper limb from shoulder to wrist: three bones, eight muscles, skin; nothing is read from a file.

    At rest the elbow is extended and the forearm supinated. All tissues are closed and oriented outward, bones and
    muscles are pairwise disjoint, and all are inside the skin. Sizes are those of an adult; shapes are schematic.

    Returns
    -------
    Anatomy
        The same vertices at every call.
    """
    skin = Tissue("skin", TissueKind.SKIN, _skin_surface())
    return Anatomy((skin, *_muscles(), *_bones()), FRAME)


def _surface(shape: Shape, axes: Sequence[Float]) -> TriMesh:
    mesh = polygonised(shape, axes=axes, relaxations=RELAXATIONS)
    return mesh.with_vertices(np.round(mesh.vertices, DECIMALS))


def _bones() -> list[Tissue]:
    humerus_axes = [
        graded_axis((-42.0, 36.0, 2.7)),
        graded_axis((-36.0, 24.0, 2.7)),
        graded_axis((-18.0, 34.0, 2.2), (34.0, 66.0, 3.5), (66.0, 248.0, 7.0), (248.0, 316.0, 4.2)),
    ]
    ulna_axes = [
        graded_axis((-20.0, 42.0, 2.2)),
        graded_axis((-34.0, 14.0, 2.2)),
        graded_axis((-256.0, -222.0, 2.0), (-222.0, -50.0, 5.0), (-50.0, 26.0, 2.2)),
    ]
    radius_axes = [
        graded_axis((0.0, 74.0, 2.3)),
        graded_axis((-18.0, 18.0, 2.3)),
        graded_axis((-256.0, -214.0, 2.5), (-214.0, -52.0, 5.0), (-52.0, -4.0, 2.2)),
    ]
    return [
        Tissue("bone_humerus", TissueKind.BONE, _surface(humerus(), humerus_axes)),
        Tissue("bone_ulna", TissueKind.BONE, _surface(ulna(), ulna_axes)),
        Tissue("bone_radius", TissueKind.BONE, _surface(radius(), radius_axes)),
    ]


def _muscles() -> list[Tissue]:
    shapes = muscle_shapes()
    tissues = []
    for name, belly in bellies().items():
        low, high = belly.box()
        axes = [graded_axis((a, b, spacing)) for a, b, spacing in zip(low, high, MUSCLE_SPACING_MM, strict=True)]
        tissues.append(Tissue(name, TissueKind.MUSCLE, _surface(shapes[name], axes)))
    return tissues


def _contour() -> Shape:
    """The limb's outline: the skin where no bone or muscle lies close below it."""
    above, below = _OUTLINE_ABOVE_ELBOW, _OUTLINE_BELOW_ELBOW
    knots = np.concatenate([above[:, :3], from_forearm(below[:, :3])])
    sections = np.concatenate([above[:, 3:], below[:, 3:]])
    return tube(knots, sections, width_direction=np.array([1.0, 0.0, 0.0]))


def _skin_surface() -> TriMesh:
    tissues = union(humerus(), ulna(), radius(), *(belly.shape() for belly in bellies().values()), blend_mm=8.0)
    shape = union(_contour(), offset(tissues, by_mm=SKIN_THICKNESS_MM), blend_mm=14.0)
    axes = [graded_axis((-60.0, 84.0, 6.8)), graded_axis((-62.0, 62.0, 6.8)), graded_axis((-282.0, 342.0, 8.2))]
    return _surface(shape, axes)
