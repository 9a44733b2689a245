"""A small part of the campaign of maps at every scale; the whole of it is ``python tests/map_campaign.py``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from map_campaign import case, outcome, table, wrong

from musclefit.certify.maps import certify_map
from musclefit.certify.model import Fold
from musclefit.vocabulary import Claim

SMALL = range(4, 16)


def test_no_claim_of_a_small_campaign_is_wrong() -> None:
    found = [outcome(seed, max_boxes=15_000) for seed in SMALL]
    assert [o.wrong for o in found] == [""] * len(SMALL)
    claims = [o.claim for o in found]
    assert claims.count(Claim.CERTIFIED.value) >= 4
    assert claims.count(Claim.REFUTED.value) >= 1
    assert f"all             {len(SMALL):5}" in table(found)


def test_the_campaign_sees_forged_claims() -> None:
    """What is refuted, said to be certified; and a fold beside the body."""
    for seed in SMALL:
        made = case(seed)
        found = certify_map(made.steps, made.skin, tissues=made.tissues, points=made.points, max_boxes=20_000)
        if found.claim is Claim.REFUTED:
            far = Fold((*(np.array(found.fold[0].place) + 1e3 * made.size_mm),), 0, (0.0, 0.0, 0.0), -1.0)
            assert "outside the body" in wrong(made, replace(found, fold=(far,)))
            return
    raise AssertionError("no case of the small campaign folds; choose other seeds")
