"""Least squares in random Fourier features: any number of points, in memory that ignores it."""

import operator
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, Key

from hamkernel import _require as require
from hamkernel._features import AbstractFeatures, SumFeatures, features
from hamkernel._field import AbstractField
from hamkernel._gram import matrix_kernel
from hamkernel._solve import AbstractSolver
from hamkernel._streaming import LeastSquares, accumulate_data, ridge_regression, solve
from hamkernel._structured import AbstractMatrixKernel, Sum

_BATCH = 1024  # points evaluated at once: 8 MB of waves for 1000 features


class FeatureField(AbstractField):
    """f(x) = Σ_r w_r φ_r(x), φ_r random features with the structure of the kernel.

    The structure is exact: f = B∇u of the potential u(x) = Σ_r (α_r cos ω_r·x + β_r sin ω_r·x).
    Evaluating f or its potential costs O(r n), whatever the number of data.

    Attributes:
        kernel: K, which the features approximate.
        features: φ, with frequencies and amplitudes.
        weights: w, shape (r,).
        residual: yᵢ − f(xᵢ) at the training data, shape (N, n); of shape (0, n) after a fit to a
            stream, which is not kept.
        residual_norm: its norm over all the training data, shape ().
        norm: ‖w‖, the norm of f in the RKHS of the approximate kernel, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant in the potential, shape ().
    """

    kernel: AbstractMatrixKernel
    features: AbstractFeatures
    weights: Float[Array, " r"]
    residual: Float[Array, "N n"]
    residual_norm: Float[Array, ""]
    norm: Float[Array, ""]
    regularization: Float[Array, ""]
    offset: Float[Array, ""]

    @property
    def dimension(self) -> int:
        return self.residual.shape[1]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.features.field(self._state(x), self.weights)

    def evaluate(self, X: ArrayLike) -> Float[Array, "N n"]:
        """The velocities at many states, as `jax.vmap(field)(X)` but in O(N n + r) memory.

        Args:
            X: states, shape (N, n).

        Raises:
            ValueError: the shape does not fit.
        """
        X = require.points(X, "X").astype(self.weights.dtype)
        if X.shape[1] != self.dimension:
            raise ValueError(f"X has {X.shape[1]} coordinates and the field {self.dimension}.")
        return _evaluate(self, X)

    def unanchored_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        x = self._state(x)
        # The kernel knows whether its fields have a potential, and says why not.
        jax.eval_shape(self.kernel.potential, x, x[None], x[None])
        return self.features.potential(x, self.weights)

    def part(self, which: int | str) -> "FeatureField":
        """The field of one term of a sum of kernels, by position or name.

        The parts add up to the field; an anchor of the whole is not theirs. `residual` and the
        norms are those of the whole fit.

        Raises:
            KeyError: there is no such part (with the choices).
        """
        if isinstance(self.kernel, Sum) and isinstance(self.features, SumFeatures):
            term, names = self.kernel.part(which), self.kernel.names
            index = names.index(which) if which in names else operator.index(which)  # type: ignore[arg-type]
            index %= len(names)
            weights = self.weights[self.features.slice(index)]
            return eqx.tree_at(
                lambda f: (f.kernel, f.features, f.weights, f.offset),
                self,
                (term, self.features.terms[index], weights, jnp.zeros_like(self.offset)),
            )
        if which == 0:
            return self
        raise KeyError(f"no part {which!r}: {type(self.kernel).__name__} is not a sum.")


@eqx.filter_jit
def _evaluate(field, X):
    return jax.lax.map(lambda x: field(x), X, batch_size=_BATCH)


