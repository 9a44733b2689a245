"""Step rules: how far a step may go before it could fold; each is a sufficient condition, point by point.

A rule takes gradients (N, n, n) of the whole step's field and gives (N,) *safe fractions*: the step shortened to less
than that fraction keeps det(I + grad D) > 0 there. Infinity where nothing limits it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from musclefit.geometry.arrays import Float, Gradients
from musclefit.vocabulary import StepKind, StepRule

Rule = Callable[[Gradients], Float]


def row_norm_fractions(gradients: Gradients) -> Float:
    r"""Smallest over rows i of :math:`(1/\sqrt n) / |\mathrm{row}_i \nabla D|` (Eq. 6 of Yu et al. 2014).

    Every row below :math:`1/\sqrt n` bounds the Frobenius norm below 1, so that I + grad D is invertible.
    (Eq. 5 there prints a sum over i; it is over j for each row i.)
    """
    rows = np.linalg.norm(gradients, axis=2).max(axis=1)
    return _reciprocal(np.sqrt(gradients.shape[1]) * rows)


def gershgorin_fractions(gradients: Gradients) -> Float:
    """Largest fraction that keeps I + fraction grad D strictly row dominant with positive diagonal (Eq. 3)."""
    diagonal = np.einsum("pii->pi", gradients)
    off = np.abs(gradients).sum(axis=2) - np.abs(diagonal)
    return _reciprocal((off - diagonal).max(axis=1))


def monotone_fractions(gradients: Gradients) -> Float:
    """Largest fraction that keeps I + fraction sym(grad D) positive definite.

    Weaker than the row norm: rotations cost little. Everywhere on a convex domain it makes the step one-to-one.
    """
    return _reciprocal(-_symmetric_eigenvalues(gradients)[:, 0])


def cayley_fractions(gradients: Gradients) -> Float:
    """Largest fraction that keeps every eigenvalue of sym(grad D) inside (-2, 2), for implicit midpoint steps.

    Both factors of the step are then strictly monotone, so one-to-one on a convex domain; its rotation is free.
    """
    return _reciprocal(0.5 * np.abs(_symmetric_eigenvalues(gradients)).max(axis=1))


def rule_for(step: StepKind, rule: StepRule) -> Rule:
    """The rule a step kind is held to; implicit steps have one of their own."""
    return cayley_fractions if step is StepKind.CAYLEY else EXPLICIT_RULES[rule]


EXPLICIT_RULES: Mapping[StepRule, Rule] = MappingProxyType(
    {
        StepRule.ROW_NORM: row_norm_fractions,
        StepRule.GERSHGORIN: gershgorin_fractions,
        StepRule.MONOTONE: monotone_fractions,
    }
)


def _symmetric_eigenvalues(gradients: Gradients) -> Float:
    """(N, n) eigenvalues of the symmetric parts, ascending."""
    return np.asarray(np.linalg.eigvalsh(0.5 * (gradients + gradients.transpose(0, 2, 1))), dtype=np.float64)


def _reciprocal(limit: Float) -> Float:
    """1 / limit where positive, else infinity."""
    return np.divide(1.0, limit, out=np.full_like(limit, np.inf), where=limit > 0.0)
