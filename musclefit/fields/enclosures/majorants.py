r"""Proved bounds of a kernel's derivatives as functions of distance, tabulated once per kernel; it knows no centres.

For a unit weight w at the origin let D(x) = K(x) w and, for a unit direction e,

* N1(r) = sup |grad D|, N2(r) = sup |d_e grad D|, N3(r) = sup |d_e² grad D|, N4(r) = sup |d_e³ grad D| over all w, e
  and all x with |x| = r,

in the spectral norm, either of the symmetric part (the *strain*) or of the whole matrix. A table holds *falling
majorants*: its entry for distance q is at least N at every distance >= q. Everything follows from the chain
f_0 = f, f_{k+1} = f_k' / r of the radial function (phi or the potential psi), because

.. math:: \nabla^n f(|x|)[e_1, \dots, e_n] =
          \sum_{j} f_{n-j} \sum_{j\ \text{pairs}} \prod (e_a \cdot e_b) \prod (x \cdot e_c)

*Scalar kernels*: grad D = w (grad phi)^T, a product of two vectors, so that strain and whole have the same sup:
N1 = |f_1| r, N2 = max(|f_1|, |f_1 + f_2 r²|), N3 = max over c in [0, 1] of |3 f_2 r c + f_3 r³ c³|, N4 = max over c in
[0, 1] of |3 f_2 + 6 f_3 r² c² + f_4 r⁴ c⁴|; a symmetric multilinear form takes its norm at equal directions (Banach
1938). N4 is tabulated for homogeneous and isochoric kernels only.

*Isochoric kernels*: D_i = -w_i omega + d_w d_i psi with omega = Laplacian of psi = 3 f_1 + r² f_2. For a unit v,
v . (grad D) v = w . (grad d_v² psi - v d_v omega), so the sup over w is the length of that vector; derivatives along e
carry over. The skew part is -(w g^T - g w^T) / 2 with g = grad omega, of norm at most |g| / 2.
The length is maximised over directions on a grid of angles. With w at its best value fixed, the quantity is a
trigonometric polynomial of degree 2 in the angles of v and at most 3 in that of e, and such a polynomial T of degree n
with sup |T| = M at t* satisfies |T(t)| >= M cos(n (t - t*)) for |t - t*| <= pi / n (M. Riesz 1914). A grid of spacing d
therefore misses at most the factor cos(d) per angle of v and cos(3 d / 2) for that of e, and dividing by them gives a
proved bound.

Between the distances of a table the chain is enclosed by products of monotone factors, and a norm N of coefficients
within c +- s is at most N(c) + sum of s_k N(k-th unit vector).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from musclefit.errors import FieldError
from musclefit.geometry.arrays import Float, frozen

CELLS = 1024
"""Cells of a table over the distance."""

ROUNDING = 1.0 + 1e-9
"""Every tabulated bound is enlarged by this, far more than its own rounding."""

EXTENTS: Mapping[int, float] = MappingProxyType({3: 8.0, 4: 16.0, 5: 1.0, 6: 1.0, 23: 1.0})
"""By kernel code: the distance, in units of the kernel's scale, up to which its table reaches."""

FINE, COARSE = 32, 10
"""Grid angles per quarter turn: for constants, and for every cell of a table."""

Enclosure = tuple[Float, Float]
"""Lower and upper ends."""


