import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from hamkernel import systems

# Both sides are the same algebra in float64; a close pair of bodies magnifies rounding.
ALGEBRA = 1e-11
# `sample` bounds each step by 1e-10; the trajectories below take tens of steps and are not chaotic.
TRAJECTORY = 1e-8

MASS, STIFFNESS, LENGTH, GRAVITY = 0.7, 1.3, 1.7, 9.5
ALPHA, BETA, COUPLING = -0.8, 1.9, 0.6
MASSES = np.array([1.3, 0.6, 2.1])
G = 0.8
CHAIN_MASS, CHAIN_STIFFNESS = np.array([1.0, 2.0, 0.5]), np.array([1.0, 3.0, 0.7, 2.0])
CIRCULATIONS = np.array([1.5, -0.7, 2.2, -1.1])
ARMS, LENGTHS = np.array([1.2, 0.7]), np.array([0.9, 1.4])


# Equations of motion, written by hand in NumPy.


def oscillator(x):
    return np.array([x[1] / MASS, -STIFFNESS * x[0]])


def pendulum(x):
    return np.array([x[1] / (MASS * LENGTH**2), -MASS * GRAVITY * LENGTH * np.sin(x[0])])


def duffing(x):
    return np.array([x[1] / MASS, -ALPHA * x[0] - BETA * x[0] ** 3])


def henon_heiles(x):
    q1, q2, p1, p2 = x
    return np.array([p1, p2, -q1 - 2 * COUPLING * q1 * q2, -q2 - COUPLING * (q1**2 - q2**2)])


def mass_matrix(angles):
    (m1, m2), (l1, l2) = ARMS, LENGTHS
    mixed = m2 * l1 * l2 * np.cos(angles[0] - angles[1])
    return np.array([[(m1 + m2) * l1**2, mixed], [mixed, m2 * l2**2]])


def double_pendulum(x):
    """Lagrange's equations for the accelerations; momenta p = M(θ)ω by the Legendre transform."""
    (m1, m2), (l1, l2), (t1, t2) = ARMS, LENGTHS, x[:2]
    w1, w2 = np.linalg.solve(mass_matrix(x[:2]), x[2:])
    cos, sin = np.cos(t1 - t2), np.sin(t1 - t2)
    a1, a2 = np.linalg.solve(
        [[(m1 + m2) * l1, m2 * l2 * cos], [l1 * cos, l2]],
        [
            -m2 * l2 * w2**2 * sin - (m1 + m2) * GRAVITY * np.sin(t1),
            l1 * w1**2 * sin - GRAVITY * np.sin(t2),
        ],
    )
    # d/dt of p = M(θ)ω
    turning = m2 * l1 * l2 * sin * (w1 - w2)
    dp = mass_matrix(x[:2]) @ [a1, a2] - turning * np.array([w2, w1])
    return np.array([w1, w2, *dp])


def kepler(x):
    q, p = x[:2], x[2:]
    return np.concatenate([p / MASS, -G * MASS * q / np.linalg.norm(q) ** 3])


def n_body(x):
    q, p = x.reshape(2, -1, 2)
    force = np.zeros_like(q)
    for i in range(len(MASSES)):
        for j in range(len(MASSES)):
            if i != j:
                r = q[j] - q[i]
                force[i] += G * MASSES[i] * MASSES[j] * r / np.linalg.norm(r) ** 3
    return np.concatenate([(p / MASSES[:, None]).ravel(), force.ravel()])


def spring_chain(x):
    q, p = x[:3], x[3:]
    at = [0.0, *q, 0.0]
    k = CHAIN_STIFFNESS
    force = [k[i] * (at[i] - at[i + 1]) + k[i + 1] * (at[i + 2] - at[i + 1]) for i in range(3)]
    return np.concatenate([p / CHAIN_MASS, force])


def induced_velocity(r):
    """Kirchhoff's velocities in the plane, (vortices, 2)."""
    v = np.zeros_like(r)
    for i in range(len(CIRCULATIONS)):
        for j in range(len(CIRCULATIONS)):
            if i != j:
                (x, y), gamma = r[i] - r[j], CIRCULATIONS[j]
                v[i] += gamma / (2 * np.pi * (x**2 + y**2)) * np.array([-y, x])
    return v


