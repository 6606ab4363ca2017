"""Hyperparameters by following the gradient of a validation loss, inside a box, from many starts.

The ridge. λ is searched relative to the Gram. The residuals of a fit lose about ε tr(G)/(Nλ) of
their digits, ε the rounding of the dtype, so Nλ ≥ 100 ε tr(G) is required at every point, with the
G before the terms of an odd or even kernel cancel. A loss below this bound is rounding noise, and
may look very good. This matters: a quadratic Hamiltonian is the flat limit of the Gaussian kernel,
so the loss of an oscillator improves along ℓ -> ∞, λ -> 0 until only noise is left of it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._closed_forms import Folds
from hamkernel._features import is_of_parts
from hamkernel._fields.base import AbstractField, Mean
from hamkernel._machine import compiled, full_precision, one_blas_thread
from hamkernel._observations.kinds import AbstractObservations, inputs_or_parameters
from hamkernel._observations.measurements import observations
from hamkernel._show import described
from hamkernel._solvers.fit import check_solver, features_of_parts, field_of_problem
from hamkernel._solvers.problem import AbstractSolver, Problem, problem
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._tuning.minimiser import MinimiserRun
from hamkernel._tuning.objective import (
    Criterion,
    Objective,
    SearchCriterion,
    criterion_of,
    parts_of,
)
from hamkernel._tuning.search import Search, best
from hamkernel._tuning.space import RIDGE, SearchSpace, constants, velocity_rms
from hamkernel._validation import check_memory


class Tuned(eqx.Module):
    """The result of `tune`.

    Attributes:
        kernel: the kernel with its tuned hyperparameters.
        regularization: the tuned λ, shape ().
        loss: the objective there, shape (); for "marginal_likelihood" the NEGATIVE log density.
        field: the fit to all data with them.
        hyperparameters: the tuned values by the names of `bounds`, in their units.
        converged: whether the run that found the best point met the tolerance on all data, shape
            (). If two steps of correction did not suffice, tune again from the kernel and λ found.
        steps: the number of its optimiser steps, shape ().
        at_bounds: the names of the hyperparameters that rest on a bound of the search box, and of
            which coordinate: `kernel.lengthscale[1]`. The data prefers values beyond it: see "How
            to choose" in the README.
        start_losses: the loss on all data at the end of the run from each start, shape (starts,):
            in the order of the starts, the caller's kernel first, or, where the runs were made on
            a subset or are finished with a low-rank loss, in ascending order; inf of those that
            were not looked at there.
        bounds: the box that was searched: for each name the lowest and highest value.
    """

    kernel: AbstractMatrixKernel
    regularization: Float[Array, ""]
    loss: Float[Array, ""]
    field: AbstractField
    hyperparameters: dict[str, Array]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    start_losses: Float[Array, " starts"]
    at_bounds: tuple[str, ...] = eqx.field(static=True)
    bounds: dict[str, tuple[float, float]]

    def __repr__(self) -> str:
        return described(self)


@one_blas_thread
@full_precision
def tune(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"] | AbstractObservations,
    Y: Num[ArrayLike, "N n"] | None = None,
    regularization: ArrayLike = 1e-3,
    folds: Folds = 5,
    *,
    objective: Criterion | Objective = "cross_validation",
    frozen: str | Sequence[str] = (),
    bounds: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    starts: int = 16,
    optimiser: optx.AbstractMinimiser | None = None,
    max_steps: int = 64,
    solver: AbstractSolver | None = None,
    mean: Mean | None = None,
    progress: bool = False,
    inputs: Num[ArrayLike, "N m"] | None = None,
    parameters: Num[ArrayLike, "N p"] | None = None,
) -> Tuned:
    """Tune every hyperparameter of K, and λ with them, down the gradient of a validation loss.

    The search starts from the given kernel and from `starts` − 1 further points, the best of a
    space-filling design in the box, on a subset of 64 points (of 256/n, with n > 4) if there are
    more. Where the runs end is compared on all data, together with the given point, and the best is
    finished there. From 2048/n points on this is done on 1024/n of them, and the best is corrected
    on all data by two more steps: each takes the time of some ten factorisations. Where the given
    point is better than that on all data, the part has misled and a run from there is finished: but
    for the penalty of "The ridge" below, the loss is never above that of the given point. New data
    of the same shape does not recompile, unless `Nystrom` takes another number of landmarks. Data
    sharded over devices is gathered on one of them for the search; the field is fitted where the
    data lies.

    Args:
        K: a matrix-valued kernel; every inexact array leaf is a hyperparameter, and no Python
            float is one.
        X: states, shape (N, n); or observations, and then there is no Y, and N is the number of
            all: points, energies, functionals.
        Y: measured velocities, shape (N, n).
        regularization: the first λ.
        folds: as in `cross_validation_loss`; give trajectory labels for data from trajectories,
            and see "The judge" below where there are few.
        objective: "cross_validation", "generalized_cross_validation", "marginal_likelihood", or
            a function (K, X, Y, regularization) -> () to minimise. The second ignores fits that
            leave less than a fifth of the residuals free, tr(I − S) < 0.2 N n, since it is 0/0
            where a fit interpolates. For the third give K an amplitude, `1.0 * k`: built-in kernels
            have amplitude 1, and a signal larger than that is taken for noise. In a function of
            your own, call `hk.fit` and `hk.simulate` with `throw=False`, and the latter with a
            constant `dt`: somewhere in the box they fail, and a point with NaN cannot win.
        frozen: names of what to keep: hyperparameters, such as "lengthscale", "regularization"
            or "terms[0].kernel.scale", and parts of K, such as "rest" of Sum(rest=…). A name
            means every hyperparameter that has it in its full name, at the end or before.
        bounds: {name: (low, high)} in place of the box from the data, in the units of the
            hyperparameter. A start outside the box is moved to its edge. A leaf h of your own has
            the box h ± 10 max(1, |h|), which may be too small, and of both signs: store what is
            positive as `log_…`, whose box is a factor of 1000 to either side, or say its bounds.
        starts: the number of runs.
        optimiser: an optimistix minimiser. If None, BFGS until the loss would fall by less than
            0.01 %, on the subset 0.1 %.
        max_steps: the largest number of steps of one run, on each part of the data; a step is one
            look at the loss.
        solver: how the final field is fitted; see `fit`. With `Nystrom` and `RandomFeatures` the
            loss on all points is that of the low-rank fit, in O(N n r) memory; the landmarks are
            those of the best kernel on the subset, and of the tuned one for the field.
        mean: what is known already, x (n,) -> (n,), as in `fit`.
        progress: print a line for each step: on how many points, how many runs go on, and the best
            loss.
        inputs: of a `Controlled` kernel, shape (N, m). An objective of your own is then called
            with (K, data, None, regularization), data the velocities with their inputs.
        parameters: of a `Family`, shape (N, p); likewise.

    Returns:
        A `Tuned`. NaN never comes out: points where the objective is not finite cannot win.

    Raises:
        TypeError: K is not matrix-valued or has complex leaves, the optimiser is not one of
            optimistix, a function is given that is to be large, or an argument is traced.
            ValueError: bad data, folds, names, or bounds; a dense loss that does not fit in
            memory. RuntimeError: the objective is finite nowhere.

    The flat limit. When λ rests on its lower bound and a lengthscale on its upper one, the data
    asks for a polynomial: the fit is good and its hyperparameters mean little.

    Units. `tune` warns if the velocities of two coordinates differ 100 times in size: the loss, a
    sum of their squares, hardly depends on the smaller one. It also warns of Python floats in K,
    which are not tuned, and of a free scale, if every term of K has an amplitude and the objective
    is a cross-validation.

    The judge. With an amplitude on the kernel and noise that is independent and of one size,
    "marginal_likelihood" finds the better field, often by a factor of two. Where the noise or the
    prior are not like that it can lose up to 40 %, and cross-validation is the safer judge: by
    runs, if there are at least six of them, else by leave-one-out, folds="loo". With three runs no
    judge is reliably better than another (`tests/benchmarks/judges.py`). `tune` warns of fewer than
    five labels.

    A smaller loss. Where there is next to no noise, a loss of 1e-12 need not mean a better field
    than one of 1e-9: it says how well points between others are met, and not how the field goes on
    beside them. If you know the size of what no field of the state can explain, such as the pull
    of another planet, say so: Nλ is its variance, bounds={"regularization": (variance / N, 1.0)}.
    The smoothest field within one standard error of the least loss was no better: with noise its
    error was 0.8 to 1.5 times as large, 1.2 in the median, by four rules, and without noise 1.0 to
    1.7 (`tests/benchmarks/tuning_ties.py`). So the least loss decides.

    Time. A search that will take more than a minute says so before the long part of it.

    The ridge. λ is never searched where rounding would decide. Unless λ is frozen or has `bounds`,
    a penalty also keeps cross-validation away from fields with rounding errors too large to be
    integrated, ‖a‖ tr(G) √ε > ‖y‖ for the coefficients a; the likelihood needs none.
    """
    frozen = (frozen,) if isinstance(frozen, str) else frozen
    _check_options(K, X, Y, regularization, frozen, bounds, starts, max_steps)
    _check_optimiser(optimiser)
    check_solver(solver)
    warn_of_constants(K)
    given = problem(K, X, Y, regularization, mean, inputs, parameters)
    alone = given.on_one_device()
    K, rows = alone.kernel, alone.rows
    exact = solver is None and is_of_parts(K)
    solver = features_of_parts() if exact else solver
    # With 5000 pairs a look takes .1 s, and features of a state, which show the size of K, 6 ms.
    looks, sizing = (64, 1) if exact else (None, None)
    # What a known kinetic energy leaves of the velocities of positions may be small, and is noise.
    if rows.states is not None and not exact:
        _warn_of_unequal_sizes(rows.states[1])
    inputs = inputs_or_parameters(inputs, parameters)
    plain = mean is None and inputs is None and not isinstance(X, AbstractObservations)
    data: Any = rows.states if plain else (observations(X, Y, inputs, part=True), None)
    criterion = criterion_of(objective, rows.count, folds, data)
    _warn_of_few_folds(criterion)
    low_rank = solver is not None and solver.is_low_rank and not criterion.custom
    if exact and low_rank:
        criterion = _of_basis(criterion, alone, solver)  # no Gram, on few points either
    parts = parts_of(rows, criterion, dense=True)
    if not low_rank and not criterion.custom:
        check_memory(rows, SEARCH_COPIES)
    few = rows if len(parts) == 1 else rows.subset(parts[0])[0]
    rms = velocity_rms(K, few)
    # For a low-rank fit λ stays above the rounding at which `choose_landmarks` drops a column.
    roundings = 2e4 if low_rank else 100.0
    kept, points = tuple(frozen), rows.points
    space = SearchSpace(
        K, points, rms, given.regularization, kept, bounds or {}, roundings, few.points[:sizing]
    )
    _warn_of_free_scale(space, criterion)
    search = Search(space, criterion, rows, rms, starts, max_steps, optimiser, progress, looks)

    of_low_rank = functools.partial(_of_low_rank, space, criterion, alone, solver)
    runs = search.runs(of_low_rank if low_rank else None)
    check_found(best(runs))
    return _tuned(space, runs, starts, given, solver)


def _of_basis(
    criterion: SearchCriterion, given: Problem, solver: AbstractSolver | None
) -> SearchCriterion:
    """The criterion of the low-rank fit in the basis that the solver makes for a problem."""
    assert solver is not None
    basis = solver._basis(given.kernel, given.rows, given.regularization)
    assert basis is not None
    return criterion.with_basis(basis)


def _of_low_rank(
    space: SearchSpace,
    criterion: SearchCriterion,
    given: Problem,
    solver: AbstractSolver | None,
    run: MinimiserRun,
) -> SearchCriterion:
    """The same for the kernel and λ of the best run."""
    kernel, regularization, _ = decode(space, jnp.asarray(run.best.u, space.low.dtype))
    there = dataclasses.replace(given, kernel=kernel, regularization=regularization)
    return _of_basis(criterion, there, solver)


def check_found(found: MinimiserRun) -> None:
    if not found.best.value < np.inf:
        raise RuntimeError(
            "the objective is not finite at any start. Likely causes, in order: a kernel that "
            "is not positive definite or not finite (hk.check_kernel(k, X) tells); bounds in "
            "which no fit succeeds (pass bounds={'regularization': (low, high)} with a larger "
            "low); an objective of your own that returns NaN."
        )


def _tuned(
    space: SearchSpace,
    runs: MinimiserRun,
    starts: int,
    given: Problem,
    solver: AbstractSolver | None,
) -> Tuned:
    """The result of the best run: its kernel, the fit with it, and the record of the search."""
    found = best(runs)
    dtype = space.low.dtype
    kernel, regularization, size = decode(space, jnp.asarray(found.best.u, dtype))
    given = dataclasses.replace(given, kernel=kernel, regularization=regularization)
    field = field_of_problem(given, solver)
    if not space.allows(regularization):
        raise ValueError(
            f"no lambda within bounds={{'regularization': ...}} can be solved with in {dtype}: "
            f"for {kernel!r} it must be at least {float(regularization):.3g}."
        )
    losses = np.full(starts, np.inf)
    losses[: len(runs.u)] = runs.best.loss
    return Tuned(
        kernel=kernel,
        regularization=regularization,
        loss=jnp.asarray(found.best.loss, dtype),
        field=field,
        hyperparameters=space.values(kernel, regularization),
        converged=jnp.asarray(found.converged),
        steps=jnp.asarray(found.steps),
        start_losses=jnp.asarray(losses, dtype),
        at_bounds=space.at_bounds(found.best.u),
        bounds=space.bounds(size),
    )


decode = compiled(lambda space, u: space.decode(u))


def _check_optimiser(given: optx.AbstractMinimiser | None) -> None:
    golden = isinstance(given, optx.GoldenSearch)  # minimises functions of one number
    if golden or not (given is None or isinstance(given, optx.AbstractMinimiser)):
        raise TypeError(
            "optimiser must be an optimistix minimiser of many variables, such as "
            "optimistix.BFGS(1e-3, 1e-3) or optimistix.OptaxMinimiser(optax.adam(0.1), 1e-3, 1e-3);"
            f" got {given!r}."
        )


def _check_options(K, X, Y, regularization, frozen, bounds, starts, max_steps) -> None:
    if not require.is_concrete(K, X, Y, regularization):
        raise TypeError(
            "tune cannot be traced: between its compiled searches it decides in Python. Call it "
            "outside of jax.jit, jax.vmap and jax.grad. The losses, such as "
            "hk.cross_validation_loss, work inside."
        )
    if not (isinstance(frozen, tuple | list) and all(isinstance(name, str) for name in frozen)):
        raise TypeError(f"frozen must be a name or a tuple of names, got {frozen!r}.")
    if bounds is not None and not isinstance(bounds, Mapping):
        raise TypeError(f"bounds must be a dict, {{name: (low, high)}}, got {bounds!r}.")
    require.count(starts, "starts")
    require.count(max_steps, "max_steps")


# The warnings of `tune` before the search: data and kernels whose best values mean little.


def _warn_of_unequal_sizes(Y: Array) -> None:
    """Warn where the velocities of one coordinate are lost beside those of another."""
    sizes = np.asarray(Y).std(axis=0)
    sizes = sizes[sizes > 0]
    if sizes.size and sizes.max() > 100 * sizes.min():  # and so 10 000 times in the loss
        require.warn(
            f"the velocities of one coordinate are {sizes.max() / sizes.min():.3g} times as large "
            "as those of another, and a loss sums the squares of both: the small one may be lost "
            "in it. Choose units in which they are of similar size. With more than one degree of "
            "freedom x stays canonical only if [q_i][p_i] is the same product of units for every i."
        )


def warn_of_constants(K: AbstractMatrixKernel) -> None:
    """Warn of Python floats in the kernel, which are no hyperparameters."""
    kept = constants(K)
    if kept:
        shown = ", ".join(f"{name} = {value:.4g}" for name, value in kept.items())
        require.warn(
            f"kept, and not tuned: {shown}. Python floats are constants to JAX. Store an array to "
            "have them tuned, jnp.array(0.3), and name it in frozen=... to have it kept."
        )


def _warn_of_few_folds(criterion: SearchCriterion) -> None:
    """Warn of so few labels that the loss depends on the choice of the groups."""
    if criterion.partition is None or criterion.custom or not criterion.partition.of_labels:
        return
    count = len(criterion.partition.folds)
    # The loss over few runs is noisy: on the pendulum of the paper, with three runs, the field
    # error was .164 where that of the likelihood was .048 (`tests/benchmarks/judges.py`).
    if count < 5:
        require.warn(
            f"the labels in folds make {count} folds, and cross-validation by fewer than "
            "5 runs is a noisy judge. Compare with objective='marginal_likelihood' and "
            "an amplitude, `1.0 * k`, or with folds='loo': the docstring of hk.tune has numbers."
        )


def _warn_of_free_scale(space: SearchSpace, criterion: SearchCriterion) -> None:
    """Warn of amplitudes on all terms where the loss depends on their ratios to λ alone."""
    free = {space.names[i] for i in space.free}
    if not criterion.logarithmic or RIDGE not in free or space.given_ridge is not None:
        return
    if _has_amplitude(space):
        require.warn(
            "every term of this kernel has an amplitude, and cross-validation does not see a "
            "factor that is common to all of them and to lambda: their values mean nothing but "
            "for their ratios. Leave one amplitude away, freeze it, frozen='scale', or pass "
            "objective='marginal_likelihood', which knows the scale."
        )


def _has_amplitude(space: SearchSpace) -> bool:
    """Whether factors that are searched multiply all of the kernel."""
    leaves, structure = jax.tree.flatten(eqx.filter(space.kernel, eqx.is_inexact_array))
    last = np.cumsum([leaf.size for leaf in leaves]) - 1
    free = [leaf if i in space.free else None for leaf, i in zip(leaves, last, strict=True)]
    terms = jax.tree.unflatten(structure, free).scalar_kernels
    return bool(terms) and all(k.has_amplitude for k in terms)


SEARCH_COPIES = 5  # matrices of the size of the Gram that the loop over a loss holds: 4.4 measured
