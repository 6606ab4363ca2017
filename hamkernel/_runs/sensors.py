"""Faults that sensors and controllers leave in a log: the rows of the table of `Runs.check`."""

import itertools
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hamkernel._runs.table import Diagnostic, Diagnostics


class Log(NamedTuple):
    """A log, one array a run.

    Attributes:
        times: times of the samples, shapes (T,).
        states: states at these times, shapes (T, n).
        inputs: inputs at their own times, shapes (P, m); empty if there are none.
        applied: inputs at the times of the states, shapes (T, m).
        names: names of the coordinates.
        input_names: names of the inputs.
    """

    times: Sequence[np.ndarray]
    states: Sequence[np.ndarray]
    inputs: Sequence[np.ndarray]
    applied: Sequence[np.ndarray]
    names: Sequence[str]
    input_names: Sequence[str]


def faults(log: Log) -> Diagnostics:
    """The table of faults of a log, one row for each kind."""
    rows = [_impossible(log), _outages(log), _wraps(log), _gaps(log), _constant(log)]
    rows += _sensors(log)
    if log.inputs:
        rows += [*_inputs(log), _feedback(log)]
    return Diagnostics(tuple(rows))


def _row(
    name: str, faults_found: Sequence[str], limit: str, meaning: str, advice: str
) -> Diagnostic:
    """A row of the table. It passes if `faults_found` is empty."""
    if not faults_found:
        return Diagnostic(name, "none", limit, True, "nothing of it in this log")
    return Diagnostic(name, _list(faults_found), limit, False, meaning, advice)


def _impossible(log: Log) -> Diagnostic:
    """The row of samples that a logger wrote in place of a measurement."""
    where = [np.flatnonzero(impossible_samples(x)) for x in log.states]
    count = sum(map(len, where))
    run = next((r for r, rows in enumerate(where) if len(rows)), 0)
    first = f"the first of them sample {where[run][0]} of run {run}" if count else ""
    return _row(
        "impossible samples",
        [f"{count}, {first}"] * bool(count),
        "20 deviations, or a row of zeros",
        f"{count} {'sample is' if count == 1 else 'samples are'} impossible beside "
        f"{'its' if count == 1 else 'their'} neighbours, {first}: a logger may have written -9999, "
        "65535 or zeros for a lost measurement",
        "Write NaN there; runs.impossible has the indices, by run.",
    )


def _wraps(log: Log) -> Diagnostic:
    """The row of angles and encoder counts that jump by a full turn."""
    where: dict[float, list[str]] = {}
    lost = False
    for run, (t, x) in enumerate(zip(log.times, log.states, strict=True)):
        real = np.where(impossible_samples(x)[:, None], np.nan, x)  # 65535 is no turn of 65536
        for c in range(x.shape[1]):
            period = wrapped_period(t, real[:, c])
            if period:
                where.setdefault(period, []).append(f"coordinate {log.names[c]} of run {run}")
                lost |= not np.isfinite(x[:, c]).all()
    full = {period: "2π" if period == 2 * np.pi else f"{period:g}" for period in where}
    option = "".join(f", period={full[period]}" for period in list(where)[:1] if period > 7)
    measured = (  # np.unwrap leaves NaN from the first lost sample on
        f" of the samples that were measured alone, ok = np.isfinite(q); q[ok] = "
        f"np.unwrap(q[ok]{option}), since after a NaN it leaves NaN"
    )
    jumps = "; ".join(f"{_list(places)} jumps by about {full[p]}" for p, places in where.items())
    return _row(
        "wrapped angles",
        [place for places in where.values() for place in places],
        "2π, 360, 4096, 65536",
        f"{jumps}: a wrapped angle",
        f"A field is learned along continuous paths; use np.unwrap(states[:, c]{option}) before"
        f"{measured if lost else ''}, and a kernel that is periodic, hk.Periodic or hk.Warp, "
        "where the field is.",
    )


