r"""The map certificate: every step of a deformation is one-to-one on what the steps before made of the body.

It takes steps as pairs of a kind and a field and the body's skin, recomputes everything from them, and knows nothing of
how they were made.

**Claim.** Let A be everything inside the skin: its surface and all points that no path leads to infinity from without
crossing it. CERTIFIED means that the composition of the steps, in exact arithmetic on the fields as they stand, is
defined on A, one-to-one and keeps orientation. (The mesh sees only its vertices: deformed triangles may still cross.)

**One explicit step** U = id + D. On a convex domain on which every eigenvalue of sym(grad D) is above -1, U is
strictly monotone, (U(a) - U(b)) . (a - b) > 0, hence one-to-one. Fields whose gradient jumps at single points are still
integrals of it along segments. The margin is 1 + the proved infimum of the eigenvalue.

**One Cayley step** U = (id + D/2) o F^-1, F = id - D/2. On a convex domain B on which all eigenvalues are within
(-2, 2), both factors are strictly monotone, so one-to-one. It is left to show that A lies in F(B). `covers` finds balls
such that the midpoint of each point of the skin lies in one; B is their hull, so the skin lies in F(B). B is convex and
compact and F a homeomorphism of it onto F(B), so the complement of F(B) is connected (Jordan-Brouwer). A point of A
outside F(B) could be joined to infinity outside F(B), hence without crossing the skin: it would not be inside.
The margin is 1 - the proved supremum of |eigenvalue| / 2.

**Composition.** U takes A onto a compact set whose boundary lies in the image of the skin (invariance of domain), hence
inside that image and in the convex hull of any cover of it. So step j + 1 is proved on the hull of the balls to which
the steps before took those around the skin. All this is done for a closed shell a little outside the skin (`shells`)
in place of the skin itself: what is inside the skin is inside the shell.

**Where a step is not monotone** there, it may be one-to-one all the same: a region of small cells around the body (for
Cayley steps: around its midpoints) then takes the hull's place, and `pairs` shows of id + D, or of id - D/2 and
id + D/2, that no two points of it come together. The complement of such a region is connected, and so is that of its
image under F, a homeomorphic compact set (Alexander duality): the arguments above hold for it word for word.

**Without a skin** the body is the axis-aligned box around the given points.

**Tissues and points outside the skin.** What is delivered need not lie inside the skin. Triangles that are not seen to
lie inside the shell get shells of their own, and points are balls of radius 0; the hulls hold them all. A then is what
no path leads to infinity from without crossing the skin or such a triangle, and the points; the arguments above hold
word for word for several shells, and a point p is in F(B) since a ball of B holds its midpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from musclefit.certify.ball_covers import (
    Cover,
    Midpoints,
    cayley_image,
    cayley_midpoints,
    explicit_image,
)
from musclefit.certify.body_shells import Patches, Shell, box_shell, point_patches, skin_shell, voxel_shell
from musclefit.certify.boxes import BoxProof, prove
from musclefit.certify.domains import Hull
from musclefit.certify.folds import Search, find_fold, find_second_midpoint
from musclefit.certify.model import Fold, MapCertificate, Place, StepCertificate
from musclefit.certify.pairs import PairProof, prove_one_to_one
from musclefit.certify.regions import CELLS, Region
from musclefit.certify.strain import Condition
from musclefit.errors import InputError
from musclefit.fields.protocol import Field, prepared
from musclefit.geometry.arrays import Bool, Points
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.winding import exact_winding_numbers, winding_numbers
from musclefit.progress import CERTIFY, Progress, Silent, Tick
from musclefit.vocabulary import Claim, Proof, StepKind

MAX_BOXES = 400_000
"""Boxes that a certificate may examine, over all steps."""

PAIRS_SHARE = 0.25
"""Of the budget that a step has left: what is kept for a proof by pairs, should it not be shown to be monotone."""

FINER_SHARE = 0.15
"""Of the budget for a proof by pairs: what is kept for the finer shell."""

MARGIN_SHARE = 0.5
"""A certified margin is at least this share of the sampled one, where the budget lasts."""

SHELLS = (40, 100)
"""Voxels along the skin's longest side: the shell around the skin, and the finer one that is tried when no claim could
be made of what is inside the first, unless a step is too steep for its surface already."""

CELLS_PER_VOXEL = 1.6
"""Cells of regions along their longest side, for each voxel of the shell."""

NEAR = 0.01
"""Of the stride of other searches: that around a place where a proof by pairs met reversed orientation."""

SAMPLES = 8000
"""Grid points of the body's bounding box that a search for a fold looks at first."""

