"""How much time and memory a case takes, from its sizes: a model fitted to measured cases, before any work is done."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from musclefit.errors import InputError
from musclefit.geometry.arrays import Float

MODEL_FILE = Path(__file__).with_name("cost_model.json")
"""Coefficients that came of `examples/cost_model.py`."""

TERMS = ("1", "vertices", "vertices x landmarks", "landmarks²", "tissues²")
"""What the CPU seconds of a part are a sum of, with coefficients that are not negative."""

EXTRAS = ("pictures", "pictures of a motion", "tetrahedra")
"""Parts that come on top of what a run takes without them."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """What time and memory of a case depend on.

    Parameters
    ----------
    vertices, tissues, landmarks : float
        Of the anatomy, and of what drives it.
    frames : float
        1 for a single run.
    rigid, tets, pictures : bool
        Whether bones are held rigid, tetrahedra made, and pictures drawn.
    """

    vertices: float
    tissues: float
    landmarks: float
    frames: float = 1
    rigid: bool = False
    tets: bool = False
    pictures: bool = False

    @property
    def parts(self) -> tuple[str, ...]:
        """What a case is made of, each with coefficients of its own: the run itself, and what comes on top."""
        moving = self.frames > 1
        own = ("rigid bones" if self.rigid else "free bones") + (", motion" if moving else "")
        drawn = ("pictures of a motion" if moving else "pictures",) if self.pictures else ()
        return own, *drawn, *(("tetrahedra",) if self.tets and not moving else ())

    def terms(self) -> tuple[float, ...]:
        """The terms of a part, as in ``TERMS``, times frames: thousands of vertices, hundreds of landmarks."""
        v, m, t = self.vertices / 1e3, self.landmarks / 1e2, self.tissues / 10.0
        return tuple(self.frames * term for term in (1.0, v, v * m, m * m, t * t))


@dataclass(frozen=True, slots=True)
class Measured:
    """A case whose cost is known; the first of a process takes what that takes to start, too."""

    sizes: Sizes
    cpu_s: float
    peak_mb: float | None = None
    first: bool = False


@dataclass(frozen=True, slots=True)
class CostModel:
    """Coefficients by part: of CPU seconds, and of the peak memory of a process.

    Parameters
    ----------
    cpu_s : mapping of part to five numbers
        Per term of ``TERMS``.
    peak_mb : mapping of part to two numbers
        The memory of the process itself, and that per thousand vertices, MB.
    error_percent : mapping of part to number
        The largest error of the CPU seconds of whole cases that the coefficients were fitted to.
    start_cpu_s : float
        What a process takes once, to import and to load what is compiled.
    """

    cpu_s: Mapping[str, tuple[float, ...]]
    peak_mb: Mapping[str, tuple[float, ...]]
    error_percent: Mapping[str, float]
    start_cpu_s: float = 0.0

    @classmethod
    def fitted(cls, cases: Sequence[Measured], *, start_cpu_s: float = 0.0) -> CostModel:
        """The model nearest to measured cases, by least squares of relative errors with no coefficient below zero.

        Cases without pictures and tetrahedra give the parts of runs; what the others take beyond these gives the rest.

        Raises
        ------
        InputError
            No case, or one that took no time.
        """
        if not cases or min(case.cpu_s for case in cases) <= 0:
            raise InputError("a cost model needs measured cases, each with CPU seconds above 0; measure some")
        cpu: dict[str, tuple[float, ...]] = {}
        peak: dict[str, tuple[float, ...]] = {}
        error: dict[str, float] = {}
        for part in sorted({case.sizes.parts[-1] for case in cases}, key=lambda part: (part in EXTRAS, part)):
            own = [case for case in cases if case.sizes.parts[-1] == part]
            told = np.array([case.cpu_s for case in own])
            below = np.array([_sum(cpu, case.sizes, case.sizes.parts[:-1]) for case in own])
            terms = np.array([case.sizes.terms() for case in own])
            terms[:, 2:] *= part not in EXTRAS  # what comes on top knows no landmarks
            cpu[part] = _least(terms / told[:, None], np.maximum(told - below, 0.0) / told)
            error[part] = float(100.0 * np.abs((terms @ np.array(cpu[part]) + below) / told - 1.0).max())
            known = [case for case in own if case.peak_mb]
            if known:
                most = np.array([case.peak_mb for case in known], dtype=float)
                terms = np.array([[1.0, case.sizes.vertices / 1e3] for case in known])
                peak[part] = _least(terms / most[:, None], np.ones(len(known)))
        return cls(cpu, peak, error, start_cpu_s)

    @classmethod
    def shipped(cls) -> CostModel:
        """The coefficients that come along."""
        read = json.loads(MODEL_FILE.read_text(encoding="utf-8"))
        return cls(**{name: read[name] for name in ("cpu_s", "peak_mb", "error_percent", "start_cpu_s")})

    def case_cpu_s(self, sizes: Sizes) -> float:
        """CPU seconds of a case; parts that were not measured are left out."""
        return _sum(self.cpu_s, sizes, sizes.parts)

    def unknown(self, sizes: Sizes) -> tuple[str, ...]:
        """The parts of a case that the model knows nothing of."""
        return tuple(part for part in sizes.parts if part not in self.cpu_s)

    def case_peak_mb(self, sizes: Sizes) -> float:
        """Peak memory of a process that runs the case, MB."""
        known = [self.peak_mb[part] for part in sizes.parts if part in self.peak_mb] or list(self.peak_mb.values())
        return max(float(own[0] + own[1] * sizes.vertices / 1e3) for own in known)

    def scale(self, made: Sequence[Measured]) -> float:
        """What some cases took over what is told for them, as the ratio of the sums; 1 without cases.

        Not the median of their ratios: the time of a study is a sum, in which its few hard cases count. Cases that were
        the first of their processes count only where there are no others, and without what a process takes to start.
        """
        later = [case for case in made if not case.first] or made
        told = sum(self.case_cpu_s(case.sizes) for case in later)
        took = sum(max(case.cpu_s - self.start_cpu_s * case.first, 0.0) for case in later)
        return took / told if took and told else 1.0

    def peak_mb_of(self, cases: Sequence[Sizes], made: Sequence[Measured]) -> float:
        """Peak memory of a process that runs some cases, MB: that of cases made before, and what larger ones add."""
        told = max(map(self.case_peak_mb, cases))
        seen = [case for case in made if case.peak_mb]
        if not seen:
            return told
        return max(float(case.peak_mb or 0.0) + max(0.0, told - self.case_peak_mb(case.sizes)) for case in seen)

    def text(self) -> str:
        """The coefficients as a file holds them."""
        merged: dict[str, dict[str, object]] = {"cpu_s": {}, "peak_mb": {}, "error_percent": {}}
        for name, table in merged.items():
            for part, value in getattr(self, name).items():
                table[part] = [float(f"{x:.3g}") for x in value] if name != "error_percent" else round(value, 1)
        told = {"terms": TERMS, "start_cpu_s": round(self.start_cpu_s, 2), **merged}
        return json.dumps(told, indent=1, ensure_ascii=False) + "\n"


def _sum(cpu_s: Mapping[str, Sequence[float]], sizes: Sizes, parts: Sequence[str]) -> float:
    terms = sizes.terms()
    return float(sum(np.dot(cpu_s[part], terms) for part in parts if part in cpu_s))


def _least(terms: Float, told: Float) -> tuple[float, ...]:
    return tuple(float(x) for x in nnls(terms, told)[0])


@dataclass(frozen=True, slots=True)
class Forecast:
    """What is left of a study.

    Parameters
    ----------
    cases, measured : int
        Left to make, and already made, by which the forecast is scaled where there are any.
    cpu_s : float
        0 where no case could be read that the others could be judged by.
    workers : int
    peak_mb : float
        Of one worker; 0 as ``cpu_s``.
    available_mb : float or None
        None where the system does not tell.
    limited : bool
        Whether memory allows fewer workers than were asked for.
    left_out : tuple of str
        Parts of cases that the model knows nothing of, such as tetrahedra of a motion.
    """

    cases: int
    measured: int
    cpu_s: float
    workers: int
    peak_mb: float
    available_mb: float | None
    limited: bool
    left_out: tuple[str, ...] = ()

    @property
    def wall_s(self) -> float:
        """Seconds until the end, when every worker has a processor for itself."""
        return self.cpu_s / max(1, self.workers)

    @property
    def in_words(self) -> str:
        """The forecast in a line or two."""
        if not self.cases:
            return "nothing is left to do"
        if not self.cpu_s:
            return f"{self.cases} cases left; none of the first of each rig can be read, so that there is no forecast"
        by = f"scaled by {self.measured} made before" if self.measured else "by the model that comes along"
        workers = "1 worker" if self.workers == 1 else f"{self.workers} workers"
        said = (
            f"{self.cases} cases left: about {_time(self.cpu_s)} of CPU ({by}), {_time(self.wall_s)} with {workers}; "
            f"about {self.peak_mb:.0f} MB each"
        )
        if self.available_mb is not None:
            said += f" of {self.available_mb:.0f} MB available"
        if self.left_out:
            said += f"; without {', '.join(self.left_out)}, which the model does not know"
        if self.limited:
            said += "; memory allows no more workers"
        if self.available_mb is not None and self.peak_mb > self.available_mb:
            said += "; one case may need more memory than there is"
        return said


def workers_that_fit(wanted: int, *, peak_mb: float, available_mb: float | None) -> int:
    """How many of the wanted workers memory allows, nine tenths of it used; at least one."""
    if available_mb is None or not peak_mb or wanted <= 1:
        return wanted
    return max(1, min(wanted, int(0.9 * available_mb / peak_mb)))


def available_mb() -> float | None:
    """Memory that processes can still take, MB (10⁶ bytes), with the limit of a control group; None where unknown."""
    if sys.platform != "linux":
        return None
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
        free = float(lines["MemAvailable"].split()[0]) * 1.024e-3
    except (OSError, KeyError, ValueError, IndexError):
        return None
    try:
        limit = float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
        used = float(Path("/sys/fs/cgroup/memory.current").read_text(encoding="ascii"))
        return min(free, (limit - used) * 1e-6)
    except (OSError, ValueError):  # no such group, or no limit: "max"
        return free


def _time(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
