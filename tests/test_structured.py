"""Structured kernels: the structure holds to rounding, and does not hold without the kernel."""

import functools
import re
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import BY_NAME, CASES, canonical, difference_mixed, mixed

import hamkernel as hk
from hamkernel._kernels.base import Invariance
from hamkernel._structures.structure import AbstractPotentialKernel

STRUCTURE = 1e-9  # relative; what sums of a few dozen rounded terms leave of an exact zero
ROUNDING = 1e-12
DIFFERENCES = 1e-8  # what sixth-order differences of a formula leave
# A structure is B(x) around the derivatives that test_scalar.py pins for every kernel, so one
# kernel of each making will do in n = 4, and two in n = 2 and 6. The slow tests run them all.
SOME = ("gaussian_ard", "partial")
MOST = {case.name for case in CASES} - {"gaussian", "matern3.5", "rational_quadratic", "lambda"}


def slow_unless(quick):
    return [] if quick else [pytest.mark.slow]


EVERYWHERE = pytest.mark.parametrize(
    ("case", "n"),
    [
        pytest.param(
            case,
            n,
            id=f"{case}-{n}",
            marks=slow_unless(case.name in SOME or (n == 4 and case.name in MOST)),
        )
        for case in CASES
        for n in (2, 4, 6)
    ],
)
EVERY = pytest.mark.parametrize(
    "case",
    [pytest.param(c, id=c.name, marks=slow_unless(c.name in MOST)) for c in CASES],
)
BARE = BY_NAME["partial"]  # no invariance at all


def odd_symplectic(k):
    return hk.Odd(hk.Symplectic(k))


def even_curl_free(k):
    return hk.Even(hk.CurlFree(k))


def random_field(K, n, seed=0, M=4):
    """Any coefficients at all: the structure is a property of the kernel, not of a fit."""
    rng = np.random.default_rng(seed)
    Z, A = jnp.asarray(rng.normal(size=(2, M, n)))
    zero = jnp.zeros(())
    return hk.KernelField(
        kernel=K,
        points=Z,
        coefficients=A,
        residual=jnp.zeros_like(A),
        norm=zero,
        regularization=zero,
        offset=zero,
    )


def states(n, seed=1, N=3):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, n)))


@jax.jit
def _observe(field, X):
    def observe(x):
        try:
            slope = jax.grad(field.potential)(x)
        except AttributeError:  # the structure has none
            slope = None
        return {"f": field(x), "mirrored": field(-x), "Df": jax.jacfwd(field)(x), "slope": slope}

    return jax.vmap(observe)(X)


def observed(field, X):
    """f(x), f(−x), Df(x) and the slope of the potential, in one program."""
    return jax.tree.map(np.asarray, _observe(field, X))


@functools.cache
def seen(structure, case, n):
    return observed(random_field(structure(case.make(n)), n), states(n))


@jax.jit
def mirrored(field, X):
    """f(x) and f(−x)."""
    return jax.vmap(field)(X), jax.vmap(field)(-X)


def asymmetry(A):
    """Largest entry of A − Aᵀ, relative to the largest of A."""
    return np.abs(A - np.swapaxes(A, -1, -2)).max() / np.abs(A).max()


def divergence(A):
    return np.abs(np.trace(A, axis1=-2, axis2=-1)).max() / np.abs(A).max()


def jacobian(structure, case, n):
    return seen(structure, case, n)["Df"]


def assert_close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, atol=STRUCTURE * np.abs(theirs).max())


# The structure.


@pytest.mark.few(4)
@EVERYWHERE
def test_symplectic_fields_are_hamiltonian(case, n):
    Df = jacobian(hk.Symplectic, case, n)
    assert asymmetry(canonical(n).T @ Df) < STRUCTURE
    assert divergence(Df) < STRUCTURE


@pytest.mark.few(6)
@EVERYWHERE
def test_curl_free_fields_have_a_symmetric_jacobian(case, n):
    assert asymmetry(jacobian(hk.CurlFree, case, n)) < STRUCTURE


