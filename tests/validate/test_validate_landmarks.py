"""The worst landmark is named with its distance; nonsense is refused."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.errors import LandmarkError
from musclefit.validate.landmarks import check_landmarks


def test_the_worst_landmark_is_named() -> None:
    targets = np.zeros((3, 3))
    arrived = np.array([[0, 0, 1e-9], [0.3, 0, 0.4], [0.1, 0, 0]])
    check = check_landmarks(["a", "b", "c"], arrived=arrived, targets=targets)
    assert (check.count, check.worst) == (3, "b")
    np.testing.assert_allclose(check.max_error_mm, 0.5, rtol=1e-12)


def test_an_arrival_that_is_not_a_number_is_no_zero_error() -> None:
    arrived = np.array([[0, 0, 0], [np.nan, 0, 0]])
    with pytest.raises(LandmarkError, match="landmark 'b' arrived at"):
        check_landmarks(["a", "b"], arrived=arrived, targets=np.zeros((2, 3)))


@pytest.mark.parametrize(("names", "rows"), [(["a"], 2), (["a", "b"], 1)])
def test_counts_that_differ_are_refused(names: list[str], rows: int) -> None:
    with pytest.raises(LandmarkError, match="do not belong together"):
        check_landmarks(names, arrived=np.zeros((rows, 3)), targets=np.zeros((rows, 3)))


def test_no_landmark_is_no_success() -> None:
    with pytest.raises(LandmarkError, match="no landmark to check"):
        check_landmarks([], arrived=np.zeros((0, 3)), targets=np.zeros((0, 3)))
