"""`tune`: hyperparameters that minimise a validation loss in a box, from many starts.

The ridge. λ is searched relative to the Gram. The relative rounding error of the residuals of a fit
is about ε tr(G)/(Nλ), with ε the rounding of the dtype. We therefore require Nλ ≥ 100 ε tr(G) at
every point, for the G before the terms of an odd or even kernel cancel. For a smaller λ the loss is
rounding noise and may look very good. This matters in practice: a quadratic Hamiltonian is the flat
limit of the Gaussian kernel, so the loss of an oscillator improves along ℓ -> ∞, λ -> 0 until it is
only rounding noise.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

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
from hamkernel._machine import entry_point, precise_jit
from hamkernel._observations.kinds import AbstractObservations, inputs_or_parameters
from hamkernel._observations.measurements import observations
from hamkernel._posterior import Posterior, posterior_of_problem
from hamkernel._show import Shown, text
from hamkernel._solvers.fit import features_of_parts, field_of_problem
from hamkernel._solvers.lagrangian import field_of_torques, torque_data
from hamkernel._solvers.problem import AbstractSolver, Problem, check_solver, make_problem
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.lagrangian import Lagrangian, lagrangian_features
from hamkernel._tuning.lagrangian import StrongRows, likeliest, sizes_of_torques
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


class Tuned(Shown, eqx.Module):
    """The result of `tune`.

    Attributes:
        kernel: the kernel with its tuned hyperparameters.
        regularization: the tuned λ, shape ().
        loss: the objective at the tuned values, shape (); for "marginal_likelihood" the NEGATIVE
            log density.
        field: the fit to all data with them.
        hyperparameters: the tuned values by the names of `bounds`, in their units.
        converged: whether the best run met the tolerance on all data, shape (). If False, two
            steps of correction did not suffice: tune again from this kernel and λ.
        steps: the number of optimiser steps of the best run, shape ().
        at_bounds: the names of the hyperparameters that rest on a bound of the search box, with
            the coordinate, `kernel.lengthscale[1]`. The data prefers values beyond the bound: see
            "How to choose" in the README.
        start_losses: the loss on all data at the end of each run, shape (starts,). If every run
            used all the data: in the order of the starts, the caller's kernel first. Otherwise
            sorted in ascending order, with inf for runs whose end was not evaluated on all the
            data.
        bounds: the box that was searched: for each name the lowest and highest value.
        problem: the data, less the prior mean, with the tuned kernel and λ; None for a Lagrangian,
            whose field keeps its posterior.
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
    problem: Problem | None

    @property
    def noise_variance(self) -> Float[Array, ""]:
        """Nλ, the variance of the noise of a row of relative noise 1.

        It is in squared units of Y if the kernel has an amplitude that `tune` found, as
        `1.0 * hk.Gaussian(1.0)`; without one, in units of the field of a kernel of amplitude 1.
        """
        if self.problem is None:
            return self.regularization * len(cast(Any, self.field).residual)
        return self.problem.ridge

    @entry_point
    def posterior(self, solver: AbstractSolver | None = None) -> Posterior:
        """`hk.condition` on the same data, with the tuned kernel and λ.

        Args:
            solver: as in `hk.condition`, `Cholesky()` if None.

        Raises:
            TypeError: conjugate gradients, which keep no factor; a Lagrangian.

        Warns:
            UserWarning: the amplitude of the kernel is exactly 1, as in `hk.condition`.
        """
        if self.problem is None:
            raise TypeError(
                "the field of a Lagrangian keeps its posterior: take its bands, "
                "tuned.field.mass_matrix_deviation(q), .gravity_deviation(q), …"
            )
        return posterior_of_problem(self.problem, solver)

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        outcome = "converged" if bool(self.converged) else "did not converge"
        values = ", ".join(
            f"{name} = {text(value)}" for name, value in self.hyperparameters.items()
        )
        rows = [
            ("kernel", text(self.kernel)),
            ("found", values),
        ]
        # Without an amplitude in the kernel, N lambda is in units of the field's own size.
        if self.problem is None or all(k.has_amplitude for k in self.kernel.scalar_kernels):
            rows.append(
                ("noise", f"{text(jnp.sqrt(self.noise_variance))} of a row, the root of N lambda")
            )
        if self.at_bounds:
            rows.append(
                ("at bounds", f"{', '.join(self.at_bounds)}: the data prefer values beyond")
            )
        rows.append(("next", ".field, .posterior(), .bounds"))
        head = f"Tuned: {outcome} after {text(self.steps)} steps, loss {text(self.loss)}"
        return head, rows


