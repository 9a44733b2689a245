"""Moment arms of a real forearm's muscles over elbow flexion beside those of OpenSim's arm26.

    musclefit architecture forearm_rigid --set drive.pose.forearm_deg=0 --curves --out elbow
    MUSCLEFIT_DATA=... python examples/forearm_moment_arms.py elbow --plot arms.svg

Prints a table in Markdown, mm: by the streamlines, by the straight line between the ends, and of the muscle that arm26
has for it. Needs ``musclefit[opensim]``; matplotlib for ``--plot``.
"""

from __future__ import annotations

import argparse
import csv
import os
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


def main() -> None:
    """Print the table, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what musclefit architecture --curves wrote")
    parser.add_argument("--plot", type=Path, help="draw the curves into this file")
    given = parser.parse_args()
    curves = curves_of(given.folder)
    angles = [float(row["elbow_deg"]) for row in next(iter(curves.values()))]
    arm26 = arm26_arms(Path(os.environ["MUSCLEFIT_DATA"]) / "opensim/arm26/arm26.osim", angles)
    drawn = []
    print("| elbow, ° | " + " | ".join(f"{angle:.0f}" for angle in angles) + " |")
    print("|---" * (len(angles) + 1) + "|")
    for part, other in PAIRS.items():
        (rows,) = (rows for name, rows in curves.items() if part in name)
        own = {f"{kind}": [float(row[f"moment_arm_{kind}_mm"]) for row in rows] for kind in ("path", "line")}
        for label, arms in (("streamlines", own["path"]), ("straight line", own["line"]), (other, arm26[other])):
            print(
                f"| {part.replace('_', ' ').replace('right ', '')}, {label} | "
                + " | ".join(f"{a:.1f}" for a in arms)
                + " |"
            )
            drawn.append((part, label, arms))
    if given.plot is not None:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, len(PAIRS), figsize=(3.2 * len(PAIRS), 3.2), sharey=True, layout="constrained")
        for axis, part in zip(axes, PAIRS, strict=True):
            for name, label, arms in drawn:
                if name == part:
                    axis.plot(angles, arms, label=label)
            axis.set(title=part.replace("_of_right", "").replace("_", " "), xlabel="elbow, °")
            axis.legend(fontsize=7)
        axes[0].set_ylabel("moment arm, mm")
        figure.savefig(given.plot)


if __name__ == "__main__":
    main()
