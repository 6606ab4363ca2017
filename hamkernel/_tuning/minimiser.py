"""Minimisers of optimistix, stepped by hand so that many runs share one compiled program.

We call the `init`, `step` and `terminate` methods of an optimistix minimiser ourselves. The
hyperparameters are h = low + (high − low)(1 + sin u)/2 with u real, as in MINUIT, so h stays in its
box and can reach a bound at a finite u (a sigmoid could not). The side of the box is π long in u.

`BoxBFGS` is the default: the BFGS of optimistix with another line search, a limit of the step, and
another tolerance, all built from the classes of optimistix. `optimistix.BFGS` halves the step in
its line search, which takes twice as many losses. Its tolerance, on differences of u and of the
loss together, cannot express "the next step promises less than 0.01 %".

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
    """The u of a point h, after h has been moved into the box by the share `margin` of its sides.

    On the edge the derivative of the sine is zero, so a minimiser could not leave it. A coordinate
    that is not finite becomes the middle of its side.
    """
    width = jnp.where(high > low, high - low, jnp.ones_like(low))
    share = jnp.clip((h - low) / width, margin, 1 - margin)
    return jnp.arcsin(2 * jnp.where(jnp.isfinite(share), share, 0.5) - 1)


class LimitedNewton(optx.AbstractDescent):
    """The direction −H g, H the inverse Hessian and g the slope, at most half of the box long.

    The quadratic model does not hold beyond half of the box, which is π wide. While H is still the
    identity, the curvature is unknown, and the direction is the steepest descent, a tenth of the
    box long.
    """

    def init(self, y, f_info_struct):
        return jnp.zeros_like(y)

    def query(self, y, f_info, state):
        H, slope = f_info.hessian_inv.pytree, f_info.grad
        direction = -(H @ slope)
        length = jnp.linalg.norm(direction)
        unknown = jnp.all(H == jnp.eye(len(y), dtype=H.dtype))
        max_length = jnp.where(unknown, 0.1 * jnp.pi, jnp.minimum(length, 0.5 * jnp.pi))
        return direction * (max_length / jnp.where(length > 0, length, jnp.ones_like(length)))

    def step(self, step_size, state):
        return step_size * state, optx.RESULTS.successful


class ParabolicSearch(optx.AbstractSearch):
    """A line search by parabolas, with the condition of Armijo.

    A step is accepted if it lowers the value by 1e-4 of the decrease that the slope promises. The
    share is small because full steps are good once the curvature is known. After a refused step,
    the next one goes to the minimum of the parabola through both values and the slope, limited to
    a tenth to a half of the refused step.
    """

    def init(self, y, f_info_struct):
        return jnp.ones((), y.dtype)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        promised = f_info.grad @ (y_eval - y)
        change = f_eval_info.f - f_info.f
        accept = first_step | (change <= 1e-4 * promised)
        # The parabola with f(0) = 0, f′(0) = p and f(1) = c has its minimum at −p/(2(c − p)).
        share = jnp.clip(-promised / (2 * (change - promised)), 0.1, 0.5)
        size = jnp.where(accept, jnp.ones_like(state), state * share)
        return size, accept, optx.RESULTS.successful, size


class BoxBFGS(optx.AbstractBFGS):
    """BFGS for a box in u; it has converged when the next step promises less than `atol`.

    The decrease that the quadratic model promises is half of the linear one, −g·Δu/2.
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
        # A step below √ε relative to u changes the value by rounding errors alone.
        stuck = step <= 1e-8 * (1 + jnp.linalg.norm(y))
        result = optx.RESULTS.where(
            stuck & ~converged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return converged | stuck, result


class Evaluation(NamedTuple):
    """A point u, the value of the function there, and the loss to report."""

    is_evaluated: Bool[Any, ""]
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
        active: whether the run goes on.
        converged: whether the run met its tolerance.
    """

    u: Float[Any, " P"]
    state: Any
    best: Evaluation
    steps: Int[Any, ""]
    active: Bool[Any, ""]
    converged: Bool[Any, ""]

    def with_curvature_of(self, runs: "MinimiserRun") -> "MinimiserRun":
        """The runs at these points, with the inverse Hessian of `runs` on a similar function.

        The first step of a quasi-Newton method only evaluates the function at its point.
        """
        if not hasattr(runs.state, "hessian_update_state"):
            return self._replace(steps=runs.steps)
        new = self.state.first_step, self.state.y_eval
        state = eqx.tree_at(lambda state: (state.first_step, state.y_eval), runs.state, new)
        return self._replace(state=state, steps=runs.steps)

    def with_curvature(self, inverse: Float[Array, "P P"]) -> "MinimiserRun":
        """A run of `BoxBFGS` with this inverse Hessian in place of the identity."""
        state = eqx.tree_at(lambda state: state.f_info.hessian_inv.pytree, self.state, inverse)
        return self._replace(state=state)


Minimisable = Callable[[Float[Array, " P"]], tuple[Float[Array, ""], Float[Array, ""]]]


def init(minimiser: optx.AbstractMinimiser, fn: Minimisable, u: Float[Array, " P"]) -> MinimiserRun:
    """A run at u, before the first evaluation of the function."""
    number = jax.ShapeDtypeStruct((), u.dtype)
    flag = jax.ShapeDtypeStruct((), jnp.bool_)
    point = Evaluation(flag, u, number, number)
    nothing = Evaluation(jnp.array(False), u, *jnp.full(2, jnp.inf, u.dtype))
    state = minimiser.init(_with_slope_backward(fn), u, None, {}, number, point, frozenset())
    no = jnp.array(False)
    return MinimiserRun(u, state, nothing, jnp.array(0), jnp.array(True), no)


def step_once(
    minimiser: optx.AbstractMinimiser, fn: Minimisable, run: MinimiserRun
) -> MinimiserRun:
    """The run after one more step of the minimisation of `fn`, u -> (value, loss)."""
    with_args, arguments = _with_slope_backward(fn), (None, {})
    u, state, aux = minimiser.step(with_args, run.u, *arguments, run.state, frozenset())
    stopped, result = minimiser.terminate(with_args, u, *arguments, state, frozenset())
    best = _better(run.best, aux)
    # After an accepted step optimistix returns the previous point; its state holds the new one.
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


def minimise(
    minimiser: optx.AbstractMinimiser, fn: Minimisable, run: MinimiserRun, steps: Any
) -> MinimiserRun:
    """Step the run until it ends or has taken `steps` steps."""
    arrays, static = eqx.partition(run, eqx.is_array)

    def active(arrays):
        return arrays.active & (arrays.steps < steps)

    def step(arrays):
        return eqx.filter(step_once(minimiser, fn, eqx.combine(arrays, static)), eqx.is_array)

    return eqx.combine(jax.lax.while_loop(active, step, arrays), static)


def run_in_box(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    start: Float[Array, " P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    deviations: Float[Array, " P"],
    steps: Any,
) -> MinimiserRun:
    """The run to the minimum of fn(h) = −log p in the box low ≤ h ≤ high, from h = `start`.

    `deviations` are rough standard deviations σ of h under the likelihood. With
    dh/du = (high − low) cos(u)/2 they give the first inverse Hessian of BFGS, (σ / (dh/du))². The
    minimiser is `inside_box(run.best.u, low, high)`, and `run.best.value` the value there.
    """
    # A hyperparameter within a tenth of its standard deviation of the best value is good enough;
    # there the quadratic −log p is ½ .1² = .005 above its minimum.
    bfgs = BoxBFGS(atol=jnp.asarray(0.005, start.dtype))
    u = from_box(start, low, high, 0.01)
    width = jnp.where(high > low, high - low, jnp.ones_like(low))
    inverse = jnp.diag((2 * deviations / (width * jnp.cos(u))) ** 2)

    def loss(u):
        value = fn(inside_box(u, low, high))
        return jnp.where(jnp.isfinite(value), value, jnp.inf), value

    return minimise(bfgs, loss, init(bfgs, loss, u).with_curvature(inverse), steps)


def best_in_box(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    design: Float[Array, "D P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    deviations: Float[Array, " P"],
    steps: Any,
    batch_size: int | None = None,
) -> MinimiserRun:
    """`run_in_box` from the best of the points of a design, so many of which are tried at once."""
    values = jax.lax.map(fn, design, batch_size=batch_size)
    start = design[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))]
    return run_in_box(fn, start, low, high, deviations, steps)


def _better(best: Evaluation, candidate: Evaluation) -> Evaluation:
    better = candidate.is_evaluated & (candidate.value < best.value)
    return jax.tree.map(lambda a, b: jnp.where(better, b, a), best, candidate)


def _with_slope_backward(fn: Minimisable) -> Callable[[Array, Any], tuple[Array, Evaluation]]:
    """`fn` for optimistix, (u, args) -> (value, the `Evaluation` at u).

    optimistix linearises in forward mode and transposes, but the derivatives of losses are written
    in reverse mode. We therefore compute the slope together with the value. A value that is not
    finite counts as 1e30, with a slope of zero.
    """

    def evaluate(u):
        value, loss = fn(u)
        # optimistix begins with an `Evaluation` of zeros, in which `is_evaluated` is False.
        is_evaluated = jnp.isfinite(u).all()
        point = Evaluation(is_evaluated, u, value.astype(u.dtype), loss.astype(u.dtype))
        # The line search interpolates values, so they must be finite.
        return jnp.where(jnp.isfinite(point.value), point.value, 1e30), point

    differentiable = jax.custom_jvp(evaluate)

    @differentiable.defjvp
    def _(primals, tangents):
        (value, point), slope = jax.value_and_grad(evaluate, has_aux=True)(*primals)
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