def point_vortices(x):
    scale = np.sqrt(np.abs(CIRCULATIONS))
    signed = np.sign(CIRCULATIONS) * scale
    q, p = np.split(x, 2)
    v = induced_velocity(np.stack([q / scale, p / signed], axis=1))
    return np.concatenate([scale * v[:, 0], signed * v[:, 1]])


N_BODY_START = [0, 0, 1.5, 0, -1, 2.5, 0, -0.4, 0.2, 0.6, -0.2, -0.2]
VORTEX_PLACES = [[0, 0], [1, 0.2], [-0.5, 1.1], [0.3, -1.4]]
VORTICES = systems.PointVortices(CIRCULATIONS)
CASES = {
    "oscillator": (systems.HarmonicOscillator(MASS, STIFFNESS), oscillator, [1.0, 0.5]),
    "pendulum": (systems.Pendulum(MASS, LENGTH, GRAVITY), pendulum, [2.0, -1.0]),
    "duffing": (systems.Duffing(MASS, ALPHA, BETA), duffing, [1.2, 0.3]),
    "henon_heiles": (systems.HenonHeiles(COUPLING), henon_heiles, [0.3, -0.2, 0.1, 0.4]),
    "double_pendulum": (
        systems.DoublePendulum(ARMS, LENGTHS, GRAVITY),
        double_pendulum,
        [0.4, -0.3, 0.5, 0.2],
    ),
    "kepler": (systems.Kepler(MASS, G), kepler, [1.0, 0.2, 0.1, 0.5]),
    "n_body": (systems.NBody(MASSES, G), n_body, N_BODY_START),
    "spring_chain": (
        systems.SpringChain(3, CHAIN_MASS, CHAIN_STIFFNESS),
        spring_chain,
        [0.5, -0.2, 0.1, 0.3, 0.0, -0.4],
    ),
    "point_vortices": (VORTICES, point_vortices, VORTICES.state(np.array(VORTEX_PLACES))),
}
every_system = pytest.mark.parametrize(
    ("system", "motion", "start"), CASES.values(), ids=CASES.keys()
)
PENDULUM, *_ = CASES["pendulum"]


def reference(motion, start, ts):
    """SciPy's DOP853 on the NumPy equations, far below the tolerance of `sample`: (T, n)."""
    start = np.array(start, float)
    span = (ts[0], ts[-1])
    return solve_ivp(
        lambda _, x: motion(x), span, start, "DOP853", t_eval=ts, rtol=1e-12, atol=1e-13
    ).y.T


# The fields


@every_system
def test_field_is_the_textbook_equation_of_motion(system, motion, start):
    states = np.array(start) + 0.1 * np.random.default_rng(0).normal(size=(20, len(start)))
    expected = np.stack([motion(x) for x in states])
    found = jax.jit(jax.vmap(lambda x: system(x)))(states)
    np.testing.assert_allclose(found, expected, rtol=ALGEBRA, atol=ALGEBRA)


@every_system
def test_energy_is_constant_along_the_reference_trajectory_and_not_with_friction(
    system, motion, start
):
    half = len(start) // 2
    ts = np.linspace(0.0, 2.0, 21)
    energy = jax.jit(jax.vmap(lambda x: system.hamiltonian(x)))
    kept = energy(reference(motion, start, ts))
    np.testing.assert_allclose(kept, kept[0], rtol=0, atol=1e-10 * max(1.0, abs(kept[0])))

    friction = np.concatenate([np.zeros(half), np.full(half, 0.1)])
    lost = energy(reference(lambda x: motion(x) - friction * x, start, ts))
    assert np.max(np.abs(lost - lost[0])) > 1e-3


