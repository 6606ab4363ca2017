"""Inputs in every solver, kind of observation, mean, posterior and file."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._features import features

GAIN = hk.InputMatrix(0.8 * hk.Gaussian(0.9), acts_on=(1,))
K = hk.Controlled(hk.Symplectic(2.0 * hk.Gaussian(1.3)), GAIN)
RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(2, 9, 2))
U = RNG.normal(size=(9, 2))
x, u = RNG.normal(size=(2, 2))
J = np.array([[0.0, 1.0], [-1.0, 0.0]])
RIDGE = 1e-2


# The Gaussian process in NumPy: H ~ GP(0, 2 exp(−d²/2·1.3²)), G₂ⱼ ~ GP(0, 0.8 exp(−d²/2·0.9²)).


def scalar(x, z):
    return 2.0 * np.exp(-np.sum((x - z) ** 2) / (2 * 1.3**2))


def blocks(s, t):
    """The covariance of (H(x), f(x, u)) with (H(z), f(z, v)), shape (3, 3)."""
    (x, u), (z, v), ell = (s[:2], s[2:]), (t[:2], t[2:]), 1.3**2
    k, d = scalar(x, z), (x - z) / ell
    gain = 0.8 * np.exp(-np.sum((x - z) ** 2) / (2 * 0.9**2)) * (u @ v)
    mixed = k * (np.eye(2) / ell - np.outer(d, d))
    out = np.empty((3, 3))
    out[0, 0], out[0, 1:], out[1:, 0] = k, J @ (k * d), J @ (-k * d)
    out[1:, 1:] = J @ mixed @ J.T + gain * np.diag([0.0, 1.0])
    return out


def covariance(S, T):
    return np.block([[blocks(s, t) for t in T] for s in S])


def given(L, targets, variances, S, T):
    """Mean and covariance of all of (H, f) at T, given L (H, f)(S) = targets + noise."""
    A = L @ covariance(S, S) @ L.T + np.diag(variances)
    across = covariance(T, S) @ L.T
    mean = across @ np.linalg.solve(A, targets)
    return mean, covariance(T, T) - across @ np.linalg.solve(A, across.T)


def velocity_rows(N):
    return np.delete(np.eye(3 * N), 3 * np.arange(N), axis=0)


S = np.hstack([X, U])
HERE = np.stack([np.r_[x, u], np.r_[X[0] + 0.1, 0, 0]])
EXACT = given(velocity_rows(9), Y.ravel(), np.full(18, 9 * RIDGE), S, HERE)


def deviations(posterior):
    """What a posterior says at the two points `HERE`."""
    covariance = posterior.covariance(x, u)
    return covariance, posterior.energy_deviation(x, HERE[1, :2])


def expected_deviations(C):
    """The same of a joint covariance of (H, f) at the two points."""
    return C[1:3, 1:3], np.sqrt(C[0, 0] - 2 * C[0, 3] + C[3, 3])


def agrees(posterior, exact, tolerance):
    mean, C = exact
    np.testing.assert_allclose(posterior.field(x, u), mean[1:3], rtol=tolerance, atol=tolerance)
    H = posterior.field.hamiltonian
    np.testing.assert_allclose(H(x) - H(HERE[1, :2]), mean[0] - mean[3], atol=tolerance)
    found = deviations(posterior)
    for own, theirs in zip(found, expected_deviations(C), strict=True):
        np.testing.assert_allclose(own, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
def test_the_posterior_is_that_of_gaussian_conditioning():
    posterior = hk.condition(K, X, Y, RIDGE, inputs=U)
    agrees(posterior, EXACT, 1e-9)
    np.testing.assert_allclose(
        posterior.deviation(x, u) ** 2, np.diag(posterior.covariance(x, u)), rtol=1e-12
    )
    some = hk.condition(K, X[:7], Y[:7], 9 / 7 * RIDGE, inputs=U[:7])
    agrees(some.updated(X[7:], Y[7:], inputs=U[7:]), EXACT, 1e-9)
    landmarks = hk.condition(K, X, Y, RIDGE, inputs=U, solver=hk.Nystrom(1e-9))
    agrees(landmarks, EXACT, 1e-5)


@pytest.mark.slow
def test_all_observations_with_inputs_are_functionals_of_the_same_process():
    masked = Y.copy()
    masked[2, 0] = masked[5, 1] = np.nan
    weights = RNG.normal(size=(2, 3, 2))
    data = (
        hk.Velocities(X, masked, noise=[1.0, 0.3], inputs=U)
        + hk.Equilibria(X[:1] + 1, inputs=U[:1])
        + hk.Functionals(X[:6].reshape(2, 3, 2), weights, [0.3, -0.2], U[:6].reshape(2, 3, 2))
        + hk.Energies(X[3:6], [0.1, 0.7, -0.4], noise=0.5)
    )
    points = np.vstack([S, np.r_[X[0] + 1, U[0]], S[:6], np.hstack([X[3:6], np.zeros((3, 2))])])
    rows = np.eye(3 * len(points)).reshape(len(points), 3, -1)
    L = list(rows[:9, 1:].reshape(18, -1)[~np.isnan(masked).ravel()]) + list(rows[9, 1:])
    L += [np.einsum("qa,qas->s", weights[r], rows[10 + 3 * r : 13 + 3 * r, 1:]) for r in (0, 1)]
    energies = rows[16:, 0]
    L += [energies[1] - energies[0], energies[2] - energies[0]]
    N = 9 + 1 + 2 + 3
    noise = np.tile([1.0, 0.3], 9)[~np.isnan(masked).ravel()]
    Sigma = np.diag(np.r_[noise**2, np.ones(4), np.zeros(2)])
    Sigma[-2:, -2:] = 0.25 * (1 + np.eye(2))  # of differences with the first energy
    targets = np.r_[masked[~np.isnan(masked)], 0, 0, 0.3, -0.2, 0.6, -0.5]
    L = np.array(L)
    A = L @ covariance(points, points) @ L.T + N * RIDGE * Sigma
    across = covariance(HERE, points) @ L.T
    exact = (
        across @ np.linalg.solve(A, targets),
        covariance(HERE, HERE) - across @ np.linalg.solve(A, across.T),
    )
    agrees(hk.condition(K, data, regularization=RIDGE), exact, 1e-8)
    found = hk.fit(K, data, regularization=RIDGE, solver=hk.ConjugateGradient(1e-12))
    np.testing.assert_allclose(found(x, u), exact[0][1:3], atol=1e-8)


@pytest.mark.slow
def test_random_features_are_those_of_drift_and_input_matrix():
    key = jax.random.key(0)
    T = jnp.asarray(S[:4])
    K = hk.Controlled(hk.Symplectic(2.0 * hk.Gaussian(1.3)), GAIN, count=2)
    exact = hk.gram(K, T).reshape(8, 8)

    def error(K, count, exact):
        rows = features(K, 4, count, key, T.dtype)(T).reshape(8, -1)
        return float(jnp.abs(rows @ rows.T - exact).max() / jnp.abs(exact).max())

    assert error(K, 8000, exact) < 0.05 < error(K, 20, exact)
    constant = hk.Controlled(hk.Symplectic(hk.Gaussian(1.3)), hk.InputMatrix(0.7), count=2)
    gain = np.kron(U[:4] @ U[:4].T, 0.7 * np.eye(2))  # of which there is one frequency, exactly
    features_of_gain = features(constant, 4, 5, key, T.dtype)(T).reshape(8, -1)[:, 10:]
    assert features_of_gain.shape == (8, 4)
    np.testing.assert_allclose(features_of_gain @ features_of_gain.T, gain, atol=1e-14)


@pytest.mark.slow
def test_a_field_of_random_features_is_the_ridge_regression_in_them():
    solver = hk.RandomFeatures(20, jax.random.key(1))
    field = hk.fit(K, X, Y, RIDGE, inputs=U, solver=solver)
    F = np.asarray(field.whole.features(jnp.asarray(S)).reshape(18, -1))
    w = np.linalg.solve(F.T @ F + 9 * RIDGE * np.eye(F.shape[1]), F.T @ Y.ravel())
    rows = np.asarray(field.whole.features.rows(jnp.asarray(HERE[0])))
    np.testing.assert_allclose(field(x, u), rows @ w, atol=1e-10)
    np.testing.assert_allclose(field.drift(x) + field.input_matrix(x) @ u, rows @ w, atol=1e-10)
    np.testing.assert_array_equal(field.input_matrix(x)[0], 0.0)
    slope = jax.grad(field.hamiltonian)(jnp.asarray(x))
    np.testing.assert_allclose(field.drift(x), J @ slope, atol=1e-12)
    np.testing.assert_allclose(field.evaluate(X, U), (F @ w).reshape(9, 2), atol=1e-9)
    posterior = hk.condition(K, X, Y, RIDGE, inputs=U, solver=solver)
    np.testing.assert_allclose(posterior.field(x, u), rows @ w, atol=1e-9)
    C = 9 * RIDGE * rows @ np.linalg.solve(F.T @ F + 9 * RIDGE * np.eye(F.shape[1]), rows.T)
    np.testing.assert_allclose(posterior.covariance(x, u), C, atol=1e-10)
    model = solver.start(K, X, RIDGE, inputs=U)
    streamed = model.add(X[:4], Y[:4], U[:4]).add(X[4:], Y[4:], inputs=U[4:]).field()
    np.testing.assert_allclose(streamed(x, u), rows @ w, atol=1e-9)


KNOWN = hk.Controlled(hk.Symplectic(hk.Gaussian(1.3)), [[0.0, 0.5], [1.0, -0.3]])


@pytest.mark.slow
def test_streams_on_landmarks_are_fits_on_the_same_landmarks():
    for kernel in (K, KNOWN):
        solver = hk.Nystrom(100.0, points=S[:7])
        chunks = [(X[:4], Y[:4], U[:4]), (X[4:], Y[4:], U[4:])]
        field = solver.fit_chunks(kernel, chunks, RIDGE, sample=X, inputs=U)
        once = hk.fit(kernel, X, Y, RIDGE, inputs=U, solver=solver)
        np.testing.assert_allclose(field(x, u), once(x, u), atol=1e-8)
        np.testing.assert_allclose(field.input_matrix(x), once.input_matrix(x), atol=1e-8)


PENDULUM = hk.systems.Driven(hk.systems.Pendulum(1.0, 1.0, 1.0), [[0.0, 0.0], [1.0, 0.2]])


def sway(x):
    return jnp.array([0.1 * x[1], -jnp.sin(x[0])])


def push(x, u):
    return jnp.array([x[1], u[0] * jnp.cos(x[0]) + u[1] ** 2])  # which is not affine in u


@pytest.mark.parametrize("mean", [sway, push, PENDULUM], ids=["of x", "of x and u", "system"])
@pytest.mark.few(1)
def test_a_mean_is_taken_off_the_data_and_added_to_the_field(mean):
    def at(x, u):
        return mean(jnp.asarray(x)) if mean is sway else mean(jnp.asarray(x), jnp.asarray(u))

    less = Y - np.array([at(a, b) for a, b in zip(X, U, strict=True)])
    rest = hk.fit(K, X, less, RIDGE, inputs=U)
    field = hk.fit(K, X, Y, RIDGE, inputs=U, mean=mean)
    np.testing.assert_allclose(field(x, u), rest(x, u) + at(x, u), atol=1e-12)
    np.testing.assert_allclose(field.drift(x), rest.drift(x) + at(x, 0 * u), atol=1e-12)
    slope = jax.jacfwd(lambda u: jnp.asarray(at(x, u)))(jnp.zeros(2))
    np.testing.assert_allclose(field.input_matrix(x), rest.input_matrix(x) + slope, atol=1e-12)
    np.testing.assert_allclose(field.evaluate(X, U), jax.vmap(field)(X, U), atol=1e-12)
    posterior = hk.condition(K, X, Y, RIDGE, inputs=U, mean=mean)
    np.testing.assert_allclose(posterior.field(x, u), field(x, u), atol=1e-10)
    if mean is PENDULUM:
        energy = rest.hamiltonian(x) + mean.drift.hamiltonian(x)
        np.testing.assert_allclose(field.hamiltonian(x), energy, atol=1e-12)
        assert posterior.energy_deviation(x, X[0]) > 0
    else:
        with pytest.raises(AttributeError, match="has no potential"):
            field.hamiltonian(x)


@pytest.mark.slow
def test_a_known_input_matrix_is_a_mean():
    field = hk.fit(KNOWN, X, Y, RIDGE, inputs=U, mean=sway)
    matrix = np.array([[0.0, 0.5], [1.0, -0.3]])

    def mean(x, u):
        return sway(x) + jnp.asarray(matrix) @ u

    less = Y - np.array([mean(a, b) for a, b in zip(X, U, strict=True)])
    rest = hk.fit(hk.Symplectic(hk.Gaussian(1.3)), X, less, RIDGE)
    np.testing.assert_allclose(field(x, u), rest(x) + mean(x, u), atol=1e-12)
    np.testing.assert_array_equal(field.input_matrix(x), matrix)
    data = hk.Velocities(X, Y, inputs=U) + hk.Energies(X[:2], [0.0, 1.0])
    other = hk.Velocities(X, Y - U @ matrix.T) + hk.Energies(X[:2], [0.0, 1.0])
    np.testing.assert_allclose(
        hk.fit(KNOWN, data, regularization=RIDGE).drift(x),
        hk.fit(hk.Symplectic(hk.Gaussian(1.3)), other, regularization=RIDGE)(x),
        atol=1e-11,
    )


@pytest.mark.slow
def test_an_objective_of_ones_own_gets_the_data_with_its_inputs():
    def objective(K, X, Y, regularization):
        assert Y is None
        assert X.inputs.shape == (9, 2)
        return hk.cross_validation_loss(K, X, Y, regularization, folds="loo")

    options = {"inputs": U, "starts": 1, "max_steps": 3, "folds": "loo", "frozen": "scale"}
    own = hk.tune(K, X, Y, objective=objective, **options)
    assert float(own.loss) <= float(hk.cross_validation_loss(K, X, Y, 1e-3, "loo", inputs=U))
    meant = hk.tune(K, X, Y, mean=push, **options)
    again = hk.fit(meant.kernel, X, Y, meant.regularization, inputs=U, mean=push)
    np.testing.assert_allclose(meant.field(x, u), again(x, u), rtol=1e-9)


def test_a_draw_is_affine_in_its_inputs_and_has_a_hamiltonian():
    x, u = np.array([-1.28, 0.39]), np.array([7.0, -5.0])
    draws = hk.condition(K, X, Y, RIDGE, inputs=U).sample(jax.random.key(0), 1)
    draw = jax.tree.map(lambda leaf: leaf[0], draws)
    np.testing.assert_allclose(draw(x, u / 2), draw(x, 0 * u) / 2 + draw(x, u) / 2, atol=1e-9)
    slope = jax.grad(draw.hamiltonian)(jnp.asarray(x))
    np.testing.assert_allclose(draw.drift(x), J @ slope, atol=1e-9)


COUNT = 200


@pytest.mark.slow
def test_draws_have_the_mean_and_the_covariance_of_the_posterior_at_every_input():
    region = np.array([[-1.5, -1.0], [1.0, 1.0]])
    x = np.array([-1.28, 0.39])
    far = np.array([7.0, -5.0])  # far outside of the inputs seen: a draw is affine in u
    mean, C = given(velocity_rows(9), Y.ravel(), np.full(18, 9 * RIDGE), S, [np.r_[x, far]])
    for solver in (hk.Cholesky(), hk.Nystrom(1e-8)):
        posterior = hk.condition(K, X, Y, RIDGE, inputs=U, solver=solver)
        draws = posterior.sample(jax.random.key(0), COUNT, region)
        values = np.asarray(eqx.filter_jit(jax.vmap(lambda f: f(x, far)))(draws))
        # In units of their spread, whitened: mean 0 ± 1/√N, covariance I ± √(1 or 2)/√N.
        white = np.linalg.solve(np.linalg.cholesky(C[1:, 1:]), (values - mean[1:]).T)
        assert np.abs(white.mean(axis=1)).max() < 4 / np.sqrt(COUNT)
        assert np.abs(white @ white.T / COUNT - np.eye(2)).max() < 4 * np.sqrt(2 / COUNT)


SOLVERS = {
    "dense": None,
    "landmarks": hk.Nystrom(1e-3),
    "features": hk.RandomFeatures(10, jax.random.key(0)),
}


@pytest.mark.slow
def test_fields_of_every_solver_come_back_from_files(tmp_path):
    file = tmp_path / "field.npz"
    for solver in SOLVERS.values():
        field = hk.fit(K, X, Y, RIDGE, inputs=U, solver=solver, mean=PENDULUM)
        for each in (field, field.drift):
            hk.save(file, each)
            back = hk.load(file)
            at = (x, u) if each is field else (x,)
            np.testing.assert_array_equal(back(*at), each(*at))
            np.testing.assert_array_equal(back.hamiltonian(x), each.hamiltonian(x))
    own = hk.fit(K, X, Y, RIDGE, inputs=U, mean=push)
    for each, at in ((own, (x, u)), (own.drift, (x,))):
        hk.save(file, each)
        np.testing.assert_array_equal(hk.load(file, mean=push)(*at), each(*at))
    with pytest.raises(ValueError, match="Pass the mean"):
        hk.load(file)


# Bad input.

DATA = hk.Velocities(X, Y, inputs=U)


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.condition(K, X, Y, RIDGE), ValueError, "inputs of Velocities are missing"),
        (lambda: hk.fit(K, hk.Equilibria(X) + DATA), ValueError, "of Equilibria are missing"),
        (lambda: hk.fit(K, DATA, inputs=U), TypeError, "observations contain their inputs"),
        (lambda: hk.fit(hk.Symplectic(hk.Gaussian()), DATA), TypeError, "takes no inputs"),
        (lambda: hk.Velocities(X, Y, inputs=U[:3]), ValueError, r"shape \(3, 2\)"),
        (lambda: hk.Equilibria(X[0], inputs=[1.0, np.inf]), ValueError, "NaN or inf"),
        (
            lambda: hk.fit(K, DATA + hk.Equilibria(X, inputs=U[:, :1])),
            ValueError,
            r"have \[1, 2\] inputs",
        ),
        (lambda: hk.fit(K, hk.Velocities(X, Y, inputs=0 * U)), ValueError, "have rank 0"),
        (lambda: hk.fit(K, hk.Energies(X, X[:, 0])), ValueError, "number of inputs"),
        (lambda: K + hk.Separable(hk.Gaussian()), TypeError, "add the drifts"),
        (
            lambda: hk.fit(K, X, Y, inputs=U, mean=lambda x, u: u[:1]),
            ValueError,
            "mean maps a state of shape",
        ),
        (
            lambda: hk.fit(hk.Symplectic(hk.Gaussian()), X, Y, mean=push),
            TypeError,
            r"mean takes \(x, u\)",
        ),
        (
            lambda: SOLVERS["features"].start(K, X, RIDGE),
            ValueError,
            "inputs of Equilibria are missing",
        ),
        (
            lambda: hk.Nystrom().fit_chunks(K, [(X, Y)], RIDGE),
            ValueError,
            "are missing",
        ),
    ],
)
def test_what_cannot_be_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_a_posterior_says_which_inputs_it_needs():
    posterior = hk.condition(K, X, Y, RIDGE, inputs=U)
    with pytest.raises(ValueError, match="needs its inputs"):
        posterior.deviation(x)
    with pytest.raises(ValueError, match="inputs of Velocities are missing"):
        posterior.updated(X, Y)
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        posterior.sample(jax.random.key(0), 2, np.zeros((2, 4)))
    plain = hk.condition(hk.Symplectic(2.0 * hk.Gaussian()), X, Y, RIDGE)
    with pytest.raises(TypeError, match="has no inputs"):
        plain.covariance(x, u)
