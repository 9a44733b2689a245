"""A job: takes a rig and what its files hold, gives all that one run needs, checked before long work; opens no file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from scipy.spatial import cKDTree

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import LandmarkError, MeshError, RigError
from musclefit.geometry.arrays import Points
from musclefit.geometry.measures import distances_from_box
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.crossings import self_crossings
from musclefit.rig.handles import BoneMotions, BonePath, Handles, Path, StraightPath
from musclefit.rig.joints import JointSystem
from musclefit.rig.lattice import ControlLattice
from musclefit.rig.paths import KeyframePath, ScrewPath
from musclefit.rig.settings import Rig
from musclefit.rig.table_reader import suggestion
from musclefit.rig.transforms import BoneTransforms, still_findings
from musclefit.vocabulary import PathKind

SAME_PLACE_MM = 1e-6
"""Handles closer than this are one place: no field can tell them apart at the default landmark limit."""

FAR_DIAGONALS = 1.0
"""Handles farther outside the anatomy than this many diagonals of its box are taken for a mistake in units or frame."""

SMALL_DIAGONALS = 1.0 / 300.0
"""Three or more handles that span less than this many diagonals are taken for metres read as millimetres."""


@dataclass(frozen=True, eq=False, slots=True)
class AttachedPoints:
    """Points of a file that the deformation takes along.

    Parameters
    ----------
    name : str
        The file's name.
    points : (k, 3) float64, mm
    rewrite : callable
        Writes the file with its points moved, (k, 3) mm, to a path; all else in it stays.
    """

    name: str
    points: Points
    rewrite: Callable[[Points, FilePath], None]


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Job:
    """Everything one run needs.

    Parameters
    ----------
    rig : Rig
        With the overrides applied and absolute paths.
    anatomy : Anatomy
        At rest, mm.
    findings : tuple of Finding
        What was noticed when reading; none of it was changed.
    handles : Handles
    path : Path
        From ``handles.source`` at 0 to the destinations at 1.
    motions : BoneMotions or None
        The rigid motion of every bone; None where neither joints, transforms nor landmarks of rigid bones drive.
    hashes : mapping of file to SHA-256
        Of every file that was read.
    name : str
        The rig file's name without suffix.
    source : str
        The rig file.
    joints : JointSystem or None
        For other poses of the same bones; None where no joint drives.
    overrides : tuple of str
        The ``key=value`` that changed the rig file's settings.
    lattice : ControlLattice or None
        The control points that drive; the handles are where they rest, and the path leads to where their splines take
        them. None where no lattice drives.
    further : tuple of AttachedPoints
        Files whose points go where the map takes them.
    stops : tuple of float
        Moments of the path's keyframes, which no step passes over.
    transforms : BoneTransforms or None
        For other times of the same bones; None where no transforms drive.
    pose : tuple of (str, float)
        The joints' angles at the destination, degrees; none where no joint drives.
    """

    rig: Rig
    anatomy: Anatomy
    findings: tuple[Finding, ...]
    handles: Handles
    path: Path
    motions: BoneMotions | None
    hashes: Mapping[str, str]
    name: str
    source: str
    joints: JointSystem | None = None
    overrides: tuple[str, ...] = ()
    lattice: ControlLattice | None = None
    further: tuple[AttachedPoints, ...] = ()
    stops: tuple[float, ...] = ()
    transforms: BoneTransforms | None = None
    pose: tuple[tuple[str, float], ...] = ()

    def __repr__(self) -> str:
        return f"Job({self.rig.title!r}: {self.anatomy!r}, {len(self.handles)} handles)"

    @property
    def title(self) -> str:
        """The rig's title and, where joints drive, the pose: ``"Right forearm: elbow 75°, turn 70°"``."""
        angles = ", ".join(f"{joint.replace('_', ' ')} {degrees:.6g}°" for joint, degrees in self.pose)
        return f"{self.rig.title}: {angles}" if angles else self.rig.title


