"""Motions: takes keyframes of joint angles over time, gives the poses of evenly spaced frames; knows no file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from hashlib import sha256
from itertools import pairwise

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float, frozen


class Interpolation(StrEnum):
    """What a motion does between its keyframes.

    ``cubic`` is the monotone piecewise cubic of Fritsch and Carlson: smooth, and never beyond the keyframes beside it,
    so that a motion whose keyframes keep the joints' limits keeps them throughout.
    """

    LINEAR = "linear"
    CUBIC = "cubic"


@dataclass(frozen=True, slots=True)
class Pose:
    """One frame's place in a motion.

    Parameters
    ----------
    number : int
        From 0.
    time_s : float
    degrees : tuple of (coordinate, angle in degrees)
        Of joints; empty where the time alone says the pose.
    """

    number: int
    time_s: float
    degrees: tuple[tuple[str, float], ...]

    @property
    def angles(self) -> Mapping[str, float]:
        """The angle of each coordinate, degrees."""
        return dict(self.degrees)

    @property
    def said(self) -> str:
        """The pose in words: ``0.45 s (knee 60 deg, ankle 20 deg)``."""
        angles = ", ".join(f"{name} {angle:.4g} deg" for name, angle in self.degrees)
        return f"{self.time_s:.4g} s" + (f" ({angles})" if angles else "")


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """Keyframes of joint coordinates.

    Parameters
    ----------
    times_s : (k,) float64, rising
    coordinates : (c,) tuple of str
        Names of joint coordinates.
    degrees : (k, c) float64
    source : str
        The file, for messages.

    Raises
    ------
    InputError
        Fewer than two keyframes, no coordinate, times that do not rise, or a value that is not finite.

    References
    ----------
    F. N. Fritsch and R. E. Carlson, SIAM J. Numer. Anal. 17 (1980) 238 (the cubic).
    """

    times_s: Float
    coordinates: tuple[str, ...]
    degrees: Float
    source: str

    def __post_init__(self) -> None:
        times, degrees = frozen(self.times_s), frozen(self.degrees)
        if len(times) < 2:
            raise InputError(f"{self.source}: holds {len(times)} keyframes; a motion needs at least 2")
        if not self.coordinates or degrees.shape != (len(times), len(self.coordinates)):
            raise InputError(
                f"{self.source}: {len(times)} keyframes of {len(self.coordinates)} coordinates have angles of shape "
                f"{degrees.shape}; give one angle for each"
            )
        if not (np.isfinite(times).all() and np.isfinite(degrees).all()):
            raise InputError(f"{self.source}: a time or an angle is not finite; correct it")
        for before, after in pairwise(times.tolist()):
            if not after > before:
                raise InputError(f"{self.source}: time {after:g} s follows {before:g} s; keyframe times must rise")
        object.__setattr__(self, "times_s", times)
        object.__setattr__(self, "degrees", degrees)

    def at(self, times_s: Float, *, interpolation: Interpolation) -> Float:
        """(n, c) angles at (n,) times between the first and the last keyframe, degrees.

        Raises
        ------
        InputError
            A time outside the motion.
        """
        low, high = float(self.times_s[0]), float(self.times_s[-1])
        outside = [t for t in np.ravel(times_s).tolist() if not low <= t <= high]
        if outside:
            raise InputError(f"{self.source}: asked for {outside[0]:g} s; the motion is from {low:g} to {high:g} s")
        if interpolation is Interpolation.LINEAR:
            columns = [np.interp(times_s, self.times_s, column) for column in self.degrees.T]
            return np.stack(columns, axis=1)
        from scipy.interpolate import PchipInterpolator  # here, for it is slow to import

        return np.asarray(PchipInterpolator(self.times_s, self.degrees, axis=0)(times_s), dtype=np.float64)

    def frames(self, count: int, *, interpolation: Interpolation) -> tuple[Pose, ...]:
        """``count`` poses evenly spaced in time, the first and the last keyframe included.

        Keyframes between are met only where a frame falls on them.

        Raises
        ------
        InputError
            Fewer than two frames.
        """
        if count < 2:
            raise InputError(f"found {count} frames; a sequence needs at least 2, its first and its last pose")
        times = np.linspace(self.times_s[0], self.times_s[-1], count)
        angles = self.at(times, interpolation=interpolation)
        angles[0], angles[-1] = self.degrees[0], self.degrees[-1]
        return tuple(
            Pose(k, float(time), tuple(zip(self.coordinates, map(float, row), strict=True)))
            for k, (time, row) in enumerate(zip(times, angles, strict=True))
        )

    def digest(self) -> str:
        """SHA-256 of times and angles."""
        return sha256(self.times_s.tobytes() + self.degrees.tobytes()).hexdigest()

    def resampling_in_words(self, count: int, *, interpolation: Interpolation) -> str:
        """How frames are made of the keyframes, for reports."""
        between = "straight lines" if interpolation is Interpolation.LINEAR else "monotone cubics (Fritsch-Carlson)"
        low, high = float(self.times_s[0]), float(self.times_s[-1])
        step = (high - low) / (count - 1)
        return (
            f"{len(self.times_s)} keyframes joined by {between}, {count} frames evenly spaced in time from {low:g} s "
            f"to {high:g} s, one every {step:.4g} s"
        )
