"""Anatomies that are generated, not read: for first steps, tests and tutorials."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from musclefit.anatomy.builtin.upper_limb import upper_limb
from musclefit.anatomy.model import Anatomy

BUILTIN: Mapping[str, Callable[[], Anatomy]] = MappingProxyType({"upper_limb": upper_limb})
"""Generators of the built-in anatomies, by name."""

__all__ = ["BUILTIN", "upper_limb"]
