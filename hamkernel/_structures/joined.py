"""The data of a regression with inputs: points (x, u), checked."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.controlled import Controlled, KnownMatrix


def joined_data(
    K: AbstractMatrixKernel,
    X: Num[ArrayLike, "N n"],
    Y: Num[ArrayLike, "N n"],
    inputs: Num[ArrayLike, "N m"] | None = None,
) -> tuple[AbstractMatrixKernel, Float[Array, "N d"], Float[Array, "N n"]]:
    """Kernel, points and targets of a regression: with inputs the points are (x, u).

    Without inputs these are K, X and Y as they came, checked. Joined points are let through.

    Raises:
        ValueError: shapes do not fit, the inputs are missing, or cannot be told from the drift;
            TypeError: K takes no inputs.
    """
    if not isinstance(K, Controlled):
        if inputs is not None:
            raise TypeError(
                f"{type(K).__name__} takes no inputs: say how they act, hk.Controlled(K, "
                "inputs=hk.InputMatrix(k, acts_on=(1,)))."
            )
        X, Y = require.data(X, Y)
        return K, X, Y
    X, Y = require.points(X, "X"), require.points(Y, "Y")
    if inputs is None:
        if K.count is None or X.shape[1] != Y.shape[1] + K.count:
            raise ValueError(
                "the inputs are missing: a Controlled kernel needs inputs=U, shape (N, m), one row "
                "for each state."
            )
        known = require.data(X[:, : Y.shape[1]], Y)  # joined before
        X, Y = require.one_dtype(require.finite(X, "X"), known[1])
        return K, X, Y
    U = require.floating(inputs, "inputs")
    if X.shape != Y.shape and U.shape == Y.shape:
        raise ValueError(
            f"X has shape {X.shape}, inputs {U.shape} and Y {Y.shape}: X and the inputs seem to be "
            "swapped, hk.fit(K, X, Y, inputs=U)."
        )
    X, Y = require.data(X, Y)
    K = _counted(K, X, U)
    U = require.finite(U.astype(X.dtype), "inputs")
    if isinstance(K.inputs, KnownMatrix):
        Y = Y - U @ jnp.asarray(K.inputs.matrix, X.dtype).T
    else:
        _check_identified(U)
    return K, jnp.concatenate([X, U], axis=1), Y


def _counted(K: Controlled, X: Float[Array, "N n"], U: Array) -> Controlled:
    """The kernel that knows the number of inputs."""
    if U.ndim != 2 or len(U) != len(X) or U.shape[1] == 0:
        hint = " For one input write U[:, None]." if U.ndim == 1 else ""
        raise ValueError(
            f"inputs has shape {U.shape}; (N, m) is needed, m inputs for each of the N = {len(X)} "
            f"states.{hint}"
        )
    if K.count is not None and K.count != U.shape[1]:
        raise ValueError(f"inputs has {U.shape[1]} columns and the kernel {K.count} inputs.")
    K = Controlled(K.drift, K.inputs, U.shape[1])
    K.check_dimension(X.shape[1] + U.shape[1])
    return K


def _check_identified(U: Float[Array, "N m"]) -> None:
    """ValueError where a combination of the inputs is the same at all points."""
    if not require.is_concrete(U):
        return
    values = np.asarray(U)
    rank = int(np.linalg.matrix_rank(values - values.mean(axis=0)))
    if rank < values.shape[1]:
        raise ValueError(
            f"the inputs, less their means, have rank {rank} and there are {values.shape[1]}: a "
            "combination of them is the same at all points, and cannot be told from the drift. "
            "Vary every input on its own, leave out those that repeat others, or give the matrix "
            "that is known, Controlled(K, inputs=G)."
        )
