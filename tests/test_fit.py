"""`fit` against closed forms solved by NumPy, its derivatives, and everything it refuses."""

import re
from typing import TYPE_CHECKING, Any, assert_type

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import BY_NAME, canonical

import hamkernel as hk
from hamkernel._solvers.problem import AbstractSolver

SIGMA, RIDGE = 1.3, 1e-3
# The condition of the system, trace / Nλ ~ 1e3, times rounding.
SOLVE = 1e-10
K = hk.Symplectic(hk.Gaussian(SIGMA))


def data(N=8, n=4, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(N, n))
    return X, np.tanh(X[:, ::-1]) + 0.1 * rng.normal(size=(N, n))


# Blocks of the paper in NumPy, and the representer system (G + NλI) a = y.


def curl_free(d):
    outer = np.outer(d, d) / SIGMA**2
    return np.exp(-d @ d / (2 * SIGMA**2)) * (np.eye(len(d)) - outer) / SIGMA**2


def rotated(block):
    J = canonical(len(block))
    return J @ block @ J.T


REFERENCES = {
    "separable": (
        hk.Separable,
        lambda x, z: np.exp(-(x - z) @ (x - z) / (2 * SIGMA**2)) * np.eye(len(x)),
    ),
    "curl_free": (hk.CurlFree, lambda x, z: curl_free(x - z)),
    "divergence_free": (
        hk.DivergenceFree,
        lambda x, z: np.trace(curl_free(x - z)) * np.eye(len(x)) - curl_free(x - z),
    ),
    "symplectic": (hk.Symplectic, lambda x, z: rotated(curl_free(x - z))),
    "odd_symplectic": (
        lambda k: hk.Odd(hk.Symplectic(k)),
        lambda x, z: rotated(curl_free(x - z) - curl_free(x + z)) / 2,
    ),
}


def reference_gram(block, X, Z):
    return np.block([[block(x, z) for z in Z] for x in X])


@pytest.mark.few(2)
@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("n", [2, 4])
def test_coefficients_and_field_are_those_of_numpy(name, n):
    structure, block = REFERENCES[name]
    X, Y = data(n=n)
    field = hk.fit(structure(hk.Gaussian(SIGMA)), X, Y, RIDGE)
    G = reference_gram(block, X, X)
    a = np.linalg.solve(G + len(X) * RIDGE * np.eye(X.size), Y.ravel())
    np.testing.assert_allclose(field.coefficients.ravel(), a, atol=SOLVE * np.abs(a).max())
    new = data(3, n, seed=1)[0]
    expected = (reference_gram(block, new, X) @ a).reshape(new.shape)
    np.testing.assert_allclose(jax.vmap(field)(jnp.asarray(new)), expected, atol=SOLVE)
    residual = Y - (G @ a).reshape(Y.shape)
    np.testing.assert_allclose(field.residual, residual, atol=SOLVE)
    np.testing.assert_allclose(field.norm, np.sqrt(a @ G @ a), rtol=SOLVE)
    np.testing.assert_array_equal(field.points, X)
    np.testing.assert_allclose(field.regularization, RIDGE)


@pytest.mark.parametrize("name", ["gaussian", "polynomial", "partial"])
def test_the_fit_minimises_the_regularised_error(name):
    k, (X, Y) = BY_NAME[name].make(4), data()
    G = np.asarray(hk.gram(hk.Symplectic(k), X)).reshape(X.size, X.size)
    field = hk.fit(hk.Symplectic(k), X, Y, RIDGE)
    best = np.asarray(field.coefficients).ravel()

    def objective(a):
        return np.sum((G @ a - Y.ravel()) ** 2) / len(X) + RIDGE * a @ G @ a

    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-1, 10.0):
        step = size * rng.normal(size=best.shape)
        assert objective(best + step) > objective(best)
        # Stationary: the change is even in the step.
        np.testing.assert_allclose(
            objective(best + step) - objective(best),
            objective(best - step) - objective(best),
            rtol=1e-6,
            atol=1e-12,
        )
    # The system without the factor N, which the paper's tables fit, solves another problem.
    other = np.linalg.solve(G + RIDGE * np.eye(X.size), Y.ravel())
    assert objective(other) > objective(best) * (1 + 1e-6)


