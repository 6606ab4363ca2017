"""Friction in the operator: J − R and operators of one's own."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import load, save

G = hk.Gaussian(1.3)
RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(2, 8, 4))
POINTS = jnp.asarray(RNG.normal(size=(5, 4)))


def block(x, z, B, ell=1.3):
    """B(x) ∂x∂zᵀ k B(z)ᵀ of the Gaussian, in NumPy."""
    d = (x - z) / ell**2
    M = np.exp(-np.sum((x - z) ** 2) / (2 * ell**2)) * (np.eye(len(x)) / ell**2 - np.outer(d, d))
    return B(x) @ M @ B(z).T


def canonical(n):
    zero, one = np.zeros((n // 2, n // 2)), np.eye(n // 2)
    return np.block([[zero, one], [-one, zero]])


def with_resistance(*diagonal):
    B = canonical(len(diagonal)) - np.diag(diagonal)
    return lambda x: B


def bumpy(x):
    """Friction that depends on the position, in NumPy and in JAX alike."""
    return canonical(4) - np.diag([0, 0, 1.0 + x[0] ** 2, 0.5])


class Bumpy(eqx.Module):
    log_strength: jax.Array

    def __call__(self, x):
        r = jnp.exp(self.log_strength) + x[0] ** 2
        return jnp.asarray(canonical(4)) - jnp.diag(jnp.stack([0 * r, 0 * r, r, 0 * r + 0.5]))


def structured():
    return hk.Structured(G, Bumpy(jnp.asarray(0.0)))


CASES = {
    "momenta": (hk.PortHamiltonian(G, 0.3), with_resistance(0, 0, 0.3, 0.3)),
    "each": (hk.PortHamiltonian(G, [0.3, 0.1]), with_resistance(0, 0, 0.3, 0.1)),
    "named": (hk.PortHamiltonian(G, [0.3, 0.1], damped=(3, 0)), with_resistance(0.1, 0, 0, 0.3)),
    "own": (structured(), bumpy),
}
every_case = pytest.mark.parametrize("name", CASES)


@every_case
def test_blocks_are_those_of_the_closed_form(name):
    K, B = CASES[name]
    x, z = np.asarray(POINTS[:2])
    np.testing.assert_allclose(K(x, z), block(x, z, B), atol=1e-13)
    np.testing.assert_allclose(K(x, x), block(x, x, B), atol=1e-13)


@pytest.mark.few(2)
@every_case
def test_energy_is_lost_as_the_dissipation_says(name):
    K, B = CASES[name]
    field = hk.fit(K, X, Y, 1e-3)
    asked = jax.jit(lambda x: (field(x), jax.grad(field.hamiltonian)(x), field.dissipation(x)))
    for x in POINTS:
        f, slope, power = map(np.asarray, asked(x))
        assert power >= 0
        np.testing.assert_allclose(-slope @ f, power, atol=1e-12 * abs(f).sum())  # −dH/dt
        np.testing.assert_allclose(f, B(np.asarray(x)) @ slope, atol=1e-11)
        np.testing.assert_allclose(power, -slope @ B(np.asarray(x)) @ slope, atol=1e-11)


def test_a_separable_field_gains_energy_somewhere_the_control():
    friction = hk.fit(hk.PortHamiltonian(G, 0.3), X, Y, 1e-3)
    free = hk.fit(hk.Separable(G), X, Y, 1e-3)
    slopes = jax.vmap(jax.grad(friction.hamiltonian))(POINTS)
    powers = -jnp.sum(slopes * jax.vmap(free)(POINTS), axis=1)
    assert powers.min() < -1e-2
    conserving = hk.fit(hk.Symplectic(G), X, Y, 1e-3)
    assert [float(conserving.dissipation(x)) for x in POINTS] == [0.0] * len(POINTS)


def test_that_there_is_a_hamiltonian_does_not_say_that_it_is_conserved():
    K = hk.PortHamiltonian(G)
    assert K.has_hamiltonian
    assert not K.conserves
    assert not K.symplectic
    field = hk.fit(K, X, Y, 1e-3)
    assert not field.is_separable
    assert field.anchored(X[0]).hamiltonian(X[0]) == pytest.approx(0.0, abs=1e-12)
    plain = hk.fit(hk.CurlFree(G), X, Y, 1e-3)
    for ask in (lambda x: plain.hamiltonian(x), plain.dissipation):
        with pytest.raises(AttributeError, match="not Hamiltonian by construction"):
            ask(X[0])


# Sums: an operator of its own is a potential of its own.


@pytest.mark.slow
def test_terms_share_a_potential_only_where_they_share_the_operator():
    def first(x):
        return jnp.asarray([[0.0, 1.0], [-1.0, -1.0]])

    def second(x):
        return jnp.asarray([[0.0, 1.0], [-1.0, -2.0]])

    one, same = hk.Structured(G, first), hk.Structured(hk.Matern(2.5), first)
    assert (one + same).no_potential is None
    assert (hk.Symplectic(G) + hk.Symplectic(hk.Matern(2.5))).no_potential is None
    different = [
        one + hk.Structured(G, second),
        hk.PortHamiltonian(G) + hk.PortHamiltonian(G),  # each with a friction that is trained
        hk.Symplectic(G) + hk.PortHamiltonian(G),
        hk.PortHamiltonian(G, damped=0) + hk.PortHamiltonian(G, damped=1),
    ]
    data = X[:, :2], Y[:, :2]
    for K in different:
        assert "each has another operator" in str(K.no_potential)
        assert not K.has_hamiltonian
    field = hk.fit(different[0], *data, 1e-2)
    with pytest.raises(AttributeError):
        field.hamiltonian(X[0, :2])
    field.part(0).hamiltonian(X[0, :2])
    shared = hk.fit(one + same, *data, 1e-2)
    parts = [shared.part(i).hamiltonian(X[0, :2]) for i in (0, 1)]
    np.testing.assert_allclose(shared.hamiltonian(X[0, :2]), sum(parts), rtol=1e-12)
    assert shared.dissipation(X[0, :2]) >= 0


# Tuning, saving, jit.


def damped_pendulum(N=40, friction=0.1, noise=0.01, seed=0):
    rng = np.random.default_rng(seed)
    q, p = rng.uniform((-2.5, -2.0), (2.5, 2.0), size=(N, 2)).T
    f = np.stack([p, -np.sin(q) - friction * p], axis=1)
    return np.stack([q, p], axis=1), f + noise * rng.normal(size=f.shape)


@pytest.mark.slow
def test_tune_finds_the_friction_and_keeps_it_where_told():
    X, Y = damped_pendulum()
    K = hk.PortHamiltonian(1.0 * hk.Gaussian(2.0), friction=0.5)
    options = {"objective": "marginal_likelihood", "starts": 3, "max_steps": 40}
    tuned = hk.tune(K, X, Y, **options)
    assert float(tuned.kernel.friction) == pytest.approx(0.1, abs=0.02)
    assert "friction" in tuned.bounds
    low, high = tuned.bounds["friction"]
    extent = np.ptp(X, axis=0)
    assert low == pytest.approx(1e-5 * extent[1] / extent[0])
    assert high == pytest.approx(30 * extent[1] / extent[0])
    kept = hk.tune(K, X, Y, frozen="friction", **options)
    assert float(kept.kernel.friction) == pytest.approx(0.5, rel=1e-12)
    assert "friction" not in kept.bounds


def test_the_friction_has_the_gradient_of_the_loss():
    X, Y = damped_pendulum(12)

    def loss(log_friction):
        K = eqx.tree_at(lambda K: K.log_friction, hk.PortHamiltonian(G), log_friction)
        return hk.log_marginal_likelihood(K, X, Y, 1e-3)

    at, step = jnp.asarray(-1.0), 1e-4
    slope = (loss(at + step) - loss(at - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(at), slope, rtol=1e-6)


@pytest.mark.slow
def test_saved_fields_come_back(tmp_path):
    file = tmp_path / "field.npz"
    for K in (hk.PortHamiltonian(G, [0.3, 0.1], damped=(3, 0)), hk.Odd(hk.PortHamiltonian(G))):
        field = hk.fit(K, X, Y, 1e-3)
        save(file, field)
        np.testing.assert_array_equal(load(file)(X[0]), field(X[0]))
    field = hk.fit(structured(), X, Y, 1e-3)
    save(file, field)
    with pytest.raises(ValueError, match="Pass the kernel that was given to fit"):
        load(file)
    other = hk.Structured(hk.Gaussian(), Bumpy(jnp.asarray(1.0)))
    np.testing.assert_array_equal(load(file, kernel=other)(X[0]), field(X[0]))


# Bad input.


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: hk.PortHamiltonian(G, -0.1), r"friction must be positive and finite, got -0\.1"),
        (lambda: hk.PortHamiltonian(G, 0.0), r"use Symplectic\(k\)"),
        (lambda: hk.PortHamiltonian(G, [0.1, 0.2], damped=1), "each of the 1 damped"),
        (lambda: hk.PortHamiltonian(G, damped=-1), "distinct coordinates, integers >= 0"),
        (lambda: hk.PortHamiltonian(G, damped=(1, 1)), "distinct coordinates"),
        (
            lambda: hk.fit(hk.PortHamiltonian(G, damped=4), X, Y),
            "does not exist: the states have 4",
        ),
        (
            lambda: hk.fit(hk.PortHamiltonian(G, [0.1] * 3), X, Y),
            "3 numbers: give one for all momenta",
        ),
        (lambda: hk.fit(hk.PortHamiltonian(G), X[:, :3], Y[:, :3]), "even dimension, got n = 3"),
        (lambda: hk.fit(hk.Symplectic(G), X[:, :3], Y[:, :3]), r"Poisson\(k, tensor\)"),
        (
            lambda: hk.fit(hk.Structured(G, lambda x: jnp.eye(3)), X, Y),
            r"returned shape \(3, 3\); .*of shape \(4, 4\)",
        ),
        (
            lambda: hk.fit(hk.Structured(G, lambda x: jnp.eye(4) / (x[0] - x[0])), X, Y),
            r"NaN or infinite at X\[0\]",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_an_operator_must_be_a_function():
    with pytest.raises(TypeError, match="constant matrix"):
        hk.Structured(G, np.eye(2))
    with pytest.raises(TypeError, match="cannot be odd or even"):
        hk.Odd(structured())
