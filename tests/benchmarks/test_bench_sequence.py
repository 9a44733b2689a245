"""What workers gain: the built-in limb followed for 12 frames by two workers and by one, on a machine with nothing else
to do; and what compiling costs a first run.

Run: pytest -n0 tests/benchmarks/test_bench_sequence.py -s -m slow
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

FRAMES = 12
TWO_BY_ONE = 1.8
COLD_S = 10.0

MOTION = Path(__file__).parents[2] / "rigs" / "forearm_motion.csv"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="two workers need two processors"),
]


def seconds(*arguments: str, cache: Path) -> float:
    """Wall time of a command, with its caches in a folder of their own."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    environment["MUSCLEFIT_CACHE"] = str(cache)
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "musclefit", *arguments], env=environment, check=False)
    assert done.returncode in (0, 1), done
    return time.perf_counter() - start


def test_two_workers_by_one(tmp_path):
    cache = tmp_path / "cache"

    def follow(workers: int, frames: int, name: str) -> float:
        options = ("--frames", str(frames), "--workers", str(workers), "--no-pictures", "--quiet")
        return seconds("sequence", "upper_limb", str(MOTION), *options, "--out", str(tmp_path / name), cache=cache)

    follow(2, 2, "warm")  # compiles
    one, two = follow(1, FRAMES, "one"), follow(2, FRAMES, "two")
    print(f"\n{FRAMES} frames: one worker {one:.1f} s, two {two:.1f} s: {one / two:.2f} times")
    assert one / two >= TWO_BY_ONE


def test_a_first_run_takes_little_longer_than_the_next(tmp_path):
    """Tetrahedra are left out, for they too are kept from the first run on."""

    def demo(name: str) -> float:
        return seconds("demo", "--no-tets", "--quiet", "--out", str(tmp_path / name), cache=tmp_path / "cache")

    cold, warm = demo("cold"), demo("warm")
    print(f"\ndemo without tets: first run {cold:.1f} s, next {warm:.1f} s")
    assert cold - warm <= COLD_S
