"""Gauss-Newton steps: a linearisation of each interval, a closed form and a line search.

The path is moved by the field and by process noise; rows are whitened by a Kalman filter.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._learned.diagnostics import NEGLIGIBLE, SETTLED
from hamkernel._learned.free_run import Stretches, error_over_constant, stretches_of_swings
from hamkernel._learned.result import Iteration
from hamkernel._learned.whiteness import whiteness
from hamkernel._machine import compiled_by_size, precise_jit
from hamkernel._runs.flow import (
    Expansion,
    Segments,
    field_values,
    is_too_stiff,
    steps_for,
    stiffness,
)
from hamkernel._runs.preprocessing import Preprocessed, sample_points, time_of_swing
from hamkernel._trajectories.kalman import (
    SmoothedPath,
    innovations,
    linearised_by_interval,
    process_covariance,
    smoothed_path,
    whitened_rows,
)
from hamkernel._trajectories.likelihood import ClosedForm, closed_form
from hamkernel._trajectories.model import Model, landmark_whitening
from hamkernel._trajectories.search import (
    Bounds,
    choose_start,
    has_process_noise,
    landmark_spacing,
    limited_by_landmarks,
    losses,
    maximise_likelihood,
    noise_free_coordinates,
    search_sample,
    solve,
)
from hamkernel._trajectories.segments import (
    LinearisedSegments,
    Piece,
    linearised_along_smoothed,
    make_segments,
    replace_pieces,
)

_SEARCH = 25  # steps of BFGS, which go on in the next iteration


class Task(NamedTuple):
    """The task: what no iteration changes.

    Attributes:
        data: the runs.
        mean: the known part of the field.
        S: the landmarks, as many as may be used.
        first: how many of them learning begins with.
        quick: how many a solve of a second or two carries.
        capped: whether these are fewer than the intervals.
        bounds: the box of hyperparameters.
        start_deviation: the standard deviation of the prior of starts.
        pieces: the runs, whole or in long parts.
    """

    data: Preprocessed
    mean: Any
    S: Float[np.ndarray, "m d"]
    first: int
    quick: int
    capped: bool
    bounds: Bounds
    start_deviation: Float[Array, " n"]
    pieces: list[Piece]

    @property
    def good(self) -> Bool[np.ndarray, " S"]:
        return self.usable(len(self.pieces))

    def usable(self, size: int) -> Bool[np.ndarray, " size"]:
        """Which of `size` segments are usable."""
        good = np.zeros(size, bool)
        good[: len(self.pieces)] = [self.data.usable[piece.run] for piece in self.pieces]
        return good

    def bounds_for(self, count: int) -> Bounds:
        """The box for `count` landmarks: the closer they lie, the shorter lengthscales may be.

        400 runs of a double pendulum without noise used 640 landmarks. In the box of the first 80,
        two lengthscales ended at their bounds, and noise took up the rest: −log p was 4e5, and it
        is −3e4 in the box for 640 (`tests/benchmarks/capacity.py double 400`).
        """
        X, scale = sample_points(self.data)[0], self.data.scale
        at_first, now = (landmark_spacing(X, self.S[:m], scale) for m in (self.first, count))
        return self.bounds.with_shorter_lengths(now / at_first if now > 0 else 1.0)


class Current(NamedTuple):
    """The state of the iterations.

    Attributes:
        model: kernel and noise.
        field: the field.
        S: its landmarks, and those that may be added.
        rows: the rows that it was learned from.
        paths: the path of each run at its samples.
        good: which pieces were kept.
        squares: the sum of their squared normalised residuals.
        free: the degrees of freedom that are left.
        pushed: by how much larger the deviation of w is in the intervals of the segments.
        is_tuned: whether a search on a sample of the rows came back to the kernel it began from.
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
    is_tuned: bool = False


class End(NamedTuple):
    """The end of the iterations.

    Attributes:
        task: the task.
        now: the last step.
        history: one entry a step.
        settled: whether noise and objective settled.
    """

    task: Task
    now: Current
    history: list[Iteration]
    settled: bool


