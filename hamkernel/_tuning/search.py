"""The search of `tune`: many runs on few points, and few on many.

The runs are made on a subset of the points. Those of their ends that differ are compared on more
points, and the best two are continued there, with the curvature that they have learned; and so on,
up to all points. The price of a loss grows with the cube of the number of points, so the last part
takes most of the time although it makes few steps from one or two ends.
"""

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
from hamkernel._machine import compiled
from hamkernel._observations.measurements import Measurements
from hamkernel._sizes import platform
from hamkernel._tuning.minimiser import BoxBFGS, MinimiserRun, begun, minimised
from hamkernel._tuning.objective import SearchCriterion, SearchObjective, parts_of
from hamkernel._tuning.space import SearchSpace

_TOLERANCE = 1e-4  # the decrease of the logarithm of a loss that a finished run may have missed
_LONG = 60.0  # seconds; the caller is warned of a longer search
_CUBIC = (
    "The price of the loss grows with the cube of N n: pass a part of the data and fit all of it "
    "with what is found, or a solver whose loss is of low rank, solver=hk.Nystrom() or "
    "solver=hk.RandomFeatures(count, key)."
)


class Search:
    """The runs, part by part.

    Args:
        space: where.
        criterion: of all observations.
        rows: their rows, on one device.
        rms: the size of velocities, see `velocity_rms`.
        starts: the number of runs.
        max_steps: of one run, on each part.
        optimiser: one of optimistix, or None for `BoxBFGS`.
        progress: whether to print how it goes.
        looks: the number of points at which a search of several starts looks first; by default 64
            for each direction of the box, and 256 at most.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        rows: Measurements,
        rms: float,
        starts: int,
        max_steps: int,
        optimiser: optx.AbstractMinimiser | None,
        progress: bool,
        looks: int | None = None,
    ):
        self.space, self.criterion, self.rows, self.rms = space, criterion, rows, rms
        self.starts, self.max_steps = starts, max_steps
        self.optimiser, self.progress = optimiser, progress
        given = np.asarray(space.encode_start(), float)[None]
        self._points = (
            given if starts == 1 else np.append(given, design(space.directions)[:looks], axis=0)
        )

    def runs(
        self, low_rank: Callable[[MinimiserRun], SearchCriterion] | None = None
    ) -> MinimiserRun:
        """The runs where the search ends, one for each start, stacked.

        Args:
            low_rank: the criterion of the last part, given the best run before; None if dense.
        """
        parts = parts_of(self.rows, self.criterion, dense=low_rank is None)
        part = self._part(self.criterion, parts[0])
        only = len(parts) == 1 and low_rank is None
        # 1e-3 where it goes on with more points: on seven problems of 120 points this took 391
        # losses of the subset and 23 of all points; 1e-2 took 328 and 29, 1e-4 476 and 22, with the
        # same fields.
        runs = self._first(part, _TOLERANCE if only else 1e-3)
        if only:
            return runs
        ends = _concatenated(_take(runs, _different(runs)), self._given(part))
        last = parts[-1] if len(parts) > 2 else None
        for more in parts[1:]:
            steps = self.max_steps
            if more is last:
                # It only corrects the best that the second part found. On so many points the loss
                # follows what happens to be held out: with 1, 2, 3 and 6 steps the median loss of
                # 141 runs of a pendulum, six seeds, was .0126, .0118, .0114 and .0112, and the
                # median field error .0025, .0025, .0026 and .0026.
                steps, ends = 2, _take(ends, [0])
            growth = (len(more) / part.count) ** 3  # and some five losses
            self._warn_of_waiting(5 * growth * part.seconds, _CUBIC)
            part = self._part(self.criterion, more)
            runs, ends = self._finished(part, ends, steps)
        if last is not None:
            runs = self._no_worse_than_given(part, runs)
        if low_rank is not None and runs.best.value.min() < np.inf:
            part = self._part(low_rank(best(runs)), np.arange(self.rows.count))
            runs, _ = self._finished(part, ends, self.max_steps)
        return runs

    def _part(self, criterion: SearchCriterion, chosen: np.ndarray) -> "Part":
        return Part(self.space, criterion, self.rows, self.rms, chosen, len(self._points))

    def _given(self, part: "Part") -> MinimiserRun:
        return part.begun(self._minimiser(_TOLERANCE), self._points[:1])

    def _first(self, part: "Part", tolerance: float) -> MinimiserRun:
        """A run from the caller's point, and from the best points of a design."""
        minimiser, points = self._minimiser(tolerance), self._points
        begun = part.begun(minimiser, points)
        # The first call compiles, and says nothing of how long the next will take.
        runs = self._looked_at(part, _take(begun, [0]), minimiser)
        if self.starts > 1:
            others = self._looked_at(part, _take(begun, np.arange(1, len(points))), minimiser)
            seconds = 25 * self.starts * part.seconds  # a run takes some 25 losses
            self._warn_of_waiting(seconds, f"Pass fewer starts than {self.starts}.")
            chosen = spread_out(points[1:], others.best.value, self.starts - 1)
            runs = _concatenated(runs, _take(others, chosen))
        if self.criterion.custom:
            values = runs.best.value
            sizes = np.abs(values[(values != 0) & (np.abs(values) < np.inf)])
            part.measure_in(sizes[0] if len(sizes) else 1.0)
            runs = self._looked_at(part, part.begun(minimiser, runs.best.u), minimiser)
        return self._descended(part, runs, minimiser, self.max_steps)

    def _finished(
        self, part: "Part", ends: MinimiserRun, steps: int
    ) -> tuple[MinimiserRun, MinimiserRun]:
        """The ends in the order of their losses on these points, with the best two finished there.

        The last of the ends is the caller's point. The second result holds the runs to be compared
        on more points: the best one and the caller's point.
        """
        minimiser = self._minimiser(_TOLERANCE)
        runs = part.begun(minimiser, ends.best.u).going_on_from(ends)
        runs = _sorted(self._looked_at(part, runs, minimiser))
        # Two ends are finished: with one, the better of two optima that are within a few per cent
        # on the subset was missed (96 points of `tuning_speed.py`, a loss 3 % larger).
        finished = self._descended(part, _take(runs, slice(2)), minimiser, steps)
        runs = _sorted(_concatenated(finished, _take(runs, slice(2, None))))
        runs = _take(runs, slice(self.starts))
        return runs, _concatenated(_take(runs, [0]), self._given(part))

    def _no_worse_than_given(self, part: "Part", runs: MinimiserRun) -> MinimiserRun:
        """These runs, and one from the caller's point if that is better than where they end.

        A part of the data can mislead. To see it takes one step on all data, which the first call
        with 1100 and 2200 points of a pendulum paid with 9 and 3 per cent more time, where the best
        of the second part needed no correction, and later calls with 40 and 60.
        """
        minimiser = self._minimiser(_TOLERANCE)
        given = self._looked_at(part, self._given(part), minimiser)
        if given.best.value[0] >= runs.best.value.min():
            return runs
        self._warn_of_waiting(25 * part.seconds, _CUBIC)  # as `_first` reckons
        given = self._descended(part, given, minimiser, self.max_steps)
        return _take(_concatenated(given, runs), slice(self.starts))

    def _minimiser(self, tolerance: float) -> optx.AbstractMinimiser:
        return BoxBFGS(atol=jnp.asarray(tolerance)) if self.optimiser is None else self.optimiser

    def _looked_at(
        self, part: "Part", runs: MinimiserRun, minimiser: optx.AbstractMinimiser
    ) -> MinimiserRun:
        """The runs with the values at their points."""
        if isinstance(minimiser, optx.AbstractQuasiNewton):  # its first step does no more
            return part.minimised(minimiser, runs, 1)
        bfgs = BoxBFGS(atol=jnp.asarray(_TOLERANCE))
        return runs._replace(best=part.minimised(bfgs, part.begun(bfgs, runs.u), 1).best)

    def _descended(
        self, part: "Part", runs: MinimiserRun, minimiser: optx.AbstractMinimiser, steps: int
    ) -> MinimiserRun:
        """The runs once each has converged or used up its steps."""
        most = runs.steps.max() + steps
        while (going := runs.going & (runs.steps < most)).any():
            # A call takes a second at most, or one step, so that Ctrl-C is heard.
            few = 1 if self.progress else max(1, int(1 / (part.seconds * going.sum())))
            runs = part.minimised(minimiser, runs, min(few, int(most - runs.steps[going].max())))
            if self.progress:
                self._say(part, runs, going.sum())
        return runs

    def _say(self, part: "Part", runs: MinimiserRun, going: int) -> None:
        sys.stdout.write(
            f"tune: {part.count} of {self.rows.count} points, step {runs.steps.max()}, "
            f"{going} of {len(runs.u)} runs, best loss {best(runs).best.loss:.6g}\n"
        )
        sys.stdout.flush()

    def _warn_of_waiting(self, seconds: float, cure: str) -> None:
        if _LONG < seconds < np.inf:
            require.warn(f"this search will take about {seconds / 60:.0f} minutes. {cure}")


