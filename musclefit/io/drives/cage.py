"""A cage around the skin: the vertices of a mesh and those of the same mesh elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from musclefit.anatomy.findings import Finding
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.io.anatomy import read_surface
from musclefit.io.drives.pairs import Pairs
from musclefit.rig.drive import Drive, Files, found_keyframes, register_drive
from musclefit.rig.job import cage_crossings, cage_handles
from musclefit.rig.keyframes import PlaceKey, require_moments
from musclefit.vocabulary import CageCrossings, PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class CageDrive(Drive):
    """Vertex pairs of two meshes with the same triangles; ``crossings`` says whether they may cross themselves."""

    kind: ClassVar[str] = "cage"
    drives: ClassVar[str] = "a cage drives"

    source: str
    target: str
    units: Unit = Unit.MILLIMETRE
    crossings: CageCrossings = CageCrossings.REFUSE
    keyframes: tuple[PlaceKey, ...] = ()

    def __post_init__(self) -> None:
        require_moments(self.keyframes)

    def resolved(self, files: Files) -> CageDrive:
        """With absolute paths."""
        return replace(
            self,
            source=files.find(self.source, key="drive.source"),
            target=files.find(self.target, key="drive.target"),
            keyframes=found_keyframes(self.keyframes, files),
        )

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> Pairs:  # noqa: ARG002
        """The vertices of both cages, and those of keyframes.

        Raises
        ------
        MeshError
            Triangles of the cages cross, or a cage is an STL file, which has no shared vertices.
        """
        source, findings = self._cage(self.source, files, key="drive.source")
        target, more = self._cage(self.target, files, key="drive.target")
        try:
            handles, arrivals = cage_handles(source, target)
        except MeshError as error:
            raise files.named("drive.target", error) from None
        crossings = [
            found
            for name, cage in ((self.source, source), (self.target, target))
            for found in cage_crossings(cage, name=Path(name).stem)
        ]
        if crossings and self.crossings is CageCrossings.REFUSE:
            raise MeshError(
                f"{files.rig}: drive: {len(crossings)} pairs of triangles of the cages cross (numbers from 0): "
                f"{'; '.join(found.message for found in crossings)}. Correct the cages, or go on all the same with "
                f'drive.crossings = "{CageCrossings.ACCEPT}"'
            )
        keys = []
        for key in self.keyframes:
            cage, found = self._cage(key.file, files, key="drive.keyframes")
            try:
                keys.append((key.at, cage_handles(source, cage)[1]))
            except MeshError as error:
                raise files.named("drive.keyframes", error) from None
            findings = (*findings, *found)
        return Pairs(handles, arrivals, path, (*findings, *more, *crossings), keyframes=tuple(keys))

    def _cage(self, path: str, files: Files, *, key: str) -> tuple[TriMesh, tuple[Finding, ...]]:
        try:
            raw = read_surface(Path(path), units=self.units)
            if raw.path.suffix.lower() == ".stl":
                raise MeshError(f"{path}: in STL every triangle has its own vertices; give the cage as PLY or OBJ")
            files.keep(raw.path, raw.sha256)
            return TriMesh(raw.vertices, raw.faces), raw.findings
        except InputError as error:
            raise files.named(key, error) from None
