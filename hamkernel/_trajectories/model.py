"""A kernel with both kinds of noise, and its rows in the span of landmarks."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Float

from hamkernel._gram import assemble, forward_differentiated
from hamkernel._kernels.base import Scaled
from hamkernel._machine import precise_jit
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.joined import InputMatrix
from hamkernel._structures.structure import AbstractStructure
from hamkernel._trajectories.segments import LinearisedSegments


class KernelRows(eqx.Module):
    """K(x, S) for many points x, as rows."""

    points: Float[Array, "m d"]

    def __call__(self, K: AbstractMatrixKernel, X: Float[Array, "N d"]):
        return functools.partial(self.rows, K), X

    def rows(self, K: AbstractMatrixKernel, X: Float[Array, "N d"]) -> Float[Array, "N n q"]:
        return assemble(K, X, self.points).reshape(len(X), K.outputs(X.shape[1]), -1)


def landmark_whitening(K: AbstractMatrixKernel, S: Float[Array, "m d"]) -> Float[Array, "q q"]:
    """T = L⁻ᵀ with L Lᵀ = K(S, S), q = m n."""
    G = forward_differentiated((K, S), KernelRows(S), rowwise=True)
    G = G.reshape(-1, G.shape[-1])
    # Each component has its own size, since units differ. Some are zero, such as q̇ for a U(q).
    d = jnp.diagonal(G)
    # A hundred times the rounding bounds how finely landmarks resolve, and biases nothing.
    rounding = 100 * jnp.finfo(G.dtype).eps * len(G) * jnp.where(d > 0, d, d.mean())
    eye = jnp.eye(len(G), dtype=G.dtype)
    return solve_triangular(jnp.linalg.cholesky(G + jnp.diag(rounding)), eye, lower=True).T


def with_amplitude(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """K with an amplitude on every structure and input matrix, which a likelihood needs.

    `Symplectic(Gaussian(2.0))` becomes `Symplectic(1.0 * Gaussian(2.0))`.
    """

    def is_structure(node: object) -> bool:
        return isinstance(node, AbstractStructure | InputMatrix)

    def scale(node):
        if not is_structure(node) or node.kernel.has_amplitude:
            return node
        return eqx.tree_at(lambda node: node.kernel, node, Scaled(node.kernel, 1.0))

    return jax.tree.map(scale, K, is_leaf=is_structure)


class Model(NamedTuple):
    """A kernel, sensor noise and process noise, as one vector h of hyperparameters.

    Attributes:
        kernel: the kernel.
        log_noise: log σ of each coordinate.
        log_process: log q of each coordinate, −inf if there is no process noise.
    """

    kernel: AbstractMatrixKernel
    log_noise: Float[Array, " n"]
    log_process: Float[Array, " n"]

    @property
    def is_disturbed(self) -> bool:
        """Whether there is process noise."""
        return bool(jnp.isfinite(self.log_process).any())

    @property
    @precise_jit  # which is one small program instead of five, as in `at`
    def flat(self) -> Float[Array, " P"]:
        leaves, _ = ravel_pytree(eqx.filter(self.kernel, eqx.is_inexact_array))
        leaves = leaves.astype(self.log_noise.dtype)
        return jnp.concatenate([leaves, self.log_noise, self.log_process])

    @precise_jit
    def unflatten(self, h: Float[ArrayLike, " P"]) -> "Model":
        h = jnp.asarray(h)
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        flat, unravel = ravel_pytree(params)
        leaves, noise, process = jnp.split(h, [flat.size, flat.size + len(self.log_noise)])
        return Model(eqx.combine(unravel(leaves.astype(flat.dtype)), static), noise, process)


class WhitenedRows(NamedTuple):
    """Rows r̃ = M̃ w + noise of variance one, independent, with unknown starts integrated out.

    Attributes:
        M: the matrix M̃, shape (D, q).
        r: the values r̃, shape (D,).
        constant: the part of −log p that does not depend on M̃.
    """

    M: Float[Array, "D q"]
    r: Float[Array, " D"]
    constant: Float[Array, ""]


def columns(
    K: AbstractMatrixKernel,
    S: Float[Array, "m d"],
    T: Float[Array, "q q"],
    rows: LinearisedSegments,
) -> Float[Array, "S L n q"]:
    """Σ_k Γ_k K(x̂(τ_k), S) T of each interval."""
    (*nodes, d), n = rows.nodes.shape, rows.residual.shape[-1]
    raw = forward_differentiated((K, rows.nodes.reshape(-1, d)), KernelRows(S), rowwise=True)
    return jnp.einsum("slkab,slkbq->slaq", rows.weights, raw.reshape(*nodes, n, -1)) @ T
