"""Minimisers of optimistix, stepped by hand so that many runs share one compiled program.

A minimiser is followed through its `init`, `step` and `terminate`, the public interface of
optimistix, from points of a box that is searched as h = low + (high − low)(1 + sin u)/2 over all
real u, as MINUIT does: an unconstrained minimiser then respects the bounds and can rest on one,
where a sigmoid would creep towards it. The side of the box is π long in u.

`BoxBFGS` is the default. It is the BFGS of optimistix with its own line search, limit of the step
and tolerance, made from the classes that optimistix has for them. The line search of
`optimistix.BFGS`, which halves the step, takes twice as many losses, and its tolerance, on
differences of u and of the loss together, cannot say "less than 0.01 % is still to be gained".

Source: Nocedal & Wright (2006), Numerical Optimization, algorithms 3.1 and 6.1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int


def inside_box(u: Array, low: Array, high: Array) -> Array:
    """The point h = low + (high − low)(1 + sin u)/2 of the box, all of the same shape."""
    return low + (high - low) * (1 + jnp.sin(u)) / 2


def from_box(h: Array, low: Array, high: Array, margin: float) -> Array:
    """The u of a point h, which is moved into the box by the share `margin` of its sides.

    On the edge itself the derivative of the sine is zero, and no slope would lead away from it. A
    coordinate that is not finite becomes the middle of its side.
    """
    width = jnp.where(high > low, high - low, jnp.ones_like(low))
    share = jnp.clip((h - low) / width, margin, 1 - margin)
    return jnp.arcsin(2 * jnp.where(jnp.isfinite(share), share, 0.5) - 1)


class LimitedNewton(optx.AbstractDescent):
    """The direction −H g, H the inverse Hessian and g the slope, no longer than half of the box.

    The quadratic model does not hold beyond half of the box, which is π wide. Where H is still the
    identity, and the curvature unknown, the direction is the steepest descent, a tenth of the box
    long.
    """

    def init(self, y, f_info_struct):
        return jnp.zeros_like(y)

    def query(self, y, f_info, state):
        H, slope = f_info.hessian_inv.pytree, f_info.grad
        direction = -(H @ slope)
        length = jnp.linalg.norm(direction)
        unknown = jnp.all(H == jnp.eye(len(y), dtype=H.dtype))
        most = jnp.where(unknown, 0.1 * jnp.pi, jnp.minimum(length, 0.5 * jnp.pi))
        return direction * (most / jnp.where(length > 0, length, jnp.ones_like(length)))

    def step(self, step_size, state):
        return step_size * state, optx.RESULTS.successful


class ParabolicSearch(optx.AbstractSearch):
    """A line search by parabolas, with the condition of Armijo.

    A step is accepted if it lowers the value by 1e-4 of the decrease that the slope promises; the
    share is small, since with a known curvature full steps are good and none should be refused. A
    refused step is followed by a step to the minimum of the parabola through both values, a tenth
    to a half as long.
    """

    def init(self, y, f_info_struct):
        return jnp.ones((), y.dtype)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        promised = f_info.grad @ (y_eval - y)
        change = f_eval_info.f - f_info.f
        accept = first_step | (change <= 1e-4 * promised)
        share = jnp.clip(-promised / (2 * (change - promised)), 0.1, 0.5)
        size = jnp.where(accept, jnp.ones_like(state), state * share)
        return size, accept, optx.RESULTS.successful, size


class BoxBFGS(optx.AbstractBFGS):
    """BFGS for a box in u that has converged where the next step promises less than `atol`.

    The quadratic model promises half of the decrease that the slope alone does.
    """

    atol: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    rtol: float = 0.0
    norm: Callable = optx.max_norm
    use_inverse: bool = True
    descent: LimitedNewton = LimitedNewton()
    search: ParabolicSearch = ParabolicSearch()
    verbose: Callable[..., None] = lambda **_: None

    def terminate(self, fn, y, args, options, state, tags):
        promised = -(state.f_info.grad @ state.descent_state) / 2
        step = jnp.linalg.norm(state.y_eval - y)
        converged = promised < self.atol
        # A step that changes less than half of the digits of u sees rounding errors alone.
        stuck = step <= 1e-8 * (1 + jnp.linalg.norm(y))
        result = optx.RESULTS.where(
            stuck & ~converged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return converged | stuck, result


class Evaluation(NamedTuple):
    """A point at which the function was evaluated: its value, and the loss that is reported."""

    seen: Bool[Any, ""]
    u: Float[Any, " P"]
    value: Float[Any, ""]
    loss: Float[Any, ""]


class MinimiserRun(NamedTuple):
    """A run in progress.

    Attributes:
        u: the current point of the minimiser.
        state: the state of the minimiser.
        best: the best point so far.
        steps: the number of steps so far.
        going: whether the run has not ended.
        converged: whether the run met its tolerance.
    """

    u: Float[Any, " P"]
    state: Any
    best: Evaluation
    steps: Int[Any, ""]
    going: Bool[Any, ""]
    converged: Bool[Any, ""]

    def going_on_from(self, runs: "MinimiserRun") -> "MinimiserRun":
        """The runs at these points, with the curvature of other `runs` on a similar function.

        The first step of a quasi-Newton method only evaluates the function at its point.
        """
        if not hasattr(runs.state, "hessian_update_state"):
            return self._replace(steps=runs.steps)
        new = self.state.first_step, self.state.y_eval
        known = eqx.tree_at(lambda state: (state.first_step, state.y_eval), runs.state, new)
        return self._replace(state=known, steps=runs.steps)

    def with_curvature(self, inverse: Float[Array, "P P"]) -> "MinimiserRun":
        """The run of `BoxBFGS` with this inverse Hessian in place of the identity."""
        state = eqx.tree_at(lambda state: state.f_info.hessian_inv.pytree, self.state, inverse)
        return self._replace(state=state)


Minimised = Callable[[Float[Array, " P"]], tuple[Float[Array, ""], Float[Array, ""]]]


def begun(minimiser: optx.AbstractMinimiser, fn: Minimised, u: Float[Array, " P"]) -> MinimiserRun:
    """A run at u, where the function has not been evaluated yet."""
    number = jax.ShapeDtypeStruct((), u.dtype)
    flag = jax.ShapeDtypeStruct((), jnp.bool_)
    point = Evaluation(flag, u, number, number)
    nothing = Evaluation(jnp.array(False), u, *jnp.full(2, jnp.inf, u.dtype))
    state = minimiser.init(_with_slope_backward(fn), u, None, {}, number, point, frozenset())
    no = jnp.array(False)
    return MinimiserRun(u, state, nothing, jnp.array(0), jnp.array(True), no)


def stepped(minimiser: optx.AbstractMinimiser, fn: Minimised, run: MinimiserRun) -> MinimiserRun:
    """The run after one more step of the minimisation of `fn`, u -> (value, loss)."""
    with_args, arguments = _with_slope_backward(fn), (None, {})
    u, state, aux = minimiser.step(with_args, run.u, *arguments, run.state, frozenset())
    stopped, result = minimiser.terminate(with_args, u, *arguments, state, frozenset())
    best = _better(run.best, aux)
    # After an accepted step optimistix returns the previous point; the new one is in its state.
    best = _better(best, getattr(state, "aux", aux))
    successful = result == optx.RESULTS.successful
    return MinimiserRun(
        u,
        state,
        best,
        run.steps + 1,
        ~stopped & successful & jnp.isfinite(u).all(),
        stopped & successful & (best.value < jnp.inf),
    )


def minimised(
    minimiser: optx.AbstractMinimiser, fn: Minimised, run: MinimiserRun, steps: Any
) -> MinimiserRun:
    """The run at its end, or once it has taken `steps` steps."""
    arrays, static = eqx.partition(run, eqx.is_array)

    def going(arrays):
        return arrays.going & (arrays.steps < steps)

    def step(arrays):
        return eqx.filter(stepped(minimiser, fn, eqx.combine(arrays, static)), eqx.is_array)

    return eqx.combine(jax.lax.while_loop(going, step, arrays), static)


def most_likely_in_box(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    start: Float[Array, " P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    deviations: Float[Array, " P"],
    steps: Any,
) -> tuple[Float[Array, " P"], Float[Array, ""]]:
    """The h in the box low ≤ h ≤ high where −log p = fn(h) is least, from `start`, and fn there.

    `deviations` are the standard deviations of h that the likelihood leaves, as far as they are
    known: their squares are the inverse Hessian that BFGS begins with.
    """
    run = run_in_box(fn, start, low, high, deviations, steps)
    return inside_box(run.best.u, low, high), run.best.value


def run_in_box(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    start: Float[Array, " P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    deviations: Float[Array, " P"],
    steps: Any,
) -> MinimiserRun:
    """The run that ends at the point of `most_likely_in_box`."""
    # No hyperparameter need be nearer to its best value than a tenth of its standard deviation,
    # where the quadratic −log p is ½ .1² above its minimum.
    bfgs = BoxBFGS(atol=jnp.asarray(0.005, start.dtype))
    u = from_box(start, low, high, 0.01)
    width = jnp.where(high > low, high - low, jnp.ones_like(low))
    inverse = jnp.diag((2 * deviations / (width * jnp.cos(u))) ** 2)

    def loss(u):
        value = fn(inside_box(u, low, high))
        return jnp.where(jnp.isfinite(value), value, jnp.inf), value

    return minimised(bfgs, loss, begun(bfgs, loss, u).with_curvature(inverse), steps)


def _better(one: Evaluation, other: Evaluation) -> Evaluation:
    better = other.seen & (other.value < one.value)
    return jax.tree.map(lambda a, b: jnp.where(better, b, a), one, other)


def _with_slope_backward(fn: Minimised) -> Callable[[Array, Any], tuple[Array, Evaluation]]:
    """`fn` for optimistix, (u, args) -> (value, the `Evaluation` at u).

    optimistix linearises in forward mode and transposes, while the derivatives of losses are
    written in reverse mode: here the slope is computed together with the value. A value that is not
    finite counts as huge, with a slope of zero.
    """

    def looked_at(u):
        value, loss = fn(u)
        # `seen` is False in the zeros that optimistix begins with.
        seen = jnp.isfinite(u).all()
        point = Evaluation(seen, u, value.astype(u.dtype), loss.astype(u.dtype))
        # A line search can interpolate a huge number, and not infinity.
        return jnp.where(jnp.isfinite(point.value), point.value, 1e30), point

    differentiable = jax.custom_jvp(looked_at)

    @differentiable.defjvp
    def _(primals, tangents):
        (value, point), slope = jax.value_and_grad(looked_at, has_aux=True)(*primals)
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))
        zeros = jax.tree.map(
            lambda a: (
                jnp.zeros_like(a)
                if jnp.issubdtype(a.dtype, jnp.inexact)
                else jnp.zeros(a.shape, jax.dtypes.float0)
            ),
            point,
        )
        return (value, point), (slope @ tangents[0], zeros)

    return lambda u, _: differentiable(u)