MAX_SPLITS = 10
"""Times that a piece of the surface is cut in four before its midpoint is given up."""

MAX_PATCHES = 400_000
"""Pieces of the surface."""

PIECES_PER_BOX = 2
"""Of the budget of boxes: so many pieces of the surface may be made by cutting and carried through steps, for each of
the shells that are tried."""

WIDE_BALL = 0.02
"""Of the size of the body: pieces in wider balls are cut."""

WHOLE = 1e-6
"""How near a whole number an exact winding number must be: on the surface itself, and at holes, it is not."""

WIDEST_BALL = 1e3
"""Times the size of the body: wider covers are given up."""


def certify_map(
    steps: Sequence[tuple[StepKind, Field]],
    skin: TriMesh | Points,
    *,
    tissues: Sequence[TriMesh] = (),
    points: Points | None = None,
    max_boxes: int = MAX_BOXES,
    margin_share: float = MARGIN_SHARE,
    pairs_share: float = PAIRS_SHARE,
    progress: Progress | None = None,
) -> MapCertificate:
    """Prove that a composition of steps is one-to-one and orientation keeping inside the skin, or that it is not.

    Parameters
    ----------
    steps : sequence of (StepKind, Field)
        First step first.
    skin : TriMesh, or (N, n) float64, mm
        The body's closed surface at rest; or points, and the body is the axis-aligned box around them.
    tissues : sequence of TriMesh
        Surfaces that the map moves as well: where they are outside the skin, the claim is made of them and of what
        they enclose, too.
    points : (N, n) float64, mm, or None
        Single points that the map moves as well, inside the skin or outside.
    max_boxes : int
        Budget over all steps, and of the pieces of the surface with it (``PIECES_PER_BOX``). When it is spent on a step
        that is not proved yet, the claim is UNDECIDED.
    margin_share : float
        In [0, 1): how much of the smallest sampled margin the proved one must reach; larger costs more boxes. A budget
        that does not reach it, but a positive margin everywhere, certifies that.
    pairs_share : float
        In [0, 1): of the budget that a step has left, what is kept for a proof by pairs where it is not shown to be
        monotone; 0 for no such proofs.

    Returns
    -------
    MapCertificate
        See the module for what its claim means. A failing sufficient condition without a fold is UNDECIDED.

    Raises
    ------
    MeshError
        The skin is not closed.
    InputError
        No points, points that are not finite, or a budget or share out of range.
    """
    if max_boxes < 1 or not 0.0 <= margin_share < 1.0 or not 0.0 <= pairs_share < 1.0:
        raise InputError(
            f"max_boxes is {max_boxes}, margin_share {margin_share} and pairs_share {pairs_share}; they must be at "
            "least 1, and in [0, 1)"
        )
    with (progress or Silent()).stage(CERTIFY) as raw_tick:
        spent, tick = 0, _never_back(raw_tick)
        steps = [(kind, prepared(field)) for kind, field in steps]
        for voxels in SHELLS if isinstance(skin, TriMesh) else SHELLS[:1]:
            body = _Body.of(skin, voxels=voxels, tissues=tissues, points=points)
            body.pieces_left, body.cells = PIECES_PER_BOX * max_boxes, round(CELLS_PER_VOXEL * voxels)
            found, fold = _judge(
                steps,
                body,
                max_boxes=max_boxes - spent,
                margin_share=margin_share,
                pairs_share=pairs_share,
                kept_share=0.0 if voxels == SHELLS[-1] or not isinstance(skin, TriMesh) else FINER_SHARE,
                tick=tick,
            )
            spent += sum(step.boxes_examined for step in found)
            open_still = bool(found) and found[-1].claim is Claim.UNDECIDED
            if not open_still or spent >= max_boxes or not found[-1].boxes_examined:
                break
    return _summary(found, fold, examined=spent, max_boxes=max_boxes)