def best(runs: MinimiserRun) -> MinimiserRun:
    """The run that found the least value."""
    return _take(runs, int(np.argmin(runs.best.value)))


def _different(runs: MinimiserRun) -> list[int]:
    """The runs, from the best on, that did not end where a better one did."""
    ends: list[int] = []
    for i in np.argsort(runs.best.value, kind="stable"):
        apart = [shares_apart(runs.best.u[i], runs.best.u[j]) for j in ends]
        # Ends within a hundredth of the box count as one, which saved 2 of 25 losses of all points.
        if runs.best.value[i] < np.inf and min(apart, default=1.0) > 0.01:
            ends.append(int(i))
    return ends


def _sorted(runs: MinimiserRun) -> MinimiserRun:
    return _take(runs, np.argsort(runs.best.value, kind="stable"))


def _take(runs: MinimiserRun, which: Any) -> MinimiserRun:
    arrays, static = eqx.partition(runs, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda a: a[which], arrays), static)


def _concatenated(one: MinimiserRun, other: MinimiserRun) -> MinimiserRun:
    arrays, static = eqx.partition(one, eqx.is_array)
    others = eqx.filter(other, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda a, b: np.append(a, b, axis=0), arrays, others), static)


class Part:
    """The objective on a subset of the observations: one compiled program for all its runs.

    Attributes:
        count: the number of these observations.
        seconds: what one step took, the least seen after the first call, which compiles.
        objective: the function of u.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        rows: Measurements,
        rms: float,
        chosen: np.ndarray,
        most: int,
    ):
        """Take those `chosen` of all observations that the criterion and the rows belong to.

        There are never more runs than `most`, to which their arrays are padded.
        """
        self.seconds, self._compiled = np.inf, False
        self._most = most + 1
        N = rows.count
        if len(chosen) < N:
            rows, chosen = rows.subset(chosen)
        self.count = rows.count
        numbers = (jnp.asarray(each, rows.targets.dtype) for each in (N / self.count, rms, 1.0))
        criterion = criterion.on(rows, chosen).hearing(space.kernel, rows)
        self.objective = SearchObjective(space, criterion, rows, *numbers)

    def measure_in(self, unit: float) -> None:
        """Divide the caller's objective by its size: tolerances are those of numbers of size 1."""
        number = jnp.asarray(unit, self.objective.unit.dtype)
        self.objective = eqx.tree_at(lambda objective: objective.unit, self.objective, number)

    def begun(
        self, minimiser: optx.AbstractMinimiser, us: Float[np.ndarray, "count P"]
    ) -> MinimiserRun:
        """Runs from points at which the function has not been evaluated yet."""
        padded = np.resize(us, (self._most, us.shape[1])).astype(jnp.result_type(float))
        runs = _begun(self.objective, minimiser, padded)
        return _take(jax.tree.map(_as_numpy, runs), slice(len(us)))

    def minimised(
        self, minimiser: optx.AbstractMinimiser, runs: MinimiserRun, steps: int
    ) -> MinimiserRun:
        """The runs after up to `steps` more steps."""
        count, before = len(runs.u), runs.steps.sum()
        # On a CPU runs one after the other took two thirds of the time. On a GPU a few hundred rows
        # do not fill the device, so runs go side by side, though a `while_loop` under `vmap` also
        # computes the lanes that have finished.
        side_by_side = platform() != "cpu" and len(self.objective.rows.targets) <= 256
        padded = _take(runs, np.resize(np.arange(count), self._most))
        padded = padded._replace(going=padded.going & (np.arange(self._most) < count))
        began = time.perf_counter()
        moved = _minimised(self.objective, minimiser, padded, padded.steps + steps, side_by_side)
        moved = _take(jax.tree.map(_as_numpy, moved), slice(count))
        if self._compiled:
            taken = int(moved.steps.sum() - before)
            self.seconds = min(self.seconds, (time.perf_counter() - began) / max(taken, 1))
        self._compiled = True
        return moved


