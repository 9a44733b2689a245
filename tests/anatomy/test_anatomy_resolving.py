"""Overlaps taken away by rule: volumes against formulas for boxes and balls, and nothing left that meets."""

from __future__ import annotations

import numpy as np
import pytest
from planted import ball, box

from musclefit.anatomy.midsurfaces import halves, own_sides
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repairs import RepairSettings
from musclefit.anatomy.resolutions import Rule
from musclefit.anatomy.resolving import resolved
from musclefit.errors import InputError
from musclefit.geometry.booleans import padded, shared, united
from musclefit.geometry.crossings import crossings_between
from musclefit.geometry.distances import nearest_places
from musclefit.geometry.faults import faults_of
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.volumes import enclosed_volume
from musclefit.progress import Silent
from musclefit.validate.overlaps import rest_overlaps

BONE, MUSCLE, OTHER, SKIN = TissueKind.BONE, TissueKind.MUSCLE, TissueKind.OTHER, TissueKind.SKIN


def _anatomy(*tissues):
    return Anatomy(tuple(Tissue(name, kind, mesh) for name, kind, mesh in tissues), "test")


def _resolved(anatomy, rule=Rule.PRIORITY):
    found = resolved(anatomy, rule=rule, settings=RepairSettings(), progress=Silent())
    assert found.left == ()
    assert rest_overlaps(found.anatomy, progress=Silent()).pairs == ()
    inner = [t for t in found.anatomy if t.kind is not SKIN]
    for i, a in enumerate(inner):
        assert faults_of(a.surface).none
        for b in inner[i + 1 :]:
            assert len(crossings_between(a.surface, b.surface)) == 0
    return found


def test_a_bone_keeps_what_a_muscle_loses():
    bone, muscle = box((4.0, 4.0, 4.0)), box((6.0, 2.0, 2.0), at=(3.0, 1.0, 1.0))
    found = _resolved(_anatomy(("m", MUSCLE, muscle), ("b", BONE, bone)))
    (pair,) = found.pairs
    assert (pair.a, pair.b) == ("b", "m")
    assert pair.rule == "priority: bone before muscle"
    assert pair.overlap_mm3 == pytest.approx(4.0, rel=1e-12)
    assert (pair.from_a_mm3, pair.from_b_mm3) == (0.0, pair.overlap_mm3)
    assert found.anatomy["b"].surface is not None
    np.testing.assert_array_equal(found.anatomy["b"].surface.vertices, bone.vertices)
    left = enclosed_volume(found.anatomy["m"].surface)
    assert left == pytest.approx(24.0 - 2.0 * 2.0 * (1.0 + CLEARANCE_MM), rel=1e-3)
    (cut,) = found.cuts
    assert (cut.name, cut.volume_before_mm3, cut.clearance_mm) == ("m", pytest.approx(24.0), CLEARANCE_MM)
    assert cut.volume_after_mm3 == left


def test_within_a_kind_the_smaller_goes_before():
    small, large = Tissue("z", MUSCLE, ball(radius=2.0)), Tissue("a", MUSCLE, ball(radius=3.0))
    assert goes_before(small, large)
    assert not goes_before(large, small)
    assert goes_before(Tissue("large", BONE, ball()), small)
    assert goes_before(small, Tissue("tiny", OTHER, ball(radius=0.1)))


def test_two_muscles_split_the_lens_of_two_balls_at_its_middle():
    r, d = 10.0, 14.0
    a, b = ball(4, radius=r), ball(4, radius=r, at=(d, 0.0, 0.0))
    lens = np.pi * (4.0 * r + d) * (2.0 * r - d) ** 2 / 12.0
    found = _resolved(_anatomy(("a", MUSCLE, a), ("b", MUSCLE, b)), Rule.SPLIT)
    (pair,) = found.pairs
    assert pair.overlap_mm3 == pytest.approx(lens, rel=0.03)
    assert pair.from_a_mm3 == pytest.approx(0.5 * pair.overlap_mm3, rel=0.03)
    assert pair.from_a_mm3 + pair.from_b_mm3 == pytest.approx(pair.overlap_mm3, rel=1e-12)
    assert found.anatomy["a"].surface.vertices[:, 0].max() < 0.5 * d + 0.1
    assert found.anatomy["b"].surface.vertices[:, 0].min() > 0.5 * d - 0.1
    for name in "ab":
        kept = enclosed_volume(found.anatomy[name].surface)
        assert kept == pytest.approx(enclosed_volume(a) - 0.5 * lens, rel=5e-3)


def test_the_middle_of_two_plates_is_where_both_are_equally_deep():
    a, b = box((20.0, 20.0, 4.0)), box((20.0, 20.0, 4.0), at=(0.0, 0.0, 2.0))
    common = shared(a, b)
    tool_a, tool_b = halves(own_sides(a, b, common), common, clearance_mm=0.02)
    inner = [v for t in (tool_a, tool_b) for v in t.vertices if (v[:2] > 4.0).all() and (v[:2] < 16.0).all()]
    heights = np.array(inner)[:, 2]
    # the shared slab is from 2 to 4: each tool ends at its middle, less or more half the clearance over the slope
    assert np.abs(heights - 3.0).min() <= 0.02
    assert enclosed_volume(tool_a) + enclosed_volume(tool_b) == pytest.approx(2.0 * 400.0, rel=0.03)


def test_split_leaves_bones_whole():
    bone, muscle = box((4.0, 4.0, 4.0)), box((6.0, 2.0, 2.0), at=(3.0, 1.0, 1.0))
    found = _resolved(_anatomy(("m", MUSCLE, muscle), ("b", BONE, bone)), Rule.SPLIT)
    assert found.pairs[0].rule == "priority: bone before muscle"
    np.testing.assert_array_equal(found.anatomy["b"].surface.vertices, bone.vertices)


