"""`simulate`: trajectories of any vector field, by Diffrax."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._fields.expansions import KernelField
from hamkernel._fields.joined import AbstractJoinedField
from hamkernel._gram import field_rounding, size_of_terms
from hamkernel._kernels.functions import as_pytree
from hamkernel._machine import compiled_without_emitters, full_precision, precise_jit
from hamkernel._structures.laws import outside
from hamkernel._symplectic import AbstractSymplecticSolver, EqualSteps, step_counts

Interpolation = Literal["held", "linear"]

# The largest number of steps if it is not known in advance: a few seconds for a cheap field.
_MAX_STEPS = 2**20
_RESULTS: Any = diffrax.RESULTS


@full_precision
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
    between: Interpolation = "held",
) -> diffrax.Solution:
    """Integrate ẋ = f(x) from x0 at time ts[0], and return the states at the times ts.

    Without `dt` the step adapts to the tolerances. With `dt` we cut every interval
    [ts[i], ts[i+1]] into the fewest equal steps of at most `dt`, so each saved state is the end of
    a step. Symplectic solvers need `dt`: their energy error stays bounded because every step is the
    same map, and an adaptive step changes the map. With equally spaced `ts` all steps have one
    size. With unequal spacing the size changes between intervals, by a fraction of at most
    dt/spacing, but never with the state.

    Args:
        field: x (n,) ↦ ẋ (n,), a function or a PyTree such as a fitted field or a system.
        x0: initial state, shape (n,), which sets the dtype; for a batch of states use `jax.vmap`.
        ts: times, shape (T,), T ≥ 2, strictly increasing, in the unit of time of the field.
        solver: any Diffrax solver; `diffrax.Dopri8()` if None. Symplectic: `ImplicitMidpoint`,
            `GaussLegendre4`, `GaussLegendre6` for every H; `StormerVerlet`, `Yoshida4` for
            H = T(p) + U(q).
        dt: the largest step; required by a symplectic solver.
        rtol: relative tolerance of the adaptive step. If None, 1e-10, and 1e-5 in float32. For a
            learned field the default is at least the rounding of f(x0),
            ε ‖Σⱼ |K(x0, xⱼ) aⱼ|‖ / ‖f(x0)‖ up to 1e-6, since a tolerance below rounding would
            reject every step.
        atol: absolute tolerance in the units of x; the default is as for `rtol`.
        max_steps: the largest number of steps of the solve, or between two saved times if `dt` is
            given and `dt` or `ts` is traced. If None, the number of steps if it is known, else 2²⁰.
            The memory of gradients grows with the square root of `max_steps`.
        progress: show a progress bar (tqdm); with `dt` it moves at every saved time.
        adjoint: the method by which Diffrax differentiates. None is reverse mode. For `jax.jvp` and
            `jax.jacfwd` pass `diffrax.ForwardMode()`, for `jax.hessian` `diffrax.DirectAdjoint()`.
        throw: whether a failed solve raises an error. If False, look at `.result`.
        inputs: u of a field (x, u) ↦ ẋ: a function t ↦ (m,) of the time of ts, or samples (T, m) at
            ts. For explicit time pass `inputs=lambda t: jnp.array([t])`.
        between: whether samples of inputs are "held" until the next sample, or "linear".

    Returns:
        A `diffrax.Solution`: `.ts` (T,), `.ys` (T, n), `.stats["num_steps"]`.

    Raises:
        ValueError: a shape, time or value does not fit. `dt` is missing for a symplectic solver, or
            for a solver without an error estimate, or needs more than `max_steps` steps. The field
            is not known to be separable, and the solver splits H. Inputs are missing, have another
            shape, or come with a symplectic solver.
        TypeError: `field` does not map a JAX array to another of the same dtype; `solver` or
            `adjoint` is no object of Diffrax; x0 has less precision than float32; or you use
            forward mode with the default adjoint.
        RuntimeError: the solve failed: too many steps, the implicit equations of a step did not
            converge, or the state overflowed. Usually a smaller `dt` helps. Or the data do not
            identify the mass matrix of a `LagrangianField`.

    Warns:
        UserWarning: the path of a fitted field leaves the data, or the arguments of a `Shared` law
            leave the range of the data.
    """
    with require.eager(x0):
        x0 = _initial_state(x0)
    with require.eager(ts):
        caller_times = require.times(ts, least=2)
        ts = require.elapsed_times(caller_times, x0.dtype)
    solver = diffrax.Dopri8() if solver is None else solver
    _check_solver(solver, dt, rtol, atol, inputs is not None)
    rhs, start = _right_hand_side(field, inputs, ts, caller_times[0], between, dt is not None)
    at_start = rhs.field if inputs is None else jax.tree_util.Partial(_initial_velocity, rhs, start)
    _check_field(at_start, x0)
    if max_steps is not None:
        max_steps = require.count(max_steps, "max_steps")
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    if not isinstance(adjoint, diffrax.AbstractAdjoint):
        raise TypeError(
            f"adjoint must be one of Diffrax, such as diffrax.ForwardMode(); got {adjoint!r}."
        )
    if dt is None:
        jumps = inputs is not None and not callable(inputs)
        tolerances = _tolerances(rhs, start, x0, rtol, atol)
        steps = _adaptive_steps(solver, ts, tolerances, max_steps, jumps)
    else:
        steps = _equal_steps(solver, ts, dt, adjoint, max_steps)
    solution = _integrate(rhs, steps, ts, x0, start, adjoint, progress)
    solution, failed = _restore_times(solution, caller_times.astype(x0.dtype))
    if steps.counts is not None:  # Diffrax counted the intervals, not the equal steps
        total = jnp.asarray(require.host_array(steps.counts).sum())
        stats = {**solution.stats, "num_steps": total, "num_accepted_steps": total}
        solution = eqx.tree_at(lambda s: s.stats, solution, stats)
    if require.is_concrete(field, solution.ys):
        warning = outside(getattr(field, "kernel", None), solution.ys)
        warning = warning or _leaves_the_data(rhs, start, caller_times, solution.ys)
        if warning:
            require.warn(warning)
    if not throw:
        return solution
    message = jax.tree_util.Partial(_reason_of_failure, solution, at_start, x0, dt is None)
    ys = require.value(solution.ys, require.host_array(failed), message, RuntimeError)
    return eqx.tree_at(lambda s: s.ys, solution, ys)


def _initial_state(x0: ArrayLike) -> Float[Array, " n"]:
    x0 = require.floating(x0, "x0")
    if x0.ndim != 1 or x0.size == 0:
        batch = " For a batch, use `jax.vmap(lambda x: hk.simulate(field, x, ts).ys)(x0)`."
        raise ValueError(
            f"x0 has shape {x0.shape}; one state of shape (n,) is needed.{batch * (x0.ndim > 1)}"
        )
    require.single_or_double(x0.dtype, "x0 has")
    return require.finite(x0, "x0")


# The field and its inputs.


class Samples(eqx.Module):
    """The inputs u(t) from samples at the times ts, held or linearly interpolated."""

    ts: Float[Array, " T"]
    values: Float[Array, "T m"]
    held: bool = eqx.field(static=True)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " m"]:
        last = len(self.ts) - 2
        index = jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, last)
        before = self.values[index]
        if self.held:
            return before
        share = (t - self.ts[index]) / (self.ts[index + 1] - self.ts[index])
        return before + share * (self.values[index + 1] - before)


class OneInput(eqx.Module):
    """The input u(t), shape (1,), from a function that returns a number."""

    function: Callable[[Array], Any]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " 1"]:
        return self.function(t)[None]


class RightHandSide(eqx.Module):
    """The field f(t, x, args) for Diffrax. If there are inputs, it takes u at `args` + t."""

    field: Any  # x -> velocity; or x, u -> velocity
    inputs: Callable[[Array], Any] | None
    # Whether u keeps its value at t = 0 for a whole interval, so that the last stage of its last
    # step does not use the next sample.
    held: bool = eqx.field(static=True)

    @property
    def is_separable(self) -> bool:
        """Whether H = T(p) + U(q), according to the field."""
        return self.inputs is None and bool(getattr(self.field, "is_separable", False))

    def __call__(self, t: Any, x: Float[Array, " n"], args: Any) -> Float[Array, " n"]:
        if self.inputs is None:
            return self.field(x)
        u = self.inputs(args if self.held else args + t)
        return self.field(x, require.floating(u, "the value of inputs").astype(x.dtype))


def _initial_velocity(rhs: RightHandSide, start: Any, x: Float[Array, " n"]) -> Float[Array, " n"]:
    """The velocity f(x, u) with the inputs u at the first time, `start`."""
    return rhs(jnp.zeros_like(start), x, start)


_FilterJit: Any = type(eqx.filter_jit(abs))  # a private class of Equinox


def _right_hand_side(
    field: Any,
    inputs: Any,
    ts: Float[Array, " T"],
    first: Float[Array, ""],
    between: Interpolation,
    constant_steps: bool,
) -> tuple[RightHandSide, Float[Array, ""] | None]:
    """The field with its inputs, and the time of the inputs at the start, for `args`."""
    # We unwrap `jax.jit`: the function inside may have attributes such as `is_separable`, and
    # Diffrax compiles the loop anyway. We do not unwrap `functools.wraps`, since its function may
    # be a different field.
    while isinstance(field, (jax.stages.Wrapped, _FilterJit)):
        field = field.__wrapped__
    if getattr(field, "refusal", ""):
        raise RuntimeError(field.refusal)
    if inputs is None:
        if getattr(field, "takes_inputs", False):
            has, alone = "inputs", "Without inputs simulate its drift, field.drift."
            if hasattr(field, "at"):
                has, alone = "parameters", "Simulate one member, field.at(θ)."
            raise ValueError(
                f"this {type(field).__name__} has {has}: hk.simulate(field, x0, ts, inputs=u), u a "
                f"function t -> (m,) or samples (T, m) at ts. {alone}"
            )
        return RightHandSide(field, None, held=False), None
    mismatch = require.signature_mismatch(field, ts, ts)
    if mismatch is not None:
        raise TypeError(
            f"field takes ({mismatch}); with inputs it is called with two arguments, the state "
            "x and its inputs u: a field of a Controlled kernel, hk.systems.Driven(system, G), or "
            "a function of yours. To simulate it without inputs, leave them out."
        )
    # We call functions with the caller's time. The times of samples count from the start.
    start = first.astype(ts.dtype) if callable(inputs) else jnp.zeros((), ts.dtype)
    held = constant_steps and between == "held" and not callable(inputs)
    return RightHandSide(field, _inputs(inputs, ts, between), held), start


def _inputs(inputs: Any, ts: Float[Array, " T"], between: Interpolation) -> Callable[[Array], Any]:
    """The inputs u as a function of time, from a function or from samples at the times ts."""
    if between not in ("held", "linear"):
        raise ValueError(f"between must be 'held' or 'linear'; got {between!r}.")
    if callable(inputs):
        mismatch = require.signature_mismatch(inputs, ts[0])
        if mismatch is not None:
            raise TypeError(
                f"inputs takes ({mismatch}); it is called with one argument, the time. Feedback "
                "closes the loop instead: hk.simulate(lambda x: field(x, law(x)), x0, ts)."
            )
        with require.traceable("inputs"):
            out = jax.eval_shape(inputs, jax.ShapeDtypeStruct((), ts.dtype))
        shape = getattr(out, "shape", type(out).__name__)
        if shape == ():
            return OneInput(as_pytree(inputs))
        if not isinstance(shape, tuple) or len(shape) != 1:
            raise ValueError(
                f"inputs(t) returns shape {shape}; one vector u of shape (m,) is needed, such as "
                "jnp.array([jnp.sin(t)])."
            )
        return as_pytree(inputs)
    values = require.floating(inputs, "inputs")
    values = values[:, None] if values.shape == ts.shape else values
    if values.ndim != 2 or len(values) != len(ts):
        hint = " A constant input is lambda t: jnp.array([…])." if values.ndim < 2 else ""
        raise ValueError(
            f"inputs has shape {values.shape}; a function t -> (m,) is needed, or samples (T, m) at"
            f" the T = {len(ts)} times ts.{hint}"
        )
    return Samples(ts, require.finite(values, "inputs").astype(ts.dtype), between == "held")


def _check_field(field: Callable[[Array], Array], x0: Float[Array, " n"]) -> None:
    dtype = require.velocity(field, x0).dtype
    if dtype != x0.dtype:
        cure = f"Pass x0 as {dtype}, or cast the output of the field."
        if not jnp.issubdtype(dtype, jnp.floating):
            cure = "Let it return floats."
        raise TypeError(f"field maps {x0.dtype} to {dtype}; the solution has one dtype. {cure}")


# The steps.


class _Steps(NamedTuple):
    """The arguments of Diffrax that set the steps, and the number of steps in each interval."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    saveat: diffrax.SaveAt
    max_steps: int
    counts: Int[Array, " intervals"] | None = None


