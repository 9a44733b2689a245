"""What certification finds, as plain records that can be kept and shown without the fields they speak of."""

from __future__ import annotations

from dataclasses import dataclass

from musclefit.geometry.arrays import Int, Points
from musclefit.vocabulary import Claim, Proof, StepKind

Place = tuple[float, ...]
"""Coordinates of a point, mm."""


@dataclass(frozen=True, slots=True)
class Fold:
    """A point at rest, inside the body, where the map turns space inside out or is no map: proved, not sampled.

    Parameters
    ----------
    place : Place
        Where the point is at rest.
    step : int
        The step that reverses orientation, counted from 0.
    place_in_step : Place
        Where the steps before take the point, proved to 1e-8 of the coordinates and of the body's extent
        (`folds.PLACE_SHARE`); for a Cayley step its midpoint (the one that Newton's method and the growing field agree
        on, where there is no ``other_midpoint``).
    determinant : float
        Below 0: a proved upper bound of det(I + grad D), or of det(I + grad D/2) det(I - grad D/2) for a Cayley step,
        which has the sign of its Jacobian.
    other_midpoint : Place or None
        A second midpoint of the point under the Cayley step, proved as closely: the implicit step has several
        solutions for a point of the body, and orientation is reversed at one of them.
    """

    place: Place
    step: int
    place_in_step: Place
    determinant: float
    other_midpoint: Place | None = None


@dataclass(frozen=True, slots=True)
class StepCertificate:
    """What is known of one step.

    Parameters
    ----------
    kind : StepKind
    claim : Claim
    margin : float
        Certified: a proved lower bound of how far the strain stays from the limit, 1 without strain, 0 at the limit.
        Else: the smallest sampled value (NaN where nothing was sampled).
    sampled_margin : float
        The smallest at tested places; the proved one is at most this and the true one lies between them.
    worst_place : Place
        Where that is, as the body stands before this step; for a Cayley step as it stands at its midpoints.
    boxes_examined, boxes_left : int
        Boxes evaluated; boxes on which the condition stayed unproved.
    domain_low, domain_high : Place
        Bounding box of the domain of the proof, which is convex unless it is by pairs.
    note : str
        Why it is not certified.
    proof : Proof
        What was proved, or tried first. By pairs, the margins are of the smallest singular value of the Jacobian (of
        both factors of a Cayley step), 1 without deformation and 0 at a fold.
    """

    kind: StepKind
    claim: Claim
    margin: float
    sampled_margin: float
    worst_place: Place
    boxes_examined: int
    boxes_left: int
    domain_low: Place
    domain_high: Place
    note: str = ""
    proof: Proof = Proof.MONOTONE


@dataclass(frozen=True, slots=True)
class MapCertificate:
    """Whether a composition of steps is one-to-one and orientation keeping on everything that it was asked of.

    That is what is inside the skin, and the tissues and points that were given beside it.

    Parameters
    ----------
    claim : Claim
        CERTIFIED: proved for every point of it. REFUTED: proved that orientation is reversed at ``fold``; since one
        sign of the Jacobian belongs to a one-to-one map, the map folds (or mirrors the whole body); or that an implicit
        step has two midpoints there, and so is no map. UNDECIDED: neither.
    margin : float
        Smallest over the steps; a proved lower bound when certified, else a sampled value.
    worst_step : int
        The step with that margin, or the one that could not be certified, counted from 0; -1 without steps.
    worst_place : Place
        See `StepCertificate.worst_place`.
    boxes_examined, boxes_left, max_boxes : int
    steps : tuple of StepCertificate
        Up to the first that could not be certified.
    fold : tuple of Fold
        The counterexample, when refuted; else empty.
    not_covered : tuple of str
        Names of what is moved by the map as well, but is not part of the claim.
    """

    claim: Claim
    margin: float
    worst_step: int
    worst_place: Place
    boxes_examined: int
    boxes_left: int
    max_boxes: int
    steps: tuple[StepCertificate, ...]
    fold: tuple[Fold, ...] = ()
    not_covered: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class MeshCertificate:
    """Do no two tets of a mesh share volume? See `musclefit.certify.meshes` for the theorem.

    Parameters
    ----------
    claim : Claim
    tets, boundary_faces : int
        What was examined.
    sheets : int
        Parts of the boundary whose outside was found to be empty of tets; 0 where it did not come to that.
    inverted, flat : int
        Tets of negative volume, and of exactly none.
    crossings : int
        Pairs of boundary triangles that cross or touch, other than at common corners and edges.
    failing : (i,) int64
        Numbers of the inverted and flat tets.
    crossing_tets : (c, 2) int64
        The tets behind each crossing pair.
    crossing_places : (c, 3) float64, mm
    note : str
        Why it is not certified.
    """

    claim: Claim
    tets: int
    boundary_faces: int
    sheets: int
    inverted: int
    flat: int
    crossings: int
    failing: Int
    crossing_tets: Int
    crossing_places: Points
    note: str = ""
