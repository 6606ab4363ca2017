"""Where hyperparameters are looked for at first: their bounds, and a design of points."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hamkernel._trajectories.likelihood import Bounds, Model
from hamkernel._tuning.space import gram_trace, hyperparameters

# Noise to begin with, of the standard deviations, besides that of smoothing. With five samples a
# swing smoothing cannot know it: it found none at all in 3 of 5 logs with noise of 8 %.
_NOISES = (0.01, 0.1)

# Process noise to begin with, of the accelerations, and how far it may go: what is three times the
# motion moves everything, and a millionth of it nothing.
_DISTURBANCES = (1e-4, 1e-2, 0.1)
_LEAST_DISTURBANCE, _MOST_DISTURBANCE = 1e-6, 3.0


def bounds_and_design(
    model: Model,
    X: np.ndarray,
    Y: np.ndarray,
    scale: np.ndarray,
    moves: np.ndarray,
    spacing: float = 0.0,
    impulse: np.ndarray | None = None,
) -> tuple[Bounds, np.ndarray]:
    """The box of all hyperparameters, those of the caller inside, and a design of first points.

    Args:
        model: the caller's kernel and the noise of the smoothed runs.
        X: states, with inputs the points (x, u).
        Y: their velocities.
        scale: the standard deviations of the coordinates.
        moves: the coordinates whose noise is looked for.
        spacing: the least lengthscale, in standard deviations of the coordinates.
        impulse: the noise of the process that would be all of the motion, shape (n,); −inf where
            it is not looked for. None where it is nowhere.
    """
    speed = float(np.sqrt(np.mean(Y**2)))
    leaves = hyperparameters(model.kernel, jnp.asarray(X), speed, jnp.asarray(X))
    start = np.asarray(model.flat)[: -len(scale)]  # without the noise of the process
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
    if spacing > 0:
        least = np.append(_least_lengths(leaves, X, scale, spacing), scale)
        low[lengths] = np.clip(least, low, high - 0.1)[lengths]
        start = np.clip(start, low, high)
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
    if impulse is None:
        noisy, process = np.concatenate(noisy), np.asarray(model.log_process)[None]
        impulse = np.full(len(scale), -np.inf)
    else:
        levels = [impulse + np.log(share) for share in _DISTURBANCES]
        kept = np.where(np.isfinite(impulse), levels, np.asarray(model.log_process))
        noisy, process = np.repeat(design, len(kept), axis=0), np.tile(kept, (len(design), 1))
    design = np.clip(noisy, low, high)
    process = np.broadcast_to(process, (len(design), len(scale)))
    looked = np.isfinite(impulse)
    # Of what is not free neither the box nor a step matters.
    least, most = (
        np.where(looked, impulse + np.log(share), 0.0)
        for share in (_LEAST_DISTURBANCE, _MOST_DISTURBANCE)
    )
    pairs = (low, least), (high, most), (free, looked)
    return Bounds(*map(np.concatenate, pairs)), np.concatenate([design, process], axis=1)


def _least_lengths(leaves, X, scale, spacing: float) -> Float[np.ndarray, " P"]:
    """The logarithm of `spacing` in units of the coordinates, or of the smallest of them."""
    spread = X.std(axis=0)
    spread[: len(scale)] = scale
    each = [
        spread if p.low.size == len(spread) else np.full(p.low.size, scale.min()) for p in leaves
    ]
    return np.log(spacing * np.maximum(np.concatenate(each), np.finfo(float).tiny))


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
    full = jnp.concatenate([jnp.asarray(h), model.log_process])
    trace = float(gram_trace(model.at(full).kernel, jnp.asarray(X))) / len(X)
    target = 4 * np.mean(np.sum(Y**2, axis=1))
    out = h.copy()
    if np.isfinite(trace) and trace > 0 and target > 0:
        out[scales] += np.log(target / trace)
    return out
