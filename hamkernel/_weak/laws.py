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
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, features, part_terms
from hamkernel._fields.kinetic import Kinetic, kinetic_of_velocities
from hamkernel._kernels.base import AbstractScalarKernel, ScalarSum
from hamkernel._kernels.built_in import Constant, Matern
from hamkernel._kernels.parts import Laws, Shared, alike
from hamkernel._learned.diagnostics import FitQuality, diagnostics_of_rows
from hamkernel._learned.free_run import Stretches, relative_error, stretches
from hamkernel._learned.result import AbstractEvidence, Iteration, Learned, misfits
from hamkernel._learned.whiteness import Whiteness
from hamkernel._machine import compiled_by_size, compiled_without_emitters, precise_jit
from hamkernel._observations.kinds import Functionals
from hamkernel._posterior import condition
from hamkernel._runs.runs import Runs
from hamkernel._solvers.lagrangian import ridge_solution
from hamkernel._solvers.triangle import append_rows, columns_used, regression_loss
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.completed import complete, has_constant_parts
from hamkernel._structures.joined import Controlled, InputMatrix
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import AbstractPotentialKernel
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

# In lengthscales. With windows of 1.0 a run of six particles on springs, of four lengthscales, has
# only 72 rows for 64 unknowns.
_WIDTH = 0.5
# Of BFGS. The masses of five particles, two draws, were off by up to .77 after 40, and by .02 here.
_STEPS = 300
# a and b of x + Σ bᵢ h kᵢ, kᵢ = f(x + aᵢ h kᵢ₋₁), the classical method of fourth order.
_RUNGE_KUTTA = np.array([0, 0.5, 0.5, 1]), np.array([1, 2, 2, 1]) / 6
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

    With inputs u, points of the path are (z, u) and points of the field are (x, u).

    Attributes:
        mass: the mass of each position, shape (m,); None where z is x.
        dimension: the number n of coordinates of a state.
    """

    mass: Float[Array, " m"] | None
    dimension: int = eqx.field(static=True)

    def __call__(self, z: Float[Array, " z"]) -> Float[Array, " d"]:
        if self.mass is None:
            return z
        ones = jnp.ones_like(self.mass)
        return z * jnp.concatenate([ones, self.mass, jnp.ones(len(z) - self.dimension)])


def _channels(runs: Runs, mean: Any, noise: Any, is_canonical: bool) -> tuple[Channels, States]:
    """The channels: q with p/m as its slope where masses are known, else all coordinates."""
    X, n = runs.host_arrays()[1], runs.dimension
    m = n // 2
    if isinstance(mean, Kinetic) and mean.mass.ndim < 2:
        mass = np.ones(m) if mean.is_of_velocities else np.asarray(mean.mass, float)
        mass = np.broadcast_to(mass, (m,))
        groups = [np.flatnonzero(mass == m_i) for m_i in np.unique(mass)]
        values, slopes = [x[:, :m] for x in X], [x[:, m:] / mass[None] for x in X]
        if noise is not None:
            noise = np.stack([noise[:m], noise[m:] / mass])
        state = States(jnp.asarray(mass), n)
    else:
        groups = [np.arange(m), np.arange(m, n)] if is_canonical else [np.arange(n)]
        values, slopes, state = X, [np.full(x.shape, np.nan) for x in X], States(None, n)
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


def interpolate_laws(K: AbstractMatrixKernel) -> Any:
    """K with laws that interpolate their values at the centres, whatever their kernels.

    A law w ~ GP(0, k) with values w(C) = L a, L Lᵀ = k(C, C), a ~ N(0, I), becomes
    b(·, C) b(C, C)⁻¹ L a for the basis b, a Matérn kernel as long as the range of the centres. With
    64 centres −log p of the rows of ten Lennard-Jones particles is off by .7 or less, for
    lengthscales from a quarter of the likeliest to the likeliest. With half, a quarter and an
    eighth of this length it is off by up to 1, 4 and 11. An unknown input matrix gets the prior
    variance 1.
    """

    def is_potential(node: Any) -> bool:
        return isinstance(node, AbstractPotentialKernel)

    def interpolate(node: Any) -> Any:
        if not is_potential(node):
            return node
        laws = [waves.kernel for waves in part_terms(node.kernel) if waves is not None]
        terms = map(_interpolant, laws)
        return eqx.tree_at(lambda node: node.kernel, node, ScalarSum(tuple(terms)))

    K = jax.tree.map(interpolate, K, is_leaf=is_potential)
    if _unknown_matrix(K) is not None:
        return eqx.tree_at(lambda K: K.inputs.kernel, K, Constant())
    return K


def _unknown_matrix(K: AbstractMatrixKernel) -> InputMatrix | None:
    """The prior of a constant input matrix; None if there is none, or the matrix is known."""
    return K.inputs if isinstance(K, Controlled) and K.known_matrix is None else None  # pyright: ignore


def _interpolant(law: Shared) -> Any:
    extent = np.ptp(np.asarray(law.centres), axis=0)
    kernel = Matern(2.5, np.where(extent > 0, extent, 1.0))
    return eqx.tree_at(lambda law: law.kernel, law, kernel)


def change_basis(F: Float[Array, "N r"], K: AbstractMatrixKernel, n: int) -> Float[Array, "N r"]:
    """The rows F T of K from the rows F of `interpolate_laws(K)`: T = L₀⁻¹L, L₀L₀ᵀ = b(C, C)."""
    basis: Any = _features_of(K, n)
    laws = basis.laws()
    shared = [waves.kernel for waves, _ in laws]
    terms = [Shared(law.kernel, law.parts, np.asarray(law.centres)) for law in shared]
    for at in alike(terms):
        group = tuple(terms[at])
        roots = (Laws(k).roots(F.dtype) for k in (tuple(map(_interpolant, group)), group))
        T = jax.lax.map(lambda both: solve_triangular(*both, lower=True), tuple(roots))
        T = T * jnp.sqrt(jnp.stack([waves.scale for waves, _ in laws[at]]))[:, None, None]
        columns = np.array([np.arange(place.start, place.stop) for _, place in laws[at]])
        F = F.at[:, columns].set(jnp.einsum("nlm,lmk->nlk", F[:, columns], T))
    if (G := _unknown_matrix(K)) is not None:
        F = F.at[:, basis.drift.columns :].multiply(jnp.sqrt(G.kernel(jnp.zeros(n), jnp.zeros(n))))
    return F


def has_fixed_basis(K: AbstractMatrixKernel) -> bool:
    """Whether all hyperparameters of K are of the kernels of its laws and of input matrices."""
    K = K.state_kernel
    outer = jax.tree.map(
        lambda node: None if isinstance(node, AbstractScalarKernel) else node,
        K,
        is_leaf=lambda node: isinstance(node, AbstractScalarKernel),
    )
    return has_constant_parts(K) and not any(map(eqx.is_inexact_array, jax.tree.leaves(outer)))


def _features_of(K: AbstractMatrixKernel, n: int) -> AbstractFeatures:
    return features(K, n, 1, jax.random.key(0), jnp.float64)


class Rows(NamedTuple):
    """The weak rows of laws.

    Attributes:
        pieces: the smoothed runs.
        state: the map from the channels to states.
        mean: the known part of the field, a function of its points.
        of_rows: the coordinates that have rows.
    """

    pieces: Pieces
    state: States
    mean: Any
    of_rows: Int[np.ndarray, " m"]

    @property
    def count(self) -> Int[Array, ""]:
        """How many rows there are in windows inside of the runs."""
        return jnp.sum(jnp.asarray(self.pieces.inside)) * len(self.of_rows)

    @property
    def dimension(self) -> int:
        """The number d of coordinates of the points of the field, inputs included."""
        return self.pieces.path.shape[2]

    def law(self, field: Any) -> Any:
        """d/dt x − field(x) − mean(x) = 0 as `weak_rows` takes it."""

        def law(z):
            s = self.state(z)
            x = s[: self.state.dimension]
            drift = sum((f(s) for f in (field, self.mean) if f is not None), jnp.zeros_like(x))
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


@compiled_by_size
def _known(rows: Rows) -> Float[Array, "B W m"]:
    return rows.known()


@precise_jit
def _basis_rows(rows: Rows, K: AbstractMatrixKernel) -> Float[Array, "B W m r"]:
    return rows.feature_rows(interpolate_laws(K))


class Design(eqx.Module):
    """The rows of a kernel over their noise, as a function of its hyperparameters.

    If all hyperparameters are of the kernels of laws, only T of `change_basis` depends on them. The
    triangle of the rows in the basis and of their targets then has all that a likelihood needs.

    Attributes:
        triangle: the triangle, shape (r + 1, r + 1); None if other hyperparameters change the rows.
        rows: the rows, and the factors of their covariance; None if there is a triangle.
        count: the number of rows.
        dimension: the number of coordinates of a point of the field, inputs included.
    """

    triangle: Float[Array, "k k"] | None
    rows: tuple[Rows, Float[Array, "B R R"]] | None
    count: Int[Array, ""]
    dimension: int = eqx.field(static=True)

    def __call__(self, K: AbstractMatrixKernel) -> tuple[Float[Array, "N r"], Float[Array, " N"]]:
        """The features of the kernel, and what the mean leaves."""
        if self.rows is not None:
            rows, L = self.rows
            F, y = whiten(L, rows.feature_rows(interpolate_laws(K))), whiten(L, rows.known())
        else:
            assert self.triangle is not None
            F, y = self.triangle[:, :-1], self.triangle[:, -1]
        return change_basis(F, K, self.dimension), y


@compiled_by_size
def _triangle(rows: Rows, L, F: Float[Array, "B W m r"]) -> Float[Array, "k k"]:
    columns = F.shape[-1]
    none = jnp.zeros((columns + 1, columns + 1), F.dtype)
    return append_rows(none, whiten(L, F), whiten(L, rows.known()))


@compiled_by_size
def _search(model: LawModel, design: Design, starts, low, high):
    def loss(h):
        shown = model.with_flat(h)
        precision = jnp.exp(-shown.log_scatter)
        F, y = design(shown.kernel)
        scatter = design.count.astype(low.dtype) * shown.log_scatter
        return regression_loss(F * precision, y * precision) + scatter

    run = best_in_box(loss, starts, low, high, jnp.full_like(low, 0.2), _STEPS)
    return inside_box(run.best.u, low, high), run.best.value


@precise_jit
def _factors(rows: Rows, field: Any, deviation):
    """The factors of the covariance of the rows with this field in the laws."""
    return factors(rows.pieces, path_covariance(rows.law(field), rows.pieces), deviation)


@compiled_by_size
def _solve(model: LawModel, design: Design) -> tuple[Float[Array, " r"], Float[Array, ""]]:
    """The mean of the weights in the basis, and how many numbers the rows determine."""
    precision = jnp.exp(-model.log_scatter)
    R, weights = ridge_solution(*(a * precision for a in design(model.kernel)))
    to_basis = change_basis(jnp.eye(len(R), dtype=R.dtype), model.kernel, design.dimension)
    return to_basis @ weights, columns_used(R)


@compiled_by_size
def _compress(rows: Rows, L, F: Float[Array, "B W m r"]):
    """All rows as r orthonormal combinations: weights (r, Q, n) at points (Q, d), targets (r,)."""
    p, n = rows.pieces, rows.state.dimension
    Q, _ = jnp.linalg.qr(whiten(L, F))

    def back(both):
        L, Q = both
        combined = jax.scipy.linalg.solve_triangular(L, Q, lower=True, trans="T")
        combined = combined.reshape(len(p.values), -1, Q.shape[1])
        on_rows = jnp.einsum("wp,wcm->mpc", p.values, combined)
        return jnp.zeros((*on_rows.shape[:2], n)).at[:, :, rows.of_rows].set(on_rows)

    weights = jax.lax.map(back, (L, Q.reshape(*L.shape[:2], -1)))  # (B, m, P, n)
    points = jax.vmap(rows.state)(jnp.asarray(p.path).reshape(-1, p.path.shape[2]))
    targets = Q.T @ whiten(L, rows._replace(mean=None).known())
    return points, jnp.moveaxis(weights, 1, 0).reshape(Q.shape[1], -1, n), targets


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


def find_laws(
    K: AbstractMatrixKernel, runs: Runs, mean: Any, known_field: Any, noise: Any
) -> Found:
    """The laws by two solves; `known_field` is `mean` plus G u of a known input matrix G."""
    n, d = runs.dimension, runs.dimension + runs.input_count
    channels, state = _channels(runs, mean, noise, K.has_hamiltonian)
    smooth = smoothed_pieces(runs, channels)
    pieces = smooth.pieces
    pieces = pieces._replace(path=np.concatenate([pieces.path, pieces.inputs], axis=2))
    unit = np.ones(n) if state.mass is None else np.append(np.ones(n // 2), state.mass)
    states, sigma = [x[:, :n] * unit[None] for x in smooth.states], smooth.noise.ravel()[:n] * unit
    K = complete(K, jnp.asarray(np.concatenate(states)), n)
    depends = sorted(set().union(*(s for k in K.scalar_kernels for s in k.supports(n))))
    if state.mass is not None and depends[-1] >= n // 2:
        raise ValueError(
            f"the laws depend on coordinate {max(depends[0], n // 2)}, which is a momentum in runs "
            f"of {n} coordinates (q, p). If all of them are positions, give a mass for each: "
            f"mass=np.ones({n})."
        )
    points = np.asarray(jax.vmap(state)(jnp.asarray(pieces.states())))
    # Inputs of one: a coordinate that inputs alone move has rows too.
    of_rows = _moving_coordinates(K, np.append(points[:, :n], np.ones((len(points), d - n)), 1))
    rows = Rows(pieces, state, known_field, of_rows)
    model = LawModel(K, jnp.asarray(np.log(2.0)))
    low, high, starts, error = _box(model, points, rows)
    deviation = jnp.full(len(of_rows), _EXACT * error)
    fixed = _basis_rows(rows, K) if has_fixed_basis(K) else None
    L, losses = _factors(rows, None, deviation), []
    for is_last in (False, True):
        triangle = None if fixed is None else _triangle(rows, L, fixed)
        design = Design(triangle, (rows, L) if fixed is None else None, rows.count, d)
        h, loss = _search(model, design, starts, low, high)
        model, starts = model.with_flat(h), starts.at[0].set(h)
        losses.append(float(loss))
        weights, used = _solve(model, design)
        if not is_last:
            basis = _features_of(interpolate_laws(model.kernel), d)
            L = _factors(rows, _FieldOfWeights(basis, weights), deviation)
    F = _basis_rows(rows, model.kernel) if fixed is None else fixed
    points, weights, targets = _compress(rows, L, F)
    inputs = points[None, :, n:] if d > n else None
    observations = Functionals(points[None, :, :n], weights[None], targets[None], inputs=inputs)
    count = int(rows.count)
    return Found(model, observations, states, sigma, (losses[0], losses[1]), count, float(used))


class _FieldOfWeights(eqx.Module):
    features: AbstractFeatures
    weights: Float[Array, " m"]

    def __call__(self, x):
        return self.features.field(x, self.weights)


def _moving_coordinates(K: AbstractMatrixKernel, X: Float[np.ndarray, "N n"]) -> np.ndarray:
    """The coordinates whose velocities the laws change."""
    some = jnp.asarray(X[np.linspace(0, len(X) - 1, min(len(X), 4)).astype(int)])
    return np.flatnonzero(np.asarray(_largest_features(K, some)) > 0)


@compiled_by_size
def _largest_features(K: AbstractMatrixKernel, X: Float[Array, "N d"]) -> Float[Array, " n"]:
    return jnp.abs(_features_of(K, X.shape[1])(X)).max(axis=(0, 2))


def _box(model: LawModel, X, rows: Rows):
    """The box of hyperparameters, a design of first points, and the size of white forces.

    With an error of a force of this size at each sample rows are as wrong as they are large.
    """
    pieces = rows.pieces
    y = np.asarray(_known(rows._replace(mean=None)))[pieces.inside]
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


def learn_laws(
    K: AbstractMatrixKernel,
    runs: Runs,
    mean: Any,
    known_field: Any,
    noise: Float[np.ndarray, " n"] | None,
    again: Callable[..., Learned],
) -> Learned:
    """`learn` for laws that many parts share; see there."""
    n = runs.dimension
    solution = find_laws(K, runs, mean, known_field, noise)
    scatter, count = float(jnp.exp(solution.model.log_scatter)), len(solution.observations.targets)
    inner = solution.model.kernel.state_kernel
    if isinstance(inner, UnknownMasses) and isinstance(mean, Kinetic):
        mean = kinetic_of_velocities(inner.masses)
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
    inputs: Float[np.ndarray, "S 2 m"]


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
    pairs = enumerate(zip(times, measured, strict=True))
    logs = [_Log(t, x, runs.input_lines(r, t)) for r, (t, x) in pairs]
    part = stretches(logs, states, int(np.clip(2 * swing, 4, 64)))
    part = Stretches(*(item[:: max(len(part.starts) // 8, 1)] for item in part))
    free, joint = solution.count - solution.used, getattr(field, "whole", field)  # of points (x, u)
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
        driven=runs.inputs is not None,
        free_run=relative_error(np.asarray(_run_freely(joint, part)), part, scale),
    )


@compiled_without_emitters
def _run_freely(field: Any, part: Stretches) -> Float[Array, "S L n"]:
    """The states at the ends of all intervals, by four steps of Runge and Kutta in each."""

    def one(x, spans, inputs):
        def across(x, both):
            span, (first, last) = both
            h = span / 4

            def step(x, i):
                def stage(state, shares):  # k₁, k₂, k₃ and k₄ in turn
                    x, k, total = state
                    u = first + (i + shares[0]) / 4 * (last - first)
                    k = field(jnp.append(x + h * shares[0] * k, u))
                    return (x, k, total + h * shares[1] * k), None

                (_, _, x), _ = jax.lax.scan(stage, (x, jnp.zeros_like(x), x), _RUNGE_KUTTA)
                return x, None

            x, _ = jax.lax.scan(step, x, jnp.arange(4.0))
            return x, jnp.where(jnp.isfinite(x), x, jnp.inf)

        return jax.lax.scan(across, x, (spans, inputs))[1]

    stretches = jnp.asarray(part.starts), jnp.asarray(part.spans), jnp.asarray(part.inputs)
    return jax.lax.map(lambda stretch: one(*stretch), stretches)
