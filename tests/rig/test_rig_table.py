"""Rig tables: what is read, and that every slip is named with its file, key and way out."""

from __future__ import annotations

import copy
import math
import subprocess
import sys
import tomllib
from dataclasses import fields
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.anatomy.model import TissueKind
from musclefit.errors import RigError
from musclefit.fields.kernels import KERNELS
from musclefit.io.drives import CageDrive, JointDrive, LandmarkDrive
from musclefit.rig.rig_table import apply_overrides, known_keys, parse_rig
from musclefit.rig.settings import AnatomySource, BoneSettings, DeformerSettings, Limits, Rig, TetSettings
from musclefit.vocabulary import PathKind, Purpose, StepRule, TestedAt, Unit

JOINTS = """
title = "Right forearm"
[anatomy]
folder = "arm"
units = "cm"
frame = "patient (LPS)"
[anatomy.kinds]
"inter*" = "other"
"FMA1*" = "bone"
[drive]
kind = "joints"
joints = "joints.json"
pose = { elbow_deg = 75, forearm_deg = 70.5 }
landmarks_per_bone = 12
[deformer]
kernel = "r3"
step_rule = "monotone"
tested_at = "landmarks"
path = "joints"
max_steps = 20
[tets]
enabled = false
edge_length_fraction = 0.1
[limits]
landmark_mm = 0
muscle_volume_percent = 2.5
"""


def rig_table(**changes: Any) -> dict[str, Any]:
    """The table above with dotted keys (``__`` for the dot) replaced; None removes one."""
    table = tomllib.loads(JOINTS)
    for dotted, value in changes.items():
        *parts, last = dotted.split("__")
        inner = table
        for part in parts:
            inner = inner.setdefault(part, {})
        if value is None:
            inner.pop(last, None)
        else:
            inner[last] = value
    return table


def landmark_table(**drive: Any) -> dict[str, Any]:
    """A rig driven by landmarks."""
    return {"title": "t", "anatomy": {"files": ["a.ply"]}, "drive": {"kind": "landmarks", "source": "p.csv", **drive}}


def test_a_full_table_is_read_key_by_key() -> None:
    rig = parse_rig(rig_table(), source="arm.toml")
    assert rig == Rig(
        title="Right forearm",
        anatomy=AnatomySource(
            folder="arm",
            units=Unit.CENTIMETRE,
            frame="patient (LPS)",
            kinds=(("inter*", TissueKind.OTHER), ("FMA1*", TissueKind.BONE)),
        ),
        drive=JointDrive(joints="joints.json", pose=(("elbow", 75.0), ("forearm", 70.5)), landmarks_per_bone=12),
        deformer=DeformerSettings(
            kernel="r3",
            step_rule=StepRule.MONOTONE,
            tested_at=TestedAt.LANDMARKS,
            path=PathKind.JOINTS,
            max_steps=20,
        ),
        tets=TetSettings(enabled=False, edge_length_fraction=0.1),
        limits=Limits(landmark_mm=0.0, muscle_volume_percent=2.5),
    )
    assert isinstance(rig.limits.landmark_mm, float)


def test_what_is_left_out_has_the_defaults_of_the_records() -> None:
    rig = parse_rig(landmark_table(), source="r.toml")
    assert rig == Rig(
        "t",
        AnatomySource(files=("a.ply",)),
        LandmarkDrive(source="p.csv"),
        limits=Limits(Purpose.ANOTHER_BODY, bone_rigidity_mm=None, muscle_volume_percent=None),
    )


def test_a_cage_is_read() -> None:
    table = landmark_table() | {"drive": {"kind": "cage", "source": "a.ply", "target": "b.ply", "units": "m"}}
    assert parse_rig(table, source="r.toml").drive == CageDrive("a.ply", "b.ply", Unit.METRE)