@entry_point
def tune(
    K: AbstractMatrixKernel | Lagrangian,
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
    accelerations: Num[ArrayLike, "N m"] | None = None,
) -> Tuned:
    """Tune every hyperparameter of K, and λ with them, down the gradient of a validation loss.

    The search starts from the given kernel and from `starts` − 1 further points, the best of a
    space-filling design in the box. It uses a subset of 64 points (256/n points if n > 4). The ends
    of the runs and the given kernel are compared on all data, and the best run is finished there.
    From 2048/n points on, they are compared on 1024/n points instead, and two steps on all data
    correct the best run; each of these steps takes the time of some ten factorisations. If the
    given kernel still has the smaller loss on all the data, a last run starts from it. The returned
    loss is therefore never larger than that of the given kernel, apart from the penalty described
    under "The ridge".

    New data of the same shape does not recompile, unless `Nystrom` takes another number of
    landmarks. Data sharded over devices is gathered on one device for the search; the field is
    fitted on the devices of the data.

    Args:
        K: a matrix-valued kernel; every inexact array leaf is a hyperparameter, and no Python
            float is one.
        X: states, shape (N, n); or observations, without Y. N is then the number of all points,
            energies and functionals.
        Y: measured velocities, shape (N, n).
        regularization: the first λ.
        folds: as in `cross_validation_loss`. For data from trajectories pass the label of the
            trajectory of each point; see "The judge" below if there are few trajectories.
        objective: "cross_validation", "generalized_cross_validation", "marginal_likelihood", or
            a function (K, X, Y, regularization) -> () to minimise. Generalised cross-validation
            ignores fits with tr(I − S) < 0.2 N n, since it is 0/0 if a fit interpolates. For the
            marginal likelihood give K an amplitude, `1.0 * k`: built-in kernels have amplitude 1,
            and would explain a larger signal as noise. In a function of your own, call `hk.fit`
            and `hk.simulate` with `throw=False`, and `hk.simulate` with a constant `dt`: somewhere
            in the box they fail, and a point with NaN cannot win.
        frozen: names of hyperparameters to keep, such as "lengthscale", "regularization" or
            "terms[0].kernel.scale", and of parts of K, such as "rest" of Sum(rest=…). A name means
            every hyperparameter whose full name contains it.
        bounds: {name: (low, high)} in place of the box from the data, in the units of the
            hyperparameter. A start outside the box is moved to its edge. A leaf h of your own has
            the box h ± 10 max(1, |h|), which may be too small and contains both signs. Store a
            positive number as `log_…`, whose box is a factor of 1000 to either side, or pass
            bounds.
        starts: the number of runs.
        optimiser: an optimistix minimiser. If None, BFGS until the loss would fall by less than
            0.01 %, on the subset 0.1 %.
        max_steps: the largest number of steps of one run on one subset of the data; a step
            evaluates the loss once.
        solver: the solver of the final field; see `fit`. With `Nystrom` and `RandomFeatures` the
            loss on all points is the loss of the low-rank fit, in O(N n r) memory. Its landmarks
            belong to the best kernel on the subset; the field has landmarks of the tuned kernel.
        mean: the known part of the field, x (n,) -> (n,), as in `fit`.
        progress: print a line for each step: the number of points, the number of active runs, and
            the best loss.
        inputs: u at each state, for a `Controlled` kernel, shape (N, m). An objective of your own
            is then called with (K, data, None, regularization), data the velocities with inputs.
        parameters: θ at each state, for a `Family`, shape (N, p); likewise.
        accelerations: q̈ at each state, for a `Lagrangian`, shape (N, m). X are then states (q, v),
            Y torques, and the objective is the marginal likelihood. Of the arguments above only
            `max_steps` is used.

    Returns:
        A `Tuned`. Its numbers are finite, since points where the objective is not finite cannot
        win.

    Raises:
        TypeError: K is not matrix-valued or has complex leaves, the optimiser is not one of
            optimistix, the objective is `log_marginal_likelihood`, which should be maximised, or an
            argument is traced. ValueError: bad data, folds, names, or bounds; a dense loss that
            does not fit in memory. RuntimeError: the objective is finite nowhere.

    The flat limit. If λ rests on its lower bound and a lengthscale on its upper bound, the best
    field is nearly a polynomial: the fit is good and its hyperparameters mean little.

    Units. `tune` warns if the velocities of two coordinates differ by a factor of 100: the loss, a
    sum of squares, hardly depends on the smaller one. `tune` also warns of Python floats in K,
    which are not tuned, and of an undetermined scale, if every term of K has an amplitude and the
    objective is a cross-validation.

    The judge. If the kernel has an amplitude and the noise is independent and of one size,
    "marginal_likelihood" finds the better field, often by a factor of two. Otherwise it can lose up
    to 40 %, and cross-validation is safer: by runs if there are at least six runs, else by
    leave-one-out, folds="loo". With three runs no judge is reliably better than another
    (`tests/benchmarks/judges.py`). `tune` warns of fewer than five labels.

    A smaller loss. With almost no noise, a loss of 1e-12 need not mean a better field than a loss
    of 1e-9. The loss measures interpolation between the data, not extrapolation. If you know the
    variance of effects that no field of the state can explain, such as the pull of another planet,
    pass it as a bound of Nλ: bounds={"regularization": (variance / N, 1.0)}. Choosing the smoothest
    field within one standard error of the smallest loss was no better. With noise the errors of
    four such rules were 0.8 to 1.5 times as large (1.2 in the median), without noise 1.0 to 1.7
    times (`tests/benchmarks/tuning_ties.py`).

    Time. `tune` warns before a search of more than a minute.

    The ridge. λ stays above the rounding of the Gram. Unless λ is frozen or has `bounds`, a penalty
    also keeps cross-validation away from fields whose rounding errors are too large for an
    integrator, ‖a‖ tr(G) √ε > ‖y‖ for the coefficients a. The likelihood needs no penalty.
    """
    if isinstance(K, Lagrangian) or accelerations is not None:
        return _tuned_lagrangian(K, X, Y, accelerations, max_steps)
    frozen = (frozen,) if isinstance(frozen, str) else frozen
    _check_options(K, X, Y, regularization, frozen, bounds, starts, max_steps)
    _check_optimiser(optimiser)
    check_solver(solver)
    warn_of_constants(K)
    problem = make_problem(K, X, Y, regularization, mean, inputs, parameters)
    local = problem.to_one_device()
    K, rows = local.kernel, local.rows
    solver = features_of_parts() if (exact := solver is None and is_of_parts(K)) else solver
    # With 5000 pairs one loss takes .1 s, and the features of one state, for the size of K, 6 ms.
    size, sizing = (64, 1) if exact else (None, None)
    # The velocities of positions minus a known kinetic energy may be small, and are noise.
    if rows.states is not None and not exact:
        _warn_of_unequal_sizes(rows.states[1])
    inputs = inputs_or_parameters(inputs, parameters)
    plain = mean is None and inputs is None and not isinstance(X, AbstractObservations)
    data: Any = rows.states if plain else (observations(X, Y, inputs, part=True), None)
    criterion = criterion_of(objective, rows.count, folds, data)
    _warn_of_few_folds(criterion)
    low_rank = solver is not None and solver.is_low_rank and not criterion.custom
    if exact and low_rank:
        criterion = _low_rank_criterion(criterion, local, solver)  # no Gram, on few points either
    parts = parts_of(rows, criterion, dense=True)
    if not low_rank and not criterion.custom:
        check_memory(rows, SEARCH_COPIES)
    subset = rows if len(parts) == 1 else rows.subset(parts[0])[0]
    rms = velocity_rms(K, subset)
    # For a low-rank fit λ stays above the rounding below which `choose_landmarks` drops a column.
    roundings = 2e4 if low_rank else 100.0
    frozen, points, ridge = tuple(frozen), rows.points, problem.regularization
    sized = subset.points[:sizing]
    space = SearchSpace(K, points, rms, ridge, frozen, bounds or {}, roundings, sized)
    _warn_of_free_scale(space, criterion)
    search = Search(space, criterion, rows, rms, starts, max_steps, optimiser, progress, size)
    at_best_run = functools.partial(_criterion_at_best_run, space, criterion, local, solver)
    runs = search.runs(at_best_run if low_rank else None)
    check_finite_loss(best(runs))
    return _result(space, runs, starts, problem, solver)


