"""Trajectories against SciPy, at times that are no multiples of the step, and every refusal."""

import functools
import math
import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel import (
    Gaussian,
    GaussLegendre4,
    GaussLegendre6,
    ImplicitMidpoint,
    StormerVerlet,
    Symplectic,
    Yoshida4,
    simulate,
)

SYMPLECTIC = [
    ImplicitMidpoint(),
    GaussLegendre4(),
    GaussLegendre6(),
    StormerVerlet(),
    Yoshida4(),
]
START = jnp.array([1.5, 0.0])
# Neither equally spaced nor multiples of any step used here.
TIMES = np.array([0.0, 0.37, 1.0, 1.01, 2.718, 3.1416, 5.0])


def name(solver):
    return type(solver).__name__


class Pendulum(eqx.Module):
    """H = p²/2 − g cos q."""

    gravity: float | jax.Array = 1.0
    is_separable = True

    def __call__(self, x):
        return jnp.stack([x[1], -self.gravity * jnp.sin(x[0])])

    def hamiltonian(self, x):
        return x[..., 1] ** 2 / 2 - self.gravity * jnp.cos(x[..., 0])


def states(*args, **options):
    ys = simulate(*args, **options).ys
    assert ys is not None
    return ys


def reference(times, start=START, **tolerances):
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13} | tolerances
    return solve_ivp(
        lambda t, x: [x[1], -np.sin(x[0])], (times[0], times[-1]), start, t_eval=times, **options
    ).y.T


def test_default_solver_agrees_with_scipy():
    times = np.linspace(0, 20, 101)
    solution = simulate(Pendulum(), START, times)
    assert jnp.asarray(solution.ys).shape == (101, 2)
    np.testing.assert_array_equal(solution.ts, times)
    # 20 time units of local errors of 1e-10.
    np.testing.assert_allclose(jnp.asarray(solution.ys), reference(times), atol=1e-8)


@pytest.mark.slow
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("solver", "error"),
    list(zip(SYMPLECTIC, [2e-3, 1e-6, 1e-9, 2e-3, 1e-5], strict=True)),
    ids=lambda v: name(v) if isinstance(v, diffrax.AbstractSolver) else None,
)
def test_states_at_times_that_are_no_multiples_of_the_step(solver, error):
    solution = simulate(Pendulum(), START, TIMES, solver, dt=0.05)
    np.testing.assert_allclose(jnp.asarray(solution.ys), reference(TIMES), atol=error)
    np.testing.assert_array_equal(jnp.asarray(solution.ys)[0], START)
    # ⌈0.37/0.05⌉ + ⌈0.63/0.05⌉ + 1 + ⌈1.708/0.05⌉ + ⌈0.4236/0.05⌉ + ⌈1.8584/0.05⌉
    assert solution.stats["num_steps"] == 8 + 13 + 1 + 35 + 9 + 38


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_multiples_of_the_step_need_no_extra_step_for_rounding(dtype):
    ts = jnp.linspace(0, 30, 301).astype(dtype)  # intervals of 0.1, give or take rounding
    naive = np.ceil(np.diff(np.asarray(ts)) / dtype(0.01))
    assert set(naive.tolist()) == {10.0, 11.0}  # what must not happen
    for dt, steps in ((0.01, 10), (0.0099, 11), (7.0, 1)):
        solution = simulate(Pendulum(), START.astype(dtype), ts, hk.StormerVerlet(), dt=dt)
        assert solution.stats["num_steps"] == 300 * steps


