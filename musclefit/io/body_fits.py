"""The folder of a body fitted to a scan or to measures: cages, surfaces, a rig, and a report; decides nothing."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.similarity import Similarity
from musclefit.io.formats.tables import toml_string
from musclefit.io.run_folder import ply_bytes, write_new_folder
from musclefit.pipeline.fit_body import KERNEL, BodyFit
from musclefit.pipeline.fit_measures import MeasureFit
from musclefit.scratch import scratch_folder

REPORT, RIG, CAGE, TARGET, SKIN, SCAN = (
    "fit.json",
    "body.toml",
    "cage.ply",
    "cage_target.ply",
    "skin_fitted.vtp",
    "scan.vtp",
)


def write_body_fit(
    folder: Path, fit: BodyFit, *, title: str, anatomy: Sequence[str], frame: str, report: dict[str, Any]
) -> None:
    """Write a fit into a new or empty folder, whole or not at all.

    ``cage.ply`` and ``cage_target.ply`` drive ``body.toml``; ``skin_fitted.vtp`` and ``scan.vtp``, both in the
    template's frame, carry ``distance_mm`` from each other at their points.
    """
    skin = _with_data(fit.skin, {"distance_mm": fit.skin_distances, "covered": fit.skin_covered.astype(np.float64)})
    files = {
        CAGE: ply_bytes(fit.cage),
        TARGET: ply_bytes(fit.cage.with_vertices(fit.target)),
        SKIN: skin,
        SCAN: _with_data(fit.scan, {"distance_mm": fit.scan_distances}),
        RIG: _rig(title, anatomy, frame, crossings=fit.crossings).encode(),
        REPORT: (json.dumps(report, indent=2) + "\n").encode(),
    }
    write_new_folder(folder, files)


def write_measure_fit(
    folder: Path, fit: MeasureFit, *, title: str, anatomy: Sequence[str], frame: str, report: dict[str, Any]
) -> None:
    """Write a template with other measures into a new or empty folder, whole or not at all.

    ``cage.ply`` and ``cage_target.ply`` drive ``body.toml``; ``skin_fitted.vtp`` carries ``displacement_mm``.
    """
    files = {
        CAGE: ply_bytes(fit.cage),
        TARGET: ply_bytes(fit.cage.with_vertices(fit.target)),
        SKIN: _with_data(fit.skin, {"displacement_mm": fit.skin.vertices - fit.rest.vertices}),
        RIG: _rig(title, anatomy, frame, crossings=fit.crossings).encode(),
        REPORT: (json.dumps(report, indent=2) + "\n").encode(),
    }
    write_new_folder(folder, files)


def matrix_of(motion: Similarity) -> list[list[float]]:
    """The motion as a 4x4 matrix, row by row."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.linear, motion.translation
    rows: list[list[float]] = matrix.tolist()
    return rows


def _with_data(mesh: TriMesh, data: dict[str, Float]) -> bytes:
    """A VTP file of the mesh with numbers at its points."""
    import pyvista as pv

    surface = pv.PolyData.from_regular_faces(np.array(mesh.vertices), np.array(mesh.faces))
    for name, values in data.items():
        surface.point_data[name] = np.array(values, dtype=np.float64)
    with scratch_folder("musclefit-surface-") as home:
        path = home / "surface.vtp"
        surface.save(path, binary=True)
        return path.read_bytes()


def _rig(title: str, anatomy: Sequence[str], frame: str, *, crossings: int) -> str:
    files = ",\n".join(f"  {toml_string(os.fspath(path))}" for path in anatomy)
    accepted = (
        f'crossings = "accept"    # {crossings} pairs of triangles of the target cross: look at them first\n'
        if crossings
        else ""
    )
    stated = f"frame = {toml_string(frame)}\n" if frame else ""
    return (
        f'title = {toml_string(title)}\n\n[anatomy]\nfiles = [\n{files},\n]\nunits = "mm"\n{stated}\n'
        f'[drive]\nkind = "cage"\nsource = "{CAGE}"\ntarget = "{TARGET}"\nunits = "mm"\n{accepted}\n'
        f'[deformer]\nkernel = "{KERNEL}"\nstep = "cayley"\n\n[limits]\npurpose = "another-body"\n'
    )
