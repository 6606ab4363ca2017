"""`Runs`: logged runs, their checks, and the inputs between their samples.

In each interval the input is a line, given by its values at the two ends, shape (…, 2, m). The line
of a held input is constant. If samples were averaged, an interval spans many samples of the log,
and the input bends inside it. The line is then the least-squares fit to the input, which has the
same impulse ∫u dt and the same first moment.

"smooth" is the natural quintic spline through the samples. Interpolation errors for a sinusoid are

    samples a period    4      6       12
    quintic spline      2e-3   1.3e-4  1.5e-6
    cubic spline        .08    .016    .001
    lines               .31    .14     .03

Band-limited interpolation Σ u_j sinc(t/h − j) is exact for an infinite sinusoid, but needs even
times. The inputs beyond the first and the last sample are unknown. The resulting error falls over k
samples as 1/k for band-limited interpolation, and as .43ᵏ for the quintic spline.
"""

from __future__ import annotations

import dataclasses
import operator
import reprlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.lib.recfunctions import unstructured_to_structured

from hamkernel import _require as require
from hamkernel._runs.flow import NODES
from hamkernel._runs.sensors import Log, faults, impossible_samples
from hamkernel._runs.smoothing import (
    Smoothing,
    processes,
    smooth_runs,
    smoothing,
)
from hamkernel._runs.table import Diagnostics
from hamkernel._show import describe, has_arrays

Between = Literal["held", "linear", "smooth"]


def spline(
    t: Float[np.ndarray, " T"], u: Float[np.ndarray, "T m"], at: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "P m"]:
    """The natural quintic spline through the samples, the interpolant with the least ∫(u‴)² dt.

    Through two samples the spline is a line. The unit of time is the median spacing, so that values
    and fourth derivatives have similar sizes in the matrix of the spline.
    """
    from scipy.interpolate import make_interp_spline  # here, so that hamkernel imports faster

    unit, free = np.median(np.diff(t)), [(d, np.zeros(u.shape[1])) for d in (3, 4)]
    degree, ends = (5, (free, free)) if len(t) > 2 else (1, None)
    through = make_interp_spline((t - t[0]) / unit, u, degree, bc_type=ends)
    return through((at - t[0]) / unit)


def values(
    t: Float[np.ndarray, " T"],
    u: Float[np.ndarray, "T m"],
    at: Float[np.ndarray, " P"],
    between: Between,
) -> Float[np.ndarray, "P m"]:
    """The inputs at the times `at`; constant before the first sample and after the last."""
    at = np.clip(at, t[0], t[-1])
    if between == "smooth":
        return spline(t, u, at)
    # A held input changes at a sample and keeps its value until the next one.
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1 - (between == "linear"))
    if between == "held":
        return u[i]
    share = (at - t[i]) / (t[i + 1] - t[i])
    return u[i] + share[:, None] * (u[i + 1] - u[i])


def lines_in_intervals(
    t: Float[np.ndarray, " T"],
    u: Float[np.ndarray, "T m"],
    at: Float[np.ndarray, " R"],
    between: Between,
) -> Float[np.ndarray, "R-1 2 m"]:
    """The least-squares line of the input in each interval of the times `at`, by its two ends.

    For u(σ) with −1 ≤ σ ≤ 1 the line is m₀ + 3 m₁ σ, with the moments m₀ = ½∫u dσ and m₁ = ½∫uσ dσ.
    We integrate over each piece between two times of `t` or `at` with four Gauss nodes, which are
    exact for a quintic times σ.
    """
    grid = np.union1d(t, at)
    grid = grid[(grid >= at[0]) & (grid <= at[-1])]
    lengths = np.diff(grid)
    x, w = np.polynomial.legendre.leggauss(4)
    nodes = grid[:-1, None] + lengths[:, None] * (1 + x[None]) / 2
    k = np.searchsorted(at, grid[:-1], side="right") - 1
    span = np.diff(at)[k]
    sigma = 2 * (nodes - at[k][:, None]) / span[:, None] - 1
    weights = (lengths / span)[:, None] * w[None] / 2
    there = values(t, u, nodes.ravel(), between).reshape(*nodes.shape, u.shape[1])
    first = np.searchsorted(grid, at[:-1])
    m0, m1 = (
        np.add.reduceat(np.einsum("pk,pkm->pm", w, there), first, axis=0)
        for w in (weights, weights * sigma)
    )
    return np.stack([m0 - 3 * m1, m0 + 3 * m1], axis=1)


