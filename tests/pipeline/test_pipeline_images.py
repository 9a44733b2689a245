"""Warped volumes: exact inverses, SimpleITK's answer to the same question, frames that never mix, labels kept whole."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import InputError
from musclefit.fields.fitting.ffd import FfdBackend
from musclefit.fields.radial import RadialBackend
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.inverses import origins
from musclefit.flow.steps import CayleyStep, ExplicitStep
from musclefit.geometry.images.grids import Frame, Grid, Interpolation, in_frame
from musclefit.geometry.images.sampling import prefiltered, sample
from musclefit.io.formats.nifti import read_volume, write_displacements, write_volume
from musclefit.pipeline.images import forward_displacements, inverse_displacements, jacobian_map, warp_image

sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed (extra examples)")

AFFINE = np.array([[-2.0, 0.1, 0.0, 30.0], [0.1, 1.8, 0.3, -40.0], [0.0, -0.2, 2.5, -25.0], [0.0, 0.0, 0.0, 1.0]])
"""Oblique, with the first axis running left, voxels of different lengths."""
TURN = np.linalg.qr(AFFINE[:3, :3])[0]
OBLIQUE = np.eye(4)
OBLIQUE[:3, :3] = TURN * np.sign(np.diag(TURN.T @ AFFINE[:3, :3])) * [2.0, 1.8, 2.5]
OBLIQUE[:3, 3] = AFFINE[:3, 3]
GRID = Grid((31, 40, 22), OBLIQUE)
RNG = np.random.default_rng(0)
IMAGE = RNG.normal(size=GRID.shape).astype(np.float32)


def deformation(kind: str) -> Deformation:
    rng = np.random.default_rng(1)
    corner, far = GRID.positions(np.array([[0.0, 0.0, 0.0], [30.0, 39.0, 21.0]]))
    at = rng.uniform(np.minimum(corner, far), np.maximum(corner, far), (20, 3))
    moved = rng.normal(scale=1.5, size=(20, 3))
    backend = FfdBackend(20.0) if kind == "ffd" else RadialBackend("r3")
    first = backend.fit(at, moved)
    second = backend.fit(at + moved, -0.6 * moved[:, [1, 2, 0]])
    make = CayleyStep if kind == "cayley" else ExplicitStep
    return Deformation((make(first), make(second)), (), Status.CONVERGED)


MAPS = {kind: deformation(kind) for kind in ("rbf", "ffd", "cayley")}
each_map = pytest.mark.parametrize("kind", MAPS)


def as_sitk(values: np.ndarray, grid: Grid):
    """The same image with ITK's origin, spacing and direction, all LPS+."""
    flip = np.diag([-1.0, -1.0, 1.0])
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.swapaxes(0, 2)), isVector=values.ndim == 4)
    image.SetOrigin((flip @ grid.affine[:3, 3]).tolist())
    image.SetSpacing(grid.spacing.tolist())
    image.SetDirection((flip @ grid.affine[:3, :3] / grid.spacing).ravel().tolist())
    return image


@each_map
def test_every_voxel_comes_from_where_the_map_takes_it_back(kind):
    vectors, unsolved = inverse_displacements(MAPS[kind], GRID, frame=Frame.RAS)
    here = GRID.positions(GRID.voxels(0, GRID.count))
    back = MAPS[kind](here + vectors.reshape(-1, 3).astype(np.float64))
    assert unsolved == 0
    np.testing.assert_allclose(back, here, rtol=0, atol=2e-6)  # the vectors are float32


@each_map
@pytest.mark.parametrize(
    ("interpolation", "theirs"),
    [(Interpolation.LINEAR, sitk.sitkLinear), (Interpolation.CUBIC, sitk.sitkBSpline)],
)
def test_a_warped_image_is_what_simpleitk_makes_with_our_displacements(kind, interpolation, theirs):
    vectors, _ = inverse_displacements(MAPS[kind], GRID, frame=Frame.RAS)
    lps = in_frame(vectors.reshape(-1, 3), of=Frame.RAS, to=Frame.LPS).reshape(vectors.shape).astype(np.float64)
    transform = sitk.DisplacementFieldTransform(as_sitk(lps, GRID))
    image = as_sitk(IMAGE, GRID)
    expected = sitk.GetArrayFromImage(sitk.Resample(image, image, transform, theirs, -9.0)).swapaxes(0, 2)
    ours = warp_image(
        IMAGE,
        GRID,
        deformation=MAPS[kind],
        frame=Frame.RAS,
        onto=GRID,
        interpolation=interpolation,
        outside=-9.0,
    )
    differ = np.abs(ours.values - expected) > 1e-4
    assert differ.mean() < 2e-4  # voxels within rounding of the image's edge are in for one and out for the other
    assert (ours.values != -9.0).mean() > 0.5


