"""Every coordinate of the runs as a Gaussian process in time, with its own hyperparameters."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._show import described
from hamkernel._trajectories.descent import minimise
from hamkernel._trajectories.padding import cut, padded
from hamkernel._trajectories.smoother import Process, Smoothed, negative_log_likelihood, smooth

# For the hyperparameters long runs are cut into pieces, which are filtered side by side, and of
# many pieces some are taken: 100 000 samples then cost as much as 16 000.
_PIECE, _PIECES = 256, 64


class Coordinate(NamedTuple):
    """A process of one coordinate in the units of the states.

    `seen` is False where the coordinate was never measured; the rest is NaN then.
    """

    process: Process
    seen: bool

    @property
    def noise(self) -> float:
        return float(np.exp(self.process.log_noise))

    @property
    def lengthscale(self) -> float:
        """ℓ in units of time, that of a Matérn kernel."""
        return float(np.sqrt(7.0) * np.exp(-self.process.log_rate))


def centred(states: Sequence[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The states less the mean of each run, and those means, shape (R, n)."""
    means = np.array([_mean(x) for x in states])
    return [x - mean[None] for x, mean in zip(states, means, strict=True)], means


def _mean(x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " n"]:
    seen = np.isfinite(x)
    return np.where(seen, x, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)


def processes(times: Sequence[np.ndarray], states: Sequence[np.ndarray]) -> list[Coordinate]:
    """The hyperparameters of each coordinate, by the marginal likelihood of all runs."""
    states = centred(states)[0]
    pieces_t, pieces_x = cut(times, states, _PIECE)
    if len(pieces_t) > _PIECES:
        chosen = np.linspace(0, len(pieces_t) - 1, _PIECES).round().astype(int)
        pieces_t, pieces_x = [pieces_t[i] for i in chosen], [pieces_x[i] for i in chosen]
    pieces = padded(pieces_t, pieces_x)
    steps = np.diff(pieces.times, axis=1, prepend=0.0)
    longest = max(t[-1] - t[0] for t in times)
    spacing = np.median(np.concatenate([np.diff(t) for t in pieces_t if len(t) > 1]))
    return [
        _process(steps, pieces.states[:, :, c], pieces.seen[:, :, c], longest, spacing)
        for c in range(states[0].shape[1])
    ]


def _process(steps, y, seen, longest: float, spacing: float) -> Coordinate:
    scale = y[seen].std() if seen.any() else 0.0
    if not scale > 0:  # never measured, or constant
        nothing = Process(*(jnp.asarray(v) for v in (-np.inf, -np.log(longest), -np.inf)))
        return Coordinate(nothing, bool(seen.any()))
    # A swing of a hundred spans of the data looks like a line; one faster than half of a sample,
    # like noise. The noise is at least what the digits of the states leave.
    low = np.log([0.3, 0.03 / longest, 1e-7])
    high = np.log([1e3, 3.0 / spacing, 2.0])
    found = _found(jnp.asarray(steps), jnp.asarray(y / scale), jnp.asarray(seen), low, high)
    log_amplitude, log_rate, log_noise = np.asarray(found)
    shift = np.log(scale)
    return Coordinate(
        Process(*(jnp.asarray(v) for v in (log_amplitude + shift, log_rate, log_noise + shift))),
        True,
    )


