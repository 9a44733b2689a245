"""Rigid bones in the field, slip in the contact zone, and surfaces as fine as the map needs, on a hinge of two rods."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import FieldError
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.isochoric_ffd import IsochoricFfdBackend
from musclefit.fields.locked import Fade
from musclefit.fields.radial import RadialBackend
from musclefit.flow.bones import IN_GAPS, BoneStepper, contact_residuals, rigid_groups
from musclefit.flow.deformation import Status
from musclefit.flow.locks import BoneLocks, LockSettings
from musclefit.flow.march import Pace, march
from musclefit.flow.rules import cayley_fractions
from musclefit.flow.steppers import HandleStepper, cayley_step
from musclefit.flow.surface_refinement import carried, carried_finely
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.solids import overlap_volume, solid_of
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.progress import Silent
from musclefit.rig.handles import BonePath, Handles


class Hinge:
    """The lower rod turns about the x axis through the origin; the others keep their place."""

    def __init__(self, degrees: float) -> None:
        self.degrees = degrees

    def at(self, t: float):
        turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([1.0, 0.0, 0.0]), angle_deg=t * self.degrees)
        return MappingProxyType(
            {"bone_upper": RigidMotion.identity(), "bone_cap": RigidMotion.identity(), "bone_lower": turn}
        )


def rod(low: float, high: float) -> TriMesh:
    mesh = trimesh.creation.capsule(height=high - low - 12.0, radius=6.0, count=[12, 12])
    mesh.apply_translation([0.0, 0.0, low - mesh.bounds[0, 2]])
    return TriMesh(np.array(mesh.vertices), np.array(mesh.faces))


def blob(centre: tuple[float, float, float], radii: tuple[float, float, float]) -> TriMesh:
    mesh = trimesh.creation.icosphere(2)
    return TriMesh(np.array(mesh.vertices) * radii + centre, np.array(mesh.faces))


ANATOMY = Anatomy(
    (
        Tissue("bone_upper", TissueKind.BONE, rod(1.2, 60.0)),
        Tissue("bone_cap", TissueKind.BONE, blob((0.0, 0.0, 75.0), (5.0, 5.0, 5.0))),
        Tissue("bone_lower", TissueKind.BONE, rod(-60.0, -1.2)),
        Tissue("muscle_front", TissueKind.MUSCLE, blob((0.0, 12.0, 0.0), (5.0, 5.0, 40.0))),
    ),
    "test",
)
MOTIONS = Hinge(40.0)
GROUPS = rigid_groups(ANATOMY, MOTIONS, zones_mm=np.full((2, 2), 4.0), sampled_mm=3.0, contact_sampled_mm=1.2)


def on_the_rods() -> Handles:
    parts = {bone: ANATOMY[bone].surface.vertices[::17] for bone in ("bone_upper", "bone_lower")}
    owner = tuple(bone for bone, part in parts.items() for _ in part)
    source = np.concatenate(list(parts.values()))
    return Handles(tuple(f"h{k}" for k in range(len(source))), source, owner)


LOCKS = BoneLocks.around(
    [TriMesh.together([ANATOMY[bone].surface for bone in group.bones]) for group in GROUPS],
    [LockSettings(0.8, Fade(over_mm=2.5, apart_mm=2.5))] * len(GROUPS),
)


RADIAL, SPLINES = RadialBackend("isochoric-r3"), IsochoricFfdBackend(24.0)


GAP = 4.0


@pytest.fixture(
    scope="module",
    params=[(RADIAL, None), (RADIAL, LOCKS), (SPLINES, None), (SPLINES, LOCKS)],
    ids=["fitted", "locked", "fitted splines", "locked splines"],
)
def bent(request):
    backend, locks = request.param
    handles = on_the_rods()
    path = BonePath(handles, MOTIONS)
    stepper = BoneStepper(
        HandleStepper(path, backend, cayley_step),
        groups=GROUPS,
        motions=MOTIONS,
        exact=5,
        lattices_mm=(6.0, 3.0, 1.5),
        iterations=40,
        locks=locks,
        gaps_mm=(GAP, GAP),
    )
    tested = np.vstack([ANATOMY.vertices(), stepper.held_points()])
    return stepper, path, march(stepper, rule=cayley_fractions, tested=tested, pace=Pace(50, 3)).require()


def exposed_residuals(groups, deformation, motions):
    """Distances of the bones' own mapped exposed vertices from their rigid motion over the whole path, mm."""
    own = [np.flatnonzero(~group.contact[: group.given]) for group in groups]
    rest = np.concatenate([group.surface.vertices[kept] for group, kept in zip(groups, own, strict=True)])
    targets = np.concatenate([group.at(motions).vertices[kept] for group, kept in zip(groups, own, strict=True)])
    return np.linalg.norm(deformation(rest) - targets, axis=1)


def test_bones_that_move_as_one_are_one_group():
    assert [group.bones for group in GROUPS] == [("bone_cap", "bone_upper"), ("bone_lower",)]


