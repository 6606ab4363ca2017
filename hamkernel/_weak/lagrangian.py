"""Learning a `Lagrangian` from positions and torques: weak rows, solved for twice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.base import KnownPart
from hamkernel._fields.kinetic import kinetic_of_velocities
from hamkernel._fields.lagrangian import LagrangianField, MachineOfPoints, lagrangian_field
from hamkernel._learned.result import AbstractLearned
from hamkernel._learned.score import Score, compute_score
from hamkernel._machine import compiled_by_size, precise_jit
from hamkernel._runs.preprocessing import preprocess
from hamkernel._runs.runs import Runs
from hamkernel._runs.table import Diagnostic, Diagnostics
from hamkernel._show import text
from hamkernel._solvers.lagrangian import (
    check_machine,
    missing_friction,
    plain_friction,
    ridge_solution,
    with_anchor,
)
from hamkernel._solvers.triangle import columns_used
from hamkernel._structures.lagrangian import (
    Lagrangian,
    LagrangianFeatures,
    lagrangian_features,
)
from hamkernel._tuning.lagrangian import Sizes, likeliest, torque_size
from hamkernel._weak.rows import (
    Channels,
    Pieces,
    factors,
    log_scale,
    path_covariance,
    smoothed_pieces,
    weak_rows,
    whiten,
)


class LearnedLagrangian(AbstractLearned):
    """The machine that `learn` found with a `Lagrangian`.

    Attributes:
        field: the machine, with the bands of what it says: `field.mass_matrix_deviation(q)`.
        kernel: the kernel with its hyperparameters.
        noise: the standard deviation of the sensor noise of each coordinate, shape (n,).
        torque_noise: the standard deviation of the torque of each joint at each sample, shape (m,).
        states: the smoothed states (q, v) of each run at its times, shape (T, 2m).
        log_evidence: the logarithm of the marginal likelihood of the weak rows, but for a constant.
            It compares kernels that were learned from the same runs.
        converged: whether the field may be used: no row of `diagnostics` that decides falls short.
        diagnostics: a table with one row for each question; `.failing` has the names of the rows
            that fall short.
        runs: the runs that were given.
        again: a function of the runs that calls `learn` with the same other arguments.
    """

    field: LagrangianField
    kernel: Lagrangian
    noise: Float[Array, " n"]
    torque_noise: Float[Array, " m"]
    states: tuple[Float[Array, "T n"], ...]
    log_evidence: float = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    diagnostics: Diagnostics = eqx.field(static=True)
    runs: Runs
    again: Callable[[Runs], LearnedLagrangian]

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        return self._headline, [
            ("kernel", text(self.kernel)),
            ("noise", text(self.noise)),
            ("torque noise", text(self.torque_noise)),
            *self._shortfalls,
            ("next", ".plot(), .score(), .field.mass_matrix(q), .field.mass_matrix_deviation(q)"),
        ]

    def _score(self, runs: Runs, first: int, draws: int) -> Score:
        learned_runs = self.runs
        mean: Any = kinetic_of_velocities(jnp.ones(()))  # of states (q, v)
        if learned_runs.inputs is not None:
            mean = KnownPart(mean, None, learned_runs.input_count, of_inputs=False)
        if learned_runs.dimension < self.field.dimension:
            learned_runs = learned_runs.with_momenta()
        noise = np.full(self.field.dimension, np.nan)
        noise[: len(self.noise)] = self.noise
        field, data = MachineOfPoints(self.field), preprocess(learned_runs, mean)
        return compute_score(field, mean, data, runs, first, noise, np.zeros_like(noise))

    def plot(self, run: int = 0) -> Any:
        """One figure: the positions of one run with their smoothed paths, gravity and inertia.

        It is that of `hk.plot.machine`.

        Args:
            run: the run, counted from 0, or from the end if negative.

        Returns:
            The Matplotlib figure.
        """
        import hamkernel  # the door to pictures, which load Matplotlib

        return hamkernel.plot.machine(self, run)

    @property
    def posterior(self) -> LagrangianField:
        """The field, which keeps its factor: its methods `…_deviation` are the bands."""
        return self.field


def learn_lagrangian(
    K: Lagrangian,
    runs: Runs,
    noise: Any,
    unused: dict[str, Any],
    again: Callable[[Runs], LearnedLagrangian],
) -> LearnedLagrangian:
    """The machine from runs of positions, or of (q, v), with torques as inputs; see `learn`.

    Args:
        K: the kernel.
        runs: the runs.
        noise: the standard deviations of the coordinates, if they are known.
        unused: arguments of `learn` that say nothing of a Lagrangian.
        again: `learn` with all arguments but the runs.
    """
    m, noise = _check(K, runs, noise, unused)
    states = runs.host_arrays()[1]
    q, v = ([x[:, part] for x in states] for part in (slice(m), slice(m, None)))
    if not v[0].shape[1]:
        v = [np.full(x.shape, np.nan) for x in q]
    if noise is not None:
        noise = np.append(noise, np.full(2 * m - len(noise), np.nan)).reshape(2, m)
    channels = Channels(q, v, [np.array([c]) for c in range(m)], noise=noise)
    smoothing = smoothed_pieces(runs, channels)
    pieces = smoothing.pieces
    X = jnp.asarray(pieces.states())
    features = lagrangian_features(K, X)
    sizes = _sizes(K, pieces, m, smoothing.lengthscale)
    R = pieces.targets[0].size
    none = jnp.zeros((len(pieces.targets), R, R))
    first = likeliest(features, _WeakRows(pieces, none), sizes)
    shown = _with_kernel(features, first.kernel)
    weights = _solve(shown, pieces, none, first.deviation)[1]
    covariance = _covariance(shown, weights, pieces)
    rows = _WeakRows(pieces, covariance)
    end = likeliest(_with_kernel(features, first.kernel), rows, sizes, np.asarray(first.deviation))
    shown = _with_kernel(features, end.kernel)
    triangle, weights, A, y = _solve(shown, pieces, covariance, end.deviation)
    raw, targets = map(np.asarray, _rows(shown, pieces))
    residual = (targets - raw @ np.asarray(weights)) / pieces.values[0].sum()
    residual = jnp.asarray(residual[pieces.inside])
    field = lagrangian_field(shown, weights, triangle, end.deviation, residual, X)
    joints = ()
    if K.friction is None:
        joints = missing_friction(A, y, _friction(shown, pieces, covariance, end.deviation))
    table = _diagnostics(field, smoothing, sizes, joints)
    if table.warning:
        require.warn(table.warning)
    return LearnedLagrangian(
        field=field,
        kernel=end.kernel,
        noise=jnp.asarray(smoothing.noise.ravel()[: runs.dimension]),
        torque_noise=end.deviation,
        states=tuple(map(jnp.asarray, smoothing.states)),
        log_evidence=-end.loss,
        converged=table.is_usable,
        diagnostics=table,
        runs=runs,
        again=again,
    )


def _check(K: Lagrangian, runs: Any, noise: Any, unused: dict[str, Any]) -> tuple[int, Any]:
    extra = [name for name, value in unused.items() if value is not None and value is not False]
    if extra:
        raise TypeError(f"{extra[0]}= does not belong to learning a Lagrangian: leave it out.")
    if runs.parameters is not None:
        raise TypeError("a Lagrangian has no parameters: leave them out of Runs.")
    if not runs.is_decided:
        raise ValueError(
            "between='auto' and delay='fit' are not looked for with a Lagrangian: give both."
        )
    n = runs.dimension
    if runs.inputs is None:
        anchor = K.known_mass_matrix
        m = n if anchor is None else len(anchor[0])
        check_machine(K, np.zeros(1), m)
    else:
        m = runs.input_count
        check_machine(K, np.concatenate(runs.inputs), m)
    if n not in (m, 2 * m):
        raise ValueError(
            f"states have {n} coordinates and there are {m} torques: a Lagrangian is learned from "
            "positions (T, m), or positions and velocities (T, 2m), with a torque for each "
            "position, zero where a joint has no motor."
        )
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError("learn needs doubles: jax.config.update('jax_enable_x64', True) first.")
    if noise is not None:
        noise = np.asarray(require.positive(noise, "noise", "Leave it out to have it smoothing."))
        if noise.shape not in ((), (n,)):
            raise ValueError(f"noise has shape {noise.shape}; a number or shape ({n},) is needed.")
        noise = np.broadcast_to(noise, (n,))
    return m, noise


def _sizes(K: Lagrangian, pieces: Pieces, m: int, lengthscale: float) -> Sizes:
    """Torques as means over windows; a sinusoid has the lengthscale 2.7/ω, see `preprocess`."""
    speed = float(np.sqrt(np.mean(pieces.states()[:, m:] ** 2)))
    acceleration = 2.7 * speed / lengthscale
    means = pieces.targets[pieces.inside] / pieces.values[0].sum()
    torque = torque_size(K, means, acceleration)
    white = np.sqrt(pieces.overlap[0, 0] * pieces.spacing) / pieces.values[0].sum()
    return Sizes(torque, speed, acceleration, torque / float(white))


class _WeakRows(eqx.Module):
    """The rows of all pieces as the search calls them."""

    pieces: Pieces
    covariance: Float[Array, "B R R"]

    def __call__(self, features: LagrangianFeatures, deviation: Float[Array, " m"]):
        rows, targets = _rows_and_targets(features, self.pieces)
        L = factors(self.pieces, self.covariance, deviation)
        return whiten(L, rows), whiten(L, targets), log_scale(L)


_with_kernel = precise_jit(lambda features, K: features.with_kernel(K))


@compiled_by_size
def _solve(features, pieces, covariance, deviation) -> tuple[Array, ...]:
    A, y, _ = _WeakRows(pieces, covariance)(features, deviation)
    return *ridge_solution(*with_anchor(features, A, y)), A, y


def _rows_and_targets(features, pieces) -> tuple[Float[Array, "B W m r"], Float[Array, "B W m"]]:
    rows = features.whiten(weak_rows(features.motion_features, pieces))
    return features.with_gains(rows, jnp.asarray(pieces.targets))


_rows = compiled_by_size(_rows_and_targets)


@compiled_by_size
def _covariance(features, weights, pieces) -> Float[Array, "B R R"]:
    coefficients = features.kernel_coefficients(weights)

    def law(x):
        a, b = features.motion_features(x)
        return a @ coefficients, b @ coefficients

    return path_covariance(law, pieces)


@compiled_by_size
def _friction(features, pieces, covariance, deviation) -> Float[Array, "N k"]:
    """The rows of friction v and tanh(v/ε), whitened as those of the Lagrangian."""
    m = features.count

    def law(x):
        columns = plain_friction(features, x[None, m:])[0]
        return jnp.zeros_like(columns), columns

    return whiten(factors(pieces, covariance, deviation), weak_rows(law, pieces))


_LEAST_SWING = 5.0  # samples in a swing, as in `diagnostics`: with fewer noise hides the motion


def _diagnostics(
    field: LagrangianField, smoothing: Any, sizes: Sizes, joints: tuple[int, ...]
) -> Diagnostics:
    share = float(np.max(np.asarray(field.noise))) / sizes.error
    # A sinusoid of period 2π/ω has the lengthscale 2.7/ω.
    swing = 2.3 * smoothing.lengthscale / smoothing.pieces.spacing
    rows = len(field.residual) * field.features.count
    used = float(columns_used(field.triangle))
    return Diagnostics(
        (
            _mass_matrix(field),
            _friction_of(joints),
            Diagnostic(
                "torques",
                f"{share:.2g} unexplained",
                "0.5",
                share < 0.5,
                f"errors of the torques, averaged over windows, are {share:.2g} of them"
                if share < 0.5
                else "the machine explains little of the torques",
                "Likely causes: torques that act at other times than logged (delay=…), in other "
                "units, or on other joints; friction; a flexible part.",
                decides=True,
            ),
            Diagnostic(
                "degrees of freedom",
                f"{rows - used:.0f} of {rows}",
                "10",
                rows - used >= 10,
                f"{rows} rows determine {used:.0f} numbers",
                "Log more.",
                decides=True,
            ),
            Diagnostic(
                "sampling",
                f"{swing:.1f} samples a swing",
                f"{_LEAST_SWING:.0f}",
                swing >= _LEAST_SWING,
                f"there are {swing:.1f} samples a swing",
                "Sample faster: with fewer than five, noise and motion cannot be told apart.",
            ),
        )
    )


def _mass_matrix(field: LagrangianField) -> Diagnostic:
    least, deviation = float(field.least_inertia), float(field.least_inertia_deviation)
    return Diagnostic(
        "mass matrix",
        f"{least:.3g} with a deviation of {deviation:.2g}",
        "two deviations",
        field.is_identified,
        field.refusal.split(". ")[0] or "the mass matrix is positive definite all along the runs",
        "Motions along one path do not tell inertia from gravity and friction: log unused.",
        decides=True,
    )


def _friction_of(joints: tuple[int, ...]) -> Diagnostic:
    names = ", ".join(map(str, joints))
    return Diagnostic(
        "friction",
        f"joints {names}" if joints else "none is missing",
        "log p + 10",
        not joints,
        f"the torques are much likelier with friction in joint {names}, without which the "
        "mass matrix is wrong"
        if joints
        else "the torques do not ask for friction that the kernel lacks",
        "Take hk.Lagrangian(…, friction=True).",
        decides=True,
    )
