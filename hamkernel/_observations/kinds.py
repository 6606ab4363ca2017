"""Observations of a field and its potential: velocities, energies, equilibria, integrals.

All are values of linear functionals of (u, f), and all kinds can be added:

    data = hk.Velocities(X, Y) + hk.Energies(Z, E) + hk.Equilibria(X0)
    field = hk.fit(K, data, regularization=1e-4)

The noise is relative: a row of relative noise s has the variance s² Nλ, where N counts all
observations: points of velocities and equilibria, energies and functionals.

A field with inputs is observed at points (x, u). Every kind except `Energies`, which belong to the
drift, holds the inputs u of its points, or the parameters of a family.
"""

from __future__ import annotations

import abc
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Num

from hamkernel import _require as require
from hamkernel._observations.blocks import AbstractBlock, Combinations, Components, Values
from hamkernel._show import describe, join_terms, shorten

# Blocks of rows, each with its measured values.
Parts = Iterator[tuple[AbstractBlock, Float[Array, " D"]]]


class AbstractObservations(eqx.Module):
    """Measured values of linear functionals of a field; a + b are the observations of both."""

    def __repr__(self) -> str:
        return describe(self)

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""

    def all_inputs(self) -> Iterator[Float[Array, "*points m"]]:
        """The inputs of each kind of observation with inputs."""
        inputs = getattr(self, "inputs", None)  # energies have none
        if inputs is not None:
            yield inputs

    @abc.abstractmethod
    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        """The blocks of rows, one for each kind, with their measured values.

        Args:
            count: m, the number of inputs of the kernel. If m > 0 the points are (x, u).
            input_name: "inputs", or "parameters" for a family: the name of u in errors.

        Raises:
            ValueError: u is missing, or there are energies of a family.
        """

    def __add__(self, other: Any) -> AbstractObservations:
        if not isinstance(other, AbstractObservations):
            raise TypeError(_addition_error(self, other))
        return Together(_summands(self) + _summands(other))

    def __radd__(self, other: Any) -> AbstractObservations:
        if isinstance(other, int) and other == 0:  # so that sum(data) works
            return self
        raise TypeError(_addition_error(self, other))

    __array_ufunc__ = None  # so that NumPy leaves array + observations to __radd__


def _addition_error(data: AbstractObservations, operand: Any) -> str:
    return (
        f"{type(data).__name__} was added to {type(operand).__name__}: only observations add up. "
        "Give an array its meaning first, for example hk.Velocities(X, Y) + hk.Energies(Z, E)."
    )


class Together(AbstractObservations):
    """The sum a + b of observations, of several kinds or of several places."""

    terms: tuple[AbstractObservations, ...]

    def __check_init__(self):
        dimensions = [term.dimension for term in self.terms]
        if len(set(dimensions)) > 1:
            raise ValueError(
                f"the observations in a sum have states of {dimensions} coordinates: all must "
                "belong to one system, with the same n."
            )

    def __repr__(self) -> str:
        return join_terms("+", shorten([repr(term) for term in self.terms]))

    @property
    def dimension(self) -> int:
        return self.terms[0].dimension

    def all_inputs(self) -> Iterator[Float[Array, "*points m"]]:
        for term in self.terms:
            yield from term.all_inputs()

    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        for term in self.terms:
            yield from term.parts(count, input_name)


def _summands(data: AbstractObservations) -> tuple[AbstractObservations, ...]:
    return data.terms if isinstance(data, Together) else (data,)


def refuse_swapped(X: Any, Y: Any, inputs: Any) -> None:
    """ValueError if X and inputs seem to be swapped."""
    if inputs is not None and np.shape(X) != np.shape(Y) == np.shape(inputs):
        raise ValueError(
            f"X has shape {np.shape(X)}, inputs {np.shape(inputs)} and Y {np.shape(Y)}: X and "
            "the inputs seem to be swapped, hk.fit(K, X, Y, inputs=U)."
        )


