"""Which of two overlapping tissues loses what they share, and why; takes tissues and cuts none for good.

Between kinds the one further in keeps it. Within a kind, *least loss* lets the one lose it that gives up the smaller
share of its volume, unless that takes it past the largest change allowed, or apart, and would not do so to the other.
Pairs are decided one after the other, those between kinds first, the largest overlap first, and each sees what the
decisions before left of both: three that meet in one place leave it to one of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from musclefit.anatomy.model import Tissue, TissueKind
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Choice
from musclefit.geometry.measures import enclosed_volume


@dataclass(frozen=True, slots=True)
class Overlap:
    """Two tissues that overlap or touch, and the volume that they share as given, mm³."""

    a: str
    b: str
    volume_mm3: float


@dataclass(frozen=True, slots=True)
class Decision:
    """Who keeps and who loses an overlap, and why."""

    overlap: Overlap
    winner: str
    loser: str
    why: str


class Chooser:
    """Decides pairs in turn; knows what earlier decisions leave of each tissue.

    Parameters
    ----------
    tissues : mapping of name to Tissue
    solids : mapping of name to manifold3d.Manifold
    choice : Choice
    settings : RepairSettings
    """

    def __init__(
        self, tissues: Mapping[str, Tissue], solids: Mapping[str, Any], *, choice: Choice, settings: RepairSettings
    ) -> None:
        self._tissues = tissues
        self._choice, self._settings = choice, settings
        self._left = dict(solids)
        self._volumes = {name: enclosed_volume(tissue.surface) for name, tissue in tissues.items()}
        self._pieces = {name: len(self._whole_pieces(name, solid)) for name, solid in solids.items()}

    def decided(self, overlaps: Sequence[Overlap]) -> tuple[Decision, ...]:
        """Decide all pairs, in an order that is the same whatever the tissues' order."""
        return tuple(self._decided(overlap) for overlap in sorted(overlaps, key=self._turn))

    def before(self, one: str, other: str) -> tuple[str, str]:
        """The tissue that goes before and the other, by kind (unless any kind may lose), then the smaller first."""
        order = list(TissueKind)
        by_kind = {name: -order.index(self._tissues[name].kind) for name in (one, other)}
        if self._choice is Choice.ANY_KIND:
            by_kind = dict.fromkeys(by_kind, 0)
        first = min((one, other), key=lambda name: (by_kind[name], self._volumes[name], name))
        return first, other if first == one else one

    def _turn(self, overlap: Overlap) -> tuple[bool, float, tuple[str, str]]:
        return self._chosen(overlap), -overlap.volume_mm3, self.before(overlap.a, overlap.b)

    def _chosen(self, overlap: Overlap) -> bool:
        """Whether the pair is decided by what it would lose."""
        if self._choice is Choice.ANY_KIND:
            return True
        same = self._tissues[overlap.a].kind is self._tissues[overlap.b].kind
        return same and self._choice is Choice.LEAST_LOSS

    def _decided(self, overlap: Overlap) -> Decision:
        first, second = self.before(overlap.a, overlap.b)
        if self._chosen(overlap):
            return self._by_loss(overlap, first, second)
        self._left[second] -= self._left[first]
        kinds = [self._tissues[name].kind for name in (first, second)]
        why = f"the smaller {kinds[0].value}" if kinds[0] is kinds[1] else f"{kinds[0].value} before {kinds[1].value}"
        return Decision(overlap, first, second, f"priority: {why}")

    def _by_loss(self, overlap: Overlap, first: str, second: str) -> Decision:
        cut = {name: self._left[name] - self._left[other] for name, other in ((first, second), (second, first))}
        kept = {name: (self._kept(name, self._left[name]), self._kept(name, cut[name])) for name in cut}
        lost = {name: (before - after) / self._volumes[name] for name, (before, after) in kept.items()}
        fails = {name: self._fails(name, cut[name]) and not self._fails(name, self._left[name]) for name in cut}
        loser = min((second, first), key=lambda name: (fails[name], lost[name]))
        winner = first if loser == second else second
        self._left[loser] = cut[loser]
        why = f"least loss: {loser} loses {100.0 * lost[loser]:.3g} % of its volume, the other would lose "
        why += f"{100.0 * lost[winner]:.3g} %"
        if fails[winner] and lost[winner] < lost[loser]:
            apart = len(self._whole_pieces(winner, cut[winner])) > self._pieces[winner]
            most = f"{self._settings.max_change_percent:g} %"
            why += " and fall apart" if apart else f" and come to more than {most} in all"
        return Decision(overlap, winner, loser, why)

    def _fails(self, name: str, solid: Any) -> bool:
        """Whether so little is left of a tissue, or in so many pieces, that the repair fails."""
        change = 1.0 - solid.volume() / self._volumes[name]
        apart = len(self._whole_pieces(name, solid)) > self._pieces[name]
        return apart or 100.0 * change > self._settings.max_change_percent

    def _kept(self, name: str, solid: Any) -> float:
        """Volume of the largest pieces, as many as there were, less hollows and other pieces, mm³."""
        apart = sorted(self._whole_pieces(name, solid), reverse=True)[self._pieces[name] :]
        return float(solid.volume()) - sum(apart)

    def _whole_pieces(self, name: str, solid: Any) -> list[float]:
        """Volumes of a solid's pieces, hollows and strays left out."""
        least = 0.01 * self._settings.stray_percent * self._volumes[name]
        return [volume for volume in (part.volume() for part in solid.decompose()) if volume > least]