@pytest.mark.slow
def test_saved_states_are_steps_and_not_interpolations():
    field, solver, energy = Pendulum(), GaussLegendre6(), Pendulum().hamiltonian(START)
    ts = np.linspace(0, 10, 11)
    coarse = states(field, START, ts, solver, dt=0.1, max_steps=128)
    fine = states(field, START, ts / 10, solver, dt=0.1, max_steps=128)
    # The same ten steps, saved at every step and at the tenth only.
    np.testing.assert_allclose(fine[-1], coarse[1], atol=1e-14)
    ours = states(field, START, ts, solver, dt=0.3, max_steps=128)
    assert jnp.abs(field.hamiltonian(ours) - energy).max() < 1e-7
    # Diffrax' own interpolation between constant steps shows what is avoided.
    term = diffrax.ODETerm(lambda t, x, args: field(x))
    saveat = diffrax.SaveAt(ts=jnp.asarray(ts))
    theirs = diffrax.diffeqsolve(term, solver, 0.0, 10.0, 0.3, START, saveat=saveat).ys
    assert jnp.abs(field.hamiltonian(theirs) - energy).max() > 1e-5


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [diffrax.Heun(), diffrax.Tsit5()], ids=name)
def test_any_solver_takes_constant_steps(solver):
    solution = simulate(Pendulum(), START, TIMES, solver, dt=0.01)
    np.testing.assert_allclose(jnp.asarray(solution.ys), reference(TIMES), atol=1e-3)
    assert solution.stats["num_steps"] == 37 + 63 + 1 + 171 + 43 + 186


def drift_and_wobble(energy):
    """Fitted change of the energy over the whole run, and the spread about that line."""
    time = np.linspace(-0.5, 0.5, energy.size)
    slope, offset = np.polyfit(time, energy, 1)
    return abs(slope), np.std(energy - slope * time - offset)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "solver",
    [
        SYMPLECTIC[0],
        *(pytest.param(solver, marks=pytest.mark.slow) for solver in SYMPLECTIC[1:]),
        diffrax.Tsit5(),
        pytest.param(diffrax.Heun(), marks=pytest.mark.slow),
    ],
    ids=name,
)
def test_energy_wobbles_without_drift_over_1e5_steps_only_if_symplectic(solver):
    field, dt, steps = Pendulum(), 0.2, 100_000
    # Saved at an irrational fraction of the period, for every phase of the motion to occur.
    ts = np.arange(0, steps + 1, 97) * dt
    ys = states(field, START, ts, solver, dt, throw=False)
    drift, wobble = drift_and_wobble(np.asarray(field.hamiltonian(ys)))
    if solver in SYMPLECTIC:
        # 1031 samples of a wobble fix the line to 12/√1031 of it: three standard errors.
        assert drift < 3 * np.sqrt(12 / ts.size) * wobble + 1e-12
    else:
        assert drift > 2 * wobble


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("options", [{}, {"solver": ImplicitMidpoint(), "dt": 0.1}])
def test_batch_by_vmap_is_the_loop(options):
    starts = jnp.array([[0.3, 0.0], [1.0, 0.5], [2.5, -0.1]])

    def run(x):
        return states(Pendulum(), x, TIMES, **options)

    loop = jnp.stack([run(x) for x in starts])
    np.testing.assert_allclose(jax.jit(jax.vmap(run))(starts), loop, atol=1e-13)


@pytest.mark.slow
def test_jit_with_traced_times_and_step_changes_nothing():
    def run(x, ts, dt):
        return states(Pendulum(), x, ts, GaussLegendre4(), dt)

    plain = run(START, TIMES, 0.05)
    np.testing.assert_allclose(
        jax.jit(run)(START, jnp.asarray(TIMES), jnp.array(0.05)), plain, atol=1e-14
    )


@pytest.mark.slow
def test_a_new_start_field_or_step_does_not_compile_again():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def run(field, x, ts, dt):
        return states(field, x, ts, ImplicitMidpoint(), dt)

    for g, dt in [(1.0, 0.1), (2.0, 0.05)]:
        run(Pendulum(jnp.array(g)), START * g, jnp.asarray(TIMES) * g, jnp.array(dt))


