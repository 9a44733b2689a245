"""Certificates of meshes against rational arithmetic: ``python tests/mesh_campaign.py --first 0 --cases 10000``.

Case k is made from seed k alone: blocks of a few tets, shaken, sheared, crushed, laid over each other, with tets left
out, corners moved onto or an ulp off the plane of a face, sizes of 1e-3 to 1e5 mm up to 1e6 mm from the origin. Of each
mesh the oracle decides in whole numbers (coordinates as `fractions.Fraction` over one denominator), with nothing of
the library's: the sign of every tet, which tets share volume (separating planes), and whether triangles of the boundary
meet beyond their common corners and edges. Of a random straight motion, the part that is said to keep every tet
right-handed must do so at every time that is tried.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import Counter
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from tet_blocks import block

from musclefit.certify.meshes import certify_mesh
from musclefit.certify.motions import largest_safe_fraction
from musclefit.geometry.meshes import TetMesh
from musclefit.vocabulary import Claim

Vector: TypeAlias = tuple[int, int, int]
Triangle: TypeAlias = tuple[Vector, Vector, Vector]

CELLS = ((1, 1, 1), (2, 1, 1), (2, 1, 1), (2, 2, 1))
TIMES = 8
"""At which a motion is tried within the part that is said to be safe."""


def case(seed: int) -> TetMesh:
    """The mesh of a seed."""
    rng = np.random.default_rng([13, seed])
    mesh = block(CELLS[rng.integers(len(CELLS))])
    kind = int(rng.integers(6))
    vertices, tets = mesh.vertices.copy(), mesh.tets.copy()
    noise = rng.normal(size=vertices.shape) * float(rng.choice([0.05, 0.15, 0.3, 0.6]))
    if kind == 0:  # shaken
        vertices += noise
    elif kind == 1:  # shaken on a coarse grid: flat tets and contacts
        vertices = np.round(4.0 * (vertices + noise)) / 4.0
    elif kind == 2:  # a second one, moved: apart, in contact, across it or inside it
        other = block((1, 1, 1))
        size = float(rng.choice([0.25, 0.5, 1.0]))
        shift = np.round(8.0 * rng.uniform(-1.5, 2.5, 3)) / 8.0
        vertices = np.concatenate([vertices, size * other.vertices + shift])
        tets = np.concatenate([tets, other.tets + mesh.tets.max() + 1])
    elif kind == 3:  # some left out, the others shaken a little
        tets = tets[rng.random(len(tets)) < 0.7]
        vertices += float(rng.choice([0.0, 0.2])) * noise
    elif kind == 4 and len(tets):  # a corner on the plane of its own tet's face, or an ulp off
        a, b, c, d = tets[rng.integers(len(tets))]
        weights = rng.dirichlet(np.ones(3))
        vertices[a] = weights @ vertices[[b, c, d]]
        for _ in range(int(rng.integers(3))):
            vertices[a] = np.nextafter(vertices[a], vertices[a] + rng.normal(size=3))
    else:  # bent round
        angle = float(rng.choice([1.0, 3.0, 6.5])) * vertices[:, 0] / vertices[:, 0].max()
        radius = 0.4 + vertices[:, 1]
        vertices = np.stack([radius * np.sin(angle), -radius * np.cos(angle), vertices[:, 2]], axis=1)[:, [1, 0, 2]]
    size = float(rng.choice([1.0, 10.0 ** rng.uniform(-3.0, 5.0)]))
    shift = rng.uniform(-1.0, 1.0, 3) * float(rng.choice([0.0, 10.0 * size, 1e6]))
    return TetMesh(size * vertices + shift, tets)


def whole(vertices: np.ndarray) -> list[Vector]:
    """Positions as whole numbers, all times the one denominator that makes them so."""
    exact = [[Fraction(float(x)) for x in row] for row in vertices]
    scale = math.lcm(*(x.denominator for row in exact for x in row), 1)
    return [(int(x * scale), int(y * scale), int(z * scale)) for x, y, z in exact]


def minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def dot(a: Vector, b: Vector) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def volume(a: Vector, b: Vector, c: Vector, d: Vector) -> int:
    """Six times that of a tet."""
    return dot(minus(b, a), cross(minus(c, a), minus(d, a)))


def share_volume(a: list[Vector], b: list[Vector]) -> bool:
    """Whether two tets that are not flat do: no plane along two of their edges has one on each side."""

    def parts(axis: Vector) -> bool:
        first, second = [dot(axis, p) for p in a], [dot(axis, p) for p in b]
        return any(axis) and (max(first) <= min(second) or max(second) <= min(first))

    edges_a = [minus(p, q) for p, q in itertools.combinations(a, 2)]
    edges_b = [minus(p, q) for p, q in itertools.combinations(b, 2)]
    axes = itertools.chain(
        [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
        (cross(minus(p[1], p[0]), minus(p[2], p[0])) for t in (a, b) for p in itertools.combinations(t, 3)),
        (cross(p, q) for p in edges_a for q in edges_b),
    )
    return not any(parts(axis) for axis in axes)


def meet(a: Triangle, b: Triangle) -> bool:
    """Whether two triangles that are not flat meet beyond their common corners and edges."""
    low = [max(min(p[k] for p in a), min(p[k] for p in b)) for k in range(3)]
    high = [min(max(p[k] for p in a), max(p[k] for p in b)) for k in range(3)]
    if any(x > y for x, y in zip(low, high, strict=True)):
        return False
    common = [p for p in a if p in b]
    if len(common) == 3:
        return True
    if len(common) == 2:  # only when folded onto each other
        p, q = common
        r, s = (next(x for x in t if x not in common) for t in (a, b))
        normal = cross(minus(q, p), minus(r, p))
        return dot(normal, minus(s, p)) == 0 and dot(cross(normal, minus(q, p)), minus(s, p)) > 0
    for one, other in ((a, b), (b, a)):
        for p, q in itertools.combinations(one, 2):
            if edge_meets(p, q, other, common):
                return True
    return False


def edge_meets(p: Vector, q: Vector, triangle: Triangle, common: list[Vector]) -> bool:
    """Whether an edge meets a triangle other than at a corner that both triangles have."""
    normal = cross(minus(triangle[1], triangle[0]), minus(triangle[2], triangle[0]))
    hp, hq = dot(normal, minus(p, triangle[0])), dot(normal, minus(q, triangle[0]))
    if hp * hq > 0:
        return False
    if hp == 0 and hq == 0:
        return edge_meets_in_plane(p, q, triangle, normal, common)
    # The point p + hp / (hp - hq) (q - p), times hp - hq, in the triangle's plane.
    span = hp - hq
    place = tuple(span * p[k] + hp * (q[k] - p[k]) for k in range(3))
    if any(all(place[k] == span * c[k] for k in range(3)) for c in common):
        return False
    sides = []
    for a, b in zip(triangle, (*triangle[1:], triangle[0]), strict=True):
        away = (place[0] - span * a[0], place[1] - span * a[1], place[2] - span * a[2])
        sides.append(dot(cross(minus(b, a), away), normal))
    sides = sides if span > 0 else [-side for side in sides]
    return min(sides) >= 0


def edge_meets_in_plane(p: Vector, q: Vector, triangle: Triangle, normal: Vector, common: list[Vector]) -> bool:
    """The same for an edge in the triangle's plane: clipped by its three sides, more than a common corner is left."""
    low, high = Fraction(0), Fraction(1)
    for a, b in zip(triangle, (*triangle[1:], triangle[0]), strict=True):
        inward = cross(normal, minus(b, a))
        at_p, at_q = dot(inward, minus(p, a)), dot(inward, minus(q, a))
        if at_p < 0 and at_q < 0:
            return False
        if at_p < 0:
            low = max(low, Fraction(at_p, at_p - at_q))
        elif at_q < 0:
            high = min(high, Fraction(at_p, at_p - at_q))
    if low > high:
        return False
    if low < high:
        return True
    place = tuple(p[k] + low * (q[k] - p[k]) for k in range(3))
    return not any(all(place[k] == c[k] for k in range(3)) for c in common)


