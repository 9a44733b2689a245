r"""Fibre directions in a muscle's tetrahedra by Laplace flow between its ends; knows no bone and no map.

The potential :math:`u` solves :math:`\Delta u = 0` with 0 on the origin, 1 on the insertion and no flux through the
rest of the surface, by linear finite elements; fibres run along its gradient. Where a muscle holds on to bone along
most of its length, that gradient dies away exponentially from the other end; in such a muscle the flow is driven by an
even flux in through the origin and out through the insertion instead. So is it where tendon sheets are stated: between
two parallel sheets held potentials would make fibres run square to both, whatever slant the muscle's end walls have.
A place of a sheet acts at the muscle's nearest place, if it is inside the muscle or within a stated distance of it.

References
----------
H. F. Choi and S. S. Blemker, Skeletal muscle fascicle arrangements can be reconstructed using a Laplacian vector field
simulation, PLoS ONE 8 (2013) e77576.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from musclefit.errors import MeshError
from musclefit.geometry.arrays import Bool, Float, Int, Points, Tets
from musclefit.geometry.measures import area_vectors, signed_volumes
from musclefit.geometry.meshes import TetMesh, TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.geometry.surfaces.samples import surface_samples
from musclefit.geometry.tets.relocation import inverse_shapes
from musclefit.geometry.tets.topology import tet_faces

SINGULAR_SHARE = 0.01
"""Where the gradient is below this share of its median over the volume, its direction says nothing."""

EVEN_FLUX_ABOVE = 0.1
"""A larger share of the volume than this without direction calls for an even flux."""

SHEET_SPACING = 0.5
"""Sheets act at places this share of the cube root of a tetrahedron's mean volume apart, or closer."""

LEAST_ACTED = 1e-6
"""Vertices belong to a sheet on which more of it acts than this share of the largest."""

CANDIDATES = 40
"""Tetrahedra that are asked whether a place of a sheet is in them."""


@dataclass(frozen=True, eq=False, slots=True)
class FibreField:
    """Directions in a muscle's tetrahedra.

    Parameters
    ----------
    mesh : TetMesh
    origin, insertion : (n,) bool
        Vertices of the two ends.
    potential : (n,) float64
        0 at the origin, 1 at the insertion (with an even flux: in the mean); NaN in pieces that do not reach both.
    directions : (k, 3) float64
        Of each tet, length 1, from origin to insertion; 0 where there is none.
    residual : float
        Largest flux out of a free vertex, over the largest into an end's: 0 if solved exactly.
    singular_share, left_out_share : float
        Share of the volume where the gradient all but vanishes; and of pieces that do not reach both ends.
    even_flux : bool
        Whether the flow is driven by an even flux, because held potentials left too much without direction.
    sheets : tuple of two bool
        Whether origin and insertion are tendon sheets, on which fibres begin and end; the flux is even then too.
    """

    mesh: TetMesh
    origin: Bool
    insertion: Bool
    potential: Float
    directions: Points
    residual: float
    singular_share: float
    left_out_share: float
    even_flux: bool = False
    sheets: tuple[bool, bool] = (False, False)

    @property
    def used(self) -> Int:
        """The numbers of the tets that have a direction."""
        found: Int = np.flatnonzero(np.linalg.norm(self.directions, axis=1) > 0.0)
        return found

    def placed_directions(self) -> tuple[Points, Points]:
        """The middles of the tets that have a direction, mm, and the directions."""
        used = self.used
        return self.mesh.vertices[self.mesh.tets[used]].mean(axis=1), self.directions[used]


