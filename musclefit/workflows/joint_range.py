"""How far the joints of a rig can turn, from the rig's file to a range for each coordinate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from musclefit.errors import InputError
from musclefit.io.rig_names import RigGiven
from musclefit.io.rigs import read_rig
from musclefit.pipeline.poses import ranges_of
from musclefit.progress import Progress
from musclefit.report.schema import joint_ranges_to_json
from musclefit.validate.joint_ranges import JointRange
from musclefit.workflows.progress import watched
from musclefit.workflows.results import Shown


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class JointRanges(Shown):
    """How far each joint of a rig can turn before bones collide, the others at rest."""

    title: str
    ranges: tuple[JointRange, ...]

    def said(self) -> str:
        """Every range in a line."""
        ends = (f"{one.coordinate} {one.low.degrees:.1f} to {one.high.degrees:.1f} deg" for one in self.ranges)
        return f"{self.title}: {'; '.join(ends)}"

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """The ranges."""
        return {"joint_ranges": joint_ranges_to_json(self.ranges)}


def joint_range(rig: RigGiven, *, overrides: Sequence[str] = (), progress: Progress | None = None) -> JointRanges:
    """Find how far each joint can turn either way before bones collide, with the other joints at rest.

    Parameters
    ----------
    rig : str, path or mapping
        Driven by joints; see `musclefit.run`.
    overrides : sequence of str
        ``key=value`` each.
    progress : Progress, optional

    Returns
    -------
    JointRanges
        Both ends of each joint, in degrees, and what stops it there.

    Raises
    ------
    RigError, MeshError, InputError
        A rig that cannot be read, or that no joint drives.
    """
    with watched(progress) as stages:
        job = read_rig(rig, overrides=overrides, progress=stages)
        if job.joints is None:
            raise InputError(f'{job.source}: no joint drives this rig; give it a [drive] of kind "joints"')
        with stages.stage("joint ranges"):
            return JointRanges(job.rig.title, tuple(ranges_of(job)))
