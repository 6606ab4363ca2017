"""Weak rows: a law of motion tested against functions of compact support, along smoothed runs.

A law d/dt a(x) + b(x) = c with a and b linear in its weights becomes

    ∫ (φ b − φ̇ a) dt = ∫ φ c dt,      φ(t) = (1 − s²)⁵, s = (t − t₀)/T, in −1 < s < 1,

in which nothing is differentiated twice in time. Positions are Gaussian processes in time, those of
`smoothing`, so that the path x = (q, v) and the covariance S of its errors follow from the samples.
Runs are cut into pieces with windows that overlap by half. Let D be the derivative of the rows of a
piece with respect to the path. Their errors then have the covariance D S Dᵀ, to first order. D
depends on the law, so a law is solved for twice: with torques as the only source of errors, and
then with this covariance.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from hamkernel._trajectories.runs import Runs
from hamkernel._trajectories.smoothing import Coordinate, Process, processes, smoothed

# In lengthscales of the smoothed positions. Of a two-link arm at 100 Hz, with noise 1e-3 rad, M was
# off by .22, .09 and .10 % with windows (1 − s²)³ of .35, .7 and 1.2; (1 − s²)⁵ of 1.2 times their
# width has the same variance.
_WIDTH = 1.0
# In a window. By the trapezoidal rule ∫ (φ b − φ̇ a) dt of a sinusoid with b = ȧ and 2.2 rad in a
# window is then wrong by 2e-6 of its size, and with (1 − s²)³ by 7e-5.
_NODES = 24
_WINDOWS = 10  # in a piece, whose covariances are matrices of 2 · 133 nodes
_MARGIN = 1.5  # lengthscales of samples beyond a piece, after which they say nothing more of it
# Samples in a lengthscale, at most. Means over ℓ/60 flatten a sinusoid of period 2.3 ℓ by 1e-4.
_SAMPLES = 60

Law = Callable[[Float[Array, " n"]], tuple[Float[Array, "m *r"], Float[Array, "m *r"]]]


class Pieces(NamedTuple):
    """B parts of runs, each with P nodes and W windows, for m positions.

    Attributes:
        path: smoothed positions and velocities at the nodes, shape (B, P, 2m).
        covariance: the covariance of the errors of (q, v) of each position, shape (B, m, 2P, 2P).
        values: φ dt of each window at the nodes, shape (W, P).
        slopes: φ̇ dt, shape (W, P).
        overlap: ∫ φ_r φ_s dt, shape (W, W).
        targets: ∫ φ c dt, shape (B, W, m).
        inside: whether a window is inside its run, shape (B, W).
        spacing: the time between samples, shape ().
    """

    path: Float[np.ndarray, "B P n"]
    covariance: Float[np.ndarray, "B m Q Q"]
    values: Float[np.ndarray, "W P"]
    slopes: Float[np.ndarray, "W P"]
    overlap: Float[np.ndarray, "W W"]
    targets: Float[np.ndarray, "B W m"]
    inside: Bool[np.ndarray, "B W"]
    spacing: float

    def states(self) -> Float[np.ndarray, "N n"]:
        """The smoothed states at all nodes of windows inside the runs."""
        near = np.abs(self.values) > 0
        used = np.einsum("bw,wp->bp", self.inside, near) > 0
        return self.path[used]


class Smoothed(NamedTuple):
    """The pieces, with what the smoother found.

    Attributes:
        pieces: the pieces.
        noise: the standard deviation of the noise of each coordinate, shape (n,).
        states: (q, v) at the samples of each run, (T, 2m).
        lengthscale: the shortest of the positions in time.
    """

    pieces: Pieces
    noise: Float[np.ndarray, " n"]
    states: list[Float[np.ndarray, "T n"]]
    lengthscale: float


def smoothed_pieces(runs: Runs, m: int, noise: Float[np.ndarray, " n"] | None) -> Smoothed:
    """The runs in pieces: m positions come first in the states, their velocities, if any, last.

    Args:
        runs: the runs, whose inputs are c.
        m: the number of positions.
        noise: the standard deviations of the coordinates, where they are known.

    Raises:
        ValueError: no run is as long as a window.
    """
    times, states = runs.on_host()
    positions = [x[:, :m] for x in states]
    coordinates = _processes(times, positions, noise)
    paths = smoothed(coordinates, times, positions)
    along = [
        np.concatenate([paths.value[r, : len(t)], paths.slope[r, : len(t)]], axis=1)
        for r, t in enumerate(times)
    ]
    of_positions = np.array([c.noise for c in coordinates])
    velocities = [x[:, m:] for x in states]
    of_slopes = np.array(
        [c.noise for c in processes(times, velocities)] if states[0].shape[1] > m else []
    )
    if noise is not None:
        of_slopes = np.asarray(noise[m:], float)
    length = min(c.lengthscale for c in coordinates)
    spacing = float(np.median(np.concatenate([np.diff(t) for t in times])))
    times, states, counts = _block_means(times, states, max(1, int(length / (_SAMPLES * spacing))))
    half = _NODES // 2
    step = _WIDTH * length / _NODES
    centres = half * (1 + np.arange(_WINDOWS))
    P = half * (_WINDOWS + 1) + 1
    phi, slope = _bump((np.arange(P)[None] - centres[:, None]) / half)
    pieces = []
    for r, (t, x, count) in enumerate(zip(times, states, counts, strict=True)):
        start = float(t[0])
        while start + 2 * half * step <= t[-1]:
            at = start + step * np.arange(P)
            near = (t >= at[0] - _MARGIN * length) & (t <= at[-1] + _MARGIN * length)
            path, covariance = np.zeros((P, 2 * m)), np.zeros((m, 2 * P, 2 * P))
            for c in range(m):
                deviations = of_positions[c], of_slopes[c] if len(of_slopes) else 0.0
                samples = t[near], x[near][:, [c, m + c] if len(of_slopes) else [c]], count[near]
                mean, covariance[c] = _posterior_path(
                    coordinates[c].process, *samples, deviations, at
                )
                path[:, c], path[:, m + c] = mean
            ends = at[centres + half]
            target = _integrals(runs, r, at, centres, half * step, m)
            pieces.append((path, covariance, target, ends <= t[-1] + 1e-9 * step))
            start = float(at[-1])  # windows of two pieces do not overlap: their errors are apart
    if not pieces:
        raise ValueError(
            f"no run is as long as a window, {2 * half * step:.3g} in the unit of the times: weak "
            "rows need runs of several swings."
        )
    stacked = (np.array(column) for column in zip(*pieces, strict=True))
    path, covariance, targets, inside = stacked
    targets = np.where(inside[:, :, None], targets, 0.0)
    overlap = phi @ phi.T * step
    windows = phi * step, slope / half
    made = Pieces(path, covariance, *windows, overlap, targets, inside, spacing)
    return Smoothed(made, np.concatenate([of_positions, of_slopes]), along, length)


def _processes(times, positions, noise: Float[np.ndarray, " n"] | None) -> list[Coordinate]:
    """The Gaussian process in time of each position, with its noise where that is known."""
    coordinates = processes(times, positions)
    for c, coordinate in enumerate(coordinates):
        if not np.isfinite(coordinate.process.log_amplitude):
            raise ValueError(
                f"position {c} {'does not move' if coordinate.seen else 'is missing'}."
            )
        if noise is not None:
            log_noise = jnp.log(jnp.asarray(noise[c], float))
            process = coordinate.process._replace(log_noise=log_noise)
            coordinates[c] = coordinate._replace(process=process)
    return coordinates


def _bump(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """φ = (1 − s²)⁵ and dφ/ds inside of −1 < s < 1, else 0."""
    rest = np.maximum(1 - s**2, 0.0)
    return rest**5, -10 * s * rest**4


def _integrals(runs, r: int, at, centres, half_width: float, m: int) -> Float[np.ndarray, "W m"]:
    """∫ φ u dt of the inputs u of run r, exactly for inputs that are lines between nodes."""
    lines = runs.applied(r, at)
    if lines.shape[2] == 0:
        return np.zeros((len(centres), m))
    x, weights = np.polynomial.legendre.leggauss(4)
    share = (1 + x) / 2
    step = at[1] - at[0]
    inside = at[:-1, None] + step * share[None]
    u = lines[:, None, 0] + share[None, :, None] * (lines[:, 1] - lines[:, 0])[:, None]
    phi = _bump((inside[None] - at[centres][:, None, None]) / half_width)[0]
    return np.einsum("wpg,pgm,g->wm", phi, u, weights / 2 * step)


def _block_means(times, states, size: int):
    """Means of `size` samples each, with how many of each coordinate are in them."""
    out = []
    for t, x in zip(times, states, strict=True):
        edges = np.arange(0, len(t), size)
        sizes = np.diff(np.append(edges, len(t)))
        there = np.isfinite(x)
        counts = np.add.reduceat(there.astype(float), edges, axis=0)
        sums = np.add.reduceat(np.where(there, x, 0.0), edges, axis=0)
        mean = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        out.append((np.add.reduceat(t, edges) / sizes, mean, counts))
    return (list(column) for column in zip(*out, strict=True))


def _covariances(process: Process, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K, dk/dt and −d²k/dt² of the Matérn-7/2 process at times `gaps` apart."""
    variance, rate = np.exp(2 * float(process.log_amplitude)), np.exp(float(process.log_rate))
    u = rate * np.abs(gaps)
    decay = variance * np.exp(-u)
    first = -np.sign(gaps) * rate * decay * (u + u**2 + u**3 / 3) / 5
    second = rate**2 * decay * (1 + u - u**3 / 3) / 5
    return decay * (1 + u + 0.4 * u**2 + u**3 / 15), first, second


