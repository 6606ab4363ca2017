"""Equal steps between saved times."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class EqualSteps(diffrax.AbstractSolver):
    """One long step made of ⌈(t1 − t0)/dt⌉ equal steps of another solver.

    With `diffrax.StepTo(ts)` every time in `ts` is the end of a step: nothing is interpolated, and
    memory is that of the saved points. The steps between two times have one size, at most `dt`,
    whatever the state. Each long step starts at time 0, so that a small step is not lost in the
    rounding of a large time; the `args` of a field with inputs are that time.
    """

    solver: diffrax.AbstractSolver
    dt: Float[Array, ""]
    adjoint: diffrax.AbstractAdjoint
    max_steps: int = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int | None:
        """Return the order of the solver that makes the steps."""
        return self.solver.order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        """Return no state: every long step begins afresh."""

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """Return the vector field at one point."""
        return self.solver.func(terms, t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, None, dict[str, Any], None, diffrax.RESULTS]:
        """Make the equal steps."""
        del solver_state, made_jump
        span = t1 - t0
        solution = diffrax.diffeqsolve(
            terms,
            self.solver,
            jnp.zeros_like(span),
            span,
            span / equal_steps(span, self.dt),
            y0,
            # With inputs, the time of the caller at which the time of this step is zero.
            None if args is None else args + t0,
            adjoint=self.adjoint,
            max_steps=self.max_steps,
            throw=False,
        )
        # Infinite where the steps did not reach t1, as what Diffrax itself has not reached.
        reached = solution.result == diffrax.RESULTS.successful
        y1 = jax.tree.map(lambda y: jnp.where(reached, y[-1], jnp.inf), solution.ys)
        return y1, None, {"y0": y0, "y1": y1}, None, solution.result


@jax.jit
def step_counts(ts: Float[Array, " T"], dt: Float[Array, ""]) -> Int[Array, " T-1"]:
    """The number of equal steps in each interval of ts."""
    return equal_steps(ts[1:] - ts[:-1], dt).astype(int)


def equal_steps(span: Float[Array, "..."], dt: Float[Array, ""]) -> Float[Array, "..."]:
    """The number of equal steps of at most `dt` that fill `span`: whole, at least 1.

    With √eps of slack: a span of 10 dt that rounding made longer is 10 steps and not 11.
    """
    slack = 1 - float(jnp.finfo(span.dtype).eps) ** 0.5
    return jnp.maximum(jnp.ceil(span / jnp.asarray(dt, span.dtype) * slack), 1)
