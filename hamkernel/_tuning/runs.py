"""Runs of an optimiser from many starts, on a subset of the points and then on all of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from hamkernel._tuning.objective import HUGE, SearchCriterion
from hamkernel._tuning.space import SearchSpace


class Runs(eqx.Module):
    """The best point of a run; of several with a leading axis."""

    u: Float[Array, "*starts P"]
    value: Float[Array, "*starts"]
    converged: Bool[Array, "*starts"]
    steps: Int[Array, "*starts"]


decode = eqx.filter_jit(lambda space, u, X: space.decode(u, X))


@eqx.filter_jit
def spread_starts(space, criterion, X, Y, scale: float, starts: int) -> Runs:
    """The runs before their first step: from the caller's point, and the best of a design.

    Args:
        space: the search space.
        criterion: of these points.
        X: states, all of them or a part.
        Y: velocities.
        scale: the number of all points over those in X; it keeps the ridge Nλ of all points.
        starts: how many runs.
    """
    u = space.encode_start(X)[None]
    if starts > 1:
        coarse = _Objective(space, criterion, X, Y, scale)
        design = _design(space.directions, X.dtype)
        values = jax.lax.map(coarse, design, batch_size=64)
        u = jnp.concatenate([u, _spread_out(design, values, starts - 1)])
    none = jnp.zeros(starts, int)
    return Runs(u, jnp.full(starts, HUGE, u.dtype), none > 0, none)


@eqx.filter_jit
def search(space, criterion, X, Y, scale: float, runs: Runs, which, optimiser, max_steps) -> Runs:
    """The runs, those from which[0] to which[1] gone on with from where they are."""
    coarse = _Objective(space, criterion, X, Y, scale)

    def one(i, runs: Runs) -> Runs:
        run = jax.tree.map(lambda leaf: leaf[i], runs)
        run = _gone_on(coarse, run, optimiser, max_steps)
        return jax.tree.map(lambda leaf, new: leaf.at[i].set(new), runs, run)

    if _side_by_side():
        return jax.vmap(lambda run: _gone_on(coarse, run, optimiser, max_steps))(runs)
    return jax.lax.fori_loop(which[0], which[1], one, runs)


def _side_by_side() -> bool:
    """Whether all runs are made at once, where all wait for the slowest.

    That pays where a lane costs nothing. On a CPU one after the other took two thirds of the time.
    """
    return jax.default_backend() != "cpu"


def scouts(starts: int) -> int:
    """How many of the runs are made before it is decided where all of them search."""
    return starts if _side_by_side() else min(starts, 4)


@eqx.filter_jit
def finish(space, criterion, X, Y, runs: Runs, optimiser, max_steps: int) -> Runs:
    """The runs with their losses on all points, in that order, the best one finished there.

    The first is the caller's point itself if the run from there, on a subset, made it worse.
    """
    fine = _Objective(space, criterion, X, Y, 1.0)
    start = space.encode_start(X)
    losses = jax.lax.map(fine, jnp.concatenate([runs.u, start[None]]))
    values, given = losses[:-1], losses[-1]
    u = runs.u.at[0].set(jnp.where(given < values[0], start, runs.u[0]))
    runs = eqx.tree_at(lambda r: (r.u, r.value), runs, (u, values.at[0].min(given)))
    order = jnp.argsort(runs.value)
    runs = jax.tree.map(lambda leaf: leaf[order], runs)
    best = jax.tree.map(lambda leaf: leaf[0], runs)
    finished = _gone_on(fine, best, optimiser, max_steps)
    return jax.tree.map(lambda new, old: old.at[0].set(new), finished, runs)


DESIGN_POINTS = 64  # for each direction of the box, and four at most: the starts are the best


class _Objective(eqx.Module):
    """u -> value. `thinning` keeps the ridge Nλ of all points when X is a subset of them."""

    space: SearchSpace
    criterion: SearchCriterion
    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    thinning: float = eqx.field(static=True)

    def unit(self, u: Float[Array, " P"]) -> Float[Array, ""]:
        """What the value is measured in by a run from u, whose tolerances are those of numbers ~ 1.

        A validation loss is searched by its logarithm; an objective of the caller's has any size.
        """
        one = jnp.ones((), self.X.dtype)
        if not self.criterion.own:
            return one
        size = jnp.abs(self(u))
        return jnp.where((size > 0) & (size < HUGE), size, one)

    def __call__(self, u: Float[Array, " P"]) -> Float[Array, ""]:
        kernel, regularization = self.space.decode(u, self.X)
        return self.criterion.value(kernel, self.X, self.Y, self.thinning * regularization)


def _gone_on(objective: _Objective, run: Runs, optimiser, max_steps: int) -> Runs:
    """One run of the optimiser, from where it is."""
    u = run.u
    # optimistix starts its best loss in the default dtype, which float32 data must then meet.
    default = jnp.result_type(float)
    unit = objective.unit(u).astype(default)

    def in_default(v):
        value = objective(v.astype(u.dtype)).astype(default)
        return jnp.where(value < HUGE, value / unit, HUGE)

    # optimistix linearises forward and transposes; our derivatives are written backward.
    @jax.custom_jvp
    def differentiable(v):
        return in_default(v)

    @differentiable.defjvp
    def _(primals, tangents):
        value, slope = jax.value_and_grad(in_default)(*primals)
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))
        return value, slope @ tangents[0]

    found = optx.minimise(
        lambda v, _: differentiable(v),
        optimiser,
        u.astype(default),
        max_steps=max_steps,
        throw=False,
    )
    best = found.value.astype(u.dtype)
    # BFGS keeps the value at its last point. Others are wrapped, see `keeping_the_best`.
    bare = isinstance(optimiser, optx.BFGS)
    f = found.state.f_info.f if bare else in_default(best)
    value = jnp.where(f < HUGE, f * unit, HUGE).astype(u.dtype)
    converged = found.result == optx.RESULTS.successful
    return Runs(best, value, converged, run.steps + found.stats["num_steps"])


def keeping_the_best(optimiser: optx.AbstractMinimiser) -> optx.AbstractMinimiser:
    """The optimiser, so that its last point is the best it has seen.

    That of BFGS is: its line search accepts no other, and optimistix's wrapper would return the
    point before it.
    """
    return optimiser if isinstance(optimiser, optx.BFGS) else optx.BestSoFarMinimiser(optimiser)


def _design(directions: tuple[int, ...], dtype) -> Float[Array, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d.

    Coordinates with the same direction move together, each through its own box. Were the
    lengthscales of n coordinates to move apart, almost every point would have some that is far
    too short or too long, and hardly a start would lead to a good optimum.
    """
    d = max(directions) + 1
    count = DESIGN_POINTS * min(d, 4)
    root = 2.0
    for _ in range(64):  # the positive solution of root^(d + 1) = root + 1
        root = (1 + root) ** (1 / (d + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, d + 1))) % 1.0
    return jnp.asarray(np.arcsin(2 * share - 1)[:, list(directions)], dtype)


def _spread_out(
    design: Float[Array, "count P"], values: Float[Array, " count"], count: int
) -> Float[Array, "{count} P"]:
    """The best points of the design that are not neighbours of a better one already taken."""
    reach = 0.25 * design.shape[1] ** 0.5  # of a box of side 1; a float has no dtype
    shares = jnp.sin(design) / 2

    def take(values, _):
        best = jnp.argmin(values)
        near = jnp.linalg.norm(shares - shares[best][None], axis=1) < reach
        return jnp.where(near, HUGE + values, values), design[best]

    return jax.lax.scan(take, values, length=count)[1]
