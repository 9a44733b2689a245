"""What a radial kernel is made of: its formula, and what sums, fits and proofs need to know of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

from musclefit.errors import FieldError
from musclefit.geometry.arrays import Float

Compiled: TypeAlias = Any
"""A function compiled by `musclefit.compiling.njit`."""


@dataclass(frozen=True, eq=False)
class Enclosure:
    """What a proof needs to know of a kernel; without it, steps of the kernel's fields stay undecided.

    Parameters
    ----------
    table : callable
        Gives (8, k + 1) falling majorants of its derivatives; see `musclefit.fields.enclosures.majorants`.
    terms : compiled (scale, extent, table, block) -> None
        Encloses one source's term over a block of boxes; see `musclefit.fields.enclosures.source_terms`.
    values : compiled (scale, r) -> (f, g, size)
        K(x) w = f w + g (x . w) x, and a bound of the sum of the absolute values of its rounded parts.
    steepest : compiled (slope, r) -> float, or None
        Sup of the length of grad D for a unit weight over distances up to r, from the table's largest N1 of the whole
        gradient; None where that is it.
    extent : float or None
        The distance, in units of the kernel's scale, up to which its table reaches; None for homogeneous kernels,
        whose table is one column of constants.
    second_order : bool
        The terms give second derivatives too.
    """

    table: Callable[[], Float]
    terms: Compiled
    values: Compiled
    steepest: Compiled = None
    extent: float | None = None
    second_order: bool = False

    @cached_property
    def majorants(self) -> Float:
        """The table, made once."""
        return self.table()


@dataclass(frozen=True, eq=False)
class Lanes:
    """Sums of a kernel that needs nothing but r and 1/r, with points side by side in vector instructions.

    Parameters
    ----------
    values, gradients : compiled (soft, sources, block) -> None
        See `musclefit.fields.evaluation.lane_sums`.
    """

    values: Compiled
    gradients: Compiled


@dataclass(frozen=True, eq=False)
class RadialKernel:
    """A kernel of a radial sum.

    Parameters
    ----------
    name : str
        As rigs and `RadialBackend` call it.
    formula : compiled (scale, r2) -> tuple
        From a squared distance, mm²: phi and phi'/r of a scalar kernel; a, a'/r, b and b'/r of an isochoric one.
        Compiled with ``musclefit.fields.evaluation.radial_sums.INNER``.
    polynomial_degree : int
        Degree of the polynomials it needs beside it to be positive definite: -1 none, 0 constants, 1 affine.
    isochoric : bool
        Its fields have no divergence.
    compact : bool
        Zero beyond r = scale.
    scaled : bool
        The kernel has a length of its own (support, width or mollifier, mm).
    enclosure : Enclosure or None
    lanes : Lanes or None
        Faster sums, where there are any.
    """

    name: str
    formula: Compiled
    polynomial_degree: int = -1
    isochoric: bool = False
    compact: bool = False
    scaled: bool = False
    enclosure: Enclosure | None = None
    lanes: Lanes | None = None

    @property
    def components(self) -> int:
        """1 for a scalar kernel, 3 for an isochoric one."""
        return 3 if self.isochoric else 1

    def proved(self) -> Enclosure:
        """What is proved of it.

        Raises
        ------
        FieldError
            Nothing is.
        """
        if self.enclosure is None:
            raise FieldError(
                f"kernel {self.name!r} comes without bounds of its derivatives, so that nothing can be proved of its "
                "fields; give it an Enclosure, or use another kernel"
            )
        return self.enclosure
