"""Locks attacked: random bones, motions, fades and lattices; dense samples of what is said to be exact or proved."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from attacks import Configuration, attack, attack_boxes
from oracles import difference_jacobian

from musclefit.certify.maps import certify_map
from musclefit.errors import NotConvergedError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.locked import Fade, LockedField
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.flow.locks import BoneLocks, LockSettings, Stand
from musclefit.flow.steps import CayleyStep
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.vocabulary import Claim, StepKind

EXACT_MM = 1e-6


def some_bone(rng: np.random.Generator) -> TriMesh:
    """A ball, a long bone, a plate or a ring; smooth or rough, of few triangles or many; 4 to 30 mm."""
    size = rng.uniform(4.0, 15.0)
    kind = rng.integers(4)
    if kind == 3:
        mesh = trimesh.creation.torus(size, rng.uniform(0.15, 0.4) * size, major_sections=24, minor_sections=12)
    else:
        mesh = trimesh.creation.icosphere(int(rng.integers(1, 4)))
        mesh.apply_scale(size * (np.ones(3), np.array([0.4, 0.5, 2.0]), np.array([1.0, 1.2, 0.2]))[kind])
    vertices = np.array(mesh.vertices)
    rough = rng.choice([0.0, 0.01, 0.04]) * size
    vertices += rng.normal(0.0, rough, vertices.shape) if rough else 0.0
    turn = RigidMotion.about_axis(centre=np.zeros(3), axis=rng.normal(size=3), angle_deg=rng.uniform(0.0, 180.0))
    return TriMesh(turn(vertices), np.array(mesh.faces))


def placed(rng: np.random.Generator, count: int) -> list[TriMesh]:
    """Bones side by side, from sharing space to a centimetre apart."""
    bones = [some_bone(rng)]
    while len(bones) < count:
        bone, direction = some_bone(rng), rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        there = max(float((b.vertices @ direction).max()) for b in bones)
        shift = there - float((bone.vertices @ direction).min()) + rng.uniform(-1.0, 10.0)
        bones.append(bone.with_vertices(bone.vertices + shift * direction))
    return bones


class Case:
    """One step of random bones."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng([77, seed])
        self.bones = placed(rng, int(rng.integers(1, 4)))
        spacing = rng.uniform(0.3, 1.2)
        self.settings = [
            LockSettings(spacing, Fade(rng.uniform(1.0, 5.0) * spacing, rng.uniform(1.0, 6.0) * spacing))
            for _ in self.bones
        ]
        everything = np.concatenate([b.vertices for b in self.bones])
        middle = everything.mean(axis=0)
        strength = rng.choice([0.2, 1.0, 3.0])
        self.motions = [
            RigidMotion.about_axis(
                centre=middle + rng.normal(0.0, 10.0, 3),
                axis=rng.normal(size=3),
                angle_deg=strength * rng.uniform(-4, 4),
            )
            for _ in self.bones
        ]
        at = np.concatenate([b.vertices[:: max(1, len(b.vertices) // 20)] for b in self.bones])
        owners = [b.vertices[:: max(1, len(b.vertices) // 20)] for b in self.bones]
        to = np.concatenate([m(part) for m, part in zip(self.motions, owners, strict=True)])
        base = RadialBackend("isochoric-r3", smoothing=1e-3).fit(0.5 * (at + to), to - at)
        if rng.random() < 0.5:
            levels = [PotentialLevel.around(everything, spacing_mm=h) for h in (8.0, 4.0)]
            local = SolenoidalField(
                tuple(replace(v, coefficients=0.05 * strength * rng.normal(size=v.coefficients.shape)) for v in levels)
            )
            base = CorrectedField(base, local)
        still = [Stand.of(RigidMotion.identity())] * len(self.bones)
        locks = BoneLocks.around(self.bones, self.settings)
        self.field = LockedField(base, locks.of_step(still, [Stand.of(m) for m in self.motions]))
        self.everything = everything

    def exact(self) -> int:
        """Samples of the surfaces beyond the zones, all of which move as their bones."""
        step, count = CayleyStep(self.field), 0
        for k, (bone, motion) in enumerate(zip(self.bones, self.motions, strict=True)):
            places = surface_samples(bone, spacing_mm=0.5).points
            free = np.ones(len(places), dtype=bool)
            for j, other in enumerate(self.bones):
                if j != k:
                    # Apart in the middle of the step is what counts; both ends bound it closely enough.
                    zone = max(self.settings[k].zone_mm, self.settings[j].zone_mm)
                    before = nearest_places(places, other).distances
                    after = nearest_places(self.motions[j].inverse()(motion(places)), other).distances
                    free &= (before > zone) & (after > zone)
            places = places[free]
            if len(places):
                assert np.linalg.norm(step(places) - motion(places), axis=1).max() <= EXACT_MM
            count += len(places)
        return count

    def bounds(self) -> None:
        """No sample of a box escapes what is proved of it."""
        rng, field = self.rng, self.field
        centres = self.everything[rng.integers(len(self.everything), size=150)] + rng.normal(0.0, 2.0, (150, 3))
        halves = 10.0 ** rng.uniform(-2.0, 1.0, (150, 1)) * rng.uniform(0.3, 1.0, (150, 3))
        attack_boxes(field, centres, halves, rng, enough=(-0.5, 0.5), tries=30)

    def laws(self) -> None:
        """Derivatives are those of the values."""
        rng = self.rng
        at = self.everything[rng.integers(len(self.everything), size=200)] + rng.normal(0.0, 2.0, (200, 3))
        differences = difference_jacobian(self.field.displacement, at, step=1e-6)
        off = np.abs(self.field.gradient(at) - differences).max(axis=(1, 2))
        assert np.quantile(off, 0.9) < 1e-5  # second derivatives jump between cells, where differences straddle two
        assert off.max() < 0.05

    def proof(self) -> Claim:
        """The claim for the box around the bones; what is certified is attacked, and its inverse undoes it."""
        steps = ((StepKind.CAYLEY, self.field),)
        certificate = certify_map(steps, self.everything, max_boxes=60_000)
        if certificate.claim is Claim.CERTIFIED:
            beside = self.everything[self.rng.integers(len(self.everything), size=12)]
            attack(Configuration(steps, self.everything, 0.0, beside), certificate, self.rng, optimise=False)
            step, at = CayleyStep(self.field), self.everything[:500]
            np.testing.assert_allclose(step.inverse()(step(at)), at, rtol=0, atol=1e-8)
        return certificate.claim


def campaign(count: int, first: int = 0) -> tuple[Counter[str], int]:
    """So many cases; gives what became of them, and how many samples were found exact."""
    tally: Counter[str] = Counter()
    samples = 0
    for seed in range(first, first + count):
        case = Case(seed)
        case.bounds()
        try:
            samples += case.exact()
            case.laws()
        except NotConvergedError:
            tally["too steep"] += 1  # a step that has no solution is refused, not delivered
        tally[case.proof().value] += 1
    return tally, samples


def test_nothing_escapes_locks_of_random_bones() -> None:
    tally, samples = campaign(4)
    assert sum(tally[claim.value] for claim in Claim) == 4
    assert samples > 1000


@pytest.mark.slow
def test_nothing_escapes_locks_of_hundreds_of_random_bones() -> None:
    count = 300
    tally, samples = campaign(count, first=100)
    print(dict(tally), samples)
    assert samples > 100 * count
    assert tally[Claim.CERTIFIED.value] > 0.25 * count
    assert tally["too steep"] < 0.3 * count
