"""Bones kept rigid or similar under a cage: put by the motion that fits the map best, the field brought into line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_rigs import egg

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import RigError
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.kept import kept_bones
from musclefit.geometry.distances import nearest_places
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.similar import Similarity
from musclefit.geometry.winding import winding_numbers
from musclefit.io.outputs import ply_bytes
from musclefit.io.rigs import read_rig
from musclefit.pipeline.retarget import Retargeting, retarget
from musclefit.rig.model import BoneLimit, BoneSettings

RIG = """
title = "two bones and a muscle in a skin that swells and bends"
[anatomy]
files = ["skin.ply", "bone_long.ply", "bone_round.ply", "muscle.ply"]
[drive]
kind = "cage"
source = "cage.ply"
target = "target.ply"
[deformer]
kernel = "r3"
step = "cayley"
[bones]
kept_lattices_mm = [24, 12, 6, 3]
keep_rigid = ["bone_long"]
keep_similar = ["bone_*"]
[certificate]
max_boxes = 60000
[tets]
enabled = false
"""


def swollen(points: np.ndarray) -> np.ndarray:
    """Wider in the middle and bent along z: no similarity."""
    x, y, z = points.T
    swell = 1.0 + 0.25 * np.cos(z / 40.0)
    return np.column_stack([x * swell + 0.002 * z**2, y * swell, 1.1 * z])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("kept")
    cage = egg((0.0, 0.0, 0.0), (44.0, 44.0, 88.0), subdivisions=2)
    tissues = {
        "skin": egg((0.0, 0.0, 0.0), (40.0, 40.0, 80.0), subdivisions=3),
        "bone_long": egg((0.0, 0.0, -25.0), (6.0, 6.0, 30.0), subdivisions=3),
        "bone_round": egg((0.0, 0.0, 40.0), (10.0, 9.0, 12.0), subdivisions=3),
        "muscle": egg((16.0, 0.0, -20.0), (7.0, 7.0, 25.0), subdivisions=3),
        "cage": cage,
        "target": TriMesh(swollen(cage.vertices), cage.faces),
    }
    for name, mesh in tissues.items():
        (made / f"{name}.ply").write_bytes(ply_bytes(mesh))
    (made / "kept.toml").write_text(RIG, encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def run(folder: Path) -> Retargeting:
    return retarget(read_rig(folder / "kept.toml"), tets=None)


def test_kept_bones_keep_their_shape_and_the_field_agrees(run: Retargeting) -> None:
    side = run.result.side
    assert side.status == "converged"
    assert side.landmarks.max_error_mm <= 1e-6
    assert side.map.claim.value == "certified"
    long, round_ = (run.result.rest[name].surface.vertices for name in ("bone_long", "bone_round"))
    moved = {name: run.result.deformed[name].surface.vertices for name in ("bone_long", "bone_round")}
    for rest, name, scale in ((long, "bone_long", 1.0), (round_, "bone_round", None)):
        fitted = Similarity.fitted(rest, moved[name])
        np.testing.assert_allclose(fitted(rest), moved[name], rtol=0, atol=1e-9)
        assert scale is None or fitted.scale == pytest.approx(scale, abs=1e-12)
        assert scale is not None or fitted.scale > 1.05
        off = np.linalg.norm(run.result.deformation(rest) - moved[name], axis=1)
        assert off.max() < 0.1
    assert side.bones is not None
    assert side.bones.residual_max_mm < 0.1
    rigidity = {t.name: (t.rigidity_mm, t.rigidity_reference) for t in side.tissues if t.kind == "bone"}
    assert rigidity["bone_long"] == (pytest.approx(0.0, abs=1e-9), "prescribed")


def test_what_each_bone_was_kept_from_is_said(run: Retargeting) -> None:
    said = {f.subject: f.message for f in run.findings if f.code == "kept-bone"}
    assert said["bone_long"].startswith("bone_long: kept rigid; the map would have bent it by up to ")
    assert "kept similar" in said["bone_round"]
    assert "its size changes by +" in said["bone_round"]


def test_an_attachment_stays_on_its_bone(run: Retargeting) -> None:
    bone = run.result.rest["bone_long"].surface.vertices
    motion = Similarity.fitted(bone, run.result.deformed["bone_long"].surface.vertices)
    beside = bone[::7] * (1.0 + 1e-3, 1.0 + 1e-3, 1.0)
    np.testing.assert_allclose(run.result.deformation(beside), motion(beside), rtol=0, atol=0.1)


def test_what_is_deep_in_another_bone_is_not_held() -> None:
    low, high = egg((0.0, 0.0, 0.0), (20.0, 20.0, 40.0)), egg((0.0, 0.0, 50.0), (20.0, 20.0, 40.0))
    bones = Anatomy(tuple(Tissue(n, TissueKind.BONE, m) for n, m in (("low", low), ("high", high))), "mm")
    still, limits = Deformation((), (), Status.CONVERGED), dict.fromkeys(("low", "high"), BoneLimit.RIGID)
    for bone, other in zip(kept_bones(bones, still, limits=limits, contact_zone_mm=1.0), (high, low), strict=True):
        within = winding_numbers(other, bone.surface) > 0.5
        assert nearest_places(bone.surface[within], other).distances.max() > 5.0
        assert within[bone.contact].sum() == within.sum() > 100
        assert not bone.contact.all()


def test_slips_are_named(folder: Path) -> None:
    job = read_rig(folder / "kept.toml", overrides=['bones.keep_rigid=["bone_lung"]'])
    with pytest.raises(RigError, match=r"bones.keep_rigid: 'bone_lung' fits no bone; did you mean 'bone_long'"):
        retarget(job, tets=None)
    with pytest.raises(RigError, match=r"have no effect beside bones.rigid"):
        BoneSettings(rigid=True, keep_rigid=("a",))


@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_similarity_is_found_again(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(7, 3)) * 50.0
    motion = Similarity(scale, Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 100.0)
    found = Similarity.fitted(points, motion(points))
    np.testing.assert_allclose(found(points), motion(points), rtol=0, atol=1e-8)
    assert found.scale == pytest.approx(scale, rel=1e-9)
