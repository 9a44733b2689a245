"""Radial sums and their fit against SciPy, ferreus-rbf and VTK, in one run, on one thread each.

Needs ferreus-rbf (``pip install .[bench]``). Threads are set before anything is imported:

    OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 RAYON_NUM_THREADS=1 pytest -n0 tests/benchmarks/test_bench_radial.py -s

200,000 points are moved by m landmarks. Printed are CPU seconds (best of three; of one for peers at 5,000 landmarks) of
fit and values, of fit, values and Jacobians, how many times as long a peer takes, and the largest error relative to the
largest displacement. The reference is the exact interpolant: weights refined by residuals in extended precision, summed
in extended precision. Compilation is outside of the time. VTK's fit takes hours for 5,000 landmarks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import vtk
from scipy.interpolate import RBFInterpolator
from scipy.linalg import lu_factor, lu_solve
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

from musclefit.fields.radial import RadialBackend

ferreus = pytest.importorskip("ferreus_rbf")
N_POINTS = 200_000
N_CHECKED = 300
THEIR_NAMES = {"r": ("linear", "Linear"), "r2logr": ("thin_plate_spline", "ThinPlateSpline")}


def cpu(function: Callable[[], object], repeats: int) -> tuple[object, float]:
    """The result and the least CPU seconds."""
    seconds = np.inf
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        seconds = min(seconds, time.process_time() - start)
    return result, seconds


def landmarks(m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Landmarks, a smooth motion of them with 0.1 mm of noise, and points, in a box of 200 mm."""
    rng = np.random.default_rng(m)
    at, points = rng.uniform(-100.0, 100.0, (m, 3)), rng.uniform(-100.0, 100.0, (N_POINTS, 3))
    moved = 8.0 * np.sin(at[:, [1, 2, 0]] / 40.0) + rng.normal(scale=0.1, size=(m, 3))
    return at, moved, points


def kernel_of(kernel: str, r2: np.ndarray) -> np.ndarray:
    if kernel == "r":
        return -np.sqrt(r2)
    return 0.5 * r2 * np.log(np.where(r2 == 0.0, 1.0, r2))


def squares(points: np.ndarray, at: np.ndarray, kind: type) -> np.ndarray:
    return sum((points[:, k, None].astype(kind) - at[None, :, k].astype(kind)) ** 2 for k in range(3))


