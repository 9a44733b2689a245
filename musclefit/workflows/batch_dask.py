"""The cases of a study on a Dask cluster that runs already; needs dask.distributed (extra ``cluster``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Lock

from musclefit.compiling import one_thread
from musclefit.errors import InputError
from musclefit.io.case_folders import CaseOutcome
from musclefit.io.studies import FileHashes, Study
from musclefit.workflows.batch_tasks import ATTEMPTS, broke_off, died, make_case

ANSWER_S = 30.0
"""How long a scheduler may take to answer."""

_one_at_a_time = Lock()
"""A worker of several threads makes one case after the other: the memory of a case is planned once per process."""


def outcomes_on_dask(address: str, study: Study, out: Path, left: list[int]) -> Iterator[CaseOutcome]:
    """The outcomes of cases, as workers of the cluster finish them; they must see the same files at the same paths.

    Raises
    ------
    InputError
        dask.distributed is not installed, or no scheduler answers at the address.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        need = "a Dask cluster needs dask.distributed; install it: pip install 'musclefit[cluster]'"
        raise InputError(need) from None
    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no scheduler answers ({error}); give its address") from None
    with client:
        futures = {
            client.submit(make_on_worker, _alone(study, number), str(out), pure=False, retries=ATTEMPTS - 1): number
            for number in left
        }
        for future in as_completed(list(futures), loop=client.loop):
            number = futures.pop(future)
            try:
                yield future.result()
            except KilledWorker:
                yield died(study, number, out, times=ATTEMPTS)
            except Exception as error:  # a worker without musclefit, a scheduler that is gone: told, the rest goes on
                said = f"the Dask cluster could not run it: {type(error).__name__}: {error}"
                yield broke_off(study.cases[number], out, reason=said)
            future.release()


def _alone(study: Study, number: int) -> Study:
    """The study with one case: data that is sent with each task is there again for a worker in place of a dead one."""
    return replace(study, cases=(study.cases[number],))


def make_on_worker(study: Study, out: str) -> CaseOutcome:
    """Make the one case of a study in a worker of a cluster, with one thread."""
    with _one_at_a_time, one_thread():
        return make_case(study, study.cases[0], Path(out), hashes=FileHashes())