def boundary(tets: np.ndarray) -> list[tuple[int, int, int]]:
    """Faces of one tet only."""
    faces = [tuple(sorted(int(t[k]) for k in ks)) for t in tets for ks in itertools.combinations(range(4), 3)]
    counts = Counter(faces)
    return [face for face in faces if counts[face] == 1]  # type: ignore[misc]


def wrong(mesh: TetMesh) -> tuple[Claim, str]:
    """The claim of a mesh, and what shows that it is wrong; empty where nothing does."""
    found = certify_mesh(mesh)
    places = whole(mesh.vertices)
    corners = [[places[k] for k in tet] for tet in mesh.tets]
    signs = [volume(*tet) for tet in corners]
    inverted, flat = sum(v < 0 for v in signs), sum(v == 0 for v in signs)
    if (found.inverted, found.flat) != (inverted, flat):
        return found.claim, f"{found.inverted} inverted and {found.flat} flat; exactly {inverted} and {flat}"
    triangles = [tuple(places[k] for k in face) for face in boundary(mesh.tets)]
    solid = [t for t in triangles if any(cross(minus(t[1], t[0]), minus(t[2], t[0])))]
    crossing = sum(meet(a, b) for a, b in itertools.combinations(solid, 2))  # type: ignore[arg-type]
    # Where tets are refuted anyhow, single contacts of an edge that lies in another triangle's plane may be missed.
    if len(solid) == len(triangles) and (found.crossings > crossing or bool(crossing) != bool(found.crossings)):
        return found.claim, f"{found.crossings} crossings; exactly {crossing}"
    overlapping = any(
        share_volume(a, b)
        for (a, va), (b, vb) in itertools.combinations(zip(corners, signs, strict=True), 2)
        if va and vb
    )
    if found.claim is Claim.CERTIFIED and (overlapping or inverted or flat or crossing):
        return found.claim, "certified, but tets share volume, are inverted, or the boundary crosses itself"
    if found.claim is Claim.REFUTED and not (overlapping or inverted or flat or crossing):
        return found.claim, f"refuted ({found.note}), but exactly nothing is wrong"
    return found.claim, ""