@pytest.mark.few(4)
@every_system
def test_float32_states_have_float32_velocities_and_energies(system, motion, start):
    x = jnp.asarray(start, jnp.float32)
    velocity, energy = system(x), system.hamiltonian(x)
    assert velocity.dtype == energy.dtype == jnp.float32
    np.testing.assert_allclose(velocity, motion(np.array(start)), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(energy, system.hamiltonian(jnp.array(start)), rtol=1e-4, atol=1e-4)


# The other systems are sampled below, where something about their trajectories is known exactly.
@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["duffing", "henon_heiles", "double_pendulum", "spring_chain"])
def test_sample_follows_the_reference_trajectory(name):
    system, motion, start = CASES[name]
    ts = np.linspace(0.5, 3.0, 6)
    X, Y = systems.sample(system, np.array(start), ts)
    expected = reference(motion, start, ts)
    np.testing.assert_allclose(X, expected, rtol=0, atol=TRAJECTORY)
    velocities = np.stack([motion(x) for x in expected])
    np.testing.assert_allclose(Y, velocities, rtol=0, atol=20 * TRAJECTORY)  # × the field's slope


@every_system
def test_field_is_divergence_free_and_its_linearisation_hamiltonian(system, motion, start):
    D = np.array(jax.jit(jax.jacfwd(lambda x: system(x)))(jnp.array(start, float)))
    half = len(start) // 2
    J = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    hessian = J.T @ D
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(D).max())
    assert abs(np.trace(D)) < 1e-12 * np.abs(D).max()


def test_double_pendulum_energy_is_kinetic_plus_potential_energy_of_the_masses():
    system, _, start = CASES["double_pendulum"]
    angles = np.array(start[:2])
    w1, w2 = np.linalg.solve(mass_matrix(angles), start[2:])
    (l1, l2), (t1, t2) = LENGTHS, angles
    v1 = l1 * w1 * np.array([np.cos(t1), np.sin(t1)])
    v2 = v1 + l2 * w2 * np.array([np.cos(t2), np.sin(t2)])
    h1 = l1 * (1 - np.cos(t1))
    h2 = h1 + l2 * (1 - np.cos(t2))
    kinetic = ARMS[0] * v1 @ v1 / 2 + ARMS[1] * v2 @ v2 / 2
    energy = kinetic + GRAVITY * (ARMS[0] * h1 + ARMS[1] * h2)
    np.testing.assert_allclose(system.hamiltonian(jnp.array(start)), energy, rtol=ALGEBRA)


def test_oscillator_has_the_closed_form_solution():
    ts = np.linspace(0.0, 5.0, 11)
    w = np.sqrt(STIFFNESS / MASS)
    X, _ = systems.sample(systems.HarmonicOscillator(MASS, STIFFNESS), np.array([2.0, 0.0]), ts)
    exact = np.stack([2 * np.cos(w * ts), -2 * MASS * w * np.sin(w * ts)], axis=1)
    np.testing.assert_allclose(X, exact, rtol=0, atol=TRAJECTORY)


@pytest.mark.few(1)
@pytest.mark.parametrize("amplitude", [1e-3, 1.0, 3.0])
def test_pendulum_returns_after_its_exact_period(amplitude):
    small = 2 * np.pi * np.sqrt(LENGTH / GRAVITY)
    exact = small * 2 / np.pi * ellipk(np.sin(amplitude / 2) ** 2)
    X, _ = systems.sample(PENDULUM, np.array([amplitude, 0.0]), np.array([0.0, small, exact]))
    np.testing.assert_allclose(X[2], X[0], rtol=0, atol=TRAJECTORY)
    # A small swing takes 2π√(l/g) up to a relative amplitude²/16; a large one does not.
    returned_early = abs(float(X[1, 0]) - amplitude) < 1e-6 * amplitude
    assert returned_early == (amplitude < 0.01)


