"""What workers gain: the built-in limb followed for 12 frames by two workers and by one, on a machine with nothing else
to do; and what compiling costs a first run.

Run: pytest tests/benchmarks/test_bench_sequence.py -s -m slow
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

UNLISTED_S = 3.0
"""CPU seconds that a run may compile beside what `musclefit.compiling_ahead` lists."""

RUN = """
import sys, time
from numba.core import event
class Watch(event.Listener):
    depth, start, found = 0, 0.0, []
    def on_start(self, e):
        if not self.depth:
            self.start = time.process_time()
        self.depth += 1
    def on_end(self, e):
        self.depth -= 1
        if not self.depth:
            what = f"{e.data['dispatcher'].py_func} {e.data['args']}"
            self.found.append((time.process_time() - self.start, what))
watch = Watch()
event.register("numba:compile", watch)
from musclefit.cli import main
code = main(sys.argv[1:])
for seconds, what in watch.found:
    print(f"COMPILED {seconds:.2f} {what}")
raise SystemExit(code)
"""

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
        options = ("--frames", str(frames), "--workers", str(workers), "--no-film", "--quiet")
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


def test_what_a_run_needs_is_compiled_ahead(tmp_path):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    environment["MUSCLEFIT_CACHE"] = str(tmp_path / "cache")
    ahead = "from musclefit.compiling_ahead import compile_ahead; compile_ahead()"
    subprocess.run([sys.executable, "-c", ahead], env=environment, check=True)
    command = [sys.executable, "-c", RUN, "demo", "--no-tets", "--quiet", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    compiled = [line for line in done.stdout.split("\n") if line.startswith("COMPILED")]
    print("\ncompiled in the run:", *compiled, sep="\n")
    assert sum(float(line.split(" ")[1]) for line in compiled) < UNLISTED_S
