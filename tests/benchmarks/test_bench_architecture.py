"""What architecture adds to a frame: a limb's muscles carried by its map, over all that the frame takes.

Run: pytest -n0 tests/benchmarks/test_bench_architecture.py -s -m slow
The real forearm takes 6 minutes of CPU time and needs ``MUSCLEFIT_DATA``; ``-m 'slow and not anatomy'`` leaves it out.

A frame is `musclefit.run` without tetrahedra, pictures and methods to compare with; carrying is the map and its
Jacobian at all of the muscles' own tetrahedra, streamlines and attachments. CPU seconds by stages; what is compiled
should be kept from a run before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import musclefit as mf
from musclefit.progress import Tick

SHARE = 0.20
"""Of a frame with its architecture, at most."""


class CpuStages:
    """CPU seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        start, inner = time.process_time(), self._inner
        self._inner = 0.0
        yield lambda _: None
        took = time.process_time() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + took - self._inner  # stages inside of it count by themselves
        self._inner = inner + took


@pytest.mark.slow
def test_carrying_the_muscles_takes_a_fifth_of_a_frame_at_most() -> None:
    assert share_of_carrying("upper_limb") <= SHARE


@pytest.mark.slow
@pytest.mark.anatomy
def test_on_a_real_forearm_it_takes_no_more(anatomy_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    assert share_of_carrying("forearm_rigid") <= SHARE


def share_of_carrying(rig: str) -> float:
    """Of the CPU time of a frame with its architecture; printed with what was carried."""
    run_stages, stages = CpuStages(), CpuStages()
    run = mf.run(rig, tets=False, pictures=False, overrides=("compare.methods=[]",), progress=run_stages)
    found = mf.architecture(run, progress=stages)
    frame, carried = sum(run_stages.seconds.values()), stages.seconds["carry fibres"]
    share = carried / (frame + carried)
    places = sum(len(line) for one in found.fibred.values() for line in one.carried_lines)
    print(
        f"\n{rig}: {len(found.carried)} muscles, {sum(row.tets for row in found.muscles)} tetrahedra and "
        f"{places} places of streamlines carried "
        f"in {carried:.1f} CPU s; frame {frame:.1f} CPU s without, share {100.0 * share:.0f} %"
    )
    return share
