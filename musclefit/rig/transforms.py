"""Rigid transforms of bones at times: matrices or quaternions in, the bones' motions at any time out; knows no file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, Points, frozen
from musclefit.geometry.rigid import RigidMotion
from musclefit.rig.chain import ChainMotions, carriers_of, some_of
from musclefit.rig.motion import Pose
from musclefit.rig.paths import ScrewMotions
from musclefit.rig.table_reader import suggestion
from musclefit.vocabulary import PathKind

ROTATION_TOLERANCE = 1e-3
"""Farthest that a matrix may be from a rotation: by how much of itself it may change a length."""

SAID_DEVIATION = 1e-9
"""Deviations above this, which is more than rounding in double precision leaves, are told."""

LAST_ROW = 1e-9
"""How far the last row of a 4x4 matrix may be from (0, 0, 0, 1)."""

LARGEST_ENTRY = 1e3
"""Entries of a rotation beyond this are not worth a singular value decomposition."""

FARTHEST_MM = 1e7
"""Longest translation; with longer ones rounding alone would move bones by 1e-9 mm."""

FAR_DIAGONALS = 20.0
"""A bone that is sent farther than this many diagonals of the anatomy's box is taken for a mistake in units."""


@dataclass(frozen=True, eq=False, slots=True)
class Given:
    """One transform of a file.

    Parameters
    ----------
    bone : str
    time_s : float or None
        None where the file states no times.
    place : str
        Where it stands in the file, for messages: "line 3".
    motion : RigidMotion
        From rest to the pose, mm.
    deviation : float
        How far what was written is from the rotation that it was taken for.
    """

    bone: str
    time_s: float | None
    place: str
    motion: RigidMotion
    deviation: float

    @property
    def said(self) -> str:
        """Bone and time in words."""
        return said(self.bone, self.time_s)


def said(bone: str, time_s: float | None) -> str:
    """Bone and time in words: ``bone 'radius' at 0.2 s``."""
    return f"bone {bone!r}" + ("" if time_s is None else f" at {time_s:g} s")


def motion_of_matrix(matrix: Float, *, place: str) -> tuple[RigidMotion, float]:
    """The motion that a homogeneous matrix writes, with the rotation nearest to its upper left part.

    Parameters
    ----------
    matrix : (4, 4) float64
        Row-major, the translation in mm in the last column.
    place : str
        File, place in it, bone and time, for messages.

    Returns
    -------
    RigidMotion
    float
        The deviation: largest difference of a singular value from 1, by which lengths are off.

    Raises
    ------
    InputError
        A value that is not finite or huge, another last row than (0, 0, 0, 1), or a matrix that mirrors, scales or
        shears by more than ``ROTATION_TOLERANCE``; the message says by how much.
    """
    if not np.isfinite(matrix).all():
        raise InputError(f"{place}: holds {matrix[~np.isfinite(matrix)][0]}; expected finite numbers, correct it")
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > LAST_ROW:
        row = ", ".join(f"{x:.6g}" for x in matrix[3])
        transposed = not matrix[:3, 3].any() and abs(matrix[3, 3] - 1.0) <= LAST_ROW
        hint = "it is written column by column: transpose it" if transposed else "correct it"
        raise InputError(f"{place}: the last row is ({row}); expected (0, 0, 0, 1), row by row; {hint}")
    linear = matrix[:3, :3]
    largest = float(np.abs(linear).max())
    if largest > LARGEST_ENTRY:
        raise InputError(f"{place}: the rotation holds {largest:.3g}; expected entries from -1 to 1; correct it")
    left, sizes, right = np.linalg.svd(linear)
    determinant, deviation = float(np.linalg.det(linear)), float(np.abs(sizes - 1.0).max())
    if determinant < 0.0:
        raise InputError(
            f"{place}: determinant {determinant:.6g}: a mirror; expected a rotation, determinant 1; express both poses "
            "in one right-handed frame (LPS and RAS both are)"
        )
    if deviation > ROTATION_TOLERANCE:
        even = sizes[0] - sizes[2] <= ROTATION_TOLERANCE * sizes[0]
        what = f"it scales by {sizes.mean():.6g}" if even else "it shears or scales unevenly"
        raise InputError(
            f"{place}: largest deviation from a rotation {deviation:.3g} ({what}); expected at most "
            f"{ROTATION_TOLERANCE:g}; give rigid transforms"
        )
    return RigidMotion(left @ right, _translation(matrix[:3, 3], place)), deviation