@pytest.mark.few(6)
@EVERYWHERE
def test_divergence_free_fields_have_no_divergence(case, n):
    assert divergence(jacobian(hk.DivergenceFree, case, n)) < STRUCTURE


@pytest.mark.parametrize("case", [BY_NAME[name] for name in (*SOME, "module")], ids=str)
def test_odd_dimensions_are_allowed_where_the_structure_allows_them(case):
    assert asymmetry(jacobian(hk.CurlFree, case, 3)) < STRUCTURE
    assert divergence(jacobian(hk.DivergenceFree, case, 3)) < STRUCTURE


@pytest.mark.few(1)
@pytest.mark.parametrize("n", [2, 4, 6])
def test_other_structures_fail_the_same_checks(n):
    separable, symplectic = (jacobian(K, BARE, n) for K in (hk.Separable, hk.Symplectic))
    curl_free, solenoidal = (jacobian(K, BARE, n) for K in (hk.CurlFree, hk.DivergenceFree))
    J = canonical(n)
    for Df in (separable, curl_free) + ((solenoidal,) if n > 2 else ()):
        assert asymmetry(J.T @ Df) > 1e-2
    for Df in (separable, symplectic, solenoidal):
        assert asymmetry(Df) > 1e-2
    for Df in (separable, curl_free):
        assert divergence(Df) > 1e-2


@pytest.mark.few(2)
@EVERYWHERE
def test_odd_symplectic_fields_are_odd_and_hamiltonian(case, n):
    field = seen(odd_symplectic, case, n)
    assert_close(field["mirrored"], -field["f"])
    assert_close(field["f"], field["slope"] @ canonical(n).T)
    assert asymmetry(canonical(n).T @ field["Df"]) < STRUCTURE


@pytest.mark.few(5)
@EVERY
def test_even_curl_free_fields_are_even_gradients(case):
    field = seen(even_curl_free, case, 4)
    assert_close(field["mirrored"], field["f"])
    assert_close(field["f"], field["slope"])
    assert asymmetry(field["Df"]) < STRUCTURE


ANY_STRUCTURE = [
    hk.Separable,
    hk.CurlFree,
    hk.Symplectic,
    hk.DivergenceFree,
    lambda k: hk.CurlFree(k) + hk.DivergenceFree(2.0 * hk.Gaussian(0.8)),
]
STRUCTURE_NAMES = ["Separable", "CurlFree", "Symplectic", "DivergenceFree", "Sum"]


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["partial", "select"])
@pytest.mark.parametrize("structure", ANY_STRUCTURE, ids=STRUCTURE_NAMES)
def test_every_structure_can_be_made_odd_or_even(structure, name):
    K = structure(BY_NAME[name].make(2))
    for parity, sign in ((hk.Odd, -1), (hk.Even, 1)):
        here, there = mirrored(random_field(parity(K), 2), states(2))
        np.testing.assert_allclose(there, sign * here, atol=STRUCTURE * np.abs(here).max())
    here, there = mirrored(random_field(K, 2), states(2))
    for sign in (-1, 1):  # the plain kernel has neither symmetry
        assert np.abs(there - sign * here).max() > 1e-2 * np.abs(here).max()


def test_odd_fields_have_even_potentials_and_even_fields_odd_ones():
    k = BARE.make(4)
    for parity, sign in ((hk.Odd, 1), (hk.Even, -1)):
        H = random_field(parity(hk.Symplectic(k)), 4).hamiltonian
        for x in states(4):
            np.testing.assert_allclose(H(-x), sign * H(x), rtol=STRUCTURE)


@pytest.mark.few(6)
@EVERYWHERE
def test_the_field_is_the_gradient_of_its_own_potential(case, n):
    field = seen(hk.Symplectic, case, n)
    assert_close(field["f"], field["slope"] @ canonical(n).T)


# The blocks.


def gaussian_curl_free(d, sigma):
    """The paper's G_c(d), eq. (curl_free_kernel_from_gaussian)."""
    return np.exp(-d @ d / (2 * sigma**2)) * (np.eye(len(d)) - np.outer(d, d) / sigma**2) / sigma**2


