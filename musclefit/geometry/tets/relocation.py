r"""Moves vertices of tets until none is inverted, near where they should be; takes positions and tets, knows no tissue.

Each tet has a shape that it should keep, and :math:`J` is the linear map from that shape to where its corners are. The
energy of a tet, per volume,

.. math:: \frac{|J|_F^2}{\chi(\det J)^{2/3}} + \frac{1 + \det^2 J}{\chi(\det J)}, \qquad
          \chi(d) = \tfrac{1}{2}\bigl(d + \sqrt{d^2 + \varepsilon^2}\bigr),

is finite for inverted tets while the softness :math:`\varepsilon` is positive, and a barrier in front of them when it
goes to 0. Nothing here proves anything: orientations are judged by who calls.

References
----------
V. Garanzha, I. Kaporin, L. Kudryavtseva, F. Protais, N. Ray, D. Sokolov, "Foldover-free maps in 50 lines of code", ACM
Trans. Graph. 40 (2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from musclefit.compiling import njit
from musclefit.geometry.arrays import Bool, Float, Int, Points, Tets

STIFFNESS = 10.0
"""Energy per mm² of missing a plane."""


@dataclass(frozen=True, eq=False, slots=True)
class Planes:
    """Planes that points of triangles should stay in front of.

    Parameters
    ----------
    corners : (r, 3) int64
        Vertices of each point's triangle ...
    shares : (r, 3) float64
        ... and its barycentric coordinates.
    places, normals : (r, 3) float64
        A place of each plane, mm, and its unit normal, which points to the front.
    margins : (r,) float64
        How far in front, mm.
    """

    corners: Int
    shares: Float
    places: Points
    normals: Points
    margins: Float

    @classmethod
    def none(cls) -> Planes:
        """No plane."""
        nowhere = np.zeros((0, 3))
        return cls(np.zeros((0, 3), np.int64), nowhere, nowhere, nowhere, np.zeros(0))

    def and_also(self, other: Planes) -> Planes:
        """These and others."""
        return Planes(
            np.concatenate([self.corners, other.corners]),
            np.concatenate([self.shares, other.shares]),
            np.concatenate([self.places, other.places]),
            np.concatenate([self.normals, other.normals]),
            np.concatenate([self.margins, other.margins]),
        )


@dataclass(frozen=True, eq=False, slots=True)
class Springs:
    """What pulls vertices to places: (m, 3) ``towards``, mm, by (m,) ``strengths``, energy per mm²."""

    towards: Points
    strengths: Float


def inverse_shapes(vertices: Points, tets: Tets) -> Float:
    """(k, 3, 3) inverses of the matrices whose columns are a tet's edges from its first corner, 1/mm."""
    edges = np.stack([vertices[tets[:, k]] - vertices[tets[:, 0]] for k in (1, 2, 3)], axis=2)
    return np.ascontiguousarray(np.linalg.inv(edges))


def relocated(
    vertices: Points,
    tets: Tets,
    *,
    free: Int,
    shapes: Float,
    weights: Float,
    springs: Springs,
    planes: Planes,
    softness: float,
    iterations: int,
) -> Points:
    r"""Positions after some iterations of L-BFGS on the energy of tets, springs and planes.

    Parameters
    ----------
    vertices : (n, 3) float64, mm
    tets : (k, 4) int64
        All tets around the free vertices, and no others.
    free : (m,) int64, rising
        Vertices that may move.
    shapes : (k, 3, 3) float64
        `inverse_shapes` of what the tets should look like.
    weights : (k,) float64
        Of the tets' energies.
    springs : Springs
        Of the free vertices.
    planes : Planes
    softness : float, > 0
        The energy's :math:`\\varepsilon`; below 1e-4 it is a barrier, to be used where no tet is inverted.
    iterations : int

    Returns
    -------
    (n, 3) float64, mm
    """
    used, numbers = np.unique(tets, return_inverse=True)
    local = np.ascontiguousarray(numbers.reshape(-1, 4), dtype=np.int64)
    where = np.searchsorted(used, free)
    places, gradient = np.array(vertices[used]), np.zeros((len(used), 3))
    fronts = _Fronts.of(planes, vertices, free)

    def energy(flat: Float) -> tuple[float, Float]:
        moved = flat.reshape(-1, 3)
        places[where] = moved
        total = _energy(places, local, shapes, weights, softness, gradient)
        off = moved - springs.towards
        pulling = springs.strengths[:, None] * off
        slope = gradient[where] + 2.0 * pulling
        total += float((pulling * off).sum()) + fronts.add(moved, slope)
        return total, slope.ravel()

    found = minimize(
        energy,
        vertices[free].ravel(),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": iterations, "maxfun": 2 * iterations, "ftol": 1e-12, "gtol": 1e-12},
    )
    moved = np.array(vertices)
    moved[free] = found.x.reshape(-1, 3)
    return moved


