"""Laws that many parts share: against double sums in NumPy, and against the law of the data."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
import hamkernel._features
from hamkernel._kernels.parts import Laws
from hamkernel._structures.laws import outside, undetermined_terms

RNG = np.random.default_rng(0)


def spring(r):
    return 0.5 * (r - 1.0) ** 2 + 0.3 * np.cos(3 * r)


def forces(q):
    """The forces of the spring law between all pairs, by a loop; q of shape (particles, 2)."""
    out = np.zeros_like(q)
    for i in range(len(q)):
        for j in range(len(q)):
            if i != j:
                apart = q[i] - q[j]
                r = np.linalg.norm(apart)
                out[i] -= ((r - 1.0) - 0.9 * np.sin(3 * r)) * apart / r
    return out


def states(count, particles=5, noise=0.0, rng=RNG):
    q = rng.normal(size=(count, particles, 2))
    p = rng.normal(size=(count, particles, 2))
    X = np.concatenate([q.reshape(count, -1), p.reshape(count, -1)], axis=1)
    F = np.stack([forces(each) for each in q]).reshape(count, -1)
    Y = np.concatenate([p.reshape(count, -1), F], axis=1)
    return X, Y + noise * rng.normal(size=Y.shape)


K = hk.Symplectic(100.0 * hk.Shared(hk.Gaussian(1.0), hk.pairs(particles=5, dim=2)))


def test_the_kernel_is_the_double_sum():
    inner, parts = hk.Matern(2.5, 0.7), hk.pairs(4, 2)
    x, z = RNG.normal(size=(2, 16))

    def distances(x):
        q = x[:8].reshape(4, 2)
        return [np.linalg.norm(q[i] - q[j]) for i in range(4) for j in range(i)]

    wanted = sum(
        float(inner(jnp.array([r]), jnp.array([s]))) for r in distances(x) for s in distances(z)
    )
    np.testing.assert_allclose(hk.Shared(inner, parts)(x, z), wanted)
    # With centres everywhere among the parts the span has next to all of it.
    centres = np.linspace(0.01, 6, 200)
    np.testing.assert_allclose(hk.Shared(inner, parts, centres)(x, z), wanted, rtol=1e-4)


def test_friction_beside_a_law_is_found_with_the_law():
    X, Y = states(12, noise=0.01, rng=np.random.default_rng(1))
    Y[:, 10:] -= 0.3 * X[:, 10:]
    J = K + hk.Friction(viscous=0.5, coulomb=1e-3)
    posterior = hk.condition(J, X, Y, 1e-4 / 12, mean=hk.kinetic(1.0))
    r = np.linspace(0.4, 3.0, 40)
    law = np.array([posterior.field.law(s, 1.0) for s in r])
    band = np.array([posterior.law_deviation(s, 1.0) for s in r])
    np.testing.assert_allclose(law, spring(r) - spring(1.0), atol=0.02)
    assert 0 < band.max() < 0.02
    # The dense posterior, of the kernel alone, has the same bands of the field.
    dense = hk.condition(J, X, Y, 1e-4 / 12, mean=hk.kinetic(1.0), solver=hk.Cholesky())
    x = X[0] + 0.1
    np.testing.assert_allclose(posterior.deviation(x), dense.deviation(x), rtol=1e-3, atol=1e-6)
    damped = jax.jacfwd(posterior.field)(jnp.asarray(x))[10:, 10:]
    np.testing.assert_allclose(np.diag(damped), -0.3, atol=0.02)


def test_weights_and_points_may_be_of_any_kind():
    def parts(x):
        return jnp.stack([x[:2], x[2:]]), jnp.array([2.0, -1.0])

    k = hk.Gaussian(1.3)
    x, z = RNG.normal(size=(2, 4))
    wanted = sum(
        a * b * k(jnp.asarray(r), jnp.asarray(s))
        for a, r in ((2.0, x[:2]), (-1.0, x[2:]))
        for b, s in ((2.0, z[:2]), (-1.0, z[2:]))
    )
    np.testing.assert_allclose(hk.Shared(k, parts)(x, z), wanted)


@pytest.mark.parametrize(
    ("parts", "x", "wanted"),
    [
        (hk.neighbours(4), np.array([0.0, 1.0, 4.0, 9.0]), [1, 3, 5]),
        (hk.neighbours(3, periodic=True), np.array([0.0, 1.0, 4.0, 9, 9, 9]), [1, 3, -4]),
        (hk.sites(2), np.array([3.0, 7.0, 1.0, 1.0]), [3, 7]),
        (hk.pairs(3, 1), np.array([0.0, 1.0, 5.0]), [1, 5, 4]),
        (hk.pairs(3, 1, among=(1, 2)), np.array([0.0, 1.0, 5.0]), [4]),
        (hk.pairs(3, 1, among=((0,), (1, 2))), np.array([0.0, 1.0, 5.0]), [1, 5]),
        (hk.pairs(2, 1, box=4.0), np.array([0.5, 3.5]), [1]),
        (hk.pairs(2, 1, of="log"), np.array([0.0, 2.0]), [np.log(2)]),
        (hk.pairs(2, 1, of="inverse"), np.array([0.0, 2.0]), [0.5]),
    ],
)
def test_ready_made_parts(parts, x, wanted):
    np.testing.assert_allclose(np.ravel(parts(jnp.asarray(x))), wanted)
    with pytest.raises(ValueError, match="got 7 coordinates"):
        parts(jnp.zeros(7))


@pytest.mark.slow
def test_gradients_of_the_features_are_those_of_jax():
    shared = hk.Shared(hk.Gaussian(0.8), hk.pairs(4, 2), np.linspace(0.1, 4, 12))
    x = jnp.asarray(RNG.normal(size=16))
    np.testing.assert_allclose(
        shared.gradients(x), jax.jacrev(shared.features)(x).T, rtol=1e-6, atol=1e-9
    )
    w = jnp.asarray(RNG.normal(size=12))
    slope = Laws((shared,)).slope(x, w)
    np.testing.assert_allclose(slope, shared.gradients(x) @ w, rtol=1e-9, atol=1e-9)
    G = hk.gram(hk.Symplectic(shared), x[None], 2 * x[None])[0, :, 0]
    J = np.kron([[0, 1], [-1, 0]], np.eye(8))
    mixed = jax.jacfwd(jax.jacrev(shared, argnums=0), argnums=1)(x, 2 * x)
    np.testing.assert_allclose(G, J @ mixed @ J.T, rtol=1e-6, atol=1e-8)


def test_parts_may_obey_several_laws_with_one_kernel():
    """The kernel is the sum of one `Shared` for each law, here of three pairs and of two laws."""
    k, C = hk.Gaussian(0.8), np.linspace(0.1, 4, 12)
    both = hk.Shared(k, hk.pairs(3, 1), C, laws=(0, 1, 0))
    apart = [lambda x: hk.pairs(3, 1)(x)[np.array([0, 2])], hk.pairs(3, 1, among=(0, 2))]
    terms = sum((hk.Shared(k, parts, C) for parts in apart[1:]), hk.Shared(k, apart[0], C))
    x, z = RNG.normal(size=(2, 3))
    w = RNG.normal(size=both.columns)

    @jax.jit  # one program
    def compared(x, z, w):
        exact = hk.Shared(k, hk.pairs(3, 1), laws=[0, 1, 0])
        each = jnp.concatenate([hk.Shared(k, parts, C).features(x) for parts in apart])
        slopes = both.gradients(x), jax.jacrev(both.features)(x).T, Laws((both,)).slope(x, w)
        return (both(x, z), terms(x, z), exact(x, z)), (both.features(x), each), slopes

    (value, wanted, exact), features, (gradients, by_ad, slope) = compared(x, z, w)
    np.testing.assert_allclose(value, wanted)
    np.testing.assert_allclose(exact, wanted, rtol=1e-4)
    np.testing.assert_allclose(*features)
    np.testing.assert_allclose(gradients, by_ad, atol=1e-9)
    np.testing.assert_allclose(slope, gradients @ w, atol=1e-9)
    assert len(undetermined_terms(hk.CurlFree(both), 3)) == 2
    with pytest.raises(ValueError, match="laws of 3 parts, and there are 6: give"):
        hk.Shared(k, hk.pairs(4, 1), laws=(0, 1, 0))(jnp.ones(4), jnp.ones(4))
    for laws in ((0, 2), (), (0.0, 1.0), ((0, 1),)):
        with pytest.raises(ValueError, match="without gaps"):
            hk.Shared(k, hk.pairs(3, 1), laws=laws)


@pytest.mark.slow
def test_a_sum_of_laws_with_alike_kernels_is_one_program():
    """Their features are those of each law, one after the other."""
    C, D, pairs = np.linspace(0.1, 4, 12), np.linspace(0.5, 5, 12), hk.pairs(4, 1)
    several = hk.Shared(hk.Gaussian(1.1), pairs, D, laws=(0, 1, 0, 1, 1, 0))
    terms = [
        2.0 * hk.Shared(hk.Gaussian(0.7), hk.pairs(4, 1, among=(0, 1, 2)), C),
        0.5 * several,
        3.0 * hk.Shared(hk.Matern(2.5, 0.8), pairs, C),
    ]
    together: Any = hamkernel._features.part_waves(terms[0] + terms[1] + terms[2])
    alone: Any = [hamkernel._features.part_waves(k) for k in terms]
    assert [len(laws.terms) for laws, _ in together._groups()] == [2, 1]
    x, w = jnp.asarray(RNG.normal(size=4)), jnp.asarray(RNG.normal(size=48))
    values = np.concatenate([waves.values(x) for waves in alone])
    gradients = np.concatenate([waves.gradients(x) for waves in alone], axis=1)
    np.testing.assert_allclose(together.values(x), values, atol=1e-10)
    np.testing.assert_allclose(together.gradients(x), gradients, atol=1e-9)
    np.testing.assert_allclose(together.slope(x, w), gradients @ w, atol=1e-9)


def test_memory_does_not_grow_with_states_parts_and_centres():
    shared = hk.Shared(hk.Gaussian(0.8), hk.pairs(200, 2), np.linspace(0.1, 4, 64))
    X = jnp.asarray(RNG.normal(size=(20, 400)))
    K = hk.Symplectic(shared)

    def loss(k):
        features = hamkernel._features.features(k, 400, 1, jax.random.key(0), X.dtype)
        return jnp.sum(features(X) ** 2)

    compiled: Any = jax.jit(jax.grad(loss)).lower(K).compile()
    whole = 20 * 200 * 199 / 2 * 64 * 8  # bytes of one array of states, parts and centres
    assert compiled.memory_analysis().temp_size_in_bytes < whole / 4


@pytest.fixture(scope="module")
def learned():
    X, Y = states(12)
    return hk.fit(K, X, Y, 1e-10, mean=hk.kinetic(1.0)), X, Y


def test_a_law_is_found_from_a_few_states(learned):
    field, X, Y = learned
    others, truth = states(10)
    error = np.asarray(field.evaluate(others)) - truth
    assert np.sqrt(np.mean(error**2) / np.mean(truth**2)) < 0.01
    assert field.is_separable  # positions alone, and a known mass: for explicit integrators
    r = np.linspace(0.5, 3.0, 30)
    law = jax.vmap(lambda r: field.law(r, 1.0))(r)
    np.testing.assert_allclose(law, spring(r) - spring(1.0), atol=5e-3)
    # Negative control: without the parts as many states say next to nothing.
    with pytest.warns(UserWarning, match="fewer points than coordinates"):
        plain = hk.fit(hk.Symplectic(hk.Gaussian(3.0)), X, Y, 1e-6, mean=hk.kinetic(1.0))
    error = np.asarray(plain.evaluate(others)) - truth
    assert np.sqrt(np.mean(error**2) / np.mean(truth**2)) > 0.1


def test_what_no_data_tell_of_laws_is_said(learned):
    constant = "a constant added to the law changes no velocity"
    assert learned[0].undetermined == (constant,)
    k, half = hk.Gaussian(1.0), lambda x: -2 * jnp.diff(x)[:, None]
    ring = hk.CurlFree(hk.Shared(k, hk.neighbours(4, periodic=True)))
    assert undetermined_terms(ring, 4) == (constant, "r added to the law changes no velocity")
    both = hk.CurlFree(hk.Shared(k, hk.neighbours(4)) + hk.Shared(k, half))
    said = undetermined_terms(both, 4)
    assert len(said) == 3
    assert any("1 times r added to law 0" in s and "r added to law 1 together" in s for s in said)


def test_states_beyond_the_data_of_a_law_are_named(learned):
    field, X, _ = learned
    assert not outside(field.kernel, jnp.asarray(X))
    X = X[:2].copy()
    X[1, 2:4] = X[1, :2] + 0.01
    said = outside(field.kernel, jnp.asarray(X))
    assert said.startswith("two particles come as close as 0.0141, and in the data no closer than")
    chain = hk.CurlFree(hk.Shared(hk.Gaussian(1.0), hk.neighbours(4), centres=[-1.0, 1.0]))
    assert not outside(chain, jnp.array([[0.0, 1.0, 0.5, 0.2]]))
    assert "reach from [-2.] to [1.]" in outside(chain, jnp.array([[0.0, 1.0, -1.0, 0.0]]))


@pytest.mark.slow
def test_a_simulation_that_leaves_the_data_of_a_law_says_so(learned):
    field, X, _ = learned
    close = X[0].copy()
    close[2:4] = close[:2] + 0.01
    with pytest.warns(UserWarning, match="two particles come as close as"):
        hk.simulate(field, close, [0.0, 1e-4], dt=1e-4)


@pytest.mark.slow
def test_all_solvers_find_the_same_law(learned):
    field, X, Y = learned
    for solver in (hk.Cholesky(), hk.Nystrom(max_points=12)):
        other = hk.fit(K, X, Y, 1e-6, mean=hk.kinetic(1.0), solver=solver)
        own = hk.fit(K, X, Y, 1e-6, mean=hk.kinetic(1.0))
        np.testing.assert_allclose(other(X[0]), own(X[0]), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(other.law(1.7, 1.0), own.law(1.7, 1.0), atol=1e-4)
    np.testing.assert_allclose(
        field.potential(X[0]) - field.potential(X[1]),
        _energy(X[0]) - _energy(X[1]),
        atol=0.05,
    )


def _energy(x):
    q = x[:10].reshape(5, 2)
    pairs = sum(spring(np.linalg.norm(q[i] - q[j])) for i in range(5) for j in range(i))
    return pairs + 0.5 * x[10:] @ x[10:]


@pytest.mark.slow
def test_the_band_of_the_law_is_wide_where_no_pair_was(learned):
    _, X, Y = learned
    noisy = Y + 0.05 * RNG.normal(size=Y.shape)
    posterior = hk.condition(K, X, noisy, 0.05**2 / len(X), mean=hk.kinetic(1.0))
    r = np.linspace(0.5, 3.0, 40)
    error = np.array([posterior.field.law(s, 1.0) for s in r]) - (spring(r) - spring(1.0))
    band = np.array([posterior.law_deviation(s, 1.0) for s in r])
    assert 0.8 < np.mean(np.abs(error) < 2 * band + 1e-12) <= 1
    assert posterior.law_deviation(15.0, 1.0) > 30 * band.max()
    np.testing.assert_allclose(
        posterior.law_deviation(15.0, 14.0) ** 2, 200 * (1 - np.exp(-0.5)), rtol=0.02
    )
    assert posterior.law_deviation(1.0, 1.0) == 0


@pytest.mark.slow
def test_a_shared_law_is_tuned_saved_and_read_back(learned, tmp_path):
    _, X, Y = learned
    Y = Y + 0.05 * RNG.normal(size=Y.shape)
    tuned = hk.tune(K, X, Y, mean=hk.kinetic(1.0), objective="marginal_likelihood", starts=1)
    assert np.sqrt(tuned.regularization * len(X)) == pytest.approx(0.05, rel=0.2)
    assert tuned.field.kernel.kernel.kernel.centres is not None
    hk.save(tmp_path / "field", tuned.field)
    again = hk.load(tmp_path / "field")
    np.testing.assert_array_equal(again.law(1.3, 1.0), tuned.field.law(1.3, 1.0))


def test_a_law_is_found_in_kernels_with_a_symmetry_and_beside_other_terms():
    """A law of all images of a state; before, such fields said that they had no law."""
    k, reflected = hk.Gaussian(1.5), -np.eye(8)
    law = 100.0 * hk.Shared(k, hk.pairs(4, 2))
    Q = RNG.normal(size=(15, 8))
    r = jnp.linspace(0.5, 2.5, 9)
    F = np.stack([forces(q.reshape(4, 2)).ravel() for q in Q])
    wanted = -(spring(r) - spring(1.0))  # the potential of the force field ∇u
    posterior = hk.condition(hk.Odd(hk.CurlFree(law)), Q, F, 1e-6)
    kernels = (
        hk.CurlFree(hk.Invariant(law, [reflected])),
        hk.CurlFree(law + 1e-6 * hk.Gaussian(2.0)),
    )
    for field in (posterior.field, *(hk.fit(K, Q, F, 1e-8) for K in kernels)):
        found = jax.jit(jax.vmap(lambda r, f=field: f.law(r, 1.0)))(r)
        np.testing.assert_allclose(found, wanted, atol=0.02)
    plain = hk.condition(hk.CurlFree(law), Q, F, 1e-6)
    np.testing.assert_allclose(
        posterior.law_deviation(2.0, 1.0), plain.law_deviation(2.0, 1.0), rtol=1e-3
    )


@pytest.mark.slow
def test_a_graph_of_springs_is_found_edge_by_edge():
    """Four particles, of whose six pairs three have a spring of stiffness 1."""
    rng = np.random.default_rng(0)
    has_spring = np.array([1, 0, 1, 0, 0, 1])
    first, second = np.triu_indices(4, 1)
    A = np.zeros((4, 4))
    A[first, second] = A[second, first] = has_spring
    values, modes = np.linalg.eigh(np.diag(A.sum(axis=1)) - A)
    w = np.sqrt(np.maximum(values, 0.0))
    t, runs = 0.05 * np.arange(161), []
    for _ in range(2):
        q, p = modes.T @ rng.normal(size=(4, 2)), modes.T @ rng.normal(size=(4, 2))
        phase = np.outer(t, w)[:, :, None]
        s = np.where(w[None, :, None] > 1e-6, w[None, :, None], 1.0)
        drift = np.where(w[None, :, None] > 1e-6, np.sin(phase) / s, t[:, None, None])
        path = q[None] * np.cos(phase) + p[None] * drift
        speed = p[None] * np.cos(phase) - q[None] * w[None, :, None] * np.sin(phase)
        x = np.concatenate([(modes @ a).reshape(len(t), 8) for a in (path, speed)], axis=1)
        runs.append(x + 0.01 * rng.normal(size=x.shape))
    k, pairs, runs = hk.Gaussian(2.0), hk.pairs(4, 2), hk.Runs(t, runs)
    learned = hk.learn(hk.Symplectic(hk.Shared(k, pairs, laws=range(6))), runs, mass=1.0)
    assert learned.converged, learned.diagnostics
    r = jnp.linspace(0.7, 2.0, 9)
    for i, is_spring in enumerate(has_spring):
        law = jax.vmap(lambda r, i=i: learned.field.law(r, 1.0, which=i))(r)
        np.testing.assert_allclose(law, is_spring * 0.5 * (r**2 - 1), atol=0.02)
    with pytest.warns(UserWarning, match="do not use this field"):  # negative control: one law
        one = hk.learn(hk.Symplectic(hk.Shared(k, pairs)), runs, mass=1.0)
    assert learned.log_evidence > one.log_evidence + 100


@pytest.mark.slow
def test_two_species_have_a_law_each():
    """Springs between unlike particles only; the law between like ones is flat."""
    like = hk.pairs(4, 2, among=(0, 1))
    unlike = hk.pairs(4, 2, among=((0, 1), (2, 3)))
    q = RNG.normal(size=(15, 4, 2))
    F = np.zeros_like(q)
    for i in (0, 1):
        for j in (2, 3):
            apart = q[:, i] - q[:, j]
            F[:, i] -= apart
            F[:, j] += apart
    k = hk.Gaussian(1.5)
    K = hk.CurlFree(100.0 * hk.Shared(k, like) + 100.0 * hk.Shared(k, unlike))
    field = hk.fit(K, q.reshape(15, 8), F.reshape(15, 8), 1e-10)
    assert abs(field.law(1.5, 1.0, which=0)) < 1e-3
    # −½ r², the potential of the force field ∇u.
    np.testing.assert_allclose(field.law(1.5, 1.0, which=1), -0.5 * (1.5**2 - 1), atol=2e-3)


def _gram_of_chain(X, Z):
    """Σ_pq J Dᵀ M D Jᵀ of three sites, M = ∂²k for the differences D x and the Gaussian k."""
    D = np.zeros((2, 6))
    D[[0, 1, 0, 1], [0, 1, 1, 2]] = [-1, -1, 1, 1]
    apart = (X @ D.T)[:, None, :, None] - (Z @ D.T)[None, :, None]
    M = (1 / 1.5**2 - apart**2 / 1.5**4) * np.exp(-(apart**2) / (2 * 1.5**2))
    forces = np.einsum("pa,ijpq,qb->iajb", D[:, :3], M, D[:, :3])
    return np.pad(forces, ((0, 0), (3, 0), (0, 0), (3, 0)))


def _normal(a, b, length):
    return np.exp(-np.sum((a[:, None] - b[None]) ** 2, axis=2) / (2 * length**2))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["inputs", "parameters"])
def test_a_law_beside_inputs_or_in_a_family_has_the_posterior_of_the_closed_form(name):
    rng, on_momenta = np.random.default_rng(3), np.diag([0, 0, 0, 1.0, 1, 1])
    (X, Y), x = rng.normal(size=(2, 10, 6)), rng.normal(size=(1, 6))
    U, u = rng.normal(size=(10, 1)), rng.normal(size=(1, 1))
    law = hk.Shared(hk.Gaussian(1.5), hk.neighbours(3), np.linspace(-6, 6, 40))

    def covariance(X, Z, U, V):
        G = _gram_of_chain(X, Z)
        if name == "parameters":
            G = G * _normal(U, V, 0.8)[:, None, :, None]
        else:
            gains = 0.7 * _normal(X, Z, 2.0) * (U @ V.T)
            G = G + gains[:, None, :, None] * on_momenta[None, :, None]
        return G.reshape(G.shape[0] * 6, -1)

    if name == "parameters":
        K = hk.Family(hk.Symplectic(law), hk.Gaussian(0.8))
    else:
        matrix = hk.InputMatrix(0.7 * hk.Gaussian(2.0), acts_on=(3, 4, 5))
        K = hk.Controlled(hk.Symplectic(law), matrix)
    G, cross = covariance(X, X, U, U) + 0.1 * np.eye(60), covariance(x, X, u, U)
    a = np.linalg.solve(G, Y.ravel())
    posterior = hk.condition(K, X, Y, 0.01, **{name: U})
    np.testing.assert_allclose(posterior.field(x[0], u[0]), cross @ a, atol=1e-6)
    variance = covariance(x, x, u, u) - cross @ np.linalg.solve(G, cross.T)
    deviation = np.sqrt(np.diag(variance).clip(0))
    np.testing.assert_allclose(posterior.deviation(x[0], u[0]), deviation, atol=1e-6)
    log_p = -0.5 * (Y.ravel() @ a + np.linalg.slogdet(2 * np.pi * G)[1])
    found = hk.log_marginal_likelihood(K, X, Y, 0.01, **{name: U})
    np.testing.assert_allclose(found, log_p, rtol=1e-6)
    assert len(posterior.field.undetermined) == 1  # a constant
    if name == "parameters":
        with pytest.raises(AttributeError, match=r"field.at\(theta\).law"):
            posterior.field.law(1.0, 0.0)
        assert np.isfinite(posterior.field.at(u[0]).law(1.0, 0.0))
    else:
        assert posterior.field.law(1.0, 0.0) == posterior.field.drift.law(1.0, 0.0)


def test_what_is_no_part_is_refused():
    with pytest.raises(TypeError, match="Shared needs a kernel and then a function"):
        hk.Shared(hk.Gaussian(1.0), 3)
    with pytest.raises(ValueError, match=r"return points\[:, None\]"):
        hk.Shared(hk.Gaussian(1.0), lambda x: x)(jnp.ones(3), jnp.ones(3))
    with pytest.raises(ValueError, match="of must be"):
        hk.pairs(3, 2, of="square")
    with pytest.raises(ValueError, match="contains no pair"):
        hk.pairs(1, 2)
    with pytest.raises(AttributeError, match="the field has no law"):
        hk.fit(hk.CurlFree(hk.Gaussian(1.0)), np.eye(2), np.eye(2), 1e-3).law(1.0)
    together = np.zeros((2, 8))
    with pytest.raises(ValueError, match="two particles in one place"):
        hk.fit(
            hk.CurlFree(hk.Shared(hk.Gaussian(1.0), hk.pairs(4, 2, of="log"))),
            together,
            together,
            1e-3,
        )


@pytest.mark.slow
@pytest.mark.parametrize("momenta", [True, False])
def test_a_law_is_learned_from_noisy_runs(momenta):
    """Six particles with springs, from one run with noise, with momenta or without."""
    rng = np.random.default_rng(2)
    q, p = rng.normal(size=(2, 6, 2))
    path = []
    for _ in range(121):
        path.append(np.concatenate([q.ravel(), p.ravel()]))
        for _ in range(4):
            p = p + 0.005 * forces(q)
            q = q + 0.01 * p
            p = p + 0.005 * forces(q)
    X = np.array(path)
    noisy = X + (0.01 if momenta else 0.001) * rng.normal(size=X.shape)
    K = hk.Symplectic(hk.Shared(hk.Matern(2.5, 1.0), hk.pairs(particles=6, dim=2)))
    runs = hk.Runs([0.04 * np.arange(121)], [noisy[:, : 24 if momenta else 12]])
    learned = hk.learn(K, runs, mass=1.0 if momenta else np.ones(12))
    assert learned.converged, learned.diagnostics
    found = [float(n) for n in np.asarray(learned.noise)[[0, -1]]]
    assert found[0] == pytest.approx(0.01 if momenta else 0.001, rel=0.3)
    assert np.isnan(found[1]) != momenta
    r = np.linspace(0.6, 2.5, 30)
    law = np.array([float(learned.field.law(s, 1.0)) for s in r])
    posterior = learned.posterior
    band = np.array([float(posterior.law_deviation(s, 1.0)) for s in r])
    error = law - (spring(r) - spring(1.0))
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.mean(np.abs(error) < 3 * band + 1e-4) > 0.8
    with pytest.raises(TypeError, match="compare log_evidence"):
        learned.gain(hk.Friction())
    with pytest.raises(ValueError, match=r"mass=np.ones\(12\)"):
        hk.learn(K, hk.Runs([0.04 * np.arange(121)], [noisy[:, :12]]), mass=1.0)


def chain_runs(masses, viscous, noise, seed):
    """A free chain with springs d + d³/2, two runs, as q and q̇."""
    rng, m, t = np.random.default_rng(seed), len(masses), 0.05 * np.arange(121)

    def rates(_, x):
        d = np.diff(x[:m])
        pull = d + 0.5 * d**3
        force = np.append(pull, 0.0) - np.append(0.0, pull) - viscous * x[m:]
        return np.concatenate([x[m:], force / masses])

    paths = [
        solve_ivp(rates, (0, 6), rng.normal(size=2 * m), t_eval=t, rtol=1e-9, atol=1e-9).y.T
        for _ in range(2)
    ]
    return hk.Runs(t, [x + noise * rng.normal(size=x.shape) for x in paths])


CHAIN = hk.Shared(hk.Gaussian(2.0), hk.neighbours(4))


def _error_of_chain(field):
    r = jnp.linspace(-1.2, 1.2, 9)
    law = jax.vmap(lambda r: field.law(r, 0.0))(r)
    return np.abs(np.asarray(law - (r**2 / 2 + r**4 / 8))).max()


@pytest.mark.slow
def test_friction_is_learned_from_noisy_runs_beside_a_law():
    K = hk.Sum(energy=hk.Symplectic(CHAIN), friction=hk.Friction())
    learned = hk.learn(K, chain_runs(np.ones(4), 0.2, 0.005, seed=0), mass=1.0)
    assert learned.converged, learned.diagnostics
    assert _error_of_chain(learned.field) < 0.02
    rubs = learned.field.part("friction")(jnp.ones(8))
    np.testing.assert_allclose(rubs[4:], -0.2, atol=0.03)


@pytest.mark.slow
def test_masses_are_learned_from_noisy_runs_beside_a_law():
    masses = np.array([1.0, 2.0, 0.7, 1.5])
    learned = hk.learn(hk.Symplectic(CHAIN), chain_runs(masses, 0.0, 0.003, seed=1), masses=True)
    assert learned.converged, learned.diagnostics
    np.testing.assert_allclose(learned.kernel.masses, masses, rtol=0.02)
    assert _error_of_chain(learned.field) < 0.02
    field, x = learned.field, learned.states[0][30]
    slope = jax.grad(field.hamiltonian)(x)
    np.testing.assert_allclose(slope[4:], learned.kernel.masses * x[4:])  # ½ q̇ᵀMq̇
    np.testing.assert_allclose(slope @ field(x), 0.0, atol=1e-7)  # the energy is conserved


@pytest.mark.slow
def test_inputs_are_learned_from_noisy_runs_beside_a_law():
    """A held force on the first of three sites, whose gain .8 is not known."""
    rng, t, m = np.random.default_rng(1), 0.05 * np.arange(121), 3

    def rates(_, x, u):
        d = np.diff(x[:m])
        pull = d + 0.5 * d**3
        return np.concatenate([x[m:], np.append(pull, 0) - np.append(0, pull) + [0.8 * u, 0, 0]])

    paths, inputs = [], []
    for _ in range(2):
        u, x = np.repeat(1.5 * rng.normal(size=25), 5)[:121], [rng.normal(size=2 * m)]
        for k in range(120):
            step = solve_ivp(rates, (t[k], t[k + 1]), x[-1], args=(u[k],), rtol=1e-8, atol=1e-8)
            x.append(step.y[:, -1])
        paths.append(np.array(x) + 0.005 * rng.normal(size=(121, 2 * m)))
        inputs.append(u)
    law = hk.Shared(hk.Gaussian(2.0), hk.neighbours(m))
    K = hk.Controlled(hk.Symplectic(law), hk.InputMatrix(1.0, acts_on=(3, 4, 5)))
    learned = hk.learn(K, hk.Runs(t, paths, inputs=inputs), mass=1.0)
    assert learned.converged, learned.diagnostics
    assert _error_of_chain(learned.field) < 0.02
    G = learned.field.input_matrix(np.zeros(2 * m))[:, 0]
    np.testing.assert_allclose(G, [0, 0, 0, 0.8, 0, 0], atol=0.02)
    posterior = learned.posterior
    assert 0 < posterior.deviation(np.zeros(2 * m), np.ones(1))[3] < 0.02
    assert 0 < posterior.chi_squared < 2
    score = learned.score(first=10, draws=0)
    assert np.all(score.rmse < 0.5 * score.persistence)
    with pytest.warns(UserWarning, match="do not use this field"):  # negative control
        backwards = hk.learn(K, hk.Runs(t, paths, inputs=[u[::-1] for u in inputs]), mass=1.0)
    assert backwards.log_evidence < learned.log_evidence - 100


def test_a_family_of_laws_is_refused_by_learn_at_once():
    t, X = np.arange(20.0), np.random.default_rng(0).normal(size=(2, 20, 8))
    runs = hk.Runs(t, list(X), parameters=[0.1, 0.2])
    with pytest.raises(TypeError, match="does not know families"):
        hk.learn(hk.Family(hk.Symplectic(CHAIN), hk.Gaussian(1.0)), runs, mass=1.0)


def test_masses_that_are_known_and_unknown_and_friction_without_momenta_are_refused():
    runs = chain_runs(np.ones(4), 0.0, 0.01, seed=0)
    with pytest.raises(TypeError, match="give one of the two"):
        hk.learn(hk.Symplectic(CHAIN), runs, mass=1.0, masses=True)
    with pytest.raises(ValueError, match=r"add hk.Friction\(\) to hk.Symplectic"):
        hk.learn(hk.PortHamiltonian(CHAIN, friction=0.1), runs, mass=1.0)
