"""The hyperparameters of a kernel, their bounds from the data, and the search space.

The method `bounds` of a kernel gives the bounds of its arrays. The method `transform_inputs` gives
the data in the coordinates of the inner kernels: a `Select` or a `Warp` transforms them first.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.tree_util import GetAttrKey, SequenceKey, keystr, tree_flatten_with_path
from jaxtyping import Array, ArrayLike, Float

from hamkernel._gram import forward_differentiated, gram_of_rows, gram_rounding, trace
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, bounds_by_value
from hamkernel._kernels.functions import Bound
from hamkernel._kernels.symmetry import drop_symmetry
from hamkernel._machine import precise_jit
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import Measurements
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.joined import AbstractJoinedKernel, Controlled
from hamkernel._tuning.minimiser import from_box, inside_box

RIDGE = "regularization"
_EDGE = 0.01  # a value within this share of the box counts as resting on a bound


@dataclasses.dataclass(frozen=True)
class Hyperparameter:
    """One trainable leaf of a kernel and its search box.

    `low` and `high` have the shape of the leaf and its stored coordinates, which are logarithms if
    `logarithmic`.
    """

    name: str
    logarithmic: bool
    low: np.ndarray
    high: np.ndarray

    @property
    def entries(self) -> list[str]:
        """The name of each number, with its place if there are several: `kernel.lengthscale[1]`."""
        if self.low.ndim == 0:
            return [self.name]
        return [
            f"{self.name}[{', '.join(map(str, index))}]" for index in np.ndindex(self.low.shape)
        ]


def hyperparameters(
    K: AbstractMatrixKernel,
    X: Float[Array, "N n"],
    rms: float,
    states: Float[Array, "M n"],
) -> list[Hyperparameter]:
    """The trainable leaves of K, in order, with their boxes from the data.

    The size of K(x, x) is taken at `states`, a subset of X or all of X. `rms` is the root mean
    square of a component of the velocities.
    """
    inputs = np.asarray(X)
    # The amplitude that fits depends on the lengthscales; we take them in the middle of their
    # boxes.
    arrays, rest = eqx.partition(K, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    middle = [
        jnp.asarray((p.low + p.high) / 2, leaf.dtype)
        for p, leaf in zip(_walk((), K, inputs, {}), leaves, strict=True)
    ]
    K_middle = eqx.combine(jax.tree.unflatten(structure, middle), rest)
    return list(_walk((), K, inputs, _amplitudes(K, K_middle, states, rms)))


def named_values(K: AbstractMatrixKernel, X: Float[np.ndarray, "N n"]) -> dict[str, Array]:
    """The values of the trainable leaves of K in their units, by the names of their bounds."""
    leaves = jax.tree.leaves(eqx.filter(K, eqx.is_inexact_array))
    return {
        param.name: jnp.exp(leaf) if param.logarithmic else leaf
        for param, leaf in zip(_walk((), K, X, {}), leaves, strict=True)
    }


def constants(K: AbstractMatrixKernel) -> dict[str, float]:
    """The Python floats among the attributes of a kernel, which are not trained, by name."""
    values: dict[str, float] = {}
    for path, node in tree_flatten_with_path(K, is_leaf=lambda node: isinstance(node, Bound))[0]:
        if isinstance(node, float) and not eqx.is_array(node):  # a NumPy float is both
            values[keystr(path).removeprefix(".")] = node
        elif isinstance(node, Bound):
            values |= node.floats
    return values


def with_leaves(K: Any, leaves: Float[Array, " p"]) -> Any:
    """The kernel K with these numbers as its trainable leaves."""
    params, static = eqx.partition(K, eqx.is_inexact_array)
    flat, unravel = ravel_pytree(params)
    return eqx.combine(unravel(leaves.astype(flat.dtype)), static)


gram_trace = precise_jit(trace)


def full_trace(K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Float[Array, ""]:
    """The trace of the Gram before terms of odd and even kernels cancel, for its rounding."""
    terms = drop_symmetry(K)
    trace = gram_trace(terms, X)
    if Invariance.REFLECTION in terms.invariance:
        return trace  # the trace of the Gram is no larger
    return jnp.maximum(trace, gram_trace(K, X))


def velocity_rms(K: AbstractMatrixKernel, rows: Measurements) -> float:
    """The root mean square of a component of a velocity, estimated from the rows.

    For other rows than velocities, the mean square is multiplied by the ratio of two mean
    diagonals: of the Gram of velocities at the points, and of the Gram of the rows.
    """
    if isinstance(rows.blocks[0], Components) and len(rows.blocks) == 1:
        return float(np.sqrt(np.mean(np.asarray(rows.measured_values()) ** 2)))
    ratio = np.sum(np.asarray(rows.y) ** 2) / np.trace(np.asarray(_gram_of_rows(K, rows)))
    components = len(rows.points) * rows.dimension
    return float(np.sqrt(ratio * float(gram_trace(K, rows.points)) / components))


_gram_of_rows = precise_jit(gram_of_rows)


def _amplitude(K: AbstractMatrixKernel, X: Array, rms: float) -> float:
    """The amplitude rms²/mean diagonal, with which K(x, x) has the size of squared velocities."""
    trace = float(gram_trace(K, X))
    ratio = rms**2 * len(X) * K.outputs(X.shape[1]) / trace if trace > 0 else 0.0
    return ratio if np.isfinite(ratio) and ratio > 0 else 1.0


def _amplitudes(
    K: AbstractMatrixKernel, middle: Any, X: Float[Array, "N d"], rms: float
) -> dict[int, float]:
    """The amplitudes with which K, and each part of K alone, has the size of squared velocities.

    The keys are the `id` of the parts; `middle` is K with hyperparameters in the middle of their
    boxes. Parts have different units. With one common factor, the size of the energy set the
    bounds for the friction. For a spring that moves by 1e-8 m in 1e-6 s, described in SI units,
    only a fraction 9e-6 of the friction was found (`tests/test_friction.py`).
    """
    amplitudes = {id(K): _amplitude(middle, X, rms)}
    if isinstance(K, Sum):
        for term, of_middle in zip(K.terms, middle.terms, strict=True):
            amplitudes |= _amplitudes(term, of_middle, X, rms)
    elif isinstance(K, AbstractJoinedKernel):
        amplitudes |= _amplitudes(K.state_kernel, middle.state_kernel, K.split(X)[0], rms)
        if isinstance(K, Controlled):
            both, drift = amplitudes[id(K)], amplitudes[id(K.drift)]  # as 1/(a + b) and 1/a
            amplitudes[id(K.inputs)] = 1 / (1 / both - 1 / drift) if both < drift else both
    return amplitudes


def boxes_of(
    k: AbstractScalarKernel, name: str, X: Float[np.ndarray, "N n"], amplitude: float
) -> list[Hyperparameter]:
    """The trainable leaves of the scalar kernel `name`, with their boxes from points X."""
    return list(_walk((GetAttrKey(name),), k, X, {}, amplitude))


def _walk(
    path: tuple,
    node: object,
    X: np.ndarray,
    amplitudes: Mapping[int, float],
    amplitude: float = 1.0,
) -> Iterator[Hyperparameter]:
    """Walk the kernel; X is the data in the coordinates of `node`."""
    kernel = node if isinstance(node, AbstractScalarKernel | AbstractMatrixKernel) else None
    amplitude = amplitudes.get(id(node), amplitude)
    inside = (X if kernel is None else kernel.transform_inputs(X)), amplitude
    for key, child in _children(node):
        if eqx.is_inexact_array(child):
            name = keystr((*path, *key)).removeprefix(".")
            if jnp.iscomplexobj(child):
                raise TypeError(
                    f"the hyperparameter {name} is complex; tune moves real numbers. Store its "
                    "real and imaginary parts as two arrays."
                )
            head, dot, last = name.rpartition(".")
            box = (
                bounds_by_value(last, child)
                if kernel is None
                else kernel.bounds(last, X, amplitude)
            )
            yield Hyperparameter(
                # `terms[0].kernel.lengthscale` for the leaf `.terms[0].kernel.log_lengthscale`
                name=head + dot + last.removeprefix("log_"),
                logarithmic=last.startswith("log_"),
                low=np.broadcast_to(box[0], child.shape),
                high=np.broadcast_to(box[1], child.shape),
            )
        elif child is not node:  # else a leaf that is no array: a degree, an activation
            if isinstance(kernel, AbstractJoinedKernel):
                inside = kernel.child_inputs(child, X, amplitude)
            yield from _walk((*path, *key), child, inside[0], amplitudes, inside[1])


def _children(node: object) -> list[tuple[tuple, Any]]:
    """The children of a node with their keys; the terms of a sum by their names."""
    if isinstance(node, Sum):
        keys = [
            (GetAttrKey(name),) if name else (GetAttrKey("terms"), SequenceKey(i))
            for i, name in enumerate(node.names)
        ]
        return list(zip(keys, node.terms, strict=True))
    return tree_flatten_with_path(node, is_leaf=lambda sub: sub is not node)[0]


class SearchSpace(eqx.Module):
    """The map u (P,) -> (kernel, λ) with h = low + (high − low)(1 + sin u)/2 for each entry.

    The entries are those of the kernel's leaves, then log λ; `free` holds the indices of the
    entries that u moves. The box of λ depends on the kernel, see `ridge_bounds`.
    """

    kernel: AbstractMatrixKernel
    states: Float[Array, "M n"]
    start: Float[Array, " entries"]
    regularization: Float[Array, ""]
    low: Float[Array, " entries"]
    high: Float[Array, " entries"]
    ridge_interval: tuple[Float[Array, ""], Float[Array, ""]] | None
    entries: tuple[str, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    roundings: float = eqx.field(static=True)

    def __init__(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        rms: float,
        regularization: Float[Array, ""],
        frozen: tuple[str, ...],
        bounds: Mapping[str, tuple[ArrayLike, ArrayLike]],
        roundings: float = 100.0,
        states: Float[Array, "M n"] | None = None,
    ):
        """Make the space for data at X; the size of the Gram is taken on `states`, or X.

        `rms` is the size of velocities, see `velocity_rms`. The smallest λ is `roundings` times the
        rounding of the Gram, ε tr(G)/N; with 100, two digits remain.
        """
        dtype = X.dtype
        self.roundings = roundings
        self.states = X if states is None else states
        params = hyperparameters(K, X, rms, self.states)
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
        self.ridge_interval = None
        for name, interval in bounds.items():
            matching = self._matching(name)
            for i, *pair in zip(matching, *_check_box(name, interval, len(matching)), strict=True):
                if self.logarithmic[i] and pair[0] <= 0:
                    raise ValueError(f"bounds[{name!r}] must be positive, got {interval}.")
                if i == len(self.names) - 1:
                    self.ridge_interval = jnp.asarray(pair[0], dtype), jnp.asarray(pair[1], dtype)
                else:
                    low[i], high[i] = np.log(pair) if self.logarithmic[i] else pair
        self.kernel = K
        self.low, self.high = jnp.asarray(low, dtype), jnp.asarray(high, dtype)
        leaves, _ = ravel_pytree(eqx.filter(K, eqx.is_inexact_array))
        self.start = jnp.asarray(np.append(leaves, np.log(regularization)), dtype)
        self.regularization = jnp.asarray(regularization, dtype)

    @property
    def chooses_ridge(self) -> bool:
        """Whether λ is searched within the default bounds."""
        return self.ridge_interval is None and self._moves_ridge

    @property
    def _moves_ridge(self) -> bool:
        return len(self.names) - 1 in self.free

    def allows(self, regularization: Float[Array, ""]) -> bool:
        """Whether λ is below the caller's upper bound, if there is one and λ is searched."""
        if self.ridge_interval is None or not self._moves_ridge:
            return True
        return bool(regularization <= 1.01 * self.ridge_interval[1])

    def decode(
        self, u: Float[Array, " P"]
    ) -> tuple[AbstractMatrixKernel, Float[Array, ""], Float[Array, ""]]:
        """The kernel and λ at u, and tr(G)/N of this kernel."""
        all_entries = jnp.zeros_like(self.start).at[jnp.asarray(self.free)].set(u)
        is_free = np.isin(np.arange(len(self.start)), self.free)
        h = jnp.where(is_free, inside_box(all_entries, self.low, self.high), self.start)
        kernel = with_leaves(self.kernel, h[:-1])
        size = self.size_of_gram(kernel)
        if not is_free[-1]:
            return kernel, self.regularization, size
        return kernel, jnp.exp(inside_box(all_entries[-1], *self.ridge_bounds(size))), size

    def size_of_gram(self, kernel: AbstractMatrixKernel) -> Float[Array, ""]:
        """tr(G)/N, before the terms of an odd or even kernel cancel."""
        return forward_differentiated((kernel, self.states), full_trace) / len(self.states)

    def ridge_bounds(self, size: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The bounds of log λ: from the rounding of the Gram to a field of almost zero.

        Args:
            size: `size_of_gram` of the kernel.
        """
        low, high = self.roundings * gram_rounding(size), 10 * size
        if self.ridge_interval is not None:
            low = jnp.maximum(low, self.ridge_interval[0])
            high = jnp.maximum(self.ridge_interval[1], low)
        return jnp.log(low), jnp.log(high)

    @precise_jit
    def encode_start(self) -> Float[Array, " P"]:
        """The u of the caller's values, moved into the box by a margin if they are outside."""
        ridge_low, ridge_high = self.ridge_bounds(self.size_of_gram(self.kernel))
        low, high = self.low.at[-1].set(ridge_low), self.high.at[-1].set(ridge_high)
        # If the kernel is not positive at the start, λ has no bounds and starts in the middle.
        # The margin is twice `_EDGE`, so that a start does not count as resting on a bound.
        return from_box(self.start, low, high, 2 * _EDGE)[jnp.asarray(self.free)]

    @property
    def directions(self) -> tuple[int, ...]:
        """For each entry that u moves, the direction in which a design of starts moves it.

        All logarithms in one array, the lengthscales of several coordinates, share one direction.
        """
        keys = [self.names[i] if self.logarithmic[i] else i for i in self.free]
        return tuple(list(dict.fromkeys(keys)).index(key) for key in keys)

    def active_bounds(self, u: Float[np.ndarray, " P"]) -> tuple[str, ...]:
        """The hyperparameters that rest on a bound; entries of arrays by name and coordinate."""
        at_edge = np.abs(np.sin(u)) > 1 - 2 * _EDGE
        return tuple(self.entries[i] for i in np.array(self.free)[at_edge])

    def bounds(self, size: Float[Array, ""]) -> dict[str, tuple[float, float]]:
        """The lowest and highest value for each name, in its units; λ for a Gram of this `size`."""
        low, high = np.array(self.low, float), np.array(self.high, float)
        low[-1], high[-1] = self.ridge_bounds(size)
        box: dict[str, tuple[float, float]] = {}
        for i in self.free:
            pair = np.array([low[i], high[i]])
            lowest, highest = (np.exp(pair) if self.logarithmic[i] else pair).tolist()
            before = box.get(self.names[i], (lowest, highest))
            box[self.names[i]] = min(before[0], lowest), max(before[1], highest)
        return box

    def values(
        self, kernel: AbstractMatrixKernel, regularization: Float[Array, ""]
    ) -> dict[str, Array]:
        """The free hyperparameters, in their units, in the shapes of the leaves."""
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
        """The entries whose full name ends in `name`, or with `of_part` contains `name`."""
        indices = [
            i
            for i, (full, entry) in enumerate(zip(self.names, self.entries, strict=True))
            if f".{full}".endswith(f".{name}")
            or f".{entry}".endswith(f".{name}")
            or (of_part and f".{name}." in f".{full}")
        ]
        if not indices:
            raise ValueError(
                f"no hyperparameter {name!r}; this kernel has "
                f"{', '.join(dict.fromkeys(self.names))}."
            )
        return indices


def _check_box(
    name: str, interval: tuple[ArrayLike, ArrayLike], size: int
) -> tuple[np.ndarray, np.ndarray]:
    """The lower and the upper bounds, one for each entry with this name."""
    sides = [np.asarray(side, float) for side in interval] if hasattr(interval, "__len__") else []
    if len(sides) != 2 or any(side.shape not in ((), (size,)) for side in sides):
        raise ValueError(
            f"bounds[{name!r}] must be (low, high), both numbers or arrays of shape ({size},), "
            f"one number for each entry; got {interval}."
        )
    low, high = (np.broadcast_to(side, (size,)) for side in sides)
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError(f"bounds[{name!r}] must be finite with low < high, got {interval}.")
    return low, high
