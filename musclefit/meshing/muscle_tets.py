"""Each muscle's own tetrahedra, with an envelope sized to it, so that thin tendons stay whole; knows no fibre.

In the mesh of all tissues one envelope serves bones and tendons alike, and tendons thinner than it are cut.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.mesh_fidelity import piece_of_tet
from musclefit.anatomy.mesh_rules import LayerRules, diagonal_mm
from musclefit.anatomy.model import Anatomy, Tissue
from musclefit.errors import MeshError
from musclefit.geometry.arrays import Int, Points
from musclefit.geometry.measures import enclosed_volume, signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.surfaces.booleans import with_balls
from musclefit.geometry.surfaces.sections import Sections
from musclefit.geometry.tets.topology import tet_faces
from musclefit.meshing.cache import TetCache
from musclefit.progress import Progress

ENVELOPE_SHARE = 0.02
"""The envelope, over the side of a square as large as a muscle's thin sections (the lowest tenth of them)."""

EDGE_SHARE = 1.0
"""The edge length aimed at, over the side of a square as large as a muscle's median section."""

ENVELOPE_FRACTION = 7e-4
"""The envelope at most, of the muscle's diagonal: that of the mesh of all tissues (`rig.settings.TetSettings`)."""

ENVELOPES_TRIED = (1.0, 0.25)
"""In the first envelope; the next is tried where a mesh falls apart or misses an end. Half of it missed the ends
again in four of nine muscles of a real forearm."""

NECK_ENVELOPES = 6.0
"""Where pieces of a mesh share a corner or an edge and no face, the surface has a neck that is too thin for any
envelope (0.005 mm in two muscles of a real forearm). Balls with a radius of so many first envelopes are put there
before the mesh is made again; one envelope's was not enough where a neck widens slowly."""

PASSES = 1
"""Of the tetrahedraliser: a second one takes half as long again, and changes fibres no more than making the same mesh
anew does."""

MISSED_ENVELOPES = 3.0
"""A mesh misses a place of the surface that is farther from it than so many times the first envelope."""


@dataclass(frozen=True, eq=False, slots=True)
class MuscleTets:
    """The tetrahedra of one muscle.

    Parameters
    ----------
    name : str
    mesh : TetMesh
    envelope_mm, first_envelope_mm : float
        That of the mesh, and the one that was tried first.
    pieces, surface_pieces : int
        Of the tetrahedra, joined by faces, and of the surface.
    loose_share : float
        Share of the volume that is in pieces beside the largest.
    missed_mm : float
        How far a place of the surface is from the tetrahedra's, at most.
    volume_share : float
        Volume of the tetrahedra over that of the surface.
    widened_mm3 : float
        What was added to the surface where it has necks that are too thin for any envelope.
    """

    name: str
    mesh: TetMesh
    envelope_mm: float
    first_envelope_mm: float
    pieces: int
    surface_pieces: int
    loose_share: float
    missed_mm: float
    volume_share: float
    widened_mm3: float

    @property
    def whole(self) -> bool:
        """Whether it is in no more pieces than its surface, and none of its ends is missing."""
        return self.pieces <= self.surface_pieces and self.missed_mm <= MISSED_ENVELOPES * self.first_envelope_mm


def muscle_tets(muscle: Tissue, cache: TetCache, *, sections: Sections, progress: Progress) -> MuscleTets:
    """Fill one muscle by itself; of several tries the first that is whole, or else the last.

    Parameters
    ----------
    muscle : Tissue
    cache : TetCache
    sections : Sections
        The muscle's.
    progress : Progress

    Raises
    ------
    MeshError
        The surface has no area, or the tetrahedraliser failed.
    """
    diagonal = diagonal_mm(Anatomy((muscle,), "alone"))
    edge, envelope = sizes_mm(muscle.surface, sections, diagonal_mm=diagonal)
    cache = replace(cache, passes=PASSES)
    pinched: Points = np.zeros((0, 3))
    for share in ENVELOPES_TRIED:
        narrower = share * envelope
        surface = with_wider_necks(muscle.surface, pinched, radius_mm=NECK_ENVELOPES * envelope)
        alone = Anatomy((replace(muscle, surface=surface),), "alone")
        found, _ = cache.tetrahedralise(alone, LayerRules(edge / diagonal, narrower / diagonal), progress=progress)
        fit = found.fits[0]
        piece = piece_of_tet(tet_faces(found.mesh.tets), inside=np.ones(len(found.mesh.tets), dtype=bool))
        made = MuscleTets(
            name=muscle.name,
            mesh=found.mesh,
            envelope_mm=narrower,
            first_envelope_mm=envelope,
            pieces=fit.pieces or 0,
            surface_pieces=fit.surface_pieces or 1,
            loose_share=loose_share(found.mesh, piece),
            missed_mm=math.inf if fit.missed_mm is None else fit.missed_mm,
            volume_share=fit.volume_mm3 / (fit.surface_mm3 or math.nan),
            widened_mm3=enclosed_volume(surface) - enclosed_volume(muscle.surface) if len(pinched) else 0.0,
        )
        if made.whole:
            break
        pinched = shared_vertices(found.mesh, piece)
    return made


def with_wider_necks(surface: TriMesh, places: Points, *, radius_mm: float) -> TriMesh:
    """The surface with balls at (n, 3) places, mm; as it was where there are none, or it does not bound a solid."""
    if not len(places):
        return surface
    try:
        return with_balls(surface, places, radius_mm=radius_mm)
    except MeshError:  # the narrower envelope has to do; what stays in pieces is named
        return surface


def shared_vertices(mesh: TetMesh, piece: Int) -> Points:
    """(n, 3) vertices that tetrahedra of different pieces have in common, mm; ``piece`` (k,) numbers the pieces."""
    lowest, highest = np.full(len(mesh.vertices), len(piece)), np.full(len(mesh.vertices), -1)
    np.minimum.at(lowest, mesh.tets, piece[:, None])
    np.maximum.at(highest, mesh.tets, piece[:, None])
    return mesh.vertices[lowest < highest]


def loose_share(mesh: TetMesh, piece: Int) -> float:
    """Share of a mesh's volume that faces do not join to its largest piece; ``piece`` (k,) numbers the pieces."""
    volumes = np.bincount(piece, signed_volumes(mesh.vertices, mesh.tets))
    return float(1.0 - volumes.max() / volumes.sum()) if len(volumes) > 1 else 0.0


def sizes_mm(surface: TriMesh, sections: Sections, *, diagonal_mm: float) -> tuple[float, float]:
    """Edge length and envelope for a muscle from its cross-sections, mm."""
    sides = np.sqrt(sections.measure(surface.vertices).areas)
    edge = min(EDGE_SHARE * float(np.median(sides)), 0.5 * diagonal_mm)
    return edge, min(ENVELOPE_SHARE * float(np.quantile(sides, 0.1)), ENVELOPE_FRACTION * diagonal_mm)
