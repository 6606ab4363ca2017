"""Poisson systems: f = Π(x)∇H with an antisymmetric Π, in any dimension."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import load, save

G = hk.Gaussian(1.3)
RNG = np.random.default_rng(0)
X = RNG.normal(size=(8, 3))
Y = RNG.normal(size=(8, 3))
POINTS = jnp.asarray(RNG.normal(size=(5, 3)))


def cross(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def field_of_body():
    return hk.fit(hk.Poisson(G, hk.poisson.rigid_body), X, Y, 1e-3)


def test_blocks_are_those_of_the_closed_form():
    x, z = X[:2]
    d = (x - z) / 1.3**2
    M = np.exp(-np.sum((x - z) ** 2) / (2 * 1.3**2)) * (np.eye(3) / 1.3**2 - np.outer(d, d))
    expected = cross(x) @ M @ cross(z).T
    np.testing.assert_allclose(hk.Poisson(G, hk.poisson.rigid_body)(x, z), expected, atol=1e-13)


def test_energy_and_casimir_are_conserved_by_every_field_and_not_by_a_separable_one():
    field = field_of_body()
    free = hk.fit(hk.Separable(G), X, Y, 1e-3)
    x = np.asarray(POINTS)
    slopes = np.asarray(jax.jit(jax.vmap(jax.grad(field.hamiltonian)))(POINTS))
    f, other = (np.asarray(each.evaluate(x)) for each in (field, free))
    np.testing.assert_allclose(np.sum(slopes * f, axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(2 * x * f, axis=1), 0.0, atol=1e-10)  # ∇C·f with C = |L|²
    np.testing.assert_allclose(f, np.cross(x, slopes), atol=1e-12)
    assert np.abs(np.sum(2 * x * other, axis=1)).max() > 1e-2
    assert field.dissipation(POINTS[0]) == 0.0
    K = field.kernel
    assert K.has_hamiltonian
    assert K.conserves
    assert not K.symplectic
    assert not field.is_separable


@pytest.mark.slow
def test_the_flow_keeps_the_sphere():
    ys = hk.simulate(field_of_body(), X[0], np.linspace(0, 2, 5)).ys
    np.testing.assert_allclose(np.sum(np.asarray(ys) ** 2, axis=1), X[0] @ X[0], rtol=1e-8)


@pytest.mark.slow
def test_a_rigid_body_is_learned_better_with_its_tensor():
    body = hk.systems.RigidBody()
    rng = np.random.default_rng(1)
    X, fresh = rng.uniform(-1, 1, size=(25, 3)), rng.uniform(-1, 1, size=(200, 3))
    Y, truth = (np.asarray(jax.vmap(body)(x)) for x in (X, fresh))
    k = hk.Gaussian(2.0)
    error = {}
    for name, K in (("poisson", hk.Poisson(k, hk.poisson.rigid_body)), ("free", hk.Separable(k))):
        off = hk.fit(K, X, Y, 1e-8).evaluate(fresh) - truth
        error[name] = np.linalg.norm(off) / np.linalg.norm(truth)
    assert error["poisson"] < 0.5 * error["free"]


# The ready-made tensors.

TENSORS = {
    "rigid_body": (hk.poisson.rigid_body, 3),
    "lotka_volterra": (hk.poisson.lotka_volterra, 2),
    "plane": (hk.poisson.charged_particle(1.7), 4),
    "space": (hk.poisson.charged_particle([0.3, -0.2, 0.9]), 6),
    "uneven": (hk.poisson.charged_particle(lambda q: 1.0 + q[0] ** 2), 4),
}


@pytest.mark.parametrize("name", TENSORS)
def test_ready_made_tensors_are_antisymmetric_and_obey_the_identity_of_jacobi(name):
    tensor, n = TENSORS[name]
    there = jax.jit(lambda x: (tensor(x), jax.jacfwd(tensor)(x)))
    for x in np.random.default_rng(3).normal(size=(3, n)):
        P, dP = map(np.asarray, there(x))  # dP[i, j, l] = ∂_l Π_ij
        np.testing.assert_array_equal(P, -P.T)
        term = np.einsum("il,jkl->ijk", P, dP)
        total = (
            term + np.moveaxis(term, (0, 1, 2), (1, 2, 0)) + np.moveaxis(term, (0, 1, 2), (2, 0, 1))
        )
        np.testing.assert_allclose(total, 0.0, atol=1e-12)


def test_systems_have_the_velocities_of_their_equations():
    x, y = X[0], np.array([0.1, 0.2, 0.3, 0.4])
    inertia = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(
        hk.systems.RigidBody(inertia)(x), np.cross(x, x / inertia), rtol=1e-12
    )
    a, b = 0.3, 0.7
    np.testing.assert_allclose(
        hk.systems.LotkaVolterra(2, 3, 4, 5)(np.array([a, b])),
        [2 * a - 3 * a * b, 5 * a * b - 4 * b],
        rtol=1e-12,
    )
    v, q = y[2:] / 2.0, y[:2]
    force = -0.3 * q + 1.7 * np.array([v[1], -v[0]])
    particle = hk.systems.ChargedParticle(2.0, 0.3, 1.7)
    np.testing.assert_allclose(particle(y), np.concatenate([v, force]), rtol=1e-12)
    assert float(jax.grad(particle.hamiltonian)(jnp.asarray(y)) @ particle(y)) == pytest.approx(0)


def test_a_charge_in_space_feels_the_force_of_lorentz():
    B, x = np.array([0.3, -0.2, 0.9]), np.array([0.0, 0.1, 0.2, 1.0, -0.5, 0.3])
    v = x[3:] / 2.0
    moved = np.asarray(hk.poisson.charged_particle(B)(x)) @ np.concatenate([np.zeros(3), v])
    np.testing.assert_allclose(moved, np.concatenate([v, np.cross(v, B)]), rtol=1e-12)


def test_damping_and_inputs_wrap_any_system():
    pendulum = hk.systems.Pendulum(1.0, 1.0, 1.0)
    damped = hk.systems.Damped(pendulum, 0.1)
    driven = hk.systems.Driven(damped, [[0.0], [2.0]])
    x, u = jnp.array([0.3, 0.2]), jnp.array([0.5])
    np.testing.assert_allclose(damped(x), [0.2, -np.sin(0.3) - 0.02], rtol=1e-12)
    np.testing.assert_allclose(damped.dissipation(x), 0.1 * 0.2**2, rtol=1e-12)
    np.testing.assert_allclose(driven(x, u), [0.2, -np.sin(0.3) - 0.02 + 1.0], rtol=1e-12)
    assert damped.hamiltonian(x) == pendulum.hamiltonian(x)
    with pytest.raises(ValueError, match="needs its inputs"):
        driven(x)
    with pytest.raises(ValueError, match="x and u swapped"):
        driven(u, x)
    with pytest.raises(ValueError, match="positive"):
        hk.systems.Damped(pendulum, -0.1)
    with pytest.raises(ValueError, match="2 coordinates"):
        hk.systems.Damped(pendulum, 0.1, damped=2)(x)
    with pytest.raises(TypeError, match="hamiltonian"):
        hk.systems.Damped(lambda x: x)


# Saving.


@pytest.mark.slow
def test_saved_fields_come_back_and_bring_the_ready_made_tensors(tmp_path):
    file = tmp_path / "field.npz"
    for name in ("rigid_body", "lotka_volterra", "plane"):
        tensor, n = TENSORS[name]
        data = np.random.default_rng(4).normal(size=(2, 4, n))
        field = hk.fit(hk.Poisson(G, tensor), *data, 1e-2)
        save(file, field)
        np.testing.assert_array_equal(load(file)(data[0, 0]), field(data[0, 0]))
    assert repr(hk.Poisson(G, hk.poisson.rigid_body)) == (
        "Poisson(Gaussian(lengthscale=1.3), tensor=rigid_body)"
    )


# Bad input.


def lopsided(x):
    return jnp.array([[0.0, 1.0, 0.0], [-1.0, 0.25, 0.0], [0.0, 0.0, 0.0]])


def test_what_is_no_poisson_system_is_refused():
    with pytest.raises(ValueError, match=r"not antisymmetric: at X\[0\] .* as large as 0\.25"):
        hk.fit(hk.Poisson(G, lopsided), X, Y)
    with pytest.raises(ValueError, match="not antisymmetric"):
        hk.gram(hk.Poisson(G, lopsided), X)
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        hk.fit(hk.Poisson(G, hk.poisson.rigid_body), X[:, :2], Y[:, :2])
    with pytest.raises(ValueError, match="n = 4, or in space, n = 6"):
        hk.fit(hk.Poisson(G, hk.poisson.charged_particle(1.0)), X, Y)
    with pytest.raises(TypeError, match="call it with the magnetic field"):
        hk.Poisson(G, hk.poisson.charged_particle)
    for given in ((), (1.0, 2.0), (1.0,)):
        with pytest.raises(TypeError, match=r"lotka_volterra is a tensor.*without brackets"):
            hk.Poisson(G, hk.poisson.lotka_volterra(*given))
    with pytest.raises(ValueError, match="one finite number for motion in a plane"):
        hk.poisson.charged_particle([1.0, 2.0])
    with pytest.raises(TypeError, match="cannot be odd or even"):
        hk.Odd(hk.Poisson(G, hk.poisson.rigid_body))
    with pytest.raises(TypeError, match="not reversible"):
        hk.Reversible(hk.Poisson(G, hk.poisson.charged_particle(1.0)))
    with pytest.raises(TypeError, match="needs a function"):
        hk.Poisson(G, np.zeros((3, 3)))
