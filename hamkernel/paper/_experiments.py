"""The experiments of the paper with its published numbers, their tests, and their tuning.

The paper minimises the k-fold cross-validation error over σ and λ by a grid search, but gives
neither k nor the grid. We take k = 5 and `GRID`, whose range contains all published values. The
search refits for every fold, in one compiled program per data set, which is faster than a loop.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel._closed_forms import Partition
from hamkernel._fields.expansions import KernelField
from hamkernel._gram import assemble, plus_ridge
from hamkernel._kernels.built_in import Gaussian
from hamkernel._simulate import simulate
from hamkernel._solvers.factors import solution
from hamkernel._solvers.fit import fit
from hamkernel._structures.base import AbstractMatrixKernel, Odd
from hamkernel._structures.structure import Separable, Symplectic
from hamkernel._tuning.tune import tune
from hamkernel.systems import AbstractHamiltonianSystem, HarmonicOscillator, Pendulum, sample

# The regularization λ_fit of `fit` in each reading of the paper's λ; the ridge of `fit` is N λ_fit.
READINGS: Mapping[str, Callable[[float, int], float]] = {
    "lambda": lambda regularization, N: regularization / N,
    "N*lambda": lambda regularization, N: regularization,
}

STRUCTURES: Mapping[str, Callable[[Gaussian], AbstractMatrixKernel]] = {
    "separable": Separable,
    "symplectic": Symplectic,
    "odd_symplectic": lambda k: Odd(Symplectic(k)),
}


@dataclasses.dataclass(frozen=True)
class Model:
    """A structure on a Gaussian kernel, with the hyperparameters of the paper.

    Attributes:
        structure: a key of `STRUCTURES`.
        lengthscale: σ of the Gaussian.
        regularization: λ.
    """

    structure: str
    lengthscale: float
    regularization: float

    @property
    def kernel(self) -> AbstractMatrixKernel:
        """The matrix-valued kernel."""
        return STRUCTURES[self.structure](Gaussian(self.lengthscale))


@dataclasses.dataclass(frozen=True)
class Published:
    """The numbers of tables I and II of the paper for one system, from a single noise seed."""

    odd_error_mean: float
    odd_error_variance: float
    true_hamiltonian_mean: float
    true_hamiltonian_variance: float
    learned_hamiltonian_mean: float
    learned_hamiltonian_variance: float


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A system, its data, the models and their test.

    Attributes:
        title: the name in reports.
        system: the true system.
        initial_states: the initial states of the trajectories in the data.
        step: the sampling interval [s].
        count: the number of data points on each trajectory.
        noise: the standard deviation of the noise on states and velocities.
        test_state: the initial state of the test trajectory.
        horizon: the duration of the test trajectory [s].
        box: (q limits, p limits) of the portraits; the odd error is sampled in its right half.
        units: the units of q and p.
        models: the models by name.
        published: the numbers of the paper.
    """

    title: str
    system: AbstractHamiltonianSystem
    initial_states: tuple[tuple[float, float], ...]
    step: float
    count: int
    noise: float
    test_state: tuple[float, float]
    horizon: float
    box: tuple[tuple[float, float], tuple[float, float]]
    units: tuple[str, str]
    models: Mapping[str, Model]
    published: Published

    @property
    def size(self) -> int:
        """The number N of data points."""
        return len(self.initial_states) * self.count


def experiments() -> dict[str, Experiment]:
    """Return the paper's experiments by name, the pendulum with both masses.

    Source: Smith & Egeland (2023), section Experiments. The paper does not evaluate the symplectic
        kernel without the odd symmetry; we give it σ and λ of the odd symplectic kernel.
    """
    oscillator = Experiment(
        title="Harmonic oscillator",
        system=HarmonicOscillator(mass=0.5, stiffness=1.0),
        initial_states=((1.0, 0.0), (2.25, 0.0), (3.5, 0.0)),
        step=0.25,
        count=5,
        noise=0.1,
        test_state=(2.0, 0.0),
        horizon=4.0,
        box=((-4.0, 4.0), (-4.0, 4.0)),
        units=("m", "kg m/s"),
        models=_models(separable=(19.5, 1e-4), odd_symplectic=(12.1, 1e-4)),
        published=Published(0.65, 0.08, 1.99, 5.43e-9, -108.54, 6.24e-9),
    )
    return {"harmonic_oscillator": oscillator} | {
        f"pendulum_m{mass:g}": _pendulum(mass) for mass in (0.5, 1.0)
    }


