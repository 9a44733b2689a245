"""Distances of samples that are measured only where they can count: those of every sample."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree, SampledDistances

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("count", [1, 50, 3000])
@pytest.mark.parametrize("reach", [0.5, 6.0, 100.0])
def test_nothing_that_counts_is_missed(count: int, reach: float) -> None:
    ball = trimesh.creation.icosphere(2, radius=10.0)
    tree = DistanceTree(TriMesh(np.array(ball.vertices), np.array(ball.faces)))
    points = np.array([25.0, 0.0, 0.0]) + RNG.normal(size=(count, 3)) * [6.0, 15.0, 15.0]
    every, sampled = tree(points), SampledDistances(points)
    found = sampled.distances(tree, up_to_mm=reach)
    np.testing.assert_array_equal(found, np.where(every <= reach, every, np.inf))
    assert (sampled.at_least(tree) <= every + 1e-9).all()
    assert sampled.smallest(tree, up_to_mm=np.inf) == every.min()
    assert sampled.smallest(tree, up_to_mm=reach) == min(every.min(), reach)
