"""The data of a regression as a kernel sees it: here, and only here, inputs join their states.

With inputs a point is (x, u): d = n + m coordinates, at which a field has n components. What comes
after this file, the Gram, the solvers and the losses, knows only that.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hamkernel import _require as require
from hamkernel._observations.base import AbstractObservations
from hamkernel._observations.blocks import AbstractBlock, Components, merged
from hamkernel._observations.kinds import Equilibria, Velocities
from hamkernel._observations.rows import Rows
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.controlled import Controlled, KnownMatrix


def observations(X: Any, Y: Any, inputs: Any = None, part: bool = False) -> AbstractObservations:
    """`X` if it is observations, and then there is no Y; else the velocities Y at states X."""
    if not isinstance(X, AbstractObservations):
        return _velocities(X, Y, inputs, part)
    if Y is not None:
        raise TypeError(
            f"{type(X).__name__} is all of the data, and Y is not needed. Say the regularization "
            "by name: hk.fit(K, data, regularization=1e-4)."
        )
    if inputs is not None:
        raise TypeError(
            "observations hold their inputs themselves: hk.Velocities(X, Y, inputs=U), and "
            "likewise hk.Equilibria and hk.Functionals."
        )
    return X


def _velocities(X: Any, Y: Any, inputs: Any, part: bool) -> Velocities:
    """The velocities Y at the states X, all of which were measured.

    Raises:
        TypeError: there is no Y. ValueError: a component of Y is NaN.
    """
    if Y is None:
        raise TypeError(
            "with states X the velocities Y are needed, of the same shape (N, n); or observations "
            f"in the place of both, hk.Velocities(X, Y); got {type(X).__name__} and nothing."
        )
    data = Velocities(X, Y, inputs=inputs)
    if data.kept is not None:
        rows = np.flatnonzero(np.isnan(np.asarray(data.Y)).any(axis=1))
        raise ValueError(
            f"Y contains NaN in {require.listed(rows)}: remove or repair those points; or, if NaN "
            "means that a component was not measured, say so: hk.Velocities(X, Y) in the place of "
            "X and Y."
        )
    if not part:
        require.warn_of_few_points(data.X)
    return data


def sampled_points(
    K: AbstractMatrixKernel, X: Float[Array, "N n"], inputs: Any
) -> tuple[AbstractMatrixKernel, Float[Array, "N d"]]:
    """The kernel, which knows how many inputs there are, and points (x, u), without velocities."""
    data = Equilibria(X, inputs)
    K = with_input_count(K, data)
    (block, _), *_ = data.parts(inputs_of(K))
    return K, block.points


def rows_of_states(X: Float[Array, "N d"], Y: Float[Array, "N n"]) -> Rows:
    """Velocities at points, all measured with one noise."""
    outputs = None if X.shape == Y.shape else Y.shape[1]
    return Rows((Components(X, outputs=outputs),), Y.reshape(-1))


def rows_of_data(
    K: AbstractMatrixKernel, data: AbstractObservations, beside: Rows | None = None
) -> tuple[AbstractMatrixKernel, Rows]:
    """The kernel, which knows how many inputs there are, and the normal form of the observations.

    `beside` are the rows of others that were there before.

    Raises:
        ValueError: inputs are missing, or cannot be told from the drift; there is one energy.
            TypeError: K takes no inputs.
    """
    K = with_input_count(K, data, part=beside is not None)
    blocks, targets = zip(*data.parts(inputs_of(K)), strict=True)
    dtype = np.result_type(*[block.points.dtype for block in blocks])
    blocks = tuple(_cast(block, dtype) for block in blocks)
    pairs = zip(blocks, targets, strict=True)
    divided = [
        y.astype(dtype) if block.noise is None else y.astype(dtype) / block.noise
        for block, y in pairs
    ]
    rows = Rows(merged(blocks), divided[0] if len(divided) == 1 else jnp.concatenate(divided))
    before = 0 if beside is None else len(beside.energies)
    if before + len(rows.energies) == 1:
        raise ValueError(
            "there is one energy, and energies are known up to a constant: two are needed to say "
            "something."
        )
    return K, rows


def inputs_of(K: AbstractMatrixKernel) -> int:
    """m, the number of inputs; 0 of a kernel that takes none."""
    return K.input_count if isinstance(K, Controlled) else 0


def with_input_count(
    K: AbstractMatrixKernel, data: AbstractObservations, part: bool = False
) -> AbstractMatrixKernel:
    """The kernel that knows the number of inputs of the data.

    Of a `part` of the data the inputs may be constant.
    """
    given = list(data.driven())
    if not isinstance(K, Controlled):
        if given:
            raise TypeError(
                f"{type(K).__name__} takes no inputs: say how they act, hk.Controlled(K, "
                "inputs=hk.InputMatrix(k, acts_on=(1,)))."
            )
        return K
    counts = {u.shape[-1] for u in given}
    if len(counts) > 1:
        raise ValueError(f"the observations have {sorted(counts)} inputs: all need the same m.")
    if not counts:
        list(data.parts(1))  # raises where inputs are needed
        return K
    count = counts.pop()
    if K.count is not None and K.count != count:
        raise ValueError(f"inputs has {count} columns and the kernel {K.count} inputs.")
    K = Controlled(K.drift, K.inputs, count)
    K.check_dimension(data.dimension + count)
    if not isinstance(K.inputs, KnownMatrix) and not part:
        _check_identified([u.reshape(-1, count) for u in given])
    return K


def _check_identified(given: list[Float[Array, "_ m"]]) -> None:
    """ValueError where a combination of the inputs is the same at all points."""
    if not require.is_concrete(given):
        return
    values = np.concatenate([np.asarray(u) for u in given])
    rank = int(np.linalg.matrix_rank(values - values.mean(axis=0)))
    if rank < values.shape[1]:
        raise ValueError(
            f"the inputs, less their means, have rank {rank} and there are {values.shape[1]}: a "
            "combination of them is the same at all points, and cannot be told from the drift. "
            "Vary every input on its own, leave out those that repeat others, or give the matrix "
            "that is known, Controlled(K, inputs=G)."
        )


def _cast(block: AbstractBlock, dtype: Any) -> AbstractBlock:
    if block.points.dtype == dtype:
        return block
    arrays, rest = eqx.partition(block, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda a: a.astype(dtype), arrays), rest)