def _posterior_path(
    process: Process,
    t: Float[np.ndarray, " T"],
    x: Float[np.ndarray, "T k"],
    counts: Float[np.ndarray, "T n"],
    deviations: tuple[float, float],
    at: Float[np.ndarray, " P"],
) -> tuple[tuple[np.ndarray, np.ndarray], Float[np.ndarray, "Q Q"]]:
    """The mean of (q, q̇) at the times `at`, and the covariance of both, q first."""
    from scipy.linalg import cho_factor, cho_solve  # so that importing does not load it

    there = np.isfinite(x)
    t0, t1 = t[there[:, 0]], t[there[:, 1]] if x.shape[1] == 2 else t[:0]
    y0 = x[there[:, 0], 0]
    y1 = x[there[:, 1], 1] if x.shape[1] == 2 else t[:0]
    centre = y0.mean() if len(y0) else 0.0

    def joint(a0, a1, b0, b1):
        blocks = [[_covariances(process, a[:, None] - b[None]) for b in (b0, b1)] for a in (a0, a1)]
        return np.block([[blocks[0][0][0], -blocks[0][1][1]], [blocks[1][0][1], blocks[1][1][2]]])

    K = joint(t0, t1, t0, t1)
    share = counts[:, : x.shape[1]]
    noise = [deviations[0] ** 2 / share[there[:, 0], 0]]
    noise += [deviations[1] ** 2 / share[there[:, 1], 1]] if x.shape[1] == 2 else []
    K[np.diag_indices_from(K)] += np.concatenate(noise)
    cross = joint(at, at, t0, t1)
    factor = cho_factor(K)
    mean = cross @ cho_solve(factor, np.concatenate([y0 - centre, y1]))
    S = joint(at, at, at, at) - cross @ cho_solve(factor, cross.T)
    return (mean[: len(at)] + centre, mean[len(at) :]), (S + S.T) / 2