def _pendulum(mass: float) -> Experiment:
    return Experiment(
        title=f"Pendulum, m = {mass:g} kg",
        system=Pendulum(mass=mass, length=1.0, gravity=9.81),
        initial_states=((0.4 * math.pi, 0.0), (0.8 * math.pi, 0.0), (0.95 * math.pi, -4.0)),
        step=0.1,
        count=8,
        noise=0.01,
        test_state=(math.pi / 2, 0.0),
        horizon=2.0,
        box=((-math.pi, math.pi), (-8.0, 8.0)),
        units=("rad", "kg m²/s"),
        models=_models(separable=(12.3, 0.1), odd_symplectic=(3.0, 1e-4)),
        published=Published(7.87, 1.49, 9.81, 2.2e-6, -16.85, 1.34e-6),
    )


def _models(**published: tuple[float, float]) -> dict[str, Model]:
    published["symplectic"] = published["odd_symplectic"]
    return {structure: Model(structure, *published[structure]) for structure in STRUCTURES}


_TIMES = 100  # steps of the test trajectory


class Outcome(eqx.Module):
    """The tests of one kernel on S seeds.

    Attributes:
        ts: times of the test trajectory [s], shape (T,).
        true: the test trajectory of the true system, shape (T, n).
        true_orbits: orbits of the true system from the initial states of the data, over the longer
            time of the phase portraits, shape (B, P, n).
        learned: the test trajectory of each learned field, shape (S, T, n).
        error: the distance ‖learned − true‖, shape (S, T).
        quantities: numbers by name, each of shape (S,).
        field: the field learned from the first seed; its `points` are the measured states.
        orbits: the orbits of this field from the same initial states, shape (B, P, n).
    """

    ts: Float[Array, " T"]
    true: Float[Array, "T n"]
    true_orbits: Float[Array, "B P n"]
    learned: Float[Array, "S T n"]
    error: Float[Array, "S T"]
    quantities: dict[str, Float[Array, " S"]]
    field: KernelField
    orbits: Float[Array, "B P n"]


def datasets(
    experiment: Experiment, keys: Key[Array, " S"]
) -> tuple[Float[Array, "S N n"], Float[Array, "S N n"]]:
    """Return states and velocities for each noise key, shape (S, N, n), by trajectory.

    Args:
        experiment: the system and its sampling.
        keys: one key for each seed, shape (S,).
    """
    ts = experiment.step * jnp.arange(experiment.count, dtype=float)
    x0 = jnp.asarray(experiment.initial_states)
    return _datasets(experiment.system, x0, ts, jnp.asarray(experiment.noise), keys)


@eqx.filter_jit
def _datasets(system, x0, ts, noise, keys):
    X, Y = jax.vmap(lambda key: sample(system, x0, ts, noise, noise, key=key))(keys)
    S, _, _, n = X.shape  # (S, B, T, n)
    return X.reshape(S, -1, n), Y.reshape(S, -1, n)  # (S, N, n)


