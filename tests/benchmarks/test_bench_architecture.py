"""What architecture adds to a frame: the built-in limb's muscles carried by its map, over all that the frame takes.

Run: pytest -n0 tests/benchmarks/test_bench_architecture.py -s -m slow

A frame is `musclefit.run` without tetrahedra, pictures and methods to compare with; carrying is the map and its
Jacobian at all of the muscles' own tetrahedra, streamlines and attachments. CPU seconds by stages; what is compiled
should be kept from a run before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

import musclefit as mf
from musclefit.progress import Tick

RIG = "upper_limb"
SHARE = 0.20


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
    run_stages, stages = CpuStages(), CpuStages()
    run = mf.run(RIG, tets=False, pictures=False, overrides=("compare.methods=[]",), progress=run_stages)
    found = mf.architecture(run, progress=stages)
    frame, carried = sum(run_stages.seconds.values()), stages.seconds["carry fibres"]
    share = carried / (frame + carried)
    print(
        f"\n{RIG}: {len(found.carried)} muscles, {sum(row.tets for row in found.muscles)} tetrahedra carried in "
        f"{carried:.1f} CPU s; frame {frame:.1f} CPU s without, share {100.0 * share:.0f} %"
    )
    assert share <= SHARE
