"""Recordings of motion capture (.c3d) by the library ezc3d: bytes -> names, times and positions in mm."""

from __future__ import annotations

import math

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float
from musclefit.io.formats.trc import UNITS
from musclefit.io.libraries.process import asked

_SIGNATURE = 0x50
"""The second byte of every C3D file."""

CPU_S, CPU_S_PER_BYTE = 3.0, 1e-6
"""The most processor time of ezc3d, which looks for the end of some damaged files for ever; 5 MB take it 0.2 s."""
MEMORY_BYTES, MEMORY_PER_BYTE = 1 << 30, 100
"""The most memory of its process; 5 MB take 70 MB."""


def read_c3d(data: bytes, *, source: str) -> tuple[tuple[str, ...], Float, Float]:
    """Markers' names, (f,) times in s and (f, m, 3) positions in mm, not a number where a marker was not seen.

    A name loses what stands before its last colon, the subject. Time 0 is that of the recording's frame 1.

    Raises
    ------
    InputError
        Not a C3D file, ezc3d is not installed or cannot read it within its limits, no point or frame, a unit that is
        not known, or a rate that is not above 0.
    """
    if len(data) < 512 or data[1] != _SIGNATURE:
        raise InputError(f"{source}: is not a C3D file (its second byte must be 50 hexadecimal); export it again")
    read = asked(
        "read_c3d",
        {},
        {"recording.c3d": data},
        library="ezc3d",
        source=source,
        cpu_s=math.ceil(CPU_S + CPU_S_PER_BYTE * len(data)),
        memory_bytes=MEMORY_BYTES + MEMORY_PER_BYTE * len(data),
    )
    positions, rate = read["positions"], float(read["rate"])
    frames, count = positions.shape[:2]
    labels = [str(label).strip().rpartition(":")[2] for label in read["labels"]][:count]
    if not frames or not count or len(labels) < count:
        raise InputError(f"{source}: {frames} frames of {count} points with {len(labels)} names; export it again")
    unit = str(read["unit"]).strip().lower()
    if unit not in UNITS:
        raise InputError(
            f"{source}: POINT:UNITS is {unit!r}; known are {', '.join(sorted(UNITS))}: state it in the file"
        )
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError(f"{source}: the frame rate is {rate:g} Hz; expected one above 0")
    times = (int(read["first_frame"]) + np.arange(frames)) / rate
    return tuple(labels), times, positions * UNITS[unit].in_mm