def _gaps(log: Log) -> Diagnostic:
    """The row of long intervals without a sample."""
    faults_found = []
    for run, dt in enumerate(map(np.diff, log.times)):
        if len(dt) > 2 and dt.max() > 10 * np.median(dt):
            faults_found.append(
                f"{dt.max():.3g} in run {run}, at a median spacing of {np.median(dt):.3g}"
            )
    return _row(
        "gaps",
        faults_found,
        "10 spacings",
        f"a gap of {_list(faults_found)}",
        "The path inside a gap is known from the field alone; cut the run in two there if the "
        "system was moved meanwhile.",
    )


def _constant(log: Log) -> Diagnostic:
    """The row of coordinates that never move."""
    faults_found = []
    for name, column in zip(log.names, np.concatenate(log.states).T, strict=True):
        column = column[np.isfinite(column)]
        if column.size and np.ptp(column) == 0:
            faults_found.append(f"{name} (always {column[0]:g})")
    return _row(
        "constant",
        faults_found,
        "some motion",
        f"constant in all runs: coordinate {_list(faults_found)}",
        "Leave it out of the states.",
    )


_QUANTA = 4.0  # a coordinate that moves by more resolution steps does not repeat by rounding


def _sensors(log: Log) -> list[Diagnostic]:
    """The rows of coordinates that look clipped, dead, repeated or interpolated."""
    scale = np.array(
        [np.nanstd(x) if np.isfinite(x).any() else 0 for x in np.concatenate(log.states).T]
    )
    unit = np.where(scale > 0, scale, 1.0)
    clipped, dead, repeated, drawn = [], [], [], []
    for c in map(int, np.flatnonzero(scale)):
        columns, name = [x[:, c] for x in log.states], log.names[c]
        steps = [np.abs(np.diff(x[np.isfinite(x)])) for x in columns]
        moving = np.concatenate(steps)
        moving = moving[moving > 0]
        quantum = moving.min()
        ends = [f(np.concatenate(columns)) for f in (np.nanmin, np.nanmax)]
        flat = {end: sum(_plateaus(x, end, quantum) for x in columns) for end in ends}
        if max(flat.values()) >= 2:
            clipped += [f"{name} at {value:.4g}" for value, count in flat.items() if count]
            continue
        # A real log of a motor repeats a quarter of the positions, and is still useful.
        share = _repeats(steps)
        if share > 0.3 and np.median(moving) > _QUANTA * quantum:
            repeated.append(f"{name} ({share:.0%})")
            continue
        share = _straight(log.times, columns)
        ratios = moving / quantum
        is_digital = np.abs(ratios - np.round(ratios)).max() < 0.01
        if share > 0.4 and not is_digital:  # .5 if every other sample was interpolated
            drawn.append(f"{name} ({share:.0%})")
        for r, x in enumerate(columns):
            stretch = _stuck(x, np.delete(log.states[r] / unit, c, axis=1))
            if stretch is not None:
                a, b = (float(log.times[r][i]) for i in stretch)
                dead.append(f"{name} of run {r} from {a:.4g} to {b:.4g}")
    return _sensor_rows(clipped, dead, repeated, drawn)


def _outages(log: Log) -> Diagnostic:
    """The row of stretches in which all coordinates keep one value, between motions."""
    places = []
    for r, (t, x) in enumerate(zip(log.times, log.states, strict=True)):
        for first, stop in _outages_of(x[:, np.isfinite(x).any(axis=0)]):
            places.append(f"run {r} from {float(t[first]):.4g} to {float(t[stop]):.4g}")
    return _row(
        "outages",
        places,
        "twice the largest step",
        f"the log seems to stand still in {_list(places)}: all coordinates keep one value there, "
        "and then jump by more than twice their largest step elsewhere",
        "Write NaN for these samples.",
    )


