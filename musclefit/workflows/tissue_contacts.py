"""Where tissues of a solver's model hold on to each other, and where they slide: takes labelled tets, gives face pairs.

A muscle is tied to bone where it holds on to it: by the faces of its tetrahedra that lie on the areas which
`musclefit.muscles.attachments` found. Without filler, each tissue has nodes of its own, and tissues slide where their
faces look at each other: the nearest place of the other is within a distance, in front, and looks back. What is neither
muscle nor bone is tied to the bones that it faces. A tissue that comes to hang on no bone this way is tied to the one
that hangs and that it faces most, and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from musclefit.errors import InputError
from musclefit.geometry.arrays import Bool, Faces, Float, Int, Points
from musclefit.geometry.measures import area_vectors
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.distances import DistanceTree
from musclefit.geometry.tets.topology import tet_faces
from musclefit.io.formats.febio_contacts import ContactPair
from musclefit.io.formats.fibre_directions import MuscleFibres
from musclefit.io.formats.solvers import LabelledTets

HALF = 0.5
"""A face belongs to an attachment that covers so much of its area, or the most of all faces."""

HANGS = "hangs on no bone"

COINCIDENT_MM = 1e-6
"""Of places closer than this it cannot be told which is in front."""


class _Skin:
    """The boundary of one part: its faces by node numbers, and distances from it."""

    def __init__(self, tets: LabelledTets, own: Int) -> None:
        self.faces: Faces = tet_faces(tets.tets[own]).boundary
        used, corners = np.unique(self.faces, return_inverse=True)
        self.surface = TriMesh(tets.vertices[used], corners.reshape(-1, 3))
        vectors = area_vectors(self.surface)
        self.areas: Float = np.linalg.norm(vectors, axis=1)
        self.normals: Points = vectors / np.maximum(self.areas, 1e-300)[:, None]
        self.middles: Points = self.surface.corners().mean(axis=1)
        self.tree = DistanceTree(self.surface)
        self.low, self.high = self.surface.vertices.min(axis=0), self.surface.vertices.max(axis=0)

    def facing(self, other: _Skin, *, within_mm: float) -> tuple[Int, float]:
        """Numbers of the faces that look at another part, and how far they are from it at most."""
        near = ((self.middles >= other.low - within_mm) & (self.middles <= other.high + within_mm)).all(axis=1)
        faces = np.flatnonzero(near)
        if not len(faces):
            return faces, 0.0
        at = other.tree.places(self.middles[faces])
        ahead = np.einsum("fi,fi->f", at.places - self.middles[faces], self.normals[faces])
        back = np.einsum("fi,fi->f", other.normals[at.faces], self.normals[faces])
        kept = (at.distances <= within_mm) & (back < 0.0) & ((ahead > 0.0) | (at.distances < COINCIDENT_MM))
        return faces[kept], float(at.distances[kept].max(initial=0.0))


class Contacts:
    """The parts of a model and what they may have to do with each other.

    Parameters
    ----------
    tets : LabelledTets
    bones : mapping of label to number
        The rigid body of each part that is bone.
    muscles : mapping of label to MuscleFibres
    bone_names : mapping of name to label
        Of the bones, as attachments name them.
    """

    def __init__(
        self,
        tets: LabelledTets,
        *,
        bones: Mapping[str, int],
        muscles: Mapping[str, MuscleFibres],
        bone_names: Mapping[str, str],
    ) -> None:
        self._bones, self._muscles, self._bone_names = bones, muscles, bone_names
        self._skins = {label: _Skin(tets, own) for label, own in tets.sets.items()}

    @property
    def edge_mm(self) -> float:
        """The mean edge of the parts' faces."""
        lengths = [
            np.linalg.norm(np.diff(skin.surface.corners()[:, [0, 1, 2, 0]], axis=1), axis=2).ravel()
            for skin in self._skins.values()
        ]
        return float(np.concatenate(lengths).mean())

    def attachments(self) -> tuple[ContactPair, ...]:
        """Muscles tied to the bones that they hold on to, without the faces that are the bone's, too.

        Raises
        ------
        InputError
            A muscle holds on to what is no bone of the model.
        """
        found = []
        for label, muscle in self._muscles.items():
            skin = self._skins[label]
            by_bone: dict[str, list[tuple[Int, Float]]] = {}
            for area in muscle.held:
                names = [self._label(label, name) for name in area.bone.split(" + ")]
                chosen = _covered(skin, area.surface)
                gaps = np.stack([self._skins[name].tree(skin.middles[chosen]) for name in names])
                for number, name in enumerate(names):
                    own = gaps.argmin(axis=0) == number
                    by_bone.setdefault(name, []).append((chosen[own], gaps[number][own]))
            for name, parts in by_bone.items():
                faces, first = np.unique(np.concatenate([part for part, _ in parts]), return_index=True)
                gaps_mm = np.concatenate([gap for _, gap in parts])[first]
                apart = ~np.isin(skin.faces[faces], np.unique(self._skins[name].faces)).all(axis=1)
                if apart.any():
                    found.append(self._pair(label, name, faces[apart], float(gaps_mm[apart].max()), "attachment"))
        return tuple(found)

    def all_pairs(self, *, within_mm: float) -> tuple[ContactPair, ...]:
        """Attachments, other tissue tied to bone, what would hang on nothing tied, and the rest of what faces sliding.

        Parameters
        ----------
        within_mm : float
            How far apart faces may be that look at each other.

        Raises
        ------
        InputError
            A part neither holds on to another nor faces one, or a muscle holds on to what is no bone of the model.
        """
        tied = {(pair.primary, pair.secondary): pair for pair in self.attachments()}
        seen = self._facing(within_mm)
        for (label, other), (faces, gap) in seen.items():
            if other in self._bones and label not in self._muscles:
                tied[label, other] = self._pair(label, other, faces, gap, "faces bone")
        hanging = {*self._bones}
        while True:
            grown = {label for pair in tied for label in pair if pair[0] in hanging or pair[1] in hanging} - hanging
            hanging |= grown
            left = [label for label in self._skins if label not in hanging]
            if grown or not left:
                if not left:
                    break
                continue
            options = [key for key in seen if key[0] in left and key[1] in hanging]
            if not options:
                raise InputError(
                    f"{left[0]} hangs on nothing: it holds on to no bone and faces no tissue within {within_mm:.3g} mm "
                    "that hangs on one; state a larger distance, or keep the filler"
                )
            label, other = max(options, key=lambda key: float(self._skins[key[0]].areas[seen[key][0]].sum()))
            tied[label, other] = self._pair(label, other, *seen[label, other], f"{label} {HANGS}")
        return (*tied.values(), *self._sliding(seen, tied))

    def _sliding(
        self, seen: Mapping[tuple[str, str], tuple[Int, float]], tied: Mapping[tuple[str, str], ContactPair]
    ) -> list[ContactPair]:
        found = []
        for label, other in combinations(self._skins, 2):
            keys = [key for key in ((label, other), (other, label)) if key in seen]
            if not keys or (label in self._bones and other in self._bones):
                continue
            key = keys[0] if keys[0][0] not in self._bones else keys[-1]
            if key[0] in self._bones:
                continue
            faces, gap = seen[key]
            pair = next((tied[k] for k in (key, key[::-1]) if k in tied), None)
            if pair is not None and pair.reason != "attachment":
                continue
            if pair is not None:
                faces = faces[~_rows_in(self._skins[key[0]].faces[faces], pair.faces)]
            if len(faces):
                found.append(self._pair(*key, faces, gap, ""))
        return found

    def _facing(self, within_mm: float) -> dict[tuple[str, str], tuple[Int, float]]:
        """The faces of each part that look at another, where both look at each other."""
        found = {}
        for one, other in combinations(self._skins, 2):
            if one in self._bones and other in self._bones:
                continue
            a, b = self._skins[one], self._skins[other]
            if (np.maximum(a.low - b.high, b.low - a.high) > within_mm).any():
                continue
            ahead, back = a.facing(b, within_mm=within_mm), b.facing(a, within_mm=within_mm)
            if len(ahead[0]) and len(back[0]):
                if one not in self._bones:
                    found[one, other] = ahead
                if other not in self._bones:
                    found[other, one] = back
        return found

    def _label(self, muscle: str, bone: str) -> str:
        label = self._bone_names.get(bone, "")
        if label not in self._bones:
            raise InputError(
                f"{muscle} holds on to {bone}, which is no bone of the run's tetrahedra; make run and architecture of "
                "the same rig"
            )
        return label

    def _pair(self, label: str, other: str, faces: Int, gap: float, reason: str) -> ContactPair:
        return ContactPair(label, other, self._skins[label].faces[faces], bool(reason), gap, reason)


