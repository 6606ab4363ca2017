"""The field that the rows ask for, in closed form, and their marginal likelihood.

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

A gradient in the hyperparameters makes K anew for each of them. Where rows are many it is taken on
some windows of them, which are as likely as any others, and on the first of the landmarks.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from hamkernel._gram.dense import assemble, forward_differentiated
from hamkernel._machine import orthonormal
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.segments import (
    LinearisedSegments,
    accumulated,
    back_substituted,
    tangents,
    windows,
)
from hamkernel._tuning.minimiser import most_likely_in_box

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


class Model(NamedTuple):
    """A kernel, the noise and that of the process, as one vector h of hyperparameters.

    Attributes:
        kernel: the kernel.
        log_noise: log σ of each coordinate.
        log_process: log q of each, −inf where the field is the whole truth.
    """

    kernel: AbstractMatrixKernel
    log_noise: Float[Array, " n"]
    log_process: Float[Array, " n"]

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


class WhitenedRows(NamedTuple):
    """Rows with independent noise of variance one, M̃ and r̃, in which no start is left.

    Attributes:
        M: what w adds to them, shape (D, q).
        r: their values, shape (D,).
        constant: the part of −log p in which M̃ has none.
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
    # All samples that a row is the mean of: what they scatter about it knows σ, and not the field.
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

    Its derivatives are M(I + MᵀM)⁻¹ − (r − Mw)wᵀ in M and r − Mw in r. The first is taken as
    (MR⁻¹)R⁻ᵀ, and MR⁻¹ is bounded by one however little noise there is.
    """
    return _regression(M, r)[0]


def _regression(M, r):
    q = M.shape[1]
    F = triangle(no_rows(q, M.dtype), M, r)
    R = F[:q, :q]
    log_det = 2 * jnp.log(jnp.abs(jnp.diagonal(R))).sum()
    return 0.5 * (F[q, q] ** 2 + log_det), (M, r, R, F[:q, q])


def _regression_backward(saved, bar):
    M, r, R, z = saved
    w = solve_triangular(R, z)
    misfit = r - M @ w
    inverse = solve_triangular(R, jnp.eye(len(R), dtype=R.dtype))
    return bar * ((M @ inverse) @ inverse.T - misfit[:, None] * w[None, :]), bar * misfit


regression_loss.defvjp(_regression, _regression_backward)


class Condensed(NamedTuple):
    """All that rows say of w, in O(q²) memory.

    Attributes:
        T: the whitening of the landmarks, shape (q, q).
        triangle: of the QR factorisation of (M̃, r̃), shape (q + 1, q + 1).
        start: QᵀM, Qᵀr and U of each segment, as `WhitenedRows` has them.
        constant: the part of −log p in which M̃ has none.
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
        moves: δz, by how much the start of each segment moves, shape (S, n).
        free: the number of rows less that of the parameters they have determined, shape ().
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


@eqx.filter_jit
def condensed(
    model: Model, S, rows: LinearisedSegments, start_deviation, whitening: Whitening
) -> Condensed:
    """The rows in the triangle of their QR factorisation, a strip at a time."""
    T = landmark_whitening(model.kernel, S)
    (size, samples, n), q = rows.counts.shape, len(T)
    # Strips of twice as many rows as columns: less, and most of the work would be the triangle's.
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


