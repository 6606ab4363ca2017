"""What is known before: the prior mean of a field, taken off the data and added to the fit."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.base import at_points, potential_of
from hamkernel._kernels.functions import as_pytree
from hamkernel._observations.rows import Rows
from hamkernel._structures.base import AbstractMatrixKernel

Mean = Callable[[Float[Array, " n"]], Float[Array, " n"]]


def checked_mean(mean: Any, n: int, dtype: Any) -> Any:
    """The mean as a PyTree, if it maps one state to one velocity; None if there is none."""
    if mean is None:
        return None
    require.velocity(mean, jnp.zeros(n, dtype), "mean")
    return as_pytree(mean)


def with_mean(field: Any, mean: Mean | None) -> Any:
    """The field and the mean together."""
    return field if mean is None else dataclasses.replace(field, mean=mean)


def without_mean(K: AbstractMatrixKernel, rows: Rows, mean: Mean | None) -> Rows:
    """The rows of f less the mean; AttributeError for energies of a mean without potential."""
    if mean is None:
        return rows
    potential = potential_of(mean, K) if len(rows.energies) else None

    def values(points):
        assert potential is not None
        return at_points(potential, points)

    return rows.less(rows.of(jax.tree_util.Partial(at_points, mean), values))