def _adaptive_steps(
    solver: diffrax.AbstractSolver,
    ts: Float[Array, " T"],
    tolerances: tuple[Float[Array, ""], Float[Array, ""]],
    max_steps: int | None,
    jumps: bool,
) -> _Steps:
    """Adaptive steps with the tolerances (rtol, atol); with `jumps` the field jumps at each ts."""
    # We end steps on ts: the interpolant of Dopri8 has a lower order. It changed the energy by
    # 1e-7, the steps themselves by 1e-10.
    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(*tolerances),
        step_ts=ts,
        # No step may have stages on both sides of a jump.
        jump_ts=ts[1:-1] if jumps else None,
    )
    limit = _MAX_STEPS + ts.size if max_steps is None else max_steps
    return _Steps(solver, controller, diffrax.SaveAt(ts=ts), limit)


@precise_jit
def _rounding(field: KernelField, x: Float[Array, " n"]) -> Float[Array, ""]:
    """The relative rounding error of f(x), at most 1e-6."""
    return field_rounding(field.kernel, x, field.points, field.coefficients, field(x), 1e-6)


def _learned_at(rhs: RightHandSide, start: Any, x: Float[Array, " n"]) -> tuple[Any, Array]:
    """The field of joined points, and the point of the state x with the inputs at the start."""
    if isinstance(rhs.field, AbstractJoinedField) and rhs.inputs is not None:
        return rhs.field.whole, rhs.field.join(x, rhs.inputs(start))
    return rhs.field, x