def test_the_contact_zone_is_where_the_groups_come_close():
    upper, lower = GROUPS
    assert upper.contact.any()
    assert lower.contact.any()
    assert (np.abs(upper.surface.vertices[upper.contact, 2]) < 12.0).all()
    for degrees in (0.0, 20.0, 40.0):
        turned = lower.at(Hinge(degrees).at(1.0)).vertices
        gap = np.linalg.norm(turned[:, None] - upper.exposed[None], axis=2).min()
        assert gap > 3.0


def test_the_field_follows_the_bones(bent):
    stepper, path, deformation = bent
    assert deformation.status is Status.CONVERGED
    residuals = exposed_residuals(GROUPS, deformation, MOTIONS.at(1.0))
    assert np.quantile(residuals, 0.99) < 0.05
    assert residuals.max() < 0.3
    away = surface_samples(ANATOMY["bone_lower"].surface, spacing_mm=0.3).points
    away = away[away[:, 2] < -8.0]
    off = np.abs(deformation(away) - MOTIONS.at(1.0)["bone_lower"](away)).max()
    assert (off < 1e-9) == (stepper.locks is not None)
    first = path.handles.source[:5]
    np.testing.assert_allclose(deformation(first), path.position(1.0)[:5], rtol=0, atol=1e-9)


def test_the_handles_alone_do_not_keep_bones_rigid(bent):
    stepper, _, _ = bent
    plain = march(stepper.handles, rule=cayley_fractions, tested=ANATOMY.vertices(), pace=Pace(50, 3)).require()
    assert np.quantile(exposed_residuals(GROUPS, plain, MOTIONS.at(1.0)), 0.99) > 0.1


def test_bones_are_held_in_fields_without_divergence_only():
    path = BonePath(on_the_rods(), MOTIONS)
    stepper = BoneStepper(
        HandleStepper(path, FfdBackend(), cayley_step),
        groups=GROUPS,
        motions=MOTIONS,
        exact=5,
        lattices_mm=(6.0,),
        iterations=1,
    )
    (make,) = stepper.makers(0.0, 1.0)
    with pytest.raises(FieldError, match=r"the backend made a FfdField: use a RadialBackend or an IsochoricFfdBackend"):
        make(stepper.held_points(), stepper.anchors(0.0))


def test_the_contact_zone_slips_along_its_bone_and_not_through(bent):
    _, _, deformation = bent
    off = contact_residuals(GROUPS, deformation, MOTIONS)
    assert len(off) == sum(int(group.contact.sum()) for group in GROUPS)
    assert off.max() < 1.0


def test_the_rule_holds_in_the_gaps_between_bones(bent):
    stepper, _, deformation = bent
    contacts = sum(int(group.contact.sum()) for group in GROUPS)
    for step, record in zip(deformation.steps, deformation.records, strict=True):
        beside = stepper.anchors(record.start)[contacts:]
        assert len(beside) == len(IN_GAPS) * contacts
        assert cayley_fractions(step.trial(beside).gradients).min() > 1.0
    rest = [group.at(MOTIONS.at(0.0)) for group in GROUPS]
    apart = np.min([nearest_places(stepper.anchors(0.0)[contacts:], bone).distances for bone in rest], axis=0)
    assert apart.max() == pytest.approx(max(IN_GAPS) * GAP, rel=0.01)


def test_stretches_compose_to_the_whole(bent):
    _, _, deformation = bent
    points = ANATOMY.vertices()
    moved, starts = points, []
    for start, end, part in deformation.by_stretch():
        moved = part(moved)
        starts.append((start, end))
    np.testing.assert_array_equal(moved, deformation(points))
    assert len(starts) == deformation.stretches == 3
    assert starts[-1][1] == 1.0


def test_fine_surfaces_keep_the_muscle_volume_and_its_distance_from_bone(bent):
    _, _, deformation = bent
    whole = frozenset(t.name for t in ANATOMY.of_kind(TissueKind.BONE))
    coarse = carried(ANATOMY, deformation)
    fine = carried_finely(ANATOMY, deformation, tolerance_mm=0.02, longest_mm=3.0, whole=whole, progress=Silent())
    rest = enclosed_volume(ANATOMY["muscle_front"].surface)
    errors = [abs(enclosed_volume(c.deformed["muscle_front"].surface) / rest - 1.0) for c in (coarse, fine)]
    assert errors[1] < 0.002
    assert errors[1] < errors[0]
    assert fine.undecided_edges == 0
    assert set(fine.splits) == {"muscle_front"}
    assert len(fine.determinants) == len(fine.rest.vertices())
    assert enclosed_volume(fine.rest["muscle_front"].surface) == pytest.approx(rest, rel=1e-12)
    muscle = fine.deformed["muscle_front"].surface
    assert len(self_crossings(muscle).pairs) == 0
    for bone in whole:
        moved = ANATOMY[bone].surface.with_vertices(MOTIONS.at(1.0)[bone](ANATOMY[bone].surface.vertices))
        assert overlap_volume(solid_of(muscle), solid_of(moved)) < 1e-6
    given = slice(0, len(coarse.rest["muscle_front"].surface.vertices))
    np.testing.assert_allclose(
        muscle.vertices[given], coarse.deformed["muscle_front"].surface.vertices, rtol=0, atol=1e-9
    )