def _outages_of(x: Float[np.ndarray, "T n"]) -> list[tuple[int, int]]:
    """The first and last rows of outages: three equal rows or more, between motion and a jump.

    If the system moves on at its largest speed while three samples are lost, the log then jumps by
    three of its largest steps. A body that comes to rest and is then struck is no outage: its last
    steps before the rest are as small as the resolution of the sensor.
    """
    steps = np.abs(np.diff(x, axis=0))
    equal = (steps == 0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(int)))
    pairs = edges.reshape(-1, 2)
    beside = np.zeros(len(steps), bool)
    for first, stop in pairs:
        beside[max(first - 1, 0) : stop + 1] = True
    ordinary = steps[~beside]
    if not (steps > 0).any() or not np.isfinite(ordinary).any(axis=0).all():
        return []
    largest = np.nanmax(ordinary, axis=0)
    quantum = np.nanmin(np.where(steps > 0, steps, np.inf), axis=0)
    outages = []
    for first, stop in pairs:
        if stop - first < 2 or first == 0 or stop == len(steps):
            continue
        ends = steps[[first - 1, stop]]
        if (ends[0] > _QUANTA * quantum).any() and (ends > 2 * largest).any():
            outages.append((int(first), int(stop)))
    return outages


def _sensor_rows(
    clipped: Sequence[str], dead: Sequence[str], repeated: Sequence[str], drawn: Sequence[str]
) -> list[Diagnostic]:
    return [
        _row(
            "clipped sensors",
            clipped,
            "two plateaus",
            f"a sensor seems clipped: coordinate {_list(clipped)} stays at its outermost value and "
            "arrives there at speed",
            "Write NaN for these samples; learning then finds the motion there.",
        ),
        _row(
            "dead sensors",
            dead,
            "one deviation of the others",
            f"a sensor seems dead: coordinate {_list(dead)} keeps one value while others move by "
            "more than a standard deviation",
            "Write NaN for these samples.",
        ),
        _row(
            "repeated samples",
            repeated,
            "30%",
            f"repeated samples: coordinate {_list(repeated)} often equals the previous sample, and "
            "otherwise changes by many steps of its resolution. The logger ran faster than the "
            "sensor, so times are late and the noise looks smaller than it is",
            "Keep the first of equal samples and write NaN for the others.",
        ),
        _row(
            "interpolated samples",
            drawn,
            "40%",
            f"interpolated samples: coordinate {_list(drawn)} lies on straight lines between some "
            "of its samples. Interpolated samples are no measurements, and the noise looks smaller "
            "than it is",
            "Give the samples at their own times: hk.Runs takes unequal sampling intervals.",
        ),
    ]


def _repeats(steps: Sequence[Float[np.ndarray, " _"]]) -> float:
    """The share of samples equal to the sample before, without stretches at rest.

    A stretch of equal values is a rest if it is a whole run, or more than ten times as long as the
    median stretch.
    """
    lengths, is_run = [], []
    for step in steps:
        ends = np.flatnonzero(np.concatenate([[True], step > 0, [True]]))
        lengths.append(np.diff(ends))
        is_run.append(np.full(len(ends) - 1, len(ends) == 2))
    length = np.concatenate(lengths)
    moves = ~np.concatenate(is_run) & (length <= 10 * np.median(length))
    return float(1 - moves.sum() / max(length[moves].sum(), 1))


