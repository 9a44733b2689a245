"""Worker processes: prepared once, one thread each, errors and deaths told, none left behind."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from multiprocessing import active_children
from pathlib import Path

import pytest

from musclefit.errors import InputError, MusclefitError
from musclefit.workflows.worker_pool import PINNED, Pool

_prepared: list[str] = []


def prepare(word: str) -> None:
    _prepared[:] = [word]


def told(number: int) -> tuple[str, int, dict[str, str | None]]:
    return _prepared[0], number, {name: os.environ.get(name) for name in PINNED}


def refuse(number: int) -> None:
    raise InputError(f"task {number} cannot be done")


def die(number: int) -> None:
    os._exit(3)


def test_without_workers_tasks_run_here_one_after_the_other() -> None:
    with Pool(0, prepare=prepare, given=("here",)) as pool:
        results = list(pool.run(told, [3, 1, 2]))
    assert [number for number, _ in results] == [3, 1, 2]
    assert {word for _, (word, _, _) in results} == {"here"}
    assert not active_children()


def test_without_tasks_nothing_is_prepared() -> None:
    _prepared[:] = ["before"]
    with Pool(0, prepare=prepare, given=("after",)) as pool:
        assert list(pool.run(told, [])) == []
    assert _prepared == ["before"]


@pytest.mark.slow
def test_workers_use_one_thread_each_and_leave_the_environment_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PINNED[0], "7")
    monkeypatch.delenv(PINNED[1], raising=False)
    before = set(active_children())
    with Pool(2, prepare=prepare, given=("there",)) as pool:
        results = dict(pool.run(told, range(5)))
    assert sorted(results) == list(range(5))
    for number, (word, same, environment) in results.items():
        assert (word, same) == ("there", number)
        assert set(environment.values()) == {"1"}
    assert os.environ[PINNED[0]] == "7"
    assert PINNED[1] not in os.environ
    assert set(active_children()) == before
    assert threading.active_count() < 4


@pytest.mark.slow
def test_errors_of_tasks_are_raised_and_dead_workers_told() -> None:
    with pytest.raises(InputError, match="task 4 cannot be done"), Pool(1, prepare=prepare, given=("x",)) as pool:
        list(pool.run(refuse, [4]))
    with pytest.raises(MusclefitError, match="ended without a word"), Pool(1, prepare=prepare, given=("x",)) as pool:
        list(pool.run(die, [0]))
    assert not active_children()


def linger(number: int) -> None:
    (Path(_prepared[0]) / "worker").write_text(str(os.getpid()), encoding="utf-8")
    time.sleep(120.0)


@pytest.mark.slow
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from test_io_worker_pool import *\n"
        "if __name__ == '__main__':\n"
        f"    with Pool(1, prepare=prepare, given=({str(tmp_path)!r},)) as pool:\n"
        "        list(pool.run(linger, [0]))\n"
    )
    (tmp_path / "parent.py").write_text(script, encoding="utf-8")
    with subprocess.Popen([sys.executable, str(tmp_path / "parent.py")]) as parent:
        said = tmp_path / "worker"
        while not (said.is_file() and said.read_text(encoding="utf-8")):
            assert parent.poll() is None
            time.sleep(0.05)
        worker = int(said.read_text(encoding="utf-8"))
        parent.kill()
    deadline = time.monotonic() + 30.0
    while _alive(worker):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    return state != "Z"
