"""Fig. 5 of Yu et al. 2014: a large deformation of a gyrus of segmented white matter, one-shot and iterative.

    python examples/fig5_gyrus.py --out musclefit-out/fig5

The anatomy is nilearn's MNI white matter at 1 mm (extra ``examples``). The crown of a gyrus of the left hemisphere is
pulled 22 mm forwards and up by 8 landmarks while 20 landmarks around it stay. The same 28 landmarks drive a lattice of
350 control points in one shot (least-norm B-splines), the iterative FFD and the iterative RBF. Counted are folded
voxels (Jacobian determinant not positive) in the box around the gyrus, and pairs of triangles of the white
matter's isosurface that cross.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from skimage.measure import marching_cubes

from musclefit.certify.maps import certify_map
from musclefit.fields.ffd import Lattice
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.radial import RadialBackend
from musclefit.flow.control_lattice import march_lattice
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import row_norm_fractions
from musclefit.flow.steppers import HandleStepper, explicit_step
from musclefit.flow.steps import ExplicitStep
from musclefit.geometry.arrays import Points
from musclefit.geometry.images.grids import Grid
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.rig.handles import StraightPath
from musclefit.rig.spread import spread_over
from musclefit.vocabulary import StepKind

PULL_MM = 22.0 * np.array([0.0, 1.0, 0.3]) / np.linalg.norm([0.0, 1.0, 0.3])
CONTROL_POINTS = (7, 10, 5)


@dataclass(frozen=True)
class Gyrus:
    """The isosurface and the voxel centres of a box around a gyrus, and the landmarks that move it; mm, RAS+."""

    surface: TriMesh
    voxels: Points
    low: Points
    high: Points
    landmarks: Points
    targets: Points


@dataclass(frozen=True)
class Row:
    """One method's line of the table."""

    method: str
    status: str
    steps: int
    folded_voxels: int
    min_determinant: float
    crossing_pairs: int
    landmark_error_mm: float
    certificate: str
    deformation: Deformation


def gyrus() -> Gyrus:
    """The gyrus whose crown is farthest to the upper left."""
    from nilearn.datasets import load_mni152_wm_template

    template = load_mni152_wm_template(resolution=1)
    values = np.asarray(template.dataobj, dtype=np.float32)
    grid = Grid(values.shape, template.affine)
    vertices, faces, _, _ = marching_cubes(values, 0.5)
    vertices = grid.positions(vertices.astype(np.float64))
    crown = vertices[np.argmax(vertices @ [-0.55, 0.1, 0.83])]
    low, high = crown - [30.0, 45.0, 32.0], crown + np.array([30.0, 45.0, 14.0])
    voxels = grid.positions(grid.voxels(0, grid.count))
    inside = ((vertices > low) & (vertices < high)).all(axis=1)
    kept = faces[inside[faces].all(axis=1)]
    used, renumbered = np.unique(kept, return_inverse=True)
    surface = TriMesh(vertices[used], renumbered.reshape(-1, 3))
    distance = np.linalg.norm(surface.vertices - crown, axis=1)
    top, around = surface.vertices[distance < 8.0], surface.vertices[(distance > 16.0) & (distance < 34.0)]
    pulled, still = top[spread_over(top, 8)], around[spread_over(around, 20)]
    return Gyrus(
        surface,
        voxels[((voxels > low) & (voxels < high)).all(axis=1)],
        low,
        high,
        np.concatenate([pulled, still]),
        np.concatenate([pulled + PULL_MM, still]),
    )


def control_displacements(lattice: Lattice, at: Points, displacements: Points) -> Points:
    """Displacements of least norm of the control points, mm, for which a one-shot FFD meets its landmarks."""
    unit = np.eye(int(np.prod(lattice.shape)))
    weights = [lattice.field(np.pad(one[:, None], ((0, 0), (0, 2)))).displacement(at)[:, 0] for one in unit]
    return np.asarray(np.linalg.lstsq(np.stack(weights, axis=1), displacements, rcond=None)[0], dtype=np.float64)


