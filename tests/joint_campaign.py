"""Joints of known axes fitted many times over, as tables: ``python tests/joint_campaign.py --fits 20``.

Every shape at several amounts of noise, finenesses, sizes, mirrored and not, anywhere in space: how far the fits are
from what is known, and how often that is within two of the uncertainties that they tell themselves. With the real
anatomy (MUSCLEFIT_DATA) also its joints, whose axes were chosen on the same bones by circles or by hand, OpenSim's, and
hips whose centre is that of a sphere through the femur's head; each of them again mirrored, at half the size, of a
quarter of the triangles, and rough: how many of these are believed, and how far off they are.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyvista
from joint_shapes import SHAPES, KnownJoint, Missed, known_joint, missed, noise
from scipy.spatial.transform import Rotation

from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.anatomy import read_surface
from musclefit.io.opensim_geometry import find_geometry, placed_meshes
from musclefit.rig.articulation import WITHIN_MM, FittedJoint, fitted_joint
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
        ("elbow, by ulna and radius", "arm/disjoint", arm["elbow"], "right_humerus", ["right_ulna", "right_radius"]),
        ("elbow, by the ulna", "arm/disjoint", arm["elbow"], "right_humerus", ["right_ulna"]),
        ("elbow, by the radius", "arm/disjoint", arm["elbow"], "right_humerus", ["right_radius"]),
        ("knee", "leg/disjoint", leg["knee"], "left_femur", ["left_tibia"]),
        ("ankle", "leg/disjoint", leg["ankle"], "left_tibia", ["left_talus"]),
        ("index finger, MCP", "untuned/finger", finger["mcp"], "right_second_metacarpal_bone", [f"proximal_{index}"]),
        ("index finger, PIP", "untuned/finger", finger["pip"], f"proximal_{index}", [f"middle_{index}"]),
        ("index finger, DIP", "untuned/finger", finger["dip"], f"middle_{index}", [f"distal_{index}"]),
    ):
        axis = np.array(table["axis"])[None]
        centre = np.array(table["centre_mm"])
        kind = JointKind.UNIVERSAL if name.endswith("MCP") else JointKind.HINGE
        others = TriMesh.together([bone(folder, one) for one in moving])
        yield KnownJoint(name, kind, bone(folder, fixed), others, centre, axis)
    for side in ("left", "right"):
        hip, femur = (
            read_surface(next((data / "body" / "bones").glob(f"{side}_{name}_FMA*.ply"))).mesh()
            for name in ("hip_bone", "femur")
        )
        yield KnownJoint(f"{side} hip", JointKind.BALL, hip, femur, head_centre(femur, hip), np.zeros((0, 3)))
    model = read_osim(data / "opensim" / "rajagopal2016" / "Rajagopal2016.osim")
    meshes = {mesh.name: mesh.mesh for mesh in placed_meshes(model, find_geometry(model, [])[0])}
    places = model.multibody.places({})
    for side, called in (("r", "right"), ("l", "left")):
        pelvis, femur, tibia = (
            meshes[f"{body}__{side}_{name}"]
            for body, name in (("pelvis", "pelvis"), (f"femur_{side}", "femur"), (f"tibia_{side}", "tibia"))
        )
        at_hip, at_knee = places[f"femur_{side}"].translation, places[f"tibia_{side}"].translation
        name = f"Rajagopal, {called}"
        yield KnownJoint(f"{name} hip", JointKind.BALL, pelvis, femur, at_hip, np.zeros((0, 3)))
        for bent_deg in (90, 5):
            bent = model.multibody.motions({f"knee_angle_{side}": np.radians(bent_deg)})
            place, along = screw_axis(bent[f"tibia_{side}"], near=at_knee)
            yield KnownJoint(f"{name} knee, 0 to {bent_deg} deg", JointKind.HINGE, femur, tibia, place, along[None])


def screw_axis(motion: RigidMotion, *, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The axis that a motion turns about and slides along: its point nearest to another one, and its direction."""
    turn = Rotation.from_matrix(motion.rotation).as_rotvec()
    along = turn / np.linalg.norm(turn)
    way = motion(near[None])[0] - near
    place = near + np.linalg.lstsq(np.eye(3) - motion.rotation, way - (way @ along) * along)[0]
    return place, along


