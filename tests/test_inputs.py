"""Fields with inputs: controlled kernels, and simulations that are driven."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel import load, save

G, V = hk.Gaussian(1.3), hk.Gaussian(0.9)
RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(2, 9, 2))
U = RNG.normal(size=(9, 2))
x, u = jnp.asarray(RNG.normal(size=2)), jnp.asarray(RNG.normal(size=2))


def curl_free(x, z, ell=1.3):
    d = (x - z) / ell**2
    return np.exp(-np.sum((x - z) ** 2) / (2 * ell**2)) * (np.eye(2) / ell**2 - np.outer(d, d))


J = np.array([[0.0, 1.0], [-1.0, 0.0]])
PRIORS = {
    "state": (hk.InputMatrix(V, acts_on=(1,)), lambda x, z: np.exp(-np.sum((x - z) ** 2) / 1.62)),
    "constant": (hk.InputMatrix(0.7, acts_on=1), lambda x, z: 0.7),
    "known": (np.array([[0.0, 0.5], [1.0, -0.3]]), lambda x, z: 0.0),
}


def kernel(name):
    return hk.Controlled(hk.Symplectic(G), inputs=PRIORS[name][0])


def formula(name, x, u, z, v):
    """K_f + Σᵢⱼ uᵢ vⱼ K_g,ij with independent entries of G in the second row."""
    return J @ curl_free(x, z) @ J.T + (u @ v) * PRIORS[name][1](x, z) * np.diag([0.0, 1.0])


@pytest.mark.few(2)
@pytest.mark.parametrize("name", PRIORS)
def test_the_fit_is_the_regression_with_the_kernel_of_joined_points(name):
    blocks = [
        [formula(name, a, b, c, d) for c, d in zip(X, U, strict=True)]
        for a, b in zip(X, U, strict=True)
    ]
    gram = np.block(blocks)
    targets = Y - U @ PRIORS["known"][0].T if name == "known" else Y
    A = np.linalg.solve(gram + 9 * 1e-2 * np.eye(18), targets.ravel()).reshape(9, 2)
    field = hk.fit(kernel(name), X, Y, 1e-2, inputs=U)
    np.testing.assert_allclose(field.coefficients, A, rtol=1e-8, atol=1e-9)
    drift = sum(J @ curl_free(np.asarray(x), z) @ J.T @ a for z, a in zip(X, A, strict=True))
    weights = [PRIORS[name][1](np.asarray(x), z) for z in X]
    learned = sum(w * np.outer([0, a[1]], v) for w, a, v in zip(weights, A, U, strict=True))
    matrix = PRIORS["known"][0] if name == "known" else learned
    np.testing.assert_allclose(field.drift(x), drift, atol=1e-10)
    np.testing.assert_allclose(field.input_matrix(x), matrix, atol=1e-10)
    np.testing.assert_allclose(field(x, u), drift + matrix @ np.asarray(u), atol=1e-10)
    np.testing.assert_allclose(field.evaluate(X, U), jax.vmap(field)(X, U), atol=1e-11)
    np.testing.assert_allclose(Y - field.evaluate(X, U), field.residual, atol=1e-10)


@pytest.mark.filterwarnings("ignore:fitting in float32")
def test_digits_are_not_lost_far_from_the_origin():
    def velocity(shift, dtype):
        states = (X + shift).astype(dtype)
        field = hk.fit(kernel("state"), states, Y.astype(dtype), 1e-2, inputs=U.astype(dtype))
        return field.evaluate(states, U.astype(dtype))

    expected = velocity(0.0, float)
    # States of size 1000 are known to 6e-5 in float32, and their squares are not at all.
    np.testing.assert_allclose(velocity(1000.0, np.float32), expected, atol=2e-3)


@pytest.mark.slow
def test_losses_and_solvers_take_inputs():
    K = kernel("state")
    blocks = [
        [formula("state", a, b, c, d) for c, d in zip(X, U, strict=True)]
        for a, b in zip(X, U, strict=True)
    ]
    A = np.block(blocks) + 9 * 1e-2 * np.eye(18)
    y = Y.ravel()
    expected = -0.5 * (y @ np.linalg.solve(A, y) + np.linalg.slogdet(A)[1] + 18 * np.log(2 * np.pi))
    likelihood = hk.log_marginal_likelihood(K, X, Y, 1e-2, inputs=U)
    np.testing.assert_allclose(likelihood, expected, rtol=1e-10)
    # Every point left out in turn, by refitting with the ridge of that fit.
    rest = [np.arange(9) != i for i in range(9)]
    refits = [hk.fit(K, X[r], Y[r], 1e-2, inputs=U[r]) for r in rest]
    left = [Y[i] - np.asarray(f(X[i], U[i])) for i, f in enumerate(refits)]
    residuals = hk.cross_validation_residuals(K, X, Y, 8 / 9 * 9 / 8 * 1e-2, "loo", inputs=U)
    np.testing.assert_allclose(residuals, left, rtol=1e-6, atol=1e-9)
    dense = hk.fit(K, X, Y, 1e-2, inputs=U)(x, u)
    for solver in (hk.ConjugateGradient(), hk.Nystrom(1e-6)):
        other = hk.fit(K, X, Y, 1e-2, inputs=U, solver=solver)(x, u)
        np.testing.assert_allclose(other, dense, atol=1e-6)


def torque(X, U):
    gain = 1 + 0.5 * np.cos(X[:, 0])
    force = -np.sin(X[:, 0]) - 0.1 * X[:, 1] + gain * U[:, 0]
    return np.stack([X[:, 1], force], axis=1)


@pytest.mark.slow
def test_tune_learns_friction_and_input_matrix_together():
    rng = np.random.default_rng(1)
    X, U = rng.uniform(-2.5, 2.5, size=(40, 2)), rng.uniform(-2, 2, size=(40, 1))
    Y = torque(X, U) + 0.01 * rng.normal(size=(40, 2))
    G = hk.InputMatrix(1.0 * hk.Gaussian(2.0), acts_on=(1,))
    K = hk.Controlled(hk.PortHamiltonian(1.0 * hk.Gaussian(2.0), 0.3), inputs=G)
    options = {"objective": "marginal_likelihood", "starts": 2, "max_steps": 100}
    tuned = hk.tune(K, X, Y, inputs=U, **options)
    fresh = rng.uniform(-2.3, 2.3, size=(100, 2)), rng.uniform(-2, 2, size=(100, 1))
    truth = torque(*fresh)
    assert np.linalg.norm(tuned.field.evaluate(*fresh) - truth) < 0.04 * np.linalg.norm(truth)
    assert float(tuned.kernel.drift.friction) == pytest.approx(0.1, abs=0.03)
    assert float(tuned.field.input_matrix(jnp.zeros(2))[1, 0]) == pytest.approx(1.5, abs=0.1)
    assert {"drift.friction", "inputs.kernel.kernel.lengthscale"} <= set(tuned.bounds)


def test_the_drift_keeps_its_structure_and_the_field_has_its_energy_balance():
    K = hk.Controlled(hk.PortHamiltonian(G, 0.3), hk.InputMatrix(V, acts_on=(1,)))
    field = hk.fit(K, X, Y, 1e-2, inputs=U)
    slope = jax.grad(field.hamiltonian)(x)
    power = slope @ field.input_matrix(x) @ u
    np.testing.assert_allclose(slope @ field(x, u), power - field.dissipation(x), atol=1e-12)
    assert field.dissipation(x) >= 0
    assert field.anchored(x).hamiltonian(x) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_array_equal(field.input_matrix(x)[0], 0.0)
    free = hk.fit(hk.Controlled(hk.Separable(G), hk.InputMatrix(V)), X, Y, 1e-2, inputs=U)
    with pytest.raises(AttributeError, match="not Hamiltonian"):
        free.hamiltonian(x)
    assert np.abs(free.input_matrix(x)[0]).max() > 1e-3


def test_saved_fields_come_back(tmp_path):
    file = tmp_path / "field.npz"
    for name in PRIORS:
        field = hk.fit(kernel(name), X, Y, 1e-2, inputs=U)
        save(file, field)
        np.testing.assert_array_equal(load(file)(x, u), field(x, u))

    def own(x, z):
        return jnp.exp(x @ z)

    K = hk.Controlled(hk.Symplectic(own), hk.InputMatrix(own))
    field = hk.fit(K, X, Y, 1e-2, inputs=U)
    save(file, field)
    np.testing.assert_array_equal(load(file, kernel=field.kernel)(x, u), field(x, u))


# Simulation.

TS = np.linspace(1.0, 4.0, 13)
START = np.array([0.3, 0.1])
DRIVEN = hk.systems.Driven(hk.systems.Pendulum(1.0, 1.0, 1.0), [[0.0], [1.0]])
SAMPLES = np.sin(3 * TS)[:, None]


def reference(force):
    """By SciPy, interval by interval, so that no step crosses a jump."""
    ys = [START]
    for i, (a, b) in enumerate(itertools.pairwise(TS)):
        push = force(i)
        done = solve_ivp(
            lambda t, y, push=push: [y[1], -np.sin(y[0]) + push(t)],
            (a, b),
            ys[-1],
            rtol=1e-11,
            atol=1e-12,
        )
        ys.append(done.y[:, -1])
    return np.array(ys)


def linear(i):
    slope = (SAMPLES[i + 1, 0] - SAMPLES[i, 0]) / (TS[i + 1] - TS[i])
    return lambda t: SAMPLES[i, 0] + slope * (t - TS[i])


DRIVES = {
    "function": (lambda t: jnp.array([jnp.sin(3 * t)]), {}, lambda i: lambda t: np.sin(3 * t)),
    "held": (SAMPLES, {}, lambda i: lambda t: SAMPLES[i, 0]),
    "linear": (SAMPLES, {"between": "linear"}, linear),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", DRIVES)
@pytest.mark.parametrize("steps", ["adaptive", "constant"])
def test_driven_trajectories_are_those_of_scipy(name, steps):
    given, options, force = DRIVES[name]
    if steps == "constant":
        options = options | {"solver": diffrax.Dopri5(), "dt": 0.01}
    else:
        options = options | {"rtol": 1e-10, "atol": 1e-10}
    ys = hk.simulate(DRIVEN, START, TS, inputs=given, **options).ys
    np.testing.assert_allclose(ys, reference(force), atol=2e-8)


@pytest.mark.slow
def test_constant_steps_keep_their_order_across_held_inputs():
    """Were the last stage to see the next sample, Dopri5 would be of first order."""
    exact = reference(DRIVES["held"][2])[-1]

    def error(dt):
        options = {"solver": diffrax.Dopri5(), "dt": dt}
        return np.abs(
            hk.simulate(DRIVEN, START, TS, inputs=SAMPLES, **options).ys[-1] - exact
        ).max()

    assert error(0.125) < 1e-5
    assert error(0.25) > 15 * error(0.125)


def test_time_is_an_input():
    def field(x, u):
        return jnp.array([x[1], -x[0] + jnp.cos(2 * u[0])])

    ys = hk.simulate(field, START, TS, inputs=lambda t: jnp.array([t])).ys
    done = solve_ivp(
        lambda t, y: [y[1], -y[0] + np.cos(2 * t)], (1, 4), START, rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(ys[-1], done.y[:, -1], atol=1e-6)


@pytest.mark.slow
def test_learned_fields_are_driven_and_differentiated():
    field = hk.fit(kernel("state"), X, Y, 1e-1, inputs=U)
    ts = np.linspace(0, 0.5, 3)

    def end(size):
        return hk.simulate(field, START, ts, inputs=lambda t: size * jnp.array([1.0, t])).ys[-1, 1]

    slope = (end(1.001) - end(0.999)) / 0.002
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), slope, rtol=1e-5)


# Bad input.

K = kernel("state")


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: hk.fit(K, X, Y), ValueError, "inputs of Velocities are missing"),
        (lambda: hk.tune(K, X, Y), ValueError, "inputs of Velocities are missing"),
        (
            lambda: hk.log_marginal_likelihood(K, X, Y, 1e-2),
            ValueError,
            "inputs of Velocities are missing",
        ),
        (lambda: hk.fit(hk.Symplectic(G), X, Y, inputs=U), TypeError, "takes no inputs"),
        (lambda: hk.fit(K, X, Y, inputs=U[:5]), ValueError, r"shape \(5, 2\).*shape \(9, 2\)"),
        (lambda: hk.fit(K, X, Y, inputs=U.T), ValueError, r"transposed: U\.T"),
        (
            lambda: hk.fit(K, X, Y, inputs=np.ones((9, 1))),
            ValueError,
            "have rank 0 and there are 1",
        ),
        (lambda: hk.fit(K, X, Y, inputs=U[:, [0, 0]]), ValueError, "have rank 1 and there are 2"),
        (lambda: hk.fit(K, X, Y, inputs=U * np.nan), ValueError, "NaN or inf"),
        (lambda: hk.fit(K, U[:, :1], Y, inputs=X), ValueError, "seem to be swapped"),
        (lambda: hk.fit(kernel("known"), X, Y, inputs=U[:, :1]), ValueError, "the kernel 2 inputs"),
        (
            lambda: hk.fit(hk.Controlled(hk.Symplectic(G), hk.InputMatrix(V, 2)), X, Y, inputs=U),
            ValueError,
            "acts_on = .* does not exist",
        ),
        (lambda: hk.Controlled(hk.Symplectic(G), V), TypeError, "hk.InputMatrix"),
        (lambda: hk.Controlled(hk.Symplectic(G), lambda x: x), TypeError, "mean=lambda x, u: G"),
        (lambda: hk.Controlled(hk.Symplectic(G), [1.0, 2.0]), ValueError, "one column"),
        (lambda: hk.Controlled(G, hk.InputMatrix(V)), TypeError, "drift of Controlled"),
        (lambda: hk.InputMatrix(-1.0), ValueError, "variance .* must be positive"),
        (lambda: hk.Odd(K), TypeError, "give them to the drift"),
        (lambda: hk.simulate(DRIVEN, START, TS), ValueError, "inputs=u"),
        (
            lambda: hk.simulate(DRIVEN, START, TS, inputs=SAMPLES[:4]),
            ValueError,
            r"samples \(T, m\)",
        ),
        (
            lambda: hk.simulate(DRIVEN, START, TS, inputs=lambda t: t * V),
            ValueError,
            "one vector u",
        ),
        (lambda: hk.simulate(DRIVEN, START, TS, inputs=[1.0]), ValueError, "A constant input is"),
        (lambda: hk.simulate(DRIVEN, START, TS, inputs=lambda t, x: x), TypeError, "the loop"),
        (
            lambda: hk.simulate(DRIVEN.drift, START, TS, inputs=SAMPLES),
            TypeError,
            r"takes \(x\); with inputs",
        ),
        (
            lambda: hk.simulate(DRIVEN, START, TS, inputs=SAMPLES, between="spline"),
            ValueError,
            "'held' or 'linear'",
        ),
        (
            lambda: hk.simulate(
                DRIVEN, START, TS, hk.ImplicitMidpoint(), 0.1, inputs=lambda t: jnp.array([t])
            ),
            ValueError,
            "ImplicitMidpoint is symplectic",
        ),
    ],
)
def test_what_cannot_be_is_refused(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_a_field_says_what_it_needs():
    field = hk.fit(kernel("state"), X, Y, 1e-2, inputs=U)
    with pytest.raises(ValueError, match="needs its inputs"):
        field(x)
    one = hk.fit(kernel("state"), X, Y, 1e-2, inputs=U[:, :1])
    with pytest.raises(ValueError, match="x and u are swapped"):
        one(u[:1], x)
    with pytest.raises(ValueError, match="X and U are swapped"):
        one.evaluate(U[:, :1], X)
    with pytest.raises(KeyError, match="no part 'friction': Symplectic is not a sum"):
        field.part("friction")
    with pytest.raises(ValueError, match="needs the inputs of every state"):
        field.evaluate(X)
    with pytest.raises(ValueError, match=r"field\.drift"):
        hk.simulate(field, START, TS)
    np.testing.assert_allclose(hk.simulate(field.drift, START, TS).ys[0], START)


def test_a_constant_input_is_no_harm_where_the_matrix_is_known():
    K = hk.Controlled(hk.Symplectic(G), [[0.0], [1.0]])
    field = hk.fit(K, X, Y, 1e-2, inputs=np.ones((9, 1)))
    shifted = hk.fit(hk.Symplectic(G), X, Y - np.array([0.0, 1.0]), 1e-2)
    np.testing.assert_allclose(field.drift(x), shifted(x), atol=1e-12)
