"""Symplectic integrators as Diffrax solvers, with constant steps chosen beforehand.

A one-step map x₁ = Ψ_h(x₀) is symplectic if (∂Ψ)ᵀ J ∂Ψ = J. Then, but for terms exponentially small
in 1/h, it follows the flow of a nearby Hamiltonian H + O(hᵖ): the error in H stays bounded instead
of growing (HLW, IX.8). That holds for one fixed map, so for a CONSTANT step: a step chosen from
the state makes a different map at every state, and the property is gone (HLW, VIII.1).

Two families, both with x = (q, p) in one array of shape (n,):

- Gauss collocation solves implicit equations and is symplectic for every Hamiltonian.
- Splitting is explicit, and needs H = T(p) + U(q).

Diffrax owns the loop over steps, the output and the gradients; Optimistix the implicit equations
and their derivative by the implicit function theorem.

Source: "HLW" below is Hairer, Lubich & Wanner, Geometric Numerical Integration, 2nd ed. (2006).
"""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar
from jaxtyping import Array, Float, Int


class Step(eqx.Module):
    """What one step from (t0, y0) to t1 needs: its signed size h and the field f(t, y)."""

    terms: Any
    args: Any
    t0: Array
    t1: Array
    y0: Float[Array, " n"]
    h: Float[Array, ""]

    def __init__(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any):
        if jax.tree.structure(y0) != jax.tree.structure(0) or jnp.ndim(y0) != 1:
            raise ValueError(
                f"A symplectic solver got a state of shape {jax.tree.map(jnp.shape, y0)}; it needs "
                "one array of shape (n,). For a batch, use `jax.vmap` over the initial states."
            )
        self.terms, self.args = terms, args
        self.t0, self.t1, self.y0 = jnp.asarray(t0), jnp.asarray(t1), jnp.asarray(y0)
        # The control carries the direction of time; its dtype may be narrower than the state's.
        self.h = jnp.asarray(terms.contr(t0, t1), self.y0.dtype)

    def field(self, t: Any, y: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.terms.vf(t, y, self.args)

    def time(self, fraction: float | np.ndarray) -> Array:
        return self.t0 + jnp.asarray(fraction, self.t0.dtype) * (self.t1 - self.t0)


class AbstractSymplecticSolver(diffrax.AbstractSolver):
    """A Diffrax solver whose step is a symplectic map for every constant step size.

    It gives no error estimate, so Diffrax refuses it together with an adaptive step size.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    nominal_order: AbstractClassVar[int]

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        """Between steps, as `SaveAt(ts=...)` asks: linear at order 2, else cubic Hermite.

        Neither is symplectic; make steps onto the times of interest, as `simulate` does.
        """
        if self.nominal_order == 2:
            return diffrax.LocalLinearInterpolation
        return diffrax.ThirdOrderHermitePolynomialInterpolation

    def order(self, terms: Any) -> int:
        """Return the order p: the error at a fixed time is O(hᵖ)."""
        del terms
        return self.nominal_order

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """Return the vector field at one point."""
        return terms.vf(t0, y0, args)

    def _dense_info(self, step: Step, y1: Float[Array, " n"]) -> dict[str, Array]:
        info = {"y0": step.y0, "y1": y1}
        if self.nominal_order > 2:  # XLA drops these two evaluations where nothing is interpolated.
            info["k0"] = step.h * step.field(step.t0, step.y0)
            info["k1"] = step.h * step.field(step.t1, y1)
        return info


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
            # Of a field with inputs, the time at which its own is zero.
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