def inputs_or_parameters(inputs: Any, parameters: Any, K: Any = None) -> Any:
    """The caller's inputs or parameters; None without both.

    Raises:
        TypeError: the caller gives both, or inputs where K takes parameters, or the reverse.
    """
    if inputs is not None and parameters is not None:
        raise TypeError(
            "inputs and parameters were both given, and one is needed: a Controlled kernel takes "
            "inputs, which act linearly; a Family takes parameters, on which its members depend "
            "in any way. For a family with inputs, pass the inputs as further parameters."
        )
    name = K.input_name if K is not None and K.takes_inputs else None
    passed = "inputs" if inputs is not None else "parameters" if parameters is not None else name
    if name is not None and passed != name:
        raise TypeError(f"{type(K).__name__} takes {name}, and {passed} were given: {name}=….")
    return parameters if inputs is None else inputs


def inputs_at(
    X: Float[Array, "*points n"], inputs: Any, parameters: Any = None
) -> Float[Array, "*points m"] | None:
    """The inputs or parameters of every state, finite and in the dtype of X; None if not given.

    Raises:
        TypeError: both are given. ValueError: the shape does not fit, or a value is not finite.
    """
    name, letter = ("inputs", "U") if parameters is None else ("parameters", "Θ")
    values = inputs_or_parameters(inputs, parameters)
    if values is None:
        return None
    U = require.floating(values, name)
    U = U[..., None] if U.shape == X.shape[:-1] != () else U  # one for each state
    if U.ndim != X.ndim or U.shape[:-1] != X.shape[:-1] or U.shape[-1] == 0:
        hint = ""
        if U.ndim == X.ndim == 2 and U.shape[1] == len(X):
            hint = f" They seem to be transposed: {letter}.T."
        elif U.ndim == 1:
            hint = f" If all states have the same: np.tile({letter}, ({len(X)}, 1))."
        raise ValueError(
            f"{name} has shape {U.shape}; one row of {name} for each of the states is needed, "
            f"which have shape {X.shape}.{hint}"
        )
    return require.finite(U.astype(X.dtype), name)


def joined_points(
    data: Any, X: Float[Array, "*points n"], count: int, input_name: str
) -> tuple[Float[Array, "*points d"], int | None]:
    """The points (x, u) and the dimension n of x; X and None for a kernel of states alone."""
    if not count:
        return X, None
    if data.inputs is None:
        name = "Controlled" if input_name == "inputs" else "Family"
        raise ValueError(
            f"the {input_name} of {type(data).__name__} are missing: a {name} kernel needs "
            f"{input_name}=…, one row of shape (m,) for each state."
        )
    return jnp.concatenate([X, data.inputs], axis=-1), X.shape[-1]


class Velocities(AbstractObservations):
    """Velocities yᵢ = f(xᵢ) + noise: the data of `fit(K, X, Y)`.

    Args:
        X: states, shape (N, n).
        Y: velocities, shape (N, n), in units of X per unit of time. NaN marks a component that was
            not measured; it adds no row.
        noise: relative standard deviations, positive: one number, one for each coordinate, shape
            (n,), or one for each component, shape (N, n); 1 if None. A row of relative noise s has
            the variance s² Nλ. The noise of unmeasured components has no effect.
        inputs: u at each state, shape (N, m), for a `Controlled` kernel.
        parameters: θ at each state, shape (N, p), for a `Family`.

    Raises:
        ValueError: shapes do not fit, no component was measured, X or a noise is not finite, or a
            noise is not positive. TypeError: the data are complex or in half precision.
    """

    X: Float[Array, "N n"]
    Y: Float[Array, "N n"]
    noise: Float[Array, "..."] | None
    kept: Int[Array, " D"] | None  # indices of the measured components; None if all were
    inputs: Float[Array, "N m"] | None

    def __init__(
        self,
        X: Num[ArrayLike, "N n"],
        Y: Num[ArrayLike, "N n"],
        noise: ArrayLike | None = None,
        inputs: Num[ArrayLike, "N m"] | None = None,
        parameters: Num[ArrayLike, "N p"] | None = None,
    ):
        refuse_swapped(X, Y, inputs)
        self.X, self.Y, kept = require.velocity_data(X, Y)
        self.inputs = inputs_at(self.X, inputs, parameters)
        self.kept = None if kept is None else jnp.asarray(kept)
        N, n = self.X.shape
        self.noise = _noise(noise, [(), (n,), (N, n)], self.X)

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        y, noise = self.Y.reshape(-1), self.noise
        if noise is not None:
            noise = noise.reshape((1,) * (2 - noise.ndim) + noise.shape)
            noise = jnp.broadcast_to(noise, self.X.shape).reshape(-1)
        if self.kept is not None:
            y, noise = y[self.kept], None if noise is None else noise[self.kept]
        points, outputs = joined_points(self, self.X, count, input_name)
        yield Components(points, self.kept, noise, outputs), y