WRONG = {
    "anatomi": (
        rig_table(anatomi={}),
        r"arm.toml: anatomi: unknown section; did you mean 'anatomy'\? known: anatomy, .*deformer, drive, limits",
    ),
    "titel": (rig_table(titel="x"), "arm.toml: titel: unknown key; did you mean 'title'"),
    "kernal": (
        rig_table(deformer__kernal="r3"),
        "arm.toml: deformer.kernal: unknown key; did you mean 'kernel'.*backend, .*kernel, .*max_steps, .*path",
    ),
    "far from any": (rig_table(limits__qqq=1), "arm.toml: limits.qqq: unknown key; known: bone_rigidity_mm"),
    "drive key": (rig_table(drive__posee=1), r"arm.toml: drive.posee: unknown key; did you mean 'pose'\?"),
    "other kind's key": (
        rig_table(drive__source="x.csv"),
        'arm.toml: drive.source: belongs to kind "(landmarks|cage)", but the kind is "joints"',
    ),
    "no title": (rig_table(title=None), "arm.toml: title: is missing; add it"),
    "blank title": (rig_table(title=" "), "arm.toml: title: is empty"),
    "title is a number": (rig_table(title=3), "arm.toml: title: found the number 3; expected text in quotes"),
    "no drive": (rig_table(drive=None), "arm.toml: drive: is missing"),
    "drive is no table": (rig_table(drive=3), "arm.toml: drive: found the number 3; expected a table"),
    "list of tables": (rig_table(tets=[{}]), r"arm.toml: tets: found the list \[\{\}\]; expected a table"),
    "no kind": (rig_table(drive__kind=None), "arm.toml: drive.kind: is missing"),
    "unknown kind": (
        rig_table(drive__kind="joint"),
        r"arm.toml: drive.kind: found 'joint'; did you mean 'joints'\? known: cage, joints, landmarks",
    ),
    "kind is a list": (
        rig_table(drive__kind=["joints"]),
        'arm.toml: drive.kind: found the list .*expected one of "cage", "joints", "landmarks"',
    ),
    "no joints": (rig_table(drive__joints=None), "arm.toml: drive.joints: is missing"),
    "no pose": (rig_table(drive__pose=None), "arm.toml: drive.pose: is missing"),
    "empty pose": (rig_table(drive__pose={}), "arm.toml: drive.pose: names no joint"),
    "radians": (
        rig_table(drive__pose={"elbow_rad": 1.0}),
        "arm.toml: drive.pose.elbow_rad: must be the name of a joint and its unit, such as elbow_deg",
    ),
    "only the unit": (rig_table(drive__pose={"_deg": 1.0}), "arm.toml: drive.pose._deg: must be the name of a joint"),
    "angle is text": (
        rig_table(drive__pose={"elbow_deg": "75"}),
        "arm.toml: drive.pose.elbow_deg: found the text '75'; expected a number",
    ),
    "angle is infinite": (
        rig_table(drive__pose={"elbow_deg": math.inf}),
        "arm.toml: drive.pose.elbow_deg: found inf; expected a finite number",
    ),
    "angle beyond float": (
        rig_table(drive__pose={"elbow_deg": 10**400}),
        "arm.toml: drive.pose.elbow_deg: found a number of more than 20 digits; expected a finite number",
    ),
    "angle is a boolean": (
        rig_table(drive__pose={"elbow_deg": True}),
        "arm.toml: drive.pose.elbow_deg: found the boolean true; expected a number",
    ),
    "steps are a boolean": (
        rig_table(deformer__max_steps=True),
        "arm.toml: deformer.max_steps: found the boolean true; expected a whole number",
    ),
    "steps are a fraction": (
        rig_table(deformer__max_steps=2.0),
        "arm.toml: deformer.max_steps: found the number 2.0; expected a whole number",
    ),
    "no turn": (
        rig_table(deformer__degrees_per_step=0),
        "arm.toml: deformer.degrees_per_step: found 0.0; expected an angle above 0 and up to 360 deg",
    ),
    "no steps": (rig_table(deformer__max_steps=0), "arm.toml: deformer.max_steps: found 0; expected at least 1"),
    "flag is a number": (
        rig_table(tets__enabled=1),
        "arm.toml: tets.enabled: found the number 1; expected true or false",
    ),
    "fraction 0": (
        rig_table(tets__edge_length_fraction=0),
        "arm.toml: tets.edge_length_fraction: found 0.0; expected a fraction of the bounding-box diagonal between",
    ),
    "fraction 1": (rig_table(tets__envelope_fraction=1.0), "arm.toml: tets.envelope_fraction: found 1.0"),
    "fraction nan": (
        rig_table(tets__envelope_fraction=math.nan),
        "arm.toml: tets.envelope_fraction: found nan; expected a finite number",
    ),
    "negative limit": (
        rig_table(limits__landmark_mm=-1e-9),
        "arm.toml: limits.landmark_mm: found -1e-09; expected a finite limit of at least 0",
    ),
    "negative count": (rig_table(limits__inverted_tets=-1), "arm.toml: limits.inverted_tets: found -1"),
    "count with a point": (
        rig_table(limits__inverted_tets=0.5),
        "arm.toml: limits.inverted_tets: found the number 0.5; expected a whole number",
    ),
    "keyframe without a moment": (
        rig_table(drive__keyframes=[{}]),
        r"arm.toml: drive.keyframes\[0\].at: is missing; add it",
    ),
    "unknown kernel": (
        rig_table(deformer__kernel="r4"),
        "arm.toml: deformer.kernel: found 'r4'; did you mean 'r'\\? known: gaussian, inverse-mu",
    ),
    "unknown backend": (
        rig_table(deformer__backend="spline"),
        "arm.toml: deformer.backend: found 'spline'; known: ffd, lattice, multilevel, rbf",
    ),
    "unknown unit": (
        rig_table(anatomy__units="inch"),
        "arm.toml: anatomy.units: found 'inch'; known: cm, m, mm",
    ),
    "unknown tissue kind": (
        rig_table(anatomy__kinds={"x*": "bones"}),
        r"arm.toml: anatomy.kinds.x\*: found 'bones'; did you mean 'bone'\? known: bone, muscle, other, skin",
    ),
    "two anatomies": (
        rig_table(anatomy__builtin="upper_limb", anatomy__units=None, anatomy__frame=None, anatomy__kinds=None),
        "arm.toml: anatomy: found builtin and folder of builtin, folder and files; give exactly one",
    ),
    "no anatomy": (rig_table(anatomy__folder=None), "arm.toml: anatomy: found none of builtin, folder and files"),
    "empty folder": (rig_table(anatomy__folder=""), "arm.toml: anatomy.folder: is empty; write a value or leave"),
    "no files": (
        rig_table(anatomy__folder=None, anatomy__files=[]),
        "arm.toml: anatomy.files: is an empty list; name at least one",
    ),
    "files is a text": (
        rig_table(anatomy__folder=None, anatomy__files="a.ply"),
        "arm.toml: anatomy.files: found the text 'a.ply'; expected a list of texts",
    ),
    "a file twice": (
        rig_table(anatomy__folder=None, anatomy__files=["a.ply", "a.ply"]),
        "arm.toml: anatomy.files: lists 'a.ply' twice; remove one",
    ),
    "units of a built-in": (
        rig_table(anatomy={"builtin": "upper_limb", "units": "mm"}),
        "arm.toml: anatomy.units: has no effect on a built-in anatomy, which states its own; remove it",
    ),
    "both landmarks": (
        rig_table(drive__landmarks="l.csv"),
        "arm.toml: drive.landmarks_per_bone: has no effect beside drive.landmarks; remove one of the two",
    ),
    "units of nothing": (
        rig_table(drive__units="m"),
        "arm.toml: drive.units: is the unit of drive.landmarks, which is not given",
    ),
    "no landmarks": (
        rig_table(drive__landmarks_per_bone=0),
        "arm.toml: drive.landmarks_per_bone: found 0; expected at least 1",
    ),
    "joints' path": (
        landmark_table() | {"deformer": {"path": "joints"}},
        'arm.toml: deformer.path: found "joints", but no joint drives this rig; write "straight"',
    ),
    "rule of Cayley steps": (
        rig_table(deformer__step="cayley"),
        'arm.toml: deformer.step_rule: has no effect on "cayley" steps, which have a rule of their own; remove it',
    ),
    "prefix of nothing": (
        landmark_table(target="q.csv", target_prefix="adult_"),
        "arm.toml: drive.target_prefix: has no effect beside drive.target; remove one of the two",
    ),
    "half a cage": (
        landmark_table() | {"drive": {"kind": "cage", "source": "a.ply"}},
        "arm.toml: drive.target: is missing",
    ),
}


