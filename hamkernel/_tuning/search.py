"""The search of `tune`: many runs on a few points, and a few runs on many points.

Each run starts on a subset of the points. The distinct ends of the runs are compared on a larger
subset, and the best two continue there with their approximate inverse Hessian. This repeats up to
all points. The price of a loss grows with the cube of the number of points, so the last subset
takes most of the time, although it makes only a few steps from one or two ends.
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Float

from hamkernel import _require as require
from hamkernel._machine import compiled_by_size
from hamkernel._observations.measurements import Measurements
from hamkernel._sizes import platform
from hamkernel._tuning.minimiser import BoxBFGS, MinimiserRun, init, minimise
from hamkernel._tuning.objective import SearchCriterion, SearchObjective, parts_of
from hamkernel._tuning.space import SearchSpace

_TOLERANCE = 1e-4  # the decrease of the logarithm of a loss that a finished run may have missed
_WARN_SECONDS = 60.0  # seconds; the caller is warned of a longer search
_CUBIC_COST_HINT = (
    "The price of the loss grows with the cube of N n: pass a part of the data and fit all of it "
    "with what is found, or a solver whose loss is of low rank, solver=hk.Nystrom() or "
    "solver=hk.RandomFeatures(count, key)."
)


@dataclasses.dataclass(frozen=True)
class Search:
    """A search from several starts, subset by subset.

    Attributes:
        space: the search space.
        criterion: the loss on all observations.
        rows: the rows of all observations, on one device.
        rms: the size of velocities, see `velocity_rms`.
        starts: the number of runs.
        max_steps: the largest number of optimiser steps of one run on one subset of the data.
        optimiser: an optimistix minimiser; None for `BoxBFGS`.
        progress: whether to print a line for each step.
        design_size: the number of points of the space-filling design from which the starts are
            chosen; by default 64 for each direction of the box, and 256 at most.
    """

    space: SearchSpace
    criterion: SearchCriterion
    rows: Measurements
    rms: float
    starts: int
    max_steps: int
    optimiser: optx.AbstractMinimiser | None
    progress: bool
    design_size: int | None = None

    @functools.cached_property
    def _points(self) -> Float[np.ndarray, "count P"]:
        """The point of the caller's kernel, and those of the design."""
        caller_point = np.asarray(self.space.encode_start(), float)[None]
        if self.starts == 1:
            return caller_point
        return np.append(caller_point, design(self.space.directions)[: self.design_size], axis=0)

    def runs(
        self, low_rank: Callable[[MinimiserRun], SearchCriterion] | None = None
    ) -> MinimiserRun:
        """The runs at the end of the search, one for each start, stacked.

        Args:
            low_rank: maps the best run so far to the criterion of the last part; None if dense.
        """
        parts = parts_of(self.rows, self.criterion, dense=low_rank is None)
        part = self._part(self.criterion, parts[0])
        only = len(parts) == 1 and low_rank is None
        # The tolerance is 1e-3 if more points follow. On seven problems of 120 points the number
        # of losses on the subset and on all points was 328 and 29 for 1e-2, 391 and 23 for 1e-3,
        # 476 and 22 for 1e-4, with the same fields.
        runs = self._first(part, _TOLERANCE if only else 1e-3)
        if only:
            return runs
        ends = _concatenate(_take(runs, _different(runs)), self._caller_run(part))
        last = parts[-1] if len(parts) > 2 else None
        for more in parts[1:]:
            steps = self.max_steps
            if more is last:
                # Two steps only. On all the data, further steps only overfit the folds: 1, 2, 3
                # and 6 steps lower the median loss (.0126, .0118, .0114, .0112) but not the field
                # error (.0025, .0025, .0026, .0026; pendulum, 141 runs, six seeds).
                steps, ends = 2, _take(ends, [0])
            growth = (len(more) / part.count) ** 3  # of one loss; some five losses follow
            self._warn_of_waiting(5 * growth * part.seconds, _CUBIC_COST_HINT)
            part = self._part(self.criterion, more)
            runs, ends = self._finish(part, ends, steps)
        if last is not None:
            runs = self._add_caller_run(part, runs)
        if low_rank is not None and runs.best.value.min() < np.inf:
            part = self._part(low_rank(best(runs)), np.arange(self.rows.count))
            runs, _ = self._finish(part, ends, self.max_steps)
        return runs

    def _part(self, criterion: SearchCriterion, chosen: np.ndarray) -> "Part":
        widths = self.starts + 1, len(self._points) + 1
        return Part(self.space, criterion, self.rows, self.rms, chosen, widths)

    def _caller_run(self, part: "Part") -> MinimiserRun:
        return part.init(self._minimiser(_TOLERANCE), self._points[:1])

    def _first(self, part: "Part", tolerance: float) -> MinimiserRun:
        """Runs from the caller's point and from the best points of a design."""
        minimiser, points = self._minimiser(tolerance), self._points
        runs_of_design = part.init(minimiser, points)
        # The first call compiles, so its time does not predict that of the next calls.
        runs = self._evaluate(part, _take(runs_of_design, [0]), minimiser)
        if self.starts > 1:
            design_runs = self._evaluate(
                part, _take(runs_of_design, np.arange(1, len(points))), minimiser
            )
            seconds = 25 * self.starts * part.seconds  # a run takes some 25 losses
            self._warn_of_waiting(seconds, f"Pass fewer starts than {self.starts}.")
            chosen = choose_starts(points[1:], design_runs.best.value, self.starts - 1)
            runs = _concatenate(runs, _take(design_runs, chosen))
        if self.criterion.custom:
            values = runs.best.value
            sizes = np.abs(values[(values != 0) & (np.abs(values) < np.inf)])
            part.set_unit(sizes[0] if len(sizes) else 1.0)
            runs = self._evaluate(part, part.init(minimiser, runs.best.u), minimiser)
        return self._descend(part, runs, minimiser, self.max_steps)

    def _finish(
        self, part: "Part", ends: MinimiserRun, steps: int
    ) -> tuple[MinimiserRun, MinimiserRun]:
        """Sort the ends by their losses on this part, and finish the best two there.

        The last of the ends is the caller's point. The second result holds the runs to compare on
        more points: the best one and the caller's point.
        """
        minimiser = self._minimiser(_TOLERANCE)
        runs = part.init(minimiser, ends.best.u).with_curvature_of(ends)
        runs = _sort(self._evaluate(part, runs, minimiser))
        # With only one end, the search missed the better of two optima whose losses on the subset
        # differ by a few per cent (96 points of `tuning_speed.py`, a loss 3 % larger).
        best_runs = self._descend(part, _take(runs, slice(2)), minimiser, steps)
        runs = _sort(_concatenate(best_runs, _take(runs, slice(2, None))))
        runs = _take(runs, slice(self.starts))
        return runs, _concatenate(_take(runs, [0]), self._caller_run(part))

    def _add_caller_run(self, part: "Part", runs: MinimiserRun) -> MinimiserRun:
        """The runs, with one more from the caller's point if its loss on all the data is smaller.

        A subset of the data can mislead. The check evaluates the loss once on all the data. For a
        pendulum with 1100 and 2200 points that took 9 % and 3 % of a first call, and 40 % and 60 %
        of a later call, when nothing had to be corrected.
        """
        minimiser = self._minimiser(_TOLERANCE)
        caller_run = self._evaluate(part, self._caller_run(part), minimiser)
        if caller_run.best.value[0] >= runs.best.value.min():
            return runs
        self._warn_of_waiting(25 * part.seconds, _CUBIC_COST_HINT)  # 25 losses, as in `_first`
        caller_run = self._descend(part, caller_run, minimiser, self.max_steps)
        return _take(_concatenate(caller_run, runs), slice(self.starts))

    def _minimiser(self, tolerance: float) -> optx.AbstractMinimiser:
        return BoxBFGS(atol=jnp.asarray(tolerance)) if self.optimiser is None else self.optimiser

    def _evaluate(
        self, part: "Part", runs: MinimiserRun, minimiser: optx.AbstractMinimiser
    ) -> MinimiserRun:
        """Evaluate the function at the current points of the runs."""
        if isinstance(minimiser, optx.AbstractQuasiNewton):  # the first step only evaluates
            return part.minimise(minimiser, runs, 1)
        bfgs = BoxBFGS(atol=jnp.asarray(_TOLERANCE))
        return runs._replace(best=part.minimise(bfgs, part.init(bfgs, runs.u), 1).best)

    def _descend(
        self, part: "Part", runs: MinimiserRun, minimiser: optx.AbstractMinimiser, steps: int
    ) -> MinimiserRun:
        """Step the runs until each has converged or used up its steps."""
        last_step = runs.steps.max() + steps
        while (active := runs.active & (runs.steps < last_step)).any():
            # A call makes one step, or as many as take a second, so that Ctrl-C works.
            steps = 1 if self.progress else max(1, int(1 / (part.seconds * active.sum())))
            steps = min(steps, int(last_step - runs.steps[active].max()))
            runs = _put(runs, active, part.minimise(minimiser, _take(runs, active), steps))
            if self.progress:
                self._say(part, runs, active.sum())
        return runs

    def _say(self, part: "Part", runs: MinimiserRun, active: int) -> None:
        sys.stdout.write(
            f"tune: {part.count} of {self.rows.count} points, step {runs.steps.max()}, "
            f"{active} of {len(runs.u)} runs, best loss {best(runs).best.loss:.6g}\n"
        )
        sys.stdout.flush()

    def _warn_of_waiting(self, seconds: float, cure: str) -> None:
        if _WARN_SECONDS < seconds < np.inf:
            require.warn(f"this search will take about {seconds / 60:.0f} minutes. {cure}")


