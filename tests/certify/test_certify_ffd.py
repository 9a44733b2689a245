"""Attacks on certificates of free-form deformations: one to three steps, both kinds, on both sides of the limit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import pytest
from attacks import MARGINS, C, Configuration, E, campaign, flow_step, grid, worst_margin

from musclefit.certify.maps import certify_map
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.ffd import FfdField, Lattice
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.vocabulary import Claim, StepKind

CAMPAIGN = 8
ISOCHORIC_SEEDS = (0, 2, 3, 4, 6, 7, 9, 11)
"""Certified, refuted and undecided ones that are quick; seconds each where the margin is a percent."""
FULL_CAMPAIGN = 520

F = TypeVar("F", FfdField, CorrectedField)


def random_field(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> FfdField:
    """Driven by control points or by landmarks, with one level or several."""
    n = len(low)
    if rng.random() < 0.4:
        lattice = Lattice.around(low, high, shape=tuple(int(k) for k in rng.integers(3, 7, n)))
        return lattice.field(rng.normal(size=(int(np.prod(lattice.shape)), n)))
    at = rng.uniform(low, high, (int(rng.integers(4, 14)), n))
    return FfdBackend(float(rng.uniform(15.0, 40.0)), 3).fit(at, rng.normal(size=at.shape))


def isochoric_field(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> CorrectedField:
    """Driven by landmarks, half of them with a local part beside, as rigid bones add one."""
    at = rng.uniform(low, high, (int(rng.integers(4, 14)), 3))
    field = IsochoricFfdBackend(float(rng.uniform(8.0, 30.0))).fit(at, rng.normal(size=at.shape))
    if rng.random() < 0.5:
        return field
    around = rng.uniform(low, high) + rng.uniform(-10.0, 10.0, (20, 3))
    levels = [PotentialLevel.around(around, spacing_mm=h) for h in (8.0, 4.0)]
    shares = [0.1 * level.spacing_mm * rng.normal(size=level.coefficients.shape) for level in levels]
    more = [replace(level, coefficients=share) for level, share in zip(levels, shares, strict=True)]
    return CorrectedField.of(field, SolenoidalField(tuple(more)))


def scaled_to(
    kind: StepKind, field: F, margin: float, moved: np.ndarray, rng: np.random.Generator, beside: np.ndarray
) -> F:
    """The field with the strength at which its smallest margin in the box around the points is the one given."""
    low, high = moved.min(axis=0), moved.max(axis=0)
    return field.scaled((1.0 - margin) / (1.0 - worst_margin(kind, field, low, high, rng, beside=beside)))


def configuration(seed: int) -> Configuration:
    """Random free-form deformations in one to three steps; earlier steps of either kind, some of them radial."""
    rng = np.random.default_rng(seed)
    n, last = 3 - seed % 4 // 3, (E, C)[seed // 4 % 2]
    margin = MARGINS[int(rng.integers(len(MARGINS)))]
    corner = rng.uniform(-200.0, 200.0, n)
    points = np.stack([corner, corner + rng.uniform(50.0, 110.0, n)])
    moved = grid(points[0], points[1], 30 if n == 2 else 9)
    beside = rng.uniform(points[0], points[1], (10, n))
    steps = []
    for _ in range(int(rng.integers(0, 3))):
        kind, low, high = (E, C)[int(rng.integers(2))], moved.min(axis=0), moved.max(axis=0)
        if rng.random() < 0.3:
            field: Any = RadialBackend("r3").fit(rng.uniform(low, high, (8, n)), rng.normal(size=(8, n)))
        else:
            field = random_field(rng, low, high)
        field = scaled_to(kind, field, float(rng.uniform(0.4, 0.8)), moved, rng, beside)
        steps.append((kind, field))
        moved = flow_step(kind, field)(moved)
    field = random_field(rng, moved.min(axis=0), moved.max(axis=0))
    steps.append((last, scaled_to(last, field, margin, moved, rng, beside)))
    return Configuration(steps, points, margin, beside)


def test_certificates_of_free_form_deformations_withstand_attack():
    tally = campaign(map(configuration, range(CAMPAIGN)), max_boxes=20_000, optimise=False)
    assert tally.of(Claim.CERTIFIED) >= 3
    assert tally.of(Claim.REFUTED) >= 1


def isochoric_configuration(seed: int) -> Configuration:
    """One or two steps without divergence, of either kind, the last on both sides of the limit."""
    rng = np.random.default_rng(seed)
    last, margin = (E, C)[(seed + seed // 10) % 2], MARGINS[3 * seed % len(MARGINS)]
    corner = rng.uniform(-200.0, 200.0, 3)
    points = np.stack([corner, corner + rng.uniform(40.0, 80.0, 3)])
    moved, beside, steps = grid(points[0], points[1], 9), rng.uniform(points[0], points[1], (10, 3)), []
    if rng.random() < 0.4:
        kind, low, high = (E, C)[int(rng.integers(2))], moved.min(axis=0), moved.max(axis=0)
        field = scaled_to(kind, isochoric_field(rng, low, high), float(rng.uniform(0.4, 0.8)), moved, rng, beside)
        steps.append((kind, field))
        moved = flow_step(kind, field)(moved)
    field = isochoric_field(rng, moved.min(axis=0), moved.max(axis=0))
    steps.append((last, scaled_to(last, field, margin, moved, rng, beside)))
    return Configuration(steps, points, margin, beside)


def test_certificates_of_isochoric_free_form_deformations_withstand_attack():
    tally = campaign(map(isochoric_configuration, ISOCHORIC_SEEDS), max_boxes=20_000, optimise=False)
    assert tally.of(Claim.CERTIFIED) >= 3
    assert tally.of(Claim.REFUTED) >= 1


@pytest.mark.slow
def test_certificates_of_isochoric_free_form_deformations_withstand_a_long_attack(capsys):
    tally = campaign(map(isochoric_configuration, range(1000, 1000 + FULL_CAMPAIGN)), max_boxes=20_000, optimise=True)
    with capsys.disabled():
        print(f"\nisochoric free-form deformations, {tally}")
    tally.require_a_sound_mixture(FULL_CAMPAIGN)


@pytest.mark.slow
def test_certificates_of_free_form_deformations_withstand_a_long_attack(capsys):
    tally = campaign(map(configuration, range(1000, 1000 + FULL_CAMPAIGN)), max_boxes=20_000, optimise=True)
    with capsys.disabled():
        print(f"\nfree-form deformations, {tally}")
    tally.require_a_sound_mixture(FULL_CAMPAIGN)


def test_a_lattice_within_a_percent_of_the_limit_is_certified():
    """The bounds are tight enough to decide at 99 % of the longest safe step."""
    rng = np.random.default_rng(3)
    low, high = np.zeros(3), np.full(3, 80.0)
    lattice = Lattice.around(low, high, shape=(5, 5, 5))
    points = np.concatenate([rng.uniform(low, high, (20000, 3)), [low, high]])
    field = scaled_to(E, lattice.field(rng.normal(size=(125, 3))), 0.01, points, rng, lattice.control_points())
    certificate = certify_map([(E, field)], points)
    assert certificate.claim is Claim.CERTIFIED
    assert certificate.margin > 0.0