def path_by_pairs(
    handles: Handles,
    target: Points,
    *,
    kind: PathKind = PathKind.STRAIGHT,
    keyframes: Sequence[tuple[float, Points]] = (),
) -> Path:
    """From the handles to ``target``, (m, 3) mm: on straight lines, through keyframes, or with their bones on screws.

    Raises
    ------
    LandmarkError
        Another number of targets than of handles, a target that is not finite, or screws where no bone owns handles
        that fix its turn.
    """
    if target.shape != handles.source.shape:
        raise LandmarkError(f"{len(handles)} handles have {len(target)} targets; give one target for each")
    bad = np.flatnonzero(~np.isfinite(target).all(axis=1))
    if bad.size:
        raise LandmarkError(f"the target of handle {handles.names[bad[0]]!r} is not finite: {target[bad[0]]}")
    if kind is PathKind.SCREWS:
        if not any(handles.owner):
            raise LandmarkError(
                "no landmark names a bone, so none can go on a screw; add a column bone, or write "
                'deformer.path = "straight"'
            )
        return ScrewPath(handles, target)
    if not keyframes:
        return StraightPath(handles.source, target)
    moments = (0.0, *(at for at, _ in keyframes), 1.0)
    return KeyframePath(moments, np.stack([handles.source, *(places for _, places in keyframes), target]))


def path_by_joints(handles: Handles, motions: BoneMotions, *, kind: PathKind, by: str = "joint") -> Path:
    """The handles on their bones: carried all the way, or straight to where the pose puts them (``straight``).

    ``by`` is what moves the bones, for messages.

    Raises
    ------
    LandmarkError
        A handle without a bone, or on one that has no motion.
    """
    known = motions.at(0.0)
    for name, owner in zip(handles.names, handles.owner, strict=True):
        if not owner:
            raise LandmarkError(f"landmark {name!r} names no bone; {by}s move bones, so give it one (column bone)")
        if owner not in known:
            raise LandmarkError(
                f"landmark {name!r} belongs to bone {owner!r}, which no {by} moves or fixes; {suggestion(owner, known)}"
            )
    carried = BonePath(handles, motions)
    return StraightPath(handles.source, carried.position(1.0)) if kind is PathKind.STRAIGHT else carried


def cage_handles(source: TriMesh, target: TriMesh) -> tuple[Handles, Points]:
    """The vertices of a cage as handles (``cage_0``, ``cage_1``, ...) and where they go.

    Raises
    ------
    MeshError
        Cages with different numbers of vertices, or with different triangles.
    """
    counts = len(source.vertices), len(target.vertices)
    if counts[0] != counts[1]:
        raise MeshError(
            f"the source cage has {counts[0]} vertices, the target cage {counts[1]}; both must have the same vertices "
            "in the same order"
        )
    if source.faces.shape != target.faces.shape:
        raise MeshError(
            f"the source cage has {len(source.faces)} triangles, the target cage {len(target.faces)}; both must have "
            "the same triangles"
        )
    differing = np.flatnonzero((source.faces != target.faces).any(axis=1))
    if differing.size:
        first = int(differing[0])
        raise MeshError(
            f"{differing.size} of {len(source.faces)} triangles of the two cages differ; the first is number {first}: "
            f"{source.faces[first].tolist()} in the source, {target.faces[first].tolist()} in the target; both must "
            "have the same triangles in the same order"
        )
    names = tuple(f"cage_{k}" for k in range(counts[0]))
    return Handles(names, source.vertices, ("",) * counts[0]), target.vertices


def cage_crossings(cage: TriMesh, *, name: str) -> tuple[Finding, ...]:
    """One finding ("cage-crossing") for each pair of triangles of a cage that cross: their numbers, corners and place.

    Nothing about vertex pairs needs a cage without crossings, but where it crosses itself two parts of the body are
    sent into each other, and the map cannot follow the cage's surface there.
    """
    found = self_crossings(cage)
    return tuple(
        Finding(
            name,
            "cage-crossing",
            f"{name}: triangles {a} {cage.faces[a].tolist()} and {b} {cage.faces[b].tolist()} cross near "
            f"({_place(place)}) mm",
        )
        for (a, b), place in zip(found.pairs.tolist(), found.places, strict=True)
    )


