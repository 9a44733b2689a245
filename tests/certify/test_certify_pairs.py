"""Proofs pair by pair, and the regions that they are made on: maps that no convex domain shows to be one-to-one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from musclefit.certify.pairs import prove_one_to_one
from musclefit.certify.regions import Region


@dataclass(frozen=True)
class Rolled:
    """A strip, 0 <= x <= 1, |y| <= 0.05, rolled up into a ring by an angle: exact values, and bounds by derivatives."""

    angle: float

    def _polar(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 1.0 / self.angle - points[:, 1], self.angle * points[:, 0]

    def displacement(self, points: np.ndarray) -> np.ndarray:
        radius, turn = self._polar(points)
        return np.stack([radius * np.sin(turn), 1.0 / self.angle - radius * np.cos(turn)], axis=1) - points

    def gradient(self, points: np.ndarray) -> np.ndarray:
        radius, turn = self._polar(points)
        rows = [
            [self.angle * radius * np.cos(turn), -np.sin(turn)],
            [self.angle * radius * np.sin(turn), np.cos(turn)],
        ]
        return np.array(rows).transpose(2, 0, 1) - np.eye(2)

    def displacement_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.displacement(points), self.gradient(points)

    def gradient_bounds(self, centres: np.ndarray, half_widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The first column turns by the angle a mm and grows with y; the second turns alone."""
        radius = np.abs(1.0 / self.angle - centres[:, 1]) + half_widths[:, 1]
        dx, dy = half_widths.T
        first = self.angle * (self.angle * radius * dx + dy)
        return self.gradient(centres), np.hypot(first, self.angle * dx) + 1e-12

    def displacement_bounds(self, centres: np.ndarray, half_widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert not half_widths.any()
        return self.displacement(centres), np.full_like(centres, 1e-13)

    def scaled(self, factor: float) -> Self:
        raise NotImplementedError


def strip() -> Region:
    cells = np.ones((64, 4), dtype=bool)
    return Region(np.array([0.0, -0.03125]), 1.0 / 64.0, cells)


@pytest.mark.parametrize("degrees", [90.0, 200.0, 300.0, 340.0])
def test_a_strip_rolled_up_is_proved_one_to_one_until_its_ends_meet(degrees: float) -> None:
    proof = prove_one_to_one(Rolled(np.radians(degrees)), (1.0,), strip(), max_boxes=200_000, tick=lambda _: None)
    assert proof.ended == ""
    assert 0.0 < proof.margin <= proof.sampled_margin
    # the inside is compressed the most: by the radius there over that of the middle
    assert proof.margin <= 1.0 - np.radians(degrees) * 0.03125 + 1e-9


@pytest.mark.parametrize("degrees", [365.0, 500.0])
def test_ends_that_lie_over_each_other_are_not_proved_apart_though_nothing_is_reversed(degrees: float) -> None:
    field = Rolled(np.radians(degrees))
    places = np.random.default_rng(0).uniform([0.0, -0.03], [1.0, 0.03], (2000, 2))
    assert np.linalg.det(np.eye(2) + field.gradient(places)).min() > 0.5
    proof = prove_one_to_one(field, (1.0,), strip(), max_boxes=60_000, tick=lambda _: None)
    assert proof.margin == -np.inf
    assert proof.left > 0
    assert proof.ended


def test_a_collapse_ends_the_search_at_once() -> None:
    class Flat(Rolled):
        def gradient(self, points: np.ndarray) -> np.ndarray:
            return np.tile(np.diag([0.0, -1.0]), (len(points), 1, 1))

    proof = prove_one_to_one(Flat(1.0), (1.0,), strip(), max_boxes=100_000, tick=lambda _: None)
    assert proof.margin == -np.inf
    assert "collapses" in proof.ended
    assert proof.examined < 2000


@given(seed=st.integers(0, 10_000), n=st.sampled_from([2, 3]))
def test_a_region_holds_its_balls_and_what_they_cut_off(seed: int, n: int) -> None:
    """A closed shell of balls: its middle is inside, far places are not, and no box with a point of it is dropped."""
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(400, n))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    centre, size = rng.uniform(-1e3, 1e3, n), 10.0 ** rng.uniform(-2.0, 3.0)
    balls, radii = centre + size * away, np.full(400, 0.6 * size)
    region = Region.around(balls, radii)
    zero = np.zeros((1, n))
    assert region.meets(centre[None], zero)[0]
    assert region.holds_balls(balls, radii).all()
    assert not region.holds_balls(balls, 3.0 * radii).any()
    assert not region.holds_balls(centre[None] + 10.0 * size, np.array([1e-3 * size]))[0]
    centres, halves = region.boxes(200)
    inside = centre + size * rng.uniform(-1.2, 1.2, (200, n))
    inside = inside[region.meets(inside, np.zeros_like(inside))]
    covered = (np.abs(inside[:, None] - centres) <= halves + 1e-9 * size).all(axis=2).any(axis=1)
    assert covered.all()


def test_a_region_leaves_gaps_between_parts_and_fills_voids() -> None:
    ring = np.array([[np.cos(t), np.sin(t)] for t in np.linspace(0.0, 2.0 * np.pi, 200)])
    region = Region.around(np.concatenate([ring, ring + np.array([5.0, 0.0])]), np.full(400, 0.05))
    places = np.array([[0.0, 0.0], [5.0, 0.0], [2.5, 0.0]])
    assert region.meets(places, np.zeros_like(places)).tolist() == [True, True, False]


class Askew(Rolled):
    """The same with other enclosures over wide boxes, true but useless: their middles reverse orientation."""

    def gradient_bounds(self, centres: np.ndarray, half_widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gradients, radii = super().gradient_bounds(centres, half_widths)
        wide = half_widths.max(axis=1) > 0.02
        gradients[wide] -= np.diag([3.0, 0.0])
        return gradients, radii + 3.0 * wide


def test_the_middle_of_a_wide_enclosure_is_not_taken_for_a_fold() -> None:
    found = prove_one_to_one(Askew(1.0), (1.0,), strip(), max_boxes=200_000, tick=lambda _: None)
    assert found.ended == ""
    assert found.margin > 0.0
