"""The functions that `tune` minimises: a loss of the dense or low-rank fit, or the caller's.

A search uses growing subsets of the observations, `parts_of`, each with a `SearchObjective`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._closed_forms import Folds, Partition
from hamkernel._kernels.functions import as_pytree
from hamkernel._machine import precise_jit
from hamkernel._observations.measurements import Measurements
from hamkernel._solvers.low_rank import AbstractBasis
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import has_constant_parts
from hamkernel._tuning.space import SearchSpace
from hamkernel._validation import (
    cross_validation_loss,
    generalized_cross_validation,
    generalized_loss_and_square,
    log_likelihood,
    log_marginal_likelihood,
    partition_loss_and_square,
    partition_of_rows,
    project_silent_directions,
)

Objective = Callable[[AbstractMatrixKernel, Array, Array, Array], Float[Array, ""]]
Criterion = Literal["cross_validation", "generalized_cross_validation", "marginal_likelihood"]

# The smallest tr(I − S)/D for which generalised cross-validation is evaluated. If a fit
# interpolates, tr(I − S) and the residual both vanish, the loss is 0/0 and can be small by
# accident. On 24 points with noise, a search without the limit leaves less than a tenth of the
# noise as residual, and with the limit more than half (`tests/test_tune.py`).
LEAST_FREE = 0.2


class SearchCriterion(eqx.Module):
    """The function to minimise, scaled so that a change of 0.01 means one per cent of a loss.

    A loss is minimised on a log scale. A negative log density is divided by half the number of
    rows, which makes it the logarithm of a mean square, too. The caller's objective is minimised
    as it is.

    Attributes:
        name: the name of the objective; None for the caller's function, which may need all the
            data.
        partition: the folds of the observations; of the rows after `restrict`.
        basis: the basis of a low-rank fit; None for the exact fit.
        projected: the targets without their silent directions, if these do not depend on u.
        fn: the caller's function.
        data: the arguments X and Y of the caller's function.
    """

    name: Criterion | None = eqx.field(static=True)
    partition: Partition | None = eqx.field(static=True, default=None)
    basis: AbstractBasis | None = None
    projected: Any = None
    fn: Any = None
    data: tuple[Any, Any] = (None, None)

    @property
    def logarithmic(self) -> bool:
        """Whether a loss is minimised, on a log scale."""
        return self.name in ("cross_validation", "generalized_cross_validation")

    @property
    def custom(self) -> bool:
        """Whether the objective is the caller's function."""
        return self.name is None

    def loss(
        self, K: AbstractMatrixKernel, rows: Measurements, regularization: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""] | None]:
        """The objective, as `tune` reports it, and ‖a‖² of the fit where a penalty needs it."""
        fit = K, rows, regularization
        if self.partition is not None:
            return partition_loss_and_square(*fit, self.partition, self.basis)
        if self.logarithmic:
            return generalized_loss_and_square(*fit, self.basis, LEAST_FREE)
        if not self.custom:
            return -log_likelihood(*fit, self.basis, self.projected), None
        with require.traceable("the objective"):
            value = self.fn(K, *self.data, regularization)
        value = require.floating(value, "the value of the objective")
        require.shape(value, "the objective returned", "one number", ())
        return value, None

    def restrict(
        self, K: AbstractMatrixKernel, rows: Measurements, chosen: Int[np.ndarray, " _"]
    ) -> "SearchCriterion":
        """This criterion for the rows of the observations `chosen`."""
        if self.partition is not None:
            partition = partition_of_rows(rows, self.partition.labels[chosen])
            return dataclasses.replace(self, partition=partition)
        if self.name == "marginal_likelihood" and has_constant_parts(K):
            # Once for all u: an eigenvalue problem of n × n for each point.
            return dataclasses.replace(self, projected=_project(K, rows))
        return self