def iterate(task: Task, now: Current, max_steps: int, bar: Any) -> End:
    """Gauss-Newton steps until noise and objective settle, at most `max_steps` of them."""
    history: list[Iteration] = []
    settled = False
    bar.total = bar.n + 1 + max_steps
    bar.update()
    while len(history) < max_steps and not settled and not _is_lost(task, now):
        before = now
        now, done = take_step(task, now)
        history.append(done)
        noise = ", ".join(f"{sigma:.3g}" for sigma in np.asarray(done.noise))
        said = f"{len(now.field.points)} landmarks, noise {noise}, kept {float(done.kept):.0%}"
        bar.set_postfix_str(said, refresh=False)
        bar.update()
        if len(history) < 2:
            continue
        noises = np.asarray(now.model.log_noise), np.asarray(before.model.log_noise)
        moved = float(np.abs(noises[0] - noises[1]).max())
        # Half a nat, as much as one degree of freedom; or a field that stays: without noise −log p
        # has no end. The objective is no sign, since defects dominate it at first.
        likelier = abs(float(history[-2].loss) - float(done.loss))
        settled = moved < 0.01 and (likelier < 0.5 or relative_change(task, before, now) < SETTLED)
    return End(task, now, history, settled)


def _is_lost(task: Task, now: Current) -> bool:
    spans = np.concatenate([np.diff(run.times) for run in task.data.runs])[None]
    return is_too_stiff(spans, _stiffness(now.field, task.data, now.paths))


def initial_loss(task: Task, model: Model) -> float:
    """−log p of the rows along the smoothed runs, at the hyperparameters of `model`."""
    S = jnp.asarray(task.S[: task.first])
    rows = _along_smoothed(task)
    return float(losses(model, np.asarray(model.flat)[None], S, rows, task.start_deviation)[0])


def begin(task: Task, model: Model, design: np.ndarray) -> Current:
    """The first model, field and path, from rows along the smoothed runs."""
    rows, paths = _along_smoothed(task), [run.path for run in task.data.runs]
    model, count = choose_start(model, design, task.S, task.first, rows, task.start_deviation)
    return _full_step(task, model, count, task.first, rows, paths)


def fix_process_noise(task: Task, now: Current, q: Float[np.ndarray, " n"]) -> tuple[Task, Current]:
    """The task and its path with the process noise q, which the search no longer changes.

    Sensor noise takes over from process noise: its search begins at the likeliest of the estimate,
    a hundredth and a tenth of the motion.
    """
    n, model = len(q), now.model
    free = task.bounds.free.copy()
    moves = free[-2 * n : -n]
    free[-n:] = False
    task = task._replace(bounds=task.bounds._replace(free=free))
    with np.errstate(divide="ignore"):
        model = model._replace(log_process=jax.device_put(np.log(q)))
    # A push is one beside the process noise of the caller, which the beginning had too.
    was_given = has_process_noise(model, task.bounds).any()
    rows = _linearise(task, now if was_given else now._replace(pushed=1.0))[3]
    noise = np.asarray(model.log_noise)
    floors = (np.log(share * task.data.scale) for share in (1e-300, 0.01, 0.1))
    noises = [np.where(moves, np.maximum(noise, floor), noise) for floor in floors]
    design = np.stack([model._replace(log_noise=sigma).flat for sigma in noises])
    values = losses(model, design, *search_sample(now.field.points, rows), task.start_deviation)
    model = model.unflatten(design[int(np.argmin(values))])
    count = len(now.field.points)
    return task, _full_step(task, model, count, count, rows, now.paths)


def _full_step(
    task: Task,
    model: Model,
    count: int,
    least: int,
    rows: LinearisedSegments,
    paths: list[np.ndarray],
) -> Current:
    """The likeliest model, field and path of rows along other paths, without a line search.

    Args:
        task: the task.
        model: where the search for the likeliest model begins.
        count: the number of landmarks in the search.
        least: the least number of landmarks of the field.
        rows: the rows along the paths.
        paths: the paths.
    """
    args, bounds = (rows, task.start_deviation), task.bounds_for(count)
    model, _ = maximise_likelihood(model, task.S[:count], *args, bounds, _SEARCH)
    model, closed = solve(model, task.S, least, task.quick, *args, bounds)
    field = Expansion(model.kernel, closed.points, closed.coefficients, task.mean)
    moves, _, pushed = _smooth(model, closed, rows, task)
    x = _segment_paths(paths, task.pieces, make_segments(task.data.runs, task.pieces, paths))
    paths = replace_pieces(paths, task.pieces, task.good, x + np.asarray(moves))
    used = len(closed.points)
    S = task.S if used > task.first else task.S[:used]
    return Current(model, field, S, rows, paths, task.good, np.inf, float(closed.free), pushed)


def _along_smoothed(task: Task) -> LinearisedSegments:
    runs = task.data.runs
    segments = make_segments(runs, task.pieces, [run.path for run in runs])
    return linearised_along_smoothed(
        task.data, task.pieces, segments, task.mean, task.usable(len(segments.starts))
    )


