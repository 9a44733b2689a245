"""Functions over boxes: value and gradient at the centres, and proved bounds of how far they get from these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from musclefit.geometry.arrays import Bool, Float, Gradients, Int, Points

SLACK = 1.0 + 1e-12
"""What rounding may add to a length."""

ROUNDING = 1e-9
"""What it may add to a value: they are millimetres, or numbers from 0 to 1."""


@dataclass(frozen=True, eq=False, slots=True)
class Turn:
    """A part of how far gradients get from that at the centre, along known directions.

    Parameters
    ----------
    along : (B, 3) float64
        Unit vectors, or zero.
    most : (B,) float64
        The part is no more than this times ``along``, either way.
    """

    along: Points
    most: Float


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
    loose : (B,) float64
        No gradient is farther from ``slope`` than this, beside the turns.
    turns : tuple of Turn
    """

    value: Float
    slope: Points
    low: Float
    high: Float
    steep: Float
    loose: Float
    turns: tuple[Turn, ...] = ()

    @property
    def off(self) -> Float:
        """(B,) how far gradients get from that at the centre, in length."""
        total = self.loose
        for turn in self.turns:
            total = total + turn.most
        return total

    def sheared(self, vectors: Points, slack: Float) -> Float:
        r"""(B,) how far the strain of :math:`v \otimes \nabla f` gets from that at the centre, v constant.

        The strain of v along a direction n has the eigenvalues (v n ± |v|) / 2 for a unit n.

        Parameters
        ----------
        vectors : (B, 3) float64
            v
        slack : (B,) float64
            How far they may be off.
        """
        length = np.linalg.norm(vectors, axis=1) * SLACK
        total: Float = (length + slack) * self.loose
        for turn in self.turns:
            with_it = np.abs(np.einsum("bi,bi->b", vectors, turn.along))
            total = total + (0.5 * (length + with_it) * SLACK + slack) * turn.most
        return total

    def sheared_by(self, matrices: Gradients, half_widths: Float, most: Float) -> Float:
        r"""(B,) the largest eigenvalues of the strain of :math:`M d \otimes \nabla f`, d from the centre of a box.

        As in `sheared`: of vectors v and n they are :math:`(v n ± |v||n|) / 2`, so half as large where both are normal
        to one another.

        Parameters
        ----------
        matrices : (B, 3, 3) float64
            M
        half_widths : (B, 3) float64, mm
        most : (B,) float64
            At least as long as any M d.
        """
        along = np.abs(np.einsum("bij,bi->bj", matrices, self.slope))
        with_it = np.einsum("bj,bj->b", along, half_widths) + _where(most > 0.0, most, self.off)
        alone = _where(most > 0.0, most, self.steep)
        sheared: Float = 0.5 * (alone + np.minimum(with_it, alone)) * SLACK
        return sheared

    def widened(self) -> Self:
        """With values as computed, which rounding has put off."""
        return replace(self, low=self.low - ROUNDING, high=self.high + ROUNDING)

    def within(self, reach: Float) -> Self:
        """With values as near to the centre's as their slopes say; no place is farther than ``reach`` (B,) from it."""
        length = np.minimum(self.steep, np.linalg.norm(self.slope, axis=1) + self.off)
        around = _where(np.isfinite(length), length, reach, otherwise=np.inf) * SLACK + ROUNDING
        return replace(
            self, low=np.maximum(self.low, self.value - around), high=np.minimum(self.high, self.value + around)
        )

    def varied(self) -> Float:
        """(B,) how far values get from that at the centre."""
        return np.maximum(self.high - self.value, self.value - self.low)

    def minus(self, other: Jets, reach: Float) -> Jets:
        """The difference of two without turns; no place of a box is farther than ``reach`` (B,) from its centre."""
        value, slope = self.value - other.value, self.slope - other.slope
        loose = (self.loose + other.loose) * SLACK
        steep = np.minimum(self.steep + other.steep, np.linalg.norm(slope, axis=1) + loose) * SLACK
        return Jets(value, slope, self.low - other.high, self.high - other.low, steep, loose).within(reach)

    def risen(self, start: float, over: float) -> Jets:
        """A smooth step of one that has no turns: 0 up to ``start``, 1 from ``over`` more on, level at both ends."""
        t, first, last = (np.clip((v - start) / over, 0.0, 1.0) for v in (self.value, self.low, self.high))
        rate, rates = _rate(t), np.stack([_rate(first), _rate(last)])
        top = np.where((first < 0.5) & (last > 0.5), 1.5, rates.max(axis=0))
        rises: Bool = (last > 0.0) & (first < 1.0)
        apart = np.maximum(top - rate, rate - rates.min(axis=0))
        steep = _where(rises, top / over, self.steep)
        length = np.linalg.norm(self.slope, axis=1)
        along = self.slope / np.where(length > 0.0, length, 1.0)[:, None]
        turn = Turn(along, np.where(rises, apart * length / over, 0.0) * SLACK)
        loose = _where(rises, top / over, self.loose) * SLACK
        return Jets(
            _step(t), (rate / over)[:, None] * self.slope, _step(first), _step(last), steep * SLACK, loose, (turn,)
        )

    def complement(self) -> Jets:
        """What it leaves of 1."""
        return replace(self, value=1.0 - self.value, slope=-self.slope, low=1.0 - self.high, high=1.0 - self.low)

    def times(self, other: Jets) -> Jets:
        """The product of two that are not negative.

        With f and g at the centre as f0 and g0, its gradient is off by (f - f0) g0' + f (g' - g0') and the same with
        both exchanged.
        """
        steep = self.high * other.steep + other.high * self.steep
        slope = self.value[:, None] * other.slope + other.value[:, None] * self.slope
        turns, loose = [], np.zeros_like(self.value)
        for one, two in ((other, self), (self, other)):
            loose = loose + one.high * two.loose
            turns += [Turn(turn.along, one.high * turn.most * SLACK) for turn in two.turns]
            length = np.linalg.norm(two.slope, axis=1)
            along = two.slope / np.where(length > 0.0, length, 1.0)[:, None]
            turns.append(Turn(along, one.varied() * length * SLACK))
        low, high = self.low * other.low, self.high * other.high
        return Jets(self.value * other.value, slope, low, high, steep * SLACK, loose * SLACK, tuple(turns))

    def only(self, kept: Int) -> Jets:
        """Of some boxes."""
        turns = tuple(Turn(turn.along[kept], turn.most[kept]) for turn in self.turns)
        return Jets(
            self.value[kept],
            self.slope[kept],
            self.low[kept],
            self.high[kept],
            self.steep[kept],
            self.loose[kept],
            turns,
        )

    def put(self, places: Int, others: Jets) -> Jets:
        """With those of some boxes in place of its own; they have at least as many turns."""

        def joined(own: Float, theirs: Float) -> Float:
            whole = own.copy()
            whole[places] = theirs
            return whole

        none = Turn(np.zeros_like(self.slope), np.zeros_like(self.value))
        own = (*self.turns, *(none for _ in others.turns[len(self.turns) :]))
        turns = tuple(
            Turn(joined(here.along, there.along), joined(here.most, there.most))
            for here, there in zip(own, others.turns, strict=True)
        )
        return Jets(
            joined(self.value, others.value),
            joined(self.slope, others.slope),
            joined(self.low, others.low),
            joined(self.high, others.high),
            joined(self.steep, others.steep),
            joined(self.loose, others.loose),
            turns,
        )

    def times_some(self, places: Int, other: Jets) -> Jets:
        """The product with one that is 1 but over some boxes, those that are given; neither is negative."""
        return self.put(places, self.only(places).times(other))

    def with_few_turns(self, count: int) -> Jets:
        """With at most so many turns of each box, the largest; the others count in any direction."""
        if len(self.turns) <= count:
            return self
        most = np.array([turn.most for turn in self.turns])
        order = np.argpartition(-most, count - 1, axis=0)
        boxes = np.arange(len(self.value))
        along = np.array([turn.along for turn in self.turns])
        kept = tuple(Turn(along[row, boxes], most[row, boxes]) for row in order[:count])
        rest = np.take_along_axis(most, order[count:], axis=0).sum(axis=0)
        return replace(self, loose=(self.loose + rest) * SLACK, turns=kept)


def _where(some: Bool, a: Float, b: Float, *, otherwise: float = 0.0) -> Float:
    """Products in some places only: elsewhere one of the two may be infinite."""
    product: Float = np.multiply(a, b, where=some, out=np.full(np.shape(b), otherwise))
    return product


def _step(t: Float) -> Float:
    return t * t * (3.0 - 2.0 * t)


def _rate(t: Float) -> Float:
    return 6.0 * t * (1.0 - t)