def laplace_fibres(mesh: TetMesh, *, origin: TriMesh, insertion: TriMesh, within_mm: float) -> FibreField:
    """Fibre directions between two areas of a muscle's surface.

    Parameters
    ----------
    mesh : TetMesh
        Of the muscle alone.
    origin, insertion : TriMesh
        The areas where fibres begin and end.
    within_mm : float
        Vertices of the mesh's boundary this close to an area belong to it: the envelope. Of an area that has fewer
        than three such vertices, the corners of the boundary's triangle nearest to its middle do.

    Raises
    ------
    MeshError
        No piece of the mesh reaches both ends.
    """
    begins, ends = end_vertices(mesh, origin, insertion, within_mm=within_mm)
    gradients, volumes = shape_gradients(mesh.vertices, mesh.tets), signed_volumes(mesh.vertices, mesh.tets)
    pieces, reached = _reaching(mesh, begins, ends)
    inside = np.isin(pieces, reached)
    stiffness = laplacian(mesh.tets, gradients, volumes, count=len(mesh.vertices))
    held = _held(stiffness, inside, begins, ends)
    found = _field(mesh, gradients, volumes, inside, begins, ends, held)
    if found.singular_share > EVEN_FLUX_ABOVE:
        areas = _vertex_areas(mesh)
        even = _even_flux(stiffness, pieces, reached, (np.where(begins, areas, 0.0), np.where(ends, areas, 0.0)))
        return replace(_field(mesh, gradients, volumes, inside, begins, ends, even), even_flux=True)
    return found


def sheet_fibres(
    mesh: TetMesh,
    *,
    origin: TriMesh,
    insertion: TriMesh,
    sheets: tuple[TriMesh | None, TriMesh | None],
    within_mm: float,
    reach_mm: float,
) -> FibreField:
    """Fibre directions from and to tendon sheets in or along a muscle, by a flux that is even over each sheet.

    Parameters
    ----------
    mesh : TetMesh
        Of the muscle alone.
    origin, insertion : TriMesh
        The areas where fibres begin and end without a sheet.
    sheets : tuple of two TriMesh or None
        The sheets of origin and insertion, open or closed; None where the area stands.
    within_mm : float
        As in `laplace_fibres`.
    reach_mm : float
        Places of a sheet farther outside the muscle than this do not count.

    Raises
    ------
    MeshError
        A sheet of which no place counts, or no piece of the mesh reaches both ends.
    """
    areas = _vertex_areas(mesh)
    near = end_vertices(mesh, origin, insertion, within_mm=within_mm)
    shares = [
        np.where(end, areas, 0.0) if sheet is None else _sheet_shares(mesh, sheet, reach_mm=reach_mm)
        for end, sheet in zip(near, sheets, strict=True)
    ]
    begins, ends = (share > LEAST_ACTED * share.max() for share in shares)
    gradients, volumes = shape_gradients(mesh.vertices, mesh.tets), signed_volumes(mesh.vertices, mesh.tets)
    pieces, reached = _reaching(mesh, begins, ends)
    inside = np.isin(pieces, reached)
    stiffness = laplacian(mesh.tets, gradients, volumes, count=len(mesh.vertices))
    even = _even_flux(stiffness, pieces, reached, (shares[0], shares[1]))
    found = _field(mesh, gradients, volumes, inside, begins, ends, even)
    return replace(found, even_flux=True, sheets=(sheets[0] is not None, sheets[1] is not None))


def _sheet_shares(mesh: TetMesh, sheet: TriMesh, *, reach_mm: float) -> Float:
    """(n,) the area of a sheet that acts on each vertex, mm²: its places by their barycentric coordinates."""
    boundary = TriMesh(mesh.vertices, tet_faces(mesh.tets).boundary)
    edge = float(np.cbrt(np.abs(signed_volumes(mesh.vertices, mesh.tets)).mean()))
    cut = surface_samples(sheet, spacing_mm=SHEET_SPACING * edge).mesh
    places, areas = cut.corners().mean(axis=1), np.linalg.norm(area_vectors(cut), axis=1)
    at = nearest_places(places, boundary)
    inside = winding_numbers(boundary, places) > 0.5
    counts = inside | (at.distances <= reach_mm)
    if not counts.any():
        raise MeshError(
            f"no place of its tendon sheet is in it or within {reach_mm:.3g} mm of it (the nearest is "
            f"{at.distances.min():.3g} mm off); check the sheet's frame and unit, or state a larger distance"
        )
    places = np.where(inside[:, None], places, at.places)[counts]
    tets, weights = _located(mesh, places)
    acted = areas[counts, None] * weights
    found: Float = np.bincount(mesh.tets[tets].ravel(), acted.ravel(), minlength=len(mesh.vertices)).astype(np.float64)
    return found


