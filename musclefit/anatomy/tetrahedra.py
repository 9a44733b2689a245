"""Tetrahedra of all tissues together: anatomy in, one mesh that the tissues share out; knows no motion.

All surfaces go into one tetrahedralisation, so that neighbouring tissues share their interface faces: while no tet
inverts and the mesh's boundary does not cross itself, no two tissues can intersect. What tetrahedralises is handed in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Faces, Float, Int, Points, Tets, frozen
from musclefit.geometry.meshes import TetMesh
from musclefit.geometry.volumes import enclosed_volume, signed_volumes
from musclefit.geometry.winding import winding_numbers
from musclefit.progress import Progress

LABELLED_VOLUME_PERCENT = 2.0
"""A tissue whose tets fill its surface less exactly than this is reported as a finding, percent."""

_INNERMOST_LAST = (TissueKind.SKIN, TissueKind.OTHER, TissueKind.MUSCLE, TissueKind.BONE)


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
        Index into ``anatomy.tissues`` of the tissue each tet belongs to. Tets inside the skin but in no other tissue
        belong to the skin, which so stands for everything that fills the room between the other tissues.
    dropped : int, >= 0
        Tets that were inside no tissue and so were left out.
    findings : tuple of Finding
        Tissues without tets, or whose tets fill another volume than their surface encloses.

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

    def __post_init__(self) -> None:
        labels = frozen(self.tissue_of_tet, np.int64)
        if labels.shape != (len(self.mesh.tets),):
            raise MeshError(f"{len(self.mesh.tets)} tets have labels of shape {labels.shape}; give one label per tet")
        if labels.size and (labels.min() < 0 or labels.max() >= len(self.anatomy)):
            raise MeshError(
                f"tet labels run from {labels.min()} to {labels.max()}, but the anatomy has {len(self.anatomy)} tissues"
            )
        volumes = signed_volumes(self.mesh.vertices, self.mesh.tets)
        if volumes.size and volumes.min() <= 0.0:
            raise MeshError(
                f"{(volumes <= 0.0).sum()} of {len(volumes)} tets are not right-handed at rest, the worst is number "
                f"{volumes.argmin()} with {volumes.min():.6g} mm³; tetrahedralise with another edge length or envelope"
            )
        object.__setattr__(self, "tissue_of_tet", labels)

    @property
    def names(self) -> tuple[str, ...]:
        """Tissue names in the order of the labels."""
        return tuple(tissue.name for tissue in self.anatomy)

    def volumes_by_tissue(self) -> Float:
        """Volume that the tets of each tissue fill, mm³, in the anatomy's order."""
        volumes = signed_volumes(self.mesh.vertices, self.mesh.tets)
        return np.bincount(self.tissue_of_tet, weights=volumes, minlength=len(self.anatomy)).astype(np.float64)


class Tetrahedraliser(Protocol):
    """Fills surfaces (n, 3) float64 mm, (f, 3) int64 with tetrahedra of one orientation, around and inside all of them.

    Both fractions are of the bounding box's diagonal, as `tetrahedralise_with` takes them.
    """

    def __call__(
        self, vertices: Points, faces: Faces, /, *, edge_length_fraction: float, envelope_fraction: float
    ) -> tuple[Points, Tets]:
        """(m, 3) vertices, mm, and (k, 4) tets."""
        ...