def test_the_objective_is_read_off_the_field():
    X, Y = data()
    field = hk.fit(K, X, Y, RIDGE)
    predicted = np.asarray(jax.vmap(field)(jnp.asarray(X)))
    np.testing.assert_allclose(field.residual, Y - predicted, atol=SOLVE)
    # At the minimum ‖f‖² = aᵀ(y − Nλa), and the objective is λ aᵀy.
    ours = np.mean(np.sum(np.asarray(field.residual) ** 2, axis=1)) + RIDGE * field.norm**2
    np.testing.assert_allclose(ours, RIDGE * np.sum(field.coefficients * Y), rtol=SOLVE)


def test_a_quartic_hamiltonian_is_learned_exactly_by_the_quartic_kernel():
    def H(x):
        return x[1] ** 2 / 2 + x[0] ** 4 / 4 - x[0] ** 2 / 2 + 0.3 * x[0] * x[1] ** 3

    X = data(30, 2)[0]
    velocity = jax.vmap(lambda x: canonical(2) @ jax.grad(H)(x))
    field = hk.fit(hk.Symplectic(hk.Polynomial(4)), X, velocity(jnp.asarray(X)), 1e-12)
    new = jnp.asarray(data(5, 2, seed=1)[0])
    np.testing.assert_allclose(jax.vmap(field)(new), velocity(new), atol=1e-6)
    learned, true = jax.vmap(field.hamiltonian)(new), jax.vmap(H)(new)
    np.testing.assert_allclose(learned - learned[0], true - true[0], atol=1e-6)
    # A cubic kernel cannot.
    cubic = hk.fit(hk.Symplectic(hk.Polynomial(3)), X, velocity(jnp.asarray(X)), 1e-12)
    assert np.abs(jax.vmap(cubic)(new) - velocity(new)).max() > 1e-2


# Transformations.


def test_fit_under_jit_is_fit():
    X, Y = data()
    expected = hk.fit(K, X, Y, RIDGE)
    field = jax.jit(hk.fit)(K, X, Y, RIDGE)
    for ours, theirs in zip(jax.tree.leaves(field), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=SOLVE)


def test_vmap_over_noise_and_over_hyperparameters():
    X, Y = data()
    x = jnp.asarray(X[0])
    noisy = Y[None] + 0.1 * np.random.default_rng(2).normal(size=(3, *Y.shape))
    many = jax.vmap(lambda Y: hk.fit(K, X, Y, RIDGE)(x))(noisy)
    np.testing.assert_allclose(many, [hk.fit(K, X, y, RIDGE)(x) for y in noisy], atol=SOLVE)

    def at(sigma, ridge):
        return hk.fit(hk.Symplectic(hk.Gaussian(sigma)), X, Y, ridge)(x)

    sigmas, ridges = np.array([0.8, 1.3]), np.array([1e-2, 1e-3])
    expected = [at(sigma, ridge) for sigma, ridge in zip(sigmas, ridges, strict=True)]
    np.testing.assert_allclose(jax.vmap(at)(sigmas, ridges), expected, atol=SOLVE)


