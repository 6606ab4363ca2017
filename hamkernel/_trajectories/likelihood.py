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
from typing import Any, NamedTuple

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
from hamkernel._observations.kinds import Functionals, Together
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.flow import means
from hamkernel._trajectories.segments import LinearisedSegments, accumulated, back_substituted
from hamkernel._tuning.minimiser import most_likely_in_box
from hamkernel._tuning.space import gram_trace, hyperparameters

# Above the rounding of K(S, S): it bounds how finely the landmarks resolve, and biases nothing.
_ROUNDINGS = 100.0


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
    # Of each component by itself, which have different units; some are zero, as q̇ of a U(q).
    d = jnp.diagonal(G)
    rounding = _ROUNDINGS * jnp.finfo(G.dtype).eps * len(G) * jnp.where(d > 0, d, d.mean())
    eye = jnp.eye(len(G), dtype=G.dtype)
    return solve_triangular(jnp.linalg.cholesky(G + jnp.diag(rounding)), eye, lower=True).T


class ProjectedRows(NamedTuple):
    """The rows with the starts projected out, M̃ and r̃, and what gives the starts back."""

    M: Float[Array, "D q"]
    r: Float[Array, " D"]
    constant: Float[Array, ""]  # what M̃ has no part in: log det U − log det W and the scatter
    T: Float[Array, "q q"]
    start: tuple[Array, Array, Array]  # QᵀM, Qᵀr and U of each segment


def project_out_starts(
    K: AbstractMatrixKernel,
    log_noise: Float[Array, " n"],
    S: Float[Array, "m d"],
    rows: LinearisedSegments,
    start_deviation: Float[Array, " n"],
) -> ProjectedRows:
    """The rows at these hyperparameters; the starts have the prior N(·, diag(start_deviation²))."""
    (*nodes, d), n = rows.nodes.shape, rows.target.shape[-1]
    size, q = len(rows.counts), len(S) * n
    raw = forward_differentiated((K, rows.nodes.reshape(-1, d)), KernelRows(S), rowwise=True)
    T = landmark_whitening(K, S)
    M = accumulated(rows.across, rows.weights, raw.reshape(*nodes, n, q)) @ T
    W = jnp.sqrt(rows.counts) * jnp.exp(-log_noise)[None, None]  # (S, L + 1, n)
    none = jnp.zeros((size, n, q), M.dtype)
    M = jnp.concatenate([(W[..., None] * M).reshape(size, -1, q), none], axis=1)
    prior = jnp.broadcast_to(jnp.diag(1 / start_deviation), (size, n, n))
    P = jnp.concatenate([(W[..., None] * rows.tangent).reshape(size, -1, n), prior], axis=1)
    r = jnp.concatenate(
        [(W * rows.target).reshape(size, -1), rows.prior_offset / start_deviation[None]], axis=1
    )
    Q, U = orthonormal(P)
    QM, Qr = jnp.einsum("sdn,sdq->snq", Q, M), jnp.einsum("sdn,sd->sn", Q, r)
    M = M - jnp.einsum("sdn,snq->sdq", Q, QM)
    r = r - jnp.einsum("sdn,sn->sd", Q, Qr)
    constant = jnp.log(jnp.diagonal(U, axis1=1, axis2=2)).sum()
    # All samples that a row is the mean of: what they scatter about it knows σ, and not the field.
    samples, scatter = (a.sum(axis=(0, 1)) for a in (rows.counts, rows.scatter))
    constant = constant + samples @ log_noise + 0.5 * scatter @ jnp.exp(-2 * log_noise)
    return ProjectedRows(M.reshape(-1, q), r.reshape(-1), constant, T, (QM, Qr, U))


def negative_log_likelihood(rows: ProjectedRows) -> Float[Array, ""]:
    """Of the rows, but for a constant; not finite where the factorisation fails."""
    R, w = _weights(rows)
    misfit = rows.r - rows.M @ w
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(R)))
    return 0.5 * (misfit @ misfit + w @ w + log_det) + rows.constant


def _weights(rows: ProjectedRows) -> tuple[Float[Array, "q q"], Float[Array, " q"]]:
    q = rows.M.shape[1]
    R = jnp.linalg.cholesky(rows.M.T @ rows.M + jnp.eye(q, dtype=rows.M.dtype))
    return R, cho_solve((R, True), rows.M.T @ rows.r)


