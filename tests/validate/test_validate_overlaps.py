"""Introduced overlap and volume outside the skin: what rides along is not introduced, what is new is; attacks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Gradients, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import refined_to
from musclefit.progress import Silent
from musclefit.validate.carried_volumes import SETTLED_MM3, CarriedVolume, Mapped, carried_volumes
from musclefit.validate.model import BoneOverlap
from musclefit.validate.overlaps import check_outside_skin, check_overlaps, rest_overlaps, solid_anatomy

QUIET = Silent()


def box(low: tuple[float, float, float], high: tuple[float, float, float], *, edge: float = 1000.0) -> TriMesh:
    mesh = trimesh.creation.box(bounds=[low, high])
    return refined_to(TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), edge_length_mm=edge)


def sphere(radius: float, *, centre: tuple[float, float, float] = (0, 0, 0), subdivisions: int = 3) -> TriMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def anatomy(*, skin: TriMesh | None = None, **muscles: TriMesh) -> Anatomy:
    tissues = [Tissue(name, TissueKind.MUSCLE, mesh) for name, mesh in muscles.items()]
    if skin is not None:
        tissues.append(Tissue("skin", TissueKind.SKIN, skin))
    return Anatomy(tuple(tissues), "test, mm")


def moved(rest: Anatomy, **shift: tuple[float, float, float]) -> Anatomy:
    """Some tissues shifted bodily, which no one-to-one map would do."""
    where, vertices = rest.slices(), np.array(rest.vertices())
    for name, by in shift.items():
        vertices[where[name]] += by
    return rest.with_vertices(vertices)


def sloped(moved: Callable[[Points], Points]) -> Mapped:
    """A map with its Jacobians by central differences, exact where it is linear."""

    def mapped(points: Points) -> tuple[Points, Gradients]:
        there = moved(points)
        steps = 1e-4 * np.eye(3)
        return there, np.stack([(moved(points + e) - moved(points - e)) / 2e-4 for e in steps], axis=2)

    return mapped


def same(points: Points) -> tuple[Points, Gradients]:
    return points, np.broadcast_to(np.eye(3), (len(points), 3, 3))


def bend(points: Points) -> Points:
    """A smooth one-to-one map that bends space and keeps volume."""
    x, y, z = points.T
    return np.stack([x, y + 0.01 * x**2, z + 2.0 * np.sin(0.1 * y)], axis=1)


def test_disjoint_tissues_stay_out_of_the_list() -> None:
    rest = anatomy(a=box((0, 0, 0), (1, 1, 1)), b=box((2, 0, 0), (3, 1, 1)), c=box((0, 5, 0), (1, 6, 1)))
    check = check_overlaps(rest, rest, mapped=same, progress=QUIET)
    assert (check.pairs, check.pairs_tested, check.not_checked) == ((), 3, ())


def test_a_new_overlap_is_introduced_whole() -> None:
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((11, 0, 0), (20, 10, 10)))
    (pair,) = check_overlaps(rest, moved(rest, b=(-4, 0, 0)), mapped=same, progress=QUIET).pairs
    assert (pair.a, pair.b, pair.rest_mm3) == ("a", "b", 0.0)
    np.testing.assert_allclose([pair.deformed_mm3, pair.introduced_mm3], 300, rtol=1e-12, atol=0)


def test_an_overlap_that_rides_along_a_growing_body_is_not_introduced() -> None:
    rest = anatomy(a=sphere(10), b=sphere(8, centre=(12, 0, 0)))

    def grow(points: Points) -> Points:
        return 1.1 * points

    (pair,) = check_overlaps(rest, rest.with_vertices(grow(rest.vertices())), mapped=sloped(grow), progress=QUIET).pairs
    assert pair.rest_mm3 > 200
    np.testing.assert_allclose(pair.deformed_mm3, 1.1**3 * pair.rest_mm3, rtol=1e-9, atol=0)
    np.testing.assert_allclose(pair.introduced_mm3, 0.0, rtol=0, atol=1e-6)


def test_overlap_beyond_what_rides_along_is_introduced() -> None:
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((9, 0, 0), (20, 10, 10)))

    def grow(points: Points) -> Points:
        return 1.1 * points

    grown = moved(rest.with_vertices(grow(rest.vertices())), b=(-2, 0, 0))
    (pair,) = check_overlaps(rest, grown, mapped=sloped(grow), progress=QUIET).pairs
    np.testing.assert_allclose(pair.rest_mm3, 100, rtol=1e-9, atol=0)
    np.testing.assert_allclose(pair.deformed_mm3, 1.1**3 * 100 + 2 * 11 * 11, rtol=1e-9, atol=0)
    np.testing.assert_allclose(pair.introduced_mm3, 2 * 11 * 11, rtol=1e-9, atol=0)


def test_a_shrinking_overlap_introduces_nothing_and_never_less() -> None:
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((8, 0, 0), (20, 10, 10)))
    (pair,) = check_overlaps(rest, moved(rest, b=(1, 0, 0)), mapped=same, progress=QUIET).pairs
    np.testing.assert_allclose([pair.rest_mm3, pair.deformed_mm3], [200, 100], rtol=1e-9, atol=0)
    assert pair.introduced_mm3 == 0.0


def test_an_overlap_bent_by_a_smooth_map_introduces_less_the_finer_the_meshes() -> None:
    """What is left is the facets' doing, and falls with the square of the edge length."""
    off = []
    for edge in (5.0, 1.25):
        rest = anatomy(a=box((0, 0, 0), (20, 10, 10), edge=edge), b=box((0, 8, 0), (20, 20, 10), edge=edge))
        (pair,) = check_overlaps(
            rest, rest.with_vertices(bend(rest.vertices())), mapped=sloped(bend), progress=QUIET
        ).pairs
        off.append(abs(pair.deformed_mm3 - 400.0))  # bend keeps volume, so the mapped rest overlap is 400 mm³
        np.testing.assert_allclose(pair.introduced_mm3, max(pair.deformed_mm3 - 400.0, 0), rtol=0, atol=SETTLED_MM3)
    assert 0 < off[1] < off[0] / 4


