"""The runs before the field is learned: condensed, smoothed, completed.

Samples that are much closer in time than the motion needs are averaged in blocks. A block becomes
one sample in its middle: the smoothed path there plus the mean of the block's residuals, whose
noise is σ/√count. The bias of that sample is of second order in the error of the smoothed path. The
scatter of the block about its mean is kept, since it determines σ.
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
from hamkernel._trajectories.flow import NODES, with_tangent
from hamkernel._trajectories.runs import Between, Runs, at_nodes, at_samples
from hamkernel._trajectories.smoothing import Coordinate, interpolated, processes, smoothed

# Rows times columns², 1 to 2 s for each solve, and up to ten where half of what is left is said to
# be that of landmarks. 20 runs of 50 samples with n = 8 have 128 landmarks; with 256 a solve takes
# 6.5 s, and the field's error would be .0105 for .0145; with 512 and 768 it is .0105 too. 400 runs
# of a double pendulum have 640, and rollouts with an error of .0056; with 160 they have .033
# (`tests/benchmarks/capacity.py`).
_WORK, _MOST_WORK = 1e10, 5e10
_POINTS = 1024  # from which boxes are taken, and landmarks if there are not more intervals


class PreprocessedRun(NamedTuple):
    """One run, condensed.

    Attributes:
        times: since the first sample, shape (T,).
        states: NaN where nothing was measured, shape (T, n).
        counts: of the samples that an entry is the mean of, shape (T, n).
        scatter: the sum of their squared distances from it, shape (T, n).
        path: smoothed states at the times, no NaN, shape (T, n).
        nodes: the same at the Gauss nodes between them, shape (T − 1, 3, n).
        slopes: their velocities there.
        inputs: at both ends of each interval, shape (T − 1, 2, m); m is 0 where there are none.
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
        """The samples of a slice, and the intervals between them."""
        first, stop, _ = samples.indices(len(self.times))
        at, between = slice(first, stop), slice(first, stop - 1)
        return PreprocessedRun(
            self.times[at] - self.times[first],
            *(each[at] for each in (self.states, self.counts, self.scatter, self.path)),
            *(each[between] for each in (self.nodes, self.slopes, self.inputs)),
        )

    def joined(self, path: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T d"]:
        """Points (x, u) at the samples, for a path there."""
        return np.concatenate([path, at_samples(self.inputs)], axis=1)


class Preprocessed(NamedTuple):
    """All runs, with the processes of their coordinates.

    Attributes:
        runs: the condensed runs.
        noise: that of each coordinate as smoothing finds it, NaN where never measured.
        scale: the standard deviation of each coordinate, shape (n,).
        usable: which runs look like the others, shape (R,).
    """

    runs: list[PreprocessedRun]
    noise: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, " n"]
    usable: Bool[np.ndarray, " R"]


