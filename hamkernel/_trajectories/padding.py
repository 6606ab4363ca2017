"""Arrays of few shapes for runs of any length, so that other lengths do not compile anew."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class Padded(NamedTuple):
    """Runs side by side. Behind the end of a run its last time is repeated and nothing was seen.

    Attributes:
        times: since the first sample of the run, shape (R, T).
        states: zero where nothing was measured, shape (R, T, n).
        seen: what was measured.
        lengths: the samples of each run; 0 for a run that is padding.
    """

    times: Float[np.ndarray, "R T"]
    states: Float[np.ndarray, "R T n"]
    seen: Bool[np.ndarray, "R T n"]
    lengths: Int[np.ndarray, " R"]


def power_of_two(count: int) -> int:
    """The least power of two that is not below `count`."""
    return 1 << max(count - 1, 0).bit_length()


def padded(times: Sequence[np.ndarray], states: Sequence[np.ndarray]) -> Padded:
    """Runs of any lengths as arrays; T is a power of two, at least 8."""
    R = power_of_two(len(times))
    T = max(power_of_two(max(len(t) for t in times)), 8)
    n = states[0].shape[1]
    out = Padded(np.zeros((R, T)), np.zeros((R, T, n)), np.zeros((R, T, n), bool), np.zeros(R, int))
    for r, (t, x) in enumerate(zip(times, states, strict=True)):
        out.times[r] = t[-1] - t[0]
        out.times[r, : len(t)] = t - t[0]
        there = np.isfinite(x)
        out.states[r, : len(t)] = np.where(there, x, 0.0)
        out.seen[r, : len(t)] = there
        out.lengths[r] = len(t)
    return out


def cut(
    times: Sequence[np.ndarray], states: Sequence[np.ndarray], most: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The runs in pieces of at most `most` samples, of nearly equal lengths."""
    pieces_t, pieces_x = [], []
    for t, x in zip(times, states, strict=True):
        count = -(-len(t) // most)
        pieces_t += np.array_split(t, count)
        pieces_x += np.array_split(x, count)
    return pieces_t, pieces_x
