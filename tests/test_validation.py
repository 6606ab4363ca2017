"""Validation losses against explicit refits, NumPy, SciPy and central differences."""

import itertools
from typing import Any, cast

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import multivariate_normal

import hamkernel as hk
from hamkernel._closed_forms import Partition, held_out
from hamkernel._solvers.factors import DenseSystem

EXACT = 1e-10  # condition of the systems, up to 1e4, times rounding
DIFFERENCES = 1e-5  # of central differences: their own error is below 1e-7
N, RIDGE = 15, 1e-3
STRUCTURES = {
    "separable": lambda k: hk.Separable(k),
    "symplectic": lambda k: hk.Symplectic(k),
    "odd symplectic": lambda k: hk.Odd(hk.Symplectic(k)),
}
SCATTERED = np.array([4, -1, 4, 9, 4, 9, -1, 9, 4, 4, 9, 4, 9, 4, 9])  # folds of 7, 2 and 6 points
FOLDS = {"equal": 5, "unequal": 4, "half": 2, "loo": "loo", "labels": SCATTERED}


def data(n: int = 2, count: int = N, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(count, n))
    return X, np.tanh(X[:, ::-1]) + 0.1 * rng.normal(size=(count, n))


def labels_of(folds, count: int = N) -> np.ndarray:
    """What `folds` means: consecutive points, as equal in number as possible, longer ones first."""
    if isinstance(folds, np.ndarray):
        return folds
    k = count if folds == "loo" else folds
    sizes = [count // k + (i < count % k) for i in range(k)]
    return np.repeat(np.arange(k), sizes)


def refits(K, X, Y, ridge: float, labels: np.ndarray) -> np.ndarray:
    """Held-out residuals of one fit per fold, each with `ridge` on the diagonal of its Gram."""
    G, n = regularised(K, X, 0.0), X.shape[1]
    residuals = np.empty(X.size)
    for label in np.unique(labels):
        out = np.repeat(labels == label, n)
        A = G[np.ix_(~out, ~out)] + ridge * np.eye(np.sum(~out))
        a = np.linalg.solve(A, Y.ravel()[~out])
        residuals[out] = Y.ravel()[out] - G[np.ix_(out, ~out)] @ a
    return residuals.reshape(Y.shape)


def mean_over_folds(residuals: np.ndarray, labels: np.ndarray) -> float:
    return float(np.mean([np.mean(residuals[labels == each] ** 2) for each in np.unique(labels)]))


def regularised(K, X, ridge: float) -> np.ndarray:
    return np.asarray(hk.gram(K, X)).reshape(X.size, X.size) + ridge * np.eye(X.size)


# The closed form.


@pytest.mark.few(3)
@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("folds", FOLDS)
@pytest.mark.parametrize("n", [2, 4])
def test_closed_form_is_explicit_refits_with_the_ridge_of_the_average_fold(structure, folds, n):
    X, Y = data(n)
    K = STRUCTURES[structure](hk.Gaussian(1.5))
    labels = labels_of(FOLDS[folds])
    count = len(np.unique(labels))
    expected = refits(K, X, Y, (N - N / count) * RIDGE, labels)
    residuals = hk.cross_validation_residuals(K, X, Y, RIDGE, FOLDS[folds])
    np.testing.assert_allclose(residuals, expected, atol=EXACT)
    loss = hk.cross_validation_loss(K, X, Y, RIDGE, FOLDS[folds])
    np.testing.assert_allclose(loss, mean_over_folds(expected, labels), rtol=EXACT)


def test_folds_of_very_different_sizes_are_refits_and_so_is_the_slope():
    X, Y = data(count=40)
    K = STRUCTURES["symplectic"](hk.Gaussian(1.5))
    labels = np.concatenate([np.full(20, 9), np.repeat([3, 5, 7], 5), [4, 4, 6, 8, 1]])
    labels = np.random.default_rng(1).permutation(labels)
    assert len(Partition(40, labels).groups) > 2  # worked on one after the other

    def expected(regularization):
        return mean_over_folds(refits(K, X, Y, (40 - 40 / 8) * regularization, labels), labels)

    loss, slope = jax.value_and_grad(hk.cross_validation_loss, 3)(K, X, Y, RIDGE, labels)
    np.testing.assert_allclose(loss, expected(RIDGE), rtol=EXACT)
    up, down = (expected(RIDGE * (1 + s * 1e-4)) for s in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / (2e-4 * RIDGE), rtol=DIFFERENCES)


def public_refits(K, X, Y, labels: np.ndarray) -> np.ndarray:
    """Held-out residuals of `fit`, whose ridge is λ times the number of points it is given."""
    residuals = np.empty_like(Y)
    for label in np.unique(labels):
        out = labels == label
        field = hk.fit(K, X[~out], Y[~out], RIDGE)
        residuals[out] = Y[out] - np.asarray(jax.vmap(field)(jnp.asarray(X[out])))
    return residuals


@pytest.mark.parametrize("folds", [3, "loo"])
def test_equal_folds_have_the_same_regularization_as_public_fits(folds):
    X, Y = data()
    K = STRUCTURES["symplectic"](hk.Gaussian(1.5))
    labels = labels_of(folds)
    residuals = public_refits(K, X, Y, labels)
    loss = hk.cross_validation_loss(K, X, Y, RIDGE, folds)
    np.testing.assert_allclose(loss, mean_over_folds(residuals, labels), rtol=EXACT)


def test_as_many_folds_as_points_leave_one_out():
    X, Y = data()
    K = STRUCTURES["symplectic"](hk.Gaussian(1.5))
    expected = refits(K, X, Y, (N - 1) * RIDGE, np.arange(N))
    for folds in (N, "loo", np.arange(N)):
        found = hk.cross_validation_residuals(K, X, Y, RIDGE, folds)
        np.testing.assert_allclose(found, expected, atol=EXACT)


def test_unequal_folds_do_not_have_the_ridge_of_each_training_set():
    # The negative control of the docstring's claim: N_train λ of each fold is another loss.
    X, Y = data()
    K = STRUCTURES["symplectic"](hk.Gaussian(1.5))
    residuals = np.empty_like(Y)
    for label in np.unique(SCATTERED):
        out = SCATTERED == label
        residuals[out] = refits(K, X, Y, np.sum(~out) * RIDGE, SCATTERED)[out]
    loss = hk.cross_validation_loss(K, X, Y, RIDGE, SCATTERED)
    assert abs(loss / mean_over_folds(residuals, SCATTERED) - 1) > 1e-4


def test_leaving_out_single_components_leaks_their_siblings():
    # The textbook formula rᵢ = aᵢ / Cᵢᵢ for each ROW keeps the other component of the point.
    rng = np.random.default_rng(3)
    X = rng.normal(size=(12, 2)) * 2
    Y = np.asarray(jax.vmap(hk.systems.Pendulum(mass=1.0))(jnp.asarray(X)))
    # A coupling that makes both components of f the same: the sibling gives the answer away.
    k = hk.Gaussian(1.0)
    K = hk.Separable(k) + hk.CurlFree(hk.Warp(k, lambda x: 3.0 * (x[:1] + x[1:])))
    y = np.broadcast_to(Y[:, :1], Y.shape)
    C = np.linalg.inv(regularised(K, X, len(X) * 1e-2))
    rows = ((C @ y.ravel()) / np.diag(C)).reshape(y.shape)
    ridge = (len(X) - 1) * 1e-2
    points = refits(K, X, y.copy(), ridge, np.arange(len(X)))
    assert np.mean(rows**2) < 0.5 * np.mean(points**2)
    loss = hk.cross_validation_loss(K, X, y, 1e-2, "loo")
    np.testing.assert_allclose(loss, np.mean(points**2), rtol=EXACT)


def test_loss_does_not_depend_on_the_order_of_points_that_keep_their_labels():
    X, Y = data()
    K = STRUCTURES["symplectic"](hk.Gaussian(1.5))
    order = np.random.default_rng(1).permutation(N)
    loss = hk.cross_validation_loss(K, X, Y, RIDGE, SCATTERED)
    moved = hk.cross_validation_loss(K, X[order], Y[order], RIDGE, SCATTERED[order])
    np.testing.assert_allclose(moved, loss, rtol=EXACT)
    # Numbers of folds mean consecutive points, so that there the order does matter.
    loss = hk.cross_validation_loss(K, X, Y, RIDGE, 3)
    moved = hk.cross_validation_loss(K, X[order], Y[order], RIDGE, 3)
    assert abs(moved / loss - 1) > 1e-3


# The other objectives.


@pytest.mark.few(3)
@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("n", [2, 4])
def test_generalized_cross_validation_is_its_definition(structure, n):
    X, Y = data(n)
    K = STRUCTURES[structure](hk.Gaussian(1.5))
    G = regularised(K, X, 0.0)
    S = G @ np.linalg.inv(G + N * RIDGE * np.eye(X.size))
    free = np.eye(X.size) - S
    expected = np.mean((free @ Y.ravel()) ** 2) / (np.trace(free) / X.size) ** 2
    loss = hk.generalized_cross_validation(K, X, Y, RIDGE)
    np.testing.assert_allclose(loss, expected, rtol=EXACT)


@pytest.mark.few(3)
@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("n", [2, 4])
def test_log_marginal_likelihood_is_the_density_of_scipy_with_noise_variance_n_lambda(structure, n):
    X, Y = data(n)
    K = STRUCTURES[structure](hk.Gaussian(1.5))
    normal = multivariate_normal(mean=np.zeros(X.size), cov=cast(Any, regularised(K, X, N * RIDGE)))
    value = hk.log_marginal_likelihood(K, X, Y, RIDGE)
    np.testing.assert_allclose(value, normal.logpdf(Y.ravel()), rtol=EXACT)


def test_losses_take_the_mean_and_the_solver_of_tune():
    X, Y = data()
    K = hk.Symplectic(hk.Gaussian(1.5))
    less = Y - np.column_stack([X[:, 1], -X[:, 0]])
    for loss, solver in (
        (hk.log_marginal_likelihood, hk.Nystrom(points=X)),  # all points: the Gram itself
        (hk.cross_validation_loss, hk.ConjugateGradient()),  # whose fit is exact
    ):
        found = loss(K, X, Y, RIDGE, mean=lambda x: jnp.array([x[1], -x[0]]), solver=solver)
        np.testing.assert_allclose(found, loss(K, X, less, RIDGE), rtol=1e-8)
    with pytest.raises(TypeError, match="solver must be an instance"):
        hk.generalized_cross_validation(K, X, Y, RIDGE, solver=cast(Any, hk.Nystrom))


# Derivatives, with respect to kernel and λ (in logarithms), X and Y.

OBJECTIVES = {
    **{
        f"cross-validation {name}": lambda K, X, Y, ridge, folds=folds: hk.cross_validation_loss(
            K, X, Y, ridge, folds
        )
        for name, folds in FOLDS.items()
    },
    "generalized cross-validation": hk.generalized_cross_validation,
    "log marginal likelihood": hk.log_marginal_likelihood,
}


# Folds of every kind are worked on by one formula, and these are in groups of two sizes.
FORMULAS = ["cross-validation unequal", *list(OBJECTIVES)[-2:]]
of_each_formula = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in FORMULAS else pytest.mark.slow) for name in OBJECTIVES],
)