@lru_cache(maxsize=32)
def majorants(code: int) -> Float:
    """(8, cells + 1) falling majorants: N1 to N4 of the strain, then of the whole gradient.

    Kernels with a table: in units of the kernel's scale; the entry of distance q is number floor(q cells / extent), the
    last one holds from the extent to infinity. Homogeneous kernels: one column of constants, to be multiplied by the
    power of the distance that has the unit's dimension (``isochoric-r3-mollified``: of sqrt(r² + scale²)); 0 where
    r² log r has none, and where N4 is not used.
    """
    if code in CONSTANTS:
        return frozen(np.array([*CONSTANTS[code], *CONSTANTS[code]])[:, None] * ROUNDING)
    if code in CHAINS_AT_ONE:
        f2, f3, f4, f5, f6 = (_exactly(value) for value in CHAINS_AT_ONE[code])
        orders = ((f2, f3), (f2, f3, f4), (f3, f4, f5), (f3, f4, f5, f6))
        return frozen(_isochoric(orders, angles=FINE) * ROUNDING)
    if code == 21:
        return frozen(_mollified().max(axis=1, keepdims=True) * ROUNDING)
    if code not in EXTENTS:
        raise FieldError(f"the derivatives of kernel number {code} have no proved bounds; give it some in `majorants`")
    edges = np.linspace(0.0, EXTENTS[code], CELLS + 1)
    if code == 23:
        return frozen(_falling(_wendland_c6(edges), (0.0,) * 8) * ROUNDING)
    f1, f1_r, f2_r, f2_rr, f3_rrr = CHAINS[code](edges)
    n1, n2, n3 = _size(f1_r), np.maximum(_size(f1), _size(_sum(f1, f2_rr))), _cubic(f2_r, f3_rrr)
    unused = np.zeros_like(n1)
    tail = (*TAILS.get(code, (0.0, 0.0, 0.0)), 0.0)
    return frozen(_falling(np.array([n1, n2, n3, unused, n1, n2, n3, unused]), tail * 2) * ROUNDING)


CONSTANTS: Mapping[int, tuple[float, float, float, float]] = MappingProxyType(
    {
        0: (1.0, 1.0, 2.0 / np.sqrt(3.0), 3.0),  # N3: |3 c - 3 c³|, N4: |3 - 18 c² + 15 c⁴|
        1: (0.0, 0.0, 2.0 * np.sqrt(2.0), 6.0),  # N3: |6 c - 4 c³|, N4: |6 - 24 c² + 16 c⁴|
        2: (3.0, 6.0, 6.0, 9.0),  # N3: |9 c - 3 c³|, N4: |9 - 18 c² + 9 c⁴|
    }
)
"""Homogeneous scalar kernels at unit distance."""

CHAINS_AT_ONE: Mapping[int, tuple[float, ...]] = MappingProxyType(
    {20: (3.0, -3.0, 9.0, -45.0, 315.0), 22: (-15.0, -15.0, 15.0, -45.0, 225.0)}
)
"""f_2 to f_6 of psi = r³ and psi = -r⁵ at unit distance."""


def _falling_factor(values: Float) -> Enclosure:
    """Enclosure on every cell of a function of distance that falls and is not negative, from its values at edges."""
    return values[1:], values[:-1]


def _times(*factors: Enclosure, by: float = 1.0) -> Enclosure:
    """Product of enclosures that are not negative, and a number."""
    low, high = np.prod([f[0] for f in factors], axis=0), np.prod([f[1] for f in factors], axis=0)
    return (by * low, by * high) if by >= 0.0 else (by * high, by * low)


def _sum(a: Enclosure, b: Enclosure) -> Enclosure:
    return a[0] + b[0], a[1] + b[1]


def _size(a: Enclosure) -> Float:
    return np.maximum(np.abs(a[0]), np.abs(a[1]))


def _exactly(value: float) -> Enclosure:
    return np.array([value]), np.array([value])


Chain = tuple[Enclosure, Enclosure, Enclosure, Enclosure, Enclosure]
"""Enclosures of f_1, f_1 r, f_2 r, f_2 r², f_3 r³ on every cell."""


def _gaussian(q: Float) -> Chain:
    e, r = _falling_factor(np.exp(-(q**2))), (q[:-1], q[1:])
    return (
        _times(e, by=-2.0),
        _times(e, r, by=-2.0),
        _times(e, r, by=4.0),
        _times(e, r, r, by=4.0),
        _times(e, r, r, r, by=-8.0),
    )


