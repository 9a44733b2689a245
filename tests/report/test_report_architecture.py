"""The page of muscle architecture: what is to be known of muscles, curves over the joint that turns, names escaped."""

from __future__ import annotations

import re
from typing import Any

import pytest
from test_report_scene import HOSTILE

from musclefit.report.architecture_html import WAY, fibre_curves, render_architecture


def muscle(name: str, **said: Any) -> dict[str, Any]:
    numbers = dict.fromkeys(("fibre_mm", "fibre_sd_mm", "path_mm", "pennation_deg", "pcsa_mm2", "volume_mm3"), 12.5)
    ends = {"origin": "humerus", "insertion": ""}
    return {
        "name": name,
        "fibres": "flow",
        **numbers,
        **ends,
        "lines_whole": 199,
        "lines": 200,
        "pieces": 1,
        "note": "",
    } | said


def attachment(name: str, end: str, bone: str) -> dict[str, Any]:
    return {
        "muscle": name, "end": end, "bone": bone, "area_mm2": 30.0, "distance_mm": 0.4 if bone else None,
        "reason": "" if bone else "the nearest is ulna, 9 mm off", "also_touches": "",
    }  # fmt: skip


def carried(name: str) -> dict[str, Any]:
    keys = ("fibre_mm", "pennation_deg", "stretch_mean", "stretch_p1", "stretch_p99", "stretch_max", "doubled_share")
    ends = {f"{end}_{what}": 0.25 for end in ("origin", "insertion") for what in ("area_ratio", "off_bone_mm")}
    return {"name": name, **dict.fromkeys(keys, 0.75), "section_ratio_mean": 1.0, **ends}


def told(*names: str, **said: Any) -> dict[str, Any]:
    ends = [attachment(n, e, b) for n in names for e, b in (("origin", "humerus"), ("insertion", ""))]
    return {
        "title": "An elbow", "schema_version": "1.0", "claim": "at rest", "within_mm": 1.27, "notes": [],
        "without_two_attachments": list(names), "without_fibres": {}, "muscles": [muscle(n) for n in names],
        "attachments": ends, "carried": [], "moment_arms": [], "curves": [], "fibre_files": [],
    } | said  # fmt: skip


def way(name: str, angles: list[float], *, turn: float = 0.0) -> list[dict[str, Any]]:
    return [
        {
            "muscle": name, "at": k / (len(angles) - 1), "elbow_deg": angle, "forearm_deg": turn * k, "path_mm": 90.0,
            "fibre_mm": 50.0 - k, "stretch": 1.0 - k / 50.0, "pennation_deg": 10.0 + k, "line_mm": 80.0,
            "moment_arm_path_mm": 20.0 + k, "moment_arm_line_mm": None,
        }
        for k, angle in enumerate(angles)
    ]  # fmt: skip


def test_free_ends_and_pieces_are_told() -> None:
    note = "its tetrahedra are in 2 pieces: 0.017 % of its volume is joined to the rest at no face"
    page = render_architecture(
        told("a", "b", muscles=[muscle("a"), muscle("b", pieces=2, note=note)], without_fibres={"c": "no piece"})
    )
    for what in (note, "1 of 2 muscles", "free: the nearest is ulna, 9 mm off", "no piece", "0 of 2 muscles"):
        assert what in page, what
    assert "After the map" not in page
    assert "On the way" not in page


def test_after_a_map_attachments_have_their_area_and_how_far_they_are_off_the_bone() -> None:
    assert "Off the bone after it" not in render_architecture(told("a"))
    page = render_architecture(told("a", carried=[carried("a")]))
    assert "Off the bone after it" in page
    assert page.count('<td class="n">0.25</td>') == 4


def test_names_cannot_become_markup() -> None:
    page = render_architecture(
        told(
            HOSTILE, title=HOSTILE, carried=[carried(HOSTILE)], curves=way(HOSTILE, [0.0, 40.0, 75.0]), notes=[HOSTILE]
        )
    )
    assert HOSTILE not in page


@pytest.mark.parametrize(
    ("angles", "turn", "along"),
    [
        ([0.0, 40.0, 75.0], 0.0, "elbow, degrees"),
        ([0.0, -10.0, -30.0], 0.0, "elbow, degrees"),
        ([0.0, 40.0, 20.0], 0.0, WAY),
        ([0.0, 40.0, 75.0], 5.0, WAY),
    ],
)
def test_curves_run_over_the_joint_that_alone_turns_one_way(angles: list[float], turn: float, along: str) -> None:
    drawn = fibre_curves(way("muscle_a", angles, turn=turn) + way("muscle_b", angles, turn=turn))
    assert list(drawn) == [
        "Mean fibre length", "Fibre length over that at rest", "Pennation", "Moment arm by the streamlines",
    ]  # fmt: skip
    for svg in drawn.values():
        assert f">{along}</text>" in svg
        xs = [float(x) for x in re.findall(r"[ML]([\d.]+) ", re.findall(r'<path d="([^"]*)"', svg)[0])]
        assert len(xs) == 3
        assert xs == sorted(xs)


def test_without_states_there_are_no_curves() -> None:
    assert fibre_curves([]) == {}
