"""Label maps become closed surfaces of the right size and place that share no volume."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.anatomy.label_surfaces import LabelName, label_anatomy
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.queries.solids import overlap_volume, solid_of
from musclefit.geometry.surfaces.crossings import crossings_between, self_crossings

GRID = Grid((40, 36, 30), np.array([[-1.5, 0, 0, 20.0], [0, 1.5, 0, -30.0], [0, 0, 2.0, 5.0], [0, 0, 0, 1]]))
NAMES = (
    LabelName(1, "muscle_outer", TissueKind.MUSCLE),
    LabelName(2, "bone_inner", TissueKind.BONE),
    LabelName(9, "skin", TissueKind.SKIN),
)
CENTRE = GRID.positions(np.array([[20.0, 18.0, 15.0]]))[0]


def ball_labels() -> np.ndarray:
    """A ball of bone, 10 mm, beside a half shell of muscle, 18 mm, in fat (label 9), 23 mm."""
    radius = np.linalg.norm(GRID.positions(GRID.voxels(0, GRID.count)) - CENTRE, axis=1).reshape(GRID.shape)
    left = (GRID.positions(GRID.voxels(0, GRID.count))[:, 0] < CENTRE[0]).reshape(GRID.shape)
    labels = np.zeros(GRID.shape, dtype=np.int16)
    labels[radius < 23.0] = 9
    labels[(radius < 18.0) & left] = 1
    labels[radius < 10.0] = 2
    return labels


@pytest.fixture(scope="module")
def anatomy():
    return label_anatomy(ball_labels(), GRID, names=NAMES, frame=Frame.RAS, source="balls")[0]


def test_surfaces_have_the_volume_and_place_of_their_labels(anatomy):
    for name, radius, tolerance in (("bone_inner", 10.0, 0.08), ("skin", 23.0, 0.03)):
        surface = anatomy[name].surface
        assert enclosed_volume(surface) == pytest.approx(4.0 / 3.0 * np.pi * radius**3, rel=tolerance)
        distances = np.linalg.norm(surface.vertices - CENTRE, axis=1)
        assert np.abs(distances - radius).max() < 1.2  # less than a voxel


def test_surfaces_do_not_cross_and_share_no_volume(anatomy):
    bone, muscle = anatomy["bone_inner"].surface, anatomy["muscle_outer"].surface
    assert len(crossings_between(bone, muscle)) == 0
    assert overlap_volume(solid_of(bone), solid_of(muscle)) == 0.0
    assert not len(self_crossings(muscle))


def test_the_skin_is_around_everything(anatomy):
    assert anatomy.skin is not None
    low, high = anatomy.skin.surface.vertices.min(axis=0), anatomy.skin.surface.vertices.max(axis=0)
    for tissue in anatomy:
        assert (tissue.surface.vertices >= low).all()
        assert (tissue.surface.vertices <= high).all()


def test_lps_surfaces_are_those_of_ras_turned_about(anatomy):
    turned = label_anatomy(ball_labels(), GRID, names=NAMES, frame=Frame.LPS, source="balls")[0]
    assert turned.frame == "patient (LPS), mm"
    for tissue in anatomy:
        expected = tissue.surface.vertices * [-1.0, -1.0, 1.0]
        np.testing.assert_allclose(turned[tissue.name].surface.vertices, expected, rtol=0, atol=1e-12)
        assert enclosed_volume(turned[tissue.name].surface) > 0.0


def test_a_label_cut_by_the_images_edge_is_still_closed():
    labels = np.zeros(GRID.shape, dtype=np.uint8)
    labels[:10, :, :] = 1
    surface = label_anatomy(labels, GRID, names=NAMES[:1], frame=Frame.RAS, source="slab")[0]["muscle_outer"].surface
    assert enclosed_volume(surface) == pytest.approx(10 * 36 * 30 * 4.5, rel=0.05)


def test_noise_still_gives_closed_surfaces():
    rng = np.random.default_rng(0)
    labels = (rng.random((20, 20, 20)) < 0.5).astype(np.uint8) + 1
    anatomy, _ = label_anatomy(labels, Grid((20, 20, 20), np.eye(4)), names=NAMES[:2], frame=Frame.RAS, source="noise")
    assert len(anatomy) == 2


def test_unnamed_labels_are_told():
    _, findings = label_anatomy(ball_labels(), GRID, names=NAMES[:1], frame=Frame.RAS, source="balls")
    assert "2 labels without a name were left out: 2, 9" in findings[0].message


def test_errors_name_the_label_and_the_way_out():
    labels = ball_labels()
    with pytest.raises(InputError, match="no voxel has label 7"):
        label_anatomy(labels, GRID, names=[LabelName(7, "x", TissueKind.OTHER)], frame=Frame.RAS, source="balls")
    with pytest.raises(InputError, match="store it as integers"):
        label_anatomy(labels.astype(float), GRID, names=NAMES, frame=Frame.RAS, source="balls")
    with pytest.raises(InputError, match="two labels have the value 1"):
        label_anatomy(labels, GRID, names=[*NAMES, NAMES[0]], frame=Frame.RAS, source="balls")
    thin = np.zeros(GRID.shape, dtype=np.uint8)
    thin[20, 18, 15] = 1
    with pytest.raises(InputError, match="thinner than the smoothing"):
        label_anatomy(thin, GRID, names=NAMES[:1], frame=Frame.RAS, source="speck")


def test_cells_that_touch_are_as_good_as_multi_label_surface_nets():
    """Voronoi cells of a ball: closed, uncrossed, a millionth shared, and about as near the truth as VTK's."""
    pyvista = pytest.importorskip("pyvista")
    count, radius = 36, 15.0
    grid = Grid((count,) * 3, np.eye(4))
    points = grid.positions(grid.voxels(0, grid.count)) - 17.5
    seeds = np.random.default_rng(1).normal(size=(6, 3)) * 7.0
    nearest = np.linalg.norm(points[:, None] - seeds, axis=2).argmin(axis=1) + 1
    labels = np.where(np.linalg.norm(points, axis=1) < radius, nearest, 0).reshape(grid.shape).astype(np.int16)

    def off(vertices, label):
        seed, at = seeds[label - 1], np.asarray(vertices, dtype=float) - 17.5
        others = np.delete(seeds, label - 1, axis=0)
        planes = [(at - 0.5 * (seed + other)) @ (other - seed) / np.linalg.norm(other - seed) for other in others]
        return np.abs(np.max([np.linalg.norm(at, axis=1) - radius, *planes], axis=0))

    names = [LabelName(k, f"cell_{k}", TissueKind.OTHER) for k in range(1, 7)]
    cells, _ = label_anatomy(labels, grid, names=names, frame=Frame.RAS, source="cells")
    image = pyvista.ImageData(dimensions=grid.shape)
    image["labels"] = labels.ravel(order="F")
    nets = image.contour_labels("all", scalars="labels", output_mesh_type="triangles")
    sides, corners = nets.cell_data["boundary_labels"], nets.faces.reshape(-1, 4)[:, 1:]
    theirs = [off(nets.points[np.unique(corners[(sides == k).any(axis=1)])], k).mean() for k in range(1, 7)]
    ours = [off(cells[f"cell_{k}"].surface.vertices, k).mean() for k in range(1, 7)]
    assert np.mean(ours) < 0.15
    assert np.mean(ours) < 1.5 * np.mean(theirs)
    solids = [solid_of(tissue.surface) for tissue in cells]
    shared = sum(overlap_volume(a, b) for i, a in enumerate(solids) for b in solids[i + 1 :])
    assert shared < 3e-6 * 4.0 / 3.0 * np.pi * radius**3
    assert not any(len(self_crossings(tissue.surface)) for tissue in cells)
