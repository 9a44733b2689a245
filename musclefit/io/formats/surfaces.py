"""The bytes of a surface file -> vertices and faces as they stand in it; knows formats, not tissues.

STL, PLY, OBJ and VTP are read here and beside, not by trimesh or VTK, because a file cut short must never pass for
a whole one: trimesh 5.2 returns 9 of 12 triangles of a shortened ASCII PLY and 11 of 12 of a shortened OBJ in
silence, VTK 9.7 crashes the process on a shortened binary PLY and rounds its coordinates to single precision. Every
count that a file states is held against what it contains. What no reader can see is a text file cut inside its last
number, or an OBJ (which states no counts) cut between two lines; such a surface is open or uses a wrong vertex, which
the check for closed surfaces finds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Float, Int, Points
from musclefit.geometry.surfaces.polygons import cut_polygons, cut_strips

WAY_OUT = "the file is damaged or cut short; export it again"
"""What to do about a file that does not hold what it says."""


@dataclass(frozen=True, eq=False, slots=True)
class Polygons:
    """What a surface file holds.

    Parameters
    ----------
    vertices : (n, 3) float64, in the file's unit
    faces : (f, 3) int64, 0-based as in the file, polygons cut into triangles
    cut : int
        Polygons with more than three corners that were cut into triangles.
    """

    vertices: Points
    faces: Faces
    cut: int


def read_stl(data: bytes, source: str) -> Polygons:
    """Read STL, binary or ASCII; each triangle has its own three vertices, and the stated normals are not used.

    Raises
    ------
    MeshError
        The bytes are not a whole STL file; ``source`` names the file in the message.
    """
    stated = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if stated >= 0 and len(data) == 84 + 50 * stated:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        with np.errstate(invalid="ignore"):  # signalling NaN: whoever takes the surface in refuses what is not finite
            corners = np.frombuffer(data, record, offset=84)["corners"].astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        corners = _ascii_stl_corners(data, source)
    else:
        needed = f"{stated} triangles, which take {84 + 50 * stated} bytes" if stated >= 0 else "a header of 84 bytes"
        raise MeshError(f"{source}: a binary STL with {needed}, but the file has {len(data)} bytes; {WAY_OUT}")
    return Polygons(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int64).reshape(-1, 3), 0)


_STL_FACET = [
    *((0, b"facet"), (1, b"normal"), (5, b"outer"), (6, b"loop")),
    *((7, b"vertex"), (11, b"vertex"), (15, b"vertex"), (19, b"endloop"), (20, b"endfacet")),
]
"""Where the words stand in one facet of an ASCII STL, which is 21 words long."""


def _ascii_stl_corners(data: bytes, source: str) -> Float:
    lines = [line.strip() for line in data.splitlines()]
    bounds = [
        line.split()[0].lower() for line in lines if line[:5].lower() == b"solid" or line[:8].lower() == b"endsolid"
    ]
    if bounds.count(b"solid") != bounds.count(b"endsolid"):
        raise MeshError(f"{source}: an ASCII STL without its last line 'endsolid'; {WAY_OUT}")
    body = [line for line in lines if line[:5].lower() != b"solid" and line[:8].lower() != b"endsolid"]
    words = np.array(b" ".join(body).lower().split(), dtype=object)
    if len(words) % 21:
        raise MeshError(f"{source}: facet {len(words) // 21 + 1} of this ASCII STL is incomplete; {WAY_OUT}")
    facets = words.reshape(-1, 21)
    for column, word in _STL_FACET:
        wrong = np.flatnonzero(facets[:, column] != word)
        if wrong.size:
            found = facets[wrong[0], column].decode(errors="replace")
            raise MeshError(f"{source}: facet {wrong[0] + 1} has {found!r} instead of {word.decode()!r}; {WAY_OUT}")
    numbers = _numbers(facets[:, [8, 9, 10, 12, 13, 14, 16, 17, 18]].ravel(), source, what="a corner")
    return numbers.reshape(-1, 3, 3)


_OBJ_IGNORED = frozenset(
    {"vt", "vn", "vp", "g", "mg", "o", "s", "l", "p", "usemtl", "mtllib", "usemap", "maplib"}
    | {"lod", "bevel", "c_interp", "d_interp", "shadow_obj"}
)


def read_obj(data: bytes, source: str) -> Polygons:
    """Read the ``v`` and ``f`` of Wavefront OBJ; textures, normals, groups, materials, lines, points are passed over.

    Raises
    ------
    MeshError
        A statement that is none, a face with less than three corners or with vertices that are not there.
    """
    vertices: list[bytes] = []
    polygons: list[list[int]] = []
    text = re.sub(rb"\\\r?\n", b" ", data)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split(b"#", 1)[0].split()
        if not words:
            continue
        if words[0] == b"v":
            if len(words) < 4:
                raise MeshError(f"{source}: line {number}: a vertex with {len(words) - 1} of 3 coordinates; {WAY_OUT}")
            vertices.extend(words[1:4])
        elif words[0] == b"f":
            polygons.append(_obj_corners(words[1:], f"{source}: line {number}", len(vertices) // 3))
        elif words[0].decode("latin-1") not in _OBJ_IGNORED:
            raise MeshError(
                f"{source}: line {number}: {words[0][:20].decode('latin-1')!r} is not a statement of a polygonal OBJ; "
                "the file is not OBJ, is damaged, or holds curved surfaces: export it as triangles"
            )
    points = _numbers(np.array(vertices, dtype=object), source, what="a vertex").reshape(-1, 3)
    sizes = np.array([len(p) for p in polygons], dtype=np.int64)
    corners = np.array([i for p in polygons for i in p], dtype=np.int64)
    return polygons_cut(points, sizes, corners, source)


_LARGEST_INDEX = 2**62
"""No file has as many vertices; larger indices are no 64-bit integers."""


def _obj_corners(words: list[bytes], place: str, known: int) -> list[int]:
    try:
        indices = [int(word.split(b"/", 1)[0]) for word in words]
    except ValueError as error:
        raise MeshError(f"{place}: a face has a corner that is not a whole number ({error}); {WAY_OUT}") from error
    if max(map(abs, indices), default=0) > _LARGEST_INDEX:
        raise MeshError(f"{place}: a face refers to vertex {str(max(indices, key=abs))[:24]}...; {WAY_OUT}")
    if 0 in indices:
        raise MeshError(f"{place}: a face refers to vertex 0, but OBJ counts from 1; export the file again")
    return [i - 1 if i > 0 else known + i for i in indices]


def _numbers(words: Any, source: str, *, what: str) -> Float:
    try:
        values: Float = words.astype(np.float64)
    except ValueError as error:
        raise MeshError(f"{source}: {what} is not a number ({error}); {WAY_OUT}") from error
    return values


def polygons_cut(vertices: Points, sizes: Int, corners: Int, source: str) -> Polygons:
    """Polygons, given by their sizes and their corners one after the other, cut into triangles.

    Raises
    ------
    MeshError
        A polygon of fewer than 3 corners, or a non-convex one of too many.
    """
    if not len(sizes):
        return Polygons(vertices, np.zeros((0, 3), np.int64), 0)
    if sizes.min() < 3:
        first = int(np.argmin(sizes))
        raise MeshError(f"{source}: face {first} (0-based) has {sizes[first]} corners; a face needs 3. {WAY_OUT}")
    if sizes.max() == 3:
        return Polygons(vertices, corners.reshape(-1, 3), 0)
    try:
        return Polygons(vertices, cut_polygons(vertices, sizes, corners), int((sizes > 3).sum()))
    except ValueError as error:
        raise MeshError(f"{source}: {error}; cut it into triangles and export it again") from None


def strips_cut(sizes: Int, corners: Int, source: str) -> Faces:
    """The triangles of strips, given by their sizes and their corners one after the other.

    Raises
    ------
    MeshError
        A strip of fewer than 3 corners.
    """
    if len(sizes) and sizes.min() < 3:
        raise MeshError(f"{source}: a triangle strip has {sizes.min()} corners; it needs 3. {WAY_OUT}")
    return cut_strips(sizes, corners)
