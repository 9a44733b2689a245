"""Fig. 4 of Yu et al. 2014: a bar bent by 150 degrees in one call, and twisted by 360 degrees before it is bent.

    python examples/fig4_bar.py --out musclefit-out/fig4

The bar is 8 x 8 x 48 mm, of cubes of 1 mm cut into six tetrahedra each. Five landmarks on its axis carry a ring of
eight derived landmarks each (skeleton handles) and follow a path of bent curves. Compared are one step straight to the
destination, the paper's loop (explicit steps along straight lines, r^2 log r), the same explicit steps along the
skeleton's path, and implicit midpoint (Cayley) steps with scalar and with isochoric kernels. The vertices are mapped; a
tetrahedron is inverted when the exact orientation of its mapped corners is wrong. The last column says whether the
continuous map is proved to be one-to-one inside the bar; that is another claim than the mesh's.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from musclefit.certify.maps import certify_map
from musclefit.errors import FieldError
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import Pace, march, one_shot
from musclefit.flow.rules import cayley_fractions, row_norm_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step, explicit_step
from musclefit.geometry.arrays import Float, Points, Tets
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.rig.handles import Path, StraightPath
from musclefit.rig.skeleton import Skeleton, SkeletonPath, SkeletonPose, ring
from musclefit.vocabulary import StepKind

STATIONS = 5
RADIUS_MM = 4.0
BEND_DEG, TWIST_DEG = 150.0, 360.0
TWIST_SHARE = 2.0 / 3.0
"""Of the path of the second case: the twist, before the bend."""


@dataclass(frozen=True)
class Method:
    """A row of the table: a field, a kind of step, and the path (straight or along the skeleton) it follows."""

    name: str
    kernel: str
    kind: StepKind
    straight: bool = False
    steps: int = 0


METHODS = (
    Method("one shot, r^2 log r", "r2logr", StepKind.EXPLICIT, straight=True),
    Method("one shot, isochoric r^5", "isochoric-r5", StepKind.EXPLICIT, straight=True),
    Method("the paper's loop, r^2 log r, straight lines", "r2logr", StepKind.EXPLICIT, straight=True, steps=1),
    Method("explicit steps, r^2 log r, along the skeleton", "r2logr", StepKind.EXPLICIT, steps=1),
    Method("Cayley steps, r^3", "r3", StepKind.CAYLEY, steps=6),
    Method("Cayley steps, isochoric r^3", "isochoric-r3", StepKind.CAYLEY, steps=6),
    Method("Cayley steps, isochoric r^5", "isochoric-r5", StepKind.CAYLEY, steps=6),
)
"""``steps`` is the least number of stretches; 0 stands for one shot."""


@dataclass(frozen=True)
class Row:
    """What one method made of the bar."""

    method: str
    ended: str
    steps: int
    inverted: int
    min_ratio: float
    max_ratio: float
    volume_percent: float
    handle_error_mm: float
    claim: str
    moved: Points
    ratios: Float


def bar(cubes: tuple[int, int, int], *, edge_mm: float) -> TetMesh:
    """A bar along z from the origin, centred on its axis; each cube is cut into six tets along the same diagonal."""
    axes = [edge_mm * np.arange(n + 1) for n in cubes]
    vertices = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    vertices[:, :2] -= 0.5 * edge_mm * np.array(cubes[:2])
    number = np.arange(len(vertices)).reshape([n + 1 for n in cubes])
    tets = []
    for order in itertools.permutations(range(3)):
        corners = np.cumsum([np.zeros(3, dtype=int), *np.eye(3, dtype=int)[list(order)]], axis=0)
        corner_of = [number[tuple(slice(o, o + n) for o, n in zip(c, cubes, strict=True))].ravel() for c in corners]
        even = np.linalg.det(np.eye(3)[list(order)]) > 0
        tets.append(np.stack(corner_of if even else [corner_of[k] for k in (0, 1, 3, 2)], axis=1))
    return TetMesh(vertices, np.concatenate(tets))


def surface_of(mesh: TetMesh) -> TriMesh:
    """The boundary of a tet mesh, without the vertices inside."""
    a, b, c, d = mesh.tets.T
    faces = np.concatenate([np.stack(f, axis=1) for f in ((a, c, b), (a, b, d), (a, d, c), (b, c, d))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    used, renumbered = np.unique(faces[first[count == 1]], return_inverse=True)
    return TriMesh(mesh.vertices[used], renumbered.reshape(-1, 3))


def bent_axis(length_mm: float, angle_deg: float, *, stations: int) -> Points:
    """Stations on the axis of a bar that is bent towards x to a circular arc; 0 degrees is straight along z."""
    along = np.linspace(0.0, length_mm, stations)
    if angle_deg == 0.0:
        return np.stack([0.0 * along, 0.0 * along, along], axis=1)
    curvature = np.deg2rad(angle_deg) / length_mm
    turned = curvature * along
    bent: Points = np.stack([1.0 - np.cos(turned), 0.0 * turned, np.sin(turned)], axis=1) / curvature
    return bent


def skeleton_paths(length_mm: float) -> dict[str, SkeletonPath]:
    """Both cases: the bend, and the twist that the bend follows."""
    straight, bent = (bent_axis(length_mm, angle, stations=STATIONS) for angle in (0.0, BEND_DEG))
    skeleton = Skeleton(straight, np.array([1.0, 0.0, 0.0]), ring(8, radius_mm=RADIUS_MM))
    none, twist = np.zeros(STATIONS), np.linspace(0.0, TWIST_DEG, STATIONS)
    return {
        "bend 150": SkeletonPath(skeleton, (SkeletonPose(1.0, bent, none),)),
        "twist 360, bend 150": SkeletonPath(
            skeleton, (SkeletonPose(TWIST_SHARE, straight, twist), SkeletonPose(1.0, bent, twist))
        ),
    }


def deform(method: Method, path: Path, tested: Points) -> Deformation:
    """The deformation of one method along one path."""
    followed = StraightPath(path.position(0.0), path.position(1.0)) if method.straight else path
    backend = RadialBackend(method.kernel)
    if method.steps == 0:
        return one_shot(followed, backend, rule=row_norm_fractions, tested=tested)
    implicit = method.kind is StepKind.CAYLEY
    stepper = HandleStepper(followed, backend, cayley_step if implicit else explicit_step)
    rule = cayley_fractions if implicit else row_norm_fractions
    return march(stepper, rule=rule, tested=tested, pace=Pace(200, method.steps))


def inverted_tets(vertices: Points, tets: Tets) -> int:
    """How many tets do not have positive volume, by exact predicates."""
    import igl.predicates

    a, b, c, d = (np.asfortranarray(vertices[tets[:, k]]) for k in range(4))
    return int((igl.predicates.orient3d(a, b, c, d) >= 0).sum())


def measure(method: Method, path: SkeletonPath, mesh: TetMesh) -> Row | None:
    """Deform and judge; nothing where handles meet on their way."""
    try:
        deformation = deform(method, path, mesh.vertices)
    except FieldError:
        return None
    moved = deformation(mesh.vertices)
    rest = signed_volumes(mesh.vertices, mesh.tets)
    ratios = signed_volumes(moved, mesh.tets) / rest
    certificate = certify_map([(method.kind, step.field) for step in deformation.steps], surface_of(mesh))
    return Row(
        method=method.name,
        ended=deformation.status.name.lower().replace("_", " "),
        steps=len(deformation.steps),
        inverted=inverted_tets(moved, mesh.tets),
        min_ratio=float(ratios.min()),
        max_ratio=float(ratios.max()),
        volume_percent=100.0 * (float((ratios * rest).sum() / rest.sum()) - 1.0),
        handle_error_mm=float(np.linalg.norm(deformation(path.position(0.0)) - path.position(1.0), axis=1).max()),
        claim=certificate.claim.value,
        moved=moved,
        ratios=ratios,
    )


def table(rows: list[Row | None]) -> list[str]:
    """One line for each method."""
    lines = [
        "| method | ended | steps | inverted tets | tet volume ratio, min | max | volume, % | handles off, mm | map |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for method, row in zip(METHODS, rows, strict=True):
        if row is None:
            lines.append(f"| {method.name} | handles meet on their way | - | - | - | - | - | - | - |")
            continue
        lines.append(
            f"| {row.method} | {row.ended} | {row.steps} | {row.inverted} | {row.min_ratio:.3f} | "
            f"{row.max_ratio:.3f} | {row.volume_percent:+.2f} | {row.handle_error_mm:.0e} | {row.claim} |"
        )
    return lines


def draw(rows: list[Row | None], path: SkeletonPath, mesh: TetMesh, file: FilePath) -> None:
    """The bar at rest and after every method, coloured by tet volume ratio; inverted tets are magenta."""
    import pyvista as pv

    shown: list[Row | None] = [None, *(row for row in rows if row is not None)]
    columns = (len(shown) + 1) // 2
    plotter = pv.Plotter(off_screen=True, shape=(2, columns), window_size=(480 * columns, 1000), border=False)
    plotter.set_background("white")
    cells = np.column_stack([np.full(len(mesh.tets), 4), mesh.tets])
    for place, row in enumerate(shown):
        plotter.subplot(place // columns, place % columns)
        vertices, ratios = (mesh.vertices, np.ones(len(mesh.tets))) if row is None else (row.moved, row.ratios)
        grid = pv.UnstructuredGrid(cells, np.full(len(mesh.tets), pv.CellType.TETRA), np.array(vertices))
        grid["volume ratio"] = ratios
        plotter.add_mesh(
            grid.extract_cells(ratios > 0.0).extract_surface(algorithm="dataset_surface"),
            scalars="volume ratio",
            clim=(0.0, 2.0),
            cmap="PuOr_r",
            show_edges=True,
            edge_opacity=0.25,
            show_scalar_bar=place == len(shown) - 1,
            scalar_bar_args={
                "title": "tet volume over that at rest; magenta: inverted\n",
                "title_font_size": 15,
                "label_font_size": 15,
                "color": "black",
                "n_labels": 5,
                "width": 0.9,
                "position_x": 0.05,
                "position_y": 0.02,
            },
        )
        if (ratios <= 0.0).any():
            plotter.add_mesh(grid.extract_cells(ratios <= 0.0), color="magenta", show_scalar_bar=False)
        ends = path.position(0.0 if row is None else 1.0)
        plotter.add_points(ends[:STATIONS], color="red", point_size=10, render_points_as_spheres=True)
        plotter.add_points(ends[STATIONS:], color="black", point_size=8, render_points_as_spheres=True)
        said = "" if row is None else f"{row.ended}, steps: {row.steps}, inverted tets: {row.inverted}"
        plotter.add_text(f"{'rest' if row is None else row.method}\n{said}", font_size=10, color="black")
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        plotter.camera.focal_point = middle
        plotter.camera.position = middle + np.array([22.0, -100.0, 42.0])
        plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.screenshot(file)
    plotter.close()


def main() -> None:
    """Print the tables and draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=FilePath, default=FilePath("musclefit-out/fig4"))
    parser.add_argument("--across", type=int, default=8, help="cubes along each side of the bar's section")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    mesh = bar((arguments.across, arguments.across, 6 * arguments.across), edge_mm=8.0 / arguments.across)
    print(f"{len(mesh.tets)} tets, {len(mesh.vertices)} vertices; {STATIONS} landmarks on the axis")
    for case, path in skeleton_paths(48.0).items():
        rows = [measure(method, path, mesh) for method in METHODS]
        lines = table(rows)
        print("\n".join(["", case, *lines]))
        file = arguments.out / f"fig4_{case.replace(', ', '_').replace(' ', '_')}.png"
        file.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        draw(rows, path, mesh, file)
        print(f"wrote {file} and the table beside it")


if __name__ == "__main__":
    main()
