"""Gauss-Newton steps: a linearisation, a closed form and a line search, again and again.

Without process noise a step is one of multiple shooting: the path solves the equation in each
segment, and the starts are projected out. With it the path is moved by the process too, and the
rows are whitened by a Kalman filter.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import compiled_by_size
from hamkernel._trajectories.diagnostics import SETTLED
from hamkernel._trajectories.flow import (
    Expansion,
    Segments,
    field_values,
    shoot,
    steps_for,
    stiffness,
    trusted,
)
from hamkernel._trajectories.kalman import (
    SmoothedPath,
    innovations,
    linearised_by_interval,
    process_covariance,
    smoothed_path,
    whiten,
    whitened_rows,
)
from hamkernel._trajectories.learned import Iteration
from hamkernel._trajectories.likelihood import (
    ClosedForm,
    Model,
    Whitening,
    agree,
    closed_form,
    landmark_whitening,
    project_out_starts,
)
from hamkernel._trajectories.preprocessing import Preprocessed
from hamkernel._trajectories.search import (
    Bounds,
    begun,
    limited_by_landmarks,
    losses,
    most_likely,
    searched,
    solved,
    without_noise,
)
from hamkernel._trajectories.segments import (
    LONG,
    LinearisedSegments,
    Piece,
    equal_pieces,
    grown,
    halved,
    linearised_along_field,
    linearised_along_smoothed,
    segmented,
    short_pieces,
    smoothed_rows,
    updated,
)
from hamkernel._trajectories.whiteness import whiteness

_ROUNDS = 4  # Levenberg steps before a segment is judged: without them up to 40 % were lost
_SEARCH = 25  # steps of BFGS, which go on in the next iteration
_SHORT_ROUNDS = 2  # iterations with short segments, in which a rough field stays near the samples
_NOT_YET_EXACT = 1e-3  # of the states: residuals for which no segment without noise is dropped


class Task(NamedTuple):
    """The task: what no iteration changes.

    Attributes:
        data: the runs.
        mean: what is known.
        S: the landmarks, as many as may be used.
        first: how many of them learning begins with.
        quick: how many a solve of a second or two carries.
        capped: whether these are fewer than the intervals.
        bounds: the box of hyperparameters.
        start_deviation: of the prior of starts.
    """

    data: Preprocessed
    mean: Any
    S: Float[np.ndarray, "m d"]
    first: int
    quick: int
    capped: bool
    bounds: Bounds
    start_deviation: Float[Array, " n"]


class Current(NamedTuple):
    """The state of the iterations.

    Attributes:
        model: kernel and noise.
        field: the field.
        S: its landmarks, and those that may be added.
        rows: what it was learned from.
        paths: the path of each run at its samples.
        good: which pieces were kept.
        squares: the sum of their squared normalised residuals.
        free: the degrees of freedom that are left.
        pushed: by how much larger the deviation of w is in the intervals of the segments.
        known: whether two searches on windows agreed on the kernel, which then stays.
    """

    model: Model
    field: Expansion
    S: Float[np.ndarray, "m d"]
    rows: LinearisedSegments
    paths: list[np.ndarray]
    good: Bool[np.ndarray, " S"]
    squares: float
    free: float
    pushed: Array | float = 1.0
    known: bool = False


class End(NamedTuple):
    """The end of the iterations.

    Attributes:
        task: the task.
        now: the last step.
        pieces: the pieces of the runs in the last step.
        history: one entry a step.
        settled: whether noise and objective settled.
    """

    task: Task
    now: Current
    pieces: list[Piece]
    history: list[Iteration]
    settled: bool


def iterate(task: Task, now: Current, most: int, bar: Any) -> End:
    """Gauss-Newton steps until noise and objective settle, at most `most` of them."""
    runs, process = task.data.runs, now.model.is_disturbed
    history: list[Iteration] = []
    pieces: list[Piece] = []
    settled = False
    bar.total = bar.n + 1 + most
    bar.update()
    for i in range(most):
        if process:
            wanted = equal_pieces(runs, LONG)
        elif i < _SHORT_ROUNDS:
            wanted = short_pieces(runs)
        elif i == _SHORT_ROUNDS:
            wanted = grown(runs, pieces, now.good)
        else:
            wanted = halved(runs, pieces, now.good)
        before, same, pieces = now, wanted == pieces, wanted
        now, done = (iterated_with_process if process else iterated)(task, now, pieces)
        history.append(done)
        noise = ", ".join(f"{sigma:.3g}" for sigma in np.asarray(done.noise))
        said = f"{len(now.field.points)} landmarks, noise {noise}, kept {float(done.kept):.0%}"
        bar.set_postfix_str(said, refresh=False)
        bar.update()
        if not same or i <= _SHORT_ROUNDS:
            continue
        moved = float(jnp.abs(now.model.log_noise - before.model.log_noise).max())
        # A hundredth of log σ, and a thousandth of the objective by degree of freedom, which may
        # still go from 2884 to 2868 for 2820 of them while σ stays; or a field that stays: without
        # noise its digits end before the objective settles.
        less = abs(float(history[-2].objective - done.objective))
        small = less < 1e-3 * max(now.free, 1.0)
        settled = moved < 0.01 and (small or changed(task, before, now) < SETTLED)
        if settled:
            break
    return End(task, now, pieces, history, settled)


def initial_loss(task: Task, model: Model) -> float:
    """−log p of the rows along the smoothed runs, at the hyperparameters of `model`."""
    *_, rows = smoothed_rows(task.data, task.mean)
    given = jnp.asarray(task.S[: task.first]), rows, task.start_deviation, project_out_starts
    return float(losses(model, model.flat[None], *given)[0])


def begin(task: Task, model: Model, design: np.ndarray) -> Current:
    """The first model, from rows along the smoothed runs with the tangent of the mean.

    Segments are short, since the errors of the smoothed path add up along a run.
    """
    pieces, good, rows = smoothed_rows(task.data, task.mean)
    paths = [run.path for run in task.data.runs]
    model, found, field, S = _first(task, model, design, rows, project_out_starts)
    good = good[: len(pieces)]
    return Current(model, field, S, rows, paths, good, np.inf, float(found.free))


def _first(
    task: Task, model: Model, design: np.ndarray, rows: LinearisedSegments, whitening: Whitening
) -> tuple[Model, ClosedForm, Expansion, np.ndarray]:
    """The likeliest model, from the best point of a design, its field, and landmarks for more."""
    given = rows, task.start_deviation
    model, count = begun(model, design, task.S, task.first, *given, whitening)
    S = task.S[:count]
    model, _ = most_likely(model, S, *given, task.bounds, _SEARCH, whitening)
    S = task.S if searched(jnp.asarray(S), rows)[1] is not rows else S
    model, found = solved(model, S, task.first, task.quick, *given, whitening, task.bounds)
    return model, found, Expansion(model.kernel, found.points, found.coefficients, task.mean), S


def iterated(task: Task, now: Current, pieces: list[Piece]) -> tuple[Current, Iteration]:
    """One Gauss-Newton step: linearisation along the current field, closed form, line search."""
    segments = segmented(task.data.runs, pieces, now.paths)
    count = steps_for(np.asarray(segments.spans), _stiffness(now.field, task.data, now.paths))
    steps = jnp.asarray(count)
    before = shoot(
        now.field,
        segments,
        now.model.log_noise,
        task.start_deviation,
        steps,
        segments.starts,
        _ROUNDS,
    )
    least = _NOT_YET_EXACT * task.data.scale
    was_asked = bool(np.isfinite(now.squares))
    good = trusted(before, segments, np.exp(np.asarray(now.model.log_noise)), least, was_asked)
    if not was_asked:  # the pieces are those of the smoothed paths
        good[: len(pieces)] &= now.good
    rows = linearised_along_field(now.field, before.path, segments, jnp.asarray(good))
    # Along longer segments the path is far off at first, and the kernel would bend to what the
    # linearisation misses: of positions with gaps a lengthscale of 2.2 became 1, and the field
    # kept ripples, an error of .016 for .0014.
    longer = segments.counts.shape[1] > now.rows.counts.shape[1]
    model, found, S, between = _solved(task, now, rows, project_out_starts, longer or now.known)
    of_windows = searched(found.points, rows)[1] is not rows
    known = was_asked and not longer and of_windows and agree(now.model, model)

    def trial(share: float) -> _Trial:
        weights, field = between(share)
        starts = before.starts + share * found.moves
        there = shoot(
            field, segments, model.log_noise, task.start_deviation, steps, starts, _ROUNDS
        )
        squares = float(np.asarray(there.squares)[good].sum())
        x = np.asarray(there.path.x)
        return _Trial(squares + float(weights @ weights), squares, field, x)

    gain, taken, best = _searched(trial, bool(good.any()))
    good = good[: len(pieces)]
    paths = updated(now.paths, pieces, good, best.x)
    step = _described(task, pieces, good, best, gain, taken, model, found.loss)
    free = float(found.free)
    return Current(model, best.field, S, rows, paths, good, best.squares, free, known=known), step


class _Trial(NamedTuple):
    objective: float
    squares: float
    field: Expansion
    x: np.ndarray


def _solved(
    task: Task, now: Current, rows: LinearisedSegments, whitening: Whitening, held: bool = False
) -> tuple[Model, ClosedForm, np.ndarray, Callable[[float], tuple[Array, Expansion]]]:
    """The likeliest model, its closed form, landmarks for more, and the way to it: share -> (w, f).

    Hyperparameters that are `held` stay. Rows that ask for no more landmarks once are not asked
    again.
    """
    model, given, used = now.model, (rows, task.start_deviation), len(now.field.points)
    if not held:
        model, _ = most_likely(model, now.S[:used], *given, task.bounds, _SEARCH, whitening)
    model, found = solved(model, now.S, used, task.quick, *given, whitening, task.bounds)
    # The current field in the new basis: the one with its values at the landmarks.
    S = found.points
    T = _landmark_whitening(model.kernel, S)
    old = T.T @ field_values(
        Expansion(now.field.kernel, now.field.points, now.field.coefficients, None), S
    ).reshape(-1)

    def between(share: float) -> tuple[Float[Array, " q"], Expansion]:
        weights = (1 - share) * old + share * found.weights
        coefficients = (T @ weights).reshape(len(S), -1)
        return weights, Expansion(model.kernel, S, coefficients, task.mean)

    return model, found, np.asarray(S) if len(S) == used else now.S, between


def _searched(trial: Callable[[float], _Trial], any_good: bool) -> tuple[float, float, _Trial]:
    """The gain, the share and the trial of the first share that makes the objective smaller."""
    at_old = trial(0.0)
    for share in 0.5 ** np.arange(5) if any_good else ():
        there = trial(share)
        if there.objective < at_old.objective:
            return at_old.objective - there.objective, share, there
    return 0.0, 0.0, at_old


def _described(task, pieces, good, best: _Trial, gain, taken, model: Model, loss) -> Iteration:
    samples = sum(len(run.times) for run in task.data.runs)
    kept = sum(piece.stop - piece.start for piece, ok in zip(pieces, good, strict=True) if ok)
    numbers = (best.objective, gain, taken, kept / samples, loss)
    objective, gain, taken, kept, loss = (jnp.asarray(value) for value in numbers)
    longest = max(piece.stop - piece.start for piece in pieces)
    noise, process = jnp.exp(model.log_noise), jnp.exp(model.log_process)
    return Iteration(longest, objective, gain, taken, noise, process, kept, loss)


def begin_with_process(task: Task, model: Model, design: np.ndarray) -> Current:
    """The first model with process noise, from the smoothed runs, whole or in long parts."""
    runs = task.data.runs
    pieces = equal_pieces(runs, LONG)
    segments = segmented(runs, pieces, [run.path for run in runs])
    good = np.zeros(len(segments.starts), bool)
    good[: len(pieces)] = [task.data.usable[piece.run] for piece in pieces]
    rows = linearised_along_smoothed(task.data, pieces, segments, task.mean, good)
    model, found, field, S = _first(task, model, design, rows, whiten)
    moves, _, pushed = _smoothed(model, found, rows, task)
    good = good[: len(pieces)]
    paths = [run.path for run in runs]
    x = _on_segments(paths, pieces, segments)
    paths = updated(paths, pieces, good, x + np.asarray(moves))
    return Current(model, field, S, rows, paths, good, np.inf, float(found.free), pushed)


def _smoothed(
    model: Model, found: ClosedForm, rows: LinearisedSegments, task: Task
) -> SmoothedPath:
    given = found.coefficients, found.points, rows, task.start_deviation
    return smoothed_path(model, *given)


def iterated_with_process(
    task: Task, now: Current, pieces: list[Piece]
) -> tuple[Current, Iteration]:
    """One Gauss-Newton step with process noise: each interval is linearised by itself.

    The objective is ‖W (y − x)‖² + Σ dᵢᵀ (Cov ηᵢ)⁻¹ dᵢ + ‖f‖², d the defect of each interval.
    """
    segments, x, steps, rows = _by_interval(task, now, pieces)
    good = rows.counts.any((1, 2))
    model, found, S, between = _solved(task, now, rows, whiten)
    moves, _, pushed = _smoothed(model, found, rows, task)
    # A defect that the integrator may leave is none: see `steps_for`.
    covariance = process_covariance(model, rows, jnp.asarray(1e-6 * task.data.scale))

    def trial(share: float) -> _Trial:
        weights, field = between(share)
        there = x + share * moves
        defect = linearised_by_interval(field, there, segments, steps, good).missed
        squares = _squares(there, defect, covariance, segments, rows.counts, model.log_noise)
        squares = float(squares) if np.isfinite(squares) else np.inf
        return _Trial(squares + float(weights @ weights), squares, field, np.asarray(there))

    gain, taken, best = _searched(trial, bool(good.any()))
    good = np.asarray(good)[: len(pieces)]
    paths = updated(now.paths, pieces, good, best.x)
    step = _described(task, pieces, good, best, gain, taken, model, found.loss)
    free = float(found.free)
    return Current(model, best.field, S, rows, paths, good, best.squares, free, pushed), step


def _by_interval(
    task: Task, now: Current, pieces: list[Piece]
) -> tuple[Segments, Float[Array, "S L+1 n"], Array, LinearisedSegments]:
    """The pieces, the path on them, Runge-Kutta steps, and the rows along it."""
    segments = segmented(task.data.runs, pieces, now.paths)
    spans = np.asarray(segments.spans).reshape(-1, 1)
    steps = jnp.asarray(steps_for(spans, _stiffness(now.field, task.data, now.paths)))
    x = jnp.asarray(_on_segments(now.paths, pieces, segments))
    good = np.zeros(len(x), bool)
    good[: len(pieces)] = [task.data.usable[piece.run] for piece in pieces]
    rows = linearised_by_interval(now.field, x, segments, steps, jnp.asarray(good))
    return segments, x, steps, rows._replace(pushed=now.pushed * rows.pushed)


def evidence(end: End) -> float:
    """−log p of the runs in as few parts as may be, about the path of the end; ∞ if it is lost."""
    task, model = end.task, end.now.model
    rows = _by_interval(task, end.now, equal_pieces(task.data.runs, LONG))[3]
    given = end.now.field.points, rows, task.start_deviation
    loss = closed_form(model, *given, whiten).loss
    return float(jnp.where(jnp.isnan(loss), jnp.inf, loss))


@compiled_by_size
def _squares(x, defect, covariance, segments: Segments, counts, log_noise) -> Float[Array, ""]:
    residual = jnp.where(counts > 0, segments.measured - x, 0.0)
    moved = jnp.linalg.solve(covariance, defect[..., None])[..., 0]
    return jnp.sum(counts * residual**2 * jnp.exp(-2 * log_noise)[None, None]) + jnp.sum(
        defect * moved
    )


def _on_segments(paths, pieces: list[Piece], segments: Segments) -> Float[np.ndarray, "S L+1 n"]:
    """The paths at the samples of each segment; after the last one they are constant."""
    x = np.repeat(np.asarray(segments.starts)[:, None], segments.measured.shape[1], axis=1)
    for s, (r, start, stop) in enumerate(pieces):
        x[s] = paths[r][stop - 1]
        x[s, : stop - start] = paths[r][start:stop]
    return x


_landmark_whitening = compiled_by_size(landmark_whitening)


def _stiffness(field: Expansion, data: Preprocessed, paths: list[np.ndarray]) -> float:
    """The stiffness of the field at 256 points along the paths."""
    X = np.concatenate([run.joined(path) for run, path in zip(data.runs, paths, strict=True)])
    return stiffness(field, X[np.linspace(0, len(X) - 1, 256).round().astype(int)], data.scale)


def changed(task: Task, before: Current, now: Current) -> float:
    """The change of the field at the landmarks, relative to its size there."""
    old, new = (
        np.asarray(field_values(each.field, now.field.points)) / task.data.scale[None]
        for each in (before, now)
    )
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))


def price(end: End, impulse: Float[np.ndarray, " n"], pushes: int = 0) -> float:
    """The gain in log p that pays for process noise: Schwarz's ½ log N for each deviation of w."""
    count = np.isfinite(impulse).sum() + pushes
    return float(0.5 * count * np.log(np.asarray(end.now.rows.counts).sum()))


