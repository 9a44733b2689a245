"""A small limb: skin around two muscles and a bone."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.geometry.meshes import TriMesh


def _ball(name, kind, *, centre, size):
    ball = trimesh.creation.icosphere(subdivisions=3)
    return Tissue(name, kind, TriMesh(np.asarray(ball.vertices) * size + centre, np.asarray(ball.faces)))


@pytest.fixture
def limb() -> Anatomy:
    return Anatomy(
        (
            _ball("skin", TissueKind.SKIN, centre=(0, 0, 0), size=(45, 30, 100)),
            _ball("biceps", TissueKind.MUSCLE, centre=(20, 0, 0), size=(12, 12, 60)),
            _ball("triceps", TissueKind.MUSCLE, centre=(-20, 0, 0), size=(12, 12, 60)),
            _ball("humerus", TissueKind.BONE, centre=(0, 0, 0), size=(6, 6, 80)),
        ),
        "test, mm",
    )