def lengthscale_kernel(name, lengthscale):
    """Kernels with a lengthscale; the last is a user's, far from shift-invariant."""
    return {
        "gaussian": hk.Gaussian(lengthscale),
        "matern": hk.Matern(2.5, lengthscale),
        "warp": hk.Warp(lambda x, z: jnp.exp(x @ z), lambda x: jnp.sin(x) / lengthscale),
    }[name]


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["gaussian", "matern", "warp"])
def test_gradients_are_central_differences(name):
    X, Y = data(5, 2)
    x = jnp.array([0.3, -0.4])

    @jax.jit
    def number(sigma, ridge, X, Y):
        field = hk.fit(hk.Odd(hk.Symplectic(lengthscale_kernel(name, sigma))), X, Y, ridge)
        return field(x) @ jnp.array([1.0, 2.0]) + field.hamiltonian(x)

    at = (jnp.array(1.1), jnp.array(1e-2), jnp.asarray(X), jnp.asarray(Y))
    gradients = jax.jit(jax.grad(number, argnums=(0, 1, 2, 3)))(*at)
    for i, (value, gradient) in enumerate(zip(at, gradients, strict=True)):
        rng = np.random.default_rng(i)
        direction = jnp.asarray(rng.normal(size=value.shape)) if value.ndim else jnp.array(1.0)
        step = 1e-5 if i != 1 else 1e-6  # λ itself is 1e-2
        moved = [(*at[:i], value + s * step * direction, *at[i + 1 :]) for s in (1, -1)]
        expected = (number(*moved[0]) - number(*moved[1])) / (2 * step)
        ours = jnp.sum(gradient * direction)
        # step² of truncation, relative to third derivatives of order 1/λ.
        np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-7)


def test_new_values_do_not_recompile():
    traces = []

    class Counting(eqx.Module):
        scale: jax.Array

        def __call__(self, x, z):
            traces.append(None)
            return jnp.exp(self.scale * (x @ z))

    X, Y = data(5, 2)
    counts = []
    for scale, ridge in ((0.5, 1e-2), (0.7, 1e-2), (0.7, 1e-3)):
        k = 2.0 * hk.Warp(Counting(jnp.array(scale)), jnp.sin)
        hk.fit(hk.Symplectic(k), X + scale, Y, ridge)
        counts.append(len(traces))
    assert counts[0] == counts[1] == counts[2] > 0
    hk.fit(hk.Symplectic(Counting(jnp.array(0.5))), X[:4], Y[:4], 1e-2)  # the control
    assert len(traces) > counts[0]


def test_a_jitted_fit_is_traced_once_for_all_values():
    X, Y = data(5, 2)

    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def learn(K, X, Y, ridge):
        return hk.fit(K, X, Y, ridge)

    for sigma, ridge in ((1.0, 1e-2), (2.0, 1e-3)):
        learn(hk.Symplectic(hk.Gaussian(sigma)), jnp.asarray(X), jnp.asarray(Y), jnp.array(ridge))


# Input of all kinds.


def test_one_point_is_enough():
    X, Y = np.array([[0.3, -0.4]]), np.array([[1.0, 2.0]])
    # K(x, x) = I/σ², so a = y / (1/σ² + λ).
    field = hk.fit(K, X, Y, RIDGE)
    np.testing.assert_allclose(field.coefficients, Y / (1 / SIGMA**2 + RIDGE), rtol=1e-12)


def test_integers_and_lists_are_read_as_floats():
    X, Y = [[0, 1], [2, -1], [1, 1]], [[1, 0], [0, 1], [1, 1]]
    expected = hk.fit(K, np.array(X, float), np.array(Y, float), 1e-2)
    for convert in (np.array, jnp.array, list):
        field = hk.fit(K, convert(X), convert(Y), 1e-2)  # pyright: ignore
        np.testing.assert_array_equal(field(X[0]), expected(X[0]))  # pyright: ignore


def test_the_wider_of_two_precisions_is_that_of_the_fit():
    X, Y = data(12)
    mixed = hk.fit(K, X.astype(np.float32), Y, 1e-2)
    same = hk.fit(K, X.astype(np.float32).astype(float), Y, 1e-2)
    np.testing.assert_array_equal(mixed.coefficients, same.coefficients)


