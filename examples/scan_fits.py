"""A template's skin fitted to scans of a heavier body: decimated, remeshed, noisy, with holes, turned; and by measures.

    MUSCLEFIT_DATA=... python examples/scan_fits.py
    MUSCLEFIT_DATA=... python examples/scan_fits.py --only "decimated" "without its head"

The scans are made of the template's skin (14,650 vertices, 68 litres) on a heavier body (100 litres, arms raised), by
the map of the rig `body_heavy`. Distances are those of the scan from the fitted skin. Takes 4 CPU minutes.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyvista as pv
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

import musclefit as mf
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.io.anatomy import read_surface
from musclefit.io.run_folder import ply_bytes

VOXEL_MM = 8.0


def heavier(skin: TriMesh, folder: Path) -> TriMesh:
    """The skin on the heavier body."""
    (folder / "heavier.toml").write_text(
        'title = "heavier"\n[anatomy]\nfiles = ["${MUSCLEFIT_DATA}/body/skin.ply"]\nunits = "mm"\n'
        '[drive]\nkind = "cage"\nsource = "${MUSCLEFIT_DATA}/body/skin_cage.ply"\ncrossings = "accept"\n'
        'target = "${MUSCLEFIT_DATA}/body/skin_cage_heavy.ply"\nunits = "mm"\n'
        '[deformer]\nkernel = "r"\nstep = "cayley"\n[compare]\nmethods = []\n[certificate]\nenabled = false\n'
        '[limits]\npurpose = "another-body"\n',
        encoding="utf-8",
    )
    done = mf.run(folder / "heavier.toml", pictures=False)
    return TriMesh(done.deformation(skin.vertices), skin.faces)


def decimated(mesh: TriMesh, vertices: int) -> TriMesh:
    """About so many vertices, by collapsed edges."""
    fewer = pv.make_tri_mesh(mesh.vertices, mesh.faces).decimate(1.0 - vertices / len(mesh.vertices))
    return TriMesh(np.asarray(fewer.points, dtype=np.float64), fewer.regular_faces.astype(np.int64))


def remeshed(mesh: TriMesh) -> TriMesh:
    """The surface of the voxels inside, smoothed by one voxel."""
    low, high = mesh.vertices.min(axis=0) - 4 * VOXEL_MM, mesh.vertices.max(axis=0) + 4 * VOXEL_MM
    axes = [np.arange(a, b, VOXEL_MM) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = (winding_numbers(mesh, grid.reshape(-1, 3)) > 0.5).reshape(grid.shape[:3]).astype(float)
    vertices, faces, _, _ = marching_cubes(gaussian_filter(inside, 1.0), 0.5)
    return TriMesh(low + VOXEL_MM * vertices, faces[:, ::-1].astype(np.int64))


def noisy(mesh: TriMesh, rms_mm: float) -> TriMesh:
    """Every vertex off by noise in each direction."""
    off = np.random.default_rng(1).normal(scale=rms_mm, size=mesh.vertices.shape)
    return TriMesh(mesh.vertices + off, mesh.faces)


def without(mesh: TriMesh, lost: np.ndarray) -> TriMesh:
    """Without some vertices (n,) and all triangles at them."""
    faces = mesh.faces[~lost[mesh.faces].any(axis=1)]
    used, numbers = np.unique(faces, return_inverse=True)
    return TriMesh(mesh.vertices[used], numbers.reshape(-1, 3))


def with_holes(mesh: TriMesh, count: int, width_mm: float) -> TriMesh:
    """Without what is near some of the vertices."""
    middles = mesh.vertices[np.random.default_rng(2).choice(len(mesh.vertices), count, replace=False)]
    near = np.linalg.norm(mesh.vertices[:, None] - middles, axis=2).min(axis=1) < 0.5 * width_mm
    return without(mesh, near)


def finer(mesh: TriMesh) -> TriMesh:
    """No edge longer than 8 mm."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=8.0)
    vertices, numbers = np.unique(vertices, axis=0, return_inverse=True)
    return TriMesh(vertices, numbers.reshape(-1)[faces])


