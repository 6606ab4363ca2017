"""Whether runs ask for process noise, and what it must gain.

The rows without it and with it are whitened differently, and their likelihoods can be compared.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._trajectories.iteration import End, evidence
from hamkernel._trajectories.kalman import SIGNIFICANT, innovations, whiten, whiteness
from hamkernel._trajectories.likelihood import (
    KernelRows,
    Model,
    WhitenedRows,
    landmark_whitening,
    limited_by_landmarks,
    losses,
    project_out_starts,
    searched,
)
from hamkernel._trajectories.preprocessing import Preprocessed, sampled
from hamkernel._trajectories.segments import LinearisedSegments


def impulses(K: AbstractMatrixKernel, S, Y, data: Preprocessed) -> Float[np.ndarray, " n"]:
    """The logarithm of the process noise that would move each coordinate as the field does.

    That is its velocity times the root of the time in which it does so. −inf where K moves nothing.
    """
    prior = np.asarray(KernelRows(S).rows(K, S)).reshape(len(S), len(data.scale), -1)
    velocity = np.sqrt(np.mean(Y**2, axis=0))
    whole = np.sqrt(np.mean(sampled(data)[1] ** 2, axis=0))
    time = np.median(data.scale / np.maximum(whole, np.finfo(float).tiny))
    with np.errstate(divide="ignore"):
        return np.where((prior != 0).any((0, 2)), np.log(velocity * np.sqrt(time)), -np.inf)


def landmark_spacing(X, S, scale: Float[np.ndarray, " n"]) -> float:
    """How far a point of X may be from all landmarks, in standard deviations.

    A field of shorter lengthscale has ripples between the landmarks.
    """
    spread = X.std(axis=0)
    spread[: len(scale)] = scale
    unit = np.where(spread > 0, spread, 1.0)
    A, B = X / unit, np.asarray(S) / unit
    squares = (A**2).sum(1)[:, None] + (B**2).sum(1)[None] - 2 * A @ B.T
    return float(np.sqrt(np.maximum(squares.min(axis=1), 0.0).max()))


def price(end: End, impulse: Float[np.ndarray, " n"]) -> float:
    """What process noise must gain in log p: Schwarz's ½ log N for each of its numbers."""
    return float(0.5 * np.isfinite(impulse).sum() * np.log(np.asarray(end.now.rows.counts).sum()))


def asks_for_process(end: End, impulse: Float[np.ndarray, " n"]) -> bool:
    """Whether anything says that the structure is not the whole truth.

    Iterations that did not settle, parts that were dropped, innovations that are not white, or rows
    that are likelier with process noise. Not where more landmarks would explain them: what a field
    on too few cannot say looks like process noise.
    """
    now, task = end.now, end.task
    given = now.field.points, now.rows, task.start_deviation
    if task.capped or limited_by_landmarks(now.model, *given, project_out_starts):
        return False
    if not (end.settled and now.good.all()):
        return True
    z = innovations(whitened_rows(now.model, *given), now.rows)
    if whiteness(z, np.asarray(now.rows.counts)) < SIGNIFICANT:
        return True
    shares = np.log([1e-3, 1e-2, 1e-1])
    design = [now.model.log_process, *(impulse + share for share in shares)]
    flat = np.tile(np.asarray(now.model.flat), (len(design), 1))
    flat[:, -len(impulse) :] = design
    part = searched(*given[:2])
    values = np.asarray(losses(now.model, jnp.asarray(flat), *part, task.start_deviation, whiten))
    return bool(values[0] - values.min() > price(end, impulse))


def likelier(without: End, process: End) -> End:
    """That of both whose rows are the likelier, process noise at its price."""
    more = price(process, np.asarray(process.now.model.log_process))
    return process if evidence(process) + more < evidence(without) else without


@eqx.filter_jit
def whitened_rows(model: Model, S, rows: LinearisedSegments, start_deviation) -> WhitenedRows:
    """The rows whitened with process noise, and M and r of the landmarks S."""
    return whiten(model, S, landmark_whitening(model.kernel, S), rows, start_deviation)