def _low_rank_criterion(
    criterion: SearchCriterion, problem: Problem, solver: AbstractSolver | None
) -> SearchCriterion:
    """The criterion of the low-rank fit in the basis that the solver makes for a problem."""
    assert solver is not None
    basis = solver.low_rank_basis(problem.kernel, problem.rows, problem.regularization)
    assert basis is not None
    return dataclasses.replace(criterion, basis=basis)


def _criterion_at_best_run(
    space: SearchSpace,
    criterion: SearchCriterion,
    problem: Problem,
    solver: AbstractSolver | None,
    run: MinimiserRun,
) -> SearchCriterion:
    """The low-rank criterion for the kernel and λ of the best run."""
    kernel, regularization, _ = decode(space, jnp.asarray(run.best.u, space.low.dtype))
    problem_there = dataclasses.replace(problem, kernel=kernel, regularization=regularization)
    return _low_rank_criterion(criterion, problem_there, solver)


def check_finite_loss(run: MinimiserRun) -> None:
    if not run.best.value < np.inf:
        raise RuntimeError(
            "the objective is not finite at any start. Likely causes, in order: a kernel that "
            "is not positive definite or not finite (hk.check_kernel(k, X) tells); bounds in "
            "which no fit succeeds (pass bounds={'regularization': (low, high)} with a larger "
            "low); an objective of your own that returns NaN."
        )


