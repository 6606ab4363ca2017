"""Runs of an optimiser of optimistix that the caller has chosen."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from hamkernel._tuning.descent import Run
from hamkernel._tuning.part import SearchObjective

_HUGE = 1e30  # stands for an objective that is not finite: an optimiser backs away from it


def checked_optimiser(given: optx.AbstractMinimiser, progress: bool) -> optx.AbstractMinimiser:
    """The caller's optimiser, if it is one of many variables."""
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


def minimised(
    objective: SearchObjective, run: Run, optimiser: optx.AbstractMinimiser, max_steps: int
) -> None:
    """Go on with one run."""
    # The wrapper's last point is the best it has seen; that of BFGS is so by itself.
    if not isinstance(optimiser, optx.BFGS):
        optimiser = optx.BestSoFarMinimiser(optimiser)
    dtype = objective.speed.dtype
    u, value, loss, converged, steps = _minimised(
        objective, jnp.asarray(run.u, dtype), optimiser, max_steps
    )
    run.u, run.value, run.loss = np.asarray(u, float), float(value), float(loss)
    run.converged, run.steps = bool(converged), run.steps + int(steps)


@eqx.filter_jit
def _minimised(objective: SearchObjective, u, optimiser, max_steps: int):
    # optimistix starts its best loss in the default dtype, which float32 data must then meet.
    default = jnp.result_type(float)
    # Tolerances are those of numbers ~ 1; an objective of the caller's has any size.
    unit = jnp.ones((), default)
    if objective.criterion.own:
        size = jnp.abs(objective(u)[0]).astype(default)
        unit = jnp.where((size > 0) & (size < jnp.inf), size, unit)

    def in_default(v):
        value = objective(v.astype(u.dtype))[0].astype(default)
        return jnp.where(value < jnp.inf, value / unit, _HUGE)

    differentiable = with_slope_backward(in_default)

    found = optx.minimise(
        lambda v, _: differentiable(v),
        optimiser,
        u.astype(default),
        max_steps=max_steps,
        throw=False,
    )
    best = found.value.astype(u.dtype)
    value, loss = objective(best)
    converged = found.result == optx.RESULTS.successful
    return best, value, loss, converged, found.stats["num_steps"]


def with_slope_backward(fn: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """`fn` of a vector for optimistix, which linearises forward, and then transposes.

    The derivatives of losses are written backward; a slope that is not finite counts as zero.
    """

    @jax.custom_jvp
    def differentiable(v):
        return fn(v)

    @differentiable.defjvp
    def _(primals, tangents):
        value, slope = jax.value_and_grad(fn)(*primals)
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))
        return value, slope @ tangents[0]

    return differentiable
