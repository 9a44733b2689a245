"""Locks attacked: random bones, motions, fades and lattices; dense samples of what is said to be exact or proved."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from attacks import Configuration, attack, attack_boxes
from locked_bones import LockedBones
from oracles import difference_jacobian

from musclefit.certify.maps import certify_map
from musclefit.errors import NotConvergedError
from musclefit.flow.steps import CayleyStep
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.vocabulary import Claim, StepKind

EXACT_MM = 1e-6


class Case(LockedBones):
    """One step of random bones, attacked."""

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
