"""The two files that are published: what is in them, and what they say of the package."""

from __future__ import annotations

import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from hatchling.build import build_sdist, build_wheel

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def files_below(*folders: str) -> set[str]:
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*"))
    return {
        path.relative_to(ROOT).as_posix()
        for path in paths
        if path.is_file() and not {"__pycache__", "node_modules"} & set(path.parts)
    }


def test_the_wheel_holds_the_package_with_its_rigs_and_says_what_it_is(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / build_wheel(str(tmp_path))) as wheel:
        held = set(wheel.namelist())
        (metadata,) = (wheel.read(name) for name in held if name.endswith(".dist-info/METADATA"))
        (points,) = (wheel.read(name).decode() for name in held if name.endswith("entry_points.txt"))
    package = files_below("musclefit") | {f"musclefit/{name}" for name in files_below("rigs")}
    assert {name for name in held if ".dist-info/" not in name} == package
    assert "musclefit/py.typed" in package
    assert any(name.endswith("licenses/LICENSE") for name in held)
    assert "musclefit = musclefit.cli:main" in points
    said = message_from_bytes(metadata)
    assert (said["Name"], said["License-Expression"]) == ("musclefit", "Apache-2.0")
    assert said["Description-Content-Type"] == "text/markdown"
    assert said.get_payload() == (ROOT / "README.md").read_text(encoding="utf-8")
    assert "Typing :: Typed" in said.get_all("Classifier", [])


def test_the_source_holds_what_builds_and_tests_it(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / build_sdist(str(tmp_path))) as source:
        held = {name.partition("/")[2] for name in source.getnames()}
    wanted = files_below("musclefit", "rigs", "tests", "examples") | {"README.md", "LICENSE", "pyproject.toml"}
    assert held - wanted <= {".gitignore", "PKG-INFO"}
    assert wanted <= held


def test_the_version_has_its_changes_and_the_readme_says_how_to_cite_it() -> None:
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    changes = Path("examples/docs/changes.md").read_text(encoding="utf-8")
    assert changes.splitlines()[2] == f"## {project['version']}"
    citation = Path("README.md").read_text(encoding="utf-8").partition("## Citation\n")[2]
    assert f"`{project['name']}`" in citation
    assert project["license"] in citation
    assert "BibTeX" in citation
    assert len(Path("README.md").read_text(encoding="utf-8").splitlines()) <= 150
