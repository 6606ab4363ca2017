"""The objective on a part of the points: one compiled program for starts, search and finish."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hamkernel._tuning.objective import SearchCriterion
from hamkernel._tuning.space import SearchSpace

# The first part has so many points, or so many rows of its Gram; with half as many the best run
# often leads to a poor optimum of all the data. The second part has so many rows, and is there
# where all points have at least twice as many. See `tests/benchmarks/tuning_speed.py`.
FIRST_POINTS, FIRST_ROWS, SECOND_ROWS = 64, 256, 1024
_BATCH = 16  # points that one call takes: as many as there are starts


def rows_of_parts(
    X: Float[Array, "N n"], criterion: SearchCriterion, dense: bool
) -> list[Int[np.ndarray, " _"]]:
    """The rows of the points of each part; all of them at last, where the loss is dense."""
    N, n = X.shape
    if criterion.own:  # it may need all the data
        return [np.arange(N)]
    counts = [min(FIRST_POINTS, max(FIRST_ROWS // n, 2)), SECOND_ROWS // n]
    if 2 * counts[1] > N:
        del counts[1]
    if counts[0] >= N:
        return [np.arange(N)]
    labels = np.zeros(N) if criterion.partition is None else criterion.partition.labels
    order = np.argsort(labels, kind="stable")
    # Spread evenly over the folds, and over the points of each.
    few = [np.sort(order[np.linspace(0, N - 1, count).round().astype(int)]) for count in counts]
    return [*few, np.arange(N)] if dense else few


class Part:
    """The objective on some of the points, as a function of u.

    Attributes:
        seconds: what one value with its slope took, the least seen.
    """

    def __init__(
        self,
        space: SearchSpace,
        criterion: SearchCriterion,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        rows: Int[np.ndarray, " M"],
    ):
        """Take `rows` of all points X, Y, to which the criterion belongs."""
        self.whole = len(rows) == len(X)
        self.seconds = np.inf
        thinning = jnp.asarray(len(X) / len(rows), X.dtype)
        if not self.whole:
            X, Y = (jnp.asarray(np.asarray(each)[rows]) for each in (X, Y))
            criterion = criterion.on(rows)
        self.objective = SearchObjective(space, criterion, X, Y, thinning)

    @property
    def points(self) -> int:
        """How many there are."""
        return len(self.objective.X)

    def __call__(self, us: Float[np.ndarray, "count P"]) -> list[tuple[float, float, np.ndarray]]:
        """Value, loss and slope at each; inf and a slope of zero where there is no value."""
        # On a CPU one after the other took two thirds of the time; elsewhere a lane costs nothing.
        side_by_side = jax.default_backend() != "cpu" and self.objective.X.size <= FIRST_ROWS
        found = []
        for start in range(0, len(us), _BATCH):
            some = us[start : start + _BATCH]
            padded = np.zeros((_BATCH, us.shape[1]), self.objective.X.dtype)
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
    """u -> what is minimised, and the loss. The ridge Nλ is that of all points."""

    space: SearchSpace
    criterion: SearchCriterion
    X: Float[Array, "M n"]
    Y: Float[Array, "M n"]
    thinning: Float[Array, ""]  # the number of all points over M

    def __call__(self, u: Float[Array, " P"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        kernel, regularization, size = self.space.decode(u)
        ridge = self.thinning * regularization
        loss, square = self.criterion.loss(kernel, self.X, self.Y, ridge)
        # Of noise a is as large at every point as it is of all of them.
        trace = self.thinning * len(self.X) * size if self.space.chooses_ridge else None
        value = self.criterion.searched(loss, square, self.Y, trace)
        return value.astype(u.dtype), loss.astype(u.dtype)


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
