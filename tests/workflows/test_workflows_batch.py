"""Studies: cases from tables and folders, failures that stop nothing, what is kept and what is made again."""

from __future__ import annotations

import csv
import json
import os
from contextlib import ExitStack
from html.parser import HTMLParser
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from studies import contents_but_for_times, write_study, write_subjects
from tiny_rigs import TISSUES, write_tiny_rig

from musclefit.cli import main
from musclefit.errors import InputError, RigError
from musclefit.io.case_folders import case_folder
from musclefit.io.folder_locks import held
from musclefit.io.formats.rows import csv_of
from musclefit.io.run_folder import ply_bytes
from musclefit.io.studies import FileHashes, inputs_of, read_study
from musclefit.progress import Silent
from musclefit.report.cohort import cohort_rows, outliers, render_cohort
from musclefit.workflows.batch import batch
from musclefit.workflows.collect import collect


def made_at(out: Path) -> dict[str, int]:
    return {p.parent.parent.name: p.stat().st_mtime_ns for p in out.glob("subjects/*/*/case.json")}


def test_a_study_is_run_resumed_and_redone_where_it_changed(tmp_path: Path) -> None:
    study, out = write_study(tmp_path, [5, 10, 400, "crooked"]), tmp_path / "out"
    first = batch(study, out=out, progress=Silent())
    assert [o.status for o in first.outcomes] == ["passed", "passed", "input refused", "input refused"]
    assert "elbow" in first.outcomes[2].reason
    assert "crooked" in first.outcomes[3].reason
    assert not first.passed

    before, whole = made_at(out), contents_but_for_times(out)
    batch(study, out=out, progress=Silent())
    assert made_at(out) == before
    assert contents_but_for_times(out) == whole

    table = tmp_path / "subjects.csv"
    table.write_text(table.read_text(encoding="utf-8").replace(",20", ",61"), encoding="utf-8")
    assert batch(study, out=out, progress=Silent()).outcomes[0].facts["age"] == "61"
    assert made_at(out) == before, "what is told of a subject, and sets nothing, makes no case again"

    write_subjects(tmp_path, [5, 12, 30, 20])
    again = batch(study, out=out, progress=Silent())
    assert again.passed
    assert {name for name, at in made_at(out).items() if at != before[name]} == {"s01", "s02", "s03"}

    (tmp_path / "rig" / "anatomy" / "skin.ply").write_bytes(ply_bytes(TISSUES["skin"]) + b"")
    os.utime(tmp_path / "rig" / "anatomy" / "skin.ply")
    before = made_at(out)
    batch(study, out=out, progress=Silent())
    assert made_at(out) == before, "the same bytes are the same input"
    mesh = TISSUES["muscle_flexor"]
    moved = type(mesh)(mesh.vertices + np.array([0.0, 0.5, 0.0]), mesh.faces)
    (tmp_path / "rig" / "anatomy" / "muscle_flexor.ply").write_bytes(ply_bytes(moved))
    batch(study, out=out, progress=Silent())
    assert all(at != before[name] for name, at in made_at(out).items())


def test_everything_that_a_run_reads_is_among_the_inputs_of_its_case(tmp_path: Path) -> None:
    study, out = write_study(tmp_path, [5]), tmp_path / "out"
    batch(study, out=out, progress=Silent())
    (case,) = read_study(study).cases
    report = json.loads((case_folder(out, case.name) / "result" / "report.json").read_text(encoding="utf-8"))
    read = report["provenance"]["input_sha256"]
    assert len(read) == 2 + len(TISSUES)
    assert set(read.values()) <= set(inputs_of(case, FileHashes()).values())


