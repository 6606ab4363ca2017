"""Low-rank validation losses against refits in NumPy, and `tune` with every solver."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import hamkernel as hk
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import measurements_of, measurements_of_states
from hamkernel._solvers.landmarks import given_landmarks, landmarks_of
from hamkernel._solvers.low_rank import LandmarkBasis
from hamkernel._validation import (
    features_of_rows,
    generalized_loss,
    held_out_rows,
    log_likelihood,
    partition_loss,
    partition_of_rows,
)

N, n, RIDGE = 30, 2, 1e-3
# Systems of condition 1e4.
ROUNDING = 1e-9


def data(N=N, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, size=(N, n))
    V = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1)
    return X, V + 0.05 * rng.normal(size=V.shape)


K = hk.Odd(hk.Symplectic(hk.Gaussian(1.2)))
X, Y = map(jnp.asarray, data())
ROWS = measurements_of_states(X, Y)
BASES = {
    "landmarks": LandmarkBasis(landmarks_of(Components(X[::5]))),
    "waves": hk.RandomFeatures(7, jax.random.key(3)),
}
FOLDS = {
    "loo": "loo",
    "5": 5,
    "2": 2,  # folds with more rows than there are features
    "labels": np.repeat(np.arange(6), 5),
    "one long": np.append(np.zeros(16, int), 1 + np.arange(14) // 2),
}


def rows_of(basis):
    return np.asarray(basis.span(K, n, X.dtype).rows_of(Components(X)))


@pytest.mark.few(1)
@pytest.mark.parametrize("folds", FOLDS)
@pytest.mark.parametrize("basis", BASES)
def test_the_loss_is_that_of_refits(basis, folds):
    partition = partition_of_rows(ROWS, FOLDS[folds])
    rows, y = rows_of(BASES[basis]), np.asarray(Y).ravel()
    names = np.unique(partition.labels)
    ridge = (N - N / len(names)) * RIDGE
    losses = []
    for name in names:
        out = partition.labels == name
        F, t = rows[~out], y[~out]
        w = np.linalg.solve(F.T @ F + ridge * np.eye(F.shape[1]), F.T @ t)
        losses.append(np.mean((y[out] - rows[out] @ w) ** 2))
    loss = partition_loss(K, ROWS, jnp.asarray(RIDGE), partition, BASES[basis])
    np.testing.assert_allclose(loss, np.mean(losses), rtol=ROUNDING)
    w = np.linalg.solve(rows.T @ rows + N * RIDGE * np.eye(rows.shape[1]), rows.T @ y)
    assert abs(np.mean((y - rows @ w) ** 2) / loss - 1) > 0.01  # the training error is another


@pytest.mark.parametrize("basis", BASES)
def test_likelihood_and_gcv_are_those_of_the_low_rank_gram(basis):
    rows, y = rows_of(BASES[basis]), np.asarray(Y).ravel()
    A = rows @ rows.T + N * RIDGE * np.eye(N * n)
    expected = multivariate_normal(np.zeros(N * n), A).logpdf(y)  # type: ignore[arg-type]
    found = log_likelihood(K, ROWS, jnp.asarray(RIDGE), BASES[basis])
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)
    a, trace = np.linalg.solve(A, y), np.trace(np.linalg.inv(A))
    found = generalized_loss(K, ROWS, jnp.asarray(RIDGE), BASES[basis])
    np.testing.assert_allclose(found, N * n * (a @ a) / trace**2, rtol=ROUNDING)


@pytest.mark.slow
def test_with_all_points_as_landmarks_it_is_the_dense_loss():
    # A ridge far above what the columns left out as dependent carry.
    partition = partition_of_rows(ROWS, 5)
    basis = LandmarkBasis(landmarks_of(Components(X)))
    found = partition_loss(K, ROWS, jnp.asarray(RIDGE), partition, basis)
    np.testing.assert_allclose(found, hk.cross_validation_loss(K, X, Y, RIDGE, 5), rtol=1e-7)
    few = partition_loss(
        K, ROWS, jnp.asarray(RIDGE), partition, LandmarkBasis(landmarks_of(Components(X[:2])))
    )
    assert abs(few / found - 1) > 0.1


@pytest.mark.few(1)
@pytest.mark.parametrize("folds", ["one long", "5", "2"])
@pytest.mark.parametrize("basis", BASES)
def test_gradients_are_those_of_finite_differences(basis, folds):
    partition = partition_of_rows(ROWS, FOLDS[folds])

    def loss(log_scale, log_ridge):
        kernel = hk.Odd(hk.Symplectic(hk.Gaussian(jnp.exp(log_scale))))
        return partition_loss(kernel, ROWS, jnp.exp(log_ridge), partition, BASES[basis])

    at = jnp.log(1.2), jnp.log(RIDGE)
    slopes = jax.grad(loss, (0, 1))(*at)
    h = 1e-5
    for i, slope in enumerate(slopes):
        up, down = (loss(*(v + s * h * (i == j) for j, v in enumerate(at))) for s in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-5)


def of_every_kind():
    """Rows of masked and noisy velocities, noisy energies, functionals and an equilibrium."""
    rng = np.random.default_rng(0)
    V = np.array(Y[:14])
    V[3, 0], V[5] = np.nan, np.nan
    E = np.asarray(X[20:26, 1] ** 2 / 2 - jnp.cos(X[20:26, 0])) + 3.7
    data = (
        hk.Velocities(X[:14], V, noise=rng.uniform(0.5, 2, size=(14, 2)))
        + hk.Energies(X[20:26], E, noise=rng.uniform(0.5, 2, size=6))
        + hk.Functionals(X[:12].reshape(4, 3, 2), rng.normal(size=(4, 3, 2)), rng.normal(size=4))
        + hk.Equilibria(np.zeros(2))
    )
    return measurements_of(K, data)[1]


ENERGIES_TOGETHER = np.repeat([0, 1, 2, 3, 4], [6, 4, 10, 3, 2])  # of 14 + 6 + 4 + 1


@pytest.mark.slow
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("waves", "folds"), [(4, 5), (30, ENERGIES_TOGETHER), (30, 5), (4, ENERGIES_TOGETHER)]
)
def test_held_out_observations_are_those_of_refits_with_a_constant_of_their_own(waves, folds):
    rows, K = of_every_kind(), hk.Symplectic(1.3 * hk.Gaussian(1.2))
    basis, partition = hk.RandomFeatures(waves, jax.random.key(0)), partition_of_rows(rows, folds)
    ridge, y = rows.count * (1 - 1 / 5) * RIDGE, np.asarray(rows.targets)
    F = np.asarray(features_of_rows(K, rows, basis))
    # The energies have one more column, whose weight costs nothing.
    columns = np.column_stack([F, np.zeros(len(y))])
    columns[rows.energies, -1] = 1 / np.asarray(rows.scale)[rows.energies]
    penalty = np.diag(np.append(np.full(F.shape[1], ridge), 0.0))
    expected = np.zeros_like(y)
    for fold in range(5):
        out = partition.labels == fold
        A, t = columns[~out], y[~out]
        w = np.linalg.lstsq(A.T @ A + penalty, A.T @ t)[0]
        expected[out] = y[out] - columns[out] @ w
        if not A[:, -1].any():  # then the constant that suits the energies held out best
            p = columns[out, -1]
            expected[out] -= p * (p @ expected[out]) / (p @ p)
    found, _ = held_out_rows(K, rows, jnp.asarray(RIDGE), partition, basis)
    np.testing.assert_allclose(found, expected, atol=ROUNDING * abs(expected).max())


LOSSES = {
    "folds": lambda K, rows, ridge, basis: partition_loss(
        K, rows, ridge, partition_of_rows(rows, 5), basis
    ),
    "generalized": generalized_loss,
    "likelihood": log_likelihood,
}


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_of_observations_are_those_of_finite_differences(loss):
    rows, basis = of_every_kind(), LandmarkBasis(landmarks_of(Components(X[::8])))

    def value(log_scale, log_ridge):
        K = hk.Symplectic(1.3 * hk.Gaussian(jnp.exp(log_scale)))
        return LOSSES[loss](K, rows, jnp.exp(log_ridge), basis)

    at, h = (jnp.log(1.2), jnp.log(RIDGE)), 1e-5
    for i, slope in enumerate(jax.grad(value, (0, 1))(*at)):
        up, down = (value(*(v + s * h * (i == j) for j, v in enumerate(at))) for s in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-5)


def test_dependent_columns_are_found():
    rng = np.random.default_rng(1)
    F = rng.normal(size=(6, 4))
    F[3], F[5] = 2 * F[0], F[1] - F[2]
    landmarks = given_landmarks(
        hk.Separable(lambda x, z: x @ z), landmarks_of(Components(jnp.asarray(F)))
    )
    kept = np.asarray(landmarks.kept).reshape(F.shape)[:, 0]
    assert kept.sum() == np.linalg.matrix_rank(F[kept]) == np.linalg.matrix_rank(F) == 4


def test_columns_kept_of_many_close_points_are_independent_and_span_the_others():
    # The Gram of 200 points in the plane, of numerical rank 120 or so.
    S, smooth = data(200)[0], hk.Symplectic(hk.Gaussian(1.5))
    kept = np.asarray(given_landmarks(smooth, landmarks_of(Components(jnp.asarray(S)))).kept)
    G = np.asarray(hk.gram(smooth, S)).reshape(S.size, S.size)
    np.linalg.cholesky(G[np.ix_(kept, kept)])  # raises where a column depends on others
    across = G[np.ix_(kept, ~kept)]
    left = G[np.ix_(~kept, ~kept)] - across.T @ np.linalg.solve(G[np.ix_(kept, kept)], across)
    assert np.abs(np.diag(left)).max() < 1e-11 < 1e-2 < G.diagonal().max()
    assert 50 < kept.sum() < 200


@pytest.mark.slow
def test_where_no_landmark_can_be_used_the_losses_are_infinite():
    # A fit is refused then; without columns it would be the zero field.
    for sign in (1.0, -1.0):
        K = hk.Symplectic(lambda x, z, sign=sign: sign * jnp.exp(-((x - z) @ (x - z))))
        given, basis = (K, ROWS, jnp.asarray(1e-3)), LandmarkBasis(landmarks_of(Components(X[:3])))
        folds = partition_loss(*given, partition_of_rows(ROWS, 3), basis)
        losses = folds, generalized_loss(*given, basis), -log_likelihood(*given, basis)
        assert all(np.isfinite(loss) if sign > 0 else loss == np.inf for loss in losses)


SOLVERS = {
    "nystrom": hk.Nystrom(),
    "features": hk.RandomFeatures(75, jax.random.key(0)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "objective"),
    [("nystrom", "cross_validation"), ("features", "marginal_likelihood")],
)
def test_tuning_with_low_rank_comes_to_the_optimum_of_the_dense_loss(
    solver, objective, monkeypatch
):
    X, Y = data(120, seed=2)
    start = hk.Symplectic(hk.Gaussian(0.4))
    with monkeypatch.context() as small:  # too small for the dense loss
        small.setattr("hamkernel._machine.memory_bytes", lambda: 1_500_000)
        options: Any = {"objective": objective, "starts": 3}
        tuned = hk.tune(start, X, Y, 0.1, 5, solver=SOLVERS[solver], **options)
    dense = hk.tune(start, X, Y, 0.1, 5, **options)

    def value(t):
        if objective == "cross_validation":
            return float(hk.cross_validation_loss(t.kernel, X, Y, t.regularization, 5))
        return -float(hk.log_marginal_likelihood(t.kernel, X, Y, t.regularization))

    # The loss of a low-rank fit is another function, close to the dense one: 5 % of it, or of
    # a log density of about a hundred.
    assert value(tuned) <= value(dense) + 0.05 * abs(value(dense))
    at_start = float(hk.cross_validation_loss(start, X, Y, 0.1, 5))
    new = data(200, seed=5)[0]
    truth = np.stack([new[:, 1], -np.sin(new[:, 0])], axis=1)
    error = np.sqrt(np.mean((tuned.field.evaluate(new) - truth) ** 2))
    assert error**2 < 0.1 * at_start
    assert type(tuned.field) is type(hk.fit(start, X, Y, 0.1, solver=SOLVERS[solver]))


@pytest.mark.slow
def test_the_loss_of_few_points_is_that_of_the_low_rank_fit_too():
    solver = hk.RandomFeatures(5, jax.random.key(1))
    tuned = hk.tune(hk.Symplectic(hk.Gaussian(1.0)), X, Y, 1e-2, 5, starts=1, solver=solver)
    losses = []
    for out in np.arange(N).reshape(5, -1):
        rest = np.setdiff1d(np.arange(N), out)
        # Without a fold the ridge is (N − N/5) λ, and so is that of the rest alone.
        field = hk.fit(tuned.kernel, X[rest], Y[rest], tuned.regularization, solver=solver)
        losses.append(np.mean((field.evaluate(X[out]) - Y[out]) ** 2))
    np.testing.assert_allclose(tuned.loss, np.mean(losses), rtol=1e-6)


@pytest.mark.slow
def test_observations_are_tuned_in_low_rank_where_the_dense_loss_does_not_fit(monkeypatch):
    # Half of the components, and energies: 260 rows.
    X, Y = data(200, seed=3)
    masked = np.where(np.arange(Y.size).reshape(Y.shape) % 2 == 0, Y, np.nan)
    observed = hk.Velocities(X, masked) + hk.Energies(
        X[:60], X[:60, 1] ** 2 / 2 - np.cos(X[:60, 0])
    )
    monkeypatch.setattr("hamkernel._machine.memory_bytes", lambda: 1_500_000)
    start, solver = hk.Symplectic(hk.Gaussian(0.4)), hk.RandomFeatures(60, jax.random.key(0))
    tuned = hk.tune(start, observed, regularization=0.1, starts=2, solver=solver)
    new = data(200, seed=5)[0]
    truth = np.stack([new[:, 1], -np.sin(new[:, 0])], axis=1)
    errors = [
        np.linalg.norm(f.evaluate(new) - truth) / np.linalg.norm(truth)
        for f in (tuned.field, hk.fit(start, observed, regularization=0.1, solver=solver))
    ]
    assert errors[0] < 0.05 < errors[1]
    with pytest.raises(ValueError, match=r"hk.Nystrom\(\)"):
        hk.tune(start, observed, regularization=0.1, starts=2)


def test_a_dense_loss_that_does_not_fit_is_refused_before_the_search(monkeypatch):
    X, Y = data(120)
    monkeypatch.setattr("hamkernel._machine.memory_bytes", lambda: 100_000)
    with pytest.raises(ValueError, match=r"hk.Nystrom\(\)"):
        hk.tune(K, X, Y, 1e-3, 5)
    with pytest.raises(ValueError, match="3 matrices of 240 by 240"):
        hk.cross_validation_loss(K, X, Y, 1e-3, 5)


@pytest.mark.slow
def test_what_does_not_fit_densely_is_tuned_with_low_rank(monkeypatch):
    X, Y = data(120)
    monkeypatch.setattr("hamkernel._machine.memory_bytes", lambda: 100_000)
    assert np.isfinite(hk.tune(K, X, Y, 1e-3, 5, starts=2, solver=hk.Nystrom()).loss)
