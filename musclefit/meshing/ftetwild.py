"""The tetrahedraliser behind `anatomy.tetrahedra`: runs fTetWild in a process with a temporary current folder.

fTetWild writes a file into the current folder, takes no interrupt and can end the process it runs in; in a process of
its own none of this reaches ours.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from musclefit.anatomy.mesh_rules import LayerRules, diagonal_mm
from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy, tetrahedralise_with
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Points, Tets
from musclefit.geometry.tets.sizing import NO_SIZING, SizingField
from musclefit.progress import Progress, Silent, Tick
from musclefit.scratch import scratch_folder
from musclefit.worker_processes import run_worker

OPTIMISATION_PASSES = 2
"""Passes of the tetrahedraliser over its mesh; the first does most, each further one costs about a quarter of it."""
STOP_ENERGY = 30.0
"""The tetrahedraliser stops early when no tet has a conformal AMIPS energy above this (3 for a regular tet)."""

_WORKER = Path(__file__).with_name("worker.py")
_UNWATCHED = Silent()

_INSERTED, _COARSENED, _PASSES = 0.1, 0.4, 0.9
"""Shares of the time that are over when all surfaces are inserted, when short edges are gone, after the last pass."""
_OPERATIONS_PER_PASS = 4


@dataclass(frozen=True, slots=True)
class Estimate:
    """What tetrahedralising is likely to take.

    Parameters
    ----------
    seconds : float
        Of one core.
    memory_mb : float
        At the peak, MB (10⁶ bytes).
    """

    seconds: float
    memory_mb: float

    @property
    def in_words(self) -> str:
        """For people."""
        time = f"{self.seconds / 60.0:.0f} min" if self.seconds >= 90.0 else f"{self.seconds:.0f} s"
        memory = f"{self.memory_mb / 1000.0:.1f} GB" if self.memory_mb >= 1000.0 else f"{self.memory_mb:.0f} MB"
        return f"about {time} of one core and {memory} of memory"


SECONDS_AT_LEAST, SECONDS_PER_TRIANGLE, SECONDS_PER_TET = 1.0, 1.8e-6, 5e-4
"""Seconds of one core: to start, per triangle given to the power of 3/2, and per tet of the edge length aimed at."""
MB_AT_LEAST, MB_PER_TRIANGLE = 120.0, 2.8e-3
"""Peak memory before anything is meshed, and per triangle given, MB."""


def estimate(anatomy: Anatomy, rules: LayerRules) -> Estimate:
    """Time and memory that `tetrahedralise` is likely to take: right within a factor of 3 or so.

    Fitted to runs with 80 to 444,000 triangles on one machine. Edges that single tissues or gaps want shorter take
    longer.
    """
    triangles = sum(len(tissue.surface.faces) for tissue in anatomy)
    edge = rules.edge_length_fraction * diagonal_mm(anatomy)
    tets = 6.0 * math.sqrt(2.0) * float(np.prod(np.ptp(anatomy.vertices(), axis=0))) / edge**3
    return Estimate(
        SECONDS_AT_LEAST + SECONDS_PER_TRIANGLE * triangles**1.5 + SECONDS_PER_TET * tets,
        MB_AT_LEAST + MB_PER_TRIANGLE * triangles,
    )


def tetrahedralise(
    anatomy: Anatomy, rules: LayerRules, *, passes: int = OPTIMISATION_PASSES, progress: Progress = _UNWATCHED
) -> TetAnatomy:
    """Fill all tissues with tetrahedra in one go, by fTetWild; see `anatomy.tetrahedra.tetrahedralise_with`.

    Parameters
    ----------
    anatomy : Anatomy
    rules : LayerRules
    passes : int
        Over the mesh, at least 1.
    progress : Progress

    Returns
    -------
    TetAnatomy
        Right-handed tetrahedra in mm, each with its tissue.

    Raises
    ------
    InputError
        A rule is out of range or names no tissue.
    MeshError
        fTetWild failed, or no tet lies in a tissue.
    """
    return tetrahedralise_with(partial(fill, passes=passes), anatomy, rules=rules, progress=progress)


def fill(
    vertices: Points,
    faces: Faces,
    *,
    edge_length_fraction: float,
    envelope_fraction: float,
    sizing: SizingField = NO_SIZING,
    passes: int = OPTIMISATION_PASSES,
    tick: Tick = lambda _: None,
) -> tuple[Points, Tets]:
    """Tetrahedra around and inside all surfaces together, by fTetWild in a process of its own.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64
    edge_length_fraction, envelope_fraction : float in (0, 1]
        Of the bounding box's diagonal.
    sizing : SizingField
        Where edges shall be shorter.
    passes : int
        Over the mesh, at least 1.
    tick : function of a fraction
        Told how far it is, by fTetWild's own words.

    Returns
    -------
    vertices : (m, 3) float64, mm
    tets : (k, 4) int64
        All of one orientation, either one.

    Raises
    ------
    MeshError
        The process failed; the message tells how it ended.

    References
    ----------
    Y. Hu et al., Fast tetrahedral meshing in the wild, ACM Trans. Graph. 39 (2020) 117.
    """
    settings = (edge_length_fraction.hex(), envelope_fraction.hex(), str(passes), STOP_ENERGY.hex())
    with scratch_folder("musclefit-meshing-") as folder:
        for name, array, kind in (
            ("vertices", vertices, np.float64),
            ("faces", faces, np.int32),
            ("sizing_vertices", sizing.vertices, np.float64),
            ("sizing_tets", sizing.tets, np.int32),
            ("sizing_lengths", sizing.lengths, np.float64),
        ):
            np.save(folder / f"{name}.npy", np.asarray(array, dtype=kind), allow_pickle=False)
        done = partial(fractions_done, passes=passes)
        code, said = run_worker(_WORKER, settings, folder=folder, fractions=done, tick=tick)
        if code:
            raise MeshError(
                f"the tetrahedraliser failed on {len(faces)} triangles ({_how(code, said)}); choose a larger "
                "tets.edge_length_fraction or tets.envelope_fraction, or run without tetrahedra"
            )
        return (
            np.load(folder / "filled_vertices.npy", allow_pickle=False),
            np.load(folder / "filled_tets.npy", allow_pickle=False),
        )


def fractions_done(lines: Iterable[str], *, passes: int = OPTIMISATION_PASSES) -> Iterable[float]:
    """How far fTetWild is, 0 to 1 and never falling, from what it prints in so many passes."""
    done, operations = 0.0, 0
    for line in lines:
        if line.startswith("initializing"):
            done = _INSERTED
        elif line.rstrip().endswith("done!"):
            if operations == 0:
                done = _COARSENED
            else:
                of_all = min(1.0, operations / (_OPERATIONS_PER_PASS * passes))
                done = max(done, _COARSENED + (_PASSES - _COARSENED) * of_all)
            operations += 1
        elif "postprocessing" in line:
            done = _PASSES
        else:
            continue
        yield done


def _how(code: int, stderr: str) -> str:
    """How a process ended, from its exit code and the last line it wrote."""
    if code == -getattr(signal, "SIGKILL", 0):
        return "it was killed, as happens when memory runs out"
    said = [line.strip() for line in stderr.splitlines() if line.strip()]
    ending = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"{ending}: {said[-1]}" if said else ending
