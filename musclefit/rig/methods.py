"""Methods by name in a rig table: what a name stands for, which one is the default, and what `--set` does to them.

It takes tables and gives tables; whether their values are right is for `musclefit.rig.rig_table` to say.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

from musclefit.errors import RigError
from musclefit.rig.settings import METHOD_SETTINGS, require_method
from musclefit.vocabulary import BackendKind, Method, PathKind, StepKind

METHOD = "deformer.method"

STANDS_FOR: Mapping[Method, Mapping[str, object]] = MappingProxyType(
    {
        Method.OWN: MappingProxyType({}),
        Method.YU2014: MappingProxyType(
            {
                "deformer.backend": BackendKind.RBF.value,
                "deformer.kernel": "r2logr",
                "deformer.step": StepKind.EXPLICIT.value,
                "deformer.path": PathKind.STRAIGHT.value,
                "bones.rigid": False,
            }
        ),
        Method.RIGID_BONES: MappingProxyType(
            {
                "deformer.kernel": "isochoric-r3",
                "deformer.step": StepKind.CAYLEY.value,
                "deformer.path": PathKind.JOINTS.value,
                "deformer.degrees_per_step": 12.0,
                "deformer.margin_floor": 0.25,
                "bones.rigid": True,
                "bones.lock": True,
                "surfaces.refine": True,
            }
        ),
    }
)
"""What a name fills in where the rig says nothing."""

IDLE: Mapping[Method, tuple[str, ...]] = MappingProxyType(
    {
        Method.OWN: (),
        Method.YU2014: (
            "bones.lock",
            "deformer.margin_floor",
            "deformer.lattice_spacing_mm",
            "deformer.lattice_levels",
        ),
        Method.RIGID_BONES: ("deformer.step_rule", "deformer.lattice_spacing_mm", "deformer.lattice_levels"),
    }
)
"""Keys that a method has no use for."""

CHOOSING = (
    "deformer.kernel",
    "deformer.step",
    "deformer.path",
    "bones.rigid",
    "bones.keep_rigid",
    "bones.keep_similar",
)
"""A rig that names no method and gives one of these says itself how it deforms."""


def method_of(table: Mapping[str, Any]) -> Method:
    """The method of a rig table, named or by default.

    Rigid bones are the default where joints or transforms drive and none of ``CHOOSING`` is given, and where
    ``bones.rigid = true`` is all of them that is given. A table that is not well-formed has none.
    """
    named = _get(table, METHOD)
    if named is not None:
        return Method(named) if isinstance(named, str) and named in list(Method) else Method.OWN
    given = {key: _get(table, key) for key in CHOOSING}
    rigid = given.pop("bones.rigid")
    if any(value is not None for value in given.values()):
        return Method.OWN
    driven_by_bones = _get(table, "drive.kind") in ("joints", "transforms")
    return Method.RIGID_BONES if rigid is True or (rigid is None and driven_by_bones) else Method.OWN


def with_method(table: Mapping[str, Any], *, source: str) -> dict[str, Any]:
    """A rig table with what its method stands for filled in.

    Raises
    ------
    RigError
        A setting that the method excludes; the message names both keys.
    """
    method = method_of(table)
    try:
        require_method(method, _given(table, METHOD_SETTINGS[method]))
    except RigError as error:
        why = "" if _get(table, METHOD) is not None else f" (nothing names another method than {method}, the default)"
        raise RigError(f"{source}: {error}{why}") from None
    filled = copy.deepcopy(dict(table))
    if method is not Method.OWN:
        _set(filled, METHOD, method.value)
    _fill(filled, method)
    return filled


def settle(before: Mapping[str, Any], after: dict[str, Any], given: Collection[str]) -> None:
    """Let values that were set one by one win over a rig's method, and a method that was set over the rig's values.

    A method that is set takes the place of all that the rig says of what it decides. A single value leaves the rig's
    method as it is, or, where that excludes the value, all else that the method stands for.

    Parameters
    ----------
    before : mapping
        The rig table.
    after : dict
        The same with single values replaced; changed in place.
    given : collection of str
        The dotted keys that were replaced.
    """
    if METHOD in given:
        method = method_of(after)
        for key in _decided(method).union(IDLE[method]):
            if key not in given:
                _drop(after, key)
        if method is Method.OWN:
            _fill(after, method_of(before))
        return
    method = method_of(before)
    if method is Method.OWN and any(_get(before, key) is not None for key in CHOOSING):
        _set(after, METHOD, Method.OWN.value)  # whatever of these is left when another backend is set
    if not _decided(method) & set(given):
        return
    _set(after, METHOD, method.value)
    try:
        require_method(method, _given(after, given))
    except RigError:
        _set(after, METHOD, Method.OWN.value)
        _fill(after, method)


def _decided(method: Method) -> set[str]:
    """The keys that a method says something of."""
    return {*METHOD_SETTINGS[method], *STANDS_FOR[method]}


def _fill(table: dict[str, Any], method: Method) -> None:
    for key, value in STANDS_FOR[method].items():
        if _get(table, key) is None and _applies(table, key, method):
            _set(table, key, value)


def _applies(table: Mapping[str, Any], key: str, method: Method) -> bool:
    """A kernel is for radial sums; rigid bones go along joints where there are any, else as their drive has it."""
    if key == "deformer.kernel":
        return _get(table, "deformer.backend") in (None, BackendKind.RBF.value)
    if key == "deformer.path" and method is Method.RIGID_BONES:
        return bool(_get(table, "drive.kind") == "joints")
    if key in ("bones.lock", "deformer.degrees_per_step"):
        return _get(table, "bones.rigid") is not False
    return True


def _given(table: Mapping[str, Any], keys: Collection[str]) -> dict[str, object]:
    """Those of some settings that a table gives and that may be such settings at all."""
    found = {key: _get(table, key) for key in keys}
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in found.items()}
    return {key: value for key, value in values.items() if isinstance(value, bool | int | float | str | tuple)}


def _get(table: Mapping[str, Any], dotted: str) -> Any:
    section, _, key = dotted.partition(".")
    inner = table.get(section)
    return inner.get(key) if isinstance(inner, Mapping) else None


def _set(table: dict[str, Any], dotted: str, value: object) -> None:
    section, _, key = dotted.partition(".")
    inner = table.setdefault(section, {})
    if isinstance(inner, dict):
        inner[key] = value


def _drop(table: dict[str, Any], dotted: str) -> None:
    section, _, key = dotted.partition(".")
    inner = table.get(section)
    if isinstance(inner, dict):
        inner.pop(key, None)
