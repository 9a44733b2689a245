"""Triangles of a page's surfaces in few bytes: the order of triangles, and which of them other surfaces have, too.

Triangles are turned so that their smallest vertex comes first, put in the order of that, and, around the same smallest
vertex, so that each begins where the one before ends. Then their first corners rise slowly, and most second corners are
known. A surface that was refined shares most of its triangles with the given one: those are told by which they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from musclefit.geometry.arrays import Bool, Int

Faces = tuple[Int, ...]
"""The triangles of each tissue, with the tissue's own numbers of vertices."""

LEAST_SHARED = 0.5
"""Share of a surface's triangles that another must have for them to be told by it."""


@dataclass(frozen=True, eq=False, slots=True)
class CodedFaces:
    """Triangles as a page holds them.

    Parameters
    ----------
    base : int or None
        Number of the surfaces, coded before, that share triangles; None where none do.
    runs : (n,) int
        How many triangles of the base, in its order, are kept, dropped, kept and so on; empty without a base.
    triangles, kept : tuple of int
        Of each tissue: how many there are, and how many of them are the base's, which come first.
    first : (m,) int
        The first corner of each other triangle.
    others : (m, 2) int
        Its second corner, less the last of the triangle before where both begin at the same vertex, else less its first
        corner; and its third less its first.
    order : tuple of (k, 3) int
        The triangles of each tissue in the order in which they are read.
    """

    base: int | None
    runs: Int
    triangles: tuple[int, ...]
    kept: tuple[int, ...]
    first: Int
    others: Int
    order: Faces


def coded(faces: Faces, known: Sequence[CodedFaces]) -> CodedFaces:
    """Code the triangles of surfaces.

    Parameters
    ----------
    faces : tuple of (k, 3) int
        Of each tissue.
    known : sequence of CodedFaces
        Surfaces of the same tissues that were coded before.
    """
    turned = [_turned(np.asarray(own, dtype=np.int64).reshape(-1, 3)) for own in faces]
    count = sum(len(own) for own in turned)
    shared = [sum(int(_found(theirs, own).sum()) for theirs, own in zip(k.order, turned, strict=True)) for k in known]
    base = max(range(len(known)), key=shared.__getitem__, default=None)
    if base is not None and shared[base] < LEAST_SHARED * count:
        base = None
    if base is None:
        kept: list[Int] = [np.zeros((0, 3), dtype=np.int64) for _ in turned]
        runs = np.zeros(0, dtype=np.int64)
    else:
        masks = [_found(theirs, own) for theirs, own in zip(known[base].order, turned, strict=True)]
        kept = [theirs[mask] for theirs, mask in zip(known[base].order, masks, strict=True)]
        runs = _runs(np.concatenate([np.zeros(0, dtype=bool), *masks]))
    rest = [_in_chains(own[~_found(own, had)]) for own, had in zip(turned, kept, strict=True)]
    if sum(map(len, kept)) + sum(map(len, rest)) != count:
        return coded(faces, ())  # triangles that stand there twice
    joined = np.concatenate([np.zeros((0, 3), dtype=np.int64), *rest])
    before = np.zeros(len(joined), dtype=np.int64)
    if len(joined):
        same = np.concatenate([[False], joined[1:, 0] == joined[:-1, 0]])
        before = np.where(same, np.concatenate([[0], joined[:-1, 2]]), joined[:, 0])
    return CodedFaces(
        base=base,
        runs=runs,
        triangles=tuple(len(own) for own in turned),
        kept=tuple(len(had) for had in kept),
        first=joined[:, 0],
        others=np.stack([joined[:, 1] - before, joined[:, 2] - joined[:, 0]], axis=1),
        order=tuple(np.concatenate(both) for both in zip(kept, rest, strict=True)),
    )


def _turned(faces: Int) -> Int:
    """The same triangles, the smallest vertex of each first."""
    rows, at = np.arange(len(faces)), faces.argmin(axis=1)
    return np.stack([faces[rows, (at + k) % 3] for k in range(3)], axis=1)


def _keys(faces: Int, width: int) -> Int:
    return (faces[:, 0] * width + faces[:, 1]) * width + faces[:, 2]


def _found(faces: Int, among: Int) -> Bool:
    """Which turned triangles are among others."""
    width = 1 + max(int(faces.max(initial=0)), int(among.max(initial=0)))
    return np.isin(_keys(faces, width), _keys(among, width))


def _runs(mask: Bool) -> Int:
    """Lengths of runs, of what is kept first."""
    ends = np.flatnonzero(np.diff(mask.astype(np.int8))) + 1
    lengths = np.diff(np.concatenate([[0], ends, [len(mask)]]))
    return np.concatenate([[0], lengths]) if len(mask) and not mask[0] else lengths


def _in_chains(faces: Int) -> Int:
    """Turned triangles by their first vertex; around it, each begins where the one before ends, as far as they do."""
    faces = faces[np.lexsort((faces[:, 1], faces[:, 0]))]
    count = len(faces)
    if not count:
        return faces
    width = 1 + int(faces.max())
    begins, ends = faces[:, 0] * width + faces[:, 1], faces[:, 0] * width + faces[:, 2]
    at = np.minimum(np.searchsorted(begins, ends), count - 1)
    follower = np.where(begins[at] == ends, at, -1)
    led = np.zeros(count, dtype=bool)
    led[follower[follower >= 0]] = True
    rank, chain = np.full(count, -1), np.zeros(count, dtype=np.int64)
    heads = np.flatnonzero(~led)
    while True:
        here, leaders, place = heads, heads, 0
        while len(here):
            rank[here], chain[here] = place, leaders
            after = follower[here]
            free = (after >= 0) & (rank[np.maximum(after, 0)] < 0)
            here, once = np.unique(after[free], return_index=True)
            leaders, place = leaders[free][once], place + 1
        left = np.flatnonzero(rank < 0)  # closed around their first vertex
        if not len(left):
            return faces[np.lexsort((rank, chain, faces[:, 0]))]
        heads = left[np.unique(faces[left, 0], return_index=True)[1]]
