"""`learn`: from noisy states at times to a field."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo, known_part
from hamkernel._fields.expansions import KernelField
from hamkernel._fields.joined import learned_field
from hamkernel._fields.kinetic import Kinetic, kinetic
from hamkernel._gram_operator import placed_product
from hamkernel._kernels.functions import as_pytree
from hamkernel._machine import follow_data, full_precision, one_blas_thread
from hamkernel._observations.kinds import inputs_or_parameters
from hamkernel._observations.measurements import sampled_points
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
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.completed import complete
from hamkernel._structures.lagrangian import Lagrangian
from hamkernel._structures.masses import UnknownMasses
from hamkernel._trajectories.diagnostics import check_identifiable, diagnostics
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
from hamkernel._trajectories.lagrangian import LearnedLagrangian, learn_lagrangian
from hamkernel._trajectories.laws import are_learned_from_rows, learn_laws
from hamkernel._trajectories.learned import Learned, empty, misfits
from hamkernel._trajectories.model import Model, with_amplitude
from hamkernel._trajectories.quality import (
    chi_squared,
    disturbances,
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


@overload
def learn(K: Lagrangian, runs: Runs, *, noise: ArrayLike | None = None) -> LearnedLagrangian: ...
@overload
def learn(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Callable[..., Array] | None = None,
    noise: ArrayLike | None = None,
    solver: Nystrom | None = None,
    *,
    process_noise: ArrayLike | None = None,
    mass: ArrayLike | None = None,
    masses: bool = False,
    iterations: int = 8,
    progress: bool | None = None,
) -> Learned: ...
@follow_data
@one_blas_thread
@full_precision
def learn(
    K: AbstractMatrixKernel | Lagrangian,
    runs: Runs,
    mean: Callable[..., Array] | None = None,
    noise: ArrayLike | None = None,
    solver: Nystrom | None = None,
    *,
    process_noise: ArrayLike | None = None,
    mass: ArrayLike | None = None,
    masses: bool = False,
    iterations: int = 8,
    progress: bool | None = None,
) -> Any:
    """Learn a field from noisy states at times, without velocities.

    `learn` models the states x(t) of each run as a solution of ẋ = f(x, u) + w, measured with
    Gaussian noise, and f as a Gaussian process with the kernel K. It starts from a smoothed path
    and iterates. Each iteration linearises every interval between two samples about the current
    path; a Kalman filter makes the rows independent, so that the field follows in closed form. The
    hyperparameters and the noise maximise the marginal likelihood p, and a Kalman smoother gives
    the next path. The iteration ends when log p rises by less than ½.

    The first pass has no process noise w. If it does not settle, or if w would raise log p by
    more than the price of its hyperparameters, a second pass estimates the intensity of w, and
    `learn` returns the likelier of the two.

    If K is made of `hk.Shared`, `learn` solves twice for the laws, without iterations, in any
    number of coordinates. It uses weak rows, ∫ φ f dt along a smoothed path, whose cost is linear
    in n. `solver` and `iterations` then have no effect, and innovations are NaN.

    Args:
        K: a matrix-valued kernel, whose hyperparameters are the first guess. `learn` gives a
            structure without an amplitude one: `Symplectic(k)` becomes `Symplectic(1.0 * k)`. Runs
            with inputs need a `Controlled` kernel, and runs with parameters a `Family`. Or a
            `Lagrangian`: `learn` then returns a `LearnedLagrangian`, from positions q, or (q, v),
            with torques as inputs, and of the arguments below only `noise` has a meaning.
        runs: the log; see `Runs`, which also says what inputs do between samples.
        mean: a known part of the field, x (n,) -> (n,), or with inputs x, u -> (n,) too; K learns
            the rest.
        noise: the standard deviation of the sensor noise, if you know it, in units of the states:
            a number, or one for each coordinate, shape (n,). `learn` can then detect that a field
            does not explain the runs. If None, it estimates the noise.
        solver: `hk.Nystrom(max_points=…)` sets the number of landmarks, points of the paths that
            carry the field. If None, `learn` begins with 48 for n = 2 and 80 for n = 4, inputs
            counted as coordinates. It doubles this number while the marginal likelihood grows by
            more than its error and a solve takes a second or two, or up to ten seconds if the
            landmarks cause half of the remaining variance. A warning says if the runs need more.
        process_noise: the intensity q of the white noise w, in units of the states over √time: a
            number, or one for each coordinate, shape (n,). The noise w stands for motion that the
            field lacks, from stiction, timing or a flexible part. 0 states that the structure is
            the whole truth. If None, `learn` estimates q if the structure alone does not explain
            the runs, and keeps it if the marginal likelihood rises enough. Intervals in which w is
            above three standard deviations, as when a hand pushes the system, get a variance of
            their own. A smaller q than the estimate may predict better: on a real pendulum half of
            it has an error of .057 rad, and the estimate .105 (`tests/benchmarks/real_logs.py`).
        mass: the known masses, one number or one for each position, shape (m,) or (m, m). The mean
            is then `hk.kinetic(mass)`, and K learns the forces, such as `Symplectic(Select(k, 0))`.
            Runs of the m positions alone get momenta that were not measured.
        masses: whether states are (q, q̇) with unknown masses instead of (q, p). `learn` then finds
            the ratios of the masses, `learned.kernel.masses`, and K becomes an `UnknownMasses`.
            With inputs the masses are those of the drift, `learned.kernel.drift.masses`.
        iterations: the largest number of iterations; 4 or 5 are usual.
        progress: whether to show a progress bar (tqdm); if None, from ten seconds on.

    Returns:
        A `Learned`: the field, its kernel, the noise, the fitted states, and how well they fit.
        Runs whose lengths have the same next power of two do not compile again.

    Raises:
        TypeError: the runs have inputs and K takes none, or the other way round; K is not
            matrix-valued, `runs` no Runs, or `solver` no Nystrom. ValueError: the structure does
            not allow this n; the data do not separate the inputs from the drift; the noise is not
            positive; a coordinate was never measured and no mean says how it moves the others;
            float64 is not enabled.

    Warns:
        UserWarning: at most once. It names the rows of `learned.diagnostics` that fall short, with
            their meaning.
    """
    _check_types(K, runs, mean, noise)
    if isinstance(K, Lagrangian):
        unused = {"mean": mean, "solver": solver, "process_noise": process_noise, "mass": mass}
        return learn_lagrangian(K, runs, noise, unused | {"masses": masses})
    again = LearnAgain(
        kernel=matrix_kernel(K),
        mean=mean if mean is None else as_pytree(mean),
        noise=noise,
        solver=solver,
        process_noise=process_noise,
        masses=masses,
        mass=mass,
        iterations=iterations,
    )
    if mass is not None:
        mean, runs = _kinetic_mean(mass, mean, runs)
    K, sigma, process = _check(with_amplitude(matrix_kernel(K)), runs, noise, process_noise, solver)
    max_steps = require.count(iterations, "iterations")
    K = _unknown_masses(K, runs.dimension) if masses else K
    drift = known_part(K, mean, runs.dimension, jnp.float64)
    check_identifiable(K, runs, drift)
    if are_learned_from_rows(K) and process is None:
        return learn_laws(K, runs, mean if mean is None else as_pytree(mean), sigma, again)
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


class LearnAgain(eqx.Module):
    """`learn` with the arguments of an earlier call, for other runs."""

    kernel: AbstractMatrixKernel
    mean: Any
    noise: Any
    solver: Nystrom | None
    process_noise: Any
    masses: bool
    mass: Any
    iterations: int

    def __call__(self, runs: Runs) -> Learned:
        """The field of these runs."""
        options = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return learn(options.pop("kernel"), runs, progress=False, **options)


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


def _kinetic_mean(mass: Any, mean: Any, runs: Any) -> tuple[Kinetic, Any]:
    """The mean of known masses, and runs of positions and momenta."""
    if mean is not None:
        raise TypeError("mass= is a mean, hk.kinetic(mass): give one of mass and mean.")
    mean = kinetic(mass)
    positions = mean.mass.shape[0] if mean.mass.ndim else 1
    if isinstance(runs, Runs) and runs.dimension == positions:
        runs = runs.with_momenta()
    return mean, runs


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
    again: LearnAgain,
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
    task, now, history = end.task, end.now, end.history
    field, data = now.field, task.data
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
    fit = with_causes(fit, runs, end) if fit.kept.any() else fit
    table = diagnostics(fit, field.kernel, sample_points(data)[0])
    if table.warning:
        require.warn(table.warning)
    observations = as_observations(now.rows, now.model, task.mean, task.start_deviation)
    count = 1 if observations is None else sum(len(y) for _, y in observations.parts())
    regularization = jnp.asarray(1 / count)
    return Learned(
        field=_field(field, regularization),
        kernel=field.kernel,
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
        history=tuple(history),
        converged=table.is_usable,
        diagnostics=table,
        runs=runs,
        observations=observations,
        mean=mean,
        evidence=Evidence(
            now.model, field.points, now.rows, task.start_deviation, data.scale, is_free
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


def _check_types(K: Any, runs: Any, mean: Any, noise: Any) -> None:
    """Refuse traced arguments, arrays in place of runs, and arguments in another order."""
    require.no_tracers("hk.learn", "Call it outside; hk.fit works inside.", K, runs, mean, noise)
    if not isinstance(runs, Runs):
        raise TypeError(
            "learn takes hk.Runs(times, states) after the kernel, hk.learn(K, runs); got "
            f"{type(K).__name__} and {type(runs).__name__}. For states with velocities take hk.fit "
            "or hk.tune."
        )
    if mean is not None and not callable(mean):
        raise TypeError(
            f"mean is a {type(mean).__name__}; a callable x (n,) -> (n,) is needed, such as "
            "hk.kinetic(mass)."
        )


def _check(
    K: AbstractMatrixKernel, runs: Any, noise: Any, process_noise: Any, solver: Any
) -> tuple[AbstractMatrixKernel, np.ndarray | None, np.ndarray | None]:
    """The kernel with its number of inputs, and both noises of the caller, (n,) or None."""
    if not (solver is None or isinstance(solver, Nystrom)):
        raise TypeError(f"the solver of learn is hk.Nystrom(max_points=…) or None; got {solver!r}.")
    n = runs.dimension
    extra = runs.inputs if runs.parameters is None else runs.parameters
    if K.takes_inputs and extra is not None:
        # This refuses the one in the place of the other.
        inputs_or_parameters(runs.inputs, runs.parameters, K)
    if K.takes_inputs and extra is None:
        needed = {
            "inputs": "what was applied: hk.Runs(times, states, inputs), for each run u at its "
            "times, shape (T, m).",
            "parameters": "to know of which system each run is: hk.Runs(times, states, "
            "parameters=[(0.5,), (0.8,), …]), for each run θ of shape (p,).",
        }
        raise TypeError(f"a {type(K).__name__} kernel needs {needed[K.input_name]}")
    if runs.parameters is not None and not K.takes_inputs:
        raise TypeError(
            f"the runs have parameters and {type(K).__name__} takes none: say how systems are "
            "alike, hk.Family(K, hk.Gaussian(1.0)), or leave parameters out of Runs."
        )
    if runs.inputs is not None and not K.takes_inputs:
        raise TypeError(
            f"the runs have inputs and {type(K).__name__} takes none: say how they act, "
            "hk.Controlled(K, inputs=hk.InputMatrix(1.0, acts_on=(1,))). To ignore what was applied"
            ", leave inputs out of Runs."
        )
    if extra is None:
        K.check_dimension(n)
    else:
        U = jnp.concatenate([jnp.atleast_2d(u) for u in extra])
        K, _ = sampled_points(K, jnp.zeros((len(U), n), U.dtype), U)
    if jax.dtypes.canonicalize_dtype(float) != jnp.float64:
        raise ValueError(
            "learn needs doubles, since paths and their tangents are compared over many steps: "
            "jax.config.update('jax_enable_x64', True) first."
        )
    return K, *_noises(noise, process_noise, n)


def _noises(
    noise: Any, process_noise: Any, n: int
) -> tuple[Float[np.ndarray, " n"] | None, Float[np.ndarray, " n"] | None]:
    """Both noises of each coordinate; None where the caller gave none."""
    sigma = process = None
    if noise is not None:
        sigma = _per_coordinate(
            require.positive(noise, "noise", "Leave it out to have it found from the runs."),
            n,
            "noise",
        )
    if process_noise is not None:
        process = _per_coordinate(
            require.floating(process_noise, "process_noise"), n, "process_noise"
        )
        if not (np.isfinite(process).all() and (process >= 0).all()):
            raise ValueError(
                f"process_noise must be 0 or more, got {process_noise}: 0 where the structure is "
                "the whole truth, None to have it found."
            )
    return sigma, process


def _per_coordinate(value: Any, n: int, name: str) -> Float[np.ndarray, " n"]:
    value = np.asarray(value, float)
    if value.shape not in ((), (n,)):
        raise ValueError(f"{name} has shape {value.shape}; a number or shape ({n},) is needed.")
    return np.broadcast_to(value, (n,))


def _unknown_masses(K: AbstractMatrixKernel, n: int) -> AbstractMatrixKernel:
    """K for states (q, q̇) of n coordinates, all masses equal at first."""
    if n == 2:
        raise ValueError(
            "masses=True with one degree of freedom: every mass explains the same motion and is "
            "only a unit of the energy, so there is nothing to find. Leave it out; (q, q̇) is "
            "(q, p) of a mass of one."
        )
    inner = K.state_kernel
    return K.with_states(
        inner if isinstance(inner, UnknownMasses) else UnknownMasses(inner, jnp.ones(n // 2))
    )
