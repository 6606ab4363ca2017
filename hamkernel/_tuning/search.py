"""The search of `tune`: many runs on few points, and few on many.

The runs are made on a subset of the points. Their ends, those that differ, are compared on more
points, and the best two are finished there, with the curvature that they have learned; and so on,
up to all points. The price of a loss grows with the cube of the points, so that the last part takes
most of the time although it looks at one or two points and takes few steps.
"""

import sys
from collections.abc import Callable

import numpy as np
import optimistix as optx

from hamkernel import _require as require
from hamkernel._observations.measurements import Measurements
from hamkernel._tuning.descent import Descent, Run
from hamkernel._tuning.objective import SearchCriterion
from hamkernel._tuning.other_optimisers import minimised
from hamkernel._tuning.part import Part, parts_of
from hamkernel._tuning.space import SearchSpace
from hamkernel._tuning.starts import design, shares_apart, spread_out

_TOLERANCE = 1e-4  # of the logarithm of a loss: what a run may still gain at its end
# The same where it goes on with more points. On seven problems of 120 points this took 391 losses
# of the subset and 23 of all points; 1e-2 took 328 and 29, 1e-4 476 and 22, with the same fields.
_COARSE = 1e-3
# Ends that are finished: with one, the better optimum of two that are within a few per cent on the
# subset was missed (96 points of `tuning_speed.py`, a loss 3 % larger).
_FINISHED = 2
# Of the box: ends that are closer are one. Without it 25 losses of all points for 23.
_SAME = 0.01
# With a second part the last one only corrects the best that it found. On so many points the loss
# follows what happens to be held out: with 1, 2, 3 and 6 steps the median loss of 141 runs of a
# pendulum, six seeds, was .0126, .0118, .0114 and .0112, and the median field error .0025, .0025,
# .0026 and .0026.
_LAST_TRIALS = 2
_LONG = 60.0  # seconds of which the caller is told beforehand
_CALLS_OF_A_RUN, _CALLS_OF_THE_LAST = 25, 5  # of the loss, as the estimates count


class Search:
    """The runs, part by part.

    Args:
        space: where.
        criterion: of all observations.
        rows: their rows, on one device.
        speed: see `Part`.
        starts: the number of runs.
        max_steps: of one run, on each part.
        optimiser: one of optimistix, or None for BFGS.
        progress: whether to print how it goes.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        rows: Measurements,
        speed: float,
        starts: int,
        max_steps: int,
        optimiser: optx.AbstractMinimiser | None,
        progress: bool,
    ):
        self.space, self.criterion, self.rows, self.speed = space, criterion, rows, speed
        self.starts, self.max_steps = starts, max_steps
        self.optimiser, self.progress = optimiser, progress
        self._given = np.asarray(space.encode_start(), float)

    def runs(self, low_rank: Callable[[Run], SearchCriterion] | None = None) -> list[Run]:
        """A run for each start, where the search ends.

        Args:
            low_rank: the criterion of the last part, given the best run before; None if dense.
        """
        parts = parts_of(self.rows, self.criterion, dense=low_rank is None)
        part = self._part(self.criterion, parts[0])
        only = len(parts) == 1 and low_rank is None
        runs = self._first(part, _TOLERANCE if only else _COARSE)
        ends = [*_different(runs), Run(self._given)]
        last = parts[-1] if len(parts) > 2 else None
        for more in parts[1:]:
            trials = np.inf
            if more is last:  # the caller's point has lost on the part before
                trials, ends = _LAST_TRIALS, ends[:1]
            growth = (len(more) / part.count) ** 3
            self._warn_of_waiting(part.seconds * growth * _CALLS_OF_THE_LAST, _SMALLER)
            part = self._part(self.criterion, more)
            runs, ends = self._finished(part, ends, trials)
        if low_rank is not None and best(runs).value < np.inf:
            part = self._part(low_rank(best(runs)), np.arange(self.rows.count))
            runs, _ = self._finished(part, ends)
        return runs

    def _part(self, criterion: SearchCriterion, chosen: np.ndarray) -> Part:
        return Part(self.space, criterion, self.rows, self.speed, chosen)

    def _first(self, part: Part, tolerance: float) -> list[Run]:
        """A run from the caller's point, and from the best points of a design."""
        runs = [Run(self._given)]
        if self.starts > 1:
            points = design(self.space.directions)
            values = np.array([value for value, *_ in part(points)])
            runs += [Run(u) for u in spread_out(points, values, self.starts - 1)]
            seconds = part.seconds * self.starts * _CALLS_OF_A_RUN
            self._warn_of_waiting(seconds, f"Pass fewer starts than {self.starts}.")
        self._descend(part, runs, tolerance)
        return runs

    def _finished(
        self, part: Part, ends: list[Run], max_trials: float = np.inf
    ) -> tuple[list[Run], list[Run]]:
        """The ends in the order of their losses on these points, the best two finished there.

        The last of the ends is the caller's point. The second list has those of them to look at on
        more points: the best, and the caller's.
        """
        points = part(np.stack([end.u for end in ends]))
        for end, (value, loss, slope) in zip(ends, points, strict=True):
            end.value, end.loss, end.slope = value, loss, slope
        ends = sorted(ends, key=lambda end: end.value)
        converged = ends[0].converged
        if max_trials < np.inf:  # a correction, which says nothing of it
            self._descend(part, ends[:1], _TOLERANCE, max_trials)
            ends[0].converged = converged
        else:
            self._descend(part, ends[:_FINISHED], _TOLERANCE)
            ends = sorted(ends, key=lambda end: end.value)
        return ends[: self.starts], [ends[0], Run(self._given)]

    def _descend(
        self, part: Part, runs: list[Run], tolerance: float, max_trials: float = np.inf
    ) -> None:
        """Go on with the runs, side by side, until each has converged or used up its steps."""
        if self.optimiser is not None:
            for run in runs:
                minimised(part.objective, run, self.optimiser, self.max_steps)
            return
        relative = self.criterion.own  # it has a unit of its own
        descents = [Descent(run, tolerance, self.max_steps, relative, max_trials) for run in runs]
        while going := [descent for descent in descents if descent.going]:
            points = part(np.stack([descent.trial for descent in going]))
            for descent, point in zip(going, points, strict=True):
                descent.tell(*point)
            if self.progress:
                self._say(part, runs, len(going))

    def _say(self, part: Part, runs: list[Run], going: int) -> None:
        sys.stdout.write(
            f"tune: {part.count} of {self.rows.count} points, "
            f"step {max(run.steps for run in runs)}, {going} of {len(runs)} runs, "
            f"best loss {best(runs).loss:.6g}\n"
        )
        sys.stdout.flush()

    def _warn_of_waiting(self, seconds: float, cure: str) -> None:
        if seconds > _LONG:
            require.warn(f"this search will take about {seconds / 60:.0f} minutes. {cure}")


_SMALLER = (
    "The price of the loss grows with the cube of N n: pass a part of the data and fit all of it "
    "with what is found, or a solver whose loss is of low rank, solver=hk.Nystrom() or "
    "solver=hk.RandomFeatures(count, key)."
)


def best(runs: list[Run]) -> Run:
    """The run that found the least value."""
    return min(runs, key=lambda run: run.value)


def _different(runs: list[Run]) -> list[Run]:
    """The runs that ended where no better one did, from the best on."""
    ends: list[Run] = []
    for run in sorted(runs, key=lambda run: run.value):
        apart = [shares_apart(run.u, end.u) for end in ends]
        if run.value < np.inf and min(apart, default=1.0) > _SAME:
            ends.append(run)
    return ends
