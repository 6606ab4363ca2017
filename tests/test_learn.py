"""`learn`: its rows against generalised least squares, its fields against the truth."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import dataclasses
import functools
import re
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._learned.diagnostics import degrees_of_freedom
from hamkernel._runs.flow import (
    NODES,
    WEIGHTS,
    Segments,
    integrate,
    jacobians,
    means,
)
from hamkernel._runs.preprocessing import preprocess
from hamkernel._trajectories.kalman import as_observations
from hamkernel._trajectories.likelihood import (
    closed_form,
    condense,
    conditional,
)
from hamkernel._trajectories.model import Model, landmark_whitening
from hamkernel._trajectories.search import _loss, losses
from hamkernel._trajectories.segments import given_path, linearise

K = hk.Symplectic(hk.Gaussian(1.0))
NO_PROCESS = jnp.full(2, -jnp.inf)
PENDULUM = hk.systems.Pendulum(1.0, 1.0, 6.0)


def logs(field=PENDULUM, noise=0.05, seed=0, count=6, samples=30, spread=2.0, length=6.0):
    """Runs of 6 s: times, noisy states, true states."""
    rng = np.random.default_rng(seed)
    ts = np.linspace(0, length, samples)
    starts = jnp.asarray(rng.uniform(-spread, spread, (count, 2)))
    true = jax.vmap(lambda x: hk.simulate(field, x, jnp.asarray(ts)).ys)(starts)
    true = list(np.asarray(true))
    return [ts] * count, [x + noise * rng.standard_normal(x.shape) for x in true], true


def field_error(field, true, system=PENDULUM):
    X = jnp.asarray(np.concatenate(true))
    f, g = (np.asarray(jax.vmap(each)(X)) for each in (system, field))
    return np.sqrt(np.mean((f - g) ** 2) / np.mean(f**2))


# The rows.


def with_missed(rows, path, slopes, spans):
    """Rows along a path that solves no equation: what the Gauss rule misses of its increments."""
    steps = jnp.einsum("slka,k,sl->sla", jnp.asarray(slopes), jnp.asarray(WEIGHTS), spans)
    return rows._replace(missed=jnp.diff(jnp.asarray(path), axis=1) - steps)


def integrals(rows):
    """The sum over the path of what drives the first segment: s of ds = Ψ s + drive, less x̂ − x."""
    sums = [np.zeros(rows.residual.shape[-1])]
    for across, drive, missed in zip(rows.across[0], rows.drive[0], rows.missed[0], strict=True):
        sums.append(np.asarray(across) @ sums[-1] + np.asarray(drive + missed))
    return np.asarray(rows.residual[0]) + np.array(sums)


def one_segment(seed=0, T=7):
    """A rough path, samples that have nothing to do with it, and rows with the identity for Φ."""
    rng = np.random.default_rng(seed)
    spans = rng.uniform(0.2, 0.5, (1, T - 1))
    path = rng.standard_normal((1, T, 2))
    nodes = rng.standard_normal((1, T - 1, 3, 2))
    slopes = rng.standard_normal((1, T - 1, 3, 2))
    measured = rng.standard_normal((1, T, 2))
    arrays = (
        jnp.asarray(a)
        for a in (
            *(spans, measured, np.ones_like(path), np.zeros_like(path), path[:, 0]),
            np.zeros((1, T - 1, 2, 0)),
        )
    )
    segments = Segments(*arrays)
    none = jnp.zeros((1, T - 1, 2, 2))
    as_path = given_path(jnp.asarray(path), jnp.asarray(nodes), segments.spans, none)
    rows = linearise(
        as_path, jnp.asarray(slopes), jnp.zeros_like(slopes), segments, jnp.array([True])
    )
    rows = with_missed(rows, path, slopes, segments.spans)
    return rows, spans[0], nodes[0].reshape(-1, 2), measured[0]


def differences(kernel, sigma, spans, nodes, measured):
    """Generalised least squares on differences: their Gram, their covariance and values."""
    T = len(measured)
    weights = np.kron(np.diag(spans) @ np.kron(np.eye(T - 1), WEIGHTS[None]), np.eye(2))
    G = np.asarray(hk.gram(kernel, nodes)).reshape(nodes.size, nodes.size)
    D = np.kron(np.diff(np.eye(T), axis=0), np.eye(2))
    return G, weights, weights @ G @ weights.T + sigma**2 * D @ D.T, D @ measured.reshape(-1)


@pytest.mark.slow
def test_without_a_tangent_rows_are_generalised_least_squares_on_differences():
    rows, spans, nodes, measured = one_segment()
    kernel, sigma = hk.Symplectic(1.7 * hk.Gaussian(1.2)), 0.3
    G, weights, A, d = differences(kernel, sigma, spans, nodes, measured)
    expected = G @ weights.T @ scipy.linalg.solve(A, d, assume_a="pos")
    S, spread = jnp.asarray(nodes), jnp.full(2, 1e4)
    model = Model(kernel, jnp.full(2, np.log(sigma)), NO_PROCESS)
    found = closed_form(model, S, rows, spread)
    field = np.einsum("iajb,jb->ia", hk.gram(kernel, nodes, nodes), found.coefficients)
    np.testing.assert_allclose(field.reshape(-1), expected, rtol=1e-5, atol=1e-6)
    used = np.trace(np.linalg.solve(A, weights @ G @ weights.T))  # of the parameters
    np.testing.assert_allclose(found.free, len(d) - used, rtol=1e-5)


def test_along_a_true_path_rows_and_functionals_are_the_variation_of_constants():
    """Of ẋ = Ax + g(x): x(t) − exp(At) x(0) is the integral of exp(A(t − s)) g(x(s))."""
    A, ts, n = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.linspace(0.0, 0.8, 9), 2
    mean = functools.partial(jnp.matmul, jnp.asarray(A))
    options = {"rtol": 1e-12, "atol": 1e-13, "dense_output": True}
    true = solve_ivp(
        lambda t, x: np.asarray(PENDULUM(x)), (0, 0.8), [1.0, 0.5], "DOP853", **options
    )
    x = jnp.asarray(true.sol(ts).T[None])
    inner = (ts[:-1, None] + np.diff(ts)[:, None] * NODES).reshape(-1)
    nodes = jnp.asarray(true.sol(inner).T.reshape(1, 8, 3, n))
    counts = jnp.full_like(x, 4.0)
    none = jnp.zeros((1, 8, 2, 0))
    segments = Segments(jnp.diff(ts)[None], x, counts, jnp.zeros_like(x), x[:, 0], none)
    path = given_path(x, nodes, segments.spans, jacobians(mean, nodes, n))
    slopes = jax.vmap(jax.vmap(jax.vmap(PENDULUM)))(nodes)
    rows = linearise(path, slopes, means(mean, nodes, slopes), segments, jnp.array([True]))
    expected = [x[0, i] - scipy.linalg.expm(A * t) @ x[0, 0] for i, t in enumerate(ts)]
    np.testing.assert_allclose(integrals(rows), expected, atol=1e-8)
    assert np.abs(expected).max() > 0.1

    spread = jnp.full(n, 100.0)
    found = as_observations(rows, Model(K, jnp.zeros(n), NO_PROCESS), mean, spread)
    ((block, targets),) = found.parts()
    np.testing.assert_allclose(block.rows(jax.vmap(PENDULUM)(block.points)), targets, atol=1e-8)
    assert len(targets) == 9 * n - n
    # Four samples in one are one of half the noise.
    once = rows._replace(counts=rows.counts / 4)
    halves = Model(K, jnp.full(n, np.log(0.5)), NO_PROCESS)
    ((_, halved),) = as_observations(once, halves, mean, spread).parts()
    np.testing.assert_allclose(halved, targets, rtol=1e-12)


def test_the_likelihood_is_that_of_the_differences_but_for_a_constant():
    rows, spans, nodes, measured = one_segment()
    pairs = [(1.2, 0.3), (0.8, 0.1), (2.5, 0.6)]
    ours, theirs = [], []
    for length, sigma in pairs:
        kernel = hk.Symplectic(1.7 * hk.Gaussian(length))
        A, d = differences(kernel, sigma, spans, nodes, measured)[2:]
        theirs.append(-scipy.stats.multivariate_normal(np.zeros(len(d)), A).logpdf(d))
        model = Model(kernel, jnp.full(2, np.log(sigma)), NO_PROCESS)
        S, spread = jnp.asarray(nodes), jnp.full(2, 1e4)
        ours.append(float(losses(model, model.flat[None], S, rows, spread)[0]))
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=1e-6)


def test_the_likelihood_at_another_noise_is_that_of_every_sample_in_a_mean():
    rows, spans, nodes, measured = one_segment()
    kernel, sigma, count = hk.Symplectic(1.7 * hk.Gaussian(1.2)), 0.3, 4
    apart = np.random.default_rng(1).standard_normal((len(measured), count, 2))
    apart -= apart.mean(axis=1, keepdims=True)
    scatter = jnp.asarray(np.sum(apart**2, axis=1)[None])
    rows = rows._replace(counts=jnp.full_like(rows.counts, count), scatter=scatter)
    S, spread = jnp.asarray(nodes), jnp.full(2, 1e4)
    model = Model(kernel, jnp.full(2, np.log(sigma)), NO_PROCESS)
    known = condense(model, S, rows, spread)
    # Differences of successive samples, of which `count` have one time.
    G, weights = differences(kernel, sigma, spans, nodes, measured)[:2]
    from_start = np.kron(np.tri(len(measured), len(spans), -1), np.eye(2)) @ weights
    moved = np.repeat(from_start.reshape(len(measured), 1, 2, -1), count, axis=1)
    D = np.kron(np.diff(np.eye(len(measured) * count), axis=0), np.eye(2))
    moved, d = D @ moved.reshape(D.shape[1], -1), D @ (measured[:, None] + apart).reshape(-1)
    ours, theirs = [], []
    for shift in (0.0, 0.4, -0.3):
        A = moved @ G @ moved.T + (sigma * np.exp(shift)) ** 2 * D @ D.T
        theirs.append(-scipy.stats.multivariate_normal(np.zeros(len(d)), A).logpdf(d))
        ours.append(float(conditional(known, S, shift).loss))
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=1e-6)


def test_the_gradient_of_the_likelihood_is_that_of_finite_differences():
    rows, _, nodes, _ = one_segment(1)
    model = Model(hk.Symplectic(1.7 * hk.Gaussian(1.2)), jnp.log(jnp.array([0.3, 0.2])), NO_PROCESS)
    S, spread = jnp.asarray(nodes[::2]), jnp.full(2, 100.0)
    gradient = jax.jit(jax.grad(lambda h: _loss(model, h, S, rows, spread)))(model.flat)
    h = np.asarray(model.flat)
    step = 1e-5 * np.eye(len(h))[:-2]  # −inf is the noise of the process
    design = jnp.asarray(np.concatenate([h[None] + step, h[None] - step]))
    up, down = np.asarray(losses(model, design, S, rows, spread)).reshape(2, -1)
    np.testing.assert_allclose(gradient[:-2], (up - down) / 2e-5, rtol=1e-5, atol=1e-6)


def test_landmarks_resolve_components_of_any_unit():
    D = np.array([1.0, 1e8])
    S = np.random.default_rng(0).uniform(-1, 1, (8, 2))
    kernel = hk.Symplectic(3.0 * hk.Gaussian(D))
    T = np.asarray(landmark_whitening(kernel, jnp.asarray(S * D[None])))
    G = np.asarray(hk.gram(kernel, S * D[None])).reshape(16, 16)
    np.testing.assert_allclose(T.T @ G @ T, np.eye(16), atol=1e-6)


def test_landmarks_closer_than_rounding_resolves_span_what_they_span():
    S = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    kernel = hk.Symplectic(hk.Gaussian(4.0))
    G = np.asarray(hk.gram(kernel, S)).reshape(80, 80)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(G)
    T = np.asarray(landmark_whitening(kernel, jnp.asarray(S)))
    np.testing.assert_allclose(G @ T @ T.T @ G, G, atol=1e-9 * np.trace(G))


@pytest.mark.slow
def test_the_flow_and_its_tangent_are_exact_to_the_tolerance_of_the_integrator():
    starts = jnp.array([[1.0, 0.5], [-0.3, 1.2]])
    spans = np.full((2, 4), 0.2)
    path = integrate(PENDULUM, starts, jnp.asarray(spans), jnp.full(4, 8), jnp.zeros((2, 4, 2, 0)))
    ts = jnp.linspace(0, 0.8, 5)

    def flow(x):
        return hk.simulate(PENDULUM, x, ts).ys

    np.testing.assert_allclose(path.x, jax.vmap(flow)(starts), atol=1e-9)
    # The tangent of the first interval by central differences.
    for s in range(2):
        steps = 1e-5 * np.eye(2)
        ends = [(flow(starts[s] + h)[1] - flow(starts[s] - h)[1]) / 2e-5 for h in steps]
        np.testing.assert_allclose(path.across[s, 0], np.stack(ends, axis=1), atol=1e-7)
        # From a node to the end: the tangent over what is left of the interval.
        left = integrate(
            PENDULUM,
            path.nodes[s, 0, 1][None],
            jnp.array([[0.2 * (1 - NODES[1])]]),
            jnp.array([8]),
            jnp.zeros((1, 1, 2, 0)),
        )
        np.testing.assert_allclose(path.to_end[s, 0, 1], left.across[0, 0], atol=1e-9)


@pytest.mark.slow
def test_averaged_samples_keep_what_they_say_of_the_noise():
    t = np.linspace(0, 6, 3000)
    x = np.column_stack([np.sin(t), np.cos(t)])
    noise = np.array([0.02, 0.05])
    data = preprocess(
        hk.Runs(t, x + noise * np.random.default_rng(0).standard_normal(x.shape)), None
    )
    run = data.runs[0]
    assert run.counts.sum(axis=0).tolist() == [3000, 3000]
    assert len(run.times) < 300
    # Within blocks, with one degree of freedom less for each of their means: to 1/√6000.
    pooled = np.sqrt(run.scatter.sum(axis=0) / (run.counts - 1).sum(axis=0))
    np.testing.assert_allclose(pooled, noise, rtol=0.05)


def test_averaged_samples_are_as_exact_as_their_number_says():
    t, squares = 0.02 * np.arange(256), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        rates, phases = rng.uniform(1, 6, 6), rng.uniform(0, 2 * np.pi, 6)

        def truth(t):
            return 0.25 * np.sin(np.multiply.outer(t, rates) + phases).sum(-1)  # noqa: B023

        x = truth(t)[:, None] + 0.001 * rng.standard_normal((256, 1))
        run = preprocess(hk.Runs(t, x), None).runs[0]
        assert len(run.times) < 200
        squares.append(run.counts[:, 0] * ((run.states[:, 0] - truth(run.times)) / 0.001) ** 2)
    # 1.0 with blocks of half the time that smoothing averages over, 1.2 without that bound.
    assert 0.85 < np.concatenate(squares).mean() < 1.1


# What is learned. One shape, so that it is compiled once.


@pytest.fixture(scope="module")
def learned():
    times, states, true = logs()
    return hk.learn(K, hk.Runs(times, states)), true


def test_a_pendulum_is_learned_from_noisy_states(learned):
    found, true = learned
    assert found.converged
    assert found.diagnostics.failing == ()  # and no warning, which is an error here
    assert field_error(found.field, true) < 0.05  # .043, .028 and .029 for three seeds
    np.testing.assert_allclose(found.noise, 0.05, rtol=0.15)
    assert np.asarray(found.kept).tolist() == [1.0] * 6
    # The fitted states are closer to the truth than the measured ones, by far.
    error = np.sqrt(np.mean((np.stack(found.states) - np.stack(true)) ** 2))
    assert error < 0.5 * 0.05
    assert np.nanmax(found.misfit) < 1.6
    assert found.residuals[0].shape == (30, 2)
    assert "Symplectic(" in repr(found.kernel)
    assert len(repr(found).splitlines()) < 70  # whatever the number of runs and iterations
    x = jnp.array([0.3, 0.2])
    gradient = jax.grad(found.field.hamiltonian)(x)
    np.testing.assert_allclose(found.field(x), [gradient[1], -gradient[0]], atol=1e-10)


def test_runs_of_other_lengths_do_not_compile_anew(learned, caplog):
    """Of 17 to 32 samples, as all are that were compiled for."""
    times, states, true = logs()
    lengths = [18, 30, 20, 27, 24, 30]
    times, states = ([a[:T] for a, T in zip(x, lengths, strict=True)] for x in (times, states))
    with jax.log_compiles():
        found = hk.learn(K, hk.Runs(times, states))
    programs = re.findall(r"XLA compilation of jit\((\w+)\)", caplog.text)
    # Data on its way to the device, and free runs over another number of stretches.
    assert set(programs) <= {"stage", "reshape", "integrate", "_with_norms"}
    assert field_error(found.field, true) < 0.06


@pytest.mark.slow
def test_one_row_that_is_no_measurement_spoils_no_field():
    times, states, true = logs()
    states[1][20] = -9999.0
    with pytest.warns(UserWarning, match="Write NaN"):
        runs = hk.Runs(times, states)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found = hk.learn(K, runs)
    # The run with that row is left out, or the field must not be used.
    assert not found.converged or field_error(found.field, true) < 0.1
    assert len(heard) == 1
    assert "one curve" not in found.diagnostics.failing


@pytest.mark.slow
def test_five_samples_a_swing_are_enough():
    """Smoothing finds next to no noise, .05 in truth: it must not be where learning ends."""
    times, states, true = logs(length=15.0)
    runs = hk.Runs(times, states)
    assert (preprocess(runs, None).noise < 0.05 / 4).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = hk.learn(K, runs)
    assert field_error(found.field, true) < 0.05  # .043, .028 and .029 for three seeds
    np.testing.assert_allclose(found.noise, 0.05, rtol=0.2)


def test_noise_from_a_few_degrees_of_freedom_is_a_guess():
    few, enough, given = (
        degrees_of_freedom(SimpleNamespace(is_noise_known=known, remaining=left))
        for known, left in ((False, 3.2), (False, 10.0), (True, 3.2))
    )
    assert (few.passes, enough.passes, given.passes) == (False, True, True)
    assert "leave 3.2 degrees of freedom: noise and field are a guess" in few.meaning


@pytest.mark.slow
def test_the_order_of_the_runs_does_not_matter(learned):
    found, true = learned
    times, states, _ = logs()
    order = [3, 1, 5, 0, 2, 4]
    other = hk.learn(K, hk.Runs(times, [states[i] for i in order]))
    np.testing.assert_allclose(other.noise, found.noise, rtol=1e-3)
    X = jnp.asarray(true[0])
    np.testing.assert_allclose(
        jax.vmap(other.field)(X), jax.vmap(found.field)(X), rtol=0.01, atol=0.01
    )


@pytest.mark.slow
def test_a_run_that_is_garbage_is_dropped_and_named():
    times, states, true = logs()
    states[2] = 3 * np.random.default_rng(9).standard_normal(states[2].shape)
    with pytest.warns(UserWarning, match="parts left out|learned from"):
        found = hk.learn(K, hk.Runs(times, states))
    assert np.asarray(found.kept).tolist() == [1, 1, 0, 1, 1, 1]
    assert found.dropped == ((2, 0, 30),)
    assert field_error(found.field, true) < 0.05
    assert all(np.isfinite(x).all() for x in found.states)


@pytest.mark.slow
def test_the_units_of_the_momenta_do_not_matter():
    times, states, true = logs()
    kernel, D = hk.Symplectic(hk.Gaussian(np.ones(2))), np.array([1.0, 1e6])
    found = hk.learn(kernel, hk.Runs(times, states))
    scaled = hk.learn(kernel, hk.Runs(times, [x * D[None] for x in states]))
    # The guess of the kernel has other units, so the search begins elsewhere, and ends within a
    # tenth of the standard deviation of each hyperparameter, which of σ is σ/√(2N).
    samples = sum(len(t) for t in times)
    np.testing.assert_allclose(scaled.noise / D, found.noise, rtol=0.1 / np.sqrt(2 * samples))
    X = np.concatenate(true)
    field, expected = (
        np.asarray(jax.vmap(each.field)(jnp.asarray(X * unit))) / unit
        for each, unit in ((scaled, D[None]), (found, np.ones((1, 2))))
    )
    error = np.abs(expected - np.asarray(jax.vmap(PENDULUM)(jnp.asarray(X)))).max()
    np.testing.assert_allclose(field, expected, atol=0.1 * error)


def damped(x):
    return PENDULUM(x) - 0.05 * jnp.array([0.0, 1.0]) * x


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("guess", [1 / 30, 1.0, 30.0])
def test_few_positions_are_enough_whatever_the_first_lengthscale(seed, guess):
    """Ten runs of ten seconds at 5 Hz, with a second optimum at a short lengthscale."""
    pendulum = hk.systems.Pendulum(0.5, 1.0, 6.0)
    rng, ts = np.random.default_rng(seed), np.linspace(0, 10, 51)
    way = rng.uniform(-1, 1, (10, 2))
    starts = way / np.linalg.norm(way, axis=1)[:, None] * rng.uniform(1.3, 2.3, (10, 1))
    true = [
        solve_ivp(lambda _, x: [2 * x[1], -3 * np.sin(x[0])], (0, 10), x, t_eval=ts, rtol=1e-9).y.T
        for x in starts
    ]
    positions = [x[:, 0] + 0.01 * rng.standard_normal(len(x)) for x in true]
    kernel = hk.Symplectic(hk.Select(hk.Gaussian(guess), 0))
    found = hk.learn(kernel, hk.Runs([ts] * 10, positions), mass=0.5)
    assert found.converged
    assert field_error(found.field, true, pendulum) < 0.005
    np.testing.assert_allclose(found.noise[0], 0.01, rtol=0.1)


@pytest.mark.slow
def test_friction_that_the_structure_lacks_is_noticed():
    times, states, _ = logs(damped, noise=0.01)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = hk.learn(K, hk.Runs(times, states), noise=0.01)
    assert len(seen) == 1
    assert "friction" in str(seen[0].message)
    assert not found.converged
    assert "missing force" in found.diagnostics.failing
    times, states, _ = logs(noise=0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = hk.learn(K, hk.Runs(times, states), noise=0.01)
    assert found.chi_squared < 1.2
    np.testing.assert_allclose(found.noise, 0.01, rtol=1e-12)


@pytest.mark.slow
def test_two_samples_in_a_run_are_used_and_no_noise_is_no_nan():
    times, states, true = logs(noise=0.0)
    times, states = [*times[:5], times[5][:2]], [*states[:5], states[5][:2]]
    found = hk.learn(K, hk.Runs(times, states))
    assert field_error(found.field, true[:5]) < 1e-3
    assert np.isfinite(found.noise).all()
    assert found.states[5].shape == (2, 2)


@pytest.mark.slow
def test_a_kernel_that_contains_the_truth_finds_it_to_the_tolerance_of_the_integrator():
    oscillator = hk.systems.HarmonicOscillator(mass=1.0, stiffness=1.5)
    times, states, true = logs(oscillator, noise=0.0)
    found = hk.learn(hk.Symplectic(hk.Polynomial(2)), hk.Runs(times, states))
    assert field_error(found.field, true, oscillator) < 1e-5


@pytest.mark.slow
def test_positions_are_enough_where_the_kinetic_energy_is_known():
    times, states, true = logs(noise=0.01)
    only_q = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in states]
    U = hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0))
    found = hk.learn(U, hk.Runs(times, only_q), mean=moved_by_momentum)
    assert field_error(found.field, true) < 0.01
    assert np.isnan(found.noise[1])
    p, q = (np.stack([x[:, c] for x in found.states]) for c in (1, 0))
    assert np.sqrt(np.mean((p - np.stack(true)[:, :, 1]) ** 2)) < 0.02
    assert np.sqrt(np.mean((q - np.stack(true)[:, :, 0]) ** 2)) < 0.01


def moved_by_momentum(x):
    return jnp.array([x[1], 0.0])


def moved_by_momenta(x):
    return jnp.concatenate([x[2:], jnp.zeros(2)])


def with_a_gap(times, states):
    """Logs of which the samples between 2.6 s and 4 s are lost."""
    kept = (times[0] < 2.6) | (times[0] > 4.0)
    return [t[kept] for t in times], [x[kept] for x in states]


@pytest.mark.slow
def test_long_intervals_of_an_uneven_run_are_cut_and_an_even_run_is_left():
    times, states, _ = logs(samples=31)
    lost = np.zeros(31, bool)
    lost[[3, 4, 11, 19, 20, 21]] = True  # intervals of two to four times the usual
    uneven = [t[~lost] for t in times], [x[~lost] for x in states]
    for t, x, run in zip(*uneven, preprocess(hk.Runs(*uneven), None).runs, strict=True):
        at = np.searchsorted(run.times, t - 1e-9)
        np.testing.assert_allclose(run.times[at], t - t[0])
        np.testing.assert_array_equal(run.states[at], x)
        assert np.isnan(np.delete(run.states, at, axis=0)).all()
        assert np.diff(run.times).max() < 1.6 * np.median(np.diff(t)) < np.diff(t).max()
    for t, run in zip(times, preprocess(hk.Runs(times, states), None).runs, strict=True):
        np.testing.assert_array_equal(run.times, t - t[0])


def orbits(seed=2, samples=60):
    """Positions, to .5 km, of three satellites at uneven times of six turns, a tenth lost."""
    rng = np.random.default_rng(seed)
    times, seen, true = [], [], []
    for size, eccentricity in ((9000.0, 0.1), (12000.0, 0.25), (15000.0, 0.4)):
        near = size * (1 - eccentricity)
        fast = np.sqrt(EARTH * (1 + eccentricity) / near)
        turns = 12 * np.pi * np.sqrt(size**3 / EARTH)
        t = np.sort(rng.uniform(0, turns, samples))
        t[0] = 0
        phase = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(phase), np.sin(phase)
        start = [near * c, near * s, -fast * s, fast * c]
        found = solve_ivp(
            attracted, (0, t[-1]), start, method="DOP853", rtol=1e-10, atol=1e-8, t_eval=t
        )
        true.append(found.y.T)
        q = found.y[:2].T + 0.5 * rng.normal(size=(samples, 2))
        seen.append(np.column_stack([q, np.full(q.shape, np.nan)]))
        seen[-1][rng.random(samples) < 0.1] = np.nan
        times.append(t)
    return times, seen, np.concatenate(true)


EARTH = 398600.4418  # km³/s²


def attracted(_, x):
    return np.concatenate([x[2:], -EARTH * x[:2] / np.hypot(*x[:2]) ** 3])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:learning did not settle")
@pytest.mark.filterwarnings("ignore:dropped. samples 0 to 0")  # a gap follows it
def test_orbits_at_uneven_times_are_usable_without_process_noise():
    times, seen, true = orbits()
    U = hk.Symplectic(hk.Select(hk.Gaussian(5000.0), (0, 1)))
    found = hk.learn(U, hk.Runs(times, seen), mean=moved_by_momenta)
    assert found.converged
    assert found.diagnostics["process noise"].passes
    assert np.asarray(found.kept).min() > 0.95
    forces = np.array([attracted(0, x)[2:] for x in true])
    off = np.asarray(found.field.evaluate(jnp.asarray(true)))[:, 2:] - forces
    assert np.linalg.norm(off) < 0.006 * np.linalg.norm(forces)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:a gap of")
@pytest.mark.filterwarnings("ignore:learning did not settle")  # at 8 iterations it still moves
def test_positions_with_gaps_leave_no_ripples_in_the_field():
    times, states, true = logs(noise=0.01, samples=51)
    times, only_q = with_a_gap(times, states)
    only_q = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in only_q]
    U = hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0))
    found = hk.learn(U, hk.Runs(times, only_q), mean=moved_by_momentum)
    assert field_error(found.field, true) < 0.005


def test_what_cannot_be_known_or_meant_is_refused():
    times, states, _ = logs(samples=5)
    runs = hk.Runs(times, states)
    unseen = [np.column_stack([x[:, 0], np.full(len(x), np.nan)]) for x in states]
    with pytest.raises(ValueError, match=r"coordinate 1 was measured in no run.*q̇ = p/m"):
        hk.learn(K, hk.Runs(times, unseen))
    with pytest.raises(
        ValueError, match=r"up to any change .* hk\.Symplectic\(hk\.Select\(k, \(0,\)"
    ):
        hk.learn(K, hk.Runs(times, [x[:, 0] for x in states]), mass=1.0)
    with pytest.raises(ValueError, match="do not depend on it"):
        hk.learn(K, hk.Runs(times, unseen), mean=lambda x: jnp.array([x[0], 0.0]))
    with pytest.raises(TypeError, match=r"learn takes hk.Runs.*hk.fit or hk.tune"):
        hk.learn(K, states)
    with pytest.raises(TypeError, match="matrix-valued"):
        hk.learn(hk.Gaussian(1.0), runs)
    with pytest.raises(TypeError, match="Nystrom"):
        hk.learn(K, runs, solver=hk.Cholesky())
    with pytest.raises(ValueError, match=r"noise must be positive.*found from the runs"):
        hk.learn(K, runs, noise=0.0)
    with pytest.raises(ValueError, match=r"noise has shape \(3,\)"):
        hk.learn(K, runs, noise=[0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="even dimension"):
        hk.learn(K, hk.Runs(times, [x[:, :1] for x in states]))


@pytest.mark.slow
def test_the_posterior_is_that_of_the_last_rows(learned):
    found, true = learned
    posterior = found.posterior
    X = jnp.asarray(np.concatenate(true)[::7])
    exact, field = (np.asarray(jax.vmap(f)(X)) for f in (posterior.field, found.field))
    np.testing.assert_allclose(exact, field, atol=0.02 * np.abs(field).max())
    truth = np.asarray(jax.vmap(PENDULUM)(X))
    z = (exact - truth) / np.asarray(jax.vmap(posterior.deviation)(X))
    assert 0.3 < np.sqrt(np.mean(z**2)) < 2.0


@pytest.mark.slow
def test_noise_of_half_the_variance_in_the_posterior_is_that_of_every_observation_twice(learned):
    found, true = learned
    X = jnp.asarray(np.concatenate(true)[::25])
    halved = dataclasses.replace(found, widening=jnp.asarray(0.5)).posterior
    # The noise variance is Nλ, and there are twice as many.
    twice = found.observations + found.observations
    again = hk.condition(found.kernel, twice, regularization=found.regularization / 2)
    for f, g in ((halved.field, again.field), (halved.deviation, again.deviation)):
        of_f, of_g = (np.asarray(jax.vmap(each)(X)) for each in (f, g))
        np.testing.assert_allclose(of_f, of_g, rtol=1e-6, atol=1e-6 * np.abs(of_g).max())
    as_found = np.asarray(jax.vmap(found.posterior.deviation)(X))
    assert (np.asarray(jax.vmap(halved.deviation)(X)) < 0.95 * as_found).all()
