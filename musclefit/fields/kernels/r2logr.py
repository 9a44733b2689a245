"""phi = r² log r: the thin-plate spline of the plane, and the paper's own kernel in space (Eq. 1)."""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from musclefit.compiling import njit
from musclefit.fields.enclosures.majorants import constants
from musclefit.fields.enclosures.source_terms import (
    FIRST,
    JUMP,
    LANES,
    PROOF,
    R2,
    SECOND,
    SMALL,
    STRAIN,
    THIRD,
    B,
    C,
    F,
    G,
    H,
    T,
)
from musclefit.fields.evaluation.radial_sums import INNER, TINY
from musclefit.fields.kernels.model import Enclosure, RadialKernel

NEAR = 0.7
"""h / r above which a source counts as near."""


@intrinsic
def _bits(_context, value):
    """The 64 bits of a number: float64 as int64, int64 as float64."""
    floats = value == types.float64
    made, target = (types.int64, ir.IntType(64)) if floats else (types.float64, ir.DoubleType())

    def generate(_context, builder, _signature, arguments):
        return builder.bitcast(arguments[0], target)

    return made(value), generate


@njit(**{**INNER, "fastmath": {"contract"}})  # reassociating the conversion of k would lose all digits
def _log(x):
    """Natural logarithm of a positive normal number to 3e-16 of max(1, |log x|), in vector instructions.

    x = 2^k y with y in [sqrt(1/2), sqrt(2)) and log y = 2 artanh(s), s = (y - 1) / (y + 1), by FDLIBM's polynomial.
    """
    bits = _bits(x)
    above = bits - 0x3FE6A09E667F3BCD  # sqrt(1/2)
    y = _bits(bits - (above & -0x10000000000000))
    k = _bits((above >> 52) + 0x4338000000000000) - 6755399441055744.0  # 1.5 * 2^52: an integer in the last bits
    s = (y - 1.0) / (y + 1.0)
    z = s * s
    high = 0.2222219843214978396 + z * (0.1818357216161805012 + z * (0.1531383769920937332 + z * 0.1479819860511658591))
    series = z * (0.6666666666666735130 + z * (0.3999999999940941908 + z * (0.2857142874366239149 + z * high)))
    return k * 0.6931471805599453094 + (2.0 * s + s * series)


@njit(**INNER)
def _formula(scale, r2):
    log = _log(r2 + TINY)
    return 0.5 * r2 * log, log + 1.0


@njit(**PROOF)
def _terms(scale, extent, table, block):
    """Second order, or, with y = r / L <= 1, r (2 log r + 1) = r (2 log L + 0.44) + L y (2 log y + 0.56).

    The last part is at most 0.57 L in size: 0.56 L at y = 1, and -2 L exp(-1.28) where its derivative vanishes.
    d_e⁴ phi = (16 c⁴ - 24 c² + 6) / r² is at most 6 / r²: the remainder 3 h q² (sum of 2 q^k / ((k+2) (k+3))) is at
    most h q² (1 + 2 q).
    """
    for i in range(LANES):
        r2, h = block[R2 + i], block[H + i]
        r = np.sqrt(r2)
        longest = max(r + h, 1e-150)
        block[G + i] = r2 if h < NEAR * r else longest * longest
    for i in range(LANES):
        block[G + i] = np.log(block[G + i])
    for i in range(LANES):
        r2, h, log = block[R2 + i], block[H + i], block[G + i]
        r = np.sqrt(r2)
        longest = max(r + h, 1e-150)
        q, inverse2 = h / r, 1.0 / r2
        far = h < NEAR * r
        by_order, near_remainder = h * q * q * (1.0 + 2.0 * q), 0.57 * longest
        t, c, third = 2.0 * inverse2, -4.0 * inverse2 * inverse2, 10.0 / r
        slope = log + 1.0 if far else log + 0.44
        block[G + i] = slope
        block[F + i] = slope
        block[T + i] = t if far else 0.0
        block[B + i] = t if far else 0.0
        block[C + i] = c if far else 0.0
        block[STRAIN + i] = by_order if far else near_remainder
        block[FIRST + i] = longest * (abs(log) + 4.0)
        block[SECOND + i] = abs(log) + 8.0
        block[THIRD + i] = third if far else 0.0
        block[JUMP + i] = 0.0 if far else near_remainder


@njit(**PROOF)
def _value(scale, r):
    if r < 1e-150:
        return 0.0, 0.0, SMALL
    log = np.log(r)
    return r * r * log, 0.0, r * r * (abs(log) + 1.0)


@njit(**PROOF)
def _steepest(slope, r):
    return r * (2.0 * abs(np.log(max(r, 1e-100))) + 1.0) + 1.0


KERNEL = RadialKernel(
    "r2logr",
    _formula,
    polynomial_degree=1,
    enclosure=Enclosure(
        # N1 and N2 are no powers of r; N3 is the largest |6 c - 4 c³|, N4 the largest |6 - 24 c² + 16 c⁴|.
        table=lambda: constants(0.0, 0.0, 2.0 * np.sqrt(2.0), 6.0),
        terms=_terms,
        values=_value,
        steepest=_steepest,
        second_order=True,
    ),
)
