"""Random features: the measure is the kernel's, the structure exact, and streams lose nothing."""

import functools
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from kernels import canonical, gaussian_profile, matern_profile, periodic, radial, rational_profile

import hamkernel as hk
from hamkernel import FeatureField, RandomFeatures
from hamkernel._features import features
from hamkernel._machine import orthonormal
from hamkernel._solvers.least_squares import ridge_regression
from hamkernel.paper import datasets, experiments

STRUCTURE = 1e-9  # relative; what sums of a thousand rounded terms leave of an exact zero
ROUNDING = 1e-12
SOLVE = 1e-10  # the condition of the ridge problems here, below 1e5, times rounding
DIFFERENCES = 1e-5  # what central differences of step 1e-5 leave
DEVIATIONS = 5.0  # standard errors of a mean of random numbers; one in 2 million goes beyond
ELL = np.array([1.0, 2.0, 1.5, 0.8])


def of_any(count: Any, key: Any) -> Any:
    """`RandomFeatures`, called as its type forbids."""
    return RandomFeatures(count, key)


def points(N=6, n=4, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, n)))


def data(N=40, n=4, seed=0):
    X = points(N, n, seed)
    return X, jnp.tanh(X[:, ::-1]) + 0.1 * points(N, n, seed + 1)


# The measure. Each kernel beside its formula, written for NumPy arrays.

KERNELS = {
    "gaussian": (lambda: hk.Gaussian(1.3), radial(gaussian_profile, 1.3)[0]),
    "gaussian_ard": (lambda: hk.Gaussian(ELL), radial(gaussian_profile, ELL)[0]),
    "matern1.5": (lambda: hk.Matern(1.5, 1.2), radial(matern_profile(1.5), 1.2)[0]),
    "matern2.5": (lambda: hk.Matern(2.5, ELL), radial(matern_profile(2.5), ELL)[0]),
    "rational_quadratic": (
        lambda: hk.RationalQuadratic(0.7, 1.1),
        radial(rational_profile(0.7), 1.1)[0],
    ),
    "periodic": (lambda: hk.Periodic(4.1, 0.8), periodic(4.1, 0.8)),
    "periodic_ard": (lambda: hk.Periodic(3 * ELL, ELL), periodic(3 * ELL, ELL)),
    "scaled": (
        lambda: 2.5 * hk.Gaussian(1.3),
        lambda x, z: 2.5 * radial(gaussian_profile, 1.3)[0](x, z),
    ),
    "sum": (
        lambda: hk.Gaussian(1.3) + 0.5 * hk.Matern(2.5, 0.9),
        lambda x, z: (
            radial(gaussian_profile, 1.3)[0](x, z) + 0.5 * radial(matern_profile(2.5), 0.9)[0](x, z)
        ),
    ),
    "product": (
        lambda: hk.Gaussian(1.7) * hk.Periodic(4.1, 0.8) * hk.Matern(2.5, 2.0),
        lambda x, z: (
            radial(gaussian_profile, 1.7)[0](x, z)
            * periodic(4.1, 0.8)(x, z)
            * radial(matern_profile(2.5), 2.0)[0](x, z)
        ),
    ),
    "select": (
        lambda: hk.Select(hk.Gaussian(ELL[:2]), (2, 0)),
        lambda x, z: radial(gaussian_profile, ELL[:2])[0](x[[2, 0]], z[[2, 0]]),
    ),
    "product_of_sums": (
        lambda: (hk.Gaussian(1.0) + 2.0 * hk.Select(hk.Gaussian(0.7), (1, 3))) * hk.Gaussian(2.0),
        lambda x, z: (
            (
                radial(gaussian_profile, 1.0)[0](x, z)
                + 2.0 * radial(gaussian_profile, 0.7)[0](x[[1, 3]], z[[1, 3]])
            )
            * radial(gaussian_profile, 2.0)[0](x, z)
        ),
    ),
}


def estimate(terms, d):
    """Mean and standard error of Σ_r c_r cos(ω_r·d), and the sum of the weights."""
    mean = variance = total = 0.0
    for s in terms:
        weights = np.asarray(s.weights)
        waves = len(weights) * weights * np.cos(np.asarray(s.frequencies) @ d)
        mean, variance = mean + waves.mean(), variance + waves.var() / len(waves)
        total += weights.sum()
    return mean, np.sqrt(variance), total


