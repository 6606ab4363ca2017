"""The minimum of a smooth function in a box, by BFGS from a good first point."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

# Stands for a value that is not finite: the line search backs away from it.
HUGE = 1e30

_EDGE = 0.01  # of the box: on the edge itself the derivative of the sine is zero


def _optimiser(tolerance: float) -> optx.BFGS:
    """BFGS whose line search quarters a step, as in `tune`."""
    bfgs = optx.BFGS(tolerance, tolerance)
    return eqx.tree_at(lambda o: o.search, bfgs, optx.BacktrackingArmijo(decrease_factor=0.25))


# A log likelihood that is a hundredth off moves no hyperparameter by a tenth of its error bar.
_BFGS = _optimiser(1e-2)


def minimise(
    fn: Callable[[Float[Array, " P"]], Float[Array, ""]],
    start: Float[Array, " P"],
    low: Float[Array, " P"],
    high: Float[Array, " P"],
    steps: int,
) -> tuple[Float[Array, " P"], Float[Array, ""]]:
    """The best h in the box low ≤ h ≤ high that BFGS finds from `start`, and fn there.

    It is searched as h = low + (high − low)(1 + sin u)/2 over all real u.
    """
    width = jnp.where(high > low, high - low, jnp.ones_like(low))

    def at(u):
        return low + (high - low) * (1 + jnp.sin(u)) / 2

    def value_at(u):
        value = fn(at(u))
        return jnp.where(jnp.isfinite(value), value, HUGE)

    # optimistix linearises forward and transposes; derivatives here are written backward.
    @jax.custom_jvp
    def objective(u):
        return value_at(u)

    @objective.defjvp
    def _(primals, tangents):
        value, slope = jax.value_and_grad(value_at)(*primals)
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))
        return value, slope @ tangents[0]

    share = jnp.clip((start - low) / width, _EDGE, 1 - _EDGE)
    share = jnp.where(jnp.isfinite(share), share, 0.5)
    found = optx.minimise(
        lambda u, _: objective(u),
        _BFGS,
        jnp.arcsin(2 * share - 1),
        max_steps=steps,
        throw=False,
    )
    return at(found.value), found.state.f_info.f
