"""Workers' files: kept within time and memory, and gone when the process that asked for them is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from musclefit.worker_processes import run_worker

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="knows no limits")


def outcome(folder: Path, text: str, *, cpu_s: float = 60.0, memory_bytes: float = float("inf")) -> tuple[int, str]:
    worker = folder / "worker.py"
    worker.write_text(text, encoding="utf-8")
    return run_worker(
        worker,
        ["first", "second"],
        folder=folder,
        fractions=lambda lines: map(float, lines),
        tick=lambda _: None,
        cpu_s=cpu_s,
        memory_bytes=memory_bytes,
    )


def test_a_worker_meets_its_arguments_and_its_exit_code_comes_back(tmp_path: Path) -> None:
    text = "import sys\nprint(0.5)\nsys.exit(7 if sys.argv[1:] == ['first', 'second'] else 3)\n"
    assert outcome(tmp_path, text) == (7, "")


def test_one_without_an_end_is_ended(tmp_path: Path) -> None:
    code, said = outcome(tmp_path, "while True: pass\n", cpu_s=1.0)
    assert code == -signal.SIGXCPU
    assert said == "no end within 1 s of processor time"


def test_one_that_asks_for_too_much_memory_is_told_so(tmp_path: Path) -> None:
    code, said = outcome(tmp_path, "bytearray(1 << 30)\n", memory_bytes=1 << 29)
    assert code == 1
    assert "MemoryError" in said


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it ends when it next prints")
def test_it_dies_with_the_process_that_asked(tmp_path: Path) -> None:
    (tmp_path / "worker.py").write_text("import os\nprint(os.getpid(), flush=True)\nwhile True: pass\n")
    main = (
        "import sys\nfrom pathlib import Path\nfrom musclefit.worker_processes import run_worker\n"
        "place = Path(sys.argv[1])\n"
        "run_worker(place / 'worker.py', [], folder=place, fractions=lambda lines: map(int, lines),\n"
        "           tick=lambda number: print(number, flush=True))\n"
    )
    command = [sys.executable, "-c", main, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as asking:
        assert asking.stdout is not None
        worker = int(asking.stdout.readline())
        assert psutil.pid_exists(worker)
        os.kill(asking.pid, signal.SIGKILL)
    until = time.monotonic() + 20.0
    while psutil.pid_exists(worker) and time.monotonic() < until:
        time.sleep(0.02)
    assert not psutil.pid_exists(worker)
