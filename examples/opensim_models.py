"""OpenSim's own models carried to another body, over their motions: places, muscles and moment arms before and after.

    MUSCLEFIT_DATA=... python examples/opensim_models.py
    MUSCLEFIT_DATA=... python examples/opensim_models.py --frames 20 --model rajagopal2016

arm26 and Rajagopal 2016 go by 27 landmarks around their closed bones to targets 8 and 12 % larger and 5 % smaller
along x, y and z, with 2 mm of noise; a run proves the map, and two exports carry the model, the second with some bodies
scaled linearly. OpenSim's library opens what is written: points must be where the map takes them, and bodies where our
own kinematics have them in every pose of the motion. Needs the extra `opensim`; takes a minute of CPU time.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import musclefit as mf
from musclefit.flow.deformation import Deformation
from musclefit.io.drives.opensim import coordinate_motion
from musclefit.rig.multibody import GROUND
from musclefit.workflows.export_osim import ExportedModel
from musclefit.workflows.import_osim import read_osim

MODELS = {
    "arm26": ("arm26.osim", "arm26_InverseKinematics.mot", ("r_humerus",)),
    "rajagopal2016": ("Rajagopal2016.osim", "subject01_walk1_ik.mot", ("pelvis", "torso", "femur_r")),
}
"""Of each model its file, its motion, and the bodies that the second export scales linearly."""
TURNED = {"rajagopal2016": ("knee_angle_r", "knee_angle_l")}
"""Columns whose signs are turned, unless the motion is asked for as given: its model bends knees below 0."""
LARGER = np.array([1.08, 1.12, 0.95])
NOISE_MM = 2.0
LONG_MM = 5.0
"""Moment arms that are shorter throughout the motion are not compared by their ratio."""


def write_rig(folder: Path) -> Path:
    """A rig of 27 landmarks around an imported model's bones."""
    vertices = mf.read_anatomy(folder / "bones").anatomy.vertices()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    grid = np.array([(x, y, z) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0) for z in (0.0, 0.5, 1.0)])
    points = low + grid * (high - low)
    targets = points * LARGER + np.random.default_rng(0).normal(scale=NOISE_MM, size=points.shape)
    rows = [f"p{k}," + ",".join(f"{v!r}" for v in row) for k, row in enumerate(np.hstack([points, targets]).tolist())]
    head = "name,x_mm,y_mm,z_mm,target_x_mm,target_y_mm,target_z_mm"
    (folder / "pairs.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    rig = folder / "to_subject.toml"
    rig.write_text(
        'title = "subject"\n[anatomy]\nfolder = "bones"\n[anatomy.kinds]\n"*" = "bone"\n[drive]\nkind = "landmarks"\n'
        'source = "pairs.csv"\n[deformer]\nkernel = "r3"\nstep = "cayley"\n[limits]\npurpose = "another-body"\n',
        encoding="utf-8",
    )
    return rig


def turned(motion: Path, columns: tuple[str, ...], out: Path) -> Path:
    """A motion with the signs of some columns turned."""
    head, mark, body = motion.read_text(encoding="utf-8").partition("endheader\n")
    names, *rows = body.splitlines()
    at = [names.split().index(column) for column in columns]
    signs = np.array([-1.0 if k in at else 1.0 for k in range(len(names.split()))])
    values = ["\t".join(repr(v) for v in (signs * np.array(row.split(), dtype=float)).tolist()) for row in rows if row]
    out.write_text("\n".join([head + mark + names, *values]) + "\n", encoding="utf-8")
    return out


def opened(path: Path) -> tuple[Any, Any]:
    """A model and its state, by OpenSim's library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import opensim
    opensim.Logger.setLevelString("Off")
    model = opensim.Model(str(path))
    return model, model.initSystem()


def places(model: Any, state: Any, values: dict[str, float]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Rotation and place (mm) of each body where OpenSim has it, the coordinates being at some values."""
    coordinates, bodies = model.getCoordinateSet(), model.getBodySet()
    for k in range(coordinates.getSize()):
        coordinates.get(k).setLocked(state, False)
        coordinates.get(k).setValue(state, values[coordinates.get(k).getName()], False)
    model.realizePosition(state)
    for k in range(bodies.getSize()):
        there = bodies.get(k).getTransformInGround(state)
        turn = there.R().asMat33()
        rotation = np.array([[turn.get(i, j) for j in range(3)] for i in range(3)])
        yield bodies.get(k).getName(), rotation, 1000.0 * np.array([there.p().get(i) for i in range(3)])


def points_off(before: Path, after: Path, move: Deformation) -> tuple[int, float]:
    """Points that were carried, and how far one is at most from where the map takes it, bodies by OpenSim, mm."""
    off = []
    bodies = {}
    for path in (before, after):
        model, state = opened(path)
        bodies[path] = {
            name: (turn, at) for name, turn, at in places(model, state, read_osim(path).multibody.values({}))
        }
    for old, new in zip(read_osim(before).points, read_osim(after).points, strict=True):
        if old.body == GROUND:
            continue
        was, now = (
            turn @ at + place
            for (turn, place), at in ((bodies[before][old.body], old.at), (bodies[after][new.body], new.at))
        )
        off.append(np.linalg.norm(now - move(was[None])[0]))
    return len(off), float(max(off))


def bodies_off(model: Path, motion: Path, frames: int) -> tuple[int, float, float]:
    """Poses compared, and how far a body is from where OpenSim has it at most: mm, and entries of its rotation."""
    ours = read_osim(model)
    moved = coordinate_motion(motion.read_bytes(), ours, source=str(motion))
    theirs, state = opened(model)
    rows = sorted({round(k) for k in np.linspace(0, len(moved.times_s) - 1, frames).tolist()})
    off_mm, off_turn = 0.0, 0.0
    for row in rows:
        here = ours.multibody.places(moved.at(row))
        for body, rotation, place in places(theirs, state, ours.multibody.values(moved.at(row))):
            off_mm = max(off_mm, float(np.linalg.norm(here[body].translation - place)))
            off_turn = max(off_turn, float(np.abs(here[body].rotation - rotation).max()))
    return len(rows), off_mm, off_turn


def in_words(exported: ExportedModel) -> list[str]:
    """Muscles, moment arms and wraps of a carried model."""
    said = exported.to_json()
    lines = [
        f"{one['body']} scaled linearly by {one['x']:.3f} {one['y']:.3f} {one['z']:.3f}, off the map by "
        f"{one['rms_mm']:.1f} mm rms, {one['largest_mm']:.1f} at most"
        for one in said.get("linear_bodies", [])
    ]
    ratios = [one["length_after_mm"] / one["length_before_mm"] for one in said["muscles"]]
    lines.append(f"{len(ratios)} muscle paths, {min(ratios):.2f} to {max(ratios):.2f} times as long at rest")
    worst = max(said["wraps"], key=lambda one: one["largest_mm"])
    lines.append(
        f"{len(said['wraps'])} wrap objects, the worst ({worst['name']}) off its samples by "
        f"{worst['rms_mm']:.1f} mm rms, {worst['largest_mm']:.1f} at most"
    )
    over = said["muscles_over_motion"]
    ranges = [[one[f"longest_{when}_mm"] - one[f"shortest_{when}_mm"] for one in over] for when in ("before", "after")]
    lines.append(f"lengths vary over the motion by up to {max(ranges[0]):.0f} mm before, {max(ranges[1]):.0f} after")
    in_bone = [[one[f"in_bone_{when}_mm"] for one in over] for when in ("before", "after")]
    deepest = [max((one[f"depth_{when}_mm"], one["muscle"]) for one in over) for when in ("before", "after")]
    lines.append(
        f"paths in bone somewhere in the motion: {np.count_nonzero(in_bone[0])} before, {np.count_nonzero(in_bone[1])} "
        f"after; deepest {deepest[0][0]:.1f} mm ({deepest[0][1]}) before, {deepest[1][0]:.1f} ({deepest[1][1]}) after"
    )
    arms = said["moment_arms"]
    largest = [
        [max(abs(one[f"least_{when}_mm"]), abs(one[f"most_{when}_mm"])) for one in arms] for when in ("before", "after")
    ]
    ratio = [after / before for before, after in zip(*largest, strict=True) if before > LONG_MM]
    lines.append(
        f"{len(arms)} moment arms; the largest of each over the motion became {min(ratio):.2f} to {max(ratio):.2f} "
        f"times as long, {np.median(ratio):.2f} at the median (of {len(ratio)} above {LONG_MM:g} mm)"
    )
    flipped = [one for one in arms if one["poses_of_other_sign"]]
    lines += [
        f"moment arm of {one['muscle']} about {one['coordinate']}: of other sign at {one['poses_of_other_sign']}, "
        f"{one['least_before_mm']:.1f} to {one['most_before_mm']:.1f} mm before, {one['least_after_mm']:.1f} to "
        f"{one['most_after_mm']:.1f} after"
        for one in flipped
    ]
    return lines


def carried(name: str, data: Path, folder: Path, frames: int, *, as_given: bool) -> Iterator[str]:
    """Carry a model twice; what came of it, in lines."""
    file, moves, linear = MODELS[name]
    model, motion = data / name / file, data / name / moves
    if name in TURNED and not as_given:
        motion = turned(motion, TURNED[name], folder / moves)
        yield f"{moves} with the signs of {' and '.join(TURNED[name])} turned"
    mf.import_osim(model, folder / "rig")
    rig = write_rig(folder / "rig")
    done = mf.run(rig, pictures=False)
    yield done.said()
    for out, scaled in ((folder / "subject", ()), (folder / "partly_linear", linear)):
        began = time.process_time()
        exported = mf.export_osim(rig, model, out, motion=motion, frames=frames, linear=scaled)
        seconds = time.process_time() - began
        compared, off_mm, off_turn = bodies_off(out / file, motion, frames)
        if scaled:
            yield f"again, with {len(scaled)} bodies scaled linearly:"
        yield f"carried and measured at {compared} times of {motion.name} in {seconds:.0f} CPU s"
        yield f"bodies within {off_mm:.1e} mm of OpenSim's places, rotations within {off_turn:.1e}"
        if not scaled:
            count, points_mm = points_off(model, out / file, done.deformation)
            yield f"{count} points at rest within {points_mm:.1e} mm of where the map takes them"
        yield from in_words(exported)


def main() -> None:
    """Carry each model and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", nargs="+", choices=MODELS, default=list(MODELS), metavar="MODEL")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--as-given", action="store_true", help="the walk with its knees below 0, as its file has them")
    given = parser.parse_args()
    for name in given.model:
        with tempfile.TemporaryDirectory() as made:
            data = Path(os.environ["MUSCLEFIT_DATA"]) / "opensim"
            for line in carried(name, data, Path(made), given.frames, as_given=given.as_given):
                print(f"{name}: {line}", flush=True)


if __name__ == "__main__":
    main()