@pytest.mark.parametrize("slip", WRONG)
def test_every_slip_is_named(slip: str) -> None:
    table, message = WRONG[slip]
    with pytest.raises(RigError, match=f"^{message}"):
        parse_rig(table, source="arm.toml")


def test_records_made_in_python_are_checked_too() -> None:
    with pytest.raises(RigError, match=r"^deformer\.max_steps: found 0; expected at least 1$"):
        DeformerSettings(max_steps=0)
    with pytest.raises(RigError, match=r"^limits\.landmark_mm: found inf"):
        Limits(landmark_mm=math.inf)
    with pytest.raises(RigError, match=r"^drive\.pose\.elbow_deg: found nan"):
        JointDrive("j.json", (("elbow", math.nan),))
    with pytest.raises(RigError, match=r"^anatomy: found none"):
        AnatomySource()


def test_overrides_replace_single_values() -> None:
    table = rig_table()
    before = copy.deepcopy(table)
    changed = apply_overrides(
        table,
        [
            "deformer.kernel=r",
            "drive.pose.elbow_deg = 90",
            "tets.enabled=true",
            'title="a = b"',
            "anatomy.folder=../other arm",
            "anatomy.kinds.bone_v1.2*=bone",
            "limits.muscle_volume_percent=1e-3",
            "deformer.kernel=r2logr",
        ],
        source="arm.toml",
    )
    assert table == before
    rig = parse_rig(changed, source="arm.toml")
    assert rig.deformer.kernel == "r2logr"
    assert isinstance(rig.drive, JointDrive)
    assert rig.drive.pose == (("elbow", 90.0), ("forearm", 70.5))
    assert rig.tets.enabled
    assert rig.title == "a = b"
    assert rig.anatomy.folder == "../other arm"
    assert rig.anatomy.kinds[-1] == ("bone_v1.2*", TissueKind.BONE)
    assert rig.limits.muscle_volume_percent == 1e-3