def flat_objective(objective, K, X, Y):
    """u -> the objective, with u the leaves of K and log λ."""
    params, static = eqx.partition(K, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(params)

    def value(u):
        return objective(eqx.combine(unravel(u[:-1]), static), X, Y, jnp.exp(u[-1]))

    return jax.jit(value), jnp.append(flat, jnp.log(RIDGE))


def differences(value, u, h=1e-3):
    """Central differences of fourth order: error h⁴ and rounding / h, both below 1e-9."""
    slope = []
    for e in np.eye(len(u)):
        at = [float(value(u + c * h * e)) for c in (-2, -1, 1, 2)]
        slope.append((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h))
    return np.array(slope)


@of_each_formula
def test_gradient_over_hyperparameters_is_that_of_central_differences(name):
    X, Y = data(2)
    K = hk.Odd(hk.Symplectic(0.7 * hk.Gaussian(np.array([1.5, 0.8])) + hk.Matern(2.5, 2.0)))
    value, u = flat_objective(OBJECTIVES[name], K, X, Y)
    expected = differences(value, u)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(jax.grad(value)(u), expected, atol=DIFFERENCES * scale)


@of_each_formula
def test_gradient_over_data_is_that_of_central_differences(name):
    X, Y = data(2, seed=1)
    K = hk.Symplectic(hk.Gaussian(1.5))
    direction = jnp.asarray(np.random.default_rng(2).normal(size=(2, *X.shape)))

    def value(t):
        return OBJECTIVES[name](K, X + t[0] * direction[0], Y + t[0] * direction[1], RIDGE)

    expected = differences(value, jnp.zeros(1))
    np.testing.assert_allclose(jax.grad(value)(jnp.zeros(1)), expected, rtol=DIFFERENCES)


class Difference(eqx.Module):
    """A Gaussian less a wider one: not positive definite from some weight on."""

    weight: jax.Array

    def __call__(self, x, z):
        s = jnp.sum((x - z) ** 2)
        return jnp.exp(-s / 2) - self.weight * jnp.exp(-s / 18)


def edge(X) -> float:
    """The weight beyond which the regularised Gram of `Difference` has no Cholesky factor."""
    low, high = 0.0, 10.0
    for _ in range(50):
        middle = (low + high) / 2
        K = hk.Symplectic(Difference(jnp.asarray(middle)))
        smallest = np.linalg.eigvalsh(regularised(K, X, N * RIDGE))[0]
        low, high = (middle, high) if smallest > 0 else (low, middle)
    return low


@pytest.mark.few(1)
@pytest.mark.parametrize("name", FORMULAS)
def test_gradient_is_that_of_differences_right_before_the_factorisation_fails(name):
    # For folds the ridge is (N − N/F) λ; for the other two it is Nλ. Both factorise here.
    X, Y = data()
    weight = 0.98 * edge(X) * (0.9 if name.startswith("cross") else 1.0)
    K = hk.Symplectic(Difference(jnp.asarray(weight)))
    value, u = flat_objective(OBJECTIVES[name], K, X, Y)
    expected = differences(value, u, h=1e-4 * weight)
    assert np.all(np.isfinite(expected))
    np.testing.assert_allclose(jax.grad(value)(u), expected, rtol=DIFFERENCES)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["cross-validation labels", "cross-validation loo"])
