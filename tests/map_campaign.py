"""Certificates of maps under attack at every scale: ``python tests/map_campaign.py --first 0 --cases 200``.

Case k is made from seed k alone: one to three steps of radial sums or free-form deformations, explicit or Cayley, of a
ball as skin with tissues and points outside, bodies of 1e-3 to 1e5 mm up to 1e6 mm from the origin, strengths on both
sides of the limit. What is certified must keep orientation at every sample of everything that was asked of, and bring
no two samples together, and implicit steps must find them midpoints within the domain that is named; what is refuted
must be reversed at the place named, which must be part of the body. One family are bones that move rigidly, locked to
their motions, of a size of their own; single steps of up to 10 times their motion.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
import trimesh
from attacks import C, E, flow_step, margins
from locked_bones import LockedBones
from scipy.spatial import cKDTree

from musclefit.certify.maps import certify_map
from musclefit.certify.model import MapCertificate
from musclefit.errors import NotConvergedError
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.protocol import Field
from musclefit.fields.radial import RadialBackend
from musclefit.geometry.meshes import TriMesh
from musclefit.vocabulary import Claim, Proof, StepKind

MARGINS = (0.5, 0.3, 0.1, 0.03, -0.03, -0.1, -0.5, -2.0)
"""Sampled margins of the last step."""

FAMILIES = (
    "r3",
    "r2logr",
    "r",
    "isochoric-r3",
    "isochoric-r5",
    "gaussian",
    "wendland-c2",
    "ffd",
    "isochoric-ffd",
)
LOCKED = 50
"""One case in so many is of bones: their proofs take longest."""
SCALED = {"gaussian": 1.0, "wendland-c2": 2.2}
"""Kernels with a length of their own, in radii of the body."""

MAX_BOXES = 200_000
MOST_CPU_S = 30.0
"""A proof that takes longer is over its budget."""

SAMPLES = 4000


@dataclass(frozen=True)
class Case:
    """Steps, a ball as skin, balls outside of it or across it, and single points."""

    family: str
    size_mm: float
    steps: list[tuple[StepKind, Field]]
    skin: TriMesh
    tissues: list[TriMesh]
    points: np.ndarray
    samples: np.ndarray


def _ball(radius: float, centre: np.ndarray) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    return TriMesh(centre + radius * np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))


def _in_balls(rng: np.random.Generator, balls: list[tuple[float, np.ndarray]], count: int) -> np.ndarray:
    found = []
    for radius, centre in balls:
        away = rng.normal(size=(count, 3))
        away *= rng.uniform(0.0, 1.0, (count, 1)) ** (1 / 3) / np.linalg.norm(away, axis=1, keepdims=True)
        found.append(centre + 0.98 * radius * away * 0.98)  # within the faces of the triangles
    return np.concatenate(found)


def _field(family: str, size: float, handles: np.ndarray, moves: np.ndarray) -> Field:
    if family == "ffd":
        return FfdBackend(0.5 * size, 2).fit(handles, moves)
    if family == "isochoric-ffd":
        return IsochoricFfdBackend(0.5 * size).fit(handles, moves)
    return RadialBackend(family, SCALED.get(family, 1.0 / size) * size).fit(handles, moves)


def case(seed: int) -> Case:
    """The case of a seed."""
    rng = np.random.default_rng(seed)
    if seed % LOCKED == LOCKED - 1:
        return _locked_case(seed, rng)
    family = FAMILIES[seed % len(FAMILIES)]
    size = 10.0 ** rng.uniform(-3.0, 5.0)
    middle = rng.uniform(-1.0, 1.0, 3) * rng.choice([0.0, 10.0 * size, 1e6])
    balls = [(size, middle)]
    if rng.random() < 0.5:
        balls.append((0.4 * size, middle + size * np.array([rng.choice([0.9, 1.6, 3.0]), 0.0, 0.0])))
    samples = _in_balls(rng, balls, SAMPLES)
    points = middle + size * rng.uniform(-1.3, 1.3, (int(rng.integers(0, 6)), 3))
    samples = np.concatenate([samples, points])
    steps: list[tuple[StepKind, Field]] = []
    moved, count = samples, int(rng.integers(1, 4))
    for number in range(count):
        kind = (E, C)[int(rng.integers(2))]
        low, high = moved.min(axis=0), moved.max(axis=0)
        handles = rng.uniform(low, high, (int(rng.integers(5, 12)), 3))
        field = _field(family, size, handles, 0.1 * size * rng.normal(size=handles.shape))
        target = rng.choice(MARGINS) if number == count - 1 else float(rng.uniform(0.4, 0.8))
        worst = float(margins(kind, field.gradient(rng.uniform(low, high, (SAMPLES, 3)))).min())
        field = field.scaled((1.0 - target) / (1.0 - worst))  # type: ignore[attr-defined]
        steps.append((kind, field))
        if number < count - 1:
            moved = flow_step(kind, field)(moved)
    tissues = [_ball(*ball) for ball in balls[1:]]
    return Case(family, size, steps, _ball(*balls[0]), tissues, points, samples)


def _locked_case(seed: int, rng: np.random.Generator) -> Case:
    """Bones that are locked to rigid motions in a ball, or across its surface, by one implicit step."""
    made = LockedBones(seed)
    corners = made.everything
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    size = float(rng.choice([0.6, 1.05])) * float(np.linalg.norm(corners - middle, axis=1).max())
    samples = np.concatenate([_in_balls(rng, [(size, middle)], SAMPLES), corners])
    points = middle + size * rng.uniform(-1.3, 1.3, (int(rng.integers(0, 6)), 3))
    worst = float(margins(C, made.field.gradient(samples)).min())
    field = made.field.scaled(min((1.0 - float(rng.choice(MARGINS))) / (1.0 - worst), 10.0))
    return Case(
        "locked", size, [(C, field)], _ball(size, middle), made.bones, points, np.concatenate([samples, points])
    )


def wrong(made: Case, found: MapCertificate) -> str:
    """What shows that a claim is wrong; empty where nothing does."""
    if found.claim is Claim.CERTIFIED:
        moved = made.samples
        try:
            for (kind, field), proved in zip(made.steps, found.steps, strict=True):
                step = flow_step(kind, field)
                inside = moved if kind is E else 0.5 * (moved + step(moved))
                slack = 1e-9 * (made.size_mm + np.abs(inside).max())
                if not ((inside >= proved.domain_low - slack) & (inside <= proved.domain_high + slack)).all():
                    return "certified, but a sample or its midpoint is outside the domain"
                if not np.linalg.det(step.jacobian(moved)).min() > 0.0:
                    return "certified, but orientation is reversed at a sample"
                moved = step(moved)
        except NotConvergedError as error:
            return f"certified, but not applied: {error}"
        apart = cKDTree(moved).query(moved, k=2)[0][:, 1]
        return "" if apart.min() > 0.0 else "certified, but two samples come together"
    if found.claim is Claim.REFUTED:
        (fold,) = found.fold
        place = np.array(fold.place)
        parts = [made.skin, *made.tissues]
        inside = any(abs(_solid_angle(part, place)) > 0.5 for part in parts) or (made.points == place).all(axis=1).any()
        if not inside:
            return "refuted by a place outside the body"
        kind, field = made.steps[fold.step]
        gradient = field.gradient(np.array([fold.place_in_step]))[0]
        value = np.linalg.det(np.eye(3) + gradient)
        if kind is C:
            value = np.linalg.det(np.eye(3) + 0.5 * gradient) * np.linalg.det(np.eye(3) - 0.5 * gradient)
        return "" if value < 0.0 else "refuted, but orientation is kept at the place"
    return ""


def _solid_angle(surface: TriMesh, place: np.ndarray) -> float:
    """Of a closed surface over 4 pi (Van Oosterom and Strackee 1983)."""
    a, b, c = (surface.vertices[surface.faces[:, k]] - place for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(above, below).sum() / (2.0 * np.pi))


def campaign(
    seeds: range, *, most_s: float = np.inf, told: bool = False, max_boxes: int = MAX_BOXES
) -> tuple[Counter[str], list[str], list[str]]:
    """Claims counted, what was wrong or failed by seed, and open claims' reasons; ends after ``most_s`` CPU seconds."""
    claims: Counter[str] = Counter()
    faults, reasons = [], []
    start = time.process_time()
    for seed in seeds:
        if time.process_time() - start > most_s:
            break
        made = case(seed)
        began = time.process_time()
        found = certify_map(made.steps, made.skin, tissues=made.tissues, points=made.points, max_boxes=max_boxes)
        took = time.process_time() - began
        claims[found.claim.value] += 1
        if found.claim is Claim.CERTIFIED and any(step.proof is Proof.PAIRS for step in found.steps):
            claims["certified by pairs"] += 1
        if found.claim is Claim.UNDECIDED:
            reasons.append(f"{seed} {made.family} {made.size_mm:.2g} mm: {found.steps[-1].note}")
        if took > MOST_CPU_S:
            claims["over budget"] += 1
            reasons.append(f"{seed} {made.family} {made.size_mm:.2g} mm: took {took:.0f} s")
        if told:
            print(f"{seed} {made.family} {made.size_mm:.2g} mm: {found.claim.value}, {took:.1f} s", flush=True)
        fault = wrong(made, found)
        if fault:
            faults.append(f"seed {seed}, {made.family}, {made.size_mm:.2g} mm: {fault}")
            if told:
                print("WRONG", faults[-1], flush=True)
    return claims, faults, reasons


def main() -> None:
    """Run some seeds and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--most-s", type=float, default=np.inf, help="CPU seconds after which no case is begun")
    given = parser.parse_args()
    claims, faults, reasons = campaign(range(given.first, given.first + given.cases), most_s=given.most_s, told=True)
    for line in (*reasons, *faults):
        print(line)
    print(dict(claims), "wrong:", len(faults))


if __name__ == "__main__":
    main()
