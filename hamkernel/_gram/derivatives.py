"""Derivatives with respect to the hyperparameters of a kernel, of which there are few.

They are taken FORWARD: each costs about one assembly. Backward through the pairs of points was
measured at 6 to 60 assemblies, and takes several times as long to compile.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

_FEW = 10_000  # entries of an array: paired as fast at once, and sooner compiled
_ENTRIES = 200_000  # of the array and its changes, up to which directions go side by side
_STRIP = 200_000  # entries of rows at once; their derivatives hold up to 13 arrays of this size


@eqx.filter_custom_vjp
def forward_differentiated(kernel_and_data, make, rowwise: bool = False):
    """make(K, data), an array, cheap to differentiate with respect to K.

    If `rowwise` then make(K, data) is a function and points instead. The function makes of points
    a row for each, and the array is its value there. Derivatives take the memory of a strip of it.
    """
    return _array(make, rowwise, *kernel_and_data)


@forward_differentiated.def_fwd
def _(perturbed, kernel_and_data, make, rowwise=False):
    return forward_differentiated(kernel_and_data, make, rowwise), None


@forward_differentiated.def_bwd
def _(saved, bar, perturbed, kernel_and_data, make, rowwise=False):
    K, data = kernel_and_data

    def paired(K, data, bar):
        if not rowwise:
            return jnp.vdot(bar, make(K, data))
        rows, X = make(K, data)
        return _paired_by_rows(rows, X, bar)

    params, static = eqx.partition(K, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(params)

    def slope(direction):
        # What does not depend on the direction depends on it now: XLA would else compute it ahead
        # of the loop and keep it, several arrays of the size of the Gram.
        here, direction = jax.lax.optimization_barrier((flat, direction))
        at = lambda h: paired(eqx.combine(unravel(h), static), data, bar)  # noqa: E731
        return jax.jvp(at, (here,), (direction,))[1]

    # Side by side the directions share what does not depend on them, at the price of memory.
    arrays, rest = eqx.partition(data, eqx.is_inexact_array)
    largest = max(each.size for each in [bar, *jax.tree.leaves(arrays)])
    together = min(flat.size, _ENTRIES // largest)
    directions = jnp.eye(flat.size, dtype=flat.dtype)
    slopes = jax.lax.map(slope, directions, batch_size=together if together > 1 else None)
    K_bar = unravel(slopes.astype(flat.dtype))
    if not any(jax.tree.leaves(perturbed[1])):
        return K_bar, jax.tree.map(lambda _: None, arrays)
    _, pull = jax.vjp(lambda arrays: _array(make, rowwise, K, eqx.combine(arrays, rest)), arrays)
    return K_bar, pull(bar)[0]


def _array(make, rowwise: bool, K, data) -> Array:
    if not rowwise:
        return make(K, data)
    rows, X = make(K, data)
    return rows(X)


def _paired_by_rows(rows, X: Float[Array, "N n"], bar: Float[Array, "N ..."]) -> Float[Array, ""]:
    """⟨bar, rows(X)⟩, in strips.

    The products of all strips are added entry by entry, and summed once: entries that XLA sums as
    it makes them are made by one thread, one at a time, in four times as long. Strips are cut out
    one at a time: `over_tiles` would rearrange, and so copy, `bar`.
    """
    N = len(X)
    if bar.size <= _FEW:
        return jnp.vdot(bar, rows(X))
    points = max(1, min(N // 4, _STRIP * N // bar.size))  # a loop of few strips is unrolled

    def strip(start, count):
        x, own = (jax.lax.dynamic_slice_in_dim(each, start, count) for each in (X, bar))
        return own * rows(x)

    def add(total, start):
        return total + strip(start, points), None

    starts = jnp.arange(0, N - points + 1, points)
    total, _ = jax.lax.scan(add, jnp.zeros((points, *bar.shape[1:]), bar.dtype), starts)
    left = N % points
    return total.sum() + (strip(N - left, left).sum() if left else 0.0)


def constant(tree):
    """`tree` with no derivative through its arrays; it may have leaves of other kinds, as K may."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(jax.lax.stop_gradient, arrays), rest)