def test_float32_agrees_to_three_digits_and_says_so():
    X, Y = data(20)
    ridge = 1e-4 / len(X)
    single = [values.astype(np.float32) for values in (X, Y)]
    with pytest.warns(UserWarning, match=r"float32: expect three digits.*jax_enable_x64"):
        field = hk.fit(K, single[0], single[1], ridge)
    assert {leaf.dtype for leaf in jax.tree.leaves(eqx.filter(field, eqx.is_array))} == {
        jnp.dtype("float32"),
        jnp.dtype("float64"),  # the lengthscale
    }
    with pytest.raises(ValueError, match="regularization must be positive and finite, got 0"):
        hk.fit(K, single[0], single[1], 1e-50)  # zero in float32
    exact, new = hk.fit(K, X, Y, ridge), jnp.asarray(data(5, seed=1)[0])
    ours, theirs = jax.vmap(field)(new.astype(jnp.float32)), jax.vmap(exact)(new)
    assert ours.dtype == jnp.float32
    np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max())


# At 1e-14 both residuals are rounding, and compiled as for a user they are alike.
AS_FOR_A_USER = pytest.param(1e-14, marks=[pytest.mark.slow, pytest.mark.ci])


@pytest.mark.parametrize("ridge", [1e-2, AS_FOR_A_USER, 1e-17, 1e-22])
@pytest.mark.parametrize("structure", [hk.Symplectic, hk.Separable])
def test_repeated_points_are_solved_or_refused_but_never_nan(structure, ridge):
    X, Y = data(6, 2)
    X, Y = np.concatenate([X, X]), np.concatenate([Y, -Y])  # the same states, opposite velocities
    field, refusal = None, ""
    try:
        field = hk.fit(structure(hk.Gaussian(SIGMA)), X, Y, ridge)
    except RuntimeError as error:
        refusal = str(error)
    if field is None:
        assert ridge < 1e-13
        assert re.search(r"N \* regularization = .*regularization is too small", refusal)
        return
    off = system_residual(field, Y)
    assert off < 1e-2
    np.testing.assert_allclose(info(field).relative_residual, off, rtol=0.5, atol=1e-14)
    if ridge == 1e-2:  # the mean of the two velocities
        np.testing.assert_allclose(jax.vmap(field)(jnp.asarray(X)), 0.0, atol=SOLVE)


def info(field) -> Any:
    return field.info


def learned(X, Y, solver) -> Any:
    return hk.fit(K, X, Y, RIDGE, solver=solver)


def system_residual(field, Y):
    """‖y − (G + NλI)a‖/‖y‖ of a fitted field, by NumPy in float64."""
    X, a = (np.asarray(each, float) for each in (field.points, field.coefficients))
    G = np.asarray(hk.gram(field.kernel, X)).reshape(X.size, X.size)
    system = G + len(X) * float(field.regularization) * np.eye(X.size)
    return np.linalg.norm(Y.ravel() - system @ a.ravel()) / np.linalg.norm(Y)


@pytest.mark.parametrize(
    ("dtype", "ridges"),
    [(float, np.geomspace(1e-12, 1e-19, 15)), (np.float32, np.geomspace(1e-3, 1e-9, 13))],
)
@pytest.mark.filterwarnings("ignore:fitting in float32")
def test_what_rounding_spoils_is_refused_and_never_a_wrong_field(dtype, ridges):
    # LAPACK factorises some matrices that are singular to rounding, and solves with noise.
    X, Y = data(8, 2)
    X, Y = np.concatenate([X, X]), np.concatenate([Y, -2 * Y])
    residuals = []
    for ridge in ridges:
        try:
            field = hk.fit(K, X.astype(dtype), Y.astype(dtype), ridge / len(X))
        except RuntimeError:
            continue
        # In float32 the Gram rounds as well, at each pair.
        residuals.append(system_residual(field, Y))
        assert residuals[-1] < (1e-2 if dtype is float else 3e-2)
    assert 0 < len(residuals) < len(ridges)  # both happen


