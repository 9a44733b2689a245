"""Tetrahedra of all tissues together: anatomy in, one mesh that the tissues share out; knows no motion.

All surfaces go into one tetrahedralisation, so that neighbouring tissues share their interface faces: while no tet
inverts and the mesh's boundary does not cross itself, no two tissues can intersect. What tetrahedralises is handed in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.mesh_fidelity import (
    TissueFit,
    fit_findings,
    joined,
    pieces_of_surface,
    pieces_of_tets,
    surface_distances,
)
from musclefit.anatomy.mesh_rules import FILLER, LayerRules, diagonal_mm
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points, Tets, frozen
from musclefit.geometry.measures import enclosed_volume, signed_volumes
from musclefit.geometry.meshes import TetMesh
from musclefit.geometry.queries.winding import inside_surface
from musclefit.geometry.tets.orientation import orientations
from musclefit.geometry.tets.sizing import SizingField
from musclefit.geometry.tets.topology import TetFaces, tet_faces
from musclefit.progress import Progress, Tick

NO_SKIN = "no-skin"
"""Code of the finding that there is no filler, because nothing says where it would end."""


@dataclass(frozen=True, eq=False, slots=True)
class TetAnatomy:
    """An anatomy and the tetrahedra that fill it.

    Parameters
    ----------
    anatomy : Anatomy
        The surfaces as they were given; the mesh follows them within the envelope, not vertex by vertex.
    mesh : TetMesh
        One mesh for all tissues; neighbours share faces.
    tissue_of_tet : (k,) int64
        Index into ``anatomy.tissues`` of the tissue each tet belongs to. The skin's index stands for the filler: tets
        inside the skin but in no other tissue.
    dropped : int, >= 0
        Tets that were inside no tissue and so were left out.
    findings : tuple of Finding
        Tissues without tets, or whose tets fill another volume than their surface encloses.
    fits : tuple of TissueFit
        How truly the tets fill the tissues and the filler; empty where nobody measured it.
    turned : int, >= 0
        Tets that came left-handed and had two corners swapped.
    joint_space_tets : int, >= 0
        Tets of filler between sliding bones that were left out.
    joint_space_mm3 : float
        Their volume.

    Raises
    ------
    MeshError
        The labels do not fit the mesh or the anatomy, or a tet is not right-handed.
    """

    anatomy: Anatomy
    mesh: TetMesh
    tissue_of_tet: Int
    dropped: int
    findings: tuple[Finding, ...]
    fits: tuple[TissueFit, ...] = ()
    turned: int = 0
    joint_space_tets: int = 0
    joint_space_mm3: float = 0.0

    def __post_init__(self) -> None:
        labels = frozen(self.tissue_of_tet, np.int64)
        if labels.shape != (len(self.mesh.tets),):
            raise MeshError(f"{len(self.mesh.tets)} tets have labels of shape {labels.shape}; give one label per tet")
        if labels.size and (labels.min() < 0 or labels.max() >= len(self.anatomy)):
            raise MeshError(
                f"tet labels run from {labels.min()} to {labels.max()}, but the anatomy has {len(self.anatomy)} tissues"
            )
        wrong = np.flatnonzero(orientations(self.mesh.vertices, self.mesh.tets) <= 0)
        if wrong.size:
            volumes = signed_volumes(self.mesh.vertices, self.mesh.tets[wrong])
            raise MeshError(
                f"{wrong.size} of {len(labels)} tets are not right-handed at rest, the worst is number "
                f"{wrong[volumes.argmin()]} with {volumes.min():.6g} mm³; tetrahedralise with another edge length or "
                "envelope"
            )
        object.__setattr__(self, "tissue_of_tet", labels)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the labels: of the tissues, and `layers.FILLER` in place of the skin."""
        return tuple(FILLER if tissue.kind is TissueKind.SKIN else tissue.name for tissue in self.anatomy)

    def volumes_by_tissue(self) -> Float:
        """Volume that the tets of each label fill, mm³, in the order of ``names``."""
        volumes = signed_volumes(self.mesh.vertices, self.mesh.tets)
        return np.bincount(self.tissue_of_tet, weights=volumes, minlength=len(self.anatomy)).astype(np.float64)


class Tetrahedraliser(Protocol):
    """Fills surfaces (n, 3) float64 mm, (f, 3) int64 with tetrahedra of one orientation, around and inside all of them.

    Both fractions are of the bounding box's diagonal, as `tetrahedralise_with` takes them; the sizing field asks for
    shorter edges than the fraction, never for longer ones.
    """

    def __call__(
        self,
        vertices: Points,
        faces: Faces,
        /,
        *,
        edge_length_fraction: float,
        envelope_fraction: float,
        sizing: SizingField,
        tick: Tick,
    ) -> tuple[Points, Tets]:
        """(m, 3) vertices, mm, and (k, 4) tets."""
        ...