def head_centre(femur: TriMesh, hip: TriMesh) -> np.ndarray:
    """The centre of the sphere through the femur's vertices near the hip bone; those off it are left out, twice."""
    near = femur.vertices[nearest_places(femur.vertices, hip).distances < 6.0]
    for _ in range(3):
        found = np.linalg.lstsq(np.column_stack([2.0 * near, np.ones(len(near))]), (near**2).sum(axis=1))[0]
        radius = np.sqrt(found[3] + found[:3] @ found[:3])
        off = np.abs(np.linalg.norm(near - found[:3], axis=1) - radius)
        near = near[off < 2.0 * np.median(off)]
    centre: np.ndarray = found[:3]
    return centre


Change = Callable[[TriMesh], TriMesh]
MIRROR = np.diag([-1.0, 1.0, 1.0])


def coarser(mesh: TriMesh) -> TriMesh:
    fewer = pyvista.make_tri_mesh(mesh.vertices, mesh.faces).decimate(0.75)
    return TriMesh(np.asarray(fewer.points, dtype=float), fewer.faces.reshape(-1, 4)[:, 1:].astype(np.int64))


def rough(mesh: TriMesh) -> TriMesh:
    return TriMesh(mesh.vertices + noise(mesh.vertices, 0.2, np.random.default_rng(0)), mesh.faces)


VARIANTS: dict[str, tuple[Change, np.ndarray]] = {
    "mirrored": (lambda mesh: TriMesh(mesh.vertices @ MIRROR, mesh.faces[:, ::-1]), MIRROR),
    "half as large": (lambda mesh: TriMesh(0.5 * mesh.vertices, mesh.faces), 0.5 * np.eye(3)),
    "of a quarter of the triangles": (coarser, np.eye(3)),
    "rough by 0.2 mm": (rough, np.eye(3)),
}
"""How the same bones are changed, and the matrix that takes the joint along."""


def believed_variants(known: KnownJoint) -> tuple[int, Missed]:
    """Of the fits to the same bones changed, how many are believable, and how far those are off at most."""
    off = [Missed(0.0, 0.0)]
    for what, (change, matrix) in VARIANTS.items():
        bones = change(known.fixed), change(known.moving)
        found = fitted_joint(*bones, kind=known.kind, within_mm=WITHIN_MM * (0.5 if what == "half as large" else 1.0))
        if believable(found):
            there = KnownJoint("", known.kind, *bones, matrix @ known.centre, unit(known.axes @ matrix.T))
            off.append(missed(found, there))
    return len(off) - 1, Missed(max(one.degrees for one in off), max(one.mm for one in off))


def believable(found: FittedJoint) -> bool:
    return JointFit("", "", found).believable


def unit(axes: np.ndarray) -> np.ndarray:
    lengths: np.ndarray = np.linalg.norm(axes, axis=1, keepdims=True)
    made: np.ndarray = axes / lengths
    return made


def of_real_bones(data: Path) -> None:
    print(
        "| joint | off | stated uncertainty | believable | of 4 variants believable | and off at most |\n"
        "|---|---|---|---|---|---|"
    )
    for known in real(data):
        known = replace(known, axes=unit(known.axes))
        found = fitted_joint(known.fixed, known.moving, kind=known.kind)
        told = Missed(found.uncertain_deg, found.uncertain_mm)
        believed, worst = believed_variants(known)
        words = [in_words(off, known) for off in (missed(found, known), told, worst)]
        sure = "yes" if believable(found) else "no"
        print(
            f"| {known.name} | {words[0]} | {words[1]} | {sure} | {believed} | {words[2] if believed else '-'} |",
            flush=True,
        )


def in_words(off: Missed, known: KnownJoint) -> str:
    return (f"{off.degrees:.1f} deg, " if len(known.axes) else "") + f"{off.mm:.1f} mm"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=20, help="of each shape; 0 for the real bones alone")
    fits = parser.parse_args().fits
    if fits:
        synthetic(fits)
    if "MUSCLEFIT_DATA" in os.environ:
        of_real_bones(Path(os.environ["MUSCLEFIT_DATA"]))