@pytest.mark.few(2)
@pytest.mark.parametrize("name", KERNELS)
def test_the_mean_of_the_waves_is_the_kernel(name, key):
    make, formula = KERNELS[name]
    terms = make().spectra(4, 20_000, key, jnp.float64)
    zero = np.zeros(4)
    for d in np.asarray(points(5)):
        mean, error, total = estimate(terms, d)
        assert abs(mean - formula(d, zero)) < DEVIATIONS * error
        np.testing.assert_allclose(total, formula(zero, zero), rtol=ROUNDING)


def test_the_mean_of_the_waves_of_another_kernel_is_not(key):
    d = np.asarray(points(1)[0])
    mean, error, _ = estimate(hk.Gaussian(1.5).spectra(4, 20_000, key, jnp.float64), d)
    formula = KERNELS["gaussian"][1]
    assert abs(mean - formula(d, np.zeros(4))) > 2 * DEVIATIONS * error


MARGINALS = {  # of one coordinate of ω
    "gaussian": (lambda: hk.Gaussian(0.7), scipy.stats.norm(scale=1 / 0.7)),
    "matern1.5": (lambda: hk.Matern(1.5, 0.7), scipy.stats.t(3, scale=1 / 0.7)),
    "matern3.5": (lambda: hk.Matern(3.5, 0.7), scipy.stats.t(7, scale=1 / 0.7)),
    # A normal over √(α/g), g ~ Gamma(α), is Student's t upside down; at α = 1 it is Laplace's
    # variance mixture, whose scale is √(1/2).
    "rational_quadratic": (
        lambda: hk.RationalQuadratic(1.0, 0.7),
        scipy.stats.laplace(scale=np.sqrt(0.5) / 0.7),
    ),
}


@pytest.mark.parametrize("name", MARGINALS)
@pytest.mark.parametrize("n", [1, 3])
def test_frequencies_have_the_spectral_density(name, n, key):
    make, marginal = MARGINALS[name]
    (s,) = make().spectra(n, 4000, key, jnp.float64)
    # Every n-th: those within a block are orthogonal, and so not independent.
    draws = np.asarray(s.frequencies)[::n]
    for a in range(n):
        assert scipy.stats.kstest(draws[:, a], marginal.cdf).pvalue > 1e-4
    wrong = scipy.stats.cauchy(scale=1 / 0.7)
    assert scipy.stats.kstest(draws[:, 0], wrong.cdf).pvalue < 1e-4


def test_directions_are_those_of_qr_without_its_program(key):
    """Two batches of `qr` in one program hang on two cores, as for draws with inputs they did."""
    A = jax.random.normal(key, (5, 7, 7))
    Q, R = np.linalg.qr(np.asarray(A))
    signs = np.sign(np.diagonal(R, axis1=1, axis2=2))
    np.testing.assert_allclose(orthonormal(A)[0], Q * signs[:, None], atol=1e-13)
    K = hk.Controlled(hk.Symplectic(hk.Gaussian()), hk.InputMatrix(hk.Gaussian()), count=1)

    def draws(keys):
        kept = jax.vmap(lambda key: features(K, 3, 8, key, jnp.dtype(float)))(keys)
        return eqx.filter(kept, eqx.is_array)

    program = str(jax.make_jaxpr(draws)(jax.random.split(key, 2)))
    assert "random_bits" in program
    assert not re.search(r"\b(qr|geqrf|householder_product)\b", program)


@pytest.mark.slow
def test_harmonics_of_a_periodic_kernel_have_its_fourier_coefficients(key):
    (s,) = hk.Periodic(2 * np.pi, 0.8).spectra(1, 100_000, key, jnp.float64)
    harmonics = np.asarray(s.frequencies)[:, 0]
    np.testing.assert_allclose(harmonics, np.round(harmonics), atol=ROUNDING)
    for j in range(-4, 5):
        p = scipy.special.ive(j, 1 / 0.8**2)
        error = np.sqrt(p * (1 - p) / harmonics.size)
        assert abs(np.mean(np.round(harmonics) == j) - p) < DEVIATIONS * error


def test_the_same_key_draws_the_same_and_another_does_not(key):
    draw = functools.partial(hk.Matern(2.5).spectra, 2, 10, dtype=jnp.float64)
    (a,), (b,), (c,) = draw(key), draw(key), draw(jax.random.key(0))
    np.testing.assert_array_equal(a.frequencies, b.frequencies)
    assert not np.allclose(a.frequencies, c.frequencies)