@eqx.filter_jit
def conditional(known: Condensed, S, shift: Array | float = 0.0) -> ClosedForm:
    """The field and the starts for rows whose noise is exp(shift) times what it was.

    All rows scale together but for the prior of the starts, which is so wide that it says nothing.
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
    """The field and the starts that the rows ask for."""
    return conditional(condensed(model, S, rows, start_deviation, whitening), S)


def solved(
    model: Model,
    S: Float[np.ndarray, "m d"],
    count: int,
    rows: LinearisedSegments,
    start_deviation,
    whitening: Whitening,
    bounds: "Bounds",
) -> tuple[Model, ClosedForm]:
    """The closed form of all rows on the first `count` landmarks or more, and the model with it.

    Landmarks are doubled while −log p falls by more than √(q/2), by which q parameters leave it
    unknown. Noise that was found on some of the rows is scaled to what all of them leave.
    """

    def on(count: int) -> tuple[Condensed, ClosedForm]:
        points = jnp.asarray(S[:count])
        known = condensed(model, points, rows, start_deviation, whitening)
        return known, conditional(known, points)

    known, found = on(count)
    while count < len(S):
        more = on(2 * count)
        if not more[1].loss < found.loss - (more[1].weights.size / 2) ** 0.5:
            break
        (known, found), count = more, 2 * count
    free, size = np.array(bounds.free), len(model.flat) - 2 * len(model.log_noise)
    free[:size] = False  # what is left are both kinds of noise
    fixed = np.isfinite(np.asarray(model.log_process)) & ~free[-len(model.log_process) :]
    many = searched(jnp.asarray(S[:count]), rows)[1] is not rows
    if many and free.any() and not fixed.any() and found.free > found.used and found.squares > 0:
        shift = jnp.log(found.squares / found.free) / 2
        there = jnp.where(jnp.asarray(free), model.flat + shift, model.flat)
        there = jnp.clip(there, jnp.asarray(bounds.low), jnp.asarray(bounds.high))
        model = model.at(jnp.where(jnp.asarray(free), there, model.flat))
        found = conditional(known, found.points, shift)
    return model, found


def limited_by_landmarks(
    model: Model, S, rows: LinearisedSegments, start_deviation, whitening: Whitening
) -> bool:
    """Whether windows of the rows are likelier with a landmark in each of their intervals.

    By more than √(q/2), by which q parameters leave −log p unknown.
    """
    width = (_ENTRIES / 3) ** 0.5
    part = windows(rows, int(width / rows.residual.shape[-1]))
    own = exact(part)[0]
    few, many = (
        float(losses(model, model.flat[None], points, part, start_deviation, whitening)[0])
        for points in (S, own)
    )
    return few - many > (rows.residual.shape[-1] * len(own) / 2) ** 0.5


# Entries of K at nodes while hyperparameters are looked for: a search with n = 8 takes 4 to 10 s.
# All rows of 20 runs of 50 samples on 128 landmarks have 25 million, and 46 s went by before it.
_ENTRIES = 1_000_000


def searched(
    S: Float[Array, "m d"], rows: LinearisedSegments
) -> tuple[Float[Array, "k d"], LinearisedSegments]:
    """The landmarks and rows on which hyperparameters are looked for: all, if they are few.

    Of many rows some windows. If the landmarks are too many for them, one in the middle of each
    interval of the windows, which for a field that is smooth over an interval is as good as all.
    """
    n = rows.residual.shape[-1]
    if 3 * n * rows.residual.size * len(S) <= _ENTRIES:
        return S, rows
    width = (_ENTRIES / 3) ** 0.5  # columns, and rows, if there are as many of both
    if n * len(S) <= width:
        return S, windows(rows, int(width**2 / (n**2 * len(S))))
    return exact(windows(rows, int(width / n)))


def exact(rows: LinearisedSegments) -> tuple[Float[Array, "k d"], LinearisedSegments]:
    """The rows with a landmark in the middle of each of their intervals.

    Those of padding are the same point again and again, which adds nothing to the span; without
    them rows of every length would be compiled for.
    """
    return rows.nodes[:, :, 1].reshape(-1, rows.nodes.shape[-1]), rows


class Bounds(NamedTuple):
    """Where hyperparameters are looked for, and which of them move."""

    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    free: Bool[np.ndarray, " P"]


def _loss(model: Model, h, S, rows, start_deviation, whitening: Whitening):
    there = model.at(h)
    T = landmark_whitening(there.kernel, S)
    made = whitening(there, S, T, rows, start_deviation)
    value = regression_loss(made.M, made.r) + made.constant
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


@eqx.filter_jit
def losses(
    model: Model,
    design: Float[Array, "count P"],
    S,
    rows: LinearisedSegments,
    start_deviation,
    whitening: Whitening,
):
    """−log p(rows) at some points h."""
    return jax.lax.map(lambda h: _loss(model, h, S, rows, start_deviation, whitening), design)


@eqx.filter_jit
def _best(
    model: Model, S, rows: LinearisedSegments, start_deviation, low, high, free, steps, whitening
):
    start = model.flat

    def loss(h):
        return _loss(model, jnp.where(free, h, start), S, rows, start_deviation, whitening)

    # Of log σ a sample of N knows 1/√(2N); a lengthscale or an amplitude is known to some tenths.
    count = jnp.maximum(rows.counts.sum(axis=(0, 1)), 1)
    kernel = jnp.full(start.size - 2 * count.size, 0.2, start.dtype)
    noise = 1 / jnp.sqrt(2 * count)
    deviations = jnp.concatenate([kernel, noise, noise])
    found, value = most_likely_in_box(loss, start, low, high, deviations, steps)
    return jnp.where(free & (value < jnp.inf), found, start), value


def most_likely(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    bounds: Bounds,
    steps: int,
    whitening: Whitening,
) -> tuple[Model, float]:
    """The model whose rows are the most likely, by BFGS from this one, and −log p there.

    Of many rows some windows, see `searched`, and −log p of those.
    """
    S, rows = searched(jnp.asarray(S), rows)
    if not bounds.free.any():
        flat = model.flat[None]
        return model, float(losses(model, flat, S, rows, start_deviation, whitening)[0])
    sides = jnp.asarray(bounds.low), jnp.asarray(bounds.high), jnp.asarray(bounds.free)
    h, value = _best(model, S, rows, start_deviation, *sides, steps, whitening)
    return model.at(h), float(value)


def begun(
    model: Model,
    design: Float[np.ndarray, "count P"],
    S: Float[np.ndarray, "m d"],
    first: int,
    rows: LinearisedSegments,
    start_deviation,
    whitening: Whitening,
) -> tuple[Model, int]:
    """The most likely model of a design, and with how many landmarks to look for a better one.

    With the first of them, or with all where −log p then falls by more than √(q/2), by which q
    parameters leave it unknown. All of the design is compared: with too few landmarks the best is a
    smooth field with much noise, at which more of them do not help.
    """
    n, width = rows.residual.shape[-1], (_ENTRIES / 3) ** 0.5
    points, part = jnp.asarray(design), windows(rows, int(width / n))
    own = exact(part)[0]
    sets = {first: jnp.asarray(S[:first]) if n * first <= width else own}
    if len(own) > first < len(S):
        sets[len(S)] = own
    best, count, start = np.inf, first, design[0]
    for size, some in sets.items():
        values = np.asarray(losses(model, points, some, part, start_deviation, whitening))
        if values.min() < best - (n * len(some) / 2) ** 0.5:
            best, count, start = values.min(), size, design[int(np.argmin(values))]
    return model.at(jnp.asarray(start)), count