def _inverse_multiquadric(q: Float) -> Chain:
    f, eta = 1.0 / np.sqrt(1.0 + q**2), q / np.sqrt(1.0 + q**2)  # eta = q f grows
    f2, f3, r = _falling_factor(f**2), _falling_factor(f**3), (eta[:-1], eta[1:])
    f4 = _falling_factor(f**4)
    return (
        _times(f3, by=-1.0),
        _times(f2, r, by=-1.0),
        _times(f4, r, by=3.0),
        _times(f3, r, r, by=3.0),
        _times(f4, r, r, r, by=-15.0),
    )


def _wendland_c2(q: Float) -> Chain:
    u, r, w = _falling_factor(1.0 - q), (q[:-1], q[1:]), _falling_factor(1.0 - q**2)
    return (
        _times(u, u, u, by=-20.0),
        _times(u, u, u, r, by=-20.0),
        _times(u, u, by=60.0),
        _times(u, u, r, by=60.0),
        _times(w, by=-60.0),
    )


def _wendland_c4(q: Float) -> Chain:
    u, r, w = _falling_factor(1.0 - q), (q[:-1], q[1:]), (5.0 * q[:-1] + 1.0, 5.0 * q[1:] + 1.0)
    u4 = _times(u, u, u, u)
    return (
        _times(u4, u, w, by=-56.0 / 3.0),
        _times(u4, u, w, r, by=-56.0 / 3.0),
        _times(u4, r, by=560.0),
        _times(u4, r, r, by=560.0),
        _times(u, u, u, r, r, by=-2240.0),
    )


CHAINS: Mapping[int, Callable[[Float], Chain]] = MappingProxyType(
    {3: _gaussian, 4: _inverse_multiquadric, 5: _wendland_c2, 6: _wendland_c4}
)

TAILS: Mapping[int, tuple[float, float, float]] = MappingProxyType(
    {
        # All of 2 q E, (2 + 4 q²) E, (12 q + 8 q³) E with E = exp(-q²) fall from q = 8 on.
        3: (16.0 * np.exp(-64.0), 258.0 * np.exp(-64.0), 4192.0 * np.exp(-64.0)),
        # N1 <= f², N2 <= 2 f³, N3 <= 6 f⁴ with f = (1 + q²)^(-1/2).
        4: (1.0 / 257.0, 2.0 / 257.0**1.5, 6.0 / 257.0**2),
    }
)
"""N1, N2, N3 from the extent on, of the kernels that do not end there."""


def _cubic(f2_r: Enclosure, f3_rrr: Enclosure) -> Float:
    """Max over c in [0, 1] of |3 a c + b c³|; convex in (a, b), so largest at a corner of their enclosure."""
    values = []
    for a in f2_r:
        for b in f3_rrr:
            square = np.divide(-a, b, out=np.zeros_like(a), where=b != 0.0)  # c² where the derivative vanishes
            inside = np.where((square > 0.0) & (square < 1.0), np.sqrt(np.abs(square)), 0.0)
            values += [np.abs(3.0 * a + b), np.abs(2.0 * a * inside)]
    return np.max(values, axis=0)  # type: ignore[no-any-return]


def _falling(values: Float, tail: tuple[float, ...]) -> Float:
    """Append the tail and take the largest value from each cell on."""
    whole = np.column_stack([values, np.array(tail)])
    return np.ascontiguousarray(np.maximum.accumulate(whole[:, ::-1], axis=1)[:, ::-1])


Orders = tuple[tuple[Enclosure, ...], ...]
"""Enclosures of (f_2 r, f_3 r³), (f_2, f_3 r², f_4 r⁴), (f_3 r, f_4 r³, f_5 r⁵) and (f_3, f_4 r², f_5 r⁴, f_6 r⁶): all
that N1 to N4 depend on."""