class _Trial(NamedTuple):
    objective: float
    squares: float
    field: Expansion
    x: np.ndarray


def _solve_rows(
    task: Task, now: Current, rows: LinearisedSegments
) -> tuple[Model, ClosedForm, np.ndarray, Callable[[float], tuple[Array, Expansion]]]:
    """The likeliest model, its closed form, landmarks for more, and the way to it: share -> (w, f).

    Rows that ask for no more landmarks once are not asked again. A kernel that is tuned stays, and
    only the noise is scaled.
    """
    args, used = (rows, task.start_deviation), len(now.field.points)
    bounds, model = task.bounds_for(used), now.model
    if not now.is_tuned:
        model, _ = maximise_likelihood(model, now.S[:used], *args, bounds, _SEARCH)
    model, closed = solve(model, now.S, used, task.quick, *args, bounds)
    # The current field in the new basis: the one with its values at the landmarks.
    S = closed.points
    T = _landmark_whitening(model.kernel, S)
    learned = Expansion(now.field.kernel, now.field.points, now.field.coefficients, None)
    old = _weights_of(learned, S, T)

    def between(share: float) -> tuple[Float[Array, " q"], Expansion]:
        weights, coefficients = _weights_between(old, closed.weights, np.array(share), S, T)
        return weights, Expansion(model.kernel, S, coefficients, task.mean)

    return model, closed, np.asarray(S) if len(S) == used else now.S, between


def _line_search(trial: Callable[[float], _Trial], any_good: bool) -> tuple[float, float, _Trial]:
    """The gain, the share and the trial of the first share that makes the objective smaller."""
    at_old = trial(0.0)
    for share in 0.5 ** np.arange(5) if any_good else ():
        there = trial(share)
        if there.objective < at_old.objective:
            return at_old.objective - there.objective, share, there
    return 0.0, 0.0, at_old


def _history_entry(task, good, best: _Trial, gain, taken, model: Model, loss) -> Iteration:
    samples = sum(len(run.times) for run in task.data.runs)
    kept = sum(piece.stop - piece.start for piece, ok in zip(task.pieces, good, strict=True) if ok)
    numbers = (best.objective, gain, taken, kept / samples, loss)
    objective, gain, taken, kept, loss = map(jax.device_put, numbers)
    longest = max(piece.stop - piece.start for piece in task.pieces)
    noise, process = (np.exp(np.asarray(a)) for a in (model.log_noise, model.log_process))
    noise, process = jax.device_put((noise, process))
    return Iteration(longest, objective, gain, taken, noise, process, kept, loss)


def _smooth(model: Model, closed: ClosedForm, rows: LinearisedSegments, task: Task) -> SmoothedPath:
    return smoothed_path(model, closed.coefficients, closed.points, rows, task.start_deviation)


def take_step(task: Task, now: Current) -> tuple[Current, Iteration]:
    """One Gauss-Newton step: each interval is linearised by itself.

    The objective is ‖W (y − x)‖² + Σ dᵢᵀ (Cov ηᵢ)⁻¹ dᵢ + ‖f‖², d the defect of each interval.
    """
    segments, x, steps, rows = _linearise(task, now)
    good = np.asarray(rows.counts).any((1, 2))
    model, closed, S, between = _solve_rows(task, now, rows)
    moves, _, pushed = _smooth(model, closed, rows, task)
    # The next step removes defects to second order, so that a thousandth of the motion is no reason
    # to shorten this one: with the integrator's 1e-6, steps are cut to a quarter for nothing.
    covariance = process_covariance(model, rows, 1e-3 * task.data.scale)

    def trial(share: float) -> _Trial:
        weights, field = between(share)
        there = np.asarray(x) + share * np.asarray(moves)
        defect = linearised_by_interval(field, there, segments, steps, good).missed
        squares = _squares(there, defect, covariance, segments, rows.counts, model.log_noise)
        squares = float(squares) if np.isfinite(squares) else np.inf
        return _Trial(squares + float(np.sum(np.asarray(weights) ** 2)), squares, field, there)

    gain, taken, best = _line_search(trial, bool(good.any()))
    good = np.asarray(good)[: len(task.pieces)]
    paths = replace_pieces(now.paths, task.pieces, good, best.x)
    step = _history_entry(task, good, best, gain, taken, model, closed.loss)
    free = float(closed.free)
    tuned = now.is_tuned or _is_tuned(now, model, closed, rows)
    now = Current(model, best.field, S, rows, paths, good, best.squares, free, pushed, tuned)
    return now, step