def check_handles(handles: Handles, path: Path, *, anatomy: Anatomy, stops: Sequence[float] = ()) -> None:
    """Raise LandmarkError when the handles cannot drive this anatomy: cheap, so that long work does not fail late.

    Two handles at one place, sent to one place or there at once at a keyframe, a bone that the anatomy does not have,
    handles far outside the anatomy, or handles so close together that they are likely in other units.
    """
    check_owners(handles, anatomy)
    _require_apart(handles, handles.source, said="stand at one place")
    _require_apart(handles, path.position(1.0), said="are sent to one place")
    for at in stops:
        _require_apart(handles, path.position(at), said=f"are sent to one place at {at:g} of the way")
    _require_near(handles, anatomy)


def check_owners(handles: Handles, anatomy: Anatomy) -> None:
    """Raise LandmarkError at a handle that belongs to a bone which the anatomy does not have."""
    bones = [tissue.name for tissue in anatomy.of_kind(TissueKind.BONE)]
    for name, owner in zip(handles.names, handles.owner, strict=True):
        if owner and owner not in bones:
            raise LandmarkError(
                f"landmark {name!r} belongs to bone {owner!r}, which the anatomy does not have; "
                f"{suggestion(owner, bones)}"
            )


def joint_findings(anatomy: Anatomy, joints: JointSystem, *, subject: str) -> tuple[Finding, ...]:
    """One finding that names the bones of the anatomy that no joint fixes or moves, if there are any."""
    if joints.still:
        message = (
            f"{len(joints.still)} bones are neither fixed nor moved by a joint and stay where they are: "
            f"{', '.join(joints.still)}"
        )
        return (Finding(subject, "bone-without-joint", message),)
    return still_findings(
        anatomy,
        joints.bones(),
        subject=subject,
        said="are neither fixed nor moved by a joint",
        code="bone-without-joint",
    )


def require_bones(anatomy: Anatomy, joints: JointSystem) -> None:
    """Raise RigError unless every bone of the joints is a bone of the anatomy."""
    bones = [tissue.name for tissue in anatomy.of_kind(TissueKind.BONE)]
    if not bones:
        raise RigError(
            f"{joints.source}: joints move bones, but the anatomy has none; set kinds in [anatomy.kinds], "
            'for example "femur*" = "bone"'
        )
    joints.check_bones(bones)


def _require_apart(handles: Handles, places: Points, *, said: str) -> None:
    if len(places) < 2:
        return
    found = cKDTree(places).query(places, k=2)
    distances, neighbours = np.asarray(found[0]), np.asarray(found[1])
    first = int(np.argmin(distances[:, 1]))
    if distances[first, 1] >= SAME_PLACE_MM:
        return
    other = int(next(k for k in neighbours[first] if k != first))
    a, b = sorted((first, other))
    raise LandmarkError(
        f"landmarks {handles.names[a]!r} and {handles.names[b]!r} {said}, ({_place(places[a])}) mm, "
        f"{np.linalg.norm(places[a] - places[b]):.2g} mm apart; remove or correct one"
    )


def _require_near(handles: Handles, anatomy: Anatomy) -> None:
    vertices = anatomy.vertices()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    outside = distances_from_box(handles.source, vertices)
    worst = int(np.argmax(outside))
    if outside[worst] > FAR_DIAGONALS * diagonal:
        raise LandmarkError(
            f"landmark {handles.names[worst]!r} at ({_place(handles.source[worst])}) mm is {outside[worst]:.4g} mm "
            f"outside the anatomy, whose box from ({_place(low)}) to ({_place(high)}) mm has a diagonal of "
            f"{diagonal:.4g} mm; likely wrong units or another frame: state drive.units and anatomy.units"
        )
    span = float(np.linalg.norm(np.ptp(handles.source, axis=0)))
    if len(handles) >= 3 and span < SMALL_DIAGONALS * diagonal:
        raise LandmarkError(
            f"the {len(handles)} landmarks span {span:.4g} mm of an anatomy with a diagonal of {diagonal:.4g} mm; "
            'likely wrong units: state drive.units (for example "m") and anatomy.units'
        )


def _place(point: Points) -> str:
    return ", ".join(f"{x:.6g}" for x in point)
