"""The meshes of an OpenSim model: found beside it, scaled and placed as the default pose has them, mm."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from musclefit.anatomy.cleaning import take_in
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.osim import OpenSimModel
from musclefit.vocabulary import Unit

BETWEEN = "__"
"""Between the body and the mesh in a surface's name."""


@dataclass(frozen=True, eq=False, slots=True)
class PlacedMesh:
    """A mesh in the ground's frame, default pose, mm; ``fault`` says why it is not closed, "" where it is."""

    name: str
    body: str
    file: Path
    mesh: TriMesh
    fault: str


def find_geometry(model: OpenSimModel, folders: Sequence[Path]) -> tuple[list[Path | None], list[str]]:
    """The file of each mesh, None where it is nowhere, and the names of those.

    Looked for are the path itself, then the model's folder, its ``Geometry`` and the given folders, as OpenSim does.
    """
    home = Path(model.source).absolute().parent
    places = [home, home / "Geometry", *folders]
    found: list[Path | None] = []
    missing = []
    for mesh in model.meshes:
        written = Path(mesh.file.replace("\\", "/"))
        tried = [written] if written.is_absolute() else [place / written for place in places]
        path = next((path for path in tried if os.path.isfile(path)), None)  # noqa: PTH113 - false for overlong names, too
        found.append(path)
        if path is None:
            missing.append(mesh.file)
    return found, list(dict.fromkeys(missing))


def placed_meshes(model: OpenSimModel, files: Sequence[Path | None]) -> tuple[PlacedMesh, ...]:
    """Every mesh that was found.

    Raises
    ------
    InputError, MeshError
        A file that cannot be read whole, or of a format that is not read.
    """
    places = model.multibody.places({})
    made = []
    names: dict[str, int] = {}
    for mesh, path in zip(model.meshes, files, strict=True):
        if path is None:
            continue
        raw = read_surface(path, units=Unit.METRE)
        if not len(raw.faces):
            raise MeshError(f"{path}: holds no triangles; remove it from the model, or export it again")
        factors = np.asarray(mesh.factors)
        if not factors.all():
            raise InputError(f"{model.source}: {mesh.file} has scale factors {factors.tolist()}; none may be 0")
        vertices = places[mesh.body](mesh.place(raw.vertices * factors))
        faces = raw.faces if factors.prod() > 0.0 else raw.faces[:, ::-1]
        name = f"{mesh.body}{BETWEEN}{path.stem}"
        names[name] = names.get(name, 0) + 1
        if names[name] > 1:
            name = f"{name}_{names[name]}"
        surface, fault = TriMesh(vertices, faces), ""
        try:
            surface = take_in(name, TissueKind.BONE, vertices=vertices, faces=faces, source=str(path))[0].surface
        except MeshError as error:
            fault = str(error)
        made.append(PlacedMesh(name, mesh.body, path, surface, fault))
    return tuple(made)
