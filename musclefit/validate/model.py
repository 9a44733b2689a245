"""What the checks of a deformed anatomy find, as plain records; a report is made of nothing else."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from musclefit.vocabulary import Claim


@dataclass(frozen=True, slots=True)
class LandmarkCheck:
    """How far the landmarks are from their destinations."""

    count: int
    max_error_mm: float
    worst: str


@dataclass(frozen=True, slots=True)
class MapCheck:
    """Whether the map is one-to-one.

    ``margin`` is how far the worst place stays from the limit of the rule (0 at the limit, 1 at rest), over all steps;
    ``folded_points`` counts tested points with det of the whole Jacobian <= 0; ``place_mm`` is the worst place at rest.
    The points sample the surfaces: no place of them is farther than ``gap_mm`` from one (None: not known).
    Where a proof was tried, ``boxes_examined`` says how many boxes of space it took and ``boxes_left`` how many stay
    undecided; ``margin`` is proved when the claim is certified. ``not_covered`` names files of attached points that a
    certified claim does not speak of.
    """

    claim: Claim
    rule: str
    margin: float
    points_tested: int
    folded_points: int
    min_jacobian_determinant: float
    place_mm: tuple[float, float, float]
    boxes_examined: int = 0
    boxes_left: int = 0
    gap_mm: float | None = None
    not_covered: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class WorstTet:
    """One tet by number, tissue and place (its middle, at rest and moved), with its moved volume over that at rest."""

    tet: int
    tissue: str
    rest_place_mm: tuple[float, float, float]
    place_mm: tuple[float, float, float]
    volume_ratio: float


@dataclass(frozen=True, slots=True)
class MeshRefinement:
    """How tets were cut finer because they came out wrong though the map is one-to-one.

    ``cut_by_tissue`` counts the tets given that were cut, most first. ``stopped`` says which bound ended the rounds
    before all was well; empty when all was. Crossings are those of the boundary, counted once no tet is inverted.
    ``moved_aside`` are tissues, how many of their vertices were moved off the map, and the farthest of them, mm, in
    ``moving_rounds`` rounds; ``left_out`` tets of filler between bones had no valid place at all.
    """

    rounds: int
    edges_split: int
    tets_before: int
    inverted_before: int
    crossings_before: int
    cut_by_tissue: tuple[tuple[str, int], ...]
    stopped: str = ""
    moving_rounds: int = 0
    moved_aside: tuple[tuple[str, int, float], ...] = ()
    left_out: int = 0
    left_out_mm3: float = 0.0


MESH_THEOREM = (
    "Every tetrahedron is right-handed, faces belong to one tetrahedron or to two on opposite sides, the boundary does "
    "not cross itself, and no tetrahedron lies outside one of its sheets: all by exact predicates. So no two "
    "tetrahedra share volume, and tissues, which share faces only, do not intersect."
)
"""What a certified mesh proves, and from what."""

MESH_SURFACES = (
    "The claim is about the tetrahedra. The original surfaces, which these follow within the envelope, ride along by "
    "the map itself, finely cut where the rig asks for it (bones held rigid: by their rigid motions), and not by the "
    "tetrahedra that hold them; whether they overlap is measured apart."
)
"""What a certified mesh does not speak of."""


@dataclass(frozen=True, slots=True)
class MeshCheck:
    """The deformed tetrahedra.

    ``inverted`` counts tets of negative volume or none; ``crossings`` pairs of boundary triangles that cross or touch,
    of which ``crossing_tissues`` names the tissues behind and how many pairs. ``straight_fraction`` is how far all
    vertices may go straight from rest to where they are, as a proved fraction, before a tet is flat. ``note`` says why
    the mesh is not certified. ``refinement`` is None where nothing had to be cut, or nothing should be.
    """

    tets: int
    inverted: int
    min_volume_ratio: float
    max_volume_ratio: float
    claim: Claim
    inverted_by_tissue: tuple[tuple[str, int], ...] = ()
    boundary_faces: int = 0
    crossings: int = 0
    crossing_tissues: tuple[tuple[str, str, int], ...] = ()
    worst: tuple[WorstTet, ...] = ()
    straight_fraction: float = 0.0
    note: str = ""
    refinement: MeshRefinement | None = None


@dataclass(frozen=True, slots=True)
class TissueCheck:
    """One tissue after the deformation.

    ``rigidity_mm`` is for bones: the largest distance of a place of the surface from where a rigid motion takes it,
    which is at a vertex (``rigidity_reference`` says which motion: "prescribed" by the joints, or the "best fit" by
    area); None for other kinds.
    Volumes outside the skin are None where there is no skin, and for the skin itself.
    """

    name: str
    kind: str
    rest_volume_mm3: float
    volume_mm3: float
    volume_change_percent: float
    rigidity_mm: float | None
    rigidity_reference: str | None
    outside_skin_rest_mm3: float | None
    outside_skin_mm3: float | None
    outside_skin_introduced_mm3: float | None


@dataclass(frozen=True, slots=True)
class BoneFieldCheck:
    """How well the field agrees with the rigid motions of the bones, which themselves are moved exactly.

    ``residual`` is on the exposed surface of the bones: its largest at their own exposed vertices and at
    ``exposed_samples`` between the places where the field is held, no place of the surface farther than ``gap_mm`` from
    one; its 99th percentile by area at these samples. ``contact_residual_max_mm`` is the largest distance of a sample
    of the contact zone from the surface of its own bone: the field may slip along it there.
    """

    contact_zone_mm: float
    exposed_vertices: int
    contact_vertices: int
    residual_p99_mm: float
    residual_max_mm: float
    contact_residual_max_mm: float
    exposed_samples: int = 0
    gap_mm: float | None = None


@dataclass(frozen=True, slots=True)
class PairOverlap:
    """Intersection of two tissues, mm³; introduced beyond the mapped rest overlap, never below 0."""

    a: str
    b: str
    rest_mm3: float
    deformed_mm3: float
    introduced_mm3: float


@dataclass(frozen=True, slots=True)
class NotChecked:
    """A tissue or pair that could not be checked, and why; never left out in silence."""

    what: str
    reason: str


@dataclass(frozen=True, slots=True)
class BoneOverlap:
    """What two bones share where their rigid motions put them, whatever becomes of the soft tissue.

    ``beyond_mm3`` is what they share beyond the overlap at rest carried along with them; ``depth_mm`` is how deep its
    places lie below the surface of either bone, at most. Both have a limit that goes by the smaller of the two bones.
    """

    a: str
    b: str
    rest_mm3: float
    posed_mm3: float
    beyond_mm3: float
    depth_mm: float
    beyond_limit_mm3: float
    depth_limit_mm: float

    @property
    def share_of_limit(self) -> float:
        """How much of its nearer limit it uses: above 1 the bones collide."""
        return max(self.depth_mm / self.depth_limit_mm, self.beyond_mm3 / self.beyond_limit_mm3)

    @property
    def collides(self) -> bool:
        """Whether it is beyond a limit."""
        return self.share_of_limit > 1.0


@dataclass(frozen=True, slots=True)
class OverlapCheck:
    """All overlapping pairs, largest first, and what could not be checked.

    ``bones`` is what bones share by their rigid motions alone: known before the deformation, no part of what it
    introduces. ``touching`` names the tissues that come to touch themselves to within rounding, with the number of
    pairs of triangles.
    """

    pairs: tuple[PairOverlap, ...]
    pairs_tested: int
    not_checked: tuple[NotChecked, ...]
    bones: tuple[BoneOverlap, ...] = ()
    touching: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True, slots=True)
class OutsideSkin:
    """Volume of one tissue outside the skin, mm³; introduced beyond what was outside at rest, never below 0."""

    name: str
    rest_mm3: float
    deformed_mm3: float
    introduced_mm3: float


@dataclass(frozen=True, slots=True)
class OutsideCheck:
    """Every tissue but the skin that could be checked, in the anatomy's order, and what could not be checked."""

    tissues: tuple[OutsideSkin, ...]
    not_checked: tuple[NotChecked, ...]


@dataclass(frozen=True, slots=True)
class Check:
    """One limit held against one number; ``place`` names where, ``next_step`` what to do where it fails.

    A limit of infinity is none: the number is told as measured, and fails only where it is not a number.

    Raises
    ------
    ValueError
        A check that does not say what to do.
    """

    name: str
    value: float
    limit: float
    unit: str
    place: str = ""
    next_step: str = field(kw_only=True)

    def __post_init__(self) -> None:
        if not self.next_step.strip():
            raise ValueError(f"the check {self.name!r} does not say what to do where it fails; give it a next_step")

    @property
    def passed(self) -> bool:
        """True when the value is a number within the limit."""
        return self.value <= self.limit

    @property
    def limited(self) -> bool:
        """Whether there is a limit to break."""
        return self.limit < math.inf
