"""Sparse fits of compact kernels: the dense solution, no divergence, nothing beyond the support."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import FieldError
from musclefit.fields.fitting.conjugate_gradients import CompactBackend
from musclefit.fields.radial import RadialBackend

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


def test_kernels_without_support_are_refused():
    with pytest.raises(FieldError, match="'r3' is not compact; compact ones are: wendland-c2"):
        CompactBackend("r3", 10.0)
    with pytest.raises(FieldError, match=r"the support is 0\.0 mm"):
        CompactBackend("wendland-c2", 0.0)
