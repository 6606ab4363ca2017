"""The search for the likeliest hyperparameters: bounds, a design of first points, BFGS.

Each gradient in the hyperparameters evaluates K anew. Of many rows the search therefore uses a
sample of windows, and the first of the landmarks.
"""

from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from hamkernel._gram_operator import placed_product
from hamkernel._kernels.built_in import Gaussian
from hamkernel._kernels.transforms import Select
from hamkernel._learned.diagnostics import MissingForce
from hamkernel._machine import compiled_by_size
from hamkernel._runs.preprocessing import Preprocessed, sample_points
from hamkernel._solvers.triangle import regression_loss
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.custom_operator import Structured
from hamkernel._structures.friction import Friction, frictions, with_rest_speed
from hamkernel._trajectories.kalman import whiten
from hamkernel._trajectories.likelihood import (
    ClosedForm,
    Condensed,
    closed_form,
    condense,
    conditional,
)
from hamkernel._trajectories.model import KernelRows, Model, landmark_whitening
from hamkernel._trajectories.segments import LinearisedSegments, windows
from hamkernel._tuning.minimiser import inside_box, run_in_box
from hamkernel._tuning.space import gram_trace, hyperparameters


class Bounds(NamedTuple):
    """The box of the hyperparameters: which are free, which are lengthscales, which amplitudes."""

    low: Float[np.ndarray, " P"]
    high: Float[np.ndarray, " P"]
    free: Bool[np.ndarray, " P"]
    lengths: Bool[np.ndarray, " P"] | Literal[False] = False
    scales: Bool[np.ndarray, " P"] | Literal[False] = False

    def with_shorter_lengths(self, share: float) -> "Bounds":
        """The box whose least lengthscales are `share` times as long."""
        return self._replace(low=np.where(self.lengths, self.low + np.log(share), self.low))


# Entries of K at nodes in the search. All rows of a chain with n = 8, 20 runs of 50 samples on 128
# landmarks, have 25 million, which took 46 s. With one million instead of two, `learn` took 109 s
# of CPU instead of 126. The error of the field was .0134 instead of .0086 (`capacity.py chain`).
_ENTRIES = 2_000_000
# Noise in standard deviations of the states. Steps of Runge and Kutta leave as much (`steps_for`),
# and below it the kernel would bend to their errors: of exact runs σ then fell to 1e-7, rose again
# from iteration to iteration, and was joined by process noise of 1e-6.
LEAST_NOISE = 1e-6
# Logarithms of the lengthscales of the first points, in extents of the data: .22, .74 and 2.5.
_SHIFTS = (-1.5, -0.3, 0.9)


