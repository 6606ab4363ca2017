"""What `tune` minimises: a validation loss of the dense or of the low-rank fit, or the caller's."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._observations.rows import Rows
from hamkernel._solvers.random_features import RandomFeatures
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._validation.bases import AbstractBasis, LandmarkBasis, WaveBasis
from hamkernel._validation.folds import Folds, Partition
from hamkernel._validation.losses import (
    cross_validation_loss,
    generalized_cross_validation,
    generalized_loss,
    log_likelihood,
    log_marginal_likelihood,
    partition_loss,
)
from hamkernel._validation.observed import (
    rows_generalized_loss,
    rows_log_likelihood,
    rows_partition,
    rows_partition_loss,
)

Objective = Callable[[AbstractMatrixKernel, Array, Array, Array], Float[Array, ""]]
Criterion = Literal["cross_validation", "generalized_cross_validation", "marginal_likelihood"]

# Up to so many points every run is on all of them, else on a subset of so many. With half as many
# the best run often leads to a poor optimum of all the data.
COARSE_POINTS = 64
COARSE_ROWS = 256  # of the Gram of the subset, at most

# Share of the residuals that a fit must leave free, tr(I − S)/D, to be judged by generalised
# cross-validation: it is 0/0 where a fit interpolates, and can be very small there.
LEAST_FREE = 0.2

HUGE = 1e30  # stands for an objective that is not finite: BFGS backs away from it


class SearchCriterion(eqx.Module):
    """The function to minimise. Losses are searched by their logarithm, which has no scale."""

    fn: Any  # a function, or the `Partial` of one of ours
    partition: Partition | None = eqx.field(static=True)
    logarithmic: bool = eqx.field(static=True)
    own: bool = eqx.field(static=True)  # the caller's, which may need all the data

    def value(self, K, X, Y, regularization) -> Float[Array, ""]:
        extra = () if self.partition is None else (self.partition,)
        with require.traceable("the objective"):
            value = self.fn(K, X, Y, regularization, *extra)
        value = require.floating(value, "the value of the objective")
        if jnp.shape(value) != ():
            raise ValueError(
                f"the objective returned shape {jnp.shape(value)}; one number, shape (), is needed."
            )
        if self.logarithmic:
            value = jnp.log(jnp.maximum(value, jnp.finfo(value.dtype).tiny))
        return jnp.where(jnp.isfinite(value), value, HUGE)

    def losses(self, values: Float[np.ndarray, " starts"]) -> Float[np.ndarray, " starts"]:
        """The caller's objective for values of the search; inf where there was none."""
        finite = values < HUGE
        losses = np.where(finite, values, 0)
        return np.where(finite, np.exp(losses) if self.logarithmic else losses, np.inf)

    def coarse_points(self, X: Float[Array, "N n"]) -> np.ndarray:
        """The rows of the subset: spread evenly over the folds, and over the points of each."""
        N, n = X.shape
        count = min(COARSE_POINTS, max(COARSE_ROWS // n, 2))
        if self.own or N <= count:
            return np.arange(N)
        labels = np.zeros(N) if self.partition is None else self.partition.labels
        even = np.linspace(0, N - 1, count).round().astype(int)
        return np.sort(np.argsort(labels, kind="stable")[even])

    def with_basis(self, basis: AbstractBasis) -> "SearchCriterion":
        """The same criterion of the low-rank fit in this basis."""
        # A Partial of a Partial would be another function, to be compiled, for each call of `tune`.
        fn = jax.tree_util.Partial(self.fn.func, **self.fn.keywords, basis=basis)
        return dataclasses.replace(self, fn=fn)

    def on(self, rows: np.ndarray) -> "SearchCriterion":
        """The same criterion for a subset of the points."""
        if self.partition is None:
            return self
        partition = Partition(len(rows), self.partition.labels[rows])
        return dataclasses.replace(self, partition=partition)


def criterion_of(objective: Criterion | Objective, N: int, folds: Folds) -> SearchCriterion:
    """What the objective of `tune` means for N points.

    A public loss is what its name is: it takes the folds and is searched by its logarithm.
    """
    partial = jax.tree_util.Partial
    if objective == "cross_validation" or objective is cross_validation_loss:
        partition = Partition(N, folds)
        return SearchCriterion(partial(partition_loss), partition, logarithmic=True, own=False)
    if objective == "generalized_cross_validation" or objective is generalized_cross_validation:
        fn = partial(generalized_loss, least_free=LEAST_FREE)
        return SearchCriterion(fn, None, logarithmic=True, own=False)
    if objective == "marginal_likelihood":
        fn = partial(_negative_log_likelihood)
        return SearchCriterion(fn, None, logarithmic=False, own=False)
    if objective is log_marginal_likelihood:
        raise TypeError(
            "log_marginal_likelihood is to be large and an objective is to be small: pass "
            "objective='marginal_likelihood'."
        )
    if not callable(objective):
        raise ValueError(
            "objective must be 'cross_validation', 'generalized_cross_validation', "
            "'marginal_likelihood' or a function (K, X, Y, regularization) -> (); "
            f"got {objective!r}."
        )
    other = require.other_arguments(objective, "K", "X", "Y", "regularization")
    if other is not None:
        raise TypeError(
            "an objective is called with (K, X, Y, regularization), by position, and returns one "
            f"number; this one takes ({other})."
        )
    return SearchCriterion(as_pytree(objective), None, logarithmic=False, own=True)


def criterion_of_rows(
    objective: Criterion | Objective, data: AbstractObservations, rows: Rows, folds: Folds
) -> SearchCriterion:
    """The same of observations, for all of them at once: what it is called with is not looked at.

    A function of the caller's is called with (K, data, None, regularization).
    """
    named = criterion_of(objective, rows.count, folds)
    if named.own:
        fn = jax.tree_util.Partial(_own_of_data, named.fn, data)
    elif named.partition is not None:
        fn = jax.tree_util.Partial(
            _partition_loss_of, rows, partition=_Kept(rows_partition(rows, folds))
        )
    elif named.logarithmic:
        fn = jax.tree_util.Partial(_generalized_loss_of, rows)
    else:
        fn = jax.tree_util.Partial(_negative_log_likelihood_of, rows)
    return SearchCriterion(fn, None, logarithmic=named.logarithmic, own=True)


class _Kept(eqx.Module):
    """A partition as a PyTree without leaves."""

    value: Partition = eqx.field(static=True)


def _own_of_data(fn, data, K, X, Y, regularization):
    return fn(K, data, None, regularization)


def _partition_loss_of(rows, K, X, Y, regularization, *, partition):
    return rows_partition_loss(K, rows, regularization, partition.value)


def _generalized_loss_of(rows, K, X, Y, regularization):
    return rows_generalized_loss(K, rows, regularization, LEAST_FREE)


def _negative_log_likelihood_of(rows, K, X, Y, regularization):
    return -rows_log_likelihood(K, rows, regularization)


def _negative_log_likelihood(K, X, Y, regularization, basis=None):
    return -log_likelihood(K, X, Y, regularization, basis)


def basis_of(solver, K, regularization, X) -> AbstractBasis:
    """What the solver would take at the best kernel of the subset; it follows the kernel then."""
    if isinstance(solver, RandomFeatures):
        return WaveBasis(solver.key, solver.count)
    landmarks = solver.landmarks(K, X, regularization)
    return LandmarkBasis(landmarks.points)
