"""Matrix products whose digits matter ask for all of them.

XLA computes float32 products on a GPU in TF32, with 10 bits of mantissa, unless the program asks
for the highest precision. No GPU is needed to see what a program asks for: the tests below look at
every product that JAX is given while a public function runs, traced or not.
"""

import contextlib
import traceback

import jax
import jax.numpy as jnp
import kernels
import numpy as np
import pytest
from data import swings

import hamkernel as hk

HIGHEST = jax.lax.Precision.HIGHEST


@contextlib.contextmanager
def imprecise_products():
    """A list that collects the places of float products below the highest precision."""
    primitive, places = jax.lax.dot_general_p, []
    bind = primitive.bind

    def spy(*args, **params):
        precision = params["precision"]
        full = precision is not None and all(p == HIGHEST for p in precision)
        if jnp.issubdtype(args[0].dtype, jnp.floating) and not full:
            frames = [f for f in traceback.extract_stack() if "hamkernel" in f.filename]
            places.append([f"{f.filename}:{f.lineno} {f.line}" for f in frames][-3:])
        return bind(*args, **params)

    primitive.bind = spy
    try:
        yield places
    finally:
        del primitive.bind


X, Y = map(jnp.asarray, swings(24))
X4, Y4 = map(jnp.asarray, swings(12, n=4))
LAMBDA = 1e-3
FEATURES = hk.RandomFeatures(50, key=jax.random.key(0))
LANDMARKS = hk.Nystrom(max_points=20)
G = hk.Gaussian(1.0)
K = hk.Symplectic(G)


def posterior_answers():
    posterior = hk.condition(K, X, Y, LAMBDA)
    posterior.deviation(X[0])
    posterior.covariance(X[0], x2=X[1])
    posterior.energy_deviation(X[0], X[1])
    fields = posterior.sample(jax.random.key(0), 2, jnp.array([[-2.0, -2.0], [2.0, 2.0]]))
    jax.vmap(lambda field: field(X[0]))(fields)
    posterior.evaluate(X[:3])
    posterior.updated(X[:3] + 0.1, Y[:3])


def field_answers():
    field = hk.fit(K, X, Y, LAMBDA)
    jax.vmap(field)(X)
    field.evaluate(X)
    field.hamiltonian(X[0])
    jax.jacfwd(field)(X[0])
    jax.grad(field.hamiltonian)(X[0])
    field.anchored(X[0])
    hk.simulate(field, X[0], jnp.linspace(0.0, 1.0, 5))
    hk.simulate(field, X[0], jnp.linspace(0.0, 1.0, 5), solver=hk.ImplicitMidpoint(), dt=0.1)


def observations_of_each_kind():
    data = (
        hk.Velocities(X, Y, noise=0.1)
        + hk.Energies(X[:5], jnp.arange(5.0))
        + hk.Equilibria(jnp.zeros((1, 2)))
        + hk.Functionals(X[None, :3], jnp.ones((1, 3, 2)), jnp.ones(1))
    )
    hk.condition(K, data, regularization=LAMBDA).deviation(X[0])


def other_answers_of_fields():
    K(X[0], X[1])
    turn = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    hk.fit(K, X, Y, LAMBDA, mean=lambda x: turn @ x)(X[0])
    hk.fit(K, X, Y, LAMBDA, mean=hk.kinetic(1.0)).hamiltonian(X[0])
    K_of_law = hk.Symplectic(hk.Shared(G, hk.sites(1), centres=jnp.linspace(-2.0, 2.0, 5)[:, None]))
    posterior = hk.condition(K_of_law, X, Y, LAMBDA)
    posterior.field.law(jnp.ones(1))
    posterior.law_deviation(jnp.ones(1), jnp.zeros(1))


def losses_and_gradients():
    folds = np.arange(24) % 4
    for loss in (
        lambda K: hk.cross_validation_loss(K, X, Y, LAMBDA, folds),
        lambda K: hk.generalized_cross_validation(K, X, Y, LAMBDA),
        lambda K: hk.log_marginal_likelihood(K, X, Y, LAMBDA),
    ):
        of_scale = jax.grad(lambda s, loss=loss: loss(hk.Symplectic(hk.Gaussian(s))))
        jax.eval_shape(of_scale, 1.0)  # traced, and not compiled