def test_subjects_in_folders_take_their_own_files_and_a_table_of_participants(tmp_path: Path) -> None:
    write_tiny_rig(tmp_path / "rig")
    for k, scale in enumerate((1.0, 1.1)):
        anatomy = tmp_path / "data" / f"sub-{k:02d}" / "surfaces"
        anatomy.mkdir(parents=True)
        for name, mesh in TISSUES.items():
            (anatomy / f"{name}.ply").write_bytes(ply_bytes(type(mesh)(mesh.vertices * scale, mesh.faces)))
    (tmp_path / "participants.tsv").write_text("participant_id\tsex\nsub-00\tF\nsub-01\tM\n", encoding="utf-8")
    study = tmp_path / "study.toml"
    study.write_text(
        '[subjects]\nfolders = "data/sub-*"\ntable = "participants.tsv"\n[rigs]\nbent = "rig/tiny.toml"\n'
        '[set]\nanatomy.folder = "{folder}/surfaces"\ntitle = "{subject}, {sex}"\n[run]\npictures = false\n',
        encoding="utf-8",
    )
    cohort = batch(study, out=tmp_path / "out", progress=Silent())
    assert [o.subject for o in cohort.outcomes] == ["sub-00", "sub-01"]
    assert [o.facts for o in cohort.outcomes] == [{"sex": "F"}, {"sex": "M"}]
    titles, volumes = [], []
    for outcome in cohort.outcomes:
        report = json.loads(
            (case_folder(tmp_path / "out", outcome.name) / "result" / "report.json").read_text(encoding="utf-8")
        )
        titles.append(report["title"])
        volumes.append(report["tissues"][0]["rest_volume_mm3"])
    assert titles == ["sub-00, F", "sub-01, M"]
    assert volumes[1] / volumes[0] == pytest.approx(1.1**3, rel=1e-9, abs=0)

    (tmp_path / "participants.tsv").write_text("participant_id\nsub-00\nsub-02\n", encoding="utf-8")
    with pytest.raises(RigError, match="subject 'sub-02' has no folder"):
        read_study(study)


def test_rigs_and_motions_are_crossed_unless_a_row_names_one(tmp_path: Path) -> None:
    write_study(tmp_path, [5])
    (tmp_path / "walk.csv").write_text("time_s,elbow_deg\n0,0\n1,10\n", encoding="utf-8")
    (tmp_path / "subjects.csv").write_text("subject,rig\nA,\nA b,two\n", encoding="utf-8")
    study = tmp_path / "study.toml"
    study.write_text(
        '[subjects]\ntable = "subjects.csv"\n[rigs]\none = "rig/tiny.toml"\ntwo = "rig/tiny.toml"\n'
        '[motions]\nwalk = "walk.csv"\n[run]\nframes = 2\npictures = false\n',
        encoding="utf-8",
    )
    assert [case.name for case in read_study(study).cases] == ["A/one-walk", "A/two-walk", "A_b/two-walk"]
    batch(study, out=tmp_path / "out", only="A/one-walk", progress=Silent())
    cohort = collect(tmp_path / "out") if (tmp_path / "out" / "study.json").exists() else None
    assert cohort is None, "one case alone writes no table"
    assert (tmp_path / "out" / "subjects" / "A" / "one-walk" / "result" / "muscles.csv").is_file()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[rigs]", "[rig]"), "unknown section"),
        (('table = "subjects.csv"', 'table = "gone.csv"'), "cannot be read"),
        (('table = "subjects.csv"', 'folders = "gone/*"'), "no folder fits"),
        (('bent = "rig/tiny.toml"', 'bent = "rig/gone.toml"'), "is not there"),
        (('title = "Elbows"', '[set]\ntitle = "{weight}"\n'), "no column 'weight'"),
        (("pictures = false", "pictures = 1"), "expected true or false"),
        (("pictures = false", "frames = 3"), "has no effect without"),
    ],
)
def test_studies_that_cannot_be_read_say_why(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    study = write_study(tmp_path, [5])
    study.write_text(study.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(RigError, match=said):
        batch(study, out=tmp_path / "out", progress=Silent())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("name\nA\n", "no column subject"),
        ("subject\nA\nA\n", "'A' a second time"),
        ("subject,a,a\nA,1,2\n", "each once"),
        ("subject,a\nA\n", "has 1 cells for 2 headings"),
        ("subject\n", "no row of a subject"),
        ("subject,drive.posture\nA,1\n", "unknown key 'drive.posture'"),
    ],
)
def test_tables_that_cannot_be_read_say_why(tmp_path: Path, table: str, said: str) -> None:
    study = write_study(tmp_path, [5])
    (tmp_path / "subjects.csv").write_text(table, encoding="utf-8")
    if "posture" in table:
        assert said in batch(study, out=tmp_path / "out", progress=Silent()).outcomes[0].reason
        return
    with pytest.raises(RigError, match=said):
        read_study(study)


