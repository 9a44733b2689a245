"""Turns a report, with its pictures, into one self-contained page; measures and judges nothing."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from musclefit.anatomy.mesh_fidelity import TissueFit
from musclefit.anatomy.mesh_rules import FILLER
from musclefit.anatomy.model import TissueKind
from musclefit.errors import InputError
from musclefit.geometry.queries.solids import ROUNDING_MM3
from musclefit.report.comparison import Row, compare, worst_first
from musclefit.report.methods import methods_of
from musclefit.report.model import SCHEMA_VERSION, MeshReport, Report, absent, bone_limit, checks_against
from musclefit.report.run_differences import Differences, MeasureRow
from musclefit.report.scene import Scene, packed, quantum_mm
from musclefit.validate.bones import RESOLUTION_DEG, STEP_DEG
from musclefit.validate.model import MESH_SURFACES, MESH_THEOREM, Check, PairOverlap, TissueCheck

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

_KINDS = {"fold": "folded places", "inverted tet": "inverted tetrahedra"}
"""What a page calls kinds of places."""

_THIN = "\N{NARROW NO-BREAK SPACE}"
_SPACE = "\N{NO-BREAK SPACE}"
_MISSING = "not measured"


def render_html(
    report: Report, *, pictures: Mapping[str, bytes], pictures_problem: str = "", scene: Scene | None = None
) -> str:
    """One page that needs no other file and no network.

    Parameters
    ----------
    report : Report
    pictures : mapping of caption to PNG bytes
        Shown in order; may be empty.
    pictures_problem : str
        Why there are no pictures, shown in their place.
    scene : Scene or None
        What the page shows in 3-D; None leaves that out.

    Returns
    -------
    str
        HTML; every name and text of the report is escaped.

    Raises
    ------
    InputError
        A picture is not a PNG; names its caption.
    """
    page = _page(report, pictures, pictures_problem)
    return _render("report.html.jinja", {**page, "scene": scene_parts(scene)})


def render_inspection(report: MeshReport) -> str:
    """One page about an anatomy as it is; needs no other file and no network, escapes every name."""
    page = _shared(report, remark="")
    page["absent"] = () if any(t.kind == TissueKind.SKIN for t in report.tissues) else ("no skin",)
    page["triangles"] = sum(t.triangles for t in report.tissues)
    page["skin"] = any(t.outside_skin_mm3 is not None for t in report.tissues)
    page["pairs"] = sorted(report.overlaps.pairs, key=lambda p: _largest_first(p.rest_mm3))
    return _render("inspection.html.jinja", page)


def render_differences(found: Differences, *, links: Sequence[str], scene: Scene | None) -> str:
    """One page about runs side by side; needs no other file and no network, escapes every name.

    Parameters
    ----------
    found : Differences
    links : sequence of str
        The address of each run's own page, from this one; "" for none.
    scene : Scene or None
    """
    better = None if found.best is None else found.runs[found.best]
    what = "Sequence" if found.frames else "Run"
    page = {
        "report": {"title": f"{what}s side by side"},
        "what": what,
        "verdict": f"no {what.lower()} is better" if better is None else f"{better} is better",
        "found": found,
        "better": better,
        "story": _told_first_of(found),
        "letters": found.letters,
        "links": links,
        "scene": scene_parts(scene),
    }
    return _render("differences.html.jinja", page)


def _told_first_of(found: Differences) -> list[MeasureRow]:
    """The three checks that tell most: those that some fail and others do not, then those that one is better in."""
    rank = {name: k for k, name in enumerate(TOLD_FIRST)}
    known = [row for row in found.measures if row.unit and (row.name in rank or False in row.passed)]

    def place(row: MeasureRow) -> tuple[bool, bool, bool, int]:
        return len(set(row.passed)) < 2, not row.best, False not in row.passed, rank.get(row.name, len(rank))

    return sorted(known, key=place)[:3]


def number(value: float | None) -> str:
    """A number for reading: four significant digits, thousands apart, powers of ten for the very small.

    >>> number(0.0), number(1234567.0), number(3.2e-8), number(float("nan"))
    ('0', '1 234 567', '3.2 × 10⁻⁸', 'not measured')
    """
    if value is None:
        return "–"
    if math.isnan(value):
        return _MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    size = abs(value)
    if size == 0:
        return "0"
    if size < 1e-3 or size >= 1e9:
        digits, exponent = f"{size:.1e}".split("e")
        text = f"{digits} × 10{int(exponent)}".replace(f"10{int(exponent)}", f"10{_raised(int(exponent))}")
    else:
        decimals = max(0, 3 - math.floor(math.log10(size)))
        text = f"{size:,.{decimals}f}".replace(",", _THIN)
        text = text.rstrip("0").rstrip(".") if "." in text else text
    return f"−{text}" if value < 0 else text


def amount(value: float | None, unit: str) -> str:
    """A number with its unit."""
    text = number(value)
    return f"{text}{_SPACE}{unit}" if unit and text not in (_MISSING, "–") else text


def seconds(value: float) -> str:
    """A duration for reading: seconds, to hundredths below ten, then minutes and seconds from two minutes on."""
    if not math.isfinite(value):
        return amount(value, "s")
    if 0 < value < 0.005:
        return f"< 0.01{_SPACE}s"
    if value < 120:
        return amount(round(value, 2 if value < 10 else 1), "s")
    whole = round(value)
    return f"{whole // 60}{_SPACE}min {whole % 60:02d}{_SPACE}s"


def in_a_line(value: Any) -> str | None:
    """A setting in a line: a value, or values of a list; None for what is not so short.

    >>> in_a_line([["elbow", 75.0], ["forearm", 70.0]]), in_a_line(True), in_a_line([])
    ('elbow 75, forearm 70', 'yes', None)
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value or None
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return number(value)
    if isinstance(value, Sequence) and value:
        parts = [
            " ".join(in_a_line(part) or "none" for part in item) if _is_short_list(item) else in_a_line(item)
            for item in value
        ]
        return None if None in parts else ", ".join(map(str, parts))
    return None


