"""Result and what it is compared with side by side: what folds, overlaps, bends and shrinks; knows rows, not pages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import median

from musclefit.anatomy.model import TissueKind
from musclefit.report.model import Report, Side, checks_against
from musclefit.rig.settings import Limits
from musclefit.validate.model import TissueCheck


@dataclass(frozen=True, slots=True)
class Cell:
    """One number of one method: NaN when it could not be measured, None when the run has no such thing.

    ``passed`` holds it against its limit, None where there is none and it could be measured.
    """

    value: float | None
    passed: bool | None = None
    place: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity; ``group`` is what it tells about (Folding, Overlap, Bones, Muscles, Landmarks)."""

    group: str
    name: str
    unit: str
    limit: float | None
    result: Cell
    baseline: Cell | None
    paper_loop: Cell | None = None


def compare(report: Report) -> tuple[Row, ...]:
    """The rows of the summary, in reading order.

    Parameters
    ----------
    report : Report

    Returns
    -------
    tuple of Row
        ``baseline`` and ``paper_loop`` are None in every row of a report without one. A row that no side has is left
        out.
    """
    result, baseline, loop = (
        None if side is None else _cells(side, report.limits)
        for side in (report.result, report.baseline, report.paper_loop)
    )
    assert result is not None
    rows = []
    for group, name, unit in _ROWS:
        one_shot, looped = (None if side is None else side[name][0] for side in (baseline, loop))
        cell, limit = result[name]
        if all(one is None or one.value is None for one in (cell, one_shot, looped)):
            continue
        rows.append(Row(group, name, unit, limit, cell, one_shot, looped))
    return tuple(rows)


def worst_first(tissues: tuple[TissueCheck, ...], limits: Limits) -> tuple[TissueCheck, ...]:
    """Tissues by how far they are from keeping their limits, the worst first.

    Each is ranked by its largest share of a limit (rigidity of bones, volume of muscles, volume outside the skin), then
    by the size of its volume change; a number that is missing where there should be one comes before all others.
    """
    return tuple(sorted(tissues, key=lambda t: (-_strain(t, limits), -_size(t.volume_change_percent), t.name)))


_NO_ROOM = 1e-200
"""Stands for a limit of zero, so that the shares of it still tell more from less."""

_ROWS = (
    ("Folding", "folded points", "points"),
    ("Folding", "smallest det J at a point", ""),
    ("Folding", "inverted tets", "tets"),
    ("Folding", "smallest tet volume ratio", ""),
    ("Overlap", "introduced overlap", "mm³"),
    ("Overlap", "grown overlap", "mm³"),
    ("Overlap", "pairs that overlap more than at rest", "pairs"),
    ("Overlap", "introduced outside skin", "mm³"),
    ("Bones", "bone off rigid", "mm"),
    ("Bones", "free bone off rigid", "mm"),
    ("Muscles", "muscle volume change", "%"),
    ("Muscles", "muscle volume change, median", "%"),
    ("Landmarks", "landmark error", "mm"),
    ("Landmarks", "steps", ""),
)


def _cells(side: Side, limits: Limits) -> dict[str, tuple[Cell, float | None]]:
    """Every row's cell and limit for one method."""
    cells: dict[str, tuple[Cell, float | None]] = {
        check.name: (
            Cell(check.value, None if check.passed and not check.limited else check.passed, check.place),
            check.limit if check.limited else None,
        )
        for check in checks_against(limits, side)
    }
    changes = [abs(t.volume_change_percent) for t in side.of_kind(TissueKind.MUSCLE)]
    introduced = [p for p in side.overlaps.pairs if not p.introduced_mm3 <= 0]
    free = {
        "smallest det J at a point": side.map.min_jacobian_determinant,
        "smallest tet volume ratio": None if side.mesh is None else side.mesh.min_volume_ratio,
        "pairs that overlap more than at rest": float(len(introduced)),
        "muscle volume change, median": None if not changes else _median(changes),
        "steps": float(side.steps),
    }
    cells |= {name: (Cell(value), None) for name, value in free.items()}
    return {name: cells.get(name, (Cell(None), None)) for _, name, _ in _ROWS}


def _median(values: list[float]) -> float:
    return median(values) if all(math.isfinite(v) for v in values) else math.nan


def _strain(tissue: TissueCheck, limits: Limits) -> float:
    shares = []
    if tissue.kind == TissueKind.BONE:
        shares.append(_share(tissue.rigidity_mm, limits.bone_rigidity_mm))
    if tissue.kind == TissueKind.MUSCLE:
        shares.append(_share(tissue.volume_change_percent, limits.muscle_volume_percent))
    if tissue.outside_skin_introduced_mm3 is not None:
        shares.append(_share(tissue.outside_skin_introduced_mm3, limits.introduced_outside_skin_mm3))
    return max(shares, default=0.0)


def _share(value: float | None, limit: float | None) -> float:
    """How much of the limit a value uses, nothing where there is none; infinite when missing."""
    size = _size(value)
    if math.isinf(size):
        return size
    return 0.0 if limit is None else size / max(limit, _NO_ROOM)


def _size(value: float | None) -> float:
    return math.inf if value is None or math.isnan(value) else abs(value)