# A Gaussian kernel is .01 at three lengthscales.
_FADED = 0.01
_LOOKED_AT = 16  # states of the path, and points of the field, that we compare


def _leaves_the_data(rhs: RightHandSide, start: Any, ts: Any, ys: Any) -> str:
    """A warning if the kernel sum of the field is nearly zero on the path; else "".

    We compare the size of the terms of the field at states of the path and at its own points.
    """
    learned = _learned_at(rhs, start, ys[0])[0]
    if not isinstance(learned, KernelField):
        return ""
    at, of = (np.linspace(0, len(X) - 1, _LOOKED_AT).astype(int) for X in (ys, learned.points))
    X = jnp.concatenate([ys[at], learned.points[of, : ys.shape[1]].astype(ys.dtype)])
    along, usual = np.split(np.asarray(_sizes(rhs, start, learned, X)), 2)
    faded = along < _FADED * np.median(usual)
    if not faded.any():
        return ""
    first = np.asarray(ts)[at][faded][0]
    return (
        f"at time {first:.4g} the path is far from the points that the field was learned from. Its "
        f"kernels are less than {_FADED} of their size there, and the field is its prior mean. "
        "Learn from runs that go there, or start nearer."
    )


@precise_jit
def _sizes(
    rhs: RightHandSide, start: Any, learned: KernelField, X: Float[Array, "N n"]
) -> Float[Array, " N"]:
    """The sizes of the terms of the field at the states X."""

    def size(x):
        point = _learned_at(rhs, start, x)[1]
        return size_of_terms(learned.kernel, point, learned.points, learned.coefficients)

    return jax.lax.map(size, X)


