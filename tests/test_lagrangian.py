"""`hk.Lagrangian`: a two-link arm in closed form, in NumPy, and its free motion by SciPy."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk

SMOOTH = hk.Gaussian(1.0)
A1, A2, A3, G1, G2 = 1.8, 0.6, 0.5, 12.0, 4.0
K = hk.Lagrangian(300.0 * hk.Gaussian(2.0), 10.0 * hk.Gaussian(2.0), angles=(0, 1))


def mass(q):
    c = A3 * np.cos(q[1])
    return np.array([[A1 + 2 * c, A2 + c], [A2 + c, A2]])


def gravity(q):
    both = G2 * np.sin(q[0] + q[1])
    return np.array([G1 * np.sin(q[0]) + both, both])


def energy(x):
    q, v = x[:2], x[2:]
    return 0.5 * v @ mass(q) @ v - G1 * np.cos(q[0]) - G2 * np.cos(q.sum())


def torque(q, v, a, viscous=0.0, dry=0.0):
    s = A3 * np.sin(q[1])
    coriolis = np.array([-s * (2 * v[0] + v[1]) * v[1], s * v[0] ** 2])
    return mass(q) @ a + coriolis + gravity(q) + viscous * v + dry * np.tanh(v / 0.1)


def batch(function):
    return jax.jit(jax.vmap(function))


def data(count, seed, noise=0.0, **friction):
    rng = np.random.default_rng(seed)
    Q, V, A = rng.uniform(-3, 3, (count, 2)), *rng.normal(0, 3.0, (2, count, 2))
    tau = np.array([torque(*each, **friction) for each in zip(Q, V, A, strict=True)])
    return np.concatenate([Q, V], 1), tau + noise * rng.normal(size=tau.shape), A


@pytest.fixture(scope="module")
def arm():
    X, tau, A = data(120, 0)
    return hk.fit(K, X, tau, 1e-12, accelerations=A)


def errors(field, seed=7):
    """Of M, gravity and torques at 40 other states, relative to their rms."""
    X, tau, A = data(40, seed)
    truth = np.array([mass(q) for q in X[:, :2]]), np.array([gravity(q) for q in X[:, :2]]), tau
    found = (
        batch(field.mass_matrix)(X[:, :2]),
        batch(field.gravity)(X[:, :2]),
        batch(field.inverse_dynamics)(X[:, :2], X[:, 2:], A),
    )
    pairs = zip(found, truth, strict=True)
    return [np.sqrt(np.mean((f - t) ** 2) / np.mean(t**2)) for f, t in pairs]


def test_mass_matrix_gravity_and_torques_are_those_of_the_arm(arm):
    assert max(errors(arm)) < 2e-3
    assert arm.is_identified
    q, v = np.array([0.4, -1.1]), np.array([0.7, 2.0])
    M = mass(q)
    np.testing.assert_allclose(arm.mass_matrix(q), arm.mass_matrix(q).T)
    x = np.concatenate([q, v])
    np.testing.assert_allclose(arm.momentum(x), M @ v, rtol=1e-3)
    of_speeds = jax.jit(jax.hessian(lambda v: arm.lagrangian(jnp.concatenate([q, v]))))
    np.testing.assert_allclose(of_speeds(v), M, rtol=2e-3)
    zero = np.zeros(4)
    wanted = energy(x) - energy(zero)
    np.testing.assert_allclose(arm.hamiltonian(x) - arm.hamiltonian(zero), wanted, rtol=1e-3)
    np.testing.assert_allclose(jax.jit(arm.gravity)(q), gravity(q), rtol=1e-3)


def test_the_features_of_torques_are_euler_and_lagrange_by_differences(arm):
    features, w = arm.features, arm.coefficients
    x, a, h = jnp.array([0.3, -0.8, 1.2, 0.5]), jnp.array([2.0, -1.0]), 1e-5

    def slope(x, i):
        step = h * jnp.eye(4)[i]
        L = lambda x: features.features_at(x) @ w  # noqa: E731
        return (L(x + step) - L(x - step)) / (2 * h)

    d = jnp.concatenate([x[2:], a])
    for i in range(2):
        along = (slope(x + 1e-4 * d, 2 + i) - slope(x - 1e-4 * d, 2 + i)) / 2e-4
        wanted = along - slope(x, i)
        found = (features.torque_features(x, a) @ w)[i]
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_a_saved_machine_is_the_same(arm, tmp_path):
    hk.save(tmp_path / "arm", arm)
    loaded = hk.load(tmp_path / "arm")
    q = np.array([0.3, -0.7])
    for name in ("mass_matrix", "mass_matrix_deviation", "gravity"):
        np.testing.assert_array_equal(getattr(loaded, name)(q), getattr(arm, name)(q))
    assert loaded.kernel.angles == (0, 1)


@pytest.mark.slow
def test_tune_finds_the_noise_and_lengthscales():
    X, tau, A = data(100, 5, noise=0.05)
    start = hk.Lagrangian(SMOOTH, SMOOTH, angles=(0, 1))
    tuned = hk.tune(start, X, tau, accelerations=A)
    np.testing.assert_allclose(jnp.sqrt(100 * tuned.regularization), 0.05, rtol=0.2)
    assert max(errors(tuned.field)) < 0.01
    assert tuned.hyperparameters["potential.kernel.lengthscale"] > 1
    again = hk.fit(tuned.kernel, X, tau, tuned.regularization, accelerations=A)
    np.testing.assert_allclose(again.mass_matrix(X[0, :2]), tuned.field.mass_matrix(X[0, :2]))


@pytest.mark.slow
def test_a_free_motion_is_scipys(arm):
    def rates(t, x):
        q, v = x[:2], x[2:]
        u = np.array([2.0 * np.cos(3 * t), 1.0])
        return np.concatenate([v, np.linalg.solve(mass(q), u - torque(q, v, np.zeros(2)))])

    x0, ts = np.array([0.5, 0.2, 0.0, 0.0]), np.linspace(0, 2, 21)
    true = solve_ivp(rates, (0, 2), x0, t_eval=ts, rtol=1e-9, atol=1e-9).y.T

    def inputs(t):
        return jnp.array([2.0 * jnp.cos(3 * t), 1.0])

    run = hk.simulate(arm, jnp.asarray(x0), jnp.asarray(ts), inputs=inputs)
    np.testing.assert_allclose(run.ys, true, atol=0.02)


@pytest.mark.slow
def test_friction_is_found_and_spoils_the_mass_matrix_where_it_is_ignored():
    X, tau, A = data(120, 1, viscous=0.8, dry=0.5)
    with_friction = hk.Lagrangian(
        K.potential, K.inertia, angles=(0, 1), friction=hk.Friction(1.0, 1.0, rest_speed=0.1)
    )
    field = hk.fit(with_friction, X, tau, 1e-10, accelerations=A)
    assert max(errors(field)[:2]) < 1e-3
    v = np.array([1.5, -0.02])
    np.testing.assert_allclose(field.friction(v), 0.8 * v + 0.5 * np.tanh(v / 0.1), rtol=0.01)
    with pytest.warns(UserWarning, match="much likelier with friction in joint 0, 1"):
        ignored = hk.fit(K, X, tau, 1e-10, accelerations=A)
    assert errors(ignored)[0] > 30 * errors(field)[0]


@pytest.mark.slow
def test_bands_hold_the_truth():
    inside = []
    for seed in range(3):
        X, tau, A = data(80, 10 + seed, noise=0.1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # at one of the states M is known to a deviation only
            field = hk.fit(K, X, tau, 0.1**2 / 80, accelerations=A)
        Q = data(30, 50 + seed)[0][:, :2]
        M = np.array([mass(q) for q in Q])
        off = np.abs(batch(field.mass_matrix)(Q) - M)
        inside.append(off < 2 * batch(field.mass_matrix_deviation)(Q))
        off = np.abs(batch(field.gravity)(Q) - np.array([gravity(q) for q in Q]))
        inside.append(off < 2 * batch(field.gravity_deviation)(Q))
        Z, tau, A = data(30, 70 + seed)
        off = np.abs(batch(field.inverse_dynamics)(Z[:, :2], Z[:, 2:], A) - tau)
        inside.append(off < 2 * batch(field.torque_deviation)(Z[:, :2], Z[:, 2:], A))
        zero = np.zeros(4)
        off = batch(field.hamiltonian)(Z) - field.hamiltonian(zero)
        off = np.abs(off - np.array([energy(z) - energy(zero) for z in Z]))
        inside.append(off < 2 * batch(partial(field.energy_deviation, x0=zero))(Z))
    share = np.mean(np.concatenate([np.ravel(each) for each in inside]))
    assert 0.85 < share <= 1


@pytest.mark.slow
def test_one_path_does_not_identify_a_mass_matrix():
    """At rest torques are gravity alone: M is unknown, and a motion is refused."""
    X, _, _ = data(40, 3)
    X[:, 2:] = 0.0
    tau = np.array([gravity(q) for q in X[:, :2]])
    with pytest.warns(UserWarning, match="the mass matrix is not identified"):
        field = hk.fit(K, X, tau, 1e-8, accelerations=np.zeros((40, 2)))
    assert not field.is_identified
    with pytest.raises(RuntimeError, match="the mass matrix is not identified"):
        hk.simulate(field, X[0], np.linspace(0, 1, 5), inputs=lambda t: jnp.zeros(2))
    with pytest.raises(RuntimeError, match="not positive definite at this state"):
        field(X[0], jnp.zeros(2))
    np.testing.assert_allclose(field.gravity(X[0, :2]), tau[0], atol=0.05)


@pytest.mark.slow
def test_a_joint_without_a_torque_that_is_not_coupled_is_refused_by_its_number():
    """Two pendulums side by side, and a motor in the first: the other half of L stays zero."""
    X, _, A = data(80, 8)
    tau = np.column_stack([2.0 * A[:, 0] + 3.0 * np.sin(X[:, 0]), np.zeros(80)])
    A[:, 1] = -5.0 * np.sin(X[:, 1])
    with pytest.warns(UserWarning, match=r"not identified.*mostly of joint 1.*needs a torque"):
        field = hk.fit(K, X, tau, 1e-8, accelerations=A)
    assert abs(field.least_direction[1]) > 0.9
    with pytest.raises(RuntimeError, match="mostly of joint 1"):
        hk.simulate(field, X[0], np.linspace(0, 1, 5), inputs=lambda t: jnp.zeros(2))


@pytest.mark.slow
def test_gains_of_motors_are_found_with_a_known_inertia_or_beside_a_known_motor():
    X, tau, A = data(120, 6)
    gains = np.array([2.5, 0.4])
    known = np.zeros(2), np.array([[A1 + 2 * A3, np.nan], [np.nan, np.nan]])
    both = hk.Lagrangian(
        K.potential, K.inertia, (0, 1), known_mass_matrix=known, unknown_gains=(0, 1)
    )
    field = hk.fit(both, X, tau / gains, 1e-12, accelerations=A)
    assert field.is_identified
    np.testing.assert_allclose(field.gains, gains, rtol=1e-3)
    assert (abs(field.gains - gains) < 4 * field.gains_deviation + 1e-4 * gains).all()
    assert max(errors(field)) < 5e-3  # torques in newton metres
    x, u = X[0], np.array([1.0, -2.0])
    expected = np.linalg.solve(mass(x[:2]), gains * u - torque(x[:2], x[2:], np.zeros(2)))
    np.testing.assert_allclose(field(x, u)[2:], expected, rtol=0.02, atol=0.02)
    one = hk.Lagrangian(K.potential, K.inertia, (0, 1), unknown_gains=1)
    field = hk.fit(one, X, tau / np.array([1.0, 0.4]), 1e-12, accelerations=A)
    np.testing.assert_allclose(field.gains, [1.0, 0.4], rtol=1e-3)
    with pytest.raises(ValueError, match="all torques of known gains are zero"):
        hk.fit(
            hk.Lagrangian(K.potential, K.inertia, unknown_gains=(0, 1)),
            X,
            tau,
            1e-12,
            accelerations=A,
        )


@pytest.mark.slow
def test_stribeck_friction_of_joints_is_found():
    X, tau, A = data(160, 9)
    X[::2, 2:] *= 0.1  # slow enough to show it
    tau = np.array([torque(x[:2], x[2:], a) for x, a in zip(X, A, strict=True)])

    def friction(v):
        return 0.5 * v + (0.8 + 0.6 * np.exp(-((v / 0.4) ** 2))) * np.tanh(v / 0.05)

    rough = hk.Friction(1.0, 1.0, stribeck=1.0, rest_speed=0.05, stribeck_speed=0.4)
    field = hk.fit(
        hk.Lagrangian(K.potential, K.inertia, (0, 1), friction=rough),
        X,
        tau + friction(X[:, 2:]),
        1e-10,
        accelerations=A,
    )
    assert max(errors(field)[:2]) < 5e-3
    v = np.array([0.3, -2.0])
    np.testing.assert_allclose(field.friction(v), friction(v), rtol=0.01)
    with pytest.raises(ValueError, match="leave out damped="):
        hk.Lagrangian(SMOOTH, SMOOTH, friction=hk.Friction(damped=(1,)))


@pytest.mark.slow
def test_one_known_entry_of_the_mass_matrix_fixes_the_scale_of_a_free_motion():
    X, _, _ = data(120, 4)
    free = [-torque(x[:2], x[2:], np.zeros(2)) for x in X]
    A = np.array([np.linalg.solve(mass(x[:2]), f) for x, f in zip(X, free, strict=True)])
    known = np.zeros(2), np.array([[A1 + 2 * A3, np.nan], [np.nan, np.nan]])
    anchored = hk.Lagrangian(K.potential, K.inertia, (0, 1), known_mass_matrix=known)
    field = hk.fit(anchored, X, np.zeros((120, 2)), 1e-12, accelerations=A)
    assert max(errors(field)) < 5e-3


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (np.eye(2), "must be a pair|shape"),
        ((np.zeros(2), np.eye(3)), "shape"),
        ((np.zeros(2), np.full((2, 2), np.nan)), "at least one known entry"),
    ],
)
def test_a_known_mass_matrix_is_checked(known, said):
    with pytest.raises(ValueError, match=said):
        hk.Lagrangian(SMOOTH, SMOOTH, known_mass_matrix=known)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"accelerations": None}, TypeError, "accelerations=A"),
        ({"Y": np.zeros((20, 2))}, ValueError, "all torques are zero.*known_mass_matrix"),
        ({"X": np.ones((20, 3))}, ValueError, r"shape \(N, 2m\)"),
        (
            {"K": hk.Lagrangian(hk.Gaussian(1.0), hk.Gaussian(1.0), angles=(5,))},
            ValueError,
            "from 0",
        ),
        (
            {"K": hk.Lagrangian(hk.Gaussian(1.0), hk.Gaussian(1.0), unknown_gains=(5,))},
            ValueError,
            "unknown_gains are .5,. and there are 2 positions",
        ),
        ({"K": hk.CurlFree(hk.Gaussian(1.0))}, TypeError, "belong to hk.Lagrangian"),
    ],
)
def test_what_cannot_be_learned_is_refused(change, error, said):
    X, tau, A = data(20, 0)
    with pytest.raises(error, match=said):
        hk.fit(**{"K": K, "X": X, "Y": tau, "regularization": 1e-6, "accelerations": A, **change})
