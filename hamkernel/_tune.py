"""Hyperparameters by following the gradient of a validation loss, inside a box, from many starts.

Coordinates. Every hyperparameter h (a stored leaf, so usually a logarithm) lives in a box and is
searched as h = low + (high − low)(1 + sin u)/2 over all real u, as MINUIT does: an unconstrained
optimiser then respects the bounds and can rest on one, where a sigmoid would creep towards it.

The ridge. λ is searched relative to the Gram. The residuals of a fit lose about ε tr(G)/(Nλ) of
their digits, ε the rounding of the dtype, so Nλ ≥ 100 ε tr(G) is demanded at every point, with
the G that was there before the terms of an odd or even kernel cancelled: what lies below is
rounding noise and can look like a very good loss. This matters. A quadratic
Hamiltonian is the flat limit of the Gaussian kernel, so the loss of an oscillator improves all
the way along ℓ -> ∞, λ -> 0 until nothing is left of it but noise.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._field import AbstractField
from hamkernel._fit import fit
from hamkernel._folds import Folds, Partition
from hamkernel._gram import matrix_kernel
from hamkernel._scalar import as_pytree
from hamkernel._search_space import SearchSpace
from hamkernel._solve import AbstractSolver
from hamkernel._structured import AbstractMatrixKernel
from hamkernel._validation import (
    generalized_loss,
    log_likelihood,
    log_marginal_likelihood,
    partition_loss,
)

Objective = Callable[[AbstractMatrixKernel, Array, Array, Array], Float[Array, ""]]
Criterion = Literal["cross_validation", "generalized_cross_validation", "marginal_likelihood"]


class Tuned(eqx.Module):
    """What `tune` found.

    Attributes:
        kernel: the kernel with its tuned hyperparameters.
        regularization: the tuned λ, shape ().
        loss: the objective there, shape (); for "marginal_likelihood" the NEGATIVE log density.
        field: the fit to all data with them.
        converged: whether the run that found the best point met the tolerances, shape ().
        steps: the number of its optimiser steps, shape ().
        at_bounds: the names of the hyperparameters that rest on a bound of the search box. The
            data would have them further out: see "How to choose" in the README.
        start_losses: the loss on all data at the end of the run from each start, shape (starts,):
            in the order of the starts, the caller's kernel first, or, where the runs were made
            on a subset, in ascending order of the loss before the best were finished.
        bounds: the box that was searched: for each name the lowest and highest value.
    """

    kernel: AbstractMatrixKernel
    regularization: Float[Array, ""]
    loss: Float[Array, ""]
    field: AbstractField
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    start_losses: Float[Array, " starts"]
    at_bounds: tuple[str, ...] = eqx.field(static=True)
    bounds: dict[str, tuple[Any, Any]] = eqx.field(static=True)


def tune(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    regularization: ArrayLike = 1e-3,
    folds: Folds = 5,
    *,
    objective: Criterion | Objective = "cross_validation",
    frozen: str | tuple[str, ...] = (),
    bounds: dict[str, tuple[ArrayLike, ArrayLike]] | None = None,
    starts: int = 16,
    optimiser: optx.AbstractMinimiser | None = None,
    max_steps: int = 64,
    solver: AbstractSolver | None = None,
    progress: bool = False,
) -> Tuned:
    """Tune every hyperparameter of K, and λ with them, by gradient descent on a validation loss.

    The search starts from the given kernel and from `starts` − 1 further points, the best of a
    space-filling design in the box. All run in one compiled call, on a subset of the points if
    there are many; the best runs are then finished on all data, and the best point that any of
    them saw is returned. New data of the same shape does not recompile.

    Args:
        K: a matrix-valued kernel; every inexact array leaf is a hyperparameter.
        X: states, shape (N, n).
        Y: measured velocities, shape (N, n).
        regularization: the first λ.
        folds: as in `cross_validation_loss`; give trajectory labels for data from trajectories.
        objective: "cross_validation", "generalized_cross_validation", "marginal_likelihood", or
            a function (K, X, Y, regularization) -> () that is to be small.
        frozen: names of hyperparameters to keep, such as "lengthscale", "regularization" or
            "terms[0].scale". A name means every hyperparameter whose full name ends in it.
        bounds: {name: (low, high)} in place of the box from the data, in the units of the
            hyperparameter. A start outside the box is moved to its edge.
        starts: the number of runs.
        optimiser: an optimistix minimiser; BFGS with tolerance 1e-3 if None.
        max_steps: the largest number of steps of one run.
        solver: how the final field is fitted; see `fit`.
        progress: print each step, through optimistix's own hook.

    Returns:
        A `Tuned`. NaN never comes out: points where the objective is not finite cannot win.

    Raises:
        TypeError: K is not matrix-valued, or a function is given that is to be large. ValueError:
            bad data, folds, names, or bounds. RuntimeError: the objective is finite nowhere.

    The flat limit. When λ rests on its lower bound and a lengthscale on its upper one, the data
    asks for a polynomial: the fit is good and its hyperparameters mean little.
    """
    K = matrix_kernel(K)
    X, Y = require.data(X, Y)
    K.check_dimension(X.shape[1])
    ridge = require.positive_scalar(regularization, "regularization").astype(X.dtype)
    criterion = _criterion(objective, len(X), folds)
    frozen = (frozen,) if isinstance(frozen, str) else tuple(frozen)
    space = SearchSpace(K, X, Y, ridge, frozen, bounds or {})
    if starts < 1:
        raise ValueError(f"starts must be at least 1, got {starts}.")
    if optimiser is None:
        optimiser = _BFGS_VERBOSE if progress else _BFGS

    runs = _search(space, criterion, X, Y, optx.BestSoFarMinimiser(optimiser), starts, max_steps)
    values = np.asarray(runs.value)
    if not (values < HUGE).any():
        raise RuntimeError(
            "the objective is not finite at any start. Likely causes, in order: a kernel that is "
            "not positive definite or not finite (hk.check_kernel(k, X) tells); bounds in which "
            "no fit succeeds (pass bounds={'regularization': (low, high)} with a larger low); an "
            "objective of your own that returns NaN."
        )
    best = int(values.argmin())
    kernel, ridge = _decode(space, runs.u[best], X)
    return Tuned(
        kernel=kernel,
        regularization=ridge,
        loss=criterion.loss(runs.value[best]),
        field=fit(kernel, X, Y, ridge, solver=solver),
        converged=runs.converged[best],
        steps=runs.steps[best],
        start_losses=criterion.loss(runs.value),
        at_bounds=space.at_bounds(runs.u[best]),
        bounds=space.box(kernel, X),
    )


# Made once: compiled functions are told apart by the functions inside these, too.
_BFGS = optx.BFGS(rtol=1e-3, atol=1e-3)
_BFGS_VERBOSE = optx.BFGS(rtol=1e-3, atol=1e-3, verbose=True)

HUGE = 1e30  # stands for an objective that is not finite: BFGS backs away from it


class _Criterion(eqx.Module):
    """The function to minimise. Losses are searched by their logarithm, which has no scale."""

    fn: Callable[..., Float[Array, ""]]
    partition: Partition | None = eqx.field(static=True)
    logarithmic: bool = eqx.field(static=True)
    own: bool = eqx.field(static=True, default=False)  # the caller's: it may need all the data

    def value(self, K, X, Y, regularization) -> Float[Array, ""]:
        extra = () if self.partition is None else (self.partition,)
        value = self.fn(K, X, Y, regularization, *extra)
        if self.logarithmic:
            value = jnp.log(jnp.maximum(value, jnp.finfo(value.dtype).tiny))
        return jnp.where(jnp.isfinite(value), value, HUGE)

    def loss(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The caller's objective for a value of the search; inf where there was none."""
        loss = jnp.exp(value) if self.logarithmic else value
        return jnp.where(value < HUGE, loss, jnp.inf)

    def coarse_points(self, X: Float[Array, "N n"]) -> np.ndarray:
        """The rows of the subset: spread evenly over the folds, and over the points of each."""
        N, n = X.shape
        if self.own or N * n <= SMALL_ROWS:
            return np.arange(N)
        labels = np.zeros(N) if self.partition is None else self.partition.labels
        count = max(COARSE_ROWS // n, 2)
        even = np.linspace(0, N - 1, count).round().astype(int)
        return np.sort(np.argsort(labels, kind="stable")[even])

    def on(self, rows: np.ndarray) -> "_Criterion":
        """The same criterion for a subset of the points."""
        if self.partition is None:
            return self
        partition = Partition(len(rows), self.partition.labels[rows])
        return _Criterion(self.fn, partition, self.logarithmic, self.own)


def _criterion(objective: Criterion | Objective, N: int, folds: Folds) -> _Criterion:
    partial = jax.tree_util.Partial
    if objective == "cross_validation":
        return _Criterion(partial(partition_loss), Partition(N, folds), logarithmic=True)
    if objective == "generalized_cross_validation":
        return _Criterion(partial(generalized_loss), None, logarithmic=True)
    if objective == "marginal_likelihood":
        return _Criterion(partial(_negative_log_likelihood), None, logarithmic=False)
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
    return _Criterion(as_pytree(objective), None, logarithmic=False, own=True)


def _negative_log_likelihood(K, X, Y, regularization):
    return -log_likelihood(K, X, Y, regularization)


class _Runs(eqx.Module):
    """The best point of each run."""

    u: Float[Array, "starts P"]
    value: Float[Array, " starts"]
    converged: Bool[Array, " starts"]
    steps: Int[Array, " starts"]


_decode = eqx.filter_jit(lambda space, u, X: space.decode(u, X))


@eqx.filter_jit
def _search(space, criterion, X, Y, optimiser, starts: int, max_steps: int) -> _Runs:
    """The runs from all starts, coarse to fine.

    The basins are found on a subset of the points, where an evaluation costs microseconds; the
    best runs are then finished on all of them. Small data is its own subset.
    """
    rows = criterion.coarse_points(X)
    X_coarse, Y_coarse = X[rows], Y[rows]
    coarse = _Objective(space, criterion.on(rows), X_coarse, Y_coarse, len(X) / len(rows))
    u = space.encode_start(X)[None]
    if starts > 1:
        design = _design(u.shape[1], DESIGN_POINTS, X.dtype)
        values = jax.lax.map(coarse, design, batch_size=64)
        u = jnp.concatenate([u, _spread_out(design, values, starts - 1)])
    runs = jax.vmap(lambda u: _run(coarse, u, optimiser, max_steps))(u)
    if len(rows) == len(X):
        return runs
    fine = _Objective(space, criterion, X, Y, 1.0)
    runs = eqx.tree_at(lambda r: r.value, runs, jax.lax.map(fine, runs.u))
    order = jnp.argsort(runs.value)
    runs = jax.tree.map(lambda leaf: leaf[order], runs)
    finished = jax.lax.map(lambda u: _run(fine, u, optimiser, max_steps), runs.u[:FINISHERS])
    return jax.tree.map(lambda new, old: old.at[:FINISHERS].set(new), finished, runs)


DESIGN_POINTS = 256  # in the box, from which the starts are chosen
FINISHERS = 1  # runs that are finished on all points
SMALL_ROWS = 128  # of the Gram, up to which every run is on all points
COARSE_ROWS = 64  # of the Gram of the subset otherwise


class _Objective(eqx.Module):
    """u -> value. `thinning` keeps the ridge Nλ of all points when X is a subset of them."""

    space: SearchSpace
    criterion: _Criterion
    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    thinning: float = eqx.field(static=True)

    def __call__(self, u: Float[Array, " P"]) -> Float[Array, ""]:
        kernel, regularization = self.space.decode(u, self.X)
        return self.criterion.value(kernel, self.X, self.Y, self.thinning * regularization)


def _run(objective: _Objective, u: Float[Array, " P"], optimiser, max_steps: int) -> _Runs:
    """One run of the optimiser from u."""
    # optimistix starts its best loss in the default dtype, which float32 data must then meet.
    default = jnp.result_type(float)

    def in_default(v):
        return objective(v.astype(u.dtype)).astype(default)

    # optimistix linearises forward and transposes; our derivatives are written backward.
    @jax.custom_jvp
    def differentiable(v):
        return in_default(v)

    @differentiable.defjvp
    def _(primals, tangents):
        value, slope = jax.value_and_grad(in_default)(*primals)
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))
        return value, slope @ tangents[0]

    found = optx.minimise(
        lambda v, _: differentiable(v),
        optimiser,
        u.astype(default),
        max_steps=max_steps,
        throw=False,
    )
    converged = found.result == optx.RESULTS.successful
    best = found.value.astype(u.dtype)
    return _Runs(best, objective(best), converged, found.stats["num_steps"])


def _design(P: int, count: int, dtype) -> Float[Array, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d."""
    root = 2.0
    for _ in range(64):  # the positive solution of root^(P + 1) = root + 1
        root = (1 + root) ** (1 / (P + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, P + 1))) % 1.0
    return jnp.asarray(np.arcsin(2 * share - 1), dtype)


def _spread_out(
    design: Float[Array, "count P"], values: Float[Array, " count"], count: int
) -> Float[Array, "{count} P"]:
    """The best points of the design that are not neighbours of a better one already taken."""
    reach = 0.25 * design.shape[1] ** 0.5  # of a box of side 1; a float has no dtype
    shares = jnp.sin(design) / 2
    taken = []
    for _ in range(count):
        best = jnp.argmin(values)
        taken.append(design[best])
        near = jnp.linalg.norm(shares - shares[best][None], axis=1) < reach
        values = jnp.where(near, HUGE + values, values)
    return jnp.stack(taken)
