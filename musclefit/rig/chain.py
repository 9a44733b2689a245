"""Bones on the way relative to each other: rest anatomy and poses in, who goes along with whom out; knows no joint.

A bone's motion is most often the product of several joints' turns. Its own screw from rest leads elsewhere than they
do, through its neighbours or away from them; its screw against the bone that it is jointed to leads as the joint does.
Which bone that is follows from rest and poses: where two jointed bones are nearest they move little against each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.geometry.arrays import Float, Points
from musclefit.geometry.rigid import RigidMotion

SAMPLES = 400
"""Vertices of each bone, at most, among which the place where two bones are nearest is looked for."""

LEVER_MM = 30.0
"""A turn counts as much as it moves a place this far from its axis, so that of two bones jointed to a third and to each
other the one with the smaller turn is gone along with: the radius goes with the ulna, not with the humerus."""

POSES = 8
"""Poses of a motion, at most, by which it is judged which bones are jointed."""

NAMED = 12
"""Bones that the finding names."""


@dataclass(frozen=True, eq=False, slots=True)
class ChainMotions:
    """Each bone on the screw against its carrier, which itself is on the way; the others on their own screws from rest.

    Parameters
    ----------
    final : mapping of bone name to RigidMotion
    carriers : mapping of bone name to bone name
        Every carrier stands before the bones that it carries, or is in no place itself.
    """

    final: Mapping[str, RigidMotion]
    carriers: Mapping[str, str] = field(default_factory=dict)

    def at(self, t: float) -> Mapping[str, RigidMotion]:
        """Rest-to-``t`` motion of each bone by name; exactly the final one at 1."""
        if t == 1.0:
            return self.final
        moved = {bone: motion.fraction(t) for bone, motion in self.final.items() if bone not in self.carriers}
        for bone, carrier in self.carriers.items():
            against = self.final[carrier].inverse() @ self.final[bone]
            moved[bone] = moved[carrier] @ against.fraction(t)
        return moved


def carriers_of(anatomy: Anatomy, poses: Sequence[Mapping[str, RigidMotion]]) -> Mapping[str, str]:
    """The bone that each bone goes along with, from the one that moves least outwards.

    The tree over all bones whose edges are together the shortest. An edge is as long as its two bones are apart at
    rest, and as the place where they are nearest moves from one against the other, and their turn against each other at
    a lever of ``LEVER_MM``, in the pose where that is most.

    Parameters
    ----------
    anatomy : Anatomy
        At rest.
    poses : sequence of mapping of bone name to RigidMotion
        From rest, of the same bones of the anatomy.

    Returns
    -------
    mapping of bone name to bone name
        Carriers first; without the bone that moves least.
    """
    bones = list(poses[0])
    if len(bones) < 2:
        return {}
    samples = [_sampled(anatomy[bone].surface.vertices) for bone in bones]
    pairs = np.array([(a, b) for a in range(len(bones)) for b in range(a + 1, len(bones))])
    nearest = [_nearest(samples[a], samples[b]) for a, b in pairs.tolist()]
    places, gaps = np.array([place for place, _ in nearest]), np.array([gap for _, gap in nearest])
    centres = np.array([places_of.mean(axis=0) for places_of in samples])
    lengths, moved = np.zeros(len(pairs)), np.zeros(len(bones))
    for pose in poses:
        rotations = np.stack([pose[bone].rotation for bone in bones])
        shifts = np.stack([pose[bone].translation for bone in bones])
        moved = np.maximum(moved, _moved(rotations, shifts, centres))
        a, b = pairs.T
        back = np.transpose(rotations[a], (0, 2, 1))
        against = back @ rotations[b]
        lengths = np.maximum(lengths, _moved(against, _applied(back, shifts[b] - shifts[a]), places))
    edges = np.full((len(bones), len(bones)), np.inf)
    edges[tuple(pairs.T)] = edges[tuple(pairs.T[::-1])] = lengths + gaps
    return {bones[b]: bones[a] for a, b in _tree(edges, root=int(np.argmin(moved)))}


def some_of(poses: Sequence[Mapping[str, RigidMotion]]) -> Sequence[Mapping[str, RigidMotion]]:
    """At most ``POSES`` of the poses, evenly, the last among them."""
    return poses[:: -math.ceil(len(poses) / POSES)]


def chain_findings(motions: ChainMotions, *, subject: str) -> tuple[Finding, ...]:
    """One finding that says which bone goes along with which, where more than one pair moves against each other."""
    final = motions.final
    jointed = [
        f"{bone} on {carrier} ({turn:.3g} deg)"
        for bone, carrier in motions.carriers.items()
        if (turn := (final[carrier].inverse() @ final[bone]).turn_deg) > 1e-6
    ]
    if len(jointed) < 2:
        return ()
    listed = ", ".join(jointed[:NAMED]) + (f" and {len(jointed) - NAMED} more" if len(jointed) > NAMED else "")
    message = f"on the way each bone turns on the screw against the one that it seems to be jointed to: {listed}"
    return (Finding(subject, "bone-chain", message),)


def _sampled(vertices: Points) -> Points:
    return vertices[:: max(1, math.ceil(len(vertices) / SAMPLES))]


def _nearest(a: Points, b: Points) -> tuple[Points, float]:
    """(3,) the middle between the nearest two of (k, 3) and (m, 3) places, and how far they are apart, mm."""
    distances, partners = (np.asarray(found) for found in cKDTree(b).query(a))
    nearest = int(np.argmin(distances))
    return 0.5 * (a[nearest] + b[int(partners[nearest])]), float(distances[nearest])


def _moved(rotations: Float, shifts: Points, places: Points) -> Float:
    """(k,) how far each motion moves its place, and its turn at the lever, mm."""
    turns = Rotation.from_matrix(rotations).magnitude()
    gone: Float = np.linalg.norm(_applied(rotations, places) + shifts - places, axis=1) + LEVER_MM * turns
    return gone


def _applied(rotations: Float, vectors: Points) -> Points:
    turned: Points = np.einsum("kij,kj->ki", rotations, vectors)
    return turned


def _tree(edges: Float, *, root: int) -> list[tuple[int, int]]:
    """The minimum spanning tree of a full graph as (from, to) in the order in which it grows from the root (Prim)."""
    reached = np.zeros(len(edges), dtype=bool)
    reached[root] = True
    grown = []
    while not reached.all():
        ways = np.where(reached[:, None] & ~reached[None, :], edges, np.inf)
        a, b = np.unravel_index(int(np.argmin(ways)), ways.shape)
        grown.append((int(a), int(b)))
        reached[b] = True
    return grown
