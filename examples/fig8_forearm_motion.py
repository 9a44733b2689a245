"""Fig. 8 of Yu et al. 2014 as a motion: a real forearm from rest to elbow 75 and forearm 70 degrees, frame by frame.

    MUSCLEFIT_DATA=... python examples/fig8_forearm_motion.py --out musclefit-out/fig8

The same landmarks in one shot, by the paper's loop, and by the rig's own method (isochoric implicit steps along the
joints, rigid bones), every frame from rest; muscle measures over time. A run that was interrupted goes on.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.interpolate import RBFInterpolator

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.figures.films import motion_pictures
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform_in_one_shot
from musclefit.pipeline.retarget import retarget
from musclefit.pipeline.sequence import posed_job
from musclefit.report.model import Side
from musclefit.report.sequence import SequenceReport
from musclefit.rig.job import Job
from musclefit.rig.motion import Pose
from musclefit.workflows.sequence import run_sequence
from musclefit.workflows.sequence_frames import read_frames
from musclefit.workflows.sequence_outputs import write_outputs
from musclefit.workflows.sequence_plan import planned

PAPER = (
    "bones.rigid=false",
    "surfaces.refine=false",
    "deformer.kernel=r2logr",
    "deformer.step=explicit",
    "deformer.path=straight",
    "deformer.degrees_per_step=360",
)
"""The paper's loop on the rig's landmarks; its baseline is the same in one shot."""


@dataclass(frozen=True)
class Row:
    """One method in one frame."""

    method: str
    pose: Pose
    certificate: str
    landmarks_mm: float
    bones_mm: float
    volume_percent: tuple[float, float]
    overlap_mm3: float
    folded: int
    cpu_s: float

    def cells(self) -> str:
        """One line of the table."""
        median, worst = self.volume_percent
        return (
            f"| {self.pose.time_s:.2f} | {self.method} | {self.certificate} | {self.folded} | "
            f"{self.landmarks_mm:.1e} | {self.bones_mm:.3g} | {median:.2g} / {worst:.2g} | "
            f"{self.overlap_mm3:.3g} | {self.cpu_s:.1f} |"
        )


HEAD = (
    "| time, s | method | map | folded vertices | landmarks, mm | bones off rigid, mm | "
    "muscle volume, median / worst, % | introduced overlap, mm³ | CPU, s |\n|---|---|---|---|---|---|---|---|---|"
)


def row_of(method: str, pose: Pose, side: Side, cpu_s: float) -> Row:
    """A line of one method's outcome."""
    changes = [abs(t.volume_change_percent) for t in side.of_kind(TissueKind.MUSCLE)]
    return Row(
        method=method,
        pose=pose,
        certificate=side.map.claim.value,
        landmarks_mm=side.landmarks.max_error_mm,
        bones_mm=max(t.rigidity_mm or 0.0 for t in side.of_kind(TissueKind.BONE)),
        volume_percent=(float(np.median(changes)), max(changes)),
        overlap_mm3=side.overlap_total.introduced_mm3,
        folded=side.map.folded_points,
        cpu_s=cpu_s,
    )


def others(job: Job, pose: Pose) -> tuple[list[Row], list[Anatomy]]:
    """One shot and the paper's loop in one pose."""
    posed = posed_job(job, pose)
    start = time.process_time()
    deform_in_one_shot(posed, job.anatomy.vertices())
    one_shot_s = time.process_time() - start
    start = time.process_time()
    result = retarget(posed, tets=None)
    both_s = time.process_time() - start
    assert result.baseline is not None
    rows = [
        row_of("one shot", pose, result.baseline.side, one_shot_s),
        row_of("the paper's loop", pose, result.result.side, both_s),
    ]
    return rows, [result.baseline.deformed, result.result.deformed]


def ours(report: SequenceReport, number: int, pose: Pose) -> Row:
    """Our line of one frame, of the report of the sequence."""
    frame = report.frames[number]
    said = {check.name: check.value for check in frame.checks}
    changes = [abs(change) for change in frame.volume_changes.values()]
    return Row(
        method="ours",
        pose=pose,
        certificate=frame.claim,
        landmarks_mm=said["landmark error"],
        bones_mm=said["bone off rigid"],
        volume_percent=(float(np.median(changes)), max(changes)),
        overlap_mm3=frame.overlap_mm3,
        folded=int(said["folded points"]),
        cpu_s=frame.cpu_s["frame"],
    )


def one_shot_by_scipy(job: Job, pose: Pose) -> float:
    """CPU seconds of SciPy's thin-plate spline from the same landmarks to the same points."""
    posed = posed_job(job, pose)
    targets, points = posed.path.position(1.0), job.anatomy.vertices()
    start = time.process_time()
    RBFInterpolator(job.handles.source, targets, kernel="thin_plate_spline")(points)
    return time.process_time() - start