def _located(mesh: TetMesh, places: Points) -> tuple[Int, Float]:
    """The tet that each place is in, or all but in, among those with the nearest middles; and its coordinates there."""
    count = min(CANDIDATES, len(mesh.tets))
    candidates = np.asarray(cKDTree(mesh.vertices[mesh.tets].mean(axis=1)).query(places, k=count)[1])
    candidates = candidates.reshape(len(places), count)
    gradients = shape_gradients(mesh.vertices, mesh.tets)
    own = np.zeros(len(places), dtype=np.int64)
    best = np.full((len(places), 4), -np.inf)
    for tets in candidates.T:
        from_first = places - mesh.vertices[mesh.tets[tets, 0]]
        weights = np.einsum("pci,pi->pc", gradients[tets], from_first) + np.array([1.0, 0.0, 0.0, 0.0])
        better = weights.min(axis=1) > best.min(axis=1)
        own[better], best[better] = tets[better], weights[better]
    best = np.maximum(best, 0.0)
    return own, best / best.sum(axis=1, keepdims=True)


def _held(stiffness: csc_array, inside: Bool, begins: Bool, ends: Bool) -> tuple[Float, float]:
    """The potential that is 0 at the origin and 1 at the insertion, and its residual."""
    fixed, free = inside & (begins | ends), np.flatnonzero(inside & ~(begins | ends))
    potential = np.where(ends, 1.0, 0.0)
    if len(free):
        right = -(stiffness[free][:, np.flatnonzero(fixed)] @ potential[fixed])
        potential[free] = _solved(stiffness[free][:, free], right)
    flux = stiffness @ np.where(inside, potential, 0.0)
    return potential, float(np.abs(flux[free]).max(initial=0.0) / max(np.abs(flux[fixed]).max(initial=0.0), 1e-300))


def _even_flux(stiffness: csc_array, pieces: Int, reached: Int, areas: tuple[Float, Float]) -> tuple[Float, float]:
    """The potential of a flux that is even over each end, 0 and 1 in the ends' means, and its residual.

    ``areas`` are those of origin and insertion that act on each vertex.
    """
    potential, residual = np.zeros(len(pieces)), 0.0
    for piece in reached:
        own = np.flatnonzero(pieces == piece)
        origin, insertion = (area[own] / area[own].sum() for area in areas)
        right = insertion - origin
        part = stiffness[own][:, own]
        found = np.concatenate([[0.0], _solved(part[1:][:, 1:], right[1:])])
        residual = max(residual, float(np.abs(part @ found - right).max() / np.abs(right).max()))
        low, high = origin @ found, insertion @ found
        potential[own] = (found - low) / (high - low)
    return potential, residual


def _solved(matrix: csc_array, right: Float) -> Float:
    solver = splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    found: Float = solver.solve(right)
    return found


def _vertex_areas(mesh: TetMesh) -> Float:
    """(n,) a third of the area of the boundary's triangles around each vertex, mm²; 0 inside."""
    boundary = tet_faces(mesh.tets).boundary
    thirds = np.linalg.norm(area_vectors(TriMesh(mesh.vertices, boundary)), axis=1) / 3.0
    return np.bincount(boundary.ravel(), np.repeat(thirds, 3), minlength=len(mesh.vertices)).astype(np.float64)