def _straight(times: Sequence[np.ndarray], columns: Sequence[np.ndarray]) -> float:
    """The share of samples on the line through their neighbours, where the neighbours differ.

    The share is 0 if the angle is wrapped. It is also 0 if fewer than ten samples lie off their
    line, as in free motion with a few collisions.
    """
    off = [np.zeros(0)]
    for t, x in zip(times, columns, strict=True):
        if wrapped_period(t, x):
            return 0.0
        t, x = t[np.isfinite(x)], x[np.isfinite(x)]
        if len(t) > 2:
            line = x[:-2] + (x[2:] - x[:-2]) * (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
            off.append(np.abs(x[1:-1] - line)[x[2:] != x[:-2]])
    bent = np.concatenate(off) > 1e-9 * np.nanmax(np.abs(np.concatenate(columns)))
    return float(1 - bent.mean()) if bent.sum() >= 10 else 0.0


def _plateaus(x: Float[np.ndarray, " T"], value: float, quantum: float) -> int:
    """The number of plateaus: x arrives fast at its outermost value and stays three samples.

    A smooth maximum can also round to one value k times. Such a parabola falls by less than
    ((k + 2)/k)² resolution steps at the next sample, 2.8 for k = 3.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], x == value, [False]]).astype(int)))
    count = 0
    for first, stop in edges.reshape(-1, 2):
        if stop - first < 3 or first == 0 or stop == len(x):
            continue
        step = min(abs(x[first - 1] - value), abs(x[stop] - value))
        count += 1 if step > _QUANTA * quantum else 0
    return count


def _stuck(x: Float[np.ndarray, " T"], rest: Float[np.ndarray, "T rest"]):
    """The longest stretch of equal values (first, last), if the sensor was stuck there; else None.

    A sensor was stuck for six samples or more if another coordinate moves by more than one standard
    deviation meanwhile, and the sensor jumps before or after. A coarse encoder at a turning point
    changes by one step, the least difference of its values, and is not stuck.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], x[1:] == x[:-1], [False]]).astype(int)))
    if not edges.size or not rest.size:
        return None
    first, stop = max(edges.reshape(-1, 2), key=lambda pair: pair[1] - pair[0])
    part = rest[first : stop + 1]
    part = part[:, np.isfinite(part).all(axis=0)]
    if stop - first < 5 or not part.size or np.ptp(part, axis=0).max() < 1.0:
        return None
    changes = np.abs(np.diff(x))
    at_ends = np.concatenate([changes[first - 1 : first], changes[stop : stop + 1]])
    if not (at_ends > 1.5 * changes[changes > 0].min(initial=np.inf)).any():
        return None
    return first, stop


def _inputs(log: Log) -> list[Diagnostic]:
    """The rows of constant inputs, and of inputs with a combination that hardly changes.

    We scale the inputs to variance one. If the variance of a combination is below .01, the error of
    its gain is more than ten times as large as with independent inputs.
    """
    U = np.concatenate(log.inputs)
    none = np.ptp(U, axis=0) == 0
    varied, alike = np.flatnonzero(~none), []
    if len(varied) > 1:
        share, direction = (a[..., 0] for a in np.linalg.eigh(np.corrcoef(U[:, varied].T)))
        if share < 0.01:
            alike = [log.input_names[int(c)] for c in varied[np.abs(direction) > 0.1]]
    unless = "unless the matrix of the inputs is known, hk.Controlled(K, inputs=G)"
    still = [f"{log.input_names[int(c)]} (always {U[0, c]:g})" for c in np.flatnonzero(none)]
    return [
        _row(
            "constant inputs",
            still,
            "some change",
            f"constant in all runs: input {_list(still)}. The data cannot distinguish its effect "
            f"from the drift, {unless}",
            "Leave it out, or log runs in which it varies.",
        ),
        _row(
            "dependent inputs",
            alike,
            "1% of the variance",
            f"inputs {_list(alike)} depend on one another: a combination of them has less than 1 % "
            f"of their variance. The data cannot distinguish their gains, {unless}",
            "Leave out inputs that repeat others, or vary each on its own.",
        ),
    ]


def _feedback(log: Log) -> Diagnostic:
    """The row of inputs that are a smooth function of the states."""
    share = _free_of_states(np.concatenate(log.states), np.concatenate(log.applied))
    many = len(log.input_names) > 1
    error = 1 / np.sqrt(max(share, 1e-12))
    return Diagnostic(
        "feedback",
        f"{share:.2g} of the variance is free of the states",
        "0.1",  # here the error of a gain is √10 times as large as with an independent input
        share >= 0.1,
        "the inputs vary by themselves"
        if share >= 0.1
        else f"{'a combination of the inputs' if many else 'the input'} is a function of the "
        f"states but for {share:.2g} of its variance: feedback without excitation. Only this "
        f"remainder distinguishes gain and drift, and their errors are {error:.2g} times as large "
        "as with an independent input",
        "Add a known disturbance to the command, log other gains of the controller, or give the "
        "input matrix, hk.Controlled(K, inputs=[[0.0], [1.0]]).",
    )


