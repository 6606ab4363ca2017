"""The hyperparameters of a kernel, with the boxes that it takes from the data.

Every kernel gives the bounds of its own arrays, `bounds`, and the data in the coordinates that the
kernels inside it see, `transform_inputs`: a `Select` or a `Warp` transforms them first.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, SequenceKey, keystr, tree_flatten_with_path
from jaxtyping import Array, Float

from hamkernel._gram.dense import gram_of_rows, trace
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, bounds_by_value
from hamkernel._kernels.functions import Bound
from hamkernel._kernels.symmetry import without_symmetry
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import Measurements
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.joined import AbstractJoinedKernel


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
    speed: float,
    states: Float[Array, "M n"],
) -> list[Hyperparameter]:
    """The trainable leaves of K, in the order of its leaves, with their boxes from the data.

    The size of K(x, x) is that at `states`, some of X or all, and `speed` that of velocities, the
    root of the mean square of their components.
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
    return list(_walk((), K, seen, _amplitude(K_middle, states, speed)))


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


def typical_speed(K: AbstractMatrixKernel, rows: Measurements) -> float:
    """The root of the mean square of a component of a velocity, as far as the rows tell.

    It is to the mean diagonal of the Gram of the points as the mean square of the rows is to that
    of theirs: an amplitude then fits both.
    """
    if isinstance(rows.blocks[0], Components) and len(rows.blocks) == 1:
        return float(np.sqrt(np.mean(np.asarray(rows.measured()) ** 2)))
    ratio = np.sum(np.asarray(rows.y) ** 2) / np.trace(np.asarray(_gram_of_rows(K, rows)))
    components = len(rows.points) * rows.dimension
    return float(np.sqrt(ratio * float(gram_trace(K, rows.points)) / components))


_gram_of_rows = eqx.filter_jit(gram_of_rows)


def _amplitude(K: AbstractMatrixKernel, X: Array, speed: float) -> float:
    """The factor that gives K(x, x) the size of velocities squared: over its mean diagonal."""
    trace = float(gram_trace(K, X))
    ratio = speed**2 * len(X) * K.outputs(X.shape[1]) / trace if trace > 0 else 0.0
    return ratio if np.isfinite(ratio) and ratio > 0 else 1.0


def _walk(path: tuple, node: object, X: np.ndarray, amplitude: float) -> Iterator[Hyperparameter]:
    """Walk the kernel; X is the data in the coordinates that `node` sees."""
    kernel = node if isinstance(node, AbstractScalarKernel | AbstractMatrixKernel) else None
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
                inside = kernel.seen_by(child, X, amplitude)
            yield from _walk((*path, *key), child, *inside)


def _children(node: object) -> list[tuple[tuple, Any]]:
    """The nodes below this one with their keys; the terms of a sum by their names."""
    if isinstance(node, Sum):
        keys = [
            (GetAttrKey(name),) if name else (GetAttrKey("terms"), SequenceKey(i))
            for i, name in enumerate(node.names)
        ]
        return list(zip(keys, node.terms, strict=True))
    return tree_flatten_with_path(node, is_leaf=lambda sub: sub is not node)[0]
