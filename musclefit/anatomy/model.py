"""Tissues and layered anatomies as values; they know kinds and order, not files or motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Points
from musclefit.geometry.meshes import TriMesh


class TissueKind(StrEnum):
    """What a tissue is, outermost first."""

    SKIN = "skin"
    OTHER = "other"
    MUSCLE = "muscle"
    BONE = "bone"


@dataclass(frozen=True, eq=False, slots=True)
class Tissue:
    """One closed surface with a name and a kind."""

    name: str
    kind: TissueKind
    surface: TriMesh

    def with_vertices(self, vertices: Points) -> Tissue:
        """The same tissue at other positions."""
        return replace(self, surface=self.surface.with_vertices(vertices))


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Anatomy:
    """Tissues in one frame, outermost first (skin, other, muscle, bone; by name within a kind).

    Parameters
    ----------
    tissues : tuple of Tissue
    frame : str
        The coordinate frame in words, for example "patient (LPS), mm".

    Raises
    ------
    InputError
        No tissue, two tissues of one name, or more than one skin.
    """

    tissues: tuple[Tissue, ...]
    frame: str

    def __repr__(self) -> str:
        return f"Anatomy({len(self.tissues)} tissues, {sum(len(t.surface.vertices) for t in self.tissues)} vertices)"

    def __post_init__(self) -> None:
        if not self.tissues:
            raise InputError("the anatomy has no tissue; give at least one closed surface")
        doubled = [name for name, count in Counter(t.name for t in self.tissues).items() if count > 1]
        if doubled:
            raise InputError(f"two tissues are named {doubled[0]!r}; tissue names must be unique, rename one file")
        skins = [t.name for t in self.tissues if t.kind is TissueKind.SKIN]
        if len(skins) > 1:
            raise InputError(
                f"{len(skins)} tissues are of kind skin ({', '.join(skins[:4])}); at most one may be: set the others' "
                "kind in [anatomy.kinds]"
            )
        order = list(TissueKind)
        ordered = tuple(sorted(self.tissues, key=lambda t: (order.index(t.kind), t.name)))
        object.__setattr__(self, "tissues", ordered)

    def __iter__(self) -> Iterator[Tissue]:
        return iter(self.tissues)

    def __len__(self) -> int:
        return len(self.tissues)

    def __getitem__(self, name: str) -> Tissue:
        for tissue in self.tissues:
            if tissue.name == name:
                return tissue
        raise InputError(f"no tissue is named {name!r}; there are: {', '.join(t.name for t in self.tissues)}")

    def of_kind(self, kind: TissueKind) -> tuple[Tissue, ...]:
        """The tissues of one kind, in order."""
        return tuple(t for t in self.tissues if t.kind is kind)

    @property
    def skin(self) -> Tissue | None:
        """The skin, or None where the anatomy has none."""
        skins = self.of_kind(TissueKind.SKIN)
        return skins[0] if skins else None

    def vertices(self) -> Points:
        """(N, 3) vertices of all tissues, one after the other in order, mm."""
        return np.concatenate([t.surface.vertices for t in self.tissues])

    def slices(self) -> dict[str, slice]:
        """Where each tissue's vertices stand in ``vertices()``."""
        ends = np.cumsum([len(t.surface.vertices) for t in self.tissues])
        starts = [0, *ends[:-1]]
        return {t.name: slice(int(a), int(b)) for t, a, b in zip(self.tissues, starts, ends, strict=True)}

    def with_vertices(self, vertices: Points) -> Anatomy:
        """The same tissues with the vertices of ``vertices()`` moved."""
        where = self.slices()
        return replace(self, tissues=tuple(t.with_vertices(vertices[where[t.name]]) for t in self.tissues))
