"""The command that puts finished runs, or sequences, side by side."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json

if TYPE_CHECKING:
    from rich.table import Table

    from musclefit.report.run_differences import Differences, Values

ROWS_SHOWN = 12
"""Of tissues, pairs and settings in the terminal; all are on the page."""

WIDTH = 160
"""Columns of the tables where there is no terminal."""


def compare(
    runs: Annotated[
        list[Path],
        Parameter(
            help="Folders written by musclefit run or musclefit sequence; the others are compared with the first."
        ),
    ],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name="--out", help="New folder for comparison.html and comparison.json. Without it nothing is written."
        ),
    ] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Compare finished runs: the settings and results that differ, by tissue and pair, and which run is better."""
    from musclefit.workflows.compare import COMPARISON_HTML
    from musclefit.workflows.compare import compare as put_beside

    made = put_beside(runs, out=out)
    if json:
        print_json(made.found.to_json())
    elif not quiet:
        _print(made.found)
        if made.folder is not None:
            print(f"written: {made.folder / COMPARISON_HTML}")
    return 0


def _print(found: Differences) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH)
    for letter, run, verdict, claim, mesh in zip(
        found.letters, found.runs, found.verdicts, found.claims, found.mesh_claims, strict=True
    ):
        known = claim if found.frames else f"map {claim}, mesh {mesh}"
        console.print(Text(f"{letter}: {run}: {verdict}; {known}"))
    what = "sequence" if found.frames else "run"
    head = f"No {what} is better" if found.best is None else f"{found.letters[found.best]} is better"
    console.print(Text(f"{head}: {found.because}."))
    for note in found.notes:
        console.print(Text(f"Note: {note}."))
    for table, left in _tables(found):
        console.print(table)
        if left:
            console.print(Text(f"... and {left} more; --out writes all to a page"))


def _tables(found: Differences) -> Iterator[tuple[Table, int]]:
    letters = found.letters
    if found.settings:
        yield _table("Set otherwise", ["", *letters], [[row.name, *row.values] for row in found.settings])
    measures = [[row.name, row.unit, *_cells(row.values, row.best)] for row in found.measures if any(row.values)]
    yield _table("Checks and measures (* better)", ["", "unit", *letters], measures, shown=len(measures))
    tissues = [
        [
            row.name,
            *_cells(row.apart_mm[1:]),
            *_cells(row.volume_change_percent, row.best if row.kind == "muscle" else ()),
            *_cells(row.rigidity_mm, row.best if row.kind == "bone" else ()),
        ]
        for row in found.tissues
    ]
    heads = ["", *(f"{x} apart mm" for x in letters[1:]), *(f"{x} volume %" for x in letters)]
    yield _table("Tissues that differ most", [*heads, *(f"{x} off rigid mm" for x in letters)], tissues)
    frames = [
        [
            f"{row.time_s:.4g}",
            *_cells(row.apart_mm[1:]),
            *_cells(row.muscle_change_percent),
            *_cells(row.introduced_mm3),
        ]
        for row in found.frames
    ]
    if frames:
        heads = ["time s", *(f"{x} apart mm" for x in letters[1:]), *(f"{x} muscle %" for x in letters)]
        yield _table("Frames", [*heads, *(f"{x} introduced mm³" for x in letters)], frames)
    pairs = [
        [f"{row.a} / {row.b}", *_cells(row.introduced_mm3, row.best), *_cells(row.deformed_mm3)] for row in found.pairs
    ]
    if pairs:
        heads = ["", *(f"{x} introduced mm³" for x in letters), *(f"{x} deformed mm³" for x in letters)]
        yield _table("Pairs that differ most", heads, pairs)


def _table(title: str, heads: list[str], rows: list[list[str]], *, shown: int = ROWS_SHOWN) -> tuple[Table, int]:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left")
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number and title != "Set otherwise" else "left", overflow="fold")
    for row in rows[:shown]:
        table.add_row(*(Text(cell) for cell in row))
    return table, max(0, len(rows) - shown)


def _cells(values: Values, best: tuple[int, ...] = ()) -> list[str]:
    return ["-" if v is None else f"{v:.4g}{' *' if k in best else ''}" for k, v in enumerate(values)]
