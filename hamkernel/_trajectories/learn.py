"""`learn_field`: from noisy states at times to a field, by iterations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo
from hamkernel._fields.expansions import KernelField
from hamkernel._fields.joined import learned_field
from hamkernel._gram_operator import placed_product
from hamkernel._kernels.functions import as_pytree
from hamkernel._learned.diagnostics import diagnostics
from hamkernel._learned.result import Learned, empty, misfits
from hamkernel._runs.flow import Expansion, field_values
from hamkernel._runs.preprocessing import (
    Preprocessed,
    decide,
    landmarks,
    preprocess,
    sample_points,
    seconds_of_iteration,
)
from hamkernel._runs.runs import Runs
from hamkernel._runs.smoothing import interpolate, power_of_two
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import complete
from hamkernel._trajectories.evidence import Evidence
from hamkernel._trajectories.iteration import (
    Current,
    End,
    Task,
    asks_for_process,
    begin,
    choose_end,
    fix_process_noise,
    initial_loss,
    innovations_of,
    iterate,
)
from hamkernel._trajectories.kalman import as_observations
from hamkernel._trajectories.model import Model
from hamkernel._trajectories.quality import (
    chi_squared,
    disturbances,
    energies,
    join_runs,
    quality,
    with_causes,
)
from hamkernel._trajectories.search import (
    LEAST_NOISE,
    bounds_and_design,
    impulses,
    landmark_spacing,
)
from hamkernel._trajectories.segments import LONG, equal_pieces


def learn_field(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Callable[..., Array] | None,
    drift: Any,
    sigma: Float[np.ndarray, " n"] | None,
    process: Float[np.ndarray, " n"] | None,
    solver: Nystrom | None,
    max_steps: int,
    progress: bool | None,
    again: Callable[[Runs], Learned],
) -> Learned:
    """The field of these runs by iterations; see `hk.learn`.

    Args:
        K: the kernel, with amplitudes and its number of inputs.
        runs: the runs.
        mean: the mean of the caller.
        drift: the known part of the field, `known_part` of the mean.
        sigma: the noise of the caller, shape (n,), or None.
        process: the process noise of the caller, shape (n,), or None.
        solver: the solver of the caller, or None.
        max_steps: the largest number of iterations.
        progress: whether to show a progress bar; see `hk.learn`.
        again: `hk.learn` with all arguments but the runs.
    """
    bar = _bar(progress, total=2 + max_steps)
    data = preprocess(runs, drift)
    bar.update()
    K = complete(K, jax.device_put(sample_points(data)[0]), runs.dimension)
    most_landmarks = None if solver is None else solver.max_points
    start = _start(K, drift, data, sigma, process, landmarks(data, most_landmarks))
    seconds = seconds_of_iteration(data, start.landmarks[1])
    bar.set_description("learning" + (f", {seconds:.0f} s an iteration" if seconds >= 1 else ""))
    task, now = start.begin(data)
    if not runs.is_decided:
        runs, data = decide(runs, data, lambda d: initial_loss(task._replace(data=d), now.model))
        task, now = start.begin(data)
    q = start.floor if process is None else np.maximum(process, start.floor)
    end = first = iterate(*fix_process_noise(task, now, q), max_steps, bar)
    if process is None and asks_for_process(end, start.impulse):

        def ends_of_part(part: Preprocessed) -> tuple[End, End]:
            task, now = start.begin(part)
            without = iterate(*fix_process_noise(task, now, q), max_steps, bar)
            return without, iterate(task, now, max_steps, bar)

        end = choose_end(end, iterate(task, now, max_steps, bar), ends_of_part)
    bar.close()
    return _result(runs, mean, end, first, process, sigma is not None, again)


class _Start(NamedTuple):
    """The first guesses that all passes share.

    Attributes:
        kernel: the kernel.
        mean: the known part of the field.
        log_noise: the first guess of log σ, shape (n,).
        free: the coordinates whose noise is estimated.
        X: points along the smoothed runs.
        Y: their velocities, less those of the mean.
        landmarks: the landmarks, how many to begin with, how many are quick, and the cap.
        spacing: the least lengthscale.
        impulse: log of the process noise that would explain all of the motion.
        floor: the process noise that stands for none.
        process: the process noise of the caller, None if it is looked for.
    """

    kernel: AbstractMatrixKernel
    mean: Any
    log_noise: Float[Array, " n"]
    free: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    landmarks: tuple[np.ndarray, int, int, bool]
    spacing: float
    impulse: np.ndarray
    floor: np.ndarray
    process: np.ndarray | None

    def begin(self, data: Preprocessed) -> tuple[Task, Current]:
        """The task and its first path.

        Process noise is free and takes up the error of the smoothed path. With process noise held
        at its floor the kernel followed this error. One of two logs of a pendulum, q alone at 5 Hz,
        noise .01, then ended at a field error of 5.4 %, for .18 %
        (`tests/benchmarks/trajectories.py "only q 5 Hz .01"`, seed 0).
        """
        model = Model(self.kernel, self.log_noise, jnp.asarray(self.impulse))
        log = self.X, self.Y, data.scale, self.free, self.impulse, self.spacing
        bounds, design = bounds_and_design(model, *log)
        if self.process is not None:  # pushes stand out beside it from the beginning
            n, is_given = len(self.process), self.process > self.floor
            bounds.free[-n:] &= ~is_given
            with np.errstate(divide="ignore"):
                design[:, -n:] = np.where(is_given, np.log(self.process), design[:, -n:])
        wide = jnp.asarray(100 * data.scale)  # a prior of starts that says next to nothing
        pieces = equal_pieces(data.runs, LONG)
        task = Task(data, self.mean, *self.landmarks, bounds, wide, pieces)
        return task, begin(task, model, design)


def _start(K, mean, data: Preprocessed, sigma: Any, process: Any, landmarks) -> _Start:
    """The first guesses from the smoothed runs; sigma and process are the caller's, or None."""
    X, Y = sample_points(data)
    if mean is not None:
        Y = Y - np.asarray(jax.vmap(mean)(jnp.asarray(X)))
    S, first = landmarks[:2]
    impulse = impulses(K, jax.device_put(S[:first]), Y, data)
    return _Start(
        kernel=K,
        mean=mean,
        log_noise=jax.device_put(np.log(_first_noise(data) if sigma is None else sigma)),
        free=np.isfinite(data.noise) & (sigma is None),
        X=X,
        Y=Y,
        landmarks=landmarks,
        spacing=landmark_spacing(X, S[:first], data.scale),
        impulse=impulse,
        floor=LEAST_NOISE * np.exp(impulse),
        process=process,
    )