def weak_rows(law: Law, pieces: Pieces) -> Float[Array, "B W m *r"]:
    """∫ (φ b − φ̇ a) dt of the features (a, b) of a law, for each window."""

    @jax.checkpoint  # else the slopes of all nodes are kept for the derivatives
    def piece_result(path):
        a, b = jax.vmap(law)(path)
        values = jnp.einsum("wp,pi...->wi...", pieces.values, b)
        return values - jnp.einsum("wp,pi...->wi...", pieces.slopes, a)

    rows = jax.lax.map(piece_result, jnp.asarray(pieces.path))
    inside = jnp.asarray(pieces.inside)
    return jnp.where(inside.reshape(*inside.shape, *(1,) * (rows.ndim - 2)), rows, 0.0)


def path_covariance(law: Law, pieces: Pieces) -> Float[Array, "B R R"]:
    """D S Dᵀ of the rows of each piece, R = W m, for a law (m,) with known weights."""
    m = pieces.targets.shape[2]

    def piece_result(piece):
        path, S = piece
        a, b = jax.vmap(jax.jacfwd(law))(path)  # (P, m, 2m)
        D = jnp.einsum("wp,pij->wipj", pieces.values, b)
        D = D - jnp.einsum("wp,pij->wipj", pieces.slopes, a)
        D = jnp.concatenate([D[..., :m], D[..., m:]], axis=2)  # (W, m, 2P, m): q, then v
        D = D.reshape(-1, *D.shape[2:])
        return jnp.einsum("rqj,jqs,tsj->rt", D, S, D)

    return jax.lax.map(piece_result, (jnp.asarray(pieces.path), jnp.asarray(pieces.covariance)))


def whiten(
    rows: Float[Array, "B W m r"],
    pieces: Pieces,
    covariance: Float[Array, "B R R"],
    deviation: Float[Array, " m"],
) -> tuple[Float[Array, "N r"], Float[Array, " N"], Float[Array, ""]]:
    """Rows and targets with independent errors of variance one, and the log of what they lost.

    The errors have the covariance of the path and that of white torques, of these deviations at
    each sample. Windows outside of the runs are zero.
    """
    torques = jnp.kron(
        jnp.asarray(pieces.overlap) * pieces.spacing, jnp.diag(jnp.square(deviation))
    )
    m = len(deviation)

    def piece_result(piece):
        A, y, C, inside = piece
        on = jnp.repeat(inside, m)
        C = jnp.where(on[:, None] & on[None], C + torques, jnp.eye(len(on), dtype=C.dtype))
        L = jnp.linalg.cholesky(C)
        both = jnp.concatenate([A.reshape(len(on), -1), y.reshape(-1, 1)], axis=1)
        done = solve_triangular(L, both, lower=True)
        return done[:, :-1], done[:, -1], jnp.log(jnp.diagonal(L)).sum()

    inputs = rows, jnp.asarray(pieces.targets), covariance, jnp.asarray(pieces.inside)
    A, y, lost = jax.lax.map(piece_result, inputs)
    return A.reshape(-1, A.shape[-1]), y.reshape(-1), lost.sum()