def _free_of_states(X: Float[np.ndarray, "N n"], U: Float[np.ndarray, "N m"]) -> float:
    """The share of the variance of U that no cubic polynomial of X explains.

    This is the smallest share of all linear combinations of the inputs. It is 1 if there are too
    few data, if all inputs are constant, or if inputs depend on one another.
    """
    X = X[:, np.isfinite(X).any(axis=0)]
    use = np.isfinite(X).all(axis=1)
    if use.sum() < 2 or not X.size:
        return 1.0
    X, U = X[use], U[use] - U[use].mean(axis=0)
    Z = (X - X.mean(axis=0)) / np.where(X.std(axis=0) > 0, X.std(axis=0), 1.0)
    powers = [np.ones(len(Z))]
    for degree in range(1, 4):
        more = itertools.combinations_with_replacement(Z.T, degree)
        new = [np.prod(factors, axis=0) for factors in more]
        if 10 * (len(powers) + len(new)) > len(Z):
            break
        powers += new
    A = np.column_stack(powers)
    varied = U.std(axis=0) > 0
    if A.shape[1] == 1 or not varied.any():
        return 1.0
    residual = U - A @ np.linalg.lstsq(A, U, rcond=None)[0]
    R = np.linalg.qr(U[:, varied], mode="r")
    if np.abs(np.diag(R)).min() <= 1e-9 * np.abs(R).max():
        return 1.0  # inputs that depend on one another are refused by `learn`
    return float(np.linalg.svd(residual[:, varied] @ np.linalg.inv(R), compute_uv=False)[-1] ** 2)


class Timing(NamedTuple):
    """The growth of residuals r with the speed v: E r² = σ² + τ²v² if the times have errors.

    Attributes:
        score: the score test of τ = 0, N(0, 1) if the times are right.
        off: τ, the standard deviation of the errors of the times.
        share: the largest share of τ²v² in the variance of the residuals of a coordinate.
    """

    score: float
    off: float
    share: float

    @property
    def is_off(self) -> bool:
        """Whether the times have errors that cause a fifth of the residuals of a coordinate.

        Ten clean logs of a pendulum, 4 runs of 80 samples each, have scores of −1 to .6. Three logs
        with noise of .02 and errors of the times of .02 have scores of 12 to 16.
        """
        return self.score > 3 and self.share > 0.2


def timing(times: list[np.ndarray], residuals: list[np.ndarray], paths: list[np.ndarray]) -> Timing:
    """The growth of the residuals with the speed along the paths.

    We compare speeds within each run only, since a faster run may have larger noise.

    Args:
        times: the times of each run, shape (T,).
        residuals: the residuals, shape (T, n); NaN where nothing was measured.
        paths: the states along the paths, shape (T, n).
    """
    scores, weights, growths, ratios = [], [], [], []
    for c in range(paths[0].shape[1]):
        parts = []
        for t, residual, path in zip(times, residuals, paths, strict=True):
            r, v = residual[:, c] ** 2, np.gradient(path[:, c], t) ** 2
            r, v = r[np.isfinite(r)], v[np.isfinite(r)]
            if r.any():
                parts.append((r, r / r.mean(), v, v - v.mean()))
        if sum(len(part[0]) for part in parts) < 20:
            continue
        r, relative, v, d = (np.concatenate(column) for column in zip(*parts, strict=True))
        if not d.any():
            continue
        scores.append(relative @ d / np.sqrt(2 * d @ d))
        growths.append(r @ d / (d @ d))
        weights.append(d @ d / r.mean() ** 2)
        ratios.append(v.mean() / r.mean())
    if not scores:
        return Timing(0.0, 0.0, 0.0)
    growth = max(float(np.average(growths, weights=weights)), 0.0)
    return Timing(sum(scores) / len(scores) ** 0.5, growth**0.5, growth * max(ratios))


# Periods of wrapped angles and encoder counts: radians, degrees, and 12 and 16 bits.
_PERIODS = (2 * np.pi, 360.0, 4096.0, 65536.0)