# The structure.


def odd_symplectic(k):
    return hk.Odd(hk.Symplectic(k))


def jacobian(field, x):
    return np.asarray(jax.jacfwd(field)(x))


def asymmetry(A):
    return np.abs(A - A.T).max() / np.abs(A).max()


def symplecticity(D):
    return asymmetry(np.linalg.solve(canonical(len(D)), D))


def divergence(D):
    return abs(np.trace(D)) / np.abs(D).max()


def parity(sign):
    def defect(f, x):
        value = f(x)
        return np.abs(f(-x) - sign * value).max() / np.abs(value).max()

    return defect


DEFECTS = {
    "curl_free": (hk.CurlFree, lambda f, x: asymmetry(jacobian(f, x))),
    "symplectic": (hk.Symplectic, lambda f, x: symplecticity(jacobian(f, x))),
    "symplectic_diverges_not": (hk.Symplectic, lambda f, x: divergence(jacobian(f, x))),
    "divergence_free": (hk.DivergenceFree, lambda f, x: divergence(jacobian(f, x))),
    "odd_symplectic": (odd_symplectic, lambda f, x: symplecticity(jacobian(f, x))),
    "odd_symplectic_is_odd": (odd_symplectic, parity(-1)),
    "even_divergence_free_is_even": (lambda k: hk.Even(hk.DivergenceFree(k)), parity(+1)),
    "odd_separable_is_odd": (lambda k: hk.Odd(hk.Separable(k)), parity(-1)),
    "even_separable_is_even": (lambda k: hk.Even(hk.Separable(k)), parity(+1)),
}


@pytest.mark.few(4)
@pytest.mark.parametrize("name", DEFECTS)
@pytest.mark.parametrize(
    "count", [1, *(pytest.param(c, marks=pytest.mark.slow) for c in (2, 7, 300)), 60]
)
def test_the_structure_is_exact_for_every_count(name, count, key):
    structure, defect = DEFECTS[name]
    X, Y = data()
    field = hk.fit(structure(hk.Gaussian(ELL)), X, Y, 1e-3, solver=RandomFeatures(count, key))
    assert all(defect(field, x) < STRUCTURE for x in points(3, seed=9))


@pytest.mark.parametrize("name", DEFECTS)
def test_without_the_structure_the_same_check_fails(name, key):
    X, Y = data()
    field = hk.fit(hk.Separable(hk.Gaussian(ELL)), X, Y, 1e-3, solver=RandomFeatures(50, key))
    assert all(DEFECTS[name][1](field, x) > 1e-3 for x in points(3, seed=9))


def test_parity_halves_the_features(key):
    def columns(K):
        return features(K, 4, 10, key, jnp.float64).columns

    k = hk.Gaussian(1.0)
    assert columns(hk.Symplectic(k)) == 20
    assert columns(odd_symplectic(k)) == columns(hk.Even(hk.Symplectic(k))) == 10
    assert columns(odd_symplectic(k + k)) == 20
    assert columns(hk.DivergenceFree(k)) == 6 * 20
    assert columns(hk.Separable(k)) == 4 * 20


STRUCTURES = {
    "separable": hk.Separable,
    "curl_free": hk.CurlFree,
    "divergence_free": hk.DivergenceFree,
    "symplectic": hk.Symplectic,
    "odd_symplectic": odd_symplectic,
    "even_symplectic": lambda k: hk.Even(hk.Symplectic(k)),
    "sum": lambda k: hk.CurlFree(k) + odd_symplectic(k),
}


def gram_error(K, X, count, key):
    rows = features(K, X.shape[1], count, key, X.dtype)(X)
    approximate = jnp.einsum("iar,jbr->iajb", rows, rows)
    exact = hk.gram(K, X)
    return jnp.linalg.norm(approximate - exact) / jnp.linalg.norm(exact)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "odd_symplectic" else pytest.mark.slow)
        for name in STRUCTURES
    ],
)
def test_the_gram_error_falls_as_the_root_of_the_count(name):
    X = points(12, 2)
    K = STRUCTURES[name](hk.Gaussian(1.3))
    counts = 4 ** np.arange(3, 7)
    keys = jax.random.split(jax.random.key(7), 10)

    @functools.partial(jax.jit, static_argnums=0)
    def mean_error(count, keys):
        return jax.lax.map(lambda key: gram_error(K, X, count, key), keys).mean()

    errors = [float(mean_error(int(count), keys)) for count in counts]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert -0.6 < slope < -0.4
    assert errors[-1] < 0.1


