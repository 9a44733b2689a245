"""Regions of a whole body that no setting was made for, from its raw surfaces to a checked pose.

    MUSCLEFIT_DATA=... python examples/regions.py [ankle] [wrist] [hip] [shoulder] [knee] --out DIR

For each region its surfaces are taken from the body as they are and repaired by `musclefit repair`, a joint is fitted
to two of its bones, and a rig of ten lines, without a single setting, is run. The folder then holds for each region
`raw/`, `anatomy/` (repaired), `joints.json`, `rig.toml`, and `run/` with the report.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from musclefit.cli.commands import main as musclefit
from musclefit.io.anatomy import read_surface
from musclefit.rig.articulation import fitted_joint
from musclefit.rig.joint_kinds import JointKind
from musclefit.vocabulary import Unit


@dataclass(frozen=True, slots=True)
class Region:
    """A joint and what is around it; tissues are named by shell-style patterns of the body's files.

    Parameters
    ----------
    fixed, moving : tuple of str
        Bones on both sides of the joint.
    soft : tuple of str
        Muscles and other tissue.
    joint : (str, str)
        The two bones that it is fitted to: a hinge's axis, or a ball's centre.
    kind : JointKind
    pose : mapping of coordinate to degrees
    """

    fixed: tuple[str, ...]
    moving: tuple[str, ...]
    soft: tuple[str, ...]
    joint: tuple[str, str]
    kind: JointKind
    pose: dict[str, float]


REGIONS = {
    "ankle": Region(
        fixed=("right_tibia_*", "right_fibula_*"),
        moving=(
            "right_talus_*",
            "right_calcaneus_*",
            "right_cuboid_*",
            "right_*_cuneiform_*",
            "right_*_metatarsal_*",
            "*navicular_bone_of_right_*",
            "*_of_right_*_toe_*",
            "sesamoid_bone_of_right_foot_*",
        ),
        soft=(
            "*gastrocnemius*",
            "*soleus*",
            "*plantaris*",
            "*tibialis*",
            "*fibularis*",
            "*hallucis*",
            "*_foot_*",
            "*extensor_digitorum_longus*",
            "*extensor_digitorum_brevis*",
            "*flexor_digitorum_longus*",
            "*flexor_digitorum_brevis*",
            "*calcaneal_tendon*",
            "*interosseous_membrane_of_*_leg*",
        ),
        joint=("right_tibia_*", "right_talus_*"),
        kind=JointKind.HINGE,
        pose={"ankle_deg": 12.0},
    ),
    "wrist": Region(
        fixed=("right_radius_*", "right_ulna_*"),
        moving=(
            "right_scaphoid_*",
            "right_lunate_*",
            "right_triquetral_*",
            "right_pisiform_*",
            "right_trapez*",
            "right_capitate_*",
            "right_hamate_*",
            "right_*_metacarpal_*",
            "*_phalanx_of_right_*_finger_*",
            "*_phalanx_of_right_thumb_*",
        ),
        soft=(
            "*carpi*",
            "*pollicis*",
            "*_hand_*",
            "*right_extensor_digitorum_FMA38501*",
            "*digitorum_profundus*",
            "*digitorum_superficialis*",
            "*extensor_digiti_minimi*",
            "*extensor_indicis*",
            "*palmaris_longus*",
            "*pronator_quadratus*",
            "*interosseous_membrane_of_*_forearm*",
            "*flexor_retinaculum_of_*_wrist*",
        ),
        joint=("right_radius_*", "right_lunate_*"),
        kind=JointKind.BALL,
        pose={"wrist_x_deg": 20.0},
    ),
    "hip": Region(
        fixed=("right_hip_bone_*",),
        moving=("right_femur_*",),
        soft=(
            *(
                "*glut*",
                "*iliac*",
                "*piriformis*",
                "*gemellus*",
                "*obturator*",
                "*quadratus_femoris*",
                "*adductor_*us_F*",
            ),
            "*pectineus*",
            "*gracilis*",
            "*sartorius*",
            "*rectus_femoris*",
            "*vastus*",
            "*tensor_fasciae*",
            "*biceps_femoris*",
            "*semitendinosus*",
            "*semimembranosus*",
            "*iliotibial*",
        ),
        joint=("right_hip_bone_*", "right_femur_*"),
        kind=JointKind.BALL,
        pose={"hip_x_deg": 20.0},
    ),
    "shoulder": Region(
        fixed=("right_scapula_*", "right_clavicle_*"),
        moving=("right_humerus_*",),
        soft=(
            "*deltoid*",
            "*spinatus*",
            "*_teres_m*",
            "*subscapularis*",
            "*pectoralis*",
            "*latissimus_dorsi*",
            "*coracobrachialis*",
            "*biceps_brachii*",
            "*triceps_brachii*",
            "*trapezius*",
            "*serratus_anterior*",
        ),
        joint=("right_scapula_*", "right_humerus_*"),
        kind=JointKind.BALL,
        pose={"shoulder_x_deg": 25.0},
    ),
    "knee": Region(
        fixed=("right_femur_*",),
        moving=("right_tibia_*", "right_fibula_*"),
        soft=(
            *("*gastrocnemius*", "*soleus*", "*plantaris*", "*popliteus*", "*tibialis*", "*fibularis*"),
            *("*vastus*", "*rectus_femoris*", "*biceps_femoris*", "*semitendinosus*", "*semimembranosus*"),
            *("*sartorius*", "*gracilis*", "*_of_right_knee*", "*meniscus*", "*patella*"),
        ),
        joint=("right_femur_*", "right_tibia_*"),
        kind=JointKind.HINGE,
        pose={"knee_deg": 9.0},
    ),
}
"""Of the right side."""

RIG = """title = "{name}"
[anatomy]
folder = "anatomy"
units = "mm"
[drive]
kind = "joints"
joints = "joints.json"
pose = {{ {pose} }}
"""


def main() -> int:
    """Make and run the regions that are named; 0 where all pass."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("regions", nargs="*", default=list(REGIONS), help=f"some of {', '.join(REGIONS)}")
    parser.add_argument("--out", type=Path, default=Path("musclefit-out/regions"), help="folder for all that is made")
    parser.add_argument("--prepare-only", action="store_true", help="run no rig")
    options = parser.parse_args()
    if not set(options.regions) <= set(REGIONS):
        parser.error(f"found {options.regions}; expected some of {', '.join(REGIONS)}")
    codes = []
    for name in options.regions:
        rig = prepared(name, options.out / name)
        if not options.prepare_only:
            codes.append(musclefit(["run", str(rig), "--out", str(rig.parent / "run")]))
    return max(codes, default=0)


