"""Preprocessing of runs: `learn` condenses, smooths and completes them before it fits a field.

If the sampling interval is much shorter than the motion needs, we average samples in blocks. A
block becomes one sample in its middle: the smoothed path there plus the mean residual of the block.
Its noise is σ/√count, and its bias is of second order in the error of the smoothed path. We keep
the scatter of the residuals about their mean, since the scatter determines σ.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._machine import compiled_by_size
from hamkernel._runs.flow import NODES, with_tangent
from hamkernel._runs.runs import Between, Runs, inputs_at_nodes, inputs_at_samples
from hamkernel._runs.smoothing import Coordinate, interpolate, processes, smooth_runs

# rows · columns² of a solve: 1e10 takes 1 to 2 s. If the residuals ask for more landmarks, a solve
# may take 5e10, up to 10 s (`tests/benchmarks/capacity.py`):
#     20 runs of 50 samples, n = 8:  128 landmarks, field error .0087; 256 take 6.5 s
#     400 runs, double pendulum:     160 landmarks, rollout error .033; 640: .0042
_WORK, _MOST_WORK = 1e10, 5e10
# Points of the paths from which we take search boxes, and landmarks if there are fewer intervals.
_POINTS = 1024


class PreprocessedRun(NamedTuple):
    """One condensed run.

    Attributes:
        times: the times since the first sample, shape (T,).
        states: means of samples, NaN where nothing was measured, shape (T, n).
        counts: the number of samples in each mean, shape (T, n).
        scatter: the sum of the squared deviations of these samples from their mean, shape (T, n).
        path: smoothed states at the times, without NaN, shape (T, n).
        nodes: smoothed states at the Gauss nodes of each interval, shape (T − 1, 3, n).
        slopes: smoothed velocities at the nodes, shape (T − 1, 3, n).
        inputs: the inputs at both ends of each interval, shape (T − 1, 2, m); m = 0 without inputs.
    """

    times: np.ndarray
    states: np.ndarray
    counts: np.ndarray
    scatter: np.ndarray
    path: np.ndarray
    nodes: np.ndarray
    slopes: np.ndarray
    inputs: np.ndarray

    @property
    def duration(self) -> float:
        return float(self.times[-1] - self.times[0])

    def part(self, samples: slice) -> "PreprocessedRun":
        """The samples of a slice and the intervals between them."""
        first, stop, _ = samples.indices(len(self.times))
        at, between = slice(first, stop), slice(first, stop - 1)
        return PreprocessedRun(
            self.times[at] - self.times[first],
            *(array[at] for array in (self.states, self.counts, self.scatter, self.path)),
            *(array[between] for array in (self.nodes, self.slopes, self.inputs)),
        )

    def points(self, path: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T d"]:
        """Points (x, u) at the samples of a path."""
        return np.concatenate([path, inputs_at_samples(self.inputs)], axis=1)


class Preprocessed(NamedTuple):
    """All preprocessed runs.

    Attributes:
        runs: the condensed runs.
        noise: the noise that smoothing found in each coordinate; NaN if it was never measured.
        scale: the standard deviation of each coordinate along the paths, 1 if constant, shape (n,).
        usable: whether each run resembles the others, shape (R,).
    """

    runs: list[PreprocessedRun]
    noise: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, " n"]
    usable: Bool[np.ndarray, " R"]


def preprocess(runs: Runs, mean: Callable[[Array], Array] | None) -> Preprocessed:
    """Condense, smooth and complete the runs.

    Args:
        runs: the logged runs.
        mean: the prior mean, which determines coordinates that were not measured; if there are
            inputs, a function of the points (x, u).
    """
    times, states = runs.host_arrays()
    times, states = [t - t[0] for t in times], [_thin_rests(x) for x in states]
    fitted_processes, usable = _robust_processes(times, states)
    counts = [np.isfinite(x).astype(float) for x in states]
    scatter = [np.zeros_like(x) for x in states]
    lengths = [c.lengthscale for c in fitted_processes if np.isfinite(c.process.log_amplitude)]
    # A pendulum of frequency ω has a lengthscale near 2.7/ω, so blocks of a tenth of it are 23 a
    # swing. Three Gauss nodes in such an interval are exact to 1e-8.
    block = 0.1 * min(lengths, default=np.inf)
    if any(2 * np.median(np.diff(t)) < block for t in times):
        paths = smooth_runs(fitted_processes, times, states)
        shortest = _shortest_block(sum(t[-1] for t in times), runs.dimension, runs.input_count)
        averaged = 0.5 * averaging_time(fitted_processes, times, paths.deviation)
        block = min(block, max(averaged, shortest))
        condensed = [
            condense(t, x, paths.value[r, : len(t)], paths.slope[r, : len(t)], block)
            for r, (t, x) in enumerate(zip(times, states, strict=True))
        ]
        times, states, counts, scatter = (list(column) for column in zip(*condensed, strict=True))
    shortest = min(lengths, default=np.inf)
    refined = [_refine(*run, shortest) for run in zip(times, states, counts, scatter, strict=True)]
    times, states, counts, scatter = (list(column) for column in zip(*refined, strict=True))
    inputs = [
        runs.input_lines(r, t + float(np.asarray(runs.times[r])[0])) for r, t in enumerate(times)
    ]
    path_runs = _add_paths(fitted_processes, times, states, counts, scatter, inputs)
    if not all(c.measured for c in fitted_processes) or mean is not None:
        path_runs = [_complete(run, mean) for run in path_runs]
    noise = np.array([c.noise if c.measured else np.nan for c in fitted_processes])
    good = [run.path for run, use in zip(path_runs, usable, strict=True) if use]
    scale = np.concatenate(good).std(axis=0)
    return Preprocessed(path_runs, noise, np.where(scale > 0, scale, 1.0), usable)


_REST = 10  # more equal states than this are a rest


def _thin_rests(x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
    """The states of a run, with NaN inside each stretch of more than ten equal states.

    At rest a quantised sensor repeats one error, so the whole stretch measures the noise only once.
    With one run in four at rest, we estimated σ as √(3/4) of its true value.
    """
    same = (np.diff(x, axis=0) == 0) | np.isnan(x).all(axis=0)
    ends = np.flatnonzero(np.concatenate([[True], ~same.all(axis=1), [True]]))
    kept = x.copy()
    for first, stop in itertools.pairwise(ends):
        if stop - first > _REST:
            kept[first + 1 : stop - 1] = np.nan
    return kept


def averaging_time(
    coordinates: list[Coordinate], times, deviation: Float[np.ndarray, "R T n"]
) -> float:
    """The averaging time of the smoother: σ²/Var x(t) sampling intervals, least over coordinates.

    In a longer block the smoothed path follows the noise, and the mean of the block is less
    accurate than σ/√count. The ratio of the squared error to σ²/count, on nine logs of a driven
    pendulum at 50 Hz, is

        block / averaging time   1.6   1.1   0.8   0.5
        ratio                    1.88  1.20  1.07  1.00

    With the longest blocks, learning reported process noise or did not converge on 10 of 20 clean
    logs, instead of on one.

    Args:
        coordinates: the processes of the coordinates.
        times: the times of each run.
        deviation: √Var x(t) of each coordinate at the times of each run.
    """
    spacing = np.median(np.concatenate([np.diff(t) for t in times]))
    there = np.concatenate([deviation[r, : len(t)] for r, t in enumerate(times)])
    counts = [
        (c.noise / max(float(np.median(there[:, i])), np.finfo(float).tiny)) ** 2
        for i, c in enumerate(coordinates)
        if c.measured
    ]
    return float(spacing * min(counts, default=np.inf))


def _shortest_block(duration: float, n: int, inputs: int) -> float:
    """The shortest block for which a solve is affordable.

    Data without noise need this bound, since their averaging time is zero.
    """
    columns = n * first_landmarks(n + inputs)
    return duration * n * columns**2 / _WORK


def with_inputs(data: Preprocessed, runs: Runs) -> Preprocessed:
    """The preprocessed runs with the inputs of `runs`, whose `between` or `delay` may differ."""
    return data._replace(
        runs=[
            run._replace(
                inputs=runs.input_lines(r, run.times + float(np.asarray(runs.times[r])[0]))
            )
            for r, run in enumerate(data.runs)
        ]
    )


def decide(
    runs: Runs, data: Preprocessed, loss: Callable[[Preprocessed], float]
) -> tuple[Runs, Preprocessed]:
    """The runs with the likeliest `between` and `delay` of their inputs.

    Args:
        runs: runs with between="auto", delay="fit", or both.
        data: the runs, preprocessed.
        loss: −log p of preprocessed runs.
    """
    kinds = get_args(Between) if runs.between == "auto" else (runs.between,)
    candidates = []

    def judge(between, delay: float) -> float:
        chosen = runs.going_on(between, delay)
        there = with_inputs(data, chosen)
        candidates.append((loss(there), chosen, there))
        return candidates[-1][0]

    for between in kinds:
        if runs.delay == "fit":
            _least(functools.partial(judge, between), _spacing(runs))
        else:
            judge(between, runs.delay)
    _, chosen, there = min(candidates, key=lambda candidate: candidate[0])
    return chosen, there


def _spacing(runs: Runs) -> float:
    """The median sampling interval of the states or of the inputs, whichever is longer."""
    assert runs.input_times is not None
    clocks = [*runs.times], [*runs.input_times]
    return max(float(np.median(np.concatenate([np.diff(t) for t in ts]))) for ts in clocks)


def _least(loss: Callable[[float], float], spacing: float) -> None:
    """Evaluate the loss downhill from 0 in steps of `spacing`, then at the vertices of parabolas.

    −log p is nearly quadratic in the delay, so the vertex of a parabola through three points is
    near its minimum. A second and a third parabola use points at closer distances.
    """
    losses = {d: loss(d) for d in (-spacing, 0.0, spacing)}
    while (best := min(losses, key=losses.__getitem__)) in (min(losses), max(losses)):
        if abs(best) > 20 * spacing:  # about a whole swing, so no delay
            return
        losses[best + np.sign(best) * spacing] = loss(best + np.sign(best) * spacing)
    for reach in (spacing, spacing / 4, spacing / 16):
        best = min(losses, key=losses.__getitem__)
        left, right = (losses.setdefault(d, loss(d)) for d in (best - reach, best + reach))
        bend = left - 2 * losses[best] + right
        if not bend > 0:
            return
        vertex = best + reach * np.clip((left - right) / (2 * bend), -1, 1)
        losses[vertex] = loss(vertex)


def _robust_processes(times, states) -> tuple[list[Coordinate], np.ndarray]:
    """The processes of the coordinates, and whether each run resembles the others.

    We leave a run out if its root mean square distance from its smoothed path, in standard
    deviations of the states, is above 1e-3 and above five times the median of all runs. On runs
    without noise the smoother is only accurate to about 1e-3. Of fewer than three runs we keep all.
    """
    coordinates = processes(times, states)
    if len(times) < 3:
        return coordinates, np.ones(len(times), bool)
    paths = smooth_runs(coordinates, times, states)
    every = np.concatenate(states)
    measured = np.isfinite(every).any(axis=0)
    spread = np.where(measured, np.nanstd(np.where(measured, every, 0.0), axis=0), 1.0)
    unit = np.where(spread > 0, spread, 1.0)
    far = np.array(
        [
            np.sqrt(np.nanmean(((x - paths.value[r, : len(x)]) / unit) ** 2))
            for r, x in enumerate(states)
        ]
    )
    usable = ~(far > max(5 * np.nanmedian(far), 1e-3))
    if usable.all():
        return coordinates, usable
    chosen = np.flatnonzero(usable)
    return processes([times[r] for r in chosen], [states[r] for r in chosen]), usable


def condense(t, x, path, slope, block: float):
    """Times, means, counts and scatter of blocks of samples; a block spans less than `block`."""
    edges = [0]
    for i in range(1, len(t)):
        if t[i] - t[edges[-1]] >= block:
            edges.append(i)
    if len(edges) < 2:
        edges.append(len(t) // 2)
    measured = np.isfinite(x)
    residual = np.where(measured, x - path, 0.0)
    counts = np.add.reduceat(measured.astype(float), edges, axis=0)
    sizes = np.diff([*edges, len(t)])
    middle = np.add.reduceat(t, edges) / sizes
    means = np.add.reduceat(residual, edges, axis=0) / np.maximum(counts, 1)
    there = interpolate(middle, t, path, slope)
    about = np.where(measured, residual - np.repeat(means, sizes, axis=0), 0.0)
    scatter = np.add.reduceat(about**2, edges, axis=0)
    return middle, np.where(counts > 0, there + means, np.nan), counts, scatter


def _refine(t, x, counts, scatter, lengthscale: float):
    """The run with its long intervals split at times without measurements.

    If one interval spans much of a swing, its linearisation is poor and Gauss-Newton steps increase
    the loss. The longest interval also sets the number of Runge-Kutta steps of all intervals.

    For positions of three orbits at uneven times, up to half a turn apart, the field error is at
    most .33 %. With parts of .35 lengthscales it was 7.6 % (`tests/test_learn.py`).
    """
    spans = np.diff(t)
    # .2 · 2.7 = .54 radians: a swing has twelve such parts.
    parts = np.ceil(spans / (0.2 * lengthscale))
    parts = np.clip(parts, 1, 16).astype(int)  # in a long gap more parts would add no information
    at = np.append(0, np.cumsum(parts))
    fine = np.interp(np.arange(at[-1] + 1), at, t)
    fine[at] = t

    def place(a: np.ndarray, empty: float) -> np.ndarray:
        out = np.full((len(fine), a.shape[1]), empty)
        out[at] = a
        return out

    return fine, place(x, np.nan), place(counts, 0.0), place(scatter, 0.0)


def _add_paths(coordinates, times, states, counts, scatter, inputs) -> list[PreprocessedRun]:
    """The runs with their smoothed paths at the samples and at the Gauss nodes."""
    grids, filled = [], []
    for t, x in zip(times, states, strict=True):
        inside = t[:-1, None] + np.diff(t)[:, None] * NODES[None]
        grid = np.concatenate([np.column_stack([t[:-1], inside]).ravel(), t[-1:]])
        wide = np.full((len(grid), x.shape[1]), np.nan)
        wide[::4] = x
        grids.append(grid)
        filled.append(wide)
    paths = smooth_runs(coordinates, grids, filled)
    out = []
    columns = zip(times, states, counts, scatter, inputs, strict=True)
    for r, (t, x, count, about, ends) in enumerate(columns):
        size = 4 * len(t) - 3
        value, slope = (a[r, :size] for a in (paths.value, paths.slope))
        nodes, slopes = (a[:-1].reshape(len(t) - 1, 4, -1)[:, 1:] for a in (value, slope))
        out.append(PreprocessedRun(t, x, count, about, value[::4], nodes, slopes, ends))
    return out


def _complete(run: PreprocessedRun, mean: Callable[[Array], Array] | None) -> PreprocessedRun:
    """The run with values of the unmeasured coordinates, from the velocities of the others.

    Newton's method finds the coordinates for which the mean equals the measured velocities. For a
    mean with q̇ = p/m they are p = m q̇. Without a mean they are zero.
    """
    missing = ~np.isfinite(run.states).any(axis=0)
    if not missing.any():
        return run
    if mean is None:  # other runs measured them; the fit finds the initial state of this run
        return run._replace(
            path=np.nan_to_num(run.path),
            nodes=np.nan_to_num(run.nodes),
            slopes=np.nan_to_num(run.slopes),
        )
    n = run.states.shape[1]
    nodes, slopes = run.nodes.reshape(-1, n), run.slopes.reshape(-1, n)
    u = np.asarray(inputs_at_nodes(run.inputs)).reshape(len(nodes), -1)
    there = np.array(_solved_for(mean, np.nan_to_num(nodes), u, np.nan_to_num(slopes), missing))
    span = np.diff(run.times)
    inner = (run.times[:-1, None] + span[:, None] * NODES[None]).ravel()
    path, found_slopes = run.path.copy(), slopes.copy()
    for c in np.flatnonzero(missing):
        path[:, c] = np.interp(run.times, inner, there[:, c])
        gradient = np.gradient(there[:, c], inner) if len(inner) > 1 else 0.0
        found_slopes[:, c] = gradient
    shape = run.nodes.shape
    return run._replace(path=path, nodes=there.reshape(shape), slopes=found_slopes.reshape(shape))


@compiled_by_size
def _solved_for(mean, X, U, slopes, missing):
    """X with missing coordinates for which the mean equals the slopes of the other coordinates."""
    on = jnp.asarray(missing)

    def one(x, u, slope):
        def step(x, _):
            f, D = with_tangent(mean, jnp.concatenate([x, u]), len(x))
            D = jnp.where(on[None, :] & ~on[:, None], D, 0.0)
            wrong = jnp.where(on, 0.0, slope - f)
            # We scale the columns of D to norm one. A coordinate with a zero column, on which no
            # measured velocity depends, keeps its value.
            unit = jnp.linalg.norm(D, axis=0)
            unit = jnp.where(unit > 0, unit, jnp.ones_like(unit))
            D = D / unit[None]
            A = D.T @ D + 1e-9 * jnp.eye(len(x), dtype=x.dtype)
            return x + jnp.linalg.solve(A, D.T @ wrong) / unit, None

        return jax.lax.scan(step, x, length=5)[0]

    return jax.lax.map(lambda point: one(*point), (X, U, slopes))


def sample_points(
    data: Preprocessed, count: int = _POINTS
) -> tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "N n"]]:
    """`count` points x of the smoothed runs, or (x, u) with inputs, and the velocities there.

    The count does not depend on the length of the runs, so XLA compiles once for all lengths. Short
    runs repeat some of their points.
    """
    n = len(data.scale)
    runs = [run for run, use in zip(data.runs, data.usable, strict=True) if use]
    points = [np.concatenate([run.nodes, inputs_at_nodes(run.inputs)], axis=-1) for run in runs]
    X = np.concatenate([array.reshape(-1, array.shape[-1]) for array in points])
    Y = np.concatenate([run.slopes.reshape(-1, n) for run in runs])
    chosen = np.linspace(0, len(X) - 1, count).round().astype(int)
    return X[chosen], Y[chosen]


def time_of_swing(data: Preprocessed) -> float:
    """The time 2π · deviation / speed of the median coordinate: the period of a sinusoid.

    Of two medians we take the shorter. The deviation of an angle that makes full turns grows with
    the length of the log: for a real pendulum that swings up the angle gave 12.6 s, and the
    velocity 2.1 s.
    """
    speed = np.sqrt(np.mean(sample_points(data)[1] ** 2, axis=0))
    periods = 2 * np.pi * data.scale / np.maximum(speed, np.finfo(float).tiny)
    return float(np.quantile(periods, 0.5, method="lower"))


def first_landmarks(d: int) -> int:
    """The number of landmarks with which learning begins, for points of d coordinates."""
    # On ten runs of 10 s, 45 for two coordinates and 80 for four were as accurate as all points.
    return {1: 24, 2: 48, 3: 64, 4: 80}.get(d, 128)


def seconds_of_iteration(data: Preprocessed, count: int) -> float:
    """The seconds of an iteration with `count` landmarks: 2 rows · columns² operations.

    One core of 2025 does about 1e10 operations a second.
    """
    n = len(data.scale)
    rows = n * sum(len(run.times) for run in data.runs)
    return 2 * rows * (count * n) ** 2 / 1e10


def landmarks(
    data: Preprocessed, count: int | None
) -> tuple[Float[np.ndarray, "m d"], int, int, bool]:
    """Landmarks: points of the paths, each farthest from the earlier ones in standard deviations.

    The choice does not depend on hyperparameters, which are not known yet. The samples at the ends
    of an interval determine one mean of the field, so there are no more landmarks than intervals,
    unless `first_landmarks(d)` is larger.

    Args:
        data: the runs.
        count: the number of landmarks; if None, as many as are useful and affordable.

    Returns:
        The landmarks, the number to begin with, the number for which a solve is quick, and whether
        this quick number is less than the number of intervals.
    """
    n, used = len(data.scale), zip(data.runs, data.usable, strict=True)
    intervals = max(sum(len(run.times) - 1 for run, use in used if use), 1)
    affordable = (np.array([_WORK, _MOST_WORK]) / (n * intervals)) ** 0.5 // n
    X, _ = sample_points(data, max(_POINTS, min(intervals, 2 * int(affordable[1]))))
    first = first_landmarks(X.shape[1])
    # Learning doubles the number, so the limit is a doubling too: a few more landmarks would cost
    # one more compilation and solve.
    affordable = first * 2 ** np.log2(np.maximum(affordable / first, 1)).astype(int)
    quick, limit = np.maximum(first, np.minimum(intervals, affordable)).tolist()
    if count is not None:
        first = quick = limit = count
    spread = X[:, n:].std(axis=0)  # of the inputs
    points = X / np.concatenate([data.scale, np.where(spread > 0, spread, 1.0)])[None]
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(limit, len(points)):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if not distance.max() > 0:
            break
        chosen.append(int(np.argmax(distance)))
    capped = count is None and quick < intervals
    return X[chosen], min(len(chosen), first), min(len(chosen), quick), capped