def block_structures(k):
    plain = hk.Separable(k), hk.CurlFree(k), hk.Symplectic(k), hk.DivergenceFree(k)
    return (*plain, odd_symplectic(k), even_curl_free(k))


@jax.jit
def all_blocks(kernels, x, z):
    return [K(x, z) for K in kernels]


@pytest.mark.parametrize("n", [2, 4])
def test_gaussian_blocks_are_the_papers(n):
    sigma, J = 1.3, canonical(n)
    kernels = block_structures(hk.Gaussian(sigma))
    for x, z in [*zip(states(n), states(n, seed=2), strict=True), (states(n)[0], states(n)[0])]:
        d, s = np.asarray(x - z), np.asarray(x + z)
        curl_free, mirror = gaussian_curl_free(d, sigma), gaussian_curl_free(s, sigma)
        # The paper prints (x − z)ᵀ(x − z) where its derivation has the outer product.
        odd = (curl_free - mirror) / 2
        expected = [
            np.exp(-d @ d / (2 * sigma**2)) * np.eye(n),
            curl_free,
            J @ curl_free @ J.T,
            np.trace(curl_free) * np.eye(n) - curl_free,
            J @ odd @ J.T,
            (curl_free + mirror) / 2,
        ]
        np.testing.assert_allclose(all_blocks(kernels, x, z), expected, atol=ROUNDING)


@pytest.mark.few(6)
@EVERY
def test_blocks_are_b_times_the_mixed_derivative_times_b_transposed(case):
    n = 4
    x, z = states(n)[0], states(n, seed=2)[0]
    ours = all_blocks(block_structures(case.make(n)), x, z)
    x, z = np.asarray(x), np.asarray(z)
    M, J = mixed(case, x, z), canonical(n)
    theirs = [
        case.formula(n)(x, z) * np.eye(n),
        M,
        J @ M @ J.T,
        np.trace(M) * np.eye(n) - M.T,
    ]
    tolerance = ROUNDING if case.mixed else DIFFERENCES
    for block, expected in zip(ours[:4], theirs, strict=True):
        np.testing.assert_allclose(block, expected, atol=tolerance * max(1.0, np.abs(M).max()))


@pytest.mark.few(4)
@EVERY
def test_blocks_of_swapped_points_are_transposed(case):
    x, z = states(4)[0], states(4, seed=2)[0]
    kernels = block_structures(case.make(4))
    here, there = all_blocks(kernels, x, z), all_blocks(kernels, z, x)
    for block, swapped in zip(here, there, strict=True):
        np.testing.assert_allclose(block, swapped.T, atol=ROUNDING * np.abs(block).max())


@jax.jit
def blocks_of_the_profile(K, x, z):
    """K(x, z) and −∇∇ᵀg(x − z) with g(d) = k(d, 0)."""
    return K(x, z), -jax.hessian(lambda d: K.kernel(d, jnp.zeros_like(d)))(x - z)


@pytest.mark.parametrize("case", [c for c in CASES if c.stationary], ids=str)
def test_for_shift_invariant_kernels_the_block_is_minus_the_hessian_of_the_profile(case):
    n = 4
    k, x, z = case.make(n), states(n)[0], states(n, seed=2)[0]
    np.testing.assert_allclose(*blocks_of_the_profile(hk.CurlFree(k), x, z), atol=ROUNDING)


def test_for_other_kernels_it_is_not():
    x, z = states(2)[:2]
    for name in ("polynomial", "partial"):
        k = BY_NAME[name].make(2)
        ours, stationary = blocks_of_the_profile(hk.CurlFree(k), x, z)
        assert np.abs(ours - stationary).max() > 1e-2


def test_parity_of_a_kernel_without_invariance_is_the_mean_over_both_arguments():
    k, n = BARE.formula(2), 2

    def even(x, z):
        return (k(x, z) + k(-x, z) + k(x, -z) + k(-x, -z)) / 4

    x, z = states(n)[:2]
    expected = difference_mixed(even, np.asarray(x), np.asarray(z))
    K = hk.Odd(hk.CurlFree(BARE.make(n)))  # an odd gradient has an even potential
    np.testing.assert_allclose(K(x, z), expected, atol=DIFFERENCES)


