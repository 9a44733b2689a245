"""Which rig file a user means: by path, or by the name of a rig that comes with musclefit; reads none."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from musclefit.errors import RigError
from musclefit.rig.table_reader import suggestion

RigGiven: TypeAlias = str | Path | Mapping[str, Any]
"""A rig: the name of a built-in one, the path of a file, or what a file would hold."""


def builtin_rigs() -> tuple[str, ...]:
    """The names of the rigs that come with musclefit, sorted."""
    return tuple(sorted(path.stem for path in rigs_folder().glob("*.toml")))


def builtin_rig_path(name: str) -> Path:
    """The file of a rig that comes with musclefit.

    Raises
    ------
    RigError
        No rig of that name; the message lists those that exist.
    """
    if name not in builtin_rigs():
        raise RigError(f"no rig is named {name!r}; {suggestion(name, builtin_rigs())}")
    return rigs_folder() / f"{name}.toml"


def rigs_folder() -> Path:
    """The folder of the built-in rigs: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    packed = package / "rigs"
    return packed if packed.is_dir() else package.parent / "rigs"


def find_rig(name_or_path: str | Path) -> Path:
    """The rig file that a user means: a path (with a folder or the suffix .toml), or the name of a built-in rig.

    Parameters
    ----------
    name_or_path : str or path

    Returns
    -------
    Path

    Raises
    ------
    RigError
        No such file, or no such name; the message lists the rigs that exist.
    """
    path = Path(name_or_path)
    if isinstance(name_or_path, str) and path.suffix != ".toml" and path.name == name_or_path:
        return builtin_rig_path(name_or_path)
    if not path.is_file():
        built_in = ", ".join(builtin_rigs())
        problem = "is a folder; name the rig file in it" if path.is_dir() else "no such rig file; give a path"
        raise RigError(f"{path}: {problem}, or the name of a built-in rig: {built_in}")
    return path
