"""Time and memory of runs against vertices, tissues, landmarks and frames: measured here, and fitted to a model.

    python examples/cost_model.py            # measures, prints the table and the fit
    python examples/cost_model.py --write    # and puts the coefficients where `musclefit batch --estimate` finds them

Each case is a limb of ellipsoids, run in a process of its own that has run a smaller one before, so that compiling and
importing are not counted.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes
from musclefit.workflows.cost import MODEL_FILE, CostModel, Measured, Sizes

CASES = {
    False: [(1, 2, 6), (6, 2, 6), (6, 2, 48), (6, 3, 6), (6, 3, 48), (1, 4, 24)],
    True: [(1, 2, 6), (4, 2, 6), (4, 2, 24), (4, 3, 6), (1, 3, 24)],
}
"""Rigid bones or not -> muscles, subdivisions of each ellipsoid, and landmarks per bone."""

CHILD = """
import json, sys, time
from pathlib import Path
from musclefit.io.provenance import peak_memory_mb
from musclefit.progress import Silent
from musclefit.workflows.batch_tasks import sizes_of
from musclefit.workflows.run import run
run(sys.argv[1], out=sys.argv[3] + "/warm", pictures=False, progress=Silent())
start = time.process_time()
done = run(sys.argv[2], out=sys.argv[3] + "/out", pictures=False, progress=Silent())
cpu_s = time.process_time() - start
print(json.dumps({"sizes": sizes_of(done.job, frames=1), "cpu_s": cpu_s, "peak_mb": peak_memory_mb()}))
"""

JOINTS = """
units = "mm, degrees"
[elbow]
centre_mm = [0, 0, 0]
axis = [0, 0, 1]
fixed = ["bone_proximal"]
moving = ["bone_distal"]
limits_deg = [-5, 60]
"""


def ellipsoid(centre: tuple[float, float, float], axes: tuple[float, float, float], *, level: int) -> TriMesh:
    """An ellipsoid, mm."""
    ball = trimesh.creation.icosphere(subdivisions=level, radius=1.0)
    return TriMesh(np.asarray(ball.vertices) * axes + centre, np.asarray(ball.faces))


def write_limb(folder: Path, *, muscles: int, level: int, landmarks: int, rigid: bool) -> Path:
    """Two bones, muscles around them, a skin, and joints that bend it; the rig's path."""
    tissues = {
        "skin": ellipsoid((0, 0, 0), (60, 28, 28), level=level),
        "bone_proximal": ellipsoid((-25, 0, 0), (18, 6, 6), level=level),
        "bone_distal": ellipsoid((25, 0, 0), (18, 6, 6), level=level),
    }
    for k in range(muscles):
        angle = 2 * np.pi * k / muscles
        width = min(5.0, 13.0 * np.sin(np.pi / max(muscles, 2)) * 0.9)
        centre = (0.0, float(13.5 * np.cos(angle)), float(13.5 * np.sin(angle)))
        tissues[f"muscle_{k:02d}"] = ellipsoid(centre, (25, width, width), level=level)
    (folder / "anatomy").mkdir(parents=True)
    for name, surface in tissues.items():
        (folder / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(surface))
    (folder / "joints.toml").write_text(JOINTS, encoding="utf-8")
    rig = folder / "limb.toml"
    rig.write_text(
        'title = "Limb of ellipsoids"\n[anatomy]\nfolder = "anatomy"\n'
        f'[drive]\nkind = "joints"\njoints = "joints.toml"\n'
        f"pose = {{ elbow_deg = 25 }}\nlandmarks_per_bone = {landmarks}\n"
        f"[bones]\nrigid = {str(rigid).lower()}\n[tets]\nenabled = false\n",
        encoding="utf-8",
    )
    return rig


def measured(folder: Path, warm: Path, *, muscles: int, level: int, landmarks: int, rigid: bool) -> Measured:
    """CPU seconds and peak memory of one run."""
    rig = write_limb(folder, muscles=muscles, level=level, landmarks=landmarks, rigid=rigid)
    told = subprocess.run(
        [sys.executable, "-c", CHILD, str(warm), str(rig), str(folder)], capture_output=True, text=True, check=True
    )
    read = json.loads(told.stdout.splitlines()[-1])
    return Measured(Sizes(**read["sizes"]), read["cpu_s"], read["peak_mb"])


def main() -> int:
    """Measure, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the coefficients of the installed package")
    write = parser.parse_args().write
    cases = []
    print("vertices  tissues  landmarks  kind          CPU s  peak MB")
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch)
        todo = [(rigid, *case) for rigid, own in CASES.items() for case in own]
        for number, (rigid, muscles, level, landmarks) in enumerate(todo):
            warm = write_limb(home / f"warm-{number}", muscles=1, level=1, landmarks=6, rigid=rigid)
            case = measured(home / str(number), warm, muscles=muscles, level=level, landmarks=landmarks, rigid=rigid)
            cases.append(case)
            s = case.sizes
            size = f"{s.vertices:8.0f} {s.tissues:8.0f} {s.landmarks:10.0f}  {s.kind:12}"
            print(f"{size} {case.cpu_s:6.2f} {case.peak_mb or 0.0:8.0f}")
            sys.stdout.flush()
    model = CostModel.fitted(cases)
    print(model.text())
    if write:
        MODEL_FILE.write_text(model.text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
