"""`Friction`: a force that is odd, takes energy away, and does not vanish outside the data."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false
# Wrong types are refused here, and any field is looked into.

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._runs.flow import Expansion, integrate, steps_for, stiffness

VISCOUS, COULOMB, REST = 0.2, 0.6, 0.2


def curve(v):
    return VISCOUS * v + COULOMB * np.tanh(v / REST)


def pendulum(x):
    """A pendulum of mass one with viscous and dry friction, in NumPy."""
    return np.stack([x[1], -6.0 * np.sin(x[0]) - curve(x[1])])


def kinematics(x):
    """q̇ = p, which is known."""
    return jnp.array([x[1], 0.0])


RNG = np.random.default_rng(0)
X = RNG.uniform((-2.5, -3.0), (2.5, 3.0), size=(60, 2))
Y = pendulum(X.T).T + 0.02 * RNG.normal(size=X.shape)
FORCES = hk.Velocities(X, np.where([True, False], np.nan, Y))  # q̇ is known
POTENTIAL = 10.0 * hk.Select(hk.Gaussian(1.5), 0)


def test_blocks_are_those_of_the_closed_form():
    K = hk.Friction([0.3, 0.1], 0.5, stribeck=0.7, rest_speed=0.2, stribeck_speed=0.4)
    x, z = RNG.normal(size=(2, 4))

    def force(v, d):
        return d * v + (0.5 + 0.7 * np.exp(-((v / 0.4) ** 2))) * np.tanh(v / 0.2)

    F, G = (np.array([0, 0, force(s[2], 0.3), force(s[3], 0.1)]) for s in (x, z))
    np.testing.assert_allclose(K(x, z), np.diag(F * G), atol=1e-14)
    assert repr(K).startswith("Friction(")


@functools.cache
def tuned(known):
    """With q̇ = p known and a potential, or with any energy."""
    energy = POTENTIAL if known else 10.0 * hk.Gaussian(2.0)
    K = hk.Sum(energy=hk.Symplectic(energy), friction=hk.Friction(0.1, 0.1, rest_speed=REST))
    options = {"objective": "marginal_likelihood", "starts": 4}
    if known:
        return hk.tune(K, FORCES, mean=kinematics, **options)
    return hk.tune(K, X, Y, **options)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.few(1)
def test_the_curve_is_found_with_a_known_kinetic_energy_and_without(known):
    found = tuned(known).field.part("friction")
    speeds = np.array([0.3, 1.0, 2.0, 3.0])
    forces = [found(jnp.array([0.3, v]))[1] for v in speeds]
    np.testing.assert_allclose(forces, -curve(speeds), rtol=0.1)
    np.testing.assert_allclose(found(jnp.array([0.3, 1.0]))[0], 0.0, atol=1e-12)


@pytest.mark.slow
def test_it_takes_energy_away_at_every_speed_where_a_gaussian_falls_to_zero():
    gaussian = hk.Sum(
        energy=hk.Symplectic(POTENTIAL),
        friction=hk.Odd(hk.CurlFree(10.0 * hk.Select(hk.Gaussian(1.0), 1))),
    )
    ordinary = hk.fit(gaussian, FORCES, regularization=1e-5, mean=kinematics).part("friction")
    found = tuned(True).field.part("friction")
    speeds = jnp.linspace(-60.0, 60.0, 241)
    states = jnp.stack([jnp.zeros_like(speeds), speeds], axis=1)
    force, others = found.evaluate(states)[:, 1], ordinary.evaluate(states)[:, 1]
    assert (force * speeds <= 0).all()
    np.testing.assert_allclose(force, -force[::-1], atol=1e-10)  # odd
    outside = np.abs(speeds) > 20
    assert np.abs(force[outside]).min() > COULOMB + 0.5 * VISCOUS * 20
    assert np.abs(others[outside]).max() < 1e-6


@pytest.mark.slow
def test_parts_are_saved_loaded_and_symmetrised(tmp_path):
    field = tuned(True).field
    hk.save(tmp_path / "f", field)
    again = hk.load(tmp_path / "f", mean=kinematics)
    x = jnp.array([0.3, 1.7])
    np.testing.assert_array_equal(again(x), field(x))
    K = hk.Odd(hk.Symplectic(hk.Gaussian(1.0)) + hk.Friction())
    np.testing.assert_allclose(K(-x, x), -K(x, x), atol=1e-14)


def test_a_rest_speed_that_was_not_given_has_the_units_of_the_momenta():
    # With .1 dry friction of momenta of some thousandths looks like a viscous one.
    forces = np.where([True, False], np.nan, Y)
    slow, found = np.array([1.0, 1e-3]), {}
    for unit in (1.0, 1e-3):
        data = hk.Velocities(X * [1.0, unit], forces * [1.0, unit])
        found[unit] = hk.fit(hk.Friction(0.1, 0.1 * unit), data, regularization=1e-6 * unit**2)
    x = jnp.array([0.0, 0.1])
    np.testing.assert_allclose(found[1e-3](x * slow), found[1.0](x) * slow, rtol=1e-6)
    own = found[1.0].kernel.rest_speed
    assert 1e-3 < own / np.abs(X[:, 1]).max() < 1e-2
    assert f"rest_speed={own:.4g}" in repr(found[1.0])
    both = hk.fit(hk.Friction() + hk.Friction(rest_speed=0.5), FORCES, regularization=1e-6)
    assert [part.rest_speed for part in both.kernel.terms] == [own, 0.5]
    still = hk.fit(hk.Friction(), X * [1.0, 0.0], Y, regularization=1e-6)  # no momenta were seen
    assert still.kernel.rest_speed == 0.1
    assert still(x)[1] == 0.0
    with pytest.raises(TypeError, match=r"without a rest speed .* Name it: hk.Friction\(rest_sp"):
        jax.jit(lambda X: hk.fit(hk.Friction(), X, Y, regularization=1e-6)(x))(X)


@pytest.mark.slow
def test_steps_of_learn_are_short_enough_for_a_momentum_that_changes_its_sign():
    rest, ts = 0.005, np.linspace(0.0, 2.0, 101)
    K = hk.Friction(VISCOUS, COULOMB, rest_speed=rest)
    at = jnp.array([[0.0, 1.0]])
    forces = jnp.array([[0.0, -1.0 / K.curve(at[0])[1]]])
    field = Expansion(K, at, forces, lambda x: jnp.array([x[1], -6.0 * jnp.sin(x[0])]))

    def slope(t, x):
        force = -6.0 * np.sin(x[0]) - VISCOUS * x[1] - COULOMB * np.tanh(x[1] / rest)
        return np.array([x[1], force])

    options = {"rtol": 1e-10, "atol": 1e-12, "t_eval": ts, "max_step": 1e-3}
    true = solve_ivp(slope, (0, 2), [1.5, 0.5], "DOP853", **options).y.T
    spans = np.diff(ts)[None]
    steps = jnp.asarray(steps_for(spans, stiffness(field, true, true.std(axis=0))))
    inputs = jnp.zeros((1, len(ts) - 1, 2, 0))
    path = integrate(field, jnp.asarray(true[:1]), jnp.asarray(spans), steps, inputs).x[0]
    assert np.abs(path - true).max() < 2e-4  # 1e-3 with steps for the usual ‖∂f/∂x‖


def positions(starts, samples, rng):
    """Times and noisy positions of 8 s from these starts, in lists."""
    ts = np.linspace(0.0, 8.0, samples)
    options = {"rtol": 1e-9, "atol": 1e-10, "t_eval": ts}
    runs = [
        solve_ivp(lambda t, x: pendulum(x), (0, 8), x0, "LSODA", **options).y.T for x0 in starts
    ]
    noisy = [x + 0.005 * rng.normal(size=x.shape) for x in runs]
    for x in noisy:
        x[:, 1] = np.nan
    return [ts] * len(starts), noisy


def energy_and_friction(guess):
    friction = hk.Friction(guess, guess, rest_speed=REST)
    return hk.Sum(energy=hk.Symplectic(POTENTIAL), friction=friction)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # one iteration does not settle
def test_it_is_found_whatever_the_guess():
    # From a guess of .003 alone the search ended at 1.2 times the force at ten times the speed.
    log = hk.Runs(*positions(([2.5, 0.0], [0.5, 4.0]), 48, np.random.default_rng(1)))
    K = energy_and_friction(0.003)
    found = hk.learn(K, log, mean=kinematics, iterations=1, process_noise=0, progress=False)
    speeds = np.array([0.5, 1.0, 3.0, 30.0])
    forces = [found.field.part("friction")(jnp.array([0.3, v]))[1] for v in speeds]
    np.testing.assert_allclose(forces[:3], -curve(speeds[:3]), rtol=0.05)
    np.testing.assert_allclose(forces[3], -curve(30.0), rtol=0.1)


@pytest.mark.slow
def test_it_is_found_from_positions_alone_and_the_motion_stops_where_it_sticks():
    # Three runs of one of six such logs lost two: the search had ended without viscous friction.
    starts = [2.5, 0.0], [0.5, 4.0], [-1.0, -2.0]
    log = hk.Runs(*positions(starts, 241, RNG))
    found = hk.learn(energy_and_friction(0.1), log, mean=kinematics)
    assert found.converged
    assert found.dropped == ()
    speeds = np.array([0.5, 1.0, 3.0, 30.0])
    forces = [found.field.part("friction")(jnp.array([0.3, v]))[1] for v in speeds]
    np.testing.assert_allclose(forces[:3], -curve(speeds[:3]), rtol=0.05)
    assert 0.5 < -forces[3] / curve(30.0) < 1.5  # ten times as fast as the log
    ts = np.asarray(log.times[0])
    options = {"rtol": 1e-9, "atol": 1e-10, "t_eval": ts}
    path = hk.simulate(found.field, jnp.array([1.5, 0.0]), jnp.asarray(ts)).ys
    expected = solve_ivp(lambda t, x: pendulum(x), (0, 8), [1.5, 0.0], "LSODA", **options).y.T
    assert np.abs(path - expected).max() < 0.05


@pytest.mark.slow
def test_it_is_found_in_metres_and_seconds_of_a_cantilever():
    # In these units the guess .1 was kept, with friction of 1e-5 of the true one and converged.
    metre, second, loss = 1e-8, 1e-6, 0.02
    ts, rates = (
        np.arange(0.0, 60.0, 0.3),
        lambda t, x: [x[1], -x[0] - 0.1 * x[0] ** 3 - loss * x[1]],
    )
    q = solve_ivp(rates, (0, 60), [1.5, 0.0], "LSODA", rtol=1e-9, atol=1e-10, t_eval=ts).y[0]
    q += 0.01 * np.random.default_rng(0).normal(size=ts.size)
    log = hk.Runs(ts * second, np.column_stack([metre * q, np.full(ts.size, np.nan)]))
    energy = hk.Symplectic(hk.Select(hk.Gaussian(metre), 0))
    K = hk.Sum(energy=energy, friction=hk.Friction())
    found = hk.learn(K, log, mean=kinematics, progress=False)
    assert found.converged
    assert not found.process_noise.any()
    force = found.field.part("friction")(jnp.array([0.0, 0.7 * metre / second]))[1]
    np.testing.assert_allclose(force, -loss * 0.7 * metre / second**2, rtol=0.05)


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.Friction(-1.0), ValueError, "viscous must be positive"),
        (lambda: hk.Friction(damped=(1, 1)), ValueError, "distinct coordinates"),
        (lambda: hk.Even(hk.Friction()), TypeError, "friction is odd"),
        (
            lambda: hk.Invariant(hk.Friction(), [-np.eye(2)]),
            TypeError,
            "no potential that could have a symmetry",
        ),
        (lambda: hk.gram(hk.Friction(), X[:, :1]), ValueError, "say which have friction"),
        (lambda: hk.gram(hk.Friction(damped=2), X), ValueError, "does not exist"),
        (lambda: hk.gram(hk.Friction([0.1, 0.2]), X), ValueError, "one for each"),
        (
            lambda: hk.gram(hk.PortHamiltonian(POTENTIAL), X),
            ValueError,
            r"coordinate 1 .* add hk\.Friction",
        ),
    ],
)
def test_what_cannot_be_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_it_works_under_jit_vmap_and_grad():
    K = hk.Friction(0.3, 0.5, stribeck=0.2)
    states = jnp.asarray(X[:5])

    @jax.jit
    def total(K):
        return jnp.sum(jax.vmap(lambda x: K(x, x))(states))

    slope = jax.grad(total)(K).log_coulomb
    step = 1e-5
    more, less = (total(hk.Friction(0.3, 0.5 * np.exp(h), stribeck=0.2)) for h in (step, -step))
    np.testing.assert_allclose(slope, (more - less) / (2 * step), rtol=1e-6)


def arm_masses(q):
    """Two links, angles of the second from the first."""
    c = jnp.cos(q[1])
    return jnp.array([[1.9 + 0.8 * c, 0.4 + 0.4 * c], [0.4 + 0.4 * c, 0.4]])


def joint_velocities(x):
    return jnp.linalg.solve(arm_masses(x[:2]), x[2:])


def rayleigh(x):
    v = joint_velocities(x)
    return jnp.concatenate([v**2 / 2, REST * jnp.logaddexp(v / REST, -v / REST)])


def on_joints(x):
    zero = jnp.zeros((2, 2))
    return jnp.block([[zero, zero], [zero, -arm_masses(x[:2])]])


@pytest.mark.slow
def test_friction_of_joints_is_that_of_rayleighs_function_and_not_of_the_momenta():
    rng = np.random.default_rng(1)
    states, fresh = rng.uniform(-1.5, 1.5, size=(2, 60, 4))

    def rubbed(X):
        V = np.array([np.linalg.solve(arm_masses(x[:2]), x[2:]) for x in X])
        return -np.array([0.3, 0.1]) * V - np.array([0.2, 0.5]) * np.tanh(V / REST)

    weight = -3.0 * np.cos(states[:, :2])
    forces = np.column_stack([np.zeros((60, 2)), weight + rubbed(states)])
    energy = hk.Symplectic(10.0 * hk.Select(hk.Gaussian(1.5), (0, 1)))
    joints = hk.Structured(1.0 * hk.Warp(lambda a, b: a @ b, rayleigh), on_joints)
    off = {}
    for name, friction in {"joints": joints, "momenta": hk.Friction(rest_speed=REST)}.items():
        field = hk.fit(hk.Sum(energy=energy, friction=friction), states, forces, 1e-6)
        found = np.asarray(jax.vmap(field.part("friction"))(fresh))[:, 2:]
        off[name] = np.linalg.norm(found - rubbed(fresh)) / np.linalg.norm(rubbed(fresh))
    assert off["joints"] < 0.01 < 0.2 < off["momenta"]