@pytest.mark.few(2)
@pytest.mark.parametrize("name", STRUCTURES)
def test_the_field_is_the_sum_of_its_features(name, key):
    basis = features(STRUCTURES[name](hk.Gaussian(1.3)), 4, 5, key, jnp.float64)
    w, x = points(1, basis.columns)[0], points(1)[0]
    rows = basis(x[None])[0]
    assert rows.shape == (4, basis.columns)
    np.testing.assert_allclose(basis.field(x, w), rows @ w, atol=ROUNDING)


# The fit, against NumPy in the same features.


def numpy_weights(rows, Y, ridge):
    rows = rows.reshape(Y.size, -1)
    below = np.sqrt(len(Y) * ridge) * np.eye(rows.shape[1])
    target = np.concatenate([np.asarray(Y).ravel(), np.zeros(rows.shape[1])])
    return np.linalg.lstsq(np.concatenate([rows, below]), target)[0]


@pytest.mark.few(1)
@pytest.mark.parametrize("name", STRUCTURES)
def test_weights_are_those_of_ridge_regression_in_numpy(name, key):
    X, Y = data()
    K, ridge = STRUCTURES[name](hk.Gaussian(1.3)), 1e-3
    field = hk.fit(K, X, Y, ridge, solver=RandomFeatures(30, key))
    assert isinstance(field, FeatureField)
    rows = np.asarray(field.features(X))
    w = numpy_weights(rows, Y, ridge)
    rows = rows.reshape(X.size, -1)
    np.testing.assert_allclose(field.weights, w, atol=SOLVE * np.abs(w).max())
    residual = np.asarray(Y) - (rows @ w).reshape(Y.shape)
    np.testing.assert_allclose(field.residual, residual, atol=SOLVE)
    np.testing.assert_allclose(field.residual_norm, np.linalg.norm(residual), rtol=SOLVE)
    np.testing.assert_allclose(field.norm, np.linalg.norm(w), rtol=SOLVE)
    np.testing.assert_allclose(Y - jax.vmap(field)(X), residual, atol=SOLVE)
    np.testing.assert_allclose(field.evaluate(X), jax.vmap(field)(X), atol=ROUNDING)
    assert field.dimension == 4
    assert float(field.regularization) == ridge


def test_a_small_ridge_keeps_the_digits_that_normal_equations_lose(key):
    # Features of a long lengthscale: singular values from 1 to rounding, and a ridge of 1e-12. The
    # filtered singular values are the reference; their condition is 1e7, its square 1e14.
    X, Y = data(200, 2)
    basis = features(hk.Symplectic(hk.Gaussian(4.0)), 2, 40, key, X.dtype)
    ridge = 1e-12
    w, *_ = ridge_regression(basis, jnp.eye(basis.columns), X, Y, jnp.asarray(ridge))
    rows, target = np.asarray(basis(X)).reshape(X.size, -1), np.asarray(Y).ravel()
    U, s, Vt = np.linalg.svd(rows, full_matrices=False)
    expected = Vt.T @ (s / (s**2 + ridge) * (U.T @ target))
    normal = np.linalg.solve(rows.T @ rows + ridge * np.eye(basis.columns), rows.T @ target)

    def lost(w):
        return np.linalg.norm(w - expected) / np.linalg.norm(expected)

    assert lost(w) < 1e-5
    assert lost(normal) > 100 * lost(w)


@pytest.mark.parametrize("name", ["curl_free", "symplectic", "odd_symplectic"])
def test_the_field_comes_from_its_potential(name, key):
    X, Y = data()
    field = hk.fit(STRUCTURES[name](hk.Gaussian(1.3)), X, Y, solver=RandomFeatures(30, key))
    B = np.eye(4) if name == "curl_free" else canonical(4)
    x = X[0]
    slope = [(field.potential(x + e) - field.potential(x - e)) / 2e-5 for e in 1e-5 * jnp.eye(4)]
    np.testing.assert_allclose(field(x), B @ np.array(slope), atol=DIFFERENCES)
    anchored = field.anchored(X[1], 3.0)
    np.testing.assert_allclose(anchored.potential(X[1]), 3.0, atol=ROUNDING)
    if name != "curl_free":
        assert float(anchored.hamiltonian(x)) == float(anchored.potential(x))


