"""Moment arms of a real forearm's muscles over elbow flexion beside those of OpenSim's arm26, and over its turn.

    musclefit architecture forearm_rigid --set drive.pose.forearm_deg=0 --curves --out elbow
    musclefit architecture forearm_rigid --set drive.pose.elbow_deg=0 --curves --out turn
    MUSCLEFIT_DATA=... python examples/forearm_moment_arms.py elbow --turn turn --plot arms.svg

All three need ``MUSCLEFIT_DATA``; ``--muscles "*biceps*" --muscles "*triceps*"`` and the like look at fewer. Prints
tables in Markdown, mm: by the streamlines, by the straight line between the ends, and of the muscle that arm26 has for
it (whose forearm does not turn). Muscles that a folder does not have are left out and named. Needs
``musclefit[opensim]``; matplotlib for ``--plot``.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

PAIRS: Mapping[str, str] = {
    "long_head_of_right_biceps": "BIClong",
    "brachialis": "BRA",
    "lateral_head_of_right_triceps": "TRIlat",
    "medial_head_of_right_triceps": "TRImed",
    "long_head_of_right_triceps": "TRIlong",
}
"""Part of the muscle's name, and the muscle of arm26."""

TURNING = ("humeral_head_of_right_pronator_teres", "ulnar_head_of_right_pronator_teres", "long_head_of_right_biceps")
"""Of the muscles whose moment arms over the forearm's turn are told, pronation above 0."""


def arm26_arms(model_file: Path, angles_deg: Sequence[float]) -> Mapping[str, list[float]]:
    """Moment arms of arm26's muscles about its elbow, mm, at each angle; its own signs, flexion above 0."""
    import opensim

    opensim.Logger.setLevelString("error")
    model = opensim.Model(str(model_file))
    state = model.initSystem()
    elbow = model.getCoordinateSet().get("r_elbow_flex")
    found: dict[str, list[float]] = {name: [] for name in PAIRS.values()}
    for angle in angles_deg:
        elbow.setValue(state, float(np.radians(angle)))
        model.realizePosition(state)
        for name, arms in found.items():
            path = opensim.Muscle.safeDownCast(model.getMuscles().get(name)).getGeometryPath()
            arms.append(1e3 * path.computeMomentArm(state, elbow))
    return found


def curves_of(folder: Path) -> Mapping[str, list[Mapping[str, str]]]:
    """The rows of curves.csv by muscle."""
    found: dict[str, list[Mapping[str, str]]] = {}
    with (folder / "curves.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault(row["muscle"], []).append(row)
    return found


def arms_of(curves: Mapping[str, list[Mapping[str, str]]], part: str) -> Mapping[str, list[float]] | None:
    """Moment arms of the muscle with a name like that, mm; None, and said so, where there is none."""
    for name, rows in curves.items():
        if part in name:
            return {
                "streamlines": [float(row["moment_arm_path_mm"]) for row in rows],
                "straight line": [float(row["moment_arm_line_mm"]) for row in rows],
            }
    print(f"no muscle is named like {part}", file=sys.stderr)
    return None


def print_heading(angle: str, angles_deg: Sequence[float]) -> None:
    """The first two lines of a table."""
    print(f"| {angle}, ° | " + " | ".join(f"{angle:.0f}" for angle in angles_deg) + " |")
    print("|---" * (len(angles_deg) + 1) + "|")


def print_row(part: str, label: str, arms: Sequence[float]) -> None:
    """One line of a table."""
    print(f"| {part.replace('_', ' ').replace('right ', '')}, {label} | " + " | ".join(f"{a:.1f}" for a in arms) + " |")


def main() -> None:
    """Print the table, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what musclefit architecture --curves wrote")
    parser.add_argument("--turn", type=Path, help="the same of a motion that turns the forearm alone")
    parser.add_argument("--plot", type=Path, help="draw the curves into this file")
    given = parser.parse_args()
    curves = curves_of(given.folder)
    angles = [float(row["elbow_deg"]) for row in next(iter(curves.values()))]
    arm26 = arm26_arms(Path(os.environ["MUSCLEFIT_DATA"]) / "opensim/arm26/arm26.osim", angles)
    drawn = []
    print_heading("elbow", angles)
    for part, other in PAIRS.items():
        own = arms_of(curves, part)
        if own is None:
            continue
        for label, arms in (*own.items(), (other, arm26[other])):
            print_row(part, label, arms)
            drawn.append((part, label, arms))
    if given.turn is not None:
        turned = curves_of(given.turn)
        print()
        print_heading("turn", [float(row["forearm_deg"]) for row in next(iter(turned.values()))])
        for part in TURNING:
            for label, arms in (arms_of(turned, part) or {}).items():
                print_row(part, label, arms)
    if given.plot is not None:
        import matplotlib.pyplot as plt

        shown = list(dict.fromkeys(name for name, _, _ in drawn))
        size = (3.2 * len(shown), 3.2)
        figure, grid = plt.subplots(1, len(shown), figsize=size, sharey=True, squeeze=False, layout="constrained")
        axes = grid[0]
        for axis, part in zip(axes, shown, strict=True):
            for name, label, arms in drawn:
                if name == part:
                    axis.plot(angles, arms, label=label)
            axis.set(title=part.replace("_of_right", "").replace("_", " "), xlabel="elbow, °")
            axis.legend(fontsize=7)
        axes[0].set_ylabel("moment arm, mm")
        figure.savefig(given.plot)


if __name__ == "__main__":
    main()
