"""Label maps become closed surfaces of the right size and place that share no volume."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from musclefit.anatomy.label_surfaces import LabelName, label_anatomy, label_fits
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.images.grids import Frame, Grid
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.queries.distances import nearest_places
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
    return label_anatomy(ball_labels(), GRID, names=NAMES, frame=Frame.RAS, source="balls").anatomy


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
    turned = label_anatomy(ball_labels(), GRID, names=NAMES, frame=Frame.LPS, source="balls").anatomy
    assert turned.frame == "patient (LPS), mm"
    for tissue in anatomy:
        expected = tissue.surface.vertices * [-1.0, -1.0, 1.0]
        np.testing.assert_allclose(turned[tissue.name].surface.vertices, expected, rtol=0, atol=1e-12)
        assert enclosed_volume(turned[tissue.name].surface) > 0.0


def test_a_label_cut_by_the_images_edge_is_still_closed():
    labels = np.zeros(GRID.shape, dtype=np.uint8)
    labels[:10, :, :] = 1
    surface = (
        label_anatomy(labels, GRID, names=NAMES[:1], frame=Frame.RAS, source="slab").anatomy["muscle_outer"].surface
    )
    assert enclosed_volume(surface) == pytest.approx(10 * 36 * 30 * 4.5, rel=0.05)


def test_noise_still_gives_closed_surfaces():
    rng = np.random.default_rng(0)
    labels = (rng.random((20, 20, 20)) < 0.5).astype(np.uint8) + 1
    made = label_anatomy(labels, Grid((20, 20, 20), np.eye(4)), names=NAMES[:2], frame=Frame.RAS, source="noise")
    assert len(made.anatomy) == 2


def test_surfaces_follow_their_voxels_within_half_a_voxel_and_one_percent():
    """Balls from 3 to 9 mm, a box, and a rod at 30 degrees at anisotropic voxels, in contact and not."""
    grid = Grid((60, 60, 40), np.diag([1.0, 1.0, 1.5, 1.0]))
    points = grid.positions(grid.voxels(0, grid.count)).reshape(*grid.shape, 3)
    labels = np.zeros(grid.shape, dtype=np.int16)
    for label, (centre, radius) in enumerate((((10, 10, 12), 3), ((30, 14, 15), 6), ((14, 40, 30), 9)), start=1):
        labels[np.linalg.norm(points - centre, axis=3) < radius] = label
    labels[40:52, 30:50, 5:20] = 4
    rod = points - np.array([30.0, 40.0, 40.0])
    axis = np.array([np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)])
    along = rod @ axis
    labels[(np.abs(along) < 14) & (np.linalg.norm(rod - along[..., None] * axis, axis=3) < 4) & (labels == 0)] = 5
    names = [LabelName(k, f"part_{k}", TissueKind.OTHER) for k in range(1, 6)]
    made = label_anatomy(labels, grid, names=names, frame=Frame.RAS, source="parts")
    fits, off = label_fits(made.anatomy, made, grid, frame=Frame.RAS)
    for fit in fits:
        surface = made.anatomy[fit.name].surface
        assert enclosed_volume(surface) == pytest.approx(1.5 * fit.voxels, rel=0.01), fit
        assert fit.largest_voxels <= 0.5, fit
        inside = contains(surface, points.reshape(-1, 3)).reshape(grid.shape)
        assert (inside != (labels == int(fit.name[-1]))).sum() < 0.01 * fit.voxels, fit
    assert not (*made.findings, *off)


def contains(surface, points):
    """By the winding number of libigl, which knows nothing of smoothing or level sets."""
    igl = pytest.importorskip("igl")
    return np.abs(igl.winding_number(surface.vertices, surface.faces, points)) > 0.5


@pytest.mark.parametrize("voxel_mm", [1.0, 0.5])
def test_bones_a_millimetre_apart_stay_apart(voxel_mm):
    """A ball in a cup with a gap of 1 mm: the surfaces keep it, but for what the voxels' stairs take of it."""
    count = int(36 / voxel_mm)
    grid = Grid((count,) * 3, np.diag([voxel_mm] * 3 + [1.0]))
    radius = np.linalg.norm(grid.positions(grid.voxels(0, grid.count)) - 17.7, axis=1).reshape(grid.shape)
    half = (grid.positions(grid.voxels(0, grid.count))[:, 2] > 17.7).reshape(grid.shape)
    labels = np.zeros(grid.shape, dtype=np.uint8)
    labels[radius < 10.0], labels[(radius > 11.0) & (radius < 15.0) & half] = 1, 2
    names = [LabelName(1, "bone_ball", TissueKind.BONE), LabelName(2, "bone_cup", TissueKind.BONE)]
    made = label_anatomy(labels, grid, names=names, frame=Frame.RAS, source="joint").anatomy
    ball, cup = made["bone_ball"].surface, made["bone_cup"].surface
    assert not len(crossings_between(ball, cup))
    gap = nearest_places(cup.vertices, ball).distances
    facing = np.linalg.norm(cup.vertices - 17.7, axis=1) < 12.0
    assert np.median(gap[facing]) == pytest.approx(1.0, abs=0.2 * voxel_mm)
    if voxel_mm == 0.5:
        assert gap.min() > 0.4


