"""Rigid bones from landmarks: pairs of points that name bones in, each bone's best motion and its residual out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.anatomy.findings import Finding
from musclefit.errors import LandmarkError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion
from musclefit.geometry.similarity import Similarity
from musclefit.rig.handles import BoneMotions, Handles
from musclefit.rig.paths import ScrewMotions, turn_left_free

MIRROR_GAIN = 0.5
"""Landmarks are mirrored when a reflection misses their targets by less than this share of what a motion misses..."""

MIRROR_SHARE = 0.05
"""... and a motion misses them by more than this share of their spread: flatter ones can be mirrored by noise alone."""

ALL_MIRROR_GAIN, ALL_MIRROR_SHARE = 0.25, 0.15
"""The same for all landmarks together: soft tissue may press some through the plane of the others."""

HALF_TURN_DEG, HALF_TURN_SHARE = 30.0, 0.25
"""Targets are turned as RAS is against LPS when their best turn is within so many degrees of that, and what it misses
them by within so much of their spread."""


@dataclass(frozen=True, eq=False, slots=True)
class BoneFit:
    """The rigid motion that takes a bone's landmarks closest to their targets.

    Parameters
    ----------
    bone : str
    motion : RigidMotion
    names : (k,) tuple of str
        The landmarks.
    missed_mm : (k,) float64
        How far from its target the motion takes each.
    """

    bone: str
    motion: RigidMotion
    names: tuple[str, ...]
    missed_mm: Float

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals, mm."""
        return float(np.sqrt(np.mean(self.missed_mm**2)))

    @property
    def max_mm(self) -> float:
        """The largest residual, mm."""
        return float(self.missed_mm.max())

    @property
    def said(self) -> str:
        """The residual in words."""
        worst = self.names[int(np.argmax(self.missed_mm))]
        return (
            f"{self.bone}: the rigid motion that fits its {len(self.names)} landmarks best misses their targets by "
            f"{self.rms_mm:.3g} mm rms, {self.max_mm:.3g} mm at most ({worst}); they arrive where the motion takes them"
        )


@dataclass(frozen=True, eq=False, slots=True)
class RigidPath:
    """Landmarks of bones that move rigidly are carried; those of no bone go straight to their targets.

    Parameters
    ----------
    handles : Handles
    target : (m, 3) float64, mm
        Of no effect for those that are carried.
    motions : BoneMotions
    """

    handles: Handles
    target: Points
    motions: BoneMotions

    def __post_init__(self) -> None:
        object.__setattr__(self, "target", frozen(self.target))

    def position(self, t: float) -> Points:
        """(m, 3) handle positions at ``t``, mm."""
        moved = (1.0 - t) * self.handles.source + t * self.target
        owners = np.asarray(self.handles.owner)
        for bone, motion in self.motions.at(t).items():
            carried = owners == bone
            moved[carried] = motion(self.handles.source[carried])
        return moved


def fit_bones(handles: Handles, target: Points) -> tuple[BoneFit, ...]:
    """Fit a rigid motion to the landmarks of each bone that owns some.

    Parameters
    ----------
    handles : Handles
        With three or more of each bone, not on one line.
    target : (m, 3) float64, mm

    Raises
    ------
    LandmarkError
        No landmark names a bone; landmarks of a bone, or their targets, that leave its turn free; or targets that only
        a mirror reaches.
    """
    owners = np.asarray(handles.owner)
    bones = [bone for bone in dict.fromkeys(handles.owner) if bone]
    if not bones:
        raise LandmarkError(
            "bones.rigid: no landmark names its bone; add a column bone with three or more landmarks for each rigid "
            "bone, or write bones.rigid = false"
        )
    return tuple(_fit(bone, handles, target, owners == bone) for bone in bones)


def motions_of_fits(fits: Sequence[BoneFit]) -> ScrewMotions:
    """Every bone on the screw to where its landmarks take it."""
    return ScrewMotions({fit.bone: fit.motion for fit in fits})