def _is_short_list(item: Any) -> bool:
    return isinstance(item, list | tuple) and all(isinstance(part, str | int | float) for part in item)


def breakable(name: str) -> Markup:
    """A name, escaped, that may be broken after each underscore."""
    return Markup("_<wbr>").join(name.split("_"))


def render_page(template: str, page: dict[str, Any]) -> str:
    """A page of one of the templates beside this module; every name and text is escaped."""
    return _render(template, page)


def scene_parts(scene: Scene | None) -> SceneParts | None:
    """What the templates put into a page for a view in 3-D; None where there is nothing to show.

    Raises
    ------
    ValueError
        A script of the viewer would close its own element; it was built wrongly.
    """
    if scene is None:
        return None
    text, data = packed(scene)
    marks = tuple(
        PlaceRow(f"{s} {m}", _KINDS.get(mark.kind, mark.kind), mark.tissues, scene.shapes[s].title, mark.title)
        for s, m, mark in sorted(scene.marks, key=lambda found: found[0] == 0)  # what is so at rest comes last
    )
    frames = any(shape.time_s is not None for shape in scene.shapes)
    return SceneParts(
        json=Markup(text),
        data=Markup(data),
        three=_script("three.min.js"),
        script=_script("viewer.js"),
        marks=marks,
        left_out=scene.left_out,
        quantum_mm=quantum_mm(scene),
        frames=frames,
    )


def sentence(check: Check) -> tuple[str, str]:
    """One failed check in words, and what to do about it."""
    return _sentence(check), check.next_step


@dataclass(frozen=True, slots=True)
class PlaceRow:
    """A place to look at: the numbers of its shape and its mark, and what it is."""

    key: str
    kind: str
    tissues: tuple[str, ...]
    state: str
    title: str


@dataclass(frozen=True, slots=True)
class SceneParts:
    """A packed scene, the scripts that show it, and its places to look at."""

    json: Markup
    data: Markup
    three: Markup
    script: Markup
    marks: tuple[PlaceRow, ...]
    left_out: tuple[str, ...]
    quantum_mm: float
    frames: bool


@dataclass(frozen=True, slots=True)
class StoryNumber:
    """One of the three numbers at the head of a page, with those of the methods compared with."""

    name: str
    value: float
    unit: str
    limit: float
    limited: bool
    passed: bool
    place: str
    others: tuple[tuple[str, float | None], ...]


@dataclass(frozen=True, slots=True)
class _TissueRow:
    tissue: TissueCheck
    paper_loop: TissueCheck | None
    baseline: TissueCheck | None
    off_limit: tuple[str, ...]
    """The columns that break a limit."""


@dataclass(frozen=True, slots=True)
class _PairRow:
    a: str
    b: str
    result: PairOverlap | None
    paper_loop: PairOverlap | None
    baseline: PairOverlap | None
    off: bool
    """Whether it has a share in a broken limit."""

    @property
    def rest_mm3(self) -> float:
        """What they share at rest."""
        found = next(side for side in (self.result, self.paper_loop, self.baseline) if side is not None)
        return found.rest_mm3