def _judge(
    steps: Sequence[tuple[StepKind, Field]],
    body: _Body,
    *,
    max_boxes: int,
    margin_share: float,
    pairs_share: float,
    kept_share: float,
    tick: Tick,
) -> tuple[tuple[StepCertificate, ...], tuple[Fold, ...]]:
    """Step by step, up to the first that is not certified.

    Of the budget that a proof by pairs has, ``kept_share`` is left for what is tried after this.
    """
    found: list[StepCertificate] = []
    for number, (kind, field) in enumerate(steps):
        budget = max_boxes - sum(step.boxes_examined for step in found)
        trial = _Trial(kind, field, body)
        part = _part(tick, number, len(steps))
        proof = trial.prove(max(1, round((1.0 - pairs_share) * budget)), margin_share, part)
        step = trial.certificate(proof)
        domain: Hull | Region = trial.domain
        if step.claim is not Claim.CERTIFIED:
            search = Search(*trial.suspects(proof), body.extent, body.samples(), body.inside, body.surely_inside)
            fold = find_fold(steps, number, search)
            if fold:
                found.append(replace(step, claim=Claim.REFUTED))
                return tuple(found), fold
            for_pairs = (1.0 - kept_share) * (budget - step.boxes_examined) if pairs_share else 0.0
            step, domain = trial.by_pairs(step, round(for_pairs), part)
            if step.claim is not Claim.CERTIFIED:
                fold = trial.fold_after_pairs(steps, number, search)
                if fold:
                    found.append(replace(step, claim=Claim.REFUTED))
                    return tuple(found), fold
        found.append(step)
        if step.claim is not Claim.CERTIFIED:
            break
        tick((number + 1) / len(steps))
        if number + 1 < len(steps):
            body.move(kind, field, trial.midpoints, domain)
    return tuple(found), ()


