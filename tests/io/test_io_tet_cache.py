"""Tets from disk equal those made, the key is the content, and a damaged entry is reported and made anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.geometry.meshes import TriMesh
from musclefit.io.tet_cache import TetCache, content_hash, default_cache_folder
from musclefit.progress import Silent
from musclefit.rig.model import TetSettings

QUIET = Silent()
SETTINGS = TetSettings(edge_length_fraction=0.3, envelope_fraction=5e-3)


def ball(radius: float, *, name: str = "muscle", kind: TissueKind = TissueKind.MUSCLE) -> Tissue:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    return Tissue(name, kind, TriMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


ANATOMY = Anatomy((ball(9.0), ball(5.0, name="bone", kind=TissueKind.BONE)), "test, mm")


def assert_same(a: TetAnatomy, b: TetAnatomy) -> None:
    np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    np.testing.assert_array_equal(a.mesh.tets, b.mesh.tets)
    np.testing.assert_array_equal(a.tissue_of_tet, b.tissue_of_tet)
    assert (a.dropped, a.findings) == (b.dropped, b.findings)


def test_the_second_call_reads_what_the_first_wrote(tmp_path: Path) -> None:
    cache = TetCache(tmp_path / "made" / "on" / "demand")
    first, first_from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    again, again_from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert (first_from_cache, again_from_cache) == (False, True)
    assert_same(first, again)
    assert [p.suffix for p in cache.folder.iterdir()] == [".npz"]


def test_findings_come_back_from_the_cache(tmp_path: Path) -> None:
    hidden = Anatomy((ball(3.0), ball(9.0, name="bone", kind=TissueKind.BONE)), "test, mm")
    cache = TetCache(tmp_path)
    first, _ = cache.tetrahedralise(hidden, SETTINGS, progress=QUIET)
    again, from_cache = cache.tetrahedralise(hidden, SETTINGS, progress=QUIET)
    assert from_cache
    assert [f.code for f in again.findings] == ["no-tets"]
    assert first.findings == again.findings


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda _: b"not a zip file at all",
        lambda data: data[: len(data) // 2],
        lambda data: data[:400] + bytes(b ^ 0xFF for b in data[400:900]) + data[900:],
    ],
    ids=["empty", "foreign", "cut", "flipped"],
)
def test_a_damaged_entry_is_reported_and_made_anew(tmp_path: Path, damage) -> None:
    cache = TetCache(tmp_path)
    first, _ = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    path = cache.path_of(ANATOMY, SETTINGS)
    path.write_bytes(damage(path.read_bytes()))
    made, from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert not from_cache
    assert [f.code for f in made.findings] == ["tet-cache"]
    assert "could not be read" in made.findings[0].message
    np.testing.assert_allclose(made.volumes_by_tissue(), first.volumes_by_tissue(), rtol=0.05)
    healed, from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert from_cache
    assert healed.findings == ()


def test_a_pickle_in_an_entry_is_not_run(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    path = cache.path_of(ANATOMY, SETTINGS)
    np.savez(path, layout=np.array([{"not": "an array"}], dtype=object))
    made, from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert not from_cache
    assert "allow_pickle" in made.findings[0].message


def test_tets_of_a_wrong_hand_in_an_entry_are_not_believed(tmp_path: Path) -> None:
    cache = TetCache(tmp_path)
    cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    path = cache.path_of(ANATOMY, SETTINGS)
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["tets"] = arrays["tets"][:, [1, 0, 2, 3]]
    np.savez(path, **arrays)
    made, from_cache = cache.tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert not from_cache
    assert "not right-handed" in made.findings[0].message


def test_a_folder_that_cannot_be_written_loses_no_work(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("in the way")
    made, from_cache = TetCache(blocker / "below").tetrahedralise(ANATOMY, SETTINGS, progress=QUIET)
    assert not from_cache
    assert len(made.mesh.tets) > 0
    assert "could not be cached" in made.findings[0].message


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
    keys = {content_hash(anatomy, SETTINGS) for anatomy in (ANATOMY, *variants)}
    keys |= {content_hash(ANATOMY, replace(SETTINGS, edge_length_fraction=0.31))}
    keys |= {content_hash(ANATOMY, replace(SETTINGS, envelope_fraction=6e-3))}
    assert len(keys) == len(variants) + 3
    assert content_hash(Anatomy((bone, muscle), "test, mm"), SETTINGS) == content_hash(ANATOMY, SETTINGS)


def test_the_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MUSCLEFIT_CACHE", str(tmp_path / "here"))
    assert default_cache_folder() == tmp_path / "here"
    monkeypatch.delenv("MUSCLEFIT_CACHE")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "musclefit"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache_folder() == Path.home() / ".cache" / "musclefit"