def evaluate(
    experiment: Experiment,
    kernel: AbstractMatrixKernel,
    X: Float[Array, "S N n"],
    Y: Float[Array, "S N n"],
    regularization: ArrayLike,
    *,
    tolerance: float = 1e-10,
) -> Outcome:
    """Fit `kernel` to every data set and test the learned fields.

    The quantities are:

    - The mean and maximum of the trajectory error over the test horizon.
    - The mean and variance of the odd error ‖f(x) + f(−x)‖ over the sampled points.
    - The mean and variance of the true Hamiltonian on the true test trajectory. If the field has a
      Hamiltonian, also its mean and variance on the learned trajectory, with the constant of the
      representer.

    Args:
        experiment: the system and its test.
        kernel: the matrix-valued kernel. If `regularization` has the shape (S,), a batch of kernels
            whose leaves have a leading axis S, one for each data set.
        X: states, shape (S, N, n), of `datasets`.
        Y: velocities, shape (S, N, n).
        regularization: the λ of `fit`, shape () for all data sets or (S,).
        tolerance: the relative and absolute tolerance of the integrator.

    Raises:
        RuntimeError: a fit or an integration failed.
    """
    (low_q, high_q), (low_p, high_p) = experiment.box
    corner, opposite = jnp.asarray([max(low_q, 0.0), low_p]), jnp.asarray([high_q, high_p])
    # As many points as in the paper, the same for every kernel and seed.
    uniform = jax.random.uniform(jax.random.key(2023), (10_000, 2))
    step = experiment.horizon / _TIMES
    # The orbits of the portraits last 2.25 test horizons, about two turns.
    ts = step * jnp.arange(round(2.25 * _TIMES) + 1, dtype=X.dtype)
    starts = jnp.asarray([experiment.test_state, *experiment.initial_states])
    accuracy = jnp.asarray(tolerance, X.dtype)
    true, energy = _truth(experiment.system, starts, ts, accuracy)
    points = corner[None] + uniform * (opposite - corner)[None]
    ridge = jnp.asarray(regularization, X.dtype)
    if not ridge.ndim:  # the same hyperparameters for all data sets
        kernel, ridge = jax.tree.map(lambda a: jnp.stack([a] * len(X)), (kernel, ridge))
    fields = _map_batches(_batch_of_fits, (kernel, X, Y, ridge))
    learned, error, quantities = _map_batches(
        lambda batch: _tests(batch, ts, true, points, accuracy), _pad(fields)
    )
    test = slice(_TIMES + 1)
    return Outcome(
        ts=ts[test],
        true=true[0, test],
        true_orbits=true[1:],
        learned=learned[:, 0, test],
        error=error,
        quantities=quantities | {name: jnp.full(len(X), value) for name, value in energy.items()},
        field=jax.tree.map(lambda leaf: leaf[0], fields),
        orbits=learned[0, 1:],
    )


@eqx.filter_jit
def _batch_of_fits(kernels_and_data) -> KernelField:
    return jax.vmap(fit)(*kernels_and_data)


def _pad(fields: KernelField) -> KernelField:
    """The same fields, padded with points of weight zero, so that XLA compiles one program."""
    extra = -fields.points.shape[1] % 24

    def longer(a: Float[Array, "S N n"]) -> Float[Array, "S M n"]:
        return jnp.pad(a, ((0, 0), (0, extra), (0, 0)))

    parts = longer(fields.points), longer(fields.coefficients), longer(fields.residual)
    return eqx.tree_at(lambda f: (f.points, f.coefficients, f.residual), fields, parts)


def _map_batches(fn: Callable, seeds):
    """The PyTree fn(seeds), computed for 20 of the S seeds on the leading axis at a time."""
    S = len(jax.tree.leaves(seeds)[0])
    batch = min(20, S)
    parts = []
    for start in range(0, S, batch):
        # We fill the last batch up with the last seed, so that all batches have one size.
        rows = np.minimum(np.arange(start, start + batch), S - 1)
        parts.append(fn(jax.tree.map(lambda a, rows=rows: a[rows], seeds)))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:S], *parts)


@eqx.filter_jit
def _truth(
    system, starts: Float[Array, "B n"], ts: Float[Array, " P"], tolerance: Float[Array, ""]
) -> tuple[Float[Array, "B P n"], dict[str, Float[Array, ""]]]:
    true = _test_trajectories(system, starts, ts, tolerance)
    energy = jax.vmap(system.hamiltonian)(true[0, : _TIMES + 1])
    return true, _moments("true_hamiltonian", energy)


