"""A rig file to start from, written for surfaces and joints that are there."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from musclefit.errors import InputError
from musclefit.io.atomic import write_atomically
from musclefit.io.formats.tables import parse_table, toml_string
from musclefit.rig.joints import parse_joints

TEMPLATE = """title = {title}
[anatomy]
folder = {folder}           # one closed surface per tissue: PLY, STL, OBJ, VTP
units = "mm"
[drive]
kind = "joints"
joints = {joints}
pose = {{ {pose} }}         # degrees; how far each can turn: musclefit joint-range {file}
"""


def init(rig: str | Path, *, anatomy: str | Path | None = None, joints: str | Path | None = None) -> str:
    """Write a rig of ten lines to start from; gives what to do next, in words.

    Parameters
    ----------
    rig : path
        The file to write.
    anatomy : path, optional
        Folder of surfaces.
    joints : path, optional
        Table of joints; the first is posed at 10 degrees, the others at 0.

    Returns
    -------
    str
        What to do next, in words.

    Raises
    ------
    InputError, RigError
        The file is there already, does not end in .toml, or folder or table are not there or cannot be used.
    """
    path = Path(rig)
    if path.suffix != ".toml":
        raise InputError(f"{path}: a rig is a TOML file; name one that ends in .toml")
    if path.exists():
        raise InputError(f"{path} is there already, and is kept; name another file")
    if anatomy is not None and not Path(anatomy).is_dir():
        raise InputError(f"{anatomy} is not a folder; name the one that holds the surfaces")
    names: Sequence[str] = ("knee",)
    if joints is not None:
        try:
            data = Path(joints).read_bytes()
        except OSError as error:
            raise InputError(f"{joints} cannot be read: {error.strerror or error}") from None
        names = parse_joints(parse_table(data, source=str(joints)), source=str(joints)).coordinates
    text = TEMPLATE.format(
        title=toml_string(path.stem.replace("_", " ").capitalize()),
        folder=_from(path, anatomy, otherwise="anatomy"),
        joints=_from(path, joints, otherwise="joints.json"),
        pose=", ".join(f"{_key(f'{name}_deg')} = {0 if k else 10}" for k, name in enumerate(names)),
        file=path.name,
    )
    write_atomically(path, text)
    missing = [what for what, given in (("surfaces", anatomy), ("joints", joints)) if given is None]
    name_them = f"name your {' and '.join(missing)} in it, " if missing else ""
    return f"{name_them}set the pose, then musclefit run {path}"


def _key(name: str) -> str:
    """A key as TOML writes it."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_string(name)


def _from(rig: Path, target: str | Path | None, *, otherwise: str) -> str:
    """A path as the rig writes it, relative to its folder where that is possible."""
    if target is None:
        return toml_string(otherwise)
    try:
        shown = Path(os.path.relpath(Path(target).absolute(), rig.absolute().parent)).as_posix()
    except ValueError:  # another drive
        shown = Path(target).absolute().as_posix()
    return toml_string(shown)
