"""A bar twisted by 180 degrees by 162 handles, and libigl's SLIM: pytest -n0 tests/benchmarks/test_bench_bar.py

Both end faces of its 18,432 tets are handles. Ours are Cayley steps along the skeleton's path, in float64 and with
exact handles. SLIM (symmetric Dirichlet energy, handles as penalties of 1e5) starts from rest, as it must start from a
mesh without inverted tets, and is stopped while it still creeps. CPU seconds of this process and their ratio are
printed.
"""

from __future__ import annotations

import itertools
import time

import igl
import numpy as np
import pytest
from scipy.spatial import cKDTree

from musclefit.fields.radial import RadialBackend
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step
from musclefit.geometry.measures import signed_volumes
from musclefit.rig.skeleton import Skeleton, SkeletonPath, SkeletonPose

CUBES = (8, 8, 48)
SLIM_ITERATIONS = 20
PENALTY = 1e5
STEPS = 3


def bar() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and right-handed tets of the bar, 1 mm cubes of six tets."""
    axes = [np.arange(n + 1.0) for n in CUBES]
    vertices = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1) - [4.0, 4.0, 0.0]
    number = np.arange(len(vertices)).reshape([n + 1 for n in CUBES])
    tets = []
    for order in itertools.permutations(np.eye(3, dtype=int)):
        corners = np.cumsum([np.zeros(3, dtype=int), *order], axis=0)
        tets.append([number[tuple(slice(o, o + n) for o, n in zip(c, CUBES, strict=True))].ravel() for c in corners])
    found = np.concatenate([np.transpose(t) for t in tets])
    wrong = signed_volumes(vertices, found) < 0.0
    found[wrong] = found[wrong][:, [0, 1, 3, 2]]
    return vertices, found


def end_faces() -> SkeletonPath:
    """The axis's ends, each with the other 80 vertices of its face; the far one turns by 180 degrees."""
    side = np.arange(-4.0, 5.0)
    grid = np.stack([g.ravel() for g in np.meshgrid(side, side, indexing="ij")], axis=1)
    axis = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 48.0]])
    skeleton = Skeleton(axis, np.array([1.0, 0.0, 0.0]), grid[np.any(grid != 0.0, axis=1)])
    return SkeletonPath(skeleton, (SkeletonPose(1.0, axis, np.array([0.0, 180.0])),))


def slim(vertices: np.ndarray, tets: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    at = cKDTree(vertices).query(source)[1].astype(np.int32)
    rest = np.asfortranarray(vertices)
    energy = igl.MappingEnergyType.SYMMETRIC_DIRICHLET
    cells, ends = np.asfortranarray(tets.astype(np.int32)), np.asfortranarray(target)
    data = igl.slim_precompute(rest, cells, rest, energy, at, ends, PENALTY)
    return igl.slim_solve(data, SLIM_ITERATIONS)


def cpu(function):
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


@pytest.mark.parametrize("kernel", ["r3", "isochoric-r5"])
def test_twisted_bar(kernel, benchmark, capsys):
    vertices, tets = bar()
    path, rest = end_faces(), signed_volumes(vertices, tets)
    source, target = path.position(0.0), path.position(1.0)
    assert (len(tets), len(source)) == (18_432, 162)

    def ours():
        stepper = HandleStepper(path, RadialBackend(kernel), cayley_step)
        deformation = march(stepper, rule=cayley_fractions, tested=vertices, pace=Pace(50, STEPS)).require()
        return deformation(vertices), deformation

    ours()
    (moved, deformation), seconds = cpu(lambda: benchmark.pedantic(ours, rounds=1))
    ratios = signed_volumes(moved, tets) / rest
    error = np.linalg.norm(deformation(source) - target, axis=1).max()
    theirs, peer_seconds = cpu(lambda: slim(vertices, tets, source, target))
    peer_ratios = signed_volumes(theirs, tets) / rest
    at = cKDTree(vertices).query(source)[1]
    missed = np.linalg.norm(theirs[at] - target, axis=1).max()
    with capsys.disabled():
        print(
            f"\n{kernel}: ours {seconds:.2f} CPU s, {len(deformation.steps)} steps, {(ratios <= 0).sum()} inverted, "
            f"volume ratios {ratios.min():.3f} to {ratios.max():.3f}, handles off {error:.1e} mm; SLIM "
            f"{peer_seconds:.1f} CPU s for {SLIM_ITERATIONS} iterations, {(peer_ratios <= 0).sum()} inverted, ratios "
            f"{peer_ratios.min():.2g} to {peer_ratios.max():.3g}, handles off {missed:.3g} mm; "
            f"CPU ratio {seconds / peer_seconds:.3f}"
        )
    assert ratios.min() > 0.0
    assert error <= 1e-9
