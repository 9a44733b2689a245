"""The command that makes the tables and the page of a study, and how a study is printed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, QuietOption, print_json

if TYPE_CHECKING:
    from musclefit.workflows.collect import Cohort

PASSED, FAILED = 0, 1

REASONS_SHOWN, OUTLIERS_SHOWN = 20, 10
"""In the terminal; all are on the page."""

ParquetOption = Annotated[
    bool, Parameter(name="--parquet", negative="", help="Write outcomes.parquet beside outcomes.csv (extra tables).")
]


def collect(
    folder: Annotated[Path, Parameter(help="The folder that musclefit batch wrote.")],
    /,
    *,
    parquet: ParquetOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Make the tables and the page of a study from the folders of its cases, wherever they were run."""
    from musclefit.workflows.collect import collect as make

    return print_cohort(make(folder, parquet=parquet), quiet=quiet, json=json)


def print_cohort(cohort: Cohort, *, quiet: bool, json: bool) -> int:
    """Print a study as far as it was run, and give the exit code."""
    if json:
        print_json(cohort.to_json())
    elif not quiet:
        _print_summary(cohort)
    return PASSED if cohort.passed else FAILED


def _print_summary(cohort: Cohort) -> None:
    from musclefit.workflows.collect import COHORT_HTML

    print(cohort.said())
    reasons = [outcome for outcome in cohort.outcomes if outcome.reason]
    for outcome in reasons[:REASONS_SHOWN]:
        print(f"  {outcome.name}: {outcome.status}: {outcome.reason}")
    if len(reasons) > REASONS_SHOWN:
        print(f"  {len(reasons) - REASONS_SHOWN} more did not pass; all are listed on the page and in outcomes.csv")
    for outlier in cohort.outliers[:OUTLIERS_SHOWN]:
        print(f"  outlier: {outlier.name}: {outlier.measure} {outlier.value:.4g}, median {outlier.median:.4g}")
    if (cohort.folder / COHORT_HTML).is_file():
        print(f"written: {cohort.folder / COHORT_HTML}")
