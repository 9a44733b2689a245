"""Slow, obvious versions that fast code must equal."""

from __future__ import annotations

import numpy as np


def scalar_profile(kernel: str, r: float, scale: float) -> float:
    """phi(r) as written in textbooks."""
    q = r / scale
    u = max(1.0 - q, 0.0)
    return {
        "r": -r,
        "r2logr": r * r * np.log(r) if r > 0.0 else 0.0,
        "r3": r**3,
        "gaussian": np.exp(-(q**2)),
        "inverse-multiquadric": 1.0 / np.sqrt(1.0 + q * q),
        "wendland-c2": u**4 * (4.0 * q + 1.0),
        "wendland-c4": u**6 * (35.0 * q * q + 18.0 * q + 3.0) / 3.0,
    }[kernel]


def potential(kernel: str, r: float, scale: float) -> float:
    """psi(r) of an isochoric kernel."""
    q = r / scale
    return {
        "isochoric-r3": r**3,
        "isochoric-r3-mollified": (r * r + scale * scale) ** 1.5,
        "isochoric-r5": -(r**5),
        "isochoric-wendland-c6": scale**2 * max(1.0 - q, 0.0) ** 8 * (32 * q**3 + 25 * q**2 + 8 * q + 1),
    }[kernel]


def isochoric_matrix(kernel: str, x: np.ndarray, scale: float, *, step: float) -> np.ndarray:
    """-(Laplacian I - grad grad^T) psi at x, by central differences."""
    hessian = np.empty((3, 3))
    e = step * np.eye(3)

    def psi(y: np.ndarray) -> float:
        return potential(kernel, float(np.linalg.norm(y)), scale)

    for i in range(3):
        for j in range(3):
            hessian[i, j] = (
                psi(x + e[i] + e[j]) - psi(x + e[i] - e[j]) - psi(x - e[i] + e[j]) + psi(x - e[i] - e[j])
            ) / (4.0 * step * step)
    return hessian - np.trace(hessian) * np.eye(3)


def row_norm_fraction(gradients: np.ndarray) -> float:
    """Eq. 6 of Yu et al. 2014, loop by loop."""
    n = gradients.shape[1]
    best = np.inf
    for gradient in gradients:
        for i in range(n):
            size = sum(gradient[i, j] ** 2 for j in range(n)) ** 0.5
            if size > 0.0:
                best = min(best, (1.0 / n**0.5) / size)
    return best


def difference_jacobian(function, points: np.ndarray, *, step: float) -> np.ndarray:
    """Central differences of a map of (N, n) points."""
    n = points.shape[1]
    columns = [(function(points + step * e) - function(points - step * e)) / (2.0 * step) for e in np.eye(n)]
    return np.stack(columns, axis=-1)


def bspline_displacement(level, x: np.ndarray) -> np.ndarray:
    """Sum of tensor-product cubic B-splines over a lattice at one point, coefficient by coefficient."""
    lattice, total = level.lattice, np.zeros(len(x))
    for index in np.ndindex(*lattice.shape):
        distances = np.abs((x - lattice.low) / lattice.spacing - np.array(index))
        inner, outer = 2.0 / 3.0 - distances**2 + 0.5 * distances**3, np.maximum(2.0 - distances, 0.0) ** 3 / 6.0
        total += np.prod(np.where(distances < 1.0, inner, outer)) * level.coefficients[index]
    return total