def best(runs: MinimiserRun) -> MinimiserRun:
    """The run with the smallest value."""
    return _take(runs, int(np.argmin(runs.best.value)))


def _different(runs: MinimiserRun) -> list[int]:
    """The indices of the runs with distinct ends, the best first."""
    ends: list[int] = []
    for i in np.argsort(runs.best.value, kind="stable"):
        apart = [box_distance(runs.best.u[i], runs.best.u[j]) for j in ends]
        # Ends closer than a hundredth of the box are one, which saved 2 of 25 losses on all
        # points.
        if runs.best.value[i] < np.inf and min(apart, default=1.0) > 0.01:
            ends.append(int(i))
    return ends


def _sort(runs: MinimiserRun) -> MinimiserRun:
    return _take(runs, np.argsort(runs.best.value, kind="stable"))


def _map(function: Callable[..., Any], *runs: MinimiserRun) -> MinimiserRun:
    """Runs whose arrays are `function` of the arrays of all the `runs`."""
    static = eqx.filter(runs[0], eqx.is_array, inverse=True)
    return eqx.combine(jax.tree.map(function, *(eqx.filter(r, eqx.is_array) for r in runs)), static)


def _take(runs: MinimiserRun, which: Any) -> MinimiserRun:
    return _map(lambda array: array[which], runs)


