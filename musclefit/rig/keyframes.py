"""Keyframes as a rig writes them: at which moment of the way the handles, or the joints, are where; knows no file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from musclefit.errors import RigError


@dataclass(frozen=True, slots=True)
class PoseKey:
    """Joint angles, degrees, at a moment in (0, 1) of the way; joints left out are evenly on their own way."""

    at: float
    pose: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class PlaceKey:
    """A file of handles at a moment in (0, 1) of the way; ``twist_deg``, one angle a station, is a skeleton's."""

    at: float
    file: str
    twist_deg: tuple[float, ...] = ()


def require_moments(keys: Sequence[PoseKey | PlaceKey]) -> None:
    """Raise RigError unless the moments rise between 0 (rest) and 1 (the destination), both excluded."""
    moments = [0.0, *(key.at for key in keys), 1.0]
    if not all(math.isfinite(at) for at in moments) or any(b <= a for a, b in pairwise(moments)):
        raise RigError(
            f"drive.keyframes: found the moments {moments[1:-1]}; expected them to rise, above 0 (rest) and below 1 "
            "(the destination, which the rig states elsewhere)"
        )
