"""The evidence of learned runs: log p, and its gain by another kernel in the drift."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hamkernel._learned.result import AbstractEvidence
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import complete
from hamkernel._trajectories.likelihood import closed_form
from hamkernel._trajectories.model import Model, with_amplitude
from hamkernel._trajectories.search import (
    LEAST_NOISE,
    Bounds,
    log_shares_of_noise,
    losses,
    maximise_likelihood,
    search_sample,
)
from hamkernel._trajectories.segments import LinearisedSegments

# Amplitudes, lengthscales and noise may change by as much in either direction.
_RANGE = np.log(1e4)
_STEPS = 25  # of BFGS, as in each iteration of learning


class Evidence(AbstractEvidence):
    """The rows along the paths that were learned, with the model under which they are likeliest.

    Attributes:
        model: the kernel and both kinds of noise.
        points: the landmarks, shape (m, d).
        rows: the runs, linearised about their paths.
        start_deviation: the prior standard deviation of starts, shape (n,).
        scale: the standard deviations of the coordinates, shape (n,).
        is_free: which kinds of noise were estimated, sensor noise first, shape (2n,).
    """

    model: Model
    points: Float[Array, "m d"]
    rows: LinearisedSegments
    start_deviation: Float[Array, " n"]
    scale: Float[np.ndarray, " n"]
    is_free: Bool[np.ndarray, " k"]

    @property
    def log_p(self) -> float:
        return -self._loss(self.model)

    def gain(self, part: AbstractMatrixKernel) -> float:
        """The gain in log p from `part` as one more term of the drift.

        We search all hyperparameters again, from their learned values and from less noise.
        """
        n, K = len(self.scale), self.model.kernel
        part = complete(with_amplitude(part), self.points, n)
        part.check_dimension(n)
        larger = self.model._replace(kernel=K.with_states(K.state_kernel + part))
        flat = np.asarray(larger.flat)
        free = np.concatenate([np.ones(len(flat) - 2 * n, bool), self.is_free])
        low, high = flat - _RANGE, flat + _RANGE
        low[-2 * n : -n] = np.minimum(flat[-2 * n : -n], np.log(LEAST_NOISE * self.scale))
        less = log_shares_of_noise(n) * self.is_free
        design = np.tile(flat, (len(less), 1))
        design[:, -2 * n :] += less
        design = np.maximum(design, low)
        points, rows = search_sample(self.points, self.rows)
        values = losses(larger, jnp.asarray(design), points, rows, self.start_deviation)
        start = larger.unflatten(jnp.asarray(design[int(np.argmin(np.asarray(values)))]))
        bounds = Bounds(low, high, free)
        args = self.points, self.rows, self.start_deviation
        best, _ = maximise_likelihood(start, *args, bounds, _STEPS)
        # Learning ends within half a nat of its optimum, and so may this search.
        return max(self._loss(self.model) - self._loss(best), 0.0)

    def _loss(self, model: Model) -> float:
        return float(closed_form(model, self.points, self.rows, self.start_deviation).loss)
