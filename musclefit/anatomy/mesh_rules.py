"""What is asked of a layered mesh: who wins where tissues overlap, how fine and true each one is; opens no file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Float
from musclefit.geometry.measures import enclosed_volume

if TYPE_CHECKING:
    from musclefit.geometry.tets.sizing import SizingField

# SciPy is imported where it is used: every rig has settings of layers, and ``musclefit --help`` should be quick.

FILLER = "filler"
"""What fills the room between the tissues and the skin: fat, fascia, vessels, whatever has no surface of its own."""

GROWTH = 0.3
"""How much longer edges may be per mm away from where short ones are asked for."""


class Gaps(StrEnum):
    """Which gaps between tissues are meshed finer."""

    NONE = "none"
    JOINTS = "joints"
    ALL = "all"


@dataclass(frozen=True, slots=True)
class LayerRules:
    """How tissues are layered.

    Parameters
    ----------
    edge_length_fraction : float in (0, 1]
        Edge length aimed at, as a fraction of the bounding box's diagonal.
    envelope_fraction : float in (0, 1]
        How far the tets' surfaces may be from the tissues', as a fraction of the bounding box's diagonal.
    priority : tuple of str
        Kinds, and names of tissues or shell-style patterns of them, first wins: where surfaces overlap, the tets are
        the first one's. Tissues that no entry fits come after, the skin always last; within an entry the smaller
        tissue wins.
    edge_length_mm, envelope_mm : tuple of (name or pattern, mm)
        For single tissues, ahead of the fractions; the first pattern that fits counts. There is one envelope for all
        surfaces together, the smallest that any tissue asks for.
    gaps : Gaps
        Which gaps are meshed finer: between bones, or between any two tissues.
    gap_ratio : float, > 0
        Edge length in a gap, over the gap's width ...
    gap_edge_mm : float, > 0, mm
        ... but not below this.
    """

    edge_length_fraction: float
    envelope_fraction: float
    priority: tuple[str, ...] = (TissueKind.BONE, TissueKind.MUSCLE, TissueKind.OTHER)
    edge_length_mm: tuple[tuple[str, float], ...] = ()
    envelope_mm: tuple[tuple[str, float], ...] = ()
    gaps: Gaps = Gaps.NONE
    gap_ratio: float = 4.0
    gap_edge_mm: float = 2.0

    def require_sane(self, anatomy: Anatomy) -> None:
        """Raise InputError where a number is out of range or a name fits no tissue."""
        for key, value in (
            ("edge_length_fraction", self.edge_length_fraction),
            ("envelope_fraction", self.envelope_fraction),
        ):
            if not 0.0 < value <= 1.0:
                raise InputError(
                    f"{key} is {value}; give a fraction of the bounding box's diagonal, above 0 and up to 1"
                )
        own = [("edge_length_mm", *item) for item in self.edge_length_mm]
        own += [("envelope_mm", *item) for item in self.envelope_mm]
        for key, pattern, length in own:
            if not 0.0 < length < np.inf:
                raise InputError(f"{key} of {pattern!r} is {length}; give a length above 0, mm")
            _require_a_tissue(anatomy, pattern, key=key)
        for name, length in (("gap_ratio", self.gap_ratio), ("gap_edge_mm", self.gap_edge_mm)):
            if not 0.0 < length < np.inf:
                raise InputError(f"{name} is {length}; give a number above 0")
        for entry in self.priority:
            if entry not in set(TissueKind):
                _require_a_tissue(anatomy, entry, key="priority")
            skin = anatomy.skin
            if skin is not None and _fits(entry, skin):
                raise InputError(
                    f"priority names the skin ({entry!r}), which always comes last: it holds what no other tissue does"
                )

    def innermost_first(self, anatomy: Anatomy) -> tuple[int, ...]:
        """Numbers of the anatomy's tissues in the order in which they win."""

        def rank(item: tuple[int, Tissue]) -> tuple[bool, int, int, float]:
            tissue = item[1]
            place = next((k for k, entry in enumerate(self.priority) if _fits(entry, tissue)), len(self.priority))
            return (
                tissue.kind is TissueKind.SKIN,
                place,
                -list(TissueKind).index(tissue.kind),
                enclosed_volume(tissue.surface),
            )

        return tuple(index for index, _ in sorted(enumerate(anatomy), key=rank))

    def envelope_of(self, tissue: Tissue, *, diagonal_mm: float) -> float:
        """The envelope that a tissue asks for, mm."""
        return _own(self.envelope_mm, tissue, self.envelope_fraction * diagonal_mm)

    def smallest_envelope(self, anatomy: Anatomy) -> float:
        """The envelope of the mesh, which is one for all surfaces, as a fraction of the diagonal."""
        diagonal = diagonal_mm(anatomy)
        return min(self.envelope_of(tissue, diagonal_mm=diagonal) for tissue in anatomy) / diagonal

    def sizing(self, anatomy: Anatomy) -> SizingField:
        """Where edges are shorter than the general length: near tissues that ask for it, and in gaps."""
        from musclefit.geometry.tets.sizing import NO_SIZING, sizing_field

        coarsest = self.edge_length_fraction * diagonal_mm(anatomy)
        places, lengths = [], []
        for tissue in anatomy:
            own = _own(self.edge_length_mm, tissue, coarsest)
            if own < coarsest:
                places.append(tissue.surface.vertices)
                lengths.append(np.full(len(tissue.surface.vertices), own))
        widths = gap_widths(anatomy, gaps=self.gaps, up_to_mm=coarsest / self.gap_ratio)
        for name, width in widths.items():
            narrow = np.isfinite(width)
            places.append(anatomy[name].surface.vertices[narrow])
            lengths.append(np.maximum(self.gap_ratio * width[narrow], self.gap_edge_mm))
        if not places:
            return NO_SIZING
        return sizing_field(np.concatenate(places), np.concatenate(lengths), coarsest_mm=coarsest, growth=GROWTH)


