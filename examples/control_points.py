"""234,777 control points in one run: time, memory, the largest error at a control point, and what is certified.

    MUSCLEFIT_DATA=... python examples/control_points.py
    MUSCLEFIT_DATA=... python examples/control_points.py --count 20000

As many of a body's vertices (skin, bones, muscles; some 0.003 mm apart) are sent where a smooth map to a heavier body
takes them. What is timed is `musclefit run` on the files of that: reading, one Cayley step of the backend "multilevel",
checks of the skin, and the proof that nothing folds anywhere inside it. Takes minutes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.model import TissueKind
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.progress import Silent

COUNT = 234_777
"""The number that PIPER's users have met."""

RIG = """\
title = "Very many control points"
[anatomy]
files = ["${MUSCLEFIT_DATA}/body/skin.ply"]
units = "mm"
[drive]
kind = "landmarks"
source = "points.csv"
units = "mm"
[deformer]
backend = "multilevel"
kernel = "r3"
step = "cayley"
[compare]
methods = []
[limits]
purpose = "another-body"
"""


def write_case(folder: Path, count: int) -> np.ndarray:
    """Write the rig and its control points; gives them (count, 3), mm."""
    job = read_rig(find_rig("body_heavy"), overrides=("deformer.kernel=r3",))
    vertices = [tissue.surface.vertices for tissue in job.anatomy if tissue.kind is not TissueKind.OTHER]
    points = np.unique(np.concatenate(vertices), axis=0)
    if count > len(points):
        raise SystemExit(f"found {len(points)} different vertices; --count is {count}")
    points = points[np.sort(np.random.default_rng(0).permutation(len(points))[:count])]
    targets = deform(job, points[:5000], progress=Silent()).deformation(points)
    with (folder / "points.csv").open("w", encoding="utf-8") as file:
        file.write("name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm\n")
        for number, row in enumerate(np.hstack([points, targets])):
            file.write(f"p{number},{','.join(repr(float(value)) for value in row)}\n")
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    return points


def main() -> None:
    """Make the case, run it in a process of its own, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=COUNT)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        points = write_case(folder, parser.parse_args().count)
        nearest = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1].min()
        command = ["run", str(folder / "rig.toml"), "--no-pictures", "--out", str(folder / "run"), "--quiet"]
        before, clock = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        code = subprocess.run([sys.executable, "-m", "musclefit", *command], check=False).returncode
        clock, after = time.monotonic() - clock, resource.getrusage(resource.RUSAGE_CHILDREN)
        if code not in (0, 1):
            raise SystemExit(f"the run ended with exit code {code}; see its message above")
        report = json.loads((folder / "run" / "report.json").read_text(encoding="utf-8"))
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    proof = report["map"]
    head = ("control points", "nearest two", "largest error at one", "verdict, map, margin", "boxes")
    print(f"| {' | '.join((*head, 'least det J at a vertex', 'CPU time', 'by the clock', 'peak memory'))} |")
    print("|---|---|---|---|---|---|---|---|---|")
    print(
        f"| {len(points):,} | {nearest:.2g} mm | {report['landmarks']['max_error_mm']:.1e} mm | {report['verdict']}, "
        f"{proof['claim']}, {proof['margin']:.2g} | {proof['boxes_examined']:,} | "
        f"{proof['min_jacobian_determinant']:.2g} | {cpu_s:.0f} s | {clock:.0f} s | "
        f"{after.ru_maxrss / 1e6:.2g} GB |"
    )


if __name__ == "__main__":
    main()
