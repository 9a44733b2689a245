"""Intermediate states: takes a finished run, gives the anatomy after each stretch of the way; knows no file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from musclefit.anatomy.model import Anatomy
from musclefit.pipeline.retarget import Retargeting


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """The anatomy on its way.

    Parameters
    ----------
    at : float
        The share of the way that is done, in (0, 1].
    anatomy : Anatomy
        With the vertices that were given, moved.
    """

    at: float
    anatomy: Anatomy


def states(result: Retargeting) -> Iterator[State]:
    """The anatomy after each stretch of the job's own deformation, the last at its end.

    Bones that joints hold rigid stand where their joints put them at that moment. Bones that are kept rigid or similar
    without joints, and surfaces that are refined, are so at the end alone: here all vertices go where the map takes
    them.
    """
    job = result.job
    vertices = job.anatomy.vertices()
    for _, end, part in result.result.deformation.by_stretch():
        vertices = part(vertices)
        moved = job.anatomy.with_vertices(vertices)
        if job.rig.bones.rigid and job.motions is not None:
            motions = job.motions.at(end)
            tissues = tuple(
                job.anatomy[t.name].with_vertices(motions[t.name](job.anatomy[t.name].surface.vertices))
                if t.name in motions
                else t
                for t in moved
            )
            moved = Anatomy(tissues, moved.frame)
        yield State(end, moved)