@pytest.mark.slow
def test_data_of_zeros_give_the_zero_field_and_finite_derivatives():
    X, Y = data(6, 2)
    for solver in (hk.Cholesky(), hk.ConjugateGradient(), hk.Nystrom()):

        def norm(Y, solver=solver):
            return learned(X, Y, solver).norm

        value, slope = jax.jit(jax.value_and_grad(norm))(jnp.zeros_like(Y))
        assert value == 0.0
        assert jnp.isfinite(slope).all()


def test_a_ridge_lost_in_rounding_is_refused_also_under_jit():
    X, Y = data(6, 2)
    X, Y = np.concatenate([X, X]), np.concatenate([Y, -Y])
    with pytest.raises(RuntimeError, match=r"= 1\.2e-24 is not positive definite"):
        hk.fit(K, X, Y, 1e-25)
    with pytest.raises(RuntimeError, match="not positive definite"):
        eqx.filter_jit(hk.fit)(K, X, Y, jnp.array(1e-25))


def test_a_kernel_that_is_not_finite_is_refused():
    def plain(x, z):
        return jnp.exp(-jnp.sqrt((x - z) @ (x - z)))

    with pytest.raises(RuntimeError, match=r"hk\.check_kernel"):
        hk.fit(hk.Symplectic(plain), *data(), RIDGE)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "solver",
    [hk.Cholesky(), hk.ConjugateGradient(), hk.Nystrom(), hk.RandomFeatures(9, jax.random.key(0))],
    ids=lambda solver: type(solver).__name__,
)
def test_a_solve_that_fails_raises_or_is_nan_beside_those_of_its_batch_that_do_not(solver):
    X, Y = data(12)

    def learned(log_lengthscale, throw):
        kernel = hk.Gaussian(1.0)
        kernel = eqx.tree_at(lambda k: k.log_lengthscale, kernel, log_lengthscale)
        return hk.fit(hk.Symplectic(kernel), X, Y, 1e-2, solver=solver, throw=throw)

    logs = jnp.array([jnp.nan, 0.5])
    with pytest.raises(RuntimeError):
        learned(logs[0], throw=True)
    with pytest.raises(RuntimeError):
        jax.block_until_ready(jax.vmap(lambda log: learned(log, throw=True).norm)(logs))
    alone = learned(logs[0], throw=False)
    for values in (alone.norm, alone.residual, alone(X[0]), alone.hamiltonian(X[0])):
        assert np.isnan(values).all()
    with pytest.raises(ValueError, match="throw=False failed"):
        alone.anchored(X[0])
    norms = jax.vmap(lambda log: learned(log, throw=False).norm)(logs)
    np.testing.assert_allclose(
        norms, [jnp.nan, float(learned(logs[1], throw=True).norm)], rtol=1e-6
    )


@pytest.mark.parametrize("kind", [hk.Cholesky, hk.ConjugateGradient, hk.Nystrom, "features"])
def test_every_field_says_how_it_was_found(kind):
    solver = hk.RandomFeatures(9, jax.random.key(0)) if kind == "features" else kind()
    field = hk.fit(K, *data(12), 1e-2, solver=solver)
    assert field.info.solver == type(solver).__name__
    assert field.regularization == 1e-2
    assert field.norm > 0
    np.testing.assert_allclose(field.residual_norm, np.linalg.norm(field.residual))


@pytest.mark.slow
def test_an_iteration_that_does_not_converge_is_nan_where_it_does_not_raise():
    solver = hk.ConjugateGradient(1e-12, 2, hk.Nystrom(max_points=2))
    field: Any = hk.fit(K, *data(30), 1e-6, solver=solver, throw=False)
    assert np.isnan(field.norm)
    assert field.info.relative_residual > 1e-12  # says how far it came


# What a type checker knows of the field: nothing of this runs.