def test_a_nested_tissue_introduces_nothing_however_coarse_it_is() -> None:
    rest = anatomy(inner=sphere(3, subdivisions=1), outer=sphere(10, subdivisions=2))
    (pair,) = check_overlaps(rest, rest.with_vertices(bend(rest.vertices())), mapped=sloped(bend), progress=QUIET).pairs
    assert pair.deformed_mm3 > 50
    assert pair.introduced_mm3 == 0.0


def test_pairs_stand_largest_first() -> None:
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((11, 0, 0), (20, 10, 10)), c=box((0, 11, 0), (10, 20, 10)))
    check = check_overlaps(rest, moved(rest, b=(-2, 0, 0), c=(0, -5, 0)), mapped=same, progress=QUIET)
    assert [(p.a, p.b) for p in check.pairs] == [("a", "c"), ("a", "b"), ("b", "c")]
    assert check.pairs[0].introduced_mm3 > check.pairs[1].introduced_mm3 > check.pairs[2].introduced_mm3


def test_an_inside_out_tissue_is_named_and_not_called_free_of_overlap() -> None:
    good = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((5, 0, 0), (20, 10, 10)), c=box((40, 0, 0), (41, 1, 1)))
    surface = good["b"].surface
    bad = anatomy(a=good["a"].surface, b=TriMesh(surface.vertices, surface.faces[:, ::-1]), c=good["c"].surface)
    check = check_overlaps(bad, bad, mapped=same, progress=QUIET)
    assert check.pairs_tested == 1
    assert [n.what for n in check.not_checked] == ["b"]
    assert "at rest: the surface encloses -1500 mm³" in check.not_checked[0].reason


