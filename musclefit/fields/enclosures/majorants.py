r"""Proved bounds of a kernel's derivatives as functions of distance, as tables; it knows neither kernels nor centres.

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

from collections.abc import Callable

import numpy as np

from musclefit.geometry.arrays import Float, frozen

CELLS = 1024
"""Cells of a table over the distance."""

ROUNDING = 1.0 + 1e-9
"""Every tabulated bound is enlarged by this, far more than its own rounding."""

FINE, COARSE = 32, 10
"""Grid angles per quarter turn: for constants, and for every cell of a table."""

Enclosed = tuple[Float, Float]
"""Lower and upper ends."""


Chain = tuple[Enclosed, Enclosed, Enclosed, Enclosed, Enclosed]
"""Enclosures of f_1, f_1 r, f_2 r, f_2 r², f_3 r³ on every cell."""


def constants(n1: float, n2: float, n3: float, n4: float) -> Float:
    """The table of a homogeneous scalar kernel, whose strain and whole gradient have the same sups: one column.

    Each is to be multiplied by the power of the distance that has the unit's dimension; 0 where there is none.
    """
    return frozen(np.array([n1, n2, n3, n4, n1, n2, n3, n4])[:, None] * ROUNDING)


def isochoric_constants(f2: float, f3: float, f4: float, f5: float, f6: float) -> Float:
    """The table of a homogeneous isochoric kernel from the chain of its potential at unit distance: one column."""
    a, b, c, d, e = (_exactly(value) for value in (f2, f3, f4, f5, f6))
    orders = ((a, b), (a, b, c), (b, c, d), (b, c, d, e))
    return frozen(isochoric_norms(orders, angles=FINE) * ROUNDING)


def falling_constants(norms: Float) -> Float:
    """One column of the largest of (8, cells) bounds."""
    return frozen(norms.max(axis=1, keepdims=True) * ROUNDING)


def falling_table(norms: Float, *, tail: tuple[float, ...] = (0.0,) * 8) -> Float:
    """(8, cells + 1) falling majorants from bounds (8, cells) on every cell and those from the extent to infinity."""
    return frozen(_falling(norms, tail) * ROUNDING)


def scalar_table(
    chain: Callable[[Float], Chain], *, extent: float, tail: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Float:
    """The table of a scalar kernel with a length of its own.

    Parameters
    ----------
    chain : callable
        Takes the (cells + 1,) edges of the cells, distances in units of the kernel's scale; encloses f_1, f_1 r, f_2 r,
        f_2 r² and f_3 r³ on every cell.
    extent : float
        Where the cells end.
    tail : (float, float, float)
        N1, N2, N3 from there on; 0 of a kernel that ends there.
    """
    f1, f1_r, f2_r, f2_rr, f3_rrr = chain(np.linspace(0.0, extent, CELLS + 1))
    n1, n2, n3 = _size(f1_r), np.maximum(_size(f1), _size(_sum(f1, f2_rr))), _cubic(f2_r, f3_rrr)
    unused = np.zeros_like(n1)
    return falling_table(np.array([n1, n2, n3, unused, n1, n2, n3, unused]), tail=(*tail, 0.0) * 2)


def falling_factor(values: Float) -> Enclosed:
    """Enclosure on every cell of a function of distance that falls and is not negative, from its values at edges."""
    return values[1:], values[:-1]


def times(*factors: Enclosed, by: float = 1.0) -> Enclosed:
    """Product of enclosures that are not negative, and a number."""
    low, high = np.prod([f[0] for f in factors], axis=0), np.prod([f[1] for f in factors], axis=0)
    return (by * low, by * high) if by >= 0.0 else (by * high, by * low)


def _sum(a: Enclosed, b: Enclosed) -> Enclosed:
    return a[0] + b[0], a[1] + b[1]


def _size(a: Enclosed) -> Float:
    return np.maximum(np.abs(a[0]), np.abs(a[1]))


def _exactly(value: float) -> Enclosed:
    return np.array([value]), np.array([value])


def _cubic(f2_r: Enclosed, f3_rrr: Enclosed) -> Float:
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


Orders = tuple[tuple[Enclosed, ...], ...]
"""Enclosures of (f_2 r, f_3 r³), (f_2, f_3 r², f_4 r⁴), (f_3 r, f_4 r³, f_5 r⁵) and (f_3, f_4 r², f_5 r⁴, f_6 r⁶): all
that N1 to N4 depend on."""


def isochoric_norms(orders: Orders, *, angles: int = COARSE) -> Float:
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


def _norm_over(norm: Callable[[Float], Float], coefficients: tuple[Enclosed, ...]) -> Float:
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
    """Half of the norm of the fourth derivative of omega.

    The max over s = c² in [0, 1] of |3 omega_2 + 6 omega_3 r² s + omega_4 r⁴ s²| / 2, with omega_4 = 11 f_5 + r² f_6:
    at an end or where the derivative vanishes.
    """
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
