"""The readers of what musclefit itself wrote and reads again, for ``python tests/reader_fuzzing.py``.

A damaged file takes the place of a good one among the other files of a small result.
"""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fuzzed_readers import Reader
from tiny_rigs import egg

from musclefit.errors import InputError

QUICK = ("certificate.enabled=false", "compare.methods=[]")


@cache
def _home() -> Path:
    home = Path(tempfile.mkdtemp(prefix="musclefit-results-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    return home


@cache
def _run_folder() -> Path:
    from tiny_rigs import write_tiny_rig

    from musclefit.progress import Silent
    from musclefit.workflows.run import run

    rig = write_tiny_rig(_home() / "run-rig")
    run(rig, out=_home() / "run", overrides=QUICK, pictures=False, progress=Silent())
    return _home() / "run"


@cache
def _sequence_folder() -> Path:
    from tiny_rigs import drive_by_joints, write_tiny_rig

    from musclefit.progress import Silent
    from musclefit.workflows.sequence import sequence

    drive_by_joints(rig := write_tiny_rig(_home() / "sequence-rig"))
    motion = rig.with_name("bend.csv")
    motion.write_text("time_s,elbow_deg\n0,0\n1,10\n", encoding="utf-8")
    out = _home() / "sequence"
    sequence(rig, motion, out=out, overrides=QUICK, pictures=False, progress=Silent())
    return out


@cache
def _study_folder() -> Path:
    from musclefit.io.case_folders import CaseCost, CaseOutcome, write_case

    out = _home() / "study"
    case = {"name": "A", "subject": "A", "rig": "one", "motion": "", "facts": {"side": "left"}}
    check = {"name": "landmarks", "value": 0.0, "limit": 0.01, "unit": "mm", "passed": True, "place": ""}
    outcome = CaseOutcome(**case, status="passed", values={"muscle, %": 0.2, "map": "certified"}, checks=(check,))  # type: ignore[arg-type]
    write_case(out, outcome, CaseCost(1.0, 2.0, 300.0, {"vertices": 100}))
    (out / "study.json").write_text(json.dumps({"title": "two", "cases": [case, case | {"name": "B"}]}))
    return out


class _InPlace:
    """Put a file's bytes at a place of a result, use the result, and put the good ones back."""

    def __init__(self, place: Path, path: Path) -> None:
        self._place, self._good = place, place.read_bytes()
        place.write_bytes(path.read_bytes())

    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        self._place.write_bytes(self._good)


def _told(usable: bool) -> None:
    """What readers answer with nothing where a file is not usable, and it is made again, is a refusal here."""
    if not usable:
        raise InputError("not usable")


def _run_with(name: str, path: Path) -> object:
    from musclefit.workflows.compare import compare

    with _InPlace(_run_folder() / name, path):
        return compare([_run_folder(), _run_folder()])


def _sequence_with(name: str, path: Path) -> object:
    from musclefit.io.finished_sequences import read_finished_sequence

    with _InPlace(_sequence_folder() / name, path):
        finished = read_finished_sequence(_sequence_folder())
        return [finished.surfaces(frame) for frame in finished.made]


def _collected(name: str, path: Path) -> object:
    from musclefit.io.case_folders import read_cost
    from musclefit.workflows.collect import collect

    with _InPlace(_study_folder() / name, path):
        found = collect(_study_folder())
        _told(found.outcomes[0].status == "passed" and read_cost(_study_folder(), "A") is not None)
        return found


def _frame(path: Path) -> object:
    """Signed anew where it can be, so that the damage is met behind the hash."""
    from musclefit.io.sequence_frames import read_frame

    data = path.read_bytes()
    try:
        record = json.loads(data)
        del record["sha256"]
        record["sha256"] = sha256(json.dumps(record, sort_keys=True, allow_nan=False).encode()).hexdigest()
        path.write_text(json.dumps(record))
    except (ValueError, RecursionError, TypeError, KeyError):
        pass
    with _InPlace(_sequence_folder() / FRAME, path):
        found = read_frame(_sequence_folder(), 1, key="")
        _told(not isinstance(found, str))
        return found


def _between(path: Path) -> object:
    from musclefit.workflows.sequence_tasks import read_between

    with _InPlace(_sequence_folder() / BETWEEN, path):
        found = read_between(_sequence_folder(), 0)
        _told(found is not None)
        return found


@cache
def _tets() -> Any:
    from musclefit.anatomy.mesh_rules import LayerRules
    from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
    from musclefit.meshing.ftetwild import tetrahedralise
    from musclefit.progress import Silent

    rules = LayerRules(edge_length_fraction=0.3, envelope_fraction=5e-3)
    anatomy = Anatomy((Tissue("muscle", TissueKind.MUSCLE, egg((0, 0, 0), (9, 9, 9), subdivisions=1)),), "mm")
    return anatomy, rules, tetrahedralise(anatomy, rules, progress=Silent())


def _cached(path: Path) -> object:
    from musclefit.meshing import cache as kept
    from musclefit.progress import Silent

    anatomy, rules, made = _tets()
    cache = kept.TetCache(_home())
    cache.path_of(anatomy, rules).write_bytes(path.read_bytes())
    with patch.object(kept, "tetrahedralise", lambda *_, **__: made):
        found, from_cache = cache.tetrahedralise(anatomy, rules, progress=Silent())
        _told(from_cache)
        return found


def _cached_files() -> list[bytes]:
    from musclefit.meshing import cache as kept
    from musclefit.progress import Silent

    anatomy, rules, made = _tets()
    cache = kept.TetCache(_home() / "new")
    with patch.object(kept, "tetrahedralise", lambda *_, **__: made):
        cache.tetrahedralise(anatomy, rules, progress=Silent())
    return [cache.path_of(anatomy, rules).read_bytes()]


def _reader(
    name: str, folder: Callable[[], Path], inside: str, read: Callable[[str, Path], object] | Callable[[Path], object]
) -> Reader:
    """A reader of a file of a result, by what uses the result or the file."""
    given = read if read in (_frame, _between) else partial(read, inside)
    return Reader(name, Path(inside).suffix, given, lambda: [(folder() / inside).read_bytes()])  # type: ignore[arg-type]


FRAME, BETWEEN = "frames/0001/frame.json", "between/0000.json"
READERS = (
    _reader("report of a run", _run_folder, "report.json", _run_with),
    _reader("surface of a run", _run_folder, "surfaces/muscle_flexor.vtp", _run_with),
    _reader("report of a sequence", _sequence_folder, "report.json", _sequence_with),
    _reader("plan of a sequence", _sequence_folder, "sequence.json", _sequence_with),
    _reader("rest of a sequence", _sequence_folder, "rest.vtp", _sequence_with),
    _reader("frame of a sequence", _sequence_folder, FRAME, _frame),
    _reader("between frames", _sequence_folder, BETWEEN, _between),
    _reader("list of a study", _study_folder, "study.json", _collected),
    _reader("case of a study", _study_folder, "subjects/A/case.json", _collected),
    _reader("cost of a study", _study_folder, "subjects/A/cost.json", _collected),
    Reader("tets of the cache", ".npz", _cached, _cached_files),
)
