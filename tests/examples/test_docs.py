"""The README and the guides: short enough, no dead link, every block of Python runs, every command line is one."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from running_scripts import run_script

from musclefit.cli.commands import app
from musclefit.io.rig_names import builtin_rigs

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "rigs" / "README.md", *sorted((ROOT / "examples" / "docs").glob("*.md"))]
PYTHON = [
    (page, number, block)
    for page in PAGES
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S))
]


def test_the_readme_is_read_in_five_minutes() -> None:
    assert len(PAGES[0].read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_no_link_is_dead(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_the_page_of_rigs_lists_all_that_come_along() -> None:
    rows = re.findall(r"^\| (`.*?) \|", PAGES[1].read_text(encoding="utf-8").partition("```")[0], re.M)
    assert sorted(name for row in rows for name in re.findall(r"`(\w+)`", row)) == sorted(builtin_rigs())


def test_every_guide_is_found_from_the_readme() -> None:
    text = PAGES[0].read_text(encoding="utf-8")
    assert all(f"examples/docs/{page.name}" in text for page in (ROOT / "examples" / "docs").glob("*.md"))


@pytest.mark.parametrize(
    ("page", "block"),
    [pytest.param(page, block, id=f"{page.parent.name}/{page.stem}-{number}") for page, number, block in PYTHON],
)
def test_blocks_of_python_run(page: Path, block: str, tmp_path: Path) -> None:
    """Each in a folder of its own, as somebody who copies it would run it; what it claims is true."""
    script = tmp_path / "block.py"
    script.write_text(f'if __name__ == "__main__":\n{_indented(block)}', encoding="utf-8")
    if page.name == "README.md" or "register_kernel" in block:  # first steps, from nothing; a kernel that would stay
        done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        said = done.stdout
    else:
        said = run_script(script, folder=tmp_path).stdout
    assert said
    assert "False" not in said


def _indented(block: str) -> str:
    return "".join(f"    {line}" for line in block.splitlines(keepends=True))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_command_lines_are_commands(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.M | re.S)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("musclefit ")]
    inline = [found for found in re.findall(r"`(musclefit [a-z][^`]*)`", text) if not re.search(r"[A-Z|\[]", found)]
    for line in [*lines, *inline]:
        words = shlex.split(line.partition(" > ")[0])[1:]
        if words[:1] == ["VERSION"] or len(words) < 2:
            continue
        app.parse_args(words, exit_on_error=False, print_error=False)
