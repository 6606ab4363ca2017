"""Where to look for hyperparameters: a box from the data.

A lengthscale far below the distance between neighbours, or far above the extent of the data,
changes nothing but rounding; an amplitude is compared with the scale of Y. Coordinates are those
that the kernel sees: behind a `Select` or a `Warp` the data is transformed first.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, SequenceKey, keystr, tree_flatten_with_path
from jaxtyping import Array, ArrayLike, Float

from hamkernel._gram.dense import trace
from hamkernel._gram.observed import gram_of_rows
from hamkernel._kernels.base import AbstractScalarKernel, Invariance
from hamkernel._kernels.dot_products import Periodic
from hamkernel._kernels.functions import Bound
from hamkernel._kernels.transforms import Select, Warp, without_symmetry
from hamkernel._observations.rows import Rows
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.controlled import Controlled
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.port_hamiltonian import PortHamiltonian


@dataclasses.dataclass(frozen=True)
class Hyperparameter:
    """One trainable leaf of a kernel and the box to look for it in.

    `low` and `high` have the shape of the leaf and are in its stored coordinates, which are
    logarithms where `logarithmic` holds.
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
    Y: Float[Array, "N n"],
    states: Float[Array, "M n"],
) -> list[Hyperparameter]:
    """The trainable leaves of K, in the order of its leaves, with their boxes from the data.

    The size of K(x, x) is that at `states`, some of X or all.
    """
    seen = np.asarray(X)
    # What is a fair amplitude depends on the lengthscales: it is that in the middle of their boxes.
    arrays, rest = eqx.partition(K, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    middle = [
        jnp.asarray((p.low + p.high) / 2, leaf.dtype)
        for p, leaf in zip(_walk((), K, seen, 1.0), leaves, strict=True)
    ]
    K_middle = eqx.combine(jax.tree.unflatten(structure, middle), rest)
    return list(_walk((), K, seen, _amplitude(K_middle, states, Y)))


def constants(K: AbstractMatrixKernel) -> dict[str, float]:
    """The Python floats among the attributes of a kernel, which are no leaves to train."""
    found: dict[str, float] = {}
    for path, node in tree_flatten_with_path(K, is_leaf=lambda node: isinstance(node, Bound))[0]:
        if isinstance(node, float) and not eqx.is_array(node):  # that of NumPy is both
            found[keystr(path).removeprefix(".")] = node
        elif isinstance(node, Bound):
            found |= node.floats
    return found


gram_trace = eqx.filter_jit(trace)


def full_trace(K: AbstractMatrixKernel, X: Float[Array, "N n"]) -> Float[Array, ""]:
    """The trace of the Gram before the terms of an odd or even kernel cancel: what rounds."""
    terms = without_symmetry(K)
    trace = gram_trace(terms, X)
    if Invariance.REFLECTION in terms.invariance:
        return trace  # that of the Gram is no larger
    return jnp.maximum(trace, gram_trace(K, X))


def typical_velocities(K: AbstractMatrixKernel, rows: Rows) -> Float[Array, "P n"]:
    """Velocities of one size at the points of observations, of which K explains as much.

    Their mean square is to the mean diagonal of the Gram of the points as that of the rows is to
    that of the rows: an amplitude then fits both.
    """
    X = rows.points
    ratio = jnp.sum(rows.y**2) / jnp.trace(gram_of_rows(K, rows))
    return jnp.full_like(X, jnp.sqrt(ratio * gram_trace(K, X) / X.size))


def _amplitude(K: AbstractMatrixKernel, X: Array, Y: Array) -> float:
    """The factor that gives K(x, x) the size of Y: mean Y² over the mean diagonal."""
    trace = float(gram_trace(K, X))
    rows = len(X) * Y.shape[1]
    ratio = float(np.mean(np.asarray(Y) ** 2)) * rows / trace if trace > 0 else 0.0
    return ratio if np.isfinite(ratio) and ratio > 0 else 1.0


def _walk(path: tuple, node: object, X: np.ndarray, amplitude: float) -> Iterator[Hyperparameter]:
    """Walk the kernel; X is the data in the coordinates that `node` sees."""
    if isinstance(node, Select):
        X = X[:, list(node.dims)]
    if isinstance(node, Controlled):  # points are (x, u)
        X = X[:, : node.outputs(X.shape[1])]
    if isinstance(node, UnknownMasses):
        X = np.asarray(node.to_momenta(jnp.asarray(X)))
    for key, child in _children(node):
        if eqx.is_inexact_array(child):
            name = keystr((*path, *key)).removeprefix(".")
            if jnp.iscomplexobj(child):
                raise TypeError(
                    f"the hyperparameter {name} is complex; tune moves real numbers. Store its "
                    "real and imaginary parts as two arrays."
                )
            head, dot, last = name.rpartition(".")
            low, high = _box(node, last, child, X, amplitude)
            yield Hyperparameter(
                # `terms[0].kernel.lengthscale` for the leaf `.terms[0].kernel.log_lengthscale`
                name=head + dot + last.removeprefix("log_"),
                logarithmic=last.startswith("log_"),
                low=np.broadcast_to(low, child.shape),
                high=np.broadcast_to(high, child.shape),
            )
        elif child is not node:  # else a leaf that is no array: a degree, an activation
            seen = X
            if isinstance(node, Warp) and isinstance(child, AbstractScalarKernel):
                seen = np.asarray(jax.vmap(node.warped)(jnp.asarray(X)))
            yield from _walk((*path, *key), child, seen, amplitude)


def _children(node: object) -> list[tuple[tuple, Any]]:
    """The nodes below this one with their keys; the terms of a sum by their names."""
    if isinstance(node, Sum):
        keys = [
            (GetAttrKey(name),) if name else (GetAttrKey("terms"), SequenceKey(i))
            for i, name in enumerate(node.names)
        ]
        return list(zip(keys, node.terms, strict=True))
    return tree_flatten_with_path(node, is_leaf=lambda sub: sub is not node)[0]


def _box(
    node: object, name: str, leaf: Array, X: np.ndarray, amplitude: float
) -> tuple[ArrayLike, ArrayLike]:
    """Bounds for the leaf `name` of `node`, in its stored coordinates."""
    ours = isinstance(node, AbstractScalarKernel)
    if isinstance(node, Periodic) and name == "log_lengthscale":
        # On a circle of radius 1; below 1/64 its Fourier series is too long for random features.
        return np.log(max(0.6 / len(X), 1 / 64)), np.log(60.0)
    if ours and name == "log_lengthscale":
        spacing, extent = _spacing_and_extent(X, per_coordinate=leaf.ndim > 0)
        return np.log(0.3 * spacing), np.log(30 * extent)
    if ours and name == "log_period":
        spacing, extent = _spacing_and_extent(X, per_coordinate=leaf.ndim > 0)
        return np.log(2 * spacing), np.log(10 * extent)
    if ours and name == "log_scale":
        return np.log(1e-5 * amplitude), np.log(1e5 * amplitude)
    if ours and name == "log_offset":
        square = np.mean(np.sum(X**2, axis=1)) or 1.0
        return np.log(1e-4 * square), np.log(1e4 * square)
    if isinstance(node, PortHamiltonian) and name == "log_friction":
        return _friction_box(node, X)
    value = np.asarray(leaf)
    if name.startswith("log_"):
        return value - np.log(1e3), value + np.log(1e3)
    reach = 10 * np.maximum(1.0, np.abs(value))  # a number of unknown meaning
    return value - reach, value + reach


# Of the damping ratio, r over the critical friction: from 1e-5, at which an oscillation loses 6e-5
# of its amplitude in a period and far less than can be seen, to overdamped 30 times over.
_LEAST_DAMPING, _MOST_DAMPING = 1e-5, 30.0


def _friction_box(node: PortHamiltonian, X: np.ndarray) -> tuple[ArrayLike, ArrayLike]:
    """Bounds for log r: an oscillation of extents (Δq, Δp) in X is critical near r = Δp/Δq."""
    n = X.shape[1]
    damped = np.asarray(range(n // 2, n) if node.damped is None else node.damped)
    extent = np.ptp(X, axis=0)
    extent = np.where(extent > 0, extent, 1.0)
    critical = np.log(extent[damped] / extent[(damped + n // 2) % n])
    if node.log_friction.ndim == 0:
        critical = critical.mean()
    return critical + np.log(_LEAST_DAMPING), critical + np.log(_MOST_DAMPING)


def _spacing_and_extent(X: np.ndarray, per_coordinate: bool) -> tuple[ArrayLike, ArrayLike]:
    """The typical distance of nearest neighbours and the extent of the data, 1 where it is 0.

    The distance of N points in an extent L is taken as L / N: a fair lower bound in any dimension,
    since points on a few trajectories lie close together along them.
    """
    ranges = np.ptp(X, axis=0)
    extent = ranges if per_coordinate else np.asarray(np.linalg.norm(ranges))
    extent = np.where(extent > 0, extent, 1.0)
    return extent / max(len(X), 2), extent
