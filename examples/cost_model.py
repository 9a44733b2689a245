"""Time and memory of runs against vertices, tissues, landmarks and frames: measured here, and fitted to a model.

    python examples/cost_model.py                  # measures, prints the table and the fit
    python examples/cost_model.py --write          # and puts the coefficients where `batch --estimate` finds them
    python examples/cost_model.py --hold-out 60    # runs a study that the model was not fitted to, beside its forecasts

Each case is a limb of ellipsoids, run in a process of its own that has run a smaller one before, so that compiling and
importing are not counted; what these take is measured apart.
"""

from __future__ import annotations

import argparse
import json
import secrets
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes
from musclefit.progress import Silent
from musclefit.workflows.batch import batch, forecast
from musclefit.workflows.cost import MODEL_FILE, CostModel, Measured, Sizes


@dataclass(frozen=True)
class Limb:
    """A limb to measure: muscles, subdivisions of each ellipsoid, landmarks per bone, and how it is run."""

    muscles: int
    level: int
    landmarks: int
    rigid: bool = False
    frames: int = 1
    pictures: bool = False
    tets: bool = False


FREE = [Limb(1, 2, 6), Limb(6, 2, 6), Limb(6, 2, 48), Limb(6, 3, 6), Limb(6, 3, 48), Limb(1, 4, 24), Limb(4, 4, 6)]
RIGID = [replace(limb, rigid=True) for limb in (FREE[0], Limb(4, 2, 6), Limb(4, 2, 24), Limb(4, 3, 6), Limb(1, 4, 24))]
MOVING = ((FREE[0], 4), (FREE[1], 8), (FREE[3], 3), (RIGID[0], 3), (RIGID[3], 3))
CASES = [
    *FREE,
    *RIGID,
    *(replace(limb, frames=frames) for limb, frames in MOVING),
    *(replace(limb, pictures=True) for limb in (FREE[0], FREE[3], FREE[5])),
    *(replace(limb, frames=frames, pictures=True) for limb, frames in MOVING[:3]),
    *(replace(limb, tets=True) for limb in (FREE[0], FREE[1], Limb(3, 2, 6), Limb(1, 3, 6))),
]

CHILD = """
import json, sys, time
from musclefit.io.provenance import cpu_seconds, peak_memory_mb
from musclefit.progress import Silent
from musclefit.workflows.batch_tasks import sizes_of
from musclefit.workflows.run import run
from musclefit.workflows.sequence import sequence

def make(rig, name):
    if told["frames"] == 1:
        return run(rig, out=told["out"] + name, pictures=told["pictures"], progress=Silent()).job
    motion = rig.rpartition("/")[0] + "/motion.csv"
    return sequence(rig, motion, out=told["out"] + name, pictures=told["pictures"], progress=Silent()).plan.job

told = json.loads(sys.argv[1])
make(told["warm"], "/warm")
first = cpu_seconds()
make(told["warm"], "/warm-again")
start = cpu_seconds()
job = make(told["rig"], "/out")
end = cpu_seconds()
sizes = sizes_of(job, frames=told["frames"], pictures=told["pictures"])
print(json.dumps({"sizes": sizes, "cpu_s": end - start, "peak_mb": peak_memory_mb(), "start_s": 2 * first - start}))
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


def write_limb(folder: Path, limb: Limb, *, bend_deg: float = 25.0) -> Path:
    """Two bones, muscles around them, a skin, and joints that bend it; the rig's path."""
    own = 60.0 + 1e-3 * secrets.randbelow(1000)  # tetrahedra are made for each, not found in the cache
    tissues = {
        "skin": ellipsoid((0, 0, 0), (own, 28, 28), level=limb.level),
        "bone_proximal": ellipsoid((-25, 0, 0), (18, 6, 6), level=limb.level),
        "bone_distal": ellipsoid((25, 0, 0), (18, 6, 6), level=limb.level),
    }
    for k in range(limb.muscles):
        angle = 2 * np.pi * k / limb.muscles
        width = min(5.0, 13.0 * np.sin(np.pi / max(limb.muscles, 2)) * 0.9)
        centre = (0.0, float(13.5 * np.cos(angle)), float(13.5 * np.sin(angle)))
        tissues[f"muscle_{k:02d}"] = ellipsoid(centre, (25, width, width), level=limb.level)
    (folder / "anatomy").mkdir(parents=True)
    for name, surface in tissues.items():
        (folder / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(surface))
    (folder / "joints.toml").write_text(JOINTS, encoding="utf-8")
    rows = [f"{k},{bend_deg * k / max(1, limb.frames - 1)}" for k in range(limb.frames)]
    (folder / "motion.csv").write_text("\n".join(["time_s,elbow_deg", *rows]) + "\n", encoding="utf-8")
    rig = folder / "limb.toml"
    frames = f"frames = {limb.frames}\n" if limb.frames > 1 else ""
    rig.write_text(
        'title = "Limb of ellipsoids"\n[anatomy]\nfolder = "anatomy"\n'
        f'[drive]\nkind = "joints"\njoints = "joints.toml"\n{frames}'
        f"pose = {{ elbow_deg = {bend_deg} }}\nlandmarks_per_bone = {limb.landmarks}\n"
        f"[bones]\nrigid = {str(limb.rigid).lower()}\n[tets]\nenabled = {str(limb.tets).lower()}\n",
        encoding="utf-8",
    )
    return rig


