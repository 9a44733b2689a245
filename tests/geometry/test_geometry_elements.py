"""Shapes of elements against VTK's own measure (Verdict) and against shapes whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv

from musclefit.geometry.elements import SOLIDS, CellKind, scaled_jacobians, warpages

TOP = np.sqrt(2.0 / 3.0)
IDEAL = {
    CellKind.TET: [[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0], [0.5, np.sqrt(0.75) / 3.0, TOP]],
    CellKind.HEX: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    CellKind.WEDGE: [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (0.5, np.sqrt(0.75)))],
    CellKind.PYRAMID: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, np.sqrt(0.5)]],
}
VTK = {CellKind.TET: pv.CellType.TETRA, CellKind.HEX: pv.CellType.HEXAHEDRON}


@pytest.mark.parametrize("kind", SOLIDS)
def test_the_ideal_element_is_1_whatever_its_size_and_mirrored_minus_1(kind):
    vertices = np.array(IDEAL[kind], dtype=float)
    corners = np.arange(len(vertices))[None]
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert scaled_jacobians(37.0 * vertices @ turn.T + 5.0, corners, kind=kind)[0] == pytest.approx(1.0)
    assert scaled_jacobians(vertices * [1, 1, -1], corners, kind=kind)[0] == pytest.approx(-1.0)
    vertices[1] = vertices[0]
    assert scaled_jacobians(vertices, corners, kind=kind)[0] <= 0.0


@pytest.mark.parametrize("kind", VTK)
def test_scaled_jacobians_are_those_of_vtk(kind):
    rng = np.random.default_rng(1)
    ideal = np.array(IDEAL[kind], dtype=float)
    vertices = (ideal + rng.normal(scale=0.12, size=(200, *ideal.shape))).reshape(-1, 3)
    corners = np.arange(len(vertices)).reshape(200, -1)
    theirs = pv.UnstructuredGrid({VTK[kind]: corners}, vertices).cell_quality("scaled_jacobian")["scaled_jacobian"]
    ours = scaled_jacobians(vertices, corners, kind=kind)
    if kind is CellKind.HEX:  # Verdict looks at the middle too, which can be worse
        assert (theirs <= ours + 1e-9).all()
        np.testing.assert_allclose(np.median(theirs - ours), 0.0, atol=1e-9)
    else:
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)


def test_warpage_is_the_angle_of_the_fold():
    for degrees in (0.0, 7.5, 90.0):
        # Folded along the diagonal 0 2, which has length 2: the corner 3 is lifted about it.
        angle = np.radians(degrees)
        vertices = np.array([[-1, 0, 0], [0, -1, 0], [1, 0, 0], [0, np.cos(angle), np.sin(angle)]])
        assert warpages(vertices, np.array([[0, 1, 2, 3]]))[0] == pytest.approx(degrees, abs=1e-6)
        assert warpages(vertices, np.array([[1, 2, 3, 0]]))[0] == pytest.approx(degrees, abs=1e-6)