def fit_findings(fits: Sequence[BoneFit]) -> tuple[Finding, ...]:
    """The residual of each bone."""
    return tuple(Finding(fit.bone, "bone-fit", fit.said) for fit in fits)


def _fit(bone: str, handles: Handles, target: Points, own: Points) -> BoneFit:
    source, target = handles.source[own], target[own]
    names = tuple(name for name, mine in zip(handles.names, own, strict=True) if mine)
    for places, what in ((source, "landmarks"), (target, "targets of the landmarks")):
        if turn_left_free(places):
            raise LandmarkError(
                f"bones.rigid: the {len(places)} {what} of bone {bone!r} ({', '.join(names[:4])}) leave its turn free; "
                "give three or more that are not on one line, or leave their column bone empty: then they go straight, "
                "and the bone follows the soft tissue"
            )
    motion = RigidMotion.fitted(source, target)
    fit = BoneFit(bone, motion, names, _distances(motion(source), target))
    flipped = source * (1.0, 1.0, -1.0)
    mirrored = BoneFit(bone, motion, names, _distances(RigidMotion.fitted(flipped, target)(flipped), target))
    spread = float(np.sqrt(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1))))
    if mirrored.rms_mm < MIRROR_GAIN * fit.rms_mm and fit.rms_mm > MIRROR_SHARE * spread:
        raise LandmarkError(
            f"bones.rigid: the targets of bone {bone!r} are a mirror image of its landmarks: a mirror misses them by "
            f"{mirrored.rms_mm:.3g} mm rms, a rigid motion by {fit.rms_mm:.3g} mm; expected no mirror: an axis has the "
            "other sign in one of the two files, or left and right are exchanged; export both in one frame (LPS or RAS)"
        )
    return fit


def refuse_mirror_image(source: Points, target: Points) -> None:
    """LandmarkError where targets, (m, 3) mm, are a mirror image of their landmarks: no one-to-one map is one.

    A similarity misses them by much, and one with a mirror by a small part of that.
    """
    flipped = source * (1.0, 1.0, -1.0)
    plain, mirrored = _missed(source, target), _missed(flipped, target)
    if mirrored < ALL_MIRROR_GAIN * plain and plain > ALL_MIRROR_SHARE * _spread(target):
        raise LandmarkError(
            f"the targets are a mirror image of the landmarks: a mirror (with one scale) misses them by {mirrored:.3g} "
            f"mm rms, a turn by {plain:.3g} mm; no map that keeps orientation is a mirror: an axis has the other sign "
            "in one of the two files, or left and right are exchanged; export both in one frame"
        )


def half_turn_findings(source: Points, target: Points, *, subject: str) -> tuple[Finding, ...]:
    """A finding where targets, (m, 3) mm, are turned about z by nearly 180 degrees: as RAS is against LPS."""
    rotation = Similarity.fitted(source, target).rotation
    off = float(np.degrees(Rotation.from_matrix(rotation @ np.diag([-1.0, -1.0, 1.0])).magnitude()))
    missed = _missed(source, target)
    if turn_left_free(source) or off > HALF_TURN_DEG or missed > HALF_TURN_SHARE * _spread(target):
        return ()
    said = (
        f"{subject}: the targets are turned by about 180 degrees about z against the landmarks (to {off:.0f} degrees), "
        "as RAS is against LPS; where that is not meant, export both in one coordinate system"
    )
    return (Finding(subject, "half-turn", said),)


def _missed(source: Points, target: Points) -> float:
    """How far the best similarity takes points from their targets, mm rms."""
    fit = Similarity.fitted(source, target)
    return _rms(_distances(fit.scale * source @ fit.rotation.T + fit.translation, target))


def _spread(points: Points) -> float:
    return _rms(_distances(points, points.mean(axis=0)))


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _distances(a: Points, b: Points) -> Float:
    found: Float = np.linalg.norm(a - b, axis=1)
    return found
