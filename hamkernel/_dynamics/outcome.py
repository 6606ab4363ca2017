"""How a solve ended: the times and states that it reached, and why it failed."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hamkernel import _require as require

RESULTS: Any = diffrax.RESULTS


@eqx.filter_jit
def finished(solution: Any, ts: Float[Array, " T"]) -> tuple[Any, Bool[Array, ""]]:
    """The solution with the caller's times, and whether it failed.

    Times that it did not reach stay infinite. A state that is not finite is a failure: adaptive
    steps reject such states, constant ones go through them.
    """
    reached_end = solution.result == RESULTS.successful
    overflowed = reached_end & ~jnp.isfinite(solution.ys).all()
    result = RESULTS.where(overflowed, RESULTS.nonfinite, solution.result)
    reached = jnp.where(jnp.isfinite(solution.ts), ts, solution.ts.astype(ts.dtype))
    solution = eqx.tree_at(
        lambda s: (s.t0, s.t1, s.ts, s.result), solution, (ts[0], ts[-1], reached, result)
    )
    return solution, result != RESULTS.successful


def counted(solution: Any, counts: Int[Array, " intervals"]) -> Any:
    """The solution with the number of equal steps; Diffrax counted the intervals around them."""
    total = jnp.asarray(require.on_host(counts).sum())
    steps = {"num_steps": total, "num_accepted_steps": total}
    return eqx.tree_at(lambda s: s.stats, solution, {**solution.stats, **steps})


def successful(
    solution: Any,
    failed: Bool[Array, ""],
    field: Any,
    x0: Float[Array, " n"],
    constant_steps: bool,
) -> Any:
    """The solution, if the solve reached its end in finite numbers."""

    def message() -> str:
        reason = (
            "Too many steps, a step whose equations could not be solved, or a state that "
            "overflowed or became NaN."
        )
        cure = "Take a smaller dt."
        if require.is_concrete(solution.result):
            if require.is_concrete(field, x0) and not jnp.isfinite(field(x0)).all():
                return (
                    "The solve failed: the field is NaN or infinite at x0 already. So is one from "
                    "a fit that failed with throw=False."
                )
            if solution.result == RESULTS.nonfinite:
                return (
                    "The state overflowed or became NaN. The step is too large for the solver, or "
                    "the field has no solution over this time. Take a smaller dt, or a shorter "
                    "time."
                )
            reason = RESULTS[solution.result]
        if not constant_steps:
            cure = (
                "Pass larger tolerances, such as rtol=1e-6, atol=1e-6: a learned field rounds, the "
                "more the smaller its regularization, and an adaptive step that is asked for more "
                "digits shrinks without end. Or allow more with max_steps."
            )
        return f"The solve failed: {reason} {cure} It may also be that the field has no solution."

    ys = require.value(solution.ys, require.on_host(failed), message, RuntimeError)
    return eqx.tree_at(lambda s: s.ys, solution, ys)
