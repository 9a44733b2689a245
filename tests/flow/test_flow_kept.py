"""Bones kept rigid or similar under a cage: put by the motion that fits the map best, the field brought into line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from attacks import attack_boxes
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_rigs import egg

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import RigError
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.kept_bones import KeptBone, KeptWay, kept_bones
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.similarity import Similarity
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.io.rigs import read_rig
from musclefit.io.run_folder import ply_bytes
from musclefit.pipeline.deformers import locked_march_of
from musclefit.pipeline.retarget import Retargeting, retarget
from musclefit.progress import Silent
from musclefit.rig.settings import BoneSettings
from musclefit.vocabulary import BoneLimit

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
    zones = np.full((2, 2), 1.0)
    for bone, other in zip(kept_bones(bones, still, limits=limits, zones_mm=zones), (high, low), strict=True):
        within = winding_numbers(other, bone.surface) > 0.5
        assert nearest_places(bone.surface[within], other).distances.max() > 5.0
        assert within[bone.contact].sum() == within.sum() > 100
        assert not bone.contact.all()


@pytest.fixture(scope="module")
def locked(folder: Path) -> Retargeting:
    return retarget(read_rig(folder / "kept.toml", overrides=["bones.lock=true"]), tets=None)


def exposed(run: Retargeting, name: str, other: str, *, spacing_mm: float) -> np.ndarray:
    """Places of a bone's surface at rest that stay outside the contact zone with another on the whole way."""
    assert run.result.side.bones is not None
    zone, steps = run.result.side.bones.contact_zone_mm, run.result.deformation.stretches
    bones = {bone.name: bone for bone in kept_of(run)}
    places = surface_samples(run.job.anatomy[name].surface, spacing_mm=spacing_mm).points
    free = np.ones(len(places), dtype=bool)
    for t in np.linspace(0.0, 1.0, 4 * steps + 1):
        there = bones[other].way.at(float(t)).undone(bones[name].way.at(float(t))(places))
        free &= nearest_places(there, run.job.anatomy[other].surface).distances > zone
    return places[free]


def kept_of(run: Retargeting) -> tuple[KeptBone, ...]:
    return locked_march_of(run.job, run.job.anatomy.vertices(), progress=Silent())[1]


@pytest.mark.parametrize(("name", "other"), [("bone_long", "bone_round"), ("bone_round", "bone_long")])
def test_locked_bones_agree_with_the_field_on_their_whole_surface(
    locked: Retargeting, run: Retargeting, name: str, other: str
) -> None:
    places = exposed(locked, name, other, spacing_mm=0.25)
    assert len(places) > 10_000
    (motion,) = (bone.motion for bone in kept_of(locked) if bone.name == name)
    assert (motion.scale == 1.0) == (name == "bone_long")
    off = np.linalg.norm(locked.result.deformation(places) - motion(places), axis=1)
    assert off.max() < 1e-9
    # without the lock the same places miss it
    assert np.linalg.norm(run.result.deformation(places) - motion(places), axis=1).max() > 1e-3


def test_a_run_with_locked_kept_bones_is_proved(locked: Retargeting) -> None:
    side = locked.result.side
    assert (side.status, side.map.claim.value) == ("converged", "certified")
    assert side.map.margin > 0.0
    assert side.landmarks.max_error_mm <= 1e-6
    assert side.bones is not None
    assert side.bones.residual_max_mm < 1e-9
    assert {"bones.contact_zone_mm"} == {f.subject for f in locked.findings if f.code == "chosen-setting"}


def test_maps_with_locked_kept_bones_are_undone_and_have_their_derivatives(locked: Retargeting) -> None:
    deformation = locked.result.deformation
    rng = np.random.default_rng(5)
    on = np.concatenate([locked.result.rest[name].surface.vertices for name in ("bone_long", "bone_round", "muscle")])
    points = on[rng.integers(len(on), size=1500)] + rng.normal(0.0, 2.0, (1500, 3))
    moved, jacobians = deformation.with_jacobian(points)
    np.testing.assert_allclose(deformation.inverse()(moved), points, rtol=0, atol=1e-8)
    h = 1e-5
    for axis in range(3):
        step = h * np.eye(3)[axis]
        slope = (deformation(points + step) - deformation(points - step)) / (2.0 * h)
        np.testing.assert_allclose(jacobians[:, :, axis], slope, rtol=0, atol=5e-4)