def _mollified() -> Float:
    """psi = (r² + s²)^(3/2) in units of rho = sqrt(r² + s²): its chain is that of r³ at rho; r / rho is in [0, 1]."""
    edges = np.linspace(0.0, 1.0, CELLS + 1)
    r = (edges[:-1], edges[1:])
    r2 = _times(r, r)
    r4 = _times(r2, r2)
    return _isochoric(
        (
            (_times(r, by=3.0), _times(r2, r, by=-3.0)),
            ((np.full(CELLS, 3.0), np.full(CELLS, 3.0)), _times(r2, by=-3.0), _times(r4, by=9.0)),
            (_times(r, by=-3.0), _times(r2, r, by=9.0), _times(r4, r, by=-45.0)),
            (
                (np.full(CELLS, -3.0), np.full(CELLS, -3.0)),
                _times(r2, by=9.0),
                _times(r4, by=-45.0),
                _times(r4, r2, by=315.0),
            ),
        ),
        angles=COARSE,
    )


def _wendland_c6(q: Float) -> Float:
    """f_2 = 528 u⁶ (6 q + 1), f_3 = -22176 u⁵, f_4 = 110880 u⁴ / q, f_5 = -110880 u³ (1 + 3 q) / q³, u = 1 - q,
    f_6 = 332640 u² (1 + q)² / q⁵."""
    u, r, w, t = (
        _falling_factor(1.0 - q),
        (q[:-1], q[1:]),
        (6 * q[:-1] + 1, 6 * q[1:] + 1),
        (3 * q[:-1] + 1, 3 * q[1:] + 1),
    )
    u3, r2 = _times(u, u, u), _times(r, r)
    u5, u6, v = _times(u3, u, u), _times(u3, u3), _falling_factor(1.0 - q**2)
    return _isochoric(
        (
            (_times(u6, w, r, by=528.0), _times(u5, r2, r, by=-22176.0)),
            (_times(u6, w, by=528.0), _times(u5, r2, by=-22176.0), _times(u3, u, r2, r, by=110880.0)),
            (_times(u5, r, by=-22176.0), _times(u3, u, r2, by=110880.0), _times(u3, t, r2, by=-110880.0)),
            (
                _times(u5, by=-22176.0),
                _times(u3, u, r, by=110880.0),
                _times(u3, t, r, by=-110880.0),
                _times(v, v, r, by=332640.0),
            ),
        ),
        angles=COARSE,
    )


def _isochoric(orders: Orders, *, angles: int) -> Float:
    """(8, cells) bounds of N1 to N4 of strain and whole gradient."""
    bases = _strain_bases(angles)
    missed = np.cos(0.5 * np.pi / angles) ** 2 * np.cos(0.75 * np.pi / angles)
    strain, skew = [], []
    for coefficients, basis, skew_norm in zip(orders, bases, (_skew_1, _skew_2, _skew_3, _skew_4), strict=True):
        gram = np.einsum("kpi,lpi->klp", basis, basis)

        def strain_norm(c: Float, gram: Float = gram) -> Float:
            products = np.einsum("ck,cl->ckl", c, c).reshape(len(c), -1)
            squares = (products @ gram.reshape(products.shape[1], -1)).max(axis=1)
            longest: Float = np.sqrt(squares) / missed
            return longest

        strain.append(_norm_over(strain_norm, coefficients))
        skew.append(_norm_over(skew_norm, coefficients))
    return np.array([*strain, *(s + k for s, k in zip(strain, skew, strict=True))])


def _norm_over(norm: Callable[[Float], Float], coefficients: tuple[Enclosure, ...]) -> Float:
    """Bound of a (semi)norm over enclosed coefficients."""
    low, high = np.array([c[0] for c in coefficients]).T, np.array([c[1] for c in coefficients]).T
    middle, spread = 0.5 * (low + high), 0.5 * (high - low)
    bound: Float = norm(middle) + spread @ norm(np.eye(len(coefficients)))
    return bound


def _skew_1(c: Float) -> Float:
    """Half of |grad omega|."""
    return 0.5 * np.abs(5.0 * c[:, 0] + c[:, 1])


def _skew_2(c: Float) -> Float:
    """Half of the norm of the Hessian of omega: omega_1 = 5 f_2 + f_3 r², omega_2 r² = 7 f_3 r² + f_4 r⁴."""
    first, second = 5.0 * c[:, 0] + c[:, 1], 7.0 * c[:, 1] + c[:, 2]
    return 0.5 * np.maximum(np.abs(first), np.abs(first + second))


