"""Edge lengths that grow away from places, and surfaces cut to them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.edge_lengths import EdgeLengths
from musclefit.geometry.surfaces.subdivision import FaceEdges, with_short_edges


def test_lengths_grow_with_the_distance_up_to_the_most() -> None:
    lengths = EdgeLengths(2.0, np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]), 0.5, 7.0)
    at = np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [96.0, 0.0, 0.0], [0.0, 0.0, 10.0], [0.0, 0.0, 1e4]])
    np.testing.assert_allclose(lengths.at(at), [2.0, 4.0, 4.0, 7.0, 7.0])
    np.testing.assert_allclose(lengths.scaled(0.5).at(at), [1.0, 2.0, 2.0, 3.5, 3.5])


def test_even_lengths_are_the_same_everywhere() -> None:
    assert (EdgeLengths.even(3.0).at(np.zeros((4, 3))) == 3.0).all()


@pytest.mark.parametrize("growth", [0.2, 1.0])
def test_no_edge_of_a_cut_surface_is_longer_than_allowed_at_its_middle(growth: float) -> None:
    ball = trimesh.creation.icosphere(1, radius=40.0)
    lengths = EdgeLengths(1.5, np.array([[0.0, 0.0, 40.0]]), growth, 12.0)
    cut = with_short_edges(TriMesh(np.array(ball.vertices), np.array(ball.faces)), longest_mm=lengths)
    ends = cut.vertices[FaceEdges.of(cut.faces).ends]
    found = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert (found <= lengths.at(ends.mean(axis=1))).all()
    assert found.max() > 3.0  # and far away they are long
