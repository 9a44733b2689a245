"""Rigs driven by a lattice's control points: files read strictly, the paper's loop, and handles for any backend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_rigs import write_tiny_rig

from musclefit.errors import InputError
from musclefit.fields.ffd import Lattice
from musclefit.io.formats.control_points import read_displacements
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform, deform_in_one_shot
from musclefit.pipeline.retarget import retarget
from musclefit.progress import Silent
from musclefit.rig.lattice import ControlLattice
from musclefit.vocabulary import Unit

LOW, HIGH, SHAPE = np.array([-70.0, -40.0, -40.0]), np.array([70.0, 40.0, 40.0]), (8, 5, 5)


def lattice_rig(folder: Path, *, lift_mm: float = 0.0, push_mm: float = 0.0) -> Path:
    """The tiny limb with the lattice's far end lifted, or pushed into the near one."""
    rig = write_tiny_rig(folder)
    ends = [(i, j, k) for i in (4, 5, 6, 7) for j in range(5) for k in range(5)]
    rows = [f"{i},{j},{k},{-push_mm},{lift_mm * (i - 3) / 2.0},0\n" for i, j, k in ends]
    (folder / "moved.csv").write_text("i,j,k,dx_mm,dy_mm,dz_mm\n" + "".join(rows))
    text = rig.read_text()
    start, end = text.index("[drive]"), text.index("[certificate]")
    drive = (
        f'[drive]\nkind = "lattice"\ndisplacements = "moved.csv"\nlow_mm = {LOW.tolist()}\nhigh_mm = {HIGH.tolist()}\n'
        f'shape = {list(SHAPE)}\n[deformer]\nbackend = "lattice"\n'
    )
    rig.write_text(text[:start] + drive + text[end:])
    return rig


def test_control_points_drive_as_in_the_paper(tmp_path):
    """The loop ends where the one-shot deformation does, control points where their splines take them; certified."""
    run = retarget(read_rig(lattice_rig(tmp_path / "rig", lift_mm=5.0)), tets=None)
    side = run.result.side
    assert side.status == "converged"
    assert side.landmarks.count == 200
    assert side.landmarks.max_error_mm < 1e-9
    assert side.map.claim.value == "certified"
    assert side.method.startswith("iterative FFD by its own control points (Yu et al. 2014)")
    points = run.job.anatomy.vertices()
    np.testing.assert_allclose(run.result.deformation(points), run.baseline.deformation(points), rtol=0, atol=1e-9)


def test_a_lattice_that_folds_is_fitted_anew_by_another_backend(tmp_path):
    """The paper's loop stalls where its one shot folds; the same control points as handles arrive.

    By 28 mm the space between two layers 20 mm apart gets a slope of -28 * 3/4 / 20 < -1, though the layers keep order.
    """
    folding = lattice_rig(tmp_path / "rig", push_mm=28.0)
    job = read_rig(folding)
    points = job.anatomy.vertices()
    assert deform(job, points, progress=Silent()).deformation.status.name == "STALLED"
    assert np.linalg.det(deform_in_one_shot(job, points).jacobian(points)).min() < 0.0
    anew = read_rig(folding, overrides=("deformer.backend=rbf", "deformer.kernel=r"))
    found = deform(anew, points, progress=Silent()).deformation
    assert found.status.name == "CONVERGED"
    np.testing.assert_allclose(found(anew.handles.source), anew.path.position(1.0), rtol=0, atol=1e-7)


def test_arrivals_are_where_the_splines_take_the_control_points():
    rng = np.random.default_rng(0)
    drive = ControlLattice(LOW, HIGH, SHAPE, rng.normal(size=(200, 3)))
    field = Lattice.around(LOW, HIGH, shape=SHAPE).field(drive.displacements)
    np.testing.assert_allclose(
        drive.arrivals(), drive.points() + field.displacement(drive.points()), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("i,j,k,dx,dy,dz\n1,1,1,1,0\n", "line 2 has 5 values for 6 columns"),
        ("i,j,k,dx,dy\n1,1,1,1,0\n", "no column dz"),
        ("i,j,k,dx,dy,dz\n8,1,1,1,0,0\n", r"line 2 moves control point \[8.0, 1.0, 1.0\]; the lattice has"),
        ("i,j,k,dx,dy,dz\n0.5,1,1,1,0,0\n", "whole numbers from 0 to"),
        ("i,j,k,dx,dy,dz\n1,1,1,1,0,0\n1,1,1,2,0,0\n", "line 3 moves control point .* again"),
        ("i,j,k,dx,dy,dz\n1,1,1,x,0,0\n", "line 2"),
        ("", "moves no control point"),
    ],
)
def test_files_of_control_points_are_read_strictly(tmp_path, text, message):
    path = tmp_path / "moved.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_displacements(path, shape=SHAPE, units=Unit.CENTIMETRE)


def test_units_and_points_left_out(tmp_path):
    path = tmp_path / "moved.csv"
    path.write_text("i;j;k;dx;dy;dz\n7;4;4;1;0;-2\n")
    moved = read_displacements(path, shape=SHAPE, units=Unit.CENTIMETRE)
    np.testing.assert_array_equal(moved[-1], [10.0, 0.0, -20.0])
    assert not moved[:-1].any()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("drive.shape=[8, 5]", "expected 3 numbers"),
        ("drive.shape=[8, 5.0, 5]", "expected a list of whole numbers"),
        ("drive.shape=[1, 5, 5]", "expected at least 2 control points along every axis"),
        ("drive.shape=[99999, 99999, 99999]", "at most 1000000 together"),
        ("drive.high_mm=[-80, 40, 40]", r"drive: drive.high_mm: found \[-80.0, 40.0, 40.0\]"),
        ("deformer.step=cayley", "control points' own loop"),
        ("deformer.kernel=r3", 'has no effect on backend "lattice"'),
    ],
)
def test_rigs_of_lattices_are_checked(tmp_path, override, message):
    with pytest.raises(InputError, match=message):
        read_rig(lattice_rig(tmp_path / "rig", lift_mm=5.0), overrides=(override,))


def test_only_a_lattice_has_a_loop_of_its_own(tmp_path):
    with pytest.raises(InputError, match="control points' own loop"):
        read_rig(write_tiny_rig(tmp_path / "rig"), overrides=("deformer.backend=lattice",))
