"""Every coordinate of the runs as a Gaussian process in time, with its own hyperparameters.

The kernel is Matérn-7/2, and a Kalman filter makes the cost linear in the number of samples.

With u = λ t and λ = √7/ℓ, the process and its first three derivatives in u obey a linear equation
driven by white noise, (d/du + 1)⁴ x = w. Between two samples the state has the transition matrix A
and the covariance P,

    A(u) = exp(−u) Σ_{j<4} (N u)ʲ/j!,      P ← P∞ + A (P − P∞) Aᵀ.

N is the companion matrix plus the identity and is nilpotent, so both formulas are exact for any
sampling interval.

We smooth by the recursion of Bryson & Frazier, backward in the adjoint (l, L): x = m − P l and
Cov = P − P L P. The recursion does not invert the predicted covariance, which is nearly singular if
samples are close. It needs no special case for padding, zero time steps or missing measurements.

Source: Hartikainen & Särkkä (2010), "Kalman filtering and smoothing solutions to temporal Gaussian
process regression models"; Bierman (1973) for the smoother.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hamkernel._machine import compiled_by_size, double_precision
from hamkernel._show import describe
from hamkernel._tuning.minimiser import best_in_box, inside_box


class Padded(NamedTuple):
    """Runs padded to one length: the last time is repeated, with nothing measured.

    Attributes:
        times: the times since the first sample of each run, shape (R, T).
        states: the samples; zero where nothing was measured, shape (R, T, n).
        measured: whether each entry of a state was measured, shape (R, T, n).
        lengths: the number of samples of each run, 0 for padding, shape (R,).
    """

    times: Float[np.ndarray, "R T"]
    states: Float[np.ndarray, "R T n"]
    measured: Bool[np.ndarray, "R T n"]
    lengths: Int[np.ndarray, " R"]


def power_of_two(count: int) -> int:
    """The least power of two that is not below `count`."""
    return 1 << max(count - 1, 0).bit_length()


def pad(times: Sequence[np.ndarray], states: Sequence[np.ndarray]) -> Padded:
    """Runs of any lengths as arrays; R and T are powers of two, and T is at least 8."""
    R = power_of_two(len(times))
    T = max(power_of_two(max(len(t) for t in times)), 8)
    n = states[0].shape[1]
    out = Padded(np.zeros((R, T)), np.zeros((R, T, n)), np.zeros((R, T, n), bool), np.zeros(R, int))
    for r, (t, x) in enumerate(zip(times, states, strict=True)):
        out.times[r] = t[-1] - t[0]
        out.times[r, : len(t)] = t - t[0]
        there = np.isfinite(x)
        out.states[r, : len(t)] = np.where(there, x, 0.0)
        out.measured[r, : len(t)] = there
        out.lengths[r] = len(t)
    return out


def cut(
    times: Sequence[np.ndarray], states: Sequence[np.ndarray], limit: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The runs in pieces of at most `limit` samples, of nearly equal lengths."""
    pieces_t, pieces_x = [], []
    for t, x in zip(times, states, strict=True):
        count = -(-len(t) // limit)
        pieces_t += np.array_split(t, count)
        pieces_x += np.array_split(x, count)
    return pieces_t, pieces_x


# The moments ∫ω^(2j) S(ω) dω of the spectral density S ∝ (1 + ω²)⁻⁴, of mass one, are 1, 1/5, 1/5
# and 1 for j = 0, …, 3.
_STATIONARY = np.array(
    [[1, 0, -0.2, 0], [0, 0.2, 0, -0.2], [-0.2, 0, 0.2, 0], [0, -0.2, 0, 1]], float
)
_nilpotent = np.eye(4) + np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [-1, -4, -6, -4]])
_powers = np.stack([np.linalg.matrix_power(_nilpotent, j) / f for j, f in enumerate((1, 1, 2, 6))])


class Process(NamedTuple):
    """The logarithms of the standard deviation of the signal, the rate λ, and the noise."""

    log_amplitude: Float[Array, ""]
    log_rate: Float[Array, ""]
    log_noise: Float[Array, ""]


