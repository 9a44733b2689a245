"""Tractograms (.tck of MRtrix, .trk of TrackVis) -> streamlines in RAS+, mm. Needs nibabel (extra ``volumes``)."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points

ENDINGS = (".tck", ".trk")


def read_tractogram(data: bytes, source: str, *, ending: str) -> tuple[Points, ...]:
    """Read the streamlines of a tractogram.

    Parameters
    ----------
    data : bytes
    source : str
        The file, for messages.
    ending : {".tck", ".trk"}

    Returns
    -------
    tuple of (p, 3) float64, mm, RAS+
        Both formats state this frame and unit.

    Raises
    ------
    InputError
        No such file, damaged, cut short, of another number of streamlines than it states, or nibabel is missing.
    """
    try:
        from nibabel.streamlines.tck import TckFile
        from nibabel.streamlines.trk import TrkFile
    except ImportError:
        raise InputError(
            f"{source}: {' and '.join(ENDINGS)} files are read by nibabel, which is not installed; install it with "
            "`pip install 'musclefit[volumes]'`"
        ) from None
    reader: Any = TckFile if ending == ".tck" else TrkFile
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            stored = reader.load(io.BytesIO(data))
            lines = tuple(np.asarray(line, dtype=np.float64) for line in stored.tractogram.streamlines)
        stated = _stated(data, stored.header, ending)
    except Exception as error:  # nibabel raises its own, struct's, numpy's and those of dictionaries and texts
        said = f"{type(error).__name__}: {error}"[:200]
        raise InputError(f"{source}: cannot be read as a tractogram ({said}); export it again") from None
    if stated not in (0, len(lines)):
        raise InputError(
            f"{source}: states {stated} streamlines and holds {len(lines)}; it is damaged or cut short: export it again"
        )
    if not all(np.isfinite(line).all() for line in lines):
        raise InputError(f"{source}: has points that are not finite; export it again")
    return lines


def _stated(data: bytes, header: Any, ending: str) -> int:
    """How many streamlines the file says that it holds; 0 where it does not."""
    if ending == ".tck":
        return int(header.get("count", 0) or 0)
    return int(np.frombuffer(data[988:992], dtype=header["endianness"] + "i4")[0])
