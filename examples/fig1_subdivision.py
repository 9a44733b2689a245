"""Fig. 1 of Yu et al. 2014: a mesh of a square moved by two landmarks, in one shot, by steps, and with subdivision.

    python examples/fig1_subdivision.py --out musclefit-out/fig1

Two landmarks inside a square of 100 mm pass each other in opposite directions while 12 landmarks on its sides stay;
targets ever farther off are reached by one step of full length and by the paper's loop (phi = r^2 log r), whose step
length is tested on a grid of points that is finer than the mesh. The map is then safe, but a mesh sees only its
vertices: where triangles are too coarse for the map some still turn over. Edges of those triangles are split, at rest,
and their middles go through the same map, until none is left or MAX_ROUNDS are done.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from musclefit.certify.maps import certify_map
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import Pace, march, one_shot
from musclefit.flow.rules import row_norm_fractions
from musclefit.flow.steppers import HandleStepper, explicit_step
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.subdivision import FaceEdges, split_edges
from musclefit.rig.handles import StraightPath
from musclefit.vocabulary import StepKind

SIDE_MM = 100.0
CELLS = 10
"""Along each side of the square; every cell is cut into two triangles."""
MOVING = np.array([[40.0, 42.0], [60.0, 58.0]])
MOVES = {
    "near": np.array([[15.0, 0.0], [-15.0, 0.0]]),
    "far": np.array([[38.0, 0.0], [-38.0, 0.0]]),
    "farther": np.array([[45.0, -20.0], [-45.0, 20.0]]),
}
TESTED_PER_SIDE = 201
MAX_ROUNDS = 12


@dataclass(frozen=True)
class Row:
    """What became of the mesh."""

    case: str
    ended: str
    steps: int
    triangles: int
    folded: int
    min_ratio: float
    min_determinant: float
    claim: str
    rest: TriMesh
    moved: TriMesh


def square() -> TriMesh:
    """The square in the plane z = 0."""
    axis = np.linspace(0.0, SIDE_MM, CELLS + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    number = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = (n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriMesh(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), faces)


def path_to(moves: Points) -> StraightPath:
    """The two landmarks on straight lines, and 12 on the sides that stay."""
    along = np.linspace(0.0, SIDE_MM, 4)[:-1]
    low, high = np.zeros(len(along)), np.full(len(along), SIDE_MM)
    sides = [(along, low), (high, along), (SIDE_MM - along, high), (low, SIDE_MM - along)]
    fixed = np.concatenate([np.stack(side, axis=1) for side in sides])
    source = np.concatenate([MOVING, fixed])
    return StraightPath(source, source + np.pad(moves, ((0, len(fixed)), (0, 0))))


def areas(mesh: TriMesh) -> Float:
    """Signed areas in the plane, positive counter-clockwise."""
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2] for k in range(3))
    u, v = b - a, c - a
    signed: Float = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return signed


def carried(mesh: TriMesh, deformation: Deformation) -> TriMesh:
    """The mesh with its vertices mapped."""
    moved = deformation(mesh.vertices[:, :2])
    return mesh.with_vertices(np.column_stack([moved, np.zeros(len(moved))]))


def subdivided(mesh: TriMesh, deformation: Deformation) -> TriMesh:
    """The mesh at rest with the edges of folded triangles split until the map folds none, at most MAX_ROUNDS times."""
    for _ in range(MAX_ROUNDS):
        folded = areas(carried(mesh, deformation)) <= 0.0
        if not folded.any():
            break
        edges = FaceEdges.of(mesh.faces)
        split = np.zeros(len(edges.ends), dtype=bool)
        split[edges.of_face[folded]] = True
        mesh = split_edges(mesh, edges, split)
    return mesh


def measure(case: str, deformation: Deformation, rest: TriMesh, tested: Points) -> Row:
    """Folds of the mesh, the smallest determinant on the grid, and the claim about the continuous map."""
    moved = carried(rest, deformation)
    ratios = areas(moved) / areas(rest)
    steps = [(StepKind.EXPLICIT, step.field) for step in deformation.steps]
    return Row(
        case=case,
        ended=deformation.status.name.lower().replace("_", " "),
        steps=len(deformation.steps),
        triangles=len(rest.faces),
        folded=int((ratios <= 0.0).sum()),
        min_ratio=float(ratios.min()),
        min_determinant=float(np.linalg.det(deformation.jacobian(tested)).min()),
        claim=certify_map(steps, np.array([[0.0, 0.0], [SIDE_MM, SIDE_MM]])).claim.value,
        rest=rest,
        moved=moved,
    )


def compare() -> list[Row]:
    """One shot and the loop to every target, and the last loop's map on the subdivided mesh."""
    mesh = square()
    fine = np.linspace(0.0, SIDE_MM, TESTED_PER_SIDE)
    tested = np.stack([g.ravel() for g in np.meshgrid(fine, fine, indexing="ij")], axis=1)
    backend, rows = RadialBackend("r2logr"), []
    for target, moves in MOVES.items():
        path = path_to(moves)
        shot = one_shot(path, backend, rule=row_norm_fractions, tested=tested)
        stepper = HandleStepper(path, backend, explicit_step)
        loop = march(stepper, rule=row_norm_fractions, tested=tested, pace=Pace(200))
        rows.append(measure(f"{target} targets, one shot", shot, mesh, tested))
        rows.append(measure(f"{target} targets, iterative", loop, mesh, tested))
    rows.append(measure(f"{target} targets, iterative, subdivided", loop, subdivided(mesh, loop), tested))
    return rows


