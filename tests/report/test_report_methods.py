"""The paragraph on methods says what the run did and no more; its references fit; its command makes the run again."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny_rigs import drive_by_joints, write_tiny_rig

from musclefit.cli import main
from musclefit.progress import Silent
from musclefit.report.citations import WORKS, Work
from musclefit.report.html import render_html
from musclefit.report.methods import methods_of
from musclefit.report.model import Report
from musclefit.vocabulary import Claim
from musclefit.workflows.run import run


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Report]:
    """A tiny run and its report."""
    home = tmp_path_factory.mktemp("methods")
    rig = write_tiny_rig(home)
    drive_by_joints(rig)
    made = run(rig, out=home / "out", overrides=["drive.pose.elbow_deg=12"], pictures=False, progress=Silent())
    return home, made.report


def with_settings(report: Report, **sections: Mapping[str, Any]) -> Report:
    """The report of a run that was set otherwise."""
    settings = report.provenance["settings"]
    changed = {name: {**settings.get(name, {}), **section} for name, section in sections.items()}
    return replace(report, provenance={**report.provenance, "settings": {**settings, **changed}})


def test_references_are_numbered_as_they_come_and_each_is_cited(done: tuple[Path, Report]) -> None:
    for pictures in (False, True):
        methods = methods_of(done[1], pictures=pictures)
        cited = [int(n) for group in re.findall(r"\[([\d, ]+)\]", methods.paragraph) for n in group.split(", ")]
        assert list(dict.fromkeys(cited)) == list(range(1, len(methods.references) + 1))
        assert methods.bibtex.count("\n@") + 1 == len(methods.references)
        assert ("PyVista" in methods.paragraph) is pictures


def test_what_was_not_used_is_not_said(done: tuple[Path, Report]) -> None:
    report = done[1]
    plain = methods_of(report, pictures=False).paragraph
    assert "elbow 12°" in plain
    assert "kernel r3" in plain
    assert "explicit" not in plain
    for word in ("fTetWild", "divergence-free", "rigidly", "PyVista", "lattice"):
        assert word not in plain
    isochoric = with_settings(report, deformer={"kernel": "isochoric-r3", "step": "cayley"}, bones={"rigid": True})
    said = methods_of(isochoric, pictures=False)
    assert "divergence-free" in said.paragraph
    assert "implicit midpoint" in said.paragraph
    assert "rigidly" in said.paragraph
    assert any("Narcowich" in words for words in said.references)
    wendland = methods_of(with_settings(report, deformer={"kernel": "wendland-c2"}), pictures=False)
    assert any("Wendland" in words for words in wendland.references)
    ffd = methods_of(with_settings(report, deformer={"backend": "ffd"}), pictures=False)
    assert "B-splines" in ffd.paragraph
    assert "(kernel" not in ffd.paragraph


@pytest.mark.parametrize(
    ("claim", "said", "unsaid"),
    [
        (Claim.CERTIFIED, "was proved one-to-one", "nothing was proved"),
        (Claim.SAMPLED, "nothing was proved", "was proved one-to-one"),
        (Claim.UNDECIDED, "did not come to an end", "was proved one-to-one"),
        (Claim.REFUTED, "The map folds", "was proved one-to-one"),
    ],
)
def test_claims_are_exact(done: tuple[Path, Report], claim: Claim, said: str, unsaid: str) -> None:
    report = done[1]
    side = replace(report.result, map=replace(report.result.map, claim=claim))
    paragraph = methods_of(replace(report, result=side), pictures=False).paragraph
    assert said in paragraph
    assert unsaid not in paragraph


def test_broken_limits_are_named(done: tuple[Path, Report]) -> None:
    report = done[1]
    assert "All limits were kept" in methods_of(report, pictures=False).paragraph
    strict = replace(report, limits=replace(report.limits, muscle_volume_percent=1e-9))
    assert "These limits were broken: muscle volume change" in methods_of(strict, pictures=False).paragraph


def test_the_command_makes_the_run_again(
    done: tuple[Path, Report], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, report = done
    command = methods_of(report, pictures=False).command
    assert command == "musclefit run tiny.toml --set drive.pose.elbow_deg=12"
    monkeypatch.chdir(home)
    again = [*shlex.split(command)[1:], "--out", str(tmp_path / "again"), "--no-pictures", "--quiet"]
    assert main(again) == 0
    first, second = (
        json.loads((out / "report.json").read_text(encoding="utf-8")) for out in (home / "out", tmp_path / "again")
    )
    for told in (first, second):
        for key in ("timings_s", "peak_memory_mb", "certificate_cost"):
            told.pop(key)
    assert first == second
    assert (home / "out" / "methods.md").read_bytes() == (tmp_path / "again" / "methods.md").read_bytes()


def test_hostile_settings_are_quoted_and_escaped(done: tuple[Path, Report]) -> None:
    report, hostile = done[1], 'title="<img src=x onerror=alert(1)>\'; rm -rf $HOME"'
    settings = {**report.provenance["settings"], "overrides": [hostile]}
    told = {**report.provenance, "settings": settings, "versions": {"musclefit": "1}\n@x{<b>", "numpy": "<i>"}}
    changed = replace(report, provenance=told)
    methods = methods_of(changed, pictures=False)
    assert shlex.split(methods.command)[-1] == hostile
    assert methods.bibtex.count("@x") == 0
    page = render_html(changed, pictures={})
    assert "<img src=x" not in page
    assert "<b>" not in page.partition('id="methods"')[2].partition("</blockquote>")[0]


def test_a_rig_given_in_python_has_no_command(done: tuple[Path, Report]) -> None:
    report = done[1]
    bare = replace(report, provenance={})
    methods = methods_of(bare, pictures=False)
    assert methods.command == ""
    assert methods.paragraph.startswith("An anatomy of 2 bones, 1 muscle and the skin was deformed with musclefit [1]")


@pytest.mark.parametrize("work", WORKS.values(), ids=lambda work: work.key)
def test_entries_of_bibtex_are_whole(work: Work) -> None:
    entry = work.bibtex(version="v 1")
    assert entry.count("{") == entry.count("}")
    assert re.match(r"@(article|misc|inproceedings)\{[a-z0-9]+,\n", entry)
    fields = dict(re.findall(r"^  (\w+) = \{(.*)\},$", entry, re.M))
    assert {"author", "title", "note"} <= fields.keys()
    assert not work.doi or re.fullmatch(r"10\.\d{4,5}/\S+", work.doi)
    assert "&" not in re.sub(r"\\&", "", entry)
    assert "{" not in work.words
    assert (work.doi or work.url.removeprefix("https://")) in work.words