def _put(runs: MinimiserRun, which: Any, moved: MinimiserRun) -> MinimiserRun:
    """The runs with `moved` in the places `which`."""

    def put(array: np.ndarray, part: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[which] = part
        return array

    return _map(put, runs, moved)


def _concatenate(first: MinimiserRun, second: MinimiserRun) -> MinimiserRun:
    return _map(lambda a, b: np.append(a, b, axis=0), first, second)


class Part:
    """The objective on a subset of the observations: one compiled program for all its runs.

    Attributes:
        count: the number of these observations.
        seconds: the shortest time of one step, without the first call, which compiles.
        objective: the function of u.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        rows: Measurements,
        rms: float,
        chosen: np.ndarray,
        widths: tuple[int, int],
    ):
        """Restrict the criterion and the rows to the observations `chosen`.

        The arrays of runs are padded to the larger of `widths`, so that one program serves all
        calls. Side by side the padding is computed too: there the runs that go on are padded to the
        smaller one, and have a program of their own.
        """
        self.seconds, self._compiled = np.inf, False
        self._widths = widths
        N = rows.count
        if len(chosen) < N:
            rows, chosen = rows.subset(chosen)
        self.count = rows.count
        numbers = (jnp.asarray(number, rows.targets.dtype) for number in (N / self.count, rms, 1.0))
        criterion = criterion.restrict(space.kernel, rows, chosen)
        self.objective = SearchObjective(space, criterion, rows, *numbers)

    def set_unit(self, unit: float) -> None:
        """Divide the caller's objective by `unit`, since tolerances assume values of size 1."""
        number = jnp.asarray(unit, self.objective.unit.dtype)
        self.objective = eqx.tree_at(lambda objective: objective.unit, self.objective, number)

    def init(
        self, minimiser: optx.AbstractMinimiser, us: Float[np.ndarray, "count P"]
    ) -> MinimiserRun:
        """Runs at points where the function has not been evaluated yet."""
        padded = np.resize(us, (self._widths[1], us.shape[1])).astype(jnp.result_type(float))
        runs = _init(self.objective, minimiser, padded)
        return _take(_map(np.asarray, runs), slice(len(us)))

    def minimise(
        self, minimiser: optx.AbstractMinimiser, runs: MinimiserRun, steps: int
    ) -> MinimiserRun:
        """The runs after up to `steps` more steps."""
        count, before = len(runs.u), runs.steps.sum()
        # On a CPU, runs one after the other took two thirds of the time of batched runs. On a GPU
        # a few hundred rows do not fill the device, so runs are batched.
        side_by_side = platform() != "cpu" and len(self.objective.rows.targets) <= 256
        width = self._widths[0 if side_by_side and count <= self._widths[0] else 1]
        padded = _take(runs, np.resize(np.arange(count), width))
        padded = padded._replace(active=padded.active & (np.arange(width) < count))
        began = time.perf_counter()
        moved = _minimise(self.objective, minimiser, padded, padded.steps + steps, side_by_side)
        moved = _take(_map(np.asarray, moved), slice(count))
        if self._compiled:
            taken = int(moved.steps.sum() - before)
            self.seconds = min(self.seconds, (time.perf_counter() - began) / max(taken, 1))
        self._compiled = True
        return moved


# On a GPU the first search of 300 points took 78 s with trials of products and 15.5 s without them.
# Later ones were as fast (NVIDIA H200).
_compiled = functools.partial(compiled_by_size, platforms=("gpu",))


@_compiled
def _init(objective, minimiser, us) -> MinimiserRun:
    return eqx.filter_vmap(functools.partial(init, minimiser, objective))(us)


@_compiled
def _minimise(objective, minimiser, runs: MinimiserRun, max_steps, side_by_side) -> MinimiserRun:
    """Step each run until it ends or has made `max_steps` steps."""
    arrays, static = eqx.partition(runs, eqx.is_array)

    def minimise_one(arrays, max_steps):
        run = minimise(minimiser, objective, eqx.combine(arrays, static), max_steps)
        return eqx.filter(run, eqx.is_array)

    across = (
        jax.vmap(minimise_one)
        if side_by_side
        else lambda *args: jax.lax.map(lambda e: minimise_one(*e), args)
    )
    return eqx.combine(across(arrays, max_steps), static)


# Where the runs start: the best points of a space-filling design of the box.


def design(directions: Sequence[int]) -> Float[np.ndarray, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d.

    Coordinates with the same direction move together, each through its own side. If the
    lengthscales of n coordinates moved independently, almost every point would have one lengthscale
    that is far too short or too long, and few starts would lead to a good optimum.
    """
    d = max(directions) + 1
    count = 64 * min(d, 4)
    root = 2.0
    for _ in range(64):  # the positive solution of root^(d + 1) = root + 1
        root = (1 + root) ** (1 / (d + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, d + 1))) % 1.0
    return np.arcsin(2 * share - 1)[:, list(directions)]


def choose_starts(
    points: Float[np.ndarray, "count P"], values: Float[np.ndarray, " count"], starts: int
) -> list[int]:
    """The indices of the best points of a design, no two of them neighbours."""
    reach = 0.25 * points.shape[1] ** 0.5  # of a box of side 1
    order = np.argsort(values, kind="stable")
    taken: list[int] = []
    for i in order:
        if all(box_distance(points[i], points[j]) >= reach for j in taken):
            taken.append(int(i))
    neighbours = [int(i) for i in order if i not in taken]  # neighbours, where the box is full
    return (taken + neighbours)[:starts]


def box_distance(u: Float[np.ndarray, " P"], v: Float[np.ndarray, " P"]) -> float:
    """The distance of two points in a box of side 1."""
    return float(np.linalg.norm(np.sin(u) - np.sin(v)) / 2)
