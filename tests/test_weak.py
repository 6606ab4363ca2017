"""Weak rows and `hk.learn` with a `Lagrangian`, beside closed forms."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from benchmarks.lagrangian import logs, mass
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._report import script
from hamkernel._runs.runs import lines_in_intervals, values
from hamkernel._runs.smoothing import Process, smooth
from hamkernel._weak import rows as weak

PROCESS = Process(jnp.log(1.3), jnp.log(2.0), jnp.log(0.1))


def test_covariances_are_derivatives_of_one_another():
    gaps, h = np.array([-1.3, -0.2, 0.4, 2.0]), 1e-5
    k, first, second = weak._covariances(PROCESS, gaps)
    above, below = (weak._covariances(PROCESS, gaps + s * h) for s in (1, -1))
    np.testing.assert_allclose(first, (above[0] - below[0]) / (2 * h), rtol=1e-7)
    np.testing.assert_allclose(second, -(above[1] - below[1]) / (2 * h), rtol=1e-7)
    np.testing.assert_allclose(weak._covariances(PROCESS, np.zeros(1))[0], 1.3**2)
    assert k[1] > k[0]


def test_the_conditioned_path_is_that_of_the_kalman_smoother():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.3, 30))
    y = np.sin(t) + 0.1 * rng.normal(size=30)
    steps = jnp.asarray(np.diff(t, prepend=t[0]))
    centre = y.mean()
    wanted = smooth(PROCESS, steps, jnp.asarray(y - centre), jnp.ones(30, bool))
    # Two channels side by side; their slopes were not measured.
    none, variance = np.full((30, 2), np.nan), np.tile([0.01, np.nan], (30, 1))
    x = np.stack([np.column_stack([y, 2 * y]), none], axis=1)
    found, S = weak._posterior_path(PROCESS, t, x, variance, t)
    q, v = np.split(found[:, 0], 2)
    np.testing.assert_allclose(q - centre, wanted.value, atol=1e-9)
    assert S is not None
    np.testing.assert_allclose(found[:, 1], 2 * found[:, 0], atol=1e-12)
    E = weak._root(S)
    np.testing.assert_allclose(E @ E.T, S, atol=1e-5 * S.max())
    np.testing.assert_allclose(v, wanted.slope, atol=1e-8)
    deviations = np.sqrt(np.diagonal(S))
    np.testing.assert_allclose(deviations[:30], wanted.deviation, rtol=1e-6)
    np.testing.assert_allclose(deviations[30:], wanted.slope_deviation, rtol=1e-6)
    x[:, 1, 0], variance[:, 1] = np.cos(t), 1e-6
    found, T = weak._posterior_path(PROCESS, t, x[:, :, :1], variance, t)
    np.testing.assert_allclose(found[30:, 0], np.cos(t), atol=5e-3)
    assert np.diagonal(T)[:30].max() < np.diagonal(S)[:30].max()


@pytest.mark.parametrize(("between", "atol"), [("held", 5e-3), ("linear", 5e-4), ("smooth", 5e-4)])
def test_inputs_at_nodes_give_the_integrals_of_inputs(between, atol):
    t, nodes, fine = 0.7 * np.arange(36), np.arange(25.0), (np.arange(24000) + 0.5) / 1000
    u = np.sin(2 * np.pi * t / 5 + 1)[:, None]
    at_nodes = weak.inputs_at_nodes(lines_in_intervals(t, u, nodes, between))

    def windows(s):
        return weak._bump(s / 12 - 1)[0] * np.array([np.ones_like(s), np.sin(s / 5)])

    wanted = windows(fine) @ values(t, u, fine, between) / 1000
    np.testing.assert_allclose(windows(nodes) @ at_nodes, wanted, atol=atol * 12)


def pendulum(x):
    """Momentum 2v and force 3 sin q, so that 2a + 3 sin q is the torque."""
    q, v = x
    return jnp.array([2.0 * v]), jnp.array([3.0 * jnp.sin(q)])


def one_piece(path):
    nodes, half = len(path), 12
    s = (np.arange(nodes)[None] - np.array([12, 24])[:, None]) / half
    phi, slope = weak._bump(s)
    step = 0.02
    roots = np.random.default_rng(1).normal(size=(1, 1, 2 * nodes, 5))
    inside = np.ones((1, 2), bool)
    targets = np.zeros((1, 2, 1))
    windows = phi * step, slope / half
    overlap, owner = phi @ phi.T * step, np.zeros(1, int)
    inputs = np.zeros((1, nodes, 0))
    return weak.Pieces(path[None], roots, owner, *windows, overlap, targets, inside, inputs, step)


def test_weak_rows_are_averages_of_the_torque_and_their_covariance_is_to_first_order():
    t = 0.02 * np.arange(37)
    q, v, a = np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)
    piece = one_piece(np.column_stack([q, v]))
    rows = weak.weak_rows(pendulum, piece).reshape(2)
    wanted = piece.values @ (2 * a + 3 * np.sin(q))
    np.testing.assert_allclose(rows, wanted, rtol=1e-5)
    slopes = jax.jacfwd(lambda path: weak.weak_rows(pendulum, piece._replace(path=path)))
    D = np.swapaxes(slopes(piece.path).reshape(2, 37, 2), 1, 2).reshape(2, 74)
    found = weak.path_covariance(pendulum, piece)[0]
    E = D @ piece.roots[0, 0]
    np.testing.assert_allclose(found, E @ E.T, rtol=1e-6)
    deviation = jnp.array([0.3])
    L = weak.factors(piece, found[None], deviation)
    A = weak.whiten(L, jnp.eye(2)[None, :, None])
    C = found + 0.09 * piece.spacing * piece.overlap
    np.testing.assert_allclose(A.T @ A, np.linalg.inv(C), rtol=1e-8)
    np.testing.assert_allclose(weak.log_scale(L), np.linalg.slogdet(C)[1] / 2, rtol=1e-10)


@pytest.mark.slow
def test_channels_that_are_alike_share_a_process_and_its_errors():
    rng, t = np.random.default_rng(2), np.arange(90) / 20
    waves = np.column_stack([np.sin(2 * t), np.cos(2 * t)])
    noisy = waves + 0.03 * rng.normal(size=waves.shape)
    runs = hk.Runs([t], [noisy])
    none = np.full(noisy.shape, np.nan)
    channels = weak.Channels([noisy], [none], [np.arange(2)], has_slopes=False)
    found = weak.smoothed_pieces(runs, channels)
    assert found.pieces.roots.shape[1] == 1
    np.testing.assert_allclose(found.noise[0], 0.03, rtol=0.3)
    assert np.isnan(found.noise[1]).all()
    assert np.sqrt(np.mean((found.states[0][:, :2] - waves) ** 2)) < 0.02
    assert np.sqrt(np.mean((found.states[0][:, 2:] - 2 * waves[:, ::-1] * [1, -1]) ** 2)) < 0.12
    noisy[40, 0] = np.nan  # no longer measured at the same times
    apart = weak.smoothed_pieces(runs, channels._replace(noise=np.full((2, 2), 0.03)))
    assert apart.pieces.roots.shape[1] == 2
    np.testing.assert_array_equal(apart.pieces.owner, [0, 1])
    np.testing.assert_allclose(apart.pieces.path, found.pieces.path, atol=0.03)


def swings(count=3, noise=1e-3, viscous=0.0, dry=0.0, seed=0, gain=1.0):
    """A pendulum 2a + 20 sin q + friction = gain u, 15 s at 50 Hz, driven by two sines."""
    rng, ts = np.random.default_rng(seed), np.arange(751) / 50
    logs = []
    for _ in range(count):
        w, p, b = rng.uniform(1, 5, 2), rng.uniform(0, 6, 2), rng.uniform(3, 9, 2)

        def motor(t, w=w, p=p, b=b):
            return float(b @ np.sin(w * t + p))

        def rates(t, x, motor=motor):
            rubs = viscous * x[1] + dry * np.tanh(x[1] / 0.1)
            return [x[1], (motor(t) - 20 * np.sin(x[0]) - rubs) / 2]

        run = solve_ivp(rates, (0, 15), rng.uniform(-1, 1, 2), t_eval=ts, rtol=1e-9, atol=1e-9)
        q = run.y[0] + noise * rng.normal(size=len(ts))
        logs.append((q[:, None], np.array([[motor(t) / gain] for t in ts])))
    q, u = zip(*logs, strict=True)
    return hk.Runs([ts] * count, list(q), inputs=list(u), between="linear")


ONE = hk.Lagrangian(hk.Gaussian(1.0), hk.Gaussian(1.0), angles=(0,))


@pytest.fixture(scope="module")
def motor():
    return hk.learn(ONE, swings())


@pytest.mark.slow
def test_a_machine_is_saved_drawn_and_reported(motor, tmp_path):
    hk.save(tmp_path / "learned.hk", motor)
    loaded = hk.load(tmp_path / "learned.hk")
    q = np.array([0.3])
    np.testing.assert_array_equal(loaded.field.gravity(q), motor.field.gravity(q))
    assert repr(loaded) == repr(motor)
    panels = loaded.plot(run=-1).axes
    assert [ax.get_ylabel() for ax in panels] == [
        "$q_{1}$", "$M_{11}$", r"$\partial V/\partial q_{1}$"
    ]  # fmt: skip
    q, M = panels[1].lines[0].get_xydata().T
    np.testing.assert_allclose(M, 2.0, rtol=0.02)
    plt.close("all")
    hk.report(loaded, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "data:image/png" in page
    assert "The field may be used" in page
    exec(script(str(tmp_path / "learned.hk"), loaded), {})


@pytest.mark.slow
def test_a_motor_on_a_pendulum_is_learned_from_its_angle(motor):
    learned = motor
    assert learned.converged
    assert learned.posterior is learned.field
    Q = np.linspace(-1.2, 1.2, 20)[:, None]
    M, G = (jax.vmap(f)(Q).ravel() for f in (learned.field.mass_matrix, learned.field.gravity))
    np.testing.assert_allclose(M, 2.0, rtol=0.01)
    np.testing.assert_allclose(G, 20 * np.sin(Q[:, 0]), atol=0.1)
    band = jax.vmap(learned.field.mass_matrix_deviation)(Q).ravel()
    assert np.mean(np.abs(M - 2.0) < 3 * band + 2e-4) > 0.9
    assert "usable" in repr(learned)
    np.testing.assert_allclose(learned.noise, 1e-3, rtol=0.2)


@pytest.mark.slow
def test_free_runs_of_a_motor_are_scored_beside_a_linear_model(motor):
    ts = np.arange(101) / 50
    new = swings(count=2, seed=4).part([slice(0, 101)] * 2)
    score = motor.score(new)
    exact = [
        solve_ivp(
            lambda t, x, u=u: [x[1], (np.interp(t, ts, u[:101, 0]) - 20 * np.sin(x[0])) / 2],
            (0, 2),
            np.asarray(found[0]),
            t_eval=ts,
            rtol=1e-9,
            atol=1e-9,
        ).y.T
        for u, found in zip(new.inputs, score.predictions, strict=True)
    ]
    np.testing.assert_allclose(score.predictions, exact, atol=0.02)
    assert score.rmse[0] < 5e-3 < score.linear[0]
    assert np.isnan(score.rmse[1])  # velocities were not measured
    assert np.isnan(score.coverage)
    assert "times better than a linear model" in score.text


@pytest.mark.slow
def test_friction_that_is_missing_is_named_and_found():
    runs = swings(viscous=0.8, dry=0.6, seed=1)
    with pytest.warns(UserWarning, match="friction in joint 0"):
        learned = hk.learn(ONE, runs)
    assert "friction" in learned.diagnostics.failing
    assert not learned.converged
    field = hk.learn(hk.Lagrangian(ONE.potential, ONE.inertia, (0,), friction=True), runs).field
    np.testing.assert_allclose(field.mass_matrix(np.zeros(1)), 2.0, rtol=0.01)
    np.testing.assert_allclose(field.friction(np.ones(1)), 0.8 + 0.6, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_two_runs_of_an_arm_are_not_explained_by_noise_alone(seed):
    """Both searches ended at M = 0 while no start had long kernels with large amplitudes."""
    rng = np.random.default_rng(seed)
    times, paths, torques = logs(rng, count=2)
    seen = [x[:, :2] + 1e-3 * rng.normal(size=(len(x), 2)) for x in paths]
    K = hk.Lagrangian(hk.Gaussian(2.0), hk.Gaussian(2.0), (0, 1))
    learned = hk.learn(K, hk.Runs(times, seen, inputs=torques, between="linear"))
    assert learned.converged
    Q = np.concatenate([x[::25, :2] for x in logs(np.random.default_rng(9), count=2)[1]])
    found = np.asarray(jax.vmap(learned.field.mass_matrix)(jnp.asarray(Q)))
    wanted = np.array([mass(q) for q in Q])
    assert np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)) < 0.01  # .005 and .004


@pytest.mark.slow
def test_the_gain_of_a_motor_is_found_from_the_angle_and_a_known_inertia():
    known = np.zeros(1), np.array([[2.0]])
    K = hk.Lagrangian(ONE.potential, ONE.inertia, (0,), known_mass_matrix=known, unknown_gains=0)
    learned = hk.learn(K, swings(seed=2, gain=2.5))
    assert learned.converged
    field = learned.field
    np.testing.assert_allclose(field.gains, 2.5, rtol=0.01)
    assert abs(field.gains[0] - 2.5) < 4 * field.gains_deviation[0]
    Q = np.linspace(-1.2, 1.2, 20)[:, None]
    M, G = (jax.vmap(f)(Q).ravel() for f in (field.mass_matrix, field.gravity))
    np.testing.assert_allclose(M, 2.0, rtol=0.01)
    np.testing.assert_allclose(G, 20 * np.sin(Q[:, 0]), atol=0.1)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"mean": lambda x: x}, TypeError, "mean= does not belong"),
        ({"masses": True}, TypeError, "masses= does not belong"),
        ({"runs": 1}, TypeError, r"hk\.Runs"),
        ({"inputs": None}, ValueError, "known_mass_matrix"),
        ({"inputs": [np.zeros((40, 3))]}, ValueError, "with a torque for each position"),
        ({"noise": -1.0}, ValueError, "positive"),
    ],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_runs_of_which_no_machine_can_be_learned_are_refused(change, error, said):
    t = np.arange(40) / 10
    u = change.pop("inputs", [np.sin(np.arange(80.0)).reshape(40, 2)])
    if u is not None and u[0].shape[1] == 3:
        u = [np.sin(np.arange(120.0)).reshape(40, 3)]
    runs = change.pop("runs", hk.Runs([t], [np.cos(np.outer(t, [1, 2]))], inputs=u))
    K = hk.Lagrangian(hk.Gaussian(1.0), hk.Gaussian(1.0))
    with pytest.raises(error, match=said):
        hk.learn(K, runs, **change)