def tetrahedralise_with(
    fill: Tetrahedraliser,
    anatomy: Anatomy,
    *,
    edge_length_fraction: float,
    envelope_fraction: float,
    progress: Progress,
) -> TetAnatomy:
    """Fill all tissues with tetrahedra in one go, and say which tet belongs to which tissue.

    Parameters
    ----------
    fill : Tetrahedraliser
    anatomy : Anatomy
    edge_length_fraction : float in (0, 1]
        Edge length aimed at, as a fraction of the bounding box's diagonal.
    envelope_fraction : float in (0, 1]
        How far the tets' surfaces may be from the tissues', as a fraction of the bounding box's diagonal.
    progress : Progress
        Is told the stages; the tetrahedraliser itself says nothing before it ends.

    Returns
    -------
    TetAnatomy
        A tet belongs to the innermost tissue that winds around its barycentre: bone before muscle before other before
        skin, and within a kind the smaller tissue.

    Raises
    ------
    InputError
        A fraction is out of range.
    MeshError
        No tet lies in a tissue.
    """
    for name, value in (("edge_length_fraction", edge_length_fraction), ("envelope_fraction", envelope_fraction)):
        if not 0.0 < value <= 1.0:
            raise InputError(f"{name} is {value}; give a fraction of the bounding box's diagonal, above 0 and up to 1")
    with progress.stage("tetrahedralise"):
        vertices, tets = fill(
            anatomy.vertices(),
            _faces(anatomy),
            edge_length_fraction=edge_length_fraction,
            envelope_fraction=envelope_fraction,
        )
    if len(tets) and np.median(signed_volumes(vertices, tets)) < 0.0:
        tets = tets[:, [0, 2, 1, 3]]
    with progress.stage("label tets") as tick:
        labels = np.full(len(tets), -1, dtype=np.int64)
        barycentres, volumes = vertices[tets].mean(axis=1), signed_volumes(vertices, tets)
        filled = np.zeros(len(anatomy))
        for done, (index, tissue) in enumerate(_outermost_first(anatomy), start=1):
            inside = _inside(tissue, barycentres)
            labels[inside], filled[index] = index, volumes[inside].sum()
            tick(done / len(anatomy))
    kept = labels >= 0
    if not kept.any():
        raise MeshError(
            f"none of the {len(tets)} tets lies inside a tissue; the surfaces are open or inside out, or thinner than "
            f"the envelope ({envelope_fraction} of the bounding box's diagonal)"
        )
    used = np.unique(tets[kept])
    mesh = TetMesh(vertices[used], np.searchsorted(used, tets[kept]))
    return TetAnatomy(
        anatomy=anatomy,
        mesh=mesh,
        tissue_of_tet=labels[kept],
        dropped=int((~kept).sum()),
        findings=labelling_findings(anatomy, filled_mm3=filled, tissue_of_tet=labels[kept]),
    )


def labelling_findings(anatomy: Anatomy, *, filled_mm3: Float, tissue_of_tet: Int) -> tuple[Finding, ...]:
    """Tissues that got no tet, or whose tets fill another volume than their surface encloses.

    Parameters
    ----------
    anatomy : Anatomy
    filled_mm3 : (tissues,) float64
        Volume of all tets that each tissue's surface winds around, those of tissues further in included.
    tissue_of_tet : (k,) int64
    """
    findings = []
    for index, tissue in enumerate(anatomy):
        if not (tissue_of_tet == index).any():
            findings.append(
                Finding(
                    tissue.name,
                    "no-tets",
                    f"{tissue.name} got no tet: it is thinner than the edge length or envelope allows, or lies wholly "
                    "inside further inward tissues; choose a smaller edge_length_fraction or envelope_fraction",
                )
            )
            continue
        enclosed = enclosed_volume(tissue.surface)
        filled = float(filled_mm3[index])
        percent = 100.0 * (filled - enclosed) / enclosed if enclosed else np.inf
        if abs(percent) > LABELLED_VOLUME_PERCENT:
            findings.append(
                Finding(
                    tissue.name,
                    "tet-volume",
                    f"the tets inside {tissue.name} fill {filled:.6g} mm³, {percent:+.1f} % off the {enclosed:.6g} mm³ "
                    "of its surface; choose a smaller envelope_fraction",
                )
            )
    return tuple(findings)


def _faces(anatomy: Anatomy) -> Faces:
    """(F, 3) faces of all tissues, into ``anatomy.vertices()``."""
    starts = [part.start for part in anatomy.slices().values()]
    return np.concatenate([t.surface.faces + start for t, start in zip(anatomy, starts, strict=True)])


def _outermost_first(anatomy: Anatomy) -> Sequence[tuple[int, Tissue]]:
    """Index and tissue so that who comes later lies further in: by kind, then from large to small."""
    return sorted(
        enumerate(anatomy), key=lambda item: (_INNERMOST_LAST.index(item[1].kind), -enclosed_volume(item[1].surface))
    )


def _inside(tissue: Tissue, points: Points) -> Int:
    """Indices of the points that a tissue's surface winds around."""
    corners = tissue.surface.vertices
    near = np.flatnonzero(((points >= corners.min(axis=0)) & (points <= corners.max(axis=0))).all(axis=1))
    inside: Int = near[winding_numbers(tissue.surface, points[near]) > 0.5]
    return inside
