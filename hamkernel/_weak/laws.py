"""Laws that many parts share, learned from noisy runs by two solves with weak rows.

Of each coordinate whose velocity the laws change there is a row for each window, see `rows.py`. The
unknowns are the weights of the features of the laws, few in a system of any size, so that a solve
is linear in the number of coordinates. Kernel and scatter maximise the likelihood.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features, is_of_parts
from hamkernel._fields.kinetic import Kinetic
from hamkernel._learned.diagnostics import FitQuality, diagnostics_of_rows
from hamkernel._learned.free_run import Stretches, relative_error, stretches
from hamkernel._learned.result import AbstractEvidence, Iteration, Learned, misfits
from hamkernel._learned.whiteness import Whiteness
from hamkernel._machine import precise_jit
from hamkernel._observations.kinds import Functionals
from hamkernel._posterior import condition
from hamkernel._runs.runs import Runs
from hamkernel._solvers.lagrangian import ridge_solution
from hamkernel._solvers.triangle import columns_used, regression_loss
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import complete, shared_laws
from hamkernel._structures.friction import frictions
from hamkernel._tuning.minimiser import best_in_box, inside_box
from hamkernel._tuning.space import hyperparameters
from hamkernel._weak.rows import (
    Channels,
    Pieces,
    factors,
    path_covariance,
    smoothed_pieces,
    weak_rows,
    whiten,
)

_SEARCHED = 4_000_000  # states times parts times centres of a loss: .1 s
# In lengthscales. With windows of 1.0 a run of six particles on springs, of four lengthscales, has
# only 72 rows for 64 unknowns.
_WIDTH = 0.5
_STEPS = 40  # of BFGS
# Of a force, as a share of it, so that rows of exact samples have a covariance.
_EXACT = 1e-6


class EvidenceOfRows(AbstractEvidence):
    """The evidence of weak rows: −log p is `loss`, up to a constant."""

    loss: float

    @property
    def log_p(self) -> float:
        return -self.loss

    def gain(self, part: AbstractMatrixKernel) -> float:
        raise TypeError(
            "gain compares fields along iterated paths, and laws that many parts share are learned "
            "from weak rows: learn again with the part in the kernel, hk.learn(K + part, runs), "
            "and compare log_evidence."
        )


class States(eqx.Module):
    """The states x of smoothed channels z: z itself, or (q, p) of z = (q, q̇) with known masses.

    Attributes:
        mass: the mass of each position, shape (m,); None where z is x.
    """

    mass: Float[Array, " m"] | None

    def __call__(self, z: Float[Array, " z"]) -> Float[Array, " n"]:
        return z if self.mass is None else z * jnp.append(jnp.ones_like(self.mass), self.mass)


def _channels(runs: Runs, mean: Any, noise: Any, is_canonical: bool) -> tuple[Channels, States]:
    """The channels: q with p/m as its slope where masses are known, else all coordinates."""
    X, n = runs.host_arrays()[1], runs.dimension
    m = n // 2
    if isinstance(mean, Kinetic) and mean.mass.ndim < 2:
        mass = np.broadcast_to(np.asarray(mean.mass, float), (m,))
        groups = [np.flatnonzero(mass == m_i) for m_i in np.unique(mass)]
        values, slopes = [x[:, :m] for x in X], [x[:, m:] / mass[None] for x in X]
        if noise is not None:
            noise = np.stack([noise[:m], noise[m:] / mass])
        state = States(jnp.asarray(mass))
    else:
        groups = [np.arange(m), np.arange(m, n)] if is_canonical else [np.arange(n)]
        values, slopes, state = X, [np.full(x.shape, np.nan) for x in X], States(None)
        noise = None if noise is None else np.stack([noise, noise])
    if noise is not None:  # alike channels have one
        noise = noise.copy()
        for g in groups:
            noise[:, g] = np.median(noise[:, g], axis=1, keepdims=True)
    return Channels(values, slopes, groups, state.mass is not None, noise, _WIDTH), state


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


class Rows(NamedTuple):
    """The weak rows of laws.

    Attributes:
        pieces: the smoothed runs.
        state: the map from the channels to states.
        mean: the known part of the field.
        of_rows: the coordinates that have rows.
    """

    pieces: Pieces
    state: States
    mean: Any
    of_rows: Int[np.ndarray, " m"]

    @property
    def count(self) -> int:
        """How many rows there are in windows inside of the runs."""
        return int(np.sum(np.asarray(self.pieces.inside))) * len(self.of_rows)

    def law(self, field: Any) -> Any:
        """d/dt x − field(x) − mean(x) = 0 as `weak_rows` takes it."""

        def law(z):
            x = self.state(z)
            drift = sum((f(x) for f in (field, self.mean) if f is not None), jnp.zeros_like(x))
            return x[self.of_rows], -drift[self.of_rows]

        return law

    def known(self) -> Float[Array, "B W m"]:
        """−∫ φ̇ x dt less what the mean says of it."""
        return weak_rows(self.law(None), self.pieces)

    def feature_rows(self, K: AbstractMatrixKernel) -> Float[Array, "B W m r"]:
        """∫ φ f dt of each feature f of the kernel."""

        def law(z):
            x = self.state(z)
            F = _features_of(K, len(x)).rows(x)[self.of_rows]
            return jnp.zeros_like(F), F

        return weak_rows(law, self.pieces)

    def part(self, chosen: np.ndarray) -> Rows:
        """The rows of some of the pieces."""
        p = self.pieces
        by_piece = {
            name: getattr(p, name)[chosen] for name in ("path", "roots", "targets", "inside")
        }
        return self._replace(pieces=p._replace(**by_piece))


@precise_jit
def _rows_over_noise(
    model: LawModel, rows: Rows, L
) -> tuple[Float[Array, "N m"], Float[Array, " N"]]:
    """Features and what the mean leaves, over their noise; zero for windows outside of the runs."""
    precision = jnp.exp(-model.log_scatter)
    features = whiten(L, rows.feature_rows(model.kernel))
    return features * precision, whiten(L, rows.known()) * precision


@precise_jit
def _search(model: LawModel, design, low, high, rows: Rows, L):
    count = jnp.sum(rows.pieces.inside, dtype=low.dtype) * len(rows.of_rows)

    def loss(h):
        shown = model.with_flat(h)
        return regression_loss(*_rows_over_noise(shown, rows, L)) + count * shown.log_scatter

    run = best_in_box(loss, design, low, high, jnp.full_like(low, 0.2), _STEPS)
    return inside_box(run.best.u, low, high), run.best.value


@precise_jit
def _factors(rows: Rows, field: Any, deviation):
    """The factors of the covariance of the rows with this field in the laws."""
    return factors(rows.pieces, path_covariance(rows.law(field), rows.pieces), deviation)


@precise_jit
def _solve(model: LawModel, rows: Rows, L) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """The mean of the weights of the features, and how many numbers the rows determine."""
    R, weights = ridge_solution(*_rows_over_noise(model, rows, L))
    return weights, columns_used(R)


@precise_jit
def _compress(model: LawModel, rows: Rows, L):
    """All rows as m orthonormal combinations: weights (m, Q, n) at points (Q, n), targets (m,)."""
    p, n = rows.pieces, rows.state(rows.pieces.path[0, 0]).shape[0]
    F, y = (
        whiten(L, a) for a in (rows.feature_rows(model.kernel), rows._replace(mean=None).known())
    )
    Q, _ = jnp.linalg.qr(F)

    def back(both):
        L, Q = both
        combined = jax.scipy.linalg.solve_triangular(L, Q, lower=True, trans="T")
        combined = combined.reshape(len(p.values), -1, Q.shape[1])
        on_rows = jnp.einsum("wp,wcm->mpc", p.values, combined)
        return jnp.zeros((*on_rows.shape[:2], n)).at[:, :, rows.of_rows].set(on_rows)

    weights = jax.lax.map(back, (L, Q.reshape(*L.shape[:2], -1)))  # (B, m, P, n)
    points = jax.vmap(rows.state)(jnp.asarray(p.path).reshape(-1, p.path.shape[2]))
    return points, jnp.moveaxis(weights, 1, 0).reshape(Q.shape[1], -1, n), Q.T @ y


class Found(NamedTuple):
    """The result of two solves.

    Attributes:
        model: the kernel and the scatter.
        observations: functionals that say all that the rows say of the laws, with unit noise.
        states: the smoothed states at the samples of each run, shape (T, n).
        noise: σ of each coordinate, shape (n,); NaN where nothing was measured.
        losses: −log p of both solves.
        count: the number of rows.
        used: how many numbers they determine.
    """

    model: LawModel
    observations: Functionals
    states: list[Float[np.ndarray, "T n"]]
    noise: Float[np.ndarray, " n"]
    losses: tuple[float, float]
    count: int
    used: float


def find_laws(K: AbstractMatrixKernel, runs: Runs, mean: Any, noise: Any) -> Found:
    """The laws by two solves."""
    n = runs.dimension
    channels, state = _channels(runs, mean, noise, K.has_hamiltonian)
    smooth = smoothed_pieces(runs, channels)
    unit = np.ones(n) if state.mass is None else np.append(np.ones(n // 2), state.mass)
    states, sigma = [x[:, :n] * unit[None] for x in smooth.states], smooth.noise.ravel()[:n] * unit
    X = np.concatenate(states)
    K = complete(K, jnp.asarray(X), n)
    depends = sorted(set().union(*(s for k in K.scalar_kernels for s in k.supports(n))))
    if state.mass is not None and depends[-1] >= n // 2:
        raise ValueError(
            f"the laws depend on coordinate {max(depends[0], n // 2)}, which is a momentum in runs "
            f"of {n} coordinates (q, p). If all of them are positions, give a mass for each: "
            f"mass=np.ones({n})."
        )
    of_rows = _moving_coordinates(K, X)
    rows = Rows(smooth.pieces, state, mean, of_rows)
    model = LawModel(K, jnp.asarray(np.log(2.0)))
    low, high, design, error = _box(model, X, rows)
    deviation = jnp.full(len(of_rows), _EXACT * error)
    L, part, losses = _factors(rows, None, deviation), _part(K, rows), []
    for field in (True, False):
        h, loss = _search(model, design, low, high, rows.part(part), L[part])
        model, design = model.with_flat(h), design.at[0].set(h)
        losses.append(float(loss))
        if field:
            w, _ = _solve(model, rows, L)
            L = _factors(rows, _FieldOfWeights(_features_of(model.kernel, n), w), deviation)
    points, weights, targets = _compress(model, rows, L)
    observations = Functionals(points[None], weights[None], targets[None])
    used = float(_solve(model, rows, L)[1])
    return Found(model, observations, states, sigma, (losses[0], losses[1]), rows.count, used)


class _FieldOfWeights(eqx.Module):
    features: AbstractFeatures
    weights: Float[Array, " m"]

    def __call__(self, x):
        return self.features.field(x, self.weights)


def _moving_coordinates(K: AbstractMatrixKernel, X: Float[np.ndarray, "N n"]) -> np.ndarray:
    """The coordinates whose velocities the laws change."""
    basis = _features_of(K, X.shape[1])
    some = jnp.asarray(X[np.linspace(0, len(X) - 1, min(len(X), 4)).astype(int)])
    return np.flatnonzero(np.abs(np.asarray(basis(some))).max(axis=(0, 2)) > 0)


def _part(K: AbstractMatrixKernel, rows: Rows) -> np.ndarray:
    """Which pieces the search of hyperparameters takes."""
    B, P = rows.pieces.path.shape[:2]
    x = jax.eval_shape(rows.state, rows.pieces.path[0, 0])
    parts = sum(
        jax.eval_shape(lambda x, law=law: law.parts_at(x), x).weights.shape[0] * law.columns
        for law in shared_laws(K)
    )
    count = int(np.clip(_SEARCHED // max(parts * P, 1), 1, B))
    return np.linspace(0, B - 1, count).astype(int)


def _box(model: LawModel, X, rows: Rows):
    """The box of hyperparameters, a design of first points, and the size of white forces.

    With an error of a force of this size at each sample rows are as wrong as they are large.
    """
    pieces = rows.pieces
    y = np.asarray(rows._replace(mean=None).known())[pieces.inside]
    rms = float(np.sqrt(np.mean(y**2))) / pieces.values[0].sum()
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
    white = np.sqrt(pieces.overlap[0, 0] * pieces.spacing) / pieces.values[0].sum()
    return *map(jnp.asarray, (low, high, np.array(design))), rms / white


def are_learned_from_rows(K: AbstractMatrixKernel) -> bool:
    """Whether all of K is made from laws that many parts share, for states alone.

    Friction beside the laws is learned by iterations: its weak rows were not measured.
    """
    return is_of_parts(K) and not (K.takes_inputs or frictions(K))


def learn_laws(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Any,
    noise: Float[np.ndarray, " n"] | None,
    again: Callable[..., Learned],
) -> Learned:
    """`learn` for laws that many parts share; see there."""
    n = runs.dimension
    solution = find_laws(K, runs, mean, noise)
    scatter, count = float(jnp.exp(solution.model.log_scatter)), len(solution.observations.targets)
    posterior = condition(
        solution.model.kernel, solution.observations, regularization=scatter**2 / count, mean=mean
    )
    states, measured = solution.states, runs.host_arrays()[1]
    sigma = solution.noise if noise is None else np.asarray(noise)
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
        evidence=EvidenceOfRows(solution.losses[1]),
        again=again,
    )


def _iteration(loss: float, sigma: np.ndarray, samples: int) -> Iteration:
    unknown, one = jnp.asarray(jnp.nan), jnp.asarray(1.0)
    noise, none = jnp.asarray(sigma), jnp.zeros(len(sigma))
    return Iteration(samples, unknown, unknown, one, noise, none, one, jnp.asarray(loss))


class _Log(NamedTuple):
    """A run as `stretches` takes it."""

    times: Float[np.ndarray, " T"]
    states: Float[np.ndarray, "T n"]
    inputs: Float[np.ndarray, "S 2 0"]


def _quality(
    runs: Runs, solution: Found, field: Any, states, sigma, is_noise_known: bool
) -> FitQuality:
    times, measured = runs.host_arrays()
    every = np.concatenate(states)
    scale = np.where((size := every.std(axis=0)) > 0, size, 1.0)
    slopes = [np.gradient(x, t, axis=0) for t, x in zip(times, states, strict=True)]
    speed = np.sqrt(np.mean(np.concatenate(slopes) ** 2, axis=0))
    spacing = np.median(np.concatenate([np.diff(t) for t in times]))
    swing = 2 * np.pi * np.median(scale / np.maximum(speed, np.finfo(float).tiny)) / spacing
    logs = [_Log(t, x, np.zeros((len(t) - 1, 2, 0))) for t, x in zip(times, measured, strict=True)]
    part = stretches(logs, states, int(np.clip(2 * swing, 4, 64)))
    part = Stretches(*(item[:: max(len(part.starts) // 8, 1)] for item in part))
    free = solution.count - solution.used
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


@precise_jit
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
