"""Rigs of very many handles: met exactly, the claim told as it is, what they cannot do refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import TISSUES, write_tiny_rig

import musclefit as mf
from musclefit.errors import RigError
from musclefit.vocabulary import Claim


@pytest.fixture
def rig(tmp_path) -> Path:
    """The tiny rig, driven by every vertex of its surfaces, bent smoothly."""
    path = write_tiny_rig(tmp_path / "rig")
    at = np.concatenate([surface.vertices for surface in TISSUES.values()])
    there = at + np.column_stack([0.0 * at[:, 0], (at[:, 0] / 60.0) ** 2 * 6.0, 0.05 * at[:, 2]])
    rows = [
        f"p{k},{','.join(repr(float(x)) for x in (*a, *b))}" for k, (a, b) in enumerate(zip(at, there, strict=True))
    ]
    text = "name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm\n" + "\n".join(rows) + "\n"
    (path.parent / "landmarks.csv").write_text(text)
    path.write_text(path.read_text().replace("[certificate]\nmax_boxes = 20000\n", ""))
    return path


def test_every_handle_arrives_and_the_claim_is_certified_or_undecided(rig, monkeypatch):
    monkeypatch.setattr("musclefit.fields.fitting.multilevel.BASE", 100)
    done = mf.run(rig, overrides=["deformer.backend=multilevel", "deformer.step=cayley"])
    moved = done.deformation(done.job.handles.source)
    np.testing.assert_allclose(moved, done.job.path.position(1.0), rtol=0, atol=1e-8)
    assert done.report.result.map.claim in (Claim.CERTIFIED, Claim.UNDECIDED)
    assert done.report.result.map.folded_points == 0
    assert "refined by compact levels" in done.report.result.method
    assert done.job.rig.certificate.max_boxes == 150_000


def test_the_papers_loop_goes_by_the_same_levels(rig):
    done = mf.run(rig, overrides=["deformer.backend=multilevel"])
    assert done.passed


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["deformer.kernel=isochoric-r3"], "refines a scalar kernel that reaches everywhere"),
        (["deformer.kernel=wendland-c2", "deformer.kernel_scale_mm=10"], "refines a scalar kernel"),
        (['bones.keep_rigid=["bone_distal"]', "deformer.step=cayley"], "which holds no bones"),
        (["deformer.smoothing=1"], "smoothing"),
    ],
)
def test_what_it_cannot_do_is_refused(rig, overrides, message):
    with pytest.raises(RigError, match=message):
        mf.run(rig, overrides=["deformer.backend=multilevel", *overrides])
