"""Branch and bound over boxes: proves a step's condition on every point of a convex domain, or says where it cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from musclefit.certify.domains import Hull
from musclefit.certify.strain import Condition, eigenvalue_rounding, strain_ranges, symmetric_eigenvalues
from musclefit.fields.protocol import Field
from musclefit.geometry.arrays import Bool, Float, Points

FIRST_CELLS = 1000
"""Boxes that a domain is cut into at first."""

BATCH = 8192
"""Boxes that are evaluated at once."""

SMALLEST = 1e-8
"""Of the domain's extent: boxes this narrow are not cut further."""

SMALL_ENOUGH = 1e-4
"""Of the domain's extent: boxes this narrow are done with any proved margin, whatever its share of the sampled one."""

OVERLAP = 1e-12
"""Of the coordinates: boxes are evaluated a little larger, so that no rounding of their centres leaves a gap."""

AT_LIMIT = 1e-12
"""Sampled margins up to this are told from none by no proof: rounding is as large."""

KEPT = 32
"""Places with the smallest sampled margins that are kept."""


@dataclass(frozen=True, eq=False, slots=True)
class BoxProof:
    """What branch and bound found of one step's condition on one domain.

    Parameters
    ----------
    margin : float
        Proved on the whole domain when positive. Otherwise no proof was found.
    sampled_margin : float
        Smallest at the centres of boxes; the true one is at most this, and the proved one too.
    places : (K, n) float64, mm
        Centres with the smallest sampled margins, worst first.
    examined, left : int
        Boxes evaluated, and boxes on which the condition stayed unproved.
    fails : bool
        The condition is proved not to hold at ``places[0]``: no more boxes can help.
    ended : str
        Why there is no proof, in words; empty where there is one.
    """

    margin: float
    sampled_margin: float
    places: Points
    examined: int
    left: int
    fails: bool
    ended: str


class _Search:
    """The state of one search; its boxes shrink until all pass, one fails for certain, or the budget is spent."""

    def __init__(self, field: Field, condition: Condition, hull: Hull, share: float) -> None:
        self.field, self.condition, self.hull, self.share = field, condition, hull, share
        n = len(hull.low)
        self.proved, self.examined = np.inf, 0
        self.places, self.samples = np.zeros((0, n)), np.zeros(0)
        self.fails = False
        self.overlap = OVERLAP * float(np.abs([hull.low, hull.high]).max())

    @property
    def needed(self) -> float:
        """The margin that a box must show: a share of the smallest sampled one."""
        return max(self.share * float(self.samples[0]), 0.0) if len(self.samples) else 0.0

    def evaluate(self, centres: Points, halves: Float) -> tuple[Float, Float]:
        """Proved and sampled margins of boxes."""
        proved, sampled = np.empty(len(centres)), np.empty(len(centres))
        for start in range(0, len(centres), BATCH):
            part = slice(start, start + BATCH)
            ranges, middles = strain_ranges(
                self.field,
                centres[part],
                halves[part] * (1.0 + 1e-9) + self.overlap,
                enough=self.condition.enough(max(self.needed, 1e-3)),
            )
            proved[part] = self.condition.margins(ranges)
            known = ~np.isnan(middles).any(axis=1)
            sampled[part] = np.where(known, self.condition.margins(middles), np.nan)
            self._keep(centres[part][known], sampled[part][known])
        self.examined += len(centres)
        return proved, sampled

    def _keep(self, centres: Points, sampled: Float) -> None:
        worst = np.argsort(sampled)[: 4 * KEPT]
        worst = worst[self.hull.contains(centres[worst])]
        places, samples = np.concatenate([self.places, centres[worst]]), np.concatenate([self.samples, sampled[worst]])
        order = np.argsort(samples, kind="stable")[:KEPT]
        self.places, self.samples = places[order], samples[order]

    def failing(self) -> bool:
        """True when the condition is proved not to hold at a kept place; that one comes first then."""
        suspects = np.flatnonzero(self.samples <= 0.0)
        if not suspects.size:
            return False
        failing = suspects[condition_fails(self.field, self.condition, self.places[suspects])]
        if failing.size:
            order = np.concatenate([failing[:1], np.delete(np.arange(len(self.samples)), failing[0])])
            self.places, self.samples, self.fails = self.places[order], self.samples[order], True
        return self.fails


