"""Fig. 6 of Yu et al. 2014: child to adult and adult to child white matter by 40 pairs of landmarks.

    MUSCLEFIT_DATA=... python examples/fig6_child_adult.py --out musclefit-out/fig6

Each direction is run all the way, and both to the middle of every pair: with F from the child and B from the adult to
the middle, child to adult is B^-1 after F and adult to child is F^-1 after B, which undo each other exactly.
Certificates are on the adult's closed surface, and on the box around the child's, which is not closed; through the
middle, both halves are certified.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from igl import point_mesh_squared_distance
from numpy.typing import NDArray

from musclefit.certify.maps import certify_map
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.protocol import Backend
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import row_norm_fractions
from musclefit.flow.steppers import HandleStepper, explicit_step
from musclefit.geometry.arrays import Points
from musclefit.geometry.images.grids import Frame, Grid
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.formats.nifti import read_volume, write_volume
from musclefit.pipeline.images import jacobian_map
from musclefit.rig.handles import StraightPath
from musclefit.vocabulary import StepKind

BACKENDS: dict[str, Backend] = {"RBF r^2 log r": RadialBackend("r2logr"), "FFD 20 mm": FfdBackend(20.0)}


Image: TypeAlias = NDArray[np.float32]
Map: TypeAlias = Callable[[Points], Points]


@dataclass(frozen=True)
class Brains:
    """Both surfaces and their landmarks, mm, RAS+ (MNI space)."""

    child: TriMesh
    adult: TriMesh
    child_landmarks: Points
    adult_landmarks: Points


@dataclass(frozen=True)
class Row:
    """One direction's line of the table."""

    what: str
    steps: int
    certificate: str
    margin: float
    landmark_error_mm: float
    round_trip_mm: float
    determinants: tuple[float, float]
    before_mm: float
    after_mm: float


def read(data: Path) -> Brains:
    """The brains of the data folder."""
    folder = data / "brain"
    with (folder / "landmarks_40.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    ends = [
        np.array([[float(row[f"{who}_{axis}_mm"]) for axis in "xyz"] for row in rows]) for who in ("child", "adult")
    ]
    surfaces = [read_surface(folder / f"{who}_white_matter.ply").mesh() for who in ("child", "adult")]
    return Brains(surfaces[0], surfaces[1], ends[0], ends[1])


def marched(source: Points, target: Points, surface: TriMesh, backend: Backend) -> Deformation:
    """The paper's loop on straight paths, tested at every vertex."""
    stepper = HandleStepper(StraightPath(source, target), backend, explicit_step)
    tested = np.concatenate([surface.vertices, source])
    return march(stepper, rule=row_norm_fractions, tested=tested, pace=Pace(200)).require()


def certified(deformation: Deformation, body: TriMesh | Points) -> tuple[str, float]:
    """Claim and margin of a map on a body."""
    proof = certify_map([(StepKind.EXPLICIT, step.field) for step in deformation.steps], body)
    return proof.claim.value, proof.margin


def in_turn(first: Map, second: Map) -> Map:
    """One map after another."""
    return lambda points: second(first(points))


def distance(a: Points, b: TriMesh) -> float:
    """Mean distance of points from a surface, mm."""
    return float(np.sqrt(point_mesh_squared_distance(np.array(a), np.array(b.vertices), np.array(b.faces))[0]).mean())


def between(a: TriMesh, b: TriMesh) -> float:
    """Mean distance of two surfaces, both ways, mm."""
    return 0.5 * (distance(a.vertices, b) + distance(b.vertices, a))


def judge(
    what: str,
    there: Map,
    back: Map,
    *,
    ends: tuple[TriMesh, TriMesh, Points, Points],
    steps: int,
    proofs: list[tuple[str, float]],
    determinants: Points,
) -> Row:
    """Measure one map from the first surface to the second."""
    source, target, source_landmarks, target_landmarks = ends
    moved = there(source.vertices)
    claims = {claim for claim, _ in proofs}
    return Row(
        what=what,
        steps=steps,
        certificate=claims.pop() if len(claims) == 1 else " / ".join(claim for claim, _ in proofs),
        margin=min(margin for _, margin in proofs),
        landmark_error_mm=float(np.abs(there(source_landmarks) - target_landmarks).max()),
        round_trip_mm=float(np.abs(back(moved) - source.vertices).max()),
        determinants=(float(determinants.min()), float(determinants.max())),
        before_mm=between(source, target),
        after_mm=between(source.with_vertices(moved), target),
    )


