"""Between frames: planted tunnelling is named with pair and time; common motion and near misses are not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.progress import Silent
from musclefit.validate.between_frames import check_passages

pytest.importorskip("ipctk")

NAMES = ("muscle_a", "muscle_b", "bone_c")


def anatomy(*centres: tuple[float, float, float], size: float = 8.0) -> Anatomy:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=size)
    tissues = [
        Tissue(name, TissueKind(name.split("_")[0]), TriMesh(np.asarray(ball.vertices) + c, np.asarray(ball.faces)))
        for name, c in zip(NAMES, centres, strict=False)
    ]
    return Anatomy(tuple(tissues), "test")


def test_planted_tunnelling_between_two_clean_frames_is_named_with_its_time() -> None:
    """A ball jumps from one side of another to the other side: neither frame shows an overlap."""
    before, after = anatomy((-40, 0, 0), (0, 0, 0)), anatomy((40, 0, 0), (0, 0, 0))
    (passage,) = check_passages(before, after, progress=Silent()).passages
    assert {passage.a, passage.b} == {"muscle_a", "muscle_b"}
    assert (passage.overlap_before_mm3, passage.overlap_after_mm3, passage.hidden) == (0.0, 0.0, True)
    contact = (40.0 - 16.0) / 80.0
    assert contact - 0.08 <= passage.at <= contact + 0.02, "conservative: a little before, never far behind"


def test_a_thin_sheet_crossed_by_a_point_is_caught() -> None:
    sheet = trimesh.creation.box(extents=(60, 60, 0.2))
    needle = trimesh.creation.box(extents=(0.2, 0.2, 4.0))
    tissues = [("muscle_sheet", sheet, 0.0), ("bone_needle", needle, 3.0)]

    def frame(shift: float) -> Anatomy:
        return Anatomy(
            tuple(
                Tissue(
                    n, TissueKind(n.split("_")[0]), TriMesh(s.vertices + np.array([0, 0, z + shift * (z > 0)]), s.faces)
                )
                for n, s, z in tissues
            ),
            "test",
        )

    assert not check_passages(frame(0.0), frame(1.0), progress=Silent()).passages
    (passage,) = check_passages(frame(0.0), frame(-6.0), progress=Silent()).passages
    assert passage.hidden


def test_a_fast_common_motion_is_free() -> None:
    before = anatomy((0, 0, 0), (16.5, 0, 0), (0, 17.0, 0))
    turn = RigidMotion.about_axis(centre=np.array([-300.0, 0, 0]), axis=np.array([0, 0, 1.0]), angle_deg=6.0)
    after = before.with_vertices(turn(before.vertices()))
    found = check_passages(before, after, progress=Silent())
    assert found.passages == ()
    assert found.pairs_examined < 20_000, "boxes of a common motion stay small"


def test_sliding_past_each_other_is_free_and_grazing_is_seen() -> None:
    before = anatomy((-20, 0, 0), (20, 16.5, 0))
    assert not check_passages(before, anatomy((20, 0, 0), (-20, 16.5, 0)), progress=Silent()).passages
    assert check_passages(before, anatomy((20, 0, 0), (-20, 13.0, 0)), progress=Silent()).passages


def test_what_overlaps_in_a_frame_is_not_hidden() -> None:
    before, after = anatomy((-30, 0, 0), (0, 0, 0)), anatomy((-12, 0, 0), (0, 0, 0))
    (passage,) = check_passages(before, after, progress=Silent()).passages
    assert passage.overlap_before_mm3 == 0.0 < passage.overlap_after_mm3
    assert not passage.hidden


def test_all_pairs_are_named() -> None:
    before = anatomy((0, 0, 0), (40, 0, 0), (80, 0, 0))
    after = anatomy((120, 0, 0), (40, 0, 0), (80, 0, 0))
    pairs = {frozenset((p.a, p.b)) for p in check_passages(before, after, progress=Silent()).passages}
    assert pairs == {frozenset(("muscle_a", "muscle_b")), frozenset(("muscle_a", "bone_c"))}


@pytest.mark.parametrize("seed", range(6))
def test_dense_sampling_finds_no_crossing_that_was_not_seen(seed: int) -> None:
    """Attack: random motions of three balls; when their surfaces meet at a sampled time, a passage must say so."""
    rng = np.random.default_rng(seed)
    before, after = (rng.uniform(-22, 22, (3, 3)) for _ in range(2))
    apart = [(i, j) for i in range(3) for j in range(i) if np.linalg.norm(before[i] - before[j]) > 17.0]
    found = check_passages(anatomy(*before), anatomy(*after), progress=Silent())
    named = {frozenset((p.a, p.b)) for p in found.passages}
    for i, j in apart:
        times = np.linspace(0, 1, 2001)[:, None]
        ways = [before[k] + times * (after[k] - before[k]) for k in (i, j)]
        if np.linalg.norm(ways[0] - ways[1], axis=1).min() < 15.0:  # well inside of each other
            assert frozenset((NAMES[i], NAMES[j])) in named


def test_other_triangles_are_refused() -> None:
    with pytest.raises(InputError, match="different tissues"):
        check_passages(anatomy((0, 0, 0), (40, 0, 0)), anatomy((0, 0, 0)), progress=Silent())
    with pytest.raises(InputError, match="1 tissues beside the skin"):
        check_passages(anatomy((0, 0, 0)), anatomy((0, 0, 0)), progress=Silent())