class _Body:
    """The body's surface in pieces at rest, and the balls to which the steps so far take them."""

    def __init__(self, patches: Patches, parts: Sequence[TriMesh | Points], single: Points) -> None:
        self.patches, self.parts, self.single = patches, parts, single
        self.cover = Cover(patches.centres, patches.radii())
        self.extent = float(np.ptp(patches.centres, axis=0).max(initial=0.0))
        self.steps: list[tuple[StepKind, Field]] = []
        self.domains: list[Hull | Region] = []
        self.pieces_left = MAX_PATCHES
        self.cells = CELLS
        self._narrow()

    @classmethod
    def of(cls, skin: TriMesh | Points, *, voxels: int, tissues: Sequence[TriMesh], points: Points | None) -> _Body:
        """The body inside a skin, or the box around points, with what is outside of it."""
        if isinstance(skin, TriMesh):
            shell = skin_shell(skin, voxels=voxels)
            patches, edge = shell.patches, shell.edge
            low, high = skin.vertices.min(axis=0), skin.vertices.max(axis=0)
        else:
            corners = _finite_points(skin)
            patches, shell = box_shell(corners), None
            low, high = corners.min(axis=0), corners.max(axis=0)
            edge = float((high - low).max()) / voxels
        n = len(low)
        parts: list[TriMesh | Points] = [skin if isinstance(skin, TriMesh) else np.array([low, high])]
        for tissue in tissues:
            corners = tissue.corners()
            held = _held(shell, low, high, corners.min(axis=1), corners.max(axis=1))
            if not held.all():
                size = float(np.ptp(corners[~held].reshape(-1, n), axis=0).max())
                patches = patches.joined(voxel_shell(corners[~held], edge=max(edge, size / voxels)).patches)
                parts.append(tissue)
        single = np.zeros((0, n)) if points is None or not len(points) else _finite_points(points)
        single = single[~_held(shell, low, high, single, single)]
        return cls(patches.joined(point_patches(single)), parts, single)

    def inside(self, places: Points) -> Bool:
        """(N,) which places at rest are in the body."""
        within = np.zeros(len(places), dtype=bool)
        for part in self.parts:
            left = np.flatnonzero(~within)
            within[left] = _within(part, places[left])
        return within

    def surely_inside(self, places: Points) -> Bool:
        """(N,) the same by the exact sum, for few places; the single points are in the body, too."""
        sure = np.array([bool((self.single == place).all(axis=1).any()) for place in places], dtype=bool)
        for part in self.parts:
            sure |= _surely_within(part, places)
        return sure

    def samples(self) -> Points:
        """Points at rest in the body: the single ones, and in each part a grid of its bounding box.

        About ``SAMPLES`` points in the first, and as many in all others together.
        """
        found = [self.single]
        for number, part in enumerate(self.parts):
            corners = part.vertices if isinstance(part, TriMesh) else part
            share = SAMPLES if number == 0 else SAMPLES / (len(self.parts) - 1)
            grid = _grid(corners.min(axis=0), corners.max(axis=0), share)
            found.append(grid[_within(part, grid)])
        return np.concatenate(found)

    def midpoints(self, field: Field) -> Midpoints:
        """Where a Cayley step has the midpoints of the surface; pieces without a proved one are cut smaller first."""
        found = cayley_midpoints(field, self.cover)
        for _ in range(MAX_SPLITS):
            cut = ~found.found & np.isfinite(self.cover.radii)
            if found.hopeless.any() or not self._may_cut(cut):
                break
            found = found.without(cut).joined(cayley_midpoints(field, self._cut(cut)))
        return found

    def _narrow(self) -> None:
        """Cut the pieces whose balls are wide for the size of the body."""
        for _ in range(MAX_SPLITS):
            widest = WIDE_BALL * float(np.ptp(self.cover.points, axis=0).max(initial=0.0))
            cut = self.cover.radii > widest
            if not self._may_cut(cut):
                break
            self._cut(cut)

    def _may_cut(self, pieces: Bool) -> bool:
        made = 4 * int(pieces.sum())
        fits = len(pieces) + made <= MAX_PATCHES and made * (1 + len(self.steps)) <= self.pieces_left
        return made > 0 and fits

    def _cut(self, pieces: Bool) -> Cover:
        """Replace pieces by their children, which then stand last; gives the children's balls."""
        children, parents = self.patches.only(pieces).split()
        self.pieces_left -= len(children) * (1 + len(self.steps))
        cover = self._carried(children)
        # A child is in the ball of the piece that it is of, too.
        narrower = cover.radii < self.cover.radii[pieces][parents]
        cover = Cover(
            np.where(narrower[:, None], cover.points, self.cover.points[pieces][parents]),
            np.where(narrower, cover.radii, self.cover.radii[pieces][parents]),
        )
        self.patches = self.patches.only(~pieces).joined(children)
        self.cover = Cover(
            np.concatenate([self.cover.points[~pieces], cover.points]),
            np.concatenate([self.cover.radii[~pieces], cover.radii]),
        )
        return cover

    def _carried(self, patches: Patches) -> Cover:
        """The balls to which the steps so far take pieces; of infinite radius where that is not proved.

        A midpoint counts only in the domain that its step was proved on: the equation may have others elsewhere.
        """
        cover = Cover(patches.centres, patches.radii())
        for (kind, field), domain in zip(self.steps, self.domains, strict=True):
            if kind is StepKind.EXPLICIT:
                cover = explicit_image(field, cover)
                continue
            midpoints = cayley_midpoints(field, cover)
            cover = cayley_image(field, midpoints)
            proved = midpoints.found & domain.holds_balls(midpoints.points, midpoints.radii)
            cover = Cover(cover.points, np.where(proved, cover.radii, np.inf))
        return cover

    def move(self, kind: StepKind, field: Field, midpoints: Midpoints | None, domain: Hull | Region) -> None:
        """Take the surface through a step that is proved on a domain."""
        self.cover = explicit_image(field, self.cover) if midpoints is None else cayley_image(field, midpoints)
        self.steps.append((kind, field))
        self.domains.append(domain)
        self._narrow()


def _finite_points(points: Points) -> Points:
    """Points that a body can be made of.

    Raises
    ------
    InputError
    """
    given = np.asarray(points, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] not in (2, 3) or not len(given) or not np.isfinite(given).all():
        raise InputError(f"points have shape {given.shape}; give finite ones of shape (N, 2) or (N, 3), N at least 1")
    return given


def _held(shell: Shell | None, low: Points, high: Points, corner: Points, opposite: Points) -> Bool:
    """(N,) which boxes are inside a shell, or, without one, inside a box."""
    if shell is not None:
        return shell.holds(corner, opposite)
    held: Bool = np.asarray(((corner >= low) & (opposite <= high)).all(axis=1), dtype=bool)
    return held