def test_a_tissue_turned_inside_out_by_the_deformation_is_named() -> None:
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((11, 0, 0), (20, 10, 10)))
    mirrored = rest.with_vertices(rest.vertices() * (-1, 1, 1))
    check = check_overlaps(rest, mirrored, mapped=same, progress=QUIET)
    assert check.pairs_tested == 0
    assert [(n.what, n.reason.split(":")[0]) for n in check.not_checked] == [("a", "deformed"), ("b", "deformed")]


def test_a_volume_that_cannot_be_believed_is_named_as_a_pair() -> None:
    rest = anatomy(a=sphere(10, subdivisions=4), b=box((-2, -2, -13.5), (2, 2, -11)))
    vertices = np.array(rest.vertices())
    cap = np.flatnonzero(vertices[rest.slices()["a"], 2] > 8.5)
    vertices[cap, 2] -= 24.0  # sinks through the bottom: a lobe that winds -1 times around b
    check = check_overlaps(rest, rest.with_vertices(vertices), mapped=same, progress=QUIET)
    assert (check.pairs, check.pairs_tested) == ((), 0)
    assert [n.what for n in check.not_checked] == ["a", "a / b"]
    assert "and did not at rest" in check.not_checked[0].reason
    assert "crosses itself or is locally inside out" in check.not_checked[1].reason


def test_a_tissue_that_folds_through_itself_is_named_even_where_it_overlaps_nothing() -> None:
    rest = anatomy(a=sphere(10, subdivisions=4), b=box((40, 0, 0), (50, 10, 10)))
    vertices = np.array(rest.vertices())
    vertices[np.flatnonzero(vertices[:, 2] > 8.5), 2] -= 24.0
    vertices[rest.slices()["b"]] = rest["b"].surface.vertices
    folded = rest.with_vertices(vertices)
    assert [n.what for n in check_overlaps(rest, folded, mapped=same, progress=QUIET).not_checked] == ["a"]
    assert check_overlaps(folded, folded, mapped=same, progress=QUIET).not_checked == ()  # the reader's finding


def test_other_tissues_are_refused() -> None:
    a, b = anatomy(a=sphere(1)), anatomy(b=sphere(1))
    with pytest.raises(InputError, match="has muscle 'a' where the deformed one has muscle 'b'"):
        check_overlaps(a, b, mapped=same, progress=QUIET)


def test_rest_overlaps_are_the_same_as_those_of_the_identity() -> None:
    rest = anatomy(a=sphere(10), b=sphere(8, centre=(12, 0, 0)), c=sphere(2), skin=sphere(5))
    alone, compared = rest_overlaps(rest, progress=QUIET), check_overlaps(rest, rest, mapped=same, progress=QUIET)
    assert [(p.a, p.b) for p in alone.pairs] == [("a", "b"), ("a", "c")]
    assert {(p.a, p.b): p.rest_mm3 for p in alone.pairs} == {(p.a, p.b): p.deformed_mm3 for p in compared.pairs}
    assert alone.pairs_tested == compared.pairs_tested == 3
    assert all(p.introduced_mm3 == 0.0 for p in alone.pairs)


def test_prepared_solids_give_the_same_answer() -> None:
    rest = anatomy(a=sphere(10), b=sphere(8, centre=(19, 0, 0)))
    deformed = moved(rest, b=(-2, 0, 0))
    once = check_overlaps(rest, deformed, mapped=same, progress=QUIET)
    again = check_overlaps(solid_anatomy(rest, progress=QUIET), deformed, mapped=same, progress=QUIET)
    assert once == again


def test_a_tissue_pushed_through_the_skin_is_outside_by_what_sticks_out() -> None:
    rest = anatomy(skin=box((0, 0, 0), (100, 100, 100)), a=box((80, 10, 10), (90, 20, 20)), b=box((10,) * 3, (20,) * 3))
    check = check_outside_skin(rest, moved(rest, a=(14, 0, 0)), mapped=same, progress=QUIET)
    outside = {t.name: t for t in check.tissues}
    assert list(outside) == ["a", "b"]
    np.testing.assert_allclose(
        [outside["a"].rest_mm3, outside["a"].deformed_mm3, outside["a"].introduced_mm3],
        [0, 400, 400],
        rtol=1e-9,
        atol=0,
    )
    assert (outside["b"].deformed_mm3, outside["b"].introduced_mm3, check.not_checked) == (0.0, 0.0, ())


