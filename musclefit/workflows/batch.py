"""A study: every subject in every rig along every motion, each in a folder of its own; what is done is kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from musclefit.errors import InputError, MusclefitError
from musclefit.io.case_folders import (
    PASSED,
    SUBJECTS,
    CaseOutcome,
    case_folder,
    case_key,
    is_done,
    read_case,
    read_cost,
)
from musclefit.io.folder_locks import held
from musclefit.io.rigs import read_rig
from musclefit.io.studies import Case, FileHashes, Study, input_files, inputs_of, read_study
from musclefit.progress import Progress
from musclefit.workflows.batch_slurm import write_slurm
from musclefit.workflows.batch_tasks import ATTEMPTS, died, make, make_case, prepare, sizes_of
from musclefit.workflows.collect import Cohort, collect, require_pyarrow, require_study_folder, write_study_json
from musclefit.workflows.cost import CostModel, Forecast, Measured, Sizes, available_mb, workers_that_fit
from musclefit.workflows.progress import TimedStages, watched
from musclefit.workflows.sequence_plan import planned
from musclefit.workflows.worker_pool import Died, Pool

Backend = Callable[[Study, Path, list[int], int], Iterator[CaseOutcome]]
"""Makes the cases of the given numbers with so many workers; gives each outcome as it is done."""


def batch(
    study: str | Path,
    *,
    out: str | Path,
    workers: int = 0,
    scheduler: str = "",
    only: str = "",
    parquet: bool = False,
    progress: Progress | None = None,
) -> Cohort:
    """Run a study: each case in a folder of its own; finished ones are kept, changed ones rerun, failures reported.

    Parameters
    ----------
    study : path
        TOML: subjects, rigs, motions, what to set; see the guide on studies.
    out : path
        New, empty, or of a study that was begun.
    workers : int
        Processes, one thread each; 0 for this process alone. Fewer are started where memory does not allow them. A
        script that asks for more must start its work inside of ``if __name__ == "__main__":``.
    scheduler : str
        The address of a running Dask scheduler, whose workers see the same files; needs dask (extra ``cluster``).
    only : str
        The name of one case: that one is made, in this process, and no table is written.
    parquet : bool
        Whether to write outcomes.parquet too (extra ``tables``).
    progress : Progress, optional

    Returns
    -------
    Cohort
        Of all cases, or of the one named by ``only``.

    Raises
    ------
    RigError, InputError
        A study that cannot be read, a folder that holds something else or that another `batch` works on, or a
        scheduler that does not answer.
    """
    if workers < 0:
        raise InputError(f"found {workers} workers; expected at least 1, or 0 for this process")
    read, folder = read_study(study), Path(out).absolute()
    if only:
        case = read.case(only)
        require_study_folder(folder)
        outcome = make_case(read, case, folder, hashes=FileHashes())
        return Cohort(read.title, (outcome,), folder)
    if parquet:
        require_pyarrow()
    require_study_folder(folder)
    with held(folder), watched(progress) as stages:
        write_study_json(read, folder)
        left = _left(read, folder, stages)
        if left:
            forecast = forecast_of(read, folder, left, workers=workers)
            stages.say(forecast.in_words)
            workers = forecast.workers if workers and not scheduler else workers
            backend = partial(_on_dask, scheduler) if scheduler else _on_processes
            _run(read, len(left), backend(read, folder, left, workers), stages)
        with stages.stage("tables and page"):
            cohort = collect(folder, parquet=parquet)
        strangers = _strangers(read, folder)
        if strangers:
            stages.say(f"of no case of the study, and left as they are: {', '.join(strangers)}")
    return cohort


def forecast(study: str | Path, *, out: str | Path, workers: int = 0) -> Forecast:
    """What is left of a study, and how long it will take; nothing is run and nothing written.

    Parameters
    ----------
    study, out, workers
        As for `batch`.

    Returns
    -------
    Forecast

    Raises
    ------
    RigError
        A study that cannot be read.
    """
    read, folder = read_study(study), Path(out).absolute()
    hashes = FileHashes()
    left = [k for k, case in enumerate(read.cases) if not _is_done(read, case, folder, hashes)]
    return forecast_of(read, folder, left, workers=workers)


def slurm(study: str | Path, *, out: str | Path) -> Path:
    """Write the script of a SLURM array that runs a study, a case per task; nothing is run.

    Parameters
    ----------
    study, out
        As for `batch`.

    Returns
    -------
    Path
        The script, to be given to sbatch; run `musclefit collect` afterwards. Cases that are done cost a second each.

    Raises
    ------
    RigError, InputError
        As `batch`.
    """
    read, folder = read_study(study), Path(out).absolute()
    require_study_folder(folder)
    write_study_json(read, folder)
    expected = forecast_of(read, folder, list(range(len(read.cases))), workers=1)
    return write_slurm(read, folder, expected)


def forecast_of(study: Study, out: Path, left: list[int], *, workers: int) -> Forecast:
    """The forecast of some cases: the model's, times what the cases made before took over what it tells for them.

    The first case of each rig and motion is read; the others are taken to have as many more or fewer vertices as their
    files have bytes. A rig and motion whose first case cannot be read is left out.
    """
    model = CostModel.shipped()
    total, peak, measured, left_out = 0.0, 0.0, 0, dict[str, None]()
    groups: dict[tuple[str, str], list[Case]] = {}
    for number in left:
        case = study.cases[number]
        groups.setdefault((case.rig, case.motion), []).append(case)
    for pair, cases in groups.items():
        made = [m for case in study.cases if (case.rig, case.motion) == pair and (m := _measured(out, case))]
        first = _sizes(study, cases)
        if first is None:
            continue
        size, first_bytes = first
        per_byte = size.vertices / max(first_bytes, 1)
        own = [replace(size, vertices=per_byte * _bytes(case) or size.vertices) for case in cases]
        left_out |= dict.fromkeys([] if made else model.unknown(size))
        measured += len(made)
        total += model.scale(made) * sum(map(model.case_cpu_s, own))
        peak = max(peak, model.peak_mb_of(own, made))
    free, wanted = available_mb(), max(1, min(workers, len(left)))
    fitting = workers_that_fit(wanted, peak_mb=peak, available_mb=free)
    total += fitting * model.start_cpu_s if total else 0.0
    limited = fitting < wanted
    return Forecast(len(left), measured, total, fitting, peak, free, limited=limited, left_out=tuple(left_out))


def _measured(out: Path, case: Case) -> Measured | None:
    """What a case took that was made before; None where it was not, or where that is not known."""
    cost = read_cost(out, case.name)
    if cost is None or not cost.cpu_s or not cost.sizes:
        return None
    return Measured(Sizes(**cost.sizes), cost.cpu_s, cost.process_peak_mb, first=cost.cases_before == 0)


def _sizes(study: Study, cases: list[Case]) -> tuple[Sizes, int] | None:
    """Sizes and bytes of the first of some cases that can be read; three are tried."""
    for case in cases[:3]:
        tets = () if study.tets is None else (f"tets.enabled={str(study.tets).lower()}",)
        try:
            job = read_rig(case.rig_file, overrides=(*case.overrides, *tets))
            frames = 1
            if case.motion_file is not None:
                frames = len(planned(job, motion=case.motion_file, frames=study.frames).poses)
            return Sizes(**sizes_of(job, frames=frames, pictures=study.pictures)), _bytes(case)
        except MusclefitError:
            continue
    return None


def _bytes(case: Case) -> int:
    """Bytes of the surfaces and other files that a case names; 0 where there are none."""
    try:
        return sum(path.stat().st_size for path in input_files(case) if path.suffix.lower() not in (".toml", ".csv"))
    except (MusclefitError, OSError):
        return 0


def _left(study: Study, out: Path, stages: TimedStages) -> list[int]:
    """The numbers of the cases that are not there, made of the same input."""
    hashes, left = FileHashes(), []
    with stages.stage("look at what is done") as tick:
        for number, case in enumerate(study.cases):
            if not _is_done(study, case, out, hashes):
                left.append(number)
            tick((number + 1) / len(study.cases))
    return left


def _is_done(study: Study, case: Case, out: Path, hashes: FileHashes) -> bool:
    former = read_case(out, case.name)
    if former is None or not former.key:
        return False
    try:
        return is_done(former, case_key(case, study, inputs_of(case, hashes)))
    except (InputError, OSError):
        return False


def _run(study: Study, left: int, outcomes: Iterator[CaseOutcome], stages: TimedStages) -> None:
    """Follow the cases as they are done, telling how many, and how long the rest will take."""
    total, done, bad, start = len(study.cases), len(study.cases) - left, 0, time.monotonic()
    before = told = done
    with stages.stage("cases") as tick:
        tick(done / total)
        for outcome in outcomes:
            done += 1
            tick(done / total)
            if outcome.status != PASSED:
                bad += 1
                stages.say(f"{outcome.name}: {outcome.status}: {outcome.reason}")
            if done - told >= max(1, total // 10) or done == total:
                told = done
                rest = (time.monotonic() - start) / (done - before) * (total - done)
                stages.say(f"{done} of {total} cases done, {bad} of them did not pass; about {rest:.0f} s left")


def _on_processes(study: Study, out: Path, left: list[int], workers: int) -> Iterator[CaseOutcome]:
    """In processes of this machine; one that ends without a word is replaced, and its case tried again."""
    times: dict[int, int] = {}
    with Pool(min(workers, len(left)), prepare=prepare, given=(study, out)) as pool:
        while left:
            again = []
            for number, result in pool.run_all(make, left):
                if not isinstance(result, Died):
                    yield result
                    continue
                times[number] = times.get(number, 0) + 1
                if times[number] < ATTEMPTS:
                    again.append(number)
                else:
                    yield died(study, number, out, times=ATTEMPTS)
            left = again


def _on_dask(address: str, study: Study, out: Path, left: list[int], workers: int) -> Iterator[CaseOutcome]:
    from musclefit.workflows.batch_dask import outcomes_on_dask

    del workers  # the cluster's own
    return outcomes_on_dask(address, study, out, left)


def _strangers(study: Study, out: Path) -> list[str]:
    """Folders of cases that the study does not have."""
    known = {case_folder(out, case.name) for case in study.cases}
    there = {folder for folder in (out / SUBJECTS).glob("*/*") if folder.is_dir()}
    return sorted(folder.relative_to(out).as_posix() for folder in there - known)
