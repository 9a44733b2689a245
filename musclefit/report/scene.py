"""Surfaces that a page shows in 3-D: records, and how they are packed small; draws and measures nothing.

Positions are multiples of one quantum, 1/65535 of the largest extent of all shapes. They are stored as differences
from what is already known (the same vertices in the first shape or the frames before, then the vertex before), as byte
planes, and compressed by gzip, which browsers unpack themselves. Triangles are coded by `triangle_coding`.
"""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Float, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.report.triangle_coding import CodedFaces, coded

FIELD_STEPS = 254
"""Steps of a coloured value over its range; 255 stands for what is not a number."""

COMPRESSION = 6
"""Of gzip, up to 9, which makes a page 1 % smaller in eight times the time."""

_STEPS = 65535


@dataclass(frozen=True, slots=True)
class SceneTissue:
    """A layer: its name, kind and colour (``#rrggbb``)."""

    name: str
    kind: str
    colour: str


@dataclass(frozen=True, eq=False, slots=True)
class SceneField:
    """A value at every vertex of a shape, drawn in colours from ``low`` to ``high``; what lies beyond has the end's."""

    name: str
    unit: str
    low: float
    high: float
    values: Float


@dataclass(frozen=True, eq=False, slots=True)
class SceneMark:
    """A place to point out: triangles, or dots where it has none.

    Parameters
    ----------
    kind : str
        "overlap", "fold", "inverted tet" or "contact zone".
    title : str
        What it is, in words.
    tissues : tuple of str
        Whom it concerns.
    vertices : (n, 3) float64, mm
    faces : (m, 3) int
    """

    kind: str
    title: str
    tissues: tuple[str, ...]
    vertices: Points
    faces: Int = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))


@dataclass(frozen=True, eq=False, slots=True)
class SceneShape:
    """All tissues in one state: a surface each, values and marks; of a frame of a motion its time and the motion."""

    title: str
    surfaces: tuple[TriMesh, ...]
    fields: tuple[SceneField, ...] = ()
    marks: tuple[SceneMark, ...] = ()
    time_s: float | None = None
    motion: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """What a page shows in 3-D.

    Parameters
    ----------
    tissues : tuple of SceneTissue
    shapes : tuple of SceneShape
        The first is at rest: displacements are against it.
    up, towards : (3,) float64
        Unit vectors of the first view: upright, and from the body to the eye.
    left_out : tuple of str
        What was found and is not drawn, in words.
    first_time_s : float or None
        Of the frame that a motion is first shown at; None for its first.
    """

    tissues: tuple[SceneTissue, ...]
    shapes: tuple[SceneShape, ...]
    up: Float
    towards: Float
    left_out: tuple[str, ...] = ()
    first_time_s: float | None = None

    @property
    def marks(self) -> list[tuple[int, int, SceneMark]]:
        """Every mark with the number of its shape and its number there."""
        return [(s, m, mark) for s, shape in enumerate(self.shapes) for m, mark in enumerate(shape.marks)]

    @property
    def vertices(self) -> int:
        """Of the shape at rest."""
        return sum(len(surface.vertices) for surface in self.shapes[0].surfaces)


def packed(scene: Scene) -> tuple[str, str]:
    """A scene as two texts that may stand in a page's script elements: JSON without ``<``, and base64.

    Returns
    -------
    tuple of str
        What the arrays are, and the arrays themselves, compressed.
    """
    low, high = scene_box(scene)
    quantum = quantum_mm(scene)
    arrays = _Arrays()
    said: dict[str, Any] = {
        "tissues": [{"name": t.name, "kind": t.kind, "colour": t.colour} for t in scene.tissues],
        "origin": low.tolist(),
        "size": (high - low).tolist(),
        "quantum": quantum,
        "up": np.asarray(scene.up).tolist(),
        "towards": np.asarray(scene.towards).tolist(),
        "first_time_s": scene.first_time_s,
        "topologies": [],
        "shapes": [],
    }
    numbers, topologies = _topologies(scene)
    codes: list[CodedFaces] = []
    for shape in topologies:
        codes.append(coded(tuple(surface.faces for surface in shape.surfaces), codes))
        said["topologies"].append(_packed_topology(shape, codes[-1], arrays))
    whole: list[np.ndarray[Any, np.dtype[np.uint16]]] = []
    for shape, number in zip(scene.shapes, numbers, strict=True):
        positions = np.rint((_joined(shape) - low) / quantum).astype(np.int64).astype(np.uint16)
        guess = _guess(scene, positions, whole, said["shapes"], number)
        whole.append(positions)
        said["shapes"].append(
            {
                "title": shape.title,
                "topology": number,
                "time_s": shape.time_s,
                "motion": shape.motion,
                "guess": guess[0],
                "positions": arrays.add_words(_signed16(positions - guess[1])),
                "fields": [_packed_field(values, arrays) for values in shape.fields],
                "marks": [_packed_mark(mark, arrays) for mark in shape.marks],
            }
        )
    text = json.dumps(said, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return _inert(text), base64.b64encode(gzip.compress(arrays.joined(), COMPRESSION, mtime=0)).decode("ascii")


def quantum_mm(scene: Scene) -> float:
    """To which multiple of mm positions are rounded."""
    low, high = scene_box(scene)
    return max(float((high - low).max()), 1e-6) / _STEPS


def scene_box(scene: Scene) -> Float:
    """Lowest and highest corner (2, 3) of all shapes, mm."""
    ends = [
        (surface.vertices.min(axis=0), surface.vertices.max(axis=0))
        for shape in scene.shapes
        for surface in shape.surfaces
        if len(surface.vertices)
    ]
    return np.stack([np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)])