def prepared(name: str, folder: Path) -> Path:
    """The region's surfaces as given and repaired, its joints and its rig, in a folder; gives the rig's file."""
    region, body = REGIONS[name], Path(os.environ["MUSCLEFIT_DATA"]) / "body"
    raw = folder / "raw"
    shutil.rmtree(raw, ignore_errors=True)
    raw.mkdir(parents=True)
    bones, soft = (
        sorted((body / "bones").glob("*.ply")),
        [*(body / "muscles").glob("*.ply"), *(body / "other").glob("*.ply")],
    )
    for path in [path for path in bones if fits(path, (*region.fixed, *region.moving))]:
        shutil.copy(path, raw / f"bone_{path.name}")
    for path in [path for path in soft if "right" in path.stem and fits(path, region.soft)]:
        shutil.copy(path, raw / f"{'muscle' if path.parent.name == 'muscles' else 'other'}_{path.name}")
    musclefit(["repair", str(raw), str(folder / "anatomy"), "--resolve", "priority"])
    (folder / "joints.json").write_text(json.dumps(joints(name, region, bones), indent=1), encoding="utf-8")
    pose = ", ".join(f"{coordinate} = {degrees:g}" for coordinate, degrees in region.pose.items())
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(name=name, pose=pose), encoding="utf-8")
    return rig


def joints(name: str, region: Region, bones: list[Path]) -> dict[str, object]:
    """The table of the region's joint, fitted to two of its bones."""
    two = [next(path for path in bones if fits(path, (pattern,))) for pattern in region.joint]
    fixed, moving = (read_surface(path, units=Unit.MILLIMETRE).mesh() for path in two)
    best = fitted_joint(fixed, moving, kind=region.kind)
    joint: dict[str, object] = {
        "centre_mm": [float(v) for v in best.centre],
        "fixed": [f"bone_{path.stem}" for path in bones if fits(path, region.fixed)],
        "moving": [f"bone_{path.stem}" for path in bones if fits(path, region.moving)],
    }
    if len(best.axes):
        joint |= {"axis": [float(v) for v in best.axes[0]]}
    else:
        axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        joint |= {"kind": "ball", "axes": axes, "coordinates": [f"{name}_{axis}" for axis in "xyz"]}
    return {"units": "mm, degrees", name: joint}


def fits(path: Path, patterns: tuple[str, ...]) -> bool:
    """Whether a file's name fits one of some patterns."""
    return any(fnmatchcase(path.stem, pattern) for pattern in patterns)


if __name__ == "__main__":
    sys.exit(main())
