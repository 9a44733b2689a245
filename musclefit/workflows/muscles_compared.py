"""Muscles of an OpenSim model before and after it was carried to another body, over a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh
from musclefit.io.formats.osim import OpenSimModel, parse_osim
from musclefit.io.opensim_muscles import MusclePaths, crossed_coordinates, muscle_paths
from musclefit.muscles.paths_in_bone import Bones, InBone
from musclefit.progress import Progress
from musclefit.rig.multibody import CoordinateKind

ARM_MM = 1.0
"""A moment arm that changes its sign is only told where it is at least this long before and after."""


@dataclass(frozen=True, eq=False, slots=True)
class MusclesCompared:
    """Muscles in the poses of a motion, of the model as it was and as it was carried.

    Parameters
    ----------
    times_s : (k,) float64
    before, after : MusclePaths
    in_bone_before, in_bone_after : tuple of k tuples of m InBone
    turning : frozenset of str
        Coordinates that are angles.
    """

    times_s: Float
    before: MusclePaths
    after: MusclePaths
    in_bone_before: tuple[tuple[InBone, ...], ...]
    in_bone_after: tuple[tuple[InBone, ...], ...]
    turning: frozenset[str]

    def muscle_rows(self) -> list[dict[str, Any]]:
        """Of each muscle the range over the motion, and the most of its path that is in bone, mm."""
        rows = []
        for k, name in enumerate(self.before.muscles):
            row: dict[str, Any] = {"muscle": name}
            for when, paths, in_bone in self._both():
                row |= {
                    f"shortest_{when}_mm": float(paths.lengths_mm[:, k].min()),
                    f"longest_{when}_mm": float(paths.lengths_mm[:, k].max()),
                }
                deepest = max((pose[k] for pose in in_bone), key=lambda found: found.depth_mm)
                row |= {
                    f"in_bone_{when}_mm": max(pose[k].length_mm for pose in in_bone),
                    f"depth_{when}_mm": deepest.depth_mm,
                    f"bone_{when}": deepest.bone,
                }
            rows.append(row)
        return rows

    def arm_rows(self) -> list[dict[str, Any]]:
        """Of each muscle and angle that it crosses the range of the moment arm, its largest change, and flips, mm."""
        rows = []
        for k, (muscle, coordinate) in enumerate(self.before.pairs):
            if coordinate not in self.turning:
                continue
            old, new = self.before.arms_mm[:, k], self.after.arms_mm[:, k]
            turned = (old * new < 0.0) & (np.minimum(np.abs(old), np.abs(new)) >= ARM_MM)
            rows.append(
                {
                    "muscle": muscle,
                    "coordinate": coordinate,
                    "least_before_mm": float(old.min()),
                    "most_before_mm": float(old.max()),
                    "least_after_mm": float(new.min()),
                    "most_after_mm": float(new.max()),
                    "largest_change_mm": float(np.abs(new - old).max()),
                    "poses_of_other_sign": int(turned.sum()),
                }
            )
        return rows

    def pose_rows(self) -> list[dict[str, Any]]:
        """Each muscle in each pose, mm."""
        return [
            {
                "time_s": float(time),
                "muscle": name,
                "length_before_mm": float(self.before.lengths_mm[row, k]),
                "length_after_mm": float(self.after.lengths_mm[row, k]),
                "in_bone_before_mm": self.in_bone_before[row][k].length_mm,
                "in_bone_after_mm": self.in_bone_after[row][k].length_mm,
                "depth_before_mm": self.in_bone_before[row][k].depth_mm,
                "depth_after_mm": self.in_bone_after[row][k].depth_mm,
            }
            for row, time in enumerate(self.times_s)
            for k, name in enumerate(self.before.muscles)
        ]

    def pose_arm_rows(self) -> list[dict[str, Any]]:
        """Each moment arm about an angle in each pose, mm."""
        return [
            {
                "time_s": float(time),
                "muscle": muscle,
                "coordinate": coordinate,
                "before_mm": float(self.before.arms_mm[row, k]),
                "after_mm": float(self.after.arms_mm[row, k]),
            }
            for row, time in enumerate(self.times_s)
            for k, (muscle, coordinate) in enumerate(self.before.pairs)
            if coordinate in self.turning
        ]

    def _both(self) -> tuple[tuple[str, MusclePaths, tuple[tuple[InBone, ...], ...]], ...]:
        return ("before", self.before, self.in_bone_before), ("after", self.after, self.in_bone_after)


Surfaces = Sequence[tuple[str, str, TriMesh]]


def muscles_compared(
    model: OpenSimModel,
    carried: bytes,
    *,
    times_s: Float,
    poses: Sequence[Mapping[str, float]],
    bones: tuple[Surfaces, Surfaces],
    progress: Progress,
) -> MusclesCompared:
    """Measure the muscles of both models in every pose.

    Parameters
    ----------
    model : OpenSimModel
    carried : bytes
        The other model's file; same names.
    times_s : (k,) float64
    poses : k mappings of coordinate to radians or metres
    bones : two sequences of (bone, body, surface)
        Closed, in their bodies' frames, mm; before and after.
    progress : Progress

    Raises
    ------
    InputError
        See `muscle_paths`.
    """
    muscles = list(dict.fromkeys(point.of for point in model.points if point.of))
    pairs = crossed_coordinates(model)
    whole = [model.multibody.values(pose) for pose in poses]
    measured, in_bone = [], []
    after = parse_osim(carried, source=model.source)
    for read, surfaces, title in ((model, bones[0], "before"), (after, bones[1], "after")):
        with progress.stage(f"muscles {title}, by OpenSim") as tick:
            paths = muscle_paths(read.data, muscles=muscles, pairs=pairs, poses=whole, source=read.source, tick=tick)
        with progress.stage(f"paths in bone {title}") as tick:
            solid, found = Bones(surfaces), []
            for row, pose in enumerate(whole):
                found.append(tuple(solid.along(paths.lines[row], read.multibody.places(pose))))
                tick((row + 1) / len(whole))
        measured.append(paths)
        in_bone.append(tuple(found))
    turning = frozenset(n for n, c in model.multibody.coordinates.items() if c.kind is not CoordinateKind.TRANSLATIONAL)
    return MusclesCompared(times_s, measured[0], measured[1], in_bone[0], in_bone[1], turning)
