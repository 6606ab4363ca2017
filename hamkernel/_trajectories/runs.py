"""`Runs`: what was logged, with what is wrong with it said at once."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._trajectories.smoothing import Smoothing, processes, smoothed, smoothing

_GAP = 10.0  # times the median spacing: between such samples the path is a guess


class Runs(eqx.Module):
    """Logged runs of one system: states at times, with noise, gaps and uneven steps.

    Runs are kept as given; none is resampled. NaN means not measured: a whole coordinate, such as
    the momenta of a log of positions, or single entries.

    Args:
        times: for each run the times of its samples, shape (T,), strictly increasing.
        states: for each run the states, shape (T, n). Angles must be continuous: `np.unwrap`.
        inputs: for each run what was applied, u at the times, shape (T, m), for `learn` with a
            `Controlled` kernel; None if nothing.
        between: how inputs go on from a sample, as in `simulate`: "held" until the next, as a
            digital controller holds its command, or "linear", for a measured force or a smooth one.
            Where they were held and are taken for linear, they come half a sample early.
        parameters: for each run the θ of its system, shape (p,), for `learn` with a `Family`; None
            if all runs are of one system.

    A single run may be given as bare arrays (T,) and (T, n).

    Raises:
        ValueError: shapes do not fit, a run has one sample only, times do not increase, an entry is
            infinite, an input is NaN, or `between` is unknown. TypeError: something is not an array
            of real numbers.

    Warns:
        UserWarning: a jump of 2π, a long gap, a coordinate that never moves: once, with the run.
    """

    times: tuple[Float[Array, " T"], ...]
    states: tuple[Float[Array, "T n"], ...]
    inputs: tuple[Float[Array, "T m"], ...] | None
    between: Literal["held", "linear"] = eqx.field(static=True)
    parameters: tuple[Float[Array, " p"], ...] | None

    def __init__(
        self,
        times: Any,
        states: Any,
        inputs: Any = None,
        between: Literal["held", "linear"] = "held",
        parameters: Any = None,
    ):
        if hasattr(times, "ndim") and times.ndim == 1:  # one run
            times, states = [times], [states]
            inputs = None if inputs is None else [inputs]
            parameters = None if parameters is None else [parameters]
        times, states = list(times), list(states)
        inside = "Make it outside; the losses and hk.simulate work inside."
        require.untraced("hk.Runs", inside, times, states, inputs)
        _check_counts(times, states, inputs)
        self.times = tuple(_times(t, r) for r, t in enumerate(times))
        self.states = tuple(
            _rows(x, t, r, "states")
            for r, (x, t) in enumerate(zip(states, self.times, strict=True))
        )
        self.inputs = None
        if inputs is not None:
            pairs = zip(inputs, self.times, strict=True)
            self.inputs = tuple(_rows(u, t, r, "inputs") for r, (u, t) in enumerate(pairs))
            _check_inputs(self.inputs)
        if between not in ("held", "linear"):
            raise ValueError(f"between must be 'held' or 'linear'; got {between!r}.")
        self.between = between
        self.parameters = None if parameters is None else _members(parameters, len(times), inputs)
        _check_coordinates(self.states)
        _warn_of_oddities(self.times, self.states)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        samples = sum(len(t) for t in self.times)
        return f"Runs({len(self)} runs, {samples} samples, n={self.dimension})"

    @property
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""
        return self.states[0].shape[1]

    def velocities(
        self,
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n"], Int[Array, " N"]]:
        """Smoothed states X, their velocities Y, and the run of each, for `hk.fit` and `hk.tune`.

        Every coordinate is a Gaussian process in time (Matérn-7/2), whose lengthscale, amplitude
        and noise come from the marginal likelihood of all runs. Linear in the number of samples.
        `hk.learn` does better: it needs no velocities.

        Returns:
            X and Y, shape (N, n), N all samples of all runs, and labels (N,), 0, 1, … by run.

        Raises:
            ValueError: a coordinate was never measured.
        """
        times, states = self.on_host()
        self._check_measured()
        paths = smoothed(processes(times, states), times, states)
        lengths = [len(t) for t in times]
        X, Y = (
            jnp.asarray(np.concatenate([a[r, :T] for r, T in enumerate(lengths)]))
            for a in (paths.value, paths.slope)
        )
        return X, Y, jnp.asarray(np.repeat(np.arange(len(times)), lengths))

    def smoothing(self, between: int = 0) -> Smoothing:
        """The smoothed states and how far they may be off: what `hk.plot.smoothing` draws.

        The processes in time are those of `velocities`.

        Args:
            between: how many times between each two samples are smoothed besides.

        Raises:
            ValueError: `between` is negative. TypeError: it is no integer.
        """
        between = operator.index(between)
        if between < 0:
            raise ValueError(f"between must be 0 or more, got {between}.")
        return smoothing(*self.on_host(), between)

    def on_host(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Times and states as NumPy arrays of doubles."""
        return [np.asarray(t, float) for t in self.times], [
            np.asarray(x, float) for x in self.states
        ]

    def applied(self) -> list[np.ndarray]:
        """The inputs as NumPy arrays of doubles, shape (T, 0) where there are none.

        With parameters they are those of the run, at all of its times.
        """
        if self.parameters is not None:
            pairs = zip(self.parameters, self.times, strict=True)
            return [np.tile(np.asarray(theta, float), (len(t), 1)) for theta, t in pairs]
        if self.inputs is None:
            return [np.zeros((len(t), 0)) for t in self.times]
        return [np.asarray(u, float) for u in self.inputs]

    def _check_measured(self) -> None:
        for c in range(self.dimension):
            if not any(np.isfinite(np.asarray(x)[:, c]).any() for x in self.states):
                raise ValueError(
                    f"coordinate {c} was measured in no run, so it has no velocities. hk.learn(K, "
                    "runs, mean=f) finds it where f says how it moves the others, as q̇ = p/m does."
                )


