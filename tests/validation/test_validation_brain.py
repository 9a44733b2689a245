"""Figures 5 and 6 of Yu et al. 2014: what one shot folds stays whole, and two brains are carried into each other."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name: str):
    """An example as a module."""
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of nilearn and what it imports
def test_a_gyrus_folds_in_one_shot_and_not_in_the_loop(tmp_path):
    pytest.importorskip("nilearn", reason="nilearn is not installed (extra examples)")
    fig5 = example("fig5_gyrus")
    rows, loop = fig5.compare(fig5.gyrus())
    shot, iterative = rows[0], rows[1:]
    assert shot.folded_voxels > 0
    assert shot.crossing_pairs > 0
    assert shot.certificate == "refuted"
    assert loop.startswith("stalled")
    for row in iterative:
        assert row.status == "converged"
        assert row.folded_voxels == 0
        assert row.crossing_pairs == 0
        assert row.landmark_error_mm < 1e-9
        assert row.certificate == "certified"


@pytest.mark.anatomy
@pytest.mark.parametrize("backend", ["RBF r^2 log r", "FFD 20 mm"])
def test_child_and_adult_are_carried_into_each_other(anatomy_data, backend):
    fig6 = example("fig6_child_adult")
    rows, _, apart = fig6.compare(fig6.read(anatomy_data), fig6.BACKENDS[backend])
    assert len(rows) == 4
    for row in rows:
        assert row.certificate == "certified"
        assert row.landmark_error_mm < 1e-9
        assert row.round_trip_mm < 1e-6
        assert row.determinants[0] > 0.0
        assert row.after_mm < 0.65 * row.before_mm
    assert 0.0 < apart < 1.0


@pytest.mark.anatomy
def test_the_mni_brain_is_warped_by_forty_landmarks_within_four_volumes_of_memory(anatomy_data):
    """Peak of NumPy's own memory, beside the input; every second voxel of the 1 mm grid."""
    import tracemalloc

    from musclefit.geometry.images.grids import Frame, Grid, Interpolation
    from musclefit.pipeline.images import warp_image

    fig6 = example("fig6_child_adult")
    brains = fig6.read(anatomy_data)
    deformation = fig6.marched(brains.adult_landmarks, brains.child_landmarks, brains.adult, fig6.BACKENDS["FFD 20 mm"])
    affine = np.diag([1.5, 1.5, 1.5, 1.0])
    affine[:3, 3] = [-98.0, -134.0, -72.0]
    grid = Grid((131, 155, 126), affine)
    values = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    tracemalloc.start()
    warped = warp_image(
        values,
        grid,
        deformation=deformation,
        frame=Frame.RAS,
        onto=grid,
        interpolation=Interpolation.LINEAR,
        outside=0.0,
    )
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert warped.unsolved == 0
    assert values.nbytes + peak <= 4.0 * values.nbytes + 40e6  # blocks of 65,536 voxels are of one size for any volume