@eqx.filter_jit
def _test_trajectories(
    field: Callable[[Array], Array],
    starts: Float[Array, "B n"],
    ts: Float[Array, " P"],
    tolerance: Float[Array, ""],
) -> Float[Array, "B P n"]:
    # We need no gradients, and a loop without checkpoints compiles faster.
    options: Any = dict(rtol=tolerance, atol=tolerance, adjoint=diffrax.ForwardMode())
    return jax.vmap(lambda x0: cast(Array, simulate(field, x0, ts, **options).ys))(starts)


@eqx.filter_jit
def _tests(fields: KernelField, ts, true, points, tolerance):
    """The trajectories (S, B, P, n), error (S, T) and quantities of S fields.

    The first row of `true` (B, P, n) is the test trajectory; the other rows are orbits.
    """
    test = slice(_TIMES + 1)

    def one(field):
        learned = _test_trajectories(field, true[:, 0], ts, tolerance)
        error = jnp.linalg.norm(learned[0, test] - true[0, test], axis=1)
        quantities = {
            "trajectory_error_mean": error.mean(),
            "trajectory_error_max": error.max(),
        }
        if field.kernel.symplectic:
            energy = jax.vmap(field.unanchored_potential)(learned[0, test])
            quantities |= _moments("learned_hamiltonian", energy)
        return learned, error, quantities

    def odd_error(field):
        values = jax.vmap(field)(jnp.concatenate([points, -points]))
        total = values[: len(points)] + values[len(points) :]  # f(x) + f(−x)
        return _moments("odd_error", jnp.linalg.norm(total, axis=1))

    learned, error, quantities = jax.vmap(one)(fields)
    # We take one seed after the other: the points of all seeds do not fit into the caches.
    return learned, error, quantities | jax.lax.map(odd_error, fields)


def _moments(name: str, values: Float[Array, " P"]) -> dict[str, Float[Array, ""]]:
    return {f"{name}_mean": values.mean(), f"{name}_variance": values.var()}


# The paper's grid search and `tune`, side by side.

FOLDS = 5
GRID = np.geomspace(0.3, 30.0, 30), np.geomspace(1e-10, 1.0, 25)  # σ, λ


class Choice(NamedTuple):
    """The hyperparameters that one method chose for each of S seeds, and tests of their fields.

    Attributes:
        lengthscale: σ, shape (S,).
        regularization: λ of `fit`, whose ridge is Nλ, shape (S,).
        loss: the cross-validation loss of this choice, shape (S,).
        seconds: the time of the search without compilation, shape (S,).
        quantities: the `quantities` of `Outcome`, each of shape (S,).
    """

    lengthscale: np.ndarray
    regularization: np.ndarray
    loss: np.ndarray
    seconds: np.ndarray
    quantities: Mapping[str, Float[Array, " S"]]


class Comparison(NamedTuple):
    """The results of grid search and gradient on the same data.

    Attributes:
        grid: the choice of the grid search.
        gradient: the choice of `tune`.
        surface: the losses of the grid for seed 0, shape (30, 25).
    """

    grid: Choice
    gradient: Choice
    surface: np.ndarray