def draw(rows: list[Row], file: Path) -> None:
    """The mesh after each case; folded triangles are magenta, the landmarks red and black."""
    import pyvista as pv

    shown: list[Row | None] = [None, *rows]
    columns = (len(shown) + 1) // 2
    plotter = pv.Plotter(off_screen=True, shape=(2, columns), window_size=(500 * columns, 1080), border=False)
    plotter.set_background("white")
    for place, row in enumerate(shown):
        plotter.subplot(place // columns, place % columns)
        rest, moved = (square(), square()) if row is None else (row.rest, row.moved)
        ratios = areas(moved) / areas(rest)
        mesh = pv.PolyData.from_regular_faces(np.array(moved.vertices), np.array(moved.faces))
        mesh["area ratio"] = ratios
        style = {"clim": (0.0, 2.0), "cmap": "PuOr_r", "below_color": "magenta", "lighting": False}
        # Folded triangles last and a little in front, so that none is hidden.
        for kind, height in ((ratios > 0.0, 0.0), (ratios <= 0.0, 0.05)):
            if kind.any():
                part = mesh.extract_cells(kind).translate((0.0, 0.0, height))
                style |= {"edge_color": "magenta" if height else "black", "line_width": 4 if height else 1}
                plotter.add_mesh(part, scalars="area ratio", show_edges=True, show_scalar_bar=False, **style)
        path = path_to(MOVES["near" if row is None else row.case.split()[0]])
        ends = path.source if row is None else path.target
        ends = np.column_stack([ends, np.full(len(ends), 0.1)])
        plotter.add_points(ends[:2], color="red", point_size=14, render_points_as_spheres=True)
        plotter.add_points(ends[2:], color="black", point_size=9, render_points_as_spheres=True)
        said = "rest\nviolet: smaller than this, orange: larger, magenta: folded"
        if row is not None:
            said = f"{row.case}\nsteps: {row.steps}, folded: {row.folded} of {row.triangles} triangles"
        plotter.add_text(said, font_size=10, color="black")
        plotter.view_xy()
        plotter.enable_parallel_projection()
        plotter.camera.parallel_scale = 0.62 * SIDE_MM
    plotter.screenshot(file)
    plotter.close()


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("musclefit-out/fig1"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    rows = compare()
    lines = ["| case | ended | steps | triangles | folded triangles | min area ratio | min det J on the grid | map |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    lines += [
        f"| {row.case} | {row.ended} | {row.steps} | {row.triangles} | {row.folded} | {row.min_ratio:.3f} | "
        f"{row.min_determinant:.3f} | {row.claim} |"
        for row in rows
    ]
    print("\n".join(lines))
    (out / "fig1_subdivision.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    draw(rows, out / "fig1_subdivision.png")
    print(f"wrote {out / 'fig1_subdivision.png'} and the table beside it")


if __name__ == "__main__":
    main()