@pytest.mark.parametrize("half", [0.05, 0.5, 3.0])
def test_bounds_of_locked_similarities_hold_at_every_place_tried(locked: Retargeting, half: float) -> None:
    rng = np.random.default_rng(int(100 * half))
    for step in locked.result.deformation.steps:
        field = step.field
        centres = np.concatenate([locked.result.rest[n].surface.vertices for n in ("bone_long", "bone_round")])
        centres = centres[rng.integers(len(centres), size=150)] + rng.normal(0.0, 1.5, (150, 3))
        halves = half * rng.uniform(0.3, 1.0, (150, 3))
        assert np.isfinite(field.gradient_bounds(centres, halves)[1]).all()
        attack_boxes(field, centres, halves, rng, enough=(-0.1, 0.1), tries=40)


def test_slips_are_named(folder: Path) -> None:
    job = read_rig(folder / "kept.toml", overrides=['bones.keep_rigid=["bone_lung"]'])
    with pytest.raises(RigError, match=r"bones.keep_rigid: 'bone_lung' fits no bone; did you mean 'bone_long'"):
        retarget(job, tets=None)
    with pytest.raises(RigError, match=r"have no effect beside bones.rigid"):
        BoneSettings(rigid=True, keep_rigid=("a",))


def test_a_bone_with_a_handle_on_it_is_held_but_not_locked_and_named(folder: Path) -> None:
    bone = egg((0.0, 0.0, -25.0), (6.0, 6.0, 30.0), subdivisions=3).vertices[::40]
    skin = egg((0.0, 0.0, 0.0), (40.0, 40.0, 80.0), subdivisions=1).vertices
    handles = np.concatenate([skin, bone])
    for file, places in (("on.csv", handles), ("to.csv", swollen(handles))):
        rows = [f"h{k},{x:.17g},{y:.17g},{z:.17g}" for k, (x, y, z) in enumerate(places)]
        (folder / file).write_text("\n".join(["name,x,y,z", *rows]), encoding="utf-8")
    table = RIG.replace('kind = "cage"', 'kind = "landmarks"\nunits = "mm"')
    table = table.replace('"cage.ply"', '"on.csv"').replace('"target.ply"', '"to.csv"')
    (folder / "landmarks.toml").write_text(table, encoding="utf-8")
    job = read_rig(folder / "landmarks.toml", overrides=["bones.lock=true", "certificate.enabled=false"])
    run = retarget(job, tets=None)
    assert run.result.side.status == "converged"
    assert run.result.side.landmarks.max_error_mm <= 1e-6
    (said,) = (f for f in run.findings if f.code == "bone-not-locked")
    assert said.subject == "bone_long"
    assert "because a handle is 0 mm from it and must arrive" in said.message
    round_ = next(
        bone for bone in locked_march_of(job, job.anatomy.vertices(), progress=Silent())[1] if "round" in bone.name
    )
    off = np.linalg.norm(run.result.deformation(round_.exposed) - round_.motion(round_.exposed), axis=1)
    assert off.max() < 1e-9


def test_the_way_of_a_bone_meets_what_is_known_and_goes_evenly_between() -> None:
    grown = Similarity(2.0, Rotation.from_rotvec([0.0, 0.0, 0.8]).as_matrix(), np.array([3.0, -1.0, 5.0]))
    way = KeptWay(np.array([10.0, 0.0, 2.0]), (0.0, 0.5, 1.0), (Similarity.identity(), grown, grown))
    places = np.random.default_rng(0).normal(0.0, 20.0, (50, 3))
    np.testing.assert_array_equal(way.at(0.0)(places), places)
    np.testing.assert_array_equal(way.at(0.5)(places), grown(places))
    np.testing.assert_allclose(way.at(0.7)(places), grown(places), rtol=0, atol=1e-12)
    half = way.at(0.25)
    assert half.scale == pytest.approx(2.0**0.5)
    np.testing.assert_allclose(Rotation.from_matrix(half.rotation).as_rotvec(), [0.0, 0.0, 0.4], atol=1e-12)
    centre = way.centre[None]
    np.testing.assert_allclose(half(centre), 0.5 * (centre + grown(centre)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(half.undone(half(places)), places, rtol=0, atol=1e-12)


@pytest.mark.parametrize("other", ['deformer.step="explicit"', 'deformer.tested_at="landmarks"'])
def test_locks_of_kept_bones_need_a_march_that_can_hold_them(folder: Path, other: str) -> None:
    with pytest.raises(RigError, match=r"bones\.lock: found step .*; kept bones are locked by step \"cayley\""):
        read_rig(folder / "kept.toml", overrides=["bones.lock=true", other])


@given(st.integers(0, 10_000), st.floats(0.2, 5.0))
def test_a_similarity_is_found_again(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(7, 3)) * 50.0
    motion = Similarity(scale, Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 100.0)
    found = Similarity.fitted(points, motion(points))
    np.testing.assert_allclose(found(points), motion(points), rtol=0, atol=1e-8)
    assert found.scale == pytest.approx(scale, rel=1e-9)
