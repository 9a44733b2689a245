"""Files of rigid transforms per bone and time: JSON or CSV <-> `BoneTransforms`; knows no anatomy."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.formats.rows import PositionColumns, Rows
from musclefit.io.formats.tables import parse_json
from musclefit.rig.table_reader import Section, suggestion
from musclefit.rig.transforms import BoneTransforms, Given, motion_of_matrix, motion_of_quaternion, said
from musclefit.vocabulary import Unit

BONE, TIME = "bone", "time_s"
MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
QUATERNION = ("qw", "qx", "qy", "qz")
REMARKS = ("phase", "remark")
"""Columns of words for the reader."""

_TEXTS = ("units", "source", "frame")
_ORDERS: Mapping[str, int] = {"quaternion_wxyz": 0, "quaternion_xyzw": 1}
"""Keys of quaternions, and by how many places they are turned to have w first."""

_TRANSLATIONS: Mapping[str, Unit | None] = {"translation": None, **{f"translation_{unit}": unit for unit in Unit}}


def parse_transforms(data: bytes, *, source: str, units: Unit) -> BoneTransforms:
    """Read a file of transforms.

    Parameters
    ----------
    data : bytes
        A CSV has a line of headings and one transform per line: ``bone``; ``time_s`` where there is more than one pose;
        ``m00`` to ``m33``, a 4x4 matrix row by row, or ``qw``, ``qx``, ``qy``, ``qz`` and ``x_mm``, ``y_mm``, ``z_mm``
        (``x_cm`` .., ``x_m`` .., ``x`` ..). ``phase`` and ``remark`` are words for the reader. A JSON file has a list
        ``transforms`` of objects with ``bone``, ``time_s`` and ``matrix`` (four rows of four, or 16 numbers), or
        ``quaternion_wxyz`` (or ``quaternion_xyzw``) and ``translation_mm`` (or ``_cm``, ``_m``, or ``translation``);
        beside it ``units``, ``frame`` and ``source``.
    source : str
        The file; its ending says which.
    units : Unit
        Length unit where the file states none.

    Returns
    -------
    BoneTransforms
        Translations in mm.

    Raises
    ------
    InputError
        A file that cannot be read, an unknown column or key, a value that is not finite, a matrix or quaternion
        that is not a rotation, or what `BoneTransforms` refuses; the message names place, bone and time.
    """
    suffix = Path(source).suffix.lower()
    if suffix == ".json":
        return _of_json(parse_json(data, source=source), source=source, units=units)
    if suffix == ".csv":
        return _of_csv(data, source=source, units=units)
    raise InputError(f"{source}: has suffix {suffix!r}; expected .json or .csv")


def transforms_text(motions: Mapping[str, RigidMotion] | Mapping[float, Mapping[str, RigidMotion]]) -> str:
    """The JSON that `parse_transforms` reads to the same motions: of one pose by bone, or of several by time in s."""
    listed: list[dict[str, Any]] = []
    for key, value in motions.items():
        if isinstance(value, RigidMotion):
            listed.append({BONE: key, "matrix": _rows_of(value)})
        else:
            listed += [{BONE: bone, TIME: key, "matrix": _rows_of(motion)} for bone, motion in value.items()]
    return json.dumps({"units": Unit.MILLIMETRE.value, "transforms": listed}, indent=1) + "\n"


def _rows_of(motion: RigidMotion) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.rotation, motion.translation
    return [[float(x) for x in row] for row in matrix]


def _of_csv(data: bytes, *, source: str, units: Unit) -> BoneTransforms:
    path = Path(source)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is not UTF-8 text (byte {error.start} is not valid); save it as UTF-8") from None
    if not text.strip():
        raise InputError(f"{source}: is empty; expected the columns {BONE}, {TIME} and m00 to m33")
    rows = Rows.of_csv(text, path, key=BONE)
    by_matrix, translations = _columns(rows, units)
    bones = rows.texts(BONE)
    times = rows.numbers([TIME])[:, 0].tolist() if TIME in rows.headings else [None] * len(bones)
    given = []
    for k, (line, _) in enumerate(rows.rows):
        if not bones[k]:
            raise InputError(f"{source}: line {line} names no bone; name it")
    values = rows.numbers(MATRIX if by_matrix else QUATERNION)
    moved = None if translations is None else translations.read(rows)
    for k, (line, _) in enumerate(rows.rows):
        place = f"{source}: line {line}: {said(bones[k], times[k])}"
        if moved is None:
            motion, off = motion_of_matrix(_in_mm(values[k].reshape(4, 4), units), place=place)
        else:
            motion, off = motion_of_quaternion(values[k], moved[k], place=place)
        given.append(Given(bones[k], times[k], f"line {line}", motion, off))
    return BoneTransforms.of(given, source=source)


def _columns(rows: Rows, units: Unit) -> tuple[bool, PositionColumns | None]:
    """Whether the columns are those of matrices, and those of translations where they are not."""
    matrix = [heading for heading in rows.headings if heading in MATRIX]
    quaternion = [heading for heading in rows.headings if heading in QUATERNION]
    translations = PositionColumns.find(rows, "", units)
    placed = () if translations is None else translations.headings
    known = (BONE, TIME, *REMARKS, *MATRIX, *QUATERNION, "x_mm", "y_mm", "z_mm")
    for heading in rows.headings:
        if heading not in known and heading not in placed:
            raise InputError(f"{rows.path}: column {heading!r} is unknown; {suggestion(heading, known)}")
    if TIME in rows.headings:
        rows.require(TIME)
    if bool(matrix) == bool(quaternion or translations):
        found = "both are there" if matrix else f"found are: {rows.said}"
        raise InputError(
            f"{rows.path}: expected the columns m00 to m33 (a 4x4 matrix, row by row), or qw, qx, qy, qz and x_mm, "
            f"y_mm, z_mm; {found}"
        )
    rows.require(*(MATRIX if matrix else QUATERNION))
    if not matrix and translations is None:
        raise InputError(f"{rows.path}: no columns x_mm, y_mm, z_mm beside the quaternion; found are: {rows.said}")
    return bool(matrix), None if matrix else translations


def _of_json(table: Mapping[str, Any], *, source: str, units: Unit) -> BoneTransforms:
    root = Section(table, source)
    root.refuse_unknown((*_TEXTS, "transforms"))
    root.require(("transforms",))
    units = root.choice("units", Unit) if "units" in root else units
    if "source" in root:
        root.text("source")
    frames = sorted(set(re.findall(r"\b(?:LPS|RAS)\b", root.text("frame")))) if "frame" in root else []
    given = [_entry(entry, units) for entry in root.sections("transforms")]
    return BoneTransforms.of(given, source=source, frame=frames[0] if len(frames) == 1 else "")


def _entry(entry: Section, units: Unit) -> Given:
    if "quaternion" in entry:
        raise entry.error("quaternion", f"does not say its order; write {' or '.join(_ORDERS)}")
    entry.refuse_unknown((BONE, TIME, "matrix", *_ORDERS, *_TRANSLATIONS))
    entry.require((BONE,))
    bone, time = entry.text(BONE), entry.number(TIME) if TIME in entry else None
    place = f"{entry.source}: {entry.key}: {said(bone, time)}"
    ways = [key for key in ("matrix", *_ORDERS) if key in entry]
    moves = [key for key in _TRANSLATIONS if key in entry]
    if len(ways) != 1 or len(moves) != (ways[0] != "matrix"):
        raise InputError(
            f"{place}: has {', '.join([*ways, *moves]) or 'no transform'}; expected matrix alone, or one quaternion "
            "and one translation"
        )
    if ways[0] == "matrix":
        motion, off = motion_of_matrix(_in_mm(_matrix(entry), units), place=place)
    else:
        wxyz = np.roll(entry.vector(ways[0], length=4), _ORDERS[ways[0]])
        unit = _TRANSLATIONS[moves[0]] or units
        moved: Points = entry.vector(moves[0], length=3) * unit.in_mm
        motion, off = motion_of_quaternion(wxyz, moved, place=place)
    return Given(bone, time, entry.key, motion, off)


def _matrix(entry: Section) -> Float:
    """(4, 4) of four rows, or of 16 numbers row by row."""
    value = entry.table["matrix"]
    if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) and len(row) == 4 for row in value):
        value = [x for row in value for x in row]
    elif not (isinstance(value, list) and len(value) == 16):
        raise entry.error("matrix", "expected four rows of four numbers, or 16 numbers row by row")
    found: Float = Section({"matrix": value}, entry.source, entry.key).vector("matrix", length=16).reshape(4, 4)
    return found


def _in_mm(matrix: Float, units: Unit) -> Float:
    """The matrix with its translation in mm."""
    scaled = np.array(matrix)
    with np.errstate(over="ignore"):
        scaled[:3, 3] *= units.in_mm
    return scaled