def test_overrides_may_add_sections_and_whole_lists() -> None:
    table = landmark_table()
    changed = apply_overrides(table, ['anatomy.files=["a.ply", "b.ply"]', "limits.inverted_tets=3"], source="r.toml")
    rig = parse_rig(changed, source="r.toml")
    assert rig.anatomy.files == ("a.ply", "b.ply")
    assert rig.limits.inverted_tets == 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("deformer.kernel", "arm.toml: --set deformer.kernel: has no '='; write --set key=value"),
        ("deformer.kernal=r3", "arm.toml: --set deformer.kernal=r3: unknown key 'deformer.kernal'; did you mean 'defo"),
        ("kernel=r3", "arm.toml: --set kernel=r3: unknown key 'kernel'; "),
        ("=3", "arm.toml: --set =3: unknown key ''"),
        ("deformer=3", "arm.toml: --set deformer=3: deformer is a section; set one of its keys: deformer.method"),
        ("drive.pose.=3", r"arm.toml: --set drive.pose.=3: unknown key 'drive.pose.'; did you mean 'drive.pose'"),
        ("title='open", "arm.toml: --set title='open: the value is not valid TOML: "),
        ("deformer.max_steps=", "arm.toml: --set deformer.max_steps=: the value is not valid TOML"),
        ("anatomy.files=[" + "[" * 50_000, "arm.toml: --set anatomy.files=.*the value is not valid TOML"),
        ("title.x=3", "arm.toml: --set title.x=3: unknown key 'title.x'"),
        ("deformer.max_steps=3\ntets.enabled=false", "arm.toml: --set (.|\n)*the value holds more than one line"),
    ],
)
def test_overrides_that_slip_are_named(override: str, message: str) -> None:
    with pytest.raises(RigError, match=f"^{message}"):
        apply_overrides(rig_table(), [override], source="arm.toml")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("deformer.max_steps=many", "arm.toml: deformer.max_steps: found the text 'many'; expected a whole number"),
        ("tets.enabled=True", "arm.toml: tets.enabled: found the text 'True'; expected true or false"),
        ("drive.pose.elbow=3", "arm.toml: drive.pose.elbow: must be the name of a joint and its unit"),
        ("title=__import__('os').getcwd()", None),
    ],
)
def test_values_of_overrides_are_judged_like_those_of_the_file(override: str, message: str | None) -> None:
    changed = apply_overrides(rig_table(), [override], source="arm.toml")
    if message is None:
        assert parse_rig(changed, source="arm.toml").title == "__import__('os').getcwd()"
        return
    with pytest.raises(RigError, match=f"^{message}"):
        parse_rig(changed, source="arm.toml")


@pytest.mark.parametrize(("path", "words"), [("chain", 'write "joints"'), ("screws", ""), ("joints", "")])
def test_joints_lead_along_themselves_and_not_along_a_chain(path: str, words: str) -> None:
    table = rig_table(deformer__path=path)
    if not words:
        assert parse_rig(table, source="arm.toml").deformer.path.value == path
        return
    with pytest.raises(RigError, match=rf'arm.toml: deformer.path: found "chain", but neither transforms nor.*{words}'):
        parse_rig(table, source="arm.toml")


