"""fTetWild in a process of its own: ``vertices.npy`` and ``faces.npy`` of the current folder -> ``filled_*.npy`` there.

Started by `musclefit.io.ftetwild` in a temporary folder; imports nothing of musclefit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pytetwild


def main(arguments: Sequence[str]) -> None:
    """Fill the surface; ``arguments`` are edge length and envelope as fractions, passes, and the energy to stop at."""
    edge_length, envelope, passes, stop_energy = arguments
    vertices, tets = pytetwild.tetrahedralize(
        np.load("vertices.npy", allow_pickle=False),
        np.load("faces.npy", allow_pickle=False),
        edge_length_fac=float.fromhex(edge_length),
        epsilon=float.fromhex(envelope),
        simplify=False,  # well-shaped triangles are mostly Delaunay already; simplified ones cut tets to shreds
        num_opt_iter=int(passes),
        stop_energy=float.fromhex(stop_energy),
        quiet=True,
    )
    np.save("filled_vertices.npy", np.asarray(vertices, dtype=np.float64), allow_pickle=False)
    np.save("filled_tets.npy", np.asarray(tets, dtype=np.int64), allow_pickle=False)


if __name__ == "__main__":
    main(sys.argv[1:])
