"""Hyperparameters of every noise seed by the paper's grid search and by `tune`, side by side.

The paper minimises the k-fold cross-validation error over σ and λ by a grid search, and gives
neither k nor the grid: here k = 5 and `GRID`, which holds all values that it reports. The search
refits for every fold, in one compiled program per data set, which is kinder to it than a loop.
"""

import time
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._gram.dense import assemble, plus_ridge
from hamkernel._kernels.built_in import Gaussian
from hamkernel._solvers.factors import solution
from hamkernel._tuning.tune import tune
from hamkernel._validation.closed_forms import Partition
from hamkernel.paper._experiments import STRUCTURES, Experiment, evaluate

FOLDS = 5
GRID = np.geomspace(0.3, 30.0, 30), np.geomspace(1e-10, 1.0, 25)  # σ, λ


class Choice(NamedTuple):
    """The hyperparameters that one method chose for each of S seeds, and tests of their fields.

    Attributes:
        lengthscale: σ, shape (S,).
        regularization: λ of `fit`, whose ridge is Nλ, shape (S,).
        loss: the cross-validation loss there, shape (S,).
        seconds: how long the search took, warm, shape (S,).
        quantities: the tests of the fields, of `Outcome`; each of shape (S,).
    """

    lengthscale: np.ndarray
    regularization: np.ndarray
    loss: np.ndarray
    seconds: np.ndarray
    quantities: Mapping[str, Float[Array, " S"]]


class Comparison(NamedTuple):
    """Grid search and gradient on the same data.

    Attributes:
        grid: what the grid search chose.
        gradient: what `tune` chose.
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
    """Tune one structure on every data set by both methods, and test what they chose.

    Args:
        experiment: the system and its test.
        structure: a key of `STRUCTURES`.
        X: states, shape (S, N, n), of `datasets`.
        Y: velocities, shape (S, N, n).

    Raises:
        RuntimeError: a fit or an integration failed.
    """
    make = STRUCTURES[structure]

    def chosen(found: list[_Found], seconds: np.ndarray) -> Choice:
        kernels = [make(Gaussian(each.lengthscale)) for each in found]
        lengthscale, regularization, loss = np.array(found).T
        outcome = evaluate(
            experiment,
            jax.tree.map(lambda *leaves: jnp.stack(leaves), *kernels),
            X,
            Y,
            regularization,
            # Where the data asks for the flat limit (σ -> ∞, λ -> 0), a field rounds at about 1e-9,
            # and with a smaller tolerance 100 times as many steps were measured.
            tolerance=1e-6,
        )
        return Choice(lengthscale, regularization, loss, seconds, outcome.quantities)

    surfaces, grid_seconds = _timed(lambda x, y: _surface(make, x, y), X, Y)
    tuned, gradient_seconds = _timed(lambda x, y: _by_gradient(make, x, y), X, Y)
    return Comparison(
        chosen([_lowest(surface) for surface in surfaces], grid_seconds),
        chosen(tuned, gradient_seconds),
        surfaces[0],
    )


def _timed(run, X, Y) -> tuple[list, np.ndarray]:
    """The results of `run` for each data set, and the seconds of each run after compilation."""
    run(X[0], Y[0])
    answers, seconds = [], []
    for x, y in zip(X, Y, strict=True):
        start = time.perf_counter()
        answers.append(run(x, y))
        seconds.append(time.perf_counter() - start)
    return answers, np.array(seconds)


class _Found(NamedTuple):
    """The end of one search."""

    lengthscale: float
    regularization: float
    loss: float


def _surface(make, x, y) -> np.ndarray:
    lengthscales, ridges = map(jnp.asarray, GRID)
    return np.asarray(grid_losses(make, lengthscales, ridges, x, y, Partition(len(x), FOLDS)))


def _lowest(surface: np.ndarray) -> _Found:
    i, j = np.unravel_index(np.nanargmin(surface), surface.shape)
    return _Found(GRID[0][i], GRID[1][j], surface[i, j])


def _by_gradient(make, x, y) -> _Found:
    tuned = tune(make(Gaussian(1.0)), x, y, 1e-3, FOLDS)
    # The only hyperparameter of these kernels, which is stored as a logarithm.
    (leaf,) = jax.tree.leaves(eqx.filter(tuned.kernel, eqx.is_inexact_array))
    return _Found(float(np.exp(leaf)), float(tuned.regularization), float(tuned.loss))


@eqx.filter_jit
def grid_losses(
    make,
    lengthscales: Float[Array, " A"],
    ridges: Float[Array, " B"],
    X: Float[Array, "N n"],
    Y: Float[Array, "N n"],
    partition: Partition,
) -> Float[Array, "A B"]:
    """Return the cross-validation loss over a grid of (σ, λ), by a refit for every fold.

    Args:
        make: scalar kernel -> matrix-valued kernel.
        lengthscales: values of σ, shape (A,).
        ridges: values of λ, shape (B,).
        X: states, shape (N, n).
        Y: velocities, shape (N, n).
        partition: the folds; each refit has the ridge (N − N/F) λ of `cross_validation_loss`.

    Returns:
        Shape (A, B); NaN where a fit fails.
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
            return jnp.mean(jnp.stack([fold_loss(G, ridge, each) for each in points]))

        # One after the other: jaxlib 0.10.2 stalls forever on two cores where several batches of
        # factorisations that do not depend on each other, here those of the folds, run at once.
        return jax.lax.map(loss, ridges)

    return jax.lax.map(row, lengthscales)
