"""What the report says of the tetrahedra at rest: keys of its schema, the worst first on the page, names escaped."""

from __future__ import annotations

from dataclasses import replace

import jsonschema
import numpy as np
import pytest

from musclefit.anatomy.mesh_fidelity import TissueFit
from musclefit.anatomy.mesh_rules import FILLER
from musclefit.report.html import render_html
from musclefit.report.model import TetSummary
from musclefit.report.schema import report_schema, to_json


def fit(name: str, error: float, *, pieces: int = 1, kind: str = "muscle") -> TissueFit:
    return TissueFit(name, kind, 9, 90.0, 100.0, 100.0 + error, 0.4, 0.1, 0.2, pieces, 1)


TETS = TetSummary(
    tets=90_001,
    vertices=17_000,
    left_out=3,
    turned=90_004,
    joint_space_tets=50,
    joint_space_mm3=12.5,
    tissues=(
        fit("skin", -0.2, kind="skin"),
        TissueFit(FILLER, FILLER, 5, 50.0),
        fit("fair", 0.1),
        fit("worse<b>", -1.5),
        fit("torn", 0.3, pieces=4),
    ),
)


def test_the_keys_are_those_of_the_schema(make_report) -> None:
    found = to_json(make_report(tets=TETS))
    jsonschema.Draft202012Validator(report_schema()).validate(found)
    assert found["tets"]["joint_space"] == {"tets": 50, "volume_mm3": 12.5}
    by_name = {tissue["name"]: tissue for tissue in found["tets"]["tissues"]}
    np.testing.assert_allclose(by_name["worse<b>"]["volume_error_percent"], -1.5, rtol=1e-12)
    np.testing.assert_allclose(by_name["worse<b>"]["yielded_mm3"], 8.5, rtol=1e-12)
    filler = by_name[FILLER]
    assert {key for key, value in filler.items() if value is None} == set(filler) - {
        "name",
        "kind",
        "tets",
        "volume_mm3",
        "alone",
    }
    assert to_json(make_report())["tets"] is None


def test_the_page_lists_what_fell_apart_and_the_worst_first(make_report) -> None:
    page = render_html(make_report(tets=TETS), pictures={})
    section = page[page.index("<h2>Tetrahedra at rest</h2>") :]
    section = section[: section.index("</section>")]
    places = [
        section.index(f'<td class="name">{name}') for name in ("skin", "filler", "torn", "worse&lt;b&gt;", "fair")
    ]
    assert places == sorted(places)
    assert '<td class="n bad">4</td>' in section
    assert "joint space between sliding bones" in section
    assert "Tetrahedra at rest" not in render_html(make_report(), pictures={})


@pytest.mark.parametrize("error", [0.0, 3.0])
def test_fits_do_not_change_the_verdict(make_report, error: float) -> None:
    assert make_report(tets=replace(TETS, tissues=(fit("a", error),))).verdict == "passed"
