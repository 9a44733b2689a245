r"""The least change of a cage that meets conditions: each vertex has a displacement and a gradient of its own.

Minimised is, over displacements :math:`y_i` and gradients :math:`M_i` at n vertices and E edges of vectors e,

.. math:: \frac1n \sum_i |\mathrm{sym}\, M_i|^2
          + \frac{1}{E} \sum_{ij} \frac{c\,|y_j - y_i - \tfrac12 (M_i + M_j) e|^2 + \ell^2 |M_j - M_i|^2}{|e|^2}

so that strain costs, rotations cost nothing, gradients agree with displacements, and a strain that is asked for at one
place fades over the length :math:`\ell`. This is the deformation graph of Sumner et al. with linear rotations.

References
----------
R. W. Sumner, J. Schmid, M. Pauly, Embedded deformation for shape manipulation, ACM Trans. Graph. 26 (2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from musclefit.geometry.arrays import Float
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.topology import edges_of

AGREEMENT = 10.0
"""How strongly gradients are held to displacements (c)."""

AT_REST = 1e-7
"""How strongly each vertex is held where it is: only so that there is one answer."""

DEPENDENT = 1e-9
"""Conditions are dependent where an eigenvalue of their scaled products is below this."""

EACH = 12
"""Unknowns of a vertex: a displacement, then a gradient by rows."""


class DependentConditionsError(Exception):
    """Conditions that say the same thing about the cage and ask for different values; ``parts`` (m,) says which."""

    def __init__(self, parts: Float) -> None:
        self.parts = parts
        super().__init__("conditions that depend on each other ask for different values")


@dataclass(frozen=True, eq=False, slots=True)
class LeastChange:
    """The energy of a cage, factorised; made by `of`."""

    rigid: Float
    """(6, n, 3) displacements of the rigid motions to first order, which no answer holds any of."""
    factors: SuperLU

    @classmethod
    def of(cls, cage: TriMesh, *, reach_mm: float) -> LeastChange:
        """Of a cage, for changes that fade over a length, mm."""
        size = float(np.linalg.norm(np.ptp(cage.vertices, axis=0)))
        places, ends = cage.vertices / size, edges_of(cage.faces).ends
        n, count = len(places), len(ends)
        strain = sparse.kron(sparse.eye(n) / np.sqrt(n), _strain_rows())
        vectors = places[ends[:, 1]] - places[ends[:, 0]]
        lengths = np.linalg.norm(vectors, axis=1)
        across = sparse.csr_matrix(
            (np.tile([-1.0, 1.0], count), (np.repeat(np.arange(count), 2), ends.ravel())), shape=(count, n)
        )
        between = 0.5 * abs(across)
        weight = sparse.diags(1.0 / (lengths * np.sqrt(count)))
        displacement, gradient = np.eye(3, EACH), np.eye(9, EACH, 3)
        agreement = sparse.kron(weight @ across, displacement)
        for k in range(3):  # column k of the gradients, times component k of the edges
            column = np.zeros((3, EACH))
            column[np.arange(3), 3 + 3 * np.arange(3) + k] = 1.0
            agreement = agreement - sparse.kron(weight @ sparse.diags(vectors[:, k]) @ between, column)
        smooth = sparse.kron(reach_mm / size * (weight @ across), gradient)
        rows = sparse.vstack([strain, np.sqrt(AGREEMENT) * agreement, smooth]).tocsr()
        system = rows.T @ rows + AT_REST / n * sparse.eye(EACH * n)
        about = places - places.mean(axis=0)
        rigid = [np.tile(axis, (n, 1)) for axis in np.eye(3)] + [np.cross(axis, about) for axis in np.eye(3)]
        return cls(
            np.array(rigid),
            splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}),
        )

    def meeting(self, slopes: Float, wanted: Float) -> Float:
        """The displacements of least energy that meet linear conditions.

        Parameters
        ----------
        slopes : (m, n, 3) float64
            Of each condition by the displacements of the n vertices.
        wanted : (m,) float64, mm
            What the slopes times the displacements shall be.

        Returns
        -------
        (n, 3) float64, mm

        Raises
        ------
        DependentConditionsError
            Conditions that depend on each other and ask for different values.
        """
        count = len(slopes)
        slopes, wanted = np.concatenate([slopes, self.rigid]), np.append(wanted, np.zeros(len(self.rigid)))
        m, n = slopes.shape[:2]
        right = np.zeros((m, n, EACH))
        right[:, :, :3] = slopes
        answers = self.factors.solve(right.reshape(m, -1).T).reshape(n, EACH, m)[:, :3]
        products = np.einsum("knc,ncm->km", slopes, answers)
        scale = 1.0 / np.sqrt(np.diagonal(products))
        values, vectors = np.linalg.eigh(scale[:, None] * products * scale)
        asked = vectors.T @ (scale * wanted)
        free = values < DEPENDENT * values[-1]
        if free.any():
            worst = int(np.argmax(np.abs(asked) * free))
            if abs(asked[worst]) > 1e-6 * np.abs(scale * wanted).max():
                raise DependentConditionsError(np.abs(vectors[:count, worst]))
        shares = scale * (vectors[:, ~free] @ (asked[~free] / values[~free]))
        return np.asarray(answers @ shares, dtype=np.float64)


def _strain_rows() -> Float:
    """(6, 12) what takes the unknowns of a vertex to the symmetric part of its gradient; squares sum to its norm."""
    rows = np.zeros((6, EACH))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        rows[k, 3 + 3 * i + j] += 1.0 if i == j else np.sqrt(0.5)
        rows[k, 3 + 3 * j + i] += 0.0 if i == j else np.sqrt(0.5)
    return rows