@pytest.mark.parametrize("name", ["gaussian_ard", "polynomial", "partial"])
def test_in_the_plane_divergence_free_is_symplectic(name):
    k, J = BY_NAME[name].make(2), canonical(2)
    x, z = states(2)[:2]
    kernels = hk.CurlFree(k), hk.DivergenceFree(k), hk.Symplectic(k)
    M, *blocks = all_blocks(kernels, x, z)
    for block in blocks:
        np.testing.assert_allclose(block, J @ M @ J.T, rtol=ROUNDING, atol=ROUNDING)
    # Not in higher dimensions, where there are more divergence-free than Hamiltonian fields.
    x, z = states(4)[:2]
    k = BY_NAME[name].make(4)
    solenoidal, hamiltonian = all_blocks((hk.DivergenceFree(k), hk.Symplectic(k)), x, z)
    assert np.abs(solenoidal - hamiltonian).max() > 1e-3


@pytest.mark.few(6)
@pytest.mark.parametrize("name", ["matern2.5", "partial"])
@pytest.mark.parametrize(
    "structure",
    [*ANY_STRUCTURE, odd_symplectic, lambda k: hk.Even(hk.DivergenceFree(k))],
    ids=[*STRUCTURE_NAMES, "Odd", "Even"],
)
def test_the_field_is_the_sum_of_its_blocks(structure, name):
    n = 4
    field = random_field(structure(BY_NAME[name].make(n)), n)
    K, Z, A = field.kernel, field.points, field.coefficients
    x = states(n)[0]
    blocks = jnp.stack([all_blocks([K], x, z)[0] for z in Z])
    expected = np.einsum("jab,jb->a", blocks, A)
    np.testing.assert_allclose(field(x), expected, atol=ROUNDING * np.abs(expected).max() * 10)


def test_the_hamiltonian_of_a_gaussian_field_is_the_papers():
    sigma, n = 1.3, 4
    field = random_field(hk.Symplectic(hk.Gaussian(sigma)), n)
    x = np.asarray(states(n)[0])
    # H(x) = −Σ ∇g(x − xᵢ)·cᵢ with cᵢ = Jᵀaᵢ, eq. (learned_hamiltonian).
    d = x - np.asarray(field.points)
    slopes = -d / sigma**2 * np.exp(-np.sum(d**2, axis=1) / (2 * sigma**2))[:, None]
    expected = -np.sum(slopes * (np.asarray(field.coefficients) @ canonical(n)))
    np.testing.assert_allclose(field.hamiltonian(jnp.asarray(x)), expected, rtol=ROUNDING)


# Sums.


def test_what_is_odd_already_stays_as_it_is():
    k = BARE.make(4)
    for once in (odd_symplectic(k), odd_symplectic(2.0 * hk.Gaussian() + hk.Select(k, (0, 1)))):
        assert eqx.tree_equal(hk.Odd(once), once)


class Growing(AbstractPotentialKernel):
    """B(x) = (1 + x₀²) J, the same at −x."""

    operator_invariance: ClassVar[Invariance] = Invariance.REFLECTION
    symplectic: ClassVar[bool] = False

    def apply(self, x, v):
        return self.factor(x) * hk.Symplectic(self.kernel).apply(x, v)

    def apply_transpose(self, x, v):
        return self.factor(x) * hk.Symplectic(self.kernel).apply_transpose(x, v)

    def factor(self, x):
        return 1 + x[0] ** 2


class Skew(AbstractPotentialKernel):
    """B(x) = exp(x₀) I."""

    operator_invariance: ClassVar[Invariance] = Invariance.NONE
    symplectic: ClassVar[bool] = False

    def apply(self, x, v):
        return jnp.exp(x[0]) * v

    def apply_transpose(self, x, v):
        return self.apply(x, v)