def test_gradient_is_that_of_differences_where_points_coincide_and_the_ridge_is_small(name):
    X, Y = data()
    X[1] = X[0]
    X[2] = X[3] + 1e-9
    K = hk.Symplectic(hk.Gaussian(3.0))
    value, u = flat_objective(OBJECTIVES[name], K, X, Y)
    u = u.at[-1].set(np.log(1e-6))
    expected = differences(value, u)  # condition 1e6: rounding 1e-10 over a step of 1e-3
    np.testing.assert_allclose(jax.grad(value)(u), expected, rtol=DIFFERENCES)


# Failure.


@pytest.mark.few(1)
@of_each_formula
def test_value_is_infinite_and_its_gradient_zero_where_the_factorisation_fails(name):
    X, Y = data()
    worst = -jnp.inf if name == "log marginal likelihood" else jnp.inf
    K = hk.Symplectic(Difference(jnp.asarray(1.2 * edge(X))))
    value, u = flat_objective(OBJECTIVES[name], K, X, Y)
    with_slope = jax.jit(jax.value_and_grad(value))
    assert value(u) == with_slope(u)[0] == worst
    np.testing.assert_array_equal(with_slope(u)[1], 0.0)
    # Beside a point where it does not fail, in one batch.
    both = jnp.stack([u.at[0].set(0.0), u])
    values, slopes = jax.jit(jax.vmap(with_slope))(both)
    assert np.isfinite(values[0])
    assert values[1] == worst
    np.testing.assert_allclose(slopes[0], with_slope(both[0])[1], rtol=EXACT)
    np.testing.assert_array_equal(slopes[1], 0.0)


