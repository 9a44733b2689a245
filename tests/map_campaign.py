"""Certificates of maps under attack at every scale: ``python tests/map_campaign.py --cases 5000 --log maps.jsonl``.

Case k is made from seed k alone: one to three steps of radial sums or free-form deformations, explicit or Cayley, of a
body with tissues and points outside, of 1e-3 to 1e5 mm up to 1e6 mm from the origin, strengths on both sides of the
limit. Two bodies in five are balls as skins, the others boxes around points; one in 50 has ten times as many handles.
What is certified must keep orientation at every sample of everything that was asked of, and bring no two samples
together, and implicit steps must find them midpoints within the domain that is named; what is refuted must be reversed
at the place named, which must be part of the body and come to where the steps take it; where a step is said to have two
midpoints there, both must solve its equation. One family are bones that move rigidly, locked to their motions, of a
size of their own; single steps of up to 10 times their motion.

Cases whose line is in the log already are not made again; a table by families ends the run. Exit code 1 where a claim
was wrong or a proof over its budget.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import trimesh
from attacks import C, E, flow_step, margins
from locked_bones import LockedBones
from scipy.spatial import cKDTree

from musclefit.certify.maps import MAX_BOXES, certify_map
from musclefit.certify.model import Fold, MapCertificate
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
LOCKED = 100
"""One case in so many is of bones: their proofs take longest."""
MANY_HANDLES = 50
"""One case in so many has ten times as many handles."""
SCALED = {"gaussian": 1.0, "wendland-c2": 2.2}
"""Kernels with a length of their own, in radii of the body."""

MOST_CPU_S = 60.0
"""A proof that takes longer is over its budget."""

SAMPLES = 1500

REASONS = {
    "budget of boxes": "the budget of boxes is spent",
    "budget of pairs": "the budget of pairs is spent",
    "folds beside the body": "in the domain around the body",
    "jumping or steep": "gradient is too steep or jumps",
    "images nearly meet": "not seen to stay so",
    "implicit step too steep": "the step is too steep there",
    "pieces cut too often": "they were cut",
    "balls too wide": "the balls that enclose",
}
"""Reasons of undecided claims, and by what words of their notes they are told."""


@dataclass(frozen=True)
class Case:
    """Steps, a ball as skin or the corners of a box, balls outside of it or across its surface, and single points."""

    family: str
    size_mm: float
    steps: list[tuple[StepKind, Field]]
    skin: TriMesh | np.ndarray
    tissues: list[TriMesh]
    points: np.ndarray
    samples: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """What came of a case; ``wrong`` says what shows that the claim is, "" where nothing does."""

    seed: int
    family: str
    size_mm: float
    claim: str
    by_pairs: bool
    cpu_s: float
    note: str
    wrong: str

    @property
    def reason(self) -> str:
        """Why the claim is undecided, in few words."""
        return next((name for name, words in REASONS.items() if words in self.note), "other")


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
    as_ball = seed // len(FAMILIES) % 5 < 2
    balls = []
    if rng.random() < 0.5:
        balls.append((0.4 * size, middle + size * np.array([rng.choice([0.9, 1.6, 3.0]), 0.0, 0.0])))
    if as_ball:
        skin: TriMesh | np.ndarray = _ball(size, middle)
        samples = _in_balls(rng, [(size, middle), *balls], SAMPLES)
    else:
        half = size * rng.uniform(0.3, 1.0, 3)
        skin = np.array([middle - half, middle + half])
        samples = rng.uniform(*skin, (SAMPLES, 3))
        samples = np.concatenate([samples, _in_balls(rng, balls, SAMPLES)]) if balls else samples
    points = middle + size * rng.uniform(-1.3, 1.3, (int(rng.integers(0, 6)), 3))
    samples = np.concatenate([samples, points])
    steps: list[tuple[StepKind, Field]] = []
    moved, count = samples, int(rng.integers(1, 4))
    many = 10 if seed % MANY_HANDLES == 0 else 1
    for number in range(count):
        kind = (E, C)[int(rng.integers(2))]
        low, high = moved.min(axis=0), moved.max(axis=0)
        handles = rng.uniform(low, high, (many * int(rng.integers(5, 12)), 3))
        field = _field(family, size, handles, 0.1 * size * rng.normal(size=handles.shape))
        target = rng.choice(MARGINS) if number == count - 1 else float(rng.uniform(0.4, 0.8))
        worst = float(margins(kind, field.gradient(rng.uniform(low, high, (SAMPLES, 3)))).min())
        field = field.scaled((1.0 - target) / (1.0 - worst))  # type: ignore[attr-defined]
        steps.append((kind, field))
        if number < count - 1:
            moved = flow_step(kind, field)(moved)
    return Case(family, size, steps, skin, [_ball(*ball) for ball in balls], points, samples)


def _locked_case(seed: int, rng: np.random.Generator) -> Case:
    """Bones that are locked to rigid motions in a ball, or across its surface, by one implicit step."""
    made = LockedBones(seed)
    corners = made.everything
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    size = float(rng.choice([0.6, 1.05])) * float(np.linalg.norm(corners - middle, axis=1).max())
    samples = np.concatenate([_in_balls(rng, [(size, middle)], SAMPLES), corners])
    points = middle + size * rng.uniform(-1.3, 1.3, (int(rng.integers(0, 6)), 3))
    worst = float(margins(C, made.field.gradient(samples)).min())
    target, strain = float(rng.choice(MARGINS)), 1.0 - worst
    field = made.field.scaled((1.0 - target) / strain if 10.0 * strain > 1.0 - target else 10.0)
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
        if not (_inside(made, place) or (made.points == place).all(axis=1).any()):
            return "refuted by a place outside the body"
        return _wrong_fold(made, fold)
    return ""


def _inside(made: Case, place: np.ndarray) -> bool:
    """Inside the skin, the box or a tissue, by solid angles."""
    if isinstance(made.skin, TriMesh):
        parts = [made.skin, *made.tissues]
    else:
        parts = made.tissues
        if ((place >= made.skin[0]) & (place <= made.skin[1])).all():
            return True
    return any(abs(_solid_angle(part, place)) > 0.5 for part in parts)


def _wrong_fold(made: Case, fold: Fold) -> str:
    """What shows that orientation is kept at a fold, or that the place does not come there; "" where nothing does."""
    kind, field = made.steps[fold.step]
    there = np.array([fold.place_in_step])
    gradient = field.gradient(there)[0]
    value = np.linalg.det(np.eye(3) + gradient)
    if kind is C:
        value = np.linalg.det(np.eye(3) + 0.5 * gradient) * np.linalg.det(np.eye(3) - 0.5 * gradient)
    if not value < 0.0:
        return "refuted, but orientation is kept at the place"
    carried = np.array([fold.place])
    try:
        for earlier, before in made.steps[: fold.step]:
            carried = flow_step(earlier, before)(carried)
    except NotConvergedError as error:
        return f"refuted, but the steps before are not applied: {error}"
    near = 1e-7 * (made.size_mm + np.abs(carried).max())
    middles = [there] if fold.other_midpoint is None else [there, np.array([fold.other_midpoint])]
    for middle in middles:
        target = middle - 0.5 * field.displacement(middle) if kind is C else middle
        if not np.abs(target - carried).max() < near:
            return "refuted, but the place does not come where it is said"
    if len(middles) == 2 and not np.abs(middles[0] - middles[1]).max() > 0.0:
        return "refuted by two midpoints that are one"
    return ""


def _solid_angle(surface: TriMesh, place: np.ndarray) -> float:
    """Of a closed surface over 4 pi (Van Oosterom and Strackee 1983)."""
    a, b, c = (surface.vertices[surface.faces[:, k]] - place for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(above, below).sum() / (2.0 * np.pi))


def outcome(seed: int, max_boxes: int = MAX_BOXES) -> Outcome:
    """Certify the case of a seed and attack the claim."""
    made = case(seed)
    began = time.process_time()
    found = certify_map(made.steps, made.skin, tissues=made.tissues, points=made.points, max_boxes=max_boxes)
    took = time.process_time() - began
    return Outcome(
        seed,
        made.family,
        made.size_mm,
        found.claim.value,
        found.claim is Claim.CERTIFIED and any(step.proof is Proof.PAIRS for step in found.steps),
        took,
        found.steps[-1].note if found.claim is Claim.UNDECIDED else "",
        wrong(made, found),
    )


def table(outcomes: Sequence[Outcome]) -> str:
    """Claims by families, and why some are undecided."""
    lines = [f"{'family':15} cases certified (by pairs) refuted undecided wrong over-budget CPU-s/case"]
    for family in (*FAMILIES, "locked", "all"):
        own = [o for o in outcomes if family in (o.family, "all")]
        claims = Counter(o.claim for o in own)
        lines.append(
            f"{family:15} {len(own):5} {claims['certified']:9} {sum(o.by_pairs for o in own):10} {claims['refuted']:7} "
            f"{claims['undecided']:9} {sum(bool(o.wrong) for o in own):5} "
            f"{sum(o.cpu_s > MOST_CPU_S for o in own):11} {np.mean([o.cpu_s for o in own] or [0.0]):10.2f}"
        )
    open_ones = [o for o in outcomes if o.claim == Claim.UNDECIDED.value]
    lines.append(f"undecided: {100.0 * len(open_ones) / max(1, len(outcomes)):.1f} %")
    lines += [f"    {count:5} {reason}" for reason, count in Counter(o.reason for o in open_ones).most_common()]
    lines += [f"WRONG seed {o.seed}, {o.family}, {o.size_mm:.2g} mm: {o.wrong}" for o in outcomes if o.wrong]
    lines += [f"over budget: seed {o.seed}, {o.family}: {o.cpu_s:.0f} s" for o in outcomes if o.cpu_s > MOST_CPU_S]
    return "\n".join(lines)


def _read(log: Path) -> list[Outcome]:
    """The cases of a log; a line that an interruption cut off is not one."""
    lines = log.read_text().split("\n")[:-1] if log.exists() else []
    return [Outcome(**json.loads(line)) for line in lines]


def main() -> int:
    """Run the cases that are not in the log yet and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--log", type=Path, default=Path("map_campaign.jsonl"))
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.cases)
    done = {o.seed: o for o in _read(given.log) if o.seed in seeds}
    if given.log.exists():
        given.log.write_text("".join(f"{json.dumps(asdict(o))}\n" for o in _read(given.log)))
    left = [seed for seed in seeds if seed not in done]
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool, given.log.open("a") as log:
        for found in pool.imap_unordered(outcome, left):
            done[found.seed] = found
            log.write(f"{json.dumps(asdict(found))}\n")
            log.flush()
            if found.wrong:
                print(f"WRONG seed {found.seed}: {found.wrong}", flush=True)
    outcomes = [done[seed] for seed in sorted(done)]
    print(table(outcomes))
    return int(any(o.wrong or o.cpu_s > MOST_CPU_S for o in outcomes))


if __name__ == "__main__":
    sys.exit(main())