class Smoothed(NamedTuple):
    """The posterior of one process at the times of its samples.

    Attributes:
        value: x(t), shape (T,).
        slope: ẋ(t).
        deviation: the standard deviation of x(t).
        slope_deviation: the standard deviation of ẋ(t).
    """

    value: Float[Array, " T"]
    slope: Float[Array, " T"]
    deviation: Float[Array, " T"]
    slope_deviation: Float[Array, " T"]


def _transition(u: Float[Array, ""]) -> Float[Array, "4 4"]:
    powers = jnp.cumprod(jnp.concatenate([jnp.ones(1, u.dtype), jnp.broadcast_to(u, (3,))]))
    return jnp.exp(-u) * jnp.tensordot(powers, jnp.asarray(_powers, u.dtype), 1)


def _stationary(process: Process) -> Float[Array, "4 4"]:
    dtype = process.log_rate.dtype
    return jnp.exp(2 * process.log_amplitude) * jnp.asarray(_STATIONARY, dtype)


def _filter(process: Process, steps, y, measured, slopes: Any = None):
    """The forward pass: arrays for the backward pass, and the terms of −2 log p, at each time.

    `steps` are the times since the previous sample, 0 for the first. `slopes` are samples of the
    derivative, a mask of the measured ones, and the logarithm of their noise. The backward pass
    does not use `slopes`.
    """
    stationary = _stationary(process)
    rate, one = jnp.exp(process.log_rate), jnp.ones_like(process.log_rate)

    def update(m, P, i, unit, sample, there, log_noise):
        row = unit * P[i]
        S = unit * row[i] + jnp.exp(2 * log_noise)
        error = jnp.where(there, sample - unit * m[i], jnp.zeros_like(sample))
        gain = jnp.where(there, row / S, jnp.zeros_like(row))
        loss = jnp.where(there, error**2 / S + jnp.log(2 * jnp.pi * S), jnp.zeros_like(S))
        return m + gain * error, P - gain[:, None] * row[None, :], S, error, loss

    def step(carry, sample):
        m, P = carry
        dt, value, there, *slope = sample
        A = _transition(jnp.exp(process.log_rate) * dt)
        m = A @ m
        P = stationary + A @ (P - stationary) @ A.T
        P = (P + P.T) / 2
        after, Q, S, error, loss = update(m, P, 0, one, value, there, process.log_noise)
        if slope:
            velocity, was_measured = slope
            after, Q, _, _, more = update(after, Q, 1, rate, velocity, was_measured, slopes[2])
            loss = loss + more
        return (after, Q), (m, P, S, error, A, loss)

    start = jnp.zeros(4, y.dtype), stationary
    _, out = jax.lax.scan(step, start, (steps, y, measured, *(slopes or ())[:2]))
    return out


def negative_log_likelihood(
    process: Process,
    steps: Float[Array, "R T"],
    y: Float[Array, "R T"],
    measured: Bool[Array, "R T"],
    slopes: Any = None,
) -> Float[Array, ""]:
    """−log p(y) of several independent runs; `steps` as in `smooth`, `slopes` as in `_filter`."""

    def one(dt, value, there, *slope):
        rates = (*slope, slopes[2]) if slope else None
        return _filter(process, dt, value, there, rates)[-1].sum()

    return 0.5 * jax.vmap(one)(steps, y, measured, *(slopes or ())[:2]).sum()