class ClosedForm(NamedTuple):
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
def closed_form(K, log_noise, S, rows: LinearisedSegments, start_deviation) -> ClosedForm:
    """The field and the starts that the rows ask for."""
    made = project_out_starts(K, log_noise, S, rows, start_deviation)
    R, w = _weights(made)
    QM, Qr, U = made.start
    right = Qr - jnp.einsum("snq,q->sn", QM, w)
    moves = back_substituted(U, right)
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype), lower=True)
    used = len(w) - jnp.sum(inverse**2)  # tr M̃ (I + M̃ᵀM̃)⁻¹ M̃ᵀ
    started = rows.counts.any(axis=(1, 2)).sum() * U.shape[1]
    free = ((rows.counts > 0).sum() - started).astype(used.dtype) - used
    return ClosedForm(w, (made.T @ w).reshape(len(S), -1), moves, free)


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


class Bounds(NamedTuple):
    """Where hyperparameters are looked for, and which of them move."""

    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    free: Bool[np.ndarray, " P"]


def _loss(model: Model, h, S, rows, start_deviation):
    there = model.at(h)
    value = negative_log_likelihood(
        project_out_starts(there.kernel, there.log_noise, S, rows, start_deviation)
    )
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


@eqx.filter_jit
def losses(
    model: Model, design: Float[Array, "count P"], S, rows: LinearisedSegments, start_deviation
):
    """−log p(rows) at some points h."""
    return jax.lax.map(lambda h: _loss(model, h, S, rows, start_deviation), design)


@eqx.filter_jit
def _best(model: Model, S, rows: LinearisedSegments, start_deviation, low, high, free, steps):
    start = model.flat

    def loss(h):
        return _loss(model, jnp.where(free, h, start), S, rows, start_deviation)

    # Of log σ a sample of N knows 1/√(2N); a lengthscale or an amplitude is known to some tenths.
    count = jnp.maximum(rows.counts.sum(axis=(0, 1)), 1)
    kernel = jnp.full(start.size - count.size, 0.2, start.dtype)
    deviations = jnp.concatenate([kernel, 1 / jnp.sqrt(2 * count)])
    found, value = most_likely_in_box(loss, start, low, high, deviations, steps)
    return jnp.where(free & (value < jnp.inf), found, start), value


def most_likely(
    model: Model, S, rows: LinearisedSegments, start_deviation, bounds: Bounds, steps: int
) -> tuple[Model, float]:
    """The model whose rows are the most likely, by BFGS from this one, and −log p there."""
    if not bounds.free.any():
        return model, float(losses(model, model.flat[None], S, rows, start_deviation)[0])
    sides = jnp.asarray(bounds.low), jnp.asarray(bounds.high), jnp.asarray(bounds.free)
    h, value = _best(model, S, rows, start_deviation, *sides, steps)
    return model.at(h), float(value)


# Noise to begin with, of the standard deviations, besides that of smoothing. With five samples a
# swing smoothing cannot know it: it found none at all in 3 of 5 logs with noise of 8 %.
_NOISES = (0.01, 0.1)


def bounds_and_design(
    model: Model, X: np.ndarray, Y: np.ndarray, scale: np.ndarray, moves: np.ndarray
) -> tuple[Bounds, np.ndarray]:
    """The box of all hyperparameters, those of the caller inside, and a design of first points.

    Args:
        model: the caller's kernel and the noise of the smoothed runs.
        X: states, with inputs the points (x, u).
        Y: their velocities.
        scale: the standard deviations of the coordinates.
        moves: the coordinates whose noise is looked for.
    """
    speed = float(np.sqrt(np.mean(Y**2)))
    leaves = hyperparameters(model.kernel, jnp.asarray(X), speed, jnp.asarray(X))
    start = np.asarray(model.flat)
    size = len(start) - len(scale)
    most = np.maximum(scale, np.exp(start[size:]))  # where next to nothing moves
    low = np.concatenate([*(p.low.ravel() for p in leaves), np.log(1e-7 * scale)])
    high = np.concatenate([*(p.high.ravel() for p in leaves), np.log(2 * most)])
    low, high = np.minimum(low, start), np.maximum(high, start)
    free = np.concatenate([np.ones(size, bool), moves])
    names = [p.name for p in leaves for _ in range(p.low.size)]
    none = np.zeros(len(scale), bool)
    lengths = np.append([name.endswith("lengthscale") for name in names], none).astype(bool)
    scales = np.append([name.split(".")[-1] == "scale" for name in names], none).astype(bool)
    extents = np.concatenate([*(_extents(p.low, X[:, : len(scale)]) for p in leaves), none])
    design = [start]
    for shift in (None, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0):
        point = start.copy()
        if shift is not None:
            if not lengths.any():
                continue
            point[lengths] = np.clip(extents - 0.7 + shift, low, high)[lengths]
        design.append(_amplified(model, point, scales, X, Y))
    design = np.array(design)
    noisy = [design]
    for share in _NOISES if moves.any() else ():
        noisy.append(design.copy())
        noisy[-1][:, size:] = np.where(moves, np.log(share * scale), start[size:])
    return Bounds(low, high, free), np.clip(np.concatenate(noisy), low, high)


