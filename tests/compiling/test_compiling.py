"""Compiled loops: shared by processes and environments, made anew when their sources change, run in threads."""

from __future__ import annotations

import fcntl
import os
import re
import runpy
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numba import config

from musclefit import compiling
from musclefit.compiling import one_thread, source_stamp, sources_of, threaded

LOOP = """
from musclefit.fields.enclosures.source_terms import rounding_share
assert rounding_share(3) > 0.0
print(sum(rounding_share.stats.cache_hits.values()), sum(rounding_share.stats.cache_misses.values()))
"""
"""Compiles one small function, or finds it: prints hits and misses."""


def begun(folder: Path) -> subprocess.Popen[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CACHE")}
    environment["MUSCLEFIT_CACHE"] = str(folder)
    return subprocess.Popen([sys.executable, "-c", LOOP], env=environment, stdout=subprocess.PIPE, text=True)


def said(process: subprocess.Popen[str]) -> str:
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return out.strip()


def test_what_one_process_compiles_another_finds(tmp_path):
    assert said(begun(tmp_path)) == "0 1"
    assert said(begun(tmp_path)) == "1 0"
    assert list((tmp_path / "compiled" / "fields" / "enclosures").glob("source_terms.rounding_share-*.nbc"))


def test_a_damaged_file_is_compiled_anew(tmp_path):
    said(begun(tmp_path))
    for pattern in ("*.nbc", "*.nbi"):
        for file in (tmp_path / "compiled").rglob(pattern):
            file.write_bytes(file.read_bytes()[:40])
        assert said(begun(tmp_path)) == "0 1"
        assert said(begun(tmp_path)) == "1 0"


VALUES = """
import sys
import numpy as np
from musclefit.fields.radial import RadialBackend
at = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])
field = RadialBackend(sys.argv[1], scale=50.0).fit(at, 0.1 * at)
values = field.displacement_bounds(at + 1.0, np.zeros((4, 3)))[0]
print(*values.ravel())
"""
"""Compiles, or finds, the bounds of one kernel's values."""


def test_what_was_compiled_of_one_kernel_is_never_taken_for_another(tmp_path):
    """Files of compiled code exchanged, as a process that is ended while it writes may leave them."""

    def values(kernel: str) -> list[str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CACHE")}
        environment["MUSCLEFIT_CACHE"] = str(tmp_path)
        command = [sys.executable, "-c", VALUES, kernel]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()

    right = {kernel: values(kernel) for kernel in ("gaussian", "wendland-c2")}
    assert right["gaussian"] != right["wendland-c2"]
    files = sorted((tmp_path / "compiled" / "fields").rglob("values.value_sums.locals.*.nbc"))
    assert len(files) >= 2
    by_name: dict[str, list[Path]] = {}
    for file in files:
        by_name.setdefault(re.sub(r"_[0-9a-f]{16}-.*", "", file.name), []).append(file)
    for own in by_name.values():
        data = [file.read_bytes() for file in own]
        for file, other in zip(own, data[1:] + data[:1], strict=True):
            file.write_bytes(other)
    assert {kernel: values(kernel) for kernel in right} == right


LOOPS = """
def made(scale, compiled):
    @compiled
    def long(x):
        y = x
{long}
        return y
    @compiled
    def sums(x):
        return long(x) + long(x + 0.5)
    return sums
""".format(long="\n".join(f"        y = (y if y > {k}.5 else -y) * scale + x" for k in range(80)))
"""Functions within a function, too long to be copied into the one that calls them."""

SUMS = """
import sys
from pathlib import Path
from musclefit import compiling
compiling._PACKAGE = Path(sys.argv[1])
sys.path.insert(0, sys.argv[1])
from loops import made
for scale in sys.argv[2:]:
    print(made(float(scale), compiling.njit(cache=True))(3.0))
"""


def test_loops_compiled_by_other_processes_do_not_stand_in_for_each_other(tmp_path):
    """Numba counts what a process compiles: what two processes compiled may have one symbol, and is linked by it."""
    (tmp_path / "loops.py").write_text(LOOPS, encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CACHE")}
    environment["MUSCLEFIT_CACHE"] = str(tmp_path / "cache")

    def values(*scales: str) -> list[str]:
        command = [sys.executable, "-c", SUMS, str(tmp_path), *scales]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    made = runpy.run_path(str(tmp_path / "loops.py"))["made"]
    right = {scale: str(made(float(scale), lambda loop: loop)(3.0)) for scale in ("0.25", "0.5")}
    assert len(set(right.values())) == 2
    assert values("0.25") == [right["0.25"]]
    assert values("0.5", "0.25") == [right["0.5"], right["0.25"]]


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path):
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    assert said(begun(tmp_path / "file")) == "0 1"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_a_process_waits_for_another_that_compiles_the_same(tmp_path):
    said(begun(tmp_path))
    (lock,) = (tmp_path / "compiled" / "fields" / "enclosures").glob("source_terms.rounding_share-*.lock")
    kept = {path: path.read_bytes() for path in lock.parent.glob("source_terms.rounding_share-*.nb?")}
    for path in kept:
        path.unlink()
    with lock.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        waiting = begun(tmp_path)
        time.sleep(4.0)
        for path, data in kept.items():  # the other is done
            path.write_bytes(data)
    assert said(waiting) == "1 0"


def test_what_is_imported_is_among_the_sources(tmp_path, monkeypatch):
    (tmp_path / "room").mkdir()
    (tmp_path / "a.py").write_text("from musclefit.room.b import (\n    X,\n    Y,\n)\n", encoding="utf-8")
    (tmp_path / "room" / "b.py").write_text("from musclefit.room import c, d\n", encoding="utf-8")
    (tmp_path / "room" / "c.py").write_text("from musclefit.a import Z\n", encoding="utf-8")
    (tmp_path / "other.py").write_text("X = 1\n", encoding="utf-8")
    monkeypatch.setattr(compiling, "_PACKAGE", tmp_path)
    names = {path.relative_to(tmp_path).as_posix() for path in sources_of(tmp_path / "a.py")}
    assert names == {"a.py", "room/b.py", "room/c.py"}
    before = source_stamp(tmp_path / "a.py")
    for asked in (sources_of, compiling._imported, source_stamp):
        asked.cache_clear()
    (tmp_path / "room" / "c.py").write_text("from musclefit.a import Z\nX = 2\n", encoding="utf-8")
    assert source_stamp(tmp_path / "a.py") != before


@threaded(over="points", each=4, least=2)
def _mark(begin, end, points, out):
    for task in range(begin, end):
        for i in range(4 * task, min(4 * task + 4, points.shape[0])):
            if points[i] < 0.0:
                raise ValueError
            out[i] += points[i]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("count", [0, 1, 5, 63, 64, 1001])
def test_every_task_is_done_once(monkeypatch, threads, count):
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    points, out = np.arange(1.0, count + 1.0), np.zeros(count)
    _mark(points, out)
    np.testing.assert_array_equal(out, points)


@pytest.mark.parametrize("threads", [1, 3])
def test_what_a_task_raises_reaches_the_caller(monkeypatch, threads):
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", threads)
    points = np.ones(1001)
    points[700] = -1.0
    with pytest.raises(ValueError):  # noqa: PT011 (compiled code)
        _mark(points, np.zeros(1001))


def test_loops_stay_in_the_thread_that_calls_them_where_that_is_asked_for(monkeypatch):
    """As a worker of a cluster does, which has other work for the other processors."""
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 3)
    pools: list[compiling.ThreadPoolExecutor] = []
    monkeypatch.setattr(compiling, "_pool", pools)
    parts: list[tuple[int, int]] = []
    with one_thread():
        compiling._run(lambda begin, end: parts.append((begin, end)), 1000, 1, ())
    assert (parts, pools) == ([(0, 1000)], [])
    compiling._run(lambda begin, end: parts.append((begin, end)), 1000, 1, ())
    assert len(parts) > 3
    assert len(pools) == 1
    pools[0].shutdown()
