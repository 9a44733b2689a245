"""A kernel from outside: one record, and fields, fits and proofs know it."""

from __future__ import annotations

import numpy as np
import pytest

from musclefit.certify.maps import certify_map
from musclefit.compiling import fingerprint, njit
from musclefit.errors import FieldError
from musclefit.fields.enclosures.majorants import Chain, falling_factor, scalar_table, times
from musclefit.fields.enclosures.source_terms import PROOF, tabulated_terms
from musclefit.fields.evaluation.radial_sums import INNER
from musclefit.fields.kernels import KERNELS, kernel_named, register
from musclefit.fields.kernels.model import Enclosure, RadialKernel
from musclefit.fields.radial import RadialBackend
from musclefit.geometry.arrays import Float
from musclefit.vocabulary import Claim, StepKind

# phi = (1 + q²)^(-1), the inverse quadratic: f_1 = -2 f², f_2 = 8 f³, f_3 = -48 f⁴ with f = 1 / (1 + q²).


@njit(**INNER)
def _formula(scale, r2):
    s = 1.0 / scale
    f = 1.0 / (1.0 + r2 * s * s)
    return f, -2.0 * s * s * f * f


@njit(**PROOF)
def _derivatives(q):
    f = 1.0 / (1.0 + q * q)
    return -2.0 * f * f, 8.0 * f * f * f, 2.0 * q * f * f, 2.0 * f * f + 8.0 * q * q * f * f * f


@njit(**PROOF)
def _value(scale, r):
    q = r / scale
    return 1.0 / (1.0 + q * q), 0.0, 1.0


def _chain(q: Float) -> Chain:
    f, r = 1.0 / (1.0 + q**2), (q[:-1], q[1:])
    f2, f3, f4 = falling_factor(f**2), falling_factor(f**3), falling_factor(f**4)
    return (
        times(f2, by=-2.0),
        times(f2, r, by=-2.0),
        times(f3, r, by=8.0),
        times(f3, r, r, by=8.0),
        times(f4, r, r, r, by=-48.0),
    )


EXTENT = 16.0
TAIL = (2.0 * 16.0 / 257.0**2, 10.0 / 257.0**2, 72.0 / 257.0**2)  # |f_1| q, |f_1| + f_2 q² and more fall from there on

KERNEL = RadialKernel(
    "inverse-quadratic",
    _formula,
    scaled=True,
    enclosure=Enclosure(
        table=lambda: scalar_table(_chain, extent=EXTENT, tail=TAIL),
        terms=tabulated_terms(_derivatives, ends=False, compact=False),
        values=_value,
        extent=EXTENT,
    ),
)

HANDLES = np.array([[x, y, z] for x in (0.0, 30.0) for y in (0.0, 30.0) for z in (0.0, 30.0)])


@pytest.fixture(autouse=True)
def _registered():
    register(KERNEL)
    register(KERNEL)  # once more is no second kernel
    yield
    from musclefit.fields.kernels import registry

    del registry._known[KERNEL.name]


def test_a_field_of_its_own_kernel_meets_its_handles_and_has_its_derivative():
    moved = np.random.default_rng(3).normal(size=HANDLES.shape)
    field = RadialBackend(KERNEL.name, scale=25.0).fit(HANDLES, moved)
    np.testing.assert_allclose(field.displacement(HANDLES), moved, atol=1e-12)
    points, step = np.random.default_rng(4).uniform(-10.0, 40.0, (50, 3)), 1e-4
    ahead, behind = (
        np.stack([field.displacement(points + side * step * axis) for axis in np.eye(3)], axis=2) for side in (1, -1)
    )
    np.testing.assert_allclose(field.gradient(points), (ahead - behind) / (2.0 * step), atol=1e-7)


def test_its_bounds_hold_at_dense_samples():
    field = RadialBackend(KERNEL.name, scale=25.0).fit(HANDLES, np.random.default_rng(5).normal(size=HANDLES.shape))
    rng = np.random.default_rng(6)
    for width in (0.01, 1.0, 6.0):
        centres = rng.uniform(-60.0, 90.0, (200, 3))
        half = np.full_like(centres, width)
        middle, radius = field.gradient_bounds(centres, half)
        ranges, _ = field.strain_bounds(centres, half, enough=(np.inf, -np.inf))
        for _ in range(30):
            found = field.gradient(centres + half * rng.uniform(-1.0, 1.0, centres.shape))
            assert (np.linalg.norm(found - middle, 2, axis=(1, 2)) <= radius).all()
            values = np.linalg.eigvalsh(0.5 * (found + found.transpose(0, 2, 1)))
            assert (values[:, 0] >= ranges[:, 0]).all()
            assert (values[:, -1] <= ranges[:, 1]).all()


def test_its_steps_are_certified_or_refuted():
    backend = RadialBackend(KERNEL.name, scale=25.0)
    calm = backend.fit(HANDLES, np.random.default_rng(7).normal(size=HANDLES.shape))
    assert certify_map([(StepKind.EXPLICIT, calm)], HANDLES).claim is Claim.CERTIFIED
    swapped = HANDLES.copy()
    swapped[:, 0] = 30.0 - swapped[:, 0]
    wild = backend.fit(HANDLES, swapped - HANDLES)
    assert certify_map([(StepKind.EXPLICIT, wild)], HANDLES).claim is Claim.REFUTED


def test_without_bounds_nothing_is_proved_and_the_reason_is_told():
    bare = RadialKernel("bare-quadratic", _formula, scaled=True)
    with pytest.raises(FieldError, match=r"^kernel 'bare-quadratic' comes without bounds .* give it an Enclosure"):
        bare.proved()


def test_names_are_unique_and_unknown_ones_are_told():
    with pytest.raises(FieldError, match=r"^a kernel is named 'r3' already; give this one another name"):
        register(RadialKernel("r3", _formula))
    with pytest.raises(FieldError, match=r"^no kernel is named 'r4'; there are: r, r2logr, r3, gaussian, "):
        kernel_named("r4")


def test_every_kernel_of_ours_can_be_proved():
    assert all(kernel.enclosure is not None for kernel in KERNELS.values())


def test_compiled_sums_of_two_formulas_are_told_apart_in_every_process():
    """The cache on disk knows a closure by what is in it."""

    def made(inner):
        @njit()
        def outer(q):
            return inner(1.0, q)

        return outer

    first, second = made(_formula), made(_value)
    assert fingerprint(first) == fingerprint(made(_formula))
    assert fingerprint(first) != fingerprint(second)
    assert fingerprint(_formula) != fingerprint(_value)
