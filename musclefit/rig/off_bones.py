"""Landmarks that stand off what they belong to, and which error of frame or unit would explain it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import nearest_places
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.rig.handles import Handles

OFF_BONE_MM = 10.0
"""Landmarks farther outside their bones are told."""

INSIDE = 0.5
"""Winding number above which a place is inside a bone."""

OFF_BONES = "landmarks-off-bones"
"""Code of the finding."""

OFF_SURFACE = "landmarks-off-surface"
"""And of that of any surface."""

_EXPLAINED = (
    ("x and y had the other sign, as RAS has against LPS", (-1.0, -1.0, 1.0)),
    ("x had the other sign: a mirror, or the other side of the body", (-1.0, 1.0, 1.0)),
    ("y had the other sign: a mirror", (1.0, -1.0, 1.0)),
    ("z had the other sign: a mirror", (1.0, 1.0, -1.0)),
    ("their unit were m", (1e3, 1e3, 1e3)),
    ("their unit were cm", (10.0, 10.0, 10.0)),
    ("their unit were a tenth of what is stated", (0.1, 0.1, 0.1)),
    ("their unit were a thousandth of what is stated", (1e-3, 1e-3, 1e-3)),
)


def off_bone_findings(handles: Handles, anatomy: Anatomy, *, subject: str) -> tuple[Finding, ...]:
    """A finding where landmarks stand outside the bones that own them, by more than ``OFF_BONE_MM``.

    Those without an owner, or of a bone that the anatomy does not have, are not looked at; those inside a bone count
    as on it.
    """
    off = _off_mm(handles.owner, handles.source, anatomy)
    far = np.flatnonzero(off > OFF_BONE_MM)
    if not far.size:
        return ()
    worst = far[np.argsort(-off[far])][:3]
    named = ", ".join(f"{handles.names[k]} {off[k]:.3g} mm from {handles.owner[k]}" for k in worst)
    likely = _likely_cause(handles.source, lambda places: _off_mm(handles.owner, places, anatomy))
    likely = likely or "; where they are no markers on the skin, check their frame, units and bones"
    said = (
        f"{subject}: {len(far)} of {len(handles)} landmarks stand more than {OFF_BONE_MM:g} mm outside the bones that "
        f"they belong to ({named}{', ...' if len(far) > len(worst) else ''}){likely}"
    )
    return (Finding(subject, OFF_BONES, said),)


def off_surface_findings(
    names: Sequence[str], places: Points, surface: TriMesh, *, subject: str
) -> tuple[Finding, ...]:
    """A finding where landmarks stand outside a surface by more than ``OFF_BONE_MM``; inside is as good as on it.

    Parameters
    ----------
    names : sequence of str
    places : (m, 3) float64, mm
    surface : TriMesh
    subject : str
        What the landmarks are called.
    """
    off = _outside_mm(places, surface)
    far = np.flatnonzero(off > OFF_BONE_MM)
    if not far.size:
        return ()
    worst = int(far[np.argmax(off[far])])
    likely = _likely_cause(places, lambda tried: _outside_mm(tried, surface)) or "; check their frame and units"
    said = (
        f"{subject}: {len(far)} of {len(places)} landmarks stand more than {OFF_BONE_MM:g} mm outside the surface, "
        f"{names[worst]} {off[worst]:.3g} mm{likely}"
    )
    return (Finding(subject, OFF_SURFACE, said),)


def _likely_cause(places: Points, off_mm: Callable[[Points], Float]) -> str:
    """The error of frame or unit that would put every place where it belongs; empty where none would."""
    tried = [float(off_mm(places * np.array(by)).max()) for _, by in _EXPLAINED]
    best = int(np.argmin(tried))
    if tried[best] > OFF_BONE_MM:
        return ""
    return f"; all would be within {max(tried[best], 0.1):.2g} mm if {_EXPLAINED[best][0]}"


def _off_mm(owners: tuple[str, ...], places: Points, anatomy: Anatomy) -> Float:
    """How far each place is outside the bone that owns it, (m,) mm; 0 inside, and without a bone."""
    off = np.zeros(len(places))
    for bone in anatomy.of_kind(TissueKind.BONE):
        own = np.flatnonzero(np.array(owners) == bone.name)
        if own.size:
            off[own] = _outside_mm(places[own], bone.surface)
    return off


def _outside_mm(places: Points, surface: TriMesh) -> Float:
    """How far each place is outside a surface, (m,) mm; 0 inside."""
    off = np.zeros(len(places))
    outside = np.flatnonzero(winding_numbers(surface, places) < INSIDE)
    off[outside] = nearest_places(places[outside], surface).distances if outside.size else 0.0
    return off