@pytest.mark.slow
def test_parts_add_up_to_the_field(key):
    X, Y = data()
    k = hk.Gaussian(1.3)
    K = hk.Sum(hamiltonian=hk.Symplectic(k), rest=hk.CurlFree(hk.Matern(2.5)))
    field = hk.fit(K, X, Y, solver=RandomFeatures(30, key))
    parts = field.part("hamiltonian"), field.part(-1)
    np.testing.assert_allclose(parts[0](X[0]) + parts[1](X[0]), field(X[0]), atol=ROUNDING)
    assert jnp.isfinite(parts[0].hamiltonian(X[0]))
    assert parts[1].features.columns == 60
    with pytest.raises(KeyError, match="no part 'friction'"):
        field.part("friction")
    with pytest.raises(AttributeError, match="no single potential"):
        field.potential  # noqa: B018


def test_a_separable_hamiltonian_is_recognised_and_learned_exactly_so(key):
    X, Y = data(n=2)
    k = hk.Select(hk.Gaussian(1.0), 0) + hk.Select(hk.Gaussian(2.0), 1)
    field = hk.fit(hk.Symplectic(k), X, Y, solver=RandomFeatures(20, key))
    assert field.is_separable
    mixed = jax.hessian(field.hamiltonian)(X[0])[0, 1]
    assert abs(float(mixed)) < STRUCTURE


@pytest.mark.slow
def test_many_features_give_the_field_of_the_exact_kernel(key):
    X, Y = data(n=2)
    K, new = odd_symplectic(hk.Gaussian(1.5)), points(50, 2, seed=5)
    exact = jax.vmap(hk.fit(K, X, Y, 1e-2))(new)
    few, many = (
        jnp.linalg.norm(hk.fit(K, X, Y, 1e-2, solver=RandomFeatures(c, key)).evaluate(new) - exact)
        / jnp.linalg.norm(exact)
        for c in (10, 500)
    )
    assert many < 0.1
    assert many < few / 2


@pytest.mark.slow
def test_the_pendulum_of_the_paper_is_learned_as_by_the_exact_kernel():
    experiment = experiments()["pendulum_m1"]
    keys = jax.random.split(jax.random.key(5), 8)
    X, Y = datasets(experiment, keys)
    model = experiment.models["odd_symplectic"]
    ts, x0 = jnp.linspace(0, experiment.horizon, 41), jnp.asarray(experiment.test_state)
    true = jnp.asarray(hk.simulate(experiment.system, x0, ts).ys)

    @jax.jit
    def errors(X, Y, key):
        solvers = None, RandomFeatures(500, key)
        # The reading of the ridge that reproduces the paper's tables.
        ridge = model.regularization / experiment.size
        fields = [hk.fit(model.kernel, X, Y, ridge, solver=s) for s in solvers]
        orbits = [hk.simulate(field, x0, ts).ys for field in fields]
        return jnp.stack([jnp.linalg.norm(jnp.asarray(ys) - true, axis=1).mean() for ys in orbits])

    exact, approximate = np.transpose([errors(*seed) for seed in zip(X, Y, keys, strict=True)])
    assert np.median(approximate / exact) < 2
    assert np.mean(approximate / exact < 2) > 0.8


# Transformations of JAX.


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda t: hk.Gaussian(t), marks=pytest.mark.slow),
        pytest.param(lambda t: hk.Matern(2.5, t * jnp.asarray(ELL[:2])), marks=pytest.mark.slow),
        pytest.param(lambda t: hk.RationalQuadratic(1.3, t), marks=pytest.mark.slow),
        lambda t: t * hk.Gaussian(1.2) * hk.Periodic(5.0 * t, 0.9),
    ],
    ids=["gaussian", "matern", "rational_quadratic", "product"],
)
def test_gradients_with_respect_to_hyperparameters_are_differences(make, key):
    X, Y = data(n=2)

    def loss(t):
        K = odd_symplectic(make(t))
        return jnp.sum(hk.fit(K, X, Y, t * 1e-2, solver=RandomFeatures(20, key)).residual ** 2)

    t, h = jnp.asarray(1.1), 1e-5
    gradient = jax.grad(loss)
    values, forward = jax.jit(jax.vmap(lambda t: jax.jvp(loss, (t,), (1.0,))))(
        t + h * jnp.array([-1.0, 0.0, 1.0])
    )
    slopes, curvatures = jax.jit(jax.vmap(lambda t: jax.jvp(gradient, (t,), (1.0,))))(
        t + h * jnp.array([-1.0, 0.0, 1.0])
    )
    slope = (values[2] - values[0]) / (2 * h)
    np.testing.assert_allclose(slopes[1], slope, rtol=DIFFERENCES)
    np.testing.assert_allclose(forward[1], slope, rtol=DIFFERENCES)
    second = (slopes[2] - slopes[0]) / (2 * h)
    np.testing.assert_allclose(curvatures[1], second, rtol=10 * DIFFERENCES)