def wrapped_period(t: Float[np.ndarray, " T"], x: Float[np.ndarray, " T"]) -> float:
    """The period at which x is wrapped; 0.0 if x is not wrapped.

    A wrapped x has steps of about the period, and all its other steps are less than a third of the
    period. In units other than radians the range of x must also be .8 to 1 periods.
    """
    t, x = t[np.isfinite(x)], x[np.isfinite(x)]
    near = np.diff(t) <= 3 * np.median(np.diff(t)) if len(t) > 1 else slice(0)
    for period in _PERIODS:
        step = np.abs(np.diff(x))[near] / period  # a momentum may change as much across a gap
        beyond = np.abs(step - 1)
        full = beyond < 1 / 3
        if not full.any() or (period > 7 and not 0.8 < np.ptp(x) / period <= 1.0):
            continue
        largest = 0.0 if full.all() else step[~full].max()
        if largest < 1 / 3 and beyond[full].max() < 0.111 + largest:
            return period
    return 0.0


def impossible_samples(x: Float[np.ndarray, "T n"]) -> Bool[np.ndarray, " T"]:
    """Whether each row of one run is impossible beside its neighbours.

    Let d be the distance of a sample from the mean of its two neighbours, and σ the standard
    deviation of d, estimated by the median so that one row in eight may be wrong. A row is
    impossible if in one coordinate the neighbours agree to d/5 and one of two conditions holds.
    - d > 20 σ, and the sample lies outside the 10 % and 90 % quantiles by more than twice their
      difference, such as −9999, 65535 or 1e30.
    - d > 6 σ, and the row, of two coordinates or more, is all zeros, which loggers write for a lost
      packet. Then all rows of zeros are impossible whose neighbours are not zeros.
    The first and the last row have one neighbour. In the first condition they must differ from it
    by more than 20 σ.
    """
    bad = np.zeros(len(x), bool)
    if len(x) < 5:
        return bad
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # columns that were never measured
        d = np.abs(x[1:-1] - (x[:-2] + x[2:]) / 2)
        sigma = 1.4826 * np.nanmedian(d, axis=0)
        alone = np.abs(x[2:] - x[:-2]) < d / 5
        low, high = (np.nanquantile(x, q, axis=0) for q in (0.1, 0.9))
        beyond = (x < low - 2 * (high - low)) | (x > high + 2 * (high - low))
        bad[1:-1] = (alone & (d > 20 * sigma) & beyond[1:-1]).any(axis=1)
        for end, inner in ((0, 1), (-1, -2)):
            bad[end] = (beyond[end] & (np.abs(x[end] - x[inner]) > 20 * sigma)).any()
        zero = (x == 0).all(axis=1) & (x.shape[1] > 1)
        if (zero[1:-1] & (alone & (d > 6 * sigma)).any(axis=1)).any():
            beside = np.pad(zero, 1)
            bad |= zero & ~(beside[:-2] | beside[2:])
    return bad


def is_on_a_curve(states: Sequence[Float[np.ndarray, "T n"]], noise: np.ndarray) -> bool:
    """Whether the momentum is a function of the position in the data of all runs, for n = 2.

    We fit p as a cubic of q. The share of the variance of p in the residual, after we subtract the
    noise of both sensors, must be below 2e-3. It is 1.6e-3 for a tank, and 9e-3 for a pendulum on a
    quarter of a swing (`tests/test_process_noise.py`).
    """
    X = np.concatenate(states)
    X = X[np.isfinite(X).all(axis=1)]
    if X.shape[1] != 2 or len(X) < 10:
        return False
    off = np.abs(X - np.median(X, axis=0))
    # Rows beyond 15 median deviations, ten standard deviations, are no measurements.
    X = X[(off <= 15 * np.median(off, axis=0)).all(axis=1)]
    q, p = (X - X.mean(axis=0)).T
    cubic = np.polynomial.polynomial.polyvander(q / max(q.std(), 1e-300), 3)
    rest = p - cubic @ np.linalg.lstsq(cubic, p, rcond=None)[0]
    slope = (q @ p) / max(q @ q, 1e-300)
    sensors = noise[1] ** 2 + (slope * noise[0]) ** 2
    # Noise of more than a tenth of the momenta would hide a curve, so we do not subtract it.
    sensors = sensors if sensors < 0.01 * p.var() else 0.0
    return bool(rest @ rest < 2e-3 * (p @ p) + 1.5 * len(X) * sensors)


def _list(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
