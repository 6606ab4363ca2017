"""What can be measured of a field and its potential: velocities, energies, equilibria, integrals.

Every kind is values of linear functionals, and any of them can be added:

    data = hk.Velocities(X, Y) + hk.Energies(Z, E) + hk.Equilibria(X0)
    field = hk.fit(K, data, regularization=1e-4)

The noise is relative: a row of noise s has the variance s² Nλ, with N the number of all
observations: points of velocities and equilibria, energies and functionals.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Num

from hamkernel import _require as require
from hamkernel._observations.blocks import AbstractBlock, Combinations, Components, Values, merged
from hamkernel._observations.rows import Rows
from hamkernel._show import described, joined


class AbstractObservations(eqx.Module):
    """Measured values of linear functionals of a field; those of two add up."""

    def __repr__(self) -> str:
        return described(self)

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""

    @abc.abstractmethod
    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        """The rows of one kind after the other, and what was measured, in the units it has."""

    def __add__(self, other: Any) -> AbstractObservations:
        if not isinstance(other, AbstractObservations):
            return NotImplemented
        return Together(_terms(self) + _terms(other))

    def __radd__(self, other: Any) -> AbstractObservations:
        return self if isinstance(other, int) and other == 0 else NotImplemented


class Together(AbstractObservations):
    """Observations of several kinds or places; made by `a + b`."""

    terms: tuple[AbstractObservations, ...]

    def __check_init__(self):
        dimensions = [term.dimension for term in self.terms]
        if len(set(dimensions)) > 1:
            raise ValueError(
                f"the observations in a sum are of states of {dimensions} coordinates: all must be "
                "of one system, with the same n."
            )

    def __repr__(self) -> str:
        return joined("+", [repr(term) for term in self.terms])

    @property
    def dimension(self) -> int:
        return self.terms[0].dimension

    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        for term in self.terms:
            yield from term.parts()


def _terms(data: AbstractObservations) -> tuple[AbstractObservations, ...]:
    return data.terms if isinstance(data, Together) else (data,)


class Velocities(AbstractObservations):
    """Velocities yᵢ = f(xᵢ) + noise: the data of `fit(K, X, Y)`.

    Args:
        X: states, shape (N, n).
        Y: velocities, shape (N, n), in units of X per unit of time. NaN is a component that was
            not measured; it takes no row.
        noise: relative standard deviations, positive: one number, one for each coordinate, shape
            (n,), or one for each component, shape (N, n); 1 if None. Those of components that
            were not measured have no effect.

    Raises:
        ValueError: shapes do not fit, no component was measured, X or a noise is not finite, or a
            noise is not positive. TypeError: the data is complex or in half precision.
    """

    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    noise: Float[Array, "..."] | None
    kept: Int[Array, " D"] | None  # the components that were measured, None if all were

    def __init__(
        self,
        X: Num[ArrayLike, "N n"],
        Y: Num[ArrayLike, "N n"],
        noise: ArrayLike | None = None,
    ):
        self.X, self.Y, kept = require.measured(X, Y)
        self.kept = None if kept is None else jnp.asarray(kept)
        N, n = self.X.shape
        self.noise = _noise(noise, [(), (n,), (N, n)], "(), (n,) or (N, n)", self.X)

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        y, noise = self.Y.reshape(-1), self.noise
        if noise is not None:
            noise = noise.reshape((1,) * (2 - noise.ndim) + noise.shape)
            noise = jnp.broadcast_to(noise, self.X.shape).reshape(-1)
        if self.kept is not None:
            y, noise = y[self.kept], None if noise is None else noise[self.kept]
        yield Components(self.X, self.kept, noise), y


class Energies(AbstractObservations):
    """Values of the potential, Eᵢ = H(xᵢ) + c + noise, with one constant c that nobody knows.

    The constant is estimated with the field, as generalised least squares do. It is the same for
    all energies in a sum of observations, and takes one of the rows.

    Args:
        X: states, shape (N, n).
        E: energies there, shape (N,): of H for `Symplectic`, of the potential for `CurlFree`.
        noise: relative standard deviations, one number or shape (N,); 1 if None. A row has the
            variance noise² Nλ in the squared units of E, so it says how energies weigh against
            velocities.

    Raises:
        ValueError: shapes do not fit, a value is not finite, or a noise is not positive; from what
            takes the data, there is one energy alone. AttributeError, from there: the structure
            has no potential.
    """

    X: Float[Array, "N n"]
    E: Float[Array, " N"]
    noise: Float[Array, "..."] | None

    def __init__(
        self,
        X: Num[ArrayLike, "N n"],
        E: Num[ArrayLike, " N"],
        noise: ArrayLike | None = None,
    ):
        X, E = require.points(X, "X"), require.floating(E, "E")
        if E.shape != X.shape[:1]:
            raise ValueError(
                f"E has shape {E.shape}; one energy for each of the {len(X)} states in X is "
                f"needed, shape ({len(X)},)."
            )
        X, E = require.one_dtype(X, E)
        require.single_or_double(X.dtype, "X and E have")
        self.X, self.E = require.finite(X, "X"), require.finite(E, "E")
        self.noise = _noise(noise, [(), E.shape], "() or (N,)", self.X)

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        noise = None if self.noise is None else jnp.broadcast_to(self.noise, self.E.shape)
        yield Values(self.X, noise), self.E


class Equilibria(AbstractObservations):
    """States where nothing moves, f(xᵢ) = 0, with the noise of a velocity.

    Args:
        X: states, shape (N, n), or one of shape (n,).

    Raises:
        ValueError: the shape does not fit, or a state is not finite.
    """

    X: Float[Array, "N n"]

    def __init__(self, X: Num[ArrayLike, "N n"] | Num[ArrayLike, " n"]):
        X = require.floating(X, "X")
        self.X = require.finite(require.points(X[None] if X.ndim == 1 else X, "X"), "X")
        require.single_or_double(self.X.dtype, "X has")

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        yield Components(self.X), jnp.zeros(self.X.size, self.X.dtype)


class Functionals(AbstractObservations):
    """Σ_q weights[r, q] · f(points[r, q]) = targets[r] + noise: increments, integrals, averages.

    An increment x(t₁) − x(t₀) in coordinate a is the integral of f_a along the path: Q nodes of a
    quadrature rule in time, weights[r, q] = w_q e_a. A row of relative noise s is given as
    weights/s and targets/s. Rows of fewer points than Q are padded with any finite points of
    weight zero.

    Rows that share their points may say so, and then cost less: `points` (S, Q, n), `weights`
    (S, R, Q, n) and `targets` (S, R) are R rows for each of S groups of points,
    Σ_q weights[s, r, q] · f(points[s, q]) = targets[s, r].

    Args:
        points: shape (R, Q, n): the Q points of each of R rows.
        weights: shape (R, Q, n): a vector for each of them, which multiplies f there.
        targets: shape (R,).

    Raises:
        ValueError: shapes do not fit, a value is not finite, or a row has weights that are all
            zero.
    """

    points: Float[Array, "S Q n"]
    weights: Float[Array, "S R Q n"]
    targets: Float[Array, " D"]

    def __init__(
        self,
        points: Num[ArrayLike, "S Q n"],
        weights: Num[ArrayLike, "S Q n"] | Num[ArrayLike, "S R Q n"],
        targets: Num[ArrayLike, " S"] | Num[ArrayLike, "S R"],
    ):
        named = {"points": points, "weights": weights, "targets": targets}
        arrays = [require.floating(array, name) for name, array in named.items()]
        dtype = np.result_type(*[array.dtype for array in arrays])
        require.single_or_double(dtype, "points, weights and targets have")
        points, weights, targets = given = [array.astype(dtype) for array in arrays]
        if weights.ndim == 3:
            weights, targets = weights[:, None], targets[:, None]
        S, R, Q, n = weights.shape if weights.ndim == 4 else (0, 0, 0, 0)
        if points.shape != (S, Q, n) or targets.shape != (S, R) or weights.size == 0:
            raise ValueError(
                "points, weights and targets have shapes "
                + f"{', '.join(str(array.shape) for array in given)}; they must be (R, Q, n), "
                "(R, Q, n) and (R,): Q points and as many vectors for each of R rows. Pad shorter "
                "rows with weights of zero."
            )
        for name, array in zip(named, given, strict=True):
            require.finite(array, name)
        zero = (require.on_host(weights) == 0).all(axis=(2, 3)).reshape(-1)
        self.weights = require.value(
            weights,
            zero,
            lambda: (
                "a row of weights that are all zero says nothing of the field: leave it out"
                + (f", row {np.flatnonzero(zero)[0]}." if require.is_concrete(zero) else ".")
            ),
        )
        self.points, self.targets = points, targets.reshape(-1)

    @property
    def dimension(self) -> int:
        return self.points.shape[2]

    def parts(self) -> Iterator[tuple[AbstractBlock, Float[Array, " D"]]]:
        rows = Combinations(groups=self.points, weights=self.weights)  # pyright: ignore[reportCallIssue]
        yield rows, self.targets


def both(X: Any, Y: Any) -> tuple[Any, Any]:
    """States and velocities, if there are both."""
    if Y is None:
        raise TypeError(
            "with states X the velocities Y are needed, of the same shape (N, n); or observations "
            f"in the place of both, hk.Velocities(X, Y); got {type(X).__name__} and nothing."
        )
    return X, Y


def as_states(X: Any, Y: Any) -> tuple[Any, Any]:
    """X and Y of velocities that were all measured with one noise, for which less is to be done."""
    if isinstance(X, Velocities) and Y is None and X.kept is None and X.noise is None:
        return X.X, X.Y
    return X, Y


def observations(X: Any, Y: Any, part: bool = False) -> AbstractObservations:
    """`X` if it is observations, and then there is no Y; else the velocities Y at states X."""
    if not isinstance(X, AbstractObservations):
        return Velocities(*require.data(*both(X, Y), part=part))
    if Y is not None:
        raise TypeError(
            f"{type(X).__name__} is all of the data, and Y is not needed. Say the regularization "
            "by name: hk.fit(K, data, regularization=1e-4)."
        )
    return X


def rows_of_states(X: Float[Array, "N d"], Y: Float[Array, "N n"]) -> Rows:
    """Velocities, all measured with one noise; at points (x, u) of a field with inputs."""
    outputs = None if X.shape == Y.shape else Y.shape[1]
    return Rows((Components(X, outputs=outputs),), Y.reshape(-1))


def rows_of_data(data: AbstractObservations, beside: Rows | None = None) -> Rows:
    """The normal form of the observations; `beside` is that of others that were there before."""
    blocks, targets = zip(*data.parts(), strict=True)
    dtype = np.result_type(*[block.points.dtype for block in blocks])
    blocks = tuple(_cast(block, dtype) for block in blocks)
    pairs = zip(blocks, targets, strict=True)
    divided = jnp.concatenate([y.astype(dtype) / block.scale for block, y in pairs])
    rows = Rows(merged(blocks), divided)
    before = 0 if beside is None else len(beside.energies)
    if before + len(rows.energies) == 1:
        raise ValueError(
            "there is one energy, and energies are known up to a constant: two are needed to say "
            "something."
        )
    return rows


def _cast(block: AbstractBlock, dtype: Any) -> AbstractBlock:
    arrays, rest = eqx.partition(block, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda a: a.astype(dtype), arrays), rest)


def _noise(noise: Any, shapes: list[tuple[int, ...]], needed: str, X: Array) -> Array | None:
    """Relative standard deviations of one of these shapes, in the dtype of X."""
    if noise is None:
        return None
    array = require.floating(noise, "noise")
    if array.shape not in shapes:
        raise ValueError(
            f"noise has shape {array.shape}; relative standard deviations of shape {needed} are "
            f"needed, here {' or '.join(map(str, shapes))}."
        )
    cure = "It is a standard deviation; what was measured without noise has a small one, as 1e-3."
    return require.positive(array, "noise", cure).astype(X.dtype)
