"""Joints of known axes fitted many times over, as tables: ``python tests/joint_campaign.py --fits 20``.

Every shape at several amounts of noise, finenesses, sizes, mirrored and not, anywhere in space: how far the fits are
from what is known, and how often that is within two of the uncertainties that they tell themselves. With the real
anatomy (MUSCLEFIT_DATA) also its joints, whose axes were chosen on the same bones by circles or by hand, and OpenSim's.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from joint_shapes import SHAPES, KnownJoint, known_joint, missed

from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.opensim_geometry import find_geometry, placed_meshes
from musclefit.rig.articulation import fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.workflows.fit_joint import JointFit
from musclefit.workflows.import_osim import read_osim

CUTS = ((40, 40), (24, 72), (72, 24), (24, 24))
SCALES = (1.0, 0.25, 1.0, 2.0)
NOISES_MM = (0.1, 0.2, 0.4)


def varied(name: str, fits: int) -> Iterator[KnownJoint]:
    for number in range(fits):
        yield known_joint(
            name,
            seed=number,
            noise_mm=NOISES_MM[number % len(NOISES_MM)],
            cuts=CUTS[number % len(CUTS)],
            scale=SCALES[(number // 2) % len(SCALES)],
            mirrored=number % 2 == 1,
        )


def synthetic(fits: int) -> None:
    print(
        "| joint | fits | angular error, median / 95 % / largest | position error, at scale 1 | "
        "within 2 stated uncertainties |"
    )
    print("|---|---|---|---|---|")
    for name in SHAPES:
        angles, places, within = [], [], []
        for number, known in enumerate(varied(name, fits)):
            found = fitted_joint(known.fixed, known.moving, kind=known.kind)
            off, scale = missed(found, known), SCALES[(number // 2) % len(SCALES)]
            angles.append(off.degrees)
            places.append(off.mm / scale)
            if len(found.axes):
                within.append(off.degrees <= 2.0 * found.uncertain_deg)
            within.append(off.mm <= 2.0 * found.uncertain_mm)
        said = " / ".join(f"{v:.1f}" for v in (np.median(angles), np.quantile(angles, 0.95), max(angles)))
        place = " / ".join(f"{v:.2f}" for v in (np.median(places), np.quantile(places, 0.95), max(places)))
        turned = f"{said} deg" if name != "ball" else "-"
        print(f"| {name} | {fits} | {turned} | {place} mm | {100 * np.mean(within):.0f} % |", flush=True)


def real(data: Path) -> Iterator[KnownJoint]:
    def bone(folder: str, name: str) -> TriMesh:
        return read_surface(next((data / folder).rglob(f"bone_{name}_FMA*.ply"))).mesh()

    arm, leg, finger = (
        json.loads((data / name).read_text())
        for name in ("arm/joints.json", "leg/joints.json", "untuned/finger_joints.json")
    )
    index = "phalanx_of_right_index_finger"
    for name, folder, table, fixed, moving in (
        ("elbow", "arm/disjoint", arm["elbow"], "right_humerus", "right_ulna"),
        ("elbow, by the radius", "arm/disjoint", arm["elbow"], "right_humerus", "right_radius"),
        ("knee", "leg/disjoint", leg["knee"], "left_femur", "left_tibia"),
        ("ankle", "leg/disjoint", leg["ankle"], "left_tibia", "left_talus"),
        ("index finger, MCP", "untuned/finger", finger["mcp"], "right_second_metacarpal_bone", f"proximal_{index}"),
        ("index finger, PIP", "untuned/finger", finger["pip"], f"proximal_{index}", f"middle_{index}"),
        ("index finger, DIP", "untuned/finger", finger["dip"], f"middle_{index}", f"distal_{index}"),
    ):
        axis = np.array(table["axis"])[None]
        centre = np.array(table["centre_mm"])
        yield KnownJoint(name, JointKind.HINGE, bone(folder, fixed), bone(folder, moving), centre, axis)
    model = read_osim(data / "opensim" / "rajagopal2016" / "Rajagopal2016.osim")
    meshes = {mesh.name: mesh.mesh for mesh in placed_meshes(model, find_geometry(model, [])[0])}
    places = model.multibody.places({})
    for side, called in (("r", "right"), ("l", "left")):
        pelvis, femur, tibia = (
            meshes[f"{body}__{side}_{name}"]
            for body, name in (("pelvis", "pelvis"), (f"femur_{side}", "femur"), (f"tibia_{side}", "tibia"))
        )
        hip, knee = places[f"femur_{side}"], places[f"tibia_{side}"]
        name = f"Rajagopal, {called}"
        yield KnownJoint(f"{name} hip", JointKind.BALL, pelvis, femur, hip.translation, np.zeros((0, 3)))
        yield KnownJoint(f"{name} knee", JointKind.HINGE, femur, tibia, knee.translation, knee.rotation[:, 2][None])


def of_real_bones(data: Path) -> None:
    print("| joint | angular error | position error | stated uncertainty | believable |\n|---|---|---|---|---|")
    for known in real(data):
        axes = known.axes / np.linalg.norm(known.axes, axis=1, keepdims=True)
        found = fitted_joint(known.fixed, known.moving, kind=known.kind)
        off = missed(found, KnownJoint(known.name, known.kind, known.fixed, known.moving, known.centre, axes))
        sure = "yes" if JointFit("", "", found).believable else "no"
        turned = f"{off.degrees:.1f} deg" if len(axes) else "-"
        told = (f"{found.uncertain_deg:.1f} deg, " if len(axes) else "") + f"{found.uncertain_mm:.1f} mm"
        print(f"| {known.name} | {turned} | {off.mm:.1f} mm | {told} | {sure} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=20, help="of each shape; 0 for the real bones alone")
    fits = parser.parse_args().fits
    if fits:
        synthetic(fits)
    if "MUSCLEFIT_DATA" in os.environ:
        of_real_bones(Path(os.environ["MUSCLEFIT_DATA"]))
