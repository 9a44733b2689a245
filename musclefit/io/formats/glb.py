"""A motion as one animated GLB: a mesh per tissue, its shape keys the frames; metres, y up; knows no report."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import igl
import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Int, Points

_FLOAT, _UINT = 5126, 5125
_ARRAY, _INDEX = 34962, 34963
_BONE_EDGE_TRIANGLES = 200
"""No tissue is thinned below this many triangles."""

Colour = tuple[float, float, float]


@dataclass(slots=True)
class _Parts:
    """The binary part and the accessors that point into it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, values: np.ndarray[Any, Any], kind: str, *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array; the number of its accessor."""
        code, values = (_UINT, values.astype("<u4")) if values.dtype.kind in "iu" else (_FLOAT, values.astype("<f4"))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": code,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            flat = values.reshape(len(values), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self.accessors.append(accessor)
        self.data += values.tobytes()
        return len(self.accessors) - 1


def animated_glb(
    frames: Sequence[Anatomy], times_s: Sequence[float], *, colours: Mapping[str, Colour], triangles: int = 30_000
) -> bytes:
    """The bytes of a GLB that viewers play: between frames, vertices move straight.

    Parameters
    ----------
    frames : sequence of Anatomy
        The same triangles in each.
    times_s : sequence of float, rising
    colours : mapping of tissue name to colour
        Red, green and blue from 0 to 1; the skin is drawn translucent.
    triangles : int
        The surfaces are thinned to about this many in all: a subset of the vertices, each where the frames have it.

    Raises
    ------
    InputError
        No frame, not one time for each, or frames with other tissues or triangles.

    References
    ----------
    Khronos Group, glTF 2.0 Specification (2021).
    """
    _require_frames(frames, times_s)
    parts = _Parts()
    every = sum(len(t.surface.faces) for t in frames[0])
    times = parts.add(np.asarray(times_s, dtype=np.float64) - times_s[0], "SCALAR", bounds=True)
    weights = parts.add(np.eye(len(frames)).ravel(), "SCALAR")
    meshes, nodes, materials, channels = [], [], [], []
    for number, tissue in enumerate(frames[0]):
        share = max(_BONE_EDGE_TRIANGLES, round(triangles * len(tissue.surface.faces) / every))
        kept, faces = thinned_surface(tissue, triangles=share)
        places = [_in_metres(frame.tissues[number].surface.vertices[kept]) for frame in frames]
        base = parts.add(places[0], "VEC3", target=_ARRAY, bounds=True)
        normal = parts.add(_normals(places[0], faces), "VEC3", target=_ARRAY)
        targets = [
            {
                "POSITION": parts.add(place - places[0], "VEC3", target=_ARRAY, bounds=True),
                "NORMAL": parts.add(_normals(place, faces) - _normals(places[0], faces), "VEC3", target=_ARRAY),
            }
            for place in places
        ]
        primitive = {
            "attributes": {"POSITION": base, "NORMAL": normal},
            "indices": parts.add(faces.ravel(), "SCALAR", target=_INDEX),
            "material": number,
            "targets": targets,
        }
        start = [1.0] + [0.0] * (len(frames) - 1)
        meshes.append({"name": tissue.name, "primitives": [primitive], "weights": start})
        nodes.append({"name": tissue.name, "mesh": number})
        materials.append(_material(tissue, colours[tissue.name]))
        channels.append({"sampler": 0, "target": {"node": number, "path": "weights"}})
    document = {
        "asset": {"version": "2.0", "generator": "musclefit"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        "animations": [
            {
                "name": "motion",
                "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
                "channels": channels,
            }
        ],
        "accessors": parts.accessors,
        "bufferViews": parts.views,
        "buffers": [{"byteLength": len(parts.data)}],
    }
    return _packed(document, bytes(parts.data))


def thinned_surface(tissue: Tissue, *, triangles: int) -> tuple[Int, Int]:
    """Which vertices of a tissue's surface are kept, and triangles between them, about as many as asked for.

    Edges are collapsed onto one of their ends, so that every kept vertex is one that was given.
    """
    vertices, faces = np.array(tissue.surface.vertices), np.array(tissue.surface.faces)
    if len(faces) > triangles:
        import pyvista as pv

        surface = pv.PolyData.from_regular_faces(vertices, faces)
        surface.point_data["number"] = np.arange(len(vertices))
        thin = surface.decimate_pro(1.0 - triangles / len(faces), preserve_topology=True)
        kept = np.asarray(thin.point_data["number"], dtype=np.int64)
        return kept, np.asarray(thin.regular_faces, dtype=np.int64)
    kept, corners = np.unique(faces, return_inverse=True)
    return kept.astype(np.int64), corners.reshape(-1, 3).astype(np.int64)


def _normals(places: Points, faces: Int) -> Points:
    return np.nan_to_num(np.asarray(igl.per_vertex_normals(np.array(places), np.array(faces)), dtype=np.float64))


def _in_metres(places: Points) -> Points:
    """From mm with z up, as bodies stand in scanners, to metres with y up, as glTF asks."""
    return 1e-3 * places[:, [0, 2, 1]] * (1.0, 1.0, -1.0)


def _material(tissue: Tissue, colour: Colour) -> dict[str, Any]:
    skin = tissue.kind is TissueKind.SKIN
    linear = [float(c) ** 2.2 for c in colour]
    material: dict[str, Any] = {
        "name": tissue.name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*linear, 0.18 if skin else 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.7,
        },
    }
    return {**material, "alphaMode": "BLEND", "doubleSided": True} if skin else material


def _packed(document: Mapping[str, Any], data: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _require_frames(frames: Sequence[Anatomy], times_s: Sequence[float]) -> None:
    if not frames or len(frames) != len(times_s):
        raise InputError(f"{len(frames)} frames have {len(times_s)} times; give at least one frame and a time for each")
    for number, frame in enumerate(frames[1:], start=1):
        for one, other in zip(frames[0], frame, strict=True):
            if one.name != other.name or not np.array_equal(one.surface.faces, other.surface.faces):
                raise InputError(f"frame {number} has other tissues or triangles than frame 0, first {other.name!r}")
