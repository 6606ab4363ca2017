"""Runs with inputs: what was applied between samples, and what is learned of it."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import functools
import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp
from test_learn import integrals

import hamkernel as hk
from hamkernel._runs.flow import NODES, Segments, integrate, jacobians, means
from hamkernel._runs.preprocessing import _least
from hamkernel._runs.runs import (
    inputs_at_nodes,
    inputs_at_samples,
    lines_in_intervals,
    values,
)
from hamkernel._trajectories.kalman import as_observations
from hamkernel._trajectories.model import Model
from hamkernel._trajectories.segments import given_path, linearise, segments_of

FRICTION, GAIN = 0.2, 1.5
PENDULUM = hk.systems.Damped(hk.systems.Pendulum(1.0, 1.0, 6.0), FRICTION)
PLANT = hk.systems.Driven(PENDULUM, [[0.0], [GAIN]])
K = hk.Controlled(hk.PortHamiltonian(hk.Gaussian(2.0), 0.1), hk.InputMatrix(1.0, acts_on=(1,)))


def joined(s):
    return PLANT(s[:2], s[2:])


# What was applied.


def held(t, u, at):
    return u[np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)]


def spline(t, u, at):
    """The interpolant of least ∫(u‴)² dt: quadratics and |t − tⱼ|⁵, orthogonal to quadratics."""
    V = np.vander(t, 3)
    system = np.block([[np.abs(t[:, None] - t) ** 5, V], [V.T, np.zeros((3, 3))]])
    values = np.concatenate([u, np.zeros((3, *u.shape[1:]))])
    return np.hstack([np.abs(at[:, None] - t) ** 5, np.vander(at, 3)]) @ np.linalg.solve(
        system, values
    )


WAYS = {"held": held, "linear": lambda t, u, at: np.interp(at, t, u), "smooth": spline}


@pytest.mark.parametrize("between", WAYS)
def test_inputs_of_intervals_are_the_best_lines_in_the_mean_square(between):
    rng = np.random.default_rng(0)
    t, u = np.sort(rng.uniform(0, 1, 12)), rng.normal(size=12)
    at = np.array([t[0], 0.3, 0.55, t[-1]])
    found = lines_in_intervals(t, u[:, None], at, between)[..., 0]
    for (a, b), ends in zip(itertools.pairwise(at), found, strict=True):
        fine = np.linspace(a, b, 200_001)
        fine = (fine[1:] + fine[:-1]) / 2
        values = WAYS[between](t, u, fine)
        slope, middle = np.polyfit(2 * (fine - a) / (b - a) - 1, values, 1)
        np.testing.assert_allclose(ends, [middle - slope, middle + slope], atol=1e-4)


def test_inputs_between_the_samples_of_a_log_are_as_they_were_said():
    t, u = np.array([0.0, 0.3, 0.4, 1.0]), np.random.default_rng(0).normal(size=(4, 2))
    lines = lines_in_intervals(t, u, t, "linear")
    np.testing.assert_allclose(lines, np.stack([u[:-1], u[1:]], axis=1), atol=1e-14)
    np.testing.assert_allclose(inputs_at_samples(lines), u, atol=1e-14)
    nodes = t[:-1, None] + np.diff(t)[:, None] * NODES
    expected = np.stack([np.interp(nodes, t, u[:, c]) for c in range(2)], axis=-1)
    np.testing.assert_allclose(inputs_at_nodes(lines), expected, atol=1e-14)
    steps = lines_in_intervals(t, u, t, "held")
    np.testing.assert_allclose(steps, np.repeat(u[:-1, None], 2, axis=1), atol=1e-14)
    assert lines_in_intervals(t, u[:, :0], t, "held").shape == (3, 2, 0)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 12])
def test_smooth_inputs_are_the_interpolant_of_least_third_derivative(count):
    rng = np.random.default_rng(count)
    t, u = np.linspace(0, 1, count), rng.normal(size=(count, 2))
    t[1:-1] += rng.uniform(-0.3, 0.3, count - 2) / count
    at = np.linspace(t[0], t[-1], 50)
    expected = spline(t, u, at) if count > 2 else u[0] + at[:, None] * (u[1] - u[0])
    np.testing.assert_allclose(values(t, u, at, "smooth"), expected, atol=1e-8)
    outside = values(t, u, np.array([-1.0, 2.0]), "smooth")
    np.testing.assert_allclose(outside, u[[0, -1]], atol=1e-12)  # they stay


def responses(per_period, between, periods=10):
    """An oscillator driven by cos t that is sampled, and its response in closed form.

    ẋ = A x + b u(t) with u a line in each interval of the samples, exactly by exponentials.
    """
    stiffness, damping = 2.3, 0.2
    t = np.arange(periods * per_period + 1) * 2 * np.pi / per_period
    lines = lines_in_intervals(t, np.cos(t)[:, None], t, between)[..., 0]
    steady = 1 / (stiffness - 1 + 1j * damping)  # ẍ + damping ẋ + stiffness x = cos t
    true = np.stack([(steady * np.exp(1j * t)).real, (1j * steady * np.exp(1j * t)).real], axis=1)
    h = t[1] - t[0]
    # The state, the input and its slope.
    A = np.zeros((4, 4))
    A[:2, :3] = [[0, 1, 0], [-stiffness, -damping, 1]]
    A[2, 3] = 1
    transition, x, out = scipy.linalg.expm(h * A), true[0], [true[0]]
    for first, last in lines:
        x = (transition @ [*x, first, (last - first) / h])[:2]
        out.append(x)
    return np.array(out), true


@pytest.mark.parametrize("per_period", [6, 9, 12])
def test_a_driven_oscillator_follows_smooth_inputs_ten_times_as_well(per_period):
    error = {}
    for between in WAYS:
        found, true = responses(per_period, between)
        error[between] = np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))
    assert error["smooth"] < 0.1 * error["linear"] < 0.1 * error["held"]
    assert error["smooth"] < 0.01


def test_inputs_have_times_of_their_own_and_act_late():
    ts, x = np.linspace(0, 1, 9), np.column_stack([np.sin(np.arange(9.0)), np.cos(np.arange(9.0))])
    own = np.linspace(-0.01, 1.01, 1000)
    late = hk.Runs(ts, x, (own, np.sin(7 * own)[:, None]), between="linear", delay=0.05)
    assert repr(late) == "Runs(1 run, 9 samples, n=2, m=1 linear, delay=0.05)"
    nodes = ts[1:-1, None] + np.diff(ts[1:])[:, None] * NODES
    found = inputs_at_nodes(late.input_lines(0, ts))[1:, :, 0]
    np.testing.assert_allclose(found, np.sin(7 * (nodes - 0.05)), atol=0.06)  # a line in each
    assert late.inputs[0].shape == (1000, 1)


def test_the_likeliest_delay_is_found_by_parabolas():
    asked = []

    def loss(delay):
        asked.append(delay)
        return (delay - 0.137) ** 2 / 2e-4 + 5 * np.cos(delay)

    _least(loss, 0.05)
    assert abs(asked[np.argmin([loss(d) for d in list(asked)])] - 0.137) < 0.002
    assert len(set(asked)) < 20


# The flow and the rows.


def driven_path(ts, u, slope):
    """A true path under u(t) = u + slope t, as a function of t."""
    options = {"rtol": 1e-12, "atol": 1e-13, "dense_output": True}
    true = solve_ivp(
        lambda t, x: PLANT(x, jnp.array([u + slope * t])),
        (ts[0], ts[-1]),
        [1.0, 0.5],
        "DOP853",
        **options,
    )
    return lambda at: true.sol(at).T


def test_the_flow_is_driven_to_the_tolerance_of_the_integrator():
    ts, (u, slope) = np.linspace(0.0, 0.8, 5), (0.7, -2.0)
    true = driven_path(ts, u, slope)
    ends = u + slope * np.column_stack([ts[:-1], ts[1:]])[None, ..., None]
    spans, steps = jnp.diff(ts)[None], jnp.full(4, 8)
    path = integrate(joined, jnp.array([[1.0, 0.5]]), spans, steps, jnp.asarray(ends))
    np.testing.assert_allclose(path.x[0], true(ts), atol=1e-8)
    inner = ts[:-1, None] + np.diff(ts)[:, None] * NODES
    np.testing.assert_allclose(
        path.nodes[0, ..., :2], true(inner.ravel()).reshape(4, 3, 2), atol=1e-8
    )
    np.testing.assert_allclose(path.nodes[0, ..., 2], u + slope * inner, atol=1e-12)


@pytest.mark.slow
def test_along_a_true_path_rows_are_exact_with_inputs():
    """Of ẋ = Ax + g(x, u): x(t) − exp(At) x(0) is the integral of exp(A(t − s)) g(x(s), u(s))."""
    A, ts, (u, slope) = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.linspace(0.0, 0.8, 9), (0.7, -2.0)
    true = driven_path(ts, u, slope)
    x = jnp.asarray(true(ts)[None])
    ends = jnp.asarray(u + slope * np.column_stack([ts[:-1], ts[1:]])[None, ..., None])
    inner = (ts[:-1, None] + np.diff(ts)[:, None] * NODES).reshape(-1)
    states = jnp.asarray(true(inner).reshape(1, 8, 3, 2))
    segments = Segments(jnp.diff(ts)[None], x, jnp.ones_like(x), jnp.zeros_like(x), x[:, 0], ends)

    def mean(s):
        return jnp.asarray(A) @ s[:2]

    @jax.jit
    def rows(ends):
        nodes = jnp.concatenate([states, inputs_at_nodes(ends)], axis=-1)
        path = given_path(x, nodes, segments.spans, jacobians(mean, nodes, 2))
        slopes = jax.vmap(jax.vmap(jax.vmap(joined)))(nodes)
        there = means(mean, nodes, slopes)
        return linearise(path, slopes, there, segments, jnp.array([True]))

    expected = [
        at - scipy.linalg.expm(A * t) @ true(0.0) for t, at in zip(ts, true(ts), strict=True)
    ]
    found = rows(ends)
    np.testing.assert_allclose(integrals(found), expected, atol=1e-8)
    model = Model(K, jnp.zeros(2), jnp.full(2, -jnp.inf))
    observations = as_observations(found, model, mean, jnp.full(2, 100.0))
    assert observations is not None
    ((block, targets),) = observations.parts(1)
    np.testing.assert_allclose(
        block.rows(jax.jit(jax.vmap(joined))(block.points)), targets, atol=1e-8
    )
    # The control: other inputs do not explain the same samples.
    wrong = integrals(rows(0 * ends)) - expected
    assert np.abs(wrong).max() > 0.1


def test_segments_that_are_not_kept_stay_at_states_of_the_runs():
    """Elsewhere a field may be NaN, as one of the logarithm of populations is at zero."""
    ts, x = np.arange(3.0), np.full((3, 2), 2.0)
    piece = (ts, x, np.ones((3, 2)), np.zeros((3, 2)), x[0], np.ones((2, 2, 1)))
    segments = segments_of([piece], 2, 4)
    nodes = jnp.full((2, 3, 3, 3), jnp.nan)
    path = given_path(jnp.full((2, 4, 2), 2.0), nodes, segments.spans, jnp.zeros((2, 3, 2, 2)))
    zero, none = jnp.zeros((2, 3, 3, 2)), jnp.zeros(2, bool)
    rows = linearise(path, zero, zero, segments, none)
    np.testing.assert_array_equal(rows.nodes[..., :2], 2.0)
    np.testing.assert_array_equal(rows.counts, 0.0)


# What is learned.


def logs(seed=0, count=6, samples=40, between="held", step=1):
    """Runs of 6 s with a torque that changes every `step` samples, noise .05."""
    rng = np.random.default_rng(seed)
    ts = np.linspace(0, 6, samples)
    U = np.repeat(rng.uniform(-2, 2, (count, -(-samples // step), 1)), step, axis=1)[:, :samples]
    starts = jnp.asarray(rng.uniform(-1.5, 1.5, (count, 2)))

    def run(x, u):
        return hk.simulate(PLANT, x, jnp.asarray(ts), inputs=u, between=between).ys

    true = np.asarray(jax.vmap(run)(starts, jnp.asarray(U)))
    noisy = true + 0.05 * rng.standard_normal(true.shape)
    return [ts] * count, list(noisy), list(U), true


@functools.cache
def learned():
    times, states, inputs, true = logs()
    return hk.learn(K, hk.Runs(times, states, inputs)), true, inputs


@pytest.mark.slow
def test_friction_and_gain_are_found_from_noisy_states():
    found, true, inputs = learned()
    np.testing.assert_allclose(found.kernel.drift.friction, FRICTION, rtol=0.06)
    x = jnp.array([0.3, 0.2])
    np.testing.assert_allclose(found.field.input_matrix(x), [[0.0], [GAIN]], rtol=0.03)
    np.testing.assert_allclose(found.noise, 0.05, rtol=0.1)
    X, U = jnp.asarray(np.concatenate(true)), jnp.asarray(np.concatenate(inputs))
    f, g = jax.vmap(PLANT)(X, U), found.field.evaluate(X, U)
    assert np.linalg.norm(f - g) < 0.03 * np.linalg.norm(f)
    # It is a field as any other: driven again from where a run began, it goes where that went.
    times, _, _, _ = logs()
    again = hk.simulate(found.field, true[0][0], times[0], inputs=inputs[0]).ys
    assert np.sqrt(np.mean((again - true[0]) ** 2)) < 0.1
    exact = hk.fit(found.kernel, found.observations, regularization=found.regularization)
    np.testing.assert_allclose(exact(x, x[:1]), found.field(x, x[:1]), atol=0.02)
    assert float(found.posterior.deviation(x, x[:1]).max()) < 0.1


@pytest.mark.slow
def test_inputs_that_are_ignored_or_of_the_wrong_time_are_taken_for_noise():
    times, states, inputs, _ = logs()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ignored = hk.learn(K.drift, hk.Runs(times, states), process_noise=0)
        runs = hk.Runs(times, states, inputs, between="linear")
        early = hk.learn(K, runs, process_noise=0)
    assert ignored.noise.min() > 2 * 0.05
    assert abs(float(ignored.kernel.friction) / FRICTION - 1) > 0.3
    assert early.noise[1] > 1.5 * 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_inputs_of_averaged_samples_and_a_known_matrix(seed):
    times, states, inputs, _ = logs(seed, samples=1200, step=30)
    known = hk.Controlled(K.drift, [[0.0], [GAIN]])
    for kernel in (K, known):
        found = hk.learn(kernel, hk.Runs(times, states, inputs))
        np.testing.assert_allclose(found.kernel.drift.friction, FRICTION, rtol=0.03)
        np.testing.assert_allclose(found.noise, 0.05, rtol=0.05)
        gain = found.field.input_matrix(jnp.array([0.3, 0.2]))
        np.testing.assert_allclose(gain, [[0.0], [GAIN]], rtol=0.01)


@pytest.mark.slow
def test_the_lag_of_inputs_and_their_gain_are_found():
    """A torque of seven samples a period, logged .06 early.

    An input that is held for an interval of .1 acts .05 later on average: held and late by .01 is
    likelier here by 8 nats than smooth and late by .06, and follows the torque as well.
    """
    rng, delay = np.random.default_rng(0), 0.06
    ts = np.linspace(0, 6, 61)
    starts = np.array([[1.0, 0.0], [-0.5, 1.0], [0.0, -1.5], [1.4, 1.0]])
    phases = rng.uniform(0, 6, len(starts))

    def torque(t, phase):
        return 2 * np.sin(9.0 * t + phase)

    states = []
    for start, phase in zip(starts, phases, strict=True):
        true = solve_ivp(
            lambda t, x, phase=phase: [
                x[1],
                -6 * np.sin(x[0]) - FRICTION * x[1] + GAIN * torque(t - delay, phase),
            ],
            (0, 6),
            start,
            "DOP853",
            t_eval=ts,
            rtol=1e-9,
            atol=1e-10,
        ).y.T
        states.append(true + 0.01 * rng.standard_normal(true.shape))
    inputs = [torque(ts, phase)[:, None] for phase in phases]
    runs = hk.Runs([ts] * 4, states, inputs, between="auto", delay="fit")
    found = hk.learn(K, runs)
    assert f"m=1 {found.runs.between}, delay=0.0" in repr(found.runs)
    lag = found.runs.delay + (0.05 if found.runs.between == "held" else 0.0)
    assert abs(lag - delay) < 0.01
    gain = found.field.input_matrix(jnp.array([0.3, 0.2]))
    np.testing.assert_allclose(gain, [[0.0], [GAIN]], rtol=0.02)


@pytest.mark.slow
def test_populations_are_learned_through_their_logarithms():
    rng, animals = np.random.default_rng(0), hk.systems.LotkaVolterra()
    ts = jnp.linspace(0, 12, 61)
    starts = np.array([[1.5, 1.0], [0.5, 0.8], [1.0, 0.5]])
    *true, unseen = (np.asarray(hk.simulate(animals, x, ts).ys) for x in starts)
    noisy = [x * np.exp(0.03 * rng.normal(size=x.shape)) for x in true]
    kernel = hk.Poisson(hk.Warp(hk.Gaussian(1.0), jnp.log), hk.poisson.lotka_volterra)
    found = hk.learn(kernel, hk.Runs([ts, ts], noisy))
    np.testing.assert_allclose(hk.simulate(found.field, starts[2], ts).ys, unseen, atol=0.1)


# What is refused.


def runs(u=None, **options):
    ts = np.linspace(0, 1, 9)
    x = np.column_stack([np.sin(ts), np.cos(ts)])
    return hk.Runs([ts], [x], None if u is None else [u], **options)


VARIED = np.sin(np.arange(9.0))[:, None]


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (
            lambda: hk.learn(K, runs()),
            TypeError,
            r"needs what was applied: hk\.Runs\(times, states, ",
        ),
        (lambda: hk.learn(K.drift, runs(VARIED)), TypeError, "leave inputs out of Runs"),
        (lambda: hk.learn(K, runs(np.tile(VARIED, 2))), ValueError, "have rank 1"),
        (
            lambda: hk.learn(hk.Controlled(K.drift, np.eye(2)), runs(VARIED)),
            ValueError,
            "1 columns and the kernel 2 inputs",
        ),
        (lambda: runs(np.where(VARIED > 0.9, np.nan, VARIED)), ValueError, "NaN at sample 2"),
        (lambda: runs(VARIED, between="cubic"), ValueError, "'smooth' or 'auto'; got 'cubic'"),
        (lambda: runs(VARIED, delay="late"), TypeError, "delay must be a number, or 'fit'"),
        (lambda: runs(VARIED, delay=np.nan), ValueError, "delay must be finite"),
        (lambda: runs(VARIED[:-1]), ValueError, r"inputs=\[\(times, u\), …\]. If only the last"),
        (
            lambda: runs((np.linspace(0, 0.7, 50), np.zeros((50, 1)))),
            ValueError,
            r"the inputs of run 0 end at 0\.7 and its states at 1: .* over the whole run",
        ),
        (
            lambda: runs((np.linspace(0.1, 1, 50), np.zeros((50, 1)))),
            ValueError,
            r"inputs of run 0 begin at 0\.1 and its states at 0",
        ),
        (
            lambda: runs((np.zeros(50), np.zeros((50, 1)))),
            ValueError,
            r"the times of inputs\[0\] must increase",
        ),
        (
            lambda: hk.Runs([[0.0, 1.0]] * 2, [np.eye(2)] * 2, [np.eye(2), np.ones((2, 1))]),
            ValueError,
            r"\[1, 2\] inputs",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:inputs 0, 1 depend")
def test_what_cannot_be_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()