def test_a_new_tolerance_does_not_compile_again():
    compiled: list[str] = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    field = Pendulum(jnp.array(1.0))
    coarse = states(field, START, TIMES, rtol=1e-3, atol=1e-3)
    assert compiled
    compiled.clear()
    fine = states(field, START, TIMES, rtol=1e-9, atol=1e-9)
    assert not compiled
    assert 1e-8 < np.abs(fine - coarse).max() < 1e-1


def test_a_tolerance_must_be_positive():
    with pytest.raises(ValueError, match="rtol must be positive"):
        states(Pendulum(jnp.array(1.0)), START, TIMES, rtol=0.0)


@pytest.mark.parametrize(
    "options",
    [
        {},
        # As those of test_integrators.py.
        pytest.param({"solver": ImplicitMidpoint(), "dt": 0.1}, marks=pytest.mark.slow),
        pytest.param({"solver": StormerVerlet(), "dt": 0.1}, marks=pytest.mark.slow),
    ],
    ids=["adaptive", "ImplicitMidpoint", "StormerVerlet"],
)
def test_gradient_of_a_rollout_is_the_central_difference(options):
    @jax.jit
    def loss(gravity, x0):
        ys = states(Pendulum(gravity), x0, np.linspace(0, 3, 7), **options)
        return jnp.sum(ys[:, 0] ** 2)

    gravity, step = jnp.array(1.2), 1e-5
    by_gravity, by_start = jax.jit(jax.grad(loss, (0, 1)))(gravity, START)
    difference = (loss(gravity + step, START) - loss(gravity - step, START)) / (2 * step)
    np.testing.assert_allclose(by_gravity, difference, rtol=1e-6)  # step² and eps/step
    e = jnp.array([step, 0.0])
    difference = (loss(gravity, START + e) - loss(gravity, START - e)) / (2 * step)
    np.testing.assert_allclose(by_start[0], difference, rtol=1e-6)


@pytest.mark.slow
def test_flow_map_by_forward_mode_is_symplectic():
    def end(x):
        adjoint = diffrax.ForwardMode()
        return states(Pendulum(), x, TIMES, GaussLegendre4(), 0.1, adjoint=adjoint)[-1]

    # For n = 2 symplectic means of determinant one.
    np.testing.assert_allclose(np.linalg.det(jax.jit(jax.jacfwd(end))(START)), 1.0, atol=1e-12)


@pytest.mark.few(1)
@pytest.mark.parametrize("options", [{}, {"solver": diffrax.Heun(), "dt": 0.1}])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.hessian])
def test_forward_mode_through_the_default_adjoint_says_which_to_pass(derivative, options):
    def end(x):
        return states(Pendulum(), x, TIMES[:2], **options)[-1, 0]

    with pytest.raises(
        TypeError, match=r"ForwardMode\(\) for jax.jvp.*DirectAdjoint\(\) for jax.hes"
    ):
        derivative(end)(START)


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("derivative", "adjoint"),
    [(jax.hessian, "DirectAdjoint"), (lambda f: jax.jacfwd(jax.jacfwd(f)), "ForwardMode")],
)
def test_hessian_of_a_rollout_is_that_of_the_scheme(derivative, adjoint):
    A, h = np.array([[0.0, 1.0], [-1.0, 0.0]]), 0.25

    def loss(x):
        options = {"adjoint": getattr(diffrax, adjoint)(), "max_steps": 4}
        return jnp.sum(
            states(lambda x: A @ x, x, [0.0, 1.0], diffrax.Heun(), h, **options)[-1] ** 2
        )

    flow = np.linalg.matrix_power(np.eye(2) + h * A + h**2 * A @ A / 2, 4)
    np.testing.assert_allclose(derivative(loss)(START), 2 * flow.T @ flow, atol=1e-14)


def test_a_symplectic_solver_without_step_is_refused():
    for solver in SYMPLECTIC:
        with pytest.raises(ValueError, match=r"needs a constant step.*destroy symplecticity"):
            simulate(Pendulum(), START, TIMES, solver)


