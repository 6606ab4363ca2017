"""The box of hyperparameters, as all real vectors u."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from hamkernel._bounds import hyperparameters, traces
from hamkernel._structured import AbstractMatrixKernel
from hamkernel._trained import trained

RIDGE = "regularization"
ROUNDINGS = 100.0  # how far the ridge must stay above the rounding of the Gram
LOW_RANK_ROUNDINGS = 2e4  # above the rounding at which `choose_landmarks` drops a column


class SearchSpace(eqx.Module):
    """The map u (P,) -> (kernel, λ) with h = low + (high − low)(1 + sin u)/2 for each entry.

    The entries are those of the kernel's leaves, then log λ; `free` says which of them u moves.
    The box of λ follows the kernel, see `ridge_box`.
    """

    kernel: AbstractMatrixKernel
    start: Float[Array, " entries"]
    low: Float[Array, " entries"]
    high: Float[Array, " entries"]
    given_ridge: tuple[Float[Array, ""], Float[Array, ""]] | None
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    roundings: float = eqx.field(static=True)

    def __init__(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
        frozen: tuple[str, ...],
        bounds: dict[str, tuple[ArrayLike, ArrayLike]],
        roundings: float = ROUNDINGS,
    ):
        self.roundings = roundings
        dtype = X.dtype
        params = hyperparameters(K, X, Y)
        sizes = [param.low.size for param in params]
        self.names = (*np.repeat([p.name for p in params], sizes).tolist(), RIDGE)
        self.logarithmic = (*np.repeat([p.logarithmic for p in params], sizes).tolist(), True)
        held = {i for name in frozen for i in _matching(name, self.names)}
        self.free = tuple(i for i in range(len(self.names)) if i not in held)
        if not self.free:
            raise ValueError(
                "every hyperparameter is frozen, so there is nothing to tune: use fit."
            )
        low, high = (
            np.concatenate([*(side(p).ravel() for p in params), [0.0]])
            for side in (lambda p: p.low, lambda p: p.high)
        )
        self.given_ridge = None
        for name, given in bounds.items():
            low_given, high_given = _checked_box(name, given)
            for i in _matching(name, self.names):
                if self.names[i] == RIDGE:
                    self.given_ridge = jnp.asarray(low_given, dtype), jnp.asarray(high_given, dtype)
                else:
                    if self.logarithmic[i] and low_given <= 0:
                        raise ValueError(f"bounds[{name!r}] must be positive, got {given}.")
                    store = np.log if self.logarithmic[i] else np.asarray
                    low[i], high[i] = store(low_given), store(high_given)
        self.kernel = K
        self.low, self.high = jnp.asarray(low, dtype), jnp.asarray(high, dtype)
        leaves, _ = ravel_pytree(eqx.filter(K, eqx.is_inexact_array))
        self.start = jnp.asarray(np.append(leaves, np.log(regularization)), dtype)

    def decode(
        self, u: Float[Array, " P"], X: Float[Array, "N n"]
    ) -> tuple[AbstractMatrixKernel, Float[Array, ""]]:
        """The kernel and λ at u."""
        n_leaves = len(self.start) - 1
        moved = jnp.zeros_like(self.start).at[jnp.asarray(self.free)].set((1 + jnp.sin(u)) / 2)
        is_free = np.isin(np.arange(len(self.start)), self.free)
        h = jnp.where(is_free, self.low + (self.high - self.low) * moved, self.start)
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        kernel = eqx.combine(ravel_pytree(params)[1](h[:n_leaves]), static)
        if not is_free[-1]:
            return kernel, jnp.exp(self.start[-1])
        low, high = self.ridge_box(kernel, X)
        return kernel, jnp.exp(low + (high - low) * moved[-1])

    @eqx.filter_jit
    def ridge_box(
        self, kernel: AbstractMatrixKernel, X: Float[Array, "N n"]
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The bounds of log λ: from the rounding of the Gram to where the field is almost zero."""
        trace, cancelling = trained((kernel, X), traces)
        low = self.roundings * jnp.finfo(X.dtype).eps * cancelling / len(X)
        high = jnp.maximum(10 * trace / len(X), 2 * low)
        if self.given_ridge is not None:
            low = jnp.maximum(low, self.given_ridge[0])
            high = jnp.maximum(self.given_ridge[1], low)
        return jnp.log(low), jnp.log(high)

    def encode_start(self, X: Float[Array, "N n"]) -> Float[Array, " P"]:
        """The u of the caller's values, moved a little inside the box where they are not."""
        ridge_low, ridge_high = self.ridge_box(self.kernel, X)
        low, high = self.low.at[-1].set(ridge_low), self.high.at[-1].set(ridge_high)
        width = jnp.where(high > low, high - low, jnp.ones_like(low))
        # Not on the edge itself, where the derivative of the sine is zero.
        share = jnp.clip((self.start - low) / width, 0.01, 0.99)
        return jnp.arcsin(2 * share - 1)[jnp.asarray(self.free)]

    def at_bounds(self, u: Float[Array, " P"]) -> tuple[str, ...]:
        """The names of the hyperparameters within a hundredth of their box of its edge."""
        names = (self.names[i] for i, s in zip(self.free, np.sin(u), strict=True) if abs(s) > 0.98)
        return tuple(dict.fromkeys(names))

    def box(self, kernel: AbstractMatrixKernel, X: Float[Array, "N n"]) -> dict[str, tuple]:
        """The bounds by name, in the units of the hyperparameters; those of λ for `kernel`."""
        ridge_low, ridge_high = self.ridge_box(kernel, X)
        low, high = np.array(self.low), np.array(self.high)
        low[-1], high[-1] = ridge_low, ridge_high
        return {
            self.names[i]: tuple(
                float(np.exp(b[i]) if self.logarithmic[i] else b[i]) for b in (low, high)
            )
            for i in self.free
        }


def _matching(name: str, names: tuple[str, ...]) -> list[int]:
    """The entries whose full name is `name` or ends in it, after a dot."""
    found = [i for i, full in enumerate(names) if full == name or full.endswith("." + name)]
    if not found:
        raise ValueError(
            f"no hyperparameter {name!r}; this kernel has {', '.join(dict.fromkeys(names))}."
        )
    return found


def _checked_box(name: str, given: tuple[ArrayLike, ArrayLike]) -> tuple[float, float]:
    low, high = (float(np.asarray(side)) for side in given)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"bounds[{name!r}] must be finite with low < high, got ({low}, {high}).")
    return low, high