def test_residuals_are_infinite_where_the_factorisation_fails():
    X, Y = data()
    K = hk.Symplectic(Difference(jnp.asarray(1.2 * edge(X))))
    assert np.all(np.isposinf(hk.cross_validation_residuals(K, X, Y, RIDGE, SCATTERED)))


def test_nan_hyperparameters_give_infinity():
    X, Y = data()
    K = hk.Symplectic(Difference(jnp.asarray(jnp.nan)))
    assert hk.cross_validation_loss(K, X, Y, RIDGE) == jnp.inf
    assert hk.generalized_cross_validation(K, X, Y, RIDGE) == jnp.inf
    assert hk.log_marginal_likelihood(K, X, Y, RIDGE) == -jnp.inf


# Transformations.


@pytest.mark.few(1)
@of_each_formula
def test_objectives_map_over_hyperparameters(name):
    X, Y = data()

    def value(lengthscale, ridge):
        return OBJECTIVES[name](hk.Symplectic(hk.Gaussian(lengthscale)), X, Y, ridge)

    lengthscales, ridges = jnp.array([0.5, 1.0, 2.0]), jnp.array([1e-3, 1e-2, 1e-1])
    expected = [value(*pair) for pair in zip(lengthscales, ridges, strict=True)]
    np.testing.assert_allclose(jax.vmap(value)(lengthscales, ridges), expected, rtol=EXACT)
    grid = jax.vmap(jax.vmap(value, (None, 0)), (0, None))(lengthscales, ridges)
    np.testing.assert_allclose(np.diag(grid), expected, rtol=EXACT)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", OBJECTIVES)