def with_own_nodes(tets: LabelledTets, *, without: Sequence[str]) -> LabelledTets:
    """The same tetrahedra, of which parts share no node.

    Parameters
    ----------
    tets : LabelledTets
    without : sequence of str
        Names of tissues that are left out.

    Raises
    ------
    InputError
        Nothing is left.
    """
    kept = np.flatnonzero(~np.isin(tets.tissue_of_tet, [k for k, name in enumerate(tets.names) if name in without]))
    if not len(kept):
        raise InputError(f"all tetrahedra are of {', '.join(without)}, which is to be left out")
    size = len(tets.vertices)
    nodes, corners = np.unique(tets.tissue_of_tet[kept, None] * size + tets.tets[kept], return_inverse=True)
    return LabelledTets(
        title=tets.title,
        vertices=tets.vertices[nodes % size],
        tets=corners.reshape(-1, 4),
        tissue_of_tet=tets.tissue_of_tet[kept],
        names=tets.names,
        fibres=None if tets.fibres is None else tets.fibres[kept],
    )


def _covered(skin: _Skin, area: TriMesh) -> Int:
    """Faces of which an area covers half, by the nearest face of each of its triangles; or the one it covers most."""
    at = skin.tree.places(area.corners().mean(axis=1)).faces
    votes = np.bincount(at, np.linalg.norm(area_vectors(area), axis=1), minlength=len(skin.faces))
    chosen: Int = np.flatnonzero(votes >= HALF * np.maximum(skin.areas, 1e-300))
    return chosen if len(chosen) else np.array([int(votes.argmax())])


def _rows_in(rows: Faces, others: Faces) -> Bool:
    known = {tuple(row) for row in others.tolist()}
    return np.array([tuple(row) in known for row in rows.tolist()], dtype=bool)