def test_a_written_field_moves_points_in_simpleitk_as_ours_does(tmp_path):
    write_displacements(
        tmp_path / "field.nii.gz",
        forward_displacements(MAPS["ffd"], GRID, frame=Frame.RAS),
        GRID,
        description="moves points",
    )
    field = sitk.ReadImage(str(tmp_path / "field.nii.gz"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    points = GRID.positions(np.array([[3.0, 4.0, 5.0], [20.0, 30.0, 11.0], [15.0, 8.0, 17.0]]))
    theirs = [transform.TransformPoint(p.tolist()) for p in in_frame(points, of=Frame.RAS, to=Frame.LPS)]
    np.testing.assert_allclose(
        in_frame(np.array(theirs), of=Frame.LPS, to=Frame.RAS), MAPS["ffd"](points), rtol=0, atol=1e-5
    )


def test_simpleitk_sees_our_voxels_where_they_are(tmp_path):
    write_volume(tmp_path / "image.nii.gz", IMAGE, GRID, description="noise")
    image = sitk.ReadImage(str(tmp_path / "image.nii.gz"))
    place = in_frame(GRID.positions(np.array([[3.0, 4.0, 5.0]])), of=Frame.RAS, to=Frame.LPS)[0]
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((3, 4, 5)), place, rtol=0, atol=1e-4)
    assert image.GetPixel(3, 4, 5) == IMAGE[3, 4, 5]
    back = read_volume(tmp_path / "image.nii.gz")
    np.testing.assert_array_equal(back.values, IMAGE)
    np.testing.assert_allclose(back.grid.affine, GRID.affine, rtol=0, atol=1e-5)


def test_a_map_in_lps_gives_the_same_image_as_its_twin_in_ras():
    ras = MAPS["ffd"]
    field = ras.steps[0].field
    rng = np.random.default_rng(1)
    at = rng.uniform(-20.0, 20.0, (15, 3))
    moved = rng.normal(size=(15, 3))
    backend = RadialBackend("r3")
    twins = {
        frame: Deformation(
            (ExplicitStep(backend.fit(in_frame(at, of=Frame.RAS, to=frame), in_frame(moved, of=Frame.RAS, to=frame))),),
            (),
            Status.CONVERGED,
        )
        for frame in Frame
    }
    images = [
        warp_image(
            IMAGE,
            GRID,
            deformation=twins[frame],
            frame=frame,
            onto=GRID,
            interpolation=Interpolation.LINEAR,
            outside=0.0,
        ).values
        for frame in Frame
    ]
    np.testing.assert_allclose(images[0], images[1], rtol=0, atol=1e-3)
    assert field is not None


def test_labels_stay_labels():
    labels = (RNG.integers(0, 3, GRID.shape) * 1000).astype(np.int16)
    warped = warp_image(
        labels,
        GRID,
        deformation=MAPS["rbf"],
        frame=Frame.RAS,
        onto=GRID,
        interpolation=Interpolation.NEAREST,
        outside=-1,
    )
    assert warped.values.dtype == np.int16
    assert set(np.unique(warped.values)) <= {-1, 0, 1000, 2000}


def test_nothing_moved_gives_the_image_back():
    still = Deformation((), (), Status.CONVERGED)
    for interpolation in Interpolation:
        warped = warp_image(
            IMAGE, GRID, deformation=still, frame=Frame.LPS, onto=GRID, interpolation=interpolation, outside=0.0
        )
        np.testing.assert_allclose(warped.values, IMAGE, rtol=0, atol=1e-5)


@each_map
def test_a_jacobian_map_is_the_volume_that_voxels_take(kind):
    found = jacobian_map(MAPS[kind], GRID, frame=Frame.RAS)
    here = GRID.positions(np.array([[10.0, 12.0, 8.0]]))
    assert found[10, 12, 8] == pytest.approx(np.linalg.det(MAPS[kind].jacobian(here))[0], rel=1e-5)


def test_written_jacobian_maps_are_simpleitks_of_the_written_field(tmp_path):
    """Central differences of the field over 2 voxels, on a grid along ITK's axes, inside its border."""
    affine = np.diag([-1.0, -1.0, 1.0, 1.0])
    affine[:3, 3] = [18.0, -10.0, -12.0]
    grid = Grid((30, 32, 26), affine)
    write_displacements(
        tmp_path / "field.nii.gz", forward_displacements(MAPS["rbf"], grid, frame=Frame.RAS), grid, description=""
    )
    write_volume(tmp_path / "det.nii.gz", jacobian_map(MAPS["rbf"], grid, frame=Frame.RAS), grid, description="")
    field = sitk.ReadImage(str(tmp_path / "field.nii.gz"), sitk.sitkVectorFloat64)
    theirs = sitk.GetArrayFromImage(sitk.DisplacementFieldJacobianDeterminant(field))
    ours = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "det.nii.gz")))
    inside = (slice(1, -1),) * 3
    assert np.ptp(ours[inside]) > 0.2
    np.testing.assert_allclose(theirs[inside], ours[inside], rtol=0, atol=0.02)


