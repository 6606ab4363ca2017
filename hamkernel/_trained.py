"""Derivatives with respect to the hyperparameters of a kernel, of which there are few.

They are taken FORWARD: each costs about one assembly. Backward through the pairs of points was
measured at 6 to 60 assemblies, and takes several times as long to compile.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

_ENTRIES = 200_000  # of the array and its changes, up to which directions go side by side


@eqx.filter_custom_vjp
def trained(kernel_and_points, make, paired=None):
    """make(K, X), an array, cheap to differentiate with respect to K.

    `paired(K, X, bar)` is ⟨bar, make(K, X)⟩, in as little memory as its derivatives should take;
    the plain product if None.
    """
    return make(*kernel_and_points)


@trained.def_fwd
def _(perturbed, kernel_and_points, make, paired=None):
    return trained(kernel_and_points, make, paired), None


@trained.def_bwd
def _(saved, bar, perturbed, kernel_and_points, make, paired=None):
    K, X = kernel_and_points
    paired = paired or (lambda K, X, bar: jnp.vdot(bar, make(K, X)))

    params, static = eqx.partition(K, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(params)

    def slope(direction):
        # What does not depend on the direction depends on it now: XLA would else compute it ahead
        # of the loop and keep it, several arrays of the size of the Gram.
        here, direction = jax.lax.optimization_barrier((flat, direction))
        at = lambda h: paired(eqx.combine(unravel(h), static), X, bar)  # noqa: E731
        return jax.jvp(at, (here,), (direction,))[1]

    # Side by side the directions share what does not depend on them, at the price of memory.
    together = min(flat.size, _ENTRIES // max(bar.size, X.size))
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    slopes = jax.lax.map(slope, directions, batch_size=together if together > 1 else None)
    K_bar = unravel(slopes.astype(flat.dtype))
    X_bar = jax.vjp(lambda X: make(K, X), X)[1](bar)[0] if perturbed[1] else None
    return K_bar, X_bar


def constant(tree):
    """`tree` with no derivative through its arrays; it may have leaves of other kinds, as K may."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(jax.lax.stop_gradient, arrays), rest)
