"""What a first run is going to need is compiled by a second process meanwhile, on another processor.

The list says which loops, with which types, in the order in which the other process compiles them: those that are
needed late and take longest first, for a run compiles what it needs at once by itself. What one process compiles the
other finds (`compiling`). A loop that is not in the list is compiled when it is needed, and one that is not needed
after all costs a run nothing but that processor.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
from contextlib import suppress
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

LOOPS = """
fields.bounds.strain_boxes i b f f rf2 f f2 f2 f1 f2 f2 f2 f1 f b f1 f2 f2
fields.solenoidal_bounds.box_bounds f2 f1 i2 j1 f2 f3 f2 rf2 f1 b f3 f2
fields.ceilings._fill_cells rf1 f rj3 rf2 b3 g4
fields.bounds.gradient_boxes i b f f rf2 f f2 f2 f1 f2 f2 f2 f1 f f3 f1
fields.loops.radial_sum_with_gradient i f f2 f2 f2 f1 f i1 i1 f2
fields.loops.radial_sum i f f2 f2 f2 f1 f i1 i1 f2
fields.ceilings._look_up rf1 f g1 i1 i2 f2 rf2 f2
fields.ceilings._fill_blocks g4 g4
fields.ceilings._mark_cells rj3 b3
fields.value_bounds.values i b f f f2 f2 f1 f2 f f2 f1
fields.loops.scalar_matrix i f f2 f2 f2
geometry.tet_relocation._energy f2 i2 f3 f1 f f2
certify.motions._positive_throughout rf2 rf2 ri2 b1
geometry.orientation._filter rf2 ri2 i1
geometry.subdivision._number_edges ri2 i i2 i2
fields.loops.isochoric_matrix i f f2 f2 f2
fields.lane_sums.values_in_lanes i f f2 rf1 f2 f2 f2
fields.lane_sums.gradients_in_lanes i f f2 rf1 f2 f2 f2 f3
fields.potentials.mark_seen f1 f f2 b3
fields.potentials.curl_sum rf1 f rj3 rf2 f2 f2
fields.potentials.curl_sum_with_gradient rf1 f rj3 rf2 f2 f2 f3
fields.potentials.spread_squares rf1 f rj3 f2 f1
fields.potentials.curl_spread rf1 f rj3 f2 f2 f2
"""
"""Module of musclefit and function; then its arguments: i int64, j int32, b bool, f float64, g float32; with a digit,
an array in C order of so many axes; r before it, one that cannot be written."""

_LETTERS = {"i": "int64", "j": "int32", "b": "boolean", "f": "float64", "g": "float32"}


def start_ahead() -> None:
    """Let another process compile, unless all is there already or there is no second processor for it.

    It ends with this process, or when it is done.
    """
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if processors < 2 or _done_file().exists():
        return
    with suppress(OSError):
        command = [sys.executable, "-m", __name__, str(os.getpid())]
        atexit.register(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).terminate)


def compile_ahead(*, parent: int | None = None) -> None:
    """Compile all that is not there yet; give up when the parent has ended."""
    for loop, types in listed():
        if parent is not None and os.getppid() != parent:
            return
        loop.compile(types)
    done = _done_file()
    with suppress(OSError):
        done.parent.mkdir(parents=True, exist_ok=True)
        done.touch()


def listed() -> list[tuple[Any, tuple[Any, ...]]]:
    """The compiled functions and the types of their arguments."""
    from numba import types

    found = []
    for line in LOOPS.split("\n")[1:-1]:
        place, *codes = line.split(" ")
        module, name = place.rsplit(".", 1)
        function = getattr(import_module(f"musclefit.{module}"), name)
        kinds = [_type(code) for code in codes]
        tasks = [types.int64, types.int64] if hasattr(function, "loop") else []  # which `compiling.threaded` adds
        found.append((getattr(function, "loop", function), (*tasks, *kinds)))
    return found


def _type(code: str) -> Any:
    from numba import types

    scalar = getattr(types, _LETTERS[code.removeprefix("r")[0]])
    axes = code.removeprefix("r")[1:]
    return types.Array(scalar, int(axes), "C", readonly=code[0] == "r") if axes else scalar


def _done_file() -> Path:
    """There once all of the list was compiled from these sources by this Numba for this processor."""
    from llvmlite import binding
    from numba import __version__, config

    from musclefit.compiling import compiled_folder, source_stamp

    package = Path(__file__).resolve().parent
    modules = {line.split(" ")[0].rsplit(".", 1)[0] for line in LOOPS.split("\n")[1:-1]}
    told = [
        __version__,
        sys.version,
        LOOPS,
        binding.get_host_cpu_name(),
        str(config.CPU_NAME),
        str(config.CPU_FEATURES),
    ]
    told += [source_stamp(package.joinpath(*m.split(".")).with_suffix(".py")) for m in sorted(modules)]
    return compiled_folder() / f"ahead-{sha256(repr(told).encode()).hexdigest()[:16]}"


if __name__ == "__main__":
    compile_ahead(parent=int(sys.argv[1]))
