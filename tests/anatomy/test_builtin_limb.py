"""The built-in limb is what its docstring promises: sound surfaces, apart from each other, joints that are free."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import igl
import igl.predicates
import manifold3d
import numpy as np
import pytest
from scipy import sparse

from musclefit.anatomy.builtin import BUILTIN, joints, upper_limb
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.geometry.measures import area_vectors, enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.joints import parse_joints
from musclefit.validate.bones import rigid_bones, shared_by_bones
from musclefit.validate.joint_ranges import joint_ranges

JOINTS_FILE = Path(__file__).parents[2] / "rigs" / "upper_limb_joints.json"
ELBOW_DEG = range(0, 141, 20)
FOREARM_DEG = range(0, 81, 20)

VOLUMES_CM3 = {
    # Bones: an adult's, marrow cavity included (dense humerus 150-250, radius 40-60, ulna 45-65 cm³).
    "bone_humerus": (150.0, 250.0),
    "bone_radius": (38.0, 65.0),
    "bone_ulna": (38.0, 65.0),
    # Muscles: MRI of ten adults, smallest woman to largest man with room (Holzbaur et al., J. Biomech. 40 (2007) 742).
    "muscle_biceps_long_head": (35.0, 150.0),
    "muscle_biceps_short_head": (35.0, 150.0),
    "muscle_brachialis": (70.0, 230.0),
    "muscle_triceps_long_head": (80.0, 300.0),
    "muscle_triceps_lateral_head": (60.0, 250.0),
    "muscle_triceps_medial_head": (40.0, 150.0),
    "muscle_brachioradialis": (30.0, 115.0),
    "muscle_pronator_teres": (18.0, 65.0),
    # Arm and forearm without hand: about 4 % of a body of 60 to 80 litres.
    "skin": (2000.0, 3600.0),
}


@pytest.fixture(scope="module")
def limb() -> Anatomy:
    return upper_limb()


@pytest.fixture(scope="module")
def solids(limb: Anatomy) -> dict[str, manifold3d.Manifold]:
    return {tissue.name: _solid(tissue.surface) for tissue in limb}


def _solid(mesh: TriMesh) -> manifold3d.Manifold:
    solid = manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)))
    assert solid.status() == manifold3d.Error.NoError
    return solid


def _joint(name: str) -> tuple[np.ndarray, np.ndarray]:
    joint = json.loads(JOINTS_FILE.read_text())[name]
    return np.array(joint["centre_mm"]), np.array(joint["axis"])


def test_tissues_are_the_promised_ones(limb: Anatomy) -> None:
    assert {tissue.name for tissue in limb} == set(VOLUMES_CM3)
    for tissue in limb:
        assert tissue.kind is TissueKind(tissue.name.split("_")[0])
    assert BUILTIN["upper_limb"] is upper_limb


@pytest.mark.parametrize("name", VOLUMES_CM3)
def test_surface_is_closed_in_one_piece_and_a_sphere(limb: Anatomy, name: str) -> None:
    mesh = limb[name].surface
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    n = len(mesh.vertices)
    directed = sparse.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n)).tocsr()
    assert directed.max() == 1.0, "an edge is run through twice in one direction"
    assert abs(directed - directed.T).nnz == 0, "an edge has one face only"
    assert sparse.csgraph.connected_components(directed, directed=False)[0] == 1
    assert np.unique(mesh.faces).size == n, "a vertex belongs to no face"
    assert n - len(edges) // 2 + len(mesh.faces) == 2, "Euler's number of a sphere"


@pytest.mark.parametrize("name", VOLUMES_CM3)
def test_surface_is_outward_uncrossed_and_of_even_triangles(limb: Anatomy, name: str) -> None:
    mesh = limb[name].surface
    assert enclosed_volume(mesh) > 0.0
    crossing = igl.predicates.find_self_intersections(np.array(mesh.vertices), np.array(mesh.faces))[1]
    assert len(crossing) == 0
    corners = mesh.corners()
    squared = np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=(1, 2))
    quality = 4.0 * np.sqrt(3.0) * np.linalg.norm(area_vectors(mesh), axis=1) / squared
    assert quality.min() > 0.15, "1 is equilateral"
    assert np.percentile(quality, 1.0) > 0.4


@pytest.mark.parametrize("name", VOLUMES_CM3)
def test_volume_is_an_adults(limb: Anatomy, name: str) -> None:
    low, high = VOLUMES_CM3[name]
    assert low < enclosed_volume(limb[name].surface) / 1000.0 < high


def test_lengths_are_an_adults(limb: Anatomy) -> None:
    extent = {name: np.ptp(limb[name].surface.vertices[:, 2]) for name in VOLUMES_CM3}
    assert 290.0 < extent["bone_humerus"] < 340.0
    assert 220.0 < extent["bone_radius"] < 255.0
    assert 240.0 < extent["bone_ulna"] < 280.0
    assert sum(len(tissue.surface.vertices) for tissue in limb) < 32_000


def test_bones_and_muscles_are_apart(solids: dict[str, manifold3d.Manifold]) -> None:
    inner = [name for name in solids if name != "skin"]
    for first, second in itertools.combinations(inner, 2):
        assert (solids[first] ^ solids[second]).volume() == 0.0, f"{first} and {second} overlap"
        assert solids[first].min_gap(solids[second], 1.0) > 0.5, f"{first} and {second} nearly touch"


def test_everything_is_well_inside_the_skin(limb: Anatomy, solids: dict[str, manifold3d.Manifold]) -> None:
    skin = limb["skin"].surface
    for tissue in limb:
        if tissue.kind is TissueKind.SKIN:
            continue
        assert (solids[tissue.name] - solids["skin"]).volume() == 0.0
        squared = igl.point_mesh_squared_distance(
            np.array(tissue.surface.vertices), np.array(skin.vertices), np.array(skin.faces)
        )[0]
        assert np.sqrt(squared.min()) > 2.0, tissue.name


@pytest.mark.parametrize(
    ("muscle", "bone", "lowest", "highest"),
    [
        ("muscle_biceps_long_head", "bone_radius", -40.0, -20.0),
        ("muscle_biceps_short_head", "bone_radius", -50.0, -25.0),
        ("muscle_brachialis", "bone_ulna", -50.0, -20.0),
        ("muscle_triceps_long_head", "bone_ulna", 0.0, 25.0),
        ("muscle_triceps_lateral_head", "bone_ulna", 0.0, 25.0),
        ("muscle_triceps_medial_head", "bone_ulna", 0.0, 25.0),
        ("muscle_brachioradialis", "bone_radius", -240.0, -200.0),
        ("muscle_brachioradialis", "bone_humerus", 30.0, 115.0),
        ("muscle_pronator_teres", "bone_humerus", -5.0, 20.0),
        ("muscle_pronator_teres", "bone_radius", -140.0, -100.0),
    ],
)
def test_muscle_ends_on_its_bone(limb: Anatomy, muscle: str, bone: str, lowest: float, highest: float) -> None:
    """Between 0.5 and 1.5 mm off the bone, at the height (mm, proximal of the elbow) where it attaches."""
    surface = limb[bone].surface
    ends = limb[muscle].surface.vertices
    ends = np.array(ends[(ends[:, 2] > lowest) & (ends[:, 2] < highest)])
    squared = igl.point_mesh_squared_distance(ends, np.array(surface.vertices), np.array(surface.faces))[0]
    assert 0.5 < np.sqrt(squared.min()) < 1.5


def test_joints_file_is_the_construction() -> None:
    for name, centre, axis in (
        ("elbow", joints.ELBOW_CENTRE, joints.ELBOW_AXIS),
        ("forearm", joints.FOREARM_CENTRE, joints.FOREARM_AXIS),
    ):
        read_centre, read_axis = _joint(name)
        np.testing.assert_allclose(read_centre, centre, rtol=0, atol=1e-12)
        np.testing.assert_allclose(read_axis, axis, rtol=0, atol=1e-12)
    limits = {name: tuple(json.loads(JOINTS_FILE.read_text())[name]["limits_deg"]) for name in ("elbow", "forearm")}
    assert limits == {"elbow": joints.ELBOW_LIMITS_DEG, "forearm": joints.FOREARM_LIMITS_DEG}


def test_no_pose_within_the_limits_is_a_collision(limb: Anatomy) -> None:
    """Together; each alone, bones stop it beyond its limits and not before."""
    system = parse_joints(json.loads(JOINTS_FILE.read_text()), source=JOINTS_FILE.name)
    bones = rigid_bones(limb, system.bones())
    low, high = joints.ELBOW_LIMITS_DEG
    for elbow, forearm in itertools.product((low, 0, 60, 120, 140, 145, high), range(-90, 91, 20)):
        found = shared_by_bones(bones, system.motions({"elbow": elbow, "forearm": forearm}))
        assert not [f for f in found if f.collides], f"elbow {elbow}, forearm {forearm}"
    for name, limits in (("elbow", joints.ELBOW_LIMITS_DEG), ("forearm", joints.FOREARM_LIMITS_DEG)):
        table = json.loads(JOINTS_FILE.read_text())
        del table[name]["limits_deg"]
        free = joint_ranges(bones, parse_joints(table, source="no limits"), only=(name,))[0]
        assert free.low.degrees < limits[0] < limits[1] < free.high.degrees


def test_positive_turns_flex_and_pronate(limb: Anatomy) -> None:
    wrist = limb["bone_radius"].surface.vertices
    wrist = wrist[wrist[:, 2] < -220.0].mean(axis=0)
    flexed = RigidMotion.about_axis(centre=_joint("elbow")[0], axis=_joint("elbow")[1], angle_deg=90.0)(wrist)
    assert flexed[1] > 200.0, "the wrist comes forward"
    centre, axis = _joint("forearm")
    pronated = RigidMotion.about_axis(centre=centre, axis=axis, angle_deg=80.0)(wrist)
    assert pronated[1] > wrist[1] + 10.0, "the radius passes in front of the ulna"
    assert pronated[0] < wrist[0] - 10.0


def test_no_bone_meets_another_in_the_feasible_range(limb: Anatomy) -> None:
    """All of elbow 0 to 140 and forearm 0 to 80 degrees, every 20, and the corners' margin of 2 degrees."""
    elbow_centre, elbow_axis = _joint("elbow")
    forearm_centre, forearm_axis = _joint("forearm")
    humerus, ulna, radius = (limb[f"bone_{name}"].surface for name in ("humerus", "ulna", "radius"))
    fixed = _solid(humerus)
    poses = [*itertools.product(ELBOW_DEG, FOREARM_DEG), *itertools.product((-2, 142), (-2, 82))]
    for elbow_deg, forearm_deg in poses:
        flexion = RigidMotion.about_axis(centre=elbow_centre, axis=elbow_axis, angle_deg=elbow_deg)
        pronation = RigidMotion.about_axis(centre=forearm_centre, axis=forearm_axis, angle_deg=forearm_deg)
        lower = _solid(ulna.with_vertices(flexion(ulna.vertices)))
        turning = _solid(radius.with_vertices((flexion @ pronation)(radius.vertices)))
        for first, second in ((fixed, lower), (fixed, turning), (lower, turning)):
            assert (first ^ second).volume() == 0.0, f"overlap at elbow {elbow_deg}, forearm {forearm_deg}"
            assert first.min_gap(second, 1.0) > 0.5, f"no gap at elbow {elbow_deg}, forearm {forearm_deg}"


def test_humerus_stops_the_forearm_far_beyond_the_range(limb: Anatomy) -> None:
    """The feasible range is a property of the bones, not of a joint without contact."""
    elbow_centre, elbow_axis = _joint("elbow")
    ulna = limb["bone_ulna"].surface
    fixed = _solid(limb["bone_humerus"].surface)
    for angle in (-25.0, 165.0):
        motion = RigidMotion.about_axis(centre=elbow_centre, axis=elbow_axis, angle_deg=angle)
        assert (fixed ^ _solid(ulna.with_vertices(motion(ulna.vertices)))).volume() > 1.0


def test_same_vertices_every_time(limb: Anatomy) -> None:
    again = upper_limb.__wrapped__()  # made once more, not remembered
    np.testing.assert_array_equal(again.vertices(), limb.vertices())
    for first, second in zip(limb, again, strict=True):
        np.testing.assert_array_equal(first.surface.faces, second.surface.faces)
    np.testing.assert_array_equal(np.round(limb.vertices(), 4), limb.vertices())