def test_a_solver_without_error_estimate_needs_a_step():
    with pytest.raises(ValueError, match="Euler estimates no error"):
        simulate(Pendulum(), START, TIMES, diffrax.Euler())


@pytest.mark.slow
def test_splitting_of_a_bare_function_is_refused():
    field = Pendulum()

    def bare(x):
        return field(x)

    with pytest.raises(ValueError, match="cannot be proved"):
        simulate(bare, START, TIMES, StormerVerlet(), dt=0.1)

    @functools.wraps(field)
    def damped(x):  # names a separable field, and is none
        return field(x) - 0.3 * x

    with warnings.catch_warnings():  # of Equinox, that the function holds a module
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match="cannot be proved"):
            simulate(damped, START, TIMES, StormerVerlet(), dt=0.1)

    ys = states(bare, START, TIMES[:2], StormerVerlet(assume_separable=True), dt=0.1)
    np.testing.assert_array_equal(ys, states(field, START, TIMES[:2], StormerVerlet(), dt=0.1))


def test_a_compiled_field_is_the_field():
    K = hk.Symplectic(hk.Select(hk.Gaussian(), 0) + hk.Select(hk.Gaussian(), 1))
    X = np.random.default_rng(0).normal(size=(2, 10, 2))
    field = hk.fit(K, X[0], X[1], 1e-2)
    ys = states(field, START, TIMES[:2], StormerVerlet(), dt=0.1)
    for compiled in (jax.jit(field), eqx.filter_jit(field)):
        again = states(compiled, START, TIMES[:2], StormerVerlet(), dt=0.1)
        np.testing.assert_array_equal(again, ys)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"x0": np.ones((3, 2))}, ValueError, r"shape \(3, 2\).*jax.vmap"),
        ({"x0": np.ones(())}, ValueError, r"one state of shape \(n,\)"),
        ({"x0": [np.nan, 0.0]}, ValueError, "x0 contains NaN"),
        ({"x0": np.ones(3)}, ValueError, r"maps a state of shape \(3,\) to shape \(2,\)"),
        ({"ts": [0.0]}, ValueError, "T ≥ 2, are needed"),
        ({"ts": np.ones((2, 2))}, ValueError, r"ts has shape \(2, 2\)"),
        ({"ts": [0.0, -1.0]}, ValueError, r"hk\.simulate\(lambda x: -field\(x\), \.\.\.\)"),
        ({"ts": [0.0, 2.0, 1.0]}, ValueError, "strictly increasing"),
        ({"ts": [0.0, 1.0, 1.0]}, ValueError, "strictly increasing"),
        ({"ts": [0.0, np.inf]}, ValueError, "ts contains NaN or inf"),
        ({"dt": 0.0}, ValueError, "dt must be positive"),
        ({"dt": [0.1, 0.2]}, ValueError, r"dt has shape \(2,\)"),
        ({"dt": 1e-300}, ValueError, "take a larger dt"),
        ({"max_steps": 0}, ValueError, "max_steps must be a whole number, at least 1; got 0"),
        ({"max_steps": 10.5}, TypeError, r"max_steps must be a whole number, .* got 10\.5"),
        # No interval takes more than 19.
        ({"dt": 0.1, "max_steps": 40}, ValueError, r"54 steps.*=40: .*leave max_steps None"),
        ({"adjoint": "forward"}, TypeError, "adjoint must be one of Diffrax"),
        ({"dt": 0.1, "rtol": 1e-3}, ValueError, "belong to adaptive steps"),
        ({"solver": ImplicitMidpoint}, TypeError, "an instance is needed"),
        ({"solver": "Tsit5"}, TypeError, "an instance is needed"),
        ({"solver": diffrax.SemiImplicitEuler(), "dt": 0.1}, ValueError, "StormerVerlet"),
        ({"field": 1.0}, TypeError, "a callable"),
        ({"field": lambda t, x: x}, TypeError, r"takes \(t, x\); .* one argument, the state x"),
        ({"field": Symplectic(Gaussian(1.0))}, TypeError, r"takes \(x, z\); .* by hk\.fit"),
        (
            {"field": lambda x: [x[1], -x[0]]},
            TypeError,
            r"returns list; .*jnp\.array\(\[\.\.\.\]\)",
        ),
        ({"field": lambda x: x.astype(jnp.float32)}, TypeError, "maps float64 to float32"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes, error, message):
    arguments = {"field": Pendulum(), "x0": START, "ts": TIMES} | changes
    with pytest.raises(error, match=message):
        simulate(**arguments)


