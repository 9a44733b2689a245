"""Tets from disk equal those made, the key is the content, and a damaged entry is reported and made anew."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.mesh_rules import Gaps, LayerRules
from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.caches import default_cache_folder
from musclefit.errors import InputError
from musclefit.geometry.meshes import TriMesh
from musclefit.meshing import cache as tet_cache
from musclefit.meshing.cache import TetCache, content_hash, default_limit_mb
from musclefit.progress import Silent
from musclefit.scratch import scratch_folder

QUIET = Silent()
RULES = LayerRules(edge_length_fraction=0.3, envelope_fraction=5e-3)


def ball(radius: float, *, name: str = "muscle", kind: TissueKind = TissueKind.MUSCLE) -> Tissue:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    return Tissue(name, kind, TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


ANATOMY = Anatomy((ball(9.0), ball(5.0, name="bone", kind=TissueKind.BONE)), "test, mm")


def assert_same(a: TetAnatomy, b: TetAnatomy) -> None:
    np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    np.testing.assert_array_equal(a.mesh.tets, b.mesh.tets)
    np.testing.assert_array_equal(a.tissue_of_tet, b.tissue_of_tet)
    assert (a.dropped, a.findings, a.fits, a.turned) == (b.dropped, b.findings, b.fits, b.turned)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> TetAnatomy:
    tets, _ = TetCache(tmp_path_factory.mktemp("made")).tetrahedralise(ANATOMY, RULES, progress=QUIET)
    return tets


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, made: TetAnatomy) -> None:
    """Tets without meshing."""
    monkeypatch.setattr(tet_cache, "tetrahedralise", lambda anatomy, *_, **__: replace(made, anatomy=anatomy))


def test_the_second_call_reads_what_the_first_wrote(tmp_path: Path) -> None:
    cache = TetCache(tmp_path / "made" / "on" / "demand")
    first, first_from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    again, again_from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert (first_from_cache, again_from_cache) == (False, True)
    assert_same(first, again)
    assert [p.suffix for p in cache.folder.iterdir()] == [".npz"]


def test_findings_come_back_from_the_cache(tmp_path: Path) -> None:
    hidden = Anatomy((ball(3.0), ball(9.0, name="bone", kind=TissueKind.BONE)), "test, mm")
    cache = TetCache(tmp_path)
    first, _ = cache.tetrahedralise(hidden, RULES, progress=QUIET)
    again, from_cache = cache.tetrahedralise(hidden, RULES, progress=QUIET)
    assert from_cache
    assert [f.code for f in again.findings] == ["no-tets", "no-skin"]
    assert first.findings == again.findings


def flagged(data: bytes, bit: int) -> bytes:
    """A zip file with one more flag set in the first entry of its directory."""
    place = data.index(b"PK\x01\x02") + 8
    return data[:place] + bytes([data[place] | bit]) + data[place + 1 :]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda _: b"not a zip file at all",
        lambda data: data[: len(data) // 2],
        lambda data: data[:400] + bytes(b ^ 0xFF for b in data[400:900]) + data[900:],
        lambda data: flagged(data, 0x20),  # "compressed patched data", which zipfile does not know
    ],
    ids=["empty", "foreign", "cut", "flipped", "patched"],
)
def test_a_damaged_entry_is_reported_and_made_anew(tmp_path: Path, damage) -> None:
    cache = TetCache(tmp_path)
    first, _ = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    path = cache.path_of(ANATOMY, RULES)
    path.write_bytes(damage(path.read_bytes()))
    made, from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert not from_cache
    (told,) = [f for f in made.findings if f.code == "tet-cache"]
    assert "could not be read" in told.message
    assert_same(replace(made, findings=first.findings), first)
    healed, from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert from_cache
    assert healed.findings == first.findings


@pytest.mark.usefixtures("quick")
def test_a_pickle_in_an_entry_is_not_run(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    path = cache.path_of(ANATOMY, RULES)
    np.savez(path, layout=np.array([{"not": "an array"}], dtype=object))
    made, from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert not from_cache
    assert "allow_pickle" in made.findings[-1].message


@pytest.mark.usefixtures("quick")
def test_tets_of_a_wrong_hand_in_an_entry_are_not_believed(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    path = cache.path_of(ANATOMY, RULES)
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["tets"] = arrays["tets"][:, [1, 0, 2, 3]]
    np.savez(path, **arrays)
    made, from_cache = cache.tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert not from_cache
    assert "not right-handed" in made.findings[-1].message


@pytest.mark.usefixtures("quick")
def test_a_folder_that_cannot_be_written_loses_no_work(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("in the way")
    made, from_cache = TetCache(blocker / "below").tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert not from_cache
    assert len(made.mesh.tets) > 0
    assert "could not be cached" in made.findings[-1].message


def test_the_key_is_all_that_tets_depend_on() -> None:
    muscle, bone = ANATOMY.tissues
    moved = muscle.with_vertices(muscle.surface.vertices + 1e-12)
    turned = replace(muscle, surface=TriMesh(muscle.surface.vertices, np.roll(muscle.surface.faces, 1, axis=1)))
    variants = [
        Anatomy((moved, bone), "test, mm"),
        Anatomy((turned, bone), "test, mm"),
        Anatomy((replace(muscle, name="other"), bone), "test, mm"),
        Anatomy((replace(muscle, kind=TissueKind.OTHER), bone), "test, mm"),
        Anatomy((muscle,), "test, mm"),
    ]
    keys = {content_hash(anatomy, RULES) for anatomy in (ANATOMY, *variants)}
    changes = [
        {"edge_length_fraction": 0.31},
        {"envelope_fraction": 6e-3},
        {"priority": ("muscle", "bone")},
        {"edge_length_mm": (("bone", 2.0),)},
        {"envelope_mm": (("bone", 2.0),)},
        {"gaps": Gaps.ALL},
        {"gap_ratio": 3.0},
        {"gap_edge_mm": 1.0},
    ]
    assert {next(iter(change)) for change in changes} == {field.name for field in fields(LayerRules)}
    keys |= {content_hash(ANATOMY, replace(RULES, **change)) for change in changes}
    keys.add(content_hash(ANATOMY, RULES, passes=1))
    assert len(keys) == 2 + len(variants) + len(changes)
    assert content_hash(Anatomy((bone, muscle), "test, mm"), RULES) == content_hash(ANATOMY, RULES)


def test_the_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path / "here"))
    assert default_cache_folder() == tmp_path / "here"
    monkeypatch.delenv("MUSCLEFIT_CACHE")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "musclefit"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache_folder() == Path.home() / ".cache" / "musclefit"


def bigger(k: int) -> Anatomy:
    """An anatomy of another content."""
    return ANATOMY.with_vertices(ANATOMY.vertices() * (1.0 + k))


@pytest.mark.usefixtures("quick")
def test_the_entries_that_were_used_longest_ago_make_room(tmp_path: Path) -> None:
    size = _kept(TetCache(tmp_path), 0).stat().st_size
    cache = TetCache(tmp_path, limit_mb=3.5 * size / 1e6)
    paths = [_kept(cache, k) for k in range(3)]
    for age, path in zip((30, 10, 20), paths, strict=True):
        os.utime(path, (time.time() - age, time.time() - age))
    assert cache.tetrahedralise(bigger(0), RULES, progress=QUIET)[1]  # used: now the latest
    tets, _ = cache.tetrahedralise(bigger(3), RULES, progress=QUIET)
    assert [path.exists() for path in paths] == [True, True, False]
    (told,) = [f.message for f in tets.findings if f.code == "tet-cache"]
    assert paths[2].name in told
    assert "1 former entries" in told


@pytest.mark.usefixtures("quick")
def test_what_is_larger_than_the_limit_is_not_kept(tmp_path: Path) -> None:
    tets, _ = TetCache(tmp_path, limit_mb=0.001).tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert list(tmp_path.iterdir()) == []
    assert "more than the cache may hold (0.001 MB)" in tets.findings[-1].message


@pytest.mark.usefixtures("quick")
def test_what_a_killed_process_was_writing_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".tets-killed").mkdir()
    (tmp_path / ".tets-killed" / "tets.npz").write_bytes(b"half")
    (tmp_path / "mine.npz").write_bytes(b"not ours")
    with scratch_folder(".tets-", inside=tmp_path) as being_written:
        path = _kept(TetCache(tmp_path), 1)
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "mine.npz", being_written, path])


@pytest.mark.usefixtures("quick")
def test_an_entry_under_another_ones_name_is_not_believed(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    path = _kept(cache, 0)
    path.rename(cache.path_of(bigger(1), RULES))
    tets, from_cache = cache.tetrahedralise(bigger(1), RULES, progress=QUIET)
    assert not from_cache
    assert "made from other content" in tets.findings[-1].message


@pytest.mark.usefixtures("quick")
def test_an_entry_cut_anywhere_is_made_anew(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    path = _kept(cache, 0)
    whole = path.read_bytes()
    for share in np.linspace(0.0, 0.999, 12):
        path.write_bytes(whole[: int(share * len(whole))])
        tets, from_cache = cache.tetrahedralise(bigger(0), RULES, progress=QUIET)
        assert not from_cache
        assert tets.findings[-1].code == "tet-cache"
        assert cache.tetrahedralise(bigger(0), RULES, progress=QUIET)[1]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
def test_a_write_that_is_broken_off_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def broken(file, **_: object) -> None:
        file.write(b"half of it")
        raise error

    monkeypatch.setattr(np, "savez", broken)
    if isinstance(error, OSError):
        tets, _ = TetCache(tmp_path).tetrahedralise(ANATOMY, RULES, progress=QUIET)
        assert "could not be cached" in tets.findings[-1].message
    else:
        with pytest.raises(KeyboardInterrupt):
            TetCache(tmp_path).tetrahedralise(ANATOMY, RULES, progress=QUIET)
    assert list(tmp_path.iterdir()) == []


def test_a_process_killed_while_writing_leaves_no_entry(tmp_path: Path, made: TetAnatomy) -> None:
    """SIGKILL, which nothing can catch, in the middle of a write."""
    arrays = tmp_path / "arrays.npz"
    np.savez(arrays, vertices=made.mesh.vertices, tets=made.mesh.tets, labels=made.tissue_of_tet)
    folder = tmp_path / "cache"
    folder.mkdir()
    script = textwrap.dedent(f"""
        import os, signal, sys
        import numpy as np
        from pathlib import Path
        from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
        from musclefit.anatomy.tetrahedra import TetAnatomy
        from musclefit.geometry.meshes import TetMesh, TriMesh
        from musclefit.meshing import cache as tet_cache
        stored = np.load({str(arrays)!r})
        surface = TriMesh(np.eye(3), np.array([[0, 1, 2]]))
        anatomy = Anatomy(tuple(Tissue(n, TissueKind.MUSCLE, surface) for n in "ab"), "test")
        tets = TetAnatomy(anatomy, TetMesh(stored["vertices"], stored["tets"]), stored["labels"], 0, ())
        whole = np.savez
        def half(file, **arrays):
            whole(file, **arrays)
            file.truncate(file.tell() // 2)
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        np.savez = half
        tet_cache._write(Path({str(folder)!r}) / "tets-0.npz", tets)
    """)
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.returncode == -9, ended.stderr
    assert [(p.name[:6], p.is_dir()) for p in folder.iterdir()] == [(".tets-", True)]


def test_the_plan_says_what_it_takes_and_whether_it_is_there(tmp_path: Path, quick: None) -> None:
    cache = TetCache(tmp_path)
    plan = cache.plan(bigger(0), RULES)
    assert (plan.kept, plan.triangles) == (False, 160)
    assert "160 triangles to fill, about" in plan.in_words
    _kept(cache, 0)
    assert cache.plan(bigger(0), RULES).in_words.startswith("tetrahedra: read from")


@pytest.mark.parametrize("said", ["much", "-1", "nan"])
def test_a_limit_that_is_no_size_is_refused(monkeypatch: pytest.MonkeyPatch, said: str) -> None:
    monkeypatch.setenv("MUSCLEFIT_CACHE_MB", said)
    with pytest.raises(InputError, match="MUSCLEFIT_CACHE_MB"):
        default_limit_mb()
    monkeypatch.setenv("MUSCLEFIT_CACHE_MB", "12.5")
    assert default_limit_mb() == 12.5


def _kept(cache: TetCache, k: int) -> Path:
    cache.tetrahedralise(bigger(k), RULES, progress=QUIET)
    return cache.path_of(bigger(k), RULES)