def gap_widths(anatomy: Anatomy, *, gaps: Gaps, up_to_mm: float) -> Mapping[str, Float]:
    """Distance of each vertex from the nearest other tissue, mm; infinite beyond ``up_to_mm``.

    Parameters
    ----------
    anatomy : Anatomy
    gaps : Gaps
        Which tissues count: bones alone, or all but the skin.
    up_to_mm : float
    """
    if gaps is Gaps.NONE:
        return {}
    tissues = [t for t in anatomy if t.kind is TissueKind.BONE or (gaps is Gaps.ALL and t.kind is not TissueKind.SKIN)]
    from scipy.spatial import cKDTree

    from musclefit.geometry.queries.distances import nearest_places

    trees = [cKDTree(t.surface.vertices) for t in tissues]
    found = {}
    for k, tissue in enumerate(tissues):
        vertices = tissue.surface.vertices
        width = np.full(len(vertices), np.inf)
        for j in _neighbours(tissues, k, up_to_mm):
            longest = _longest_edge(tissues[j])
            near, _ = trees[j].query(vertices, distance_upper_bound=up_to_mm + longest)
            asked = np.flatnonzero(np.isfinite(near))
            if len(asked):
                exact = nearest_places(vertices[asked], tissues[j].surface).distances
                width[asked] = np.minimum(width[asked], np.where(exact <= up_to_mm, exact, np.inf))
        found[tissue.name] = width
    return found


def diagonal_mm(anatomy: Anatomy) -> float:
    """Diagonal of the anatomy's bounding box, mm."""
    return float(np.linalg.norm(np.ptp(anatomy.vertices(), axis=0)))


def _neighbours(tissues: Sequence[Tissue], k: int, within: float) -> list[int]:
    """Numbers of other tissues whose boxes come within a distance of the k-th's."""
    boxes = [(t.surface.vertices.min(axis=0), t.surface.vertices.max(axis=0)) for t in tissues]
    low, high = boxes[k][0] - within, boxes[k][1] + within
    return [j for j, (a, b) in enumerate(boxes) if j != k and bool((a <= high).all() and (b >= low).all())]


def _longest_edge(tissue: Tissue) -> float:
    corners = tissue.surface.corners()
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0.0))


def _own(table: Sequence[tuple[str, float]], tissue: Tissue, otherwise: float) -> float:
    return next((length for pattern, length in table if fnmatchcase(tissue.name, pattern)), otherwise)


def _fits(entry: str, tissue: Tissue) -> bool:
    return entry == tissue.kind.value if entry in set(TissueKind) else fnmatchcase(tissue.name, entry)


def _require_a_tissue(anatomy: Anatomy, pattern: str, *, key: str) -> None:
    if not any(fnmatchcase(tissue.name, pattern) for tissue in anatomy):
        raise InputError(f"{key}: no tissue is named {pattern!r}; there are: {', '.join(t.name for t in anatomy)}")
