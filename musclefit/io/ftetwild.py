"""The tetrahedraliser behind `anatomy.tetrahedra`: runs fTetWild in a process with a temporary current folder.

fTetWild writes a file into the current folder, takes no interrupt and can end the process it runs in; in a process of
its own none of this reaches ours.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy, tetrahedralise_with
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Faces, Points, Tets
from musclefit.progress import Progress, Silent

OPTIMISATION_PASSES = 2
"""Passes of the tetrahedraliser over its mesh; the first does most, each further one costs about a quarter of it."""
STOP_ENERGY = 30.0
"""The tetrahedraliser stops early when no tet has a conformal AMIPS energy above this (3 for a regular tet)."""

_WORKER = Path(__file__).with_name("ftetwild_worker.py")
_UNWATCHED = Silent()


def tetrahedralise(
    anatomy: Anatomy,
    *,
    edge_length_fraction: float = 0.05,
    envelope_fraction: float = 1e-3,
    progress: Progress = _UNWATCHED,
) -> TetAnatomy:
    """Fill all tissues with tetrahedra in one go, by fTetWild; see `anatomy.tetrahedra.tetrahedralise_with`.

    Parameters
    ----------
    anatomy : Anatomy
    edge_length_fraction, envelope_fraction : float in (0, 1]
        Of the bounding box's diagonal.
    progress : Progress

    Raises
    ------
    InputError
        A fraction is out of range.
    MeshError
        fTetWild failed, or no tet lies in a tissue.
    """
    return tetrahedralise_with(
        fill,
        anatomy,
        edge_length_fraction=edge_length_fraction,
        envelope_fraction=envelope_fraction,
        progress=progress,
    )


def fill(
    vertices: Points, faces: Faces, *, edge_length_fraction: float, envelope_fraction: float
) -> tuple[Points, Tets]:
    """Tetrahedra around and inside all surfaces together, by fTetWild in a process of its own.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    faces : (f, 3) int64
    edge_length_fraction, envelope_fraction : float in (0, 1]
        Of the bounding box's diagonal.

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
    settings = (edge_length_fraction.hex(), envelope_fraction.hex(), str(OPTIMISATION_PASSES), STOP_ENERGY.hex())
    with tempfile.TemporaryDirectory(prefix="musclefit-tets-", ignore_cleanup_errors=True) as scratch:
        folder = Path(scratch)
        np.save(folder / "vertices.npy", np.asarray(vertices, dtype=np.float64), allow_pickle=False)
        np.save(folder / "faces.npy", np.asarray(faces, dtype=np.int32), allow_pickle=False)
        ended = subprocess.run(  # kills the process when we are interrupted
            [sys.executable, "-P", str(_WORKER), *settings],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
        if ended.returncode:
            how = _how(ended.returncode, ended.stderr)
            raise MeshError(
                f"the tetrahedraliser failed on {len(faces)} triangles ({how}); choose a larger "
                "tets.edge_length_fraction or tets.envelope_fraction, or run without tetrahedra"
            )
        return (
            np.load(folder / "filled_vertices.npy", allow_pickle=False),
            np.load(folder / "filled_tets.npy", allow_pickle=False),
        )


def _how(code: int, stderr: str) -> str:
    """How a process ended, from its exit code and the last line it wrote."""
    if code == -getattr(signal, "SIGKILL", 0):
        return "it was killed, as happens when memory runs out"
    said = [line.strip() for line in stderr.splitlines() if line.strip()]
    ending = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"{ending}: {said[-1]}" if said else ending