def test_new_values_do_not_recompile(name):
    traced = []

    def kernel(x, z, log_lengthscale):
        traced.append(name)
        return jnp.exp(-jnp.sum((x - z) ** 2) * jnp.exp(-2 * log_lengthscale) / 2)

    def value(log_lengthscale, ridge, seed):
        k = jax.tree_util.Partial(kernel, log_lengthscale=jnp.asarray(log_lengthscale))
        folds_again = OBJECTIVES[name]
        return folds_again(hk.Symplectic(k), *data(seed=seed), ridge)

    first = value(0.0, 1e-3, 0)
    count = len(traced)
    assert count > 0
    assert value(0.5, 1e-2, 1) != first
    assert len(traced) == count


def test_labels_equal_in_value_do_not_recompile_and_others_do():
    traced = []

    def kernel(x, z, c):
        traced.append(0)
        return c * jnp.exp(-jnp.sum((x - z) ** 2) / 2)

    K = hk.Symplectic(jax.tree_util.Partial(kernel, c=jnp.asarray(1.0)))
    hk.cross_validation_loss(K, *data(), RIDGE, SCATTERED)
    count = len(traced)
    for same in (SCATTERED.copy(), 3 * SCATTERED - 7):  # and in order, whatever they are called
        hk.cross_validation_loss(K, *data(), RIDGE, same)
        assert len(traced) == count
    hk.cross_validation_loss(K, *data(), RIDGE, SCATTERED[::-1])
    assert len(traced) > count


