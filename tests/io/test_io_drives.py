"""A drive from outside: one class, and rig files, jobs, runs and reports know it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from tiny_rigs import write_tiny_rig

import musclefit as mf
from musclefit.anatomy.model import Anatomy
from musclefit.errors import RigError
from musclefit.rig import drive as registry
from musclefit.rig.drive import DRIVES, Drive, Driver, Files, register_drive
from musclefit.rig.handles import Handles, StraightPath
from musclefit.rig.handles import Path as HandlePath
from musclefit.vocabulary import PathKind


@dataclass(frozen=True, slots=True)
class StretchDrive(Drive):
    """The corners of the anatomy's box, moved away from its middle by ``share`` of their distance."""

    kind: ClassVar[str] = "stretch"
    drives: ClassVar[str] = "a stretch drives"

    share: float

    def __post_init__(self) -> None:
        if not -0.5 < self.share < 1.0:
            raise RigError(f"drive.share: found {self.share}; expected a share above -0.5 and below 1")

    def resolved(self, files: Files) -> StretchDrive:  # noqa: ARG002
        return replace(self)

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> Driver:  # noqa: ARG002
        return Stretched(self.share)


@dataclass(frozen=True, eq=False)
class Stretched(Driver):
    share: float
    findings: tuple[()] = ()
    frame: str = ""

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:
        vertices = anatomy.vertices()
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
        target = corners + self.share * (corners - 0.5 * (low + high))
        names = tuple(f"corner_{k}" for k in range(8))
        return Handles(names, corners, ("",) * 8), StraightPath(corners, target)


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    register_drive(StretchDrive)
    yield
    del registry._known["stretch"]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The tiny rig, with its drive replaced."""
    path = write_tiny_rig(tmp_path / "rig")
    text = path.read_text(encoding="utf-8")
    before, _, after = text.partition("[drive]\n")
    rest = after.partition("\n[")
    drive = '[drive]\nkind = "stretch"\nshare = 0.1\n'
    path.write_text(before + drive + ("\n[" + rest[2] if rest[1] else ""), encoding="utf-8")
    return path


def test_a_rig_file_names_it_and_a_run_follows_it(rig: Path) -> None:
    done = mf.run(rig, tets=False, overrides=["limits.muscle_volume_percent=100", "limits.bone_rigidity_mm=10"])
    assert isinstance(done.job.rig.drive, StretchDrive)
    vertices = done.rest.vertices()
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    np.testing.assert_allclose(done.deformation(vertices), vertices + 0.1 * (vertices - middle), atol=1e-9)
    assert done.report.limits_in_words.startswith("for another body, because a stretch drives by a field")


def test_its_keys_are_checked_like_all_others(rig: Path) -> None:
    with pytest.raises(RigError, match=r"drive.share: found 2.0; expected a share above -0.5 and below 1"):
        mf.read_rig(rig, overrides=["drive.share=2.0"])
    with pytest.raises(RigError, match=r"--set drive.shares=1: unknown key .drive.shares.; did you mean .drive.share."):
        mf.read_rig(rig, overrides=["drive.shares=1"])
    with pytest.raises(RigError, match=r"bones.rigid: nothing says how bones move rigidly"):
        mf.read_rig(rig, overrides=["bones.rigid=true", "deformer.method=own"])


def test_kinds_are_unique() -> None:
    @dataclass(frozen=True, slots=True)
    class Other(StretchDrive):
        pass

    with pytest.raises(RigError, match=r"^a drive is of kind 'stretch' already; give this one another"):
        register_drive(Other)
    assert set(DRIVES) == {"landmarks", "joints", "transforms", "cage", "lattice", "skeleton", "opensim", "stretch"}