def test_henon_heiles_escapes_over_its_saddle_at_a_sixth():
    system = systems.HenonHeiles()
    saddle = jnp.array([0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(system(saddle), 0, atol=ALGEBRA)
    np.testing.assert_allclose(system.hamiltonian(saddle), 1 / 6, rtol=ALGEBRA)


def test_duffing_rests_in_its_wells():
    system, *_ = CASES["duffing"]
    well = jnp.array([np.sqrt(-ALPHA / BETA), 0.0])
    np.testing.assert_allclose(system(well), 0, atol=ALGEBRA)
    np.testing.assert_allclose(system.hamiltonian(well), -(ALPHA**2) / (4 * BETA), rtol=ALGEBRA)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_spring_chain_has_the_textbook_normal_frequencies(count):
    system = systems.SpringChain(count, mass=MASS, stiffness=STIFFNESS)
    found = np.linalg.eigvals(jax.jacfwd(system)(jnp.zeros(2 * count)))
    modes = np.arange(1, count + 1) * np.pi / (2 * (count + 1))
    expected = np.repeat(2 * np.sqrt(STIFFNESS / MASS) * np.sin(modes), 2)
    np.testing.assert_allclose(np.sort(np.abs(found.imag)), expected, rtol=1e-10)
    np.testing.assert_allclose(found.real, 0, atol=1e-10)


# Conserved quantities along sampled trajectories


def assert_conserved(values):
    np.testing.assert_allclose(
        values, np.broadcast_to(values[0], np.shape(values)), atol=TRAJECTORY
    )


def assert_changes(values):
    assert np.max(np.abs(values - values[0])) > 1e-2


def test_kepler_orbit_is_an_ellipse_with_its_period():
    mu, gm = 0.7, 0.8
    system = systems.Kepler(mu, gm)
    start = jnp.array([1.0, 0.2, 0.1, 0.5])
    axis = -gm * mu / (2 * float(system.hamiltonian(start)))
    period = 2 * np.pi * np.sqrt(axis**3 / gm)
    X, _ = systems.sample(system, start, np.linspace(0, period, 9))
    np.testing.assert_allclose(X[-1], X[0], rtol=0, atol=TRAJECTORY)
    q, p = np.split(np.array(X), 2, axis=1)
    spin = q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]
    assert_conserved(spin)
    # The Laplace-Runge-Lenz vector points along the ellipse, which does not turn.
    distance = np.linalg.norm(q, axis=1, keepdims=True)
    lenz = np.stack([p[:, 1] * spin, -p[:, 0] * spin], axis=1) - mu**2 * gm * q / distance
    assert_conserved(lenz)
    assert_changes(distance)


@pytest.mark.slow
def test_n_body_conserves_momentum_and_angular_momentum_in_total_only():
    system, _, start = CASES["n_body"]
    ts = np.linspace(0, 3, 7)
    X, _ = systems.sample(system, np.array(start), ts)
    q, p = np.array(X).reshape(7, 2, 3, 2).transpose(1, 0, 2, 3)
    total = p.sum(axis=1)
    assert_conserved(total)
    spin = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    assert_conserved(spin.sum(axis=1))
    centre = np.einsum("i,tic->tc", MASSES, q)
    assert_conserved(centre - ts[:, None] * total)
    assert_changes(p[:, 0])
    assert_changes(spin[:, 0])


@pytest.mark.slow
def test_two_bodies_of_n_body_move_relative_to_each_other_as_in_kepler():
    m1, m2 = 1.3, 0.6
    mu = m1 * m2 / (m1 + m2)
    r, v = np.array([1.0, 0.2]), np.array([0.1, 1.1])
    drift = np.array([0.3, -0.2])
    ts = np.linspace(0, 2, 5)
    both = [*(-m2 / (m1 + m2) * r), *(m1 / (m1 + m2) * r)]
    momenta = [*(m1 * drift - mu * v), *(m2 * drift + mu * v)]
    X, _ = systems.sample(systems.NBody((m1, m2), G), np.array(both + momenta), ts)
    relative, _ = systems.sample(systems.Kepler(mu, G * (m1 + m2)), np.array([*r, *(mu * v)]), ts)
    np.testing.assert_allclose(X[:, 2:4] - X[:, :2], relative[:, :2], atol=TRAJECTORY)


@pytest.mark.slow
def test_point_vortices_conserve_their_impulses_weighted_by_circulation():
    X, _ = systems.sample(VORTICES, VORTICES.state(np.array(VORTEX_PLACES)), np.linspace(0, 3, 7))
    r = np.array(jax.vmap(VORTICES.positions)(X))  # (T, vortices, 2)
    assert_conserved(np.einsum("i,tic->tc", CIRCULATIONS, r))
    assert_conserved(np.einsum("i,tic->t", CIRCULATIONS, r**2))
    assert_changes(r.sum(axis=1))
    assert_changes((r**2).sum(axis=(1, 2)))


def test_point_vortex_positions_and_state_are_inverse_and_carry_velocities():
    places = np.array(VORTEX_PLACES)
    state = VORTICES.state(places)
    np.testing.assert_allclose(VORTICES.positions(state), places, rtol=ALGEBRA)
    velocity = VORTICES.positions(VORTICES(state))
    np.testing.assert_allclose(velocity, induced_velocity(places), rtol=ALGEBRA)


@pytest.mark.few(1)
@pytest.mark.parametrize("circulations", [(1.0, 3.0), (-1.0, -3.0), (3.0, -1.0)])
def test_vortex_pair_turns_about_its_centre_at_the_textbook_rate(circulations):
    system = systems.PointVortices(circulations)
    distance, total = 0.8, sum(circulations)
    places = np.array([[0.0, 0.0], [distance, 0.0]])
    rate = total / (2 * np.pi * distance**2)
    X, _ = systems.sample(system, system.state(places), np.array([0.0, 2.0]))
    centre = np.array(circulations) @ places / total
    turn = np.exp(1j * rate * 2.0)
    expected = centre[0] + turn * (places[:, 0] - centre[0])
    found = np.array(system.positions(X[1]))
    np.testing.assert_allclose(found[:, 0] + 1j * found[:, 1], expected, atol=TRAJECTORY)


def test_opposite_vortices_travel_straight_at_the_textbook_speed():
    gamma, distance = 1.4, 0.6
    system = systems.PointVortices((gamma, -gamma))
    places = np.array([[0.0, 0.0], [distance, 0.0]])
    X, _ = systems.sample(system, system.state(places), np.array([0.0, 2.0]))
    moved = np.array(system.positions(X[1])) - places
    expected = [0.0, 2.0 * gamma / (2 * np.pi * distance)]
    np.testing.assert_allclose(moved, [expected, expected], atol=TRAJECTORY)


# Parameters


@every_system
def test_every_leaf_is_a_finite_real_array_and_has_a_gradient(system, motion, start):
    leaves = jax.tree.leaves(system)
    assert leaves
    assert all(eqx.is_inexact_array(leaf) for leaf in leaves)
    x = jnp.array(start)
    gradient = eqx.filter_jit(eqx.filter_grad(lambda s: s.hamiltonian(x)))(system)
    evaluate = eqx.filter_jit(lambda s: s.hamiltonian(x))
    step = 1e-6
    for i, leaf in enumerate(leaves):
        for k in np.ndindex(leaf.shape):

            def energy(h, i=i, k=k):
                moved = [u.at[k].add(h) if j == i else u for j, u in enumerate(leaves)]
                return evaluate(jax.tree.unflatten(jax.tree.structure(system), moved))

            slope = (energy(step) - energy(-step)) / (2 * step)
            found = jax.tree.leaves(gradient)[i][k]
            # A central difference of step 1e-6 is right to about 1e-9 of the energy's size.
            np.testing.assert_allclose(found, slope, rtol=1e-6, atol=1e-7)


def test_parameters_read_back_as_given():
    system = systems.DoublePendulum([1, 2], np.array([3.0, 0.5]), 9)
    np.testing.assert_allclose(system.masses, [1, 2], rtol=1e-15)
    np.testing.assert_allclose(system.lengths, [3, 0.5], rtol=1e-15)
    np.testing.assert_allclose(system.gravity, 9, rtol=1e-15)
    np.testing.assert_allclose(systems.HarmonicOscillator().mass, 0.5, rtol=1e-15)
    np.testing.assert_array_equal(systems.PointVortices([1.0, -2.0]).circulations, [1, -2])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: systems.HarmonicOscillator(mass=-1.0), "mass must be positive"),
        (lambda: systems.HarmonicOscillator(stiffness=0.0), "stiffness must be positive"),
        (lambda: systems.Pendulum(length=np.nan), "length must be positive"),
        (lambda: systems.Pendulum(mass=np.ones(2)), "mass has shape"),
        (lambda: systems.Duffing(cubic_stiffness=np.inf), "cubic_stiffness must be finite"),
        (lambda: systems.HenonHeiles(np.ones(1)), "coupling has shape"),
        (lambda: systems.DoublePendulum(masses=1.0), "masses has shape"),
        (lambda: systems.DoublePendulum(lengths=(1.0, -1.0)), "lengths must be positive"),
        (lambda: systems.Kepler(gravitational_parameter=0), "gravitational_parameter must be"),
        (lambda: systems.NBody([1.0]), "two or more"),
        (lambda: systems.NBody(3.0), "two or more"),
        (lambda: systems.NBody([1.0, 0.0]), "masses must be positive"),
        (lambda: systems.SpringChain(0), "count must be a whole number, at least 1; got 0"),
        (lambda: systems.SpringChain(3, mass=[1.0, 2.0]), "mass has shape"),
        (lambda: systems.SpringChain(3, stiffness=[1.0] * 3), "stiffness has shape"),
        (lambda: systems.PointVortices([1.0, 0.0]), "must not be zero"),
        (lambda: systems.PointVortices([1.0, np.nan]), "must be finite"),
        (lambda: systems.PointVortices([1.0]), "two or more"),
        (lambda: VORTICES.state(np.zeros((2, 2))), "positions has shape"),
    ],
)
def test_impossible_parameters_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_count_of_springs_must_be_an_integer():
    with pytest.raises(TypeError, match="whole number"):
        systems.SpringChain(3.0)  # pyright: ignore[reportArgumentType]


