r"""The radial kernels by name, and what each needs of the sum that uses it.

A *scalar* kernel is a function phi(r); the field is a weighted sum of phi(|x - c_j|).

An *isochoric* kernel is the divergence-free matrix K(x) = a(r) I + b(r) x x^T that belongs to a potential psi
(Narcowich and Ward 1994; Lowitzsch 2005). In three dimensions

.. math:: K = -(\Delta I - \nabla\nabla^T) \psi = -(\psi'' + \psi'/r)\, I + (\psi'' - \psi'/r)\, \hat x \hat x^T

Signs are chosen so that every kernel is (conditionally) positive definite. The formulas stand in `loops`
and, for those in lanes, in `lane_sums`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class RadialKernel:
    """A kernel of a radial sum.

    Parameters
    ----------
    name : str
    code : int
        Its number in the compiled loops.
    polynomial_degree : int
        Degree of the polynomials it needs beside it to be positive definite: -1 none, 0 constants, 1 affine.
    components : int
        1 for a scalar kernel, 3 for an isochoric one.
    compact : bool
        Zero beyond r = scale.
    smooth_at_centre : bool
        False when the gradient of the field jumps at a centre.
    scaled : bool
        The kernel has a length of its own (support, width or mollifier, mm).
    """

    name: str
    code: int
    polynomial_degree: int
    components: int = 1
    compact: bool = False
    smooth_at_centre: bool = True
    scaled: bool = False
    in_lanes: bool = False

    @property
    def isochoric(self) -> bool:
        """True when its fields have no divergence."""
        return self.components == 3


KERNELS: Mapping[str, RadialKernel] = MappingProxyType(
    {
        kernel.name: kernel
        for kernel in (
            RadialKernel("r", 0, 0, smooth_at_centre=False, in_lanes=True),
            RadialKernel("r2logr", 1, 1),
            RadialKernel("r3", 2, 1),
            RadialKernel("gaussian", 3, -1, scaled=True),
            RadialKernel("inverse-multiquadric", 4, -1, scaled=True),
            RadialKernel("wendland-c2", 5, -1, compact=True, scaled=True),
            RadialKernel("wendland-c4", 6, -1, compact=True, scaled=True),
            RadialKernel("isochoric-r3", 20, 0, components=3, smooth_at_centre=False, in_lanes=True),
            RadialKernel("isochoric-r3-mollified", 21, 0, components=3, scaled=True, in_lanes=True),
            RadialKernel("isochoric-r5", 22, 1, components=3),
            RadialKernel("isochoric-wendland-c6", 23, -1, components=3, compact=True, scaled=True),
        )
    }
)
"""Every kernel by name."""
