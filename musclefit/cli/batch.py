"""The command that runs a study of many subjects."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from musclefit.cli.collect import PASSED, ParquetOption, print_cohort
from musclefit.cli.options import JsonOption, QuietOption, print_json
from musclefit.errors import InputError
from musclefit.worker_processes import usable_processors
from musclefit.workflows.progress import TimedStages


def batch(
    study: Annotated[Path, Parameter(help="A TOML file: subjects, rigs, motions, and what to set for each.")],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name=["--out", "-o"],
            help="Folder for the results; finished cases are kept. Without it: musclefit-out/ and the study's name.",
        ),
    ] = None,
    workers: Annotated[
        int,
        Parameter(
            name="--workers",
            help="Processes, one thread each; fewer where memory does not suffice. Without it: one per processor.",
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
        bool, Parameter(name="--estimate", negative="", help="Forecast time and memory, and run nothing.")
    ] = False,
    only: Annotated[
        str, Parameter(name="--only", help="Run this one case and write no table, as each task of an array does.")
    ] = "",
    parquet: ParquetOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> int:
    """Run every subject with every rig and motion; finished cases are kept, and a failure does not stop the rest."""
    from musclefit.workflows import batch as studies

    ways = {"--slurm": slurm, "--estimate": estimate, "--only": only, "--scheduler": scheduler}
    chosen = [name for name, given in ways.items() if given]
    if len(chosen) > 1:
        raise InputError(f"found {' and '.join(chosen)}; expected one of them")
    folder = out if out is not None else Path("musclefit-out") / study.stem
    if slurm:
        script = studies.slurm(study, out=folder)
        if json:
            print_json({"script": str(script)})
        elif not quiet:
            print(f"wrote {script}; give it to sbatch, and afterwards: musclefit collect {folder}")
        return PASSED
    if estimate:
        told = studies.forecast(study, out=folder, workers=workers or usable_processors())
        if json:
            print_json({**asdict(told), "wall_s": told.wall_s})
        else:
            print(told.in_words)
        return PASSED
    with TimedStages(shown=not quiet) as stages:
        cohort = studies.batch(
            study,
            out=folder,
            workers=workers or usable_processors(),
            scheduler=scheduler,
            only=only,
            parquet=parquet,
            progress=stages,
        )
    return print_cohort(cohort, quiet=quiet, json=json)
