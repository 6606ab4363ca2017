"""Kernels that see points through a descriptor: the Gram by Jacobians, and equivariant warps."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

ATOMS = np.triu_indices(4, 1)  # of a molecule of four atoms, the last three alike


def inverse_distances(x):
    r = x.reshape(-1, 3)
    return 1 / jnp.linalg.norm(r[ATOMS[0]] - r[ATOMS[1]], axis=1)


def angles(x):
    return jnp.array([jnp.cos(x[0]), jnp.sin(x[0]), x[1]])


def moved(order):
    """The matrix that puts atom order[i] in place i."""
    return np.kron(np.eye(4)[list(order)], np.eye(3))


GENERATORS = [moved((0, 2, 1, 3)), moved((0, 2, 3, 1))]
GROUP = [moved((0, *rest)) for rest in itertools.permutations((1, 2, 3))]


@pytest.fixture(scope="module")
def molecules():
    ideal = np.array([[0, 0, 0], [1.1, 0, 0], [0, 1.1, 0], [0, 0, 1.1]]).reshape(-1)
    return ideal + 0.1 * np.random.default_rng(0).normal(size=(14, 12))


def by_hand(k, X, B=None):
    """The Gram from the second derivatives of k, pair by pair."""
    pair = jax.jit(jax.jacfwd(jax.jacrev(k, 0), 1))
    blocks = np.array([[pair(x, z) for z in X] for x in X])  # (N, N, n, n)
    blocks = blocks if B is None else B @ blocks @ B.T
    return blocks.transpose(0, 2, 1, 3)


@pytest.mark.few(1)
@pytest.mark.parametrize("inner", [hk.Gaussian(1.3), 2.0 * hk.Matern(2.5, 0.9)])
def test_the_gram_of_a_warp_is_that_of_its_second_derivatives(inner, key):
    X = jax.random.normal(key, (5, 2))
    k = 3.0 * hk.Warp(inner, angles)
    J, R = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([0.0, 0.4])
    for K, B in ((hk.Symplectic(k), J), (hk.PortHamiltonian(k, 0.4), J - R)):
        expected = by_hand(lambda x, z: 3.0 * inner(angles(x), angles(z)), X, B)
        np.testing.assert_allclose(hk.gram(K, X), expected, atol=1e-13 * np.abs(expected).max())
        np.testing.assert_allclose(hk.gram(K, X)[1, :, 2], K(X[1], X[2]), atol=1e-13)


@pytest.mark.slow
def test_an_equivariant_warp_has_the_mean_over_both_arguments(molecules):
    """Against the mean over all pairs of permutations, written out."""
    inner = hk.Matern(2.5, 0.5)
    K: Any = hk.Invariant(
        hk.CurlFree(hk.Warp(inner, inverse_distances, equivariant=True)), GENERATORS
    )

    def mean(x, z):
        pairs = itertools.product(GROUP, GROUP)
        values = [inner(inverse_distances(g @ x), inverse_distances(h @ z)) for g, h in pairs]
        return sum(values[1:], start=values[0]) / 36

    X = jnp.asarray(molecules[:3])
    expected = by_hand(mean, X)
    np.testing.assert_allclose(hk.gram(K, X), expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(K.kernel(X[0], X[1]), mean(X[0], X[1]), rtol=1e-13)


def test_forces_on_permuted_atoms_are_permuted_forces(molecules):
    warp = hk.Warp(hk.Gaussian(0.5), inverse_distances, equivariant=True)
    forces = np.random.default_rng(1).normal(size=molecules.shape)
    invariant = hk.fit(hk.Invariant(hk.CurlFree(warp), GENERATORS), molecules, forces, 1e-6)
    plain = hk.fit(hk.CurlFree(warp), molecules, forces, 1e-6)
    S, x = GROUP[4], jnp.asarray(molecules[0]) + 0.05
    permuted = S @ invariant(x)
    largest = np.abs(permuted).max()  # coefficients of opposite signs leave nothing to small forces
    np.testing.assert_allclose(invariant(S @ x), permuted, rtol=0, atol=1e-8 * largest)
    assert np.abs(plain(S @ x) - S @ plain(x)).max() > 0.1  # the negative control


def test_a_map_that_is_not_equivariant_is_refused(molecules):
    def weighted(x):
        return inverse_distances(x) * jnp.arange(1.0, 7.0)

    K = hk.Invariant(hk.CurlFree(hk.Warp(hk.Gaussian(1.0), weighted, equivariant=True)), GENERATORS)
    with pytest.raises(ValueError, match=r"no permutation of them\. Leave out equivariant=True"):
        hk.gram(K, molecules)


@pytest.mark.slow  # 110 s of compilation
def test_atoms_in_one_place_are_named_before_any_solve(molecules):
    warp = hk.Warp(hk.Matern(2.5, 2.0), inverse_distances, equivariant=True)
    twice = hk.Warp(hk.Warp(hk.Gaussian(1.0), jnp.square), inverse_distances)
    kernels = warp, 2.0 * (warp + hk.Gaussian(1.0)) * hk.Gaussian(1.0), twice
    X = molecules.copy()
    X[7, 3:6] = X[7, :3]
    for one in kernels:
        with pytest.raises(ValueError, match=r"infinite at X\[7\]: two atoms in one place"):
            hk.fit(hk.CurlFree(one), X, np.ones_like(X), 1e-3)
    K = hk.Invariant(hk.CurlFree(warp), GENERATORS)
    with pytest.raises(ValueError, match=r"infinite at X\[7\]: two atoms in one place"):
        hk.log_marginal_likelihood(K, X, np.ones_like(X), 1e-3)
    field = hk.fit(hk.CurlFree(warp), molecules, np.ones_like(X), 1e-3)
    assert np.isnan(field(X[7])).all()
    assert np.isnan(field.potential(X[7]))
    with pytest.raises(RuntimeError, match="NaN or infinite at x0 already"):
        hk.simulate(field, X[7], jnp.linspace(0.0, 1.0, 3))
    roots = hk.CurlFree(hk.Select(hk.Warp(hk.Gaussian(1.0), jnp.sqrt), (2,)))
    X[3, 2] = X[:, 2].min() - 1.0
    with pytest.raises(ValueError, match=r"infinite at X\[3\]: two atoms in one place"):
        hk.fit(roots, X - X[3], np.ones_like(X), 1e-3)


@pytest.mark.slow
def test_losses_through_a_descriptor_have_their_derivatives(molecules):
    forces = np.random.default_rng(1).normal(size=molecules.shape)

    def loss(log_lengthscale):
        warp = hk.Warp(hk.Gaussian(jnp.exp(log_lengthscale)), inverse_distances, equivariant=True)
        K = hk.Invariant(hk.CurlFree(warp), GENERATORS)
        return hk.log_marginal_likelihood(K, molecules, forces, 1e-2)

    here, step = jnp.log(0.7), 1e-4
    difference = (loss(here + step) - loss(here - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(loss)(here), difference, rtol=1e-6)


def test_an_equivariant_warp_comes_back_from_a_file(molecules, tmp_path):
    warp = hk.Warp(hk.Gaussian(0.5), inverse_distances, equivariant=True)
    field = hk.fit(hk.Invariant(hk.CurlFree(warp), GENERATORS), molecules, molecules, 1e-6)
    hk.save(tmp_path / "field", field)
    loaded = hk.load(tmp_path / "field", field.kernel)
    np.testing.assert_allclose(loaded(molecules[1]), field(molecules[1]))
    assert "equivariant=True" in repr(field.kernel)


@pytest.mark.slow
def test_directions_without_a_prior_do_not_enter_the_likelihood(molecules):
    """Against the density of the other components in NumPy, in a basis of the distances."""
    rng = np.random.default_rng(1)
    X = molecules
    K = hk.CurlFree(hk.Warp(hk.Matern(2.5, 0.5), inverse_distances))
    forces = np.asarray(jax.vmap(hk.fit(K, X, rng.normal(size=X.shape), 1e-3))(jnp.asarray(X)))
    G = np.asarray(hk.gram(K, X)).reshape(168, 168)
    jacobians = np.asarray(jax.vmap(jax.jacobian(inverse_distances))(jnp.asarray(X)))
    bases = [np.linalg.svd(J)[2][:6] for J in jacobians]  # of twelve directions six are distances
    Q = np.zeros((84, 168))
    for i, basis in enumerate(bases):
        Q[6 * i : 6 * i + 6, 12 * i : 12 * i + 12] = basis
    for regularization in (1e-2, 1e-4, 1e-6):
        A = Q @ G @ Q.T + 14 * regularization * np.eye(84)
        y = Q @ forces.reshape(-1)
        _, log_det = np.linalg.slogdet(A)
        expected = -0.5 * (y @ np.linalg.solve(A, y) + log_det + 84 * np.log(2 * np.pi))
        found = hk.log_marginal_likelihood(K, X, forces, regularization)
        np.testing.assert_allclose(found, expected, rtol=1e-8)
        moved = forces + np.tile([1.0, 0.0, 0.0], 4)  # a net force, of which K knows nothing
        found = hk.log_marginal_likelihood(K, X, moved, regularization)
        np.testing.assert_allclose(found, expected, rtol=1e-8)
    angle = hk.Symplectic(hk.Warp(hk.Gaussian(1.0), angles))  # which sees every direction
    states, slopes = rng.normal(size=(2, 6, 2))
    A = np.asarray(hk.gram(angle, states)).reshape(12, 12) + 0.06 * np.eye(12)
    _, log_det = np.linalg.slogdet(A)
    y = slopes.reshape(-1)
    expected = -0.5 * (y @ np.linalg.solve(A, y) + log_det + 12 * np.log(2 * np.pi))
    np.testing.assert_allclose(hk.log_marginal_likelihood(angle, states, slopes, 1e-2), expected)


def test_the_likelihood_through_a_warp_has_its_derivative_in_the_targets():
    """Against −A⁻¹y in NumPy."""
    states, slopes = np.random.default_rng(2).normal(size=(2, 6, 2))
    K = hk.Symplectic(hk.Warp(hk.Gaussian(1.0), angles))
    A = np.asarray(hk.gram(K, states)).reshape(12, 12) + 0.06 * np.eye(12)
    found = jax.grad(lambda Y: hk.log_marginal_likelihood(K, states, Y, 1e-2))(jnp.asarray(slopes))
    np.testing.assert_allclose(found.reshape(-1), -np.linalg.solve(A, slopes.reshape(-1)))
