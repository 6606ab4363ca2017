"""Rows whitened by a Kalman filter: samples of a motion that the field alone does not explain.

The model is ẋ = f(x, u) + w, with w white of intensity diag(q²). Each interval is linearised by
itself about a path x̂. The distance d from the path moves by

    dᵢ₊₁ = Ψᵢ dᵢ + Σ_k Γ_ik g(x̂(τ_k)) − ôᵢ + ηᵢ,    Cov ηᵢ = Σ_k Γ_ik diag(q²) Γ_ikᵀ / (h w_k),

where ôᵢ is the sum of the `drive` of the interval and of the defect that the path `missed`. A
sample is yᵢ − x̂ᵢ = dᵢ + εᵢ. Let g = K(·, S) T w. The Kalman filter of (Ψ, Cov η, Cov ε) turns the
samples into rows that are linear in w and have independent noise of variance one.

The filter carries a matrix E. Its columns are the expectation of d for each entry of w, given the
samples so far; its last column is minus the expectation for w = 0. A measured component c with the
innovation variance s gives the row (E_c, y_c − x̂_c + E_c)/√s. Then E ← E − k E_c with the gain k,
and across the interval E ← Ψ E + (Γ K T, ô). The filter also carries a root L of Cov d: a sample
changes L by Potter's update, and an interval by an orthonormal factor of ((Ψ L)ᵀ, √Cov ηᵀ).

The smoothed d and η are gradients. Let J = ½ Σ e²/s, let u be a push of the state between two
samples, and m the expectation of d given the samples before it. Then E[η | y] = −Cov η ∂J/∂u, and
E[d | y] = m − P ∂J/∂m with P = L Lᵀ. The reason: −J is log p(y | m) but for a constant, and the
derivative of p(y | m) = ∫ N(d; m, P) p(y | d) dd is P⁻¹(E[d | y] − m) p(y | m).

Source: Potter (1963), in Bierman (1977), "Factorization methods for discrete sequential
estimation"; Bryson & Frazier (1963) for the smoother.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._machine import compiled_by_size, orthonormal
from hamkernel._observations.kinds import Functionals, Together
from hamkernel._runs.flow import WEIGHTS, Expansion, Path, Segments, integrate, means
from hamkernel._trajectories.model import Model, WhitenedRows, columns, landmark_whitening
from hamkernel._trajectories.segments import LinearisedSegments, linearise


class Filtered(NamedTuple):
    """The output of the filter on S segments.

    Attributes:
        rows: E_c/√s, the samples in the last column, shape (S, L + 1, n, q); 0 where none is.
        log_variance: log s, 0 where there is no sample, shape (S, L + 1, n).
        expected: E before each sample, shape (S, L + 1, n, q).
        roots: L before each sample, shape (S, L + 1, n, n).
    """

    rows: Float[Array, "S L+1 n q"]
    log_variance: Float[Array, "S L+1 n"]
    expected: Float[Array, "S L+1 n q"]
    roots: Float[Array, "S L+1 n n"]


def process_roots(
    log_process: Float[Array, " n"], rows: LinearisedSegments
) -> Float[Array, "S L n 3n"]:
    """A root √Cov η, with one column for each node and component of w."""
    h = rows.spans[:, :, None] * jnp.asarray(WEIGHTS, rows.spans.dtype)[None, None]
    scale = jnp.where(h > 0, 1 / jnp.sqrt(jnp.where(h > 0, h, 1.0)), 0.0)
    q = jnp.exp(log_process)[None, None, None, None]
    roots = rows.weights * (rows.pushed[..., None] * scale)[..., None, None] * q
    return jnp.moveaxis(roots, 2, 3).reshape(*rows.drive.shape, -1)


def run_filter(
    model: Model,
    rows: LinearisedSegments,
    local: Float[Array, "S L n q"],
    start: Float[Array, "S n q"],
    start_deviation: Float[Array, " n"],
) -> Filtered:
    """The whitened rows of columns E that grow by `local` in each interval, from `start`."""
    noise, n = jnp.exp(2 * model.log_noise), rows.residual.shape[-1]

    def take_samples(L, E, y, count):
        out = []
        for c in range(n):
            there, phi = count[c] > 0, L[c]
            r = noise[c] / jnp.where(there, count[c], 1.0)
            s = phi @ phi + r
            k = jnp.where(there, L @ phi / s, 0.0)
            e = E[c].at[-1].add(y[c])
            # P − s k kᵀ = L (I − φφᵀ/s) Lᵀ, and I − φφᵀ/s = (I − β φφᵀ)² for β = 1/(s + √(r s)):
            # with φ·φ = s − r, 2β − β²(s − r) = 1/s. So L ← L (I − β φφᵀ), βLφ = k/(1 + √(r/s)).
            out.append((jnp.where(there, e / jnp.sqrt(s), 0.0), jnp.where(there, jnp.log(s), 0.0)))
            L = L - jnp.outer(k / (1 + jnp.sqrt(r / s)), phi)
            E = E - jnp.outer(k, e)
        return L, E, [jnp.stack(column) for column in zip(*out, strict=True)]

    def step(carry, at):
        (L, E), (across, root, drive, y, count) = carry, at
        after, E_after, out = take_samples(L, E, y, count)
        U = orthonormal(jnp.concatenate([(across @ after).T, root.T])[None])[1][0]
        return (U.T, across @ E_after + drive), (*out, E, L)

    def segment(across, roots, local, y, count, E):
        # No interval follows the last sample: we append one in which nothing moves.
        still = [jnp.eye(n, dtype=y.dtype), jnp.zeros_like(roots[0]), jnp.zeros_like(local[0])]
        padded = [
            jnp.concatenate([a, b[None]])
            for a, b in zip((across, roots, local), still, strict=True)
        ]
        return jax.lax.scan(step, (jnp.diag(start_deviation), E), (*padded, y, count))[1]

    roots = process_roots(model.log_process, rows)
    args = rows.across, roots, local, rows.residual, rows.counts, start
    rows_, log_variance, expected, L = jax.vmap(segment)(*args)
    return Filtered(rows_, log_variance, expected, L)


def whiten(
    model: Model,
    S: Float[Array, "m d"],
    T: Float[Array, "q q"],
    rows: LinearisedSegments,
    start_deviation,
) -> WhitenedRows:
    """The rows with process noise and starts integrated out, in the order of time."""
    local = columns(model.kernel, S, T, rows)
    local = jnp.concatenate([local, (rows.drive + rows.missed)[..., None]], axis=-1)
    start = jnp.zeros((*local.shape[:1], *local.shape[2:]), local.dtype)
    start = start.at[..., -1].set(-rows.prior_offset)
    output = run_filter(model, rows, local, start, start_deviation)
    flat = output.rows.reshape(-1, local.shape[-1])
    # The scatter of averaged samples about their mean depends on σ, and not on the field or w.
    more, scatter = jnp.maximum(rows.counts - 1, 0.0).sum((0, 1)), rows.scatter.sum((0, 1))
    constant = 0.5 * output.log_variance.sum() + more @ model.log_noise
    constant = constant + 0.5 * scatter @ jnp.exp(-2 * model.log_noise)
    return WhitenedRows(flat[:, :-1], flat[:, -1], constant)


_BLOCK = 256  # rows that are predicted at once
# A push is an interval in which w exceeds this number of standard deviations; a normal w does so in
# one interval of 370. A hand pushed a real pendulum by 9 standard deviations if all intervals
# determine q, and by 30 if the pushed ones do not. Errors of rollouts on three logs, in rad:
#     no limit  .099 .066 .250;   limit 3  .052 .024 .159;   limit 5  .055 .024 .168
_PUSH = 3.0


class SmoothedPath(NamedTuple):
    """The path given the samples and a field, and the disturbance w that also moved it.

    Attributes:
        moves: the path less x̂, shape (S, L + 1, n).
        disturbance: the mean of w in each interval, shape (S, L, n).
        pushed: the factor by which the next step enlarges the standard deviation of w in an
            interval, shape (S, L). We divide the mean of w by its standard deviation q/√h and take
            the largest coordinate; if the result is at most `_PUSH`, the factor is 1.
    """

    moves: Float[Array, "S L+1 n"]
    disturbance: Float[Array, "S L n"]
    pushed: Float[Array, "S L"]


@compiled_by_size
def smoothed_path(
    model: Model,
    coefficients: Float[Array, "m n"],
    S: Float[Array, "m d"],
    rows: LinearisedSegments,
    start_deviation,
) -> SmoothedPath:
    """The smoothed path for the field with these coefficients."""
    (*nodes, d), n = rows.nodes.shape, rows.residual.shape[-1]
    field = Expansion(model.kernel, S, coefficients, None)
    g = jax.vmap(field)(rows.nodes.reshape(-1, d)).reshape(*nodes, n)
    push = jnp.einsum("slkab,slkb->sla", rows.weights, g) - rows.drive - rows.missed

    def half_chi_squared(push, start):
        out = run_filter(model, rows, -push[..., None], -start[..., None], start_deviation)
        return 0.5 * jnp.sum(out.rows**2), out

    slopes, out = jax.grad(half_chi_squared, (0, 1), has_aux=True)(push, rows.prior_offset)
    # m at the first sample is the offset of the start, and later the push adds to it, so these
    # slopes are ∂J/∂m at all samples. E is −m.
    adjoint = jnp.concatenate([slopes[1][:, None], slopes[0]], axis=1)
    back = jnp.einsum("slba,slb->sla", out.roots, adjoint)
    moves = -out.expected[..., 0] - jnp.einsum("slab,slb->sla", out.roots, back)
    # E[w | y] at node k is −diag(q²) Γ_kᵀ ∂J/∂u / (h w_k); we return its weighted mean over k.
    h = jnp.where(rows.spans > 0, rows.spans, 1.0)[..., None]
    w = jnp.einsum("slkab,sla->slb", rows.weights, slopes[0])  # Σ_k h w_k Γ_kᵀ∂J/∂u / (h w_k)
    variance = jnp.exp(2 * model.log_process)[None, None] * rows.pushed[..., None] ** 2
    w = -variance * w / h
    unit = jnp.where(model.log_process > -jnp.inf, jnp.exp(model.log_process), jnp.inf)
    size = jnp.abs(w / unit[None, None]).max(axis=-1) * jnp.sqrt(rows.spans)
    return SmoothedPath(moves, w, jnp.where(size > _PUSH, size, 1.0))


@compiled_by_size
def linearised_by_interval(
    field: Expansion, x: Float[Array, "S L+1 n"], segments: Segments, steps, good
) -> LinearisedSegments:
    """The rows along a path that the field need not follow; `missed` is the defect by interval.

    Segments that are not finite are dropped.
    """
    (S, L), n, m = segments.spans.shape, x.shape[-1], segments.inputs.shape[-1]
    there = integrate(
        field,
        x[:, :-1].reshape(-1, n),
        segments.spans.reshape(-1, 1),
        steps,
        segments.inputs.reshape(S * L, 1, 2, m),
    )
    nodes, to_end, across = (a.reshape(S, L, *a.shape[2:]) for a in there[1:])
    defect = x[:, 1:] - there.x[:, 1].reshape(S, L, n)
    finite = jnp.isfinite(defect).all((1, 2)) & jnp.isfinite(across).all((1, 2, 3))
    good = good & finite
    nodes = jnp.where(good[:, None, None, None], nodes, 0.0)
    slopes = jax.vmap(jax.vmap(jax.vmap(field)))(nodes)
    rows = linearise(
        Path(x, nodes, to_end, across),
        slopes,
        means(field.mean, nodes, slopes),
        segments,
        good,
    )
    return rows._replace(missed=jnp.where(good[:, None, None], defect, 0.0))


@compiled_by_size
def process_covariance(
    model: Model, rows: LinearisedSegments, least: Float[Array, " n"]
) -> Float[Array, "S L n n"]:
    """Cov η of each interval, plus the squares of `least` on its diagonal."""
    roots = process_roots(model.log_process, rows)
    return jnp.einsum("slab,slcb->slac", roots, roots) + jnp.diag(least**2)[None, None]


def innovations(made: WhitenedRows, rows: LinearisedSegments) -> Float[np.ndarray, "S L+1 n"]:
    """The innovations: each row minus its prediction from the earlier rows, in standard deviations.

    The innovations are L⁻¹r with L Lᵀ = I + M Mᵀ. Under the model they are independent and N(0, 1).
    The residuals of a fit are not, since every sample takes part in the fit. We keep the earlier
    rows as R w = v with unit noise. For the next block of rows M, L is the factor of I + V Vᵀ with
    V = M R⁻¹. Both R and L come from orthonormal factors: if sensors have no noise, the products
    M Mᵀ lose all digits of I. An innovation is 0 where there is no sample or the segment is not
    finite.
    """
    from scipy.linalg import lapack, solve_triangular  # so that importing does not load them

    M, r, size = np.asarray(made.M), np.asarray(made.r), len(rows.residual)
    q = M.shape[1]
    factor = np.eye(q + 1)  # R and v; the last entry is a residual, which is not used
    factor[q, q] = 0.0
    out = np.zeros(len(r))
    finite = np.isfinite(M).all(axis=1) & np.isfinite(r)
    finite = np.repeat(finite.reshape(size, -1).all(axis=1), len(r) // size)
    there = np.flatnonzero(finite & ((M != 0).any(axis=1) | (r != 0)))
    # 8960 rows with q = 2560 take 5 s in blocks; segments of 20 rows, one by one, took 18 s.
    for at in np.array_split(there, -(-len(there) // _BLOCK)) if len(there) else ():
        A, y, R, v = M[at], r[at], factor[:q, :q], factor[:q, q]
        V = solve_triangular(R, A.T, trans=1).T
        root: Any = np.linalg.qr(np.concatenate([np.eye(len(y)), V.T]), mode="r")
        L = root.T * np.sign(np.diagonal(root))[None]
        out[at] = solve_triangular(L, y - V @ v, lower=True)
        # The QR of a triangle above d rows takes 2 d q² operations; a plain QR took 18 s, q = 2048.
        both = np.column_stack([A, y])
        # `dtpqrt` eliminates 32 columns at once; 16 to 64 take as long.
        factor, *_ = lapack.dtpqrt(0, min(32, q + 1), factor, both)  # type: ignore[attr-defined]
        factor[q, q] = 0.0
    return out.reshape(rows.residual.shape)


def as_observations(
    rows: LinearisedSegments, model: Model, mean: object, start_deviation: Float[Array, " n"]
) -> Together | None:
    """The samples as observations of f = g + m with independent unit noise, segment by segment.

    The weights are the whitened rows of g at the nodes. The targets are r̃ plus the same rows of the
    mean m. None if no segment has more samples than are needed to fix its start.
    """
    n = rows.residual.shape[-1]
    least = np.asarray(rows.counts, bool).sum((1, 2)) > n
    there = _means(mean, rows.nodes, rows.nodes[..., :n])
    # On the host: one segment of a JAX array compiles.
    every = jax.tree.map(np.asarray, (rows, there))
    observations = []
    for s in np.flatnonzero(np.asarray(least)):
        one = jax.tree.map(lambda a, s=s: a[s : s + 1], every)
        B, r = (np.asarray(a) for a in _rows_at_nodes(model, one[0], start_deviation))
        informative = B.any(axis=1)  # the first sample of a segment depends on its start alone
        last = int(np.flatnonzero(one[0].counts[0].any(axis=1))[-1])
        B = B[informative].reshape(informative.sum(), -1, n)[:, : 3 * last]
        target = r[informative] + np.einsum("dqn,qn->d", B, one[1][0, :last].reshape(-1, n))
        points = one[0].nodes[0, :last].reshape(1, 3 * last, -1)
        x, u = np.split(points, [n], axis=2)
        observations.append(Functionals(x, B[None], target[None], u if u.size else None))
    return Together(tuple(observations)) if observations else None


_means = compiled_by_size(means)


@compiled_by_size
def _rows_at_nodes(model: Model, rows: LinearisedSegments, start_deviation):
    """The rows of one segment as functionals of g at its nodes, and their targets."""
    _, L, _, n, _ = rows.weights.shape
    placed = jnp.einsum("lkab,lj->lajkb", rows.weights[0], jnp.eye(L, dtype=rows.weights.dtype))
    drive = (rows.drive + rows.missed)[0][..., None]
    local = jnp.concatenate([placed.reshape(L, n, -1), drive], axis=-1)[None]
    start = jnp.zeros((1, n, local.shape[-1]), local.dtype).at[..., -1].set(-rows.prior_offset)
    flat = run_filter(model, rows, local, start, start_deviation).rows.reshape((L + 1) * n, -1)
    return flat[:, :-1], flat[:, -1]


@compiled_by_size
def whitened_rows(model: Model, S, rows: LinearisedSegments, start_deviation) -> WhitenedRows:
    """The rows whitened with process noise, and M and r of the landmarks S."""
    return whiten(model, S, landmark_whitening(model.kernel, S), rows, start_deviation)