class RandomFeatures(AbstractSolver):
    """Ridge regression in random Fourier features: O(N n r²) time, O(r²) memory beside the data.

    Solves for the weights of r features by QR, tile by tile, never through the normal equations.
    The structure of the field is exact for every count; the kernel is approximate, with an error
    that falls as count^(−1/2), and faster than that for fields that the features can represent.
    For shift-invariant kernels: Gaussian, Matern, RationalQuadratic and Periodic, their sums,
    products, multiples and Select, in every structure and parity.

    How to choose: from 500 frequencies in the plane; more for short lengthscales and rough kernels
    (a field of Matern(1.5) has frequencies of infinite fourth moment, and converges slowly). Where
    N n is a few thousands `Cholesky()` is exact and as fast; `Nystrom()` needs fewer columns for
    the same accuracy, and places them on the data.

    Args:
        count: frequencies for each term of each scalar kernel. Each has a cosine and a sine, of an
            odd or even kernel only one of them; a divergence-free field has a set for each of the
            n(n − 1)/2 planes, a separable one for each component.
        key: the random key, `jax.random.key(0)`. The same key draws the same features.

    Raises:
        ValueError: count is not positive. TypeError: count is no integer, or key is no key.

    Source: Rahimi & Recht (2007).
    """

    count: int = eqx.field(static=True)
    key: Key[Array, ""]

    def __init__(self, count: int, key: Any):
        if isinstance(count, bool) or not hasattr(count, "__index__"):
            raise TypeError(f"RandomFeatures needs an integer count, got {count!r}.")
        if operator.index(count) < 1:
            raise ValueError(f"RandomFeatures needs count >= 1, got {count}.")
        dtype = getattr(key, "dtype", None)
        if dtype == jnp.uint32:  # a key of the older kind, jax.random.PRNGKey
            key = jax.random.wrap_key_data(key)
        elif dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
            raise TypeError(f"RandomFeatures needs a key, jax.random.key(0); got {key!r}.")
        self.count = operator.index(count)
        self.key = key

    def fit(
        self,
        K: AbstractMatrixKernel,
        X: Float[Array, "N n"],
        Y: Float[Array, "N n"],
        regularization: Float[Array, ""],
    ) -> FeatureField:
        return _fit(K, self, X, Y, regularization)

    def start(self, K: AbstractMatrixKernel, n: int, dtype: Any = float) -> "FeatureFit":
        """A fit without data yet, to which chunks are added: see `FeatureFit`.

        Args:
            K: a matrix-valued kernel.
            n: the number of coordinates of a state.
            dtype: float32 or float64; the default float if not given.

        Raises:
            TypeError: a kernel without a known spectral density. ValueError: n is not allowed by
                the structure.
        """
        K = matrix_kernel(K)
        K.check_dimension(n)
        basis = features(K, n, self.count, self.key, jnp.zeros((), dtype).dtype)
        state = LeastSquares.empty(basis.columns, jnp.zeros((), dtype).dtype)
        return FeatureFit(K, basis, state, jnp.zeros((), int), n)

    def fit_chunks(
        self,
        K: AbstractMatrixKernel,
        chunks: Iterable[tuple[ArrayLike, ArrayLike]],
        regularization: ArrayLike = 1e-4,
        progress: bool = False,
    ) -> FeatureField:
        """`hk.fit` to data that comes in chunks, in one pass and with memory for one chunk.

        The field is that of one fit to all the data, to rounding. To add data later keep the
        `FeatureFit` of `start` instead.

        Args:
            K: a matrix-valued kernel.
            chunks: pairs (X, Y) of states and velocities, shape (Nᵢ, n) each: a generator, or
                slices of memory-mapped files. Every new Nᵢ compiles anew: equal ones are fast.
            regularization: λ > 0, as in `hk.fit`, with N the number of all points.
            progress: show a progress bar where the standard error is a terminal.

        Raises:
            ValueError: there is no chunk, or as `hk.fit` for one of them. TypeError: as `hk.fit`.
        """
        from tqdm import tqdm  # so that importing the package does not load it

        model = None
        for X, Y in tqdm(chunks, "chunks", disable=None if progress else True):
            X, Y = require.data(X, Y)
            model = self.start(K, X.shape[1], X.dtype) if model is None else model
            model = model.add(X, Y)
        if model is None:
            raise ValueError("fit_chunks needs at least one chunk (X, Y); the iterator was empty.")
        return model.field(regularization)


@eqx.filter_jit
def _fit(K, solver, X, Y, regularization):
    basis = features(K, X.shape[1], solver.count, solver.key, X.dtype)
    ridge = len(X) * regularization
    weights, residual, _ = ridge_regression(basis, basis.columns, X, Y, ridge)
    return _field(K, basis, weights, residual, jnp.linalg.norm(residual), regularization)


def _field(K, basis, weights, residual, residual_norm, regularization):
    return FeatureField(
        kernel=K,
        features=basis,
        weights=weights,
        residual=residual,
        residual_norm=residual_norm,
        norm=jnp.linalg.norm(weights),
        regularization=regularization,
        offset=jnp.zeros((), weights.dtype),
    )


class FeatureFit(eqx.Module):
    """A fit in random features to the data added so far, made by `RandomFeatures.start`.

    It has a fixed size, (r + 1)² numbers. `add` returns a new one, and `field` solves for any λ:

        model = hk.RandomFeatures(500, key).start(K, n=2).add(X, Y)
        field = model.field(1e-4)
        better = model.add(X_new, Y_new).field(1e-4)

    Attributes:
        kernel: K.
        features: the features of K.
        state: the triangular factor of all rows.
        count: N, the number of points added, shape ().
        dimension: n, the number of coordinates of a state.
    """

    kernel: AbstractMatrixKernel
    features: AbstractFeatures
    state: LeastSquares
    count: Int[Array, ""]
    dimension: int = eqx.field(static=True)

    def add(self, X: ArrayLike, Y: ArrayLike) -> "FeatureFit":
        """The fit with more data.

        Args:
            X: states, shape (N, n).
            Y: measured velocities, shape (N, n).

        Raises:
            ValueError: a shape does not fit, or the data is not finite. TypeError: its dtype.
        """
        X, Y = require.data(X, Y)
        if X.shape[1] != self.dimension:
            raise ValueError(
                f"the chunk has {X.shape[1]} coordinates and the fit {self.dimension}."
            )
        dtype = self.state.factor.dtype
        return _added(self, X.astype(dtype), Y.astype(dtype))

    def field(self, regularization: ArrayLike = 1e-4) -> FeatureField:
        """The field learned from all data added so far; O(r³), and no pass over the data.

        Args:
            regularization: λ > 0, as in `hk.fit`.

        Raises:
            ValueError: λ is not positive, or no data was added.
        """
        dtype = self.state.factor.dtype
        regularization = require.positive_scalar(regularization, "regularization").astype(dtype)
        count = require.value(
            self.count, self.count == 0, "no data yet: add(X, Y) before asking for the field."
        )
        return _solved(self, count, regularization)


@eqx.filter_jit
def _added(fit, X, Y):
    state = accumulate_data(fit.state, fit.features, X, Y)
    return eqx.tree_at(lambda f: (f.state, f.count), fit, (state, fit.count + len(X)))


@eqx.filter_jit
def _solved(fit, count, regularization):
    weights, residual_norm = solve(fit.state, count.astype(regularization.dtype) * regularization)
    unseen = jnp.zeros((0, fit.dimension), weights.dtype)
    return _field(fit.kernel, fit.features, weights, unseen, residual_norm, regularization)
