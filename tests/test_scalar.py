"""Scalar kernels against their formulas, their derivatives where a point meets itself."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from kernels import BY_NAME, CASES, difference_mixed, fourth_power, mixed, slope

import hamkernel as hk
from hamkernel._kernels.base import Invariance, ScalarProduct, ScalarSum

ROUNDING = 1e-12  # a few operations in float64, for values of order one
DIFFERENCES = 1e-8  # what sixth-order differences of a formula leave
EVERY = pytest.mark.parametrize("case", CASES, ids=str)
BUILTIN = pytest.mark.parametrize("case", [c for c in CASES if c.builtin], ids=str)


def clouds(n, N=4, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(N, n)), rng.normal(size=(N, n))


def as_structures_take_it(k):
    """The scalar kernel that a structure makes of any callable."""
    return hk.Symplectic(k).kernel


def mixed_block(k, x, z):
    return jax.jacfwd(jax.grad(k, argnums=0), argnums=1)(x, z)


@eqx.filter_jit
def mixed_blocks(k, X, Z):
    return jax.vmap(functools.partial(mixed_block, k))(X, Z)


# Values and derivatives.


@pytest.mark.parametrize("n", [2, 6])
@EVERY
def test_value_is_the_formula(case, n):
    k, formula = case.make(n), case.formula(n)
    for x, z in zip(*clouds(n), strict=True):
        np.testing.assert_allclose(
            k(jnp.asarray(x), jnp.asarray(z)), formula(x, z), rtol=ROUNDING, atol=ROUNDING
        )


@EVERY
def test_mixed_derivative_is_exact_apart_and_at_coincident_points(case):
    n = 4
    X, Z = clouds(n)
    X, Z = np.concatenate([X, X]), np.concatenate([Z, X])
    expected = np.stack([mixed(case, x, z) for x, z in zip(X, Z, strict=True)])
    tolerance = DIFFERENCES if case.mixed is None else ROUNDING
    np.testing.assert_allclose(
        mixed_blocks(case.make(n), X, Z), expected, atol=tolerance * np.abs(expected).max()
    )


@pytest.mark.parametrize("case", [c for c in CASES if c.mixed], ids=str)
def test_closed_forms_of_this_suite_agree_with_differences(case):
    x, z = (points[0] for points in clouds(4))
    np.testing.assert_allclose(
        mixed(case, x, z), difference_mixed(case.formula(4), x, z), atol=DIFFERENCES * 100
    )


def jump_at_coincidence(k, n=4, step=1e-6):
    """‖M(x, x + h) − M(x, x)‖ relative to ‖M(x, x)‖, the worst of several x and directions."""
    X, directions = clouds(n)
    here, near = mixed_blocks(k, X, X), mixed_blocks(k, X, X + step * directions)
    return float(jnp.max(jnp.abs(near - here)) / jnp.max(jnp.abs(here)))


@EVERY
def test_mixed_derivative_at_coincident_points_is_the_limit_from_neighbours(case):
    # Linear in the step for Matérn-3/2, the roughest: some 1e-6 times the inverse lengthscale.
    assert jump_at_coincidence(case.make(4)) < 1e-4


def distance(x, z):
    """The usual 'double where', right for first derivatives only."""
    s = (x - z) @ (x - z)
    return jnp.where(s > 0, jnp.sqrt(jnp.where(s > 0, s, 1.0)), 0.0)


def repaired_matern52(x, z):
    r = 5**0.5 * distance(x, z)
    return (1 + r + r**2 / 3) * jnp.exp(-r)


def plain_matern52(x, z):
    r = 5**0.5 * jnp.sqrt((x - z) @ (x - z))
    return (1 + r + r**2 / 3) * jnp.exp(-r)


def test_a_kernel_of_the_distance_fails_the_same_checks():
    X, Z = clouds(4)
    ours = hk.Matern(2.5, 1.0)
    for theirs in (repaired_matern52, plain_matern52):
        np.testing.assert_allclose(mixed_blocks(theirs, X, Z), mixed_blocks(ours, X, Z), atol=1e-12)
        assert not jump_at_coincidence(theirs) < 0.1  # NaN for the plain square root


@pytest.mark.few(8)
@pytest.mark.parametrize("case", [c for c in CASES if c.smoothness >= 1], ids=str)
def test_third_derivatives_at_coincident_points_are_the_limit_from_neighbours(case):
    k = as_structures_take_it(case.make(4))
    X, directions = clouds(4, N=2)

    @jax.jit
    def third(X, Z):
        return jax.vmap(jax.jacfwd(functools.partial(mixed_block, k)))(X, Z)

    here, near = third(X, X), third(X, X + 1e-6 * directions)
    assert jnp.isfinite(here).all()
    # Linear in the step for Matérn-5/2; blocks are of order one.
    np.testing.assert_allclose(near, here, atol=1e-4 * max(1.0, float(jnp.abs(here).max())))
    if case.stationary:  # an odd derivative of an even function
        np.testing.assert_allclose(here, 0.0, atol=ROUNDING)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "case", [c for c in CASES if c.name not in ("function", "lambda")], ids=str
)
def test_gradient_in_the_hyperparameters_at_coincident_points(case):
    k = as_structures_take_it(case.make(4))
    trained, static = eqx.partition(k, eqx.is_inexact_array)
    theta, unravel = ravel_pytree(trained)
    X, weights = clouds(4, N=1)
    weights = np.outer(weights[0], X[0])

    @jax.jit
    def total(theta):
        k = eqx.combine(unravel(theta), static)
        return jnp.sum(weights * mixed_block(k, X[0], X[0]))

    step, basis = 1e-5, np.eye(theta.size)
    expected = [(total(theta + step * e) - total(theta - step * e)) / (2 * step) for e in basis]
    # Central differences: step² in the truncation, 1e-16 / step in the rounding.
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(jax.grad(total)(theta), expected, atol=1e-8 * scale)


# Algebra.

GAUSSIAN, POLYNOMIAL, MATERN = hk.Gaussian(0.9), hk.Polynomial(2, 0.6), hk.Matern(1.5, 1.4)


@pytest.mark.parametrize(
    ("combined", "expected"),
    [
        (GAUSSIAN + POLYNOMIAL, lambda g, p, m: g + p),
        (GAUSSIAN * POLYNOMIAL, lambda g, p, m: g * p),
        (GAUSSIAN * POLYNOMIAL + MATERN, lambda g, p, m: g * p + m),
        (GAUSSIAN * (POLYNOMIAL + MATERN), lambda g, p, m: g * (p + m)),
        (GAUSSIAN + POLYNOMIAL * MATERN, lambda g, p, m: g + p * m),
        ((GAUSSIAN + POLYNOMIAL) * (MATERN + GAUSSIAN), lambda g, p, m: (g + p) * (m + g)),
        (sum([GAUSSIAN, POLYNOMIAL, MATERN]), lambda g, p, m: g + p + m),
        (3.0 * GAUSSIAN, lambda g, p, m: 3 * g),
        (GAUSSIAN * 3, lambda g, p, m: 3 * g),
        (np.float64(3) * GAUSSIAN, lambda g, p, m: 3 * g),
        (jnp.array(3.0) * GAUSSIAN, lambda g, p, m: 3 * g),
        (2.0 * (3.0 * GAUSSIAN) * POLYNOMIAL, lambda g, p, m: 6 * g * p),
        (GAUSSIAN + POLYNOMIAL.__call__, lambda g, p, m: g + p),
        ((lambda x, z: x @ z) + GAUSSIAN, lambda g, p, m: math.sqrt(p) - 0.6 + g),
        ((lambda x, z: POLYNOMIAL(x, z)) * GAUSSIAN, lambda g, p, m: p * g),
    ],
)
def test_algebra_is_pointwise(combined, expected):
    x, z = jnp.array([0.3, -1.0]), jnp.array([0.8, -0.1])
    numbers = (float(k(x, z)) for k in (GAUSSIAN, POLYNOMIAL, MATERN))
    np.testing.assert_allclose(combined(x, z), expected(*numbers), rtol=ROUNDING)


def test_sums_and_products_do_not_nest():
    total, product = GAUSSIAN + POLYNOMIAL + (MATERN + GAUSSIAN), GAUSSIAN * POLYNOMIAL * MATERN
    assert isinstance(total, ScalarSum)
    assert isinstance(product, ScalarProduct)
    assert (len(total.terms), len(product.terms)) == (4, 3)


@pytest.mark.parametrize(
    "combine",
    [
        lambda: GAUSSIAN + 1.0,
        lambda: 1.0 + GAUSSIAN,
        lambda: GAUSSIAN + hk.Gaussian,
        lambda: GAUSSIAN + hk.Symplectic(GAUSSIAN),
        lambda: GAUSSIAN * hk.Symplectic(GAUSSIAN),
    ],
)
def test_what_is_no_kernel_is_not_added(combine):
    with pytest.raises(TypeError):
        combine()


# What a kernel says of itself.


@BUILTIN
def test_declared_invariance_holds(case):
    k = case.make(4)
    X, Z = clouds(4)
    X, Z = jnp.asarray(X), jnp.asarray(Z)
    values = jax.vmap(k)(X, Z)
    if Invariance.REFLECTION in k.invariance:
        np.testing.assert_allclose(jax.vmap(k)(-X, -Z), values, rtol=ROUNDING)
    if Invariance.TRANSLATION in k.invariance:
        np.testing.assert_allclose(jax.vmap(k)(X + 0.7, Z + 0.7), values, rtol=ROUNDING)


@EVERY
def test_invariance_is_declared_exactly_where_it_is_known(case):
    declared = as_structures_take_it(case.make(4)).invariance
    assert (Invariance.REFLECTION in declared) == case.reflective
    assert (Invariance.TRANSLATION in declared) == case.stationary
    # The formulas agree: a kernel outside the list above would be caught, or is a user's.
    x, z = (points[0] for points in clouds(4))
    formula = case.formula(4)
    mirrored = np.isclose(formula(-x, -z), formula(x, z), rtol=1e-9)
    shifted = np.isclose(formula(x + 0.7, z + 0.7), formula(x, z), rtol=1e-9)
    assert mirrored == (case.reflective or case.name in ("function", "lambda"))
    assert shifted == case.stationary


# Hyperparameters.


@pytest.mark.parametrize(
    ("kernel", "name", "given"),
    [
        (hk.Gaussian(2.0), "lengthscale", 2.0),
        (hk.Gaussian(np.array([1.0, 3.0])), "lengthscale", [1.0, 3.0]),
        (hk.Gaussian(2), "lengthscale", 2.0),
        (hk.Matern(2.5, 2.0), "lengthscale", 2.0),
        (hk.RationalQuadratic(0.7, 2.0), "alpha", 0.7),
        (hk.RationalQuadratic(0.7, 2.0), "lengthscale", 2.0),
        (hk.Polynomial(3, 0.4), "offset", 0.4),
        (hk.Periodic(3.0, 0.4), "period", 3.0),
        (hk.Periodic(np.array([3.0, 2.0]), 0.4), "period", [3.0, 2.0]),
        (hk.Periodic(3.0, 0.4), "lengthscale", 0.4),
        (2.5 * hk.Gaussian(), "scale", 2.5),
    ],
)
def test_a_positive_hyperparameter_is_stored_as_its_logarithm(kernel, name, given):
    np.testing.assert_allclose(getattr(kernel, name), given, rtol=ROUNDING)
    np.testing.assert_allclose(getattr(kernel, f"log_{name}"), np.log(given), rtol=ROUNDING)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("gaussian", 1),
        ("gaussian_ard", 4),
        ("matern2.5", 1),
        ("rational_quadratic", 2),
        ("polynomial", 1),
        ("periodic", 2),
        ("sum", 3),
        ("scaled_product", 3),
        ("warp", 1),
        ("select", 2),
        ("function", 0),
        ("lambda", 0),
        ("partial", 4),
        ("module", 12 * 4 + 12),
    ],
)
def test_every_number_of_a_kernel_is_a_trainable_leaf(name, count):
    K = hk.Odd(hk.Symplectic(BY_NAME[name].make(4)))
    leaves = jax.tree.leaves(eqx.filter(K, eqx.is_inexact_array))
    assert sum(leaf.size for leaf in leaves) == count


def test_arrays_bound_by_a_partial_are_the_leaves_of_the_kernel():
    w = jnp.asarray(slope(2))
    for partial in (functools.partial, jax.tree_util.Partial):
        k = as_structures_take_it(partial(BY_NAME["partial"].make(2).func, w))
        (leaf,) = jax.tree.leaves(k)
        np.testing.assert_array_equal(leaf, w)


def test_what_else_a_partial_binds_stays_static():
    def power(w, x, z, *, degree, offset):
        return (jnp.sum(w * x * z) + offset) ** degree

    # A traced degree could not be a Python exponent; an array among the keywords is a leaf.
    k = as_structures_take_it(functools.partial(power, np.ones(2), degree=3, offset=jnp.array(0.5)))
    assert len(jax.tree.leaves(k)) == 2
    x, z = jnp.array([0.3, -1.0]), jnp.array([0.8, -0.1])
    np.testing.assert_allclose(jax.jit(lambda k: k(x, z))(k), 0.84**3, rtol=ROUNDING)


def test_arrays_of_the_map_of_a_warp_are_leaves():
    linear = functools.partial(jnp.matmul, jnp.diag(jnp.array([1.0, 2.0])))
    warped = hk.Warp(hk.Gaussian(1.0), linear)
    assert len(jax.tree.leaves(warped)) == 2
    x, z = jnp.array([0.3, -1.0]), jnp.array([0.8, -0.1])
    np.testing.assert_allclose(warped(x, z), hk.Gaussian(np.array([1.0, 0.5]))(x, z), rtol=ROUNDING)


@BUILTIN
def test_leaves_are_unconstrained_reals(case):
    X = clouds(2, N=6)[0]
    arrays, static = eqx.partition(case.make(2), eqx.is_inexact_array)
    for value in (-1.5, 0.7, 1.5):
        k = eqx.combine(jax.tree.map(lambda leaf, v=value: jnp.full_like(leaf, v), arrays), static)
        G = jax.vmap(jax.vmap(k, (None, 0)), (0, None))(X, X)
        assert jnp.linalg.eigvalsh(G).min() > -1e-10 * jnp.trace(G)
        assert jnp.isfinite(G).all()


@pytest.mark.few(7)
@BUILTIN
def test_float32_points_give_float32_values_and_derivatives(case):
    k = case.make(4)
    X, Z = (points.astype(np.float32) for points in clouds(4))
    assert {leaf.dtype for leaf in jax.tree.leaves(k)} == {jnp.dtype("float64")}
    value, block = k(jnp.asarray(X[0]), jnp.asarray(Z[0])), mixed_blocks(k, X, Z)
    assert value.dtype == block.dtype == jnp.float32
    expected = mixed_blocks(k, X.astype(float), Z.astype(float))
    # 1e-7 from the rounding, times the condition of the expression (fourth powers of ~5).
    np.testing.assert_allclose(block, expected, atol=1e-5 * float(jnp.abs(expected).max()))


class Wide(eqx.Module):
    """A kernel of the user with a parameter in float64, which is more than the data may have."""

    ell: jax.Array

    def __call__(self, x, z):
        return jnp.exp(-((x - z) @ (x - z)) / self.ell**2)

    def scaled(self, x):
        return x / self.ell


@pytest.mark.parametrize("make", [lambda k: k, lambda k: hk.Warp(hk.Gaussian(), k.scaled)])
def test_a_users_parameters_do_not_widen_the_data(make):
    K = hk.Symplectic(make(Wide(jnp.asarray(np.float64(1.3)))))
    X, Y = (points.astype(np.float32) for points in clouds(2))
    with jax.numpy_dtype_promotion("standard"):  # the kernel mixes dtypes itself
        assert hk.gram(K, X).dtype == jnp.float32
        with pytest.warns(UserWarning, match="fitting in float32"):
            values = hk.fit(K, X, Y, 1e-2).evaluate(X)
        expected = hk.fit(K, X.astype(float), Y.astype(float), 1e-2).evaluate(X)
    np.testing.assert_allclose(values, expected, atol=1e-3)


@pytest.mark.few(4)
@BUILTIN
def test_integer_points_are_read_as_floats(case):
    # In their own dtype the hyperparameters would be cut to integers.
    k, x, z = case.make(2), jnp.array([1, 2]), jnp.array([0, 3])
    expected = case.formula(2)(np.array([1.0, 2.0]), np.array([0.0, 3.0]))
    np.testing.assert_allclose(k(x, z), expected, rtol=1e-12)
    K = hk.Symplectic(k)
    np.testing.assert_array_equal(K(x, z), K(x.astype(float), z.astype(float)))


# Refusals.


@pytest.mark.parametrize("nu", [1.5, 9.5, 20.5])
def test_matern_is_zero_far_away_and_not_nan(nu):
    far = jnp.asarray([0.0, 3e3, 1e10, 1e19], jnp.float32)
    k = hk.Matern(nu)
    values, slopes = jax.vmap(jax.value_and_grad(lambda r: k(jnp.zeros(1, r.dtype), r[None])))(far)
    np.testing.assert_array_equal(values, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(slopes, np.zeros(4))


def test_a_heavy_tail_is_finite_where_rounding_makes_a_square_negative():
    k = hk.RationalQuadratic(alpha=1e-3, lengthscale=0.01)
    X = np.random.default_rng(0).normal(size=(30, 2)).astype(np.float32)
    assert np.isfinite(hk.gram(hk.Odd(hk.Symplectic(k)), X)).all()


def test_matern_one_half_is_refused_with_the_reason():
    with pytest.raises(ValueError, match=r"not differentiable at x = z.*nu=1\.5"):
        hk.Matern(0.5)


@pytest.mark.parametrize("nu", [2.0, 0.0, -1.5, 2.4999, float("nan"), float("inf")])
def test_matern_needs_half_integers(nu):
    with pytest.raises(ValueError, match=r"needs nu = 1\.5, 2\.5"):
        hk.Matern(nu)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf"), [1.0, -1.0]])
@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("lengthscale", hk.Gaussian),
        ("lengthscale", lambda bad: hk.Matern(2.5, bad)),
        ("lengthscale", lambda bad: hk.RationalQuadratic(1.0, bad)),
        ("lengthscale", lambda bad: hk.Periodic(1.0, bad)),
        ("period", lambda bad: hk.Periodic(bad)),
    ],
)
def test_hyperparameters_must_be_positive(name, make, bad):
    with pytest.raises(ValueError, match=f"{name} must be positive and finite, got"):
        make(bad if isinstance(bad, float) else np.array(bad))


@pytest.mark.parametrize(
    ("make", "error", "match"),
    [
        (lambda: hk.RationalQuadratic(alpha=0.0), ValueError, "alpha must be positive"),
        (lambda: hk.RationalQuadratic(alpha=np.ones(2)), ValueError, "alpha has shape"),
        (lambda: hk.Polynomial(offset=0.0), ValueError, "offset must be positive"),
        (lambda: hk.Polynomial(degree=0), ValueError, "degree must be a whole number"),
        (lambda: hk.Polynomial(degree=2.5), TypeError, r"whole number, at least 1; got 2\.5"),  # pyright: ignore
        (lambda: -1.0 * hk.Gaussian(), ValueError, r"scale of a kernel must be .* got -1\.0"),
        (lambda: hk.Gaussian(np.ones((2, 2))), ValueError, r"number or a vector \(n,\)"),
        (
            lambda: hk.Periodic(np.ones((2, 2))),
            ValueError,
            r"period .* a number or a vector \(n,\)",
        ),
        (lambda: hk.Gaussian(1j), TypeError, "real numbers are needed"),
        (lambda: hk.Select(hk.Gaussian(), ()), ValueError, "distinct coordinates"),
        (lambda: hk.Select(hk.Gaussian(), (0, 0)), ValueError, "distinct coordinates"),
        (
            lambda: hk.Select(hk.Gaussian(), -1),
            ValueError,
            r"integers >= 0 such as \(2, 3\); got -1",
        ),
        (lambda: hk.Select(hk.Gaussian(), (0.5,)), ValueError, r"integers >= 0.*got \(0\.5,\)"),
        (
            lambda: hk.Select(hk.Gaussian(), "q"),
            ValueError,
            r"distinct coordinates, integers .* got 'q'",
        ),
        (lambda: hk.Select((0,), hk.Gaussian()), TypeError, "scalar kernel is needed"),
        (lambda: hk.Select(3, 0), TypeError, "scalar kernel is needed"),
        (lambda: hk.Warp(hk.Gaussian(), 3), TypeError, "got 3 as map"),  # pyright: ignore
        (lambda: hk.Warp(jnp.sin, hk.Gaussian()), TypeError, "a kernel and then a map"),  # pyright: ignore
        (lambda: hk.Warp(hk.Gaussian, jnp.sin), TypeError, r"hk\.Gaussian\(lengthscale=1\.0\)"),
    ],
)
def test_constructors_refuse(make, error, match):
    with pytest.raises(error, match=match):
        make()


@pytest.mark.parametrize("dims", [1, np.int64(1), (1,), np.array([1])])
def test_select_takes_one_coordinate_or_several(dims):
    x, z = jnp.array([0.3, -1.0]), jnp.array([0.8, -0.1])
    np.testing.assert_allclose(
        hk.Select(hk.Gaussian(), dims)(x, z), math.exp(-(0.9**2) / 2), rtol=ROUNDING
    )


def test_select_keeps_the_order_of_its_coordinates():
    x, z = jnp.array([0.3, -1.0, 0.5]), jnp.array([0.8, -0.1, 0.4])
    k = hk.Gaussian(np.array([1.0, 2.0]))
    expected = math.exp(-(0.1**2 + 0.25**2) / 2)
    np.testing.assert_allclose(hk.Select(k, (2, 0))(x, z), expected, rtol=ROUNDING)
    expected = math.exp(-(0.9**2 + 0.25**2) / 2)
    np.testing.assert_allclose(hk.Select(k, (1, 0))(x, z), expected, rtol=ROUNDING)


def test_select_beyond_the_last_coordinate_is_refused():
    with pytest.raises(ValueError, match=r"coordinates \(0, 2\) and the point has 2"):
        hk.Select(hk.Gaussian(), (0, 2))(jnp.zeros(2), jnp.ones(2))


def test_a_warp_must_return_a_vector():
    with pytest.raises(ValueError, match=r"returned shape \(\).*a vector \(m,\) is needed"):
        hk.Warp(hk.Gaussian(), lambda x: x[0])(jnp.zeros(2), jnp.ones(2))


def test_a_warp_into_complex_numbers_is_refused():
    warped = hk.Warp(hk.Gaussian(), lambda x: jnp.exp(1j * x))
    with (
        jax.numpy_dtype_promotion("standard"),
        pytest.raises(
            TypeError, match=r"map of Warp has dtype complex128; real numbers are needed"
        ),
    ):
        warped(jnp.zeros(2), jnp.ones(2))


def test_a_warp_may_return_a_list_of_numbers():
    x, z = jnp.array([0.3, 1.0]), jnp.array([-0.2, 0.5])
    listed = hk.Warp(hk.Gaussian(), lambda x: [jnp.cos(x[0]), x[1]])
    assert listed(x, z) == hk.Warp(hk.Gaussian(), lambda x: jnp.array([jnp.cos(x[0]), x[1]]))(x, z)


def test_lengthscales_must_match_the_coordinates():
    with pytest.raises(ValueError, match=r"3 lengthscales and the point has shape \(2,\)"):
        hk.Gaussian(np.ones(3))(jnp.zeros(2), jnp.ones(2))


def test_a_negative_lengthscale_fails_under_jit_too():
    @eqx.filter_jit
    def value(lengthscale):
        return hk.Gaussian(lengthscale)(jnp.zeros(2), jnp.ones(2))

    np.testing.assert_allclose(value(jnp.array(1.0)), math.exp(-1), rtol=ROUNDING)
    with pytest.raises(RuntimeError, match="lengthscale must be positive and finite"):
        value(jnp.array(-1.0)).block_until_ready()


def test_a_user_kernel_of_more_than_a_scalar_is_refused():
    k = as_structures_take_it(lambda x, z: x * z)
    with pytest.raises(ValueError, match=r"<lambda> returned an array of shape \(2,\).*one pair"):
        k(jnp.zeros(2), jnp.ones(2))


def test_a_user_kernel_is_wrapped_without_change():
    x, z = jnp.array([0.3, -1.0]), jnp.array([0.8, -0.1])
    np.testing.assert_array_equal(as_structures_take_it(fourth_power)(x, z), fourth_power(x, z))