@every_system
def test_states_of_another_shape_are_refused(system, motion, start):
    n = len(start)
    with pytest.raises(ValueError, match="is needed"):
        system(jnp.zeros(n + 2))
    with pytest.raises(ValueError, match="n even"):
        system(jnp.zeros(n + 1))
    with pytest.raises(ValueError, match=r"jax\.vmap"):
        system(jnp.zeros((3, n)))
    with pytest.raises(ValueError, match="is needed"):
        system.hamiltonian(jnp.zeros(n + 1))


def test_only_the_hamiltonian_is_needed_for_a_new_system():
    class Quartic(systems.AbstractHamiltonianSystem):
        strength: jax.Array

        def hamiltonian(self, x):
            x = jnp.asarray(x)
            return x[1] ** 2 / 2 + self.strength * x[0] ** 4

    system = Quartic(jnp.array(0.3))
    np.testing.assert_allclose(system(jnp.array([2.0, 0.5])), [0.5, -1.2 * 8], rtol=ALGEBRA)
    with pytest.raises(TypeError, match="abstract"):
        systems.AbstractHamiltonianSystem()  # pyright: ignore[reportAbstractUsage]


def test_a_new_parameter_value_does_not_recompile():
    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def velocity(system, x):
        return system(x)

    x = jnp.array([1.0, 0.5])
    for mass in (0.5, 2.0):
        system = systems.Pendulum(mass=mass, length=1.0, gravity=2.0)
        np.testing.assert_allclose(velocity(system, x)[0], 0.5 / mass, rtol=ALGEBRA)