ONE_LONG = np.append(np.zeros(240, int), 1 + np.arange(160) // 10)  # and sixteen short runs


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize(
    "folds", [5, "loo", np.arange(400) % 7, ONE_LONG], ids=["5", "loo", "labels", "one long"]
)
def test_loss_and_its_gradient_take_the_memory_of_three_grams(folds):
    X, Y = data(4, count=400)
    K = hk.Odd(hk.Symplectic(hk.Gaussian(np.ones(4))))

    def loss(K, ridge):
        return hk.cross_validation_loss(K, X, Y, ridge, folds)

    gram = 8 * X.size**2
    small = 0.3 * gram  # data, residuals, scratch space, and the blocks of five folds
    for function in (loss, jax.grad(loss, argnums=(0, 1))):
        analysis = jax.jit(function).lower(K, jnp.asarray(RIDGE)).compile().memory_analysis()
        assert analysis is not None
        assert gram < analysis.temp_size_in_bytes <= 3 * gram + small


@pytest.mark.slow
def test_many_hyperparameters_do_not_take_the_memory_of_many_grams():
    X, Y = data(16, count=100)
    k = hk.Gaussian(np.ones(16))

    def loss(K):
        return hk.log_marginal_likelihood(K, X, Y, RIDGE)

    analysis = jax.jit(jax.grad(loss)).lower(hk.Symplectic(k + k + k)).compile().memory_analysis()
    assert analysis is not None
    gram = 8 * X.size**2
    assert gram < analysis.temp_size_in_bytes < 3.1 * gram  # 48 directions, a few at a time


def test_every_lapack_call_of_a_loss_and_its_gradient_waits_for_the_one_before():
    # Side by side they were seen to stall for ever, see `_solvers/factors.py`.
    partition = Partition(N, SCATTERED)
    assert len(partition.groups) == 2

    def loss_and_gradient(A, y):
        r, pull = jax.vjp(lambda A, y: held_out(DenseSystem(A), y, partition)[0], A, y)  # pyright: ignore
        return r, pull(r)

    program = jax.make_jaxpr(loss_and_gradient)(jnp.eye(N), jnp.ones(N)).jaxpr
    upstream, calls = {}, []  # the calls that each variable depends on
    for i, equation in enumerate(program.eqns):
        variables = [v for v in equation.invars if isinstance(v, jax.extend.core.Var)]
        before = set().union(*(upstream.get(v, set()) for v in variables))
        if "cholesky" in str(equation) or "triangular_solve" in str(equation):
            calls.append((i, before))
            before = before | {i}
        upstream |= dict.fromkeys(equation.outvars, before)
    # The factor, three solves of two calls each, the inverse of its block; then of each group a
    # factor and two solves.
    assert len(calls) == 8 + 2 * 3
    assert all(one in before for (one, _), (_, before) in itertools.pairwise(calls))


@pytest.mark.few(1)
@of_each_formula
def test_float32_data_gives_float32_losses(name):
    X, Y = (each.astype(np.float32) for each in data())
    K, objective = hk.Symplectic(hk.Gaussian(1.5)), OBJECTIVES[name]
    value = objective(K, X, Y, 1e-2)
    assert value.dtype == jnp.float32
    expected = objective(K, X.astype(float), Y.astype(float), 1e-2)
    np.testing.assert_allclose(value, expected, rtol=1e-3)  # condition 1e3 times 6e-8, squared


def test_loss_works_under_jit_with_labels_closed_over():
    X, Y = data()
    K = hk.Symplectic(hk.Gaussian(1.5))
    compiled = jax.jit(lambda K, X, Y, r: hk.cross_validation_loss(K, X, Y, r, SCATTERED))
    expected = hk.cross_validation_loss(K, X, Y, RIDGE, SCATTERED)
    np.testing.assert_allclose(compiled(K, X, Y, RIDGE), expected, rtol=EXACT)


# Refusals.


@pytest.mark.parametrize(
    ("folds", "message"),
    [
        (1, "between 2 and the number of points, 15; got 1"),
        (16, "between 2 and the number of points"),
        (-3, "between 2 and the number of points"),
        ("trajectory", "a number, 'loo' or labels; got 'trajectory'"),
        (2.0, r"whole number, 'loo', or one label for each point; got 2\.0"),
        (np.full(N, 2.0), "in one"),
        (np.array(N * ["north"]), "in one"),
        (np.full(N, 3), "in one"),
        (np.arange(N - 1), r"shape \(14,\)"),
        (np.zeros((N, 2), int), r"shape \(15, 2\)"),
    ],
)
def test_bad_folds_are_refused(folds, message):
    K = hk.Symplectic(hk.Gaussian(1.5))
    with pytest.raises(ValueError, match=message):
        hk.cross_validation_loss(K, *data(), RIDGE, folds)


def test_traced_labels_are_refused():
    K = hk.Symplectic(hk.Gaussian(1.5))
    with pytest.raises(TypeError, match="must be concrete"):
        jax.jit(lambda folds: hk.cross_validation_loss(K, *data(), RIDGE, folds))(SCATTERED)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_bad_kernels_data_and_ridges_are_refused(name):
    objective, (X, Y) = OBJECTIVES[name], data()
    K = hk.Symplectic(hk.Gaussian(1.5))
    with pytest.raises(TypeError, match="matrix-valued"):
        objective(hk.Gaussian(1.5), X, Y, RIDGE)
    with pytest.raises(ValueError, match="shape"):
        objective(K, X, Y[:-1], RIDGE)
    with pytest.raises(ValueError, match="positive"):
        objective(K, X, Y, -RIDGE)
    with pytest.raises(ValueError, match=r"odd|even"):
        objective(K, X[:, :1], Y[:, :1], RIDGE)


@pytest.mark.parametrize("count", [pytest.param(240, marks=pytest.mark.slow), 243])
def test_the_gradient_over_many_strips_of_the_gram_is_that_of_differences(count):
    # Strips of 60 points, and of 243 three that are left.
    rng = np.random.default_rng(0)
    X, Y = rng.uniform(-3, 3, size=(count, 2)), rng.normal(size=(count, 2))

    @jax.jit
    def loss(t):
        k = hk.Gaussian(jnp.exp(t) * jnp.array([1.0, 1.5]))
        return hk.log_marginal_likelihood(hk.Symplectic(k), X, Y, 1e-3)

    h = 1e-5
    difference = (loss(0.1 + h) - loss(0.1 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(loss)(0.1), difference, rtol=1e-6)
