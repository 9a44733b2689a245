"""Names of bones -> the joints between them that anatomy knows; knows words, not surfaces' fits."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from musclefit.rig.joint_kinds import JointKind


@dataclass(frozen=True, slots=True)
class NamedJoint:
    """A joint between bones that carry its names, and every bone that it moves.

    Parameters
    ----------
    name : str
    kind : JointKind
    fixed, moving : str
    moves : tuple of str
        All that the joint moves, ``moving`` first.
    also_moving : tuple of str
        Bones whose surfaces are part of the joint's beside that of ``moving``, as the lunate's beside the scaphoid's.
    """

    name: str
    kind: JointKind
    fixed: str
    moving: str
    moves: tuple[str, ...]
    also_moving: tuple[str, ...] = ()


_PROXIMAL, _MIDDLE, _DISTAL = (
    rf"{word} phalanx|phalanx {word}(?:is)?" for word in ("proximal", "(?:middle|intermediate|medial?)", "distal")
)

_JOINTS: tuple[tuple[str, str, str, JointKind], ...] = (
    ("hip", r"hip|hip bone|pelvis|ilium|innominate", r"femur", JointKind.BALL),
    ("knee", r"femur", r"tibia", JointKind.HINGE),
    ("ankle", r"tibia", r"talus", JointKind.HINGE),
    ("shoulder", r"scapula", r"humerus", JointKind.BALL),
    ("elbow", r"humerus", r"ulna", JointKind.HINGE),
    ("wrist", r"radius", r"scaphoid|lunate|carpals?", JointKind.UNIVERSAL),
    ("cmc", r"trapezium", r"metacarpal", JointKind.UNIVERSAL),
    ("mcp", r"metacarpal", _PROXIMAL, JointKind.HINGE),
    ("mtp", r"metatarsal", _PROXIMAL, JointKind.HINGE),
    ("pip", _PROXIMAL, _MIDDLE, JointKind.HINGE),
    ("dip", _MIDDLE, _DISTAL, JointKind.HINGE),
    ("ip", _PROXIMAL, _DISTAL, JointKind.HINGE),
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
    "1(?:st)?": "thumb",
    "2(?:nd)?": "index",
    "3(?:rd)?": "middle",
    "4(?:th)?": "ring",
    "5(?:th)?": "little",
}
"""Words for the fingers that a bone may belong to."""

_TOES = {
    "thumb": "big_toe",
    "index": "second_toe",
    "middle": "third_toe",
    "ring": "fourth_toe",
    "little": "little_toe",
}
"""A finger's word -> the toe that has it, too."""

_OF_RAYS = ("cmc", "mcp", "mtp", "pip", "dip", "ip")
"""Joints between bones of one finger or toe."""

_SEGMENTS = (
    r"scapula|clavicle|hip|hip bone|pelvis|ilium|innominate|sacrum",
    r"humerus|femur",
    r"radius|ulna|tibia|fibula|patella",
    r"scaphoid|lunate|triquetral|triquetrum|pisiform|trapezium|trapezoid|capitate|hamate|carpals?"
    r"|talus|calcaneus|navicular|cuboid|cuneiform|tarsals?",
    r"metacarpals?|metatarsals?",
    _PROXIMAL,
    _MIDDLE,
    _DISTAL,
)
"""Bones of the limbs from the trunk outwards: a joint moves none of a segment before that of its moving bone."""

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
        Each moves the bones that are joined to its moving bone outwards along the limb: not through the bone that
        carries it, nor through bones of the other side, of another finger or nearer to the trunk. Scaphoid and lunate
        are one wrist.
    """
    words = {bone: _plain(bone) for bone in bones}
    found: dict[tuple[str, str, str], NamedJoint] = {}
    for joint, fixed, moving, kind in _said(words, meeting):
        name = "_".join(part for part in (joint, _ray(words[moving]), _side(words[moving])) if part)
        moves = _beyond(moving, fixed, words, meeting)
        own = (name, fixed, "" if joint == "wrist" else moving)
        before = found.get(own)
        if before is None:
            found[own] = NamedJoint(name, kind, fixed, moving, moves)
        else:
            all_moved = dict.fromkeys((before.moving, *before.also_moving, moving, *sorted({*before.moves, *moves})))
            found[own] = replace(before, moves=tuple(all_moved), also_moving=(*before.also_moving, moving))
    counts: dict[str, int] = {}
    unique = []
    for one in found.values():
        counts[one.name] = counts.get(one.name, 0) + 1
        name = one.name if counts[one.name] == 1 else f"{one.name}_{counts[one.name]}"
        unique.append(replace(one, name=name))
    return tuple(unique)


def _said(words: Mapping[str, str], meeting: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str, str, JointKind]]:
    """Every joint that two bones' names say, with the bone that carries it and the one that it moves."""
    for joint, fixed_words, moving_words, kind in _JOINTS:
        for fixed in words:
            for moving in meeting.get(fixed, ()):
                if not (_says(words[fixed], fixed_words) and _says(words[moving], moving_words)):
                    continue
                if _other_side(words[fixed], words[moving]):
                    continue
                ray = "thumb" if joint == "cmc" else _ray(words[fixed])
                if joint not in _OF_RAYS or ray == _ray(words[moving]):
                    yield joint, fixed, moving, kind


def _plain(name: str) -> str:
    """Words of letters, and single digits such as those of a first metacarpal, by blanks."""
    return " ".join(re.findall(r"[a-z]+|(?<![0-9])[1-5](?![0-9])(?:st|nd|rd|th)?", name.lower()))


def _says(words: str, pattern: str) -> bool:
    return re.search(rf"\b(?:{pattern})\b", words) is not None


def _side(words: str) -> str:
    return next((side for side in _SIDES if _says(words, side)), "")


def _other_side(words: str, others: str) -> bool:
    """Whether both say a side, and not the same."""
    return bool(_side(words) and _side(others) and _side(words) != _side(others))


def _ray(words: str) -> str:
    """The finger or toe that a bone belongs to."""
    if not _says(words, "phalanx|metacarpals?|metatarsals?"):
        return ""
    if _says(words, "big toe|great toe|hallux"):
        return "big_toe"
    finger = next((ray for word, ray in _RAYS.items() if _says(words, word)), "")
    return _TOES.get(finger, "") if _says(words, "toe|metatarsals?") else finger


def _segment(words: str) -> int:
    """How far out along its limb a bone is; beyond all others where its name does not say."""
    return next((k for k, said in enumerate(_SEGMENTS) if _says(words, said)), len(_SEGMENTS))


def _beyond(moving: str, fixed: str, words: Mapping[str, str], meeting: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """The moving bone and those reached from it outwards by bones that meet."""
    nearest, ray = _segment(words[moving]), _ray(words[moving])

    def outwards(bone: str) -> bool:
        other_ray = ray and _ray(words[bone]) and _ray(words[bone]) != ray
        return _segment(words[bone]) >= nearest and not other_ray and not _other_side(words[bone], words[moving])

    reached, waiting = {moving}, [moving]
    while waiting:
        for other in meeting.get(waiting.pop(), ()):
            if other != fixed and other not in reached and outwards(other):
                reached.add(other)
                waiting.append(other)
    return (moving, *sorted(reached - {moving}))