# Sampling

START = np.array([[1.0, 0.0], [2.2, -0.5], [-0.3, 0.4]])
TS = np.linspace(0.0, 1.0, 5)


@pytest.mark.slow
def test_a_single_state_gives_a_single_trajectory():
    X, Y = systems.sample(PENDULUM, START, TS)
    assert X.shape == Y.shape == (3, 5, 2)
    np.testing.assert_array_equal(X[:, 0], START)
    x, y = systems.sample(PENDULUM, START[1], TS)
    assert x.shape == y.shape == (5, 2)
    np.testing.assert_allclose(x, X[1], rtol=1e-12)
    np.testing.assert_allclose(y, Y[1], rtol=1e-12)


def test_one_time_gives_the_initial_states():
    X, Y = systems.sample(PENDULUM, START, np.array([3.0]))
    np.testing.assert_array_equal(X[:, 0], START)
    np.testing.assert_allclose(Y[:, 0], np.stack([pendulum(x) for x in START]), rtol=ALGEBRA)


def test_any_function_is_a_field():
    X, Y = systems.sample(lambda x: -2.0 * x, np.array([1.0, 2.0, 3.0]), TS)
    exact = np.exp(-2 * TS)[:, None] * [1.0, 2.0, 3.0]
    np.testing.assert_allclose(X, exact, rtol=TRAJECTORY)
    np.testing.assert_allclose(Y, -2 * exact, rtol=TRAJECTORY)


