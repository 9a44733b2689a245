"""Fibre lengths and cross-sections of a real forearm's muscles, at rest, beside published ones.

    MUSCLEFIT_DATA=... python examples/forearm_architecture.py

Prints a table in Markdown. With ``--report FILE`` it takes the report.json of `musclefit architecture` as it is.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import musclefit as mf

MURRAY = "Murray 2000"
FRIDEN = "Fridén 2001"
WRIST = "OpenSim wrist"
ARM26 = "OpenSim arm26"
SOURCES: Mapping[str, str] = {
    MURRAY: "W. M. Murray, T. S. Buchanan and S. L. Delp, The isometric functional capacity of muscles that cross "
    "the elbow, J. Biomech. 33 (2000) 943-952, abstract: fascicles, and PCSA, of 10 specimens",
    FRIDEN: "J. Fridén, D. Albrecht and R. L. Lieber, Biomechanical analysis of the brachioradialis as a donor in "
    "tendon transfer, Clin. Orthop. Rel. Res. 383 (2001) 152-161, abstract: fibres of four regions, 10 specimens",
    WRIST: "optimal_fiber_length and pennation_angle_at_optimal of the OpenSim model wrist.osim (R. V. Gonzalez, "
    "T. S. Buchanan and S. L. Delp, J. Biomech. 30 (1997) 705-712)",
    ARM26: "the same of the OpenSim model arm26.osim (K. R. S. Holzbaur, W. M. Murray and S. L. Delp, Ann. Biomed. "
    "Eng. 33 (2005) 829-840)",
}

PUBLISHED: tuple[tuple[str, str, str, str, str], ...] = (
    ("brachioradialis", "104 to 180", "", "", FRIDEN),
    ("brachioradialis", "177", "120", "", MURRAY),
    ("pronator_teres", "55", "", "", MURRAY),
    ("brachialis", "85.8", "", "0", ARM26),
    ("long_head_of_right_biceps", "115.7", "", "0", ARM26),
    ("long_head_of_right_triceps", "134", "", "12", ARM26),
    ("lateral_head_of_right_triceps", "113.8", "", "9", ARM26),
    ("medial_head_of_right_triceps", "113.8", "", "9", ARM26),
    ("extensor_carpi_radialis_longus", "93.6", "", "2.5", WRIST),
    ("extensor_digitorum", "62.6 to 72.4", "", "2 to 3", WRIST),
    ("humeroulnar_head_of_right_flexor_digitorum_superficialis", "83.5 (index)", "", "6", WRIST),
    ("flexor_digitorum_profundus", "74.9 (little)", "", "8", WRIST),
    ("flexor_pollicis_longus", "55.2", "", "7", WRIST),
)
"""Part of the muscle's name, fibre length in mm, PCSA in mm², pennation in degrees, source; empty: not found there."""


def rows(muscles: list[Mapping[str, Any]]) -> Sequence[tuple[str, ...]]:
    """One row for each published value and muscle that it is of."""
    found = []
    for part, fibre, pcsa, pennation, source in PUBLISHED:
        for muscle in muscles:
            if part in muscle["name"]:
                measured = (muscle["fibre_mm"], muscle["pcsa_mm2"], muscle["pennation_deg"])
                fibre_mm, pcsa_mm2, degrees = ("" if v is None else f"{v:.0f}" for v in measured)
                name = muscle["name"].removeprefix("muscle_").rsplit("_", 1)[0].replace("_", " ").replace("right ", "")
                found.append((name, fibre_mm, fibre, pcsa_mm2, pcsa, degrees, pennation, source))
    return found


def main() -> None:
    """Print the table and its sources."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, help="report.json of musclefit architecture")
    given = parser.parse_args()
    if given.report is None:
        muscles = mf.architecture("forearm_rigid", deform=False).to_json()["muscles"]
    else:
        muscles = json.loads(given.report.read_text(encoding="utf-8"))["muscles"]
    print("| muscle | fibre, mm | published | PCSA, mm² | published | pennation, ° | published | source |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows(muscles):
        print("| " + " | ".join(row) + " |")
    for name, source in SOURCES.items():
        print(f"- {name}: {source}")


if __name__ == "__main__":
    main()
