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

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField
from hamkernel._machine.devices import on_one_device
from hamkernel._machine.threads import one_blas_thread
from hamkernel._observations.kinds import AbstractObservations, as_states, both, observations
from hamkernel._show import described
from hamkernel._solvers.cholesky import AbstractSolver
from hamkernel._solvers.fit import checked_rows, fit
from hamkernel._solvers.means import Mean, without_mean
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._solvers.random_features import RandomFeatures
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._tuning.boxes import constants, typical_velocities
from hamkernel._tuning.objective import Criterion, Objective, criterion_of, criterion_of_rows
from hamkernel._tuning.plan import SearchPlan, size
from hamkernel._tuning.runs import keeping_the_best
from hamkernel._tuning.space import LOW_RANK_ROUNDINGS, ROUNDINGS, SearchSpace
from hamkernel._validation.folds import Folds
from hamkernel._validation.losses import check_memory


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
            data prefers values beyond it: see "How to choose" in the README.
        start_losses: the loss on all data at the end of the run from each start, shape (starts,):
            in the order of the starts, the caller's kernel first, or, where the runs were made on
            a subset or are finished with a low-rank loss, in ascending order before that.
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
    bounds: dict[str, tuple[float, float]]

    def __repr__(self) -> str:
        return described(self)


@one_blas_thread
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
) -> Tuned:
    """Tune every hyperparameter of K, and λ with them, down the gradient of a validation loss.

    The search starts from the given kernel and from `starts` − 1 further points, the best of a
    space-filling design in the box. All run in one compiled call, on a subset of 64 points (of
    256/n, with n > 4) if there are more; the best one is then finished on all data, and the best
    point that any of them saw is returned, or the given one where that is better on all data. New
    data of the same shape does not recompile, unless `Nystrom` takes another number of landmarks.
    Data that is spread over devices is gathered on one of them for the search; the field is fitted
    where the data lies.

    Args:
        K: a matrix-valued kernel; every inexact array leaf is a hyperparameter, and no Python
            float is one.
        X: states, shape (N, n); or observations, and then there is no Y. Every run is on all of
            them, with the dense loss.
        Y: measured velocities, shape (N, n).
        regularization: the first λ.
        folds: as in `cross_validation_loss`; give trajectory labels for data from trajectories.
        objective: "cross_validation", "generalized_cross_validation", "marginal_likelihood", or
            a function (K, X, Y, regularization) -> () to minimise. The second ignores fits that
            leave less than a fifth of the residuals free, tr(I − S) < 0.2 N n, since it is 0/0
            where a fit interpolates. For the third give K an amplitude, `1.0 * k`: built-in
            kernels have 1, and a signal that is larger than the prior's is explained as noise. In
            a function of your own, `hk.fit` and `hk.simulate` want `throw=False`, and the latter a
            constant `dt`: somewhere in the box they fail, and NaN is then a point that cannot win.
        frozen: names of what to keep: hyperparameters, such as "lengthscale", "regularization"
            or "terms[0].kernel.scale", and parts of K, such as "rest" of Sum(rest=…). A name
            means every hyperparameter that has it in its full name, at the end or before.
        bounds: {name: (low, high)} in place of the box from the data, in the units of the
            hyperparameter. A start outside the box is moved to its edge. A leaf h of your own has
            the box h ± 10 max(1, |h|), which may be too small, and of both signs: store what is
            positive as `log_…`, whose box is a factor of 1000 to either side, or say its bounds.
        starts: the number of runs.
        optimiser: an optimistix minimiser. If None, BFGS with tolerance 1e-3, on a subset 1e-2.
        max_steps: the largest number of steps of one run.
        solver: how the final field is fitted; see `fit`. With `Nystrom` and `RandomFeatures` the
            loss on all points is that of the low-rank fit, in O(N n r) memory; the landmarks are
            those of the best kernel on the subset, and of the tuned one for the field.
        mean: what is known already, x (n,) -> (n,), as in `fit`; with it, too, every run is on all
            data.
        progress: print each step of the default optimiser, through optimistix's own hook (of one
            of yours say verbose=True to itself): the logarithm of a loss, or the objective over
            its first value, and the coordinates u of the search, whose sines go from one end of
            the box to the other.

    Returns:
        A `Tuned`. NaN never comes out: points where the objective is not finite cannot win.

    Raises:
        TypeError: K is not matrix-valued or has complex leaves, the optimiser is not one of
            optimistix, a function is given that is to be large, or an argument is traced.
            ValueError: bad data, folds, names, or bounds; a dense loss that does not fit in
            memory. RuntimeError: the objective is finite nowhere.

    The flat limit. When λ rests on its lower bound and a lengthscale on its upper one, the data
    asks for a polynomial: the fit is good and its hyperparameters mean little.

    Units. A warning comes where the velocities of two coordinates differ 100 times in size: the
    loss, a sum of their squares, hardly sees the smaller one. Another warning names the Python
    floats in K, which are kept.

    The ridge. λ is never searched where rounding would decide. Unless `bounds` say what it may be,
    or it is frozen, it also stays so large that a field fitted to noise is smooth to about 1e-9
    and can be integrated: a few runs tell how much that is, then all of them search above it.
    """
    K = matrix_kernel(K)
    frozen = (frozen,) if isinstance(frozen, str) else frozen
    _check_options(K, X, Y, regularization, frozen, bounds, starts, max_steps)
    X, Y = as_states(X, Y)
    coarse = keeping_the_best(_minimiser(optimiser, progress, _COARSE))
    optimiser = keeping_the_best(_minimiser(optimiser, progress, _BFGS))
    _warn_of_constants(K)
    low_rank = isinstance(solver, Nystrom | RandomFeatures)
    roundings = LOW_RANK_ROUNDINGS if low_rank else ROUNDINGS
    if isinstance(X, AbstractObservations) or mean is not None:
        given = observations(X, Y), None
        rows, ridge, mean = checked_rows(K, *given, regularization, mean)
        rows = without_mean(K, rows, mean)
        check_memory(rows.targets, _RUN_COPIES)
        X, Y, measured = rows.points, typical_velocities(K, rows), rows.measured()
        criterion = criterion_of_rows(objective, given[0], rows, folds)
    else:
        X, Y = given = require.data(*both(X, Y))
        X, Y = on_one_device("X", X), on_one_device("Y", Y)
        K.check_dimension(X.shape[1])
        _warn_of_unequal_sizes(Y)
        ridge, measured = require.ridge(regularization, X.dtype), Y
        criterion = criterion_of(objective, len(X), folds)
    space = SearchSpace(K, X, Y, ridge, tuple(frozen), bounds or {}, roundings)
    thin = criterion.coarse_points(X)
    runs = optimiser, coarse, starts, max_steps
    plan = SearchPlan(criterion, X, Y, given, mean, size(measured), thin, solver, *runs)
    if plan.thinned and not low_rank:
        check_memory(X, _RUN_COPIES)
    found = plan.carry_out(space)
    if found is None:
        raise RuntimeError(
            "the objective is not finite at any start. Likely causes, in order: a kernel that "
            "is not positive definite or not finite (hk.check_kernel(k, X) tells); bounds in "
            "which no fit succeeds (pass bounds={'regularization': (low, high)} with a larger "
            "low); an objective of your own that returns NaN."
        )
    if not found.solved:
        fit(found.kernel, *given, found.regularization, solver=solver, mean=mean)  # raises
    if not found.space.allows(found.regularization):
        raise ValueError(
            f"no lambda within bounds={{'regularization': ...}} can be solved with in {X.dtype}: "
            f"for {found.kernel!r} it must be at least {float(found.regularization):.3g}."
        )
    runs, best = found.runs, found.best
    losses = criterion.losses(np.asarray(runs.value))
    return Tuned(
        kernel=found.kernel,
        regularization=found.regularization,
        loss=jnp.asarray(losses[best]),
        field=found.field,
        converged=jnp.asarray(runs.converged[best]),
        steps=jnp.asarray(runs.steps[best]),
        start_losses=jnp.asarray(losses),
        at_bounds=found.space.at_bounds(np.asarray(runs.u[best])),
        bounds=found.space.box(found.kernel, X),
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


def _minimiser(
    given: optx.AbstractMinimiser | None, progress: bool, ours: dict[bool, optx.BFGS]
) -> optx.AbstractMinimiser:
    """The optimiser of the caller, or ours."""
    if given is None:
        return ours[bool(progress)]
    if progress:
        raise ValueError(
            "progress is printed by the optimiser: pass verbose=True to yours, and no progress."
        )
    golden = isinstance(given, optx.GoldenSearch)  # minimises functions of one number
    if golden or not isinstance(given, optx.AbstractMinimiser):
        raise TypeError(
            "optimiser must be an optimistix minimiser of many variables, such as "
            "optimistix.BFGS(1e-3, 1e-3) or optimistix.OptaxMinimiser(optax.adam(0.1), 1e-3, 1e-3);"
            f" got {given!r}."
        )
    return given


def _warn_of_unequal_sizes(Y: Array) -> None:
    sizes = np.asarray(Y).std(axis=0)
    sizes = sizes[sizes > 0]
    if sizes.size and sizes.max() > _UNEQUAL * sizes.min():
        require.warn(
            f"the velocities of one coordinate are {sizes.max() / sizes.min():.3g} times as large "
            "as those of another, and a loss sums the squares of both: the small one may be lost "
            "in it. Choose units in which they are of similar size. With more than one degree of "
            "freedom x stays canonical only if [q_i][p_i] is the same product of units for every i."
        )


def _warn_of_constants(K: AbstractMatrixKernel) -> None:
    kept = constants(K)
    if kept:
        shown = ", ".join(f"{name} = {value:.4g}" for name, value in kept.items())
        require.warn(
            f"kept, and not tuned: {shown}. Python floats are constants to JAX. Store an array to "
            "have them tuned, jnp.array(0.3), and name it in frozen=... to have it kept."
        )


_UNEQUAL = 100.0  # in size, and so 10 000 in the loss


_RUN_COPIES = 5  # matrices of the size of the Gram that a run holds: 4.4 measured


def _bfgs(verbose: bool, tolerance: float) -> optx.BFGS:
    """BFGS whose line search quarters a step, which takes fewer evaluations than to halve it."""
    bfgs = optx.BFGS(tolerance, tolerance, verbose=verbose)
    return eqx.tree_at(lambda o: o.search, bfgs, optx.BacktrackingArmijo(decrease_factor=0.25))


# Made once: compiled functions are told apart by the functions inside these, too.
_BFGS = {verbose: _bfgs(verbose, 1e-3) for verbose in (False, True)}
_COARSE = {verbose: _bfgs(verbose, 1e-2) for verbose in (False, True)}