def _is_tuned(now: Current, model: Model, closed: ClosedForm, rows: LinearisedSegments) -> bool:
    """Whether a search on a sample of the rows moved the kernel by less than its error.

    A sample of 144 of 2000 rows tells hyperparameters to some tenths, and noise from iteration to
    iteration to a factor of two: 400 runs of a double pendulum did not settle in eight iterations
    (`tests/benchmarks/capacity.py double 400`). Where the search uses all rows, it goes on.
    """
    used = len(now.field.points)
    if len(closed.points) > used or search_sample(closed.points, rows)[1] is rows:
        return False
    size = 2 * len(model.log_noise)
    moved = np.asarray(model.flat)[:-size] - np.asarray(now.model.flat)[:-size]
    return bool(np.abs(moved).max(initial=0.0) < 0.2)


def _linearise(
    task: Task, now: Current
) -> tuple[Segments, Float[Array, "S L+1 n"], np.ndarray, LinearisedSegments]:
    """The segments, the path on them, Runge-Kutta steps, and the rows along it."""
    segments = make_segments(task.data.runs, task.pieces, now.paths)
    spans = np.asarray(segments.spans).reshape(-1, 1)
    steps = steps_for(spans, _stiffness(now.field, task.data, now.paths))
    x = jax.device_put(_segment_paths(now.paths, task.pieces, segments))
    good = task.usable(len(x))
    rows = linearised_by_interval(now.field, x, segments, steps, good)
    if np.ndim(now.pushed):
        rows = rows._replace(pushed=now.pushed)
    return segments, x, steps, rows


@compiled_by_size
def _squares(x, defect, covariance, segments: Segments, counts, log_noise) -> Float[Array, ""]:
    residual = jnp.where(counts > 0, segments.measured - x, 0.0)
    moved = jnp.linalg.solve(covariance, defect[..., None])[..., 0]
    return jnp.sum(counts * residual**2 * jnp.exp(-2 * log_noise)[None, None]) + jnp.sum(
        defect * moved
    )


def _segment_paths(paths, pieces: list[Piece], segments: Segments) -> Float[np.ndarray, "S L+1 n"]:
    """The paths at the samples of each segment; after the last one they are constant."""
    x = np.repeat(np.asarray(segments.starts)[:, None], segments.measured.shape[1], axis=1)
    for s, (r, start, stop) in enumerate(pieces):
        x[s] = paths[r][stop - 1]
        x[s, : stop - start] = paths[r][start:stop]
    return x


_landmark_whitening = compiled_by_size(landmark_whitening)


@compiled_by_size
def _weights_of(field: Expansion, S: Float[Array, "m d"], T: Float[Array, "q q"]):
    """The weights w of the field K(·, S) T w that has the values of `field` at S."""
    return T.T @ jax.vmap(field)(S).reshape(-1)


@precise_jit
def _weights_between(old, new, share, S: Float[Array, "m d"], T: Float[Array, "q q"]):
    """The weights at a share of the way from the old ones to the new, and their coefficients."""
    weights = (1 - share) * old + share * new
    return weights, (T @ weights).reshape(len(S), -1)


def _stiffness(field: Expansion, data: Preprocessed, paths: list[np.ndarray]) -> float:
    """The stiffness of the field at 256 points along the paths."""
    X = np.concatenate([run.points(path) for run, path in zip(data.runs, paths, strict=True)])
    return stiffness(field, X[np.linspace(0, len(X) - 1, 256).round().astype(int)], data.scale)


def relative_change(task: Task, before: Current, now: Current) -> float:
    """The change of the field at the landmarks, relative to its size there."""
    old, new = (
        np.asarray(field_values(state.field, now.field.points)) / task.data.scale[None]
        for state in (before, now)
    )
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))


def asks_for_landmarks(end: End) -> bool:
    """Whether the rows are likelier with more landmarks, at less noise too if time is the limit."""
    (task, now), n = end[:2], len(end.task.data.scale)
    args = now.model, now.field.points, now.rows, task.start_deviation
    capped = task.capped and len(now.field.points) >= task.quick
    return limited_by_landmarks(*args, capped and bool(task.bounds.free[-2 * n : -n].any()))


def noisy_counts(end: End) -> Float[np.ndarray, "S L+1 n"]:
    """How many samples there are where there is noise: zero in coordinates that are exact."""
    task, now = end.task, end.now
    exact = noise_free_coordinates(now.model, task.bounds, task.data.scale)
    return np.where(exact, 0, now.rows.counts)


