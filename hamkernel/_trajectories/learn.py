"""`learn`: from noisy states at times to a field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from hamkernel import _require as require
from hamkernel._fields.base import SolverInfo, known_part
from hamkernel._fields.joined import learned_field
from hamkernel._fields.kernel_field import KernelField
from hamkernel._gram.operator import placed_product
from hamkernel._kernels.base import Scaled
from hamkernel._kernels.functions import as_pytree
from hamkernel._observations.kinds import beside
from hamkernel._observations.measurements import sampled_points
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.controlled import Controlled, InputMatrix
from hamkernel._structures.family import AbstractFamily
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import AbstractStructure
from hamkernel._trajectories.diagnostics import NEGLIGIBLE, FitQuality, check_identifiable, diagnose
from hamkernel._trajectories.flow import Expansion, steps_for, with_tangent
from hamkernel._trajectories.learned import Iteration, Learned, empty, misfits
from hamkernel._trajectories.likelihood import (
    Bounds,
    Model,
    as_observations,
    bounds_and_design,
    closed_form,
    landmark_whitening,
    losses,
    most_likely,
)
from hamkernel._trajectories.preprocessing import (
    Preprocessed,
    decided,
    landmarks,
    preprocess,
    sampled,
)
from hamkernel._trajectories.runs import Runs
from hamkernel._trajectories.segments import (
    LinearisedSegments,
    Piece,
    Shooting,
    grown,
    halved,
    linearised_along_field,
    segmented,
    shoot,
    short_pieces,
    smoothed_rows,
    trusted,
)
from hamkernel._trajectories.smoothing import interpolated

_ROUNDS = 4  # Levenberg steps before a segment is diagnose: without them up to 40 % were lost
_SEARCH = 25  # steps of BFGS, which go on in the next iteration
_SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)  # of a step, until one makes the objective smaller
_WIDE = 100.0  # standard deviations of the states: the prior of a start
_SHORT_ROUNDS = 2  # iterations with short segments, in which a rough field stays near the samples
_MOST = 8  # iterations; 4 or 5 are the rule
_SETTLED = 0.01  # of log σ, and of the objective by degree of freedom
_UNCHANGED = 1e-4  # of the field: without noise its digits end before the objective settles


def learn(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Callable[..., Array] | None = None,
    noise: ArrayLike | None = None,
    solver: Nystrom | None = None,
    *,
    masses: bool = False,
    progress: bool = False,
) -> Learned:
    """Learn a field from noisy states at times, without velocities.

    A sample is the start of its run plus the integral of the field along the path. The path is
    first the smoothed one, then that of the current field, linearised in the field and the start
    (Gauss-Newton multiple shooting). Each iteration is in closed form: starts are projected out,
    hyperparameters and the noise of each coordinate follow from the marginal likelihood, and a line
    search checks ‖W(x − x̂)‖² + ‖f‖² itself. Segments begin with up to 12 samples and grow to runs,
    or to parts of them where a whole run cannot be followed.

    Args:
        K: a matrix-valued kernel. Its hyperparameters are the first guess. A structure without an
            amplitude gets one, `Symplectic(k)` becomes `Symplectic(1.0 * k)`. Runs with inputs need
            a `Controlled` one, and runs with parameters a `Family`.
        runs: what was logged; see `Runs`, and there how inputs go on between samples.
        mean: a known part of the field, x (n,) -> (n,), or with inputs x, u -> (n,) too; K learns
            the rest.
        noise: the standard deviation of the sensor noise, in units of the states, a number or one
            for each coordinate, shape (n,), if it is known; then a field that does not explain the
            runs is detected. If None, it is estimated.
        solver: `hk.Nystrom(max_points=…)` sets how many landmarks carry the field; if None, 48 for
            n = 2 and 80 for n = 4, which cover the paths evenly. Inputs count as coordinates.
        masses: whether states are (q, q̇) with unknown masses instead of (q, p). Their ratios are
            then learned, `learned.kernel.masses`; see `UnknownMasses`, whose kernel K becomes.
            With inputs they are those of the drift, `learned.kernel.drift.masses`.
        progress: show a progress bar (tqdm).

    Returns:
        A `Learned`: the field, its kernel, the noise, the fitted states, and how well they fit.
        Runs of other lengths, in the same powers of two, do not compile anew.

    Raises:
        TypeError: the runs have inputs and K takes none, or the other way round; K is not
            matrix-valued, `runs` no Runs, or `solver` no Nystrom. ValueError: n is not one that the
            structure allows; the inputs cannot be told from the drift; the noise is not positive; a
            coordinate was never measured and no mean says how it moves the others; doubles are not
            enabled.

    Warns:
        UserWarning: parts of runs were dropped, the structure does not explain the runs, the runs
            are too few to find the noise, or the iterations did not settle.
    """
    require.untraced("hk.learn", "Call it outside; hk.fit works inside.", K, runs, mean, noise)
    K, given = _check(with_amplitude(matrix_kernel(K)), runs, noise, solver)
    if masses:
        K = with_masses(K, runs.dimension)
    known = known_part(K, mean, runs.dimension, jnp.float64)
    check_identifiable(runs, known)
    data = preprocess(runs, known)
    measured = np.isfinite(data.noise)
    X, Y = sampled(data)
    if known is not None:
        Y = Y - np.asarray(jax.vmap(known)(jnp.asarray(X)))
    # Smoothing may find no noise at all; a share of 1e-7 is what the digits of a log leave.
    level = np.maximum(np.where(measured, data.noise, data.scale), 1e-6 * data.scale)
    model = Model(K, jnp.log(jnp.asarray(level if given is None else given)))
    moves = measured & (given is None)
    bounds, design = bounds_and_design(model, X, Y, data.scale, moves)
    S = landmarks(X, data.scale, None if solver is None else solver.max_points)
    task = Task(data, known, S, bounds, jnp.asarray(_WIDE * data.scale))
    first = begin(task, model, design)
    if not runs.is_decided:
        runs, data = decided(
            runs, data, lambda data: initial_loss(task._replace(data=data), first.model)
        )
        task = task._replace(data=data)
        first = begin(task, first.model, design)
    now, pieces, history, converged = _iterated(task, first, progress)
    mean = None if mean is None else as_pytree(mean)
    return _learned(runs, mean, task, now, pieces, history, converged, given is not None, measured)


def _iterated(
    task: Task, now: Current, progress: bool
) -> tuple[Current, list[Piece], list[Iteration], bool]:
    """Gauss-Newton steps until noise and objective settle."""
    from tqdm import tqdm  # so that importing the package does not load it

    history: list[Iteration] = []
    pieces: list[Piece] = []
    bar = tqdm(range(_MOST), "learning", disable=None if progress else True)
    for i in bar:
        if i < _SHORT_ROUNDS:
            wanted = short_pieces(task.data.runs)
        elif i == _SHORT_ROUNDS:
            wanted = grown(task.data.runs, pieces, now.good)
        else:
            wanted = halved(task.data.runs, pieces, now.good)
        before, same, pieces = now, wanted == pieces, wanted
        now, step = iterated(task, now, pieces)
        history.append(step)
        noise = ", ".join(f"{sigma:.3g}" for sigma in np.asarray(step.noise))
        bar.set_postfix_str(f"noise {noise}, kept {float(step.kept):.0%}")
        moved = float(jnp.abs(now.model.log_noise - before.model.log_noise).max())
        small = float(step.gain) < _SETTLED * max(now.free, 1.0)
        settled = moved < _SETTLED and (small or changed(task, before, now) < _UNCHANGED)
        if settled and same and i > _SHORT_ROUNDS:
            bar.close()
            return now, pieces, history, True
    bar.close()
    return now, pieces, history, False


def _learned(
    runs: Runs,
    mean: Any,
    task: Task,
    now: Current,
    pieces: list[Piece],
    history: list[Iteration],
    converged: bool,
    given: bool,
    measured: np.ndarray,
) -> Learned:
    """The result, and the warnings that it asks for."""
    field, data = now.field, task.data
    times, _ = runs.on_host()
    velocity = jax.jit(jax.vmap(field))
    states = [
        path
        if len(path) == len(t)
        else interpolated(t - t[0], run.times, path, np.asarray(velocity(run.joined(path))))
        for t, run, path in zip(times, data.runs, now.paths, strict=True)
    ]
    kept = np.zeros(len(data.runs))
    for (r, start, stop), good in zip(pieces, now.good, strict=True):
        kept[r] += good * (stop - start) / len(data.runs[r].times)
    noise = np.where(measured, np.exp(np.asarray(now.model.log_noise)), np.nan)
    misfit = misfits(runs, states, noise)
    chi_squared = now.squares / max(now.free, 1.0)
    fit = FitQuality(kept, misfit, chi_squared, now.free, len(history), converged)
    converged = diagnose(fit, noise, data.scale, given)
    observations = as_observations(now.rows, now.model.log_noise, task.mean)
    count = 1 if observations is None else sum(len(y) for _, y in observations.parts())
    regularization = jnp.asarray(1 / count)
    return Learned(
        field=_field(field, regularization),
        kernel=field.kernel,
        regularization=regularization,
        noise=jnp.asarray(noise),
        states=tuple(jnp.asarray(x) for x in states),
        kept=jnp.asarray(kept),
        misfit=jnp.asarray(misfit),
        chi_squared=jnp.asarray(chi_squared),
        history=tuple(history),
        converged=converged,
        runs=runs,
        observations=observations,
        mean=mean,
    )


def _field(found: Expansion, regularization: Float[Array, ""]) -> Any:
    """The field as one of the library."""
    S, A = found.points, found.coefficients
    square = jnp.sum(A * placed_product(found.kernel, S, S, A))  # ‖f‖² = aᵀGa
    field = KernelField(
        kernel=found.kernel,
        points=S,
        coefficients=A,
        residual=empty(A.shape[1]),
        norm=jnp.sqrt(jnp.maximum(square, 0.0)),
        regularization=regularization,
        offset=jnp.zeros((), S.dtype),
        info=SolverInfo("learn", landmarks=jnp.asarray(len(S))),
        mean=None,
    )
    return learned_field(field, found.mean)


def _check(
    K: AbstractMatrixKernel, runs: Any, noise: Any, solver: Any
) -> tuple[AbstractMatrixKernel, np.ndarray | None]:
    """The kernel, which knows how many inputs there are, and the noise that was given, (n,)."""
    if not isinstance(runs, Runs):
        raise TypeError(
            f"learn takes hk.Runs(times, states), lists of arrays, one entry a run; got a "
            f"{type(runs).__name__}. For states with velocities take hk.fit or hk.tune."
        )
    if not (solver is None or isinstance(solver, Nystrom)):
        raise TypeError(f"the solver of learn is hk.Nystrom(max_points=…) or None; got {solver!r}.")
    n = runs.dimension
    given = runs.inputs if runs.parameters is None else runs.parameters
    if K.takes_inputs and given is not None:
        beside(runs.inputs, runs.parameters, K)  # refuses the one in the place of the other
    if isinstance(K, AbstractFamily) and given is None:
        raise TypeError(
            "a Family needs to know of which system each run is: hk.Runs(times, states, "
            "parameters=[(0.5,), (0.8,), …]), for each run θ of shape (p,)."
        )
    if K.takes_inputs and given is None:
        raise TypeError(
            f"{type(K).__name__} needs what was applied: hk.Runs(times, states, inputs), for each "
            "run u at its times, shape (T, m)."
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
    if given is None:
        K.check_dimension(n)
    else:
        U = jnp.concatenate([jnp.atleast_2d(each) for each in given])
        K, _ = sampled_points(K, jnp.zeros((len(U), n), U.dtype), U)
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            "learn needs doubles, since paths and their tangents are compared over many steps: "
            "jax.config.update('jax_enable_x64', True) first."
        )
    if noise is None:
        return K, None
    given = np.asarray(
        require.positive(noise, "noise", "Leave it out to have it found from the runs.")
    )
    if given.shape not in ((), (n,)):
        raise ValueError(f"noise has shape {given.shape}; a number or shape ({n},) is needed.")
    return K, np.broadcast_to(given, (n,))


def with_amplitude(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """K, every structure and input matrix in it scaled; a likelihood needs amplitudes.

    `Symplectic(Gaussian(2.0))` becomes `Symplectic(1.0 * Gaussian(2.0))`.
    """

    def is_structure(node: object) -> bool:
        return isinstance(node, AbstractStructure | InputMatrix)

    def scaled(node):
        if not is_structure(node) or node.kernel.has_amplitude:
            return node
        return eqx.tree_at(lambda node: node.kernel, node, Scaled(node.kernel, 1.0))

    return jax.tree.map(scaled, K, is_leaf=is_structure)


def with_masses(K: AbstractMatrixKernel, n: int) -> AbstractMatrixKernel:
    """K for states (q, q̇) of n coordinates, all masses equal at first."""
    if n == 2:
        raise ValueError(
            "masses=True with one degree of freedom: every mass explains the same motion and is "
            "only a unit of the energy, so there is nothing to find. Leave it out; (q, q̇) is "
            "(q, p) of a mass of one."
        )
    if isinstance(K, Controlled):
        return Controlled(with_masses(K.drift, n), K.inputs, K.count)
    if isinstance(K, AbstractFamily):
        raise ValueError(
            "masses=True is for one system: for a family write hk.Family(hk.UnknownMasses(K, "
            "masses), k)."
        )
    return K if isinstance(K, UnknownMasses) else UnknownMasses(K, jnp.ones(n // 2))


class Task(NamedTuple):
    """What does not change: the runs, the mean, landmarks, the box and the prior of starts."""

    data: Preprocessed
    mean: Any
    S: Float[Array, "m d"]
    bounds: Bounds
    start_deviation: Float[Array, " n"]


class Current(NamedTuple):
    """Where learning stands.

    Attributes:
        model: kernel and noise.
        field: the field.
        rows: what it was learned from.
        paths: of each run at its samples.
        good: which pieces were kept.
        squares: the sum of their squared normalised residuals.
        free: the degrees of freedom that are left.
    """

    model: Model
    field: Expansion
    rows: LinearisedSegments
    paths: list[np.ndarray]
    good: Bool[np.ndarray, " S"]
    squares: float
    free: float


def initial_loss(task: Task, model: Model) -> float:
    """−log p of the rows along the smoothed runs, at the hyperparameters of `model`."""
    *_, rows = smoothed_rows(task.data, task.mean)
    return float(losses(model, model.flat[None], task.S, rows, task.start_deviation)[0])


def begin(task: Task, model: Model, design: np.ndarray) -> Current:
    """INT: rows along the smoothed runs, with the tangent of the mean.

    In short segments: the errors of the smoothed path add up along a run.
    """
    pieces, good, rows = smoothed_rows(task.data, task.mean)
    paths = [run.path for run in task.data.runs]
    values = np.asarray(losses(model, jnp.asarray(design), task.S, rows, task.start_deviation))
    model = model.at(jnp.asarray(design[int(np.argmin(values))]))
    model, _ = most_likely(model, task.S, rows, task.start_deviation, task.bounds, _SEARCH)
    found = closed_form(model.kernel, model.log_noise, task.S, rows, task.start_deviation)
    field = Expansion(model.kernel, task.S, found.coefficients, task.mean)
    return Current(model, field, rows, paths, good[: len(pieces)], np.inf, float(found.free))


def iterated(task: Task, now: Current, pieces: list[Piece]) -> tuple[Current, Iteration]:
    """GN: one linearisation along the current field, one closed form, one line search."""
    runs = task.data.runs
    segments = segmented(runs, pieces, now.paths)
    count = steps_for(np.asarray(segments.spans), _stiffness(now.field, task.data, now.paths))
    steps = jnp.asarray(count)
    before = shoot(
        now.field,
        segments,
        now.model.log_noise,
        task.start_deviation,
        steps,
        segments.starts,
        _ROUNDS,
    )
    least = NEGLIGIBLE * task.data.scale
    good = trusted(before, segments, np.exp(np.asarray(now.model.log_noise)), least)
    rows = linearised_along_field(now.field, before.path, segments, jnp.asarray(good))
    model, loss = most_likely(now.model, task.S, rows, task.start_deviation, task.bounds, _SEARCH)
    found = closed_form(model.kernel, model.log_noise, task.S, rows, task.start_deviation)
    # The current field in the new basis, by what it says of the same rows.
    known = rows._replace(target=rows.along, prior_offset=jnp.zeros_like(rows.prior_offset))
    old = closed_form(model.kernel, model.log_noise, task.S, known, task.start_deviation).weights
    T = _landmark_whitening(model.kernel, task.S)

    def trial(share: float) -> _Trial:
        weights = (1 - share) * old + share * found.weights
        field = Expansion(model.kernel, task.S, (T @ weights).reshape(len(task.S), -1), task.mean)
        starts = before.starts + share * found.moves
        there = shoot(
            field, segments, model.log_noise, task.start_deviation, steps, starts, _ROUNDS
        )
        squares = float(np.asarray(there.squares)[good].sum())
        return _Trial(squares + float(weights @ weights), squares, field, there)

    at_old = trial(0.0)
    taken, best = 0.0, at_old
    for share in _SHARES if good.any() else ():
        there = trial(share)
        if there.objective < best.objective:
            taken, best = share, there
            break
    good = good[: len(pieces)]
    paths = _updated(now.paths, pieces, good, best.shooting)
    samples = sum(len(run.times) for run in runs)
    kept = sum(piece.stop - piece.start for piece, ok in zip(pieces, good, strict=True) if ok)
    gain = at_old.objective - best.objective
    numbers = (best.objective, gain if taken else 0.0, taken, kept / samples, loss)
    objective, gain, taken, kept, loss = (jnp.asarray(value) for value in numbers)
    longest = max(piece.stop - piece.start for piece in pieces)
    noise = jnp.exp(model.log_noise)
    step = Iteration(longest, objective, gain, taken, noise, kept, loss)
    free = float(found.free)
    return Current(model, best.field, rows, paths, good, best.squares, free), step


class _Trial(NamedTuple):
    objective: float
    squares: float
    field: Expansion
    shooting: Shooting


def _updated(paths, pieces: list[Piece], good, there: Shooting) -> list[np.ndarray]:
    """The paths, those of the pieces that were kept along the field."""
    new, x = [path.copy() for path in paths], np.asarray(there.path.x)
    for s, (r, start, stop) in enumerate(pieces):
        if good[s] and np.isfinite(x[s]).all():
            new[r][start:stop] = x[s, : stop - start]
    return new


_landmark_whitening = eqx.filter_jit(landmark_whitening)


@eqx.filter_jit
def _norms(field, X: Float[Array, "N d"], scale: Float[Array, " n"]) -> Float[Array, " N"]:
    def norm(s):
        D = with_tangent(field, s, len(scale))[1]
        return jnp.linalg.norm(D * scale[None] / scale[:, None])

    return jax.vmap(norm)(X)


def _stiffness(field: Expansion, data: Preprocessed, paths: list[np.ndarray]) -> float:
    """‖∂f/∂x‖ in standard deviations along the paths, but for the largest twentieth."""
    X = np.concatenate([run.joined(path) for run, path in zip(data.runs, paths, strict=True)])
    X = X[np.linspace(0, len(X) - 1, 256).round().astype(int)]
    norms = np.asarray(_norms(field, jnp.asarray(X), jnp.asarray(data.scale)))
    return float(np.nanquantile(np.where(np.isfinite(norms), norms, 0.0), 0.95))


def changed(task: Task, before: Current, now: Current) -> float:
    """By how much the field has changed at the landmarks, relative to its size there."""
    old, new = (
        np.asarray(_values(each.field, task.S)) / task.data.scale[None] for each in (before, now)
    )
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))


_values = eqx.filter_jit(lambda field, S: jax.vmap(field)(S))
