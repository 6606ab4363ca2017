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
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.low_rank import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._validation.folds import Folds, Partition
from hamkernel._validation.losses import (
    cross_validation_loss,
    generalized_cross_validation,
    log_marginal_likelihood,
)
from hamkernel._validation.of_rows import (
    generalized_loss_and_square,
    log_likelihood,
    partition_loss_and_square,
    partition_of_rows,
)

Objective = Callable[[AbstractMatrixKernel, Array, Array, Array], Float[Array, ""]]
Criterion = Literal["cross_validation", "generalized_cross_validation", "marginal_likelihood"]

# Share of the residuals that a fit must leave free, tr(I − S)/D, to be judged by generalised
# cross-validation: it is 0/0 where a fit interpolates, and can be very small there.
LEAST_FREE = 0.2


class SearchCriterion(eqx.Module):
    """The function to minimise, in units in which a change of 0.01 is one per cent of a loss.

    A loss is searched by its logarithm; a negative log density per half a row, which is the
    logarithm of a square too; and the caller's objective as it is.
    """

    fn: Any  # a function, or the `Partial` of one of ours
    partition: Partition | None = eqx.field(static=True)  # of the observations; see `on`
    logarithmic: bool = eqx.field(static=True)
    own: bool = eqx.field(static=True)  # the caller's, which may need all the data

    def loss(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""] | None]:
        """The objective, as `tune` reports it, and ‖a‖² of the fit where there is a wall for it."""
        extra = () if self.partition is None else (self.partition,)
        with require.traceable("the objective"):
            value = self.fn(K, rows, regularization, *extra)
        value, square = value if self.logarithmic else (value, None)
        value = require.floating(value, "the value of the objective")
        if jnp.shape(value) != ():
            raise ValueError(
                f"the objective returned shape {jnp.shape(value)}; one number, shape (), is needed."
            )
        return value, square

    def searched(self, loss, square, rows: Measurements, wall) -> Float[Array, ""]:
        """What the search minimises: the loss in its units, and the wall.

        The wall keeps away from fields that rounding makes rough where the loss is still right.
        f(x) = Σ K(x, xⱼ) aⱼ rounds by up to ε tr(G) ‖a‖, of which an adaptive step, or the
        iteration of an implicit one, sees 1e-2. It is to stay a share √ε of the velocities:
        ‖a‖ tr(G) √ε ≤ ‖y‖. Beyond the wall the square of the logarithm of what is too much is
        added: of 18 fields, for polynomial and trigonometric H with noise of 0, 1 and 10 %, all can
        then be integrated (`tests/benchmarks/tuned_fields.py`). The likelihood has no need of one:
        its Nλ is the variance of y − f = Nλ a. Of an objective of the caller's nothing is known.

        Args:
            loss: the value of `loss`, shape ().
            square: ‖a‖², shape ().
            rows: what the loss is of.
            wall: tr(G)² over ‖y‖², of velocities at all points of the rows; None where the caller
                has said what λ may be.
        """
        value = loss
        if self.logarithmic:
            tiny = jnp.finfo(loss.dtype).tiny
            value = jnp.log(jnp.maximum(loss, tiny))
            if wall is not None:
                eps = jnp.log(jnp.finfo(loss.dtype).eps).astype(loss.dtype)
                beyond = (jnp.log(jnp.maximum(square, tiny)) + jnp.log(wall) + eps) / 2
                value = value + jnp.maximum(beyond, 0) ** 2
        elif not self.own:
            value = value * (2 / rows.size)
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    def with_basis(self, basis: AbstractBasis) -> "SearchCriterion":
        """The same criterion of the low-rank fit in this basis."""
        # A Partial of a Partial would be another function, to be compiled, for each call of `tune`.
        fn = jax.tree_util.Partial(self.fn.func, **self.fn.keywords, basis=basis)
        return dataclasses.replace(self, fn=fn)

    def on(self, rows: Measurements, chosen: np.ndarray) -> "SearchCriterion":
        """The same criterion for the rows of some observations."""
        if self.partition is None:
            return self
        partition = partition_of_rows(rows, self.partition.labels[chosen])
        return dataclasses.replace(self, partition=partition)


def criterion_of(
    objective: Criterion | Objective, N: int, folds: Folds, data: tuple[Any, Any] = (None, None)
) -> SearchCriterion:
    """What the objective of `tune` means for N observations.

    A public loss is what its name is: it takes the folds and is searched by its logarithm. A
    function of the caller's is called with what the caller gave, states and velocities, or
    observations and None.
    """
    partial = jax.tree_util.Partial
    if objective == "cross_validation" or objective is cross_validation_loss:
        partition = Partition(N, folds)
        return SearchCriterion(
            partial(partition_loss_and_square), partition, logarithmic=True, own=False
        )
    if objective == "generalized_cross_validation" or objective is generalized_cross_validation:
        fn = partial(generalized_loss_and_square, least_free=LEAST_FREE)
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
    fn = partial(_own_of_data, as_pytree(objective), data)
    return SearchCriterion(fn, None, logarithmic=False, own=True)


def _own_of_data(fn, data, K, rows, regularization):
    return fn(K, *data, regularization)


def _negative_log_likelihood(K, rows, regularization, basis=None):
    return -log_likelihood(K, rows, regularization, basis)