def _result(
    space: SearchSpace,
    runs: MinimiserRun,
    starts: int,
    problem: Problem,
    solver: AbstractSolver | None,
) -> Tuned:
    """The `Tuned` of the best run: its kernel and λ, the field, and the record of the search."""
    best_run = best(runs)
    dtype = space.low.dtype
    kernel, regularization, size = decode(space, jnp.asarray(best_run.best.u, dtype))
    problem = dataclasses.replace(problem, kernel=kernel, regularization=regularization)
    field = field_of_problem(problem, solver)
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
        loss=jnp.asarray(best_run.best.loss, dtype),
        field=field,
        hyperparameters=space.values(kernel, regularization),
        converged=jnp.asarray(best_run.converged),
        steps=jnp.asarray(best_run.steps),
        start_losses=jnp.asarray(losses, dtype),
        at_bounds=space.active_bounds(best_run.best.u),
        bounds=space.bounds(size),
        problem=dataclasses.replace(problem, spread=None),
    )


def _tuned_lagrangian(K: Any, X: Any, Y: Any, accelerations: Any, max_steps: int) -> Tuned:
    """The likeliest kernel and noise of a machine, and the fit with them."""
    if not isinstance(K, Lagrangian):
        raise TypeError("accelerations= belongs to hk.Lagrangian(potential=…, inertia=…).")
    data = torque_data(K, X, Y, accelerations)
    features = lagrangian_features(K, data.states)
    end = likeliest(
        features, StrongRows(data), sizes_of_torques(features.kernel, data), steps=max_steps
    )
    deviation = jnp.exp(jnp.log(end.deviation).mean())
    field = field_of_torques(end.kernel, data, deviation)
    regularization = deviation**2 / len(data.states)
    return Tuned(
        kernel=cast(Any, end.kernel),
        regularization=regularization,
        loss=jnp.asarray(end.loss, deviation.dtype),
        field=cast(Any, field),
        hyperparameters=end.values | {RIDGE: regularization},
        converged=jnp.asarray(end.converged),
        steps=jnp.asarray(end.steps),
        start_losses=jnp.asarray([end.loss], deviation.dtype),
        at_bounds=end.at_bounds,
        bounds=end.bounds,
        problem=None,
    )


