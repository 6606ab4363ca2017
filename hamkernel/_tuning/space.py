"""The box of hyperparameters, as all real vectors u."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from hamkernel._gram.derivatives import forward_differentiated
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._tuning.boxes import full_trace, hyperparameters

RIDGE = "regularization"
ROUNDINGS = 100.0  # how far the ridge stays above the rounding of the Gram, ε tr(G): two digits
LOW_RANK_ROUNDINGS = 2e4  # above the rounding at which `choose_landmarks` drops a column
_EDGE = 0.01  # the share of the box that counts as resting on a bound


class SearchSpace(eqx.Module):
    """The map u (P,) -> (kernel, λ) with h = low + (high − low)(1 + sin u)/2 for each entry.

    The entries are those of the kernel's leaves, then log λ; `free` says which of them u moves.
    The box of λ follows the kernel, see `ridge_box`.
    """

    kernel: AbstractMatrixKernel
    states: Float[Array, "M n"]
    start: Float[Array, " entries"]
    regularization: Float[Array, ""]
    low: Float[Array, " entries"]
    high: Float[Array, " entries"]
    given_ridge: tuple[Float[Array, ""], Float[Array, ""]] | None
    entries: tuple[str, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    roundings: float = eqx.field(static=True)

    def __init__(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        speed: float,
        regularization: Float[Array, ""],
        frozen: tuple[str, ...],
        bounds: Mapping[str, tuple[ArrayLike, ArrayLike]],
        roundings: float = ROUNDINGS,
        states: Float[Array, "M n"] | None = None,
    ):
        """Make the space for data at X; the size of the Gram is taken on `states`, or X.

        `speed` is that of velocities, see `boxes.typical_speed`.
        """
        dtype = X.dtype
        self.roundings = roundings
        self.states = X if states is None else states
        params = hyperparameters(K, X, speed, self.states)
        sizes = [param.low.size for param in params]
        self.names = (*np.repeat([p.name for p in params], sizes).tolist(), RIDGE)
        self.entries = (*(entry for p in params for entry in p.entries), RIDGE)
        self.logarithmic = (*np.repeat([p.logarithmic for p in params], sizes).tolist(), True)
        held = {i for name in frozen for i in self._matching(name, of_part=True)}
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
            matching = self._matching(name)
            for i, *pair in zip(matching, *_checked_box(name, given, len(matching)), strict=True):
                if self.logarithmic[i] and pair[0] <= 0:
                    raise ValueError(f"bounds[{name!r}] must be positive, got {given}.")
                if i == len(self.names) - 1:
                    self.given_ridge = jnp.asarray(pair[0], dtype), jnp.asarray(pair[1], dtype)
                else:
                    low[i], high[i] = np.log(pair) if self.logarithmic[i] else pair
        self.kernel = K
        self.low, self.high = jnp.asarray(low, dtype), jnp.asarray(high, dtype)
        leaves, _ = ravel_pytree(eqx.filter(K, eqx.is_inexact_array))
        self.start = jnp.asarray(np.append(leaves, np.log(regularization)), dtype)
        self.regularization = jnp.asarray(regularization, dtype)

    @property
    def chooses_ridge(self) -> bool:
        """Whether the least λ is ours to choose, and not what the caller has said."""
        return self.given_ridge is None and self._moves_ridge

    @property
    def _moves_ridge(self) -> bool:
        return len(self.names) - 1 in self.free

    def allows(self, regularization: Float[Array, ""]) -> bool:
        """Whether λ is below the upper bound that the caller gave, if it is searched in one."""
        if self.given_ridge is None or not self._moves_ridge:
            return True
        return bool(regularization <= 1.01 * self.given_ridge[1])

    def decode(
        self, u: Float[Array, " P"]
    ) -> tuple[AbstractMatrixKernel, Float[Array, ""], Float[Array, ""]]:
        """The kernel and λ at u, and tr(G)/N there."""
        n_leaves = len(self.start) - 1
        moved = jnp.zeros_like(self.start).at[jnp.asarray(self.free)].set((1 + jnp.sin(u)) / 2)
        is_free = np.isin(np.arange(len(self.start)), self.free)
        h = jnp.where(is_free, self.low + (self.high - self.low) * moved, self.start)
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        flat, unravel = ravel_pytree(params)
        kernel = eqx.combine(unravel(h[:n_leaves].astype(flat.dtype)), static)
        size = self.size_of_gram(kernel)
        if not is_free[-1]:
            return kernel, self.regularization, size
        low, high = self.ridge_box(size)
        return kernel, jnp.exp(low + (high - low) * moved[-1]), size

    def size_of_gram(self, kernel: AbstractMatrixKernel) -> Float[Array, ""]:
        """tr(G)/N, before the terms of an odd or even kernel cancel."""
        return forward_differentiated((kernel, self.states), full_trace) / len(self.states)

    def ridge_box(self, size: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The bounds of log λ: from the rounding of the Gram to where the field is almost zero.

        Args:
            size: `size_of_gram` of the kernel.
        """
        low, high = self.roundings * jnp.finfo(self.low.dtype).eps * size, 10 * size
        if self.given_ridge is not None:
            low = jnp.maximum(low, self.given_ridge[0])
            high = jnp.maximum(self.given_ridge[1], low)
        return jnp.log(low), jnp.log(high)

    @eqx.filter_jit
    def encode_start(self) -> Float[Array, " P"]:
        """The u of the caller's values, moved a little inside the box where they are not."""
        ridge_low, ridge_high = self.ridge_box(self.size_of_gram(self.kernel))
        low, high = self.low.at[-1].set(ridge_low), self.high.at[-1].set(ridge_high)
        width = jnp.where(high > low, high - low, jnp.ones_like(low))
        # Not on the edge itself, where the derivative of the sine is zero, nor where it would
        # count as resting there before it has moved.
        share = jnp.clip((self.start - low) / width, 2 * _EDGE, 1 - 2 * _EDGE)
        # Where the kernel is not positive at the start there is no box of λ.
        share = jnp.where(jnp.isfinite(share), share, 0.5)
        return jnp.arcsin(2 * share - 1)[jnp.asarray(self.free)]

    @property
    def directions(self) -> tuple[int, ...]:
        """For each entry that u moves, the direction in which a design of starts moves it.

        It is one for all logarithms in an array: those are lengthscales of several coordinates.
        """
        keys = [self.names[i] if self.logarithmic[i] else i for i in self.free]
        return tuple(list(dict.fromkeys(keys)).index(key) for key in keys)

    def at_bounds(self, u: Float[np.ndarray, " P"]) -> tuple[str, ...]:
        """The hyperparameters that rest on a bound; of an array by name and coordinate."""
        at_edge = np.abs(np.sin(u)) > 1 - 2 * _EDGE
        return tuple(self.entries[i] for i in np.array(self.free)[at_edge])

    def box(self, size: Float[Array, ""]) -> dict[str, tuple[float, float]]:
        """The lowest and highest value for each name, in its units; λ where the Gram has `size`."""
        low, high = np.array(self.low, float), np.array(self.high, float)
        low[-1], high[-1] = self.ridge_box(size)
        box: dict[str, tuple[float, float]] = {}
        for i in self.free:
            pair = np.array([low[i], high[i]])
            least, most = (np.exp(pair) if self.logarithmic[i] else pair).tolist()
            before = box.get(self.names[i], (least, most))
            box[self.names[i]] = min(before[0], least), max(before[1], most)
        return box

    def values(
        self, kernel: AbstractMatrixKernel, regularization: Float[Array, ""]
    ) -> dict[str, Array]:
        """The hyperparameters that are searched, in their units, in the shapes of the leaves."""
        names = iter(dict.fromkeys(self.names))
        leaves = jax.tree.leaves(eqx.filter(kernel, eqx.is_inexact_array))
        logarithmic = dict(zip(self.names, self.logarithmic, strict=True))
        values = {
            name: jnp.asarray(np.exp(np.asarray(leaf)) if logarithmic[name] else leaf)
            for name, leaf in zip(names, leaves, strict=False)
        }
        values[RIDGE] = regularization
        return {name: values[name] for name in dict.fromkeys(self.names[i] for i in self.free)}

    def _matching(self, name: str, of_part: bool = False) -> list[int]:
        """The entries whose full name ends in `name`, or, of a part, has it anywhere."""
        found = [
            i
            for i, (full, entry) in enumerate(zip(self.names, self.entries, strict=True))
            if f".{full}".endswith(f".{name}")
            or f".{entry}".endswith(f".{name}")
            or (of_part and f".{name}." in f".{full}")
        ]
        if not found:
            raise ValueError(
                f"no hyperparameter {name!r}; this kernel has "
                f"{', '.join(dict.fromkeys(self.names))}."
            )
        return found


def _checked_box(
    name: str, given: tuple[ArrayLike, ArrayLike], size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a box, for each entry of that name."""
    sides = [np.asarray(side, float) for side in given] if hasattr(given, "__len__") else []
    if len(sides) != 2 or any(side.shape not in ((), (size,)) for side in sides):
        raise ValueError(
            f"bounds[{name!r}] must be (low, high), both numbers or arrays of shape ({size},), "
            f"one number for each entry; got {given}."
        )
    low, high = (np.broadcast_to(side, (size,)) for side in sides)
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError(f"bounds[{name!r}] must be finite with low < high, got {given}.")
    return low, high