@pytest.mark.parametrize("rule", [Rule.PRIORITY, Rule.SPLIT])
def test_three_that_meet_in_one_place_are_parted_whatever_their_order(rule):
    meshes = [ball(2), ball(2, at=(11.0, 0.0, 0.0)), ball(2, at=(5.0, 10.0, 0.0))]
    names = ["a", "b", "c"]
    one = _resolved(_anatomy(*((n, MUSCLE, m) for n, m in zip(names, meshes, strict=True))), rule)
    other = _resolved(_anatomy(*((n, MUSCLE, m) for n, m in list(zip(names, meshes, strict=True))[::-1])), rule)
    assert len(one.pairs) == 3
    for name in names:
        np.testing.assert_array_equal(one.anatomy[name].surface.vertices, other.anatomy[name].surface.vertices)


def test_surfaces_that_only_touch_are_parted_too():
    left, right = box((2.0, 2.0, 2.0)), box((2.0, 2.0, 2.0), at=(2.0, 0.0, 0.0))
    found = _resolved(_anatomy(("a", MUSCLE, left), ("b", MUSCLE, right)))
    assert found.pairs[0].overlap_mm3 <= 1e-6
    assert len(found.cuts) == 1


def test_a_tissue_inside_another_leaves_a_hollow():
    found = _resolved(_anatomy(("m", MUSCLE, ball(3)), ("b", BONE, ball(2, radius=3.0))))
    left = enclosed_volume(found.anatomy["m"].surface)
    assert left == pytest.approx(
        enclosed_volume(ball(3)) - enclosed_volume(ball(2, radius=3.0 + CLEARANCE_MM)), rel=1e-3
    )


def test_nothing_left_is_an_error_that_names_the_tissue():
    with pytest.raises(InputError, match="nothing is left of 'm'"):
        _resolved(_anatomy(("m", MUSCLE, ball(2, radius=3.0)), ("b", BONE, ball(2))))


def test_crumbs_are_taken_out_and_counted():
    muscle = box((10.0, 10.0, 10.0))
    cutters = [
        box((1.0, 12.0, 12.0), at=(5.0, -1.0, -1.0)),
        box((6.0, 10.9, 12.0), at=(5.5, -1.0, -1.0)),
        box((6.0, 3.0, 10.9), at=(5.5, 9.0, -1.0)),
    ]
    bone = united(cutters, smooth_within_mm=1e-6)  # leaves a slab and a crumb of 4 x 0.1 x 0.1 mm
    found = _resolved(_anatomy(("m", MUSCLE, muscle), ("b", BONE, bone)))
    (cut,) = found.cuts
    (change,) = cut.changes
    assert change.code == "stray-pieces"
    assert change.area_mm2 == pytest.approx(2 * 0.08**2 + 4 * 0.08 * 3.98, rel=0.05)
    assert cut.volume_after_mm3 == pytest.approx(10.0 * 10.0 * 4.98, rel=1e-3)


def test_one_inside_another_of_its_kind_is_not_split():
    found = _resolved(_anatomy(("m", MUSCLE, ball(3)), ("n", MUSCLE, ball(2, radius=3.0))), Rule.SPLIT)
    assert found.pairs[0].rule == "priority: the smaller muscle"


def _wedge(thickness, *, turned, at=(0.0, 0.0, 0.0)):
    """A blade of 12 x 12 mm that ends in a knife's edge, where growing along normals leaves no clearance."""
    t = thickness
    vertices = np.array(
        [[0.0, -6.0, -t], [0.0, 6.0, -t], [0.0, -6.0, t], [0.0, 6.0, t], [12.0, -6.0, 0.0], [12.0, 6.0, 0.0]]
    )
    faces = np.array([[0, 2, 1], [1, 2, 3], [0, 1, 5], [0, 5, 4], [2, 4, 5], [2, 5, 3], [0, 4, 2], [1, 3, 5]])
    return TriMesh((vertices[:, [1, 2, 0]] if turned else vertices) + np.array(at), faces)


def test_knife_edges_are_cut_out_with_a_clearance_around_their_triangles():
    first, second = _wedge(0.05, turned=False), _wedge(0.06, turned=True, at=(6.0, 0.5, -3.0))
    anatomy = _anatomy(("a", MUSCLE, first), ("b", MUSCLE, second), ("c", MUSCLE, ball(3, radius=9.0)))
    assert all(faults_of(t.surface).none for t in anatomy)
    found = _resolved(anatomy)
    assert len(found.pairs) == 3
    assert max(cut.clearance_mm for cut in found.cuts) >= CLEARANCE_MM


def test_triangles_padded_keep_the_distance_on_all_sides():
    mesh = ball(1)
    tool = padded(mesh, np.array([3, 4, 40]), distance_mm=0.1)
    assert faults_of(tool).crossings == 0
    apart = nearest_places(tool.vertices, TriMesh(mesh.vertices, mesh.faces[[3, 4, 40]])).distances
    assert apart.min() >= 0.1 - 1e-9
    assert apart.max() <= 0.1 * 3.0**0.5 + 1e-9


def test_the_skin_is_left_alone_and_what_is_apart_too():
    skin, a, b = ball(2, radius=30.0), ball(2), ball(2, at=(0.0, 0.0, 20.5))
    anatomy = _anatomy(("skin", SKIN, skin), ("a", BONE, a), ("b", MUSCLE, b))
    found = _resolved(anatomy)
    assert found.pairs == ()
    assert all(found.anatomy[t.name].surface is t.surface for t in anatomy)