def measured(folder: Path, limb: Limb) -> tuple[Measured, float]:
    """CPU seconds and peak memory of one run; and what its process took before it was as fast as it gets."""
    warm = write_limb(folder / "warm", replace(limb, muscles=1, level=1, landmarks=6, frames=min(limb.frames, 2)))
    told = {
        "warm": str(warm),
        "rig": str(write_limb(folder / "limb", limb)),
        "out": str(folder / "runs"),
        "frames": limb.frames,
        "pictures": limb.pictures,
    }
    command = [sys.executable, "-c", CHILD, json.dumps(told)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    read = json.loads(done.stdout.splitlines()[-1])
    return Measured(Sizes(**read["sizes"]), read["cpu_s"], read["peak_mb"]), read["start_s"]


def hold_out(home: Path, subjects: int) -> None:
    """Run a study of limbs of other sizes than those measured, and print what was forecast before, and on the way."""
    rng = np.random.default_rng(11)
    rows = []
    for k in range(subjects):
        limb = Limb(int(rng.integers(2, 6)), 3, int(rng.integers(8, 40)))
        write_limb(home / f"sub-{k:03d}", limb, bend_deg=round(float(rng.uniform(5, 35)), 1))
        rows.append(f"sub-{k:03d},{rng.uniform(5, 35):.1f},{limb.landmarks}")
    headings = "subject,drive.pose.elbow_deg,drive.landmarks_per_bone"
    (home / "subjects.csv").write_text("\n".join([headings, *rows]) + "\n", encoding="utf-8")
    study = home / "study.toml"
    study.write_text(
        'title = "Limbs"\n[subjects]\ntable = "subjects.csv"\nfolders = "sub-*"\n'
        '[rigs]\nlimb = "sub-000/limb.toml"\n[set]\nanatomy.folder = "{folder}/anatomy"\n[run]\npictures = false\n',
        encoding="utf-8",
    )
    out = home / "out"
    before = forecast(study, out=out)
    cases = [f"sub-{k:03d}/limb" for k in range(subjects)]
    for name in cases[:5]:
        batch(study, out=out, only=name, progress=Silent())
    after = forecast(study, out=out)
    batch(study, out=out, progress=Silent())
    costs = [json.loads((out / "subjects" / name / "cost.json").read_text(encoding="utf-8"))["cpu_s"] for name in cases]
    for what, told, took in (
        ("before the first", before.cpu_s - CostModel.shipped().start_cpu_s, sum(costs)),
        ("after five", after.cpu_s - CostModel.shipped().start_cpu_s, sum(costs[5:])),
    ):
        print(f"forecast {what} of {subjects}: {told:.1f} CPU s; took {took:.1f} ({100 * (told / took - 1):+.0f} %)")


def main() -> int:
    """Measure, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the coefficients of the installed package")
    parser.add_argument("--hold-out", type=int, default=0, help="run a study of so many subjects; measure nothing else")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        if given.hold_out:
            hold_out(Path(scratch), given.hold_out)
            return 0
        cases, starts = [], []
        print("parts                               vertices  tissues  landmarks  frames   CPU s  peak MB")
        for number, limb in enumerate(CASES):
            case, start_s = measured(Path(scratch) / str(number), limb)
            cases.append(case)
            starts.append(start_s)
            s = case.sizes
            size = f"{' + '.join(s.parts):36}{s.vertices:8.0f} {s.tissues:8.0f} {s.landmarks:10.0f} {s.frames:7.0f}"
            print(f"{size} {case.cpu_s:7.2f} {case.peak_mb or 0.0:8.0f}", flush=True)
    model = CostModel.fitted(cases, start_cpu_s=float(np.median(starts)))
    print(model.text())
    if given.write:
        MODEL_FILE.write_text(model.text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