def smooth(
    process: Process, steps: Float[Array, " T"], y: Float[Array, " T"], measured: Bool[Array, " T"]
) -> Smoothed:
    """The posterior of the process given one run, at all its times, measured or not.

    Args:
        process: the hyperparameters.
        steps: the time since the previous sample, 0 for the first.
        y: the samples.
        measured: whether each sample was measured.
    """
    m, P, S, error, A, _ = _filter(process, steps, y, measured)

    # Let J be −log p(this sample and the later ones | m), l = ∂J/∂m and L = ∂²J/∂m². A sample maps
    # m to C m + … and adds error²/(2S) to J. An interval maps m to A m. The chain rule gives l and
    # L backward in time. Then E[x | y] = m − P l and Cov[x | y] = P − P L P, as in `kalman.py`.
    def step(carry, at):
        l, L = carry  # noqa: E741 - the adjoint, after the sample
        m, P, S, error, A, there = at
        on = there.astype(y.dtype)
        C = jnp.eye(4, dtype=y.dtype).at[:, 0].add(-on * P[0] / S)
        l = C.T @ l  # noqa: E741
        l = l.at[0].add(-on * error / S)  # noqa: E741
        L = C.T @ L @ C
        L = L.at[0, 0].add(on / S)
        value = m - P @ l
        covariance = P - P @ L @ P
        return (A.T @ l, A.T @ L @ A), (value[:2], jnp.diagonal(covariance)[:2])

    none = jnp.zeros(4, y.dtype), jnp.zeros((4, 4), y.dtype)
    _, (mean, variance) = jax.lax.scan(step, none, (m, P, S, error, A, measured), reverse=True)
    rate = jnp.exp(process.log_rate)
    deviation = jnp.sqrt(jnp.maximum(variance, jnp.zeros_like(variance)))
    return Smoothed(mean[:, 0], rate * mean[:, 1], deviation[:, 0], rate * deviation[:, 1])


class Coordinate(NamedTuple):
    """The process of one coordinate, in the units of the states.

    Attributes:
        process: the hyperparameters.
        measured: whether the coordinate was ever measured.
        slope_noise: the noise of samples of its derivative; NaN if there are none.
    """

    process: Process
    measured: bool
    slope_noise: float = np.nan

    @property
    def noise(self) -> float:
        return float(np.exp(self.process.log_noise))

    @property
    def lengthscale(self) -> float:
        """The lengthscale ℓ of the Matérn kernel, in units of time."""
        return float(np.sqrt(7.0) * np.exp(-float(self.process.log_rate)))


