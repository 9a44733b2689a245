"""A whole body on a heavier one, and one SciPy warp of its points: pytest -n0 tests/benchmarks/test_bench_bodies.py

688 tissues and the skin, 485,000 vertices, 509 handles, phi = r. Ours is everything a run does but reading and
writing: solids, Cayley steps, certificate, volumes, overlaps at rest, deformed and introduced, tissue outside the skin.
SciPy's is a fit and one evaluation at the vertices. CPU seconds of this process, their ratio and peak memory are
printed.
"""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RBFInterpolator

from musclefit.geometry.queries.solids import ROUNDING_MM3
from musclefit.io.rigs import read_rig
from musclefit.pipeline.retarget import outcome_of
from musclefit.progress import Silent
from musclefit.validate.overlaps import solid_anatomy

RIG = Path(__file__).resolve().parents[2] / "rigs" / "body_heavy.toml"
CPU_RATIO = 60.0
MEMORY_GIB = 4.0


def cpu(function):
    start = time.process_time()
    result = function()
    return result, time.process_time() - start


def test_a_body_of_689_tissues(anatomy_data, monkeypatch, benchmark, capsys):
    monkeypatch.setenv("MUSCLEFIT_DATA", str(anatomy_data))
    job, reading = cpu(lambda: read_rig(RIG))
    points = job.anatomy.vertices()
    source, target = job.handles.source, job.path.position(1.0)

    def ours(job):
        return outcome_of(job, rest=solid_anatomy(job.anatomy, progress=Silent()), progress=Silent())

    few = replace(job.anatomy, tissues=job.anatomy.tissues[:8])
    ours(replace(job, anatomy=few))  # compiles
    outcome, seconds = cpu(lambda: benchmark.pedantic(ours, args=(job,), rounds=1))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    side = outcome.side
    _, moving = cpu(lambda: outcome.deformation(points))
    warped, theirs = cpu(lambda: points + RBFInterpolator(source, target - source, kernel="linear")(points))
    one_shot_off = np.abs(warped - outcome.deformation(points)).max()
    new = [p for p in side.overlaps.pairs if p.rest_mm3 <= ROUNDING_MM3]
    old = [p for p in side.overlaps.pairs if p.rest_mm3 > ROUNDING_MM3]
    outside = [t.outside_skin_introduced_mm3 for t in side.tissues if t.outside_skin_introduced_mm3 is not None]
    with capsys.disabled():
        print(
            f"\n{len(job.anatomy)} tissues, {len(points)} vertices, {len(source)} handles: SciPy {theirs:.2f} CPU s; "
            f"ours {seconds:.1f} with all checks (reading {reading:.1f}, moving the points once {moving:.2f}), ratio "
            f"{seconds / theirs:.1f}; peak memory {memory:.2f} GiB; cage off {side.landmarks.max_error_mm:.1e} mm; map "
            f"{side.map.claim.value}, margin {side.map.margin:.2f}, {side.map.boxes_examined} boxes; of "
            f"{side.overlaps.pairs_tested} pairs {len(new)} overlap newly by {sum(p.introduced_mm3 for p in new):.2g} "
            f"mm³ in all, {len(old)} that overlap at rest share {sum(p.deformed_mm3 for p in old):.0f} mm³, "
            f"{sum(p.introduced_mm3 for p in old):.0f} beyond that carried along; {sum(outside):.2g} mm³ newly outside "
            f"the skin; {side.edges_split} edges split; not checked "
            f"{[n.what for n in side.overlaps.not_checked]}; from SciPy's warp by up to {one_shot_off:.1f} mm"
        )
        for pair in new:
            print(f"    {pair.a} / {pair.b}: {pair.introduced_mm3:.2g} mm³")
    assert seconds <= CPU_RATIO * theirs
    assert memory <= MEMORY_GIB
    assert side.landmarks.max_error_mm <= 1e-6
    assert side.map.claim.value == "certified"
    assert sum(p.introduced_mm3 for p in new) <= 10.0
    assert sum(outside) <= 1.0
