"""What lies between two frames: given triangles that meet are looked at with finer ones, in poses on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from musclefit.anatomy.model import Anatomy
from musclefit.errors import MusclefitError
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.surface_refinement import MAX_ROUNDS, bent_edges, split_bent
from musclefit.geometry.arrays import Points
from musclefit.geometry.queries.solids import ROUNDING_MM3
from musclefit.geometry.surfaces.subdivision import FaceEdges, with_short_edges
from musclefit.pipeline.chosen_settings import surface_choices
from musclefit.pipeline.poses import collision_in_words, collision_on_the_way
from musclefit.pipeline.proving import proved
from musclefit.pipeline.refining import deform_finely
from musclefit.pipeline.retarget import motions_of_held_bones
from musclefit.pipeline.sequence import Stage, posed_job
from musclefit.progress import Silent
from musclefit.rig.motion import Pose
from musclefit.validate.between_frames import Passage, check_passages
from musclefit.validate.close_meetings import Look, MeetingKind, Names, Posed, Refined, looked_at, told_by_frames
from musclefit.validate.tissues import Motion

MAX_POSES = 7
"""Poses that are made for one pair of frames, both frames counted: each costs what a frame's march and proof do."""

MAX_PAIRS = 24
"""Pairs of tissues that are looked at closer between two frames, those that no frame shows first; what is beyond is
told as not settled, unless its second frame shows it."""

SAME_MM = 1e-6
"""A frame that is made again must be where it was up to this."""

MAX_TRIANGLES = 600_000
"""Two tissues are cut into no more triangles than this."""


class PoseError(MusclefitError):
    """Two tissues cannot be looked at in a pose on the way."""


@dataclass(frozen=True, slots=True)
class Between:
    """What lies between two frames.

    Parameters
    ----------
    meetings : tuple of (Passage, Look)
        Every pair of tissues whose given triangles meet, and what that turns out to be. Where there is none, it is
        proved that no given triangles meet on straight ways.
    pairs_examined : int
        Of primitives.
    """

    meetings: tuple[tuple[Passage, Look], ...]
    pairs_examined: int


def between_frames(stage: Stage, poses: tuple[Pose, Pose], ends: tuple[Anatomy, Anatomy]) -> Between:
    """Examine what lies between two frames.

    Parameters
    ----------
    stage : Stage
    poses : two Poses
        Of the frames, the earlier first.
    ends : two Anatomies
        The frames on the given triangles.

    Raises
    ------
    InputError
        ipctk is not installed, or the frames have different tissues.
    """
    found = check_passages(*ends, progress=Silent())
    way = PosesOnTheWay(stage, poses, ends)
    looks: dict[Passage, Look] = {}
    for passage in sorted(found.passages, key=lambda passage: not passage.hidden):
        if way.pairs < MAX_PAIRS:
            looks[passage] = looked_at(passage, stage.job.anatomy, way)
        else:
            looks[passage] = told_by_frames(passage, stage.job.anatomy) or _unlooked(passage)
    return Between(tuple((passage, looks[passage]) for passage in found.passages), found.pairs_examined)


def _unlooked(passage: Passage) -> Look:
    """What is left when no more pairs are looked at: an overlap of given triangles in the second frame, or nothing."""
    kind = MeetingKind.ENTERS if passage.overlap_after_mm3 > ROUNDING_MM3 else MeetingKind.UNSETTLED
    return Look(kind, note=f"{MAX_PAIRS} other pairs were looked at closer between these frames, and no more are")


@dataclass(frozen=True, eq=False, slots=True)
class _Map:
    """A map, and the bones that go by motions of their own."""

    deformation: Deformation
    held: Mapping[str, Motion]

    def moved(self, name: str, points: Points) -> Points:
        """Where (N, 3) points of a tissue are, mm."""
        return self.held[name](points) if name in self.held else self.deformation(points)


