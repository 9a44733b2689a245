"""The commands that run a study of many subjects, and collect what came of it."""

from __future__ import annotations

import json as json_text
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from musclefit.errors import InputError
from musclefit.workflows.progress import TimedStages

if TYPE_CHECKING:
    from musclefit.workflows.collect import Cohort

PASSED, FAILED = 0, 1

Quiet = Annotated[bool, Parameter(name="--quiet", negative="", help="Print nothing but errors.")]
Json = Annotated[bool, Parameter(name="--json", negative="", help="Print the outcomes as JSON, not a summary.")]
Parquet = Annotated[
    bool, Parameter(name="--parquet", negative="", help="Write outcomes.parquet beside outcomes.csv (extra tables).")
]


def batch(
    study: Annotated[Path, Parameter(help="A TOML file: subjects, rigs, motions, and what to set for each.")],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name=["--out", "-o"],
            help="Folder for the results; what is done there is kept. Without it: musclefit-out/ and the study's name.",
        ),
    ] = None,
    workers: Annotated[
        int,
        Parameter(
            name="--workers",
            help="Processes, one thread each; fewer where memory allows no more. Without it: as many as processors.",
        ),
    ] = 0,
    scheduler: Annotated[
        str,
        Parameter(name="--scheduler", help="Address of a running Dask scheduler to run the cases on (extra cluster)."),
    ] = "",
    slurm: Annotated[
        bool, Parameter(name="--slurm", negative="", help="Write the script of a SLURM array and run nothing.")
    ] = False,
    estimate: Annotated[
        bool, Parameter(name="--estimate", negative="", help="Tell how long it will take and run nothing.")
    ] = False,
    only: Annotated[
        str, Parameter(name="--only", help="Make this one case and write no table; as each task of an array does.")
    ] = "",
    parquet: Parquet = False,
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Run every subject in every rig along every motion: done cases are kept, failures do not stop the rest."""
    from musclefit.workflows import batch as studies

    ways = {"--slurm": slurm, "--estimate": estimate, "--only": only, "--scheduler": scheduler}
    chosen = [name for name, given in ways.items() if given]
    if len(chosen) > 1:
        raise InputError(f"found {' and '.join(chosen)}; expected one of them")
    folder = out if out is not None else Path("musclefit-out") / study.stem
    if slurm:
        script = studies.slurm(study, out=folder)
        if not quiet:
            print(f"wrote {script}; give it to sbatch, and afterwards: musclefit collect {folder}")
        return PASSED
    if estimate:
        told = studies.forecast(study, out=folder, workers=workers or _processors())
        print(told.in_words if told is not None else "nothing is left to do, or no first case can be read")
        return PASSED
    with TimedStages(shown=not quiet) as stages:
        cohort = studies.batch(
            study,
            out=folder,
            workers=workers or _processors(),
            scheduler=scheduler,
            only=only,
            parquet=parquet,
            progress=stages,
        )
    return _print(cohort, quiet=quiet, json=json)


def collect(
    folder: Annotated[Path, Parameter(help="The folder that musclefit batch wrote.")],
    /,
    *,
    parquet: Parquet = False,
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Make the tables and the page of a study from the folders of its cases, wherever they were run."""
    from musclefit.workflows.collect import collect as make

    return _print(make(folder, parquet=parquet), quiet=quiet, json=json)


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _print(cohort: Cohort, *, quiet: bool, json: bool) -> int:
    if json:
        from musclefit.report.cohort import cohort_rows

        print(json_text.dumps(cohort_rows(cohort.outcomes), indent=2, allow_nan=False, ensure_ascii=False))
    elif not quiet:
        from musclefit.workflows.collect import COHORT_HTML

        print(cohort.said())
        for outcome in cohort.outcomes:
            if outcome.reason:
                print(f"  {outcome.name}: {outcome.status}: {outcome.reason}")
        for outlier in cohort.outliers[:10]:
            print(f"  outlier: {outlier.name}: {outlier.measure} {outlier.value:.4g}, median {outlier.median:.4g}")
        if (cohort.folder / COHORT_HTML).is_file():
            print(f"written: {cohort.folder / COHORT_HTML}")
    return PASSED if cohort.passed else FAILED
