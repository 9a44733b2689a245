"""Time and memory of runs against vertices, tissues, landmarks and frames: measured here, and fitted to a model.

    python examples/cost_model.py            # measures, prints the table and the fit
    python examples/cost_model.py --write    # and puts the coefficients where `batch --estimate` finds them
    python examples/cost_model.py --hold-out 500 --limbs 36    # runs a study beside its forecasts; 1 where they are off

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

from musclefit.anatomy.builtin import upper_limb
from musclefit.anatomy.model import TissueKind
from musclefit.geometry.meshes import TriMesh
from musclefit.io.case_folders import read_cost
from musclefit.io.rig_names import find_rig
from musclefit.io.run_folder import ply_bytes
from musclefit.io.studies import read_study
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


BUILT_IN = """
title = "Built-in limb by the paper's loop"
[anatomy]
folder = "u000/anatomy"
[drive]
kind = "joints"
joints = "u000/joints.json"
pose = { elbow_deg = 30, forearm_deg = 20 }
[deformer]
method = "yu2014"
[compare]
methods = []
[tets]
enabled = false
"""

WITHIN_PERCENT = 25.0
"""How near the forecast after some cases shall come."""


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


def write_varied_study(home: Path, *, ellipsoids: int, limbs: int) -> Path:
    """A study of limbs of ellipsoids and of built-in limbs, each of its own size, tissues and pose; in random order."""
    rng = np.random.default_rng(11)
    rows = []
    for k in range(ellipsoids):
        limb = Limb(int(rng.integers(2, 6)), 2 + int(rng.random() < 0.5), int(rng.integers(8, 40)))
        write_limb(home / f"e{k:03d}", limb)
        rows.append(f"e{k:03d},ellipsoids,joints.toml,{limb.landmarks},{rng.uniform(5, 35):.1f},")
    for k in range(limbs):
        write_built_in(home / f"u{k:03d}", size=float(rng.uniform(0.8, 1.15)), muscles=int(rng.integers(4, 9)), rng=rng)
        angles = f"{rng.uniform(10, 60):.1f},{rng.uniform(0, 40):.1f}"
        rows.append(f"u{k:03d},built_in,joints.json,{rng.integers(8, 17)},{angles}")
    rows = [rows[k] for k in rng.permutation(len(rows))]
    headings = "subject,rig,joints,drive.landmarks_per_bone,drive.pose.elbow_deg,drive.pose.forearm_deg"
    (home / "subjects.csv").write_text("\n".join([headings, *rows]) + "\n", encoding="utf-8")
    (home / "built_in.toml").write_text(BUILT_IN, encoding="utf-8")
    named = ('ellipsoids = "e000/limb.toml"\n' * bool(ellipsoids), 'built_in = "built_in.toml"\n' * bool(limbs))
    study = home / "study.toml"
    study.write_text(
        f'title = "Limbs"\n[subjects]\ntable = "subjects.csv"\nfolders = "[eu][0-9]*"\n[rigs]\n{"".join(named)}'
        '[set]\nanatomy.folder = "{folder}/anatomy"\ndrive.joints = "{folder}/{joints}"\n[run]\npictures = false\n',
        encoding="utf-8",
    )
    return study


def write_built_in(folder: Path, *, size: float, muscles: int, rng: np.random.Generator) -> None:
    """The built-in limb with some of its muscles and of another size, and its joints."""
    tissues = upper_limb().tissues
    kept = set(rng.permutation([t.name for t in tissues if t.kind is TissueKind.MUSCLE])[:muscles])
    (folder / "anatomy").mkdir(parents=True)
    for tissue in tissues:
        if tissue.kind is not TissueKind.MUSCLE or tissue.name in kept:
            surface = tissue.surface.with_vertices(size * tissue.surface.vertices)
            (folder / "anatomy" / f"{tissue.name}.ply").write_bytes(ply_bytes(surface))
    joints = json.loads(find_rig("upper_limb").with_name("upper_limb_joints.json").read_text(encoding="utf-8"))
    for joint in joints.values():
        if isinstance(joint, dict):
            joint["centre_mm"] = [size * x for x in joint["centre_mm"]]
    (folder / "joints.json").write_text(json.dumps(joints), encoding="utf-8")


def hold_out(home: Path, *, ellipsoids: int, limbs: int, pilots: int) -> bool:
    """Run a varied study, and print what was forecast before, and after some cases; whether the latter came near."""
    study, out = write_varied_study(home, ellipsoids=ellipsoids, limbs=limbs), home / "out"
    before = forecast(study, out=out)
    names = [case.name for case in read_study(study).cases]
    groups = [[name for name in names if name.startswith(letter)] for letter in "eu"]
    first = [name for group in groups for name in group[:pilots]]
    for name in first:
        batch(study, out=out, only=name, progress=Silent())
    after = forecast(study, out=out)
    batch(study, out=out, progress=Silent())
    costs = {name: cost for name in names if (cost := read_cost(out, name)) is not None and cost.cpu_s}
    for group, said in zip(groups, ("ellipsoids", "built-in limbs"), strict=True):
        took = [float(costs[name].cpu_s or 0.0) for name in group]
        if took:
            print(f"{len(took)} {said}: {sum(took):.1f} CPU s, each {min(took):.2f} to {max(took):.2f}")
    start, rest = CostModel.shipped().start_cpu_s, [name for name in names if name not in first]
    peak = max(float(cost.process_peak_mb or 0.0) for cost in costs.values())
    near = True
    for what, told, of in (("before the first", before, names), (f"after the first {pilots} of each", after, rest)):
        in_all = sum(float(costs[name].cpu_s or 0.0) for name in of)
        off = [100.0 * (ours / theirs - 1.0) for ours, theirs in ((told.cpu_s - start, in_all), (told.peak_mb, peak))]
        print(
            f"forecast {what}, for {len(of)}: {told.cpu_s - start:.1f} CPU s; took {in_all:.1f} ({off[0]:+.0f} %); "
            f"{told.peak_mb:.0f} MB; took {peak:.0f} ({off[1]:+.0f} %)"
        )
        near = max(map(abs, off)) <= WITHIN_PERCENT
    return near


def main() -> int:
    """Measure, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="replace the coefficients of the installed package")
    parser.add_argument("--hold-out", type=int, default=0, help="run a study of so many limbs; measure nothing else")
    parser.add_argument("--limbs", type=int, default=0, help="and of so many built-in limbs")
    parser.add_argument("--pilots", type=int, default=5, help="of each kind, made before the second forecast")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        if given.hold_out or given.limbs:
            study = Path(scratch).resolve()
            return not hold_out(study, ellipsoids=given.hold_out, limbs=given.limbs, pilots=given.pilots)
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