@pytest.mark.parametrize(
    ("make", "formula"),
    [
        (lambda ell: hk.Periodic(3.0, ell), lambda ell: periodic(3.0, ell)),
        pytest.param(
            lambda alpha: hk.RationalQuadratic(alpha, 1.1),
            lambda alpha: radial(rational_profile(alpha), 1.1)[0],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["periodic_lengthscale", "rational_quadratic_alpha"],
)
def test_slopes_of_the_measure_are_those_of_the_kernel_in_the_mean(make, formula, key):
    d = np.array([0.7, -0.4])

    def kernel(t):
        (s,) = make(t).spectra(2, 200_000, key, jnp.float64)
        return s.weights @ jnp.cos(s.frequencies @ d)

    h, zero = 1e-6, np.zeros(2)
    exact = (formula(0.8 + h)(d, zero) - formula(0.8 - h)(d, zero)) / (2 * h)
    assert abs(exact) > 0.02
    # Its standard error is about 1 over the root of the count, 0.002.
    np.testing.assert_allclose(jax.grad(kernel)(0.8), exact, atol=0.01)


def test_fits_run_under_jit_and_vmap_and_new_values_do_not_recompile(key):
    X, Y = data(n=2)
    solver = RandomFeatures(20, key)

    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def fitted(ell, ridge):
        return hk.fit(hk.Symplectic(hk.Gaussian(ell)), X, Y, ridge, solver=solver)(X[0])

    alone = jnp.stack([fitted(jnp.asarray(ell), jnp.asarray(1e-3)) for ell in (1.0, 1.5)])
    together = jax.vmap(
        lambda ell: hk.fit(hk.Symplectic(hk.Gaussian(ell)), X, Y, 1e-3, solver=solver)(X[0])
    )(jnp.array([1.0, 1.5]))
    np.testing.assert_allclose(together, alone, rtol=SOLVE)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:fitting in float32")
def test_float32_stays_float32(key):
    X, Y = (a.astype(jnp.float32) for a in data(n=2))
    k = hk.Matern(2.5) + hk.Gaussian(1.0) + hk.RationalQuadratic() + hk.Periodic(4.0, 1.0)
    field = hk.fit(hk.Symplectic(2.0 * k), X, Y, solver=RandomFeatures(20, key))
    assert field.weights.dtype == field(X[0]).dtype == field.potential(X[0]).dtype == X.dtype


# Streams.


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("sum", "separable") else pytest.mark.slow)
        for name in STRUCTURES
    ],
)
def test_a_fit_to_chunks_is_the_fit_to_all(name, key):
    X, Y = data(N=90)
    K, solver = STRUCTURES[name](hk.Gaussian(1.3)), RandomFeatures(20, key)
    whole = hk.fit(K, X, Y, 1e-3, solver=solver)
    cuts = [(0, 2), (2, 46), (46, 90)]  # the first with fewer rows than features
    chunks = ((np.asarray(X[a:b]), np.asarray(Y[a:b])) for a, b in cuts)
    streamed = solver.fit_chunks(K, chunks, 1e-3)
    scale = float(jnp.abs(whole.weights).max())
    np.testing.assert_allclose(streamed.weights, whole.weights, atol=SOLVE * scale)
    np.testing.assert_allclose(streamed.residual_norm, whole.residual_norm, rtol=SOLVE)
    assert streamed.residual.shape == (0, 4)
    new = points(5, seed=3)
    np.testing.assert_allclose(streamed.evaluate(new), whole.evaluate(new), atol=SOLVE)