def _as_numpy(leaf: Any) -> Any:
    return np.asarray(leaf) if eqx.is_array(leaf) else leaf


@compiled
def _begun(objective, minimiser, us) -> MinimiserRun:
    return eqx.filter_vmap(functools.partial(begun, minimiser, objective))(us)


@compiled
def _minimised(objective, minimiser, runs: MinimiserRun, most, side_by_side) -> MinimiserRun:
    """The runs, each at its end or at its largest number of steps."""
    arrays, static = eqx.partition(runs, eqx.is_array)

    def one(arrays, most):
        run = minimised(minimiser, objective, eqx.combine(arrays, static), most)
        return eqx.filter(run, eqx.is_array)

    across = jax.vmap(one) if side_by_side else lambda *each: jax.lax.map(lambda e: one(*e), each)
    return eqx.combine(across(arrays, most), static)


# Where the runs start: the best points of a space-filling design of the box.


def design(directions: Sequence[int]) -> Float[np.ndarray, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d.

    Coordinates with the same direction move together, each through its own side. If the
    lengthscales of n coordinates moved independently, almost every point would have one that is far
    too short or too long, and hardly a start would lead to a good optimum.
    """
    d = max(directions) + 1
    count = 64 * min(d, 4)
    root = 2.0
    for _ in range(64):  # the positive solution of root^(d + 1) = root + 1
        root = (1 + root) ** (1 / (d + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, d + 1))) % 1.0
    return np.arcsin(2 * share - 1)[:, list(directions)]


def spread_out(
    points: Float[np.ndarray, "count P"], values: Float[np.ndarray, " count"], starts: int
) -> list[int]:
    """The indices of the best points of a design, of which no two are neighbours."""
    reach = 0.25 * points.shape[1] ** 0.5  # of a box of side 1
    order = np.argsort(values, kind="stable")
    taken: list[int] = []
    for i in order:
        if all(shares_apart(points[i], points[j]) >= reach for j in taken):
            taken.append(int(i))
    left = [int(i) for i in order if i not in taken]  # neighbours, where the box is full
    return (taken + left)[:starts]


def shares_apart(u: Float[np.ndarray, " P"], v: Float[np.ndarray, " P"]) -> float:
    """The distance of two points in a box of side 1."""
    return float(np.linalg.norm(np.sin(u) - np.sin(v)) / 2)
