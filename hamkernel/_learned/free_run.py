"""Free runs: predictions of a field from one state, without use of later samples."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hamkernel._runs.flow import integrate, steps_for, stiffness
from hamkernel._runs.smoothing import power_of_two


class Stretches(NamedTuple):
    """Stretches of runs over which a field runs freely, padded with intervals of no length.

    Attributes:
        starts: the states at the starts of the stretches, shape (S, n).
        spans: the lengths of the intervals, shape (S, L).
        inputs: the inputs at both ends of each interval, shape (S, L, 2, m).
        measured: the samples at the ends of the intervals, NaN where there are none, (S, L, n).
    """

    starts: Float[np.ndarray, "S n"]
    spans: Float[np.ndarray, "S L"]
    inputs: Float[np.ndarray, "S L 2 m"]
    measured: Float[np.ndarray, "S L n"]


def stretches_of_swings(
    runs: list, paths: list[np.ndarray], swing: float, count: float = 2.0
) -> Stretches:
    """Stretches over `count` swings, of 4 to 64 intervals, that cover the condensed runs."""
    spacing = np.median(np.concatenate([np.diff(run.times) for run in runs]))
    return stretches(runs, paths, int(np.clip(count * swing / spacing, 4, 64)))


def stretches(runs: list, paths: list[np.ndarray], length: int) -> Stretches:
    """Stretches of `length` intervals that cover the condensed runs, from states of their paths."""
    parts = []
    for run, path in zip(runs, paths, strict=True):
        for first in range(0, len(path) - 1, length):
            stop = min(first + length, len(path) - 1)
            spans = np.diff(run.times[first : stop + 1])
            measured = run.states[first + 1 : stop + 1]
            parts.append((path[first], spans, run.inputs[first:stop], measured))
    return pad_stretches(parts)


def pad_stretches(parts: list[tuple]) -> Stretches:
    """Stretches (start, spans, inputs, measured) of different lengths in arrays of one shape."""
    L = power_of_two(max(len(spans) for _, spans, _, _ in parts))
    starts, spans, inputs, measured = [], [], [], []
    for start, own_spans, own_inputs, own_measured in parts:
        missing = L - len(own_spans)
        starts.append(start)
        spans.append(np.pad(own_spans, (0, missing)))
        inputs.append(np.pad(own_inputs, ((0, missing), (0, 0), (0, 0)), "edge"))
        measured.append(np.pad(own_measured, ((0, missing), (0, 0)), constant_values=np.nan))
    return Stretches(*map(np.array, (starts, spans, inputs, measured)))


def predictions(
    field: Any, part: Stretches, scale: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "S L n"]:
    """The states that the field predicts at the ends of the intervals; inf if they diverge.

    Args:
        field: a function of the points (x, u).
        part: the stretches.
        scale: the standard deviations of the coordinates.
    """
    ends = np.concatenate([part.starts, part.inputs[:, 0, 0]], axis=1)
    steps = steps_for(part.spans, stiffness(field, ends, scale))
    path = integrate(field, *jax.device_put((part.starts, part.spans, steps, part.inputs)))
    x = np.asarray(path.x)[:, 1:]
    return np.where(np.isfinite(x), x, np.inf)


def error_over_constant(field: Any, part: Stretches, scale: Float[np.ndarray, " n"]) -> float:
    """The RMS error of free runs over that of a constant, in standard deviations.

    The constant is the state at the start of the stretch or the mean of its samples, whichever is
    nearer. Each error counts as at most three standard deviations, so that one path that diverges
    does not decide.
    """
    return relative_error(predictions(field, part, scale), part, scale)


def relative_error(
    predicted: Float[np.ndarray, "S L n"], part: Stretches, scale: Float[np.ndarray, " n"]
) -> float:
    """The RMS error of predicted states over that of a constant, as `error_over_constant`."""
    measured = part.measured / scale
    finite = np.isfinite(measured)
    if not finite.any():
        return 0.0
    predicted = predicted / scale
    error = np.clip(np.where(finite, predicted - measured, 0.0), -3, 3)
    count = np.maximum(finite.sum(axis=1, keepdims=True), 1)
    mean = np.where(finite, measured, 0.0).sum(axis=1, keepdims=True) / count
    constants = (part.starts[:, None] / scale, mean)
    least = min(float((np.where(finite, measured - c, 0.0) ** 2).sum()) for c in constants)
    with np.errstate(over="ignore"):  # runs at rest, of which a constant misses nothing
        return float(np.sqrt((error**2).sum() / max(least, np.finfo(float).tiny)))
