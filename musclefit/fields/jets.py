"""Functions over boxes: value and gradient at the centres, and proved bounds of how far they get from these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Int, Points

SLACK = 1.0 + 1e-12
"""What rounding may add to a length."""

ROUNDING = 1e-9
"""What it may add to a value: they are millimetres, or numbers from 0 to 1."""


@dataclass(frozen=True, eq=False, slots=True)
class Jets:
    """One function over each of B boxes.

    Parameters
    ----------
    value : (B,) float64
        At the centre.
    slope : (B, 3) float64
        Its gradient there.
    low, high : (B,) float64
        No value of the box is outside.
    steep : (B,) float64
        No gradient of the box is longer.
    off : (B,) float64
        None is farther from ``slope``.
    """

    value: Float
    slope: Points
    low: Float
    high: Float
    steep: Float
    off: Float

    def widened(self, by: float) -> Self:
        """With values known to a length only."""
        return type(self)(self.value, self.slope, self.low - by, self.high + by, self.steep, self.off)

    def within(self, reach: Float) -> Jets:
        """With values as near to the centre's as their slopes say; no place is farther than ``reach`` (B,) from it."""
        length = np.minimum(self.steep, np.linalg.norm(self.slope, axis=1) + self.off)
        around = np.where(np.isfinite(length), length * reach, np.inf) * SLACK + ROUNDING
        low, high = np.maximum(self.low, self.value - around), np.minimum(self.high, self.value + around)
        return Jets(self.value, self.slope, low, high, self.steep, self.off)

    def varied(self) -> Float:
        """(B,) how far values get from that at the centre."""
        return np.maximum(self.high - self.value, self.value - self.low)

    def minus(self, other: Jets, reach: Float) -> Jets:
        """The difference; no place of a box is farther than ``reach`` (B,) from its centre."""
        value, slope = self.value - other.value, self.slope - other.slope
        off = (self.off + other.off) * SLACK
        steep = np.minimum(self.steep + other.steep, np.linalg.norm(slope, axis=1) + off) * SLACK
        return Jets(value, slope, self.low - other.high, self.high - other.low, steep, off).within(reach)

    def risen(self, start: float, over: float) -> Jets:
        """A smooth step of it: 0 up to ``start``, 1 from ``over`` more on, level at both ends: 3 t² - 2 t³."""
        t, first, last = (np.clip((v - start) / over, 0.0, 1.0) for v in (self.value, self.low, self.high))
        rate, rates = _rate(t), np.stack([_rate(first), _rate(last)])
        top = np.where((first < 0.5) & (last > 0.5), 1.5, rates.max(axis=0))
        rises: Bool = (last > 0.0) & (first < 1.0)
        apart = np.maximum(top - rate, rate - rates.min(axis=0))
        steep = np.where(rises, top * self.steep / over, 0.0)
        length = np.minimum(np.linalg.norm(self.slope, axis=1), self.steep)
        off = np.where(rises, (top * self.off + apart * length) / over, 0.0)
        slope = (rate / over)[:, None] * self.slope
        return Jets(_step(t), slope, _step(first), _step(last), steep * SLACK, off * SLACK)

    def complement(self) -> Jets:
        """What it leaves of 1."""
        return Jets(1.0 - self.value, -self.slope, 1.0 - self.high, 1.0 - self.low, self.steep, self.off)

    def times(self, other: Jets) -> Jets:
        """The product of two that are not negative."""
        steep = self.high * other.steep + other.high * self.steep
        off = self.varied() * other.steep + self.value * other.off
        off += other.varied() * self.steep + other.value * self.off
        slope = self.value[:, None] * other.slope + other.value[:, None] * self.slope
        off = np.minimum(off, steep + np.linalg.norm(slope, axis=1))
        low, high = self.low * other.low, self.high * other.high
        return Jets(self.value * other.value, slope, low, high, steep * SLACK, off * SLACK)

    def only(self, kept: Int) -> Jets:
        """Of some boxes."""
        parts = (self.value, self.slope, self.low, self.high, self.steep, self.off)
        return Jets(*(part[kept] for part in parts))


def _step(t: Float) -> Float:
    return t * t * (3.0 - 2.0 * t)


def _rate(t: Float) -> Float:
    return 6.0 * t * (1.0 - t)