def noise_free_coordinates(
    model: Model, bounds: Bounds, scale: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """The coordinates that the field explains as far as paths are integrated: no noise is left.

    What is left there are errors of integration, which are never white. Of a pendulum with noise of
    0, 1e-6, 1e-5, 1e-4 and 1e-3 of the states, 5 runs of 60 samples, the noise found is 1.0001 (the
    least is 1), 1.0009, 9.9, 99 and 990 millionths, and the whiteness 6e-67, 1, 1, .98 and .99.
    """
    n = len(scale)
    least = np.asarray(model.log_noise) < np.log(LEAST_NOISE * scale) + 0.1
    still = not bounds.free[-n:].any()
    return bounds.free[-2 * n : -n] & least & still


def _loss(model: Model, h, S, rows, start_deviation):
    there = model.unflatten(h)
    T = landmark_whitening(there.kernel, S)
    made = whiten(there, S, T, rows, start_deviation)
    value = regression_loss(made.M, made.r) + made.constant
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


_compiled_loss = compiled_by_size(_loss)


def losses(
    model: Model,
    design: Float[ArrayLike, "count P"],
    S,
    rows: LinearisedSegments,
    start_deviation,
) -> Float[np.ndarray, " count"]:
    """−log p(rows) at some points h, one after another: designs of all sizes share a program."""
    values = [
        _compiled_loss(model, jax.device_put(h), S, rows, start_deviation)
        for h in np.asarray(design)
    ]
    return np.array(values)


def search_sample(
    S: Float[Array, "m d"], rows: LinearisedSegments
) -> tuple[Float[Array, "k d"], LinearisedSegments]:
    """The landmarks and rows of the search for hyperparameters: all of them if they are few.

    A search on many rows uses a sample of windows. Where even the windows are too many for the
    landmarks, the middle of each interval takes the place of the landmarks: for a field that is
    smooth over an interval it is as good.
    """
    n = rows.residual.shape[-1]
    if 3 * n * rows.residual.size * len(S) <= _ENTRIES:
        return S, rows
    width = (_ENTRIES / 3) ** 0.5  # columns, and rows, if there are as many of both
    if n * len(S) <= width:
        return S, windows(rows, int(width**2 / (n**2 * len(S))))
    return exact(limiting_windows(rows))


def exact(rows: LinearisedSegments) -> tuple[Float[Array, "k d"], LinearisedSegments]:
    """The rows with a landmark in the middle of each of their intervals.

    Intervals of padding repeat one point, which adds nothing to the span. Without the padding XLA
    would compile for rows of every length.
    """
    middles = np.asarray(rows.nodes)[:, :, 1].reshape(-1, rows.nodes.shape[-1])
    return jax.device_put(middles), rows


@compiled_by_size
def _best(
    model: Model, S, rows: LinearisedSegments, start_deviation, low, high, free, scales, steps
):
    start = model.flat

    def loss(h):
        return _loss(model, jnp.where(free, h, start), S, rows, start_deviation)

    # N samples determine log σ to 1/√(2N), and a lengthscale is known to some tenths. Beside a
    # lengthscale an amplitude is known as well, but it rises with the second to eighth power of the
    # lengthscale. With .2 for amplitudes BFGS stopped on the way along this ridge, 1.1 above the
    # least −log p, and with .5 or 1 at most .01 (`test_the_units_of_the_momenta_do_not_matter`).
    # Counts of animals (`test_a_field_outside_the_structure_is_asked_for`) took 26, 28, 42 steps.
    count = jnp.maximum(rows.counts.sum(axis=(0, 1)), 1)
    noise = jnp.tile(1 / jnp.sqrt(2 * count), 2)
    kernel = jnp.where(scales, 0.5, 0.2)
    deviations = kernel.at[-noise.size :].set(noise)
    run = run_in_box(loss, start, low, high, deviations, steps)
    end, value = inside_box(run.best.u, low, high), run.best.value
    return jnp.where(free & (value < jnp.inf), end, start), value


def maximise_likelihood(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    bounds: Bounds,
    steps: int,
) -> tuple[Model, float]:
    """The likeliest model of the rows, by BFGS from `model`, and −log p there.

    The search and its −log p use the rows of `search_sample`.
    """
    S, rows = search_sample(jnp.asarray(S), rows)
    if not bounds.free.any():
        flat = np.asarray(model.flat)[None]
        return model, float(losses(model, flat, S, rows, start_deviation)[0])
    scales = np.broadcast_to(bounds.scales, bounds.low.shape)
    low, high, free, scales = jax.device_put((bounds.low, bounds.high, bounds.free, scales))
    h, value = _best(model, S, rows, start_deviation, low, high, free, scales, steps)
    return model.unflatten(h), float(value)


def choose_start(
    model: Model,
    design: Float[np.ndarray, "count P"],
    S: Float[np.ndarray, "m d"],
    first: int,
    rows: LinearisedSegments,
    start_deviation,
) -> tuple[Model, int]:
    """The likeliest model of a design, and the number of landmarks for the search from there.

    The number is `first`, or all of them if −log p then falls by more than √(q/2), the uncertainty
    of −log p with q weights. Every point of the design is evaluated with both numbers: on too few
    landmarks the best point is a smooth field with much noise, where more landmarks do not help.
    """
    n, width = rows.residual.shape[-1], (_ENTRIES / 3) ** 0.5
    part = limiting_windows(rows)
    middles = exact(part)[0]
    sets = {first: jnp.asarray(S[:first]) if n * first <= width else middles}
    if len(middles) > first < len(S):
        sets[len(S)] = middles
    best, count, start = np.inf, first, design[0]
    for size, points in sets.items():
        values = losses(model, design, points, part, start_deviation)
        if values.min() < best - (n * len(points) / 2) ** 0.5:
            best, count, start = values.min(), size, design[int(np.argmin(values))]
    return model.unflatten(start), count


def solve(
    model: Model,
    S: Float[np.ndarray, "m d"],
    count: int,
    quick: int,
    rows: LinearisedSegments,
    start_deviation,
    bounds: "Bounds",
) -> tuple[Model, ClosedForm]:
    """The closed form of all rows on the first `count` landmarks or more, and its model.

    The number of landmarks is doubled while −log p falls by more than √(q/2), the uncertainty of
    −log p with q weights. Beyond `quick` landmarks it is doubled only where windows predict half
    of the remaining variance. Of a short log all rows are in one window, and are asked before a
    larger solve compiles. If the search used a sample of the rows, both kinds of noise are scaled
    to the residuals of all rows.
    """
    free, size = np.array(bounds.free), len(model.flat) - 2 * len(model.log_noise)
    free[:size] = False  # the kernel stays, both kinds of noise are scaled

    def solution(count: int) -> tuple[Condensed, ClosedForm]:
        points = jax.device_put(S[:count])
        triangle = condense(model, points, rows, start_deviation)
        return triangle, conditional(triangle, points)

    triangle, closed = solution(count)
    n = len(model.log_noise)
    is_short = limiting_windows(rows) is rows
    while count < len(S):
        is_slow = count <= quick < min(2 * count, len(S))
        args = model, closed.points, rows, start_deviation
        if is_slow and not limited_by_landmarks(*args, bool(free.any()), least=np.log(2) / 2):
            break
        # All landmarks gain at least as much as twice as many, which must gain √(q/2).
        if is_short and landmark_gain(*args)[0] <= (n * count) ** 0.5:
            break
        more = solution(2 * count)
        if not float(more[1].loss) < float(closed.loss) - (more[1].weights.size / 2) ** 0.5:
            break
        (triangle, closed), count = more, 2 * count
    # The floor of process noise may be scaled with the sensor noise; q of the caller may not.
    is_held = has_process_noise(model, bounds) & ~free[-n:]
    is_sample = search_sample(jnp.asarray(S[:count]), rows)[1] is not rows
    scales = is_sample and free.any() and not is_held.any()
    if scales and closed.free > closed.used and closed.squares > 0:
        shift = _excess(closed)
        if abs(shift) > 0.01:  # residuals depend on the noise: a secant step, a half to twice it
            again = _excess(conditional(triangle, closed.points, shift))
            shift = shift / (1 - np.clip(again / shift, -1.0, 0.5))
        h = np.asarray(model.flat)
        model = model.unflatten(np.where(free, np.clip(h + shift, bounds.low, bounds.high), h))
        closed = conditional(triangle, closed.points, shift)
    return model, closed


def has_process_noise(model: Model, bounds: Bounds) -> Bool[np.ndarray, " n"]:
    """The coordinates whose process noise is above its floor, which stands for none."""
    floor = np.asarray(bounds.low)[-len(model.log_process) :]
    return np.asarray(model.log_process) > floor + 0.1  # more than the rounding of a logarithm


def _excess(closed: ClosedForm) -> float:
    """The logarithm of the deviation of the residuals, in units of the noise."""
    return float(np.log(closed.squares / closed.free) / 2)


def limiting_windows(rows: LinearisedSegments) -> LinearisedSegments:
    """As many samples as a search can take with a landmark in each of their intervals."""
    return windows(rows, int((_ENTRIES / 3) ** 0.5 / rows.residual.shape[-1]))


def limited_by_landmarks(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    with_less_noise: bool = False,
    least: float = 0.0,
) -> bool:
    """Whether windows of the rows are likelier with a landmark in each of their intervals.

    The gain of log p must exceed √(q/2), its uncertainty with q weights, and `least` for each
    degree of freedom. The search takes the field that too few landmarks cannot represent for noise,
    and with so much noise more landmarks do not help: `with_less_noise` also tries less. 400 runs
    of a double pendulum without noise end with noise of .002 to .008 on 160 landmarks. Windows of
    them have a log p of 1733, of 1732 with more landmarks, and of 2002 and 2454 with more landmarks
    and a third or a hundredth of the noise.
    """
    gain, part = landmark_gain(model, S, rows, start_deviation, with_less_noise)
    counts, n = np.asarray(part.counts), rows.residual.shape[-1]
    q, freedom = n * len(exact(part)[0]), (counts > 0).sum() - n * len(counts)
    return bool(gain > max((q / 2) ** 0.5, least * freedom))


def landmark_gain(
    model: Model, S, rows: LinearisedSegments, start_deviation, with_less_noise: bool = False
) -> tuple[float, LinearisedSegments]:
    """The gain of log p of windows from a landmark in each of their intervals, and the windows."""
    shares = np.array([1.0, 0.3, 0.1, 0.03] if with_less_noise else [1.0])
    part = limiting_windows(rows)
    less = np.tile(np.asarray(model.flat), (len(shares), 1))
    less[:, -2 * len(model.log_noise) :] += np.log(shares)[:, None]
    few, many = (
        losses(model, flat, points, part, start_deviation).min()
        for points, flat in ((S, less[:1]), (exact(part)[0], less))
    )
    return float(few - many), part


def log_shares_of_noise(n: int) -> Float[np.ndarray, "5 k"]:
    """Logarithms of the shares of sensor and process noise beside which a larger kernel is tried.

    Process noise, or without it sensor noise, had to explain what the smaller kernel cannot.

    Returns:
        A row for each try, sensor noise first, shape (5, 2n).
    """
    shares = [[1.0, 1.0], [1.0, 0.1], [1.0, 0.01], [0.1, 0.1], [0.01, 0.01]]
    return np.repeat(np.log(shares), n, axis=1)


def missing_friction(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    data: Preprocessed,
) -> MissingForce:
    """Viscous and dry friction of the momenta beside the drift.

    Kernels stay. Forces as large as all of the motion are as good as free in the closed form. None
    is missing where the kernel has friction, or is that of a family.

    The gain of four runs of positions of a pendulum, 80 samples each, with viscous friction of .1
    and .03 is 75 and 33 beside the process noise found; with white pushes and no friction −9 to −6.
    """
    K, (X, Y) = model.kernel, sample_points(data)
    n = Y.shape[1]
    force, fastest = np.sqrt(np.mean(Y[:, n // 2 :] ** 2)), np.abs(X[:, n // 2 : n]).max()
    if frictions(K) or K.input_name == "parameters" or not fastest > 0:
        return MissingForce()
    both = Friction(force / fastest, 1e-6 * force) + Friction(1e-6 * force / fastest, force)
    more = with_rest_speed(both, jnp.asarray(X), n)
    return _missing(model, more, S, rows, start_deviation, X, Y, _momenta(n))


def missing_inertia(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    data: Preprocessed,
    mean: Any,
) -> MissingForce:
    """Forces that are quadratic in the velocities, beside the drift.

    Velocities are no momenta where a mass matrix depends on the positions, and ½ vᵀ∂M/∂q v is such
    a force. They are the gradient in v of g(q, v), of degree three in v. None is missing where the
    mean has such forces, for families, and with one degree of freedom, where (q, v) is (q, p) of
    another q.

    At the first step, of four runs of 80 positions of a double pendulum, three seeds, the gain is
    43 to 55, and that of friction −7 to −5; of coupled pendula with friction 96 to 139, and 140 to
    239. So three times the gain of friction tells them apart (`tests/test_process_noise.py`).
    """
    K, (X, Y) = model.kernel, sample_points(data)
    n = Y.shape[1]
    force, fastest = np.sqrt(np.mean(Y[:, n // 2 :] ** 2)), np.abs(X[:, n // 2 : n]).max()
    if n < 4 or n % 2 or K.input_name == "parameters" or not (force > 0 and fastest > 0):
        return MissingForce()
    v, some = slice(n // 2, n), jnp.asarray(X[:: -(-len(X) // 8)])  # at most eight points
    if mean is not None and jax.vmap(jax.hessian(mean))(some)[:, v, v, v].any():
        return MissingForce()
    size, positions = force / (3 * fastest**2), tuple(range(n // 2))
    lengths = Gaussian(np.maximum(data.scale[: n // 2], 1e-3 * data.scale[: n // 2].max()))
    cubic = Select(_cubic, tuple(range(n // 2, n)))
    units = _momenta(n)
    more = Structured(size**2 * (Select(lengths, positions) * cubic), _Diagonal(1 / units))
    return _missing(model, more, S, rows, start_deviation, X, Y, units)


def missing_structure(
    model: Model,
    S,
    rows: LinearisedSegments,
    start_deviation,
    data: Preprocessed,
) -> MissingForce:
    """A field outside the structure: a gradient in scaled coordinates, beside the drift.

    Any field in the plane is the sum of a Hamiltonian one and such a gradient. The gradient is a
    third as large as the motion and smooth over two standard deviations. None is missing for
    families.

    Of three runs of counts of predators and prey, whose logarithms alone are Hamiltonian, four
    seeds, the gain is 88 to 91 with noise of 2 %, and 20 to 31 with 5 %
    (`tests/benchmarks/verdicts.py "counts of animals"`). A gradient as large as the motion and
    smooth over one deviation had −25 to 14 with 5 %. Of pendula with white noise the gain is −26 to
    −17. Sensors whose errors are correlated had −15 to −5 in 19 of 20 logs, and 25 in one, where
    the share of the gradient in the motion was .12.
    """
    X, Y = sample_points(data)
    rate = np.sqrt(np.mean(Y**2, axis=0))
    # q̇ = p/m, without process noise, has no other force.
    is_moved = np.isfinite(np.asarray(model.log_process)) & (rate > 0)
    if model.kernel.input_name == "parameters" or not is_moved.any():
        return MissingForce()
    lengths = 2 * data.scale
    more = Structured(Gaussian(lengths), _Diagonal(0.3 * lengths * rate * is_moved))
    units = np.where(is_moved, rate, np.inf)
    return _missing(model, more, S, rows, start_deviation, X, Y, units)


def _cubic(v: Float[Array, " m"], w: Float[Array, " m"]) -> Float[Array, ""]:
    return jnp.dot(v, w) ** 3


class _Diagonal(eqx.Module):
    """The operator x -> diag(values)."""

    values: Float[np.ndarray, " n"]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        return jnp.diag(jnp.asarray(self.values, x.dtype))


def _momenta(n: int) -> Float[np.ndarray, " n"]:
    """Units in which forces on momenta count, and nothing else does."""
    return np.where(np.arange(n) >= n // 2, 1.0, np.inf)


def _missing(
    model: Model,
    more: AbstractMatrixKernel,
    S,
    rows: LinearisedSegments,
    start_deviation,
    X: Float[np.ndarray, "N d"],
    Y: Float[np.ndarray, "N n"],
    units: Float[np.ndarray, " n"],
) -> MissingForce:
    """The force of `more` beside the kernel of states, with less noise if that is likelier.

    X are points along the runs, Y the velocities there, and
    `units` those in which the force is compared with Y.
    """
    K, n = model.kernel, rows.residual.shape[-1]
    S, rows = search_sample(jnp.asarray(S), rows)
    less = log_shares_of_noise(n)

    def likeliest(model: Model) -> tuple[float, Model]:
        design = np.tile(np.asarray(model.flat), (len(less), 1))
        design[:, -2 * n :] += less
        values = losses(model, design, S, rows, start_deviation)
        return float(values.min()), model.unflatten(design[int(np.argmin(values))])

    loss, _ = likeliest(model)
    least, larger = likeliest(model._replace(kernel=K.with_states(K.state_kernel + more)))
    missing = MissingForce(loss - least)
    if not missing.is_there:
        return missing
    A = closed_form(larger, S, rows, start_deviation).coefficients
    # Inputs are columns of the points, and do not change the force.
    force = np.asarray(placed_product(more, jnp.asarray(X[:, :n]), S[:, :n], A))
    return missing._replace(share=float(np.linalg.norm(force / units) / np.linalg.norm(Y / units)))


def bounds_and_design(
    model: Model,
    X: np.ndarray,
    Y: np.ndarray,
    scale: np.ndarray,
    moves: np.ndarray,
    impulse: np.ndarray,
    spacing: float = 0.0,
) -> tuple[Bounds, np.ndarray]:
    """The box of all hyperparameters, those of the caller inside, and a design of first points.

    Args:
        model: the caller's kernel and the noise of the smoothed runs.
        X: states, with inputs the points (x, u).
        Y: their velocities.
        scale: the standard deviations of the coordinates.
        moves: the coordinates whose noise is estimated.
        impulse: log of the process noise that would explain all of the motion, shape (n,); −inf
            in coordinates without process noise.
        spacing: the least lengthscale, in standard deviations of the coordinates.
    """
    speed = float(np.sqrt(np.mean(Y**2)))
    leaves = hyperparameters(model.kernel, jnp.asarray(X), speed, jnp.asarray(X))
    start = np.asarray(model.flat)[: -len(scale)]  # without process noise
    size = len(start) - len(scale)
    largest = np.maximum(scale, np.exp(start[size:]))  # where next to nothing moves
    low = np.concatenate([*(p.low.ravel() for p in leaves), np.log(LEAST_NOISE * scale)])
    high = np.concatenate([*(p.high.ravel() for p in leaves), np.log(2 * largest)])
    free = np.concatenate([np.ones(size, bool), moves])
    names = [p.name for p in leaves for _ in range(p.low.size)]
    none = np.zeros(len(scale), bool)

    def is_named(*kinds: str) -> Bool[np.ndarray, " P"]:
        return np.append([name.split(".")[-1] in kinds for name in names], none).astype(bool)

    lengths, scales = is_named("lengthscale"), is_named("scale")
    # Long Gaussians need an amplitude of the eighth power of their length for a quartic energy. The
    # log p of two masses on hardening springs rises by 20 with the limit 1e10 in place of 1e5
    # (`test_learning_from_states_finds_a_full_matrix`).
    high = np.where(scales, high + np.log(1e5), high)
    forces = is_named("viscous", "coulomb", "stribeck")
    # The guesses of friction are numbers without units. Short windows, with which the search
    # begins, tell none from another: .1 stays where it is 2e4 a second (`tests/test_friction.py`).
    start = np.where(forces, np.clip(start, low, high), start)
    low, high = np.minimum(low, start), np.maximum(high, start)
    if spacing > 0:
        least = np.append(_least_lengths(leaves, X, scale, spacing), scale)
        low[lengths] = np.clip(least, low, high - 0.1)[lengths]
        start = np.clip(start, low, high)
    extents = np.concatenate([*(_extents(p.low, X[:, : len(scale)]) for p in leaves), none])
    kernels = [_scale_amplitudes(model, start, scales, X, Y)]
    for shift in _SHIFTS if lengths.any() else ():
        point = np.where(lengths, np.clip(extents + shift, low, high), start)
        kernels.append(_scale_amplitudes(model, point, scales, X, Y))
    kernels += [_add_friction(kernels[-1], (low + high) / 2, forces)] if forces.any() else []
    # The smoother found no noise at all in 3 of 5 logs with five samples a swing and noise of 8 %,
    # and from too little noise no slope leads back. So each kernel stands beside three noises, as
    # `test_few_positions_are_enough_whatever_the_first_lengthscale` needs (`tests/test_learn.py`).
    sigmas = [start[size:], *(np.log(share * scale) for share in (0.01, 0.1))]
    noisy = [
        np.append(h[:size], np.where(moves, sigma, start[size:]))
        for sigma in (sigmas if moves.any() else sigmas[:1])
        for h in kernels
    ]
    looked = np.isfinite(impulse)
    least, some, limit = (
        np.where(looked, impulse + np.log(share), 0.0) for share in (1e-6, 0.01, 3.0)
    )
    some = np.where(looked, some, -np.inf)
    pairs = (low, least), (high, limit), (free, looked), (lengths, none), (scales, none)
    design = [np.append(np.clip(h, low, high), some) for h in [start, *noisy]]
    return Bounds(*map(np.concatenate, pairs)), np.array(design)


def _add_friction(point, middle, forces) -> Float[np.ndarray, " P"]:
    """The point with friction of a third of all forces.

    Coefficients of friction are amplitudes too: from the caller's alone the search ended without
    viscous friction in one of six logs of three runs, 63 nats above the best, and two of the runs
    were lost. The middle of the box is a friction as large as all forces together.
    """
    return np.where(forces, middle + np.log(0.3), point)


def _least_lengths(leaves, X, scale, spacing: float) -> Float[np.ndarray, " P"]:
    """The logarithm of `spacing` in units of the coordinates, or of the smallest of them."""
    spread = X.std(axis=0)
    spread[: len(scale)] = scale
    spreads = [
        spread if p.low.size == len(spread) else np.full(p.low.size, scale.min()) for p in leaves
    ]
    return np.log(spacing * np.maximum(np.concatenate(spreads), np.finfo(float).tiny))


def _extents(leaf: np.ndarray, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, " size"]:
    """The logarithm of the extent of X, for each coordinate where the leaf has as many entries."""
    ranges = np.maximum(np.ptp(X, axis=0), np.finfo(float).tiny)
    if leaf.shape == ranges.shape:
        return np.log(ranges * np.sqrt(len(ranges)))
    return np.full(leaf.size, np.log(np.hypot.reduce(ranges)))


def _scale_amplitudes(model: Model, h, scales, X, Y):
    """The point h with amplitudes at which velocities of the prior are twice those observed."""
    if not scales.any():
        return h
    full = np.concatenate([h, np.asarray(model.log_process)])
    trace = float(gram_trace(model.unflatten(full).kernel, jnp.asarray(X))) / len(X)
    target = 4 * np.mean(np.sum(Y**2, axis=1))
    out = h.copy()
    if np.isfinite(trace) and trace > 0 and target > 0:
        out[scales] += np.log(target / trace)
    return out


@compiled_by_size
def _prior_rows(K: AbstractMatrixKernel, S: Float[Array, "m d"]) -> Float[Array, "m n q"]:
    return KernelRows(S).rows(K, S)


def impulses(K: AbstractMatrixKernel, S, Y, data: Preprocessed) -> Float[np.ndarray, " n"]:
    """The logarithm of the process noise that would move each coordinate as much as the field does.

    It is the velocity times the root of the time over which it lasts; −inf where K moves nothing.
    """
    prior = np.asarray(_prior_rows(K, S)).reshape(len(S), len(data.scale), -1)
    velocity = np.sqrt(np.mean(Y**2, axis=0))
    speed = np.sqrt(np.mean(sample_points(data)[1] ** 2, axis=0))
    time = np.median(data.scale / np.maximum(speed, np.finfo(float).tiny))
    with np.errstate(divide="ignore"):
        return np.where((prior != 0).any((0, 2)), np.log(velocity * np.sqrt(time)), -np.inf)


def landmark_spacing(X, S, scale: Float[np.ndarray, " n"]) -> float:
    """The largest distance of a point of X from its nearest landmark, in standard deviations.

    A field of shorter lengthscale has ripples between the landmarks.
    """
    spread = X.std(axis=0)
    spread[: len(scale)] = scale
    unit = np.where(spread > 0, spread, 1.0)
    A, B = X / unit, np.asarray(S) / unit
    squares = (A**2).sum(1)[:, None] + (B**2).sum(1)[None] - 2 * A @ B.T
    return float(np.sqrt(np.maximum(squares.min(axis=1), 0.0).max()))
