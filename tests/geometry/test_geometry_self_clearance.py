"""Parts of a surface that all but touch are moved apart, at whatever angle; what keeps apart is left alone."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.booleans import as_mesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.self_clearance import too_close, with_self_clearance

WIDTH, MOST = 0.02, 0.025


def extruded(outline: list[tuple[float, float]], *, height: float = 5.0) -> TriMesh:
    return as_mesh(m3.CrossSection([np.array(outline)]).extrude(height))


def slotted(gap: float) -> TriMesh:
    """A block with a slot from one side."""
    low, high = 2.0 - 0.5 * gap, 2.0 + 0.5 * gap
    return extruded([(0, 0), (10, 0), (10, low), (3, low), (3, high), (10, high), (10, 4), (0, 4)])


def toothed(gap: float) -> TriMesh:
    """A block whose upper arm has a tooth that almost stands on the lower one, at 45 degrees."""
    return extruded([(0, 0), (10, 0), (10, 1), (3, 1), (3, 3), (5, 3), (7, 1 + gap), (8, 3), (10, 3), (10, 4), (0, 4)])


def folded() -> TriMesh:
    """A block with a fold: a corner of two of its triangles is pulled over the edge and lies on the next face."""
    block = as_mesh(m3.Manifold.cube([4.0, 4.0, 4.0]).refine(4))
    top = np.isclose(block.vertices[:, 2], 4.0)
    (pulled,) = np.flatnonzero(top & np.isclose(block.vertices[:, 0], 1.0) & np.isclose(block.vertices[:, 1], 2.0))
    moved = block.vertices.copy()
    moved[pulled] += [1.03, 0.2, 1e-9]
    return block.with_vertices(moved)


@pytest.mark.parametrize("scale", [-1.0, 1.0])
@pytest.mark.parametrize("gap", [1e-7, 1e-3, 0.005])
@pytest.mark.parametrize("shape", [slotted, toothed])
def test_what_almost_touches_is_moved_apart(shape: object, gap: float, scale: float) -> None:
    given = shape(gap)  # type: ignore[operator]
    if scale < 0.0:  # the mirror image
        given = TriMesh(given.vertices * [-1.0, 1.0, 1.0], given.faces[:, ::-1])
    assert not len(self_crossings(given))
    assert too_close(given, width_mm=WIDTH).any()
    done = with_self_clearance(given, width_mm=WIDTH, most_mm=MOST)
    assert not too_close(done.mesh, width_mm=0.99 * WIDTH).any()
    assert faults_of(done.mesh).none
    assert 0.0 < done.moved_mm <= MOST
    assert np.linalg.norm(done.mesh.vertices - given.vertices, axis=1).max() <= MOST * (1.0 + 1e-12)
    assert enclosed_volume(done.mesh) == pytest.approx(enclosed_volume(given), rel=0.02)


def test_what_keeps_apart_is_left_alone() -> None:
    given = slotted(0.05)
    done = with_self_clearance(given, width_mm=WIDTH, most_mm=MOST)
    assert done.mesh is given
    assert (done.moved, done.removed, done.filled) == (0, 0, 0)


def test_a_fold_without_width_is_taken_out() -> None:
    given = folded()
    assert too_close(given, width_mm=1e-6).any()
    done = with_self_clearance(given, width_mm=WIDTH, most_mm=MOST)
    assert done.removed > 0
    assert faults_of(done.mesh).none
    assert not too_close(done.mesh, width_mm=0.1 * WIDTH).any()
    assert enclosed_volume(done.mesh) == pytest.approx(enclosed_volume(given), rel=1e-3)
