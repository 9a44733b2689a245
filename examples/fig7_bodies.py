"""Fig. 7: a whole body (skin and 688 tissues) on two heavier ones by a cage of 509 vertices, method by method.

    MUSCLEFIT_DATA=... python examples/fig7_bodies.py

One shot is what other tools do with a cage's vertices; the paper's loop takes steps by its row-norm rule; ours are
implicit midpoint (Cayley) steps. All three have the same kernel, a scalar one, since the volume must change. Folds are
counted at the vertices of all tissues, and among the tetrahedra of a lattice that fills the skin. In the pictures folds
are magenta, what two tissues newly share or what is newly outside the skin is blue. Takes 8 CPU minutes.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.certify.maps import certify_map
from musclefit.figures.camera import View
from musclefit.figures.colours import tissue_colours
from musclefit.figures.panels import Marks, Panel, determinant_panels, screenshot, tissue_panels
from musclefit.flow.deformation import Deformation
from musclefit.geometry.measures import signed_volumes
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import ROUNDING_MM3, outside_mesh, overlap_mesh
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform, deform_in_one_shot
from musclefit.pipeline.proving import STEP_KINDS
from musclefit.progress import Silent
from musclefit.rig.job import Job
from musclefit.rig.settings import DeformerSettings
from musclefit.validate.overlaps import SolidAnatomy, check_outside_skin, check_overlaps, solid_anatomy
from musclefit.vocabulary import StepKind

KERNELS = {"heavy": "r", "very_heavy": "r3"}
LATTICE_MM = 8.0
DETAIL_MM = 60.0
"""Around what folds, in the close view."""
SHOWN_MM3 = 0.1
"""What is new and smaller is counted and named, but not drawn."""
QUIET = Silent()


@dataclass(frozen=True)
class Made:
    """What one method made of the body."""

    method: str
    deformed: Anatomy
    determinants: np.ndarray
    new: tuple[TriMesh, ...]

    def marks(self) -> Marks:
        """Folds and what is new."""
        where = self.deformed.slices()
        return Marks({name: self.determinants[s] for name, s in where.items()}, self.new)


def methods(job: Job, points: np.ndarray) -> dict[str, Callable[[], Deformation]]:
    """The three ways to move the same cage with the same kernel."""

    def marched(step: StepKind) -> Deformation:
        settings = DeformerSettings(kernel=job.rig.deformer.kernel, step=step)
        return deform(replace(job, rig=replace(job.rig, deformer=settings)), points, progress=QUIET).deformation

    return {
        "one shot": lambda: deform_in_one_shot(job, points),
        "the paper's loop": lambda: marched(StepKind.EXPLICIT),
        "ours": lambda: marched(StepKind.CAYLEY),
    }


def lattice_tets(job: Job) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and right-handed tets, six to each cube of a lattice that is wholly inside the skin."""
    skin = job.anatomy.skin
    assert skin is not None
    low, high = skin.surface.vertices.min(axis=0), skin.surface.vertices.max(axis=0)
    axes = [np.arange(a, b + LATTICE_MM, LATTICE_MM) for a, b in zip(low, high, strict=True)]
    vertices = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    inside = winding_numbers(skin.surface, vertices) > 0.9
    shape = [len(axis) for axis in axes]
    number = np.arange(len(vertices)).reshape(shape)
    tets = []
    for order in itertools.permutations(np.eye(3, dtype=int)):
        corners = np.cumsum([np.zeros(3, dtype=int), *order], axis=0)
        slices = [tuple(slice(o, o + n - 1) for o, n in zip(c, shape, strict=True)) for c in corners]
        tets.append(np.stack([number[s].ravel() for s in slices], axis=1))
    found = np.concatenate(tets)
    found = found[inside[found].all(axis=1)]
    wrong = signed_volumes(vertices, found) < 0.0
    found[wrong] = found[wrong][:, [0, 1, 3, 2]]
    used, local = np.unique(found, return_inverse=True)
    return vertices[used], local.reshape(-1, 4)


def overlaps_in_words(
    rest: SolidAnatomy, deformed: Anatomy, deformation: Deformation
) -> tuple[str, tuple[TriMesh, ...]]:
    """New pairs, growth of the old ones and tissue newly outside the skin, as cells of the table; and what is new."""
    after = solid_anatomy(deformed, progress=QUIET)
    mapped = deformation.with_jacobian
    pairs = check_overlaps(rest, after, mapped=mapped, progress=QUIET).pairs
    new = [p for p in pairs if p.rest_mm3 <= ROUNDING_MM3 and p.introduced_mm3 > ROUNDING_MM3]
    old = [p for p in pairs if p.rest_mm3 > ROUNDING_MM3]
    outside = check_outside_skin(rest, after, mapped=mapped, progress=QUIET).tissues
    grown = sum(p.introduced_mm3 for p in old) / sum(p.deformed_mm3 for p in old)
    for pair in new:
        print(f"    new: {pair.a} / {pair.b} {pair.introduced_mm3:.2g} mm³")
    for tissue in outside:
        if tissue.introduced_mm3 > 1.0:
            print(f"    newly outside the skin: {tissue.name} {tissue.introduced_mm3:.2g} mm³")
    skin = deformed.skin
    assert skin is not None
    shown = [overlap_mesh(after.solids[p.a], after.solids[p.b]) for p in new if p.introduced_mm3 > SHOWN_MM3]
    shown += [
        outside_mesh(after.solids[t.name], after.solids[skin.name]) for t in outside if t.introduced_mm3 > SHOWN_MM3
    ]
    words = (
        f"{sum(p.introduced_mm3 for p in new):.2g} in {len(new)} | {100.0 * grown:.2f} % of {len(old)} | "
        f"{sum(t.introduced_mm3 for t in outside):.2g}"
    )
    return words, tuple(shown)


