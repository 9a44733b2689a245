"""The sampled check of a map: folds are counted, NaN is a fold, nothing is called proved."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import InputError
from musclefit.validate.maps import check_map
from musclefit.vocabulary import Claim

POINTS = np.arange(12.0).reshape(4, 3)


def test_a_map_without_a_fold_is_sampled_not_certified():
    check = check_map(np.array([1.0, 0.2, 3.0, 1.0]), points=POINTS, rule="row-norm", margin=0.5)
    assert check.claim is Claim.SAMPLED
    assert (check.folded_points, check.points_tested) == (0, 4)
    assert check.min_jacobian_determinant == 0.2
    assert check.place_mm == (3.0, 4.0, 5.0)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, -np.inf])
def test_a_fold_refutes_and_is_placed(bad):
    check = check_map(np.array([1.0, 0.5, 3.0, bad]), points=POINTS, rule="row-norm", margin=0.5)
    assert check.claim is Claim.REFUTED
    assert check.folded_points == 1
    assert check.place_mm == (9.0, 10.0, 11.0)


def test_wrong_counts_are_errors():
    with pytest.raises(InputError, match="no point to test"):
        check_map(np.zeros(0), points=np.zeros((0, 3)), rule="", margin=1.0)
    with pytest.raises(InputError, match="4 points have determinants of shape"):
        check_map(np.ones(3), points=POINTS, rule="", margin=1.0)