decode = precise_jit(lambda space, u: space.decode(u))


def _check_optimiser(optimiser: optx.AbstractMinimiser | None) -> None:
    golden = isinstance(optimiser, optx.GoldenSearch)  # minimises functions of one number
    if golden or not (optimiser is None or isinstance(optimiser, optx.AbstractMinimiser)):
        raise TypeError(
            "optimiser must be an optimistix minimiser of many variables, such as "
            "optimistix.BFGS(1e-3, 1e-3) or optimistix.OptaxMinimiser(optax.adam(0.1), 1e-3, 1e-3);"
            f" got {optimiser!r}."
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
    """Warn if the velocities of one coordinate are much smaller than those of another."""
    sizes = np.asarray(Y).std(axis=0)
    sizes = sizes[sizes > 0]
    if sizes.size and sizes.max() > 100 * sizes.min():  # a factor of 10 000 in the loss
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
    # The loss over few runs is noisy. On the pendulum of the paper, with three runs, the field
    # error was .164 by cross-validation and .048 by the likelihood (`tests/benchmarks/judges.py`).
    if count < 5:
        require.warn(
            f"the labels in folds make {count} folds, and cross-validation by fewer than "
            "5 runs is a noisy judge. Compare with objective='marginal_likelihood' and "
            "an amplitude, `1.0 * k`, or with folds='loo': the docstring of hk.tune has numbers."
        )


def _warn_of_free_scale(space: SearchSpace, criterion: SearchCriterion) -> None:
    """Warn of amplitudes on all terms if the loss depends only on their ratios to λ."""
    free = {space.names[i] for i in space.free}
    if not criterion.logarithmic or RIDGE not in free or space.ridge_interval is not None:
        return
    if _has_amplitude(space):
        require.warn(
            "every term of this kernel has an amplitude, and cross-validation does not see a "
            "factor that is common to all of them and to lambda: their values mean nothing but "
            "for their ratios. Leave one amplitude away, freeze it, frozen='scale', or pass "
            "objective='marginal_likelihood', which knows the scale."
        )


def _has_amplitude(space: SearchSpace) -> bool:
    """Whether every term of the kernel has a free amplitude."""
    leaves, structure = jax.tree.flatten(eqx.filter(space.kernel, eqx.is_inexact_array))
    last = np.cumsum([leaf.size for leaf in leaves]) - 1
    free = [leaf if i in space.free else None for leaf, i in zip(leaves, last, strict=True)]
    terms = jax.tree.unflatten(structure, free).scalar_kernels
    return bool(terms) and all(k.has_amplitude for k in terms)


SEARCH_COPIES = 5  # matrices of the size of the Gram that a search holds; 4.4 were measured
