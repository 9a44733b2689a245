"""Work beside other work: both go on at once, faults of either end the other, progress is told in order."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Barrier, Event, current_thread

import pytest
from tiny_rigs import write_tiny_rig

import musclefit as mf
import musclefit.workflows.run as under_test
from musclefit.errors import MeshError
from musclefit.progress import Progress, Silent, Tick
from musclefit.workflows.beside import Beside, at_once
from musclefit.workflows.progress import TimedStages

SMALL = ("compare.methods=[]", "tets.enabled=true")


def test_both_go_on_at_once_and_the_result_is_waited_for() -> None:
    started = Event()

    def work(_: Progress) -> str:
        assert started.wait(10.0)
        return current_thread().name

    with Beside(work, progress=Silent(), waiting=Silent()) as beside:
        started.set()
        assert beside() == beside() != current_thread().name


def test_work_that_nobody_waits_for_is_given_up() -> None:
    given_up = Event()

    def work(progress: Progress) -> None:
        try:
            with progress.stage("endless") as tick:
                while True:
                    tick(0.5)
                    time.sleep(0.01)
        finally:
            given_up.set()

    with pytest.raises(KeyboardInterrupt), Beside(work, progress=Silent(), waiting=Silent()):
        raise KeyboardInterrupt
    assert given_up.is_set()


def test_things_are_worked_on_two_at_a_time_and_come_back_in_their_order() -> None:
    both = Barrier(2, timeout=10.0)
    ticks: list[float] = []

    def work(number: int, _: Progress) -> tuple[int, str]:
        both.wait()
        return number, current_thread().name

    done = at_once(work, range(4), threads=2, tick=ticks.append)
    assert [number for number, _ in done] == [0, 1, 2, 3]
    assert {name for _, name in done}.isdisjoint({current_thread().name})
    assert ticks == sorted(ticks)
    assert ticks[-1] == 1.0
    assert at_once(work, (), threads=2, tick=ticks.append) == ()


def test_where_one_fails_the_others_are_given_up() -> None:
    begun, given_up = Event(), Event()

    def work(what: str, progress: Progress) -> None:
        if what == "bad":
            assert begun.wait(10.0)
            raise MeshError("no mesh")
        try:
            with progress.stage(what) as tick:
                begun.set()
                while True:
                    tick(0.5)
                    time.sleep(0.01)
        finally:
            given_up.set()

    with pytest.raises(MeshError, match="no mesh"):
        at_once(work, ("endless", "bad", "waiting"), threads=2, tick=lambda _: None)
    assert given_up.is_set()


def test_what_the_work_raised_is_raised_at_the_next_stage_and_at_the_end() -> None:
    def work(_: Progress) -> None:
        raise MeshError("no mesh")

    with Beside(work, progress=Silent(), waiting=Silent()) as beside:
        with pytest.raises(MeshError, match="no mesh"):
            beside()
        with pytest.raises(MeshError, match="no mesh"), beside.while_well(Silent()).stage("next"):
            pytest.fail("the stage began")


def test_a_mesh_that_fails_ends_a_run_and_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object, **__: object) -> None:
        raise MeshError("the tetrahedraliser failed")

    monkeypatch.setattr(under_test, "prepared_tets", failing)
    with pytest.raises(MeshError, match="the tetrahedraliser failed"):
        mf.run(
            write_tiny_rig(tmp_path / "rig"), out=tmp_path / "run", overrides=SMALL, pictures=False, progress=Silent()
        )
    assert not (tmp_path / "run").exists()


def test_who_waits_is_told_what_for_and_how_far_it_is() -> None:
    told: list[tuple[str, float]] = []

    class Told:
        @contextmanager
        def stage(self, name: str) -> Iterator[Tick]:
            yield lambda fraction: told.append((name, fraction))

    def work(progress: Progress) -> int:
        with progress.stage("mesh") as tick:
            tick(0.25)
            begun.set()
            time.sleep(0.7)
        return 7

    begun = Event()
    with Beside(work, progress=Silent(), waiting=Told()) as beside:
        assert begun.wait(10.0)
        assert beside() == 7
        known = len(told)
        assert known > 0
        assert set(told) == {("wait: mesh", 0.25)}
        assert beside() == 7
    assert len(told) == known


class InOrder:
    """Progress that takes stages one after the other or nested, from one thread."""

    def __init__(self) -> None:
        self.open: list[str] = []
        self.thread = current_thread()

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        assert current_thread() is self.thread
        self.open.append(name)
        yield lambda _: None
        assert self.open.pop() == name


def test_who_is_told_of_stages_is_told_of_one_after_the_other() -> None:
    with TimedStages(shown=False, beside=InOrder()) as stages:
        within = Event()

        def work(progress: Progress) -> None:
            with progress.stage("beside"):
                assert within.wait(10.0)

        with Beside(work, progress=stages.in_another_thread(), waiting=stages) as beside, stages.stage("other"):
            within.set()
            beside()
    assert {"beside", "other"} <= set(stages.seconds) <= {"beside", "other", "wait: beside"}