def test_one_bad_label_never_refuses_the_rest():
    labels = ball_labels()
    labels[1, 1, 1], labels[3, 3:30, 3:25] = 11, 12
    names = [*NAMES, LabelName(11, "speck", TissueKind.OTHER), LabelName(12, "fascia", TissueKind.OTHER)]
    names.append(LabelName(13, "nothing", TissueKind.MUSCLE))
    made = label_anatomy(labels, GRID, names=names, frame=Frame.RAS, source="balls")
    assert {t.name for t in made.anatomy} == {"muscle_outer", "bone_inner", "skin", "fascia", "speck"}
    fits, off = label_fits(made.anatomy, made, GRID, frame=Frame.RAS)
    said = {finding.code: finding.message for finding in (*made.findings, *off)}
    assert "speck: its surface encloses" in said["off-its-voxels"]
    assert "1 named labels have no voxel: nothing" in said["absent-labels"]
    assert next(fit for fit in fits if fit.name == "fascia").volume_percent == pytest.approx(0.0, abs=1.0)


def test_labels_at_the_border_are_named():
    labels = np.zeros(GRID.shape, dtype=np.uint8)
    labels[:10, :, 5:] = 1
    made = label_anatomy(labels, GRID, names=NAMES[:1], frame=Frame.RAS, source="slab")
    said = next(finding.message for finding in made.findings if finding.code == "cut-by-image")
    assert "first i and first j and last j and last k slice" in said


def test_surfaces_of_a_mirrored_frame_are_not_called_inside_out():
    made = label_anatomy(ball_labels(), GRID, names=NAMES, frame=Frame.LPS, source="balls")
    assert not [finding for finding in made.findings if finding.code == "inside-out"]


def test_what_is_no_segmentation_is_refused():
    scan = np.random.default_rng(0).integers(-1000, 2000, size=GRID.shape)
    with pytest.raises(InputError, match="holds values from -1000 to 1999; labels are 0"):
        label_anatomy(scan, GRID, names=NAMES, frame=Frame.RAS, source="ct")
    numbered = np.arange(GRID.count).reshape(GRID.shape)
    with pytest.raises(InputError, match="holds 43200 different values up to 43199, more than 20000 labels"):
        label_anatomy(numbered, GRID, names=NAMES, frame=Frame.RAS, source="mr")
    with pytest.raises(InputError, match="every voxel is 0"):
        label_anatomy(np.zeros(GRID.shape, dtype=int), GRID, names=NAMES, frame=Frame.RAS, source="none")


def test_unnamed_labels_are_told():
    findings = label_anatomy(ball_labels(), GRID, names=NAMES[:1], frame=Frame.RAS, source="balls").findings
    assert "2 labels without a name were left out: 2, 9" in findings[0].message


def test_errors_name_the_label_and_the_way_out():
    labels = ball_labels()
    with pytest.raises(InputError, match="1 named labels have no voxel: x"):
        label_anatomy(labels, GRID, names=[LabelName(7, "x", TissueKind.OTHER)], frame=Frame.RAS, source="balls")
    with pytest.raises(InputError, match="store it as integers"):
        label_anatomy(labels.astype(float), GRID, names=NAMES, frame=Frame.RAS, source="balls")
    with pytest.raises(InputError, match="two labels have the value 1"):
        label_anatomy(labels, GRID, names=[*NAMES, NAMES[0]], frame=Frame.RAS, source="balls")


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
    cells = label_anatomy(labels, grid, names=names, frame=Frame.RAS, source="cells").anatomy
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


@pytest.mark.parametrize("seed", range(4))
def test_labels_that_fold_into_each_other_share_no_point(seed):
    """Sheets a voxel or two thick and wound into each other, in skin, of voxels that are too coarse for them."""
    rng = np.random.default_rng(seed)
    grid = Grid((30, 28, 26), np.diag([2.0, 2.0, 3.0, 1.0]))
    noise = [gaussian_filter(rng.normal(size=grid.shape), 1.5) for _ in range(4)]
    labels = (np.argmax(noise, axis=0) + 1).astype(np.int16)
    labels[np.linalg.norm(np.indices(grid.shape).T - [15.0, 14.0, 13.0], axis=-1).T > 11.0] = 0
    kinds = (TissueKind.MUSCLE, TissueKind.BONE, TissueKind.OTHER, TissueKind.SKIN)
    names = [LabelName(k, f"fold_{k}", kind) for k, kind in enumerate(kinds, start=1)]
    made = label_anatomy(labels, grid, names=names, frame=Frame.RAS, source="folds")
    surfaces = [tissue.surface for tissue in made.anatomy]
    assert len(surfaces) == 4
    for one, other in combinations(surfaces, 2):
        assert not len(crossings_between(one, other))
    said = next(finding.message for finding in made.findings if finding.code == "drawn-apart")
    assert "drawn back in" in said
    assert "still cross" not in said
    fits, _ = label_fits(made.anatomy, made, grid, frame=Frame.RAS)
    assert all(abs(fit.volume_percent) < 5.0 for fit in fits), fits


def test_labels_of_single_voxels_share_no_point_either():
    """Each voxel one of three labels by chance: whatever is left of them, nothing crosses."""
    labels = np.random.default_rng(5).integers(0, 4, size=(14, 15, 16))
    names = [LabelName(k, f"grain_{k}", TissueKind.OTHER) for k in (1, 2, 3)]
    made = label_anatomy(labels, Grid((14, 15, 16), np.eye(4)), names=names, frame=Frame.RAS, source="grains")
    assert len(made.anatomy) == 3
    for one, other in combinations([tissue.surface for tissue in made.anatomy], 2):
        assert not len(crossings_between(one, other))