def motion_of_quaternion(wxyz: Float, translation_mm: Points, *, place: str) -> tuple[RigidMotion, float]:
    """The motion of a unit quaternion (w, x, y, z) and a translation, mm; and how far its length is from 1.

    Raises
    ------
    InputError
        A value that is not finite or huge, or a length that differs from 1 by more than ``ROTATION_TOLERANCE``.
    """
    values = np.concatenate([wxyz, translation_mm])
    if not np.isfinite(values).all():
        raise InputError(f"{place}: holds {values[~np.isfinite(values)][0]}; expected finite numbers, correct it")
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(wxyz))
    if not abs(length - 1.0) <= ROTATION_TOLERANCE:
        raise InputError(
            f"{place}: the quaternion's length is {length:.6g}; expected 1, off by at most {ROTATION_TOLERANCE:g}; "
            "normalise it, or correct the columns"
        )
    rotation = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
    return RigidMotion(rotation, _translation(translation_mm, place)), abs(length - 1.0)


def _translation(translation_mm: Points, place: str) -> Points:
    farthest = float(np.abs(translation_mm).max())
    if farthest > FARTHEST_MM:
        raise InputError(
            f"{place}: the translation holds {farthest:.3g} mm; expected at most {FARTHEST_MM:g} mm; correct it or its "
            "units"
        )
    return translation_mm


@dataclass(frozen=True, eq=False, slots=True)
class Track:
    """One bone's motions at its times, and between two of them along the screw that leads from one to the other.

    Parameters
    ----------
    times_s : (k,) float64, rising
    motions : (k,) tuple of RigidMotion
    """

    times_s: Float
    motions: tuple[RigidMotion, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "times_s", frozen(self.times_s))

    def at(self, time_s: float) -> RigidMotion:
        """The motion at a time from the first to the last; exactly the one given where one is."""
        later = int(np.searchsorted(self.times_s, time_s))
        if self.times_s[later] == time_s:
            return self.motions[later]
        before, after = self.motions[later - 1], self.motions[later]
        share = (time_s - self.times_s[later - 1]) / (self.times_s[later] - self.times_s[later - 1])
        return (after @ before.inverse()).fraction(float(share)) @ before