def inputs_at_samples(ends: Float[np.ndarray, "intervals 2 m"]) -> Float[np.ndarray, "R m"]:
    """The inputs at the ends of the intervals; at a jump, the mean of both sides."""
    before, after = (
        np.concatenate([ends[:1, 0], ends[:, 1]]),
        np.concatenate([ends[:, 0], ends[-1:, 1]]),
    )
    return (before + after) / 2


def inputs_at_nodes(
    ends: Float[Array | np.ndarray, "*S 2 m"],
) -> Float[Array | np.ndarray, "*S 3 m"]:
    """The inputs at the three Gauss nodes of each interval."""
    shares = NODES.reshape((1,) * (ends.ndim - 2) + (3, 1))
    first, last = ends[..., :1, :], ends[..., 1:, :]
    return first + shares * (last - first)


class Runs(eqx.Module):
    """Logged runs of one system: states at times, with noise, gaps and uneven steps.

    `Runs` keeps the data as NumPy arrays of doubles, and resamples nothing. NaN means not measured,
    for single entries or for a whole coordinate, such as the momenta of a log of positions. Masked
    entries of NumPy and missing ones of pandas and polars become NaN. The names of columns stay in
    `names` and `input_names`, for printing and plotting. `check()` returns a table of the faults
    that sensors and controllers may have left in the log.

    Args:
        times: for each run the times of its samples, shape (T,), strictly increasing. One number is
            the sampling interval of all runs, which then begin at 0. One array (T,) beside states
            (R, T, n) holds the times of all R runs.
        states: for each run the states, shape (T, n), or (T,) for one coordinate. Angles must be
            continuous: `np.unwrap`.
        inputs: for each run the inputs u, for `learn` with a `Controlled` kernel. An array has the
            inputs at the times of the states, shape (T, m), or (T,) for one input. A pair (times,
            u), shapes (P,) and (P, m), has times of its own that span the run, such as a command at
            1 kHz beside a camera at 50 Hz. None if there are no inputs.
        between: the inputs between two samples. "held": constant until the next sample, as the
            command of a digital controller. "linear": for a measured force. "smooth": the quintic
            spline, for an input with 4 to 20 samples a period. "auto": `learn` takes the likeliest
            of the three, see `learned.runs`. To treat held inputs as linear advances them by half a
            sampling interval.
        parameters: for each run the θ of its system, shape (p,), for `learn` with a `Family`; None
            if all runs are of one system.
        delay: the time after which an input acts, in the unit of the times: u(t − delay) acts at
            time t. If "fit", `learn` finds the delay.

    A single run may be given as bare arrays or lists of numbers, (T,) and (T, n). Instead of an
    array (T, n) you may pass a mapping of names to columns (T,), such as a dictionary or a Dataset
    of xarray.

    Raises:
        ValueError: shapes do not fit, a run has one sample only or no measurement, times do not
            increase, a column of the states holds the times, or an entry is infinite. An input is
            NaN, or inputs do not span the states. `between` is unknown.
        TypeError: something is not an array of real numbers, or there are both inputs and
            parameters.

    Warns:
        UserWarning: once for each kind of fault. Faults of states are impossible samples, outages,
            jumps of 2π, 360, 4096 or 65536, long gaps, constant coordinates, and sensors that are
            clipped, dead, repeated or interpolated. Faults of inputs are constant or dependent
            inputs, and inputs that are a function of the states.
    """

    times: tuple[Float[np.ndarray, " T"], ...]
    states: tuple[Float[np.ndarray, "T n"], ...]
    inputs: tuple[Float[np.ndarray, "P m"], ...] | None
    input_times: tuple[Float[np.ndarray, " P"], ...] | None
    between: Between | Literal["auto"] = eqx.field(static=True)
    delay: float | Literal["fit"] = eqx.field(static=True)
    parameters: tuple[Float[Array, " p"], ...] | None
    names: tuple[str, ...] | None = eqx.field(static=True)
    input_names: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        times: Any,
        states: Any,
        inputs: Any = None,
        between: Between | Literal["auto"] = "held",
        parameters: Any = None,
        delay: float | Literal["fit"] = 0.0,
    ):
        times, states, inputs, parameters = map(_as_list, (times, states, inputs, parameters))
        if _is_one_run(times, states):
            times, states = [times], [states]
            inputs = None if inputs is None else [inputs]  # an array, or a pair (times, u)
            parameters = None if parameters is None else [parameters]
        states = _entries(states, "states")
        if _are_of_all_runs(times, states):
            times = [times] * len(states)
        times = _entries(times, "times")
        inputs = None if inputs is None else _entries(inputs, "inputs")
        inside = "Make it outside; the losses and hk.simulate work inside."
        require.no_tracers("hk.Runs", inside, times, states, inputs)
        _check_counts(times, states, inputs)
        times = [_sample_times(t, x) for t, x in zip(times, states, strict=True)]
        self.times = tuple(_times(t, r) for r, t in enumerate(times))
        self.states = tuple(
            _rows(x, t, r, "states")
            for r, (x, t) in enumerate(zip(states, self.times, strict=True))
        )
        if between not in (*get_args(Between), "auto"):
            raise ValueError(
                f"between must be 'held', 'linear', 'smooth' or 'auto'; got {between!r}."
            )
        self.between = between
        self.delay = "fit" if isinstance(delay, str) and delay == "fit" else _seconds(delay)
        self.names = _names(states, self.states, "states")
        self.inputs = self.input_times = self.input_names = None
        if inputs is not None:
            pairs = zip(inputs, self.times, strict=True)
            signals = [_signal(u, t, r) for r, (u, t) in enumerate(pairs)]
            self.input_times, self.inputs = (tuple(part) for part in zip(*signals, strict=True))
            _check_inputs(self.inputs)
            of_values = [
                u[1] if _is_pair(u, t) else u for u, t in zip(inputs, self.times, strict=True)
            ]
            self.input_names = _names(of_values, self.inputs, "inputs")
        self.parameters = None if parameters is None else _members(parameters, len(times), inputs)
        _check_coordinates(self.states)
        self._refuse_times()
        for row in self.check():
            if not row.passes:
                require.warn(f"{row.meaning}. {row.advice}")

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        if not has_arrays((self.times, self.states, self.inputs or ())):
            return describe(self)
        samples = sum(len(t) for t in self.times)
        said = [
            f"{len(self)} run{'s' * (len(self) != 1)}",
            f"{samples} samples",
            f"n={self.dimension}" + _name_list(self.names),
        ]
        if self.inputs is not None:
            said.append(f"m={self.input_count}{_name_list(self.input_names)} {self.between}")
            if self.delay != 0.0:
                delay = self.delay if isinstance(self.delay, str) else f"{self.delay:.4g}"
                said.append(f"delay={delay}")
        return f"Runs({', '.join(said)})"

    def check(self) -> Diagnostics:
        """A table of the faults that sensors and controllers may have left in the log.

        Each kind of fault has a row: impossible samples, outages, wrapped angles, gaps, constant
        coordinates, clipped and dead sensors, repeated and interpolated samples. With inputs there
        are rows for constant inputs, dependent inputs and feedback. A row has a value, its limit,
        its meaning and advice. `.failing` names the rows that fail; the constructor has warned of
        them.
        """
        times, states = self.host_arrays()
        inputs = [np.asarray(u, float) for u in self.inputs or ()]
        lines = [self.input_lines(r, t) for r, t in enumerate(times)] if inputs else []
        return faults(
            Log(
                times,
                states,
                inputs,
                [np.concatenate([ends[:, 0], ends[-1:, 1]]) for ends in lines],
                self.coordinate_names,
                self.input_names or [str(c) for c in range(self.input_count)],
            )
        )

    @property
    def impossible(self) -> tuple[Int[np.ndarray, " k"], ...]:
        """The indices of impossible samples in each run, such as −9999 or a row of zeros."""
        return tuple(np.flatnonzero(impossible_samples(x)) for x in self.host_arrays()[1])

    @property
    def dimension(self) -> int:
        """The number n of coordinates of a state."""
        return self.states[0].shape[1]

    def velocities(
        self,
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n"], Int[Array, " N"]]:
        """Smoothed states X, their velocities Y and run labels, for `hk.fit` and `hk.tune`.

        Each coordinate is a Gaussian process in time (Matérn-7/2). Its lengthscale, amplitude and
        noise maximise the marginal likelihood of all runs. The cost is linear in the number of
        samples. `hk.learn` is more accurate, since it needs no velocities.

        Returns:
            X and Y, shape (N, n), for all N samples of all runs, and labels 0, 1, … of the runs,
            shape (N,).

        Raises:
            ValueError: a coordinate was never measured.
        """
        times, states = self.host_arrays()
        self._check_measured()
        paths = smooth_runs(processes(times, states), times, states)
        lengths = [len(t) for t in times]
        X, Y = (
            jnp.asarray(np.concatenate([a[r, :T] for r, T in enumerate(lengths)]))
            for a in (paths.value, paths.slope)
        )
        return X, Y, jnp.asarray(np.repeat(np.arange(len(times)), lengths))

    def smoothing(self, between: int = 0) -> Smoothing:
        """The smoothed states with their standard deviations, as `hk.plot.smoothing` draws them.

        The Gaussian processes in time are those of `velocities`.

        Args:
            between: the number of additional times between two samples.

        Raises:
            ValueError: `between` is negative.
            TypeError: `between` is not an integer.
        """
        between = operator.index(between)
        if between < 0:
            raise ValueError(f"between must be 0 or more, got {between}.")
        return smoothing(*self.host_arrays(), between)

    def host_arrays(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Times and states as NumPy arrays of doubles."""
        return [np.asarray(t, float) for t in self.times], [
            np.asarray(x, float) for x in self.states
        ]

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """The names of the columns; 0, 1, … if the log has none."""
        return self.names or tuple(map(str, range(self.dimension)))

    @property
    def input_count(self) -> int:
        """The number of inputs or of parameters; 0 if there are none."""
        arrays = self.inputs or self.parameters
        return arrays[0].shape[-1] if arrays else 0

    @property
    def is_decided(self) -> bool:
        """Whether the caller chose both `between` and `delay`, so that `learn` need not."""
        return self.inputs is None or (self.between != "auto" and self.delay != "fit")

    def input_lines(self, run: int, at: Float[np.ndarray, " R"]) -> Float[np.ndarray, "R-1 2 m"]:
        """The least-squares line of the inputs in each interval of the times `at`, by its two ends.

        The parameters of a run are its inputs at all times. We treat between="auto" as "linear",
        and delay="fit" as 0.
        """
        if self.parameters is not None:
            return np.tile(np.asarray(self.parameters[run], float), (len(at) - 1, 2, 1))
        if self.inputs is None or self.input_times is None:
            return np.zeros((len(at) - 1, 2, 0))
        between = "linear" if self.between == "auto" else self.between
        delay = 0.0 if isinstance(self.delay, str) else self.delay
        t, u = (np.asarray(a[run], float) for a in (self.input_times, self.inputs))
        return lines_in_intervals(t, u, np.asarray(at) - delay, between)

    def going_on(self, between: Between | Literal["auto"], delay: float) -> "Runs":
        """The same runs with another `between` and `delay` of the inputs, without new checks."""
        return self._with(between=between, delay=delay)

    def part(self, of_runs: Sequence[slice]) -> "Runs":
        """The samples of each run in its slice; runs without samples there are dropped.

        All samples of the inputs stay, so that the inputs between samples do not change.
        """
        kept = [
            r
            for r, (t, of_run) in enumerate(zip(self.times, of_runs, strict=True))
            if len(t[of_run])
        ]

        def cut(arrays, slices=None):
            if arrays is None:
                return None
            return tuple(arrays[r] if slices is None else arrays[r][slices[r]] for r in kept)

        return self._with(
            times=cut(self.times, of_runs),
            states=cut(self.states, of_runs),
            inputs=cut(self.inputs),
            input_times=cut(self.input_times),
            parameters=cut(self.parameters),
        )

    def with_momenta(self) -> "Runs":
        """Runs of states (q, p) from runs of positions; the momenta are NaN."""
        states = tuple(np.concatenate([x, np.full_like(x, np.nan)], axis=1) for x in self.states)
        names = self.names and (*self.names, *(f"p of {name}" for name in self.names))
        return self._with(states=states, names=names)

    def _with(self, **changes: Any) -> "Runs":
        new = object.__new__(Runs)
        for field in dataclasses.fields(self):
            object.__setattr__(new, field.name, changes.get(field.name, getattr(self, field.name)))
        return new

    def _refuse_times(self) -> None:
        """Raise if a column of the states holds the times, as in `Runs(table[:, 0], table)`."""
        for c, name in enumerate(self.coordinate_names):
            pairs = zip(self.states, self.times, strict=True)
            if all(np.array_equal(x[:, c], t) for x, t in pairs):
                raise ValueError(
                    f"column {name} of the states holds the times: give the states alone, such as "
                    "table[:, 1:] or frame[['q', 'p']]."
                )

    def _check_measured(self) -> None:
        for c in range(self.dimension):
            if not any(np.isfinite(np.asarray(x)[:, c]).any() for x in self.states):
                raise ValueError(
                    f"coordinate {self.coordinate_names[c]} was measured in no run, so it has no "
                    "velocities. hk.learn(K, runs, mean=f) finds it if the velocity of another "
                    "coordinate in f depends on it, as in q̇ = p/m."
                )


def _as_list(values: Any) -> Any:
    """The values: an iterator becomes a list, and a mapping of columns a structured array."""
    return _named_columns(list(values) if isinstance(values, Iterator) else values)


def _named_columns(values: Any) -> Any:
    """A structured array for each mapping of columns, also inside a list; else `values`."""
    if isinstance(values, list | tuple) and any(isinstance(entry, Mapping) for entry in values):
        return type(values)(map(_named_columns, values))
    if not isinstance(values, Mapping) or not values:
        return values
    names = [str(name) for name in values]
    columns = [require.doubles(values[name], f"column {name!r}") for name in values]
    shapes = {column.shape for column in columns}
    if len(shapes) > 1 or columns[0].ndim != 1:
        said = ", ".join(f"{name} {c.shape}" for name, c in zip(names, columns, strict=True))
        raise ValueError(f"columns of one length, shape (T,), are needed; got {said}.")
    return unstructured_to_structured(np.stack(columns, axis=1), names=names)


def _depth(values: Any) -> int | None:
    """The number of axes of an array, a frame, or nested lists; None for anything else."""
    if hasattr(values, "shape"):
        return len(values.shape)
    if isinstance(values, list | tuple):
        return 1 + (_depth(values[0]) or 0) if len(values) else None
    return 0 if isinstance(values, int | float) else None


def _is_one_run(times: Any, states: Any) -> bool:
    """Whether `times` and `states` are of one run."""
    t, x = _depth(times), _depth(states)
    if x is None or x > 2:
        return False
    if t == 2 and x == 1:
        raise ValueError(
            "times have two axes and states one: they seem to be swapped, hk.Runs(times, states)."
        )
    if t == 0 and isinstance(states, list | tuple) and x == 2:  # of rows, or of runs
        return len(states[0]) < len(states)
    if t == 2 and hasattr(times, "shape"):  # a frame of one column
        return times.shape[1] == 1 and len(states) == len(times)
    return t in (0, 1)


def _are_of_all_runs(times: Any, states: Any) -> bool:
    """Whether `times` are one sampling interval, or the times of each run."""
    if _depth(times) == 1:
        return _depth(states) == 3 and len(times) == len(states[0])
    return _depth(times) == 0


def _entries(values: Any, name: str) -> list[Any]:
    """A list with one entry a run."""
    is_frame = hasattr(values, "columns") or hasattr(values, "data_vars")
    if isinstance(values, Iterable) and not isinstance(values, str | bytes | dict) and not is_frame:
        return list(values)
    got = f"one {type(values).__name__}" if is_frame else reprlib.repr(values)
    raise TypeError(
        f"{name} must be a list with one array a run, or the array of one run; got {got}."
    )


def _names(entries: Sequence[Any], arrays: Sequence[np.ndarray], of: str) -> tuple[str, ...] | None:
    """The names of the columns, the same in all runs; else None. Another order raises an error."""
    names = [_column_names(x, a.shape[1]) for x, a in zip(entries, arrays, strict=True)]
    for run, columns in enumerate(names):
        if columns and names[0] and columns != names[0] and sorted(columns) == sorted(names[0]):
            raise ValueError(
                f"the columns of {of}[0] are {', '.join(names[0])} and those of {of}[{run}] "
                f"{', '.join(columns)}: give all runs in one order."
            )
    return names[0] if all(columns == names[0] for columns in names) else None


def _column_names(values: Any, count: int) -> tuple[str, ...] | None:
    """The names of the columns of a frame, a structured array, or an array of xarray."""
    names = getattr(values, "columns", None)  # pandas and polars
    if names is None and getattr(values, "dims", None):  # xarray
        last = values.coords.get(values.dims[-1]) if len(values.dims) == 2 else None
        names = [values.name] if last is None else last.values
    elif names is None and hasattr(values, "to_numpy"):  # one column of pandas or polars
        names = [getattr(values, "name", None)]
    elif names is None:
        names = getattr(getattr(values, "dtype", None), "names", None)
    names = () if names is None else tuple(names)
    is_text = len(names) == count and all(isinstance(name, str) for name in names)
    return tuple(map(str, names)) if is_text else None


def _name_list(names: tuple[str, ...] | None) -> str:
    return f" ({', '.join(names)})" if names else ""


def _sample_times(times: Any, states: Any) -> Any:
    """The times of samples from 0 on, if `times` is a sampling interval; else `times`."""
    if _depth(times) != 0:
        return times
    interval = float(require.doubles(times, "the sampling interval"))
    if not 0 < interval < np.inf:
        raise ValueError(f"the sampling interval must be positive and finite; got {interval:g}.")
    return interval * np.arange(len(states))


def _check_counts(times: Sequence[Any], states: Sequence[Any], inputs: Any) -> None:
    if not times:
        raise ValueError("there are no runs: pass lists of arrays, one entry a run.")
    for name, entries in (("states", states), ("inputs", inputs)):
        if entries is not None and len(entries) != len(times):
            raise ValueError(
                f"times has {len(times)} runs and {name} has {len(entries)}: pass lists of equal "
                "length, one entry a run, times (T,) and states (T, n)."
            )


def _members(parameters: Any, count: int, inputs: Any) -> tuple[Float[Array, " p"], ...]:
    """The parameters of each run, finite and of one shape."""
    if inputs is not None:
        raise TypeError(
            "runs have inputs or parameters: those of a Controlled kernel or those of a Family. An "
            "input of a family may be one of the parameters of hk.fit."
        )
    if hasattr(parameters, "columns"):
        parameters = require.doubles(parameters, "parameters")  # one row a run
    length = len(parameters) if hasattr(parameters, "__len__") else None
    if length != count:
        got = "no entries" if length is None else f"{length} entries"
        raise ValueError(
            f"parameters has {got} and there are {count} runs: one θ of shape (p,) for each run is "
            "needed, such as [(0.5,), (0.8,)]."
        )
    rows = tuple(
        jnp.atleast_1d(require.floating(t, f"parameters[{r}]")) for r, t in enumerate(parameters)
    )
    shapes = {theta.shape for theta in rows}
    if len(shapes) > 1 or rows[0].ndim != 1 or rows[0].size == 0:
        raise ValueError(
            f"parameters has entries of shape {', '.join(map(str, sorted(shapes)))}: one θ of "
            "shape (p,) for each run is needed, with one p, such as [(0.5,), (0.8,)]."
        )
    return tuple(require.finite(theta, f"parameters[{r}]") for r, theta in enumerate(rows))


def _times(t: Any, run: int, of: str = "states") -> Float[np.ndarray, " T"]:
    name = f"times[{run}]" if of == "states" else f"the times of {of}[{run}]"
    dtype, t = getattr(t, "dtype", None), require.doubles(t, name)
    t = t[:, 0] if t.ndim == 2 and t.shape[1] == 1 else t  # a frame of one column
    if t.ndim != 1:
        raise ValueError(f"{name} has shape {t.shape}; times of shape (T,) are needed.")
    if t.size < 2:
        raise ValueError(
            f"run {run} has {t.size} sample{'s' * (t.size != 1)}: at least two are needed to see "
            "anything move. Leave it out."
        )
    if not np.isfinite(t).all():
        raise ValueError(f"{name} contains NaN or inf at {np.flatnonzero(~np.isfinite(t))[0]}.")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        i = int(back[0])
        cure = "Sort by time and drop repeats; where a log starts anew, start a new run."
        if dtype == np.float32 and (np.diff(t) >= 0).all() and abs(t[i]) > 1e5:
            step = np.spacing(np.float32(t[i]))
            cure = (
                f"They are float32, which tells times near {t[i]:g} apart by {step:g} only: pass "
                "NumPy arrays of float64, or subtract the first time before they are rounded."
            )
        raise ValueError(
            f"{name} must increase; sample {i + 1}, at {t[i + 1]:g}, does not come after "
            f"sample {i}, at {t[i]:g} ({back.size} such). {cure}"
        )
    return t


def _rows(x: Any, t: np.ndarray, run: int, name: str) -> Float[np.ndarray, "T n"]:
    x = require.doubles(x, f"{name}[{run}]")
    x = x[:, None] if x.ndim == 1 and len(x) == len(t) else x
    if x.ndim != 2 or len(x) != len(t) or x.shape[1] == 0:
        hint, columns = "", "n" if name == "states" else "m"
        if x.ndim == 2 and x.shape[1] == len(t):
            hint = f" It seems transposed: {name}[{run}].T."
        elif x.ndim == 1 and len(x) and len(x) % len(t) == 0:
            hint = f" Rows of one flat list: np.reshape(values, ({len(t)}, {len(x) // len(t)}))."
        elif name == "inputs" and x.ndim == 2:
            hint = (
                " Inputs with times of their own are pairs, inputs=[(times, u), …]. If only the "
                "last input is missing, repeat the one before."
            )
        raise ValueError(
            f"{name}[{run}] has shape {x.shape} and times[{run}] has shape {t.shape}; the shape "
            f"must be ({len(t)}, {columns}), one row for each sample.{hint}"
        )
    if np.isinf(np.asarray(x)).any():
        raise ValueError(f"{name}[{run}] contains inf. Write NaN for what was not measured.")
    return x


def _seconds(delay: Any) -> float:
    if isinstance(delay, bool | str | None) or np.ndim(delay):
        raise TypeError(f"delay must be a number, or 'fit'; got {delay!r}.")
    delay = require.doubles(delay, "delay")
    if not np.isfinite(delay):
        raise ValueError(f"delay must be finite; got {delay!r}.")
    return float(delay)


def _is_pair(u: Any, t: np.ndarray) -> bool:
    """Whether the inputs of a run with the times t are a pair (times, u)."""
    return isinstance(u, tuple) or (
        isinstance(u, list) and len(u) == 2 != len(t) and _depth(u[0]) == 1
    )


def _signal(
    u: Any, t: np.ndarray, run: int
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, "P m"]]:
    """The times and values of the inputs of one run whose states have the times t."""
    if not _is_pair(u, t):
        return t, _rows(u, t, run, "inputs")
    if len(u) != 2:
        raise ValueError(
            f"inputs[{run}] is a tuple of {len(u)}: give an array (T, m), or (times, u)."
        )
    input_times = _times(u[0], run, "inputs")
    values = _rows(u[1], input_times, run, "inputs")
    spacing = float(np.median(np.diff(np.asarray(input_times))))
    # A held command lasts until the next one, so one more spacing after the last command is known.
    for name, missing, end in (
        ("begin", input_times[0] - t[0], (input_times[0], t[0])),
        ("end", t[-1] - input_times[-1], (input_times[-1], t[-1])),
    ):
        if missing > 1.001 * spacing:
            raise ValueError(
                f"the inputs of run {run} {name} at {float(end[0]):g} and its states at "
                f"{float(end[1]):g}: the inputs must be known over the whole run. Cut the states, "
                "or repeat the command that was held."
            )
    return input_times, values


def _check_coordinates(states: tuple[np.ndarray, ...]) -> None:
    sizes = {x.shape[1] for x in states}
    if len(sizes) > 1:
        raise ValueError(
            f"the runs have {sorted(sizes)} coordinates: all must be states of one system. Write "
            "NaN for coordinates that a run did not measure."
        )
    for run, x in enumerate(states):
        if not np.isfinite(np.asarray(x)).any():
            raise ValueError(f"nothing was measured in run {run}: leave it out.")


def _check_inputs(inputs: tuple[np.ndarray, ...]) -> None:
    sizes = {u.shape[1] for u in inputs}
    if len(sizes) > 1:
        raise ValueError(f"the runs have {sorted(sizes)} inputs: all need the same m.")
    for run, u in enumerate(inputs):
        if np.isnan(np.asarray(u)).any():
            raise ValueError(
                f"inputs[{run}] contains NaN at sample {np.argwhere(np.isnan(np.asarray(u)))[0][0]}"
                ": the inputs must be known at every sample. Repeat the command that was held"
                ", interpolate, or cut the run there."
            )