def test_many_tiles_are_one(key):
    X, Y = data(N=2000, n=2)  # rows in tiles of a thousand, and a rest
    K, solver = hk.Symplectic(hk.Gaussian(1.3)), RandomFeatures(20, key)
    field = hk.fit(K, X, Y, 1e-3, solver=solver)
    rows = np.asarray(field.features(X)).reshape(X.size, -1)
    square = rows.T @ rows + len(X) * 1e-3 * np.eye(40)
    w = np.linalg.solve(square, rows.T @ np.asarray(Y).ravel())
    np.testing.assert_allclose(field.weights, w, atol=SOLVE * np.abs(w).max())
    residual = np.asarray(Y) - (rows @ w).reshape(Y.shape)
    np.testing.assert_allclose(field.residual, residual, atol=SOLVE)


def test_data_and_ridge_may_change_after_the_fit(key):
    X, Y = data(N=60, n=2)
    K, solver = hk.Symplectic(hk.Gaussian(1.3)), RandomFeatures(20, key)
    model = solver.start(K, X).add(X[:30], Y[:30])
    before = model.field(1e-2)
    rows = np.asarray(before.features(X))
    w = numpy_weights(rows[:30], Y[:30], 1e-2)
    np.testing.assert_allclose(before(X[0]), rows[0] @ w, atol=SOLVE)
    after = model.add(X[30:], Y[30:]).field(1e-4)
    w = numpy_weights(rows, Y, 1e-4)
    np.testing.assert_allclose(after(X[0]), rows[0] @ w, atol=SOLVE)


def test_ridge_regression_in_many_tiles_is_least_squares_in_numpy():
    rng, ridge = np.random.default_rng(0), 1e-9
    # Columns of different scales, and rows that the sample, every tenth point, does not resemble.
    A = rng.normal(size=(10_000, 6)) * np.logspace(0, -5, 6)
    A[1::10] *= np.logspace(0, 3, 6)
    W, y = rng.normal(size=(6, 6)), rng.normal(size=(10_000, 1))
    rows, index = jnp.asarray(A)[:, None, :], jnp.arange(10_000)[:, None]
    w, residual, trace = ridge_regression(
        lambda X: rows[X[:, 0]], jnp.asarray(W), index, jnp.asarray(y), jnp.asarray(ridge)
    )
    below = np.concatenate([A @ W, np.sqrt(ridge) * np.eye(6)])
    expected = np.linalg.lstsq(below, np.append(y, np.zeros(6)))[0]
    np.testing.assert_allclose(w, expected, rtol=SOLVE)
    np.testing.assert_allclose(residual, y - A @ W @ expected[:, None], atol=ROUNDING)
    np.testing.assert_allclose(trace, np.sum((A @ W) ** 2), rtol=ROUNDING)


@pytest.mark.few(1)
@pytest.mark.parametrize("repeated", [1, 40])
def test_features_may_be_many_more_than_rows(key, repeated):
    X, Y = (jnp.tile(each, (repeated, 1)) for each in data(N=6, n=2))
    field = hk.fit(hk.Symplectic(hk.Gaussian(3.0)), X, Y, 1e-5, solver=RandomFeatures(600, key))
    rows = np.asarray(field.features(X)).reshape(X.size, -1)
    gram = rows @ rows.T + len(X) * 1e-5 * np.eye(X.size)
    w = rows.T @ np.linalg.solve(gram, np.asarray(Y).ravel())
    np.testing.assert_allclose(field.weights, w, atol=SOLVE * np.abs(w).max())


# Refusals.


def test_features_that_do_not_fit_in_memory_are_refused():
    X, Y = data(n=2)
    solver = RandomFeatures(10**7, jax.random.key(0))
    for ask in (lambda K: hk.fit(K, X, Y, solver=solver), lambda K: solver.start(K, X)):
        with pytest.raises(
            ValueError, match=r"count = 10000000 needs 2\.56e\+07 GB.*fewer features"
        ):
            ask(hk.Symplectic(hk.Gaussian(1.0)))


def test_the_memory_of_features_is_that_of_all_their_columns():
    # Six pairs of four coordinates, sines and cosines, two kernels: 24 columns for a frequency.
    X, Y = data(n=4)
    K = hk.DivergenceFree(hk.Gaussian(1.0) + hk.Gaussian(2.0))
    with pytest.raises(ValueError, match="8 matrices of 240000 by 240000"):
        hk.fit(K, X, Y, solver=RandomFeatures(10**4, jax.random.key(0)))


