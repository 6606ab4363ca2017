"""Families of systems: the kernel k(θ, ϑ) K(x, z) against NumPy, and its members as fields of K."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel import load, save
from hamkernel._tuning.space import hyperparameters

RNG = np.random.default_rng(0)
N, LAMBDA = 9, 1e-2
X, Y = RNG.normal(size=(2, N, 2))
THETA = RNG.normal(size=(N, 1))
x, z, theta = (jnp.asarray(RNG.normal(size=size)) for size in (2, 2, 1))
J = np.array([[0.0, 1.0], [-1.0, 0.0]])
SMOOTH, ALIKE = hk.Gaussian(1.3), hk.Gaussian(0.7)
K = hk.Family(hk.Symplectic(SMOOTH), ALIKE)
# H = T(p) + U(q; θ): one part for all members, and one that depends on θ.
PARTS = hk.Symplectic(hk.Select(SMOOTH, 1)) + hk.Family(hk.Symplectic(hk.Select(SMOOTH, 0)), ALIKE)


def symplectic(x, z):
    d = (x - z) / 1.3**2
    second = np.exp(-np.sum((x - z) ** 2) / 3.38) * (np.eye(2) / 1.3**2 - np.outer(d, d))
    return J @ second @ J.T


def of_one(x, z, c):
    """Symplectic(Select(SMOOTH, c)), which moves the other coordinate alone."""
    d = (x[c] - z[c]) / 1.3
    second = np.exp(-(d**2) / 2) * (1 - d**2) / 1.3**2
    return second * np.diag(np.eye(2)[1 - c])


def alike(t, s):
    return np.exp(-np.sum((t - s) ** 2) / (2 * 0.7**2))


FORMULAS = {
    "one": (K, lambda x, t, z, s: alike(t, s) * symplectic(x, z)),
    "parts": (PARTS, lambda x, t, z, s: of_one(x, z, 1) + alike(t, s) * of_one(x, z, 0)),
}


def gram(formula, X, T, Z, S):
    rows = [
        [formula(a, t, b, s) for b, s in zip(Z, S, strict=True)] for a, t in zip(X, T, strict=True)
    ]
    return np.block(rows)


@pytest.fixture(scope="module")
def fields():
    return {name: hk.fit(FORMULAS[name][0], X, Y, LAMBDA, parameters=THETA) for name in FORMULAS}


@pytest.mark.parametrize("name", FORMULAS)
def test_the_fit_is_the_regression_with_k_times_K(fields, name):
    formula = FORMULAS[name][1]
    A = gram(formula, X, THETA, X, THETA) + N * LAMBDA * np.eye(2 * N)
    coefficients = np.linalg.solve(A, Y.ravel())
    field = fields[name]
    np.testing.assert_allclose(field.coefficients.ravel(), coefficients, rtol=1e-8, atol=1e-9)
    there = gram(formula, [x], [theta], X, THETA) @ coefficients
    np.testing.assert_allclose(field(x, theta), there, atol=1e-10)
    np.testing.assert_allclose(Y - field.evaluate(X, THETA), field.residual, atol=1e-10)
    likelihood = -0.5 * (Y.ravel() @ coefficients + np.linalg.slogdet(2 * np.pi * A)[1])
    found = hk.log_marginal_likelihood(FORMULAS[name][0], X, Y, LAMBDA, parameters=THETA)
    assert found == pytest.approx(likelihood, rel=1e-10)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", FORMULAS)
def test_a_member_is_an_ordinary_field_with_its_structure(fields, name):
    field = fields[name]
    member = field.at(theta)
    np.testing.assert_allclose(member(x), field(x, theta), atol=1e-10)
    np.testing.assert_allclose(member.evaluate(X), [field(a, theta) for a in X], atol=1e-10)
    np.testing.assert_allclose(J @ jax.grad(member.hamiltonian)(x), member(x), atol=1e-12)
    assert member.anchored(x).hamiltonian(x) == pytest.approx(0.0, abs=1e-12)
    assert member.kernel.symplectic
    assert member.is_separable == (name == "parts")
    orbit = hk.simulate(member, x, jnp.linspace(0.0, 3.0, 7)).ys
    energies = jax.vmap(member.hamiltonian)(orbit)
    assert np.ptp(energies) < 1e-6 * max(1.0, np.abs(energies).max())


def test_without_structure_members_have_no_hamiltonian():
    free = hk.fit(hk.Family(hk.Separable(SMOOTH), ALIKE), X, Y, LAMBDA, parameters=THETA)
    with pytest.raises(AttributeError, match="not Hamiltonian"):
        free.at(theta).hamiltonian(x)
    slopes = J.T @ jax.jacfwd(free.at(theta))(x)  # a Hessian if there were an H
    assert np.abs(slopes - slopes.T).max() > 1e-2


def test_the_parts_of_a_member_add_up_and_a_term_without_parameters_is_shared(fields):
    one, other = (fields["parts"].at(t) for t in (theta, theta + 0.5))
    np.testing.assert_allclose(one.part(0)(x) + one.part(1)(x), one(x), atol=1e-12)
    np.testing.assert_array_equal(one.part(0)(x), other.part(0)(x))
    assert np.abs(one.part(1)(x) - other.part(1)(x)).max() > 1e-3
    squares = [float(one.part(i).norm) ** 2 for i in (0, 1)]
    assert float(one.norm) == pytest.approx(np.sqrt(sum(squares)), rel=1e-12)


def test_the_norm_of_a_member_is_that_of_its_expansion(fields):
    member = fields["one"].at(theta)
    a = np.asarray(member.coefficients).ravel()
    G = gram(lambda x, t, z, s: symplectic(x, z), X, THETA, X, THETA)
    assert float(member.norm) == pytest.approx(np.sqrt(a @ G @ a), rel=1e-10)


def test_it_is_the_poisson_kernel_on_states_and_parameters(fields):
    """Π = diag(J, 0) moves x alone, and the velocity of θ was not measured."""
    tensor = jnp.zeros((3, 3)).at[0, 1].set(1.0).at[1, 0].set(-1.0)
    Q = hk.Poisson(hk.Gaussian(jnp.array([1.3, 1.3, 0.7])), lambda s: tensor)
    unseen = np.concatenate([Y, np.full((N, 1), np.nan)], axis=1)
    data = hk.Velocities(np.concatenate([X, THETA], axis=1), unseen)
    other = hk.fit(Q, data, regularization=LAMBDA)(jnp.concatenate([x, theta]))
    np.testing.assert_allclose(fields["one"](x, theta), other[:2], atol=1e-9)


@pytest.mark.slow
def test_solvers_losses_and_observations_take_parameters(fields):
    dense = fields["one"](x, theta)
    for solver in (hk.ConjugateGradient(), hk.Nystrom(1e-6)):
        other = hk.fit(K, X, Y, LAMBDA, parameters=THETA, solver=solver)(x, theta)
        np.testing.assert_allclose(other, dense, atol=1e-6)
    data = hk.Velocities(X, Y, parameters=THETA)
    np.testing.assert_allclose(hk.fit(K, data, regularization=LAMBDA)(x, theta), dense, atol=1e-12)
    # One point left out at a time, by refitting with the ridge of that fit.
    left = hk.cross_validation_residuals(K, X, Y, LAMBDA, "loo", parameters=THETA)
    rest = np.arange(N) != 0
    refit = hk.fit(K, X[rest], Y[rest], LAMBDA, parameters=THETA[rest])
    np.testing.assert_allclose(left[0], Y[0] - refit(X[0], THETA[0]), rtol=1e-6, atol=1e-9)


def test_a_mean_may_depend_on_the_member():
    def mean(x, t):
        return jnp.array([x[1], -t[0] * x[0]])

    field = hk.fit(K, X, Y, LAMBDA, parameters=THETA, mean=mean)
    less = Y - np.array([mean(a, t) for a, t in zip(X, THETA, strict=True)])
    rest = hk.fit(K, X, less, LAMBDA, parameters=THETA)
    np.testing.assert_allclose(field(x, theta), rest(x, theta) + mean(x, theta), atol=1e-10)
    np.testing.assert_allclose(field.at(theta)(x), field(x, theta), atol=1e-12)
    with pytest.raises(AttributeError, match="has no potential of the structure"):
        field.at(theta).hamiltonian(x)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the amplitude")
def test_the_deviation_is_that_of_the_gaussian_process_and_grows_outside_of_the_range():
    posterior = hk.condition(K, X, Y, LAMBDA, parameters=THETA)
    formula = FORMULAS["one"][1]
    A = gram(formula, X, THETA, X, THETA) + N * LAMBDA * np.eye(2 * N)
    c = gram(formula, [x], [theta], X, THETA)
    expected = symplectic(x, x) - c @ np.linalg.solve(A, c.T)
    np.testing.assert_allclose(posterior.covariance(x, theta), expected, atol=1e-12)
    inside = posterior.deviation(X[0], THETA[0])
    away = [np.asarray(posterior.deviation(X[0], THETA.max(axis=0) + d)) for d in (0.7, 1.4, 7.0)]
    sizes = [np.linalg.norm(d) for d in (inside, *away)]
    assert sizes == sorted(sizes)
    np.testing.assert_allclose(away[-1], np.sqrt(np.diag(symplectic(x, x))), rtol=1e-6)
    # The potential of differences: J ∂∂ᵀ Cov(H) Jᵀ is the covariance of f.
    step = 1e-4
    shift = jnp.array([step, 0.0])
    slope = posterior.energy_deviation(x + shift, x - shift, theta) / (2 * step)
    assert slope == pytest.approx(float(posterior.deviation(x, theta)[1]), rel=1e-5)
    half = hk.condition(K, X[:5], Y[:5], LAMBDA * N / 5, parameters=THETA[:5])
    both = half.updated(X[5:], Y[5:], parameters=THETA[5:])
    np.testing.assert_allclose(both.deviation(x, theta), np.sqrt(np.diag(expected)), atol=1e-10)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the amplitude")
def test_draws_have_the_spread_of_the_posterior_and_members_of_their_own():
    posterior = hk.condition(K, X, Y, LAMBDA, parameters=THETA)
    draws = posterior.sample(jax.random.key(0), 200, jnp.array([[-2.0, -2.0], [2.0, 2.0]]))
    values = np.asarray(jax.vmap(lambda f: f(X[0], THETA[1]))(draws))
    np.testing.assert_allclose(values.std(axis=0), posterior.deviation(X[0], THETA[1]), rtol=0.2)
    one = jax.tree.map(lambda leaf: leaf[0], eqx.filter(draws, eqx.is_array))
    one = eqx.combine(one, draws)
    np.testing.assert_allclose(one.at(THETA[1])(X[0]), values[0], atol=1e-9)


def test_new_parameters_do_not_compile_anew(fields):
    field, traces = fields["one"], []

    @jax.jit
    def velocity(theta):
        traces.append(None)
        return field.at(theta)(x)

    for t in (0.1, 0.2, 0.3):
        np.testing.assert_allclose(velocity(jnp.array([t])), field(x, jnp.array([t])), atol=1e-10)

    @jax.jit
    def refitted(T):
        traces.append(None)
        return hk.fit(K, X, Y, LAMBDA, parameters=T)(x, theta)

    for shift in (0.0, 1.0):
        refitted(jnp.asarray(THETA + shift))
    assert len(traces) == 2


def test_saved_families_and_members_come_back_and_a_member_exports(fields, tmp_path):
    file = tmp_path / "field.npz"
    for field in fields.values():
        save(file, field)
        np.testing.assert_array_equal(load(file)(x, theta), field(x, theta))
        save(file, field.at(theta))
        np.testing.assert_array_equal(load(file)(x), field.at(theta)(x))
    exported = jax.export.export(jax.jit(fields["one"]))(x, theta)
    again = jax.export.deserialize(exported.serialize())
    np.testing.assert_allclose(again.call(x, theta), fields["one"](x, theta), atol=1e-12)


def test_the_bounds_of_a_lengthscale_of_the_parameters_follow_the_parameters():
    def box(factor):
        S = jnp.asarray(np.concatenate([X, factor * THETA], axis=1))
        found = hyperparameters(K.with_count(1), S, 1.0, S)
        return {p.name: np.array([p.low, p.high]) for p in found}

    small, large = box(1.0), box(1000.0)
    name = "parameters.lengthscale"
    np.testing.assert_allclose(large[name] - small[name], np.log(1000.0), rtol=1e-12)
    for other in small.keys() - {name}:
        np.testing.assert_array_equal(large[other], small[other])
    extent = np.ptp(THETA)
    np.testing.assert_allclose(np.exp(small[name]), [0.3 * extent / N, 30 * extent], rtol=1e-12)


def test_a_hamiltonian_that_changes_with_time_is_followed(fields):
    """θ is the time: H(x, t)."""
    field, ts = fields["one"], jnp.linspace(0.0, 1.0, 5)
    found = hk.simulate(field, x, ts, inputs=lambda t: jnp.array([t])).ys
    velocity = jax.jit(lambda t, x: field(x, jnp.array([t])))
    expected = solve_ivp(velocity, (0, 1), x, t_eval=ts, rtol=1e-9, atol=1e-10).y.T
    np.testing.assert_allclose(found, expected, atol=1e-5)


RUNS = ([np.arange(3.0)] * 2, [X[:3], X[3:6]])
TWICE = np.repeat(THETA[:1], N, axis=0)


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.fit(K, X, Y), ValueError, "parameters of Velocities are missing: a Family"),
        (lambda: hk.fit(K, X, Y, inputs=THETA), TypeError, "Family takes parameters, and inputs"),
        (
            lambda: hk.fit(hk.Symplectic(SMOOTH), X, Y, parameters=THETA),
            TypeError,
            r"hk.Family\(K, k\) for the parameters of a family",
        ),
        (
            lambda: hk.fit(K, X, Y, parameters=THETA, inputs=THETA),
            TypeError,
            "inputs and parameters were both given",
        ),
        (lambda: hk.fit(K, X, Y, parameters=THETA[:4]), ValueError, "one row of parameters for"),
        (lambda: hk.fit(K, X, Y, parameters=THETA.T), ValueError, r"transposed: Θ.T"),
        (lambda: hk.fit(K, X, Y, parameters=THETA * np.nan), ValueError, "parameters"),
        (lambda: hk.fit(K, X, Y, parameters=TWICE), ValueError, "one system and no family"),
        (
            lambda: hk.fit(K, X, Y, parameters=np.concatenate([THETA, TWICE], axis=1)),
            ValueError,
            r"parameters\[:, 1\] is .* at all points",
        ),
        (
            lambda: hk.fit(
                K,
                hk.Velocities(X, Y, parameters=THETA) + hk.Energies(X, Y[:, 0]),
                regularization=1e-2,
            ),
            ValueError,
            "each member of a family has another constant",
        ),
        (lambda: hk.Family(SMOOTH, ALIKE), TypeError, "must be a matrix-valued kernel"),
        (lambda: hk.Family(K, ALIKE), TypeError, "takes inputs or parameters: put"),
        (lambda: hk.Controlled(K, hk.InputMatrix(1.0)), TypeError, "parameters itself"),
        (lambda: hk.Family(hk.Symplectic(SMOOTH), 2), TypeError, "a scalar kernel is needed"),
        (lambda: hk.Odd(K), TypeError, "give them to the members"),
        (lambda: hk.fit(K, X[:, :1], Y[:, :1], parameters=THETA), ValueError, "even"),
        (lambda: hk.Runs(*RUNS, parameters=[0.5]), ValueError, "there are 2 runs"),
        (lambda: hk.Runs(*RUNS, parameters=[(0.5,), (1.0, 2.0)]), ValueError, "with one p"),
        (
            lambda: hk.Runs(*RUNS, [X[:3], X[:3]], parameters=[(0.5,), (1.0,)]),
            TypeError,
            "runs have inputs or parameters",
        ),
        (lambda: hk.learn(K, hk.Runs(*RUNS)), TypeError, "of which system each run is"),
        (
            lambda: hk.learn(hk.Symplectic(SMOOTH), hk.Runs(*RUNS, parameters=[(0.5,), (1.0,)])),
            TypeError,
            "the runs have parameters and Symplectic takes none",
        ),
        (
            lambda: hk.learn(K, hk.Runs(*RUNS, parameters=[(0.5,), (0.5,)])),
            ValueError,
            "one system and no family",
        ),
    ],
)
def test_what_cannot_be_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_a_family_asks_for_its_parameters_and_says_where_its_energy_is(fields):
    field = fields["one"]
    with pytest.raises(ValueError, match=r"needs its parameters.*field.at\(θ\)"):
        field(x)
    np.testing.assert_array_equal(field.at(0.5)(x), field.at([0.5])(x))
    with pytest.raises(ValueError, match=r"shape \(1,\) is needed"):
        field.at([0.5, 0.6])
    for ask in (lambda: field.hamiltonian(x), lambda: field.potential(x)):
        with pytest.raises(AttributeError, match=r"field.at\(θ\).hamiltonian"):
            ask()
    with pytest.raises(KeyError, match=r"field\.at"):
        field.part(0)
    with pytest.raises(ValueError, match=r"field.at\(θ\)"):
        hk.simulate(field, x, jnp.linspace(0.0, 1.0, 3))
    assert not hasattr(field, "drift")


@pytest.mark.slow
def test_eight_short_runs_of_eight_pendulums_tell_of_a_ninth():
    rng = np.random.default_rng(0)
    lengths, ts = np.linspace(0.5, 1.5, 8), np.linspace(0.0, 3.0, 31)

    def velocity(t, x, length):
        return [x[1] / length**2, -9.81 * length * np.sin(x[0])]

    def run(length):
        start = [rng.uniform(0.5, 2.2), 0.0]
        path = solve_ivp(velocity, (0, 3), start, t_eval=ts, args=(length,), rtol=1e-9).y.T
        return path + 0.01 * path.std(axis=0) * rng.normal(size=path.shape)

    runs = hk.Runs([ts] * 8, [run(a) for a in lengths], parameters=[(a,) for a in lengths])
    learned = hk.learn(hk.Family(hk.Odd(hk.Symplectic(hk.Gaussian(2.0))), hk.Gaussian(1.0)), runs)
    fresh = rng.uniform(-1, 1, size=(200, 2)) * [2.0, 1.5]
    truth = np.array([velocity(0, a, 0.83) for a in fresh])
    found = learned.field.at([0.83]).evaluate(fresh)
    assert np.linalg.norm(found - truth) < 0.02 * np.linalg.norm(truth)  # .0096 here
    deviation = jax.vmap(lambda a: learned.posterior.deviation(a, jnp.array([0.83])))
    assert np.linalg.norm(found - truth) < 4 * np.linalg.norm(deviation(jnp.asarray(fresh)))