@dataclass(frozen=True, eq=False, slots=True)
class BoneTransforms:
    """The rigid motions of bones, in one pose or over time.

    Parameters
    ----------
    tracks : mapping of bone name to Track
        Of one pose at time 0 where ``timed`` is false.
    source : str
        The file, for messages.
    timed : bool
        Whether the file states times.
    frame : str
        "LPS" or "RAS" where the file says so, else "".
    findings : tuple of Finding
    carriers : mapping of bone name to bone name
        Whom each bone goes along with on the way (`musclefit.rig.chain`); empty where no anatomy is known.

    Raises
    ------
    InputError
        No bone, or bones that have no time in common.
    """

    tracks: Mapping[str, Track]
    source: str
    timed: bool
    frame: str = ""
    findings: tuple[Finding, ...] = ()
    carriers: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.tracks:
            raise InputError(f"{self.source}: holds no transform; give at least one bone's")
        if self.first_s > self.last_s:
            late = max(self.tracks, key=lambda bone: self.tracks[bone].times_s[0])
            early = min(self.tracks, key=lambda bone: self.tracks[bone].times_s[-1])
            raise InputError(
                f"{self.source}: {said(late, self.first_s)} begins after {said(early, self.last_s)} ends; give times "
                "that all bones have"
            )

    @classmethod
    def of(cls, given: Sequence[Given], *, source: str, frame: str = "") -> BoneTransforms:
        """Put a file's transforms in order of bones and times.

        Raises
        ------
        InputError
            A bone twice at one time (or twice where no time is stated), or times of some transforms alone.
        """
        timed = [one for one in given if one.time_s is not None]
        if timed and len(timed) < len(given):
            without = next(one for one in given if one.time_s is None)
            raise InputError(
                f"{source}: {without.place}: {without.said} states no time, but {timed[0].said} does ("
                f"{timed[0].place}); give every transform its time_s, or none"
            )
        by_bone: dict[str, list[Given]] = {}
        for one in given:
            by_bone.setdefault(one.bone, []).append(one)
        tracks = {}
        for bone, own in by_bone.items():
            own.sort(key=lambda one: one.time_s or 0.0)
            for before, after in pairwise(own):
                if before.time_s == after.time_s:
                    column = "" if timed else "give each its time_s, or "
                    raise InputError(
                        f"{source}: {before.said} stands twice, at {before.place} and {after.place}; {column}remove one"
                    )
            tracks[bone] = Track(np.array([one.time_s or 0.0 for one in own]), tuple(one.motion for one in own))
        findings = (*_deviation_findings(given, source), *_gap_findings(tracks, source))
        return cls(tracks, source, bool(timed), frame, findings)

    @property
    def first_s(self) -> float:
        """The first time that every bone has, s."""
        return max(float(track.times_s[0]) for track in self.tracks.values())

    @property
    def last_s(self) -> float:
        """The last time that every bone has, s."""
        return min(float(track.times_s[-1]) for track in self.tracks.values())

    @property
    def times_s(self) -> Float:
        """(k,) times of the file from the first to the last that every bone has, s."""
        every = np.unique(np.concatenate([track.times_s for track in self.tracks.values()]))
        return every[(every >= self.first_s) & (every <= self.last_s)]

    def bones(self) -> tuple[str, ...]:
        """The bones that have transforms."""
        return tuple(self.tracks)

    def at(self, time_s: float) -> Mapping[str, RigidMotion]:
        """The motion of every bone from rest to its pose at a time.

        Raises
        ------
        InputError
            A time that some bone does not have.
        """
        if not self.first_s <= time_s <= self.last_s:
            raise InputError(
                f"{self.source}: asked for {time_s:g} s; its bones are known from {self.first_s:g} to {self.last_s:g} s"
            )
        return {bone: track.at(time_s) for bone, track in self.tracks.items()}

    def relative_to(self, time_s: float) -> BoneTransforms:
        """The motions from the bones' poses at a time, where the anatomy rests; exactly the identity at that time.

        Raises
        ------
        InputError
            A time that some bone does not have, or transforms without times.
        """
        self.require_times()
        rest = self.at(time_s)
        tracks = {}
        for bone, track in self.tracks.items():
            back = rest[bone].inverse()
            moved = dict(zip(track.times_s.tolist(), (motion @ back for motion in track.motions), strict=True))
            moved[time_s] = RigidMotion.identity()
            times = sorted(moved)
            tracks[bone] = Track(np.array(times), tuple(moved[time] for time in times))
        return replace(self, tracks=tracks)

    def carrying(self, carriers: Mapping[str, str]) -> BoneTransforms:
        """The same, and further bones (by name) that move with one of these."""
        return replace(self, tracks={**self.tracks, **{bone: self.tracks[by] for bone, by in carriers.items()}})

    def chained(self, anatomy: Anatomy) -> BoneTransforms:
        """The same, with the bones jointed as the anatomy at rest and all poses say."""
        poses = [self.at(float(time)) for time in self.times_s]
        return replace(self, carriers=carriers_of(anatomy, some_of(poses)))

    def motions(self, time_s: float | None, *, kind: PathKind) -> ScrewMotions | ChainMotions:
        """The bones' way to their poses at a time, the last where it is None.

        On a chain each bone is on the screw against its carrier, else on its own from rest.

        Raises
        ------
        InputError
            A time that some bone does not have, or one where the file states none.
        """
        if time_s is not None:
            self.require_times()
        final = self.at(self.last_s if time_s is None else time_s)
        return ChainMotions(final, self.carriers) if kind is PathKind.CHAIN else ScrewMotions(final)

    def require_times(self) -> None:
        """Raise InputError where the file states no times."""
        if not self.timed:
            raise InputError(f"{self.source}: states no times, so there is one pose alone; add time_s, or ask for none")

    def frames(self, count: int) -> tuple[Pose, ...]:
        """The poses at the file's own times (0), or ``count`` poses evenly spaced in time, first and last included.

        Raises
        ------
        InputError
            Fewer than two frames, or no times.
        """
        self.require_times()
        times = self.times_s if count == 0 else np.linspace(self.first_s, self.last_s, max(count, 0))
        if len(times) < 2 or self.first_s == self.last_s:
            found = f"{len(times)} frames" if count else f"{len(times)} times that all bones have"
            raise InputError(f"{self.source}: found {found}; a sequence needs at least 2, at times that differ")
        return tuple(Pose(k, float(time), ()) for k, time in enumerate(times))

    def resampling_in_words(self, count: int) -> str:
        """How frames are made of the transforms, for reports."""
        times = self.times_s
        kept = "one frame at each" if count == 0 else f"{count} frames evenly spaced in time"
        return (
            f"transforms of {len(self.tracks)} bones at {len(times)} times, between them each bone on the screw from "
            f"one to the next, {kept} from {self.first_s:g} s to {self.last_s:g} s"
        )

    def digest(self) -> str:
        """SHA-256 of bones, times and motions."""
        found = sha256()
        for bone, track in self.tracks.items():
            found.update(bone.encode() + track.times_s.tobytes())
            for motion in track.motions:
                found.update(motion.rotation.tobytes() + motion.translation.tobytes())
        return found.hexdigest()

    def check_bones(self, anatomy: Anatomy) -> None:
        """Raise InputError unless every bone is a bone of the anatomy and stays within sight of it."""
        bones = {tissue.name: tissue for tissue in anatomy.of_kind(TissueKind.BONE)}
        kinds = {tissue.name: tissue.kind.value for tissue in anatomy}
        for bone in self.tracks:
            if bone in bones:
                continue
            if bone in kinds:
                raise InputError(
                    f"{self.source}: {bone!r} is of kind {kinds[bone]!r}, and transforms move bones; name bones, or "
                    "set its kind in [anatomy.kinds]"
                )
            raise InputError(f"{self.source}: the anatomy has no bone {bone!r}; {suggestion(bone, bones)}")
        vertices = anatomy.vertices()
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        for bone, track in self.tracks.items():
            centre = bones[bone].surface.vertices.mean(axis=0)
            for time, motion in zip(track.times_s.tolist(), track.motions, strict=True):
                far = float(np.linalg.norm(motion(centre[None])[0] - centre))
                if far > FAR_DIAGONALS * diagonal:
                    raise InputError(
                        f"{self.source}: {said(bone, time if self.timed else None)} is sent {far:.4g} mm away; the "
                        f"anatomy's box has a diagonal of {diagonal:.4g} mm: likely wrong units (drive.units), or "
                        "motions that do not start from the anatomy's rest (drive.reference_time_s)"
                    )


