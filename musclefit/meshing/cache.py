"""Tetrahedralisations kept on disk by the content they were made from; knows no tet's meaning.

Environment: ``MUSCLEFIT_CACHE`` names the folder, without it the platform's folder for caches is used;
``MUSCLEFIT_CACHE_MB`` limits its size.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.mesh_fidelity import TissueFit
from musclefit.anatomy.mesh_rules import LayerRules
from musclefit.anatomy.model import Anatomy
from musclefit.anatomy.tetrahedra import TetAnatomy
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TetMesh
from musclefit.meshing.ftetwild import OPTIMISATION_PASSES, STOP_ENERGY, Estimate, estimate, tetrahedralise
from musclefit.progress import Progress
from musclefit.scratch import scratch_folder

DEFAULT_LIMIT_MB = 2000.0
"""Size of the folder when the environment says nothing, MB (10⁶ bytes)."""

CACHE_FINDING = "tet-cache"
"""Code of findings about the cache."""

_LAYOUT = "musclefit tets 4"
_MAKING = ".tets-"
_UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    NotImplementedError,  # of zipfile, at flags that it does not know
    zipfile.BadZipFile,
    zlib.error,
    MeshError,
)


def default_limit_mb() -> float:
    """The number in ``MUSCLEFIT_CACHE_MB``, or else ``DEFAULT_LIMIT_MB``.

    Raises
    ------
    InputError
        It is not a number, or below 0.
    """
    chosen = os.environ.get("MUSCLEFIT_CACHE_MB")
    if not chosen:
        return DEFAULT_LIMIT_MB
    try:
        limit = float(chosen)
    except ValueError:
        limit = math.nan
    if not limit >= 0.0:
        raise InputError(f"MUSCLEFIT_CACHE_MB is {chosen!r}; give a size in MB, 0 to keep nothing")
    return limit


@dataclass(frozen=True, slots=True)
class TetPlan:
    """What making the tets of an anatomy will take.

    Parameters
    ----------
    path : Path
        Where they are kept.
    kept : bool
        Whether something is there already.
    triangles : int
        Of all surfaces.
    estimate : Estimate
        Of making them anew.
    """

    path: Path
    kept: bool
    triangles: int
    estimate: Estimate

    @property
    def in_words(self) -> str:
        """For people, one line."""
        if self.kept:
            return f"tetrahedra: read from {self.path}"
        return (
            f"tetrahedra: {self.triangles} triangles to fill, {self.estimate.in_words} (estimated); "
            f"kept in {self.path.parent} for the next run"
        )


@dataclass(frozen=True, slots=True)
class TetCache:
    """Tetrahedralisations in a folder, one file each, named by the SHA-256 of what they were made from.

    Parameters
    ----------
    folder : Path
        Made when something is first written.
    limit_mb : float
        Entries that were used longest ago are removed until the folder holds no more, MB (10⁶ bytes).
    passes : int
        Of the tetrahedraliser over a mesh.
    """

    folder: Path
    limit_mb: float = DEFAULT_LIMIT_MB
    passes: int = OPTIMISATION_PASSES

    def plan(self, anatomy: Anatomy, rules: LayerRules) -> TetPlan:
        """What `tetrahedralise` will take."""
        path = self.path_of(anatomy, rules)
        triangles = sum(len(tissue.surface.faces) for tissue in anatomy)
        return TetPlan(path, path.exists(), triangles, estimate(anatomy, rules))

    def tetrahedralise(self, anatomy: Anatomy, rules: LayerRules, *, progress: Progress) -> tuple[TetAnatomy, bool]:
        """The tets of an anatomy from the folder, or made and written there.

        Returns
        -------
        TetAnatomy
            With a finding "tet-cache" where an entry was corrupt and so made anew, could not be written, or had others
            removed to make room.
        from_cache : bool
        """
        path = self.path_of(anatomy, rules)
        notes = []
        if path.exists():
            try:
                with progress.stage("read tets"):
                    return _read(path, anatomy), True
            except _UNREADABLE as error:
                reason = f"{type(error).__name__}: {error}"
                notes.append(f"the cached tets in {path} could not be read ({reason}) and were made anew")
        made = tetrahedralise(anatomy, rules, passes=self.passes, progress=progress)
        try:
            notes += self._keep(path, made)
        except OSError as error:
            notes.append(f"the tets could not be cached in {path} ({error}); set MUSCLEFIT_CACHE to another folder")
        findings = tuple(Finding("tet cache", CACHE_FINDING, note) for note in notes)
        return replace(made, findings=(*made.findings, *findings)), False

    def path_of(self, anatomy: Anatomy, rules: LayerRules) -> Path:
        """Where the tets of an anatomy by these rules are kept."""
        return self.folder / f"tets-{content_hash(anatomy, rules, passes=self.passes)}.npz"

    def _keep(self, path: Path, tets: TetAnatomy) -> list[str]:
        """Write an entry and remove the oldest others until the limit holds; what was done beside writing, in words."""
        _write(path, tets)
        size = path.stat().st_size
        if size > 1e6 * self.limit_mb:
            path.unlink()
            return [
                f"the tets take {size / 1e6:.0f} MB, more than the cache may hold ({self.limit_mb:g} MB), and were not "
                "kept; set MUSCLEFIT_CACHE_MB"
            ]
        removed = []
        room = 1e6 * self.limit_mb - size
        for other, stored in self._entries_latest_first(besides=path):
            room -= stored
            if room < 0.0:
                with suppress(FileNotFoundError):  # another process was faster
                    other.unlink()
                    removed.append(f"{other.name} ({stored / 1e6:.1f} MB)")
        if not removed:
            return []
        return [
            f"{len(removed)} former entries of {self.folder} were removed to keep it below {self.limit_mb:g} MB "
            f"(MUSCLEFIT_CACHE_MB): {', '.join(removed)}"
        ]

    def _entries_latest_first(self, *, besides: Path) -> Iterator[tuple[Path, int]]:
        """Entries and their sizes by last use."""
        found = []
        for file in self.folder.glob("tets-*.npz"):
            with suppress(FileNotFoundError):
                stat = file.stat()
                if file != besides:
                    found.append((stat.st_mtime, stat.st_size, file))
        for _, size, file in sorted(found, reverse=True):
            yield file, size


def content_hash(anatomy: Anatomy, rules: LayerRules, *, passes: int = OPTIMISATION_PASSES) -> str:
    """SHA-256 over all that tets depend on: tissues, rules, the tetrahedraliser's passes and version."""
    digest = hashlib.sha256()

    def add(part: bytes) -> None:
        digest.update(len(part).to_bytes(8, "little") + part)

    for text in (_LAYOUT, version("pytetwild"), str(passes), STOP_ENERGY.hex()):
        add(text.encode())
    add(json.dumps(asdict(rules), sort_keys=True).encode())
    for tissue in anatomy:
        add(tissue.name.encode())
        add(str(tissue.kind).encode())
        add(tissue.surface.vertices.astype("<f8").tobytes())
        add(tissue.surface.faces.astype("<i8").tobytes())
    return digest.hexdigest()


