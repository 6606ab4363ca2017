"""One kernel, fitted to the data of every noise seed and tested, in one compiled program."""

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel._field import KernelField
from hamkernel._fit import fit
from hamkernel._simulate import simulate
from hamkernel._structured import AbstractMatrixKernel
from hamkernel.paper._experiments import Experiment
from hamkernel.systems import sample

_TIMES = 200  # steps of the test trajectory
_POINTS = 10_000  # where the odd error is sampled, as in the paper
_POINTS_KEY = 2023  # the same points for every kernel and seed
_BATCH = 20  # seeds in one call of the compiled program, whatever their number


class Outcome(eqx.Module):
    """The tests of one kernel on S seeds.

    Attributes:
        ts: times of the test trajectory [s], shape (T,).
        true: the test trajectory of the true system, shape (T, n).
        true_orbits: from the initial states of the data, over the longer time of the phase
            portraits, shape (B, P, n).
        learned: the test trajectory of each learned field, shape (S, T, n).
        error: its distance from the true one, shape (S, T).
        quantities: numbers by name, each of shape (S,).
        field: the one learned from the first seed; its `points` are the states measured.
        orbits: `true_orbits` with this field.
    """

    ts: Float[Array, " T"]
    true: Float[Array, "T n"]
    true_orbits: Float[Array, "B P n"]
    learned: Float[Array, "S T n"]
    error: Float[Array, "S T"]
    quantities: dict[str, Float[Array, " S"]]
    field: KernelField
    orbits: Float[Array, "B P n"]


def datasets(
    experiment: Experiment, keys: Key[Array, " S"]
) -> tuple[Float[Array, "S N n"], Float[Array, "S N n"]]:
    """Return states and velocities for each noise key, trajectory after trajectory.

    Args:
        experiment: what is sampled.
        keys: one key per seed.
    """
    ts = experiment.step * jnp.arange(experiment.count, dtype=float)
    x0 = jnp.asarray(experiment.initial_states)
    return _datasets(experiment.system, x0, ts, jnp.asarray(experiment.noise), keys)


@eqx.filter_jit
def _datasets(system, x0, ts, noise, keys):
    X, Y = jax.vmap(lambda key: sample(system, x0, ts, noise, noise, key=key))(keys)
    S, _, _, n = X.shape  # (S, B, T, n)
    return X.reshape(S, -1, n), Y.reshape(S, -1, n)  # (S, N, n)


def evaluate(
    experiment: Experiment,
    kernel: AbstractMatrixKernel,
    X: Float[Array, "S N n"],
    Y: Float[Array, "S N n"],
    regularization: ArrayLike,
    *,
    tolerance: float = 1e-10,
) -> Outcome:
    """Fit `kernel` to every data set and test the learned fields.

    The quantities are the mean and maximum of the trajectory error over the test horizon; mean and
    variance of the odd error ‖f(x) + f(−x)‖ over the sampled points; and along the test
    trajectory, mean and variance of the learned Hamiltonian on the learned trajectory (where the
    kernel has one; with the constant that the representer gives it) and of the true Hamiltonian
    on the true trajectory.

    Args:
        experiment: the system and its test.
        kernel: the matrix-valued kernel; where `regularization` has the shape (S,), one for each
            data set, as leaves with a leading axis S.
        X: states, shape (S, N, n), of `datasets`.
        Y: velocities, shape (S, N, n).
        regularization: of `fit`, shape () for all data sets or (S,).
        tolerance: of the integrator, relative and absolute.

    Raises:
        RuntimeError: a fit or an integration failed.
    """
    (low_q, high_q), (low_p, high_p) = experiment.box
    corner, opposite = jnp.asarray([max(low_q, 0.0), low_p]), jnp.asarray([high_q, high_p])
    uniform = jax.random.uniform(jax.random.key(_POINTS_KEY), (_POINTS, 2))
    step = experiment.horizon / _TIMES
    ts = step * jnp.arange(round(experiment.portrait_horizon / step) + 1, dtype=X.dtype)
    starts = jnp.asarray([experiment.test_state, *experiment.initial_states])
    accuracy = jnp.asarray(tolerance, X.dtype)
    true = _trajectories(experiment.system, starts, ts, accuracy)
    points = corner[None] + uniform * (opposite - corner)[None]
    ridge = jnp.asarray(regularization, X.dtype)
    if not ridge.ndim:  # the same hyperparameters for all data sets
        kernel, ridge = jax.tree.map(lambda a: jnp.stack([a] * len(X)), (kernel, ridge))
    batch = min(_BATCH, len(X))
    outcomes = []
    for start in range(0, len(X), batch):
        # The last batch is filled up with the last seed, so that no other size is compiled.
        rows = np.minimum(np.arange(start, start + batch), len(X) - 1)
        K, x, y, delta = jax.tree.map(lambda a, rows=rows: a[rows], (kernel, X, Y, ridge))
        tested = _evaluate(K, x, y, delta, experiment.system, ts, true, points, accuracy)
        outcomes.append(tested)
    first = outcomes[0]
    learned, error, quantities = jax.tree.map(
        lambda *parts: jnp.concatenate(parts)[: len(X)],
        *((each.learned, each.error, each.quantities) for each in outcomes),
    )
    return dataclasses.replace(first, learned=learned, error=error, quantities=quantities)