@pytest.mark.parametrize(
    ("k", "what"),
    [
        (lambda: hk.Polynomial(3), "Polynomial"),
        (lambda: hk.Warp(hk.Gaussian(1.0), jnp.sin), "Warp"),
        (lambda: lambda x, z: jnp.exp(x @ z), "UserKernel (<lambda>)"),
        (lambda: hk.Gaussian(1.0) + hk.Polynomial(2), "Polynomial"),
        (lambda: hk.Gaussian(1.0) * hk.Polynomial(2), "Polynomial"),
        (lambda: hk.Select(hk.Polynomial(2), 0), "Polynomial"),
    ],
)
def test_kernels_without_a_spectral_density_are_refused(k, what, key):
    X, Y = data()
    for K in (hk.Symplectic(k()), hk.Odd(hk.Separable(k()))):
        with pytest.raises(TypeError, match=f"cannot draw frequencies for {re.escape(what)}"):
            hk.fit(K, X, Y, solver=RandomFeatures(10, key))


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda key: of_any(0, key), ValueError, "count must be a whole number, at least 1; got 0"),
        (
            lambda key: of_any(2.5, key),
            TypeError,
            "count must be a whole number, at least 1; got 2.5",
        ),
        (
            lambda key: of_any(True, key),
            TypeError,
            "count must be a whole number, at least 1; got True",
        ),
        (lambda key: of_any(10, 3), TypeError, "a key of JAX, such as jax.random.key(0); got 3"),
        (
            lambda key: of_any(10, key).fit_chunks(hk.Symplectic(hk.Gaussian(1.0)), []),
            ValueError,
            "at least one chunk",
        ),
        (
            lambda key: of_any(10, key).start(hk.Symplectic(hk.Gaussian(1.0)), points(n=3)),
            ValueError,
            "even dimension, got n = 3",
        ),
        (
            lambda key: of_any(10, key).start(hk.CurlFree(hk.Gaussian(1.0)), points(n=3)).field(),
            ValueError,
            "no data yet",
        ),
        (
            lambda key: (
                RandomFeatures(10, key)
                .start(hk.CurlFree(hk.Gaussian(1.0)), points(n=3))
                .add(*data())
            ),
            ValueError,
            "the data have 4 coordinates and the fit 3",
        ),
        (
            lambda key: of_any(10, key).start(
                hk.CurlFree(hk.Gaussian(np.array([1.0, 2.0]))), points(n=3)
            ),
            ValueError,
            "2 lengthscales",
        ),
        (
            lambda key: of_any(10, key).start(
                hk.CurlFree(hk.Select(hk.Gaussian(1.0), 3)), points(n=3)
            ),
            ValueError,
            "Select has coordinates (3,)",
        ),
        (
            lambda key: of_any(10, key).start(hk.CurlFree(hk.Periodic(1.0, 0.01)), points(n=3)),
            ValueError,
            "at least 1/64",
        ),
        (
            lambda key: of_any(10, key).start(hk.Gaussian(1.0), points(n=3)),
            TypeError,
            "must be a matrix-valued kernel",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(call, error, text, key):
    with pytest.raises(error, match=re.escape(text)):
        call(key)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("structure", "text"),
    [(hk.Separable, "components are independent"), (hk.DivergenceFree, "matrix potential")],
)
def test_a_field_without_a_potential_says_why(structure, text, key):
    X, Y = data(n=2)
    field = hk.fit(structure(hk.Gaussian(1.0)), X, Y, solver=RandomFeatures(10, key))
    with pytest.raises(AttributeError, match=text):
        field.potential  # noqa: B018
    with pytest.raises(AttributeError, match="not Hamiltonian by construction"):
        field.hamiltonian  # noqa: B018


@pytest.mark.slow
def test_a_heavy_tail_of_frequencies_overflows_nowhere(key):
    X, Y = data(n=2)

    def size(alpha):
        K = hk.CurlFree(hk.RationalQuadratic(alpha))
        return hk.fit(K, X, Y, solver=RandomFeatures(50, key))(X[0]).sum()

    assert np.isfinite(size(0.01))
    assert np.isfinite(jax.grad(size)(0.01))


def test_a_key_of_the_older_kind_is_a_key():
    old, new = RandomFeatures(5, jax.random.PRNGKey(3)), RandomFeatures(5, jax.random.key(3))
    assert jax.random.key_data(old.key).tolist() == jax.random.key_data(new.key).tolist()