class SearchObjective(eqx.Module):
    """The function u -> (value, loss): the number to minimise, and the objective that is reported.

    Attributes:
        space: maps u to a kernel and λ.
        criterion: the loss on `rows`.
        rows: all observations, or a subset of them.
        thinning: the number of all observations over the number in `rows`. A fit to the subset has
            the ridge Nλ of all the data.
        rms: the size of velocities, see `velocity_rms`.
        unit: the scale by which a custom objective is divided; 1 for built-in losses.
    """

    space: SearchSpace
    criterion: SearchCriterion
    rows: Measurements
    thinning: Float[Array, ""]
    rms: Float[Array, ""]
    unit: Float[Array, ""]

    def __call__(self, u: Float[Array, " P"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return self.value_and_loss(*self.space.decode(u.astype(self.rms.dtype)))

    def value_and_loss(
        self, K: AbstractMatrixKernel, regularization: Float[Array, ""], size: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The value and the loss of a kernel and λ, given `size` = tr(G)/N."""
        loss, square = self.criterion.loss(K, self.rows, self.thinning * regularization)
        value = loss
        if self.criterion.logarithmic:
            value = jnp.log(jnp.maximum(loss, jnp.finfo(loss.dtype).tiny))
            if self.space.chooses_ridge and square is not None:
                value = value + self.rounding_penalty(square, size)
        elif self.criterion.custom:
            value = value / self.unit.astype(value.dtype)
        else:
            value = value * (2 / self.rows.size)
        return jnp.where(jnp.isfinite(value), value, jnp.inf), loss

    def rounding_penalty(
        self, square: Float[Array, ""], size: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The penalty on fields whose rounding errors are too large to be integrated.

        f(x) = Σ K(x, xⱼ) aⱼ rounds by up to ε tr(G) ‖a‖. An adaptive step, or the iteration of an
        implicit step, sees about 1e-2 of that bound. The error should not exceed a share √ε of the
        velocities, which means ‖a‖ tr(G) √ε ≤ ‖y‖. The penalty is the squared logarithm of the
        ratio of the two sides if that ratio is larger than 1. All of 18 fields, with polynomial and
        trigonometric H and noise of 0, 1 and 10 %, can then be integrated
        (`tests/benchmarks/tuned_fields.py`). The likelihood needs no penalty, since its Nλ is the
        variance of y − f = Nλ a. The caller's objective gets none, since its meaning is unknown.

        Args:
            square: ‖a‖², shape ().
            size: tr(G)/N, shape ().
        """
        X, dtype = self.rows.points, square.dtype
        # The coefficients of noise, a = (y − f)/(Nλ), have the same size at every point, so ‖a‖/‖y‖
        # of a subset is that of all the data, whose trace is N `size`.
        trace = self.thinning * len(X) * size
        velocities = self.rms**2 * (len(X) * self.space.kernel.outputs(X.shape[1]))
        tiny, eps = jnp.finfo(dtype).tiny, jnp.log(jnp.finfo(dtype).eps).astype(dtype)
        # log_ratio = log(‖a‖ tr(G) √ε / ‖y‖) with ‖y‖² = rms² times the number of components
        scale = trace**2 / jnp.maximum(velocities, tiny)
        log_ratio = (jnp.log(jnp.maximum(square, tiny)) + jnp.log(scale) + eps) / 2
        return jnp.maximum(log_ratio, 0) ** 2


def parts_of(
    rows: Measurements, criterion: SearchCriterion, dense: bool
) -> list[Int[np.ndarray, " _"]]:
    """The observations of each part of a search: a few, more, and all if the loss is dense."""
    N, n = rows.count, len(rows.targets) / rows.count
    if criterion.custom:  # a custom objective may need all the data
        return [np.arange(N)]
    # The first part has 256 rows or 64 points, whichever is fewer. With half as many, the best
    # run often leads to a poor optimum on all the data (`tests/benchmarks/tuning_speed.py`). The
    # second part has 1024 rows, and is used if all points have at least twice as many.
    counts = [min(64, max(int(256 / n), 2)), int(1024 / n)]
    if 2 * counts[1] > N:
        del counts[1]
    if counts[0] >= N:
        return [np.arange(N)]
    labels = np.zeros(N) if criterion.partition is None else criterion.partition.labels
    order = np.argsort(labels, kind="stable")
    # Evenly spaced over the folds and over the observations of each fold.
    subsets = [np.sort(order[np.linspace(0, N - 1, count).round().astype(int)]) for count in counts]
    return [*subsets, np.arange(N)] if dense else subsets


def criterion_of(
    objective: Criterion | Objective, N: int, folds: Folds, data: tuple[Any, Any] = (None, None)
) -> SearchCriterion:
    """The criterion that the `objective` of `tune` means, for N observations.

    A public loss function may be passed in place of its name. It then uses `folds` and is minimised
    on a log scale, exactly as the name would be. Any other function is called with the caller's
    data: states and velocities, or observations and None.
    """
    if objective == "cross_validation" or objective is cross_validation_loss:
        return SearchCriterion("cross_validation", Partition(N, folds))
    if objective == "generalized_cross_validation" or objective is generalized_cross_validation:
        return SearchCriterion("generalized_cross_validation")
    if objective == "marginal_likelihood":
        return SearchCriterion("marginal_likelihood")
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
    mismatch = require.signature_mismatch(objective, "K", "X", "Y", "regularization")
    if mismatch is not None:
        raise TypeError(
            "an objective is called with (K, X, Y, regularization), by position, and returns one "
            f"number; this one takes ({mismatch})."
        )
    return SearchCriterion(None, fn=as_pytree(objective), data=data)


_project = precise_jit(project_silent_directions)