@pytest.mark.parametrize(
    "field",
    [
        lambda x: np.sin(x),
        lambda x: jnp.array([math.sin(x[1]), x[0]]),
        lambda x: x if x[0] > 0 else -x,
    ],
)
def test_a_field_that_jax_cannot_trace_is_told_to_use_jax_numpy(field):
    with pytest.raises(TypeError, match=r"jax\.numpy in place of numpy.*jnp\.where") as caught:
        simulate(field, START, TIMES)
    assert isinstance(caught.value.__cause__, jax.errors.JAXTypeError)


def test_an_error_inside_the_field_is_not_hidden():
    def field(x):
        return jnp.stack(x, axes=0)  # pyright: ignore[reportCallIssue]

    with pytest.raises(TypeError, match="unexpected keyword argument 'axes'"):
        simulate(field, START, TIMES)


def test_bad_times_are_refused_under_jit_too():
    with pytest.raises(Exception, match="strictly increasing"):
        jax.jit(lambda ts: states(Pendulum(), START, ts))(jnp.array([0.0, 2.0, 1.0]))


@pytest.mark.slow
def test_failed_solves_raise_unless_told_not_to():
    ts = np.array([0.0, 5.0])
    with pytest.raises(RuntimeError, match="maximum number of solver steps"):
        simulate(Pendulum(), START, ts, max_steps=3)
    with pytest.raises(RuntimeError, match="Too many steps"):
        jax.jit(lambda ts: states(Pendulum(), START, ts, Yoshida4(), dt=0.01, max_steps=100))(ts)
    with pytest.raises(RuntimeError, match=r"maximum number|diverge"):
        simulate(Pendulum(jnp.array(1e4)), START, ts, ImplicitMidpoint(), dt=0.5)
    with pytest.raises(RuntimeError, match=r"overflowed.*smaller dt"):
        simulate(lambda x: x**3, START, ts, diffrax.Euler(), dt=0.1)
    quiet = simulate(Pendulum(), START, ts, max_steps=3, throw=False)
    assert quiet.result == diffrax.RESULTS.max_steps_reached
    stiff = Pendulum(jnp.array(1e4))
    stuck = simulate(stiff, START, ts, ImplicitMidpoint(), dt=0.5, throw=False)
    assert stuck.result != diffrax.RESULTS.successful
    # The state of a step that failed is no state.
    assert not jnp.isfinite(jnp.asarray(stuck.ys)[1:]).any()


@pytest.mark.few(1)
@pytest.mark.parametrize("options", [{}, {"solver": Yoshida4(), "dt": 0.1}])
def test_progress_shows_a_bar_and_changes_nothing(options, capsys):
    quiet = simulate(Pendulum(), START, TIMES, **options)
    assert "%" not in capsys.readouterr().err
    loud = simulate(Pendulum(), START, TIMES, progress=True, **options)
    jax.effects_barrier()
    assert "100.00%" in capsys.readouterr().err
    np.testing.assert_array_equal(loud.ys, quiet.ys)


