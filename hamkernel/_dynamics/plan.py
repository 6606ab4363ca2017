"""The steps of a solve: adaptive ones, or equal ones between the saved times."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from hamkernel import _require as require
from hamkernel._dynamics.equal_steps import AbstractSymplecticSolver, EqualSteps, step_counts
from hamkernel._dynamics.inputs import learned_at, refuse_symplectic
from hamkernel._dynamics.rounding import rounding

# Bounds the loop where the number of steps is not known beforehand: some seconds of a cheap field.
_MAX_STEPS = 2**20


class Plan(NamedTuple):
    """What Diffrax is told of the steps, and their number in each interval where it is known."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    saveat: diffrax.SaveAt
    max_steps: int
    counts: Int[Array, " intervals"] | None


def adaptive(
    solver: diffrax.AbstractSolver,
    ts: Float[Array, " T"],
    tolerances: tuple[Float[Array, ""], Float[Array, ""]],
    max_steps: int | None,
    jumps: bool,
) -> Plan:
    """Steps of these tolerances, rtol and atol; with `jumps` the field jumps at the saved times."""
    # Steps end on ts: the interpolant of Dopri8 is of lower order, and was measured to break
    # the conservation of energy by 1e-7 where the steps themselves keep it to 1e-10.
    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(*tolerances),
        step_ts=ts,
        # No step may have a stage on the other side of a jump.
        jump_ts=ts[1:-1] if jumps else None,
    )
    most = _MAX_STEPS + ts.size if max_steps is None else max_steps
    return Plan(solver, controller, diffrax.SaveAt(ts=ts), most, None)


def tolerances(
    field: Any, x0: Float[Array, " n"], rtol: float | None, atol: float | None
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The relative and the absolute tolerance, by default no less than the field rounds."""
    default = jnp.asarray(1e-10 if x0.dtype == jnp.float64 else 1e-5, x0.dtype)
    if rtol is None or atol is None:
        default = jnp.maximum(default, rounding(*learned_at(field, x0)))
    return _tolerance("rtol", rtol, default), _tolerance("atol", atol, default)


def equal(
    solver: diffrax.AbstractSolver,
    ts: Float[Array, " T"],
    dt: ArrayLike,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int | None,
) -> Plan:
    """The fewest equal steps of at most dt in every interval."""
    with eager(dt):
        dt = require.positive_scalar(dt, "dt")
    with eager(ts, dt):
        counts = step_counts(ts, dt)
        bound = _bound(counts, max_steps)
    steps = EqualSteps(solver, dt, adjoint, bound)
    saveat = diffrax.SaveAt(t0=True, steps=True)
    return Plan(steps, diffrax.StepTo(ts), saveat, ts.size - 1, counts)


def check_solver(
    solver: Any, dt: Any, rtol: float | None, atol: float | None, has_inputs: bool
) -> None:
    """Refuse what is no solver, and what it cannot do."""
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
    if has_inputs and isinstance(solver, AbstractSymplecticSolver):
        refuse_symplectic(solver)


def _tolerance(name: str, given: float | None, default: Array) -> Float[Array, ""]:
    """As an array: every new Python number would compile anew."""
    if given is None:
        return default
    with eager(given):
        return require.positive_scalar(given, name).astype(default.dtype)


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


def eager(*values: Any) -> AbstractContextManager[None]:
    """Operations on constants happen at once, also under jit, so that they can be checked."""
    if require.is_concrete(*values):
        return jax.ensure_compile_time_eval()
    return nullcontext()
