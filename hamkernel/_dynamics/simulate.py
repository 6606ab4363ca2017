"""Trajectories of any vector field, by Diffrax.

Diffrax takes most of a second to import, so it loads when `simulate` is called and not with the
package.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._dynamics.inputs import (
    AtStart,
    Between,
    Driven,
    inputs_of,
    learned_at,
    refuse_missing,
    refuse_symplectic,
)
from hamkernel._dynamics.rounding import rounding

if TYPE_CHECKING:
    import diffrax

# Bounds the loop where the number of steps is not known beforehand: some seconds of a cheap field.
_MAX_STEPS = 2**20


class _Autonomous(eqx.Module):
    """The field as Diffrax calls it, f(t, x, args); it keeps what the field knows of itself."""

    field: Callable[[Array], Array]

    @property
    def is_separable(self) -> bool:
        return bool(getattr(self.field, "is_separable", False))

    def __call__(self, t: Any, x: Float[Array, " n"], args: Any) -> Float[Array, " n"]:
        del t, args
        return self.field(x)


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

    from hamkernel._dynamics.equal_steps import (
        AbstractSymplecticSolver,
        EqualSteps,
        step_counts,
    )

    with _eager(x0):
        x0 = _initial_state(x0)
    with _eager(ts):
        given = require.times(ts, least=2)
        ts = require.elapsed(given, x0.dtype)
    if solver is None:
        solver = diffrax.Dopri8()
    _check_solver(solver, dt, rtol, atol)
    field = _uncompiled(field)
    start = None
    if inputs is None:
        refuse_missing(field)
        right_hand_side: Any = _Autonomous(field)
    else:
        if isinstance(solver, AbstractSymplecticSolver):
            refuse_symplectic(solver)
        # Functions get the caller's time, samples have times of their own: those since the start.
        start = given[0].astype(x0.dtype) if callable(inputs) else jnp.zeros((), x0.dtype)
        held = dt is not None and between == "held" and not callable(inputs)
        driven: Any = field  # of x and u
        right_hand_side = Driven(driven, inputs_of(inputs, ts, between), held)
        field = AtStart(right_hand_side, start)
    _check_field(field, x0)
    if max_steps is not None:
        max_steps = require.count(max_steps, "max_steps")
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    if not isinstance(adjoint, diffrax.AbstractAdjoint):
        raise TypeError(
            f"adjoint must be one of Diffrax, such as diffrax.ForwardMode(); got {adjoint!r}."
        )

    if dt is None:
        counts = None
        default = jnp.asarray(1e-10 if x0.dtype == jnp.float64 else 1e-5, x0.dtype)
        if rtol is None or atol is None:
            default = jnp.maximum(default, rounding(*learned_at(field, x0)))
        # Steps end on ts: the interpolant of Dopri8 is of lower order, and was measured to break
        # the conservation of energy by 1e-7 where the steps themselves keep it to 1e-10.
        controller = diffrax.ClipStepSizeController(
            diffrax.PIDController(
                rtol=_tolerance("rtol", rtol, default, x0.dtype),
                atol=_tolerance("atol", atol, default, x0.dtype),
            ),
            step_ts=ts,
            # A held input jumps there: no step may have a stage on the other side.
            jump_ts=ts[1:-1] if inputs is not None and not callable(inputs) else None,
        )
        saveat = diffrax.SaveAt(ts=ts)
        max_steps = _MAX_STEPS + ts.size if max_steps is None else max_steps
    else:
        with _eager(dt):
            dt = require.positive_scalar(dt, "dt")
        with _eager(ts, dt):
            counts = step_counts(ts, dt)
            bound = _bound(counts, max_steps)
        solver = EqualSteps(solver, dt, adjoint, bound)
        controller = diffrax.StepTo(ts)
        saveat = diffrax.SaveAt(t0=True, steps=True)
        max_steps = ts.size - 1

    meter = diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter()
    try:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(right_hand_side),
            solver,
            ts[0],
            ts[-1],
            None,
            x0,
            start,
            saveat=saveat,
            stepsize_controller=controller,
            adjoint=adjoint,
            max_steps=max_steps,
            throw=False,
            progress_meter=meter,
        )
    except TypeError as error:
        if "forward-mode" not in str(error) or isinstance(adjoint, diffrax.ForwardMode):
            raise
        raise TypeError(
            f"{type(adjoint).__name__} is for reverse mode alone: pass adjoint="
            "diffrax.ForwardMode() for jax.jvp and jax.jacfwd, adjoint=diffrax.DirectAdjoint() for "
            "jax.hessian."
        ) from error
    solution, failed = _finished(solution, given.astype(x0.dtype))
    if counts is not None:  # Diffrax counted the save intervals; the steps are inside them.
        total = require.on_host(counts).sum()
        steps = {"num_steps": jnp.asarray(total), "num_accepted_steps": jnp.asarray(total)}
        solution = eqx.tree_at(lambda s: s.stats, solution, {**solution.stats, **steps})
    return _successful(solution, failed, field, x0, dt is not None) if throw else solution


_FilterJit: Any = type(eqx.filter_jit(abs))  # Equinox does not name it


def _uncompiled(field: Any) -> Any:
    """What a compiled field compiles: it knows what it is, and the loop around it is compiled."""
    # Not behind every `__wrapped__`: what functools.wraps names is another field.
    while isinstance(field, (jax.stages.Wrapped, _FilterJit)):
        field = field.__wrapped__
    return field


def _eager(*values: Any) -> AbstractContextManager[None]:
    """Operations on constants happen at once, also under jit: they are checked and counted."""
    if require.is_concrete(*values):
        return jax.ensure_compile_time_eval()
    return nullcontext()


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


def _check_field(field: Callable[[Array], Array], x0: Float[Array, " n"]) -> None:
    dtype = require.velocity(field, x0).dtype
    if dtype != x0.dtype:
        cure = f"Pass x0 as {dtype}, or cast the output of the field."
        if not jnp.issubdtype(dtype, jnp.floating):
            cure = "Let it return floats."
        raise TypeError(f"field maps {x0.dtype} to {dtype}; the solution has one dtype. {cure}")


def _check_solver(solver: Any, dt: Any, rtol: float | None, atol: float | None) -> None:
    import diffrax

    from hamkernel._dynamics.equal_steps import AbstractSymplecticSolver

    name = type(solver).__name__
    if isinstance(solver, type) or not isinstance(solver, diffrax.AbstractSolver):
        shown = solver.__name__ if isinstance(solver, type) else name
        raise TypeError(f"solver is {shown}; an instance is needed, such as hk.ImplicitMidpoint().")
    if isinstance(solver, diffrax.SemiImplicitEuler):
        raise ValueError(
            "SemiImplicitEuler takes two vector fields, one for q and one for p; simulate has one. "
            "hk.StormerVerlet() is symplectic too, of order 2, and takes the whole field."
        )
    if dt is not None and not (rtol is None and atol is None):
        raise ValueError("rtol and atol belong to adaptive steps, but dt sets constant ones.")
    if dt is None and isinstance(solver, AbstractSymplecticSolver):
        raise ValueError(
            f"{name} is symplectic and needs a constant step: pass dt=... An adaptive step would "
            "destroy symplecticity, since a step chosen from the state is a different map at every "
            "state, and the energy would drift as with any other method. A tenth of the shortest "
            "period or less is a start."
        )
    if dt is None and not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            f"{name} estimates no error, so the step cannot adapt to one: pass dt=... for constant "
            "steps, or use a solver such as diffrax.Dopri8()."
        )


def _tolerance(name: str, given: float | None, default: Array, dtype: Any) -> Float[Array, ""]:
    """An array, because a number in a compiled program would compile anew for every value."""
    if given is None:
        return default
    with _eager(given):
        return require.positive_scalar(given, name).astype(dtype)


def _bound(counts: Int[Array, " intervals"], max_steps: int | None) -> int:
    """A number of steps that no save interval exceeds, where the counts are known."""
    if not require.is_concrete(counts):
        return max_steps or _MAX_STEPS
    each = np.asarray(counts)
    most = int(each.max())
    if most >= np.iinfo(np.int32).max:
        raise ValueError(
            "dt is so small that more than two thousand million steps lie between two of ts: "
            "take a larger dt, in the unit of time of ts."
        )
    if max_steps is None:  # A power of two: neighbouring values of dt share one compiled loop.
        return 2 ** (most - 1).bit_length()
    if each.sum() > max_steps:
        raise ValueError(
            f"dt cuts ts into {each.sum()} steps, more than max_steps={max_steps}: take a larger "
            "dt, or leave max_steps None."
        )
    return max_steps


@eqx.filter_jit
def _finished(solution: Any, ts: Float[Array, " T"]) -> tuple[Any, Bool[Array, ""]]:
    """The solution with the caller's times, and whether it failed.

    Times that it did not reach stay infinite. Where a state is not finite the result says so:
    adaptive steps reject such states, constant ones go through them.
    """
    import diffrax

    RESULTS: Any = diffrax.RESULTS
    reached_end = solution.result == RESULTS.successful
    overflowed = reached_end & ~jnp.isfinite(solution.ys).all()
    result = RESULTS.where(overflowed, RESULTS.nonfinite, solution.result)
    reached = jnp.where(jnp.isfinite(solution.ts), ts, solution.ts.astype(ts.dtype))
    solution = eqx.tree_at(
        lambda s: (s.t0, s.t1, s.ts, s.result), solution, (ts[0], ts[-1], reached, result)
    )
    return solution, result != RESULTS.successful


def _successful(
    solution: Any,
    failed: Bool[Array, ""],
    field: Any,
    x0: Float[Array, " n"],
    constant_steps: bool,
) -> Any:
    """The solution, if the solve reached its end in finite numbers."""
    import diffrax

    RESULTS = diffrax.RESULTS

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