def test_one_study_at_a_time_writes_into_a_folder_and_one_process_at_a_time_into_a_case(tmp_path: Path) -> None:
    study, out = write_study(tmp_path, [5]), tmp_path / "out"
    with held(out.absolute()), pytest.raises(InputError, match="is being written by another process"):
        batch(study, out=out, progress=Silent())
    assert not (out / "study.json").exists()
    with ExitStack() as elsewhere:
        elsewhere.enter_context(held(case_folder(out.absolute(), "s00/bent")))
        thread = Thread(target=batch, args=(study,), kwargs={"out": out, "only": "s00/bent", "progress": Silent()})
        thread.start()
        thread.join(1.5)
        assert thread.is_alive(), "it waits for the other"
        assert not list(out.glob("subjects/*/*/case.json"))
    thread.join(60.0)
    assert collect_after(study, out) == ["passed"]


def collect_after(study: Path, out: Path) -> list[str]:
    return [outcome.status for outcome in batch(study, out=out, progress=Silent()).outcomes]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    study = write_study(tmp_path, [5])
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"holds no study\.json"):
        batch(study, out=tmp_path / "other", progress=Silent())
    with pytest.raises(InputError, match=r"holds no study\.json"):
        collect(tmp_path / "other")


def test_commands_tell_and_give_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, out = write_study(tmp_path, [5, 400]), tmp_path / "out"
    assert main(["batch", str(study), "--out", str(out), "--estimate"]) == 0
    assert "2 cases left" in capsys.readouterr().out
    assert not out.exists()
    assert main(["batch", str(study), "--out", str(out), "--slurm", "--quiet"]) == 0
    assert main(["batch", str(study), "--out", str(out), "--only", "s00/bent", "--quiet"]) == 0
    assert main(["collect", str(out), "--json"]) == 1
    assert main(["batch", str(study), "--out", str(out), "--estimate", "--json"]) == 0
    decoder, text = json.JSONDecoder(), capsys.readouterr().out.lstrip()
    collected, end = decoder.raw_decode(text[text.index("{") :])
    assert [case["status"] for case in collected["cases"]] == ["passed", "not run"]
    assert json.loads(text[text.index("{") :][end:])["cases"] == 1
    assert main(["collect", str(out), "--parquet"]) == 1
    said = capsys.readouterr().out
    assert "1 passed, 1 not run" in said
    assert main(["batch", str(study), "--out", str(out), "--only", "s07/bent"]) == 2
    assert "no case is named 's07/bent'" in capsys.readouterr().err
    assert main(["batch", str(study), "--slurm", "--estimate"]) == 2
    import pyarrow.parquet as parquet

    rows = list(csv.DictReader((out / "outcomes.csv").read_text(encoding="utf-8").splitlines()))
    table = parquet.read_table(out / "outcomes.parquet").to_pylist()
    assert [row["status"] for row in rows] == [row["status"] for row in table] == ["passed", "not run"]
    assert float(rows[0]["least det J"]) == table[0]["least det J"]
    assert table[1]["least det J"] is None


class _Outcome:
    """A case with one measure."""

    def __init__(self, name: str, value: float | None, **named: str) -> None:
        self.name, self.subject, self.rig = name, named.get("subject", name), named.get("rig", "r")
        self.motion, self.reason = "", named.get("reason", "")
        self.status = "passed" if not self.reason else "input refused"
        self.facts = {"status": "x"} if "fact" in named else {}
        self.values = {"m [mm]": value}


