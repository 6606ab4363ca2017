"""Runs of an optimiser from many starts, on a subset of the points and then on all of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from hamkernel._objective import HUGE, SearchCriterion
from hamkernel._search_space import SearchSpace


class Runs(eqx.Module):
    """The best point of each run."""

    u: Float[Array, "starts P"]
    value: Float[Array, " starts"]
    converged: Bool[Array, " starts"]
    steps: Int[Array, " starts"]


decode = eqx.filter_jit(lambda space, u, X: space.decode(u, X))


@eqx.filter_jit
def starting_points(space, criterion, X, Y, scale: float, starts: int) -> Float[Array, "starts P"]:
    """The caller's values, and the best of a space-filling design in the box, as u.

    Args:
        space: the search space.
        criterion: of these points.
        X: states, all or a part of them.
        Y: velocities.
        scale: the number of all points over those in X; it keeps the ridge Nλ of all points.
        starts: how many.
    """
    u = space.encode(space.start, X)[None]
    if starts > 1:
        design = _design(u.shape[1], DESIGN_POINTS, X.dtype)
        objective = _Objective(space, criterion, X, Y, scale)
        values = jax.lax.map(objective, design, batch_size=64)
        u = jnp.concatenate([u, _spread_out(design, values, starts - 1)])
    return u


@eqx.filter_jit
def moved(space: SearchSpace, other: SearchSpace, u: Float[Array, "starts P"], X: Array) -> Array:
    """The points u of a space in another one: the same hyperparameters, moved into its box."""
    return jax.vmap(lambda u: other.encode(space.entries(u, X), X))(u)


def search(
    space, criterion, X, Y, scale: float, u: Float[Array, "starts P"], optimiser, max_steps: int
) -> Runs:
    """The runs from all starts u on X and Y, all points or a part of them; those of a part sorted.

    Starts that are almost the same share a run. Other arguments are those of `starting_points`,
    and an optimistix minimiser with the largest number of steps of each run.
    """
    first, run_of = _distinct(np.asarray(u))
    order = np.concatenate([first, np.setdiff1d(np.arange(len(u)), first)])
    count = jnp.asarray(len(first))  # traced: any number is one program
    runs = _search(space, criterion, X, Y, scale, np.asarray(u)[order], count, optimiser, max_steps)
    runs = jax.tree.map(lambda leaf: np.asarray(leaf)[run_of], runs)  # NumPy compiles nothing
    return runs if scale == 1 else _sorted(runs)


@eqx.filter_jit
def _search(space, criterion, X, Y, scale, u, count, optimiser, max_steps) -> Runs:
    """The runs from the first `count` of the starts."""
    coarse = _Objective(space, criterion, X, Y, scale)

    def nothing(u):
        return Runs(u, jnp.asarray(HUGE, u.dtype), jnp.asarray(False), jnp.asarray(0))

    def run(i_and_u):
        i, u = i_and_u
        return jax.lax.cond(i < count, lambda u: _run(coarse, u, optimiser, max_steps), nothing, u)

    # Side by side all wait for the slowest, which only pays where a lane costs nothing: one after
    # the other took two thirds of the time on a CPU.
    together = None if jax.default_backend() == "cpu" else len(u)
    return jax.lax.map(run, (jnp.arange(len(u)), u), batch_size=together)


def _distinct(u: Float[np.ndarray, "starts P"]) -> tuple[np.ndarray, np.ndarray]:
    """The rows of u that are no neighbours of one before, and for each row which of those it is."""
    shares = np.sin(u) / 2
    first, run_of = [], []
    for i, share in enumerate(shares):
        near = np.abs(shares[first] - share).max(axis=1) < NEIGHBOURS
        if not near.any():
            first.append(i)
        run_of.append(near.argmax() if near.any() else len(first) - 1)
    return np.array(first), np.array(run_of)


@eqx.filter_jit
def finish(space, criterion, X, Y, runs: Runs, optimiser, max_steps: int) -> Runs:
    """The runs with their losses on all points, the best of them finished there."""
    fine = _Objective(space, criterion, X, Y, 1.0)
    runs = _sorted(eqx.tree_at(lambda r: r.value, runs, jax.lax.map(fine, runs.u)))
    finished = jax.lax.map(lambda u: _run(fine, u, optimiser, max_steps), runs.u[:FINISHERS])
    return jax.tree.map(lambda new, old: old.at[:FINISHERS].set(new), finished, runs)


def _sorted(runs: Runs) -> Runs:
    order = jnp.argsort(runs.value)
    return jax.tree.map(lambda leaf: leaf[order], runs)


DESIGN_POINTS = 256  # in the box, from which the starts are chosen
FINISHERS = 1  # runs that are finished on all points
NEIGHBOURS = 0.02  # of the side of the box, within which starts share a run


class _Objective(eqx.Module):
    """u -> value. `thinning` keeps the ridge Nλ of all points when X is a subset of them."""

    space: SearchSpace
    criterion: SearchCriterion
    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    thinning: float = eqx.field(static=True)

    def __call__(self, u: Float[Array, " P"]) -> Float[Array, ""]:
        kernel, regularization = self.space.decode(u, self.X)
        return self.criterion.value(kernel, self.X, self.Y, self.thinning * regularization)


def _run(objective: _Objective, u: Float[Array, " P"], optimiser, max_steps: int) -> Runs:
    """One run of the optimiser from u."""
    # optimistix starts its best loss in the default dtype, which float32 data must then meet.
    default = jnp.result_type(float)

    def in_default(v):
        return objective(v.astype(u.dtype)).astype(default)

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
    value = found.state.f_info.f.astype(u.dtype) if bare else objective(best)
    converged = found.result == optx.RESULTS.successful
    return Runs(best, value, converged, found.stats["num_steps"])


def keeping_the_best(optimiser: optx.AbstractMinimiser) -> optx.AbstractMinimiser:
    """The optimiser, so that its last point is the best it has seen.

    That of BFGS is: its line search accepts no other, and optimistix's wrapper would return the
    point before it.
    """
    return optimiser if isinstance(optimiser, optx.BFGS) else optx.BestSoFarMinimiser(optimiser)


def _design(P: int, count: int, dtype) -> Float[Array, "count P"]:
    """A space-filling design in the box: the additive sequence of Roberts (2018), R_d."""
    root = 2.0
    for _ in range(64):  # the positive solution of root^(P + 1) = root + 1
        root = (1 + root) ** (1 / (P + 1))
    share = (0.5 + np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, P + 1))) % 1.0
    return jnp.asarray(np.arcsin(2 * share - 1), dtype)


def _spread_out(
    design: Float[Array, "count P"], values: Float[Array, " count"], count: int
) -> Float[Array, "{count} P"]:
    """The best points of the design that are not neighbours of a better one already taken."""
    reach = 0.25 * design.shape[1] ** 0.5  # of a box of side 1; a float has no dtype
    shares = jnp.sin(design) / 2
    taken = []
    for _ in range(count):
        best = jnp.argmin(values)
        taken.append(design[best])
        near = jnp.linalg.norm(shares - shares[best][None], axis=1) < reach
        values = jnp.where(near, HUGE + values, values)
    return jnp.stack(taken)