def _skew_3(c: Float) -> Float:
    """Half of the norm of the third derivative of omega: omega_2 r and omega_3 r³ = 9 f_4 r³ + f_5 r⁵."""
    second, third = 7.0 * c[:, 0] + c[:, 1], 9.0 * c[:, 1] + c[:, 2]
    return 0.5 * _cubic((second, second), (third, third))


def _skew_4(c: Float) -> Float:
    """Half of the norm of the fourth derivative of omega: max over s = c² in [0, 1] of |3 omega_2 + 6 omega_3 r² s +
    omega_4 r⁴ s²| / 2, with omega_4 = 11 f_5 + r² f_6: at an end or where the derivative vanishes."""
    second, third, fourth = 7.0 * c[:, 0] + c[:, 1], 9.0 * c[:, 1] + c[:, 2], 11.0 * c[:, 2] + c[:, 3]
    root = np.divide(-3.0 * third, fourth, out=np.zeros_like(third), where=fourth != 0.0)
    sizes = [np.abs(3.0 * second + 6.0 * third * s + fourth * s**2) for s in (0.0, 1.0, np.clip(root, 0.0, 1.0))]
    return 0.5 * np.asarray(np.max(sizes, axis=0), dtype=np.float64)


def _strain_bases(angles: int) -> tuple[Float, Float, Float, Float]:
    """Vectors whose combination by the coefficients is maximised in length, for N1 to N4: (k, directions, 3) each.

    At x = (1, 0, 0): e = (cos a, sin a, 0) and v all directions; mirror images and signs leave a in [0, pi/2] and the
    polar angles of v in [0, pi] and [0, pi/2].
    """
    step = 0.5 * np.pi / angles
    a, theta, phi = (
        g.ravel()
        for g in np.meshgrid(
            step * np.arange(angles + 1), step * np.arange(2 * angles + 1), step * np.arange(angles + 1), indexing="ij"
        )
    )
    x = np.zeros((a.size, 3))
    x[:, 0] = 1.0
    e = np.column_stack([np.cos(a), np.sin(a), np.zeros_like(a)])
    v = np.column_stack([np.cos(theta), np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)])
    X, Y, P = v[:, :1], e[:, :1], np.sum(v * e, axis=1, keepdims=True)
    first = np.array([x - 3.0 * X * v, X**2 * x - X * v])
    second = np.array(
        [
            e - 3.0 * P * v,
            (Y + 2.0 * P * X) * x + X**2 * e - (5.0 * X * Y + P) * v,
            X**2 * Y * x - X * Y * v,
        ]
    )
    third = np.array(
        [
            (1.0 + 2.0 * P**2) * x + (4.0 * P * X + 2.0 * Y) * e - (5.0 * X + 10.0 * P * Y) * v,
            (X**2 + Y**2 + 4.0 * P * X * Y) * x + 2.0 * X**2 * Y * e - (7.0 * X * Y**2 + X + 2.0 * P * Y) * v,
            X**2 * Y**2 * x - X * Y**2 * v,
        ]
    )
    fourth = np.array(
        [
            3.0 * (1.0 + 2.0 * P**2) * e - 15.0 * P * v,
            3.0 * (X**2 + Y**2 + 4.0 * P * X * Y) * e
            + (6.0 * P * X + 3.0 * Y + 6.0 * P**2 * Y) * x
            - (21.0 * P * Y**2 + 21.0 * X * Y + 3.0 * P) * v,
            (Y**3 + 3.0 * X**2 * Y + 6.0 * P * X * Y**2) * x
            + 3.0 * X**2 * Y**2 * e
            - (9.0 * X * Y**3 + 3.0 * P * Y**2 + 3.0 * X * Y) * v,
            X**2 * Y**3 * x - X * Y**3 * v,
        ]
    )
    return first, second, third, fourth
