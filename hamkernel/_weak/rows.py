"""Weak rows: a law of motion, integrated against test functions along smoothed runs.

A law d/dt a(z) + b(z) = c, with a and b linear in its weights, becomes

    ∫ (φ b − φ̇ a) dt = ∫ φ c dt,      φ(t) = (1 − s²)⁵, s = (t − t₀)/T, in −1 < s < 1,

which contains no second time derivative. The channels of a run are its positions or all its
coordinates. Each channel is a Gaussian process in time, as in `smoothing`. The samples therefore
determine the path z of the channels, with slopes if the law needs them, and the covariance S of its
errors.

We cut runs into pieces with windows that overlap by half. Let D be the derivative of the rows of a
piece with respect to the path. To first order the errors of the rows have the covariance D S Dᵀ.
Since D depends on the law, callers solve twice: first with the known part of D, then with all of D.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from hamkernel._runs.preprocessing import condense
from hamkernel._runs.runs import Runs
from hamkernel._runs.smoothing import Coordinate, Process, power_of_two, processes, smooth_runs

# Nodes in a window. For a sinusoid with b = ȧ and 2.2 rad in a window, the trapezoidal rule for
# ∫ (φ b − φ̇ a) dt then has a relative error of 2e-6. With φ = (1 − s²)³ the error is 7e-5.
_NODES = 24
_WINDOWS = 10  # windows in a piece, at most: S is then a matrix of 2 · 133 rows
_ROWS = 2048  # rows in a piece, at most: their Cholesky factor takes .3 s
_MARGIN = 1.5  # lengthscales beyond a piece in which samples still inform its path
# Samples in a lengthscale, at most. Means over ℓ/60 flatten a sinusoid of period 2.3 ℓ by 1e-4.
_SAMPLES = 60
_FEWEST = 13  # samples that the longest run needs
_TOGETHER = 256  # samples smoothed at once: the Cholesky factor of 512 rows takes 5 ms

Law = Callable[[Float[Array, " z"]], tuple[Float[Array, "m *r"], Float[Array, "m *r"]]]


class Channels(NamedTuple):
    """The C channels of each run, with samples of their slopes if there are any.

    Attributes:
        values: samples of the channels, shape (T, C), NaN where nothing was measured.
        slopes: samples of their derivatives, shape (T, C), NaN where nothing was measured.
        groups: indices of the channels that share one process.
        has_slopes: whether the law needs the slopes, so that the path contains them.
        noise: the standard deviations of values and of slopes, shape (2, C); None if unknown.
        width: the width of the windows, in lengthscales of the smoothed channels.
    """

    values: list[Float[np.ndarray, "T C"]]
    slopes: list[Float[np.ndarray, "T C"]]
    groups: list[Int[np.ndarray, " g"]]
    has_slopes: bool = True
    noise: Float[np.ndarray, "2 C"] | None = None
    # For a two-link arm at 100 Hz with noise 1e-3 rad, windows (1 − s²)³ of width .35, .7 and 1.2
    # gave errors of M of .22, .09 and .10 %. A window (1 − s²)⁵ of 1.2 times the width has the same
    # variance.
    width: float = 1.0


class Pieces(NamedTuple):
    """B parts of runs, each with P nodes and W windows of m rows, for C channels.

    Attributes:
        path: smoothed channels at the nodes, and then their slopes if the law needs them, shape
            (B, P, Z), Z = C or 2C.
        roots: E with E Eᵀ the covariance of the errors of a channel at the nodes, and then of its
            slope, shape (B, G, Q, k), Q = P or 2P.
        owner: the index of the root of each channel, shape (C,).
        values: φ dt of each window at the nodes, shape (W, P).
        slopes: φ̇ dt, shape (W, P).
        overlap: ∫ φ_r φ_s dt, shape (W, W).
        targets: ∫ φ c dt, shape (B, W, m).
        inside: whether a window is inside its run, shape (B, W).
        inputs: the result of `inputs_at_nodes`, shape (B, P, m).
        spacing: the time between samples, shape ().
    """

    path: Float[np.ndarray, "B P Z"]
    roots: Float[np.ndarray, "B G Q k"]
    owner: Int[np.ndarray, " C"]
    values: Float[np.ndarray, "W P"]
    slopes: Float[np.ndarray, "W P"]
    overlap: Float[np.ndarray, "W W"]
    targets: Float[np.ndarray, "B W m"]
    inside: Bool[np.ndarray, "B W"]
    inputs: Float[np.ndarray, "B P m"]
    spacing: float

    def states(self) -> Float[np.ndarray, "N Z"]:
        """The path at all nodes of the windows inside the runs."""
        near = np.abs(self.values) > 0
        used = np.einsum("bw,wp->bp", self.inside, near) > 0
        return self.path[used]


class Smoothed(NamedTuple):
    """The pieces, and the results of the smoother.

    Attributes:
        pieces: the pieces.
        noise: the standard deviations of the noise of values and of slopes, shape (2, C), NaN where
            nothing was measured.
        states: the smoothed channels and their slopes at the samples of each run, shape (T, 2C).
        lengthscale: the shortest lengthscale of the channels, in units of time.
    """

    pieces: Pieces
    noise: Float[np.ndarray, "2 C"]
    states: list[Float[np.ndarray, "T n"]]
    lengthscale: float


def smoothed_pieces(runs: Runs, channels: Channels) -> Smoothed:
    """The runs cut into pieces. No window is longer than the median run.

    Args:
        runs: the runs, whose inputs are c.
        channels: the channels of these runs.

    Raises:
        ValueError: no run has 13 samples, or a channel is constant or was never measured.
    """
    times, C = runs.host_arrays()[0], channels.values[0].shape[1]
    if max(map(len, times)) < _FEWEST:
        raise ValueError(
            f"no run has the {_FEWEST} samples that weak rows need: log more of them, or pass "
            "velocities to hk.fit."
        )
    samples = _samples(times, channels)
    durations = [t[-1] - t[0] for t in times]
    half = _NODES // 2
    step = min(channels.width * samples.length, float(np.median(durations))) / _NODES
    W = int(np.clip(_ROWS // C, 2, _WINDOWS))
    centres = half * (1 + np.arange(W))
    P = half * (W + 1) + 1
    phi, slope = _bump((np.arange(P)[None] - centres[:, None]) / half)
    path, roots, inside, inputs, targets = [], [], [], [], []
    for r, (t, duration) in enumerate(zip(times, durations, strict=True)):
        # Windows of two pieces do not overlap, so we treat their errors as independent. 1e-9 allows
        # for rounding.
        count = (duration / step - 2 * half + 1e-9) // (half * (W + 1)) + 1
        for i in range(int(count)):
            at = t[0] + step * (half * (W + 1) * i + np.arange(P))
            z, errors = samples.path(r, at, 1 + channels.has_slopes)
            path.append(z)
            roots.append(errors)
            inside.append(at[centres + half] <= t[-1] + 1e-9 * step)
            inputs.append(inputs_at_nodes(runs.input_lines(r, at)))
            targets.append(_integrals(runs, r, at, centres, half * step, C))
    # We pad to a power of two, so that XLA does not recompile for other data.
    k = power_of_two(max(E.shape[1] for piece in roots for E in piece))
    is_inside = np.array(inside)
    pieces = Pieces(
        np.array(path)[:, :, : (1 + channels.has_slopes) * C],
        np.array([[np.pad(E, ((0, 0), (0, k - E.shape[1]))) for E in piece] for piece in roots]),
        np.array([next(i for i, g in enumerate(samples.sets) if c in g) for c in range(C)]),
        phi * step,
        slope / half,
        phi @ phi.T * step,
        np.where(is_inside[:, :, None], np.array(targets), 0.0),
        is_inside,
        np.array(inputs),
        float(np.median(np.concatenate([np.diff(t) for t in times]))),
    )
    along = [
        np.concatenate(
            [samples.path(r, at)[0] for at in np.array_split(t, -(-len(t) // _TOGETHER))]
        )
        for r, t in enumerate(times)
    ]
    return Smoothed(pieces, samples.noise, along, samples.length)


class _Samples(NamedTuple):
    """Samples of the channels and of their slopes, averaged if the sampling is fast.

    Attributes:
        times: the times of each run, shape (T,).
        both: the samples, NaN where nothing was measured, shape (T, 2, C).
        counts: the number of samples in each mean, shape (T, 2, C).
        coordinates: the process of each channel.
        noise: the standard deviations of the noise of one sample, shape (2, C).
        sets: indices of the channels with one process that were measured at the same times.
        length: the shortest lengthscale.
    """

    times: list[np.ndarray]
    both: list[np.ndarray]
    counts: list[np.ndarray]
    coordinates: list[Coordinate]
    noise: Float[np.ndarray, "2 C"]
    sets: list[Int[np.ndarray, " g"]]
    length: float

    def path(
        self, r: int, at: Float[np.ndarray, " P"], orders: int = 0
    ) -> tuple[Float[np.ndarray, "P Z"], list[Float[np.ndarray, "Q k"]]]:
        """Channels and slopes of run r at the times `at`, and a root of the covariance of each set.

        The covariance is of the values if `orders` is 1, and of values and slopes if it is 2. There
        are no roots if `orders` is 0.
        """
        t, reach = self.times[r], _MARGIN * self.length
        near = (t >= at[0] - reach) & (t <= at[-1] + reach)
        C, Q = len(self.coordinates), orders * len(at)
        out, roots = np.zeros((len(at), 2 * C)), []
        for g in self.sets:
            variance = self.noise[:, g] ** 2 / np.maximum(self.counts[r][near][:, :, g], 1)
            samples = t[near], self.both[r][near][:, :, g], variance[:, :, 0]
            mean, S = _posterior_path(self.coordinates[g[0]].process, *samples, at, orders > 0)
            out[:, g], out[:, C + g] = np.split(mean, 2)
            roots += [] if S is None else [_root(S[:Q, :Q])]
        return out, roots


def _samples(times: list[np.ndarray], channels: Channels) -> _Samples:
    """The samples; if a lengthscale has many more than 60, means over ℓ/60."""
    coordinates, noise = _processes(times, channels)
    length = min(c.lengthscale for c in coordinates)
    both = [np.stack(pair, axis=1) for pair in zip(channels.values, channels.slopes, strict=True)]
    counts = [np.isfinite(x).astype(float) for x in both]
    C, block = len(coordinates), length / _SAMPLES
    if any(2 * np.median(np.diff(t)) < block for t in times):
        paths = smooth_runs(coordinates, times, channels.values)
        means = []
        for r, (t, x) in enumerate(zip(times, both, strict=True)):
            z = np.concatenate([paths.value[r, : len(t)], paths.slope[r, : len(t)]], axis=1)
            slopes = np.gradient(z, t, axis=0)
            means.append(condense(t, x.reshape(len(t), -1), z, slopes, block)[:3])
        times, both, counts = (list(column) for column in zip(*means, strict=True))
        both, counts = ([x.reshape(-1, 2, C) for x in runs] for runs in (both, counts))
    sets = list(channels.groups)
    if any((x[:, :, g] != x[:, :, g[:1]]).any() for x in counts for g in sets):
        sets = [np.array([c]) for c in range(C)]
    return _Samples(times, both, counts, coordinates, noise, sets, length)


def _processes(times, channels: Channels) -> tuple[list[Coordinate], Float[np.ndarray, "2 C"]]:
    """The process of each channel, and the noise of values and slopes."""
    coordinates = processes(times, channels.values, channels.groups, channels.slopes)
    for c, coordinate in enumerate(coordinates):
        if not np.isfinite(coordinate.process.log_amplitude):
            said = "does not move" if coordinate.measured else "is missing"
            raise ValueError(f"position {c} {said}.")
    noise = np.array([[c.noise for c in coordinates], [c.slope_noise for c in coordinates]])
    if channels.noise is not None:
        noise = np.where(np.isnan(noise), np.nan, channels.noise)
        coordinates = [
            c._replace(process=c.process._replace(log_noise=jnp.log(jnp.asarray(s))))
            for c, s in zip(coordinates, noise[0], strict=True)
        ]
    return coordinates, noise


def _bump(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """φ = (1 − s²)⁵ and dφ/ds for −1 < s < 1; 0 outside."""
    rest = np.maximum(1 - s**2, 0.0)
    return rest**5, -10 * s * rest**4


def inputs_at_nodes(lines: Float[np.ndarray, "P-1 2 m"]) -> Float[np.ndarray, "P m"]:
    """Values u_p for which Σ g_p u_p is the integral of g u over the step, for a smooth g.

    The means of u, weighted with the linear interpolants of the nodes, are right for a linear g
    even if u jumps. The second difference removes their error u″/12 of a smooth u.
    """
    first, last = lines[:, 0], lines[:, 1]
    means = np.pad(first / 3 + last / 6, ((0, 1), (0, 0)))
    means[1:] += first / 6 + last / 3
    means[1:-1] -= np.diff(means, 2, axis=0) / 12
    return means


def _integrals(runs, r: int, at, centres, half_width: float, m: int) -> Float[np.ndarray, "W m"]:
    """∫ φ u dt of the inputs u of run r, as lines between the nodes `at`."""
    lines = runs.input_lines(r, at)
    if lines.shape[2] == 0:
        return np.zeros((len(centres), m))
    x, weights = np.polynomial.legendre.leggauss(4)
    share = (1 + x) / 2
    step = at[1] - at[0]
    inside = at[:-1, None] + step * share[None]
    u = lines[:, None, 0] + share[None, :, None] * (lines[:, 1] - lines[:, 0])[:, None]
    phi = _bump((inside[None] - at[centres][:, None, None]) / half_width)[0]
    return np.einsum("wpg,pgm,g->wm", phi, u, weights / 2 * step)


def _covariances(process: Process, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """k, dk/dt and −d²k/dt² of the Matérn-7/2 process at the time differences `gaps`."""
    variance, rate = np.exp(2 * float(process.log_amplitude)), np.exp(float(process.log_rate))
    u = rate * np.abs(gaps)
    decay = variance * np.exp(-u)
    first = -np.sign(gaps) * rate * decay * (u + u**2 + u**3 / 3) / 5
    second = rate**2 * decay * (1 + u - u**3 / 3) / 5
    return decay * (1 + u + 0.4 * u**2 + u**3 / 15), first, second


def _posterior_path(
    process: Process,
    t: Float[np.ndarray, " T"],
    x: Float[np.ndarray, "T 2 c"],
    variance: Float[np.ndarray, "T 2"],
    at: Float[np.ndarray, " P"],
    has_errors: bool = True,
) -> tuple[Float[np.ndarray, "Q c"], Float[np.ndarray, "Q Q"] | None]:
    """The posterior means of channels and slopes at the times `at`, and their covariance.

    All c channels were measured at the same times, so they have one covariance; None without
    `has_errors`. `variance` is the noise variance of each sample.
    """
    from scipy.linalg import cho_factor, cho_solve  # here, so that hamkernel imports faster

    is_value, is_slope = np.isfinite(x[:, :, 0]).T
    y = x[is_value, 0]
    centre = y.mean(axis=0) if len(y) else np.zeros(x.shape[2])

    def joint(a0, a1, b0, b1):
        blocks = [[_covariances(process, a[:, None] - b[None]) for b in (b0, b1)] for a in (a0, a1)]
        return np.block([[blocks[0][0][0], -blocks[0][1][1]], [blocks[1][0][1], blocks[1][1][2]]])

    samples = t[is_value], t[is_slope]
    K = joint(*samples, *samples)
    K[np.diag_indices_from(K)] += np.append(variance[is_value, 0], variance[is_slope, 1])
    factor = cho_factor(K)
    cross = joint(at, at, *samples)
    mean = cross @ cho_solve(factor, np.concatenate([y - centre[None], x[is_slope, 1]]))
    mean[: len(at)] += centre[None]
    S = joint(at, at, at, at) - cross @ cho_solve(factor, cross.T) if has_errors else None
    return mean, S


def _root(S: Float[np.ndarray, "Q Q"]) -> Float[np.ndarray, "Q k"]:
    """E with E Eᵀ ≈ S, without 1e-6 of the trace of the correlation matrix."""
    unit = np.sqrt(np.maximum(np.diagonal(S), np.finfo(float).tiny))
    squares, V = np.linalg.eigh(S / unit[:, None] / unit[None])
    squares, V = np.maximum(squares[::-1], 0.0), V[:, ::-1]
    k = int(np.searchsorted(np.cumsum(squares), (1 - 1e-6) * squares.sum())) + 1
    return unit[:, None] * V[:, :k] * np.sqrt(squares[:k])


def weak_rows(law: Law, pieces: Pieces) -> Float[Array, "B W m *r"]:
    """∫ (φ b − φ̇ a) dt for each window; the law returns the features (a, b) at a point z."""

    @jax.checkpoint  # else reverse mode stores the derivatives at all nodes
    def piece_result(path):
        a, b = jax.vmap(law)(path)
        values = jnp.einsum("wp,pi...->wi...", pieces.values, b)
        return values - jnp.einsum("wp,pi...->wi...", pieces.slopes, a)

    rows = jax.lax.map(piece_result, jnp.asarray(pieces.path))
    inside = jnp.asarray(pieces.inside)
    return jnp.where(inside.reshape(*inside.shape, *(1,) * (rows.ndim - 2)), rows, 0.0)


def path_covariance(law: Law, pieces: Pieces) -> Float[Array, "B R R"]:
    """D S Dᵀ of the R = W m rows of each piece, for a law with known weights and m components."""
    C, P = len(pieces.owner), pieces.path.shape[1]
    Z = C * pieces.roots.shape[2] // P  # without the inputs, which are known

    def piece_result(piece):
        path, roots = piece
        # One node at a time: its derivatives have the kernels of a law in common.
        slopes_a, slopes_b = jax.lax.map(jax.jacfwd(law), path)  # (P, m, Z)

        def add(total, c):
            D = [
                jnp.einsum("wp,pi->wip", pieces.values, slopes_b[:, :, c + shift])
                - jnp.einsum("wp,pi->wip", pieces.slopes, slopes_a[:, :, c + shift])
                for shift in range(0, Z, C)
            ]
            D = jnp.concatenate(D, axis=2)
            E = D.reshape(-1, D.shape[2]) @ roots[jnp.asarray(pieces.owner)[c]]
            return total + E @ E.T, None

        R = len(pieces.values) * slopes_a.shape[1]
        return jax.lax.scan(add, jnp.zeros((R, R), path.dtype), jnp.arange(C))[0]

    return jax.lax.map(piece_result, (jnp.asarray(pieces.path), jnp.asarray(pieces.roots)))


def factors(
    pieces: Pieces, covariance: Float[Array, "B R R"], deviation: Float[Array, " m"]
) -> Float[Array, "B R R"]:
    """The Cholesky factors of the covariance of the rows of each piece.

    Errors of the path and white noise of c contribute. `deviation` is the standard deviation of c
    at each sample. The rows of windows outside the runs have the identity.
    """
    white = jnp.asarray(pieces.overlap) * pieces.spacing
    white = jnp.kron(white, jnp.diag(jnp.square(deviation)))
    on = jnp.repeat(jnp.asarray(pieces.inside), len(deviation), axis=1)
    one = jnp.eye(len(white), dtype=covariance.dtype)
    C = jnp.where(on[:, :, None] & on[:, None], covariance + white[None], one[None])
    return jax.lax.map(jnp.linalg.cholesky, C)


def whiten(factors: Float[Array, "B R R"], rows: Float[Array, "B W m *r"]) -> Float[Array, "N *r"]:
    """The rows divided by the Cholesky factors, so that their errors are independent N(0, 1)."""
    B, R, _ = factors.shape
    done = jax.lax.map(
        lambda both: solve_triangular(*both, lower=True), (factors, rows.reshape(B, R, -1))
    )
    return done.reshape(B * R, *rows.shape[3:])


def log_scale(factors: Float[Array, "B R R"]) -> Float[Array, ""]:
    """The sum of the logarithms of the diagonals of the Cholesky factors."""
    return jnp.log(jnp.diagonal(factors, axis1=1, axis2=2)).sum()