def _within(part: TriMesh | Points, places: Points) -> Bool:
    """(N,) which places are inside a surface, or in a box given by its corners.

    By the fast sum, which is good for a search: what is claimed of a place is claimed by `_surely_within`.
    """
    if isinstance(part, TriMesh):
        return winding_numbers(part, places) > 0.5
    within: Bool = np.asarray(((places >= part[0]) & (places <= part[1])).all(axis=1), dtype=bool)
    return within


def _surely_within(part: TriMesh | Points, places: Points) -> Bool:
    """(N,) which places are inside, by the exact sum: a winding number other than 0 of a closed surface.

    From there no path leads to infinity without crossing it. Places on the surface itself, and what a surface with
    holes half encloses, are not.
    """
    if not isinstance(part, TriMesh):
        return _within(part, places)
    numbers = exact_winding_numbers(part, places)
    whole = np.round(numbers)
    sure: Bool = np.logical_and(np.abs(numbers - whole) < WHOLE, whole != 0.0)
    return sure


def _grid(low: Points, high: Points, count: float) -> Points:
    """About ``count`` points of a box, its sides included but for a rounding."""
    per_axis = max(2, round(count ** (1.0 / len(low))))
    axes = [np.linspace(low[k], high[k], per_axis) for k in range(len(low))]
    points: Points = np.stack([g.ravel() for g in np.meshgrid(*axes, indexing="ij")], axis=1)
    # On the box's own sides the grid is a rounding outside.
    points += 1e-6 * (0.5 * (low + high) - points)
    return points