def test_outliers_are_far_from_the_median_of_their_own_rig() -> None:
    usual = [_Outcome(f"a{k}", 10.0 + 0.1 * k) for k in range(9)]
    others = [_Outcome(f"b{k}", 100.0 + k, rig="q") for k in range(9)]
    (far,) = outliers([*usual, _Outcome("far", 20.0), *others])
    assert far.name == "far"
    median = 10.45
    spread = sorted(abs(v - median) for v in [10.0 + 0.1 * k for k in range(9)] + [20.0])
    assert far.score == pytest.approx((20.0 - median) / (1.4826 * (spread[4] + spread[5]) / 2), rel=1e-12, abs=0)
    assert not outliers([*usual[:6], _Outcome("far", 20.0)]), "seven values are too few"
    assert not outliers([_Outcome(f"c{k}", 1.0) for k in range(20)])
    equal = [_Outcome(f"d{k}", 1.0) for k in range(20)]
    assert [o.name for o in outliers([*equal, _Outcome("far", 2.0)])] == ["far"]


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.scripts, self.handlers, self.images, self.addresses = 0, 0, 0, []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        self.images += tag == "img"
        self.handlers += sum(name.startswith("on") for name, _ in attrs)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]


def test_hostile_names_do_no_harm_in_page_and_table() -> None:
    name = "<script>alert(1)</script>\" onmouseover='x' {{7*7}} =cmd()"
    outcome = _Outcome(name, 1.0, subject=f"={name}", reason=name, fact="x")
    page = render_cohort(name, [outcome], thumbnails={name: b"jpeg"}, links={name: "subjects/a/report.html"})
    tags, harmless = _Tags(), _Tags()
    tags.feed(page)
    harmless.feed(render_cohort("a", [_Outcome("a", 1.0)], thumbnails={}, links={}))
    assert (tags.scripts, tags.handlers, tags.images) == (harmless.scripts, 0, 1)
    assert sorted(address for address in tags.addresses if not address.startswith("#")) == [
        "data:image/jpeg;base64,anBlZw==",
        "subjects/a/report.html",
    ]
    assert "{{7*7}}" in page
    rows = cohort_rows([outcome])
    assert rows[0]["status"] == "input refused"
    assert rows[0]["subject: status"] == "x"
    (row,) = csv.DictReader(csv_of(rows).splitlines())
    assert row["subject"] == f"'={name}"
    assert row["case"] == name


@pytest.mark.parametrize("name", ["../elsewhere", "s00/..", "", "s00//bent", "a\\b", "s" * 201])
def test_cases_named_out_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    case = {"name": name, "subject": "s00", "rig": "bent", "motion": "", "facts": {}}
    (tmp_path / "study.json").write_text(json.dumps({"title": "t", "cases": [case]}), encoding="utf-8")
    with pytest.raises(InputError, match=r"holds no study\.json of a study"):
        collect(tmp_path)


@pytest.mark.parametrize("name", ["s01/bent", "../../elsewhere", "x" * 5000])
def test_a_record_of_another_case_counts_as_none(tmp_path: Path, name: str) -> None:
    case = {"name": "s00/bent", "subject": "s00", "rig": "bent", "motion": "", "facts": {}}
    (tmp_path / "study.json").write_text(json.dumps({"title": "t", "cases": [case]}), encoding="utf-8")
    folder = case_folder(tmp_path, "s00/bent")
    folder.mkdir(parents=True)
    record = {**case, "name": name, "status": "passed"}
    (folder / "case.json").write_text(json.dumps(record), encoding="utf-8")
    (outcome,) = collect(tmp_path).outcomes
    assert (outcome.name, outcome.status) == ("s00/bent", "not run")
    (folder / "case.json").write_text(json.dumps({**record, "name": "s00/bent"}), encoding="utf-8")
    assert collect(tmp_path).outcomes[0].status == "passed"
