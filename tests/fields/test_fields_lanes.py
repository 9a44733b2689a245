"""Sums with points in lanes against the same sums in a plain loop, and the reciprocal root that they are made of."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from musclefit.fields import radial
from musclefit.fields.evaluation.lanes import SHARE, WIDTH, load, shared_inverse_root, shared_root, store
from musclefit.fields.kernels import KERNELS
from musclefit.fields.radial import RadialBackend

IN_LANES = [kernel.name for kernel in KERNELS.values() if kernel.lanes is not None]


@njit
def roots(block):
    x = load(block, 0)
    store(block, 1, shared_root(x))
    store(block, 2, shared_inverse_root(x))


def test_roots_are_right_to_a_few_units_in_the_last_place():
    rng = np.random.default_rng(0)
    given = np.concatenate([10.0 ** rng.uniform(-180.0, 180.0, 4000), rng.uniform(1.0, 4.0, 4000), [1e-180, 1.0, 4.0]])
    given = np.pad(given, (0, -len(given) % WIDTH), constant_values=2.0)
    found = np.empty((2, len(given)))
    for i in range(0, len(given), WIDTH):
        block = np.zeros((3, WIDTH))
        block[0] = given[i : i + WIDTH]
        roots(block)
        found[:, i : i + WIDTH] = block[1:] / SHARE
    expected = np.sqrt(given.astype(np.longdouble))
    assert np.abs(found[0] / expected - 1.0).max() < 1e-15
    assert np.abs(found[1] * expected - 1.0).max() < 1e-15


@pytest.mark.parametrize("kernel", IN_LANES)
@pytest.mark.parametrize("n_points", [1, WIDTH + 1, 150])
def test_lanes_give_what_the_loop_of_any_kernel_gives(kernel, n_points, monkeypatch):
    rng = np.random.default_rng(n_points)
    at, moved = rng.uniform(-50.0, 50.0, (33, 3)) + 300.0, rng.normal(size=(33, 3))
    field = RadialBackend(kernel, scale=7.0).fit(at, moved)
    points = rng.uniform(240.0, 360.0, (n_points, 3))
    points[0] = at[5]  # a centre itself
    values, (again, gradients) = field.displacement(points), field.displacement_and_gradient(points)
    monkeypatch.setattr(radial, "kernel_named", lambda name: replace(KERNELS[name], lanes=None))
    expected, expected_gradients = field.displacement_and_gradient(points)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(again, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(gradients, expected_gradients, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_machines_without_rough_roots_give_the_same(tmp_path):
    """This very file on the instructions of an older machine."""
    environment = os.environ | {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma"}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(Path(__file__))]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