def _field(
    mesh: TetMesh,
    gradients: Float,
    volumes: Float,
    inside: Bool,
    begins: Bool,
    ends: Bool,
    solved: tuple[Float, float],
) -> FibreField:
    """Directions along a potential, and how much of the volume has none."""
    potential, residual = solved
    slopes = np.einsum("kci,kc->ki", gradients, potential[mesh.tets])
    sizes = np.linalg.norm(slopes, axis=1)
    used = inside[mesh.tets[:, 0]]
    order = np.argsort(sizes[used])
    covered = np.cumsum(volumes[used][order])
    median = float(sizes[used][order[np.searchsorted(covered, 0.5 * covered[-1])]])
    singular = used & (sizes < SINGULAR_SHARE * median)
    directions = np.where(used[:, None], slopes, 0.0) / np.where(sizes > 0.0, sizes, 1.0)[:, None]
    total = float(volumes.sum())
    return FibreField(
        mesh=mesh,
        origin=begins & inside,
        insertion=ends & inside,
        potential=np.where(inside, potential, np.nan),
        directions=directions,
        residual=residual,
        singular_share=float(volumes[singular].sum()) / total,
        left_out_share=float(volumes[~used].sum()) / total,
    )


def end_vertices(mesh: TetMesh, origin: TriMesh, insertion: TriMesh, *, within_mm: float) -> tuple[Bool, Bool]:
    """(n,) which vertices of the boundary belong to each end.

    One near both belongs to the smaller area: a tip that lies on the bone which a muscle holds on to all its length is
    its end for all that.
    """
    boundary = tet_faces(mesh.tets).boundary
    outer = np.unique(boundary)
    distances = [nearest_places(mesh.vertices[outer], area).distances for area in (origin, insertion)]
    near = [own <= within_mm for own in distances]
    larger = 0 if _area_mm2(origin) >= _area_mm2(insertion) else 1
    near[larger] &= ~near[1 - larger]
    found = []
    for area, mine in zip((origin, insertion), near, strict=True):
        chosen = np.zeros(len(mesh.vertices), dtype=bool)
        chosen[outer[mine]] = True
        if chosen.sum() < 3:
            middle = area.corners().mean(axis=(0, 1))
            chosen[boundary[np.linalg.norm(mesh.vertices[boundary].mean(axis=1) - middle, axis=1).argmin()]] = True
        found.append(chosen)
    found[larger] &= ~found[1 - larger]
    return found[0], found[1]


def _area_mm2(surface: TriMesh) -> float:
    return float(np.linalg.norm(area_vectors(surface), axis=1).sum())


def shape_gradients(vertices: Points, tets: Tets) -> Float:
    """(k, 4, 3) gradients of the tets' barycentric coordinates, 1/mm."""
    inner = inverse_shapes(vertices, tets)
    return np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)


def laplacian(tets: Tets, gradients: Float, volumes: Float, *, count: int) -> csc_array:
    """(count, count) stiffness of linear elements: entries are the integrals of products of gradients, mm."""
    entries = np.einsum("kai,kbi,k->kab", gradients, gradients, volumes)
    rows, columns = np.repeat(tets, 4, axis=1), np.tile(tets, (1, 4))
    return csc_array(coo_array((entries.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count)))


def _reaching(mesh: TetMesh, begins: Bool, ends: Bool) -> tuple[Int, Int]:
    """The piece of each vertex, and the pieces that reach both ends.

    Raises
    ------
    MeshError
        None does.
    """
    pieces = _pieces(mesh.tets, len(mesh.vertices))
    reached = np.intersect1d(pieces[begins], pieces[ends])
    if not len(reached):
        raise MeshError("no piece of the tetrahedra reaches from origin to insertion; mesh it finer")
    return pieces, reached


def _pieces(tets: Tets, count: int) -> Int:
    """(count,) the piece that each vertex belongs to."""
    ends = np.concatenate([tets[:, [0, k]] for k in (1, 2, 3)])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
