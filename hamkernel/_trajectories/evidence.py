"""The field that the rows ask for, in closed form, and their marginal likelihood.

In the span of landmarks S, g(x) = K(x, S) T w with T = L⁻ᵀ, L Lᵀ = K(S, S) and w ~ N(0, I). Rows
divided by their noise, M = W B K(·, S) T and P = W Φ, are M w + P δz + ε with ε ~ N(0, I). The
starts have a prior so wide that it only stands in where nothing else is known. With Q the
orthonormal columns of P, what is left is M̃ = (I − QQᵀ) M and r̃ = (I − QQᵀ) r, which is exact
generalised least squares with the starts integrated out; no complete QR is needed:

    (I + M̃ᵀM̃) w = M̃ᵀ r̃,
    −2 log p = ‖r̃ − M̃w‖² + ‖w‖² + log det(I + M̃ᵀM̃) + 2 log det U − 2 log det W

for P = QU, but for a constant.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float

from hamkernel._gram.dense import assemble
from hamkernel._gram.derivatives import forward_differentiated
from hamkernel._machine import orthonormal
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.descent import HUGE, minimise
from hamkernel._trajectories.rows import Rows, accumulated

# Above the rounding of K(S, S): it bounds how finely the landmarks resolve, and biases nothing.
_ROUNDINGS = 100.0


class Columns(eqx.Module):
    """K(x, S) for many points x, as rows."""

    points: Float[Array, "m d"]

    def __call__(self, K: AbstractMatrixKernel, X: Float[Array, "N d"]):
        return functools.partial(self.rows, K), X

    def rows(self, K: AbstractMatrixKernel, X: Float[Array, "N d"]) -> Float[Array, "N n q"]:
        return assemble(K, X, self.points).reshape(len(X), K.outputs(X.shape[1]), -1)


def whitening(K: AbstractMatrixKernel, S: Float[Array, "m d"]) -> Float[Array, "q q"]:
    """T = L⁻ᵀ with L Lᵀ = K(S, S), q = m n."""
    G = forward_differentiated((K, S), Columns(S), rowwise=True)
    G = G.reshape(-1, G.shape[-1])
    # Of each component by itself, which have different units; some are zero, as q̇ of a U(q).
    d = jnp.diagonal(G)
    rounding = _ROUNDINGS * jnp.finfo(G.dtype).eps * len(G) * jnp.where(d > 0, d, d.mean())
    eye = jnp.eye(len(G), dtype=G.dtype)
    return solve_triangular(jnp.linalg.cholesky(G + jnp.diag(rounding)), eye, lower=True).T


class Projected(NamedTuple):
    """Rows free of the starts: M̃, r̃, and what gives the starts back."""

    M: Float[Array, "D q"]
    r: Float[Array, " D"]
    constant: Float[Array, ""]  # what M̃ has no part in: log det U − log det W and the scatter
    T: Float[Array, "q q"]
    start: tuple[Array, Array, Array]  # QᵀM, Qᵀr and U of each segment


def projected(
    K: AbstractMatrixKernel,
    log_noise: Float[Array, " n"],
    S: Float[Array, "m d"],
    rows: Rows,
    spread: Float[Array, " n"],
) -> Projected:
    """The rows for these hyperparameters; `spread` is the standard deviation of the starts."""
    (*nodes, d), n = rows.nodes.shape, rows.target.shape[-1]
    size, q = len(rows.counts), len(S) * n
    raw = forward_differentiated((K, rows.nodes.reshape(-1, d)), Columns(S), rowwise=True)
    T = whitening(K, S)
    M = accumulated(rows.across, rows.weights, raw.reshape(*nodes, n, q)) @ T
    W = jnp.sqrt(rows.counts) * jnp.exp(-log_noise)[None, None]  # (S, L + 1, n)
    none = jnp.zeros((size, n, q), M.dtype)
    M = jnp.concatenate([(W[..., None] * M).reshape(size, -1, q), none], axis=1)
    prior = jnp.broadcast_to(jnp.diag(1 / spread), (size, n, n))
    P = jnp.concatenate([(W[..., None] * rows.tangent).reshape(size, -1, n), prior], axis=1)
    r = jnp.concatenate(
        [(W * rows.target).reshape(size, -1), rows.displaced / spread[None]], axis=1
    )
    Q, U = orthonormal(P)
    QM, Qr = jnp.einsum("sdn,sdq->snq", Q, M), jnp.einsum("sdn,sd->sn", Q, r)
    M = M - jnp.einsum("sdn,snq->sdq", Q, QM)
    r = r - jnp.einsum("sdn,sn->sd", Q, Qr)
    constant = jnp.log(jnp.diagonal(U, axis1=1, axis2=2)).sum()
    # All samples that a row is the mean of: what they scatter about it knows σ, and not the field.
    samples, scatter = (a.sum(axis=(0, 1)) for a in (rows.counts, rows.scatter))
    constant = constant + samples @ log_noise + 0.5 * scatter @ jnp.exp(-2 * log_noise)
    return Projected(M.reshape(-1, q), r.reshape(-1), constant, T, (QM, Qr, U))


def negative_log_likelihood(rows: Projected) -> Float[Array, ""]:
    """Of the rows, but for a constant; not finite where the factorisation fails."""
    R, w = _weights(rows)
    misfit = rows.r - rows.M @ w
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(R)))
    return 0.5 * (misfit @ misfit + w @ w + log_det) + rows.constant


def _weights(rows: Projected) -> tuple[Float[Array, "q q"], Float[Array, " q"]]:
    q = rows.M.shape[1]
    R = jnp.linalg.cholesky(rows.M.T @ rows.M + jnp.eye(q, dtype=rows.M.dtype))
    return R, cho_solve((R, True), rows.M.T @ rows.r)


class Solution(NamedTuple):
    """The closed form.

    Attributes:
        weights: w, shape (q,); ‖f‖² = ‖w‖².
        coefficients: T w, shape (m, n).
        moves: δz, by how much the start of each segment moves, shape (S, n).
        free: the number of rows less that of the parameters they have determined, shape ().
    """

    weights: Float[Array, " q"]
    coefficients: Float[Array, "m n"]
    moves: Float[Array, "S n"]
    free: Float[Array, ""]


@eqx.filter_jit
def solved(K, log_noise, S, rows: Rows, spread) -> Solution:
    """The field and the starts that the rows ask for."""
    made = projected(K, log_noise, S, rows, spread)
    R, w = _weights(made)
    QM, Qr, U = made.start
    right = Qr - jnp.einsum("snq,q->sn", QM, w)
    moves = back_substituted(U, right)
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype), lower=True)
    used = len(w) - jnp.sum(inverse**2)  # tr M̃ (I + M̃ᵀM̃)⁻¹ M̃ᵀ
    started = rows.counts.any(axis=(1, 2)).sum() * U.shape[1]
    free = ((rows.counts > 0).sum() - started).astype(used.dtype) - used
    return Solution(w, (made.T @ w).reshape(len(S), -1), moves, free)


def back_substituted(U: Float[Array, "S n n"], b: Float[Array, "S n"]) -> Float[Array, "S n"]:
    n = b.shape[1]
    out: list[Array] = [b[:, 0]] * n
    for i in reversed(range(n)):
        left = b[:, i]
        for j in range(i + 1, n):
            left = left - U[:, i, j] * out[j]
        out[i] = left / U[:, i, i]
    return jnp.stack(out, axis=1)


class Model(NamedTuple):
    """A kernel and the noise, as one vector h of hyperparameters."""

    kernel: AbstractMatrixKernel
    log_noise: Float[Array, " n"]

    @property
    def flat(self) -> Float[Array, " P"]:
        leaves, _ = ravel_pytree(eqx.filter(self.kernel, eqx.is_inexact_array))
        return jnp.concatenate([leaves.astype(self.log_noise.dtype), self.log_noise])

    def at(self, h: Float[Array, " P"]) -> "Model":
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        flat, unravel = ravel_pytree(params)
        kernel = eqx.combine(unravel(h[: flat.size].astype(flat.dtype)), static)
        return Model(kernel, h[flat.size :])


class Box(NamedTuple):
    """Where hyperparameters are looked for, and which of them move."""

    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    free: Bool[np.ndarray, " P"]


def _loss(model: Model, h, S, rows, spread):
    there = model.at(h)
    value = negative_log_likelihood(projected(there.kernel, there.log_noise, S, rows, spread))
    return jnp.where(jnp.isfinite(value), value, HUGE)


@eqx.filter_jit
def losses(model: Model, design: Float[Array, "count P"], S, rows: Rows, spread):
    """−log p(rows) at some points h."""
    return jax.lax.map(lambda h: _loss(model, h, S, rows, spread), design)


@eqx.filter_jit
def _best(model: Model, S, rows: Rows, spread, low, high, free, steps):
    start = model.flat

    def loss(h):
        return _loss(model, jnp.where(free, h, start), S, rows, spread)

    # Of log σ a sample of N knows 1/√(2N); a lengthscale or an amplitude is known to some tenths.
    count = jnp.maximum(rows.counts.sum(axis=(0, 1)), 1)
    kernel = jnp.full(start.size - count.size, 0.2, start.dtype)
    sizes = jnp.concatenate([kernel, 1 / jnp.sqrt(2 * count)])
    found, value = minimise(loss, start, low, high, sizes, steps)
    return jnp.where(free & (value < HUGE), found, start), value


def most_likely(model: Model, S, rows: Rows, spread, box: Box, steps: int) -> tuple[Model, float]:
    """The model whose rows are the most likely, by BFGS from this one, and −log p there."""
    if not box.free.any():
        return model, float(losses(model, model.flat[None], S, rows, spread)[0])
    sides = jnp.asarray(box.low), jnp.asarray(box.high), jnp.asarray(box.free)
    h, value = _best(model, S, rows, spread, *sides, steps)
    return model.at(h), float(value)
