"""Fibres at places and the areas where muscles hold on to bone, by muscle, as one NumPy archive without pickles."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh

FIBRES = "fibres.npz"

_AGAIN = "name a folder that this version's musclefit architecture wrote, or write it again"


@dataclass(frozen=True, eq=False, slots=True)
class HeldArea:
    """Where a muscle holds on to bone.

    Parameters
    ----------
    bone : str
        Its name, or names joined by " + ".
    surface : TriMesh
        Of the muscle, at rest, mm.
    """

    bone: str
    surface: TriMesh


@dataclass(frozen=True, eq=False, slots=True)
class MuscleFibres:
    """Directions of a muscle's fibres.

    Parameters
    ----------
    places : (k, 3) float64
        At rest, mm.
    directions : (k, 3) float64
        There, of length 1.
    held : tuple of HeldArea
    moved : (k, 3) float64 or None
        Where the map takes the places, mm; None where nothing was deformed.
    carried : (k, 3) float64 or None
        F f: the directions there, their length the fibre's stretch.
    """

    places: Points
    directions: Points
    held: tuple[HeldArea, ...] = ()
    moved: Points | None = None
    carried: Points | None = None


def fibre_bytes(fibres: Mapping[str, MuscleFibres]) -> bytes:
    """The archive of each muscle's fibres by name; carried ones only where all have them."""
    all_ = list(fibres.values())
    areas = [(number, area) for number, one in enumerate(all_) for area in one.held]
    arrays: dict[str, Any] = {
        "muscles": np.array(list(fibres), dtype=str),
        "muscle": np.repeat(np.arange(len(all_)), [len(one.places) for one in all_]),
        "places_mm": _together([one.places for one in all_]),
        "directions": _together([one.directions for one in all_]),
        "area_muscle": np.array([number for number, _ in areas], dtype=np.int64),
        "area_bone": np.array([area.bone for _, area in areas], dtype=str),
        "area_vertices": np.array([len(area.surface.vertices) for _, area in areas], dtype=np.int64),
        "area_faces": np.array([len(area.surface.faces) for _, area in areas], dtype=np.int64),
        "area_vertices_mm": _together([area.surface.vertices for _, area in areas]),
        "area_corners": np.concatenate([area.surface.faces for _, area in areas] or [np.zeros((0, 3), np.int64)]),
    }
    moved = [(one.moved, one.carried) for one in all_]
    if all(place is not None and along is not None for place, along in moved):
        arrays["moved_mm"] = _together([place for place, _ in moved if place is not None])
        arrays["carried"] = _together([along for _, along in moved if along is not None])
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def read_fibres(path: Path) -> Mapping[str, MuscleFibres]:
    """Each muscle's fibres by name.

    Raises
    ------
    InputError
        The file cannot be read, or is not as `fibre_bytes` makes it.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        names, muscle = [str(name) for name in arrays["muscles"]], arrays["muscle"]
        areas = _areas(arrays)
        rows = [arrays["places_mm"], arrays["directions"]]
        rows += [arrays["moved_mm"], arrays["carried"]] if "carried" in arrays else []
        of = arrays["area_muscle"]
        if len(of) != len(areas):
            raise ValueError("areas and muscles do not fit together")
    except (OSError, ValueError, TypeError, KeyError, EOFError, NotImplementedError, IndexError, MeshError) as error:
        raise InputError(f"{path}: holds no fibres ({error}); {_AGAIN}") from None
    except zipfile.BadZipFile as error:
        raise InputError(f"{path}: holds no fibres ({error}); {_AGAIN}") from None
    if muscle.ndim != 1 or any(
        row.shape != (len(muscle), 3) or row.dtype != np.float64 or not np.isfinite(row).all() for row in rows
    ):
        raise InputError(f"{path}: places and directions do not fit together; {_AGAIN}")
    found = {}
    for number, name in enumerate(names):
        own, held = muscle == number, tuple(area for area, k in zip(areas, of, strict=True) if k == number)
        parts = [row[own] for row in rows]
        found[name] = MuscleFibres(parts[0], parts[1], held, *parts[2:])
    return found


def _areas(arrays: Mapping[str, Any]) -> list[HeldArea]:
    vertices, corners = arrays["area_vertices_mm"], arrays["area_corners"]
    counts = zip(arrays["area_bone"], arrays["area_vertices"].tolist(), arrays["area_faces"].tolist(), strict=True)
    areas, v, f = [], 0, 0
    if min(arrays["area_vertices"].min(initial=0), arrays["area_faces"].min(initial=0)) < 0:
        raise ValueError("an area of less than no triangles")
    for bone, points, faces in counts:
        areas.append(HeldArea(str(bone), TriMesh(vertices[v : v + points], corners[f : f + faces])))
        v, f = v + points, f + faces
    if (v, f) != (len(vertices), len(corners)):
        raise ValueError("areas and their triangles do not fit together")
    return areas


def _together(parts: Sequence[Points]) -> Points:
    return np.concatenate(parts or [np.zeros((0, 3))])