def moved(mesh: TriMesh) -> TriMesh:
    """Turned by 155 degrees and moved by 2 m."""
    turn = Rotation.from_rotvec(np.radians(155.0) * np.array([0.2, 0.4, 0.9]) / np.linalg.norm([0.2, 0.4, 0.9]))
    return TriMesh(mesh.vertices @ turn.as_matrix().T + np.array([1500.0, -1300.0, 200.0]), mesh.faces)


def on_a_floor(mesh: TriMesh) -> TriMesh:
    """With a plate below its feet."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    plate = trimesh.creation.box(extents=[900.0, 500.0, 10.0]).subdivide().subdivide()
    below = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2] - 20.0])
    corners = np.asarray(plate.vertices) + below
    return TriMesh(np.vstack([mesh.vertices, corners]), np.vstack([mesh.faces, plate.faces + len(mesh.vertices)]))


def head(mesh: TriMesh) -> np.ndarray:
    """Vertices above the neck."""
    height: np.ndarray = mesh.vertices[:, 2]
    return np.asarray(height > height.max() - 0.14 * np.ptp(height))


SCANS: dict[str, Callable[[TriMesh], TriMesh]] = {
    "as it is": lambda mesh: mesh,
    "decimated": lambda mesh: decimated(mesh, 1000),
    "remeshed (8 mm voxels)": remeshed,
    "finer, noise of 2 mm": lambda mesh: noisy(finer(mesh), 2.0),
    "20 holes of 80 mm, noise of 1 mm": lambda mesh: noisy(with_holes(mesh, 20, 80.0), 1.0),
    "without its head": lambda mesh: without(mesh, head(mesh)),
    "turned by 155 degrees and moved by 2 m": moved,
    "inside out": lambda mesh: TriMesh(mesh.vertices, mesh.faces[:, ::-1]),
    "on a floor: fails": on_a_floor,
    "remeshed, 8 holes of 100 mm, noise of 1 mm, moved": lambda mesh: moved(
        noisy(with_holes(remeshed(mesh), 8, 100.0), 1.0)
    ),
}


def measured(skin: Path, mesh: TriMesh, folder: Path) -> None:
    """The template brought to the heavier body's stature and waist: how far what is reached is off."""
    stature = float(np.ptp(mesh.vertices[:, 2]))
    (folder / "measures.csv").write_text(
        f"name,kind,value,unit,height\nstature,stature,{stature!r},mm,\nwaist,girth,1000,mm,1050\n", encoding="utf-8"
    )
    began = time.process_time()
    found = mf.fit_measures(skin, folder / "measures.csv", folder / "measured")
    seconds = time.process_time() - began
    for one in found.measures():
        print(f"{one['name']}: {one['before']:.1f} mm, wanted {one['wanted']:.1f}, reached {one['reached']:.3f}")
    done = mf.run(folder / "measured" / "body.toml", tets=False, pictures=False)
    print(f"by measures: map {done.report.result.map.claim.value}; {seconds:.0f} CPU s for the fit")


def short(value: float) -> str:
    """Two digits that count, without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def main() -> None:
    """Fit the skin to each scan, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[*SCANS, "measures"], metavar="SCAN")
    chosen = parser.parse_args().only or [*SCANS, "measures"]
    template = Path(os.environ["MUSCLEFIT_DATA"]) / "body" / "skin.ply"
    skin = read_surface(template).mesh()
    columns = ("scan", "vertices", "median, mm", "95 % within", "largest", "scan without skin", "skin without scan")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        body = heavier(skin, folder)
        print(f"| {' | '.join((*columns, 'verdict', 'CPU s'))} |\n|{9 * '---|'}")
        for name in (name for name in chosen if name in SCANS):
            scan = SCANS[name](body)
            (folder / "scan.ply").write_bytes(ply_bytes(scan))
            began = time.process_time()
            found = mf.fit_body(template, folder / "scan.ply")
            far, fit, verdict = found.fit.from_scan, found.fit, "passed" if found.passed else "failed"
            print(
                f"| {name} | {len(scan.vertices):,} | {short(far.median_mm)} | {short(far.most_95_mm)} | "
                f"{short(far.max_mm)} | {short(100 * fit.unmatched)} % | {short(100 * fit.uncovered)} % | {verdict} | "
                f"{time.process_time() - began:.0f} |",
                flush=True,
            )
        if "measures" in chosen:
            measured(template, body, folder)


if __name__ == "__main__":
    main()
