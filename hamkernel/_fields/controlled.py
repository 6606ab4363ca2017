"""Learned fields with inputs, f(x, u) = f(x) + G(x) u."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._features.structured import ControlledFeatures
from hamkernel._fields.base import AbstractField, FieldSum, Scalar, SolverInfo, at_points
from hamkernel._fields.features import FeatureField
from hamkernel._fields.kernel_field import KernelField
from hamkernel._fields.known import AtRest, KnownPart
from hamkernel._structures.base import Sum
from hamkernel._structures.controlled import Controlled


class ControlledField(AbstractField):
    """f(x, u) = f(x) + G(x) u, one state (n,) and its inputs (m,) per call.

    The potential, the Hamiltonian and the dissipation are those of the drift; `residual`, `norm`,
    `regularization` and `info` belong to the whole. A mean of x and u may be any function of u; the
    drift is then f(x, 0), and the input matrix ∂f/∂u there.

    Attributes:
        whole: the field of the points (x, u), of dimension n + m.
    """

    whole: KernelField | FeatureField

    @property
    def kernel(self) -> Controlled:
        """The controlled kernel K."""
        K = self.whole.kernel
        assert isinstance(K, Controlled)
        return K

    @property
    def points(self) -> Float[Array, "M n"]:
        """The states zⱼ that carry the field, shape (M, n); random features have none."""
        return self._expansion.points[..., : self.dimension]

    @property
    def inputs(self) -> Float[Array, "M m"]:
        """uⱼ at the points, shape (M, m)."""
        return self._expansion.points[..., self.dimension :]

    @property
    def coefficients(self) -> Float[Array, "M n"]:
        """aⱼ, shape (M, n)."""
        return self._expansion.coefficients

    @property
    def _expansion(self) -> KernelField:
        if isinstance(self.whole, KernelField):
            return self.whole
        raise AttributeError("a field of random features has weights, field.whole, and no points.")

    @property
    def residual(self) -> Float[Array, "..."]:
        """yᵢ − f(xᵢ, uᵢ) at the training data, as that of `KernelField`."""
        return self.whole.residual

    @property
    def norm(self) -> Float[Array, ""]:
        """‖(f, G)‖ in the RKHS of K, less what was known, shape ()."""
        return self.whole.norm

    @property
    def regularization(self) -> Float[Array, ""]:
        """The λ of the fit, shape ()."""
        return self.whole.regularization

    @property
    def offset(self) -> Float[Array, ""]:
        """The constant in the potential of the drift, shape ()."""
        return self.whole.offset

    @property
    def info(self) -> SolverInfo:
        """How the solver went."""
        return self.whole.info

    @property
    def mean(self) -> Callable[..., Any] | None:
        """What was known of the drift, x (n,) -> (n,)."""
        return self.drift.mean

    @property
    def dimension(self) -> int:
        whole = self.whole
        shape = whole.coefficients if isinstance(whole, KernelField) else whole.residual
        return shape.shape[-1]

    @property
    def takes_inputs(self) -> bool:
        """That a velocity needs u as well: `hk.simulate` asks."""
        return True

    @property
    def drift(self) -> KernelField | FeatureField:
        """f, a field of its own: `field.drift(x)`, `field.drift.hamiltonian(x)`."""
        return without_inputs(self.whole, self.dimension)

    def __call__(
        self, x: Num[ArrayLike, " n"], u: Num[ArrayLike, " m"] | None = None
    ) -> Float[Array, " n"]:
        """The velocity f(x) + G(x) u.

        Raises:
            ValueError: u is missing, or x or u has another shape.
        """
        s = self.joined(x, u)
        learned, known = self.whole._learned(s), self.whole.mean
        return learned if known is None else learned + known(s).astype(learned.dtype)

    def joined(self, x: Any, u: Any) -> Float[Array, " d"]:
        """The point (x, u).

        Raises:
            ValueError: u is missing, or x or u has another shape.
        """
        if u is None:
            raise ValueError(
                "this field needs its inputs: field(x, u), and hk.simulate(field, x0, ts, "
                "inputs=u). Without inputs it is field.drift(x)."
            )
        n, m = self.dimension, self.kernel.input_count
        shapes = jnp.shape(x), jnp.shape(u)
        if shapes != ((n,), (m,)):
            swapped = " x and u are swapped." if shapes == ((m,), (n,)) else ""
            raise ValueError(
                f"x has shape {shapes[0]} and u {shapes[1]}; one state ({n},) and its inputs "
                f"({m},) are needed, field(x, u).{swapped}"
            )
        x = self._state(x)
        return jnp.concatenate([x, require.floating(u, "u").astype(x.dtype)])

    def input_matrix(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n m"]:
        """The input matrix G(x), shape (n, m)."""
        x = self._state(x)
        # Forward mode drops what does not depend on u: this costs as much as G(x) alone.
        return jax.jacfwd(lambda u: self(x, u))(jnp.zeros(self.kernel.input_count, x.dtype))

    def evaluate(
        self, X: Num[ArrayLike, "N n"], U: Num[ArrayLike, "N m"] | None = None
    ) -> Float[Array, "N n"]:
        """The velocities at many states with their inputs, shapes (N, n) and (N, m).

        Raises:
            ValueError: the inputs are missing, or a shape does not fit.
        """
        self._check_single()
        X = require.points(X, "X").astype(self.offset.dtype)
        n, m = self.dimension, self.kernel.input_count
        if X.shape[1] != n:
            is_swapped = getattr(U, "shape", None) == (len(X), n)
            swapped = " X and U are swapped." if is_swapped else ""
            raise ValueError(f"X has {X.shape[1]} coordinates and the field {n}.{swapped}")
        inputs = None if U is None else require.points(U, "U").astype(X.dtype)
        if inputs is None or inputs.shape != (len(X), m):
            raise ValueError(
                f"field.evaluate(X, U) needs the inputs of every state, shape ({len(X)}, {m}); "
                f"got {None if inputs is None else inputs.shape}."
            )
        S, known = jnp.concatenate([X, inputs], axis=1), self.whole.mean
        learned = self.whole._evaluated(S)
        return learned if known is None else learned + _known_at(known, S, n)

    @property
    def potential(self) -> Scalar:
        """That of the drift.

        Raises:
            AttributeError: the structure has no potential (with the reason).
        """
        return self.drift.potential

    def unanchored_potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """That of the drift."""
        return self.drift.unanchored_potential(x)

    def _evaluated(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        return self.drift._evaluated(X)

    def _learned(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.drift._learned(x)

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return self.drift._learned_potential(x)

    def _term(self, kernel: Sum, position: int) -> "ControlledField":
        raise KeyError("the parts are those of the drift: field.drift.part(…).")


def _known_at(known: Callable[..., Any], S: Float[Array, "N d"], n: int) -> Float[Array, "N n"]:
    return at_points(known, S).reshape(len(S), n)


def without_inputs(part: Any, n: int) -> Any:
    """A field or a mean of points (x, u) at u = 0, as one of x."""
    if isinstance(part, FieldSum):
        terms = [without_inputs(term, n) for term in part.terms]
        known = tuple(term for term in terms if term is not None)
        return FieldSum(known) if known else None
    if isinstance(part, KnownPart):
        if part.mean is None or not part.of_inputs:
            return part.mean
        own = getattr(part.mean, "drift", None)  # which has a potential where it knows one
        return AtRest(part.mean, part.count) if own is None else own
    if isinstance(part, KernelField):
        values = part.value_points
        return dataclasses.replace(
            part,
            kernel=_of_drift(part.kernel),
            points=part.points[..., :n],
            value_points=None if values is None else values[..., :n],
            mean=without_inputs(part.mean, n),
        )
    if isinstance(part, FeatureField):
        assert isinstance(part.features, ControlledFeatures)
        features = part.features.drift
        return dataclasses.replace(
            part,
            kernel=_of_drift(part.kernel),
            features=features,
            weights=part.weights[..., : features.columns],
            residual=part.residual[..., :n],
            mean=without_inputs(part.mean, n),
        )
    return part


def _of_drift(K: Any):
    assert isinstance(K, Controlled)
    return K.drift


def learned_field(field: Any, known: Any) -> Any:
    """The field of a solver plus the prior mean `known`; of a controlled kernel one of x and u."""
    if known is not None:
        field = dataclasses.replace(field, mean=known)
    if not isinstance(field.kernel, Controlled):
        return field
    return ControlledField(whole=field)  # pyright: ignore[reportCallIssue]


def known_of(field: AbstractField) -> Any:
    """The prior mean of a field, as a function of the points of the solver, x or (x, u)."""
    return field.whole.mean if isinstance(field, ControlledField) else field.mean
