"""The prior mean of a field as a function of its points: x, or (x, u) where there are inputs."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.controlled import KnownMatrix
from hamkernel._structures.joined import AbstractJoinedKernel

Mean = Callable[..., Float[Array, " n"]]


class KnownPart(eqx.Module):
    """A prior mean of x, or of x and u, plus G u where G is known; a function of a point (x, u)."""

    mean: Callable[..., Any] | None
    matrix: KnownMatrix | None
    count: int = eqx.field(static=True)
    of_inputs: bool = eqx.field(static=True)  # whether the mean is one of x and u

    def __call__(self, s: Float[Array, " d"]) -> Float[Array, " n"]:
        x, u = s[: -self.count], s[-self.count :]
        known = jnp.zeros_like(x)
        if self.matrix is not None:
            known = jnp.asarray(self.matrix.matrix, x.dtype) @ u
        if self.mean is None:
            return known
        value = self.mean(x, u) if self.of_inputs else self.mean(x)
        return known + value.astype(x.dtype)


class AtInputs(eqx.Module):
    """x -> f(x, u) of a function f, for one u."""

    field: Callable[..., Any]
    u: Float[Array, " m"]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.field(x, self.u.astype(x.dtype))


def known_part(K: AbstractMatrixKernel, mean: Any, n: int, dtype: Any) -> Any:
    """The prior mean at the points of K, plus G u if K has a known input matrix G.

    Args:
        K: the kernel.
        mean: x (n,) -> (n,); of a controlled kernel it may be x, u -> (n,) too.
        n: the number of coordinates of a state.
        dtype: of the states.

    Returns:
        A PyTree that maps one point to one velocity; None if the prior mean is zero.

    Raises:
        TypeError, ValueError: the mean does not map one state to one velocity.
    """
    if not isinstance(K, AbstractJoinedKernel):
        if mean is None:
            return None
        require.velocity(mean, jnp.zeros(n, dtype), "mean")
        return as_pytree(mean)
    matrix = K.known_matrix
    if mean is None:
        return None if matrix is None else KnownPart(None, matrix, K.input_count, of_inputs=False)
    x = jnp.zeros(n, dtype)
    of_inputs = _takes_inputs(mean, x)
    at_zero = AtInputs(mean, jnp.zeros(K.input_count, dtype)) if of_inputs else mean
    require.velocity(at_zero, x, "mean")
    return KnownPart(as_pytree(mean), matrix, K.input_count, of_inputs)


def _takes_inputs(mean: Any, x: Float[Array, " n"]) -> bool:
    """Whether the mean takes x and u; a second argument with a default does not count."""
    if getattr(mean, "takes_inputs", False):
        return True
    alone, both = (require.other_arguments(mean, *args) for args in ((x,), (x, x)))
    return callable(mean) and alone is not None and both is None
