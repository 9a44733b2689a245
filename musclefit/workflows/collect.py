"""The cases of a study, wherever they were run, made one table and one page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, TypeAdapter

from musclefit.errors import InputError
from musclefit.io.atomic import write_atomically, write_bytes_atomically
from musclefit.io.case_folders import MISSING, PASSED, RESULT, SUBJECTS, CaseOutcome, case_folder, read_case, read_cost
from musclefit.io.formats.rows import csv_of
from musclefit.io.run_folder import PICTURES, REPORT_HTML
from musclefit.io.studies import Study
from musclefit.report.cohort import Outlier, cohort_rows, outliers, render_cohort
from musclefit.workflows.results import Shown

STUDY_JSON, OUTCOMES_CSV, OUTCOMES_PARQUET = "study.json", "outcomes.csv", "outcomes.parquet"
CHECKS_CSV, COSTS_CSV, COHORT_HTML = "checks.csv", "costs.csv", "cohort.html"

_THUMBNAIL_PX = 256
_LONGEST_PART = 200


def _below_the_folder(name: str) -> str:
    """The name of a case: folders below that of the study, subject first."""
    parts = name.split("/")
    if not all(0 < len(part) <= _LONGEST_PART and part not in {".", ".."} for part in parts) or set(name) & {
        "\\",
        "\0",
    }:
        raise ValueError("no path below the study's folder")
    return name


@dataclass(frozen=True, slots=True)
class _Case:
    """A case as `write_study_json` tells it."""

    name: Annotated[str, AfterValidator(_below_the_folder)]
    subject: str
    rig: str
    motion: str
    facts: dict[str, str]


@dataclass(frozen=True, slots=True)
class _Study:
    title: str
    cases: list[_Case]


_STUDY: TypeAdapter[_Study] = TypeAdapter(_Study)


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Cohort(Shown):
    """A study as far as it was run.

    Parameters
    ----------
    title : str
    outcomes : tuple of CaseOutcome
        In the order of the study, those that were not run among them.
    folder : Path
    """

    title: str
    outcomes: tuple[CaseOutcome, ...]
    folder: Path

    @property
    def passed(self) -> bool:
        """Whether every case was run and keeps its limits."""
        return all(outcome.status == PASSED for outcome in self.outcomes)

    @property
    def outliers(self) -> tuple[Outlier, ...]:
        """Measures far from those of the other cases."""
        return outliers(self.outcomes)

    def said(self) -> str:
        """How many cases came to what, in a line."""
        counts = Counter(outcome.status for outcome in self.outcomes).most_common()
        said = ", ".join(f"{count} {status}" for status, count in counts)
        return f"{self.title}: {len(self.outcomes)} cases: {said}; in {self.folder}"

    def to_json(self) -> dict[str, Any]:
        """Title, folder, a row per case and the outliers, for programs."""
        return {
            "title": self.title,
            "folder": str(self.folder),
            "passed": self.passed,
            "cases": cohort_rows(self.outcomes),
            "outliers": [asdict(outlier) for outlier in self.outliers],
        }

    def tables(self) -> Mapping[str, Iterable[Any]]:
        """Outcomes and outliers."""
        return {"outcomes": cohort_rows(self.outcomes), "outliers": self.outliers}


def collect(folder: str | Path, *, parquet: bool = False) -> Cohort:
    """Make the tables and the page of a study from the folders of its cases.

    Parameters
    ----------
    folder : path
        As `musclefit batch` wrote it.
    parquet : bool
        Whether to write outcomes.parquet beside outcomes.csv; needs pyarrow (extra ``tables``).

    Returns
    -------
    Cohort
        Also as outcomes.csv, checks.csv, costs.csv and cohort.html in the folder.

    Raises
    ------
    InputError
        The folder holds no study, or pyarrow is not installed.
    """
    out = Path(folder)
    if parquet:
        require_pyarrow()
    title, told = _read_study_json(out)
    outcomes = tuple(_outcome(out, case) for case in told)
    rows = cohort_rows(outcomes)
    write_atomically(out / OUTCOMES_CSV, csv_of(rows))
    checks = [{"case": o.name, **check} for o in outcomes for check in o.checks]
    write_atomically(out / CHECKS_CSV, csv_of(checks))
    costs = [
        {"case": o.name, "cpu_s": c.cpu_s, "wall_s": c.wall_s, "process_peak_mb": c.process_peak_mb, **_sizes(c.sizes)}
        for o in outcomes
        if (c := read_cost(out, o.name)) is not None
    ]
    write_atomically(out / COSTS_CSV, csv_of(costs))
    if parquet:
        write_bytes_atomically(out / OUTCOMES_PARQUET, parquet_bytes(rows))
    links, thumbnails = {}, {}
    for outcome in outcomes:
        result = case_folder(out, outcome.name) / RESULT
        if (result / REPORT_HTML).is_file():
            links[outcome.name] = (result / REPORT_HTML).relative_to(out).as_posix()
        small = _thumbnail(result / PICTURES)
        if small is not None:
            thumbnails[outcome.name] = small
    page = render_cohort(title, outcomes, thumbnails=thumbnails, links=links)
    write_atomically(out / COHORT_HTML, page)
    return Cohort(title, outcomes, out)


def require_study_folder(out: Path) -> None:
    """Raise InputError, before long work, where a folder holds something else than a study or cases of one."""
    if out.exists() and not out.is_dir():
        raise InputError(f"the output folder {out} is a file; name a folder that does not exist yet")
    there = {place.name for place in out.iterdir()} if out.is_dir() else set()
    if STUDY_JSON not in there and there - {SUBJECTS}:
        raise InputError(f"{out} holds no {STUDY_JSON} of a study; name a new folder, or that of a study")


def write_study_json(study: Study, out: Path) -> None:
    """Write what `collect` needs to know of a study."""
    cases = [
        {"name": c.name, "subject": c.subject, "rig": c.rig, "motion": c.motion, "facts": dict(c.facts)}
        for c in study.cases
    ]
    text = json.dumps({"title": study.title, "cases": cases}, indent=1, ensure_ascii=False)
    write_atomically(out / STUDY_JSON, text + "\n")


def parquet_bytes(rows: list[dict[str, Any]]) -> bytes:
    """Rows as a Parquet file: numbers as float64, the rest as text.

    Raises
    ------
    InputError
        pyarrow is not installed.
    """
    pyarrow = require_pyarrow()
    from pyarrow import parquet

    columns = {}
    for heading in rows[0] if rows else ():
        cells = [row[heading] for row in rows]
        numbers = all(cell is None or isinstance(cell, int | float) for cell in cells) and any(
            cell is not None for cell in cells
        )
        kind = pyarrow.float64() if numbers else pyarrow.string()
        told = [None if cell is None else float(cell) if numbers else str(cell) for cell in cells]
        columns[heading] = pyarrow.array(told, type=kind)
    data = BytesIO()
    parquet.write_table(pyarrow.table(columns), data)
    return data.getvalue()


def require_pyarrow() -> Any:
    """pyarrow, or InputError where it is not installed."""
    try:
        import pyarrow
    except ImportError:
        raise InputError("Parquet needs pyarrow; install it: pip install 'musclefit[tables]'") from None
    return pyarrow


def _outcome(out: Path, case: _Case) -> CaseOutcome:
    """What came of a case, with the facts that the study tells of its subject now."""
    found = read_case(out, case.name)
    if found is None:
        return CaseOutcome(**asdict(case), status=MISSING, reason="it was not run, or not to its end")
    return replace(found, facts=case.facts)


def _sizes(sizes: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: sizes.get(name) for name in ("vertices", "tissues", "landmarks", "frames", "rigid", "tets", "pictures")
    }


def _read_study_json(out: Path) -> tuple[str, list[_Case]]:
    try:
        told = _STUDY.validate_python(json.loads((out / STUDY_JSON).read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError):
        raise InputError(
            f"{out} holds no {STUDY_JSON} of a study; give the folder that musclefit batch wrote"
        ) from None
    return told.title, told.cases


def _thumbnail(pictures: Path) -> bytes | None:
    """The first picture of a run, small; None where there is none that can be read."""
    from PIL import Image

    for path in sorted(pictures.glob("*.png"))[:1]:
        try:
            with Image.open(path) as picture:
                small = picture.convert("RGB")
        except (OSError, ValueError):
            return None
        small.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
        data = BytesIO()
        small.save(data, "JPEG", quality=80)
        return data.getvalue()
    return None