class Energies(AbstractObservations):
    """Values of the potential, Eᵢ = H(xᵢ) + c + noise, with one unknown constant c.

    A fit estimates the constant together with the field (generalised least squares). All energies
    in a sum of observations share the constant, which uses up one row. With a `Controlled` kernel H
    is the energy of the drift.

    Args:
        X: states, shape (N, n).
        E: energies there, shape (N,): of H for `Symplectic`, of the potential for `CurlFree`.
        noise: relative standard deviations, one number or shape (N,); 1 if None. An energy has the
            variance noise² Nλ, in squared units of E, so `noise` sets the weight of energies
            against velocities.

    Raises:
        ValueError: shapes do not fit, a value is not finite, or a noise is not positive. `fit` and
            the other functions of data raise ValueError for a single energy, and AttributeError if
            the structure has no potential.
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
        require.shape(E, "E has", "one energy for each state in X", X.shape[:1])
        X, E = require.one_dtype(X, E)
        require.single_or_double(X.dtype, "X and E have")
        self.X, self.E = require.finite(X, "X"), require.finite(E, "E")
        self.noise = _noise(noise, [(), E.shape], self.X)

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        noise = None if self.noise is None else jnp.broadcast_to(self.noise, self.E.shape)
        if input_name == "parameters":
            raise ValueError(
                "hk.Energies have one unknown constant, and each member of a family has another "
                "constant: learn a family from velocities, equilibria and functionals."
            )
        if not count:
            yield Values(self.X, noise), self.E
        else:
            u = jnp.zeros((len(self.X), count), self.X.dtype)
            yield Values(jnp.concatenate([self.X, u], axis=1), noise, self.dimension), self.E


class Equilibria(AbstractObservations):
    """States where nothing moves, f(xᵢ) = 0 or f(xᵢ, uᵢ) = 0, with the noise of a velocity.

    Args:
        X: states, shape (N, n), or one of shape (n,).
        inputs: the inputs that hold the states, for a `Controlled` kernel, shape (N, m) or (m,).
        parameters: θ at each state, for a `Family`, shape (N, p) or (p,).

    Raises:
        ValueError: a shape does not fit, or a value is not finite.
    """

    X: Float[Array, "N n"]
    inputs: Float[Array, "N m"] | None

    def __init__(
        self,
        X: Num[ArrayLike, "N n"] | Num[ArrayLike, " n"],
        inputs: Num[ArrayLike, "N m"] | Num[ArrayLike, " m"] | None = None,
        parameters: Num[ArrayLike, "N p"] | Num[ArrayLike, " p"] | None = None,
    ):
        X = require.floating(X, "X")
        inputs, parameters = (
            jnp.asarray(u)[None] if u is not None and X.ndim == np.ndim(u) == 1 else u
            for u in (inputs, parameters)
        )
        self.X = require.finite(require.points(X[None] if X.ndim == 1 else X, "X"), "X")
        require.single_or_double(self.X.dtype, "X has")
        self.inputs = inputs_at(self.X, inputs, parameters)

    @property
    def dimension(self) -> int:
        return self.X.shape[1]

    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        points, outputs = joined_points(self, self.X, count, input_name)
        yield Components(points, outputs=outputs), jnp.zeros(self.X.size, self.X.dtype)


class Functionals(AbstractObservations):
    """Σ_q weights[r, q] · f(points[r, q]) = targets[r] + noise: increments, integrals, averages.

    An increment x(t₁) − x(t₀) in coordinate a is the integral of f_a along the path: take the Q
    nodes of a quadrature rule in time and weights[r, q] = w_q e_a. For a row of relative noise s
    divide its weights and its target by s. Pad rows of fewer points with any finite points of
    weight zero.

    R rows that share their points cost less in one group: for S groups pass `points` (S, Q, n),
    `weights` (S, R, Q, n) and `targets` (S, R),
    Σ_q weights[s, r, q] · f(points[s, q]) = targets[s, r].

    Args:
        points: the Q points of each of R rows, shape (R, Q, n).
        weights: the vector that multiplies f at each point, shape (R, Q, n).
        targets: the measured values of the sums, shape (R,).
        inputs: u at each point, for a `Controlled` kernel, shape (R, Q, m) or (S, Q, m).
        parameters: θ at each point, for a `Family`, shape (R, Q, p) or (S, Q, p).

    Raises:
        ValueError: shapes do not fit, a value is not finite, or a row has weights that are all
            zero.
    """

    points: Float[Array, "S Q n"]
    weights: Float[Array, "S R Q n"]
    targets: Float[Array, " D"]
    inputs: Float[Array, "S Q m"] | None

    def __init__(
        self,
        points: Num[ArrayLike, "S Q n"],
        weights: Num[ArrayLike, "S Q n"] | Num[ArrayLike, "S R Q n"],
        targets: Num[ArrayLike, " S"] | Num[ArrayLike, "S R"],
        inputs: Num[ArrayLike, "S Q m"] | None = None,
        parameters: Num[ArrayLike, "S Q p"] | None = None,
    ):
        named = {"points": points, "weights": weights, "targets": targets}
        arrays = [require.floating(array, name) for name, array in named.items()]
        dtype = np.result_type(*[array.dtype for array in arrays])
        require.single_or_double(dtype, "points, weights and targets have")
        points, weights, targets = arrays = [array.astype(dtype) for array in arrays]
        if weights.ndim == 3:
            weights, targets = weights[:, None], targets[:, None]
        S, R, Q, n = weights.shape if weights.ndim == 4 else (0, 0, 0, 0)
        if points.shape != (S, Q, n) or targets.shape != (S, R) or weights.size == 0:
            raise ValueError(
                "points, weights and targets have shapes "
                + f"{', '.join(str(array.shape) for array in arrays)}; they must be (R, Q, n), "
                "(R, Q, n) and (R,): Q points and Q vectors for each of R rows. Pad shorter rows "
                "with weights of zero."
            )
        points, weights, targets = (
            require.finite(array, name)
            for name, array in zip(named, (points, weights, targets), strict=True)
        )
        zero = (require.host_array(weights) == 0).all(axis=(2, 3)).reshape(-1)
        self.weights = require.value(
            weights,
            zero,
            lambda: (
                "a row with weights that are all zero contains no information: leave it out"
                + (f", row {np.flatnonzero(zero)[0]}." if require.is_concrete(zero) else ".")
            ),
        )
        self.points, self.targets = points, targets.reshape(-1)
        self.inputs = inputs_at(points, inputs, parameters)

    @property
    def dimension(self) -> int:
        return self.points.shape[2]

    def parts(self, count: int = 0, input_name: str = "inputs") -> Parts:
        points, _ = joined_points(self, self.points, count, input_name)
        rows = Combinations(groups=points, weights=self.weights)  # pyright: ignore[reportCallIssue]
        yield rows, self.targets


def _noise(noise: Any, shapes: list[tuple[int, ...]], X: Array) -> Array | None:
    """The relative standard deviations, of one of these shapes, in the dtype of X."""
    if noise is None:
        return None
    array = require.floating(noise, "noise")
    require.shape(array, "noise has", "a relative standard deviation", *shapes)
    cure = "It is a standard deviation; for exact measurements take a small one, such as 1e-3."
    return require.positive(array, "noise", cure).astype(X.dtype)