def test_only_time_since_the_first_one_counts():
    late, _ = systems.sample(PENDULUM, START, TS + 1e6)
    early, _ = systems.sample(PENDULUM, START, TS)
    np.testing.assert_allclose(late, early, rtol=0, atol=TRAJECTORY)


def test_noise_has_the_given_deviations_and_is_independent(key):
    X, Y = systems.sample(PENDULUM, START, TS)

    def noise(key):
        noisy = systems.sample(
            PENDULUM, START, TS, state_noise=0.1, velocity_noise=np.array([0.2, 3.0]), key=key
        )
        return noisy[0] - X, noisy[1] - Y

    keys = jax.random.split(key, 2000)
    draws = jnp.concatenate(jax.vmap(noise)(keys), axis=-1).reshape(-1, 4)  # 30 000 of 4
    scale = np.array([0.1, 0.1, 0.2, 3.0])
    z = np.array(draws) / scale
    # Standard errors with 30 000 draws: 0.006 for means and correlations, 0.004 for deviations.
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=0.03)
    np.testing.assert_allclose(z.std(axis=0), 1, atol=0.02)
    np.testing.assert_allclose(np.corrcoef(z.T), np.eye(4), atol=0.03)
    np.testing.assert_allclose((z**4).mean(axis=0), 3, atol=0.3)  # Gaussian: kurtosis 3 ± 0.03


def test_velocities_belong_to_the_true_states(key):
    X, Y = systems.sample(PENDULUM, START, TS)
    noisy, velocities = systems.sample(PENDULUM, START, TS, state_noise=0.1, key=key)
    np.testing.assert_allclose(velocities, Y, rtol=1e-12)
    assert np.max(np.abs(noisy - X)) > 0.1
    assert np.max(np.abs(velocities - jax.vmap(jax.vmap(PENDULUM))(noisy))) > 0.1


@pytest.mark.slow
def test_seeds_are_vmapped_and_jitted_alike(key):
    keys = jax.random.split(key, 100)

    def draw(key):
        return systems.sample(PENDULUM, START, TS, 0.1, 0.2, key=key)

    X, Y = jax.vmap(draw)(keys)
    assert X.shape == Y.shape == (100, 3, 5, 2)
    jitted = jax.jit(jax.vmap(draw))(keys)
    np.testing.assert_allclose(jitted[0], X, rtol=0, atol=1e-12)
    np.testing.assert_allclose(jitted[1], Y, rtol=0, atol=1e-12)
    alone = draw(keys[17])
    np.testing.assert_allclose(alone[0], X[17], rtol=0, atol=1e-12)
    assert np.abs(X[0] - X[1]).max() > 0.1


@pytest.mark.slow
def test_everything_may_be_traced(key):
    @jax.jit
    def draw(mass, x0, ts, noise):
        return systems.sample(systems.Pendulum(mass), x0, ts, noise, noise, key=key)

    system = systems.Pendulum(0.9)
    expected = systems.sample(system, START, TS, 0.1, 0.1, key=key)
    found = draw(0.9, START, TS, 0.1)
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=TRAJECTORY)
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=20 * TRAJECTORY)


@pytest.mark.slow
def test_gradients_through_a_trajectory_match_differences():
    def end(mass, length, x0):
        X, Y = systems.sample(systems.Pendulum(mass, length, GRAVITY), x0, TS)
        return jnp.sum(X[:, -1]) + jnp.sum(Y[:, -1])

    m, r, x = jnp.array(0.9), jnp.array(1.3), jnp.array(START)
    by_mass, by_length, by_state = jax.grad(end, argnums=(0, 1, 2))(m, r, x)
    h = 1e-4  # squared 1e-8; the integration's 1e-10 over h is 1e-6
    move = jnp.zeros_like(x).at[1, 0].set(h)
    for slope, ahead, behind in [
        (by_mass, end(m + h, r, x), end(m - h, r, x)),
        (by_length, end(m, r + h, x), end(m, r - h, x)),
        (by_state[1, 0], end(m, r, x + move), end(m, r, x - move)),
    ]:
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), rtol=1e-5)