def test_a_folded_map_says_which_voxels_it_cannot_solve():
    """x -> x + 8 sin(x / 4) has places that nothing else but a fold reaches; they are counted, not guessed."""
    at = np.array([[-20.0, 0, 0], [-5.0, 0, 0], [5.0, 0, 0], [20.0, 0, 0], [0, 20.0, 0], [0, -20.0, 0], [0, 0, 20.0]])
    moved = np.zeros((7, 3))
    moved[1, 0], moved[2, 0] = 30.0, -30.0
    folded = Deformation((ExplicitStep(RadialBackend("gaussian", scale=8.0).fit(at, moved)),), (), Status.ONE_SHOT)
    targets = np.random.default_rng(3).uniform(-20.0, 20.0, (500, 3))
    found = origins(folded, targets, tolerance_mm=1e-6)
    error = np.abs(folded(found.points) - targets).max(axis=1)
    assert (error[found.found] <= 1e-6).all()
    assert found.found.mean() > 0.5


@pytest.mark.parametrize("interpolation", list(Interpolation))
def test_half_a_voxel_beyond_the_edge_belongs_to_the_image(interpolation):
    source = prefiltered(IMAGE, interpolation)
    inside = np.array([[-0.49, 0.0, 0.0], [30.49, 39.0, 21.0]])
    outside = np.array([[-0.51, 0.0, 0.0], [30.51, 39.0, 21.0]])
    out = np.empty(2, dtype=np.float32)
    sample(source, outside, interpolation=interpolation, outside=-5.0, out=out)
    np.testing.assert_array_equal(out, -5.0)
    sample(source, inside, interpolation=interpolation, outside=-5.0, out=out)
    assert (out != -5.0).all()


def test_errors_name_the_file_and_the_way_out(tmp_path):
    with pytest.raises(InputError, match="give one value for each voxel"):
        warp_image(
            IMAGE[1:],
            GRID,
            deformation=MAPS["rbf"],
            frame=Frame.RAS,
            onto=GRID,
            interpolation=Interpolation.LINEAR,
            outside=0.0,
        )
    with pytest.raises(InputError, match="no such image"):
        read_volume(tmp_path / "none.nii.gz")
    with pytest.raises(InputError, match=r"read and written as \.nii"):
        read_volume(tmp_path / "none.mha")
    (tmp_path / "text.nii.gz").write_text("no image")
    with pytest.raises(InputError, match="cannot be read as NIfTI"):
        read_volume(tmp_path / "text.nii.gz")
    with pytest.raises(InputError, match="displacements are not finite"):
        write_displacements(tmp_path / "d.nii", np.full((*GRID.shape, 3), np.nan), GRID, description="")
    with pytest.raises(InputError, match="voxels have no volume"):
        Grid((2, 2, 2), np.diag([1.0, 1.0, 0.0, 1.0]))