def _bar(progress: bool | None, total: int) -> Any:
    """A progress bar, by default from ten seconds on."""
    from tqdm import tqdm  # so that importing the package does not load it

    wait = 0.0 if progress else 10.0
    return tqdm(desc="learning", total=total, disable=progress is False, delay=wait)


def _first_noise(data: Preprocessed) -> Float[np.ndarray, " n"]:
    """The noise of each coordinate that the smoother estimates, at least 1e-6 of the states."""
    noise = np.where(np.isfinite(data.noise), data.noise, data.scale)
    return np.maximum(noise, 1e-6 * data.scale)


def _result(
    runs: Runs,
    mean: Any,
    end: End,
    first: End,
    given_process: np.ndarray | None,
    is_noise_given: bool,
    again: Callable[[Runs], Learned],
) -> Learned:
    """The result; warns where it must.

    Args:
        runs: the runs of the caller.
        mean: the mean of the caller.
        end: the end that is returned.
        first: the end of the first pass, without process noise unless some was given.
        given_process: the process noise of the caller, if any.
        is_noise_given: whether the caller gave the noise.
        again: `learn` with all arguments but the runs.
    """
    mean = None if mean is None else as_pytree(mean)
    task, now, data = end.task, end.now, end.task.data
    times = runs.host_arrays()[0]
    states = _fitted_states(end, times)
    noise = np.where(np.isfinite(data.noise), np.exp(np.asarray(now.model.log_noise)), np.nan)
    # Without process noise q stands at the floor of the integrator, and is none.
    is_free = task.bounds.free[-2 * len(noise) :]
    process = np.where(is_free[len(noise) :], np.exp(np.asarray(now.model.log_process)), 0.0)
    process = process if given_process is None else given_process
    misfit = misfits(runs, states, noise)
    z, counts = innovations_of(end), np.asarray(now.rows.counts)
    fit = quality(runs, end, misfit, z, process, states)
    fit = fit if first is end else fit._replace(**chi_squared(first, innovations_of(first)))
    fit = fit._replace(noise=noise, is_noise_known=is_noise_given)
    fit = fit._replace(process=process if given_process is None else None)
    observations = as_observations(now.rows, now.model, task.mean, task.start_deviation)
    count = 1 if observations is None else sum(len(y) for _, y in observations.parts())
    regularization = jnp.asarray(1 / count)
    field = _field(now.field, regularization)
    if fit.kept.any():
        fit = with_causes(fit, runs, end)._replace(energies=energies(field, fit, states))
    table = diagnostics(fit, now.field.kernel, sample_points(data)[0])
    if table.warning:
        require.warn(table.warning)
    return Learned(
        field=field,
        kernel=now.field.kernel,
        regularization=regularization,
        noise=jnp.asarray(noise),
        process_noise=jnp.asarray(process),
        states=tuple(jax.device_put(states)),
        kept=jnp.asarray(fit.kept),
        dropped=fit.dropped,
        pushed=fit.pushed,
        misfit=jnp.asarray(misfit),
        chi_squared=jnp.asarray(fit.chi_squared),
        innovations=tuple(map(jnp.asarray, join_runs(np.where(counts > 0, z, np.nan), end))),
        whiteness=jnp.asarray(fit.white.probability),
        widening=jnp.asarray(fit.white.widening),
        disturbance=disturbances(end, times, bool(process.any())),
        history=tuple(end.history),
        converged=table.is_usable,
        diagnostics=table,
        runs=runs,
        observations=observations,
        mean=mean,
        evidence=Evidence(
            now.model, now.field.points, now.rows, task.start_deviation, data.scale, is_free
        ),
        again=again,
    )


