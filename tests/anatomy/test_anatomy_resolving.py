"""Overlaps taken away by rule: volumes against formulas for boxes and balls, and nothing left that meets."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from planted import ball, box

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.repair.choosing import Chooser
from musclefit.anatomy.repair.midsurfaces import halves, own_sides
from musclefit.anatomy.repair.overlaps import CUT, resolved
from musclefit.anatomy.repair.records import RepairSettings
from musclefit.anatomy.repair.resolutions import Choice, Rule
from musclefit.errors import InputError
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.gaps import smallest_gap
from musclefit.geometry.queries.solids import solid_of
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.surfaces.booleans import as_manifold, difference, grown_by, padded, shared, united
from musclefit.geometry.surfaces.crossings import crossings_between, self_crossings
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.slivers import heights
from musclefit.geometry.surfaces.subdivision import with_short_edges
from musclefit.geometry.surfaces.thin_walls import thin_places
from musclefit.progress import Silent
from musclefit.validate.overlaps import rest_overlaps

DEFAULTS = RepairSettings()
CUT_MM = CUT * DEFAULTS.clearance_mm
BONE, MUSCLE, OTHER, SKIN = TissueKind.BONE, TissueKind.MUSCLE, TissueKind.OTHER, TissueKind.SKIN


def _anatomy(*tissues):
    return Anatomy(tuple(Tissue(name, kind, mesh) for name, kind, mesh in tissues), "test")


def _resolved(anatomy, rule=Rule.PRIORITY, settings=DEFAULTS, *, choice=Choice.LEAST_LOSS):
    found = resolved(anatomy, rule=rule, choice=choice, settings=settings, progress=Silent())
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
    assert left == pytest.approx(24.0 - 2.0 * 2.0 * (1.0 + CUT_MM), rel=1e-3)
    (cut,) = found.cuts
    assert (cut.name, cut.volume_before_mm3, cut.clearance_mm) == ("m", pytest.approx(24.0), CUT_MM)
    assert cut.volume_after_mm3 == left


def test_within_a_kind_the_smaller_goes_before():
    tissues = {
        "z": Tissue("z", MUSCLE, ball(radius=2.0)),
        "a": Tissue("a", MUSCLE, ball(radius=3.0)),
        "large": Tissue("large", BONE, ball()),
        "tiny": Tissue("tiny", OTHER, ball(radius=0.1)),
    }
    solids = {name: as_manifold(tissue.surface) for name, tissue in tissues.items()}
    chooser = Chooser(tissues, solids, choice=Choice.LEAST_LOSS, settings=DEFAULTS)
    assert chooser.before("z", "a") == chooser.before("a", "z") == ("z", "a")
    assert chooser.before("z", "large") == ("large", "z")
    assert chooser.before("tiny", "z") == ("z", "tiny")


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
    # the shared slab is from 2 to 4: each tool ends half the clearance beyond its middle
    assert np.abs(heights - 3.0).min() == pytest.approx(0.01, abs=1e-3)
    assert enclosed_volume(tool_a) + enclosed_volume(tool_b) == pytest.approx(2.0 * 400.0, rel=0.04)


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
    assert left == pytest.approx(enclosed_volume(ball(3)) - enclosed_volume(ball(2, radius=3.0 + CUT_MM)), rel=1e-3)


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
    found = _resolved(_anatomy(("m", MUSCLE, muscle), ("b", BONE, bone)), settings=RepairSettings(clearance_mm=0.02))
    cut, left = found.cuts[0], 0.02 * CUT
    (change,) = cut.changes
    assert change.code == "stray-pieces"
    assert change.area_mm2 == pytest.approx(2 * (0.1 - left) ** 2 + 4 * (0.1 - left) * (4.0 - left), rel=0.05)
    assert cut.volume_after_mm3 == pytest.approx(10.0 * 10.0 * (5.0 - left), rel=1e-3)


def test_one_inside_another_of_its_kind_is_not_split():
    found = _resolved(_anatomy(("m", MUSCLE, ball(3)), ("n", MUSCLE, ball(2, radius=3.0))), Rule.SPLIT)
    assert found.pairs[0].rule.startswith("least loss: m loses 2.")
    assert [cut.name for cut in found.cuts] == ["m"]


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
    assert max(cut.clearance_mm for cut in found.cuts) >= CUT_MM


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


def _gaps(anatomy):
    inner = [solid_of(t.surface) for t in anatomy if t.kind is not SKIN]
    return [smallest_gap(a, b, within_mm=2.0) for i, a in enumerate(inner) for b in inner[i + 1 :]]


def _tube(radius, length, *, at=(0.0, 0.0, 0.0), sides=48):
    shape = trimesh.creation.cylinder(radius, length, sections=sides)
    return TriMesh(np.array(shape.vertices) + np.array(at), np.array(shape.faces, dtype=np.int64))


@pytest.mark.parametrize("clearance", [0.04, 0.1, 0.4])
@pytest.mark.parametrize("rule", [Rule.PRIORITY, Rule.SPLIT])
def test_the_clearance_is_left_between_all_pairs_and_told(clearance, rule):
    anatomy = _anatomy(
        ("a", MUSCLE, ball(3)),
        ("b", MUSCLE, ball(3, at=(14.0, 0.0, 0.0))),
        ("tube", BONE, _tube(2.0, 30.0, at=(7.0, 0.0, 0.0))),
        ("sheet", OTHER, box((40.0, 40.0, 0.7), at=(-12.0, -20.0, -0.3))),
    )
    found = _resolved(anatomy, rule, RepairSettings(clearance_mm=clearance))
    assert min(_gaps(found.anatomy)) >= clearance
    assert (found.clearance_mm, found.gaps) == (clearance, ())


def test_tissues_that_do_not_overlap_but_nearly_touch_get_the_clearance_too():
    low, high = box((10.0, 10.0, 4.0)), box((8.0, 8.0, 2.0), at=(1.0, 1.0, 4.03))
    found = _resolved(_anatomy(("low", MUSCLE, low), ("high", MUSCLE, high)))
    assert found.pairs == ()
    assert found.anatomy["high"].surface is high
    assert 0.1 <= min(_gaps(found.anatomy)) <= 0.15
    (cut,) = found.cuts
    assert cut.name == "low"
    assert 400.0 - 70.0 * (1.2 * CUT_MM - 0.03) <= cut.volume_after_mm3 <= 400.0 - 64.0 * (CUT_MM - 0.03)


def test_a_clearance_that_is_not_reached_is_told(monkeypatch):
    monkeypatch.setattr("musclefit.anatomy.repair.overlaps.ROUNDS", 0)
    low, high = box((10.0, 10.0, 4.0)), box((8.0, 8.0, 2.0), at=(1.0, 1.0, 4.03))
    found = _resolved(_anatomy(("low", MUSCLE, low), ("high", MUSCLE, high)))
    (gap,) = found.gaps
    assert ({gap.a, gap.b}, gap.gap_mm) == ({"low", "high"}, pytest.approx(0.03, abs=1e-9))


def _between_plates(left):
    """A muscle of which two bone plates leave a wall of a thickness, beside a thick part."""
    room = 0.5 * left + CUT_MM
    return _anatomy(
        ("m", MUSCLE, box((20.0, 10.0, 20.0), at=(0.0, 0.0, -10.0))),
        ("upper", BONE, box((14.0, 14.0, 12.0), at=(-2.0, -2.0, room))),
        ("lower", BONE, box((14.0, 14.0, 12.0), at=(-2.0, -2.0, -room - 12.0))),
    )


@pytest.mark.parametrize(("left", "stays"), [(0.02, False), (0.04, False), (0.12, True)])
def test_walls_that_plates_leave_go_below_half_the_clearance(left, stays):
    found = _resolved(_between_plates(left))
    muscle = found.anatomy["m"].surface
    assert (muscle.vertices[:, 0].min() < 1.0) == stays
    assert not thin_places(muscle, width_mm=0.5 * RepairSettings().clearance_mm).thin.any()
    assert found.thin == ()
    (cut,) = found.cuts
    assert ("thin-walls" in {change.code for change in cut.changes}) == (not stays)


def test_a_tissue_that_is_thin_by_nature_is_left_so_and_told():
    sheet = box((20.0, 20.0, 0.03), at=(-10.0, -10.0, 0.0))
    found = _resolved(_anatomy(("sheet", MUSCLE, sheet), ("tube", BONE, _tube(2.0, 10.0))))
    (thin,) = found.thin
    assert thin.name == "sheet"
    kept = 400.0 - np.pi * (2.0 + CUT_MM) ** 2
    assert thin.area_mm2 == pytest.approx(2.0 * kept, rel=0.03)
    assert enclosed_volume(found.anatomy["sheet"].surface) == pytest.approx(0.03 * kept, rel=0.01)


def _bent(points):
    """A smooth one-to-one map that turns about the z axis, more with height."""
    x, y, z = points.T
    return np.column_stack(
        [x * np.cos(z / 40.0) - y * np.sin(z / 40.0), x * np.sin(z / 40.0) + y * np.cos(z / 40.0), z]
    )


def test_what_grazing_cuts_leave_can_be_bent_without_crossing_itself():
    muscle, tube = ball(4, radius=10.0), _tube(4.0, 30.0, at=(13.7, 0.0, 0.0), sides=64)
    plain = difference(muscle, [grown_by(tube, distance_mm=CUT_MM)], smooth_within_mm=0.0)
    found = _resolved(_anatomy(("m", MUSCLE, muscle), ("tube", BONE, tube)))
    cut = found.anatomy["m"].surface
    assert (heights(plain) < 0.01).sum() >= 15
    assert (heights(cut) < 0.01).sum() <= 2
    fine = with_short_edges(cut, longest_mm=1.0)
    assert len(self_crossings(fine.with_vertices(_bent(np.array(fine.vertices))))) == 0


def test_least_loss_cuts_the_plate_where_the_bar_would_fall_apart():
    bar, plate = box((4.0, 4.0, 40.0), at=(-2.0, -2.0, -20.0)), box((12.0, 12.0, 2.0), at=(-6.0, -6.0, -1.0))
    anatomy = _anatomy(("bar", MUSCLE, bar), ("plate", MUSCLE, plate))
    least = _resolved(anatomy)
    assert [cut.name for cut in least.cuts] == ["plate"]
    assert (least.cuts[0].pieces_before, least.cuts[0].pieces_after) == (1, 1)
    assert least.pairs[0].rule.startswith("least loss: plate loses 11.1 % of its volume, the other would lose 52.5 %")
    smaller = _resolved(anatomy, choice=Choice.SMALLER)
    (cut,) = smaller.cuts
    assert (cut.name, cut.pieces_before, cut.pieces_after) == ("bar", 1, 2)
    assert smaller.pairs[0].rule == "priority: the smaller muscle"


def test_least_loss_spreads_losses_that_would_come_to_too_much_for_one():
    anatomy = _anatomy(
        ("big", MUSCLE, box((20.0, 20.0, 20.0))),
        ("n1", MUSCLE, box((18.0, 20.0, 20.0), at=(19.6, 0.0, 0.0))),
        ("n2", MUSCLE, box((20.0, 18.0, 20.0), at=(0.0, 19.6, 0.0))),
        ("n3", MUSCLE, box((20.0, 20.0, 18.0), at=(0.0, 0.0, 19.6))),
    )
    found = _resolved(anatomy)
    assert max(abs(cut.change_percent) for cut in found.cuts) < 6.0
    said = [pair.rule for pair in found.pairs if "in all" in pair.rule]
    assert len(said) == 1
    assert said[0].endswith("% and come to more than 5 % in all")
    changes = {cut.name: cut.change_percent for cut in _resolved(anatomy, choice=Choice.SMALLER).cuts}
    assert changes["big"] < -6.0


def test_any_kind_lets_a_bone_lose_to_a_muscle_that_would_lose_more():
    bone, muscle = box((20.0, 20.0, 20.0)), box((4.0, 4.0, 1.0), at=(2.0, 2.0, 19.5))
    anatomy = _anatomy(("b", BONE, bone), ("m", MUSCLE, muscle))
    assert [cut.name for cut in _resolved(anatomy).cuts] == ["m"]
    found = _resolved(anatomy, choice=Choice.ANY_KIND)
    assert [cut.name for cut in found.cuts] == ["b"]
    assert found.pairs[0].rule.startswith("least loss: b loses 0.1 %")


@pytest.mark.parametrize("choice", list(Choice))
def test_what_three_share_one_of_them_keeps(choice):
    meshes = {"a": ball(3), "b": ball(3, at=(8.0, 0.0, 0.0)), "c": ball(3, at=(4.0, 7.0, 0.0))}
    found = _resolved(_anatomy(*((name, MUSCLE, mesh) for name, mesh in meshes.items())), choice=choice)
    lattice = np.stack(np.meshgrid(*[np.linspace(-3.0, 11.0, 29)] * 3), axis=-1).reshape(-1, 3) - [0.0, 1.0, 4.0]
    inside = np.ones(len(lattice), dtype=bool)
    for mesh in meshes.values():
        inside &= winding_numbers(mesh, lattice) > 0.5
    owners = sum((winding_numbers(found.anatomy[name].surface, lattice[inside]) > 0.5).astype(int) for name in "abc")
    assert inside.sum() > 500
    assert (owners <= 1).all()
    assert (owners == 1).mean() > 0.9
