"""The cost model: gives back what it was made of, forecasts, and keeps workers within memory."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from studies import write_study

from musclefit.errors import InputError
from musclefit.io.case_folders import CaseCost, CaseOutcome, write_case
from musclefit.io.studies import read_study
from musclefit.workflows.batch import forecast
from musclefit.workflows.cost import EXTRAS, CostModel, Forecast, Measured, Sizes, workers_that_fit

COEFFICIENTS = (0.3, 0.02, 0.05, 0.4, 0.1)


def seconds(sizes: Sizes) -> float:
    """The law that cases of these tests obey, written out."""
    v, m, t = sizes.vertices / 1000, sizes.landmarks / 100, sizes.tissues / 10
    a, b, c, d, e = COEFFICIENTS
    return sizes.frames * (a + b * v + c * v * m + d * m**2 + e * t**2)


def cases() -> list[Sizes]:
    rng = np.random.default_rng(4)
    drawn = rng.uniform([500, 3, 10], [50_000, 70, 300], size=(40, 3))
    return [Sizes(v, t, m) for v, t, m in drawn]


def test_a_fit_gives_back_the_law_that_made_its_cases() -> None:
    model = CostModel.fitted([Measured(s, seconds(s), 300 + 2 * s.vertices / 1000) for s in cases()])
    np.testing.assert_allclose(model.cpu_s["free bones"], COEFFICIENTS, rtol=1e-6, atol=0)
    np.testing.assert_allclose(model.peak_mb["free bones"], (300, 2), rtol=1e-6, atol=0)
    assert model.error_percent["free bones"] < 1e-4
    assert model.case_cpu_s(Sizes(10_000, 20, 100)) == pytest.approx(seconds(Sizes(10_000, 20, 100)), rel=1e-6)


def test_noise_of_ten_percent_stays_within_twenty_five() -> None:
    rng = np.random.default_rng(7)
    model = CostModel.fitted([Measured(s, seconds(s) * rng.uniform(0.9, 1.1)) for s in cases()])
    assert max(abs(model.case_cpu_s(s) / seconds(s) - 1) for s in cases()) < 0.25


def test_pictures_and_tetrahedra_come_on_top_and_frames_multiply() -> None:
    own = cases()
    drawn = [replace(sizes, pictures=True) for sizes in own]
    meshed = [replace(sizes, tets=True) for sizes in own]
    moving = [replace(sizes, frames=4 + k) for k, sizes in enumerate(own)]
    measured = [
        *(Measured(s, seconds(s)) for s in own),
        *(Measured(s, seconds(s) + 2.0 + 0.05 * s.vertices / 1000) for s in drawn),
        *(Measured(s, seconds(s) + 9.0) for s in meshed),
        *(Measured(s, 0.5 * s.frames * seconds(replace(s, frames=1))) for s in moving),
    ]
    model = CostModel.fitted(measured, start_cpu_s=2.5)
    some = Sizes(20_000, 30, 200)
    bare = seconds(some)
    assert model.case_cpu_s(some) == pytest.approx(bare, rel=1e-6)
    assert model.case_cpu_s(replace(some, pictures=True)) == pytest.approx(bare + 2.0 + 0.05 * 20, rel=1e-6)
    assert model.case_cpu_s(replace(some, pictures=True, tets=True)) == pytest.approx(bare + 12.0, rel=1e-6)
    assert model.case_cpu_s(replace(some, frames=10)) == pytest.approx(5.0 * bare, rel=1e-6)
    assert model.unknown(replace(some, rigid=True, pictures=True)) == ("rigid bones",)
    assert CostModel(**json.loads(model.text(), object_hook=_without_terms)).start_cpu_s == 2.5


def _without_terms(read: dict[str, object]) -> dict[str, object]:
    read.pop("terms", None)
    return read


def test_nothing_cannot_be_fitted() -> None:
    with pytest.raises(InputError, match="measure some"):
        CostModel.fitted([])


def test_the_coefficients_that_come_along_are_positive_and_of_every_part() -> None:
    model = CostModel.shipped()
    known = {"free bones", "rigid bones", "free bones, motion", "rigid bones, motion", *EXTRAS}
    assert known == model.cpu_s.keys() == model.peak_mb.keys()
    assert model.start_cpu_s > 0
    for kind in model.cpu_s:
        assert min(model.cpu_s[kind]) >= 0 < sum(model.cpu_s[kind])
        assert model.peak_mb[kind][0] > 50


@pytest.mark.parametrize(("wanted", "peak", "free", "got"), [(8, 500, 2300, 4), (8, 500, None, 8), (3, 9000, 500, 1)])
def test_workers_keep_within_memory(wanted: int, peak: float, free: float | None, got: int) -> None:
    assert workers_that_fit(wanted, peak_mb=peak, available_mb=free) == got


def test_a_forecast_says_what_limits_it() -> None:
    said = Forecast(10, 0, 7200.0, 2, 900.0, 2000.0, limited=True).in_words
    assert "10 cases left: about 2.0 h of CPU" in said
    assert "60 min with 2 workers" in said
    assert "memory allows no more workers" in said
    assert (
        "without tetrahedra, which"
        in Forecast(9, 0, 9.0, 1, 9.0, 99.0, limited=False, left_out=("tetrahedra",)).in_words
    )
    assert "more memory than there is" in Forecast(1, 0, 1.0, 1, 900.0, 500.0, limited=False).in_words


def test_what_was_measured_before_scales_what_is_left(tmp_path: Path) -> None:
    study, out = write_study(tmp_path, range(5, 25)), tmp_path / "out"
    fresh = forecast(study, out=out)
    assert (fresh.cases, fresh.measured) == (20, 0)
    sizes = Sizes(648, 4, 12, 1, rigid=False)
    model = CostModel.shipped()
    per_case = model.case_cpu_s(sizes)
    made = zip(read_study(study).cases[:3], (90.0, 2.0, 6.0), (0, 1, 2), strict=True)
    for case, factor, before in made:  # the first of a process has started it
        cost = CaseCost(factor * per_case, 1.0, 2000.0, asdict(sizes), before)
        write_case(out, CaseOutcome.of(case, "passed"), cost)
    told = forecast(study, out=out)
    assert told.measured == 3
    expected = 4.0 * (fresh.cpu_s - model.start_cpu_s) / 20 * told.cases + model.start_cpu_s
    assert told.cpu_s == pytest.approx(expected, rel=1e-9)
    assert told.peak_mb == pytest.approx(2000.0, abs=1e-9), "as large as those made before"
    json.dumps(asdict(told), allow_nan=False)


def test_cases_made_before_are_summed_and_the_first_of_a_process_counts_alone() -> None:
    model = CostModel({"free bones": (1.0, 1.0, 0.0, 0.0, 0.0)}, {"free bones": (300.0, 2.0)}, {})
    small, large = Sizes(1000, 4, 12), Sizes(9000, 4, 12)  # 2 and 10 s, 302 and 318 MB
    first = Measured(small, 50.0, 400.0, first=True)
    assert model.scale([]) == 1.0
    assert model.scale([first]) == 25.0
    assert replace(model, start_cpu_s=2.0).scale([first, first]) == 24.0
    assert replace(model, start_cpu_s=60.0).scale([first]) == 1.0, "it tells nothing"
    assert model.scale([first, Measured(small, 2.0), Measured(large, 22.0)]) == 2.0
    assert model.peak_mb_of([small, large], []) == 318.0
    assert model.peak_mb_of([small, large], [first]) == 416.0
    assert model.peak_mb_of([small], [Measured(large, 1.0, 500.0)]) == 500.0