def make(name: str, job: Job, rest: SolidAnatomy | None, tets: tuple[np.ndarray, np.ndarray]) -> list[Made]:
    """Every method on one body; prints its lines of the table."""
    points, skin = job.anatomy.vertices(), job.anatomy.skin
    assert skin is not None
    made = []
    for method, marched in methods(job, points).items():
        say(f"{name}, {method}: moves {len(points)} vertices")
        start = time.process_time()
        deformation = marched()
        moved, jacobians = deformation.with_jacobian(points)
        seconds = time.process_time() - start
        determinants = np.linalg.det(jacobians)
        say(f"{name}, {method}: proves {deformation.stretches} steps")
        start = time.process_time()
        proof = certify_map([(STEP_KINDS[type(s)], s.field) for s in deformation.steps], skin.surface)
        proved = time.process_time() - start
        off = np.abs(deformation(job.handles.source) - job.path.position(1.0)).max()
        inverted = int((signed_volumes(deformation(tets[0]), tets[1]) <= 0.0).sum())
        deformed = job.anatomy.with_vertices(moved)
        tail, new = "", tuple[TriMesh, ...]()
        if rest is not None:
            say(f"{name}, {method}: measures overlaps")
            words, new = overlaps_in_words(rest, deformed, deformation)
            tail = f" {words} |"
        print(
            f"| {name}, {method} | {deformation.stretches} | {off:.0e} | {(determinants <= 0).sum()} | {inverted} | "
            f"{determinants.min():.2f} | {proof.claim.value} | {proof.margin:.2f} | "
            f"{seconds:.1f} + {proved:.1f} |{tail}",
            flush=True,
        )
        made.append(Made(method, deformed, determinants, new))
    return made


def say(what: str) -> None:
    """Progress, apart from the table."""
    print(f"[{time.process_time():5.0f} s] {what}", file=sys.stderr, flush=True)


def front(anatomies: list[Anatomy]) -> View:
    """From in front, upright."""
    points = np.concatenate([a.skin.surface.vertices for a in anatomies if a.skin is not None])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * (high - low)
    right, up, towards = np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), np.array([0, -1.0, 0])
    return View(0.5 * (low + high), right, up, towards, half[0], half[2], half[1])


def close(view: View, places: np.ndarray) -> View:
    """The same view of what is around some places."""
    axes = np.stack([view.right, view.up, view.towards])
    low, high = (places @ axes.T).min(axis=0) - DETAIL_MM, (places @ axes.T).max(axis=0) + DETAIL_MM
    half = 0.5 * (high - low)
    return replace(view, centre=(0.5 * (low + high)) @ axes, half_width_mm=half[0], half_height_mm=half[1])


def draw(rest: Anatomy, made: list[Made], *, stem: Path) -> None:
    """All tissues, whole and close to where they fold; and the determinants: white where volume is kept."""
    panels = (Panel("rest", rest), *(Panel(m.method, m.deformed, m.marks()) for m in made))
    view, colours = front([p.anatomy for p in panels]), tissue_colours(rest)
    pictures = {
        "tissues": tissue_panels(panels, view, colours=colours, height_px=1100),
        "determinants": determinant_panels(panels[1:], view, height_px=1100),
    }
    folded = np.concatenate([m.deformed.vertices()[m.determinants <= 0.0] for m in made])
    if len(folded):
        near = close(view, folded)
        pictures["folds"] = tissue_panels(panels[1:], near, colours=colours, height_px=700)
        pictures["folds_determinants"] = determinant_panels(panels[1:], near, height_px=700)
    for what, plotter in pictures.items():
        stem.with_name(f"{stem.name}_{what}.png").write_bytes(screenshot(plotter))


def main() -> None:
    """Print the table and draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("musclefit-out/fig7"))
    parser.add_argument("--body", choices=[*KERNELS, "both"], default="both")
    parser.add_argument("--no-overlaps", action="store_true", help="leave out the overlaps, which take a minute a row")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    bodies = list(KERNELS) if arguments.body == "both" else [arguments.body]
    head = (
        "| body, method | steps | cage off, mm | folded vertices | inverted tets | smallest det J | map | margin | "
        "CPU s, map + proof |"
    )
    print(head + ("" if arguments.no_overlaps else " new overlap, mm³ | grown overlap | newly outside skin, mm³ |"))
    print("|" + "---|" * (9 if arguments.no_overlaps else 12))
    rest, tets = None, None
    for name in bodies:
        job = read_rig(find_rig(f"body_{name}"), overrides=(f"deformer.kernel={KERNELS[name]}",))
        for finding in job.findings:
            if finding.code == "cage-crossing":
                print(f"    {finding.message}")
        if tets is None:
            say(f"fills the skin with tets of {LATTICE_MM:g} mm")
            tets = lattice_tets(job)
        if rest is None and not arguments.no_overlaps:
            rest = solid_anatomy(job.anatomy, progress=QUIET)
        made = make(name.replace("_", " "), job, rest, tets)
        draw(job.anatomy, made, stem=arguments.out / f"fig7_{name}")
    print(f"{len(tets[1]) if tets else 0} tets in the lattice; pictures in {arguments.out}")


if __name__ == "__main__":
    main()