def preprocess(runs: Runs, mean: Callable[[Array], Array] | None) -> Preprocessed:
    """Condense, smooth and complete the runs; `mean` fills in what was never measured.

    With inputs it is a function of the points (x, u).
    """
    times, states = runs.on_host()
    times, states = [t - t[0] for t in times], [_thin_rests(x) for x in states]
    found, usable = _robust_processes(times, states)
    counts = [np.isfinite(x).astype(float) for x in states]
    scatter = [np.zeros_like(x) for x in states]
    lengths = [c.lengthscale for c in found if np.isfinite(c.process.log_amplitude)]
    # A pendulum of frequency ω has a lengthscale near 2.7/ω, so a tenth of it is 23 samples a
    # swing; three Gauss nodes in such an interval are exact to 1e-8, and samples at 5 Hz of a
    # pendulum of period 2.6 are left as they are.
    block = 0.1 * min(lengths, default=np.inf)
    if any(2 * np.median(np.diff(t)) < block for t in times):
        paths = smoothed(found, times, states)
        shortest = _shortest_block(sum(t[-1] for t in times), runs.dimension, runs.input_count)
        averaged = 0.5 * averaging_time(found, times, paths.deviation)
        block = min(block, max(averaged, shortest))
        averages = [
            condensed(t, x, paths.value[r, : len(t)], paths.slope[r, : len(t)], block)
            for r, (t, x) in enumerate(zip(times, states, strict=True))
        ]
        times, states, counts, scatter = (list(each) for each in zip(*averages, strict=True))
    shortest = min(lengths, default=np.inf)
    refined = [_refined(*run, shortest) for run in zip(times, states, counts, scatter, strict=True)]
    times, states, counts, scatter = (list(each) for each in zip(*refined, strict=True))
    inputs = [runs.applied(r, t + float(np.asarray(runs.times[r])[0])) for r, t in enumerate(times)]
    path_runs = _with_paths(found, times, states, counts, scatter, inputs)
    if not all(c.seen for c in found) or mean is not None:
        path_runs = [_completed(run, mean) for run in path_runs]
    noise = np.array([c.noise if c.seen else np.nan for c in found])
    good = [run.path for run, use in zip(path_runs, usable, strict=True) if use]
    scale = np.concatenate(good).std(axis=0)
    return Preprocessed(path_runs, noise, np.where(scale > 0, scale, 1.0), usable)


_REST = 10  # equal states, from which a system is at rest