if TYPE_CHECKING:

    def types(X: Any, key: Any, either: hk.Nystrom | hk.RandomFeatures, some: hk.Nystrom | None):
        driven = hk.Controlled(K, hk.InputMatrix(1.0))
        assert_type(hk.fit(K, X, X), hk.KernelField)
        assert_type(hk.fit(K, X, X, solver=some), hk.KernelField)
        assert_type(hk.fit(K, X, X, solver=hk.RandomFeatures(8, key)), hk.FeatureField)
        assert_type(hk.fit(K, X, X, solver=either), hk.KernelField | hk.FeatureField)
        assert_type(hk.fit(driven, X, X, solver=some, inputs=X), hk.ControlledField)


# The norm, where rounding leaves nothing of it.


def test_a_norm_lost_in_rounding_is_nan_and_not_a_wrong_number():
    # The velocity x has no Hamiltonian part, so that the field is small beside it. The norm
    # at λ = 1e-6 was 11.5 for 14.2; others, of a cᵀGc below zero, were 0.
    X = 0.3 * np.random.default_rng(9).normal(size=(30, 2))
    K, ridges = hk.Odd(hk.Symplectic(hk.Gaussian(2.0))), 10.0 ** -np.arange(2.0, 7.0)
    right = np.array([float(hk.fit(K, X, X, ridge).norm) for ridge in ridges])
    with pytest.warns(UserWarning, match="float32"):
        fields = [hk.fit(K, X.astype("f4"), X.astype("f4"), ridge) for ridge in ridges]
    norms = np.array([float(field.norm) for field in fields])
    finite = np.isfinite(norms)
    # Whether it still has a digit at λ = 1e-6 depends on the processor: 14.5 for 14.2, or NaN.
    assert finite[:4].all()
    np.testing.assert_allclose(norms[finite], right[finite], 0.05)
    # Of a field that is smaller still no digit is left on any.
    X = (0.1 * np.random.default_rng(11).normal(size=(30, 2))).astype("f4")
    with pytest.warns(UserWarning, match="float32"):
        assert np.isnan(hk.fit(K, X, X, 1e-6).norm)
    nothing = hk.fit(K, X.astype(float), np.zeros(X.shape), 1e-4)
    assert nothing.norm == 0


# Refusals, before any work is done.


class Forbidden(AbstractSolver):
    def fit(self, problem, throw=True, progress=False):
        raise AssertionError("the solver was called with bad input")


@pytest.mark.filterwarnings("ignore:fitting in float32")
@pytest.mark.parametrize("act", [hk.fit, hk.condition, hk.tune])
def test_a_mean_that_is_not_finite_at_the_data_is_named_before_any_solve(act):
    X, Y = data(5)
    with pytest.raises(ValueError, match=r"mean is NaN or infinite at the data of \d of the 5 obs"):
        act(K, X, Y, 1e-3, mean=lambda x: jnp.log(x), solver=Forbidden())
    solver = {"solver": Forbidden()} if act is not hk.tune else {}
    with pytest.raises(ValueError, match=r"as large as \de\+200, and their squares.*Change the un"):
        act(K, X, np.sign(Y) * 2e200, 1e-3, **solver)
    with pytest.raises(ValueError, match=r"as large as \de\+30, .* overflow in float32"):
        act(K, X.astype("f4"), np.sign(Y).astype("f4") * 1e30, 1e-3, **solver)


def test_a_mean_may_be_nan_where_failure_is_not_to_raise():
    X, Y = data(5)
    field = hk.fit(K, X, Y, 1e-3, mean=lambda x: jnp.log(x), throw=False)
    assert np.isnan(field.norm)


