"""Tets of the built-in limb made and read back from the cache: pytest -n0 tests/benchmarks/test_bench_tets.py -s

CPU seconds of this process and its children, since tetrahedra are made in a process of their own. With MUSCLEFIT_DATA
and ``MUSCLEFIT_BENCH_RIG=forearm`` the 70 surfaces of the real forearm take their place (10 minutes).
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.meshing.cache import TetCache
from musclefit.progress import Silent
from musclefit.workflows.run import layer_rules

RIG = os.environ.get("MUSCLEFIT_BENCH_RIG", "upper_limb")
AT_LEAST = 20.0
"""How much less CPU the second run must take."""


def cpu_seconds() -> float:
    children = os.times()
    return time.process_time() + children.children_user + children.children_system


def test_the_second_run_reads_what_the_first_one_made(tmp_path: Path) -> None:
    job = read_rig(find_rig(RIG), overrides=("tets.enabled=true",), progress=Silent())
    cache, rules = TetCache(tmp_path), layer_rules(job.rig.tets)
    seconds: list[float] = []
    found: list[TetAnatomy] = []
    for second_run in (False, True):
        before = cpu_seconds()
        tets, from_cache = cache.tetrahedralise(job.anatomy, rules, progress=Silent())
        seconds.append(cpu_seconds() - before)
        assert from_cache is second_run
        found.append(tets)
    made, read = seconds
    print(
        f"\n{RIG}: {len(found[0].mesh.tets)} tets made in {made:.1f} CPU s, read in {read:.3f}: {made / read:.0f} times"
    )
    np.testing.assert_array_equal(found[0].mesh.vertices, found[1].mesh.vertices)
    np.testing.assert_array_equal(found[0].mesh.tets, found[1].mesh.tets)
    np.testing.assert_array_equal(found[0].tissue_of_tet, found[1].tissue_of_tet)
    assert made >= AT_LEAST * read
