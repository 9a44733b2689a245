"""Tetrahedralisations kept on disk by the content they were made from; knows no tet's meaning.

Environment: ``MUSCLEFIT_CACHE`` names the folder; without it the platform's folder for caches is used.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import zipfile
import zlib
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import MeshError
from musclefit.geometry.meshes import TetMesh
from musclefit.io.ftetwild import OPTIMISATION_PASSES, STOP_ENERGY, tetrahedralise
from musclefit.progress import Progress
from musclefit.rig.model import TetSettings

_LAYOUT = "musclefit tets 1"
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, MeshError)


def default_cache_folder() -> Path:
    """The folder of ``MUSCLEFIT_CACHE``, or else ``musclefit`` in the platform's folder for caches."""
    chosen = os.environ.get("MUSCLEFIT_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "musclefit" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "musclefit"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "musclefit"


@dataclass(frozen=True, slots=True)
class TetCache:
    """Tetrahedralisations in a folder, one file each, named by the SHA-256 of what they were made from.

    Parameters
    ----------
    folder : Path
        Made when something is first written.
    """

    folder: Path

    def tetrahedralise(self, anatomy: Anatomy, settings: TetSettings, *, progress: Progress) -> tuple[TetAnatomy, bool]:
        """The tets of an anatomy from the folder, or made and written there.

        Returns
        -------
        TetAnatomy
            With a finding "tet-cache" where an entry was corrupt and so made anew, or could not be written.
        from_cache : bool
        """
        path = self.path_of(anatomy, settings)
        troubles = []
        if path.exists():
            try:
                return _read(path, anatomy), True
            except _UNREADABLE as error:
                reason = f"{type(error).__name__}: {error}"
                troubles.append(f"the cached tets in {path} could not be read ({reason}) and were made anew")
        made = tetrahedralise(
            anatomy,
            edge_length_fraction=settings.edge_length_fraction,
            envelope_fraction=settings.envelope_fraction,
            progress=progress,
        )
        try:
            _write(path, made)
        except OSError as error:
            troubles.append(f"the tets could not be cached in {path} ({error}); set MUSCLEFIT_CACHE to another folder")
        findings = tuple(Finding("tet cache", "tet-cache", trouble) for trouble in troubles)
        return replace(made, findings=(*made.findings, *findings)), False

    def path_of(self, anatomy: Anatomy, settings: TetSettings) -> Path:
        """Where the tets of an anatomy with these settings are kept."""
        return self.folder / f"tets-{content_hash(anatomy, settings)}.npz"


def content_hash(anatomy: Anatomy, settings: TetSettings) -> str:
    """SHA-256 over all that tets depend on: names, kinds, vertices, faces, settings, the tetrahedraliser's version."""
    digest = hashlib.sha256()

    def add(part: bytes) -> None:
        digest.update(len(part).to_bytes(8, "little") + part)

    for text in (
        _LAYOUT,
        version("pytetwild"),
        settings.edge_length_fraction.hex(),
        settings.envelope_fraction.hex(),
        str(OPTIMISATION_PASSES),
        STOP_ENERGY.hex(),
    ):
        add(text.encode())
    for tissue in anatomy:
        add(tissue.name.encode())
        add(str(tissue.kind).encode())
        add(tissue.surface.vertices.astype("<f8").tobytes())
        add(tissue.surface.faces.astype("<i8").tobytes())
    return digest.hexdigest()


def _write(path: Path, tets: TetAnatomy) -> None:
    """Write beside the final name first, so that a reader never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix="tets-", suffix=".tmp", delete=False) as file:
        temporary = Path(file.name)
        try:
            np.savez(
                file,
                layout=np.array(_LAYOUT),
                vertices=tets.mesh.vertices,
                tets=tets.mesh.tets,
                tissue_of_tet=tets.tissue_of_tet,
                dropped=np.array(tets.dropped),
                findings=np.array([[f.subject, f.code, f.message] for f in tets.findings], dtype=str).reshape(-1, 3),
            )
            file.close()
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


def _read(path: Path, anatomy: Anatomy) -> TetAnatomy:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        if str(stored["layout"]) != _LAYOUT:
            raise ValueError(f"layout {str(stored['layout'])!r}, expected {_LAYOUT!r}")
        return TetAnatomy(
            anatomy=anatomy,
            mesh=TetMesh(stored["vertices"], stored["tets"]),
            tissue_of_tet=stored["tissue_of_tet"],
            dropped=int(stored["dropped"]),
            findings=tuple(Finding(str(s), str(c), str(m)) for s, c, m in stored["findings"]),
        )