def measure(method: str, deformation: Deformation, scene: Gyrus) -> Row:
    """Folds, crossings and landmark errors of one deformation, and the certificate of the iterative ones."""
    determinants = np.linalg.det(deformation.jacobian(scene.voxels))
    moved = scene.surface.with_vertices(deformation(scene.surface.vertices))
    certificate = certify_map(
        [(StepKind.EXPLICIT, step.field) for step in deformation.steps], np.stack([scene.low, scene.high])
    )
    return Row(
        method=method,
        status=deformation.status.name.lower(),
        steps=len(deformation.steps),
        folded_voxels=int((~(determinants > 0.0)).sum()),
        min_determinant=float(determinants.min()),
        crossing_pairs=len(self_crossings(moved)),
        landmark_error_mm=float(np.abs(deformation(scene.landmarks) - scene.targets).max()),
        certificate=certificate.claim.value,
        deformation=deformation,
    )


def compare(scene: Gyrus) -> tuple[list[Row], str]:
    """All methods on the same landmarks; and how far the paper's own loop over the 350 control points gets."""
    path = StraightPath(scene.landmarks, scene.targets)
    lattice = Lattice.around(scene.low, scene.high, shape=CONTROL_POINTS)
    controls = control_displacements(lattice, path.source, path.target - path.source)
    tested = np.concatenate([scene.voxels[::5], scene.surface.vertices, scene.landmarks])
    shot = Deformation((ExplicitStep(lattice.field(controls)),), (), Status.ONE_SHOT)
    rows = [measure("FFD, 350 control points, one shot", shot, scene)]
    for method, backend in (
        ("FFD, 28 landmarks, iterative", FfdBackend(10.0)),
        ("RBF r^2 log r, 28 landmarks, iterative", RadialBackend("r2logr")),
    ):
        stepper = HandleStepper(path, backend, explicit_step)
        rows.append(measure(method, march(stepper, rule=row_norm_fractions, tested=tested, pace=Pace(200)), scene))
    loop = march_lattice(lattice, controls, tested=scene.voxels, max_steps=200)
    said = (
        f"{loop.status.name.lower()} at {100.0 * loop.records[-1].end:.0f} % of the way after {len(loop.records)} steps"
    )
    return rows, said


def draw(rows: list[Row], scene: Gyrus, file: Path) -> None:
    """The gyrus at rest and after every method; folded places are magenta."""
    import pyvista as pv

    plotter = pv.Plotter(
        off_screen=True, shape=(1, 1 + len(rows)), window_size=(640 * (1 + len(rows)), 720), border=False
    )
    plotter.set_background("white")
    for column, row in enumerate([None, *rows]):
        plotter.subplot(0, column)
        vertices = scene.surface.vertices if row is None else row.deformation(scene.surface.vertices)
        mesh = pv.PolyData.from_regular_faces(np.array(vertices), np.array(scene.surface.faces))
        if row is None:
            plotter.add_mesh(mesh, color="#e9e2d5", smooth_shading=True)
            title = "rest, 28 landmarks"
        else:
            mesh["det J"] = np.linalg.det(row.deformation.jacobian(scene.surface.vertices))
            plotter.add_mesh(
                mesh,
                scalars="det J",
                clim=(0.0, 2.0),
                cmap="PuOr_r",
                below_color="magenta",
                smooth_shading=True,
                show_scalar_bar=column == len(rows),
            )
            title = f"{row.method}\n{row.folded_voxels} folded voxels, {row.crossing_pairs} crossing pairs"
        ends = scene.landmarks if row is None else scene.targets
        plotter.add_points(ends[:8], color="red", point_size=12, render_points_as_spheres=True)
        plotter.add_points(ends[8:], color="black", point_size=9, render_points_as_spheres=True)
        plotter.add_text(title, font_size=10, color="black")
        middle = 0.5 * (scene.low + scene.high)
        plotter.camera.focal_point = middle
        plotter.camera.position = middle + 190.0 * np.array([-0.62, 0.25, 0.74])
        plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.screenshot(file)
    plotter.close()


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("musclefit-out/fig5"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    scene = gyrus()
    print(f"{len(scene.voxels)} voxels, {len(scene.surface.faces)} triangles, pull {np.linalg.norm(PULL_MM):.0f} mm")
    rows, loop = compare(scene)
    print("| method | ended | steps | folded voxels | min det J | crossing pairs | landmarks, mm | map |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row.method} | {row.status} | {row.steps} | {row.folded_voxels} | {row.min_determinant:.3g} | "
            f"{row.crossing_pairs} | {row.landmark_error_mm:.1e} | {row.certificate} |"
        )
    print(f"the paper's loop over the 350 control points themselves: {loop}")
    draw(rows, scene, out / "fig5_gyrus.png")
    print(f"wrote {out / 'fig5_gyrus.png'}")


if __name__ == "__main__":
    main()
