"""Trajectories of any vector field, by Diffrax.

Diffrax takes most of a second to import, so it loads when `simulate` is called and not with the
package.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._dynamics.inputs import Between
from hamkernel._dynamics.right_hand_side import check_field, right_hand_side

if TYPE_CHECKING:
    import diffrax


def simulate(
    field: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    x0: Num[ArrayLike, " n"],
    ts: Num[ArrayLike, " T"],
    solver: diffrax.AbstractSolver | None = None,
    dt: ArrayLike | None = None,
    *,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int | None = None,
    progress: bool = False,
    adjoint: diffrax.AbstractAdjoint | None = None,
    throw: bool = True,
    inputs: Callable[[Float[Array, ""]], Any] | Num[ArrayLike, "T m"] | None = None,
    between: Between = "held",
) -> diffrax.Solution:
    """Integrate ẋ = f(x) from x0 at time ts[0], and return the states at the times ts.

    Without `dt` the step adapts to the tolerances. With `dt` every interval [ts[i], ts[i+1]] is cut
    into the fewest equal steps of at most `dt` (to √ε of it), so that each saved state is the end
    of a step and none is interpolated. Symplectic solvers need this: they keep the energy error
    bounded because every step is the same map, and a step chosen from the state is a different map
    each time. With equally spaced `ts` all steps are of one size; unequal spacing changes the size
    (by at most dt divided by the spacing) from interval to interval, still independently of the
    state.

    Args:
        field: x (n,) ↦ ẋ (n,), a function or a PyTree such as a fitted field or a system.
        x0: initial state, shape (n,); for a batch, `jax.vmap` over it. It sets the dtype.
        ts: times, shape (T,), T ≥ 2, strictly increasing, in the unit of time of the field.
        solver: any Diffrax solver; `diffrax.Dopri8()` if None. Symplectic: `ImplicitMidpoint`,
            `GaussLegendre4`, `GaussLegendre6` for every H; `StormerVerlet`, `Yoshida4` for
            H = T(p) + U(q).
        dt: the largest step; required by a symplectic solver.
        rtol: relative tolerance of the adaptive step. If None, 1e-10, and 1e-5 in float32; of a
            learned field no less than its rounding at x0, ε ‖Σⱼ |K(x0, xⱼ) aⱼ|‖ / ‖f(x0)‖, and at
            most 1e-6: steps that are asked for more digits than the field has are all rejected.
        atol: absolute tolerance, likewise, in the units of x.
        max_steps: the most steps of the whole solve, or between two saved times where `dt` is given
            and it or `ts` is traced. If None, enough where the number is known, else 2²⁰. It bounds
            the memory of gradients (as its square root).
        progress: show a progress bar (tqdm); with `dt` it moves at every saved time.
        adjoint: how Diffrax differentiates; None is its default, for reverse mode alone.
            For `jax.jvp` and `jax.jacfwd` pass `diffrax.ForwardMode()`, for `jax.hessian`
            `diffrax.DirectAdjoint()`.
        throw: raise if the solve fails. If False, look at `.result`.
        inputs: u of a field (x, u) ↦ ẋ: a function t ↦ (m,) of the time as it is in ts, or samples
            (T, m) at ts. An explicit time is one: `inputs=lambda t: jnp.array([t])`.
        between: samples are "held" until the next one, or "linear" in between.

    Returns:
        A `diffrax.Solution`: `.ts` (T,), `.ys` (T, n), `.stats["num_steps"]`.

    Raises:
        ValueError: a shape, time or value does not fit; a symplectic solver without `dt`; a solver
            that cannot estimate its error without `dt`; a splitting of a field that is not known to
            be separable; more steps of `dt` than `max_steps`; inputs that are missing, of another
            shape, or together with a symplectic solver.
        TypeError: `field` is no function of one JAX array that returns one, of the same dtype;
            `solver` or `adjoint` is none of Diffrax; x0 is of less precision than float32; forward
            mode through the default adjoint.
        RuntimeError: the solve failed: too many steps, the implicit equations of a step did not
            converge, or the state overflowed. Usually the remedy is a smaller `dt`.
    """
    import diffrax

    from hamkernel._dynamics.outcome import counted, finished, successful
    from hamkernel._dynamics.plan import adaptive, check_solver, eager, equal, tolerances
    from hamkernel._dynamics.solve import checked_adjoint, followed

    with eager(x0):
        x0 = _initial_state(x0)
    with eager(ts):
        given = require.times(ts, least=2)
        ts = require.elapsed(given, x0.dtype)
    solver = diffrax.Dopri8() if solver is None else solver
    check_solver(solver, dt, rtol, atol, inputs is not None)
    rhs = right_hand_side(field, inputs, ts, given[0], between, dt is not None)
    check_field(rhs.at_start, x0)
    if max_steps is not None:
        max_steps = require.count(max_steps, "max_steps")
    adjoint = checked_adjoint(adjoint)
    if dt is None:
        jumps = inputs is not None and not callable(inputs)
        plan = adaptive(solver, ts, tolerances(rhs.at_start, x0, rtol, atol), max_steps, jumps)
    else:
        plan = equal(solver, ts, dt, adjoint, max_steps)
    solution = followed(rhs, plan, ts, x0, adjoint, progress)
    solution, failed = finished(solution, given.astype(x0.dtype))
    if plan.counts is not None:
        solution = counted(solution, plan.counts)
    if not throw:
        return solution
    return successful(solution, failed, rhs.at_start, x0, dt is not None)


def _initial_state(x0: ArrayLike) -> Float[Array, " n"]:
    x0 = require.floating(x0, "x0")
    if x0.ndim != 1 or x0.size == 0:
        hint = (
            " For a batch, use `jax.vmap(lambda x: hk.simulate(field, x, ts).ys)(x0)`."
            if x0.ndim > 1
            else ""
        )
        raise ValueError(f"x0 has shape {x0.shape}; one state of shape (n,) is needed.{hint}")
    require.single_or_double(x0.dtype, "x0 has")
    return require.finite(x0, "x0")