def _thin_rests(x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
    """The states of a run, NaN inside of a stretch of equal ones.

    At rest a quantised sensor repeats one error, which is one measurement of the noise and not one
    for each sample: with one run in four at rest σ was found as √(3/4) of what it is.
    """
    same = (np.diff(x, axis=0) == 0) | np.isnan(x).all(axis=0)
    ends = np.flatnonzero(np.concatenate([[True], ~same.all(axis=1), [True]]))
    kept = x.copy()
    for first, stop in itertools.pairwise(ends):
        if stop - first > _REST:
            kept[first + 1 : stop - 1] = np.nan
    return kept


def averaging_time(found: list[Coordinate], times, deviation: Float[np.ndarray, "R T n"]) -> float:
    """The time of the σ²/Var x(t) samples that smoothing averages, the least of all coordinates.

    In a longer block the path bends with the noise, and the block's sample is not as exact as
    σ/√count says. On nine logs at 50 Hz of a driven pendulum the squares of the errors were 1.88,
    1.20, 1.07 and 1.00 times that for blocks of 1.6, 1.1, 0.8 and 0.5 of this time, and with the
    longest 10 of 20 clean logs were said to have process noise, or did not converge, for one.

    Args:
        found: the processes of the coordinates.
        times: those of each run.
        deviation: √Var x(t) of each coordinate at the times of each run.
    """
    spacing = np.median(np.concatenate([np.diff(t) for t in times]))
    there = np.concatenate([deviation[r, : len(t)] for r, t in enumerate(times)])
    counts = [
        (c.noise / max(float(np.median(there[:, i])), np.finfo(float).tiny)) ** 2
        for i, c in enumerate(found)
        if c.seen
    ]
    return float(spacing * min(counts, default=np.inf))


def _shortest_block(duration: float, n: int, inputs: int) -> float:
    """The shortest block whose rows can be afforded: without noise smoothing averages nothing."""
    columns = n * first_landmarks(n + inputs)
    return duration * n * columns**2 / _WORK


def with_inputs(data: Preprocessed, runs: Runs) -> Preprocessed:
    """The same runs with the inputs of `runs`, which may go on differently between samples."""
    return data._replace(
        runs=[
            run._replace(inputs=runs.applied(r, run.times + float(np.asarray(runs.times[r])[0])))
            for r, run in enumerate(data.runs)
        ]
    )


def decided(
    runs: Runs, data: Preprocessed, loss: Callable[[Preprocessed], float]
) -> tuple[Runs, Preprocessed]:
    """The likeliest way in which inputs go on between samples, and their likeliest delay.

    Args:
        runs: runs with between="auto", delay="fit", or both.
        data: the runs, preprocessed.
        loss: −log p of preprocessed runs.
    """
    kinds = get_args(Between) if runs.between == "auto" else (runs.between,)
    found = []

    def judge(between, delay: float) -> float:
        chosen = runs.going_on(between, delay)
        there = with_inputs(data, chosen)
        found.append((loss(there), chosen, there))
        return found[-1][0]

    for between in kinds:
        if runs.delay == "fit":
            _least(functools.partial(judge, between), _spacing(runs))
        else:
            judge(between, runs.delay)
    _, chosen, there = min(found, key=lambda each: each[0])
    return chosen, there


def _spacing(runs: Runs) -> float:
    """The median spacing of the inputs, or of the states where these are further apart."""
    assert runs.input_times is not None
    both = [*runs.times], [*runs.input_times]
    return max(float(np.median(np.concatenate([np.diff(t) for t in each]))) for each in both)


def _least(loss: Callable[[float], float], spacing: float) -> None:
    """Evaluate the loss near its minimum: downhill in whole spacings from 0, then by parabolas.

    −log p is nearly quadratic in the delay, so that a parabola through three points finds its
    minimum; a second and a third one through closer points settle it.
    """
    known = {d: loss(d) for d in (-spacing, 0.0, spacing)}
    while (best := min(known, key=known.__getitem__)) in (min(known), max(known)):
        if abs(best) > 20 * spacing:  # a delay of a whole swing is no delay
            return
        known[best + np.sign(best) * spacing] = loss(best + np.sign(best) * spacing)
    for reach in (spacing, spacing / 4, spacing / 16):
        best = min(known, key=known.__getitem__)
        left, right = (known.setdefault(d, loss(d)) for d in (best - reach, best + reach))
        bend = left - 2 * known[best] + right
        if not bend > 0:
            return
        vertex = best + reach * np.clip((left - right) / (2 * bend), -1, 1)
        known[vertex] = loss(vertex)


def _robust_processes(times, states) -> tuple[list[Coordinate], np.ndarray]:
    """The processes, without runs that are five times as far from them as the median run.

    In standard deviations of the states; up to a thousandth of those no run is left out, since of
    exact runs the smoother leaves that, most of it in the fastest one.
    """
    found = processes(times, states)
    if len(times) < 3:
        return found, np.ones(len(times), bool)
    paths = smoothed(found, times, states)
    every = np.concatenate(states)
    seen = np.isfinite(every).any(axis=0)
    spread = np.where(seen, np.nanstd(np.where(seen, every, 0.0), axis=0), 1.0)
    unit = np.where(spread > 0, spread, 1.0)
    far = np.array(
        [
            np.sqrt(np.nanmean(((x - paths.value[r, : len(x)]) / unit) ** 2))
            for r, x in enumerate(states)
        ]
    )
    usable = ~(far > max(5 * np.nanmedian(far), 1e-3))
    if usable.all():
        return found, usable
    chosen = np.flatnonzero(usable)
    return processes([times[r] for r in chosen], [states[r] for r in chosen]), usable


def condensed(t, x, path, slope, block: float):
    """Times, means, counts and scatter of blocks of samples that span at most `block`."""
    edges = [0]
    for i in range(1, len(t)):
        if t[i] - t[edges[-1]] >= block:
            edges.append(i)
    if len(edges) < 2:
        edges.append(len(t) // 2)
    seen = np.isfinite(x)
    residual = np.where(seen, x - path, 0.0)
    counts = np.add.reduceat(seen.astype(float), edges, axis=0)
    sizes = np.diff([*edges, len(t)])
    middle = np.add.reduceat(t, edges) / sizes
    means = np.add.reduceat(residual, edges, axis=0) / np.maximum(counts, 1)
    there = interpolated(middle, t, path, slope)
    about = np.where(seen, residual - np.repeat(means, sizes, axis=0), 0.0)
    scatter = np.add.reduceat(about**2, edges, axis=0)
    return middle, np.where(counts > 0, there + means, np.nan), counts, scatter


def _refined(t, x, counts, scatter, lengthscale: float):
    """The run, its long intervals cut at times at which nothing was measured.

    Three Gauss nodes do not see how a field varies along a third of a swing, and Gauss-Newton steps
    that trust them go uphill. Steps of Runge and Kutta are as many as the longest interval needs.
    Even runs are left as they are. Of positions on three orbits, 60 uneven times each, up to half a
    turn apart, process noise was found where there is none, and the field was off by 1.2 % along
    the motion; with it and the steps of `likelier` by .3 % (`tests/test_learn.py`).
    """
    spans = np.diff(t)
    usual = np.median(spans)
    # One radian: Gauss nodes, of order six, are exact to 1e-4/2⁶ there. Even runs are not cut.
    parts = np.ceil(spans / max(0.35 * lengthscale, 1.5 * usual))
    parts = np.clip(parts, 1, 16).astype(int)  # of a pause nothing is known in its midst
    at = np.append(0, np.cumsum(parts))
    fine = np.interp(np.arange(at[-1] + 1), at, t)
    fine[at] = t

    def placed(a: np.ndarray, empty: float) -> np.ndarray:
        out = np.full((len(fine), a.shape[1]), empty)
        out[at] = a
        return out

    return fine, placed(x, np.nan), placed(counts, 0.0), placed(scatter, 0.0)


def _with_paths(found, times, states, counts, scatter, inputs) -> list[PreprocessedRun]:
    """The smoothed path at the samples and at the nodes between them."""
    grids, filled = [], []
    for t, x in zip(times, states, strict=True):
        inside = t[:-1, None] + np.diff(t)[:, None] * NODES[None]
        grid = np.concatenate([np.column_stack([t[:-1], inside]).ravel(), t[-1:]])
        wide = np.full((len(grid), x.shape[1]), np.nan)
        wide[::4] = x
        grids.append(grid)
        filled.append(wide)
    paths = smoothed(found, grids, filled)
    out = []
    each = zip(times, states, counts, scatter, inputs, strict=True)
    for r, (t, x, count, about, ends) in enumerate(each):
        size = 4 * len(t) - 3
        value, slope = (a[r, :size] for a in (paths.value, paths.slope))
        nodes, slopes = (a[:-1].reshape(len(t) - 1, 4, -1)[:, 1:] for a in (value, slope))
        out.append(PreprocessedRun(t, x, count, about, value[::4], nodes, slopes, ends))
    return out


def _completed(run: PreprocessedRun, mean: Callable[[Array], Array] | None) -> PreprocessedRun:
    """The run with its unmeasured coordinates found from how they move the others.

    Given q̇ and a mean with q̇ = p/m, that is p = m q̇; in general Newton's method for the
    coordinates that explain the slopes.
    """
    missing = ~np.isfinite(run.states).any(axis=0)
    if not missing.any():
        return run
    if mean is None:  # known from other runs; the fit finds where this one started
        return run._replace(
            path=np.nan_to_num(run.path),
            nodes=np.nan_to_num(run.nodes),
            slopes=np.nan_to_num(run.slopes),
        )
    n = run.states.shape[1]
    nodes, slopes = run.nodes.reshape(-1, n), run.slopes.reshape(-1, n)
    u = np.asarray(at_nodes(run.inputs)).reshape(len(nodes), -1)
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
    """X with its missing coordinates such that the mean equals the slopes of the others."""
    on = jnp.asarray(missing)

    def one(x, u, slope):
        def step(x, _):
            f, D = with_tangent(mean, jnp.concatenate([x, u]), len(x))
            D = jnp.where(on[None, :] & ~on[:, None], D, 0.0)
            wrong = jnp.where(on, 0.0, slope - f)
            # In units in which every coordinate moves the others equally; one that moves none of
            # them stays where it is.
            unit = jnp.linalg.norm(D, axis=0)
            unit = jnp.where(unit > 0, unit, jnp.ones_like(unit))
            D = D / unit[None]
            A = D.T @ D + 1e-9 * jnp.eye(len(x), dtype=x.dtype)
            return x + jnp.linalg.solve(A, D.T @ wrong) / unit, None

        return jax.lax.scan(step, x, length=5)[0]

    return jax.lax.map(lambda each: one(*each), (X, U, slopes))


def sampled(
    data: Preprocessed, count: int = _POINTS
) -> tuple[Float[np.ndarray, "N d"], Float[np.ndarray, "N n"]]:
    """Points, (x, u) with inputs, and velocities of the smoothed runs at some of their nodes.

    Always as many, if need be some of them twice, so that other lengths do not compile anew.
    """
    n = len(data.scale)
    runs = [run for run, use in zip(data.runs, data.usable, strict=True) if use]
    points = [np.concatenate([run.nodes, at_nodes(run.inputs)], axis=-1) for run in runs]
    X = np.concatenate([each.reshape(-1, each.shape[-1]) for each in points])
    Y = np.concatenate([run.slopes.reshape(-1, n) for run in runs])
    chosen = np.linspace(0, len(X) - 1, count).round().astype(int)
    return X[chosen], Y[chosen]


def time_of_swing(data: Preprocessed) -> float:
    """2π times the median over coordinates of deviation over speed: the period of a sine."""
    speed = np.sqrt(np.mean(sampled(data)[1] ** 2, axis=0))
    return float(2 * np.pi * np.median(data.scale / np.maximum(speed, np.finfo(float).tiny)))


def first_landmarks(d: int) -> int:
    """With how many landmarks learning begins, for points of d coordinates."""
    # 45 for two coordinates and 80 for four were as good as all on ten runs of 10 s.
    return {1: 24, 2: 48, 3: 64, 4: 80}.get(d, 128)


def seconds_of_iteration(data: Preprocessed, count: int) -> float:
    """The time of an iteration with `count` landmarks: 2 rows · columns² operations.

    One core of 2025 makes 1e10 of them in a second: 19 billion took 1.6 s.
    """
    n = len(data.scale)
    rows = n * sum(len(run.times) for run in data.runs)
    return 2 * rows * (count * n) ** 2 / 1e10


def landmarks(
    data: Preprocessed, count: int | None
) -> tuple[Float[np.ndarray, "m d"], int, int, bool]:
    """Points of the paths, how many of them to begin with, how many are quick, and the cap.

    The last is whether quick ones are fewer than intervals.

    Each is the one farthest from those before, in standard deviations. They do not depend on
    hyperparameters, which are not known yet. There are at most as many as intervals: of a field on
    an interval its samples see the mean.

    Args:
        data: the runs.
        count: how many there are; if None, as many as are of use.
    """
    n, used = len(data.scale), zip(data.runs, data.usable, strict=True)
    intervals = max(sum(len(run.times) - 1 for run, use in used if use), 1)
    affordable = (np.array([_WORK, _MOST_WORK]) / (n * intervals)) ** 0.5 // n
    X, _ = sampled(data, max(_POINTS, min(intervals, 2 * int(affordable[1]))))
    first = first_landmarks(X.shape[1])
    # They are doubled: a last step to a few more would cost a compilation and a solve.
    affordable = first * 2 ** np.log2(np.maximum(affordable / first, 1)).astype(int)
    quick, most = np.maximum(first, np.minimum(intervals, affordable)).tolist()
    if count is not None:
        first = quick = most = count
    spread = X[:, n:].std(axis=0)  # of the inputs
    points = X / np.concatenate([data.scale, np.where(spread > 0, spread, 1.0)])[None]
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(most, len(points)):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        if not distance.max() > 0:
            break
        chosen.append(int(np.argmax(distance)))
    capped = count is None and quick < intervals
    return X[chosen], min(len(chosen), first), min(len(chosen), quick), capped
