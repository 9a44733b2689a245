"""Damaged files: every reader refuses them in words; a small part of ``python tests/reader_fuzzing.py``."""

from __future__ import annotations

from pathlib import Path

import pytest
from reader_fuzzing import READERS, Reader, fuzzed, survive

from musclefit.errors import InputError

FILES = 12
SEED = 2


SLOW = ("recording c3d",)
"""Whose every file takes a process of its own."""


@pytest.mark.parametrize(
    "reader",
    [pytest.param(r, id=r.name, marks=[pytest.mark.slow] if r.name in SLOW else []) for r in READERS],
)
def test_a_good_file_is_read_and_damaged_ones_are_refused_in_words(reader: Reader, tmp_path: Path) -> None:
    refused = 0
    for data in reader.examples():
        (tmp_path / f"good{reader.ending}").write_bytes(data)
        reader.read(tmp_path / f"good{reader.ending}")
    problems = {n: survive(reader, fuzzed(reader, seed=SEED, number=n), tmp_path) for n in range(FILES)}
    assert not {n: problem for n, problem in problems.items() if problem}
    for number in range(FILES):
        (tmp_path / f"bad{reader.ending}").write_bytes(fuzzed(reader, seed=SEED, number=number))
        try:
            reader.read(tmp_path / f"bad{reader.ending}")
        except InputError:
            refused += 1
    assert refused, "no damage was refused"


def test_what_no_reader_may_let_through_is_told(tmp_path: Path) -> None:
    def fails(path: Path) -> None:
        raise KeyError(path.suffix)

    def swells(path: Path) -> None:
        raise MemoryError

    assert survive(Reader("a", ".a", fails, lambda: [b""]), b"", tmp_path).startswith("uncaught KeyError: '.a'")
    assert survive(Reader("a", ".a", swells, lambda: [b""]), b"", tmp_path) == "over 1 GiB"


READERS_OF = {
    **dict.fromkeys((".vtp", ".ply", ".obj"), ("points", "surface")),
    **{".vtu": ("points", "tets of a run"), ".trc": ("points", "landmarks"), ".mrk.json": ("points", "landmarks")},
    **{".nii.gz": ("image",), ".nii": ("image",), ".toml": ("rig", "joints")},
    ".csv": ("label names", "landmarks", "lattice", "motion", "points"),
}


@pytest.mark.anatomy
def test_the_kept_faults_are_refused_in_words(anatomy_data: Path, tmp_path: Path) -> None:
    files = sorted((anatomy_data / "faults").iterdir())
    assert files
    for file in files:
        ending = next(ending for ending in READERS_OF if file.name.endswith(ending))
        fit = [r for r in READERS if file.name.endswith(r.ending) and r.name.startswith(READERS_OF[ending])]
        assert fit, file.name
        for reader in fit:
            assert survive(reader, file.read_bytes(), tmp_path) == "", (file.name, reader.name)