@eqx.filter_jit
def _found(steps, y, seen, low, high) -> Float[Array, "3"]:
    """(log amplitude, log rate, log noise) by BFGS from the best point of a grid."""
    low, high = jnp.asarray(low, y.dtype), jnp.asarray(high, y.dtype)

    def loss(h):
        return negative_log_likelihood(Process(*h), steps, y, seen)

    rates = np.linspace(0.1, 0.95, 12)
    noises = np.log([1e-5, 1e-3, 1e-2, 0.1, 0.5])
    rate, noise = (each.ravel() for each in np.meshgrid(rates, noises))
    design = jnp.stack(
        [
            jnp.full(rate.shape, np.log(1.5), y.dtype),
            low[1] + (high[1] - low[1]) * jnp.asarray(rate, y.dtype),
            jnp.asarray(noise, y.dtype),
        ],
        axis=1,
    )
    values = jax.lax.map(loss, design, batch_size=12)
    values = jnp.where(jnp.isfinite(values), values, jnp.inf)
    count = jnp.maximum(seen.sum(), 1).astype(y.dtype)
    sizes = jnp.stack(
        [jnp.full_like(count, 0.2), jnp.full_like(count, 0.1), 1 / jnp.sqrt(2 * count)]
    )
    return minimise(loss, design[jnp.argmin(values)], low, high, sizes, steps=40)[0]


@eqx.filter_jit
def _smoothed(process: Process, steps, y, seen: Bool[Array, "R T"]) -> Smoothed:
    return jax.vmap(lambda dt, value, there: smooth(process, dt, value, there))(steps, y, seen)


class Paths(NamedTuple):
    """Smoothed runs, each entry of shape (R, T, n), in the units of the states and times."""

    value: Float[np.ndarray, "R T n"]
    slope: Float[np.ndarray, "R T n"]
    deviation: Float[np.ndarray, "R T n"]
    slope_deviation: Float[np.ndarray, "R T n"]


def smoothed(
    found: list[Coordinate], times: Sequence[np.ndarray], states: Sequence[np.ndarray]
) -> Paths:
    """All runs at all their times, padded; times without a measurement too.

    A coordinate that was never measured is NaN; one that is constant stays so.
    """
    states, means = centred(states)
    runs = padded(times, states)
    steps = np.diff(runs.times, axis=1, prepend=0.0)
    paths = Paths(*(np.zeros(runs.states.shape) for _ in Paths._fields))
    for c, coordinate in enumerate(found):
        if not np.isfinite(coordinate.process.log_amplitude):
            for path in paths:
                path[:, :, c] = 0.0 if coordinate.seen else np.nan
        else:
            one = _smoothed(
                coordinate.process, steps, runs.states[:, :, c], jnp.asarray(runs.seen[:, :, c])
            )
            for path, values in zip(paths, one, strict=True):
                path[:, :, c] = np.asarray(values)
        paths.value[: len(means), :, c] += means[:, None, c]
    return paths


class Smoothing(eqx.Module):
    """Runs smoothed one coordinate at a time, for a look at them; no field is asked.

    Attributes:
        times: of each run, shape (P,): its samples and what was asked for between them.
        states: the smoothed states there, shape (P, n); NaN where never measured.
        deviation: the standard deviation of each coordinate, the sensor noise left out, (P, n).
        noise: the standard deviation of the sensor noise of each coordinate, shape (n,).
    """

    times: tuple[Float[Array, " P"], ...]
    states: tuple[Float[Array, "P n"], ...]
    deviation: tuple[Float[Array, "P n"], ...]
    noise: Float[Array, " n"]

    def __repr__(self) -> str:
        return described(self)


def smoothing(times: Sequence[np.ndarray], states: Sequence[np.ndarray], between: int) -> Smoothing:
    """The runs at their samples and at so many times between each two."""
    found = processes(times, states)
    grids, wide = [], []
    for t, x in zip(times, states, strict=True):
        shares = np.arange(between + 1) / (between + 1)
        inside = t[:-1, None] + np.diff(t)[:, None] * shares[None]
        grids.append(np.append(inside.ravel(), t[-1]))
        spread = np.full((len(grids[-1]), x.shape[1]), np.nan)
        spread[:: between + 1] = x
        wide.append(spread)
    paths = smoothed(found, grids, wide)
    values, deviations = (
        tuple(jnp.asarray(a[r, : len(t)]) for r, t in enumerate(grids))
        for a in (paths.value, paths.deviation)
    )
    noise = jnp.asarray([c.noise if c.seen else np.nan for c in found])
    return Smoothing(tuple(jnp.asarray(t) for t in grids), values, deviations, noise)