@pytest.mark.few(1)
@pytest.mark.parametrize("parity", [None, hk.Odd], ids=["bare", "odd"])
def test_an_operator_may_depend_on_the_state(parity):
    rng = np.random.default_rng(0)
    X, Y = 1 + rng.normal(size=(2, 5, 2))
    K, J = Growing(hk.Gaussian(1.3)), hk.Symplectic(hk.Gaussian(1.3))
    if parity is not None:
        K, J = parity(K), parity(J)
    factor = 1 + X[:, 0] ** 2
    expected = factor[:, None, None, None] * hk.gram(J, X) * factor[None, None, :, None]
    np.testing.assert_allclose(hk.gram(K, X), expected, rtol=1e-9, atol=1e-12)
    field = hk.fit(K, X, Y, 1e-2)
    sums = np.einsum("iajb,jb->ia", expected, field.coefficients)
    np.testing.assert_allclose(jax.vmap(field)(X), sums, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(field.evaluate(X), sums, rtol=1e-9, atol=1e-12)


def named_sum():
    k = BARE.make(4)
    return hk.Sum(conservative=hk.Symplectic(k), rest=hk.Separable(hk.Gaussian(0.7)))


def test_parts_add_up_to_the_field():
    field, x = random_field(named_sum(), 4), states(4)[0]
    parts = [field.part(0), field.part("rest")]
    np.testing.assert_allclose(sum(part(x) for part in parts), field(x), rtol=ROUNDING)
    np.testing.assert_array_equal(field.part("conservative")(x), parts[0](x))
    np.testing.assert_array_equal(field.part(-1)(x), parts[1](x))
    assert np.abs(parts[1](x)).max() > 1e-3


def test_a_sum_keeps_the_structure_of_each_part_and_only_that():
    field = random_field(named_sum(), 4)
    J, X = canonical(4), states(4)
    assert asymmetry(J.T @ observed(field.part("conservative"), X)["Df"]) < STRUCTURE
    assert asymmetry(J.T @ observed(field, X)["Df"]) > 1e-2


def test_sums_are_flat_and_keep_names():
    K = named_sum() + hk.CurlFree(hk.Gaussian())
    assert isinstance(K, hk.Sum)
    assert K.names == ("conservative", "rest", None)
    assert isinstance(K.part(2), hk.CurlFree)
    assert isinstance(K.part("rest"), hk.Separable)
    total = sum([hk.CurlFree(hk.Gaussian()), hk.Separable(hk.Gaussian())])
    assert isinstance(total, hk.Sum)
    assert len(total.terms) == 2
    odd = hk.Odd(K)
    assert isinstance(odd, hk.Sum)
    assert odd.names == K.names


@pytest.mark.slow
def test_friction_is_found_where_it_cannot_be_taken_for_energy():
    mass, length, gravity, damping = 0.3, 0.5, 9.81, 0.05
    k = hk.Gaussian(1.0)
    energy, odd = hk.Symplectic(k), hk.Odd(hk.CurlFree(hk.Select(k, 1)))
    unique, ambiguous = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        q, p = rng.uniform((-2.5, -0.8), (2.5, 0.8), size=(150, 2)).T
        force = -mass * gravity * length * np.sin(q) - damping * p
        Y = np.stack([p / (mass * length**2), force], axis=1) + 1e-3 * rng.normal(size=(150, 2))
        for errors, friction in ((unique, odd), (ambiguous, hk.CurlFree(k))):
            K = hk.Sum(energy=energy, friction=friction)
            field = hk.fit(K, np.stack([q, p], axis=1), Y, 1e-8)
            at = jnp.array([[0.0, 0.5], [1.0, 0.5], [2.0, 0.5], [1.0, -0.5]])
            found = field.part("friction").evaluate(at)[:, 1]
            errors.append(np.abs(found / (-damping * at[:, 1]) - 1).max())
    assert max(unique) < 0.03  # 0.002 to 0.018 measured
    assert min(ambiguous) > 10  # 50 to 80


def test_the_potential_of_a_sum_of_one_structure_is_the_sum_of_potentials():
    K = hk.Symplectic(hk.Gaussian(1.2)) + hk.Symplectic(hk.Polynomial(3))
    field, x = random_field(K, 4), states(4)[0]
    expected = field.part(0).hamiltonian(x) + field.part(1).hamiltonian(x)
    np.testing.assert_allclose(field.hamiltonian(jnp.asarray(x)), expected, rtol=ROUNDING)


def test_a_missing_part_is_refused_with_the_choices():
    field = random_field(named_sum(), 4)
    for which in ("friction", 2, -3, 0.5, None):
        with pytest.raises(KeyError, match=r"positions 0 to 1 and the names \['conservative',"):
            field.part(which)  # pyright: ignore[reportArgumentType]
    second = field.part(np.int64(-1))  # pyright: ignore[reportArgumentType]
    assert eqx.tree_equal(second, field.part(1))
    alone = random_field(hk.CurlFree(hk.Gaussian()), 2)
    assert alone.part(0) is alone
    with pytest.raises(KeyError, match="CurlFree is not a sum"):
        alone.part(1)


# Refusals.


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: hk.Symplectic(hk.Gaussian), TypeError, r"write, for example, hk\.Gaussian"),
        (lambda: hk.Symplectic(3.0), TypeError, r"callable \(x, z\) -> scalar; got 3\.0"),
        (lambda: hk.CurlFree(hk.CurlFree(hk.Gaussian())), TypeError, "matrix-valued CurlFree"),
        (lambda: hk.Odd(hk.Gaussian()), TypeError, re.escape("Odd(Symplectic(k))")),  # pyright: ignore
        (lambda: hk.Even(lambda x, z: x @ z), TypeError, re.escape("Even(Symplectic(k))")),  # pyright: ignore
        (lambda: hk.Odd(hk.Symplectic), TypeError, "such as hk.Symplectic"),  # pyright: ignore
        (lambda: hk.Odd(even_curl_free(hk.Gaussian())), ValueError, "no fields but zero"),
        (lambda: hk.Odd(Skew(hk.Gaussian())), TypeError, "fields of Skew cannot be odd or even"),
        (lambda: hk.Sum(hk.Gaussian()), TypeError, "a term of a Sum must be a matrix"),  # pyright: ignore
        (lambda: hk.Sum(), ValueError, "at least one kernel"),
        (
            lambda: hk.Sum(regularization=hk.Symplectic(hk.Gaussian())),
            ValueError,
            "called regularization",
        ),
        (
            lambda: named_sum() + named_sum(),
            ValueError,
            r"distinct names, got \['conservative', 'rest', 'conservative', 'rest'\]",
        ),
        (lambda: hk.Symplectic(hk.Gaussian()) + 1.0, TypeError, "unsupported operand"),
    ],
)
def test_constructors_refuse(make, error, match):
    with pytest.raises(error, match=match):
        make()


