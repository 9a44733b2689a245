"""Volumes of tissues before and after, and how rigid the bones stayed: two anatomies -> checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.arrays import Points
from musclefit.geometry.measures import area_vectors, enclosed_volume, volume_change_percent
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.rigid import RigidMotion
from musclefit.validate.model import OutsideCheck, TissueCheck

Motion = Callable[[Points], Points]
"""Takes a whole bone from rest to where it is put, (N, 3) mm."""

PRESCRIBED = "prescribed"
BEST_FIT = "best fit"


def check_tissues(
    rest: Anatomy, deformed: Anatomy, *, motions: Mapping[str, Motion], outside: OutsideCheck
) -> tuple[TissueCheck, ...]:
    """Volume, percent change and, of bones, distance from rigid; one record per tissue in the anatomy's order.

    Parameters
    ----------
    rest, deformed : Anatomy
        The same tissues before and after, vertex by vertex.
    motions : mapping of bone name to callable
        Where each bone is taken as a whole, rest to deformed: by joints, or as the rig keeps it.
        A bone that is missing here is held against the rigid
        motion that fits it best (Kabsch), and the record says so: that is a weaker claim.
    outside : OutsideCheck
        Of `check_outside_skin`; a tissue missing there gets None.

    Notes
    -----
    Volumes are signed sums over triangles: a tissue that turned inside out has a negative volume here.

    Raises
    ------
    InputError
        The anatomies have different tissues or vertex counts, or a motion names no bone.
    MeshError
        A tissue encloses no positive volume at rest.
    """
    bones = {tissue.name for tissue in rest.of_kind(TissueKind.BONE)}
    unknown = [name for name in motions if name not in bones]
    if unknown:
        raise InputError(
            f"a motion is prescribed for {unknown[0]!r}, which is not a bone; bones are: {', '.join(sorted(bones))}"
        )
    beyond = {tissue.name: tissue for tissue in outside.tissues}
    checks = []
    for before, after in _paired(rest, deformed):
        volume_before, volume_after = enclosed_volume(before.surface), enclosed_volume(after.surface)
        if volume_before <= 0.0:
            raise MeshError(
                f"{before.name} encloses {volume_before:.6g} mm³ at rest, so a change of volume means nothing; "
                "reverse its triangles"
            )
        rigidity, reference = _rigidity(before, after, motions)
        out = beyond.get(before.name)
        checks.append(
            TissueCheck(
                name=before.name,
                kind=str(before.kind),
                rest_volume_mm3=volume_before,
                volume_mm3=volume_after,
                volume_change_percent=volume_change_percent(before.surface, after.surface),
                rigidity_mm=rigidity,
                rigidity_reference=reference,
                outside_skin_rest_mm3=None if out is None else out.rest_mm3,
                outside_skin_mm3=None if out is None else out.deformed_mm3,
                outside_skin_introduced_mm3=None if out is None else out.introduced_mm3,
            )
        )
    return tuple(checks)


def _paired(rest: Anatomy, deformed: Anatomy) -> list[tuple[Tissue, Tissue]]:
    if [t.name for t in rest] != [t.name for t in deformed]:
        different = sorted({t.name for t in rest} ^ {t.name for t in deformed})
        raise InputError(f"the anatomies before and after differ in: {', '.join(different[:4]) or 'order'}")
    pairs = list(zip(rest, deformed, strict=True))
    for before, after in pairs:
        if len(before.surface.vertices) != len(after.surface.vertices):
            raise InputError(
                f"{before.name} has {len(before.surface.vertices)} vertices at rest and "
                f"{len(after.surface.vertices)} deformed; check the same mesh before and after"
            )
    return pairs


def _rigidity(before: Tissue, after: Tissue, motions: Mapping[str, Motion]) -> tuple[float, str] | tuple[None, None]:
    """Largest distance of a bone's vertex from where the rigid motion takes it, and which motion that is."""
    if before.kind is not TissueKind.BONE:
        return None, None
    source, target = before.surface.vertices, after.surface.vertices
    prescribed = motions.get(before.name)
    motion: Motion = _fitted_by_area(before.surface, after.surface) if prescribed is None else prescribed
    # Triangles are moved straight: what is farthest off is a vertex.
    distance = float(np.linalg.norm(motion(source) - target, axis=1).max())
    return distance, BEST_FIT if prescribed is None else PRESCRIBED


def _fitted_by_area(before: TriMesh, after: TriMesh) -> RigidMotion:
    """The rigid motion with the least squared distance over the whole surface, however finely parts of it are cut.

    The middles of the sides, a third of the triangle's area each, integrate what is quadratic exactly.
    """
    middles = [0.5 * (corners + np.roll(corners, 1, axis=1)) for corners in (before.corners(), after.corners())]
    source, target = (part.reshape(-1, 3) for part in middles)
    return RigidMotion.fitted(source, target, weights=np.repeat(np.linalg.norm(area_vectors(before), axis=1), 3))
