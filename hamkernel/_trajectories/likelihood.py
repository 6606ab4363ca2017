"""The field given the rows, in closed form, and their marginal likelihood.

In the span of landmarks S, g(x) = K(x, S) T w with T = L⁻ᵀ, L Lᵀ = K(S, S) and w ~ N(0, I). Rows
divided by their noise, M = W B K(·, S) T and P = W Φ, are M w + P δz + ε with ε ~ N(0, I). The
starts have a prior so wide that it only stands in where nothing else is known. With Q the
orthonormal columns of P, what is left is M̃ = (I − QQᵀ) M and r̃ = (I − QQᵀ) r, which is exact
generalised least squares with the starts integrated out; no complete QR is needed:

    (I + M̃ᵀM̃) w = M̃ᵀ r̃,
    −2 log p = ‖r̃ − M̃w‖² + ‖w‖² + log det(I + M̃ᵀM̃) + 2 log det U − 2 log det W

for P = QU, but for a constant. All of it is in the triangle of the QR factorisation of (I, 0) above
(M̃, r̃), which keeps the digits that I + M̃ᵀM̃ loses where there is next to no noise, and which takes
rows a strip at a time.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from hamkernel._gram import assemble, forward_differentiated
from hamkernel._kernels.base import Scaled
from hamkernel._machine import compiled_by_size, full_precision, orthonormal
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.joined import InputMatrix
from hamkernel._structures.structure import AbstractStructure
from hamkernel._trajectories.flow import back_substituted, tangents
from hamkernel._trajectories.segments import LinearisedSegments, accumulated


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
    # For each component by itself, since units differ; some are zero, such as q̇ for a U(q).
    d = jnp.diagonal(G)
    # A hundred times the rounding bounds how finely landmarks resolve, and biases nothing.
    rounding = 100 * jnp.finfo(G.dtype).eps * len(G) * jnp.where(d > 0, d, d.mean())
    eye = jnp.eye(len(G), dtype=G.dtype)
    return solve_triangular(jnp.linalg.cholesky(G + jnp.diag(rounding)), eye, lower=True).T


def with_amplitude(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """K, every structure and input matrix in it scaled; a likelihood needs amplitudes.

    `Symplectic(Gaussian(2.0))` becomes `Symplectic(1.0 * Gaussian(2.0))`.
    """

    def is_structure(node: object) -> bool:
        return isinstance(node, AbstractStructure | InputMatrix)

    def scaled(node):
        if not is_structure(node) or node.kernel.has_amplitude:
            return node
        return eqx.tree_at(lambda node: node.kernel, node, Scaled(node.kernel, 1.0))

    return jax.tree.map(scaled, K, is_leaf=is_structure)


class Model(NamedTuple):
    """A kernel, sensor noise and process noise, as one vector h of hyperparameters.

    Attributes:
        kernel: the kernel.
        log_noise: log σ of each coordinate.
        log_process: log q of each coordinate, −inf where the field is the whole truth.
    """

    kernel: AbstractMatrixKernel
    log_noise: Float[Array, " n"]
    log_process: Float[Array, " n"]

    @property
    def is_disturbed(self) -> bool:
        """Whether there is process noise."""
        return bool(jnp.isfinite(self.log_process).any())

    @property
    def flat(self) -> Float[Array, " P"]:
        leaves, _ = ravel_pytree(eqx.filter(self.kernel, eqx.is_inexact_array))
        leaves = leaves.astype(self.log_noise.dtype)
        return jnp.concatenate([leaves, self.log_noise, self.log_process])

    def at(self, h: Float[Array, " P"]) -> "Model":
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        flat, unravel = ravel_pytree(params)
        leaves, noise, process = jnp.split(h, [flat.size, flat.size + len(self.log_noise)])
        return Model(eqx.combine(unravel(leaves.astype(flat.dtype)), static), noise, process)


def agree(one: Model, other: Model) -> bool:
    """Whether hyperparameters of both kernels are the same to a tenth.

    Of 400 exact runs of a double pendulum amplitudes went on to and fro by 5 to 10 %, and the noise
    of windows by a factor of two with them, for all of eight iterations.
    """
    size = len(one.flat) - 2 * len(one.log_noise)
    return bool(jnp.abs(one.flat - other.flat)[:size].max() < 0.1)


class WhitenedRows(NamedTuple):
    """Rows with independent noise of variance one, M̃ and r̃, in which no start is left.

    Attributes:
        M: what w adds to them, shape (D, q).
        r: their values, shape (D,).
        constant: the part of −log p that does not depend on M̃.
        start: QᵀM, Qᵀr and U of each segment, which give the starts back, where they were projected
            out.
    """

    M: Float[Array, "D q"]
    r: Float[Array, " D"]
    constant: Float[Array, ""]
    start: tuple[Array, Array, Array] | None = None


Whitening = Callable[[Model, Array, Array, LinearisedSegments, Array], WhitenedRows]


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


def project_out_starts(
    model: Model,
    S: Float[Array, "m d"],
    T: Float[Array, "q q"],
    rows: LinearisedSegments,
    start_deviation: Float[Array, " n"],
) -> WhitenedRows:
    """The rows at these hyperparameters; the starts have the prior N(·, diag(start_deviation²))."""
    log_noise, n, size = model.log_noise, rows.residual.shape[-1], len(rows.counts)
    M = accumulated(rows.across, columns(model.kernel, S, T, rows))
    q = M.shape[-1]
    W = jnp.sqrt(rows.counts) * jnp.exp(-log_noise)[None, None]  # (S, L + 1, n)
    none = jnp.zeros((size, n, q), M.dtype)
    M = jnp.concatenate([(W[..., None] * M).reshape(size, -1, q), none], axis=1)
    prior = jnp.broadcast_to(jnp.diag(1 / start_deviation), (size, n, n))
    Phi = tangents(rows.across)
    P = jnp.concatenate([(W[..., None] * Phi).reshape(size, -1, n), prior], axis=1)
    r = jnp.concatenate(
        [(W * rows.target).reshape(size, -1), rows.prior_offset / start_deviation[None]], axis=1
    )
    Q, U = orthonormal(P)
    QM, Qr = jnp.einsum("sdn,sdq->snq", Q, M), jnp.einsum("sdn,sd->sn", Q, r)
    M = M - jnp.einsum("sdn,snq->sdq", Q, QM)
    r = r - jnp.einsum("sdn,sn->sd", Q, Qr)
    constant = jnp.log(jnp.diagonal(U, axis1=1, axis2=2)).sum()
    # The scatter of the samples about their mean depends on σ, and not on the field.
    samples, scatter = (a.sum(axis=(0, 1)) for a in (rows.counts, rows.scatter))
    constant = constant + samples @ log_noise + 0.5 * scatter @ jnp.exp(-2 * log_noise)
    return WhitenedRows(M.reshape(-1, q), r.reshape(-1), constant, (QM, Qr, U))


def triangle(
    above: Float[Array, "k k"], M: Float[Array, "D q"], r: Float[Array, " D"]
) -> Float[Array, "k k"]:
    """The triangle of the QR factorisation of `above` over (M, r), k = q + 1."""
    return jnp.linalg.qr(jnp.concatenate([above, jnp.column_stack([M, r])]), mode="r")


def no_rows(q: int, dtype) -> Float[Array, "k k"]:
    """The triangle before there are rows: that of the prior w ~ N(0, I)."""
    return jnp.diag(jnp.append(jnp.ones(q, dtype), 0))


@jax.custom_vjp
def regression_loss(M: Float[Array, "D q"], r: Float[Array, " D"]) -> Float[Array, ""]:
    """½(‖r − Mw‖² + ‖w‖² + log det(I + MᵀM)) at its least w.

    Its derivatives are M(I + MᵀM)⁻¹ − (r − Mw)wᵀ in M and r − Mw in r. The first term is computed
    as (MR⁻¹)R⁻ᵀ, since MR⁻¹ is bounded by one however small the noise is.
    """
    return _regression_forward(M, r)[0]


@full_precision
def _regression_forward(M, r):
    q = M.shape[1]
    F = triangle(no_rows(q, M.dtype), M, r)
    R = F[:q, :q]
    log_det = 2 * jnp.log(jnp.abs(jnp.diagonal(R))).sum()
    return 0.5 * (F[q, q] ** 2 + log_det), (M, r, R, F[:q, q])


@full_precision
def _regression_backward(saved, bar):
    M, r, R, z = saved
    w = solve_triangular(R, z)
    misfit = r - M @ w
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype))
    return bar * ((M @ inverse) @ inverse.T - misfit[:, None] * w[None, :]), bar * misfit


regression_loss.defvjp(_regression_forward, _regression_backward)


class Condensed(NamedTuple):
    """The information of the rows about the weights w, in O(q²) memory.

    Attributes:
        T: the whitening of the landmarks, shape (q, q).
        triangle: of the QR factorisation of (M̃, r̃), shape (q + 1, q + 1).
        start: QᵀM, Qᵀr and U of each segment, as `WhitenedRows` has them.
        constant: the part of −log p that does not depend on M̃.
        scatter: the sum of squares of samples about the rows that are their means, in units of σ².
        samples: how many samples there are, less n for each start.
        rows: the number of rows, less n for each start.
    """

    T: Float[Array, "q q"]
    triangle: Float[Array, "k k"]
    start: tuple[Array, Array, Array] | None
    constant: Float[Array, ""]
    scatter: Float[Array, ""]
    samples: Float[Array, ""]
    rows: Float[Array, ""]


class ClosedForm(NamedTuple):
    """The closed form.

    Attributes:
        weights: w, shape (q,); ‖f‖² = ‖w‖².
        points: the landmarks, shape (m, d).
        coefficients: T w, shape (m, n).
        moves: δz, the correction of the start of each segment, shape (S, n).
        free: the number of rows less the number of parameters that they determine, shape ().
        used: that number of parameters.
        squares: ‖r̃ − M̃w‖².
        loss: −log p(rows), but for a constant.
    """

    weights: Float[Array, " q"]
    points: Float[Array, "m d"]
    coefficients: Float[Array, "m n"]
    moves: Float[Array, "S n"]
    free: Float[Array, ""]
    used: Float[Array, ""]
    squares: Float[Array, ""]
    loss: Float[Array, ""]


@compiled_by_size
def condensed(
    model: Model, S, rows: LinearisedSegments, start_deviation, whitening: Whitening
) -> Condensed:
    """The rows in the triangle of their QR factorisation, a strip at a time."""
    T = landmark_whitening(model.kernel, S)
    (size, samples, n), q = rows.counts.shape, len(T)
    # Strips have twice as many rows as columns: with fewer, most of the work is the triangle's.
    count = 1
    while size % (2 * count) == 0 and size // (2 * count) * samples * n >= 2 * q:
        count *= 2

    def strip(F, part):
        made = whitening(model, S, T, part, start_deviation)
        return triangle(F, made.M, made.r), (made.start, made.constant)

    parts = jax.tree.map(lambda a: a.reshape(count, -1, *a.shape[1:]), rows)
    F, (start, constant) = jax.lax.scan(strip, jnp.zeros((q + 1, q + 1), T.dtype), parts)
    if start is not None:
        start = jax.tree.map(lambda a: a.reshape(size, *a.shape[2:]), start)
    started = (rows.counts.any(axis=(1, 2)).sum() * n).astype(T.dtype)
    scatter = (rows.scatter.sum((0, 1)) @ jnp.exp(-2 * model.log_noise)).astype(T.dtype)
    count, samples = (rows.counts > 0).sum().astype(T.dtype), rows.counts.sum().astype(T.dtype)
    sizes = samples - started, count - started
    return Condensed(T, F, start, constant.sum(), scatter, *sizes)


@compiled_by_size
def conditional(known: Condensed, S, shift: Array | float = 0.0) -> ClosedForm:
    """The field and the starts for rows whose noise is exp(shift) times what it was.

    The prior of the starts does not scale with the rows; it is too wide for that to matter.
    """
    q, scale = len(known.T), jnp.exp(-shift)
    there = scale * known.triangle
    F = triangle(no_rows(q, there.dtype), there[:, :q], there[:, q])
    R = F[:q, :q]
    w = solve_triangular(R, F[:q, q])
    inverse = solve_triangular(R, jnp.eye(q, dtype=R.dtype))
    used = q - jnp.sum(inverse**2)  # tr M̃ (I + M̃ᵀM̃)⁻¹ M̃ᵀ
    moves = jnp.zeros((0, S.shape[1]), w.dtype)
    if known.start is not None:
        QM, Qr, U = known.start
        moves = back_substituted(U, Qr - jnp.einsum("snq,q->sn", QM, w))
    loss = 0.5 * F[q, q] ** 2 + jnp.log(jnp.abs(jnp.diagonal(R))).sum() + known.constant
    loss = loss + shift * known.samples + 0.5 * (scale**2 - 1) * known.scatter
    squares = F[q, q] ** 2 - w @ w
    coefficients = (known.T @ w).reshape(len(S), -1)
    return ClosedForm(w, S, coefficients, moves, known.rows - used, used, squares, loss)


def closed_form(
    model: Model, S, rows: LinearisedSegments, start_deviation, whitening: Whitening
) -> ClosedForm:
    """The field and the starts given the rows."""
    return conditional(condensed(model, S, rows, start_deviation, whitening), S)