def test_structures_refuse_dimensions_they_cannot_have():
    for K in (hk.Symplectic(hk.Gaussian()), named_sum(), odd_symplectic(hk.Gaussian())):
        with pytest.raises(ValueError, match=r"even dimension, got n = 3\. Add the missing"):
            K(jnp.zeros(3), jnp.ones(3))
    with pytest.raises(ValueError, match="n >= 2, got n = 1"):
        hk.DivergenceFree(hk.Gaussian())(jnp.zeros(1), jnp.ones(1))
    for n in (1, 2, 3):
        for structure in (hk.CurlFree, hk.Separable):
            assert structure(hk.Gaussian())(jnp.zeros(n), jnp.ones(n)).shape == (n, n)


def test_a_block_needs_two_points_of_one_space():
    K = hk.Symplectic(hk.Gaussian())
    with pytest.raises(ValueError, match=r"shape \(4, 2\).*one pair of points.*jax\.vmap"):
        K(jnp.zeros((4, 2)), jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match="X has 2 coordinates and Z has 4"):
        K(jnp.zeros(2), jnp.zeros(4))


def test_a_number_is_no_term_of_a_sum_of_structures():
    K = hk.CurlFree(hk.Gaussian())
    assert (0 + K) is K  # as the built-in sum begins
    with pytest.raises(TypeError):
        _ = 3 + K  # pyright: ignore[reportOperatorIssue]
