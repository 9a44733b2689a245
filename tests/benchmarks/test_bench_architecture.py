"""What architecture adds to a frame: the built-in limb's muscles carried by its map, over all that the frame takes.

Run: pytest -n0 tests/benchmarks/test_bench_architecture.py -s -m slow

A frame is `musclefit.run` without tetrahedra, pictures and methods to compare with; carrying is the map and its
Jacobian at all of the muscles' own tetrahedra, streamlines and attachments. CPU seconds; compiling is done before.
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

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        start = time.process_time()
        yield lambda _: None
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - start


@pytest.mark.slow
def test_carrying_the_muscles_takes_a_fifth_of_a_frame_at_most() -> None:
    given = {"tets": False, "pictures": False, "overrides": ("compare.methods=[]",)}
    mf.architecture(mf.run(RIG, **given), muscles=["*pronator*"])  # compiles, and keeps no tetrahedra but its own
    start = time.process_time()
    run = mf.run(RIG, **given)
    frame = time.process_time() - start
    stages = CpuStages()
    found = mf.architecture(run, progress=stages)
    carried = stages.seconds["carry fibres"]
    share = carried / (frame + carried)
    print(
        f"\n{RIG}: {len(found.carried)} muscles, {sum(row.tets for row in found.muscles)} tetrahedra carried in "
        f"{carried:.1f} CPU s; frame {frame:.1f} CPU s without, share {100.0 * share:.0f} %"
    )
    assert share <= SHARE