def test_an_override_inside_what_is_no_table_is_named() -> None:
    with pytest.raises(RigError, match=r"^arm.toml: --set drive.pose.elbow_deg=3: pose is not a table in the file"):
        apply_overrides(rig_table(drive__pose=4), ["drive.pose.elbow_deg=3"], source="arm.toml")


@pytest.mark.parametrize("name", KERNELS)
def test_every_kernel_has_a_rig_key_and_a_length_where_it_needs_one(name: str) -> None:
    given = rig_table(deformer__kernel=name)
    with_length = rig_table(deformer__kernel=name, deformer__kernel_scale_mm=40.0)
    right, wrong = (with_length, given) if KERNELS[name].scaled else (given, with_length)
    assert parse_rig(right, source="arm.toml").deformer.kernel == name
    with pytest.raises(
        RigError, match=r"^arm.toml: deformer.kernel_scale_mm: (is missing; kernel|has no effect: kernel)"
    ):
        parse_rig(wrong, source="arm.toml")


def test_kernels_that_do_not_exist_and_lengths_that_are_none_are_refused() -> None:
    with pytest.raises(RigError, match=r"^arm.toml: deformer.kernel: found 'gausian'; did you mean 'gaussian'"):
        parse_rig(rig_table(deformer__kernel="gausian"), source="arm.toml")
    with pytest.raises(RigError, match=r"^arm.toml: deformer.kernel_scale_mm: found -3.0; expected a finite length"):
        parse_rig(rig_table(deformer__kernel="gaussian", deformer__kernel_scale_mm=-3.0), source="arm.toml")


def test_known_keys_are_the_fields_of_the_records() -> None:
    keys = known_keys()
    assert len(keys) == len(set(keys))
    assert {f"limits.{f.name}" for f in fields(Limits)} < set(keys)
    assert {"title", "drive.kind", "drive.pose", "drive.target", "anatomy.kinds", "deformer.max_steps"} < set(keys)


def test_known_keys_do_not_depend_on_what_was_imported_before() -> None:
    code = "from musclefit.rig.rig_table import known_keys; print(*known_keys())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    drives = (CageDrive, JointDrive, LandmarkDrive)
    assert {f"drive.{field.name}" for drive in drives for field in fields(drive)} < set(said.stdout.split())


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.dates(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(key=st.sampled_from(known_keys()), value=values)
def test_whatever_stands_under_a_key_gives_a_rig_or_a_rig_error_that_names_the_file(key: str, value: Any) -> None:
    table = rig_table(**{key.replace(".", "__"): value})
    message = "arm.toml: "
    try:
        parse_rig(table, source="arm.toml")
    except RigError as error:
        message = str(error)
    assert message.startswith("arm.toml: ")


def test_another_backend_leaves_the_former_ones_keys_behind() -> None:
    table = rig_table(deformer__kernel="r3")
    changed = apply_overrides(table, ["deformer.backend=ffd", "deformer.lattice_spacing_mm=15"], source="r.toml")
    deformer = parse_rig(changed, source="r.toml").deformer
    assert (deformer.backend.value, deformer.lattice_spacing_mm) == ("ffd", 15.0)
    same = apply_overrides(table, ["deformer.backend=rbf"], source="r.toml")
    assert parse_rig(same, source="r.toml").deformer.kernel == "r3"


@pytest.mark.parametrize(
    ("backend", "key", "value"),
    [("ffd", "kernel", "r3"), ("rbf", "lattice_levels", "3"), ("rbf", "lattice_spacing_mm", "9")],
)
def test_keys_of_the_other_backend_are_errors(backend: str, key: str, value: str) -> None:
    table = apply_overrides(rig_table(), [f"deformer.backend={backend}", f"deformer.{key}={value}"], source="r.toml")
    with pytest.raises(RigError, match=f'r.toml: deformer.{key}: has no effect on backend "{backend}"; remove it'):
        parse_rig(table, source="r.toml")


def test_a_lock_without_rigid_bones_is_refused():
    with pytest.raises(RigError, match=r"bones\.lock: locks rigid and kept bones, but bones\.rigid is false"):
        BoneSettings(lock=True)
