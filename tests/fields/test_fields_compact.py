"""Sparse fits of compact kernels: the dense solution, no divergence, nothing beyond the support, slip along normals."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import FieldError
from musclefit.fields.compact import CompactBackend
from musclefit.fields.rbf import RadialBackend

COMPACT = ["wendland-c2", "wendland-c4", "isochoric-wendland-c6"]


def scattered(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-40.0, 40.0, (count, 3)), rng.normal(size=(count, 3))


@pytest.mark.parametrize("kernel", COMPACT)
def test_the_sparse_fit_is_the_dense_one(kernel):
    at, moved = scattered()
    points = np.random.default_rng(1).uniform(-60.0, 60.0, (200, 3))
    sparse, dense = CompactBackend(kernel, 25.0).fit(at, moved), RadialBackend(kernel, scale=25.0).fit(at, moved)
    np.testing.assert_allclose(sparse.displacement(at), moved, rtol=0, atol=1e-9)
    np.testing.assert_allclose(sparse.displacement(points), dense.displacement(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kernel", COMPACT)
def test_beyond_the_support_nothing_moves(kernel):
    at, moved = scattered()
    field = CompactBackend(kernel, 25.0).fit(at, moved)
    away = np.array([[200.0, 0.0, 0.0], [0.0, -66.0, 0.0], [0.0, 0.0, 1e6]])
    np.testing.assert_array_equal(field.displacement(away), 0.0)
    np.testing.assert_array_equal(field.gradient(away), 0.0)


def test_at_slip_points_only_the_normal_part_is_held():
    at, moved = scattered()
    normals = np.random.default_rng(2).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    field = CompactBackend("isochoric-wendland-c6", 25.0).fit_with_slip(at, moved, slip_normals=normals)
    there = field.displacement(at)
    np.testing.assert_allclose(there[:40], moved[:40], rtol=0, atol=1e-9)
    along = np.einsum("si,si->s", there[40:] - moved[40:], normals)
    np.testing.assert_allclose(along, 0.0, rtol=0, atol=1e-9)
    assert np.abs(there[40:] - moved[40:]).max() > 0.1
    assert np.abs(np.trace(field.gradient(at + 1.0), axis1=1, axis2=2)).max() < 1e-10


def test_kernels_without_support_are_refused():
    with pytest.raises(FieldError, match="'r3' is not compact; compact ones are: wendland-c2"):
        CompactBackend("r3", 10.0)
    with pytest.raises(FieldError, match=r"the support is 0\.0 mm"):
        CompactBackend("wendland-c2", 0.0)
