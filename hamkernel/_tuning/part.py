"""The objective on a part of the points: one compiled program for starts, search and finish."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel._observations.measurements import Measurements
from hamkernel._tuning.objective import SearchCriterion
from hamkernel._tuning.space import SearchSpace

# The first part has so many points, or so many rows of its Gram; with half as many the best run
# often leads to a poor optimum of all the data. The second part has so many rows, and is there
# where all points have at least twice as many. See `tests/benchmarks/tuning_speed.py`.
FIRST_POINTS, FIRST_ROWS, SECOND_ROWS = 64, 256, 1024
_BATCH = 16  # points that one call takes: as many as there are starts


def parts_of(
    rows: Measurements, criterion: SearchCriterion, dense: bool
) -> list[Int[np.ndarray, " _"]]:
    """The observations of each part; all of them at last, where the loss is dense."""
    N, n = rows.count, len(rows.targets) / rows.count
    if criterion.own:  # it may need all the data
        return [np.arange(N)]
    counts = [min(FIRST_POINTS, max(int(FIRST_ROWS / n), 2)), int(SECOND_ROWS / n)]
    if 2 * counts[1] > N:
        del counts[1]
    if counts[0] >= N:
        return [np.arange(N)]
    labels = np.zeros(N) if criterion.partition is None else criterion.partition.labels
    order = np.argsort(labels, kind="stable")
    # Spread evenly over the folds, and over the observations of each.
    few = [np.sort(order[np.linspace(0, N - 1, count).round().astype(int)]) for count in counts]
    return [*few, np.arange(N)] if dense else few


class Part:
    """The objective on some of the observations, as a function of u.

    Attributes:
        count: how many there are.
        seconds: what one value with its slope took, the least seen.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        rows: Measurements,
        speed: float,
        chosen: Int[np.ndarray, " C"],
    ):
        """Take those `chosen` of all that the criterion belongs to.

        Args:
            space: of u.
            criterion: of all observations.
            rows: all.
            speed: the root of the mean square of the components of velocities, as they are typical.
            chosen: which of them, counted from 0 and in order.
        """
        self.seconds = np.inf
        N = rows.count
        if len(chosen) < N:
            rows, chosen = rows.subset(chosen)
        self.count = rows.count
        dtype = rows.targets.dtype
        thinning = jnp.asarray(N / self.count, dtype)
        criterion = criterion.on(rows, chosen)
        self.objective = SearchObjective(
            space, criterion, rows, thinning, jnp.asarray(speed, dtype)
        )

    def __call__(self, us: Float[np.ndarray, "count P"]) -> list[tuple[float, float, np.ndarray]]:
        """Value, loss and slope at each; inf and a slope of zero where there is no value."""
        # On a CPU one after the other took two thirds of the time; elsewhere a lane costs nothing.
        side_by_side = (
            jax.default_backend() != "cpu" and len(self.objective.rows.targets) <= FIRST_ROWS
        )
        found = []
        for start in range(0, len(us), _BATCH):
            some = us[start : start + _BATCH]
            padded = np.zeros((_BATCH, us.shape[1]), self.objective.speed.dtype)
            padded[: len(some)] = some
            began = time.perf_counter()
            arrays = _evaluated(self.objective, padded, np.asarray(len(some)), side_by_side)
            values, losses, slopes = (np.asarray(each, float)[: len(some)] for each in arrays)
            self.seconds = min(self.seconds, (time.perf_counter() - began) / len(some))
            losses = np.where(values < np.inf, losses, np.inf)
            slopes = np.where(np.isfinite(slopes), slopes, 0)
            found += zip(values.tolist(), losses.tolist(), slopes, strict=True)
        return found


class SearchObjective(eqx.Module):
    """u -> what is minimised, and the loss. The ridge Nλ is that of all observations."""

    space: SearchSpace
    criterion: SearchCriterion
    rows: Measurements
    thinning: Float[Array, ""]  # the number of all observations over that of these
    speed: Float[Array, ""]

    def __call__(self, u: Float[Array, " P"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        kernel, regularization, size = self.space.decode(u)
        loss, square = self.criterion.loss(kernel, self.rows, self.thinning * regularization)
        value = self.criterion.searched(loss, square, self.rows, self.wall(size))
        return value.astype(u.dtype), loss.astype(u.dtype)

    def wall(self, size: Float[Array, ""]) -> Float[Array, ""] | None:
        """What `searched` takes, given tr(G)/N; None where there is no wall."""
        if not self.space.chooses_ridge:
            return None
        X = self.rows.points
        trace = self.thinning * len(X) * size  # of noise a is as large at every point
        square = self.speed**2 * (len(X) * self.space.kernel.outputs(X.shape[1]))
        return trace**2 / jnp.maximum(square, jnp.finfo(square.dtype).tiny)


@eqx.filter_jit
def _evaluated(objective, us, count, side_by_side: bool):
    """Values, losses and slopes at the first `count` of `us`."""
    slopes = jax.value_and_grad(objective, has_aux=True)
    if side_by_side:
        (values, losses), gradients = jax.vmap(slopes)(us)
        return values, losses, gradients

    def one(i, found):
        (value, loss), slope = slopes(us[i])
        return tuple(
            each.at[i].set(new) for each, new in zip(found, (value, loss, slope), strict=True)
        )

    zeros = jnp.zeros(len(us), us.dtype)
    return jax.lax.fori_loop(0, count, one, (zeros, zeros, jnp.zeros_like(us)))
