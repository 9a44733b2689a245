"""Fibre directions at places, by muscle, as one NumPy archive without pickles."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points

FIBRES = "fibres.npz"


def fibre_bytes(fibres: Mapping[str, tuple[Points, Points]]) -> bytes:
    """The archive of places (k, 3), mm at rest, and directions (k, 3) of each muscle by name."""
    counts = [len(places) for places, _ in fibres.values()]
    file = io.BytesIO()
    np.savez(
        file,
        muscles=np.array(list(fibres), dtype=str),
        muscle=np.repeat(np.arange(len(counts)), counts),
        places_mm=np.concatenate([places for places, _ in fibres.values()] or [np.zeros((0, 3))]),
        directions=np.concatenate([along for _, along in fibres.values()] or [np.zeros((0, 3))]),
    )
    return file.getvalue()


def read_fibres(path: Path) -> Mapping[str, tuple[Points, Points]]:
    """Places, mm at rest, and directions of each muscle by name.

    Raises
    ------
    InputError
        The file cannot be read, or is not as `fibre_bytes` makes it.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            names, muscle = [str(name) for name in stored["muscles"]], stored["muscle"]
            places, directions = stored["places_mm"], stored["directions"]
    except (OSError, ValueError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: holds no fibres ({error}); name a folder that musclefit architecture wrote"
        ) from None
    if places.shape != (len(muscle), 3) or directions.shape != places.shape or not np.isfinite(places).all():
        raise InputError(f"{path}: places and directions do not fit together; write it again")
    return {name: (places[muscle == k], directions[muscle == k]) for k, name in enumerate(names)}
