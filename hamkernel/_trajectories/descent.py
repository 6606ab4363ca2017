"""The minimum of a smooth function in a box, by BFGS from a good first point."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from hamkernel._tuning.other_optimisers import with_slope_backward

# Stands for a value that is not finite: the line search backs away from it.
HUGE = 1e30

_EDGE = 0.01  # of the box: on the edge itself the derivative of the sine is zero


# A log likelihood that is a hundredth off moves no hyperparameter by a tenth of its error bar; its
# size says nothing, so there is no relative tolerance.
_BFGS = eqx.tree_at(
    lambda o: o.search,
    optx.BFGS(rtol=1e-9, atol=1e-2),
    optx.BacktrackingArmijo(decrease_factor=0.25),  # as in `tune`
)


def minimise(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    start: Float[Array, " P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    sizes: Float[Array, " P"],
    steps: int,
) -> tuple[Float[Array, " P"], Float[Array, ""]]:
    """The best h in the box low ≤ h ≤ high that BFGS finds from `start`, and fn there.

    It is searched as h = low + (high − low)(1 + sin(u₀ + D v))/2 over all real v, D such that v
    is one where h has moved by `sizes`: BFGS begins with the identity for a Hessian, so these are
    to be the standard deviations that a likelihood leaves, as far as they are known.
    """
    width = jnp.where(high > low, high - low, jnp.ones_like(low))
    share = jnp.clip((start - low) / width, _EDGE, 1 - _EDGE)
    share = jnp.where(jnp.isfinite(share), share, 0.5)
    u0 = jnp.arcsin(2 * share - 1)
    D = 2 * sizes / (width * jnp.cos(u0))

    def at(v):
        return low + (high - low) * (1 + jnp.sin(u0 + D * v)) / 2

    def value_at(v):
        value = fn(at(v))
        return jnp.where(jnp.isfinite(value), value, HUGE)

    objective = with_slope_backward(value_at)
    found = optx.minimise(
        lambda v, _: objective(v), _BFGS, jnp.zeros_like(start), max_steps=steps, throw=False
    )
    return at(found.value), found.state.f_info.f