class _Arrays:
    """One run of bytes, and where each array stands in it."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def joined(self) -> bytes:
        return b"".join(self._parts)

    def add_words(self, values: Int, *, running: bool = True) -> list[int]:
        """Signed whole numbers, column by column, in byte planes; where they stand.

        Parameters
        ----------
        values : (rows,) or (rows, columns) int
        running : bool
            As differences along the rows.
        """
        columns = np.atleast_2d(np.asarray(values, dtype=np.int64).T)
        steps = (np.diff(columns, axis=1, prepend=0) if running else columns).ravel()
        folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype(np.uint64)
        planes = max(1, (int(folded.max(initial=0)).bit_length() + 7) // 8)
        data = b"".join(
            ((folded >> np.uint64(8 * k)) & np.uint64(255)).astype(np.uint8).tobytes() for k in range(planes)
        )
        return [self._add(data), columns.shape[1], columns.shape[0], planes]

    def add_floats(self, values: Float) -> list[int]:
        """Single-precision floats as they are: where they stand, and how many."""
        flat = np.ascontiguousarray(values, dtype="<f4").ravel()
        return [self._add(flat.tobytes()), len(flat)]

    def _add(self, data: bytes) -> int:
        at = self._size
        self._parts.append(data)
        self._size += len(data)
        return at


def _topologies(scene: Scene) -> tuple[list[int], list[SceneShape]]:
    """For each shape the number of its triangles, and a shape that has them by that number, the coarsest first."""
    first: list[SceneShape] = []
    own = []
    for shape in scene.shapes:
        number = next((k for k, other in enumerate(first) if _same_triangles(shape, other)), len(first))
        own.append(number)
        if number == len(first):
            first.append(shape)
    order = sorted(range(len(first)), key=lambda k: sum(len(surface.faces) for surface in first[k].surfaces))
    return [order.index(number) for number in own], [first[k] for k in order]


def _same_triangles(one: SceneShape, other: SceneShape) -> bool:
    return all(
        a.faces is b.faces
        or (len(a.vertices) == len(b.vertices) and a.faces.shape == b.faces.shape and np.array_equal(a.faces, b.faces))
        for a, b in zip(one.surfaces, other.surfaces, strict=True)
    )


def _packed_topology(shape: SceneShape, code: CodedFaces, arrays: _Arrays) -> dict[str, Any]:
    """Numbers of vertices and triangles of each tissue, and the triangles as they were coded."""
    return {
        "vertices": [len(surface.vertices) for surface in shape.surfaces],
        "triangles": list(code.triangles),
        "base": code.base,
        "kept": list(code.kept),
        "runs": arrays.add_words(code.runs, running=False),
        "first": arrays.add_words(code.first),
        "others": arrays.add_words(code.others, running=False),
    }


def _guess(
    scene: Scene,
    positions: np.ndarray[Any, np.dtype[np.uint16]],
    whole: list[np.ndarray[Any, np.dtype[np.uint16]]],
    said: list[dict[str, Any]],
    number: int,
) -> tuple[list[Any], np.ndarray[Any, np.dtype[np.uint16]]]:
    """Where the vertices are likely to be, from the shapes before, and how the page finds the same."""
    same = [k for k, shape in enumerate(said) if shape["topology"] == number]
    own = scene.shapes[len(said)].motion
    frames = [k for k in same if said[k]["time_s"] is not None and said[k]["motion"] == own]
    if len(frames) >= 2 and scene.shapes[len(said)].time_s is not None:
        return ["line", frames[-2], frames[-1]], whole[frames[-1]] + (whole[frames[-1]] - whole[frames[-2]])
    if same:
        return ["shape", same[-1] if frames else same[0]], whole[same[-1] if frames else same[0]]
    if said and all(len(a.vertices) <= len(b.vertices) for a, b in _beside(scene, len(said))):
        starts = np.cumsum([0, *(len(b.vertices) for _, b in _beside(scene, len(said)))])
        rows = np.concatenate(
            [np.arange(s, s + len(a.vertices)) for (a, _), s in zip(_beside(scene, len(said)), starts, strict=False)]
        )
        return ["first of", 0], whole[0][rows]
    return ["nothing"], np.zeros_like(positions)


def _beside(scene: Scene, number: int) -> list[tuple[TriMesh, TriMesh]]:
    return list(zip(scene.shapes[number].surfaces, scene.shapes[0].surfaces, strict=True))


def _packed_field(found: SceneField, arrays: _Arrays) -> dict[str, Any]:
    share = (np.asarray(found.values, dtype=np.float64) - found.low) / (found.high - found.low)
    steps = np.where(np.isnan(share), 255, np.rint(np.clip(np.nan_to_num(share), 0, 1) * FIELD_STEPS)).astype(np.int64)
    return {
        "name": found.name,
        "unit": found.unit,
        "low": found.low,
        "high": found.high,
        "values": arrays.add_words(steps[:, None]),
    }


def _packed_mark(mark: SceneMark, arrays: _Arrays) -> dict[str, Any]:
    return {
        "kind": mark.kind,
        "title": mark.title,
        "tissues": list(mark.tissues),
        "vertices": arrays.add_floats(mark.vertices),
        "faces": arrays.add_words(np.asarray(mark.faces).reshape(-1, 3)),
    }


def _joined(shape: SceneShape) -> Float:
    return np.concatenate([surface.vertices for surface in shape.surfaces])


def _signed16(words: np.ndarray[Any, np.dtype[np.uint16]]) -> Int:
    return words.view(np.int16).astype(np.int64)


def _inert(text: str) -> str:
    """JSON that closes no element and opens no comment, whatever names it holds."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