@dataclass(frozen=True, eq=False, slots=True)
class _Fronts:
    """Planes with what does not move put into their offsets."""

    corners: Int
    shares: Float
    normals: Points
    offsets: Float

    @classmethod
    def of(cls, planes: Planes, vertices: Points, free: Int) -> _Fronts:
        number = np.full(len(vertices), -1)
        number[free] = np.arange(len(free))
        local = number[planes.corners]
        held: Bool = local < 0
        still = (vertices[planes.corners] * (planes.shares * held)[:, :, None]).sum(axis=1)
        offsets = ((still - planes.places) * planes.normals).sum(axis=1) - planes.margins
        return cls(np.where(held, 0, local), np.where(held, 0.0, planes.shares), planes.normals, offsets)

    def add(self, moved: Points, slope: Points) -> float:
        """The energy of missed planes; its gradient is added to ``slope``."""
        points = (moved[self.corners] * self.shares[:, :, None]).sum(axis=1)
        missed = np.minimum(0.0, (points * self.normals).sum(axis=1) + self.offsets)
        on = np.flatnonzero(missed)
        for k in range(3):
            force = 2.0 * STIFFNESS * missed[on] * self.shares[on, k]
            np.add.at(slope, self.corners[on, k], force[:, None] * self.normals[on])
        return STIFFNESS * float((missed[on] ** 2).sum())


@njit(cache=True)
def _energy(places, tets, shapes, weights, softness, gradient):
    gradient[:] = 0.0
    jac = np.empty((3, 3))
    cof = np.empty((3, 3))
    total = 0.0
    for t in range(len(tets)):
        first = tets[t, 0]
        shape = shapes[t]
        for i in range(3):
            for j in range(3):
                entry = 0.0
                for k in range(3):
                    entry += (places[tets[t, k + 1], i] - places[first, i]) * shape[k, j]
                jac[i, j] = entry
        for i in range(3):
            for j in range(3):
                p, q, r, s = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                cof[i, j] = jac[p, r] * jac[q, s] - jac[p, s] * jac[q, r]
        det = jac[0, 0] * cof[0, 0] + jac[0, 1] * cof[0, 1] + jac[0, 2] * cof[0, 2]
        root = np.sqrt(softness * softness + det * det)
        chi = 0.5 * (det + root) if det > 0.0 else 0.5 * softness * softness / (root - det)
        slope = chi / root
        square = 0.0
        for i in range(3):
            for j in range(3):
                square += jac[i, j] * jac[i, j]
        power = chi ** (2.0 / 3.0)
        stretch = square / power
        swell = (1.0 + det * det) / chi
        total += weights[t] * (stretch + swell)
        of_jac = weights[t] * 2.0 / power
        of_det = weights[t] * ((-2.0 / 3.0 * stretch - swell) / chi * slope + 2.0 * det / chi)
        for k in range(3):
            for i in range(3):
                entry = 0.0
                for j in range(3):
                    entry += (of_jac * jac[i, j] + of_det * cof[i, j]) * shape[k, j]
                gradient[tets[t, k + 1], i] += entry
                gradient[first, i] -= entry
    return total
