"""fTetWild in a process of its own: ``vertices.npy``, ``faces.npy`` of the current folder -> ``filled_*.npy`` there.

Started by `musclefit.meshing.ftetwild` in a temporary folder; imports nothing of musclefit. What fTetWild prints is its
progress; when nobody reads it any more, this process ends.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import pytetwild


def main(arguments: Sequence[str]) -> None:
    """Fill the surface; ``arguments`` are edge length and envelope as fractions, passes, and the energy to stop at."""
    edge_length, envelope, passes, stop_energy = arguments
    sizing = {}
    lengths = np.load("sizing_lengths.npy", allow_pickle=False)
    if len(lengths):
        sizing = {
            "bg_vertices": np.load("sizing_vertices.npy", allow_pickle=False),
            "bg_tets": np.load("sizing_tets.npy", allow_pickle=False),
            "bg_values": lengths,
        }
    vertices, tets = pytetwild.tetrahedralize(
        np.load("vertices.npy", allow_pickle=False),
        np.load("faces.npy", allow_pickle=False),
        edge_length_fac=float.fromhex(edge_length),
        epsilon=float.fromhex(envelope),
        simplify=False,  # well-shaped triangles are mostly Delaunay already; simplified ones cut tets to shreds
        num_opt_iter=int(passes),
        stop_energy=float.fromhex(stop_energy),
        disable_filtering=True,  # its own test of what lies inside now and then drops a tet deep in the mesh
        quiet=False,
        loglevel=6,
        **sizing,
    )
    np.save("filled_vertices.npy", np.asarray(vertices, dtype=np.float64), allow_pickle=False)
    np.save("filled_tets.npy", np.asarray(tets, dtype=np.int64), allow_pickle=False)


if __name__ == "__main__":
    main(sys.argv[1:])