def tetrahedralise_with(
    fill: Tetrahedraliser, anatomy: Anatomy, *, rules: LayerRules, progress: Progress
) -> TetAnatomy:
    """Fill all tissues with tetrahedra in one go, and say which tet belongs to which tissue.

    Parameters
    ----------
    fill : Tetrahedraliser
    anatomy : Anatomy
    rules : LayerRules
    progress : Progress

    Returns
    -------
    TetAnatomy
        A tet belongs to the first tissue, in the order of ``rules.priority``, that winds around its barycentre and
        around that of a neighbour: one that no face joins to others of a tissue is cut by its surface, and is left to
        the next (counted in ``fits``).

    Raises
    ------
    InputError
        A rule is out of range or names no tissue, or a tissue has the filler's name.
    MeshError
        No tet lies in a tissue.
    """
    rules.require_sane(anatomy)
    if any(tissue.name == FILLER for tissue in anatomy):
        raise InputError(f"a tissue is named {FILLER!r}, which stands for the room between tissues and skin; rename it")
    envelope = rules.smallest_envelope(anatomy)
    with progress.stage("tetrahedralise") as tick:
        vertices, tets = fill(
            anatomy.vertices(),
            surface_faces(anatomy),
            edge_length_fraction=rules.edge_length_fraction,
            envelope_fraction=envelope,
            sizing=rules.sizing(anatomy),
            tick=tick,
        )
    left_handed = signed_volumes(vertices, tets) < 0.0
    turned = len(tets) if 2 * int(left_handed.sum()) > len(tets) else 0
    if turned:
        tets = tets[:, [0, 2, 1, 3]]
    with progress.stage("label tets") as tick:
        return _labelled(anatomy, vertices, tets, rules=rules, turned=turned, tick=tick)


def _labelled(
    anatomy: Anatomy, vertices: Points, tets: Tets, *, rules: LayerRules, turned: int, tick: Tick
) -> TetAnatomy:
    barycentres, volumes = vertices[tets].mean(axis=1), signed_volumes(vertices, tets)
    labels = np.full(len(tets), -1, dtype=np.int64)
    inside: dict[int, Bool] = {}
    faces = tet_faces(tets)
    alone: dict[int, int] = {}
    for done, index in enumerate(reversed(rules.innermost_first(anatomy)), start=1):
        found = inside_surface(anatomy.tissues[index].surface, barycentres)
        inside[index] = joined(faces, inside=found)
        alone[index] = int(found.sum() - inside[index].sum())
        labels[inside[index]] = index
        tick(0.3 * done / len(anatomy))
    kept = labels >= 0
    names = {tissue.name: index for index, tissue in enumerate(anatomy)}
    if not kept.any():
        raise MeshError(
            f"none of the {len(tets)} tets lies inside a tissue; the surfaces are open or inside out, or thinner than "
            f"the envelope ({rules.smallest_envelope(anatomy):.3g} of the bounding box's diagonal)"
        )
    fits = _fits(anatomy, vertices, faces, labels=labels, volumes=volumes, inside=inside, rules=rules, tick=tick)
    fits = tuple(replace(f, alone=alone[names[f.name]]) if f.name in names else f for f in fits)
    used = np.unique(tets[kept])
    return TetAnatomy(
        anatomy=anatomy,
        mesh=TetMesh(vertices[used], np.searchsorted(used, tets[kept])),
        tissue_of_tet=labels[kept],
        dropped=int((~kept).sum()),
        findings=(*fit_findings(fits), *_no_skin(anatomy, dropped=int((~kept).sum()))),
        fits=fits,
        turned=turned,
    )


def _fits(
    anatomy: Anatomy,
    vertices: Points,
    faces: TetFaces,
    *,
    labels: Int,
    volumes: Float,
    inside: dict[int, Bool],
    rules: LayerRules,
    tick: Tick,
) -> tuple[TissueFit, ...]:
    """The skin first, then the filler, then the other tissues in their order."""
    diagonal = diagonal_mm(anatomy)
    found = []
    for index, tissue in enumerate(anatomy):
        own = labels == index
        skin = tissue.kind is TissueKind.SKIN
        taken = inside[index] if skin else own
        envelope = rules.envelope_of(tissue, diagonal_mm=diagonal)
        off, missed = None, None
        if inside[index].any():
            off, missed = surface_distances(tissue.surface, vertices, faces, inside=inside[index])
        found.append(
            TissueFit(
                name=tissue.name,
                kind=tissue.kind.value,
                tets=int(taken.sum()),
                volume_mm3=float(volumes[taken].sum()),
                surface_mm3=enclosed_volume(tissue.surface),
                inside_mm3=float(volumes[inside[index]].sum()),
                envelope_mm=envelope,
                off_mm=off,
                missed_mm=missed,
                pieces=pieces_of_tets(faces, inside=inside[index]),
                surface_pieces=pieces_of_surface(tissue.surface),
            )
        )
        if skin:
            found.append(TissueFit(FILLER, FILLER, int(own.sum()), float(volumes[own].sum())))
        tick(0.3 + 0.7 * (index + 1) / len(anatomy))
    return tuple(found)


def _no_skin(anatomy: Anatomy, *, dropped: int) -> tuple[Finding, ...]:
    """That there is no filler, where there is no skin to end it."""
    if anatomy.skin is not None:
        return ()
    message = (
        f"the anatomy has no skin, so nothing says where filler between the tissues would end: there is none, and "
        f"{dropped} tets outside all tissues were left out"
    )
    return (Finding(FILLER, NO_SKIN, message),)


def surface_faces(anatomy: Anatomy) -> Faces:
    """(F, 3) faces of all tissues, into ``anatomy.vertices()``."""
    starts = [part.start for part in anatomy.slices().values()]
    return np.concatenate([t.surface.faces + start for t, start in zip(anatomy, starts, strict=True)])