@pytest.mark.slow
def test_single_precision_stays_single_and_is_looser():
    X, Y = systems.sample(systems.Pendulum(), START.astype(np.float32), TS)
    assert X.dtype == Y.dtype == jnp.float32
    exact, _ = systems.sample(systems.Pendulum(), START, TS)
    np.testing.assert_allclose(X, exact, rtol=0, atol=2e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"state_noise": 0.1}, "key"),
        ({"velocity_noise": 0.1}, "key"),
        ({"state_noise": -0.1, "key": 0}, "not negative"),
        ({"velocity_noise": np.nan, "key": 0}, "not negative"),
        ({"velocity_noise": [0.1, 0.1, 0.1], "key": 0}, "velocity_noise has shape"),
        ({"ts": [0.0, 1.0, 1.0]}, "strictly increasing"),
        ({"ts": [1.0, 0.0]}, "strictly increasing"),
        ({"ts": [0.0, np.inf]}, "ts contains NaN"),
        ({"ts": 1.0}, "ts has shape"),
        ({"ts": []}, "ts has shape"),
        ({"ts": [[0.0, 1.0]]}, "ts has shape"),
        ({"x0": [1.0, np.nan]}, "x0 contains NaN or inf in row 0"),
        ({"x0": np.zeros((2, 3, 2))}, "x0 has shape"),
        ({"x0": 1.0}, "x0 has shape"),
        ({"x0": [1.0, 0.0, 0.0, 0.0]}, "one state of shape"),
        ({"system": lambda x: x[0]}, "system maps .* one velocity"),
    ],
)
def test_impossible_samples_are_refused(change, message):
    arguments = {"system": PENDULUM, "x0": START, "ts": TS, **change}
    if "key" in arguments:
        arguments["key"] = jax.random.key(arguments["key"])
    with pytest.raises(ValueError, match=message):
        systems.sample(**arguments)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (1.0, "system is a float"),
        (lambda t, x: x, r"system takes \(t, x\)"),
        (lambda x: (x, x), "system returns tuple; one velocity"),
        (lambda x: np.sin(x), r"jax\.numpy in place of numpy"),
    ],
)
def test_what_is_no_field_is_refused(system, message):
    with pytest.raises(TypeError, match=message):
        systems.sample(system, START, TS)


def test_a_noise_level_known_only_later_needs_a_key():
    with pytest.raises(ValueError, match="key"):
        jax.jit(lambda noise: systems.sample(PENDULUM, START, TS, noise))(0.0)


def test_times_that_single_precision_cannot_tell_apart_are_refused():
    ts = np.array([0.0, 1.0, 1.0 + 1e-9])
    systems.sample(PENDULUM, START[0], ts)
    with pytest.raises(ValueError, match="strictly increasing in float32"):
        systems.sample(PENDULUM, START[0].astype(np.float32), ts)


@pytest.mark.slow
def test_trajectories_without_an_end_are_errors_that_name_the_row():
    fall = np.array([[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]])  # the second meets the centre
    with pytest.raises(RuntimeError, match="row 1 could not be integrated"):
        systems.sample(systems.Kepler(), fall, np.array([0.0, 3.0]))
    # x(t) = 1/(1 − t) is infinite at t = 1.
    jitted = eqx.filter_jit(systems.sample)
    with pytest.raises(RuntimeError, match="could not be integrated"):
        jitted(lambda x: x**2, np.array([1.0]), np.array([0.0, 2.0]))


@pytest.mark.parametrize(
    ("key", "error", "message"),
    [
        (0, TypeError, r"jax.random.key\(0\); got 0"),
        (np.zeros(2), TypeError, "must be a key"),
        (jax.random.split(jax.random.key(0), 3), ValueError, "jax.vmap"),
    ],
)
def test_what_is_no_key_is_refused(key, error, message):
    with pytest.raises(error, match=message):
        systems.sample(PENDULUM, START, TS, 0.1, key=key)


def test_keys_of_the_older_kind_are_the_same():
    old = systems.sample(PENDULUM, START, TS, 0.1, key=jax.random.PRNGKey(3))[0]
    np.testing.assert_array_equal(
        old, systems.sample(PENDULUM, START, TS, 0.1, key=jax.random.key(3))[0]
    )
