"""Thin walls, narrow slots and small gaps: boxes whose distances are known, on both sides of the limit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh

from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
from musclefit.cli import main
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.booleans import difference
from musclefit.io.run_folder import ply_bytes
from musclefit.progress import Silent, Tick
from musclefit.validate.closeness import close_findings
from musclefit.validate.overlaps import solid_anatomy


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriMesh:
    made = trimesh.creation.box(bounds=[low, high])
    return TriMesh(np.asarray(made.vertices, dtype=np.float64), np.asarray(made.faces, dtype=np.int64))


def found(
    surfaces: dict[str, TriMesh], *, thinnest_mm: float = 0.0, smallest_gap_mm: float = 0.0
) -> list[tuple[str, str]]:
    tissues = [
        Tissue(name, TissueKind.SKIN if name == "skin" else TissueKind.MUSCLE, surface)
        for name, surface in surfaces.items()
    ]
    solids = solid_anatomy(Anatomy(tuple(tissues), frame="unspecified"), progress=Silent())
    findings = close_findings(solids, thinnest_mm=thinnest_mm, smallest_gap_mm=smallest_gap_mm, progress=Silent())
    return [(f.subject, f.code) for f in findings]


BLOCK = box((0.0, 0.0, 0.0), (10.0, 10.0, 10.0))


@pytest.mark.parametrize("gap", [0.01, 0.3])
def test_a_gap_is_found_below_the_limit_and_not_above(gap: float) -> None:
    two = {"a": BLOCK, "b": box((10.0 + gap, 0.0, 0.0), (20.0, 10.0, 10.0))}
    assert found(two, smallest_gap_mm=1.1 * gap) == [("a and b", "small-gap")]
    assert found(two, smallest_gap_mm=0.9 * gap) == []
    assert found(two) == []


class Watched(Silent):
    """Progress that keeps what it was told, by stage."""

    def __init__(self) -> None:
        self.told: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        yield self.told.setdefault(name, []).append


def test_every_pair_of_a_search_for_gaps_is_told_to_the_bar() -> None:
    row = [box((11.0 * k, 0.0, 0.0), (11.0 * k + 10.0, 10.0, 10.0)) for k in range(4)]
    tissues = tuple(Tissue(f"m{k}", TissueKind.MUSCLE, surface) for k, surface in enumerate(row))
    solids, watched = solid_anatomy(Anatomy(tissues, frame="unspecified"), progress=Silent()), Watched()
    close_findings(solids, thinnest_mm=0.0, smallest_gap_mm=1.5, progress=watched)
    np.testing.assert_allclose(watched.told["gaps"], [1 / 3, 2 / 3, 1.0])


def test_overlap_contact_and_the_skin_are_no_gap() -> None:
    across = {"a": BLOCK, "b": box((9.0, 0.0, 0.0), (20.0, 10.0, 10.0))}
    assert found(across, smallest_gap_mm=0.5) == []
    within = {"skin": box((-0.1, -0.1, -0.1), (10.1, 10.1, 10.1)), "a": BLOCK}
    assert found(within, smallest_gap_mm=0.5) == []


@pytest.mark.parametrize("width", [0.2, 0.8])
def test_walls_and_slots_are_told_apart_and_from_what_is_wide(width: float) -> None:
    plate = {"a": box((0.0, 0.0, 0.0), (10.0, 10.0, width))}
    assert found(plate, thinnest_mm=1.1 * width) == [("a", "thin-wall")]
    assert found(plate, thinnest_mm=0.9 * width) == []
    tool = box((5.0, -1.0, 4.0), (5.0 + width, 11.0, 11.0))
    slotted = {"a": difference(BLOCK, [tool], smooth_within_mm=0.0)}
    assert found(slotted, thinnest_mm=1.1 * width) == [("a", "narrow-slot")]
    assert found(slotted, thinnest_mm=0.9 * width) == []


def test_check_fails_on_what_is_closer_than_stated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "muscle_a.ply").write_bytes(ply_bytes(BLOCK))
    (tmp_path / "muscle_b.ply").write_bytes(ply_bytes(box((10.25, 0.0, 0.0), (20.0, 10.0, 0.5))))
    assert main(["check", str(tmp_path), "--quiet"]) == 0
    assert main(["check", str(tmp_path), "--quiet", "--smallest-gap-mm", "0.2", "--thinnest-mm", "0.4"]) == 0
    assert main(["check", str(tmp_path), "--smallest-gap-mm", "0.3"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "muscle_a and muscle_b are 0.25 mm apart, closer than 0.3 mm" in said
    assert main(["check", str(tmp_path), "--thinnest-mm", "0.6"]) == 1
    assert "muscle_b is thinner than 0.6 mm over" in " ".join(capsys.readouterr().out.split())
    assert main(["check", str(tmp_path), "--thinnest-mm", "-1"]) == 2
    assert "thinnest_mm: found -1; give a length of at least 0 mm" in capsys.readouterr().err


def test_gaps_tell_how_far_they_are() -> None:
    told: dict[str, list[float]] = {}

    class Watched:
        @contextmanager
        def stage(self, name: str) -> Iterator[Tick]:
            yield told.setdefault(name, []).append

    blocks = [box((10.5 * k, 0.0, 0.0), (10.5 * k + 10.0, 10.0, 10.0)) for k in range(4)]
    tissues = [Tissue(f"muscle_{k}", TissueKind.MUSCLE, block) for k, block in enumerate(blocks)]
    solids = solid_anatomy(Anatomy(tuple(tissues), frame="unspecified"), progress=Silent())
    findings = close_findings(solids, thinnest_mm=0.0, smallest_gap_mm=1.0, progress=Watched())
    assert len(findings) == 3
    assert told["gaps"] == [1 / 3, 2 / 3, 1.0]