def compare(
    experiment: Experiment,
    structure: str,
    X: Float[Array, "S N n"],
    Y: Float[Array, "S N n"],
) -> Comparison:
    """Tune one structure on every data set by both methods, and test the tuned kernels.

    Args:
        experiment: the system and its test.
        structure: a key of `STRUCTURES`.
        X: states, shape (S, N, n), of `datasets`.
        Y: velocities, shape (S, N, n).

    Raises:
        RuntimeError: a fit or an integration failed.
    """
    make = STRUCTURES[structure]

    def choice(ends: list[_SearchEnd], seconds: np.ndarray) -> Choice:
        kernels = [make(Gaussian(end.lengthscale)) for end in ends]
        kernels = jax.tree.map(lambda *leaves: jnp.stack(leaves), *kernels)
        lengthscale, regularization, loss = np.array(ends).T
        # In the flat limit (σ -> ∞, λ -> 0) a field has rounding errors of about 1e-9. With a
        # smaller tolerance the integrator took 100 times as many steps.
        outcome = evaluate(experiment, kernels, X, Y, regularization, tolerance=1e-6)
        return Choice(lengthscale, regularization, loss, seconds, outcome.quantities)

    surfaces, grid_seconds = _time(lambda x, y: _surface(make, x, y), X, Y)
    tuned, gradient_seconds = _time(lambda x, y: _search_by_gradient(make, x, y), X, Y)
    return Comparison(
        choice([_least_loss(surface) for surface in surfaces], grid_seconds),
        choice(tuned, gradient_seconds),
        surfaces[0],
    )


def _time(run, X, Y) -> tuple[list, np.ndarray]:
    """The results of `run` for each data set, and the seconds of each run after compilation."""
    run(X[0], Y[0])
    answers, seconds = [], []
    for x, y in zip(X, Y, strict=True):
        start = time.perf_counter()
        answers.append(run(x, y))
        seconds.append(time.perf_counter() - start)
    return answers, np.array(seconds)


class _SearchEnd(NamedTuple):
    """The hyperparameters at the end of one search, and their loss."""

    lengthscale: float
    regularization: float
    loss: float


def _surface(make, x, y) -> np.ndarray:
    lengthscales, ridges = map(jnp.asarray, GRID)
    return np.asarray(grid_losses(make, lengthscales, ridges, x, y, Partition(len(x), FOLDS)))


def _least_loss(surface: np.ndarray) -> _SearchEnd:
    i, j = np.unravel_index(np.nanargmin(surface), surface.shape)
    return _SearchEnd(GRID[0][i], GRID[1][j], surface[i, j])


def _search_by_gradient(make, x, y) -> _SearchEnd:
    tuned = tune(make(Gaussian(1.0)), x, y, 1e-3, FOLDS)
    # The only hyperparameter of these kernels is log σ.
    (leaf,) = jax.tree.leaves(eqx.filter(tuned.kernel, eqx.is_inexact_array))
    return _SearchEnd(float(np.exp(leaf)), float(tuned.regularization), float(tuned.loss))


@eqx.filter_jit
def grid_losses(
    make,
    lengthscales: Float[Array, " A"],
    ridges: Float[Array, " B"],
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    partition: Partition,
) -> Float[Array, "A B"]:
    """Return the cross-validation loss over a grid of (σ, λ), by a refit for each of the F folds.

    Each refit has the ridge (N − N/F) λ, as in `cross_validation_loss`. A loss is NaN if a refit
    fails.
    """
    N, n = X.shape
    points = partition.folds

    def fold_loss(G, ridge, held_out):
        rest = np.setdiff1d(np.arange(N), held_out)
        trained = G[rest][:, :, rest].reshape(len(rest) * n, len(rest) * n)
        across = G[held_out][:, :, rest].reshape(len(held_out) * n, len(rest) * n)
        _, a = solution(plus_ridge(trained, ridge), Y[rest].reshape(-1))
        return jnp.mean((Y[held_out].reshape(-1) - across @ a) ** 2)

    def row(lengthscale):
        G = assemble(make(Gaussian(lengthscale)), X, X)

        def loss(regularization):
            ridge = (N - N / len(points)) * regularization
            return jnp.mean(jnp.stack([fold_loss(G, ridge, fold) for fold in points]))

        # Workaround for a deadlock in jaxlib 0.10.2 on two cores: several independent batches of
        # factorisations, such as those of the folds, must not run at once. We take one ridge after
        # the other.
        return jax.lax.map(loss, ridges)

    return jax.lax.map(row, lengthscales)