class PosesOnTheWay:
    """Tissues in poses between two frames, made from rest like frames; joints turn evenly from frame to frame.

    Each pose is marched once, whatever pairs are looked at, and no more than `MAX_POSES` are.
    """

    def __init__(self, stage: Stage, poses: tuple[Pose, Pose], ends: tuple[Anatomy, Anatomy]) -> None:
        self._stage, self._ends = stage, ends
        self._first, self._second = poses
        self._maps: dict[float, _Map | MusclefitError] = {}
        self._pairs: set[Names] = set()

    @property
    def pairs(self) -> int:
        """Pairs of tissues that were looked at."""
        return len(self._pairs)

    def can_make(self, moments: Sequence[float]) -> bool:
        """Whether the poses at these fractions of the way are there already or may still be made."""
        return len({*self._maps, *moments}) <= MAX_POSES

    def pose(self, moment: float) -> Pose:
        """The pose at a fraction of the way."""
        first, second = self._first, self._second
        if moment in (0.0, 1.0):
            return second if moment else first
        target = second.angles
        degrees = tuple((name, (1.0 - moment) * angle + moment * target[name]) for name, angle in first.degrees)
        return Pose(first.number, (1.0 - moment) * first.time_s + moment * second.time_s, degrees)

    def refined(self, names: Names, moments: Sequence[float], *, fineness: int) -> Refined:
        """Two tissues at fractions of the way, cut finer at rest where a map of one of these poses bends them.

        Each step of fineness halves the longest edge that the rig allows, and quarters its chord tolerance.

        Raises
        ------
        MusclefitError
            The bones cannot take a pose on the way, the method does not reach it, its rule fails at a vertex of the
            finer surfaces, or they would have too many triangles.
        """
        self._pairs.add(names)
        chosen = surface_choices(self._stage.job)
        chord, lengths = chosen.chord_mm / 4**fineness, chosen.longest.scaled(0.5**fineness)
        longest = lengths.most_mm
        maps = [self._map(moment) for moment in moments]
        given = self._stage.job.anatomy
        tissues = []
        for name in names:
            surface = with_short_edges(given[name].surface, longest_mm=lengths)
            bending = [map_.deformation for map_ in maps if name not in map_.held]
            known = [deformation.jacobian(surface.vertices) for deformation in bending]
            for _ in range(MAX_ROUNDS):
                if len(surface.faces) > MAX_TRIANGLES // 2:
                    raise PoseError(
                        f"{name} would need more than {MAX_TRIANGLES // 2} triangles to be looked at with edges of "
                        f"{longest:.3g} mm and a chord tolerance of {chord:.3g} mm"
                    )
                edges = FaceEdges.of(surface.faces)
                bent = np.zeros(len(edges.ends), dtype=bool)
                for jacobians in known:
                    bent |= bent_edges(edges, surface.vertices, jacobians, tolerance_mm=chord)
                if not bent.any():
                    break
                before, surface = len(surface.vertices), split_bent(surface, edges, bent)
                fresh = [deformation.jacobian(surface.vertices[before:]) for deformation in bending]
                known = [np.concatenate([old, new]) for old, new in zip(known, fresh, strict=True)]
            else:
                raise PoseError(
                    f"{name} is still bent by more than {chord:.3g} mm between vertices after {MAX_ROUNDS} rounds of "
                    "splitting"
                )
            tissues.append(replace(given[name], surface=surface))
        rest = Anatomy(tuple(tissues), given.frame)
        for number, moment in enumerate((0.0, 1.0)):
            self._require_frame(self._ends[number], self._map(moment), names)
        posed = tuple(Posed(_posed(rest, map_), map_.deformation.with_jacobian) for map_ in maps)
        return Refined(rest, posed, chord, longest)

    def _map(self, moment: float) -> _Map:
        if moment not in self._maps:
            try:
                self._maps[moment] = self._marched(self.pose(moment))
            except MusclefitError as error:
                self._maps[moment] = error
        made = self._maps[moment]
        if isinstance(made, MusclefitError):
            raise made
        return made

    def _require_frame(self, frame: Anatomy, map_: _Map, names: Names) -> None:
        """Raise where a frame is not what the map makes of it: then the map's way says nothing about it."""
        for name in names:
            made = map_.moved(name, self._stage.job.anatomy[name].surface.vertices)
            off = float(np.linalg.norm(made - frame[name].surface.vertices, axis=1).max())
            if not off <= SAME_MM:
                raise PoseError(f"{name} is up to {off:.3g} mm off in a frame from where the map takes it")

    def _marched(self, pose: Pose) -> _Map:
        job = posed_job(self._stage.job, pose)
        collision = collision_on_the_way(job, self._stage.bones)
        if collision is not None:
            raise PoseError(f"the pose at {pose.said} is refused: {collision_in_words(job, collision)}")
        made = proved(deform_finely(job, progress=Silent()), job, progress=Silent())[0].deformed
        if made.deformation.status is not Status.CONVERGED:
            raise PoseError(f"the method does not reach the pose at {pose.said}: {made.deformation.status.value}")
        return _Map(made.deformation, motions_of_held_bones(job, made))


def _posed(rest: Anatomy, map_: _Map) -> Anatomy:
    return rest.with_vertices(np.concatenate([map_.moved(t.name, t.surface.vertices) for t in rest]))