def test_what_sticks_out_at_rest_rides_along() -> None:
    rest = anatomy(
        skin=box((0, 0, 0), (100, 100, 100)), a=box((95, 10, 10), (105, 20, 20)), nail=box((110,) * 3, (111,) * 3)
    )

    def grow(points: Points) -> Points:
        return 1.2 * points

    check = check_outside_skin(rest, rest.with_vertices(grow(rest.vertices())), mapped=sloped(grow), progress=QUIET)
    a, nail = check.tissues
    np.testing.assert_allclose([a.rest_mm3, a.deformed_mm3], [500, 1.2**3 * 500], rtol=1e-9, atol=0)
    np.testing.assert_allclose([a.introduced_mm3, nail.introduced_mm3], 0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(nail.deformed_mm3, 1.2**3, rtol=1e-9, atol=0)


def test_without_a_skin_nothing_is_claimed() -> None:
    check = check_outside_skin(anatomy(a=sphere(1)), anatomy(a=sphere(1)), mapped=same, progress=QUIET)
    assert (check.tissues, check.not_checked) == ((), ())


def test_an_inside_out_skin_is_named_and_nothing_is_claimed() -> None:
    skin = sphere(10)
    rest = anatomy(skin=TriMesh(skin.vertices, skin.faces[:, ::-1]), a=sphere(1))
    check = check_outside_skin(rest, rest, mapped=same, progress=QUIET)
    assert check.tissues == ()
    assert [n.what for n in check.not_checked] == ["skin"]


def test_carried_volume_of_a_curved_map_is_its_integral() -> None:
    def swell(points: Points) -> Points:
        return points * (1.0 + 0.02 * points[:, :1] ** 2 * np.array([0.0, 0.0, 1.0]))

    # det = 1 + 0.02 x^2, over [0, 10]^3: 1000 + 0.02 * 100 * 1000 / 3
    (volume,) = carried_volumes(
        [box((0, 0, 0), (10, 10, 10))], against=[1000 + 2000 / 3], mapped=sloped(swell), tick=lambda _: None
    )
    assert volume.settled
    np.testing.assert_allclose(volume.volume_mm3, 1000 + 2000 / 3, rtol=0, atol=SETTLED_MM3)


def test_a_carried_volume_need_not_be_exacter_than_what_it_is_compared_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("musclefit.validate.carried_volumes.BATCH_TRIANGLES", 1)
    surfaces = [box((0, 0, 0), (10, 10, 10)), box((5, 0, 0), (30, 10, 10)), box((-20, 0, 0), (10, 7, 10))]
    calls: list[int] = []

    def counted(points: Points) -> tuple[Points, Gradients]:
        calls.append(len(points))
        return sloped(bend)(points)

    exact = carried_volumes(
        surfaces, against=[v.volume_mm3 for v in _volumes(surfaces)], mapped=sloped(bend), tick=_ignore
    )
    loose = carried_volumes(surfaces, against=[1e9] * 3, mapped=counted, tick=_ignore)
    assert all(v.settled for v in (*exact, *loose))
    assert len(calls) == 3  # one level of three batches
    np.testing.assert_allclose([v.volume_mm3 for v in loose], [v.volume_mm3 for v in exact], rtol=1e-2)


def _volumes(surfaces: list[TriMesh]) -> tuple[CarriedVolume, ...]:
    return carried_volumes(surfaces, against=[0.0] * len(surfaces), mapped=sloped(bend), tick=_ignore)


def _ignore(_: float) -> None:
    """Drop a tick."""


def test_a_rest_that_is_checked_against_many_poses_is_measured_once() -> None:
    tissues = [("muscle_a", (0, 0, 0), (10, 10, 10)), ("muscle_b", (8, 0, 0), (20, 10, 10))]
    anatomy = Anatomy(tuple(Tissue(n, TissueKind.MUSCLE, box(a, b)) for n, a, b in tissues), "mm")
    rest = solid_anatomy(anatomy, progress=QUIET)
    first = check_overlaps(rest, anatomy, mapped=same, progress=QUIET)
    assert first.pairs[0].rest_mm3 == pytest.approx(200.0, rel=1e-12)

    parts = dict(rest.known)
    assert len(parts) == 1
    assert check_overlaps(rest, anatomy, mapped=same, progress=QUIET) == first
    assert all(rest.known[key] is part for key, part in parts.items())


def test_a_surface_too_large_to_refine_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("musclefit.validate.carried_volumes.MAX_TRIANGLES", 20)
    (volume,) = carried_volumes([box((0, 0, 0), (10, 10, 10))], against=[0.0], mapped=sloped(bend), tick=lambda _: None)
    assert not volume.settled
    assert "too large to refine" in volume.doubt()


def test_a_map_too_rough_to_settle_is_said_to_be() -> None:
    rng = np.random.default_rng(0)

    def noise(points: Points) -> Points:
        return points + rng.normal(scale=0.3, size=points.shape)

    (volume,) = carried_volumes(
        [box((0, 0, 0), (10, 10, 10))], against=[1000.0], mapped=sloped(noise), tick=lambda _: None
    )
    assert not volume.settled
    assert "still changed it by" in volume.doubt()


@pytest.mark.anatomy
def test_the_forearm_at_rest_is_free_of_overlap(anatomy_data: Path) -> None:
    tissues = []
    for path in sorted((anatomy_data / "arm" / "disjoint").glob("*.ply")):
        mesh = trimesh.load(path, process=False)
        kind = TissueKind(path.stem.split("_")[0])
        tissues.append(Tissue(path.stem, kind, TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))))
    rest = solid_anatomy(Anatomy(tuple(tissues), "patient, mm"), progress=QUIET)
    check = rest_overlaps(rest, progress=QUIET)
    assert (check.pairs, check.pairs_tested, check.not_checked) == ((), 69 * 68 // 2, ())
    outside = check_outside_skin(rest, rest, mapped=same, progress=QUIET)
    assert outside.not_checked == ()
    # One phalanx pierces the rebuilt skin of the finger by 0.018 mm³; everything else is inside.
    assert sum(t.rest_mm3 for t in outside.tissues) < 0.05
    assert max(t.introduced_mm3 for t in outside.tissues) == pytest.approx(0.0, abs=1e-6)


# --- what bones share by their motions


def test_only_what_is_beyond_the_motions_of_bones_counts_as_introduced():
    """Given 1 mm of overlap with the pose; what is deformed shares 1 mm, then 1.5 mm."""
    rest = anatomy(a=box((0, 0, 0), (10, 10, 10)), b=box((12, 0, 0), (20, 10, 10)), c=box((22, 0, 0), (30, 10, 10)))
    given = (BoneOverlap("a", "b", 0.0, 100.0, 100.0, 1.0, 200.0, 2.0),)
    for shift, beyond in ((-3.0, 0.0), (-3.5, 50.0), (-2.5, 0.0)):
        after = moved(rest, b=(shift, 0, 0), c=(-12.5, 0, 0))
        found = check_overlaps(rest, after, mapped=same, by_motions=given, progress=QUIET)
        pairs = {(p.a, p.b): p for p in found.pairs}
        assert pairs["a", "b"].introduced_mm3 == pytest.approx(beyond, abs=1e-9)
        assert pairs["a", "b"].deformed_mm3 == pytest.approx(100.0 * (-2.0 - shift))
        assert pairs["a", "c"].introduced_mm3 == pytest.approx(50.0), "a pair that was not given counts in full"
        assert found.bones == given
