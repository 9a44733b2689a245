"""Names of bones -> the joints between them that anatomy knows; knows words, not surfaces' fits."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from musclefit.rig.joint_kinds import JointKind


@dataclass(frozen=True, slots=True)
class NamedJoint:
    """A joint between two bones that carry its names, and every bone that it moves."""

    name: str
    kind: JointKind
    fixed: str
    moving: str
    moves: tuple[str, ...]


_JOINTS: tuple[tuple[str, str, str, JointKind], ...] = (
    ("hip", r"hip|hip bone|pelvis|ilium|innominate", r"femur", JointKind.BALL),
    ("knee", r"femur", r"tibia", JointKind.HINGE),
    ("ankle", r"tibia", r"talus", JointKind.HINGE),
    ("shoulder", r"scapula", r"humerus", JointKind.BALL),
    ("elbow", r"humerus", r"ulna", JointKind.HINGE),
    ("mcp", r"metacarpal", r"proximal phalanx", JointKind.HINGE),
    ("pip", r"proximal phalanx", r"middle phalanx", JointKind.HINGE),
    ("dip", r"middle phalanx", r"distal phalanx", JointKind.HINGE),
    ("ip", r"proximal phalanx", r"distal phalanx", JointKind.HINGE),
)
"""Name, what the bone that carries it and the one that it moves are called, and kind."""

_RAYS = {
    "thumb": "thumb",
    "first": "thumb",
    "index": "index",
    "second": "index",
    "third": "middle",
    "middle finger": "middle",
    "fourth": "ring",
    "ring": "ring",
    "fifth": "little",
    "little": "little",
}
"""Words for the fingers that a bone may belong to."""

_SIDES = ("left", "right")


def named_joints(bones: Iterable[str], *, meeting: Mapping[str, Sequence[str]]) -> tuple[NamedJoint, ...]:
    """The joints between bones that meet, as far as their names say them.

    Parameters
    ----------
    bones : iterable of str
    meeting : mapping of a bone to those that come close to it

    Returns
    -------
    tuple of NamedJoint
        Each moves the bones that are joined to its moving bone other than through the bone that carries it.
    """
    words = {bone: _plain(bone) for bone in bones}
    found = []
    for joint, fixed_words, moving_words, kind in _JOINTS:
        for fixed in words:
            for moving in meeting.get(fixed, ()):
                if not (_says(words[fixed], fixed_words) and _says(words[moving], moving_words)):
                    continue
                if _side(words[fixed]) != _side(words[moving]) and _side(words[fixed]) and _side(words[moving]):
                    continue
                if joint in ("mcp", "pip", "dip", "ip") and _ray(words[fixed]) != _ray(words[moving]):
                    continue
                moves = _beyond(moving, fixed, meeting)
                name = "_".join(part for part in (joint, _ray(words[moving]), _side(words[moving])) if part)
                found.append(NamedJoint(name, kind, fixed, moving, moves))
    counts: dict[str, int] = {}
    unique = []
    for one in found:
        counts[one.name] = counts.get(one.name, 0) + 1
        name = one.name if counts[one.name] == 1 else f"{one.name}_{counts[one.name]}"
        unique.append(NamedJoint(name, one.kind, one.fixed, one.moving, one.moves))
    return tuple(unique)


def _plain(name: str) -> str:
    return " ".join(re.findall(r"[a-z]+", name.lower()))


def _says(words: str, pattern: str) -> bool:
    return re.search(rf"\b(?:{pattern})\b", words) is not None


def _side(words: str) -> str:
    return next((side for side in _SIDES if _says(words, side)), "")


def _ray(words: str) -> str:
    if not _says(words, "phalanx|metacarpal"):
        return ""
    return next((ray for word, ray in _RAYS.items() if _says(words, word)), "")


def _beyond(moving: str, fixed: str, meeting: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """The moving bone and those reached from it by bones that meet, without passing the one that carries it."""
    reached, waiting = {moving}, [moving]
    while waiting:
        for other in meeting.get(waiting.pop(), ()):
            if other != fixed and other not in reached:
                reached.add(other)
                waiting.append(other)
    return (moving, *sorted(reached - {moving}))
