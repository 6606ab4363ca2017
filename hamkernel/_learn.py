"""`learn`: from noisy runs to a field or a machine; the door to all ways of learning."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._features import is_of_parts
from hamkernel._fields.base import known_part
from hamkernel._fields.kinetic import Kinetic, kinetic, kinetic_of_velocities
from hamkernel._kernels.functions import as_pytree
from hamkernel._learned.result import Learned
from hamkernel._machine import follow_data, full_precision, one_blas_thread
from hamkernel._observations.kinds import inputs_or_parameters
from hamkernel._observations.measurements import sampled_points
from hamkernel._runs.runs import Runs
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.completed import shared_laws
from hamkernel._structures.lagrangian import Lagrangian
from hamkernel._structures.masses import UnknownMasses
from hamkernel._trajectories.learn import learn_field
from hamkernel._trajectories.model import with_amplitude
from hamkernel._weak.lagrangian import LearnedLagrangian, learn_lagrangian
from hamkernel._weak.laws import learn_laws


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

    If K is made of `hk.Shared`, alone or beside `hk.Friction`, unknown masses and inputs with a
    constant input matrix, `learn` solves twice for the laws, without iterations, in any number of
    coordinates. It uses weak rows, ∫ φ f dt along a smoothed path, whose cost is linear in n.
    `solver` and `iterations` then have no effect, and innovations are NaN. If you give
    `process_noise`, such as 0, `learn` iterates: chains of n = 4, 8 and 12 then take 3.5, 7 and 10
    times as long, and four laws of five are two to four times more accurate. `learn` also iterates
    if the input matrix depends on the state, or if `between` or `delay` is to be found.

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
            the ratios of the masses, `learned.kernel.masses`, and K becomes an `UnknownMasses`. All
            coordinates of a particle of `hk.pairs` have one mass.
            With inputs the masses are those of the drift, `learned.kernel.drift.masses`. If K is
            made of `hk.Shared` laws of positions, the kinetic energy is ½ q̇ᵀMq̇. Laws are in the
            unit of H, in which the first mass is 1.
        iterations: the largest number of iterations; 4 or 5 are usual.
        progress: whether to show a progress bar (tqdm); if None, from ten seconds on.

    Returns:
        A `Learned`: the field, its kernel, the noise, the fitted states, and how well they fit.
        Runs whose lengths have the same next power of two do not compile again.

    Raises:
        TypeError: the runs have inputs and K takes none, or the other way round; K is not
            matrix-valued, or a `Family` of `hk.Shared` laws; `runs` is no Runs, or `solver` is no
            Nystrom.
        ValueError: the structure does not allow this n; the data do not separate the inputs from
            the drift; the noise is not positive; a coordinate was never measured and no mean says
            how it moves the others; float64 is not enabled.

    Warns:
        UserWarning: at most once. It names the rows of `learned.diagnostics` that fall short, with
            their meaning.
    """
    _check_types(K, runs, mean, noise)
    again = LearnAgain(
        kernel=K if isinstance(K, Lagrangian) else matrix_kernel(K),
        mean=mean if mean is None else as_pytree(mean),
        noise=noise,
        solver=solver,
        process_noise=process_noise,
        masses=masses,
        mass=mass,
        iterations=iterations,
    )
    if isinstance(K, Lagrangian):
        unused = {"mean": mean, "solver": solver, "process_noise": process_noise, "mass": mass}
        return learn_lagrangian(K, runs, noise, unused | {"masses": masses}, again)
    if mass is not None and masses:
        raise TypeError("masses=True finds the masses, and mass= states them: give one of the two.")
    if mass is not None:
        mean, runs = _kinetic_mean(mass, mean, runs)
    K, sigma, process = _check(with_amplitude(matrix_kernel(K)), runs, noise, process_noise, solver)
    max_steps = require.count(iterations, "iterations")
    if masses:
        K = _unknown_masses(K, runs.dimension)
        if mean is None and is_of_parts(K) and _are_forces(K, runs.dimension):
            mean = kinetic_of_velocities(jnp.ones(runs.dimension // 2))
    drift = known_part(K, mean, runs.dimension, jnp.float64)
    _check_identifiable(K, runs, drift)
    # Rows are the cheaper way from n = 4 on. For chains of n = 4, 8 and 12 iterations take 3.5, 7
    # and 10 times as long, for errors of the law of 1.5 to a quarter times those of rows
    # (`tests/benchmarks/parts.py ways 2 4 6`).
    if is_of_parts(K) and process is None and runs.is_decided:
        mean = mean if mean is None else as_pytree(mean)
        return learn_laws(K, runs, mean, drift, sigma, again)
    return learn_field(K, runs, mean, drift, sigma, process, solver, max_steps, progress, again)


class LearnAgain(eqx.Module):
    """`learn` with the arguments of an earlier call, for other runs."""

    kernel: AbstractMatrixKernel | Lagrangian
    mean: Any
    noise: Any
    solver: Nystrom | None
    process_noise: Any
    masses: bool
    mass: Any
    iterations: int

    def __call__(self, runs: Runs) -> Any:
        """The field of these runs."""
        options = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return learn(options.pop("kernel"), runs, progress=False, **options)


def _kinetic_mean(mass: Any, mean: Any, runs: Any) -> tuple[Kinetic, Any]:
    """The mean of known masses, and runs of positions and momenta."""
    if mean is not None:
        raise TypeError("mass= is a mean, hk.kinetic(mass): give one of mass and mean.")
    mean = kinetic(mass)
    positions = mean.mass.shape[0] if mean.mass.ndim else 1
    if isinstance(runs, Runs) and runs.dimension == positions:
        runs = runs.with_momenta()
    return mean, runs


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
    if runs.parameters is not None and shared_laws(K):
        raise TypeError(
            "learn does not know families of hk.Shared laws: weak rows have no parameters, and "
            "iterations take too long. Learn the runs of each system alone, with the kernel inside "
            "of Family; or fit the family to smoothed velocities, X, Y, labels = "
            "runs.velocities() and hk.fit(K, X, Y, mean=…, parameters=thetas[labels])."
        )
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


def _are_forces(K: AbstractMatrixKernel, n: int) -> bool:
    """Whether no scalar kernel of K depends on a momentum."""
    return all(max(s, default=0) < n // 2 for k in K.scalar_kernels for s in k.supports(n))


def _unknown_masses(K: AbstractMatrixKernel, n: int) -> AbstractMatrixKernel:
    """K for states (q, q̇) of n coordinates, all masses equal at first."""
    if n == 2:
        raise ValueError(
            "masses=True with one degree of freedom: every mass explains the same motion and is "
            "only a unit of the energy, so there is nothing to find. Leave it out; (q, q̇) is "
            "(q, p) of a mass of one."
        )
    inner = K.state_kernel
    if isinstance(inner, UnknownMasses):
        return K
    bodies = {law.parts.bodies for law in shared_laws(K) if hasattr(law.parts, "bodies")}
    labels = bodies.pop() if len(bodies) == 1 else None
    count = n // 2 if labels is None else max(labels) + 1
    return K.with_states(UnknownMasses(inner, jnp.ones(count), labels))


def _check_identifiable(
    K: AbstractMatrixKernel, runs: Runs, mean: Callable[[Array], Array] | None
) -> None:
    """Raise unless the coordinates that no run measured are determined.

    A mean of the points (x, u) must say how they move the others, and K must not change how. A K
    that changes the velocities of both kinds of coordinates represents the system in coordinates
    p -> g(q, p) as well. The runs then fit each of them equally.
    """
    measured = np.any([np.isfinite(x).any(axis=0) for x in runs.host_arrays()[1]], axis=0)
    if measured.all():
        return
    names = np.array(runs.coordinate_names)[~measured]
    never = f"coordinate {', '.join(names)} was measured in no run"
    if mean is None:
        raise ValueError(
            f"{never}. From the others alone it is known only up "
            "to any change of coordinates, p -> g(q, p), so there is nothing to learn it from. "
            "Say how it moves the others: mean=lambda x: jnp.array([x[1] / m, 0.0]) for q̇ = p/m "
            "and K a kernel for the rest, such as hk.Symplectic(hk.Select(k, 0)) for ṗ = -U'(q). "
            "Or log it."
        )
    n = len(measured)
    points = np.random.default_rng(0).standard_normal((8, n + runs.input_count))
    with require.traceable("mean"):
        D = np.asarray(jax.vmap(jax.jacfwd(mean))(jnp.asarray(points)))  # (8, n, d)
    slopes = np.abs(D[:, measured, :n]).max(axis=(0, 1), initial=0.0)
    blind = np.flatnonzero(~measured & ~(slopes > 0))  # also where a slope is NaN
    if len(blind):
        raise ValueError(
            f"coordinate {runs.coordinate_names[blind[0]]} was measured in no run, and the "
            "velocities of the mean do not depend on it: give a mean that says how it moves the "
            "others, such as q̇ = p/m."
        )
    points[:, n:] = 0.0  # another p cannot stand for an input, but for its slope
    variances = np.asarray(jax.vmap(lambda x: jnp.diag(K(x, x)))(jnp.asarray(points)))
    is_changed = np.nanmax(variances, axis=0) > 0
    if is_changed[measured].any() and is_changed[~measured].any():
        positions = tuple(np.flatnonzero(measured).tolist())
        raise ValueError(
            f"{never}, and K also changes how it moves the "
            "others: then it is known only up to any change of coordinates, p -> g(q, p), and so "
            "are the field and its energy. If the masses are known, K is for the forces alone: "
            f"hk.Symplectic(hk.Select(k, {positions})), k a kernel of {len(positions)} "
            f"coordinate{'s' * (len(positions) > 1)}."
        )
