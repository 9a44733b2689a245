"""A limb of four balls as files: two bones, a muscle, the skin, and landmark pairs that bend it; runs in a second."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import trimesh

from musclefit.geometry.meshes import TriMesh
from musclefit.io.run_folder import ply_bytes

LANDMARKS = 12
BEND_DEG = 25.0

RIG = """
title = "Four balls, bent"

[anatomy]
folder = "anatomy"

[drive]
kind = "landmarks"
source = "landmarks.csv"

[deformer]
kernel = "r3"

[certificate]
max_boxes = 20000

[tets]
enabled = false
edge_length_fraction = 0.2
envelope_fraction = 0.01

[limits]
bone_rigidity_mm = 2.0
muscle_volume_percent = 50.0
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

JOINT_DRIVE = """
[drive]
kind = "joints"
joints = "joints.toml"
pose = { elbow_deg = 25 }
landmarks_per_bone = 6
"""


def egg(centre: tuple[float, float, float], axes: tuple[float, float, float], *, subdivisions: int = 2) -> TriMesh:
    """An ellipsoid, mm."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return TriMesh(np.asarray(ball.vertices) * axes + centre, np.asarray(ball.faces))


TISSUES: Mapping[str, TriMesh] = MappingProxyType(
    {
        "skin": egg((0, 0, 0), (60, 28, 28)),
        "bone_proximal": egg((-25, 0, 0), (18, 6, 6)),
        "bone_distal": egg((25, 0, 0), (18, 6, 6)),
        "muscle_flexor": egg((0, 13, 0), (25, 5, 5)),
    }
)


def landmark_rows() -> list[list[str]]:
    """The cells of the landmark table: the ends of each bone's axes, and where a bend of the elbow takes them."""
    angle = np.radians(BEND_DEG)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    rows = [["name", "bone", "x_mm", "y_mm", "z_mm", "target_x_mm", "target_y_mm", "target_z_mm"]]
    for bone, centre, motion in (("bone_proximal", -25.0, np.eye(3)), ("bone_distal", 25.0, turn)):
        for k, direction in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
            at = np.array([centre, 0, 0]) + direction * (18, 6, 6)
            rows.append([f"{bone}_{k}", bone, *(repr(float(x)) for x in (*at, *(motion @ at)))])
    return rows


def exchanged_rows() -> list[list[str]]:
    """The same, but the distal bone's ends along z are sent to each other's places, so that their ways cross."""
    rows = landmark_rows()
    ends = [row for row in rows if row[0] in ("bone_distal_2", "bone_distal_5")]
    ends[0][5:8], ends[1][5:8] = ends[1][2:5], ends[0][2:5]
    return rows


def write_landmarks(path: Path, rows: list[list[str]]) -> None:
    """Write a table as CSV."""
    path.write_text("".join(",".join(row) + "\n" for row in rows), encoding="utf-8")


def write_tiny_rig(folder: Path) -> Path:
    """Write the anatomy, landmarks, joints and rig into a new folder; the rig's path."""
    (folder / "anatomy").mkdir(parents=True)
    for name, surface in TISSUES.items():
        (folder / "anatomy" / f"{name}.ply").write_bytes(ply_bytes(surface))
    write_landmarks(folder / "landmarks.csv", landmark_rows())
    (folder / "joints.toml").write_text(JOINTS, encoding="utf-8")
    rig = folder / "tiny.toml"
    rig.write_text(RIG, encoding="utf-8")
    return rig


def drive_by_joints(rig: Path) -> None:
    """Let joints drive a tiny rig in place of landmark pairs."""
    drive_by(rig, JOINT_DRIVE.replace("[drive]", "").strip())


def drive_by(rig: Path, keys: str) -> None:
    """Give a tiny rig another ``[drive]``."""
    text = rig.read_text(encoding="utf-8")
    start, end = text.index("[drive]"), text.index("[deformer]")
    rig.write_text(f"{text[:start]}[drive]\n{keys}\n\n{text[end:]}", encoding="utf-8")