def compare(brains: Brains, backend: Backend) -> tuple[list[Row], dict[str, Deformation], float]:
    """All maps of one backend; and how far apart the two directions all the way are, mm."""
    child, adult = brains.child, brains.adult
    boxes: dict[str, TriMesh | Points] = {
        "child": np.stack([child.vertices.min(axis=0), child.vertices.max(axis=0)]),
        "adult": adult,
    }
    ends = {
        "child to adult": (child, adult, brains.child_landmarks, brains.adult_landmarks),
        "adult to child": (adult, child, brains.adult_landmarks, brains.child_landmarks),
    }
    maps, rows, halves = {}, [], {}
    for what, end in ends.items():
        who = what.split()[0]
        maps[what] = marched(end[2], end[3], end[0], backend)
        rows.append(
            judge(
                f"{what}, all the way",
                maps[what],
                maps[what].inverse(),
                ends=end,
                steps=len(maps[what].steps),
                proofs=[certified(maps[what], boxes[who])],
                determinants=np.linalg.det(maps[what].jacobian(end[0].vertices)),
            )
        )
        halves[who] = marched(end[2], 0.5 * (end[2] + end[3]), end[0], backend)
    proofs = [certified(halves[who], boxes[who]) for who in halves]
    for what, end in ends.items():
        first, last = (
            (halves["child"], halves["adult"]) if what.startswith("child") else (halves["adult"], halves["child"])
        )
        middle = first(end[0].vertices)
        inner = np.linalg.det(first.jacobian(end[0].vertices)) * np.linalg.det(last.inverse().jacobian(middle))
        rows.append(
            judge(
                f"{what}, through the middle",
                in_turn(first, last.inverse()),
                in_turn(last, first.inverse()),
                ends=end,
                steps=len(first.steps) + len(last.steps),
                proofs=proofs,
                determinants=inner,
            )
        )
    maps |= {f"{who} to the middle": half for who, half in halves.items()}
    apart = maps["adult to child"](maps["child to adult"](child.vertices)) - child.vertices
    return rows, maps, float(np.linalg.norm(apart, axis=1).mean())


def draw(brains: Brains, maps: dict[str, Deformation], file: Path) -> None:
    """Both brains at rest, where they meet, and carried to the other, coloured by the Jacobian determinant."""
    import pyvista as pv

    middle = 0.5 * (brains.child_landmarks + brains.adult_landmarks)
    ends = {"child": brains.child_landmarks, "adult": brains.adult_landmarks, "the middle": middle}
    plotter = pv.Plotter(off_screen=True, shape=(2, 3), window_size=(2000, 1250), border=False)
    plotter.set_background("white")
    for row, (who, other, surface) in enumerate((("child", "adult", brains.child), ("adult", "child", brains.adult))):
        for column, where in enumerate((who, "the middle", other)):
            plotter.subplot(row, column)
            deformation = None if where == who else maps[f"{who} to {where}"]
            vertices = surface.vertices if deformation is None else deformation(surface.vertices)
            mesh = pv.PolyData.from_regular_faces(np.array(vertices), np.array(surface.faces))
            if deformation is None:
                plotter.add_mesh(mesh, color="#e9e2d5", smooth_shading=True)
            else:
                mesh["det J"] = np.linalg.det(deformation.jacobian(surface.vertices))
                plotter.add_mesh(
                    mesh,
                    scalars="det J",
                    clim=(0.0, 2.0),
                    cmap="PuOr_r",
                    below_color="magenta",
                    smooth_shading=True,
                    show_scalar_bar=(row, column) == (1, 2),
                )
            plotter.add_points(ends[where], color="red", point_size=10, render_points_as_spheres=True)
            plotter.add_text(who if where == who else f"{who} to {where}: det J", font_size=11, color="black")
            plotter.camera.focal_point = (0.0, -15.0, 10.0)
            plotter.camera.position = (-330.0, 90.0, 190.0)
            plotter.camera.up = (0.0, 0.0, 1.0)
            plotter.camera.view_angle = 26.0
    plotter.screenshot(file)
    plotter.close()


