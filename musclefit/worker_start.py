"""Runs a worker's file within limits, as long as the process that asked for it lives; imports nothing of musclefit.

Started by `musclefit.worker_processes` with the number of that process, the limits, the file and its arguments.
"""

from __future__ import annotations

import math
import os
import runpy
import signal
import sys


def main(parent: str, cpu_s: str, memory_bytes: str, worker: str) -> None:
    """Run the file; ``sys.argv`` is what it would be without us."""
    _end_with(int(parent))
    _limit(float(cpu_s), float(memory_bytes))
    runpy.run_path(worker, run_name="__main__")


def _end_with(parent: int) -> None:
    """Die when the parent does: at once on Linux, elsewhere when next something is printed.

    A library may work for minutes without giving Python a chance to look.
    """
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    if sys.platform == "linux":
        import ctypes

        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
        if os.getppid() != parent:  # it died before we asked
            sys.exit(1)


def _limit(cpu_s: float, memory_bytes: float) -> None:
    """Take no more processor time and memory than that, where the system knows limits."""
    if sys.platform == "win32":
        return
    import resource

    for kind, most in ((resource.RLIMIT_CPU, cpu_s), (resource.RLIMIT_AS, memory_bytes)):
        _, hard = resource.getrlimit(kind)
        if math.isfinite(most) and (hard == resource.RLIM_INFINITY or most <= hard):
            resource.setrlimit(kind, (math.ceil(most), hard))


if __name__ == "__main__":
    started, sys.argv = sys.argv, sys.argv[4:]
    main(*started[1:5])