@eqx.filter_jit
def _trajectories(
    field: Callable[[Array], Array],
    starts: Float[Array, "B n"],
    ts: Float[Array, " P"],
    tolerance: Float[Array, ""],
) -> Float[Array, "B P n"]:
    # Nothing is differentiated here, and a plain loop compiles faster than one with checkpoints.
    options: Any = dict(rtol=tolerance, atol=tolerance, adjoint=diffrax.ForwardMode())
    return jax.vmap(lambda x0: cast(Array, simulate(field, x0, ts, **options).ys))(starts)


@eqx.filter_jit
def _evaluate(kernel, X, Y, regularization, system, ts, true, points, tolerance) -> Outcome:
    """`true` (1 + B, P, n): the test trajectory, of which the test takes the start, and orbits."""
    test = slice(_TIMES + 1)

    def one_seed(kernel, regularization, X, Y):
        field = fit(kernel, X, Y, regularization)
        learned = _trajectories(field, true[:, 0], ts, tolerance)
        error = jnp.linalg.norm(learned[0, test] - true[0, test], axis=1)
        quantities = {
            "trajectory_error_mean": error.mean(),
            "trajectory_error_max": error.max(),
            **_moments("true_hamiltonian", jax.vmap(system.hamiltonian)(true[0, test])),
        }
        if kernel.symplectic:
            energy = jax.vmap(field.unanchored_potential)(learned[0, test])
            quantities |= _moments("learned_hamiltonian", energy)
        return field, learned, error, quantities

    def odd_error(field):
        values = jax.vmap(field)(jnp.concatenate([points, -points]))
        total = values[: len(points)] + values[len(points) :]  # f(x) + f(−x)
        return _moments("odd_error", jnp.linalg.norm(total, axis=1))

    fields, learned, error, quantities = jax.vmap(one_seed)(kernel, regularization, X, Y)
    # One seed after the other: all at once, the many points would not fit into the caches.
    quantities |= jax.lax.map(odd_error, fields)
    return Outcome(
        ts=ts[test],
        true=true[0, test],
        true_orbits=true[1:],
        learned=learned[:, 0, test],
        error=error,
        quantities=quantities,
        field=jax.tree.map(lambda leaf: leaf[0], fields),
        orbits=learned[0, 1:],
    )


def _moments(name: str, values: Float[Array, " P"]) -> dict[str, Float[Array, ""]]:
    return {f"{name}_mean": values.mean(), f"{name}_variance": values.var()}
