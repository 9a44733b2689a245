r"""The paper's own loop over the control points of a lattice (Eq. 7 and 8): points keep their lattice coordinates.

A point with lattice coordinates w is at X(w) = sum_i B_i(w) C_i, and moves by D(w) = sum_i B_i(w) (C*_i - C_i). The
gradient that limits a step is that of D by the *present* position, grad D = (dD/dw) (dX/dw)^{-1}, a product of
matrices; Appendix B of the paper divides element by element, which is not the inverse and divides by zero on an
axis-aligned lattice.

Since points keep their coordinates, the loop ends where the one-shot deformation does, X(w) = sum_i B_i(w) C*_i, or it
stalls before: it can say that a lattice's deformation folds, but not unfold it. `march.march` with an `FfdBackend`
fits a fresh lattice in every step and can.

References
----------
X. Yu et al., "Foldover-free shape deformation for biomedicine", J. Biomed. Inform. 48 (2014), section 4.3, Eq. 7-8.
"""

from __future__ import annotations

import numpy as np

from musclefit.fields.ffd import Lattice
from musclefit.flow.deformation import Deformation, Status, StepRecord
from musclefit.flow.march import SHORTEST_REACH
from musclefit.flow.rules import row_norm_fractions
from musclefit.flow.steps import ExplicitStep
from musclefit.geometry.arrays import Float, Gradients, Points


def lattice_row_norm_fractions(displacement_slopes: Gradients, position_slopes: Gradients) -> Float:
    r"""Eq. 8: smallest over rows i of :math:`(1/\sqrt n) / |\mathrm{row}_i \nabla D|`, slopes by lattice coordinates.

    Parameters
    ----------
    displacement_slopes, position_slopes : (N, n, n) float64
        dD/dw and dX/dw at the tested points.

    Returns
    -------
    (N,) float64
        Safe fractions of the step; 0 where dX/dw is singular, so that no step is safe.
    """
    regular = (
        np.abs(np.linalg.det(position_slopes))
        > 1e-12 * np.linalg.norm(position_slopes, axis=(1, 2)) ** (position_slopes.shape[1])
    )
    fractions = np.zeros(len(position_slopes))
    gradients = np.linalg.solve(
        position_slopes[regular].transpose(0, 2, 1), displacement_slopes[regular].transpose(0, 2, 1)
    ).transpose(0, 2, 1)
    fractions[regular] = row_norm_fractions(gradients)
    return fractions


def march_lattice(lattice: Lattice, displacements: Points, *, tested: Points, max_steps: int) -> Deformation:
    """Move control points towards their destinations in steps of Eq. 8, as far as they go.

    Parameters
    ----------
    lattice : Lattice
        The control points at rest.
    displacements : (K, n) float64, mm
        From rest to their destinations.
    tested : (N, n) float64, mm
        Where Eq. 8 is tested, at rest.
    max_steps : int

    Returns
    -------
    Deformation
        One explicit step with the field that was reached (the steps of the loop compose to it exactly), a record for
        every step of the loop, and STALLED where the destinations cannot be reached without a fold.
    """
    field = lattice.field(displacements)
    slopes = field.gradient(tested)
    identity = np.eye(lattice.dimension)
    done, status = 0.0, Status.CONVERGED
    records: list[StepRecord] = []
    while done < 1.0:
        if len(records) == max_steps:
            status = Status.OUT_OF_STEPS
            break
        fractions = lattice_row_norm_fractions((1.0 - done) * slopes, identity + done * slopes)
        worst = int(np.argmin(fractions))
        fraction = float(fractions[worst])
        place = tuple(float(x) for x in tested[worst])
        if fraction < SHORTEST_REACH or done + fraction * (1.0 - done) <= done:
            status = Status.STALLED
            records.append(StepRecord(done, done, 0.0, place))
            break
        end = 1.0 if fraction > 1.0 else done + fraction * (1.0 - done)
        records.append(StepRecord(done, end, max(0.0, 1.0 - 1.0 / fraction), place))
        done = end
    return Deformation((ExplicitStep(field.scaled(done)),), tuple(records), status)