class _Trial:
    """One step on the surface it moves."""

    def __init__(self, kind: StepKind, field: Field, body: _Body) -> None:
        self.kind, self.field, self.cells = kind, field, body.cells
        self.collapsed: Points = np.zeros((0, body.cover.points.shape[1]))
        self.midpoints: Midpoints | None = body.midpoints(field) if kind is StepKind.CAYLEY else None
        held = body.cover if self.midpoints is None else Cover(self.midpoints.points, self.midpoints.radii)
        kept = np.isfinite(held.points).all(axis=1) & np.isfinite(held.radii)
        self.blocked = ""
        if not kept.all():
            self.blocked = "the balls that enclose the moved surface grew beyond all numbers"
        elif self.midpoints is not None and not self.midpoints.found.all():
            self.blocked = (
                f"no midpoint is proved for {int(np.sum(~self.midpoints.found))} of {len(kept)} pieces of the surface: "
                + (
                    "the step is too steep there"
                    if self.midpoints.hopeless.any()
                    else f"they were cut {MAX_SPLITS} times, or as often as the budget of pieces allows"
                )
            )
        elif held.radii.max() > WIDEST_BALL * float(np.ptp(held.points, axis=0).max() + 1.0):
            self.blocked = "the balls that enclose the moved surface grew too wide"
        self.held = Cover(held.points[kept], held.radii[kept])
        # Where nothing is known of where the surface goes, the domain that is told of is where it comes from.
        known = held if kept.any() else Cover(body.cover.points, np.zeros(len(kept)))
        self.domain = Hull.around(known.points[kept | ~kept.any()], known.radii[kept | ~kept.any()])

    def prove(self, max_boxes: int, margin_share: float, tick: Tick) -> BoxProof | None:
        """Branch and bound on the step's domain; nothing where there is none."""
        if self.blocked:
            return None
        return prove(
            self.field,
            Condition.of(self.kind),
            self.domain,
            max_boxes=max_boxes,
            margin_share=margin_share,
            tick=tick,
        )

    def certificate(self, proof: BoxProof | None) -> StepCertificate:
        """The record of what was found, before a fold is looked for."""
        n = len(self.domain.low)
        if proof is None:
            margin, place, examined, left, note = np.nan, (np.nan,) * n, 0, 0, self.blocked
        else:
            margin, examined, left = proof.sampled_margin, proof.examined, proof.left
            place = _place(proof.places[0]) if len(proof.places) else (np.nan,) * n
            note = proof.ended
        certified = proof is not None and proof.margin > 0.0
        return StepCertificate(
            kind=self.kind,
            claim=Claim.CERTIFIED if certified else Claim.UNDECIDED,
            margin=proof.margin if proof is not None and certified else margin,
            sampled_margin=margin,
            worst_place=place,
            boxes_examined=examined,
            boxes_left=left,
            domain_low=_place(self.domain.low),
            domain_high=_place(self.domain.high),
            note=note,
        )

    def by_pairs(self, step: StepCertificate, max_boxes: int, tick: Tick) -> tuple[StepCertificate, Hull | Region]:
        """What is known of a step that is not shown to be monotone once pairs of its places were looked at.

        Gives the domain of the proof, too; the step as it is where a proof is not to be had.
        """
        if self.blocked or max_boxes < 1:
            return step, self.domain
        region = Region.around(self.held.points, self.held.radii, cells=self.cells)
        factors = (-0.5, 0.5) if self.kind is StepKind.CAYLEY else (1.0,)
        proof: PairProof = prove_one_to_one(self.field, factors, region, max_boxes=max_boxes, tick=tick)
        low, high = region.bounds
        certified = proof.margin > 0.0
        if proof.sampled_margin < 0.0:
            self.collapsed = proof.place[None]
        found = replace(
            step,
            claim=Claim.CERTIFIED if certified else Claim.UNDECIDED,
            proof=Proof.PAIRS if certified else step.proof,
            boxes_examined=step.boxes_examined + proof.examined,
            boxes_left=proof.left,
            note="" if certified else f"{step.note}; nor by pairs: {proof.ended}",
        )
        if not certified:
            return found, self.domain
        return (
            replace(
                found,
                margin=proof.margin,
                sampled_margin=proof.sampled_margin,
                worst_place=_place(proof.place),
                domain_low=_place(low),
                domain_high=_place(high),
            ),
            region,
        )

    def fold_after_pairs(
        self, steps: Sequence[tuple[StepKind, Field]], number: int, search: Search
    ) -> tuple[Fold, ...]:
        """A fold where a proof by pairs met a place with reversed orientation, or a place with two midpoints."""
        fold: tuple[Fold, ...] = ()
        if len(self.collapsed):
            near = replace(search, starts=self.collapsed, stride=NEAR * search.stride, samples=search.samples[:0])
            fold = find_fold(steps, number, near)
        if not fold and self.kind is StepKind.CAYLEY:
            wider = replace(search, starts=np.concatenate([self.collapsed, search.starts]))
            fold = find_second_midpoint(steps, number, wider, among=self.domain.contains)
        return fold

    def suspects(self, proof: BoxProof | None) -> tuple[Points, float]:
        """Where to look for a fold first, and how far around."""
        stride = 0.02 * float((self.domain.high - self.domain.low).max())
        if proof is not None:
            return proof.places, stride
        places = self.held.points
        thinned = places[:: max(1, len(places) // 256)]
        return thinned, stride


def _part(tick: Tick, number: int, count: int) -> Callable[[float], None]:
    return lambda done: tick((number + done) / count)


def _never_back(tick: Tick) -> Tick:
    """A tick that repeats the largest share done when the work starts over."""
    furthest = 0.0

    def ahead(done: float) -> None:
        nonlocal furthest
        furthest = max(furthest, done)
        tick(furthest)

    return ahead


def _place(point: Points) -> Place:
    return tuple(float(x) for x in point)


def _summary(
    steps: tuple[StepCertificate, ...], fold: tuple[Fold, ...], *, examined: int, max_boxes: int
) -> MapCertificate:
    """One record from the steps'; no steps at all are the identity, which is certified."""
    if not steps:
        return MapCertificate(Claim.CERTIFIED, 1.0, -1, (), 0, 0, max_boxes, ())
    last = steps[-1]
    worst = len(steps) - 1 if last.claim is not Claim.CERTIFIED else int(np.argmin([s.margin for s in steps]))
    return MapCertificate(
        claim=last.claim,
        margin=steps[worst].margin,
        worst_step=worst,
        worst_place=steps[worst].worst_place,
        boxes_examined=examined,
        boxes_left=sum(step.boxes_left for step in steps),
        max_boxes=max_boxes,
        steps=steps,
        fold=fold,
    )