def subtract_means(states: Sequence[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The states minus the mean of each run, and the means, shape (R, n)."""
    means = np.array([_mean(x) for x in states])
    return [x - mean[None] for x, mean in zip(states, means, strict=True)], means


def _mean(x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " n"]:
    measured = np.isfinite(x)
    return np.where(measured, x, 0.0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)


@double_precision
def processes(
    times: Sequence[np.ndarray],
    states: Sequence[np.ndarray],
    groups: Sequence[np.ndarray] | None = None,
    slopes: Sequence[np.ndarray] | None = None,
) -> list[Coordinate]:
    """The hyperparameters of each coordinate, which maximise the marginal likelihood of all runs.

    Args:
        times: the times of each run, shape (T,).
        states: the states of each run, shape (T, n); NaN where nothing was measured.
        groups: indices of the coordinates that share one process; if None, each has its own.
        slopes: samples of the derivatives, shapes (T, n), NaN where nothing was measured; or None.
    """
    states, n = subtract_means(states)[0], states[0].shape[1]
    slopes = [np.full(x.shape, np.nan) for x in states] if slopes is None else slopes
    both = [np.concatenate(pair, axis=1) for pair in zip(states, slopes, strict=True)]
    # We filter at most 64 pieces of 256 samples in parallel, so the cost stops growing at 16 000
    # samples.
    pieces_t, pieces_x = cut(times, both, 256)
    if len(pieces_t) > 64:
        chosen = np.linspace(0, len(pieces_t) - 1, 64).round().astype(int)
        pieces_t, pieces_x = [pieces_t[i] for i in chosen], [pieces_x[i] for i in chosen]
    pieces = pad(pieces_t, pieces_x)
    steps = np.diff(pieces.times, axis=1, prepend=0.0)
    longest = max(t[-1] - t[0] for t in times)
    spacing = np.median(np.concatenate([np.diff(t) for t in pieces_t if len(t) > 1]))
    out: list[Any] = [None] * n
    for g in map(np.atleast_1d, range(n) if groups is None else groups):
        arrays: list[Any] = [
            a[:, :, c] for c in (g, n + g) for a in (pieces.states, pieces.measured)
        ]
        arrays = [a.swapaxes(1, 2).reshape(-1, a.shape[1]) for a in arrays]
        # At most 512 rows, 64 pieces of eight coordinates, determine the few hyperparameters.
        part = np.unique(np.linspace(0, len(arrays[0]) - 1, 512).round().astype(int))
        arrays = [a[part] for a in (np.repeat(steps, len(g), 0), *arrays)]
        dt, x, measured, v, measured_slope = arrays
        coordinate = _process(dt, x, measured, v, measured_slope, longest, spacing)
        for c in g:
            out[c] = coordinate._replace(measured=bool(pieces.measured[:, :, c].any()))
    return out


def _process(steps, y, measured, v, measured_slope, longest: float, spacing: float) -> Coordinate:
    scale = y[measured].std() if measured.any() else 0.0
    if not scale > 0:  # never measured, or constant
        nothing = Process(*(jnp.asarray(v) for v in (-np.inf, -np.log(longest), -np.inf)))
        return Coordinate(nothing, bool(measured.any()))
    # Bounds of (amplitude, rate, noise) in units of the data. A rate below .03/longest looks like a
    # line in the data, and a rate above 3/spacing like noise. The noise is at least the rounding.
    low, high = [0.3, 0.03 / longest, 1e-7], [1e3, 3.0 / spacing, 2.0]
    slopes = None
    if measured_slope.any():
        speed = (v[measured_slope].std() or 1.0) / scale
        low, high = [*low, 1e-7 * speed], [*high, 2.0 * speed]
        slopes = v / scale, measured_slope
    box = np.log(low), np.log(high)
    data = jax.device_put((steps, y / scale, measured, slopes, *box))
    log_amplitude, log_rate, *log_noise = np.asarray(_fit_process(*data))
    shift = np.log(scale)
    logs = log_amplitude + shift, log_rate, log_noise[0] + shift
    slope_noise = float(np.exp(log_noise[1] + shift)) if slopes else np.nan
    return Coordinate(Process(*jax.device_put(logs)), True, slope_noise)


@compiled_by_size
def _fit_process(steps, y, measured, slopes, low, high) -> Float[Array, " h"]:
    """The logs of amplitude, rate, noise and noise of slopes, by BFGS from the best of a grid."""
    low, high = jnp.asarray(low, y.dtype), jnp.asarray(high, y.dtype)

    def loss(h):
        rates = None if slopes is None else (*slopes, h[3])
        return negative_log_likelihood(Process(*h[:3]), steps, y, measured, rates)

    rates = np.linspace(0.1, 0.95, 12)
    noises = np.log([1e-5, 1e-3, 1e-2, 0.1, 0.5])
    rate, noise = (grid.ravel() for grid in np.meshgrid(rates, noises))
    columns = [
        jnp.full(rate.shape, np.log(1.5), y.dtype),
        low[1] + (high[1] - low[1]) * jnp.asarray(rate, y.dtype),
        jnp.asarray(noise, y.dtype),
    ]
    count = jnp.maximum(measured.sum(), 1).astype(y.dtype)
    sizes = [jnp.full_like(count, 0.2), jnp.full_like(count, 0.1), 1 / jnp.sqrt(2 * count)]
    if slopes is not None:  # in the grid the slopes have the same relative noise
        columns, sizes = [*columns, columns[2] + high[3] - high[2]], [*sizes, sizes[2]]
    design, sizes = jnp.stack(columns, axis=1), jnp.stack(sizes)
    run = best_in_box(loss, design, low, high, sizes, 40, batch_size=12)
    return inside_box(run.best.u, low, high)


@compiled_by_size
def _smooth_each(process: Process, steps, y, measured: Bool[Array, "R T"]) -> Smoothed:
    return jax.vmap(lambda dt, value, there: smooth(process, dt, value, there))(steps, y, measured)


class Paths(NamedTuple):
    """Smoothed runs: arrays of shape (R, T, n), in the units of the states and times."""

    value: Float[np.ndarray, "R T n"]
    slope: Float[np.ndarray, "R T n"]
    deviation: Float[np.ndarray, "R T n"]
    slope_deviation: Float[np.ndarray, "R T n"]


@double_precision
def smooth_runs(
    coordinates: list[Coordinate], times: Sequence[np.ndarray], states: Sequence[np.ndarray]
) -> Paths:
    """The smoothed paths of all runs at all their times, measured or not, with padding.

    A coordinate that was never measured is NaN. A constant coordinate stays constant.
    """
    states, means = subtract_means(states)
    runs = pad(times, states)
    steps = np.diff(runs.times, axis=1, prepend=0.0)
    paths = Paths(*(np.zeros(runs.states.shape) for _ in Paths._fields))
    for c, coordinate in enumerate(coordinates):
        if not np.isfinite(coordinate.process.log_amplitude):
            for path in paths:
                path[:, :, c] = 0.0 if coordinate.measured else np.nan
        else:
            one = _smooth_each(
                coordinate.process,
                steps,
                runs.states[:, :, c],
                jax.device_put(runs.measured[:, :, c]),
            )
            for path, values in zip(paths, one, strict=True):
                path[:, :, c] = np.asarray(values)
        paths.value[: len(means), :, c] += means[:, None, c]
    return paths


class Smoothing(eqx.Module):
    """Runs smoothed one coordinate at a time, without a field, for inspection.

    Attributes:
        times: the times of each run, shape (P,): its samples, and times between them.
        states: the smoothed states, shape (P, n); NaN for coordinates that were never measured.
        deviation: the posterior standard deviation without the sensor noise, shape (P, n).
        noise: the standard deviation of the sensor noise of each coordinate, shape (n,).
    """

    times: tuple[Float[Array, " P"], ...]
    states: tuple[Float[Array, "P n"], ...]
    deviation: tuple[Float[Array, "P n"], ...]
    noise: Float[Array, " n"]

    def __repr__(self) -> str:
        return describe(self)


def smoothing(times: Sequence[np.ndarray], states: Sequence[np.ndarray], between: int) -> Smoothing:
    """The smoothed runs at their samples and at `between` times between two samples."""
    coordinates = processes(times, states)
    grids, wide = [], []
    for t, x in zip(times, states, strict=True):
        shares = np.arange(between + 1) / (between + 1)
        inside = t[:-1, None] + np.diff(t)[:, None] * shares[None]
        grids.append(np.append(inside.ravel(), t[-1]))
        spread = np.full((len(grids[-1]), x.shape[1]), np.nan)
        spread[:: between + 1] = x
        wide.append(spread)
    paths = smooth_runs(coordinates, grids, wide)
    values, deviations = (
        tuple(jnp.asarray(a[r, : len(t)]) for r, t in enumerate(grids))
        for a in (paths.value, paths.deviation)
    )
    noise = jnp.asarray([c.noise if c.measured else np.nan for c in coordinates])
    return Smoothing(tuple(jnp.asarray(t) for t in grids), values, deviations, noise)


def interpolate(
    times: np.ndarray, at: np.ndarray, x: np.ndarray, slopes: np.ndarray
) -> Float[np.ndarray, "T n"]:
    """Hermite's cubic through the states x at the times `at`, with their velocities `slopes`."""
    i = np.clip(np.searchsorted(at, times) - 1, 0, len(at) - 2)
    h = (at[i + 1] - at[i])[:, None]
    s = ((times - at[i])[:, None]) / h
    return (
        (1 + 2 * s) * (1 - s) ** 2 * x[i]
        + s * (1 - s) ** 2 * h * slopes[i]
        + s**2 * (3 - 2 * s) * x[i + 1]
        + s**2 * (s - 1) * h * slopes[i + 1]
    )
