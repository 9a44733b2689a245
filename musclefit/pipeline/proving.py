"""The proof of a job's map; what it fails at goes back to the march."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np

from musclefit.certify.maps import certify_map
from musclefit.certify.model import MapCertificate
from musclefit.errors import NotConvergedError
from musclefit.flow.deformation import Deformation, Status
from musclefit.flow.steps import CayleyStep, ExplicitStep, Step
from musclefit.geometry.arrays import Points
from musclefit.geometry.queries.winding import winding_numbers
from musclefit.pipeline.refining import Made
from musclefit.progress import Progress
from musclefit.rig.job import Job
from musclefit.vocabulary import Claim, StepKind

STEP_KINDS: Mapping[type[Step], StepKind] = MappingProxyType(
    {ExplicitStep: StepKind.EXPLICIT, CayleyStep: StepKind.CAYLEY}
)

PROOFS = 6
"""Times that a march is taken back by what its proof comes upon."""

PAIRS_SHARE = 0.95
"""Of what a budget has left where no rule is shown to hold: what goes to a proof by pairs."""

MARGIN_SHARE = 0.1
"""A certified margin is at least this share of the sampled one: a larger one would take many more boxes to prove."""


def proved(made: Made, job: Job, *, by_pairs: bool = True, progress: Progress) -> tuple[Made, MapCertificate | None]:
    """The proof of the map, where the rig asks for one; the march goes on from what it fails at.

    Between the places that a march is tested at, such as in the gap between two bones, a step may be too long for
    its rule. A proof that comes upon such a place has the march tested there, too, and is tried again. What is open at
    the end is tried pair by pair (`musclefit.certify.pairs`), with the boxes that the budget still has.

    Parameters
    ----------
    made : Made
    job : Job
        What it was made of.
    by_pairs : bool
        Whether what is open at the end is tried pair by pair.
    """
    proof = _proof(made, job, progress)
    for _ in range(PROOFS):
        place = None if proof is None else place_at_rest(made.deformed.deformation, proof)
        again = None if place is None else made.tested_too(place)
        if again is None or again.deformed.deformation.status is not Status.CONVERGED:
            break
        made, proof = again, _proof(again, job, progress)
    left = 0 if proof is None or proof.claim is not Claim.UNDECIDED else proof.max_boxes - proof.boxes_examined
    if by_pairs and left > 0:
        found = _proof(made, job, progress, max_boxes=left, pairs_share=PAIRS_SHARE)
        proof = proof if found is None or found.claim is Claim.UNDECIDED else found
    return made, proof


def place_at_rest(deformation: Deformation, proof: MapCertificate) -> Points | None:
    """(1, 3) where at rest a step was found to break its rule, mm; None where none was, or that is not known."""
    if proof.claim is not Claim.UNDECIDED or not proof.steps or not proof.steps[-1].sampled_margin <= 0.0:
        return None
    number, place = len(proof.steps) - 1, np.array([proof.steps[-1].worst_place])
    step = deformation.steps[number]
    if isinstance(step, CayleyStep):  # the place is one of midpoints
        place = place - 0.5 * step.field.displacement(place)
    try:
        return Deformation(deformation.steps[:number], (), Status.CONVERGED).inverse()(place)
    except NotConvergedError:
        return None


def _proof(
    made: Made, job: Job, progress: Progress, *, max_boxes: int | None = None, pairs_share: float = 0.0
) -> MapCertificate | None:
    settings, deformation = job.rig.certificate, made.deformed.deformation
    if not settings.enabled or not deformation.steps:
        return None
    skin = job.anatomy.skin
    certified = partial(
        certify_map,
        [(STEP_KINDS[type(step)], step.field) for step in deformation.steps],
        made.sampled.points if skin is None else skin.surface,
        tissues=[tissue.surface for tissue in job.anatomy.tissues if skin is None or tissue.name != skin.name],
        max_boxes=settings.max_boxes if max_boxes is None else max_boxes,
        margin_share=MARGIN_SHARE,
        pairs_share=pairs_share,
        progress=progress,
    )
    attached = np.concatenate([np.zeros((0, 3)), *(file.points for file in job.further)])
    proof = certified(points=attached)
    if proof.claim is not Claim.UNDECIDED or not _any_outside(job, attached):
        return proof
    # Points far from the body may be what no proof reaches: then it is made of the body, and says what it leaves out.
    of_body = certified()
    names = tuple(file.name for file in job.further)
    return replace(of_body, not_covered=names) if of_body.claim is Claim.CERTIFIED else proof


def _any_outside(job: Job, points: Points) -> bool:
    """Whether any of (N, 3) points, mm, are outside the skin: without those that are not the proof is the same."""
    if not len(points) or job.anatomy.skin is None:
        return len(points) > 0
    return bool((winding_numbers(job.anatomy.skin.surface, points) < 0.5).any())
