"""Derivatives with respect to the hyperparameters of a kernel, of which there are few.

They are taken FORWARD, one at a time: each costs about one assembly. Backward through the pairs of
points was measured at 6 to 60 assemblies, and takes several times as long to compile.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree


@eqx.filter_custom_vjp
def trained(kernel_and_points, make):
    """make(K, X), an array, cheap to differentiate with respect to K."""
    return make(*kernel_and_points)


@trained.def_fwd
def _(perturbed, kernel_and_points, make):
    return trained(kernel_and_points, make), None


@trained.def_bwd
def _(saved, bar, perturbed, kernel_and_points, make):
    K, X = kernel_and_points

    def paired(K, X):
        return jnp.vdot(bar, make(K, X))

    params, static = eqx.partition(K, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(params)

    def slope(direction):
        at = lambda flat: paired(eqx.combine(unravel(flat), static), X)  # noqa: E731
        return jax.jvp(at, (flat,), (direction,))[1]

    K_bar = unravel(jax.lax.map(slope, jnp.eye(flat.size, dtype=flat.dtype)))
    X_bar = jax.grad(paired, argnums=1)(K, X) if perturbed[1] else None
    return K_bar, X_bar