@pytest.mark.few(1)
@pytest.mark.parametrize("options", [{}, {"solver": GaussLegendre4(), "dt": 0.01}])
def test_float32_stays_float32_and_late_times_are_as_exact_as_early_ones(options):
    # The field does not depend on time. Near 1e5 neighbouring float32 are 0.008 apart, about the
    # constant step.
    ts = 1e5 + np.linspace(0, 5, 101)
    solution = simulate(Pendulum(), START.astype(jnp.float32), ts, **options)
    assert jnp.asarray(solution.ys).dtype == jnp.float32
    assert "dt" not in options or solution.stats["num_steps"] == 500
    np.testing.assert_allclose(jnp.asarray(solution.ys), reference(ts - ts[0]), atol=2e-5)
    np.testing.assert_array_equal(solution.ts, ts.astype(np.float32))
    assert (float(solution.t0), float(solution.t1)) == (ts[0], ts[-1])


@pytest.mark.slow
def test_a_state_that_overflows_in_constant_steps_is_no_success():
    def run(throw):
        return simulate(lambda x: x**2, np.ones(1), np.array([0.0, 0.5, 2.0]), dt=0.01, throw=throw)

    solution = run(throw=False)
    ys = np.asarray(solution.ys)
    assert solution.result == diffrax.RESULTS.nonfinite
    assert not np.isfinite(ys[-1]).any()
    np.testing.assert_allclose(ys[1], [2.0], atol=1e-8)  # 1/(1 - t)
    with pytest.raises(RuntimeError, match="overflowed"):
        run(throw=True)


@pytest.mark.slow
def test_the_reason_of_a_failure_is_the_one_that_is_said():
    with pytest.raises(RuntimeError, match="NaN or infinite at x0 already"):
        simulate(lambda x: x * jnp.nan, START, TIMES)
    with pytest.raises(TypeError, match="return floats"):
        simulate(lambda x: jnp.array([1, 2]), START, TIMES)
    with pytest.raises(TypeError, match="float32 or float64"):
        simulate(Pendulum(), START.astype(jnp.float16), TIMES)


def test_each_tolerance_is_its_own():
    pendulum, x0, ts = hk.systems.Pendulum(), jnp.array([1.0, 0.0]), jnp.linspace(0.0, 1.0, 5)

    def steps(**tolerances):
        return int(hk.simulate(pendulum, x0, ts, **tolerances).stats["num_steps"])

    assert steps(atol=1e-2) < steps(atol=1e-12)
    assert steps(rtol=1e-2, atol=1e-9) < steps(rtol=1e-12, atol=1e-9)


def swings(X):
    return jax.vmap(lambda x: jnp.array([x[1], -jnp.sin(x[0])]))(X)


@pytest.mark.parametrize("has_inputs", [False, True])
def test_paths_far_from_the_data_are_said(has_inputs):
    X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (30, 2)))
    K, U, inputs = Symplectic(Gaussian(1.0)), None, None
    if has_inputs:
        K = hk.Controlled(K, inputs=hk.InputMatrix(1.0, acts_on=(1,)))
        U, inputs = jnp.sin(jnp.arange(30.0))[:, None], lambda t: jnp.zeros(1)
    field, ts = hk.fit(K, X, swings(X), inputs=U), jnp.linspace(0, 1, 5)
    for near in (0.5, 1.5):
        simulate(field, jnp.array([near, 0.0]), ts, inputs=inputs)
    with pytest.warns(UserWarning, match="at time 0 the path is far from the points"):
        simulate(field, jnp.array([9.0, 0.0]), ts, inputs=inputs)


def test_turns_of_an_angle_are_not_far_from_the_data():
    X = jnp.asarray(np.random.default_rng(0).uniform([-3, -1], [3, 1], (30, 2)))
    k = hk.Select(hk.Periodic(2 * np.pi), 0) * hk.Select(Gaussian(2.0), 1)
    field = hk.fit(Symplectic(k), X, swings(X))
    simulate(field, jnp.array([40.0, 0.5]), jnp.linspace(0, 1, 5))