def exact(kernel: str, at: np.ndarray, moved: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Displacements of the points by the interpolant in extended precision."""
    m, long = len(at), np.longdouble
    at, points = at / 100.0, points / 100.0  # the interpolant does not know the unit; the system is better off

    def rows(where: np.ndarray, kind: type) -> np.ndarray:
        return np.hstack([kernel_of(kernel, squares(where, at, kind)), np.ones((len(where), 1)), where.astype(kind)])

    upper = rows(at, np.float64)
    factor = lu_factor(np.vstack([upper, np.hstack([upper[:, m:].T, np.zeros((4, 4))])]), check_finite=False)
    solution, data = np.zeros((m + 4, 3), long), np.vstack([moved, np.zeros((4, 3))]).astype(long)
    tail = np.hstack([np.ones((m, 1)), at]).astype(long).T
    for _ in range(4):
        top = [rows(at[i : i + 250], long) @ solution for i in range(0, m, 250)]
        residual = data - np.vstack([*top, tail @ solution[:m]])
        solution += lu_solve(factor, residual.astype(np.float64))
    return (rows(points, long) @ solution).astype(np.float64)


def by_ferreus(kernel: str, at: np.ndarray, moved: np.ndarray):
    config = ferreus.interpolant_config
    settings = config.InterpolantSettings(
        getattr(config.RBFKernelType, THEIR_NAMES[kernel][1]), drift=config.Drift.Linear
    )
    return ferreus.RBFInterpolator(at, moved, settings)


def by_vtk(kernel: str, at: np.ndarray, moved: np.ndarray, points: np.ndarray) -> np.ndarray:
    transform, source, target, out = (
        vtk.vtkThinPlateSplineTransform(),
        vtk.vtkPoints(),
        vtk.vtkPoints(),
        vtk.vtkPoints(),
    )
    source.SetData(numpy_to_vtk(at, deep=True))
    target.SetData(numpy_to_vtk(at + moved, deep=True))
    transform.SetSourceLandmarks(source)
    transform.SetTargetLandmarks(target)
    (transform.SetBasisToR if kernel == "r" else transform.SetBasisToR2LogR)()
    given = vtk.vtkPoints()
    given.SetData(numpy_to_vtk(points, deep=True))
    out.SetDataTypeToDouble()
    transform.TransformPoints(given, out)
    return vtk_to_numpy(out.GetData()) - points


@pytest.mark.parametrize("kernel", ["r", "r2logr"])
@pytest.mark.parametrize("m", [500, 5000])
def test_values_and_jacobians_against_peers(m: int, kernel: str) -> None:
    at, moved, points = landmarks(m)
    backend = RadialBackend(kernel)
    backend.fit(at[:20], moved[:20]).displacement_and_gradient(points[:10])
    backend.fit(at[:20], moved[:20]).displacement(points[:10])
    repeats = 3 if m == 500 else 1

    def scipy() -> np.ndarray:
        return RBFInterpolator(at, moved, kernel=THEIR_NAMES[kernel][0], degree=1)(points)

    runs = {
        "ours": (lambda: backend.fit(at, moved).displacement(points), 3),
        "ours with Jacobians": (lambda: backend.fit(at, moved).displacement_and_gradient(points)[0], 3),
        "SciPy": (scipy, repeats),
        "ferreus-rbf": (lambda: by_ferreus(kernel, at, moved).evaluate(points), repeats),
        "ferreus-rbf with Jacobians": (
            lambda: by_ferreus(kernel, at, moved).evaluate_with_gradients(points)[0],
            repeats,
        ),
    }
    if m == 500:
        runs["VTK"] = (lambda: by_vtk(kernel, at, moved, points), 1)
    values, seconds = {}, {}
    for name, (run, times) in runs.items():
        values[name], seconds[name] = cpu(run, times)
    expected = exact(kernel, at, moved, points[:N_CHECKED])
    print(f"\nphi = {kernel}, m = {m}, {N_POINTS} points: CPU s, over ours, over ours with Jacobians, relative error")
    errors = {}
    for name, found in values.items():
        errors[name] = np.abs(found[:N_CHECKED] - expected).max() / np.abs(expected).max()
        over, over_jacobians = (seconds[name] / seconds[key] for key in ("ours", "ours with Jacobians"))
        print(f"{name:27} {seconds[name]:8.3f} {over:8.2f} {over_jacobians:8.2f} {errors[name]:10.1e}")
    assert errors["ours"] < 1e-9
    assert errors["ours with Jacobians"] < 1e-9


@pytest.mark.parametrize("m", [500, 5000])
def test_isochoric_sums_against_scalar_ones(m: int) -> None:
    """The same centres and weights summed by the isochoric kernel and by the scalar one."""
    at, moved, points = landmarks(m)
    scalar = replace(RadialBackend("r").fit(at[:20], moved[:20]), centres=at, weights=moved)
    isochoric = replace(scalar, kernel="isochoric-r3")
    print(f"\nm = {m}, {N_POINTS} points, no fit: CPU s scalar, isochoric, ratio")
    for name in ("displacement", "displacement_and_gradient"):
        fields = (scalar, isochoric)
        for field in fields:
            getattr(field, name)(points[:10])
        few, many = (cpu(lambda f=field, n=name: getattr(f, n)(points), 3)[1] for field in fields)
        print(f"{name:27} {few:8.3f} {many:8.3f} {many / few:8.2f}")
