"""The arguments of scalar kernels: one point, and hyperparameters one for each coordinate."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require


def one_point(x: ArrayLike) -> Float[Array, " n"]:
    """`x` as a float array; a batch would silently give a wrong number."""
    x = require.floating(x, "the point")
    if x.ndim != 1:
        raise ValueError(
            f"the point has shape {x.shape}; a kernel takes one pair of points of shape (n,). Use "
            "jax.vmap for many, or hk.gram for a Gram."
        )
    return x


def divided(
    x: Float[Array, " n"], scale: Float[Array, "..."], name: str = "lengthscale"
) -> Float[Array, " n"]:
    """x/scale in the dtype of x, for one point; the scale is a number, or one per coordinate."""
    x = one_point(x)
    if scale.ndim and scale.shape != x.shape:
        raise ValueError(
            f"the kernel has {scale.size} {name}s and the point has shape {x.shape}: "
            "give one number, or one for each coordinate that the kernel sees."
        )
    return x / scale.astype(x.dtype)


def log_per_coordinate(value: ArrayLike, name: str, cure: str = "") -> Float[Array, "..."]:
    """The logarithm of a positive hyperparameter, one number or one per coordinate."""
    array = require.positive(value, name, cure)
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; it must be a number or a vector (n,).")
    return jnp.log(array)
