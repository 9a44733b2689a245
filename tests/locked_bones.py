"""Random bones, their motions and the field that is locked to them: what attacks on locks and on proofs share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from musclefit.fields.corrected import CorrectedField
from musclefit.fields.locked import Fade, LockedField
from musclefit.fields.radial import RadialBackend
from musclefit.fields.solenoidal import PotentialLevel, SolenoidalField
from musclefit.flow.locks import BoneLocks, LockSettings, Stand
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion


def some_bone(rng: np.random.Generator) -> TriMesh:
    """A ball, a long bone, a plate or a ring; smooth or rough, of few triangles or many; 4 to 30 mm."""
    size = rng.uniform(4.0, 15.0)
    kind = rng.integers(4)
    if kind == 3:
        mesh = trimesh.creation.torus(size, rng.uniform(0.15, 0.4) * size, major_sections=24, minor_sections=12)
    else:
        mesh = trimesh.creation.icosphere(int(rng.integers(1, 4)))
        mesh.apply_scale(size * (np.ones(3), np.array([0.4, 0.5, 2.0]), np.array([1.0, 1.2, 0.2]))[kind])
    vertices = np.array(mesh.vertices)
    rough = rng.choice([0.0, 0.01, 0.04]) * size
    vertices += rng.normal(0.0, rough, vertices.shape) if rough else 0.0
    turn = RigidMotion.about_axis(centre=np.zeros(3), axis=rng.normal(size=3), angle_deg=rng.uniform(0.0, 180.0))
    return TriMesh(turn(vertices), np.array(mesh.faces))


def placed(rng: np.random.Generator, count: int) -> list[TriMesh]:
    """Bones side by side, from sharing space to a centimetre apart."""
    bones = [some_bone(rng)]
    while len(bones) < count:
        bone, direction = some_bone(rng), rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        there = max(float((b.vertices @ direction).max()) for b in bones)
        shift = there - float((bone.vertices @ direction).min()) + rng.uniform(-1.0, 10.0)
        bones.append(bone.with_vertices(bone.vertices + shift * direction))
    return bones


class LockedBones:
    """One step of random bones, each locked to a motion of its own."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng([77, seed])
        self.bones = placed(rng, int(rng.integers(1, 4)))
        spacing = rng.uniform(0.3, 1.2)
        self.settings = [
            LockSettings(spacing, Fade(rng.uniform(1.0, 5.0) * spacing, rng.uniform(1.0, 6.0) * spacing))
            for _ in self.bones
        ]
        everything = np.concatenate([b.vertices for b in self.bones])
        middle = everything.mean(axis=0)
        strength = rng.choice([0.2, 1.0, 3.0])
        self.motions = [
            RigidMotion.about_axis(
                centre=middle + rng.normal(0.0, 10.0, 3),
                axis=rng.normal(size=3),
                angle_deg=strength * rng.uniform(-4, 4),
            )
            for _ in self.bones
        ]
        at = np.concatenate([b.vertices[:: max(1, len(b.vertices) // 20)] for b in self.bones])
        owners = [b.vertices[:: max(1, len(b.vertices) // 20)] for b in self.bones]
        to = np.concatenate([m(part) for m, part in zip(self.motions, owners, strict=True)])
        base = RadialBackend("isochoric-r3", smoothing=1e-3).fit(0.5 * (at + to), to - at)
        if rng.random() < 0.5:
            levels = [PotentialLevel.around(everything, spacing_mm=h) for h in (8.0, 4.0)]
            local = SolenoidalField(
                tuple(replace(v, coefficients=0.05 * strength * rng.normal(size=v.coefficients.shape)) for v in levels)
            )
            base = CorrectedField(base, local)
        still = [Stand.of(RigidMotion.identity())] * len(self.bones)
        locks = BoneLocks.around(self.bones, self.settings)
        self.field = LockedField(base, locks.of_step(still, [Stand.of(m) for m in self.motions]))
        self.everything = everything