def _write(path: Path, tets: TetAnatomy) -> None:
    """Write in a folder beside first, so that a reader never sees half a file."""
    with scratch_folder(_MAKING, inside=path.parent) as folder, (folder / path.name).open("wb") as file:
        np.savez(
            file,
            layout=np.array(_LAYOUT),
            made_from=np.array(path.stem),
            vertices=tets.mesh.vertices,
            tets=tets.mesh.tets.astype(np.int32 if len(tets.mesh.vertices) < 2**31 else np.int64),
            tissue_of_tet=tets.tissue_of_tet.astype(np.int32),
            dropped=np.array(tets.dropped),
            turned=np.array(tets.turned),
            findings=np.array([[f.subject, f.code, f.message] for f in tets.findings], dtype=str).reshape(-1, 3),
            fits=np.array(json.dumps([asdict(fit) for fit in tets.fits])),
        )
        file.flush()
        os.fsync(file.fileno())
        file.close()
        (folder / path.name).replace(path)


def _read(path: Path, anatomy: Anatomy) -> TetAnatomy:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        if str(stored["layout"]) != _LAYOUT:
            raise ValueError(f"layout {str(stored['layout'])!r}, expected {_LAYOUT!r}")
        if str(stored["made_from"]) != path.stem:
            raise ValueError(f"made from other content, {str(stored['made_from'])!r}")
        tets = TetAnatomy(
            anatomy=anatomy,
            mesh=TetMesh(stored["vertices"], stored["tets"]),
            tissue_of_tet=stored["tissue_of_tet"],
            dropped=int(stored["dropped"]),
            findings=tuple(Finding(str(s), str(c), str(m)) for s, c, m in stored["findings"]),
            fits=tuple(TissueFit(**fit) for fit in json.loads(str(stored["fits"]))),
            turned=int(stored["turned"]),
        )
    with suppress(OSError):  # a folder that may only be read serves as well
        os.utime(path)
    return tets
