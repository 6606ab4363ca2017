"""One closed form along smoothed runs, and then Gauss-Newton steps along the current field."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._trajectories.evidence import Box, Model, losses, most_likely, solved, whitening
from hamkernel._trajectories.flow import Expansion, steps_for, with_tangent
from hamkernel._trajectories.judged import NEGLIGIBLE
from hamkernel._trajectories.learned import Step
from hamkernel._trajectories.prepared import Prepared
from hamkernel._trajectories.rows import Rows
from hamkernel._trajectories.shooting import (
    Piece,
    Shot,
    rows_along,
    segmented,
    short_cuts,
    shot,
    trusted,
)
from hamkernel._trajectories.start import smooth_rows

_ROUNDS = 4  # Levenberg steps before a segment is judged: without them up to 40 % were lost
_SEARCH = 25  # steps of BFGS, which go on in the next iteration
_SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of a step, until one makes the objective smaller


class Task(NamedTuple):
    """What does not change: the runs, the mean, landmarks, the box and the prior of starts."""

    data: Prepared
    mean: Any
    S: Float[Array, "m d"]
    box: Box
    spread: Float[Array, " n"]


class Current(NamedTuple):
    """Where learning stands.

    Attributes:
        model: kernel and noise.
        field: the field.
        rows: what it was learned from.
        paths: of each run at its samples.
        good: which pieces were kept.
        squares: the sum of their squared normalised residuals.
        free: the degrees of freedom that are left.
    """

    model: Model
    field: Expansion
    rows: Rows
    paths: list[np.ndarray]
    good: Bool[np.ndarray, " S"]
    squares: float
    free: float


def begin(task: Task, model: Model, design: np.ndarray) -> Current:
    """INT: rows along the smoothed runs, with the tangent of the mean.

    In short segments: the errors of the smoothed path add up along a run.
    """
    runs = task.data.runs
    paths = [run.path for run in runs]
    pieces = short_cuts(runs)
    segments = segmented(runs, pieces, paths)
    good = np.zeros(len(segments.starts), bool)
    good[: len(pieces)] = [task.data.usable[piece.run] for piece in pieces]
    rows = smooth_rows(task.data, pieces, segments, task.mean, good)
    values = np.asarray(losses(model, jnp.asarray(design), task.S, rows, task.spread))
    model = model.at(jnp.asarray(design[int(np.argmin(values))]))
    model, _ = most_likely(model, task.S, rows, task.spread, task.box, _SEARCH)
    found = solved(model.kernel, model.log_noise, task.S, rows, task.spread)
    field = Expansion(model.kernel, task.S, found.coefficients, task.mean)
    return Current(model, field, rows, paths, good[: len(pieces)], np.inf, float(found.free))


def iterated(task: Task, now: Current, pieces: list[Piece]) -> tuple[Current, Step]:
    """GN: one linearisation along the current field, one closed form, one line search."""
    runs = task.data.runs
    segments = segmented(runs, pieces, now.paths)
    count = steps_for(np.asarray(segments.spans), _stiffness(now.field, task.data, now.paths))
    steps = jnp.asarray(count)
    before = shot(
        now.field, segments, now.model.log_noise, task.spread, steps, segments.starts, _ROUNDS
    )
    least = NEGLIGIBLE * task.data.scale
    good = trusted(before, segments, np.exp(np.asarray(now.model.log_noise)), least)
    rows = rows_along(now.field, before.path, segments, jnp.asarray(good))
    model, loss = most_likely(now.model, task.S, rows, task.spread, task.box, _SEARCH)
    found = solved(model.kernel, model.log_noise, task.S, rows, task.spread)
    # The current field in the new basis, by what it says of the same rows.
    known = rows._replace(target=rows.along, displaced=jnp.zeros_like(rows.displaced))
    old = solved(model.kernel, model.log_noise, task.S, known, task.spread).weights
    T = _whitening(model.kernel, task.S)

    def trial(share: float) -> _Trial:
        weights = (1 - share) * old + share * found.weights
        field = Expansion(model.kernel, task.S, (T @ weights).reshape(len(task.S), -1), task.mean)
        starts = before.starts + share * found.moves
        there = shot(field, segments, model.log_noise, task.spread, steps, starts, _ROUNDS)
        squares = float(np.asarray(there.squares)[good].sum())
        return _Trial(squares + float(weights @ weights), squares, field, there)

    at_old = trial(0.0)
    taken, best = 0.0, at_old
    for share in _SHARES if good.any() else ():
        there = trial(share)
        if there.objective < best.objective:
            taken, best = share, there
            break
    good = good[: len(pieces)]
    paths = _updated(now.paths, pieces, good, best.shot)
    samples = sum(len(run.times) for run in runs)
    kept = sum(piece.stop - piece.start for piece, ok in zip(pieces, good, strict=True) if ok)
    gain = at_old.objective - best.objective
    numbers = (best.objective, gain if taken else 0.0, taken, kept / samples, loss)
    objective, gain, taken, kept, loss = (jnp.asarray(value) for value in numbers)
    longest = max(piece.stop - piece.start for piece in pieces)
    noise = jnp.exp(model.log_noise)
    step = Step(longest, objective, gain, taken, noise, kept, loss)
    free = float(found.free)
    return Current(model, best.field, rows, paths, good, best.squares, free), step


class _Trial(NamedTuple):
    objective: float
    squares: float
    field: Expansion
    shot: Shot


def _updated(paths, pieces: list[Piece], good, there: Shot) -> list[np.ndarray]:
    """The paths, those of the pieces that were kept along the field."""
    new, x = [path.copy() for path in paths], np.asarray(there.path.x)
    for s, (r, start, stop) in enumerate(pieces):
        if good[s] and np.isfinite(x[s]).all():
            new[r][start:stop] = x[s, : stop - start]
    return new


_whitening = eqx.filter_jit(whitening)


@eqx.filter_jit
def _norms(field, X: Float[Array, "N d"], scale: Float[Array, " n"]) -> Float[Array, " N"]:
    def norm(s):
        D = with_tangent(field, s, len(scale))[1]
        return jnp.linalg.norm(D * scale[None] / scale[:, None])

    return jax.vmap(norm)(X)


def _stiffness(field: Expansion, data: Prepared, paths: list[np.ndarray]) -> float:
    """‖∂f/∂x‖ in standard deviations along the paths, but for the largest twentieth."""
    X = np.concatenate([run.joined(path) for run, path in zip(data.runs, paths, strict=True)])
    X = X[np.linspace(0, len(X) - 1, 256).round().astype(int)]
    norms = np.asarray(_norms(field, jnp.asarray(X), jnp.asarray(data.scale)))
    return float(np.nanquantile(np.where(np.isfinite(norms), norms, 0.0), 0.95))


def changed(task: Task, before: Current, now: Current) -> float:
    """By how much the field has changed at the landmarks, relative to its size there."""
    old, new = (
        np.asarray(_values(each.field, task.S)) / task.data.scale[None] for each in (before, now)
    )
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))


_values = eqx.filter_jit(lambda field, S: jax.vmap(field)(S))
