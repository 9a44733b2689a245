"""There and back on a real forearm: 200,000 points through a map of several steps and through its inverse."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.progress import Silent

POINTS = 200_000

METHODS = {
    "RBF r^2 log r, Cayley": ("deformer.kernel=r2logr", "deformer.step=cayley", "deformer.path=joints"),
    "RBF isochoric r^3, Cayley": ("deformer.kernel=isochoric-r3", "deformer.step=cayley", "deformer.path=joints"),
    "FFD 20 mm, Cayley": ("deformer.backend=ffd", "deformer.step=cayley", "deformer.path=joints"),
    "RBF r^2 log r, explicit": ("deformer.kernel=r2logr",),
}


@pytest.mark.slow
@pytest.mark.anatomy
@pytest.mark.parametrize("method", METHODS)
def test_two_hundred_thousand_points_come_back(anatomy_data, monkeypatch, capsys, method):
    """The forearm's own vertices, elbow 75 and forearm 70 degrees in at least 4 steps; both ways round."""
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    job = read_rig(find_rig("forearm"), overrides=("deformer.min_steps=4", *METHODS[method]))
    points = job.anatomy.vertices()
    assert len(points) >= POINTS
    points = points[:POINTS]
    deformation = deform(job, points, progress=Silent()).deformation.require()
    assert len(deformation.steps) >= 4
    inverse = deformation.inverse()
    there_and_back = np.abs(inverse(deformation(points)) - points).max()
    back_and_there = np.abs(deformation(inverse(deformation(points))) - deformation(points)).max()
    with capsys.disabled():
        print(
            f"\n{method}: {len(deformation.steps)} steps, {len(points)} points come back to within "
            f"{there_and_back:.1e} mm, their images to within {back_and_there:.1e} mm"
        )
    assert there_and_back <= 1e-9
    assert back_and_there <= 1e-9