def around(surface: TriMesh, *, spacing_mm: float) -> Grid:
    """An image grid, RAS+, around a surface."""
    low, high = surface.vertices.min(axis=0) - 5.0, surface.vertices.max(axis=0) + 5.0
    counts = np.ceil((high - low) / spacing_mm).astype(int) + 1
    affine = np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0])
    affine[:3, 3] = low
    return Grid((int(counts[0]), int(counts[1]), int(counts[2])), affine)


def draw_slices(determinants: Mapping[str, tuple[Image, Grid, TriMesh]], file: Path) -> None:
    """An axial slice through each Jacobian map, with the outline of the brain that the map is defined on."""
    import pyvista as pv

    plotter = pv.Plotter(off_screen=True, shape=(1, len(determinants)), window_size=(1400, 800), border=False)
    plotter.set_background("white")
    for column, (title, (values, grid, surface)) in enumerate(determinants.items()):
        plotter.subplot(0, column)
        image = pv.ImageData(dimensions=grid.shape)
        image["det J"] = values.ravel(order="F")
        height = float(np.median(surface.vertices[:, 2]))
        layer = (
            image.cast_to_structured_grid().transform(grid.affine, inplace=False).slice("z", origin=(0.0, 0.0, height))
        )
        mesh = pv.PolyData.from_regular_faces(np.array(surface.vertices), np.array(surface.faces))
        plotter.add_mesh(
            layer,
            scalars="det J",
            clim=(0.0, 2.0),
            cmap="PuOr_r",
            below_color="magenta",
            lighting=False,
            show_scalar_bar=column == 0,
            scalar_bar_args={"position_x": 0.25, "position_y": 0.05, "width": 0.5, "height": 0.07},
        )
        plotter.add_mesh(mesh.slice("z", origin=(0.0, 0.0, height)).translate((0, 0, 0.5)), color="black", line_width=2)
        plotter.add_text(f"{title}: det J at z = {height:.0f} mm", font_size=11, color="black")
        plotter.view_xy()
        plotter.enable_parallel_projection()
        plotter.camera.zoom(1.15)
    plotter.screenshot(file)
    plotter.close()


def main() -> None:
    """Print the tables, write the Jacobian maps of both directions, and draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("musclefit-out/fig6"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ.get("MUSCLEFIT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    brains = read(data)
    for name, backend in BACKENDS.items():
        rows, maps, apart = compare(brains, backend)
        print(f"\n{name}")
        print(
            "| map | steps | certificate | margin | handles, mm | round trip, mm | det J | distance before, after, mm |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for row in rows:
            print(
                f"| {row.what} | {row.steps} | {row.certificate} | {row.margin:.2f} | {row.landmark_error_mm:.1e} | "
                f"{row.round_trip_mm:.1e} | {row.determinants[0]:.2f} to {row.determinants[1]:.2f} | "
                f"{row.before_mm:.2f}, {row.after_mm:.2f} |"
            )
        print(f"the two directions all the way, one after the other: {apart:.2f} mm from the identity on average")
    grids = {
        "child to adult": (read_volume(data / "brain" / "child_T1_2mm.nii.gz").grid, brains.child),
        "adult to child": (around(brains.adult, spacing_mm=2.0), brains.adult),
    }
    found = {}
    for what, (grid, surface) in grids.items():
        determinants = jacobian_map(maps[what], grid, frame=Frame.RAS)
        file = out / f"jacobian_{what.replace(' ', '_')}.nii.gz"
        write_volume(file, determinants, grid, description=f"det J, {what}")
        print(f"det J, {what}, over {grid.count} voxels: {determinants.min():.2f} to {determinants.max():.2f}; {file}")
        found[what] = (determinants, grid, surface)
    draw(brains, maps, out / "fig6_child_adult.png")
    draw_slices(found, out / "fig6_jacobian_maps.png")
    print(f"wrote {out / 'fig6_child_adult.png'} and {out / 'fig6_jacobian_maps.png'}")


if __name__ == "__main__":
    main()
