"""The posterior against closed forms, against itself differentiated, and against its own draws.

The closed forms of means and variances for every kind of observation are in `test_observations.py`.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import canonical

import hamkernel as hk
from hamkernel._observations.blocks import Values

SOLVE = 1e-9
PENDULUM = hk.systems.Pendulum()
K = hk.Symplectic(3.0 * hk.Gaussian(1.5))
REGION = np.array([[-2.5, -2.5], [2.5, 2.5]])
X0 = np.zeros(2)
INSIDE, OUTSIDE = np.array([0.3, -0.4]), np.array([2.2, 6.0])


def data(N, seed=0):
    X = np.random.default_rng(seed).uniform(-2, 2, (N, 2))
    return X, np.array(jax.vmap(PENDULUM)(X))


X, Y = data(12)
ENERGIES = hk.Energies(data(6, 1)[0], jax.vmap(PENDULUM.hamiltonian)(data(6, 1)[0]))
RIDGE = 1e-3
POSTERIOR = hk.condition(K, X, Y, RIDGE)
BOTH = hk.condition(K, hk.Velocities(X, Y) + ENERGIES, regularization=RIDGE)


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [None, hk.Nystrom()], ids=["exact", "low rank"])
def test_the_covariance_of_two_states_is_the_recipe_of_the_readme(solver):
    """K(x, x₂) − K(x, X)(G + NλI)⁻¹K(X, x₂), by the Gram and NumPy."""
    A = np.asarray(hk.gram(K, X)).reshape(24, 24) + 12 * RIDGE * np.eye(24)
    left, right = (hk.gram(K, at[None], X)[0].reshape(2, -1) for at in (INSIDE, OUTSIDE))
    expected = np.asarray(K(INSIDE, OUTSIDE)) - left @ np.linalg.solve(A, right.T)
    posterior = POSTERIOR if solver is None else hk.condition(K, X, Y, RIDGE, solver=solver)
    found = posterior.covariance(INSIDE, x2=OUTSIDE)
    np.testing.assert_allclose(found, expected, atol=1e-10 if solver is None else 1e-5)
    np.testing.assert_allclose(posterior.covariance(OUTSIDE, x2=INSIDE), found.T, atol=1e-12)


def test_chi_squared_is_the_quadratic_form_of_the_rows():
    A = np.asarray(hk.gram(K, X)).reshape(24, 24) + 12 * RIDGE * np.eye(24)
    y = Y.ravel()
    np.testing.assert_allclose(POSTERIOR.chi_squared, y @ np.linalg.solve(A, y) / 24, rtol=1e-8)
    noisy = hk.condition(K, hk.Velocities(X, Y, noise=2.0), regularization=RIDGE / 4)
    np.testing.assert_allclose(noisy.chi_squared, POSTERIOR.chi_squared, rtol=1e-8)
    # An amplitude that is a hundred times too small in variance.
    weak = hk.condition(hk.Symplectic(0.03 * hk.Gaussian(1.5)), X, Y, 1e-6)
    assert weak.chi_squared > 10
    assert "deviations are too small" in repr(weak)


def test_a_second_state_in_the_place_of_inputs_is_refused_with_the_keyword():
    with pytest.raises(TypeError, match=r"has no inputs.*posterior\.covariance\(x, x2=z\)"):
        POSTERIOR.covariance(INSIDE, OUTSIDE)
    with pytest.raises(TypeError, match="u2 came without x2"):
        POSTERIOR.covariance(INSIDE, u2=OUTSIDE)


def test_the_warning_of_an_amplitude_of_one_is_told_to_scale_only_what_is_not_scaled():
    with pytest.warns(UserWarning, match=r"Tune 1\.0 \* Gaussian"):
        hk.condition(hk.Symplectic(hk.Gaussian(1.5)), X, Y, RIDGE)
    with pytest.warns(UserWarning, match=r"1 \* Gaussian.* is exactly 1.*Tune the amplitude by"):
        hk.condition(hk.Symplectic(1.0 * hk.Gaussian(1.5)), X, Y, RIDGE)


@pytest.mark.few(1)
@pytest.mark.parametrize("posterior", [POSTERIOR, BOTH], ids=["velocities", "energies"])
def test_the_covariance_of_energies_differentiated_twice_is_that_of_the_field(posterior):
    def energies(x, z):
        pair = [Values(point[None]) for point in (x, z)]
        return posterior.conditional.covariance(*pair)[0, 0]

    J = canonical(2)
    x = jnp.asarray(INSIDE)
    mixed = jax.jit(jax.jacfwd(jax.jacfwd(energies, 0), 1))(x, x)
    np.testing.assert_allclose(J @ mixed @ J.T, posterior.covariance(x), atol=1e-8)


@pytest.mark.slow
def test_variances_are_positive_and_vanish_where_nothing_is_unknown():
    close = hk.condition(K, X, Y, 1e-12)
    for posterior in (POSTERIOR, BOTH, close):
        points = jnp.asarray(np.concatenate([X, data(20, 5)[0]]))
        deviations = jax.vmap(posterior.deviation)(points)
        energy = jax.vmap(posterior.energy_deviation, in_axes=(0, None))(points, points[0])
        assert (deviations >= 0).all()
        assert (energy >= 0).all()
        assert energy[0] == 0
    assert jax.vmap(close.deviation)(jnp.asarray(X)).max() < 1e-3


def test_more_is_unknown_farther_away_up_to_the_prior():
    prior = np.sqrt(np.diagonal(K(INSIDE, INSIDE)))
    near, far = POSTERIOR.deviation(INSIDE), POSTERIOR.deviation(100 * OUTSIDE)
    assert (near < 0.2 * prior).all()
    np.testing.assert_allclose(far, prior, rtol=1e-10)


@pytest.mark.slow
def test_deviations_can_be_differentiated_mapped_and_compiled():
    x, h = jnp.asarray(INSIDE), 1e-6
    slope = jax.jit(jax.grad(lambda x: BOTH.deviation(x).sum()))(x)
    for e, got in zip(np.eye(2), slope, strict=True):
        change = BOTH.deviation(x + h * e).sum() - BOTH.deviation(x - h * e).sum()
        np.testing.assert_allclose(got, change / (2 * h), rtol=1e-6)
    mapped = jax.vmap(jax.jit(BOTH.deviation))(jnp.stack([x, x]))
    np.testing.assert_allclose(mapped[1], BOTH.deviation(x), rtol=SOLVE)


def same(one, other, rtol=SOLVE):
    for x in (INSIDE, OUTSIDE):
        np.testing.assert_allclose(one.field(x), other.field(x), rtol=rtol, atol=rtol)
        np.testing.assert_allclose(one.covariance(x), other.covariance(x), rtol=rtol, atol=rtol)
        energies = [each.energy_deviation(x, X0) for each in (one, other)]
        np.testing.assert_allclose(*energies, rtol=rtol)


MEAN = hk.systems.HarmonicOscillator()


@pytest.mark.slow
@pytest.mark.parametrize("mean", [MEAN, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.few(1)
def test_an_update_is_a_refit_with_the_same_noise(mean):
    old, new = (hk.Velocities(*data(12)) + ENERGIES, hk.Velocities(*data(5, 7)))
    more = hk.Energies(data(3, 8)[0], np.ones(3))
    both = hk.condition(K, old, regularization=RIDGE, mean=mean).updated(new + more)
    whole = hk.condition(K, old + new + more, regularization=RIDGE * 18 / 26, mean=mean)
    same(both, whole)
    np.testing.assert_allclose(both.field.regularization, RIDGE * 18 / 26)
    np.testing.assert_allclose(both.field.norm, whole.field.norm, rtol=SOLVE)
    np.testing.assert_allclose(both.field.residual, whole.field.residual, atol=SOLVE)


GRID = np.stack(np.meshgrid(*[np.linspace(-3, 3, 9)] * 2), axis=-1).reshape(-1, 2)


@pytest.mark.slow
def test_landmarks_tell_what_the_dense_posterior_tells_where_they_are():
    solver = hk.Nystrom(tolerance=200.0, points=GRID)  # which leaves 110
    posterior = hk.condition(K, hk.Velocities(X, Y) + ENERGIES, regularization=RIDGE, solver=solver)
    for x in (INSIDE, X[0]):
        np.testing.assert_allclose(posterior.field(x), BOTH.field(x), atol=1e-4)
        np.testing.assert_allclose(posterior.deviation(x), BOTH.deviation(x), rtol=1e-2)
    far = posterior.deviation(100 * OUTSIDE)  # nothing is known there, and nothing claimed
    np.testing.assert_allclose(far, BOTH.deviation(100 * OUTSIDE), rtol=1e-10)
    more = hk.Velocities(*data(5, 7))
    updated = posterior.updated(more)
    all_data = hk.Velocities(X, Y) + ENERGIES + more
    same(updated, hk.condition(K, all_data, regularization=RIDGE * 18 / 23, solver=solver), 1e-8)


@pytest.mark.slow
def test_features_tell_what_their_own_kernel_tells(key):
    solver = hk.RandomFeatures(30, key)
    posterior = hk.condition(K, X, Y, RIDGE, solver=solver)
    basis = posterior.field.features
    F, here = np.asarray(basis(jnp.asarray(X))).reshape(24, -1), np.asarray(basis.rows(INSIDE))
    inverse = np.linalg.inv(F.T @ F + 12 * RIDGE * np.eye(F.shape[1]))
    expected = 12 * RIDGE * here @ inverse @ here.T
    np.testing.assert_allclose(posterior.covariance(INSIDE), expected, atol=SOLVE)
    same(
        hk.condition(K, X[:8], Y[:8], RIDGE, solver=solver).updated(X[8:], Y[8:]),
        hk.condition(K, X, Y, RIDGE * 8 / 12, solver=solver),
        1e-8,
    )


SAMPLES = 1000
SOLVERS = {
    "dense": None,
    "nystrom": hk.Nystrom(tolerance=1e-3),
    "features": hk.RandomFeatures(100, jax.random.key(0)),
}
slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("solver", "mean"),
    [
        ("dense", MEAN),
        pytest.param("dense", None, marks=slow),
        pytest.param("nystrom", MEAN, marks=slow),
        pytest.param("features", MEAN, marks=slow),
    ],
)
@pytest.mark.few(2)
def test_draws_have_the_mean_and_the_covariance_of_the_posterior(solver, mean, key):
    posterior = hk.condition(K, X, Y, RIDGE, solver=SOLVERS[solver], mean=mean)
    points = jnp.asarray([INSIDE, X[0], OUTSIDE])

    @jax.jit
    def asked(field):
        return jax.vmap(field)(points), field.hamiltonian(points[0]) - field.hamiltonian(points[2])

    fields = posterior.sample(key, SAMPLES, REGION)
    velocities, changes = jax.lax.map(asked, fields)  # (samples, points, n)
    # Five standard errors, of a mean and of a covariance.
    for i, x in enumerate(points):
        covariance = np.asarray(posterior.covariance(x))
        scale = np.sqrt(np.diagonal(covariance))
        off = (velocities[:, i].mean(axis=0) - posterior.field(x)) / scale
        assert abs(off).max() < 5 / SAMPLES**0.5
        off = (np.cov(velocities[:, i].T) - covariance) / np.outer(scale, scale)
        assert abs(off).max() < 5 * (2 / SAMPLES) ** 0.5
    H = posterior.field.hamiltonian
    deviation = posterior.energy_deviation(points[0], points[2])
    assert abs(changes.mean() - H(points[0]) + H(points[2])) < 5 * deviation / SAMPLES**0.5
    assert abs(changes.std() / deviation - 1) < 5 / (2 * SAMPLES) ** 0.5


@pytest.mark.slow
def test_draws_of_low_rank_leave_nothing_of_the_prior_at_the_landmarks(key):
    """There the rest of the prior is zero, and draws are as near to the mean as the data say."""
    posterior, points = hk.condition(K, X, Y, RIDGE, solver=hk.Nystrom(points=X)), jnp.asarray(X)
    velocities = jax.vmap(lambda field: jax.vmap(field)(points))(posterior.sample(key, 3, REGION))
    mean, deviation = (jax.vmap(f)(points) for f in (posterior.field, posterior.deviation))
    off = (velocities - mean[None]) / deviation[None]
    assert 0.3 < abs(off).max() < 5  # in standard deviations; those of the prior are 10 of them


@pytest.mark.slow
def test_draws_without_a_spectrum_are_right_in_the_region(key):
    kernel = hk.Symplectic(hk.Warp(3.0 * hk.Gaussian(1.5), jnp.tanh))
    posterior = hk.condition(kernel, X, Y, RIDGE)
    fields = posterior.sample(key, SAMPLES, REGION)
    assert fields.mean is None
    velocities = jax.lax.map(jax.jit(lambda field: field(INSIDE)), fields)
    ratio = velocities.std(axis=0) / posterior.deviation(INSIDE)
    assert abs(ratio - 1).max() < 5 / (2 * SAMPLES) ** 0.5


@pytest.mark.slow
def test_draws_are_ordinary_fields_whose_orbits_keep_their_own_energy(key, tmp_path):
    fields = POSTERIOR.sample(key, 3, REGION)
    ts = jnp.linspace(0.0, 2.0, 5)
    orbits = jax.vmap(lambda f: hk.simulate(f, INSIDE, ts).ys)(fields)
    energies = jax.vmap(lambda f, ys: jax.vmap(f.hamiltonian)(ys))(fields, orbits)
    assert abs(energies - energies[:, :1]).max() < 1e-8
    assert abs(orbits[0, -1] - orbits[1, -1]).max() > 1e-6  # they are not the same
    one = jax.tree.map(lambda leaf: leaf[0], fields)
    np.testing.assert_allclose(one.evaluate(X[:2]), jax.vmap(one)(jnp.asarray(X[:2])), atol=SOLVE)
    hk.save(tmp_path / "draw.npz", one)
    np.testing.assert_array_equal(hk.load(tmp_path / "draw.npz")(INSIDE), one(INSIDE))
    again = POSTERIOR.sample(key, 3, REGION)
    np.testing.assert_array_equal(again.coefficients, fields.coefficients)


@pytest.mark.slow
def test_sixty_four_hamiltonians_run_in_one_call(key):
    import time

    fields = POSTERIOR.sample(key, 64, REGION)
    ts = jnp.linspace(0.0, 20.0, 101)
    run = jax.jit(lambda fields: jax.vmap(lambda f: hk.simulate(f, INSIDE, ts).ys)(fields))
    jax.block_until_ready(run(fields))
    start = time.perf_counter()
    orbits = jax.block_until_ready(run(fields))
    assert time.perf_counter() - start < 10
    energies = jax.vmap(lambda f, ys: jax.vmap(f.hamiltonian)(ys))(fields, orbits)
    assert abs(energies - energies[:, :1]).max() < 1e-7


@pytest.mark.slow
def test_a_row_more_costs_a_tenth_of_a_refit():
    import time

    X, Y = data(1001)

    def seconds(call):
        jax.block_until_ready(call())
        times = []
        for _ in range(5):
            start = time.perf_counter()
            jax.block_until_ready(call())
            times.append(time.perf_counter() - start)
        return min(times)

    posterior = hk.condition(K, X[:1000], Y[:1000], RIDGE)
    refit = seconds(lambda: hk.condition(K, X, Y, RIDGE))
    update = seconds(lambda: posterior.updated(X[1000:], Y[1000:]))
    assert 10 * update < refit, (update, refit)


# What is refused.


def test_what_cannot_be_said_is_refused():
    with pytest.raises(TypeError, match="conjugate gradients find a field and keep no factor"):
        hk.condition(K, X, Y, RIDGE, solver=hk.ConjugateGradient())
    separable = hk.condition(hk.Separable(3.0 * hk.Gaussian(1.5)), X, Y, RIDGE)
    assert (separable.deviation(INSIDE) > 0).all()
    with pytest.raises(AttributeError, match="no potential"):
        separable.energy_deviation(INSIDE, X0)
    kinetic = hk.condition(K, X, Y, RIDGE, mean=lambda x: x * jnp.array([0.0, 1.0]))
    with pytest.raises(AttributeError, match="the mean"):
        kinetic.energy_deviation(INSIDE, X0)
    with pytest.raises(ValueError, match="new data have 4 coordinates and the posterior 2"):
        POSTERIOR.updated(np.zeros((3, 4)), np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"shape \(3,\); one state of shape \(2,\)"):
        POSTERIOR.deviation(np.zeros(3))


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (
            np.zeros((2, 3)),
            r"shape \(2, 3\); a box, its lowest and its highest corner, .* \(2, 2\)",
        ),
        (np.zeros(2), r"region has shape \(2,\)"),
        (REGION[::-1], "first row the lower corner"),
        (np.array([[0.0, 0.0], [np.inf, 1.0]]), "region must be finite"),
    ],
)
def test_a_region_that_is_none_is_refused(region, message, key):
    with pytest.raises(ValueError, match=message):
        POSTERIOR.sample(key, 2, region)


def test_a_failed_solve_is_nan_if_it_is_not_to_raise():
    one_place = np.tile(X[:1], (12, 1))
    failed = hk.condition(K, one_place, Y, 1e-30, throw=False)
    assert np.isnan(failed.field(INSIDE)).all()
    with pytest.raises(RuntimeError, match="raise it"):
        hk.condition(K, one_place, Y, 1e-30)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "k", [hk.Gaussian(1.0), 1.0 * hk.Gaussian(1.0), hk.Matern(2.5) * hk.Gaussian(1.0)]
)
def test_an_amplitude_that_nobody_tuned_gets_a_warning(k):
    for kernel in (hk.Symplectic(k), hk.Odd(hk.Symplectic(k))):
        with pytest.warns(UserWarning, match="amplitude of .* is exactly 1"):
            hk.condition(kernel, X, Y, RIDGE)


# Other libraries, where they are installed.


def test_a_scalar_case_is_that_of_scikit_learn():
    gaussian_process = pytest.importorskip("sklearn.gaussian_process")
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel  # pyright: ignore

    x = np.random.default_rng(0).uniform(-2, 2, (15, 1))
    y = np.sin(x)
    kernel = ConstantKernel(3.0, "fixed") * RBF(1.5, "fixed")
    theirs = gaussian_process.GaussianProcessRegressor(kernel, alpha=15 * RIDGE, optimizer=None)
    at = np.array([[0.3], [3.0]])
    mean, deviation = theirs.fit(x, y[:, 0]).predict(at, return_std=True)
    ours = hk.condition(hk.Separable(3.0 * hk.Gaussian(1.5)), x, y, RIDGE)
    np.testing.assert_allclose(ours.field.evaluate(at)[:, 0], mean, atol=SOLVE)
    np.testing.assert_allclose(jax.vmap(ours.deviation)(at)[:, 0], deviation, atol=SOLVE)


def test_values_and_gradients_together_are_those_of_gpytorch():
    torch = pytest.importorskip("torch")
    gpytorch = pytest.importorskip("gpytorch")
    kernel = gpytorch.kernels.RBFKernelGrad().double()
    kernel.lengthscale = 1.5
    x = torch.as_tensor(X[:5]).double()
    theirs = kernel(x, x).to_dense().detach().numpy().reshape(5, 3, 5, 3)
    curl_free = hk.CurlFree(hk.Gaussian(1.5))
    from hamkernel._gram import between
    from hamkernel._observations.blocks import Components

    values, slopes = Values(jnp.asarray(X[:5])), Components(jnp.asarray(X[:5]))
    np.testing.assert_allclose(between(curl_free, values, values), theirs[:, 0, :, 0], atol=1e-6)
    ours = between(curl_free, values, slopes).reshape(5, 5, 2)
    np.testing.assert_allclose(ours, theirs[:, 0, :, 1:], atol=1e-6)


@pytest.mark.slow
def test_evaluate_and_the_default_region_are_those_of_single_states_and_of_the_data():
    means, deviations = POSTERIOR.evaluate(X[:3])
    np.testing.assert_allclose(means[1], POSTERIOR.field(X[1]), atol=1e-12)
    np.testing.assert_allclose(deviations[1], POSTERIOR.deviation(X[1]), atol=1e-12)
    with pytest.raises(TypeError, match="no inputs"):
        POSTERIOR.evaluate(X, X)
    corners = np.stack([X.min(axis=0), X.max(axis=0)])
    draws = [POSTERIOR.sample(jax.random.key(0), 2, *region) for region in ((), (corners,))]
    np.testing.assert_array_equal(*(draw.coefficients for draw in draws))


def test_the_score_of_a_field_is_one_minus_the_share_of_the_variance_it_leaves():
    at, there = data(9, 3)
    there[2, 1] = np.nan
    left = there - np.asarray(POSTERIOR.field.evaluate(at))
    share = np.nansum(left**2) / np.nansum((there - np.nanmean(there, axis=0)) ** 2)
    np.testing.assert_allclose(POSTERIOR.field.score(at, there), 1 - share)
    with pytest.raises(ValueError, match="Y has shape"):
        POSTERIOR.field.score(at, there[:4])


@pytest.mark.slow
def test_the_posterior_of_tune_is_that_of_condition_with_what_was_tuned():
    tuned = hk.tune(K, X, Y, starts=1, max_steps=1, objective="marginal_likelihood")
    np.testing.assert_allclose(tuned.noise_variance, 12 * tuned.regularization)
    again = hk.condition(tuned.kernel, X, Y, tuned.regularization)
    np.testing.assert_allclose(
        tuned.posterior().covariance(INSIDE), again.covariance(INSIDE), atol=1e-12
    )
    assert "lengthscale = " in repr(tuned)
    assert ".posterior()" in repr(tuned)