def streams():
    for solver in (hk.Nystrom(), FEATURES):
        fit = solver.start(K, X, regularization=LAMBDA)
        fit.add(X, Y).field()(X[0])


def learning():
    ts = jnp.linspace(0.0, 3.0, 16)
    states = np.asarray(hk.simulate(hk.systems.Pendulum(), jnp.array([1.0, 0.0]), ts).ys)
    noise = 0.01 * np.random.default_rng(0).normal(size=states.shape)
    hk.learn(K, hk.Runs([ts], [states + noise]), iterations=2)


SLOW = (
    "learn",
    "tune low rank",
    "other answers",
    "posterior",
    "fields",
    "observations",
    "streams",
)  # 37 s and 18 s: they are traced and compiled anew
CALLS = {
    "fields": field_answers,
    "other answers": other_answers_of_fields,
    "posterior": posterior_answers,
    "observations": observations_of_each_kind,
    "losses": losses_and_gradients,
    "Nystrom": lambda: hk.condition(K, X, Y, LAMBDA, solver=LANDMARKS).deviation(X[0]),
    "RandomFeatures": lambda: hk.fit(K, X, Y, LAMBDA, solver=FEATURES),
    "ConjugateGradient": lambda: hk.fit(K, X, Y, LAMBDA, solver=hk.ConjugateGradient()),
    "streams": streams,
    "product": lambda: hk.gram_operator(K, X).mv(Y),
    "tune": lambda: hk.tune(K, X, Y, LAMBDA, starts=2, max_steps=3),
    "tune low rank": lambda: hk.tune(K, X, Y, LAMBDA, starts=2, max_steps=2, solver=LANDMARKS),
    "molecule": lambda: hk.fit(
        hk.Invariant(hk.CurlFree(hk.Gaussian(1.0)), [jnp.eye(4)[jnp.array([1, 0, 3, 2])]]),
        X4,
        Y4,
        LAMBDA,
    )(X4[0]),
    "friction": lambda: hk.fit(hk.PortHamiltonian(hk.Gaussian(1.0)), X, Y, LAMBDA)(X[0]),
    "check": lambda: hk.check_kernel(hk.Gaussian(1.0), X),
    "readout": lambda: hk.readout(
        hk.condition(K, X, Y, LAMBDA), {"p2": lambda x: x[1] ** 2, "q2": lambda x: x[0] ** 2}
    ),
    "learn": learning,
}


@pytest.mark.filterwarnings("ignore")  # two iterations do not settle, amplitudes are not tuned
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in CALLS]
)
def test_products_of_public_functions_are_in_full_precision(name):
    jax.clear_caches()
    with imprecise_products() as places:
        CALLS[name]()
    assert not places, "\n".join(map(str, places[:5]))


@pytest.mark.parametrize("case", kernels.CASES, ids=str)
def test_products_of_every_kernel_are_in_full_precision(case):
    jax.clear_caches()
    k = case.make(2)
    with imprecise_products() as places:
        jax.eval_shape(lambda X: hk.gram(hk.Symplectic(k), X), X[:3])
    assert not places, "\n".join(map(str, places[:5]))


POINTS3 = jnp.concatenate([X, X[:, :1] ** 2], axis=1)
# A kernel and its data: X, Y, and keywords of `fit`.
STRUCTURES = {
    "curl free": (hk.CurlFree(G), X, Y, {}),
    "divergence free": (hk.DivergenceFree(G), X4, Y4, {}),
    "separable": (hk.Separable(G), X, Y, {}),
    "poisson": (hk.Poisson(G, hk.poisson.rigid_body), POINTS3, POINTS3, {}),
    "structured": (
        hk.Structured(G, lambda x: jnp.array([[0.0, 1.0], [-1.0, -(x[0] ** 2)]])),
        X,
        Y,
        {},
    ),
    "parity": (hk.Reversible(hk.Even(hk.Symplectic(G))), X, Y, {}),
    "sum": (
        hk.Sum(energy=hk.Odd(hk.Symplectic(G)), rest=hk.Friction(0.3, 0.1, rest_speed=0.1)),
        X,
        Y,
        {},
    ),
    "controlled": (
        hk.Controlled(hk.Symplectic(G), hk.InputMatrix(1.0, acts_on=(1,))),
        X,
        Y,
        {"inputs": X[:, :1]},
    ),
    "family": (hk.Family(hk.Symplectic(G), G), X, Y, {"parameters": X[:, :1]}),
    "masses": (hk.UnknownMasses(hk.Symplectic(G), np.array([2.0, 1.0])), X4, Y4, {}),
    "shared": (
        hk.Symplectic(hk.Shared(G, hk.sites(2), centres=jnp.linspace(-2.0, 2.0, 5)[:, None])),
        X4,
        Y4,
        {},
    ),
}