def _render(template: str, page: dict[str, Any]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("musclefit", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "amount": amount,
        "seconds": seconds,
        "breakable": breakable,
        "in_a_line": in_a_line,
    }
    return with_contents(environment.get_template(template).render({"tables_script": _script("tables.js"), **page}))


def with_contents(page: str) -> str:
    """A page whose sections can be linked to, with a list of them where the template leaves a place.

    Headings are the templates' own: a name in them would be escaped, and none stands there.
    """
    seen: list[tuple[str, str]] = []

    def named(found: re.Match[str]) -> str:
        slug = f"section-{len(seen) + 1}"
        seen.append((slug, found[1]))
        return f'<span id="{slug}"></span>{found[0]}'

    page = re.sub(r"<h2>([^<]*)</h2>", named, page)
    links = "".join(f'<a href="#{slug}">{title}</a>' for slug, title in seen)
    contents = f'<nav class="contents" id="contents" aria-label="Contents"><strong>Contents</strong>{links}</nav>'
    return page.replace("<!--contents-->", contents, 1)


@cache
def _script(name: str) -> Markup:
    """A script of the folder ``viewer``; it holds nothing that would close its element."""
    text = files("musclefit.report").joinpath("viewer", name).read_text(encoding="utf-8")
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError(f"the script {name} would close its own element; build it again without markup")
    return Markup(text)


def _shared(report: Report | MeshReport, *, remark: str) -> dict[str, Any]:
    """What both pages name."""
    failed = [check for check in report.checks if not check.passed]
    return {
        "report": report,
        "verdict": report.verdict,
        "checks": report.checks,
        "failed": failed,
        "sentences": [(_sentence(check), check.next_step) for check in failed],
        "remark": remark,
        "total_seconds": math.fsum(report.timings_s.values()),
        "schema_version": SCHEMA_VERSION,
    }


def _page(report: Report, pictures: Mapping[str, bytes], pictures_problem: str) -> dict[str, Any]:
    """Everything the page of a run names."""
    return {
        **_shared(report, remark=_remark(report)),
        "result": report.result,
        "baseline": report.baseline,
        "paper_loop": report.paper_loop,
        "groups": _grouped(compare(report)),
        "absent": absent(report.result),
        "pictures": {
            caption: "" if k == 0 else _data_uri(caption, png) for k, (caption, png) in enumerate(pictures.items())
        },
        "first_picture": {caption: _data_uri(caption, png) for caption, png in list(pictures.items())[:1]},
        "story": _story(report),
        "methods": methods_of(report, pictures=bool(pictures)),
        "pictures_problem": pictures_problem,
        "tissues": _tissue_rows(report),
        "pairs": _pair_rows(report),
        "range_step_deg": STEP_DEG,
        "range_resolution_deg": RESOLUTION_DEG,
        "mesh_theorem": MESH_THEOREM,
        "mesh_surfaces": MESH_SURFACES,
        "tet_rows": _tet_rows(report),
        "fits": () if report.tets is None else sorted(report.tets.tissues, key=_worst_fit_first),
        "skin": any(t.outside_skin_mm3 is not None for t in report.result.tissues),
        "bones": any(t.rigidity_mm is not None for t in report.result.tissues),
    }


TOLD_FIRST = ("introduced overlap", "bone off rigid", "muscle volume change", "landmark error", "folded points")
"""Checks from which the three numbers at the head of a page are taken, those that fail before the others."""


def _story(report: Report) -> list[StoryNumber]:
    """The three numbers that tell most, with the other methods'."""
    sides = (("paper's loop", report.paper_loop), ("one shot", report.baseline))
    others = {
        name: {check.name: check.value for check in checks_against(report.limits, side)}
        for name, side in sides
        if side is not None
    }
    return story_of(report.checks, others)


def story_of(checks: Iterable[Check], others: Mapping[str, Mapping[str, float]]) -> list[StoryNumber]:
    """The three numbers that tell most: what fails, then overlap, bones and muscles.

    Parameters
    ----------
    checks : iterable of Check
    others : mapping of name to values by check
        What stands beside them.
    """
    known = [check for check in checks if check.unit]
    rank = {name: k for k, name in enumerate(TOLD_FIRST)}
    first = sorted(known, key=lambda check: (check.passed, rank.get(check.name, len(rank))))[:3]
    return [
        StoryNumber(
            check.name,
            check.value,
            check.unit,
            check.limit,
            check.limited,
            check.passed,
            check.place if check.value else "",
            tuple((name, values[check.name]) for name, values in others.items() if check.name in values),
        )
        for check in first
    ]


def _tet_rows(report: Report) -> list[tuple[str, int, int, int, float]]:
    """Tissues with inverted tets, tets that were cut or vertices moved aside: how many of each, and how far, mm."""
    mesh = report.result.mesh
    if mesh is None:
        return []
    inverted = dict(mesh.inverted_by_tissue)
    cut = {} if mesh.refinement is None else dict(mesh.refinement.cut_by_tissue)
    aside = {} if mesh.refinement is None else {name: found for name, *found in mesh.refinement.moved_aside}
    return [
        (name, inverted.get(name, 0), cut.get(name, 0), int(count), float(far))
        for name, (count, far) in ((name, aside.get(name, (0, 0.0))) for name in {**inverted, **cut, **aside})
    ]


def _remark(report: Report) -> str:
    """How the methods compared with do against the same limits, in words."""
    said = [
        f"{name} {_outcome(checks_against(report.limits, side))}"
        for name, side in (("the paper's loop", report.paper_loop), ("one shot", report.baseline))
        if side is not None
    ]
    return f"Held against the same limits, {' and '.join(said)}." if said else ""


def _outcome(checks: tuple[Check, ...]) -> str:
    failed = sum(not check.passed for check in checks)
    return f"fails {failed} of {len(checks)} checks" if failed else "keeps them all"


def _sentence(check: Check) -> str:
    """One failed check in words."""
    if not check.unit and check.limit == 0 and check.value == 1:
        return f"{check.name}: {check.place}" if check.place else check.name
    where = f" ({check.place})" if check.place else ""
    if not check.limited:
        return f"{check.name}: {amount(check.value, check.unit)}{where}"
    return f"{check.name}: {amount(check.value, check.unit)}{where}; the limit is {amount(check.limit, check.unit)}"


def _grouped(rows: tuple[Row, ...]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.group, []).append(row)
    return groups


def _tissue_rows(report: Report) -> list[_TissueRow]:
    loop, baseline = (
        {} if side is None else {t.name: t for t in side.tissues} for side in (report.paper_loop, report.baseline)
    )
    ordered = worst_first(report.result.tissues, report.limits)
    return [_TissueRow(t, loop.get(t.name), baseline.get(t.name), _off_limit(t, report)) for t in ordered]


def _off_limit(tissue: TissueCheck, report: Report) -> tuple[str, ...]:
    limits = report.limits
    off = []
    most = math.inf if limits.muscle_volume_percent is None else limits.muscle_volume_percent
    if tissue.kind == TissueKind.MUSCLE and not abs(tissue.volume_change_percent) <= most:
        off.append("volume")
    if tissue.kind == TissueKind.BONE and (
        tissue.rigidity_mm is None or not tissue.rigidity_mm <= bone_limit(report.result, tissue, limits)
    ):
        off.append("rigidity")
    outside = tissue.outside_skin_introduced_mm3
    if outside is not None and not outside <= limits.introduced_outside_skin_mm3:
        off.append("outside")
    return tuple(off)


def _pair_rows(report: Report) -> list[_PairRow]:
    """Every pair that overlaps on any side: those apart at rest, then the others, largest introduced first."""
    result, loop, baseline = (
        {} if side is None else {(p.a, p.b): p for p in side.overlaps.pairs}
        for side in (report.result, report.paper_loop, report.baseline)
    )
    pairs = {**result, **loop, **baseline}
    broken = {check.name for check in report.checks if not check.passed}

    def off(pair: PairOverlap | None) -> bool:
        limited_by = "introduced overlap" if pair is not None and pair.rest_mm3 <= ROUNDING_MM3 else "grown overlap"
        return pair is not None and limited_by in broken and not pair.introduced_mm3 <= 0

    rows = [
        _PairRow(a, b, result.get((a, b)), loop.get((a, b)), baseline.get((a, b)), off(result.get((a, b))))
        for a, b in pairs
    ]

    def rank(row: _PairRow) -> tuple[bool, *tuple[tuple[float, float], ...]]:
        apart = row.result is not None and row.result.rest_mm3 <= ROUNDING_MM3
        return not apart, *(
            (1.0, 0.0) if side is None else (_largest_first(side.introduced_mm3), _largest_first(side.deformed_mm3))
            for side in (row.result, row.paper_loop, row.baseline)
        )

    return sorted(rows, key=rank)


def _worst_fit_first(fit: TissueFit) -> tuple[bool, bool, float]:
    """The skin and the filler, then tissues that fell apart, then the largest error of volume."""
    whole = fit.kind in (TissueKind.SKIN, FILLER)
    apart = fit.pieces is not None and fit.surface_pieces is not None and fit.pieces > fit.surface_pieces
    return not whole, not apart, -abs(fit.volume_error_percent or 0.0)


def _largest_first(value: float) -> float:
    """Sorts the largest first, and what is not a number before all."""
    return -math.inf if math.isnan(value) else -value


def _data_uri(caption: str, png: bytes) -> str:
    if not png.startswith(PNG_SIGNATURE):
        raise InputError(f"the picture {caption!r} is not a PNG (it starts with {png[:8]!r}); give PNG bytes")
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