def _fitted_states(end: End, times: list[np.ndarray]) -> list[Float[np.ndarray, "T n"]]:
    """The paths at all times of their runs, by cubics where samples were averaged."""
    now, data = end.now, end.task.data
    out = []
    for t, run, path in zip(times, data.runs, now.paths, strict=True):
        if not np.array_equal(run.times, t - t[0]):
            X, N = run.points(path), len(path)
            X = np.pad(X, ((0, power_of_two(N) - N), (0, 0)), "edge")  # one program for many logs
            slope = np.asarray(field_values(now.field, jnp.asarray(X)))[:N]
            path = interpolate(t - t[0], run.times, path, slope)
        out.append(path)
    return out


def _field(expansion: Expansion, regularization: Float[Array, ""]) -> Any:
    """The field as one of the library."""
    S, A = expansion.points, expansion.coefficients
    square = np.vdot(A, placed_product(expansion.kernel, S, S, A))  # ‖f‖² = aᵀGa
    field = KernelField(
        kernel=expansion.kernel,
        points=S,
        coefficients=A,
        residual=empty(A.shape[1]),
        norm=jax.device_put(np.sqrt(max(square, 0.0))),
        regularization=regularization,
        offset=jnp.zeros((), S.dtype),
        info=SolverInfo("learn", landmarks=jax.device_put(len(S))),
        mean=None,
    )
    return learned_field(field, expansion.mean)
