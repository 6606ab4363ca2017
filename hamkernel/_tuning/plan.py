"""The searches of `tune`, one after the other: a few runs that see the noise, then all of them.

The loss can be right where the field is already rough. The coefficients are the residual over Nλ,
so f(x) rounds at about 1e-2 ε tr(G)/(Nλ) times the residual, and an adaptive step, or the
iteration of an implicit one, that is asked for more digits fails. So where the best field has
Nλ < √ε tr(G) ‖y − f‖/‖y‖ that becomes the bound: of 18 fields, for polynomial and trigonometric H
with noise of 0, 1 and 10 %, all can then be integrated, and 5 of those from noisy data cannot
without it (`tests/benchmarks/tuned_fields.py`). The runs above the bound start anew, and not from
where those without it ended: that can be in a valley that the bound cuts off. A few runs
tell the residual of noisy data; where they were wrong about it, their bound is taken back.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from hamkernel._fields.base import AbstractField
from hamkernel._solvers.cholesky import AbstractSolver
from hamkernel._solvers.fit import fit
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._solvers.random_features import RandomFeatures
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._tuning.objective import HUGE, SearchCriterion, basis_of
from hamkernel._tuning.runs import Runs, decode, finish, scouts, search, spread_starts
from hamkernel._tuning.space import SearchSpace

# The least misfit, as a share of Y, that a few runs tell. What is smaller is less of the data than
# of the search.
_NOISE = 1e-3


class Found(NamedTuple):
    """The runs in a space, as NumPy arrays, and the fit to all data at the best of their points."""

    space: SearchSpace
    runs: Runs
    best: int
    kernel: AbstractMatrixKernel
    regularization: Float[Array, ""]
    field: AbstractField
    misfit: float  # the residual over Y, in size; 1 where there is none

    @property
    def fitted(self) -> tuple[AbstractMatrixKernel, Float[Array, ""]]:
        """The kernel and λ."""
        return self.kernel, self.regularization

    @property
    def solved(self) -> bool:
        """Whether the fit is. Conjugate gradients can fail near the rounding of the Gram."""
        return bool(jnp.isfinite(self.field.residual).all())


@dataclasses.dataclass(frozen=True)
class SearchPlan:
    """What every search of one call has in common; (N, n) `X`, `Y` are on one device."""

    criterion: SearchCriterion
    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    data: tuple[Any, Any]  # X and Y where the caller has them, or observations and None
    mean: Any
    size: float  # of what was measured, its norm
    rows: np.ndarray  # of the subset that the runs are made on
    solver: AbstractSolver | None
    optimiser: optx.AbstractMinimiser
    coarse: optx.AbstractMinimiser  # of runs on a subset
    starts: int
    max_steps: int

    @property
    def thinned(self) -> bool:
        return len(self.rows) < len(self.X)

    def carry_out(self, space: SearchSpace) -> Found | None:
        """The best of all runs, in this space or in one whose least λ suits the noise.

        None if no run found a point where the objective is finite.
        """
        few = scouts(self.starts) if space.may_rise else self.starts
        runs = self._run(space, self._not_run(space), 0, few)
        scouted = self._found(space, runs) if few < self.starts else None
        noisy = scouted is not None and scouted.misfit > _NOISE
        found = self._smoothed(scouted) if noisy else None
        if found is None or found.space.holds_up(*found.fitted, self.X, found.misfit):
            found = self._best_of_all(space, runs, few)
        return self._smoothed(found) or found

    def _smoothed(self, found: Found | None) -> Found | None:
        """The best of all runs where λ suits the misfit of `found`; None where it did already."""
        if found is None:
            return None
        smooth = found.space.smooth(*found.fitted, self.X, found.misfit)
        if smooth is found.space:
            return None
        return self._best_of_all(smooth, self._not_run(smooth), 0)

    def _not_run(self, space: SearchSpace) -> Runs:
        return spread_starts(space, *self._part, self.starts)

    def _best_of_all(self, space: SearchSpace, runs: Runs, made: int) -> Found | None:
        """The best of all the runs, of which so many have been made."""
        runs = self._run(space, runs, made, self.starts)
        return self._found(space, self._finished(space, runs))

    def _run(self, space: SearchSpace, runs: Runs, first: int, stop: int) -> Runs:
        if first == stop:
            return runs
        which = np.array([first, stop])
        optimiser = self.coarse if self.thinned else self.optimiser
        return search(space, *self._part, runs, which, optimiser, self.max_steps)

    @functools.cached_property
    def _part(self) -> tuple[SearchCriterion, Array, Array, float]:
        """The criterion, X and Y of the subset, and how many points stand behind each of them."""
        X, Y = (self.X[self.rows], self.Y[self.rows]) if self.thinned else (self.X, self.Y)
        return self.criterion.on(self.rows), X, Y, len(self.X) / len(self.rows)

    def _finished(self, space: SearchSpace, runs: Runs) -> Runs:
        """The runs with their losses on all data, and the best one finished there."""
        low_rank = isinstance(self.solver, Nystrom | RandomFeatures) and not self.criterion.own
        if not (self.thinned or low_rank):
            return runs
        criterion = self.criterion
        if low_rank:
            kernel, ridge = decode(space, runs.u[np.argmin(runs.value)], self.X)
            criterion = criterion.with_basis(basis_of(self.solver, kernel, ridge, self.X))
        return finish(space, criterion, self.X, self.Y, runs, self.optimiser, self.max_steps)

    def _found(self, space: SearchSpace, runs: Runs) -> Found | None:
        runs = jax.tree.map(np.asarray, runs)  # NumPy compiles nothing
        best = int(runs.value.argmin())
        if not runs.value[best] < HUGE:
            return None
        kernel, ridge = decode(space, jnp.asarray(runs.u[best]), self.X)
        field = fit(kernel, *self.data, ridge, solver=self.solver, mean=self.mean, throw=False)
        misfit = float(field.residual_norm) / self.size
        misfit = misfit if np.isfinite(misfit) else 1.0
        return Found(space, runs, best, kernel, ridge, field, misfit)


def size(values: Array) -> float:
    return float(np.maximum(jnp.linalg.norm(values), np.finfo(float).tiny))
