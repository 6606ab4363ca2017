"""BFGS that asks for one point at a time, so that many runs share one compiled loss.

Each value comes with its slope: one program serves the starts, the search and its finish, and a
run takes its curvature along from a part of the data to all of it.

Source: Nocedal & Wright (2006), Numerical Optimization, algorithms 3.1 and 6.1.
"""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass
class Run:
    """The best point of a run.

    Attributes:
        u: where it is, shape (P,).
        value: what is minimised there.
        loss: the objective there, as it is reported.
        slope: that of the value, shape (P,); None where it is not known.
        converged: whether the run met its tolerance.
        steps: how many it took.
        curvature: the estimate of the inverse Hessian that it ended with, shape (P, P).
    """

    u: Float[np.ndarray, " P"]
    value: float = np.inf
    loss: float = np.inf
    slope: Float[np.ndarray, " P"] | None = None
    converged: bool = False
    steps: int = 0
    curvature: Float[np.ndarray, "P P"] | None = None


# A step is taken if it lowers the value by this share of what the slope promises. Small: as the
# curvature becomes known a step of full length is good, and none is to be refused.
_SUFFICIENT = 1e-4
# Of the box, which is π wide, that a first step crosses, where no curvature is known.
_FIRST = 0.1 * np.pi
# A step is at most so long: half of the box, where a quadratic model is no longer one.
_LONGEST = 0.5 * np.pi
_SHORTEST = 1e-8  # a step that moves no more than half the digits of u finds only rounding


class Descent:
    """A run in progress: `trial` is where it wants the value and slope next, `tell` takes them.

    Args:
        run: where to start, with its value and slope if they are known; it is updated.
        tolerance: of the value. The run has converged where what the quadratic model still
            promises is less.
        max_steps: of this descent.
        max_trials: the points that it may ask for after the first, taken as steps or not.
        relative: whether the tolerance is a share of the first value.
    """

    def __init__(
        self,
        run: Run,
        tolerance: float,
        max_steps: int,
        relative: bool = False,
        max_trials: float = np.inf,
    ):
        self.run = run
        self.going = True
        self.trial = run.u
        self._tolerance, self._relative = tolerance, relative
        self._left, self._trials = max_steps, max_trials
        self._step = np.zeros_like(run.u)
        if run.slope is not None:
            self._turn()

    def tell(self, value: float, loss: float, slope: Float[np.ndarray, " P"]) -> None:
        """Take the value at `trial`, and move on."""
        run = self.run
        self._trials -= run.slope is not None
        if run.slope is None:
            run.value, run.loss, run.slope = value, loss, slope
            if self._relative and 0 < abs(value) < np.inf:
                self._tolerance *= abs(value)
            self._turn()
        elif value <= run.value + _SUFFICIENT * (run.slope @ self._step):
            self._learn(slope - run.slope)
            run.u, run.value, run.loss, run.slope = self.trial, value, loss, slope
            run.steps += 1
            self._left -= 1
            self._turn()
        else:
            self._shorten(value)
        self.going = self.going and self._trials > 0

    def _turn(self) -> None:
        """Choose the next direction, or stop."""
        run, slope = self.run, self.run.slope
        assert slope is not None
        if not run.value < np.inf or self._left <= 0:
            self.going = False
            return
        size = float(np.linalg.norm(slope))
        if run.curvature is None:
            # Across the whole box this slope would not be worth the tolerance.
            run.converged = size * np.pi < self._tolerance
            step = -slope * (_FIRST / size) if size > 0 else slope
        else:
            step = -run.curvature @ slope
            run.converged = bool(-(step @ slope) < 2 * self._tolerance)
        self.going = not run.converged
        length = float(np.linalg.norm(step))
        self._step = step * min(1.0, _LONGEST / length) if length > 0 else step
        self.trial = run.u + self._step

    def _learn(self, change: Float[np.ndarray, " P"]) -> None:
        """The BFGS update of the inverse Hessian, which keeps it positive."""
        s, y = self._step, change
        along = float(s @ y)
        if along <= 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):
            return
        one = np.eye(len(s))
        H = self.run.curvature
        # Not scaled to the first curvature seen, that of the steepest direction: along a valley
        # nothing would be promised, and the run would stop at its side.
        H = one if H is None else H
        left = one - np.outer(s, y) / along
        self.run.curvature = left @ H @ left.T + np.outer(s, s) / along

    def _shorten(self, value: float) -> None:
        """Go to the minimum of the parabola through both values, a tenth to a half of the way."""
        assert self.run.slope is not None
        promised = float(self.run.slope @ self._step)
        share = -promised / (2 * (value - self.run.value - promised))
        self._step = self._step * float(np.clip(share, 0.1, 0.5))
        self.trial = self.run.u + self._step
        if np.linalg.norm(self._step) > _SHORTEST * (1 + np.linalg.norm(self.run.u)):
            return
        self.going = self.run.curvature is not None
        if self.going:  # it was wrong: once more, down the slope
            self.run.curvature = None
            self._turn()
