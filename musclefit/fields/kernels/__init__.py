r"""The radial kernels: one file each, with everything that the rest of musclefit needs to know of it.

A *scalar* kernel is a function phi(r); the field is a weighted sum of phi(|x - c_j|).

An *isochoric* kernel is the divergence-free matrix K(x) = a(r) I + b(r) x x^T that belongs to a potential psi
(Narcowich and Ward 1994; Lowitzsch 2005). In three dimensions

.. math:: K = -(\Delta I - \nabla\nabla^T) \psi = -(\psi'' + \psi'/r)\, I + (\psi'' - \psi'/r)\, \hat x \hat x^T

Signs are chosen so that every kernel is (conditionally) positive definite. `model` says what a kernel is made of;
`register` adds one from outside.
"""

from musclefit.fields.kernels import (
    gaussian,
    inverse_multiquadric,
    isochoric_r3,
    isochoric_r3_mollified,
    isochoric_r5,
    isochoric_wendland_c6,
    r,
    r2logr,
    r3,
    wendland_c2,
    wendland_c4,
)
from musclefit.fields.kernels.model import RadialKernel
from musclefit.fields.kernels.registry import KERNELS, kernel_named, register

__all__ = ["KERNELS", "RadialKernel", "kernel_named", "register"]

for _module in (
    r,
    r2logr,
    r3,
    gaussian,
    inverse_multiquadric,
    wendland_c2,
    wendland_c4,
    isochoric_r3,
    isochoric_r3_mollified,
    isochoric_r5,
    isochoric_wendland_c6,
):
    register(_module.KERNEL)