def picture(columns: Sequence[tuple[Pose, list[Anatomy]]], names: Sequence[str], file: Path) -> None:
    """A column for each pose, a row for each method, all from one view."""
    titles = [f"{pose.time_s:.2f} s" for pose, _ in columns for _ in names]
    every = [anatomy for _, anatomies in columns for anatomy in anatomies]
    drawn = [Image.open(BytesIO(data)).convert("RGB") for data in motion_pictures(every, titles, height_px=620)]
    width, height = drawn[0].size
    sheet = Image.new("RGB", (120 + width * len(columns), height * len(names)), "white")
    for number, image in enumerate(drawn):
        column, row = divmod(number, len(names))
        sheet.paste(image, (120 + column * width, row * height))
    for row, name in enumerate(names):
        ImageDraw.Draw(sheet).text((8, row * height + height // 2), name, fill="black", font_size=18)
    sheet.save(file)


def measures_picture(report: SequenceReport, file: Path) -> None:
    """The second row of Fig. 9: volume, length and largest section of the muscles over time, and their gaps."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    made = report.made
    times = [frame.time_s for frame in made]
    kinds = {
        "volume, change in %": "volume_mm3",
        "centreline, change in %": "centreline_mm",
        "largest section, change in %": "largest_section_mm2",
        "smallest gap, mm": "gap_mm",
    }
    figure, axes = plt.subplots(1, len(kinds), figsize=(18, 4), layout="constrained")
    for axis, (title, key) in zip(axes, kinds.items(), strict=True):
        lines = {}
        for number, muscle in enumerate(made[0].muscles):
            values = np.array([getattr(frame.muscles[number], key) for frame in made], dtype=float)
            lines[muscle.name] = values if key == "gap_mm" else 100.0 * (values / values[0] - 1.0)
        spread = {
            name: float(np.ptp(line[np.isfinite(line)])) for name, line in lines.items() if np.isfinite(line).any()
        }
        loudest = sorted(spread, key=lambda name: -spread[name])[:4]
        for name, line in lines.items():
            known = name in loudest
            label = name.removeprefix("muscle_").split("_FMA")[0].replace("_", " ") if known else None
            axis.plot(
                times, line, color=None if known else "0.8", lw=1.6 if known else 0.6, label=label, zorder=1 + known
            )
        axis.set(title=title, xlabel="time, s")
        axis.legend(fontsize=6)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def compare(rig: str, *, figure: str, at: Sequence[float]) -> None:
    """Run a rig's motion by our method, and compare it with the others at some shares of its time."""
    parser = argparse.ArgumentParser(description=f"{figure}: a motion, method by method")
    parser.add_argument("--out", type=Path, default=Path("musclefit-out") / figure)
    parser.add_argument("--frames", type=int, default=0, help="frames; without it those of the rig")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], help="key=value of the rig, for our method")
    options = parser.parse_args()
    job = read_rig(find_rig(rig), overrides=options.set)
    plan = planned(job, frames=options.frames)
    report = run_sequence(plan, options.out / "sequence", workers=options.workers)
    write_outputs(plan, options.out / "sequence", report)
    poses = plan.poses
    chosen = sorted({round(share * (len(poses) - 1)) for share in at})
    frames = {frame.summary.number: frame for frame in read_frames(job, options.out / "sequence")}
    paper = read_rig(find_rig(rig), overrides=PAPER)
    columns = []
    print(HEAD)
    for number in chosen:
        rows, anatomies = others(paper, poses[number])
        if report.frames[number].outcome == "made":
            rows.append(ours(report, number, poses[number]))
            anatomies.append(frames[number].anatomy())
            columns.append((poses[number], anatomies))
        for row in rows:
            print(row.cells(), flush=True)
    frame_s, march_s = (float(np.mean([f.cpu_s[part] for f in report.made])) for part in ("frame", "march"))
    scipy_s = one_shot_by_scipy(job, poses[chosen[-1]])
    print(
        f"\nCPU s per frame: {frame_s:.1f} ({march_s:.1f} of it the march; the rest moves, refines, proves and "
        f"checks); SciPy's one-shot warp of the same points by the same landmarks: {scipy_s:.3f}, "
        f"{frame_s / scipy_s:.0f} times less"
    )
    print(f"\n{report.verdict}: {len(report.made)} of {len(poses)} frames made, {report.certified} certified")
    for check in report.checks:
        said = "ok" if check.passed else "FAIL"
        print(f"{said:4s} {check.name}: {check.value:.4g} {check.unit} (limit {check.limit:g}) {check.place}")
    picture(columns, ["one shot", "paper's loop", "ours"], options.out / f"{figure}.png")
    measures_picture(report, options.out / f"{figure}_muscles.png")
    print(f"wrote {options.out / figure}.png, {options.out / figure}_muscles.png and {options.out / 'sequence'}")


if __name__ == "__main__":
    compare("forearm_motion", figure="fig8", at=(0.33, 0.67, 1.0))
