"""Compiles what rigid bones need in a process of its own, while the first run reads its anatomy and marches.

The loops of proofs are half of what a first run compiles, and are needed last. What one process compiles others find
(`musclefit.compiling`): the process beside marches and proves something small, a bone that turns in a ball.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numba
import numpy as np
import trimesh
from numba.core.codegen import get_host_cpu_features

from musclefit.certify.maps import certify_map
from musclefit.certify.model import MapCertificate
from musclefit.compiling import compiled_folder, source_stamp
from musclefit.errors import InputError
from musclefit.fields.corrected import CorrectedField
from musclefit.fields.fitting.solenoidal import SolenoidalBackend
from musclefit.fields.locked import Fade, LockedField
from musclefit.fields.radial import RadialBackend
from musclefit.flow.locks import BoneLocks, LockSettings, Stand
from musclefit.flow.steps import CayleyStep
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.io.folder_locks import held
from musclefit.rig.job import Job
from musclefit.vocabulary import StepKind

MODULE = "musclefit.workflows.compiling_ahead"
"""Run by the process beside."""

ENDED_WITHIN_S = 10.0
"""So long it is waited for after it was told to end."""


@contextmanager
def compiled_ahead(job: Job) -> Iterator[None]:
    """Have the loops of a proof compiled meanwhile, where the job will need them and nobody compiled them before.

    Not on a machine of one processor, where it would gain nothing. The process is ended with the context; what it
    compiled up to then stays.
    """
    bones, processors = job.rig.bones, getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    needed = bones.rigid and job.rig.certificate.enabled and len(processors) > 1
    if not needed or _mark().exists():
        yield
        return
    nothing = subprocess.DEVNULL
    process = subprocess.Popen([sys.executable, "-m", MODULE], stdin=nothing, stdout=nothing, stderr=nothing)
    try:
        yield
    finally:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(ENDED_WITHIN_S)


def small_march_and_proof() -> tuple[MapCertificate, MapCertificate]:
    """A step with a bone locked to its motion, fitted, tried and proved, and one of the paper's loop, proved.

    What a first run needs first is compiled first.
    """
    bone, skin = _ball(6.0), _ball(20.0)
    turn = RigidMotion.about_axis(centre=np.zeros(3), axis=np.array([0.0, 0.0, 1.0]), angle_deg=1.0)
    at = bone.vertices[::8]
    base = RadialBackend("isochoric-r3").fit(at, turn(at) - at)
    bend = 0.1 * np.sin(bone.vertices[:, [1, 2, 0]])  # so that the lattices count in the proof
    backend, no_normals = SolenoidalBackend(1e-3), np.zeros((0, 3))
    lattices = backend.at_rest([(h, bone.vertices) for h in (4.0, 2.0)]).levels
    local = backend.fit(bone.vertices, bend, slip_normals=no_normals, on=lattices, iterations=5)
    locks = BoneLocks.around([bone], [LockSettings(1.0, Fade(3.0, 4.0))])
    still, turned = Stand.of(RigidMotion.identity()), Stand.of(turn)
    field = LockedField(CorrectedField.of(base, local), locks.of_step([still], [turned]))
    CayleyStep(field).trial(skin.vertices)
    loop = RadialBackend("r2logr").fit(at, turn(at) - at)
    locked = certify_map([(StepKind.CAYLEY, field)], skin, tissues=[bone], points=no_normals)
    return locked, certify_map([(StepKind.EXPLICIT, loop)], skin, tissues=[bone], points=no_normals)


def _ball(radius_mm: float) -> TriMesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius_mm)
    return TriMesh(np.array(ball.vertices), np.array(ball.faces))


def _mark() -> Path:
    """Is there once the loops are: named by the sources, the compiler and the processor that they were made for."""
    made_of = (source_stamp(Path(__file__).resolve()), numba.__version__, get_host_cpu_features())
    return compiled_folder() / f"ahead-{hashlib.sha256('|'.join(map(str, made_of)).encode()).hexdigest()[:16]}"


def compile_ahead() -> None:
    """Compile, and leave the mark; nothing where another process is at it already."""
    with suppress(InputError), held(_mark()):
        small_march_and_proof()
        _mark().touch()


if __name__ == "__main__":
    compile_ahead()