def wrong_motion(mesh: TetMesh, seed: int) -> str:
    """What shows that a straight motion to a shaken mesh is not as safe as it is said to be."""
    rng = np.random.default_rng([14, seed])
    size = float(np.ptp(mesh.vertices, axis=0).max())
    end = mesh.vertices + size * float(rng.choice([0.05, 0.3])) * rng.normal(size=mesh.vertices.shape)
    safe = largest_safe_fraction(mesh.vertices, end, mesh.tets).fraction
    both = whole(np.concatenate([mesh.vertices, end]))
    start, last = both[: len(end)], both[len(end) :]
    for number in range(TIMES + 1) if safe else ():
        t = Fraction(safe) * number / TIMES
        a, b = t.denominator - t.numerator, t.numerator
        there = [
            (a * p[0] + b * q[0], a * p[1] + b * q[1], a * p[2] + b * q[2]) for p, q in zip(start, last, strict=True)
        ]
        if any(volume(*(there[k] for k in tet)) <= 0 for tet in mesh.tets):
            return f"a tet is flat or inverted at {t} of a motion that is safe to {safe}"
    return ""


def campaign(seeds: range) -> tuple[Counter[str], list[str]]:
    """Claims counted, and what was wrong by seed."""
    claims: Counter[str] = Counter()
    faults = []
    for seed in seeds:
        mesh = case(seed)
        if not len(mesh.tets):
            continue
        claim, fault = wrong(mesh)
        claims[claim.value] += 1
        claims["tets"] += len(mesh.tets)
        faults += [f"seed {seed}: {said}" for said in (fault, wrong_motion(mesh, seed)) if said]
    return claims, faults


def main() -> None:
    """Run some seeds and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cases", type=int, default=1000)
    given = parser.parse_args()
    start = time.process_time()
    claims, faults = campaign(range(given.first, given.first + given.cases))
    for line in faults:
        print(line)
    print(dict(claims), "wrong:", len(faults), f"in {time.process_time() - start:.0f} CPU s")


if __name__ == "__main__":
    main()
