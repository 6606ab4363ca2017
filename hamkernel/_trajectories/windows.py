"""Weak rows: what noisy runs say of a field, without derivatives and without iterations.

With a test function φ that vanishes with its slope at both ends of a window, integration by parts
of ẋ = f(x) gives −∫ φ̇ x dt = ∫ φ f(x) dt. The left side takes the raw samples, the right side f
along a smoothed path x̂. For the momenta of known masses, where these were not measured, two
integrations give ∫ φ̈ m q dt = ∫ φ f_p dt.

**Noise.** With W the weights of a window at the samples, φ̇ or φ̈ times those of the trapezoidal
rule, white noise of the samples gives rows of the covariance C₀ = σ² W Wᵀ. An error δx of the path
adds (∫ φ ∂f/∂x δx dt). With D_j the weights of φ times ∂f/∂x_j along the path, and S_j the
covariance of x_j given its samples,

    C = C₀ + Σ_j D_j S_j D_jᵀ.

The first solve takes C₀, and its solution gives the D_j of a second one. Everything is closed form
and linear in the number of coordinates and of samples, but for the Cholesky factor of C, which is
taken of pieces of runs with at most 2048 rows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import compiled
from hamkernel._tuning.minimiser import most_likely_in_box


class Windows(NamedTuple):
    """Test functions (1 − s²)³ over windows of samples, half of which overlap.

    Attributes:
        value: φ times the weights of the trapezoidal rule, shape (R, T).
        slope: φ̇ times these weights.
        bend: φ̈ times these weights.
    """

    value: Float[np.ndarray, "R T"]
    slope: Float[np.ndarray, "R T"]
    bend: Float[np.ndarray, "R T"]


def windows(times: Float[np.ndarray, " T"], width: int) -> Windows:
    """The test functions over windows of `width` intervals between samples, at least 4.

    The trapezoidal rule is exact to O(h⁶) for them, since φ and φ̇ and φ̈ vanish at both ends.
    """
    T = len(times)
    width = max(min(width, T - 1), 4)
    starts = np.arange(0, T - width, max(width // 2, 1))
    half = np.diff(times) / 2
    weights = np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])
    out = Windows(*(np.zeros((len(starts), T)) for _ in range(3)))
    for r, first in enumerate(starts):
        inside = slice(first, first + width + 1)
        t = times[inside]
        reach = (t[-1] - t[0]) / 2
        s = (t - t[0]) / reach - 1
        out.value[r, inside] = (1 - s**2) ** 3 * weights[inside]
        out.slope[r, inside] = -6 * s * (1 - s**2) ** 2 / reach * weights[inside]
        out.bend[r, inside] = -6 * (1 - s**2) * (1 - 5 * s**2) / reach**2 * weights[inside]
        # Exact for constants, and for x = t and x = t²/2: the rule alone is off by 1e-3.
        value = out.value[r, inside]
        for rows, x in ((out.slope, t - t.mean()), (out.bend, (t - t.mean()) ** 2 / 2)):
            rows[r, inside] -= value * rows[r, inside].sum() / value.sum()
            rows[r, inside] *= value.sum() / abs(rows[r, inside] @ x)
    return out


class Smoother(NamedTuple):
    """Deviation of the process, its rate √7/ℓ, and the noise of values and of slopes, in logs."""

    log_amplitude: Float[Array, ""]
    log_rate: Float[Array, ""]
    log_noise: Float[Array, ""]
    log_slope_noise: Float[Array, ""]


class Channels(NamedTuple):
    """Samples of alike functions of time, each with its slope, in pieces side by side.

    Attributes:
        times: from −1 to 1, shape (S, T); the last is repeated after the end of a piece.
        values: 0 where nothing was measured, shape (S, T, C).
        slopes: their derivatives in these units of time, likewise.
        has_value: which values were measured, (S, T, C).
        has_slope: which slopes were.
    """

    times: Float[np.ndarray, "S T"]
    values: Float[np.ndarray, "S T C"]
    slopes: Float[np.ndarray, "S T C"]
    has_value: Bool[np.ndarray, "S T C"]
    has_slope: Bool[np.ndarray, "S T C"]


class SmoothedChannels(NamedTuple):
    """Means of the values and of their slopes, and the covariance of the values of a channel."""

    values: Float[Array, "S T C"]
    slopes: Float[Array, "S T C"]
    covariance: Float[Array, "S G T T"]  # G = 1 where all channels were measured at the same times


def _prior(h: Smoother, t: Float[Array, " T"]) -> Float[Array, "2T 2T"]:
    """The covariance of values and slopes: Matérn 7/2, and a line of deviation 10."""
    rate = jnp.exp(h.log_rate)
    u = rate * (t[:, None] - t[None])
    a, size = jnp.abs(u), jnp.exp(2 * h.log_amplitude - jnp.abs(u))
    value = size * (1 + a + 0.4 * a**2 + a**3 / 15)
    first = -size * u * (1 + a + a**2 / 3) / 5 * rate  # ∂/∂t
    second = size * (1 + a - a**3 / 3) / 5 * rate**2
    one = jnp.ones_like(u)
    line = jnp.block([[one + t[:, None] * t[None], one * t[:, None]], [one * t[None], one]])
    return jnp.block([[value, -first], [first, second]]) + 1e2 * line


def _noise(h: Smoother, has_value, has_slope) -> Float[Array, "G 2T"]:
    # A missing sample has the variance 1e6, ten thousand times that of a line.
    both = jnp.where(has_value, jnp.exp(2 * h.log_noise), 1e6)
    slopes = jnp.where(has_slope, jnp.exp(2 * h.log_slope_noise), 1e6)
    return jnp.concatenate([both, slopes])


def _groups(channels: Channels) -> tuple[Array, ...]:
    """Pieces with their channels in groups that were measured at the same times."""
    alike = all((a == a[:, :, :1]).all() for a in (channels.has_value, channels.has_slope))
    G = 1 if alike else channels.values.shape[2]

    def split(a):
        S, T, C = a.shape
        return jnp.asarray(a).reshape(S, T, G, C // G).transpose(0, 2, 1, 3)

    y = jnp.concatenate([split(channels.values), split(channels.slopes)], axis=2)
    has_value = split(channels.has_value)[..., 0], split(channels.has_slope)[..., 0]
    return jnp.asarray(channels.times), y, *has_value  # (S, T), (S, G, 2T, C/G), (S, G, T) twice


@compiled
def _fit_process(pieces: tuple[Array, ...], low, high, is_free) -> Float[Array, "4"]:
    def loss(h):
        h = Smoother(*jnp.where(is_free, h, low))

        def piece_loss(piece):
            t, y, has_value, has_slope = piece
            K = _prior(h, t)

            def group_loss(y, has_value, has_slope):
                L = jnp.linalg.cholesky(K + jnp.diag(_noise(h, has_value, has_slope)))
                z = jax.scipy.linalg.solve_triangular(L, y, lower=True)
                log_det = jnp.sum(jnp.log(jnp.diagonal(L)))
                return 0.5 * jnp.sum(z**2) + y.shape[1] * log_det

            return jax.vmap(group_loss)(y, has_value, has_slope).sum()

        return jax.lax.map(piece_loss, pieces).sum()

    shares = jnp.asarray([0.3, 0.5, 0.7])
    rates, noises = jnp.meshgrid(shares, jnp.asarray([0.2, 0.4, 0.6, 0.8]))
    design = jnp.stack(
        [
            jnp.full(rates.size, 0.6),
            rates.ravel(),
            noises.ravel(),
            noises.ravel(),
        ],
        axis=1,
    )
    design = low[None] + (high - low)[None] * design
    values = jax.lax.map(loss, design)
    start = design[jnp.nanargmin(values)]
    h = most_likely_in_box(loss, start, low, high, jnp.full(4, 0.1), 60)[0]
    return jnp.where(is_free, h, low)


@compiled
def _condition(h: Smoother, pieces: tuple[Array, ...]):
    def condition_piece(piece):
        t, y, has_value, has_slope = piece
        K, T = _prior(h, t), len(t)

        def condition_group(y, has_value, has_slope):
            L = jnp.linalg.cholesky(K + jnp.diag(_noise(h, has_value, has_slope)))
            V = jax.scipy.linalg.solve_triangular(L, K, lower=True)
            mean = V.T @ jax.scipy.linalg.solve_triangular(L, y, lower=True)
            return mean, K[:T, :T] - V[:, :T].T @ V[:, :T]

        return jax.vmap(condition_group)(y, has_value, has_slope)

    return jax.lax.map(condition_piece, pieces)


def smooth_channels(
    channels: Channels, noise: tuple[float | None, float | None] = (None, None)
) -> tuple[Smoother, SmoothedChannels]:
    """Channels smoothed by one process, with hyperparameters by the likelihood of all of them.

    Args:
        channels: functions of size 1 at times from −1 to 1.
        noise: σ of values and σ of slopes, None where it is unknown.
    """
    pieces = _groups(channels)
    # A swing a hundred times as long as the data looks like a line; one faster than half a sample,
    # like noise.
    spacing = float(np.median(np.diff(channels.times[0])[np.diff(channels.times[0]) > 0]))
    speed = float(np.sqrt(np.mean(channels.slopes**2) / max(np.mean(channels.has_slope), 1e-9)))
    low = np.log([0.01, 0.03, 1e-7, 1e-7 * max(speed, 1.0)])
    high = np.log([1e3, 3.0 / spacing, 2.0, 2.0 * max(speed, 1.0)])
    is_free = np.array([True, True, noise[0] is None, noise[1] is None and speed > 0])
    low = np.where(is_free, low, np.log([1, 1, noise[0] or 1.0, noise[1] or 1.0]))
    part = jax.tree.map(lambda a: a[np.linspace(0, len(a) - 1, min(len(a), 8)).astype(int)], pieces)
    h = Smoother(*_fit_process(part, *map(jnp.asarray, (low, high, is_free))))
    mean, covariance = _condition(h, pieces)
    S, G, T2, C = mean.shape
    both = mean.transpose(0, 2, 1, 3).reshape(S, T2, G * C)
    T = T2 // 2
    return h, SmoothedChannels(both[:, :T], both[:, T:], covariance)


class Chunk(NamedTuple):
    """Windows of one piece of a run that are solved for together, padded with empty ones.

    Attributes:
        points: the smoothed path at its samples, shape (T, n).
        value: the weights of φ, shape (R, T); zero in an empty window.
        rows: −∫ φ̇ x dt or ∫ φ̈ m q dt for each of the coordinates of rows, shape (c, R).
        roots: B_c with C₀ = B_c B_cᵀ of each of these coordinates, shape (c, R, T).
        path_roots: B_j with S_j = B_j B_jᵀ, for each coordinate j that the field depends on and
            is found by smoothing, shape (G, T, k); G = 1 where it is the same for all of them.
    """

    points: Float[np.ndarray, "T n"]
    value: Float[np.ndarray, "R T"]
    rows: Float[np.ndarray, "c R"]
    roots: Float[np.ndarray, "c R T"]
    path_roots: Float[np.ndarray, "G T k"]


def white_factors(chunk: Chunk) -> Float[Array, "c R R"]:
    """The Cholesky factors of C₀, of each coordinate; the identity for empty windows."""
    C = jnp.einsum("crt,cst->crs", chunk.roots, chunk.roots)
    return jnp.linalg.cholesky(C + _empty_windows(chunk)[None])


def _empty_windows(chunk: Chunk) -> Float[Array, "R R"]:
    return jnp.diag(jnp.where(jnp.abs(chunk.value).sum(axis=1) == 0, 1.0, 0.0))


def full_factor(chunk: Chunk, slopes: Float[Array, "T c j"]) -> Float[Array, "cR cR"]:
    """The Cholesky factor of C with ∂f_c/∂x_j along the path."""
    c, R, T = chunk.roots.shape
    white = jnp.einsum("crt,cst->crs", chunk.roots, chunk.roots) + _empty_windows(chunk)[None]
    C = jax.scipy.linalg.block_diag(*white)
    k = chunk.path_roots.shape[2]
    by_coordinate = jnp.moveaxis(slopes, 2, 0)  # (j, T, c)
    roots = jnp.broadcast_to(chunk.path_roots, (len(by_coordinate), T, k))

    def add(C, both):
        slope, root = both
        E = jnp.einsum("rt,tc,tk->crk", chunk.value, slope, root).reshape(c * R, k)
        return C + E @ E.T, None

    C, _ = jax.lax.scan(add, C, (by_coordinate, roots))
    return jnp.linalg.cholesky(C)


def whiten_rows(factor: Float[Array, "..."], rows: Float[Array, "c R *m"]) -> Float[Array, "cR *m"]:
    """L⁻¹ of rows, for the factors of C₀ or the factor of C."""
    solve = jax.scipy.linalg.solve_triangular
    c, R = rows.shape[:2]
    columns = rows.reshape(c, R, -1)
    if factor.ndim == 3:
        out = jax.vmap(lambda L, y: solve(L, y, lower=True))(factor, columns)
    else:
        out = solve(factor, columns.reshape(c * R, -1), lower=True)
    return out.reshape(c * R, *rows.shape[2:])
