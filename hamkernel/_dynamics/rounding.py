"""How many digits a learned field has: an adaptive step must not ask for more."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._fields.kernel_field import KernelField
from hamkernel._kernels.symmetry import without_symmetry
from hamkernel._structures.base import AbstractMatrixKernel

# At an equilibrium f is zero and has no digits at all; with 1e-6 states are right to a few digits.
_FEWEST = 1e-6


def rounding(field: Any, x: Float[Array, " n"]) -> Float[Array, ""]:
    """The share of f(x) that rounding may change, at most 1e-6; 0 of fields that do not say.

    f(x) = Σⱼ K(x, xⱼ) aⱼ has large terms of both signs where the ridge is small. They round, each
    to ε of itself: ρ = ε ‖Σⱼ |K(x, xⱼ) aⱼ|‖ / ‖f(x)‖.

    Args:
        field: any field; one of `hk.fit` knows its terms.
        x: a state, shape (n,).
    """
    if not isinstance(field, KernelField):
        return jnp.zeros((), x.dtype)
    return _rounding(field.kernel, x, field.points, field.coefficients, field(x))


@eqx.filter_jit
def _rounding(
    K: AbstractMatrixKernel,
    x: Float[Array, " n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
    velocity: Float[Array, " n"],
) -> Float[Array, ""]:
    K = without_symmetry(K)
    terms = jax.vmap(lambda z, a: K.expansion(x, z[None], a[None]))(Z, A)
    size = jnp.linalg.norm(jnp.sum(jnp.abs(terms), axis=0))
    least = jnp.finfo(x.dtype).tiny
    share = jnp.finfo(x.dtype).eps * size / jnp.maximum(jnp.linalg.norm(velocity), least)
    return jax.lax.stop_gradient(jnp.minimum(share, _FEWEST).astype(x.dtype))
