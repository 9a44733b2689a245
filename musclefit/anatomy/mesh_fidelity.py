"""How truly tets fill tissues: volumes, and distances between their surfaces and those given; knows no motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from musclefit.anatomy.findings import Finding
from musclefit.geometry.arrays import Bool, Int, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.tets.topology import TetFaces, interface

LABELLED_VOLUME_PERCENT = 2.0
"""A tissue whose tets fill its surface less exactly than this is reported as a finding, percent."""


@dataclass(frozen=True, slots=True)
class TissueFit:
    """What a tissue got of the mesh.

    Parameters
    ----------
    name : str
        Of a tissue, or `layers.FILLER`.
    kind : str
        Of the tissue; "filler" for the filler.
    tets : int
        That are the tissue's own; for the skin, all inside it.
    volume_mm3 : float
        Of these.
    surface_mm3 : float or None
        Enclosed by the surface that was given; None for the filler.
    inside_mm3 : float or None
        Of all tets inside that surface, those that other tissues won included; None for the filler.
    envelope_mm : float or None
        How far the tets' surface may be from the given one.
    off_mm : float or None
        How far it is: the largest distance of a vertex or a middle of a triangle of the tets' surface from the given
        one; None where there is no surface to compare.
    missed_mm : float or None
        The other way: of the given surface from the tets'.
    pieces, surface_pieces : int or None
        Into how many the tets inside the surface fall, joined by faces, and the surface itself; None for the filler.
    alone : int
        Tets whose barycentre is inside the surface, but that no face joins to another such: they were left to the
        tissue that comes next.
    """

    name: str
    kind: str
    tets: int
    volume_mm3: float
    surface_mm3: float | None = None
    inside_mm3: float | None = None
    envelope_mm: float | None = None
    off_mm: float | None = None
    missed_mm: float | None = None
    pieces: int | None = None
    surface_pieces: int | None = None
    alone: int = 0

    @property
    def volume_error_percent(self) -> float | None:
        """How much more the tets inside the given surface fill than it encloses, percent; None for the filler."""
        if self.surface_mm3 is None or self.inside_mm3 is None or not self.surface_mm3:
            return None
        return 100.0 * (self.inside_mm3 - self.surface_mm3) / self.surface_mm3

    @property
    def yielded_mm3(self) -> float | None:
        """Volume inside the tissue's surface that other tissues won; None for the filler."""
        return None if self.inside_mm3 is None else self.inside_mm3 - self.volume_mm3


def surface_distances(given: TriMesh, vertices: Points, faces: TetFaces, *, inside: Bool) -> tuple[float, float]:
    """Hausdorff distances between the surface of some tets and the one that was given, both ways, mm.

    Sampled at the vertices and the middles of the triangles, so never above the true distances.

    Parameters
    ----------
    given : TriMesh
    vertices : (n, 3) float64, mm
    faces : TetFaces
        Of the whole mesh.
    inside : (k,) bool
        The tets.

    Returns
    -------
    off, missed : float
        Tets' surface from the given one, and back.
    """
    triangles = interface(faces, np.flatnonzero(inside), count=len(inside))
    used = np.unique(triangles)
    filled = TriMesh(vertices[used], np.searchsorted(used, triangles))
    return _largest(filled, given), _largest(given, filled)


def joined(faces: TetFaces, *, inside: Bool) -> Bool:
    """Those of some tets that share a face with another of them; all, where none does.

    Parameters
    ----------
    faces : TetFaces
        Of the whole mesh.
    inside : (k,) bool
        The tets.
    """
    pairs = faces.tets[faces.tets[:, 1] >= 0]
    found = np.zeros(len(inside), dtype=bool)
    found[pairs[inside[pairs].all(axis=1)]] = True
    return found if found.any() else inside


def pieces_of_tets(faces: TetFaces, *, inside: Bool) -> int:
    """Into how many pieces some tets fall, joined by faces.

    Parameters
    ----------
    faces : TetFaces
        Of the whole mesh.
    inside : (k,) bool
        The tets.
    """
    return len(np.unique(piece_of_tet(faces, inside=inside)[inside]))


def piece_of_tet(faces: TetFaces, *, inside: Bool) -> Int:
    """(k,) a number for each tet, the same for those of some that faces join; see `pieces_of_tets`."""
    pairs = faces.tets[faces.tets[:, 1] >= 0]
    pairs = pairs[inside[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(inside),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def pieces_of_surface(surface: TriMesh) -> int:
    """Into how many pieces a surface falls, joined by vertices."""
    a, b, c = surface.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    graph = coo_matrix((np.ones(len(ends[0]), dtype=bool), ends), shape=(len(surface.vertices),) * 2)
    _, labels = connected_components(graph, directed=False)
    return len(np.unique(labels[surface.faces[:, 0]]))


def _largest(surface: TriMesh, other: TriMesh) -> float:
    samples = np.concatenate([surface.vertices, surface.corners().mean(axis=1)])
    return float(nearest_places(samples, other).distances.max())


def fit_findings(fits: tuple[TissueFit, ...]) -> tuple[Finding, ...]:
    """Tissues that got no tet, whose tets fill another volume than their surface encloses, or that fell apart."""
    findings = []
    for fit in fits:
        if fit.surface_mm3 is None:
            continue
        if not fit.tets:
            findings.append(
                Finding(
                    fit.name,
                    "no-tets",
                    f"{fit.name} got no tet: it is thinner than the edge length or envelope allows, or lies wholly "
                    "inside tissues that win over it; choose a smaller edge length or envelope for it, or another "
                    "tets.priority",
                )
            )
            continue
        error = fit.volume_error_percent
        if error is None or abs(error) > LABELLED_VOLUME_PERCENT:
            said = "another volume than" if error is None else f"{error:+.1f} % off"
            findings.append(
                Finding(
                    fit.name,
                    "tet-volume",
                    f"the tets inside {fit.name} fill {fit.inside_mm3:.6g} mm³, {said} the {fit.surface_mm3:.6g} mm³ "
                    "of its surface; choose a smaller envelope for it",
                )
            )
        if fit.pieces is not None and fit.surface_pieces is not None and fit.pieces > fit.surface_pieces:
            findings.append(
                Finding(
                    fit.name,
                    "tet-pieces",
                    f"the tets inside {fit.name} fall into {fit.pieces} pieces, its surface into {fit.surface_pieces}: "
                    f"in places it is thinner than its envelope of {fit.envelope_mm:.3g} mm, or coarse beside a "
                    "neighbour; choose a smaller envelope or edge length for it",
                )
            )
    return tuple(findings)
