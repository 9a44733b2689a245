"""Vectors of WIDTH numbers as a type of compiled loops: arithmetic and roots; knows no kernel.

Left to itself the compiler puts the sources of one point side by side and adds them up for each point anew. With points
side by side there is nothing to add up, and one rough reciprocal root gives both r and 1/r without square root or
division.
"""

from __future__ import annotations

import operator

from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from musclefit.compiling import njit

FAST = ("reassoc", "contract", "arcp", "nsz")
"""LLVM flags: reorder sums; NaN and infinity keep their meaning."""

INNER = {"fastmath": set(FAST), "error_model": "numpy", "forceinline": True}


def _features() -> str:
    """Instructions that code is made for."""
    if config.CPU_NAME is None and config.CPU_FEATURES is None:
        host: str = binding.get_host_cpu_features().flatten()
        return host
    return str(config.CPU_FEATURES or "")


ROUGH_ROOTS = "+avx512f" in _features()
"""The machine has reciprocal square roots to 14 bits."""

WIDTH = 8 if ROUGH_ROOTS else 4
"""Numbers of one vector."""

_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_INDEX = ir.IntType(32)


class _LanesType(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(name=f"Lanes{WIDTH}")


LANES = _LanesType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _VECTOR)


def _spread(builder, number):
    """A number in every lane."""
    unknown = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(unknown, number, _INDEX(0))
    return builder.shuffle_vector(first, unknown, ir.Constant(ir.VectorType(_INDEX, WIDTH), [0] * WIDTH))


def _arithmetic(operation, instruction: str) -> None:
    """Let an operation take two vectors, or a vector and a number."""

    @type_callable(operation)
    def typing(_context):
        def typer(a, b):
            return LANES if LANES in (a, b) and {a, b} <= {LANES, types.float64} else None

        return typer

    def lower(_context, builder, signature, arguments):
        pairs = zip(arguments, signature.args, strict=True)
        vectors = [given if kind == LANES else _spread(builder, given) for given, kind in pairs]
        return getattr(builder, instruction)(*vectors, flags=FAST)

    for kinds in ((LANES, LANES), (LANES, types.float64), (types.float64, LANES)):
        lower_builtin(operation, *kinds)(lower)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")
_arithmetic(operator.truediv, "fdiv")


def _from(context, builder, kind, array, first):
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [first]), _VECTOR.as_pointer())


@intrinsic
def load_from(_context, array, first):  # noqa: ARG001 (names of the compiled arguments)
    """WIDTH numbers of an array in memory order, from a number on."""

    def generate(context, builder, signature, arguments):
        found = builder.load(_from(context, builder, signature.args[0], *arguments))
        found.align = 8
        return found

    return LANES(array, types.intp), generate


@intrinsic
def store_from(_context, array, first, value):  # noqa: ARG001
    """Write WIDTH numbers of an array in memory order, from a number on."""

    def generate(context, builder, signature, arguments):
        written = builder.store(arguments[2], _from(context, builder, signature.args[0], *arguments[:2]))
        written.align = 8
        return context.get_dummy_value()

    return types.void(array, types.intp, LANES), generate


@njit(**INNER)
def load(array, row):
    """Row of a (k, WIDTH) array in memory order."""
    return load_from(array, row * WIDTH)


@njit(**INNER)
def store(array, row, value):
    """Write a row of a (k, WIDTH) array in memory order."""
    store_from(array, row * WIDTH, value)


@intrinsic
def zero(_context):
    """0 in every lane."""

    def generate(_context, _builder, _signature, _arguments):
        return ir.Constant(_VECTOR, [0.0] * WIDTH)

    return LANES(), generate


@intrinsic
def root(_context, x):  # noqa: ARG001
    """Square root of each."""

    def generate(_context, builder, _signature, arguments):
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{WIDTH}f64")
        return builder.call(function, arguments)

    return LANES(LANES), generate


@intrinsic
def _rough_inverse_root(_context, x):  # noqa: ARG001
    """1 / sqrt(x) to 6.2e-5 of itself."""

    def generate(_context, builder, _signature, arguments):
        mask = ir.IntType(8)
        kind = ir.FunctionType(_VECTOR, [_VECTOR, _VECTOR, mask])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.rsqrt14.pd.512")
        return builder.call(function, [*arguments, ir.Constant(_VECTOR, ir.Undefined), mask(255)])

    return LANES(LANES), generate


SHARE = -3.2 if ROUGH_ROOTS else 1.0
"""`shared_inverse_root` is this times the reciprocal square root."""

# (35 - 35 z + 21 z² - 5 z³) / 16 = (ROOT - z) (z (z + SLOPE) + OFFSET) 5 / 16
_ROOT, _SLOPE, _OFFSET = 2.525847987286030548, -1.674152012713969452, 2.771346508275563235


@njit(**INNER)
def shared_inverse_root(x):
    """SHARE / sqrt(x), x > 0, to a few units in the last place: the factor is left to the caller, once for a sum.

    A rough y makes z = x y² = 1 + e, |e| < 1.3e-4; the series of (1 + e)^(-1/2) is cut behind e³, 6e-17 of it away.
    """
    if ROUGH_ROOTS:
        y = _rough_inverse_root(x)
        z = x * (y * y)
        return (y * (z - _ROOT)) * (z * (z + _SLOPE) + _OFFSET)
    return 1.0 / root(x)


@njit(**INNER)
def shared_root(x):
    """SHARE sqrt(x), x > 0."""
    if ROUGH_ROOTS:
        return x * shared_inverse_root(x)
    return root(x)