def _check_counts(times: Sequence[Any], states: Sequence[Any], inputs: Any) -> None:
    if not times:
        raise ValueError("there are no runs: pass lists of arrays, one entry a run.")
    for name, other in (("states", states), ("inputs", inputs)):
        if other is not None and len(other) != len(times):
            raise ValueError(
                f"times has {len(times)} runs and {name} has {len(other)}: pass lists of equal "
                "length, one entry a run, times (T,) and states (T, n)."
            )


def _members(parameters: Any, count: int, inputs: Any) -> tuple[Float[Array, " p"], ...]:
    """The parameters of each run, finite and of one shape."""
    if inputs is not None:
        raise TypeError(
            "runs have inputs or parameters: those of a Controlled kernel or those of a Family. An "
            "input of a family may be one of the parameters of hk.fit."
        )
    length = len(parameters) if hasattr(parameters, "__len__") else None
    if length != count:
        got = "no entries" if length is None else f"{length} entries"
        raise ValueError(
            f"parameters has {got} and there are {count} runs: one θ of shape (p,) for each run is "
            "needed, such as [(0.5,), (0.8,)]."
        )
    rows = tuple(require.floating(t, f"parameters[{r}]") for r, t in enumerate(parameters))
    shapes = {theta.shape for theta in rows}
    if len(shapes) > 1 or rows[0].ndim != 1 or rows[0].size == 0:
        raise ValueError(
            f"parameters has entries of shape {', '.join(map(str, sorted(shapes)))}: one θ of "
            "shape (p,) for each run is needed, with one p, such as [(0.5,), (0.8,)]."
        )
    return tuple(require.finite(theta, f"parameters[{r}]") for r, theta in enumerate(rows))


def _times(t: Any, run: int) -> Float[Array, " T"]:
    t = require.floating(t, f"times[{run}]")
    if t.ndim != 1:
        raise ValueError(f"times[{run}] has shape {t.shape}; times of shape (T,) are needed.")
    if t.size < 2:
        raise ValueError(
            f"run {run} has {t.size} sample{'s' * (t.size != 1)}: at least two are needed to see "
            "anything move. Leave it out."
        )
    seen = np.asarray(t)
    if not np.isfinite(seen).all():
        raise ValueError(
            f"times[{run}] contains NaN or inf at {np.flatnonzero(~np.isfinite(seen))[0]}."
        )
    back = np.flatnonzero(np.diff(seen) <= 0)
    if back.size:
        i = int(back[0])
        raise ValueError(
            f"times[{run}] must increase; sample {i + 1}, at {seen[i + 1]:g}, does not come after "
            f"sample {i}, at {seen[i]:g} ({back.size} such). Sort by time and drop repeats; "
            "where a log starts anew, start a new run."
        )
    return t


