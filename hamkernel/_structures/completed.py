"""`complete`: the attributes of kernels that the data determine, in `Friction` and `Shared`."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.parts import Shared
from hamkernel._structures.base import AbstractMatrixKernel, nodes_of
from hamkernel._structures.friction import with_rest_speed


def complete(K: AbstractMatrixKernel, X: Float[Array, "N d"], n: int) -> Any:
    """The kernel K with the rest speeds of `Friction` and the centres of `Shared`, from data X."""
    K = with_rest_speed(K, X, n)
    if all(shared.centres is not None for shared in shared_laws(K)):
        return K
    require.no_tracers("hk.Shared() without centres", "Name them: hk.Shared(k, parts, centres).", X)
    with require.eager():
        states = np.asarray(X)[:, :n]

    def lacks_centres(node: Any) -> bool:
        return isinstance(node, Shared) and node.centres is None

    def add_centres(node: Any) -> Any:
        return node.with_centres(states) if lacks_centres(node) else node

    return jax.tree.map(add_centres, K, is_leaf=lacks_centres)


def shared_laws(K: Any) -> list[Shared]:
    """The `Shared` kernels within K."""
    return nodes_of(Shared, K)


def has_constant_parts(K: AbstractMatrixKernel) -> bool:
    """Whether every scalar kernel of K has `Shared` laws, and no map to the parts is trainable."""
    laws = [shared_laws(k) for k in K.scalar_kernels]
    parts = [shared.parts for laws_of_kernel in laws for shared in laws_of_kernel]
    return all(laws) and not any(map(eqx.is_inexact_array, jax.tree.leaves(parts)))