def _extents(leaf: np.ndarray, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, " size"]:
    """The logarithm of the extent of X, for each coordinate where the leaf has as many entries."""
    ranges = np.maximum(np.ptp(X, axis=0), np.finfo(float).tiny)
    if leaf.shape == ranges.shape:
        return np.log(ranges * np.sqrt(len(ranges)))
    return np.full(leaf.size, np.log(np.hypot.reduce(ranges)))


def _amplified(model: Model, h, scales, X, Y):
    """The point h, its amplitudes such that a velocity of the prior is twice one that was seen."""
    if not scales.any():
        return h
    trace = float(gram_trace(model.at(jnp.asarray(h)).kernel, jnp.asarray(X))) / len(X)
    target = 4 * np.mean(np.sum(Y**2, axis=1))
    out = h.copy()
    if np.isfinite(trace) and trace > 0 and target > 0:
        out[scales] += np.log(target / trace)
    return out


def as_observations(
    rows: LinearisedSegments, log_noise: Float[Array, " n"], mean: Any
) -> Together | None:
    """CᵀW B f = CᵀW (x − x̂ + ô + B m) + ε with ε ~ N(0, I), one block for each segment.

    C are the last columns of the complete QR of W Φ, so that the start is projected out. None where
    no segment has more samples than its start takes.
    """
    sigma = np.exp(np.asarray(log_noise))
    at_nodes = _at_nodes(mean, rows.nodes, len(sigma))
    every = jax.tree.map(np.asarray, (rows, at_nodes))  # one segment of a JAX array compiles
    segments = (jax.tree.map(lambda a, s=s: a[s], every) for s in range(len(rows.counts)))
    found = [_of_segment(segment, at_nodes, sigma) for segment, at_nodes in segments]
    parts = tuple(part for part in found if part is not None)
    return Together(parts) if parts else None


@eqx.filter_jit
def _at_nodes(mean, nodes: Float[Array, "S L 3 d"], n: int) -> Float[Array, "S L 3 n"]:
    return means(mean, nodes, nodes[..., :n])


def _of_segment(
    rows: Any, mean: Float[np.ndarray, "L 3 n"], sigma: Float[np.ndarray, " n"]
) -> Functionals | None:
    """The block of one segment, `rows` without their first axis; None if it says nothing."""
    n = len(sigma)
    if not rows.counts.any():
        return None
    last = int(np.flatnonzero(rows.counts.any(axis=1))[-1])  # padding follows
    B = _sums(rows.across[:last], rows.weights[:last])
    counts = rows.counts[: last + 1]
    seen = counts.reshape(-1) > 0
    W = (np.sqrt(counts) / sigma[None]).reshape(-1)[seen]
    P = W[:, None] * rows.tangent[: last + 1].reshape(-1, n)[seen]
    if len(P) <= n:
        return None
    C = np.linalg.qr(P, mode="complete")[0][:, n:]
    B = C.T @ (W[:, None] * B[seen])
    target = C.T @ (W * rows.target[: last + 1].reshape(-1)[seen]) + B @ mean[:last].reshape(-1)
    x, u = np.split(rows.nodes[:last].reshape(1, 3 * last, -1), [n], axis=2)
    return Functionals(x, B.reshape(1, len(B), 3 * last, n), target[None], u if u.size else None)


def _sums(
    across: Float[np.ndarray, "L n n"], weights: Float[np.ndarray, "L 3 n n"]
) -> Float[np.ndarray, "D Q"]:
    """B of one segment as a matrix: all samples by all nodes."""
    L, k, n, _ = weights.shape
    out = np.zeros((L + 1, n, L, k, n))
    for i in range(L):
        out[i + 1] = np.einsum("ab,blkc->alkc", across[i], out[i])
        out[i + 1, :, i] += np.moveaxis(weights[i], 0, 1)
    return out.reshape((L + 1) * n, L * k * n)
