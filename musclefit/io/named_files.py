"""The files a rig names -> where they lie, their bytes and hashes; knows paths and one variable, not what they hold."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from musclefit.errors import InputError, RigError

DATA_VARIABLE = "MUSCLEFIT_DATA"
"""The environment variable that `${MUSCLEFIT_DATA}` in a rig file stands for."""

DATA_DEFAULT = "../../shared/data"
"""Where the data folder is looked for when the variable is not set, from the rig's folder."""

_PLACEHOLDER = "${" + DATA_VARIABLE + "}"


def resolve_data(text: str, *, folder: Path, source: str, key: str) -> Path:
    """The absolute path that a rig file means by ``text``.

    Parameters
    ----------
    text : str
        As written; relative paths start at ``folder``. ``${MUSCLEFIT_DATA}`` at its start stands for the environment
        variable of that name, or ``../../shared/data`` from ``folder``; nothing else is expanded.
    folder : Path
        The rig's.
    source, key : str
        The rig file and the dotted key, for messages.

    Raises
    ------
    RigError
        Nothing is there, or the text holds another variable. A last part with one of ``*?[`` is taken for a pattern,
        and left to who reads it.
    """
    expanded = text
    hint = "correct the path; relative ones start at the rig's folder"
    if text.startswith(_PLACEHOLDER):
        value = os.environ.get(DATA_VARIABLE, "")
        data = Path(value).absolute() if value else folder.absolute() / DATA_DEFAULT
        said = "is set to" if value else "is not set, so the data folder is looked for in"
        if not data.is_dir():
            raise RigError(
                f"{source}: {key}: no data folder: the environment variable {DATA_VARIABLE} {said} "
                f"{os.path.normpath(data)}, which is not a folder; set {DATA_VARIABLE} to the folder of the data"
            )
        hint = f"{DATA_VARIABLE} {said} {os.path.normpath(data)}"
        expanded = str(data) + text.removeprefix(_PLACEHOLDER)
    if "${" in expanded:
        raise RigError(
            f"{source}: {key}: found {text!r}; only {_PLACEHOLDER} at the start of a path is expanded, "
            "write the rest out"
        )
    resolved = Path(os.path.normpath(folder.absolute() / expanded))
    if not is_there(resolved) and not set("*?[") & set(resolved.name):
        raise RigError(f"{source}: {key}: {resolved} does not exist (written as {text!r}; {hint})")
    return resolved


def is_there(path: Path) -> bool:
    """Whether a file or folder exists; none has a name longer than the system takes."""
    try:
        return path.exists()
    except OSError:  # a name longer than the system takes
        return False


@dataclass(slots=True)
class NamedFiles:
    """The files that a rig names: resolves them, reads them, and keeps each one's SHA-256 under its written name.

    Parameters
    ----------
    rig : Path
        The rig file; relative paths start at its folder.
    hashes : dict
        SHA-256 of every file read so far, by its name as the rig writes it.
    written : dict
        How the rig writes each absolute path that was resolved.
    """

    rig: Path
    hashes: dict[str, str] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """The folder that relative paths start at."""
        return self.rig.parent

    def find(self, text: str, *, key: str) -> str:
        """The absolute path of what is written under ``key``."""
        found = str(resolve_data(text, folder=self.folder, source=str(self.rig), key=key))
        self.written[found] = text
        return found

    def read(self, path: Path, *, key: str) -> bytes:
        """The bytes of a file; its hash is kept.

        Raises
        ------
        RigError
            The file cannot be read.
        """
        place = f"{self.rig}: {key}" if key else str(self.rig)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RigError(f"{place}: {path} cannot be read: {error.strerror or error}") from None
        self.keep(path, sha256(data).hexdigest())
        return data

    def keep(self, path: Path, digest: str) -> None:
        """Keep the hash of a file that was read."""
        self.hashes[self.written.get(str(path), path.name)] = digest

    def named(self, key: str, error: InputError) -> InputError:
        """The same error with the rig file and the key in front."""
        return type(error)(f"{self.rig}: {key}: {error}")
