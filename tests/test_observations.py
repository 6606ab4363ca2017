"""Observations of every kind against closed forms solved by NumPy, and what they refuse."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import canonical

import hamkernel as hk

LENGTH, AMPLITUDE, RIDGE = 1.3, 2.0, 1e-3
# The condition of the systems, trace / Nλ ~ 1e4, times rounding.
SOLVE = 1e-9
K = hk.Symplectic(AMPLITUDE * hk.Gaussian(LENGTH))
J = canonical(2)


# Covariances of H and f = J∇H in NumPy.


def value_value(x, z):
    return AMPLITUDE * np.exp(-(x - z) @ (x - z) / (2 * LENGTH**2))


def value_field(x, z):
    return value_value(x, z) * J @ (x - z) / LENGTH**2


def field_field(x, z):
    d = (x - z) / LENGTH
    return value_value(x, z) / LENGTH**2 * J @ (np.eye(2) - np.outer(d, d)) @ J.T


class Reference:
    """Rows [(weight of H, weights of f, point), …] with targets and standard deviations."""

    def __init__(self, *kinds):
        self.rows = [row for kind in kinds for row in kind[0]]
        self.targets = np.concatenate([np.ravel(kind[1]) for kind in kinds])
        self.noise = np.concatenate([np.ravel(kind[2]) for kind in kinds])
        self.constant = np.array([sum(b for b, _, _ in row) for row in self.rows])

    def covariance(self, left, right):
        return sum(
            b * c * value_value(x, z)
            + b * value_field(x, z) @ v
            + c * value_field(z, x) @ u
            + u @ field_field(x, z) @ v
            for b, u, x in left
            for c, v, z in right
        )

    def matrix(self, left, right):
        return np.array([[self.covariance(a, b) for b in right] for a in left])

    def projected(self, sigma2):
        """C = A⁻¹ − A⁻¹P(PᵀA⁻¹P)⁻¹PᵀA⁻¹, P the unknown constant of the energies."""
        A = self.matrix(self.rows, self.rows) + sigma2 * np.diag(self.noise**2)
        C = np.linalg.inv(A)
        if self.constant.any():
            Cp = C @ self.constant
            C = C - np.outer(Cp, Cp) / (self.constant @ Cp)
        return C

    def at(self, asked, sigma2):
        """Mean and covariance of what is asked."""
        C, c = self.projected(sigma2), self.matrix(asked, self.rows)
        return c @ C @ self.targets, self.matrix(asked, asked) - c @ C @ c.T


ZERO = np.zeros(2)


def velocities(seed, N=4, noise=None, missing=False):
    rng = np.random.default_rng(seed)
    X, Y = rng.normal(size=(N, 2)), rng.normal(size=(N, 2))
    if missing:
        Y[rng.random((N, 2)) < 0.4] = np.nan
    s = np.broadcast_to(1.0 if noise is None else noise, Y.shape)
    seen = np.argwhere(~np.isnan(Y))
    rows = [[(0.0, np.eye(2)[a], X[i])] for i, a in seen]
    return hk.Velocities(X, Y, noise), (rows, Y[tuple(seen.T)], s[tuple(seen.T)]), N


def energies(seed, N=5, noise=None):
    rng = np.random.default_rng(seed)
    X, E = rng.normal(size=(N, 2)), 10 + rng.normal(size=N)
    s = np.broadcast_to(1.0 if noise is None else noise, E.shape)
    return hk.Energies(X, E, noise), ([[(1.0, ZERO, x)] for x in X], E, s), N


def equilibria(seed, N=2):
    X = np.random.default_rng(seed).normal(size=(N, 2))
    rows = [[(0.0, e, x)] for x in X for e in np.eye(2)]
    return hk.Equilibria(X), (rows, np.zeros(2 * N), np.ones(2 * N)), N


def functionals(seed, R=3, Q=4):
    rng = np.random.default_rng(seed)
    points, weights, t = (rng.normal(size=s) for s in ((R, Q, 2), (R, Q, 2), R))
    rows = [[(0.0, weights[r, q], points[r, q]) for q in range(Q)] for r in range(R)]
    return hk.Functionals(points, weights, t), (rows, t, np.ones(R)), R


KINDS = {
    "velocities": velocities,
    "noisy_coordinates": lambda seed: velocities(seed, noise=np.array([0.5, 2.0])),
    "masked": lambda seed: velocities(seed, N=5, missing=True),
    "masked_and_noisy": lambda seed: velocities(
        seed, N=5, noise=np.random.default_rng(seed).uniform(0.5, 2, (5, 2)), missing=True
    ),
    "energies": energies,
    "noisy_energies": lambda seed: energies(seed, noise=np.linspace(0.5, 2, 5)),
    "equilibria": equilibria,
    "functionals": functionals,
}
PAIRS = [(a, b) for i, a in enumerate(KINDS) for b in list(KINDS)[i:]]
ASKED = np.array([[0.3, -0.2], [2.5, 1.0]])
FIELD_ASKED = [[(0.0, e, x)] for x in ASKED for e in np.eye(2)]
ENERGY_ASKED = [[(1.0, ZERO, ASKED[0]), (-1.0, ZERO, ASKED[1])]]


@pytest.mark.few(3)
@pytest.mark.parametrize(("first", "second"), PAIRS, ids=lambda name: name)
def test_fit_and_posterior_of_each_pair_of_kinds_are_the_closed_form(first, second):
    (a, rows_a, n_a), (b, rows_b, n_b) = KINDS[first](1), KINDS[second](2)
    reference, sigma2 = Reference(rows_a, rows_b), (n_a + n_b) * RIDGE
    posterior = hk.condition(K, a + b, regularization=RIDGE)
    mean, covariance = reference.at(FIELD_ASKED, sigma2)
    for field in (posterior.field, hk.fit(K, a + b, regularization=RIDGE)):
        np.testing.assert_allclose(field(ASKED[0]), mean[:2], atol=SOLVE)
        np.testing.assert_allclose(field.evaluate(ASKED).reshape(-1), mean, atol=SOLVE)
        H = field.hamiltonian
        change, variance = reference.at(ENERGY_ASKED, sigma2)
        np.testing.assert_allclose(H(ASKED[0]) - H(ASKED[1]), change[0], atol=SOLVE)
    blocks = covariance.reshape(2, 2, 2, 2)
    for i, x in enumerate(ASKED):
        np.testing.assert_allclose(posterior.covariance(x), blocks[i, :, i], atol=SOLVE)
        deviation = np.sqrt(np.diagonal(blocks[i, :, i]))
        np.testing.assert_allclose(posterior.deviation(x), deviation, atol=SOLVE)
    got = posterior.energy_deviation(*ASKED)
    np.testing.assert_allclose(got, np.sqrt(variance[0, 0]), atol=SOLVE)


def test_one_kind_alone_is_the_closed_form():
    for name in ("energies", "masked", "functionals"):
        data, rows, N = KINDS[name](3)
        field = hk.fit(K, data, regularization=RIDGE)
        mean, _ = Reference(rows).at(FIELD_ASKED, N * RIDGE)
        np.testing.assert_allclose(field.evaluate(ASKED).reshape(-1), mean, atol=SOLVE)


def test_velocities_alone_are_the_fit_of_today_to_the_last_digit():
    data, _, _ = velocities(0, N=8)
    old = hk.fit(K, data.X, data.Y, RIDGE)
    for field in (
        hk.fit(K, data, regularization=RIDGE),
        hk.condition(K, data.X, data.Y, RIDGE).field,
    ):
        np.testing.assert_allclose(field.coefficients, old.coefficients, rtol=SOLVE)
        np.testing.assert_allclose(field.residual, old.residual, atol=SOLVE)
        np.testing.assert_allclose(field.norm, old.norm, rtol=SOLVE)


def test_residuals_are_those_of_the_rows_in_their_own_units():
    a, b = velocities(1, noise=np.array([0.5, 2.0]))[0], energies(2, noise=2.0)[0]
    field = hk.fit(K, a + b, regularization=RIDGE)
    of_a, of_b = field.residual[:8], field.residual[8:]
    np.testing.assert_allclose(of_a.reshape(4, 2), a.Y - jax.vmap(field)(a.X), atol=SOLVE)
    off = b.E - jax.vmap(field.hamiltonian)(b.X)
    np.testing.assert_allclose(of_b, off - off.mean(), atol=SOLVE)


def test_the_constant_of_the_energies_is_unknown_and_shared():
    a, b = velocities(1)[0], energies(2, N=6)[0]
    halves = [hk.Energies(b.X[i], b.E[i] + 100.0) for i in (slice(2), slice(2, 6))]
    field = hk.fit(K, a + b, regularization=RIDGE)
    moved = hk.fit(K, a + halves[0] + halves[1], regularization=RIDGE)
    np.testing.assert_allclose(moved.evaluate(ASKED), field.evaluate(ASKED), atol=SOLVE)
    other = hk.fit(K, a + halves[0] + hk.Energies(b.X[2:], b.E[2:]), regularization=RIDGE)
    assert jnp.abs(other.evaluate(ASKED) - field.evaluate(ASKED)).max() > 0.1  # the control


def test_order_and_splitting_change_nothing():
    made = [KINDS[name](i)[0] for i, name in enumerate(("masked_and_noisy", "noisy_energies"))]
    v, e, f = *made, functionals(5)[0]
    whole = hk.condition(K, v + e + f, regularization=RIDGE)
    i, j = np.array([3, 0, 4, 1, 2]), np.array([2, 0, 1])
    parts = sum(
        [hk.Velocities(v.X[r], v.Y[r], v.noise[r]) for r in (i[:2], i[2:])]
        + [hk.Energies(e.X[r], e.E[r], e.noise[r]) for r in (i[:3], i[3:])]
        + [hk.Functionals(f.points[r], f.weights[r, 0], f.targets[r]) for r in (j[:1], j[1:])]
    )
    split = hk.condition(K, parts, regularization=RIDGE)
    x, x0 = ASKED
    np.testing.assert_allclose(split.field(x), whole.field(x), atol=SOLVE)
    np.testing.assert_allclose(split.field.norm, whole.field.norm, atol=SOLVE)
    np.testing.assert_allclose(split.covariance(x), whole.covariance(x), atol=SOLVE)
    np.testing.assert_allclose(
        split.energy_deviation(x, x0), whole.energy_deviation(x, x0), atol=SOLVE
    )


def test_the_squares_of_the_norms_of_parts_add_up_with_energies_too():
    rng = np.random.default_rng(3)
    X, Z = rng.normal(size=(2, 6, 2))
    data = hk.Velocities(X, rng.normal(size=(6, 2))) + hk.Energies(Z, rng.normal(size=6))
    field = hk.fit(K + hk.Symplectic(hk.Gaussian(0.7)), data, regularization=1e-2)
    squares = [field.part(i).norm ** 2 for i in range(2)]
    np.testing.assert_allclose(sum(squares), field.norm**2, rtol=SOLVE)


def test_functionals_that_share_points_or_are_padded_are_the_same_rows():
    rng = np.random.default_rng(0)
    points, weights, targets = (rng.normal(size=s) for s in ((3, 4, 2), (3, 5, 4, 2), (3, 5)))
    shared = hk.fit(K, hk.Functionals(points, weights, targets), regularization=RIDGE)
    repeated = np.repeat(points, 5, axis=0), weights.reshape(15, 4, 2), targets.reshape(15)
    alone = hk.fit(K, hk.Functionals(*repeated), regularization=RIDGE)
    padded = [np.pad(a, ((0, 0), (0, 2), (0, 0))) for a in repeated[:2]]
    padded = hk.fit(K, hk.Functionals(*padded, repeated[2]), regularization=RIDGE)
    for field in (alone, padded):
        np.testing.assert_allclose(field.evaluate(ASKED), shared.evaluate(ASKED), atol=SOLVE)


EVERYTHING = sum(
    KINDS[name](i)[0]
    for i, name in enumerate(("masked_and_noisy", "functionals", "noisy_energies"))
)
GRID = np.stack(np.meshgrid(*[np.linspace(-3.5, 3.5, 13)] * 2), axis=-1).reshape(-1, 2)
SOLVERS = {
    "ConjugateGradient": hk.ConjugateGradient(tolerance=1e-12),
    "Nystrom": hk.Nystrom(tolerance=100.0, points=GRID),  # half a lengthscale apart leave 76
}


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("name", SOLVERS)
def test_other_solvers_find_the_field_of_the_dense_one(name):
    exact = hk.fit(K, EVERYTHING, regularization=RIDGE)
    field = hk.fit(K, EVERYTHING, regularization=RIDGE, solver=SOLVERS[name])
    np.testing.assert_allclose(field.evaluate(ASKED), exact.evaluate(ASKED), atol=1e-4)
    np.testing.assert_allclose(field.norm, exact.norm, rtol=1e-4)
    H, H_exact = field.hamiltonian, exact.hamiltonian
    changes = [h(ASKED[0]) - h(ASKED[1]) for h in (H, H_exact)]
    np.testing.assert_allclose(*changes, atol=1e-4)


@pytest.mark.slow
def test_conjugate_gradients_of_rows_are_preconditioned():
    X = np.random.default_rng(0).uniform(-2, 2, size=(40, 2))
    data = hk.Velocities(X, np.sin(X[:, ::-1]), noise=np.array([1.0, 0.5]))
    solver = hk.ConjugateGradient(tolerance=1e-10)
    field = hk.fit(K, data, regularization=1e-4, solver=solver)
    exact = hk.fit(K, data, regularization=1e-4)
    np.testing.assert_allclose(field.evaluate(X), exact.evaluate(X), atol=1e-7)
    assert int(field.info.iterations or 0) in range(1, 17)  # 8, and more than 100 without


@pytest.mark.slow
def test_random_features_learn_from_every_kind_what_their_own_kernel_learns(key):
    solver = hk.RandomFeatures(40, key)
    field = hk.fit(K, EVERYTHING, regularization=RIDGE, solver=solver)
    basis, n = field.features, 2
    rows, targets = [], []
    for block, y in EVERYTHING.parts():
        of = jax.vmap(basis.waves.values)(block.points) if block.of_values else basis(block.points)
        rows.append(np.asarray(block.rows(of)))
        targets.append(np.asarray(y / block.scale))
    F, y = np.concatenate(rows), np.concatenate(targets)
    p = np.concatenate(
        [float(b.of_values) / np.asarray(b.scale) for b, _ in EVERYTHING.parts()]
    )  # of the unknown constant
    keep = np.eye(len(p)) - np.outer(p, p) / (p @ p)
    N = sum(block.count for block, _ in EVERYTHING.parts())
    w = np.linalg.solve(F.T @ keep @ F + N * RIDGE * np.eye(F.shape[1]), F.T @ keep @ y)
    np.testing.assert_allclose(field.weights, w, atol=SOLVE)
    assert field.dimension == n


@pytest.mark.slow
def test_derivatives_with_respect_to_everything_are_those_of_differences():
    v, e, f = velocities(1)[0], energies(2)[0], functionals(3)[0]

    def asked(scale):
        data = hk.Velocities(v.X, scale * v.Y, scale * jnp.ones(2)) + hk.Energies(e.X, e.E)
        data = data + hk.Functionals(scale * f.points, f.weights[:, 0], f.targets)
        kernel = hk.Symplectic(scale * hk.Gaussian(LENGTH))
        return hk.fit(kernel, data, regularization=scale * RIDGE)(jnp.asarray(ASKED[0])).sum()

    at, h = jnp.asarray(1.5), 1e-5
    slope = (asked(at + h) - asked(at - h)) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(asked))(at), slope, rtol=1e-6)


# What it is worth.

PENDULUM = hk.systems.Pendulum()
BOX = np.random.default_rng(99).uniform(-2, 2, (1000, 2))
TRUE = jax.vmap(PENDULUM)(BOX)


def pendulum_data(N, seed):
    X = np.random.default_rng(seed).uniform(-2, 2, (N, 2))
    return X, np.array(jax.vmap(PENDULUM)(X))


def error(field, which=slice(None)):
    off = (field.evaluate(BOX) - TRUE)[:, which]
    return float(jnp.linalg.norm(off) / jnp.linalg.norm(TRUE[:, which]))


MODEL = hk.Symplectic(20.0 * hk.Gaussian(2.5))


def test_thirty_energies_make_a_field_of_four_velocities():
    alone, both = [], []
    for seed in range(5):
        Z, _ = pendulum_data(30, 100 + seed)
        velocities = hk.Velocities(*pendulum_data(4, seed))
        energies = hk.Energies(Z, jax.vmap(PENDULUM.hamiltonian)(Z))
        alone.append(error(hk.fit(MODEL, velocities, regularization=1e-10)))
        both.append(error(hk.fit(MODEL, velocities + energies, regularization=1e-10)))
    assert np.median(both) < 0.01
    assert np.median(alone) > 0.2


def test_half_of_the_components_are_worth_as_many_full_rows():
    ratios = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        X, Y = pendulum_data(40, seed)
        Y += 0.01 * rng.normal(size=Y.shape)
        masked = np.where(rng.permutation(80).reshape(40, 2) < 40, np.nan, Y)
        full = error(hk.fit(MODEL, X[:20], Y[:20], 1e-5))
        ratios.append(error(hk.fit(MODEL, hk.Velocities(X, masked), regularization=1e-5)) / full)
    assert np.median(ratios) < 1.5


def test_noise_that_is_told_is_used():
    given, ignored = [], []
    for seed in range(5):
        X, Y = pendulum_data(40, seed)
        Y += np.array([0.1, 0.001]) * np.random.default_rng(seed).normal(size=Y.shape)
        data, ridge = hk.Velocities(X, Y, noise=np.array([1.0, 0.01])), 0.1**2 / 40
        for fits, field in (
            (given, hk.fit(MODEL, data, regularization=ridge)),
            (ignored, hk.fit(MODEL, X, Y, ridge)),
        ):
            fits.append([error(field), error(field, 1)])
    assert np.median(given, axis=0)[0] <= np.median(ignored, axis=0)[0]
    assert 3 * np.median(given, axis=0)[1] <= np.median(ignored, axis=0)[1]


# Prior means.


def kinetic(x):
    return jnp.stack([x[1], jnp.zeros_like(x[0])])


MEANS = {
    "system": hk.systems.HarmonicOscillator(),
    "field": hk.fit(MODEL, *pendulum_data(8, 7), 1e-3),
    "function": kinetic,
}


@pytest.mark.few(2)
@pytest.mark.parametrize("name", MEANS)
@pytest.mark.parametrize("solver", [None, hk.ConjugateGradient(1e-12), hk.Nystrom(1e-8)])
def test_a_mean_is_taken_off_the_data_and_added_to_the_field(name, solver):
    mean, (X, Y) = MEANS[name], pendulum_data(8, 0)
    m = np.array(jax.vmap(mean)(X))
    field = hk.fit(MODEL, X, Y, RIDGE, mean=mean, solver=solver)
    expected = hk.fit(MODEL, X, Y - m, RIDGE).evaluate(ASKED) + jax.vmap(mean)(jnp.asarray(ASKED))
    np.testing.assert_allclose(field.evaluate(ASKED), expected, atol=1e-6)
    np.testing.assert_allclose(field(ASKED[0]), expected[0], atol=1e-6)
    data = hk.Velocities(X[:3], Y[:3]) + hk.Functionals(
        X[3:, None], Y[3:, None], (Y[3:] ** 2).sum(1)
    )
    both = hk.fit(MODEL, data, regularization=RIDGE, mean=mean, solver=solver)
    assert jnp.isfinite(both(ASKED[0])).all()


def test_a_mean_with_a_hamiltonian_is_in_that_of_the_field():
    X, Y = pendulum_data(8, 0)
    x = jnp.asarray(ASKED[0])
    for name in ("system", "field"):
        field = hk.fit(MODEL, X, Y, RIDGE, mean=MEANS[name])
        np.testing.assert_allclose(J @ jax.grad(field.hamiltonian)(x), field(x), atol=SOLVE)
        assert field.anchored(x, 2.0).hamiltonian(x) == pytest.approx(2.0)
    field = hk.fit(MODEL, X, Y, RIDGE, mean=kinetic)
    with pytest.raises(AttributeError, match=r"the mean, kinetic, has no potential.*hk\.systems"):
        _ = field.hamiltonian


def test_a_system_of_another_structure_is_not_told_to_be_a_system():
    X, Y = pendulum_data(8, 0)
    field = hk.fit(hk.CurlFree(hk.Gaussian(1.5)), X, Y, RIDGE, mean=MEANS["system"])
    with pytest.raises(AttributeError, match=r"f = J∇H, and CurlFree.*use Symplectic\(k\)"):
        _ = field.potential
    learned = hk.fit(MODEL, X, Y, RIDGE)
    field = hk.fit(hk.CurlFree(hk.Gaussian(1.5)), X, Y, RIDGE, mean=learned)
    with pytest.raises(AttributeError, match=r"was learned with Symplectic: learn both with one"):
        _ = field.potential


def test_energies_with_a_mean_are_the_closed_form():
    data, rows, N = energies(2)
    mean, H = MEANS["system"], MEANS["system"].hamiltonian
    field = hk.fit(K, data, regularization=RIDGE, mean=mean)
    known = np.array(jax.vmap(H)(data.X))
    expected, _ = Reference((rows[0], rows[1] - known, rows[2])).at(FIELD_ASKED, N * RIDGE)
    expected = expected.reshape(2, 2) + jax.vmap(mean)(jnp.asarray(ASKED))
    np.testing.assert_allclose(field.evaluate(ASKED), expected, atol=SOLVE)


@pytest.mark.slow
def test_separability_needs_that_of_the_mean():
    k = 2.0 * (hk.Select(hk.Gaussian(1.0), (0,)) + hk.Select(hk.Gaussian(1.0), (1,)))
    X, Y = pendulum_data(8, 0)
    separable = hk.fit(hk.Symplectic(k), X, Y, RIDGE, mean=MEANS["system"])
    assert separable.is_separable
    assert not hk.fit(hk.Symplectic(k), X, Y, RIDGE, mean=MEANS["field"]).is_separable
    orbit = hk.simulate(separable, ASKED[0], [0.0, 1.0], hk.StormerVerlet(), dt=0.1)
    assert jnp.isfinite(orbit.ys).all()


def test_save_keeps_the_mean_and_the_values(tmp_path):
    X, Y = pendulum_data(5, 0)
    data = hk.Velocities(X, Y) + energies(1)[0]
    for name in ("system", "field"):
        field = hk.fit(K, data, regularization=RIDGE, mean=MEANS[name])
        hk.save(tmp_path / name, field)
        loaded = hk.load(tmp_path / name)
        np.testing.assert_array_equal(loaded(ASKED[0]), field(ASKED[0]))
        np.testing.assert_array_equal(loaded.hamiltonian(ASKED[0]), field.hamiltonian(ASKED[0]))
    field = hk.fit(K, X, Y, RIDGE, mean=kinetic)
    hk.save(tmp_path / "own", field)
    with pytest.raises(ValueError, match=r"hk\.load\(path, mean=\.\.\.\)"):
        hk.load(tmp_path / "own")
    loaded = hk.load(tmp_path / "own", mean=kinetic)
    np.testing.assert_array_equal(loaded(ASKED[0]), field(ASKED[0]))
    with pytest.raises(ValueError, match="when it was saved"):
        hk.load(tmp_path / "own", mean=lambda x: 2 * kinetic(x))


# What is refused.

GOOD = velocities(0)[0]
SIX = np.zeros((3, 4, 2))
REFUSED = {
    "Y of another shape": (lambda: hk.Velocities(np.zeros((3, 2)), np.zeros((3, 4))), "must be eq"),
    "all masked": (lambda: hk.Velocities(np.zeros((3, 2)), np.full((3, 2), np.nan)), "all 6 comp"),
    "infinite Y": (lambda: hk.Velocities(np.zeros((1, 2)), [[np.nan, np.inf]]), "Y contains NaN"),
    "zero noise": (lambda: hk.Velocities(GOOD.X, GOOD.Y, 0.0), "noise must be positive"),
    "negative noise": (lambda: hk.Velocities(GOOD.X, GOOD.Y, [1.0, -1.0]), "noise must be pos"),
    "noise of a shape": (lambda: hk.Velocities(GOOD.X, GOOD.Y, np.ones(4)), r"\(2,\) or \(4, 2\)"),
    "energies of a shape": (lambda: hk.Energies(GOOD.X, np.ones((4, 1))), r"E has shape \(4, 1\)"),
    "noise of energies": (lambda: hk.Energies(GOOD.X, np.ones(4), 0.0), "noise must be positive"),
    "equilibria": (lambda: hk.Equilibria(np.zeros((1, 2, 2))), r"X has shape \(1, 2, 2\)"),
    "functionals": (lambda: hk.Functionals(SIX, SIX[:, :2], np.ones(3)), "must be .R, Q, n"),
    "targets": (lambda: hk.Functionals(SIX, SIX + 1, np.ones(2)), "must be .R, Q, n"),
    "zero weights": (
        lambda: hk.Functionals(SIX, SIX + np.array([1, 0, 1])[:, None, None], np.ones(3)),
        "all zero contains no information: leave it out, row 1",
    ),
    "another n": (lambda: GOOD + hk.Equilibria(np.zeros((1, 4))), r"\[2, 4\] coordinates"),
    "one energy": (
        lambda: hk.fit(K, GOOD + hk.Energies(GOOD.X[:1], [1.0]), regularization=RIDGE),
        "there is one energy",
    ),
    "odd n": (lambda: hk.fit(K, hk.Equilibria(np.zeros((1, 3))), regularization=1.0), "even dim"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_sense_is_refused(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call()


def test_energies_of_what_has_no_potential_are_refused():
    data = GOOD + energies(1)[0]
    for kernel in (hk.Separable(hk.Gaussian(1.0)), K + hk.CurlFree(hk.Gaussian(1.0))):
        for solver in (hk.Cholesky(), hk.Nystrom(), hk.ConjugateGradient()):
            with pytest.raises(AttributeError, match="energies were given, and"):
                hk.fit(kernel, data, regularization=RIDGE, solver=solver)
    with pytest.raises(AttributeError, match=r"the mean, .* has no potential"):
        hk.fit(K, data, regularization=RIDGE, mean=kinetic)


def test_arguments_that_do_not_belong_together_are_refused():
    with pytest.raises(TypeError, match="pass λ by name"):
        hk.fit(K, GOOD, 1e-3)
    with pytest.raises(TypeError, match="Y is missing"):
        hk.fit(K, GOOD.X)
    with pytest.raises(ValueError, match=r"mean maps a state of shape \(2,\) to shape \(\)"):
        hk.fit(K, GOOD, regularization=RIDGE, mean=lambda x: x.sum())
    for sum_of in (lambda: GOOD + 1.0, lambda: GOOD + GOOD.X, lambda: np.ones((2, 2)) + GOOD):
        with pytest.raises(TypeError, match=r"only observations add up.*hk\.Velocities\(X, Y\) \+"):
            sum_of()


def test_what_is_not_measured_is_known_inside_jit_where_the_data_is_a_constant():
    X, Y = pendulum_data(8, 0)
    Y = np.where(np.arange(16).reshape(8, 2) == 5, np.nan, Y)
    expected = hk.fit(K, hk.Velocities(X, Y), regularization=RIDGE)(ASKED[0])

    def learned(ridge):
        return hk.fit(K, hk.Velocities(X, Y), regularization=ridge)(ASKED[0])

    np.testing.assert_allclose(jax.jit(learned)(RIDGE), expected, atol=SOLVE)
    with pytest.raises(ValueError, match=r"Y contains NaN or inf in row 2.*hk\.Velocities"):
        jax.jit(lambda ridge: hk.fit(K, X, Y, ridge)(ASKED[0]))(RIDGE)  # while tracing
    traced = eqx.filter_jit(lambda Y: hk.fit(K, hk.Velocities(X, Y), regularization=RIDGE))
    with pytest.raises(RuntimeError, match=r"make hk\.Velocities\(X, Y\) outside of jax\.jit"):
        traced(jnp.asarray(Y))


def test_observations_are_pytrees_that_cross_jit_and_print():
    masked = velocities(0, missing=True)[0]
    field = jax.jit(lambda data: hk.fit(K, data, regularization=RIDGE).coefficients)
    expected = hk.fit(K, masked, regularization=RIDGE).coefficients
    np.testing.assert_allclose(field(masked), expected, atol=SOLVE)
    assert re.search(r"Velocities\(.*\+ Energies\(", repr(masked + energies(0)[0]), re.DOTALL)


# Losses.


def mixed():
    (v, rows_v, _), (e, rows_e, _) = KINDS["masked_and_noisy"](1), KINDS["noisy_energies"](2)
    f, rows_f, _ = KINDS["functionals"](3)
    return v + e + f, Reference(rows_v, rows_e, rows_f), v


# Of 5 velocities, 5 energies and 3 functionals; in the second one fold has all energies.
FOLDS = {"mixed": np.arange(13) % 3, "energies": np.repeat([0, 1, 2, 0, 1], [3, 2, 6, 1, 1])}


@pytest.mark.parametrize("name", FOLDS)
def test_held_out_rows_are_those_of_refits(name):
    data, reference, v = mixed()
    point = np.concatenate([np.asarray(v.kept) // 2, np.arange(5, 13)])  # of each row
    folds = FOLDS[name]
    sigma2 = 13 * (1 - 1 / 3) * RIDGE
    A = reference.matrix(reference.rows, reference.rows) + sigma2 * np.diag(reference.noise**2)
    expected = np.zeros(len(A))
    for fold in range(3):
        out = folds[point] == fold
        # Generalised least squares with the constant, from the rows that are left.
        p, y, C = reference.constant, reference.targets, np.linalg.inv(A[~out][:, ~out])
        across = A[out][:, ~out] @ C
        if p[~out].any():
            off = y - p * (p[~out] @ C @ y[~out]) / (p[~out] @ C @ p[~out])
            expected[out] = off[out] - across @ off[~out]
        else:  # then the constant that suits the energies held out best
            off, weights = y[out] - across @ y[~out], p[out] / reference.noise[out] ** 2
            expected[out] = off - p[out] * (weights @ off) / weights.sum()
    residuals = hk.cross_validation_residuals(K, data, regularization=RIDGE, folds=folds)
    np.testing.assert_allclose(residuals, expected, atol=1e-8)
    squares = (expected / reference.noise) ** 2
    loss = np.mean([squares[folds[point] == fold].mean() for fold in range(3)])
    got = hk.cross_validation_loss(K, data, regularization=RIDGE, folds=folds)
    np.testing.assert_allclose(got, loss, rtol=1e-8)


def test_the_likelihood_and_the_generalised_loss_are_their_closed_forms():
    data, reference, _ = mixed()
    sigma2, y, P = 13 * RIDGE, reference.targets, reference.constant
    A = reference.matrix(reference.rows, reference.rows) + sigma2 * np.diag(reference.noise**2)
    C = reference.projected(sigma2)
    # Under a flat prior of the constant.
    log_det = np.linalg.slogdet(A)[1] + np.log(P @ np.linalg.solve(A, P))
    density = -0.5 * (y @ C @ y + log_det + (len(y) - 1) * np.log(2 * np.pi))
    got = hk.log_marginal_likelihood(K, data, regularization=RIDGE)
    np.testing.assert_allclose(got, density, rtol=1e-9)
    s = reference.noise
    D, free = len(y) - 1, np.trace(C * np.outer(s, s))
    loss = D * np.sum((s * (C @ y)) ** 2) / free**2
    got = hk.generalized_cross_validation(K, data, regularization=RIDGE)
    np.testing.assert_allclose(got, loss, rtol=1e-9)


def test_losses_of_velocities_are_those_of_x_and_y():
    data = velocities(0, N=8)[0]
    for loss in (
        hk.cross_validation_loss,
        hk.generalized_cross_validation,
        hk.log_marginal_likelihood,
    ):
        old = loss(K, data.X, data.Y, RIDGE)
        np.testing.assert_allclose(loss(K, data, regularization=RIDGE), old, rtol=SOLVE)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "loss",
    [hk.cross_validation_loss, hk.generalized_cross_validation, hk.log_marginal_likelihood],
)
def test_derivatives_of_losses_of_observations_are_those_of_differences(loss):
    data, _, _ = mixed()

    def of(h):
        return loss(hk.Symplectic(h * hk.Gaussian(h)), data, regularization=h * RIDGE)

    at, h = jnp.asarray(1.4), 1e-5
    np.testing.assert_allclose(jax.grad(of)(at), (of(at + h) - of(at - h)) / (2 * h), rtol=1e-5)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", FOLDS)
def test_the_noise_of_energies_may_be_learned(name):
    v, e, folds = velocities(1, N=5)[0], energies(2)[0], FOLDS[name][:10]
    direction = np.array([1.0, -0.5, 0.3, 0.2, -1.0])

    def of(h):
        noisy = hk.Energies(e.X, e.E, np.linspace(0.5, 2, 5) + h * direction)
        return hk.cross_validation_loss(K, v + noisy, None, RIDGE, folds)

    of, h = jax.jit(jax.value_and_grad(of)), 1e-5
    slope = (of(h)[0] - of(-h)[0]) / (2 * h)
    np.testing.assert_allclose(of(0.0)[1], slope, rtol=1e-6)
