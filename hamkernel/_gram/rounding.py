"""How far a Gram and a field of a kernel round."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._kernels.symmetry import without_symmetry
from hamkernel._structures.base import AbstractMatrixKernel


def gram_rounding(trace: Float[Array, "..."]) -> Float[Array, "..."]:
    """ε tr(G), the size of the rounding errors in products with the Gram G and in its factors.

    A ridge or a pivot that is smaller than this number is lost in the rounding. `trace` may be that
    of G, of its diagonal blocks, or of G/N, for a bound of λ.
    """
    return jnp.finfo(trace.dtype).eps * trace


@eqx.filter_jit
def field_rounding(
    K: AbstractMatrixKernel,
    x: Float[Array, " n"],
    Z: Float[Array, "M n"],
    A: Float[Array, "M n"],
    velocity: Float[Array, " n"],
    most: float = jnp.inf,
) -> Float[Array, ""]:
    """ε ‖Σⱼ |K(x, zⱼ) aⱼ|‖ / ‖f(x)‖, the relative rounding error of f(x) = Σⱼ K(x, zⱼ) aⱼ.

    It is cut to `most`, since it grows without bound where f(x) tends to zero. Where the ridge is
    small the terms are large, of both signs, and each rounds to ε of itself.
    """
    K = without_symmetry(K)
    terms = jax.vmap(lambda z, a: K.expansion(x, z[None], a[None]))(Z, A)
    size = jnp.linalg.norm(jnp.sum(jnp.abs(terms), axis=0))
    least = jnp.finfo(x.dtype).tiny
    share = jnp.finfo(x.dtype).eps * size / jnp.maximum(jnp.linalg.norm(velocity), least)
    return jax.lax.stop_gradient(jnp.minimum(share, most).astype(x.dtype))