@pytest.mark.few(3)
@pytest.mark.parametrize("name", STRUCTURES)
def test_products_of_every_structure_are_in_full_precision(name):
    jax.clear_caches()
    K, X, Y, more = STRUCTURES[name]

    def loss_and_field(X, Y, ridge):
        if not more:
            return hk.fit(K, X, Y, ridge, throw=False)(X[0]), hk.generalized_cross_validation(
                K, X, Y, ridge
            )
        return hk.fit(K, X, Y, ridge, throw=False, **more).evaluate(X, *more.values())

    with imprecise_products() as places:  # traced, and not compiled
        jax.eval_shape(jax.jacrev(loss_and_field, 2), X, Y, LAMBDA)
    assert not places, "\n".join(map(str, places[:5]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the mass matrix")  # velocities are no torques
def test_products_of_a_machine_are_in_full_precision():
    jax.clear_caches()
    K, (q, v) = hk.Lagrangian(G, G, angles=(0, 1)), jnp.split(X4[0], 2)

    def answers(field, q, v):
        x = jnp.concatenate([q, v])
        of_q = field.mass_matrix, field.mass_matrix_deviation, field.potential, field.gravity
        of_x = field.momentum, field.lagrangian, field.hamiltonian, field.rest_torques
        rest = field.inverse_dynamics(q, v, v), field.torque_deviation(q, v, v)
        rest += field.gravity_deviation(q), field.friction(v), field.energy_deviation(x, 2 * x)
        return [f(q) for f in of_q], [f(x) for f in of_x], rest

    with imprecise_products() as places:
        field = hk.fit(K, X4, X4[:, :2], LAMBDA, accelerations=X4[:, 2:])
        jax.eval_shape(answers, field, q, v)
    assert not places, "\n".join(map(str, places[:5]))


PENDULUM = hk.systems.Pendulum()
SYSTEMS = [
    (hk.systems.Acrobot(), 4),
    (hk.systems.CartPole(), 4),
    (hk.systems.ChargedParticle(), 4),
    (hk.systems.Damped(PENDULUM, 0.1), 2),
    (hk.systems.DoublePendulum(), 4),
    (hk.systems.Duffing(), 2),
    (hk.systems.HarmonicOscillator(), 2),
    (hk.systems.HenonHeiles(), 4),
    (hk.systems.Kepler(), 4),
    (hk.systems.LotkaVolterra(), 2),
    (hk.systems.NBody(), 8),
    (PENDULUM, 2),
    (hk.systems.PointVortices(), 4),
    (hk.systems.RigidBody(), 3),
    (hk.systems.SpringChain(4), 8),
]


def test_products_of_systems_are_in_full_precision():
    jax.clear_caches()
    driven = hk.systems.Driven(PENDULUM, jnp.array([[0.0], [1.0]]))
    with imprecise_products() as places:
        jax.eval_shape(driven, jnp.ones(2), jnp.ones(1))
        for system, n in SYSTEMS:
            jax.eval_shape(system, jnp.arange(1.0, n + 1))
            jax.eval_shape(system.hamiltonian, jnp.arange(1.0, n + 1))
        jax.eval_shape(hk.systems.RigidBody().casimir, jnp.ones(3))
        jax.eval_shape(hk.systems.Damped(PENDULUM, 0.1).dissipation, jnp.ones(2))
    assert not places, "\n".join(map(str, places[:5]))


def test_the_spy_sees_a_product_at_default_precision():
    with imprecise_products() as places:
        jax.jit(lambda x: x @ x)(X[0])
    assert places