def asks_for_process(end: End, impulse: Float[np.ndarray, " n"]) -> bool:
    """Whether iterations with next to no process noise say that it is not enough.

    They did not settle, or log p would gain more than the price of process noise, with less sensor
    noise too. If the landmarks are the limit and leave next to nothing, process noise would only
    stand for them.
    """
    now, task, model = end.now, end.task, end.now.model
    if not end.settled:
        return True
    noise = np.asarray(model.log_noise)
    if np.max(np.exp(noise) / task.data.scale) < NEGLIGIBLE:
        if task.capped and asks_for_landmarks(end):
            return False
    free = task.bounds.free[-2 * len(noise) : -len(noise)]
    design = [np.asarray(model.flat)]
    for q, sigma in itertools.product(np.log([1e-3, 1e-2, 1e-1]), np.log([1.0, 0.3, 0.1])):
        less = model._replace(log_noise=noise + sigma * free, log_process=impulse + q)
        design.append(np.asarray(less.flat))
    S, rows = search_sample(now.field.points, now.rows)
    values = losses(model, np.stack(design), S, rows, task.start_deviation)
    factor = np.asarray(now.rows.counts).sum() / np.asarray(rows.counts).sum()
    return bool(factor * (values[0] - values.min()) > price(end))


def price(end: End) -> float:
    """The gain in log p that pays for process noise: Schwarz's ½ log N for each deviation of w."""
    deviations = np.isfinite(np.asarray(end.now.model.log_process)).sum()
    count = deviations + (np.asarray(end.now.rows.pushed) > 1).sum()
    return float(0.5 * count * np.log(np.asarray(end.now.rows.counts).sum()))


def likelier(end: End, disturbed: End) -> End:
    """The end with process noise if log p pays for the noise; else the end without."""
    return disturbed if _loss(disturbed) + price(disturbed) < _loss(end) else end


def choose_end(end: End, disturbed: End, on_part: Callable[[Preprocessed], tuple[End, End]]) -> End:
    """The likelier end; by free runs over what is left out, where innovations of both refute log p.

    Two runs of a drive with cogging, which the kernel lacks, are likelier with process noise by
    6000 nats, and the free run is off by 2.7 mm for 1.3 (`tests/benchmarks/machines.py drive`).
    Where both are worse than a constant, as on a real pendulum, free runs say nothing.

    Args:
        end: the end without process noise.
        disturbed: the end with process noise.
        on_part: both ends of learning from a part of the data.
    """
    if (
        likelier(end, disturbed) is end
        or is_white(end)
        or is_white(disturbed)
        or _loss(end) == np.inf
    ):
        return likelier(end, disturbed)
    if max(len(run.times) for run in end.task.data.runs) < 5:
        return likelier(end, disturbed)
    part, rest = _split(end.task.data, disturbed.now.paths)
    errors = [error_over_constant(e.now.field, rest, end.task.data.scale) for e in on_part(part)]
    return end if errors[0] < min(errors[1], 1.0) else disturbed


def is_white(end: End) -> bool:
    """Whether the innovations of an end are as good as white."""
    return whiteness(innovations_of(end), noisy_counts(end)).is_enough


def innovations_of(end: End) -> Float[np.ndarray, "S L+1 n"]:
    """The innovations of the rows of an end, in standard deviations."""
    now = end.now
    rows = whitened_rows(now.model, now.field.points, now.rows, end.task.start_deviation)
    return innovations(rows, now.rows)


def _split(data: Preprocessed, paths: list[np.ndarray]) -> tuple[Preprocessed, Stretches]:
    """The first four fifths of each run, and stretches of two swings over the rest."""
    cuts = [len(run.times) - len(run.times) // 5 for run in data.runs]
    runs = [run.part(slice(0, cut)) for run, cut in zip(data.runs, cuts, strict=True)]
    last = [
        (run.part(slice(cut - 1, None)), path[cut - 1 :])
        for run, cut, path in zip(data.runs, cuts, paths, strict=True)
        if cut < len(run.times)
    ]
    rest = stretches_of_swings(
        [run for run, _ in last], [path for _, path in last], time_of_swing(data)
    )
    return data._replace(runs=runs), rest


def _loss(end: End) -> float:
    """−log p of the runs about the path of the end; ∞ if it is lost."""
    rows = _linearise(end.task, end.now)[3]
    loss = closed_form(end.now.model, end.now.field.points, rows, end.task.start_deviation).loss
    return float(jnp.where(jnp.isnan(loss), jnp.inf, loss))