def _rows(x: Any, t: Array, run: int, name: str) -> Float[Array, "T n"]:
    x = require.floating(x, f"{name}[{run}]")
    if x.ndim != 2 or len(x) != len(t) or x.shape[1] == 0:
        hint = ""
        if x.ndim == 2 and x.shape[1] == len(t):
            hint = f" It seems transposed: {name}[{run}].T."
        elif x.ndim == 1 and len(x) == len(t):
            hint = f" One row a sample: {name}[{run}][:, None]."
        raise ValueError(
            f"{name}[{run}] has shape {x.shape} and times[{run}] has shape {t.shape}; one row a "
            f"sample, shape ({len(t)}, {'n' if name == 'states' else 'm'}), is needed.{hint}"
        )
    if np.isinf(np.asarray(x)).any():
        raise ValueError(f"{name}[{run}] contains inf. Write NaN for what was not measured.")
    return x


def _check_coordinates(states: tuple[Array, ...]) -> None:
    sizes = {x.shape[1] for x in states}
    if len(sizes) > 1:
        raise ValueError(
            f"the runs have {sorted(sizes)} coordinates: all must be states of one system. Write "
            "NaN for coordinates that a run did not measure."
        )
    for run, x in enumerate(states):
        if not np.isfinite(np.asarray(x)).any():
            raise ValueError(f"nothing was measured in run {run}: leave it out.")


def _check_inputs(inputs: tuple[Array, ...]) -> None:
    sizes = {u.shape[1] for u in inputs}
    if len(sizes) > 1:
        raise ValueError(f"the runs have {sorted(sizes)} inputs: all need the same m.")
    for run, u in enumerate(inputs):
        if np.isnan(np.asarray(u)).any():
            raise ValueError(
                f"inputs[{run}] contains NaN at sample {np.argwhere(np.isnan(np.asarray(u)))[0][0]}"
                ": what was applied must be known at every sample. Repeat the command that was held"
                ", interpolate, or cut the run there."
            )


def _warn_of_oddities(times: tuple[Array, ...], states: tuple[Array, ...]) -> None:
    gaps, jumps, still = [], [], []
    for run, (t, x) in enumerate(zip(times, states, strict=True)):
        dt, x = np.diff(np.asarray(t)), np.asarray(x)
        if len(dt) > 2 and dt.max() > _GAP * np.median(dt):
            gaps.append(f"{dt.max():.3g} in run {run}, at a median spacing of {np.median(dt):.3g}")
        for c in range(x.shape[1]):
            if _is_wrapped(np.asarray(t), x[:, c]):
                jumps.append(f"coordinate {c} of run {run}")
    X = np.concatenate([np.asarray(x) for x in states])
    for c in range(X.shape[1]):
        column = X[np.isfinite(X[:, c]), c]
        if column.size and np.ptp(column) == 0:
            still.append(f"{c} (always {column[0]:g})")
    if jumps:
        require.warn(
            f"{_some(jumps)} jumps by about 2π: a wrapped angle. A field is learned along "
            "continuous paths; use np.unwrap(states[:, c]) before, and a kernel that is periodic, "
            "hk.Periodic or hk.Warp, where the field is."
        )
    if gaps:
        require.warn(
            f"a gap of {_some(gaps)}. The path inside a gap is known from the field alone; cut the "
            "run in two there if the system was moved meanwhile."
        )
    if still:
        require.warn(
            f"constant in all runs: coordinate {_some(still)}. Leave it out of the states."
        )


def _is_wrapped(t: Float[np.ndarray, " T"], x: Float[np.ndarray, " T"]) -> bool:
    """Whether x turns by 2π between samples that are else less than a third as far, as it goes."""
    t, x = t[np.isfinite(x)], x[np.isfinite(x)]
    near = np.diff(t) <= 3 * np.median(np.diff(t)) if len(t) > 1 else slice(0)
    step = np.abs(np.diff(x))[near]  # across a gap a momentum may go as far
    beyond = np.abs(step - 2 * np.pi)
    full = beyond < 2 * np.pi / 3
    if not full.any() or full.all():
        return bool(full.any() and beyond.max() < 0.7)
    others = step[~full].max()
    return bool(others < 2 * np.pi / 3 and beyond[full].max() < 0.7 + others)


def _some(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
