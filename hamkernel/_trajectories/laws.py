"""Laws that many parts share, learned from noisy runs by two solves with weak rows.

Of each coordinate whose velocity the laws change there is a row for each window, see `windows.py`.
The unknowns are the weights of the features of the laws, few in a system of any size, so that a
solve is linear in the number of coordinates. Kernel and scatter maximise the likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._closed_forms import log_density
from hamkernel._features import AbstractFeatures, features, is_of_parts
from hamkernel._fields.kinetic import Kinetic
from hamkernel._machine import compiled
from hamkernel._observations.kinds import Functionals
from hamkernel._posterior import condition
from hamkernel._solvers.low_rank_factor import LowRankSystem
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import completed, shared_laws
from hamkernel._trajectories.diagnostics import FitQuality, diagnostics_of_rows
from hamkernel._trajectories.evidence import EvidenceOfRows
from hamkernel._trajectories.free_run import Stretches, relative_error, stretches
from hamkernel._trajectories.learned import Iteration, Learned, misfits
from hamkernel._trajectories.runs import Runs
from hamkernel._trajectories.whiteness import Whiteness
from hamkernel._trajectories.windows import (
    Channels,
    Chunk,
    full_factor,
    smooth_channels,
    white_factors,
    whiten_rows,
    windows,
)
from hamkernel._tuning.minimiser import most_likely_in_box
from hamkernel._tuning.space import hyperparameters

_ROWS = 2048  # factored at once: .3 s
_LONGEST = 256  # samples smoothed at once: a factor of 512 rows takes 5 ms
_SEARCHED = 4_000_000  # states times parts times centres of a loss: .1 s
_STEPS = 40  # of BFGS

WIDTH = 12  # intervals of a window


class Piece(NamedTuple):
    """A part of a run, smoothed at once.

    Attributes:
        run: its number.
        samples: which of them.
        states: the smoothed states, shape (T, n).
        raw: the samples, those that were not measured replaced by smoothed ones, shape (T, n).
        roots: B_j with B_j B_jᵀ the covariance of x_j, of each coordinate, (T, k).
    """

    run: int
    samples: slice
    states: Float[np.ndarray, "T n"]
    raw: Float[np.ndarray, "T n"]
    roots: list[Float[np.ndarray, "T k"]]


class SmoothedRuns(NamedTuple):
    """Runs, smoothed.

    Attributes:
        pieces: in their order, with overlaps.
        noise: σ of each coordinate, shape (n,); NaN where nothing was measured.
        masses: the known mass of each position, shape (m,); None where no mean has them.
    """

    pieces: list[Piece]
    noise: Float[np.ndarray, " n"]
    masses: Float[np.ndarray, " m"] | None


def smoothed_runs(
    runs: Runs, mean: Any, noise: Float[np.ndarray, " n"] | None, is_canonical: bool
) -> SmoothedRuns:
    """The runs smoothed: q with p/m as its derivative where masses are known, else alone."""
    n = runs.dimension
    m = n // 2
    parts = _parts(runs)
    states = [np.zeros((s.stop - s.start, n)) for _, s in parts]
    roots: list[list[Any]] = [[None] * n for _ in parts]
    sigma = np.full(n, np.nan)
    masses = None
    if isinstance(mean, Kinetic) and mean.mass.ndim < 2:
        masses = np.broadcast_to(np.asarray(mean.mass, float), (m,))
        groups = [
            (np.flatnonzero(masses == mass), np.flatnonzero(masses == mass) + m, mass)
            for mass in np.unique(masses)
        ]
    elif is_canonical:
        groups = [(np.arange(m), None, 1.0), (np.arange(m, n), None, 1.0)]
    else:
        groups = [(np.arange(n), None, 1.0)]
    for of_values, of_slopes, mass in groups:
        channels, means, size, unit = _channels(runs, parts, of_values, of_slopes, mass)
        slope_size = size / unit * mass
        known_noise = (
            None if noise is None else float(np.median(noise[of_values])) / size,
            None
            if noise is None or of_slopes is None
            else float(np.median(noise[of_slopes])) / slope_size,
        )
        h, smooth = smooth_channels(channels, known_noise)
        sigma[of_values] = size * np.exp(h.log_noise)
        if of_slopes is not None and channels.has_slope.any():
            sigma[of_slopes] = slope_size * np.exp(h.log_slope_noise)
        for k, (_, samples) in enumerate(parts):
            T = samples.stop - samples.start
            states[k][:, of_values] = means[k] + size * np.asarray(smooth.values)[k, :T]
            if of_slopes is not None:
                states[k][:, of_slopes] = slope_size * np.asarray(smooth.slopes)[k, :T]
            piece_roots = [size * _root(np.asarray(S)[:T, :T]) for S in smooth.covariance[k]]
            for i, c in enumerate(of_values):
                roots[k][c] = piece_roots[i * len(piece_roots) // len(of_values)]
    pieces = []
    for (r, samples), path, piece_roots in zip(parts, states, roots, strict=True):
        x = runs.on_host()[1][r][samples]
        pieces.append(Piece(r, samples, path, np.where(np.isfinite(x), x, path), piece_roots))
    return SmoothedRuns(pieces, sigma, masses)


def _root(S: Float[np.ndarray, "T T"]) -> Float[np.ndarray, "T k"]:
    """B with B Bᵀ = S but for a millionth of its trace."""
    squares, V = np.linalg.eigh(S)
    order = np.argsort(-squares)
    squares, V = np.maximum(squares[order], 0.0), V[:, order]
    k = int(np.searchsorted(np.cumsum(squares), (1 - 1e-6) * squares.sum())) + 1
    return V[:, :k] * np.sqrt(squares[:k])


def _parts(runs: Runs) -> list[tuple[int, slice]]:
    """Parts of runs that are smoothed at once, which overlap by half of a window."""
    out = []
    for r, t in enumerate(runs.on_host()[0]):
        start, stop = 0, 0
        while stop < len(t):
            stop = start + _LONGEST
            stop = stop if len(t) - stop > 2 * WIDTH else len(t)
            out.append((r, slice(start, stop)))
            start = stop - WIDTH // 2 - 1
    return out


def _channels(
    runs: Runs,
    parts: list[tuple[int, slice]],
    of_values: np.ndarray,
    of_slopes: np.ndarray | None,
    mass: float,
) -> tuple[Channels, Float[np.ndarray, "S 1 C"], float, float]:
    """Coordinates as channels, their means, their size, and the unit of time."""
    times, states = runs.on_host()
    T = max(s.stop - s.start for _, s in parts)
    t = np.zeros((len(parts), T))
    x, v = np.full((2, len(parts), T, len(of_values)), np.nan)
    for k, (r, part) in enumerate(parts):
        clock, length = times[r][part], part.stop - part.start
        t[k, :length], t[k, length:] = clock - clock[0], clock[-1] - clock[0]
        x[k, :length] = states[r][part][:, of_values]
        if of_slopes is not None:
            v[k, :length] = states[r][part][:, of_slopes] / mass
    unit = t[:, -1].max() / 2
    is_measured, has_slope = np.isfinite(x), np.isfinite(v)
    counts = np.maximum(is_measured.sum(axis=1, keepdims=True), 1)
    means = np.where(is_measured, x, 0.0).sum(axis=1, keepdims=True) / counts
    x = np.where(is_measured, x - means, 0.0)
    size = float(np.sqrt((x**2).sum() / max(is_measured.sum(), 1))) or 1.0
    v = np.where(has_slope, v, 0.0) * unit / size
    return Channels(t / unit - 1, x / size, v, is_measured, has_slope), means, size, unit


def chunks_of(runs: Runs, smooth: SmoothedRuns, of_rows: np.ndarray, depends: np.ndarray) -> Chunk:
    """The weak rows of some coordinates, in chunks of one shape, side by side."""
    times = runs.on_host()[0]
    raw: list[tuple] = []
    window_limit = max(_ROWS // len(of_rows), 2)
    for piece in smooth.pieces:
        t = times[piece.run][piece.samples]
        made = windows(t, WIDTH)
        R = len(made.value)
        if not R:
            continue
        for index in np.array_split(np.arange(R), -(-R // window_limit)):
            used = np.flatnonzero(made.value[index].any(axis=0) | made.slope[index].any(axis=0))
            samples = slice(used[0], used[-1] + 1)
            value, slope, bend = (item[index][:, samples] for item in made)
            z = piece.raw[samples]
            rows = -slope @ z[:, of_rows]
            roots = slope[None] * smooth.noise[of_rows, None, None]
            for i, c in enumerate(of_rows):
                if np.isnan(smooth.noise[c]) and smooth.masses is not None:
                    q = c - len(smooth.masses)
                    rows[:, i] = smooth.masses[q] * (bend @ z[:, q])
                    roots[i] = bend * smooth.masses[q] * smooth.noise[q]
            path_roots = [piece.roots[j][samples] for j in depends]
            alike = all(
                item is path_roots[0] or np.array_equal(item, path_roots[0]) for item in path_roots
            )
            path_roots = path_roots[:1] if alike else path_roots
            raw.append((piece.states[samples], value, rows.T, roots, path_roots))
    R, T = (max(len(item[1]) for item in raw), max(len(item[0]) for item in raw))
    G = max(len(item[4]) for item in raw)
    k = max(root.shape[1] for item in raw for root in item[4])
    out = []
    for points, value, rows, roots, path_roots in raw:
        r, t = R - len(value), T - len(points)
        path_roots = path_roots * (G // len(path_roots))
        padded = [np.pad(item, ((0, t), (0, k - item.shape[1]))) for item in path_roots]
        out.append(
            Chunk(
                np.pad(points, ((0, t), (0, 0)), "edge"),
                np.pad(value, ((0, r), (0, t))),
                np.pad(rows, ((0, 0), (0, r))),
                np.pad(roots, ((0, 0), (0, r), (0, t))),
                np.stack(padded),
            )
        )
    return jax.tree.map(lambda *item: jnp.asarray(np.stack(item)), *out)


class LawModel(NamedTuple):
    """A kernel, and by how much rows scatter more than their covariance says."""

    kernel: AbstractMatrixKernel
    log_scatter: Float[Array, ""]

    @property
    def flat(self) -> Float[Array, " P"]:
        leaves, _ = ravel_pytree(eqx.filter(self.kernel, eqx.is_inexact_array))
        return jnp.append(leaves, self.log_scatter)

    def with_flat(self, h: Float[Array, " P"]) -> LawModel:
        params, static = eqx.partition(self.kernel, eqx.is_inexact_array)
        _, unravel = ravel_pytree(params)
        return LawModel(eqx.combine(unravel(h[:-1]), static), h[-1])


def _features_of(K: AbstractMatrixKernel, n: int) -> AbstractFeatures:
    return features(K, n, 1, jax.random.key(0), jnp.float64)


def _design(K, chunk: Chunk, of_rows) -> Float[Array, "c R m"]:
    """∫ φ f_c dt of each feature."""
    basis = _features_of(K, chunk.points.shape[1])

    def features_at(x):
        return basis.rows(x)[of_rows]

    F = jax.lax.map(features_at, chunk.points)  # (T, c, m)
    return jnp.einsum("rt,tcm->crm", chunk.value, F)


def _residual_rows(mean, chunk: Chunk, of_rows) -> Float[Array, "c R"]:
    if mean is None:
        return jnp.asarray(chunk.rows)
    drift = jax.vmap(lambda x: mean(x)[of_rows])(chunk.points)
    return jnp.asarray(chunk.rows) - jnp.einsum("rt,tc->cr", chunk.value, drift)


def _rows(
    K, chunks: Chunk, factors, mean, of_rows
) -> tuple[Float[Array, "D m"], Float[Array, " D"]]:
    """The whitened rows of the features, and of what the mean leaves; zero for empty windows."""

    def one(both):
        chunk, L = both
        F = whiten_rows(L, _design(K, chunk, of_rows))
        return F, whiten_rows(L, _residual_rows(mean, chunk, of_rows))

    F, y = jax.lax.map(one, (chunks, factors))
    return F.reshape(-1, F.shape[2]), y.reshape(-1)


@compiled
def negative_log_likelihood(model: LawModel, chunks: Chunk, factors, mean, of_rows):
    """−log p of the whitened rows, y ~ N(0, ΦΦᵀ + s²I)."""
    F, y = _rows(model.kernel, chunks, factors, mean, of_rows)
    ridge = jnp.exp(2 * model.log_scatter)
    empty = jnp.sum(jnp.abs(chunks.value).sum(axis=2) == 0) * len(of_rows)
    density = log_density(LowRankSystem(F, ridge), y)
    return -density - 0.5 * empty.astype(ridge.dtype) * jnp.log(2 * jnp.pi * ridge)


@compiled
def _best_of(model, design, chunks, factors, mean, of_rows):
    return jax.lax.map(
        lambda h: negative_log_likelihood(model.with_flat(h), chunks, factors, mean, of_rows),
        design,
    )


@compiled
def _search(model: LawModel, start, low, high, chunks, factors, mean, of_rows, steps):
    def loss(h):
        return negative_log_likelihood(model.with_flat(h), chunks, factors, mean, of_rows)

    return most_likely_in_box(loss, start, low, high, jnp.full(len(start), 0.2), steps)


@compiled
def _white(chunks: Chunk):
    return jax.lax.map(white_factors, chunks)


@compiled
def _full(field, chunks: Chunk, of_rows, depends):
    def one(chunk):
        def slope(x):
            inner = lambda part: field(x.at[depends].set(part))[of_rows]  # noqa: E731
            return jax.jacfwd(inner)(x[depends])

        return full_factor(chunk, jax.lax.map(slope, chunk.points))

    return jax.lax.map(one, chunks)


@compiled
def _weights_of(model: LawModel, chunks, factors, mean, of_rows) -> Float[Array, " m"]:
    """The mean of the weights of the features."""
    F, y = _rows(model.kernel, chunks, factors, mean, of_rows)
    m = F.shape[1]
    Q, R = jnp.linalg.qr(jnp.concatenate([F, jnp.exp(model.log_scatter) * jnp.eye(m)]))
    return jax.scipy.linalg.solve_triangular(R, Q[: len(y)].T @ y)


@compiled
def _compress(model: LawModel, chunks: Chunk, factors, of_rows):
    """The rows of all chunks as m orthonormal combinations: weights (Q, n, m) and targets (m,)."""

    def rows_of(both):
        chunk, L = both
        return whiten_rows(L, _design(model.kernel, chunk, of_rows)), whiten_rows(L, chunk.rows)

    F, y = jax.lax.map(rows_of, (chunks, factors))
    S, D, m = F.shape
    Q, _ = jnp.linalg.qr(F.reshape(S * D, m))

    def back(both):
        chunk, L, Q = both
        c, R = chunk.rows.shape
        solve = jax.scipy.linalg.solve_triangular
        if L.ndim == 3:
            unwhitened = jax.vmap(lambda L, q: solve(L, q, lower=True, trans="T"))(
                L, Q.reshape(c, R, -1)
            )
        else:
            unwhitened = solve(L, Q, lower=True, trans="T").reshape(c, R, -1)
        on_rows = jnp.einsum("rt,crm->mtc", chunk.value, unwhitened)
        n = chunk.points.shape[1]
        return jnp.zeros((*on_rows.shape[:2], n)).at[:, :, of_rows].set(on_rows)

    weights = jax.lax.map(back, (chunks, factors, Q.reshape(S, D, -1)))  # (S, m, T, n)
    weights = jnp.moveaxis(weights, 1, 0).reshape(Q.shape[1], -1, weights.shape[3])
    return weights, Q.T @ y.reshape(-1)


class Found(NamedTuple):
    """The result of two solves.

    Attributes:
        model: the kernel and the scatter.
        observations: functionals that say all that the rows say of the laws, with unit noise.
        smooth: the smoothed runs.
        losses: −log p of both solves.
        count: the number of rows.
    """

    model: LawModel
    observations: Functionals
    smooth: SmoothedRuns
    losses: tuple[float, float]
    count: int


def find_laws(K: AbstractMatrixKernel, runs: Runs, mean: Any, noise: Any) -> Found:
    """The laws by two solves."""
    n = runs.dimension
    smooth = smoothed_runs(runs, mean, noise, K.has_hamiltonian)
    X = np.concatenate([piece.states for piece in smooth.pieces])
    K = completed(K, jnp.asarray(X), n)
    depends = sorted(set().union(*(s for k in K.scalar_kernels for s in k.supports(n))))
    missing = [j for j in depends if smooth.pieces[0].roots[j] is None]
    if missing:
        raise ValueError(
            f"the laws depend on coordinate {missing[0]}, which is a momentum in runs of {n} "
            f"coordinates (q, p). If all of them are positions, give a mass for each: "
            f"mass=np.ones({n})."
        )
    depends, of_rows = np.asarray(depends), jnp.asarray(_moving_coordinates(K, X))
    chunks = chunks_of(runs, smooth, np.asarray(of_rows), depends)
    part = _part(K, chunks)
    model = LawModel(K, jnp.asarray(np.log(2.0)))
    low, high, design = _box(model, X, chunks)
    factors, losses = _white(chunks), []
    for first in (True, False):
        selected = jax.tree.map(lambda a: a[part], (chunks, factors))
        args = *selected, mean, of_rows
        start = model.flat
        if first:
            values = np.asarray(_best_of(model, design, *args))
            start = design[int(np.nanargmin(values))]
        h, loss = _search(model, start, low, high, *args, _STEPS)
        model = model.with_flat(h)
        losses.append(float(loss))
        if first:
            w = _weights_of(model, chunks, factors, mean, of_rows)
            field = _FieldOfWeights(_features_of(model.kernel, n), w, mean)
            factors = _full(field, chunks, of_rows, jnp.asarray(depends))
    weights, targets = _compress(model, chunks, factors, of_rows)
    points = chunks.points.reshape(1, -1, n)
    observations = Functionals(points, weights[None], targets[None])
    count = int((np.abs(np.asarray(chunks.value)).sum(axis=2) > 0).sum()) * len(of_rows)
    return Found(model, observations, smooth, (losses[0], losses[1]), count)


class _FieldOfWeights(eqx.Module):
    features: AbstractFeatures
    weights: Float[Array, " m"]
    mean: Any

    def __call__(self, x):
        f = self.features.field(x, self.weights)
        return f if self.mean is None else f + self.mean(x)


def _moving_coordinates(K: AbstractMatrixKernel, X: Float[np.ndarray, "N n"]) -> np.ndarray:
    """The coordinates whose velocities the laws change."""
    basis = _features_of(K, X.shape[1])
    some = jnp.asarray(X[np.linspace(0, len(X) - 1, min(len(X), 4)).astype(int)])
    return np.flatnonzero(np.abs(np.asarray(basis(some))).max(axis=(0, 2)) > 0)


def _part(K: AbstractMatrixKernel, chunks: Chunk) -> np.ndarray:
    """Which chunks the search of hyperparameters takes."""
    parts = sum(
        jax.eval_shape(law.of, chunks.points[0, 0]).weights.shape[0] * len(law.centres or ())
        for law in shared_laws(K)
    )
    S, T = chunks.points.shape[:2]
    count = int(np.clip(_SEARCHED // max(parts * T, 1), 1, S))
    return np.linspace(0, S - 1, count).astype(int)


def _box(model: LawModel, X, chunks: Chunk):
    """The box of hyperparameters, and a design of first points."""
    reach = jnp.maximum(chunks.value.sum(axis=2), 1e-300)[:, None]
    forces = jnp.where(chunks.rows != 0, chunks.rows / reach, 0.0)
    rms = float(np.sqrt(float(jnp.sum(forces**2)) / np.sum(np.asarray(chunks.rows) != 0)))
    some = jnp.asarray(X[np.linspace(0, len(X) - 1, min(len(X), 64)).astype(int)])
    leaves = hyperparameters(model.kernel, some, rms, some[:1])
    low = np.concatenate([*(p.low.ravel() for p in leaves), [-1.0]])
    high = np.concatenate([*(p.high.ravel() for p in leaves), [5.0]])
    start = np.asarray(model.flat)
    low, high = np.minimum(low, start - 0.1), np.maximum(high, start + 0.1)
    names = [p.name.split(".")[-1] for p in leaves for _ in range(p.low.size)] + [""]
    design = [start]
    for length in (0.35, 0.5, 0.65, 0.8):
        for size in (0.4, 0.55, 0.7):
            shares = [{"lengthscale": length, "scale": size}.get(name) for name in names]
            at = [low[i] + (high[i] - low[i]) * s if s else start[i] for i, s in enumerate(shares)]
            design.append(np.array(at))
    return tuple(map(jnp.asarray, (low, high, np.array(design))))


def are_learned_from_rows(K: AbstractMatrixKernel) -> bool:
    """Whether all of K is made from laws that many parts share, for states alone."""
    return is_of_parts(K) and not K.takes_inputs


def learn_laws(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Any,
    noise: Float[np.ndarray, " n"] | None,
    again: Callable[..., Learned],
) -> Learned:
    """`learn` for laws that many parts share; see there.

    Raises:
        ValueError: no run has the 13 samples of a window.
    """
    if max(len(t) for t in runs.times) <= WIDTH:
        raise ValueError(
            f"no run has the {WIDTH + 1} samples of a window, from which laws of many parts are "
            "learned: log more of them, or pass velocities to hk.fit."
        )
    n = runs.dimension
    solution = find_laws(K, runs, mean, noise)
    scatter, count = float(jnp.exp(solution.model.log_scatter)), len(solution.observations.targets)
    posterior = condition(
        solution.model.kernel, solution.observations, regularization=scatter**2 / count, mean=mean
    )
    states, measured = _paths(runs, solution.smooth), runs.on_host()[1]
    sigma = solution.smooth.noise if noise is None else np.asarray(noise)
    quality = _quality(runs, solution, posterior.field, states, sigma, noise is not None)
    table = diagnostics_of_rows(quality, scatter)
    if table.warning:
        require.warn(table.warning)
    unknown = tuple(jnp.full(x.shape, jnp.nan) for x in measured)
    return Learned(
        field=posterior.field,
        kernel=solution.model.kernel,
        regularization=jnp.asarray(1 / count),
        noise=jnp.asarray(sigma),
        process_noise=jnp.zeros(n),
        states=tuple(map(jnp.asarray, states)),
        kept=jnp.ones(len(states)),
        dropped=(),
        pushed=(),
        misfit=jnp.asarray(quality.misfit),
        chi_squared=jnp.asarray(scatter**2),
        innovations=unknown,
        whiteness=jnp.asarray(jnp.nan),
        widening=jnp.asarray(scatter**2),
        disturbance=tuple(jnp.zeros(x.shape) for x in measured),
        history=tuple(_iteration(loss, sigma, len(unknown[0])) for loss in solution.losses),
        converged=table.is_usable,
        diagnostics=table,
        runs=runs,
        observations=solution.observations,
        mean=mean,
        evidence=EvidenceOfRows(-solution.losses[1]),
        again=again,
    )


def _iteration(loss: float, sigma: np.ndarray, samples: int) -> Iteration:
    unknown, one = jnp.asarray(jnp.nan), jnp.asarray(1.0)
    noise, none = jnp.asarray(sigma), jnp.zeros(len(sigma))
    return Iteration(samples, unknown, unknown, one, noise, none, one, jnp.asarray(loss))


def _paths(runs: Runs, smooth: SmoothedRuns) -> list[Float[np.ndarray, "T n"]]:
    """The smoothed states of each run; where two pieces overlap, half of each."""
    out = [np.zeros(np.shape(x)) for x in runs.states]
    done = [0] * len(out)
    for piece in smooth.pieces:
        start, stop = piece.samples.start, piece.samples.stop
        first = (start + done[piece.run]) // 2 if start else 0
        out[piece.run][first:stop] = piece.states[first - start :]
        done[piece.run] = stop
    return out


class _Log(NamedTuple):
    """A run as `stretches` takes it."""

    times: Float[np.ndarray, " T"]
    states: Float[np.ndarray, "T n"]
    inputs: Float[np.ndarray, "S 2 0"]


def _quality(
    runs: Runs, solution: Found, field: Any, states, sigma, is_noise_known: bool
) -> FitQuality:
    times, measured = runs.on_host()
    every = np.concatenate(states)
    scale = np.where((size := every.std(axis=0)) > 0, size, 1.0)
    slopes = [np.gradient(x, t, axis=0) for t, x in zip(times, states, strict=True)]
    speed = np.sqrt(np.mean(np.concatenate(slopes) ** 2, axis=0))
    spacing = np.median(np.concatenate([np.diff(t) for t in times]))
    swing = 2 * np.pi * np.median(scale / np.maximum(speed, np.finfo(float).tiny)) / spacing
    logs = [_Log(t, x, np.zeros((len(t) - 1, 2, 0))) for t, x in zip(times, measured, strict=True)]
    part = stretches(logs, states, int(np.clip(2 * swing, 4, 64)))
    part = Stretches(*(item[:: max(len(part.starts) // 8, 1)] for item in part))
    free = float(solution.count - len(solution.observations.targets))
    scatter = float(jnp.exp(solution.model.log_scatter))
    return FitQuality(
        names=runs.coordinate_names,
        noise=sigma,
        scale=scale,
        is_noise_known=is_noise_known,
        kept=np.ones(len(states)),
        dropped=(),
        misfit=misfits(runs, states, sigma),
        core=np.full(len(sigma), np.nan),
        chi_squared=scatter**2,
        free=free,
        remaining=free,
        white=Whiteness(1.0, 1.0, np.zeros(len(sigma))),
        process=None,
        share=0.0,
        impulse=0.0,
        pushed=(),
        count=2,
        settled=True,
        swing=float(swing),
        driven=False,
        free_run=relative_error(np.asarray(_run_freely(field, part)), part, scale),
    )


@compiled
def _run_freely(field: Any, part: Stretches) -> Float[Array, "S L n"]:
    """The states at the ends of all intervals, by four steps of Runge and Kutta in each."""

    def one(x, spans):
        def across(x, span):
            def step(x, _):
                h = span / 4
                k1 = field(x)
                k2 = field(x + h / 2 * k1)
                k3 = field(x + h / 2 * k2)
                return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3)), None

            x, _ = jax.lax.scan(step, x, length=4)
            return x, jnp.where(jnp.isfinite(x), x, jnp.inf)

        return jax.lax.scan(across, x, spans)[1]

    return jax.lax.map(lambda both: one(*both), (jnp.asarray(part.starts), jnp.asarray(part.spans)))