def still_findings(
    anatomy: Anatomy, bones: Sequence[str], *, subject: str, said: str, code: str
) -> tuple[Finding, ...]:
    """One finding that names the bones of the anatomy that have no motion of their own, if there are any.

    Parameters
    ----------
    bones : sequence of str
        Those that have one.
    said : str
        What the others lack, in words.
    code : str
        Of the finding.
    """
    free = [t.name for t in anatomy.of_kind(TissueKind.BONE) if t.name not in bones]
    if not free:
        return ()
    return (Finding(subject, code, f"{len(free)} bones {said} and follow the soft tissue: {', '.join(free)}"),)


def _deviation_findings(given: Sequence[Given], source: str) -> tuple[Finding, ...]:
    off = [one for one in given if one.deviation > SAID_DEVIATION]
    if not off:
        return ()
    worst = max(off, key=lambda one: one.deviation)
    message = (
        f"{len(off)} of {len(given)} transforms are not exactly rotations, the most {worst.said} ({worst.place}): "
        f"off by {worst.deviation:.2g}, {1e3 * worst.deviation:.2g} mm at 1 m from the coordinates' origin; each is "
        "taken for the nearest rotation, with its translation as given"
    )
    return (Finding(Path(source).name, "projected-rotation", message),)


def _gap_findings(tracks: Mapping[str, Track], source: str) -> tuple[Finding, ...]:
    """One finding that names bones which lack times that others have."""
    every = np.unique(np.concatenate([track.times_s for track in tracks.values()])) if tracks else np.zeros(0)
    lacking = {bone: len(every) - len(track.times_s) for bone, track in tracks.items()}
    lacking = {bone: count for bone, count in lacking.items() if count}
    if not lacking:
        return ()
    named = ", ".join(f"{bone} {count}" for bone, count in lacking.items())
    message = (
        f"of {len(every)} times some bones lack some: {named}; between its own times each bone is on the screw from "
        "one to the next, and times outside of what all bones have are left out"
    )
    return (Finding(Path(source).name, "missing-times", message),)