def condition_fails(field: Field, condition: Condition, points: Points) -> Bool:
    """(N,) where a step's condition is proved not to hold."""
    gradients, radii = field.gradient_bounds(points, np.zeros_like(points))
    values = symmetric_eigenvalues(gradients)
    off = radii + eigenvalue_rounding(gradients)
    fails: Bool = (values[:, 0] + off < -condition.low) | (values[:, -1] - off > condition.high)
    return fails


def prove(
    field: Field,
    condition: Condition,
    hull: Hull,
    *,
    max_boxes: int,
    margin_share: float,
    tick: Callable[[float], None],
) -> BoxProof:
    """Prove a step's condition everywhere in a hull.

    Boxes whose proved margin is at least ``margin_share`` of the smallest sampled one are done; the others are cut in
    two, four or eight, by how much they lack. ``tick`` is told the share of the budget used.
    """
    search = _Search(field, condition, hull, margin_share)
    centres, halves = hull.cells(FIRST_CELLS)
    inherited = np.full(len(centres), -np.inf)  # proved margins of the boxes these were cut from
    extent = float((hull.high - hull.low).max())
    too_small = False
    while len(centres) and search.examined + len(centres) <= max_boxes:
        proved, sampled = search.evaluate(centres, halves)
        if search.failing():
            break
        proved = np.maximum(proved, inherited)
        width = halves.max(axis=1)
        stuck = width < SMALLEST * extent
        done = (proved > 0.0) & ((proved >= search.needed) | (width < SMALL_ENOUGH * extent))
        search.proved = min(search.proved, float(proved[done].min(initial=np.inf)))
        centres, halves, inherited, sampled = centres[~done], halves[~done], proved[~done], sampled[~done]
        too_small = bool(stuck[~done].any())
        if too_small:
            break
        centres, halves, inherited = _cut(centres, halves, inherited, sampled, search.needed)
        kept = hull.meets(centres, halves + search.overlap)
        centres, halves, inherited = centres[kept], halves[kept], inherited[kept]
        tick(min(1.0, search.examined / max_boxes))
    margin = -np.inf if search.fails else min(search.proved, float(inherited.min(initial=np.inf)))
    return BoxProof(
        margin=margin,
        sampled_margin=float(search.samples[0]) if len(search.samples) else np.inf,
        places=search.places,
        examined=search.examined,
        left=int(np.sum(~(inherited > 0.0))),
        fails=search.fails,
        ended="" if margin > 0.0 else _why(search, too_small=too_small, max_boxes=max_boxes, waiting=len(centres)),
    )


def _why(search: _Search, *, too_small: bool, max_boxes: int, waiting: int) -> str:
    """Why a search ended without a proof."""
    if search.fails:
        return "the sufficient condition is proved not to hold at the worst place"
    worst = float(search.samples[0]) if len(search.samples) else np.nan
    if worst <= AT_LIMIT:
        return f"the condition is at its limit at the worst place (sampled margin {worst:.3g}): no more boxes can help"
    if too_small:
        return (
            f"boxes of {SMALLEST:g} of the domain's extent are not proved and no smaller ones help: the field has no "
            f"close bounds there (smallest sampled margin {worst:.3g})"
        )
    return (
        f"the budget of boxes is spent: {waiting} more were to be examined after {search.examined}, of at most "
        f"{max_boxes} that this step had left"
    )


def _cut(centres: Points, halves: Float, proved: Float, sampled: Float, needed: float) -> tuple[Points, Float, Float]:
    """Cut boxes along one, two or three of their longest sides, the more the further their proof is from sufficing."""
    n = centres.shape[1]
    room = sampled - needed
    lacks = np.divide(sampled - proved, room, out=np.full_like(room, np.inf), where=room > 0.0)
    cuts = np.minimum(1 + (lacks > 1.6).astype(int) + (lacks > 2.4), n)
    parts = []
    order = np.argsort(-halves, axis=1, kind="stable")
    for count in range(1, n + 1):
        chosen = np.flatnonzero(cuts == count)
        if not chosen.size:
            continue
        here, half, axes = centres[chosen], halves[chosen].copy(), order[chosen, :count]
        rows = np.arange(len(chosen))
        for k in range(count):
            half[rows, axes[:, k]] *= 0.5
        for signs in np.ndindex(*(2,) * count):
            moved = here.copy()
            for k, sign in enumerate(signs):
                moved[rows, axes[:, k]] += (2 * sign - 1) * half[rows, axes[:, k]]
            parts.append((moved, half, proved[chosen]))
    whole = [np.concatenate([part[i] for part in parts]) for i in range(3)] if parts else [centres, halves, proved]
    return whole[0], whole[1], whole[2]