def whitening_of(model: Model) -> Whitening:
    """The function that whitens the rows of this model."""
    return whiten if model.is_disturbed else project_out_starts


def asks_for_landmarks(end: End) -> bool:
    """Whether the rows are likelier with more landmarks, at less noise too if time is the limit."""
    (task, now), n = end[:2], len(end.task.data.scale)
    given = now.model, now.field.points, now.rows, task.start_deviation, whitening_of(now.model)
    capped = task.capped and len(now.field.points) >= task.quick
    return limited_by_landmarks(*given, capped and bool(task.bounds.free[-2 * n : -n].any()))


def asks_for_process(end: End, impulse: Float[np.ndarray, " n"]) -> bool:
    """Whether anything suggests that the structure is not the whole truth.

    Iterations that did not settle, parts that were dropped, innovations that are not white, or rows
    that are likelier with process noise. Of innovations and rows it is not said where more
    landmarks would explain them: what a field on too few cannot say looks like process noise. Where
    parts are lost the lengthscale has often collapsed, and landmarks are always too few for that.
    """
    now, task = end.now, end.task
    given = now.field.points, now.rows, task.start_deviation
    if task.capped and task.first == task.quick:
        return False
    if not (end.settled and now.good.all()):
        return True
    counts = noisy_counts(end)
    if not counts.any():
        return False
    if asks_for_landmarks(end):
        return False
    z = innovations(whitened_rows(now.model, *given), now.rows)
    if not whiteness(z, counts).is_enough:
        return True
    shares = np.log([1e-3, 1e-2, 1e-1])
    design = [now.model.log_process, *(impulse + share for share in shares)]
    flat = np.tile(np.asarray(now.model.flat), (len(design), 1))
    flat[:, -len(impulse) :] = design
    part = searched(*given[:2])
    values = np.asarray(losses(now.model, jnp.asarray(flat), *part, task.start_deviation, whiten))
    return bool(values[0] - values.min() > price(end, impulse))


def noisy_counts(end: End) -> Float[np.ndarray, "S L+1 n"]:
    """How many samples there are where there is noise: zero in coordinates that are exact."""
    task, now = end.task, end.now
    return np.where(without_noise(now.model, task.bounds, task.data.scale), 0, now.rows.counts)


def likelier(without: End, process: End, most: int, bar: Any) -> tuple[End, End]:
    """The end without process noise, and the likelier of both ends, process noise at its price.

    Steps without it that lost their way go on from the field that those with it found, for which no
    path of a rough field has to be followed: each interval is linearised by itself.
    """
    if not (without.settled and without.now.good.all()):
        model = process.now.model
        model = model._replace(log_process=jnp.full_like(model.log_process, -jnp.inf))
        now = process.now._replace(model=model, pushed=1.0)
        again = iterate(without.task, now, most, bar)
        without = again if evidence(again) < evidence(without) else without
    pushes = int((process.now.rows.pushed > 1).sum())
    more = price(process, np.asarray(process.now.model.log_process), pushes)
    return without, process if evidence(process) + more < evidence(without) else without
