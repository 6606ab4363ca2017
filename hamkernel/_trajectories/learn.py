"""`learn`: from noisy states at times to a field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._trajectories.evidence import (
    Box,
    Model,
    Solution,
    losses,
    most_likely,
    solved,
    whitening,
)
from hamkernel._trajectories.flow import Expansion, steps_for
from hamkernel._trajectories.prepared import Prepared, check_identifiable, prepared
from hamkernel._trajectories.rows import Rows, Segments
from hamkernel._trajectories.runs import Runs
from hamkernel._trajectories.shooting import (
    LONG,
    SHORT,
    Piece,
    Shot,
    cuts,
    halved,
    rows_along,
    segmented,
    shot,
    trusted,
)
from hamkernel._trajectories.start import (
    box_of,
    landmarks,
    sampled,
    smooth_rows,
    with_amplitude,
)

_WIDE = 100.0  # standard deviations of the states: the prior of a start
_ROUNDS = 4  # Levenberg steps before a segment is judged
_SEARCH = 25  # steps of BFGS, which go on in the next iteration
_MOST = 10  # iterations
_SETTLED = 0.01  # of log σ, and of the objective by degree of freedom


class Current(NamedTuple):
    """Where learning stands."""

    model: Model
    field: Expansion
    paths: list[np.ndarray]  # of each run at its samples
    free: float  # degrees of freedom that are left


class Task(NamedTuple):
    """What does not change while learning."""

    data: Prepared
    mean: Any
    S: Float[Array, "m n"]
    box: Box
    spread: Float[Array, " n"]


def begin(task: Task, model: Model, design: np.ndarray) -> tuple[Current, np.ndarray]:
    """INT: one closed form along the smoothed runs; and which runs it explains."""
    runs = task.data.runs
    pieces = cuts(runs, SHORT)
    segments = segmented(runs, pieces, [run.path for run in runs])
    real = np.arange(len(segments.starts)) < len(pieces)
    rows = smooth_rows(task.data, pieces, segments, task.mean, real)
    values = np.asarray(losses(model, jnp.asarray(design), task.S, rows, task.spread))
    model = model.at(jnp.asarray(design[int(np.argmin(values))]))
    model, _ = most_likely(model, task.S, rows, task.spread, task.box, _SEARCH)
    found = solved(model.kernel, model.log_noise, task.S, rows, task.spread)
    field = Expansion(model.kernel, task.S, found.coefficients, task.mean)
    return Current(model, field, [run.path for run in runs], float(found.free)), real


def iterated(task: Task, now: Current, pieces: list[Piece]) -> tuple[Current, dict[str, Any], np.ndarray]:
    """GN: one linearisation along the current field, one closed form, one line search."""
    runs = task.data.runs
    segments = segmented(runs, pieces, now.paths)
    steps = jnp.asarray(steps_for(np.asarray(segments.spans), _stiffness(now.field, now.paths)))
    log_noise = now.model.log_noise
    before = shot(now.field, segments, log_noise, task.spread, steps, segments.starts, _ROUNDS)
    good = trusted(before, segments)
    if not good.any():
        return now, {"samples": _longest(pieces), "kept": 0.0, "step": 0.0}, good
    rows = rows_along(now.field, before.path, segments, jnp.asarray(good))
    model, loss = most_likely(now.model, task.S, rows, task.spread, task.box, _SEARCH)
    found = solved(model.kernel, model.log_noise, task.S, rows, task.spread)
    # The current field in the new basis, by what it says of the same rows.
    known = rows._replace(target=rows.along, displaced=jnp.zeros_like(rows.displaced))
    old = solved(model.kernel, model.log_noise, task.S, known, task.spread).weights
    T = _whitening(model.kernel, task.S)

    def objective(weights, starts):
        coefficients = (T @ weights).reshape(task.S.shape)
        field = Expansion(model.kernel, task.S, coefficients, task.mean)
        there = shot(field, segments, model.log_noise, task.spread, steps, starts, _ROUNDS)
        squares = np.asarray(there.squares)[good]
        return float(squares.sum() + weights @ weights), field, there

    first, field, after = objective(old, before.starts)
    best, share = first, 0.0
    for t in (1.0, 0.5, 0.25, 0.125, 0.0625):
        weights = (1 - t) * old + t * found.weights
        value, candidate, there = objective(weights, before.starts + t * found.moves)
        if value < best:
            best, share, field, after = value, t, candidate, there
            break
    paths = [p.copy() for p in now.paths]
    for s, (r, start, stop) in enumerate(pieces):
        if np.isfinite(after.squares[s]) and good[s]:
            paths[r][start:stop] = np.asarray(after.path.x[s, : stop - start])
    kept = sum(p.stop - p.start for p, g in zip(pieces, good, strict=False) if g)
    note = {
        "samples": _longest(pieces),
        "objective": best,
        "gain": first - best,
        "step": share,
        "noise": np.exp(np.asarray(model.log_noise)),
        "kept": kept / sum(len(run.times) for run in runs),
        "loss": loss,
    }
    return Current(model, field, paths, float(found.free)), note, good


def _longest(pieces: list[Piece]) -> int:
    return max(piece.stop - piece.start for piece in pieces)


_whitening = eqx.filter_jit(whitening)


@eqx.filter_jit
def _norms(field, X):
    return jax.vmap(lambda x: jnp.linalg.norm(jax.jacfwd(field)(x)))(X)


def _stiffness(field: Expansion, paths: list[np.ndarray]) -> float:
    """‖Df‖ along the paths, but for the largest twentieth."""
    X = np.concatenate(paths)
    X = X[np.linspace(0, len(X) - 1, 256).round().astype(int)]
    return float(np.nanquantile(np.asarray(_norms(field, jnp.asarray(X))), 0.95))


def learn(K: AbstractMatrixKernel, runs: Runs, mean=None, noise=None, solver=None, progress=False):
    K = with_amplitude(matrix_kernel(K))
    check_identifiable(runs, mean)
    mean = None if mean is None else as_pytree(mean)
    data = prepared(runs, mean)
    X, Y = sampled(data)
    if mean is not None:
        Y = Y - np.asarray(jax.vmap(mean)(jnp.asarray(X)))
    n = len(data.scale)
    S = landmarks(X, data.scale, getattr(solver, "max_points", None))
    level = np.where(np.isfinite(data.noise), data.noise, data.scale)
    level = np.maximum(level, 1e-7 * data.scale)
    moves = np.isfinite(data.noise)
    if noise is not None:
        level, moves = np.broadcast_to(np.asarray(noise, float), (n,)), np.zeros(n, bool)
    model = Model(K, jnp.asarray(np.log(level)))
    box, design = box_of(model, X, Y, data.scale, moves)
    task = Task(data, mean, S, box, jnp.asarray(_WIDE * data.scale))
    now, _ = begin(task, model, design)
    history = []
    converged = False
    for i in range(_MOST):
        if i <= 2:
            pieces = cuts(data.runs, SHORT if i < 2 else LONG)
        before = now.model.log_noise
        now, note, good = iterated(task, now, pieces)
        history.append(note)
        settled = np.abs(np.asarray(now.model.log_noise - before)).max() < _SETTLED
        split = halved(pieces, good[: len(pieces)])
        if i >= 2 and settled and note["gain"] < _SETTLED * now.free and split == pieces:
            converged = True
            break
        pieces = split
    return now, history, converged