X, Y = data(5)
HOLE = np.where(np.arange(5)[:, None] == 3, np.nan, X)
ENDLESS = np.where(np.arange(5)[:, None] == 1, np.inf, Y)


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ((K, X[:0], Y[:0]), ValueError, r"X has shape \(0, 4\): at least one point"),
        ((K, X, Y[:4]), ValueError, r"X has shape \(5, 4\) and Y has shape \(4, 4\).*equal"),
        ((K, X, Y[:, :2]), ValueError, r"Y has shape \(5, 2\)"),
        ((K, X[0], Y[0]), ValueError, r"X has shape \(4,\); it must be \(N, n\).*X\[None\]"),
        ((K, X, Y[0]), ValueError, r"Y has shape \(4,\)"),
        ((K, X[None], Y[None]), ValueError, r"\(1, 5, 4\).*Join trajectories with `X\.reshape"),
        ((K, 1.0, 2.0), ValueError, r"X has shape \(\)"),
        ((K, X[:, :3], Y[:, :3]), ValueError, "even dimension, got n = 3. Add the missing"),
        ((K, HOLE, Y), ValueError, "X contains NaN or inf in row 3: remove or repair"),
        ((K, X, ENDLESS), ValueError, "Y contains NaN or inf in row 1"),
        ((K, np.full((9, 2), np.nan), np.ones((9, 2))), ValueError, "0, 1, 2, 3, 4 and 4 more"),
        ((K, X, Y, 0.0), ValueError, r"regularization must be positive and finite, got 0\.0"),
        ((K, X, Y, -1e-3), ValueError, r"regularization must be positive .* got -0\.001"),
        ((K, X, Y, float("nan")), ValueError, "regularization must be positive .* got nan"),
        ((K, X, Y, np.ones(5)), ValueError, r"regularization has shape \(5,\); one number"),
        ((K, X, Y, None), TypeError, "regularization must hold real numbers; got None"),
        ((K, [[1, 2], [3]], Y), TypeError, r"X must hold real numbers.*rows of equal length"),
        ((K, X * 1j, Y), TypeError, "X has dtype complex128; real numbers are needed"),
        ((K, X, Y, 1e-3j), TypeError, "regularization has dtype complex128"),
        ((K, X.astype(np.float16), Y.astype(np.float16)), TypeError, "dtype float16"),
        ((hk.Gaussian(), X, Y), TypeError, r"hk\.Symplectic\(k\), hk\.CurlFree\(k\)"),
        (
            (lambda x, z: x @ z, X, Y),
            TypeError,
            "K, the first argument, must be a matrix-valued kernel; got <function",
        ),
        (
            (hk.Symplectic, X, Y),
            TypeError,
            "K, the first argument, must be a matrix-valued kernel; got <class",
        ),
    ],
)
def test_bad_input_is_refused_before_the_solve(arguments, error, match):
    with pytest.raises(error, match=match):
        hk.fit(*arguments, solver=Forbidden())


def test_a_kernel_of_more_than_a_scalar_is_refused_by_name():
    def features(x, z):
        return x * z

    with pytest.raises(ValueError, match=r"features returned an array of shape \(4,\).*one pair"):
        hk.fit(hk.Symplectic(features), X, Y)


@pytest.mark.parametrize("solver", [hk.Cholesky, "cholesky"])
def test_what_is_no_solver_is_refused(solver):
    with pytest.raises(TypeError, match=r"instance, for example hk\.Cholesky\(\); got"):
        hk.fit(K, X, Y, solver=solver)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((X, Y, jnp.array(-1.0)), "regularization must be positive and finite"),
        ((X, Y, jnp.array(jnp.nan)), "regularization must be positive and finite"),
        ((HOLE, Y, jnp.array(RIDGE)), "X contains NaN or inf: remove"),
        ((X, ENDLESS, jnp.array(RIDGE)), "Y contains NaN or inf: remove"),
    ],
)
def test_values_are_refused_under_jit_too(arguments, match):
    learn = eqx.filter_jit(lambda X, Y, ridge: hk.fit(K, X, Y, ridge))
    with pytest.raises(RuntimeError, match=match):
        learn(*map(jnp.asarray, arguments))


def test_shapes_are_refused_under_jit_while_tracing():
    with pytest.raises(ValueError, match=r"Y has shape \(4, 4\)"):
        jax.jit(hk.fit)(K, X, Y[:4], RIDGE)
