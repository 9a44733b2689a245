"""Joints that the names of bones say: of the wrist, the thumb and the toes too, and what each of them moves."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

import musclefit as mf
from musclefit.io.anatomy import read_surface
from musclefit.rig.joint_kinds import JointKind
from musclefit.rig.named_joints import NamedJoint, named_joints


def joints(*touching: tuple[str, str], side: str = "right") -> dict[str, NamedJoint]:
    """Of bones that meet in pairs, all of one side."""
    pairs = [tuple(f"{side} {name}" for name in pair) for pair in touching]
    return of_pairs(pairs)


def of_pairs(pairs: Iterable[tuple[str, ...]]) -> dict[str, NamedJoint]:
    meeting: dict[str, list[str]] = {}
    for a, b in pairs:
        meeting.setdefault(a, []).append(b)
        meeting.setdefault(b, []).append(a)
    return {one.name: one for one in named_joints(meeting, meeting=meeting)}


CARPUS = tuple(itertools.combinations(["scaphoid", "lunate", "triquetral", "capitate", "hamate", "trapezium"], 2))
THUMB = (
    ("trapezium", "first metacarpal bone"),
    ("first metacarpal bone", "proximal phalanx of thumb"),
    ("proximal phalanx of thumb", "distal phalanx of thumb"),
)
INDEX = (
    ("capitate", "second metacarpal bone"),
    ("trapezium", "second metacarpal bone"),
    ("second metacarpal bone", "proximal phalanx of index finger"),
)
HAND = (
    ("humerus", "ulna"),
    ("humerus", "radius"),
    ("radius", "ulna"),
    ("radius", "scaphoid"),
    ("radius", "lunate"),
    ("ulna", "lunate"),
    ("first metacarpal bone", "second metacarpal bone"),
    ("proximal phalanx of thumb", "proximal phalanx of index finger"),
    *CARPUS,
    *THUMB,
    *INDEX,
)


def test_wrist_and_thumb_are_found() -> None:
    found = joints(*HAND)
    assert {name: one.kind for name, one in found.items()} == {
        "elbow_right": JointKind.HINGE,
        "wrist_right": JointKind.UNIVERSAL,
        "cmc_thumb_right": JointKind.UNIVERSAL,
        "mcp_thumb_right": JointKind.HINGE,
        "mcp_index_right": JointKind.HINGE,
        "ip_thumb_right": JointKind.HINGE,
    }
    cmc = found["cmc_thumb_right"]
    assert (cmc.fixed, cmc.moving) == ("right trapezium", "right first metacarpal bone")


def test_scaphoid_and_lunate_are_one_wrist_that_moves_the_hand_alone() -> None:
    wrist = joints(*HAND)["wrist_right"]
    assert (wrist.fixed, wrist.moving, wrist.also_moving) == ("right radius", "right scaphoid", ("right lunate",))
    assert wrist.moves[:2] == ("right scaphoid", "right lunate")
    assert set(wrist.moves) == {f"right {n}" for pair in HAND for n in pair} - {
        "right humerus",
        "right ulna",
        "right radius",
    }


def test_a_finger_moves_no_other_one_where_they_touch() -> None:
    found = joints(*HAND)
    assert found["mcp_thumb_right"].moves == ("right proximal phalanx of thumb", "right distal phalanx of thumb")
    assert set(found["cmc_thumb_right"].moves) == {f"right {name}" for pair in THUMB for name in pair} - {
        "right trapezium"
    }
    assert found["mcp_index_right"].moves == ("right proximal phalanx of index finger",)


def test_an_elbow_moves_forearm_and_hand_and_not_the_trunk() -> None:
    elbow = of_pairs([("l humerus", "l ulna"), ("l ulna", "l radius"), ("l ulna", "pelvis"), ("l radius", "carpals")])
    assert elbow["elbow"].moves == ("l ulna", "carpals", "l radius")


@pytest.mark.parametrize(
    ("carries", "moves", "name"),
    [
        ("metacarpal_1", "phalanx_proximal_1", "mcp_thumb"),
        ("phalanx_proximalis_2", "phalanx_media_2", "pip_index"),
        ("Metacarpal_1_left", "proximal_phalanx_1_left", "mcp_thumb_left"),
        ("3rd metacarpal", "proximal phalanx of middle finger", "mcp_middle"),
        ("left first metatarsal bone", "proximal phalanx of left big toe", "mtp_big_toe_left"),
        ("proximal phalanx of left second toe", "middle phalanx of left second toe", "pip_second_toe_left"),
        ("proximal phalanx of right index finger", "middle phalanx of right second toe", ""),
        ("left radius", "right scaphoid", ""),
        ("radius", "carpal", "wrist"),
        ("trapezium", "second metacarpal bone", ""),
    ],
)
def test_names_say_finger_toe_and_side(carries: str, moves: str, name: str) -> None:
    assert list(of_pairs([(carries, moves)])) == ([name] if name else [])


REAL = {
    "radius": "right_radius",
    "scaphoid": "right_scaphoid",
    "lunate": "right_lunate",
    "capitate": "right_capitate",
    "proximal": "proximal_phalanx_of_right_thumb",
    "distal": "distal_phalanx_of_right_thumb",
}


@pytest.mark.anatomy
@pytest.mark.slow
def test_wrist_and_thumb_of_a_real_hand(anatomy_data: Path) -> None:
    """The wrist turns about the head of the capitate, and the thumb's last joint across its bones."""
    bones = {name: next((anatomy_data / "body" / "bones").glob(f"{file}_FMA*.ply")) for name, file in REAL.items()}
    wrist = mf.fit_joint(bones["radius"], [bones["scaphoid"], bones["lunate"]], kind="named")
    assert wrist.kind is JointKind.UNIVERSAL
    capitate, radius = (read_surface(bones[name]).mesh().vertices for name in ("capitate", "radius"))
    nearest = np.argsort(np.linalg.norm(capitate - radius.mean(axis=0), axis=1))[:50]
    assert np.linalg.norm(wrist.centre_mm - capitate[nearest].mean(axis=0)) < 6.0
    thumb = mf.fit_joint(bones["proximal"], bones["distal"], kind="named")
    distal = read_surface(bones["distal"]).mesh().vertices
    length = np.linalg.svd(distal - distal.mean(axis=0), full_matrices=False)[2][0]
    assert thumb.believable
    assert thumb.axis is not None
    assert np.degrees(np.arccos(abs(thumb.axis @ length))) > 75.0
