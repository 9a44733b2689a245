"""Methods by name: what they stand for, which one is the default, what excludes what, and what `--set` does to them."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest

from musclefit.errors import RigError
from musclefit.io.drives import JointDrive
from musclefit.rig.methods import IDLE, STANDS_FOR
from musclefit.rig.rig_table import apply_overrides, known_keys, parse_rig
from musclefit.rig.settings import METHOD_SETTINGS, AnatomySource, BoneSettings, DeformerSettings, Rig, SurfaceSettings
from musclefit.vocabulary import BackendKind, Method, PathKind, StepKind, StepRule, TestedAt

RIGS = Path(__file__).resolve().parents[2] / "rigs"

TEN_LINES = """
title = "Knee, bent"
[anatomy]
folder = "knee"
[drive]
kind = "joints"
joints = "joints.json"
pose = { knee_deg = 60 }
"""

DRIVES: dict[str, dict[str, Any]] = {
    "joints": {"kind": "joints", "joints": "j.json", "pose": {"knee_deg": 60}},
    "transforms": {"kind": "transforms", "transforms": "t.csv"},
    "landmarks": {"kind": "landmarks", "source": "p.csv"},
    "cage": {"kind": "cage", "source": "a.ply", "target": "b.ply"},
}


def table(drive: str = "joints", **sections: Any) -> dict[str, Any]:
    return {"title": "Knee", "anatomy": {"folder": "knee"}, "drive": dict(DRIVES[drive]), **sections}


def parsed(drive: str = "joints", **sections: Any) -> Rig:
    return parse_rig(table(drive, **sections), source="knee.toml")


def overridden(before: dict[str, Any], *overrides: str) -> Rig:
    return parse_rig(apply_overrides(before, overrides, source="knee.toml"), source="knee.toml")


# --- what a name stands for


def test_ten_lines_are_the_best_method() -> None:
    rig = parse_rig(tomllib.loads(TEN_LINES), source="knee.toml")
    assert rig == Rig(
        title="Knee, bent",
        anatomy=AnatomySource(folder="knee"),
        drive=JointDrive("joints.json", (("knee", 60.0),)),
        deformer=DeformerSettings(
            method=Method.RIGID_BONES,
            kernel="isochoric-r3",
            step=StepKind.CAYLEY,
            path=PathKind.JOINTS,
            degrees_per_step=12.0,
            margin_floor=0.25,
        ),
        bones=BoneSettings(rigid=True, lock=True),
        surfaces=SurfaceSettings(refine=True),
    )


@pytest.mark.parametrize("drive", DRIVES)
def test_the_papers_loop_is_its_loop_whatever_drives(drive: str) -> None:
    rig = parsed(drive, deformer={"method": "yu2014"})
    assert rig.deformer == DeformerSettings(
        method=Method.YU2014,
        backend=BackendKind.RBF,
        kernel="r2logr",
        step=StepKind.EXPLICIT,
        step_rule=StepRule.ROW_NORM,
        tested_at=TestedAt.ALL_POINTS,
        path=PathKind.STRAIGHT,
    )
    assert (rig.bones, rig.surfaces) == (BoneSettings(), SurfaceSettings())


@pytest.mark.parametrize(
    ("drive", "sections", "method", "path"),
    [
        ("joints", {}, "rigid-bones", "joints"),
        ("transforms", {}, "rigid-bones", "chain"),
        ("landmarks", {"bones": {"rigid": True}}, "rigid-bones", "chain"),
        ("landmarks", {"deformer": {"method": "rigid-bones"}}, "rigid-bones", "chain"),
        ("joints", {"bones": {"rigid": True}}, "rigid-bones", "joints"),
        ("joints", {"bones": {"iterations": 9}, "deformer": {"min_steps": 3}}, "rigid-bones", "joints"),
        ("landmarks", {}, "own", "straight"),
        ("cage", {}, "own", "straight"),
        ("joints", {"bones": {"rigid": False}}, "own", "straight"),
        ("joints", {"bones": {"keep_rigid": ["femur"]}}, "own", "straight"),
        ("joints", {"deformer": {"kernel": "r3"}}, "own", "straight"),
        ("joints", {"deformer": {"step": "cayley"}}, "own", "straight"),
        ("joints", {"deformer": {"path": "joints"}}, "own", "joints"),
        ("joints", {"deformer": {"method": "own"}}, "own", "straight"),
        ("transforms", {"deformer": {"method": "own"}}, "own", "chain"),
    ],
)
def test_the_default_follows_from_what_drives_and_what_is_said(
    drive: str, sections: dict[str, Any], method: str, path: str
) -> None:
    rig = parsed(drive, **sections)
    best = method == "rigid-bones"
    assert (rig.deformer.method, rig.deformer.path) == (method, path)
    assert (rig.bones.rigid, rig.surfaces.refine) == (best, best)
    if best:
        assert (rig.deformer.kernel, rig.deformer.step) == ("isochoric-r3", "cayley")


def test_what_a_method_leaves_free_may_be_said_beside_it() -> None:
    loop = parsed(deformer={"method": "yu2014", "kernel": "r", "tested_at": "landmarks"}, surfaces={"refine": True})
    assert (loop.deformer.kernel, loop.deformer.tested_at, loop.surfaces.refine) == ("r", "landmarks", True)
    best = parsed(
        deformer={"method": "rigid-bones", "kernel": "isochoric-r5", "path": "screws"}, surfaces={"refine": False}
    )
    assert (best.deformer.kernel, best.deformer.path, best.surfaces.refine) == ("isochoric-r5", "screws", False)
    assert best.bones.rigid
    splines = parsed(deformer={"backend": "ffd"})
    assert (splines.deformer.method, splines.deformer.backend, splines.bones.rigid) == ("rigid-bones", "ffd", True)
    assert parsed(deformer={"method": "yu2014", "step": "explicit"}).deformer.method == "yu2014"


# --- what excludes what


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"deformer": {"method": "yu2014", "step": "cayley"}}, 'deformer.step = "cayley"'),
        ({"deformer": {"method": "yu2014", "kernel": "isochoric-r3"}}, 'deformer.kernel = "isochoric-r3"'),
        ({"deformer": {"method": "yu2014", "step_rule": "monotone"}}, 'deformer.step_rule = "monotone"'),
        ({"deformer": {"method": "yu2014", "path": "joints"}}, 'deformer.path = "joints"'),
        ({"deformer": {"method": "yu2014", "backend": "ffd"}}, 'deformer.backend = "ffd"'),
        ({"deformer": {"method": "yu2014"}, "bones": {"rigid": True}}, "bones.rigid = true"),
        ({"deformer": {"method": "yu2014"}, "bones": {"keep_rigid": ["a"]}}, r'bones.keep_rigid = \["a"\]'),
        ({"deformer": {"method": "rigid-bones", "step": "explicit"}}, 'deformer.step = "explicit"'),
        ({"deformer": {"method": "rigid-bones", "path": "straight"}}, 'deformer.path = "straight"'),
        ({"deformer": {"method": "rigid-bones", "smoothing": 0.5}}, "deformer.smoothing = 0.5"),
        ({"deformer": {"method": "rigid-bones"}, "bones": {"rigid": False}}, "bones.rigid = false"),
        ({"deformer": {"tested_at": "landmarks"}}, 'deformer.tested_at = "landmarks"'),
    ],
)
def test_a_method_and_a_key_that_it_excludes_are_an_error_that_names_both(sections: dict[str, Any], named: str) -> None:
    method = sections["deformer"].get("method", "rigid-bones")
    with pytest.raises(
        RigError, match=rf'^knee.toml: deformer.method: "{method}" and {named} exclude each other'
    ) as told:
        parsed(**sections)
    assert ("the default" in str(told.value)) == ("method" not in sections["deformer"])


def test_a_rule_of_explicit_steps_is_refused_with_the_method_that_has_none() -> None:
    with pytest.raises(RigError, match=r'deformer.step_rule: has no effect on "cayley" steps \(of .*"rigid-bones"\)'):
        parsed(deformer={"step_rule": "gershgorin"})


@pytest.mark.parametrize("key", ["lattice_spacing_mm", "lattice_levels"])
def test_lattices_of_handles_are_refused_where_rigid_bones_have_their_own(key: str) -> None:
    with pytest.raises(
        RigError, match=rf"^knee.toml: deformer.{key}: has no effect on rigid bones, whose lattices are"
    ):
        parsed(deformer={"backend": "ffd", key: 8})
    free = parsed(deformer={"method": "own", "backend": "ffd", key: 8}, bones={"rigid": False})
    assert getattr(free.deformer, key) == 8


def test_a_method_that_is_set_drops_lattices_of_handles() -> None:
    own = table(deformer={"method": "own", "backend": "ffd", "lattice_spacing_mm": 8.0, "lattice_levels": 3})
    best = overridden(own, "deformer.method=rigid-bones")
    assert (best.deformer.backend, best.deformer.lattice_spacing_mm, best.bones.rigid) == ("rbf", 20.0, True)
    splines = overridden(own, "deformer.method=rigid-bones", "deformer.backend=ffd")
    assert (splines.deformer.backend, splines.deformer.lattice_spacing_mm) == ("ffd", 20.0)


def test_a_method_without_bones_to_move_is_refused() -> None:
    with pytest.raises(RigError, match=r"bones.rigid: nothing says how bones move rigidly"):
        parsed("cage", deformer={"method": "rigid-bones"})


def test_an_unknown_method_is_named() -> None:
    with pytest.raises(RigError, match=r"deformer.method: found 'yu'; .*known: own, rigid-bones, yu2014"):
        parsed(deformer={"method": "yu"})


def test_records_made_in_python_are_held_to_their_method() -> None:
    rig = parsed()
    with pytest.raises(RigError, match=r'^deformer.method: "rigid-bones" and deformer.step = "explicit"'):
        Rig(rig.title, rig.anatomy, rig.drive, DeformerSettings(method=Method.RIGID_BONES))


# --- overrides


@pytest.mark.parametrize(
    ("before", "overrides", "expected"),
    [
        ({}, ["deformer.kernel=isochoric-r5"], ("rigid-bones", "isochoric-r5", "cayley", "joints", True)),
        ({}, ["bones.rigid=false"], ("own", "isochoric-r3", "cayley", "joints", False)),
        ({}, ["deformer.path=screws"], ("rigid-bones", "isochoric-r3", "cayley", "screws", True)),
        ({}, ["deformer.method=yu2014"], ("yu2014", "r2logr", "explicit", "straight", False)),
        ({}, ["deformer.method=own"], ("own", "isochoric-r3", "cayley", "joints", True)),
        (
            {"deformer": {"method": "yu2014"}},
            ["deformer.kernel=isochoric-r3", "deformer.step=cayley"],
            ("own", "isochoric-r3", "cayley", "straight", False),
        ),
        (
            {"deformer": {"method": "yu2014", "kernel": "r"}},
            ["deformer.method=rigid-bones"],
            ("rigid-bones", "isochoric-r3", "cayley", "joints", True),
        ),
        (
            {
                "deformer": {
                    "kernel": "isochoric-r5",
                    "step": "cayley",
                    "path": "joints",
                    "margin_floor": 0.1,
                    "min_steps": 5,
                },
                "bones": {"rigid": True, "iterations": 7},
            },
            ["deformer.method=yu2014", "deformer.kernel=r3"],
            ("yu2014", "r3", "explicit", "straight", False),
        ),
        (
            {"deformer": {"step_rule": "monotone", "kernel": "r"}},
            ["deformer.method=rigid-bones"],
            ("rigid-bones", "isochoric-r3", "cayley", "joints", True),
        ),
        ({"deformer": {"kernel": "r3"}}, ["deformer.path=joints"], ("own", "r3", "explicit", "joints", False)),
    ],
)
def test_what_is_set_wins_over_the_file(
    before: dict[str, Any], overrides: list[str], expected: tuple[str, str, str, str, bool]
) -> None:
    given = table(**copy.deepcopy(before))
    rig = overridden(given, *overrides)
    made = rig.deformer
    assert (made.method, made.kernel, made.step, made.path, rig.bones.rigid) == expected
    assert given == table(**before)


def test_another_backend_keeps_the_method_where_it_can() -> None:
    best = overridden(table(), "deformer.backend=ffd")
    assert (best.deformer.method, best.deformer.backend, best.bones.rigid) == ("rigid-bones", "ffd", True)
    loop = overridden(table(deformer={"method": "yu2014", "kernel": "r"}), "deformer.backend=ffd")
    assert (loop.deformer.method, loop.deformer.backend, loop.deformer.step) == ("own", "ffd", "explicit")
    own = overridden(table(deformer={"kernel": "r"}), "deformer.backend=ffd")
    assert (own.deformer.method, own.deformer.step, own.bones.rigid) == ("own", "explicit", False)


def test_a_value_that_is_no_setting_is_told_as_such() -> None:
    with pytest.raises(RigError, match=r"deformer.kernel: found 'r4'"):
        overridden(table(deformer={"method": "yu2014"}), "deformer.kernel=r4")


# --- the tables themselves


def test_methods_speak_of_keys_that_exist_and_agree_with_themselves() -> None:
    assert set(METHOD_SETTINGS) == set(STANDS_FOR) == set(IDLE) == set(Method)
    for method in Method:
        keys = {*METHOD_SETTINGS[method], *STANDS_FOR[method], *IDLE[method]}
        assert keys <= set(known_keys())
        for key, value in STANDS_FOR[method].items():
            assert value in METHOD_SETTINGS[method].get(key, (value,))


@pytest.mark.parametrize(
    ("rig", "method"),
    [
        ("upper_limb", "rigid-bones"),
        ("forearm", "yu2014"),
        ("forearm_rigid", "rigid-bones"),
        ("forearm_motion", "rigid-bones"),
        ("leg_jump", "rigid-bones"),
    ],
)
def test_rigs_that_come_along_say_how_they_deform(rig: str, method: str) -> None:
    written = tomllib.loads((RIGS / f"{rig}.toml").read_text(encoding="utf-8"))
    assert parse_rig(written, source=rig).deformer.method == method


def test_the_ten_lines_of_the_readme_are_read_as_they_stand() -> None:
    assert f"```toml{TEN_LINES}```" in (RIGS / "README.md").read_text(encoding="utf-8")


# --- limits by purpose


@pytest.mark.parametrize(
    ("drive", "sections", "purpose", "because"),
    [
        ("joints", {}, "posing", "bones are rigid"),
        ("joints", {"deformer": {"method": "yu2014"}}, "posing", "joints move the bones"),
        ("transforms", {"deformer": {"method": "yu2014"}}, "posing", "transforms move the bones"),
        ("landmarks", {}, "another-body", "landmarks drive by a field that may change volume"),
        ("landmarks", {"deformer": {"backend": "ffd"}}, "another-body", "landmarks drive by a field that may change"),
        ("landmarks", {"deformer": {"path": "screws"}}, "posing", "bones go on screws"),
        ("landmarks", {"bones": {"rigid": True}}, "posing", "bones are rigid"),
        (
            "landmarks",
            {"deformer": {"kernel": "isochoric-r3", "step": "cayley"}},
            "posing",
            "landmarks drive by a kernel that keeps volume",
        ),
        ("cage", {}, "another-body", "a cage drives by a field that may change volume"),
        ("cage", {"limits": {"purpose": "posing"}}, "posing", "the rig says so"),
        ("joints", {"limits": {"purpose": "another-body"}}, "another-body", "the rig says so"),
    ],
)
def test_limits_are_for_a_purpose_that_follows_from_the_drive(
    drive: str, sections: dict[str, Any], purpose: str, because: str
) -> None:
    rig = parsed(drive, **sections)
    assert rig.limits.purpose == purpose
    assert rig.purpose_because.startswith(because)
    free = purpose == "another-body"
    assert (rig.limits.bone_rigidity_mm, rig.limits.muscle_volume_percent) == ((None, None) if free else (0.01, 1.0))
    assert rig.limits.held_rigidity_mm == 0.01
    assert rig.limits.introduced_overlap_mm3 == 1.0


def test_numbers_in_the_rig_win_over_its_purpose() -> None:
    rig = parsed("cage", limits={"bone_rigidity_mm": 5})
    assert (rig.limits.bone_rigidity_mm, rig.limits.muscle_volume_percent) == (5.0, None)
    assert rig.limits.held_rigidity_mm == 5.0
    both = overridden(table("cage"), "limits.muscle_volume_percent=50", "limits.purpose=another-body")
    assert (both.limits.bone_rigidity_mm, both.limits.muscle_volume_percent) == (None, 50.0)