def _tolerances(
    rhs: RightHandSide, start: Any, x0: Float[Array, " n"], rtol: Any, atol: Any
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The relative and absolute tolerance. The defaults are at least the rounding error of f."""
    default = jnp.asarray(1e-10 if x0.dtype == jnp.float64 else 1e-5, x0.dtype)
    if rtol is None or atol is None:
        learned, point = _learned_at(rhs, start, x0)
        if isinstance(learned, KernelField):
            # At an equilibrium f is zero and its relative rounding error infinite; so we limit the
            # tolerance to 1e-6.
            default = jnp.maximum(default, _rounding(learned, point))

    def tolerance(name: str, value: Any) -> Float[Array, ""]:
        if value is None:
            return default
        with require.eager(value):  # an array, since JAX compiles for each new Python number
            return require.positive_scalar(value, name).astype(default.dtype)

    return tolerance("rtol", rtol), tolerance("atol", atol)


def _equal_steps(
    solver: diffrax.AbstractSolver,
    ts: Float[Array, " T"],
    dt: ArrayLike,
    adjoint: diffrax.AbstractAdjoint,
    max_steps: int | None,
) -> _Steps:
    """The fewest equal steps of at most dt in every interval."""
    with require.eager(dt):
        dt = require.positive_scalar(dt, "dt")
    with require.eager(ts, dt):
        counts = step_counts(ts, dt)
        bound = _bound(counts, max_steps)
    steps = EqualSteps(solver, dt, adjoint, bound)
    saveat = diffrax.SaveAt(t0=True, steps=True)
    return _Steps(steps, diffrax.StepTo(ts), saveat, ts.size - 1, counts)


def _bound(counts: Int[Array, " intervals"], max_steps: int | None) -> int:
    """A bound on the number of steps in an interval of ts; a default if the counts are traced."""
    if not require.is_concrete(counts):
        return max_steps or _MAX_STEPS
    numbers = np.asarray(counts)
    largest = int(numbers.max())
    if largest >= np.iinfo(np.int32).max:
        raise ValueError(
            "dt is so small that more than two thousand million steps lie between two of ts: "
            "take a larger dt, in the unit of time of ts."
        )
    if max_steps is None:  # A power of two: neighbouring values of dt share one compiled loop.
        return 2 ** (largest - 1).bit_length()
    if numbers.sum() > max_steps:
        raise ValueError(
            f"dt cuts ts into {numbers.sum()} steps, more than max_steps={max_steps}: take a "
            "larger dt, or leave max_steps None."
        )
    return max_steps


def _check_solver(solver: Any, dt: Any, rtol: Any, atol: Any, has_inputs: bool) -> None:
    """Raise an error if `solver` is no solver, or cannot use the options."""
    name = solver.__name__ if isinstance(solver, type) else type(solver).__name__
    symplectic = isinstance(solver, AbstractSymplecticSolver)
    if isinstance(solver, type) or not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"solver is {name}; an instance is needed, such as hk.ImplicitMidpoint().")
    if isinstance(solver, diffrax.SemiImplicitEuler):
        raise ValueError(
            "SemiImplicitEuler takes two vector fields, one for q and one for p; simulate has one. "
            "hk.StormerVerlet() is symplectic too, of order 2, and takes the whole field."
        )
    if dt is not None and not (rtol is None and atol is None):
        raise ValueError("rtol and atol belong to adaptive steps, but dt sets constant ones.")
    if dt is None and symplectic:
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
    if has_inputs and symplectic:
        raise ValueError(
            f"{name} is symplectic, and a field with inputs is not the flow of one H: the energy "
            "that it keeps bounded is not conserved while inputs do work. Use the default solver, "
            "or diffrax.Dopri5() with dt=..."
        )


# The solve and its outcome.

_solve = compiled_without_emitters(diffrax.diffeqsolve)


def _integrate(
    rhs: RightHandSide,
    steps: _Steps,
    ts: Float[Array, " T"],
    x0: Float[Array, " n"],
    start: Float[Array, ""] | None,
    adjoint: diffrax.AbstractAdjoint,
    progress: bool,
) -> diffrax.Solution:
    """The solution of Diffrax; if the solve fails, it is incomplete."""
    try:
        return _solve(
            diffrax.ODETerm(rhs),
            steps.solver,
            ts[0],
            ts[-1],
            None,
            x0,
            start,
            saveat=steps.saveat,
            stepsize_controller=steps.controller,
            adjoint=adjoint,
            max_steps=steps.max_steps,
            throw=False,
            progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
        )
    except TypeError as error:
        if "forward-mode" not in str(error) or isinstance(adjoint, diffrax.ForwardMode):
            raise
        raise TypeError(
            f"{type(adjoint).__name__} is for reverse mode alone: pass adjoint="
            "diffrax.ForwardMode() for jax.jvp and jax.jacfwd, adjoint=diffrax.DirectAdjoint() for "
            "jax.hessian."
        ) from error


@precise_jit
def _restore_times(solution: Any, ts: Float[Array, " T"]) -> tuple[Any, Bool[Array, ""]]:
    """The solution at the caller's times, and whether it failed.

    Times that the solve did not reach stay infinite. A state that is not finite counts as a failure
    too, since constant steps continue with such states.
    """
    reached_end = solution.result == _RESULTS.successful
    overflowed = reached_end & ~jnp.isfinite(solution.ys).all()
    result = _RESULTS.where(overflowed, _RESULTS.nonfinite, solution.result)
    reached = jnp.where(jnp.isfinite(solution.ts), ts, solution.ts.astype(ts.dtype))
    new = ts[0], ts[-1], reached, result
    solution = eqx.tree_at(lambda s: (s.t0, s.t1, s.ts, s.result), solution, new)
    return solution, result != _RESULTS.successful


def _reason_of_failure(solution: Any, field: Any, x0: Float[Array, " n"], adapts: bool) -> str:
    """The reason for the failure of a solve, and a remedy."""
    reason = (
        "Too many steps, a step whose equations could not be solved, or a state that "
        "overflowed or became NaN."
    )
    if require.is_concrete(solution.result):
        if require.is_concrete(field, x0) and not jnp.isfinite(field(x0)).all():
            return (
                "The solve failed: the field is NaN or infinite at x0 already. So is one from "
                "a fit that failed with throw=False."
            )
        if solution.result == _RESULTS.nonfinite:
            return (
                "The state overflowed or became NaN. The step is too large for the solver, or "
                "the field has no solution over this time. Take a smaller dt, or a shorter time."
            )
        reason = _RESULTS[solution.result]
    cure = "Take a smaller dt."
    if adapts:
        cure = (
            "Pass larger tolerances, such as rtol=1e-6, atol=1e-6: adaptive steps shrink without "
            "end below the rounding of a learned field, which grows as its regularization falls. "
            "Or allow more steps with max_steps."
        )
    return f"The solve failed: {reason} {cure} It may also be that the field has no solution."
