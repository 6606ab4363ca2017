"""Structures in positions and velocities: their masses are found, up to a common factor."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# Wrong types are refused here.

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._learn import _unknown_masses

RATIO = 2.5
S = np.diag([1.0, 1.0, 1.0, RATIO])
G = hk.Gaussian(1.3)
K = hk.UnknownMasses(hk.Symplectic(G), [2.0, 2.0 * RATIO])


def energy(y):
    """Two masses on a hardening spring and between springs, in (q, q̇)."""
    q, v = y[:2], y[2:]
    kinetic = (v[0] ** 2 + RATIO * v[1] ** 2) / 2
    return kinetic + q[0] ** 2 / 2 + q[0] ** 4 / 4 + 0.75 * (q[1] - q[0]) ** 2 + q[1] ** 2 / 2


def moves(y):
    force = -jax.grad(energy)(y)[:2]
    return jnp.concatenate([y[2:], force / jnp.array([1.0, RATIO])])


def states(count, seed=0):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, 4))


def test_the_gram_is_that_of_momenta_between_the_masses():
    X, Z = states(5), states(3, 1)
    inner = np.asarray(hk.gram(hk.Symplectic(G), X @ S, Z @ S))
    inverse = np.linalg.inv(S)
    expected = np.einsum("ab,ibjc,cd->iajd", inverse, inner, inverse)
    np.testing.assert_allclose(hk.gram(K, X, Z), expected, atol=1e-12)
    np.testing.assert_allclose(K.masses, [1.0, RATIO])
    assert repr(K) == f"UnknownMasses({hk.Symplectic(G)!r}, masses=[1, 2.5])"
    full = hk.UnknownMasses(hk.Symplectic(G), [[2.0, 0.5], [0.5, 3.0]])
    assert repr(full) == f"UnknownMasses({hk.Symplectic(G)!r}, masses=[[1, 0.25], [0.25, 1.5]])"
    bodies = hk.UnknownMasses(hk.Symplectic(G), [2.0, 3.0], labels=(0, 0, 1))
    assert repr(bodies).endswith("masses=[1, 1.5], labels=(0, 0, 1))")


M = np.array([[1.0, 0.4], [0.4, 2.5]])
FULL = hk.UnknownMasses(hk.Symplectic(G), 2.0 * M)


def test_a_full_mass_matrix_is_kept_over_its_first_entry():
    np.testing.assert_allclose(FULL.masses, M, atol=1e-12)
    X, Z = states(5), states(3, 1)
    full = np.block([[np.eye(2), np.zeros((2, 2))], [np.zeros((2, 2)), M]])
    inner = np.asarray(hk.gram(hk.Symplectic(G), X @ full, Z @ full))
    inverse = np.linalg.inv(full)
    expected = np.einsum("ab,ibjc,cd->iajd", inverse, inner, inverse)
    np.testing.assert_allclose(hk.gram(FULL, X, Z), expected, atol=1e-12)
    np.testing.assert_allclose(FULL.to_velocities(FULL.to_momenta(X)), X, atol=1e-12)
    diagonal = hk.UnknownMasses(hk.Symplectic(G), np.diag([1.0, RATIO]))
    np.testing.assert_allclose(hk.gram(diagonal, X, Z), hk.gram(K, X, Z), atol=1e-12)


def coupled(y):
    """Two unlike springs that harden, and masses that pull at each other: q̈ = −M⁻¹∇U."""
    q = y[:2]
    force = -jnp.array([1.0, 2.0]) * q - jnp.array([1.0, 0.5]) * q**3
    return jnp.concatenate([y[2:], jnp.linalg.solve(jnp.asarray(M), force)])


def test_a_field_with_the_right_matrix_keeps_its_energy_and_the_diagonal_cannot_fit():
    X = states(80)
    Y = np.asarray(jax.vmap(coupled)(jnp.asarray(X)))
    kernel = hk.Symplectic(100.0 * hk.Gaussian(4.0))
    right = hk.fit(hk.UnknownMasses(kernel, M), X, Y, 1e-8)
    assert float(jnp.linalg.norm(right.residual)) < 0.01 * np.linalg.norm(Y)
    x = jnp.asarray(X[3])
    slope = jax.grad(right.hamiltonian)(x)
    np.testing.assert_allclose(slope @ right(x), 0.0, atol=1e-9)
    np.testing.assert_allclose(slope[2:], M @ X[3, 2:], atol=0.05)  # ∂H/∂q̇ = M q̇
    diagonal = hk.fit(hk.UnknownMasses(kernel, np.diag(M)), X, Y, 1e-8)
    assert float(jnp.linalg.norm(diagonal.residual)) > 10 * float(jnp.linalg.norm(right.residual))


def test_a_field_with_the_right_masses_keeps_its_energy_and_others_cannot_fit():
    X = states(80)
    Y = np.asarray(jax.vmap(moves)(jnp.asarray(X)))
    kernel = hk.Symplectic(100.0 * hk.Gaussian(4.0))
    right = hk.fit(hk.UnknownMasses(kernel, [1.0, RATIO]), X, Y, 1e-8)
    assert float(jnp.linalg.norm(right.residual)) < 0.01 * np.linalg.norm(Y)
    x = jnp.asarray(X[3])
    slope = jax.grad(right.hamiltonian)(x)
    np.testing.assert_allclose(slope @ right(x), 0.0, atol=1e-9)
    np.testing.assert_allclose(slope, jax.grad(energy)(x), atol=0.05)
    wrong = hk.fit(kernel, X, Y, 1e-8)  # equal masses, and no H has this field
    assert float(jnp.linalg.norm(wrong.residual)) > 10 * float(jnp.linalg.norm(right.residual))


def test_friction_takes_energy_from_velocities_as_it_does_from_momenta():
    X = states(30)
    Y = np.asarray(jax.vmap(moves)(jnp.asarray(X))) - 0.3 * X * [0.0, 0.0, 1.0, 1.0]
    damped = hk.PortHamiltonian(hk.Gaussian(4.0), 0.3)
    field = hk.fit(hk.UnknownMasses(damped, [1.0, RATIO]), X, Y, 1e-8)
    x = jnp.asarray(X[0])
    lost = -jax.grad(field.hamiltonian)(x) @ field(x)
    np.testing.assert_allclose(field.dissipation(x), lost, atol=1e-9)


PUSHED = hk.systems.Driven(moves, [[0.0], [0.0], [0.7], [0.0]])
GAIN = hk.InputMatrix(1.0, acts_on=(2, 3))


def test_masses_are_those_of_a_drift_as_well():
    X, U = states(80), np.random.default_rng(3).uniform(-2, 2, (80, 1))
    Y = np.asarray(jax.vmap(PUSHED)(jnp.asarray(X), jnp.asarray(U)))
    kernel = hk.Symplectic(100.0 * hk.Gaussian(4.0))
    unequal = hk.UnknownMasses(kernel, [1.0, RATIO])
    field = hk.fit(hk.Controlled(unequal, GAIN), X, Y, 1e-8, inputs=U)
    assert float(jnp.linalg.norm(field.residual)) < 0.01 * np.linalg.norm(Y)
    x, u = jnp.asarray(X[3]), jnp.asarray(U[3])
    np.testing.assert_allclose(field.input_matrix(x), [[0], [0], [0.7], [0]], atol=0.01)
    slope = jax.grad(field.hamiltonian)(x)
    np.testing.assert_allclose(slope @ field(x, u), slope @ field.input_matrix(x) @ u, atol=1e-9)
    wrong = hk.fit(hk.Controlled(kernel, GAIN), X, Y, 1e-8, inputs=U)
    assert float(jnp.linalg.norm(wrong.residual)) > 10 * float(jnp.linalg.norm(field.residual))
    with pytest.raises(TypeError, match="takes no kernel with inputs"):
        hk.UnknownMasses(hk.Controlled(kernel, GAIN), [1.0, RATIO])


@pytest.mark.slow
def test_tuning_finds_the_ratio():
    X = states(60)
    rng = np.random.default_rng(2)
    Y = np.asarray(jax.vmap(moves)(jnp.asarray(X))) + 0.01 * rng.standard_normal(X.shape)
    start = hk.UnknownMasses(hk.Symplectic(1.0 * hk.Gaussian(1.0)), [1.0, 1.0])
    found = hk.tune(start, X, Y, objective="marginal_likelihood", starts=2)
    np.testing.assert_allclose(found.kernel.masses, [1.0, RATIO], rtol=0.05)


@pytest.mark.slow
def test_tuning_finds_a_full_matrix():
    X = states(60)
    rng = np.random.default_rng(2)
    # With noise of 0.01 these 60 points leave M₂₂ at 2.29, and M₁₂ at 0.34.
    Y = np.asarray(jax.vmap(coupled)(jnp.asarray(X))) + 0.001 * rng.standard_normal(X.shape)
    start = hk.UnknownMasses(hk.Symplectic(1.0 * hk.Gaussian(1.0)), np.eye(2))
    found = hk.tune(start, X, Y, objective="marginal_likelihood", starts=2)
    np.testing.assert_allclose(found.kernel.masses, M, atol=0.1)


def test_positions_of_one_body_have_one_mass():
    tied = hk.UnknownMasses(hk.Symplectic(G), [2.0, 2.0 * RATIO], labels=(0, 0, 1, 1))
    masses = [1.0, 1.0, RATIO, RATIO]
    np.testing.assert_allclose(tied.masses, masses)
    assert tied.log_masses.shape == (1,)
    X, Z = np.random.default_rng(0).normal(size=(2, 3, 8))
    apart = hk.UnknownMasses(hk.Symplectic(G), masses)
    np.testing.assert_allclose(hk.gram(tied, X, Z), hk.gram(apart, X, Z), atol=1e-12)
    with pytest.raises(ValueError, match="there are 4 masses: states"):
        hk.fit(tied, np.ones((9, 4)), np.ones((9, 4)))
    for masses, labels in (([1, 1], (0, 0, 2)), (np.eye(3), (0, 1, 2)), ([1, 1], ())):
        with pytest.raises(ValueError, match="the number of its body"):
            hk.UnknownMasses(hk.Symplectic(G), masses, labels=labels)
    # `learn` ties the coordinates of a particle of `hk.pairs`.
    pairs = hk.Symplectic(hk.Shared(G, hk.pairs(3, 2)))
    assert _unknown_masses(pairs, 12).labels == (0, 0, 1, 1, 2, 2)
    assert _unknown_masses(hk.Symplectic(G), 12).labels is None


def test_what_has_no_masses_to_find_is_refused():
    with pytest.raises(ValueError, match="one degree of freedom every mass explains"):
        hk.UnknownMasses(hk.Symplectic(G), [1.0])
    with pytest.raises(ValueError, match="masses must be positive"):
        hk.UnknownMasses(hk.Symplectic(G), [1.0, -1.0])
    with pytest.raises(ValueError, match="not symmetric"):
        hk.UnknownMasses(hk.Symplectic(G), [[1.0, 0.5], [0.0, 1.0]])
    with pytest.raises(ValueError, match=r"positive definite.* lowest eigenvalue is -1"):
        hk.UnknownMasses(hk.Symplectic(G), [[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(TypeError, match="must be a matrix-valued kernel"):
        hk.UnknownMasses(G, [1.0, 1.0])
    with pytest.raises(ValueError, match="there are 2 masses: states"):
        hk.fit(K, np.ones((9, 6)), np.ones((9, 6)))
    t = np.linspace(0, 6, 20)
    one = hk.Runs(t, np.column_stack([np.sin(t), np.cos(t)]))
    with pytest.raises(ValueError, match="masses=True with one degree of freedom"):
        hk.learn(hk.Symplectic(G), one, masses=True)


@pytest.mark.slow
def test_learning_from_states_finds_the_ratio():
    rng = np.random.default_rng(0)
    ts = np.linspace(0, 6, 31)
    starts = jnp.asarray(rng.uniform(-1, 1, (6, 4)))
    true = jax.vmap(lambda x: hk.simulate(moves, x, jnp.asarray(ts)).ys)(starts)
    noisy = [x + 0.01 * rng.standard_normal(x.shape) for x in np.asarray(true)]
    found = hk.learn(hk.Symplectic(hk.Gaussian(1.0)), hk.Runs([ts] * 6, noisy), masses=True)
    np.testing.assert_allclose(found.kernel.masses, [1.0, RATIO], rtol=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:look at. the innovations are not white")  # one log
def test_learning_from_driven_states_finds_the_ratio_and_the_gain():
    rng = np.random.default_rng(0)
    ts, starts = np.linspace(0, 6, 31), jnp.asarray(rng.uniform(-1, 1, (6, 4)))
    U = rng.uniform(-2, 2, (6, 31, 1))

    def path(x, u):
        return hk.simulate(PUSHED, x, jnp.asarray(ts), inputs=u).ys

    true = np.asarray(jax.vmap(path)(starts, jnp.asarray(U)))
    noisy = [x + 0.01 * rng.standard_normal(x.shape) for x in true]
    K = hk.Controlled(hk.Symplectic(hk.Gaussian(1.0)), GAIN)
    runs = hk.Runs([ts] * 6, noisy, list(U))
    found = hk.learn(K, runs, masses=True, process_noise=0)
    np.testing.assert_allclose(found.kernel.drift.masses, [1.0, RATIO], rtol=0.05)
    gain = found.field.input_matrix(jnp.zeros(4))
    np.testing.assert_allclose(gain, [[0], [0], [0.7], [0]], atol=0.03)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:learning did not converge")  # at 8 iterations it still moves
def test_learning_from_states_finds_a_full_matrix():
    rng = np.random.default_rng(0)
    ts = np.linspace(0, 6, 31)
    starts = jnp.asarray(rng.uniform(-1.5, 1.5, (6, 4)))
    true = jax.vmap(lambda x: hk.simulate(coupled, x, jnp.asarray(ts)).ys)(starts)
    noisy = [x + 0.01 * rng.standard_normal(x.shape) for x in np.asarray(true)]
    start = hk.UnknownMasses(hk.Symplectic(hk.Gaussian(1.0)), np.eye(2))
    found = hk.learn(start, hk.Runs([ts] * 6, noisy))
    np.testing.assert_allclose(found.kernel.masses, M, atol=0.15)
