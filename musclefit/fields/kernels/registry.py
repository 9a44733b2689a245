"""The kernels by name: those of musclefit, and those that are registered from outside."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from musclefit.errors import FieldError
from musclefit.fields.kernels.model import RadialKernel

_known: dict[str, RadialKernel] = {}

KERNELS: Mapping[str, RadialKernel] = MappingProxyType(_known)
"""Every kernel by name."""


def register(kernel: RadialKernel) -> None:
    """Make a kernel known by its name, for rigs and for Python.

    Parameters
    ----------
    kernel : RadialKernel
        With its formula and derivatives and, for proofs, its enclosure.

    Raises
    ------
    FieldError
        Another kernel has that name.
    """
    if _known.setdefault(kernel.name, kernel) is not kernel:
        raise FieldError(f"a kernel is named {kernel.name!r} already; give this one another name")


def kernel_named(name: str) -> RadialKernel:
    """The kernel of a name.

    Raises
    ------
    FieldError
        There is none.
    """
    if name not in _known:
        raise FieldError(f"no kernel is named {name!r}; there are: {', '.join(_known)}")
    return _known[name]
