"""Learned fields of joined points (x, u): fields with inputs, and families of systems."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._features import ControlledFeatures
from hamkernel._fields.base import (
    AbstractField,
    AtInputs,
    FieldSum,
    KnownPart,
    Scalar,
    SolverInfo,
    map_states,
    root,
)
from hamkernel._fields.expansions import FeatureField, KernelField
from hamkernel._gram_operator import placed_product
from hamkernel._machine import follow_data
from hamkernel._structures.base import Sum
from hamkernel._structures.joined import AbstractJoinedKernel


def _column(u: Array, ndim: int, m: int) -> Array:
    """The inputs u; in the shape (…, 1) if m = 1 and u has one number for each state."""
    return u[..., None] if u.ndim == ndim and m == 1 else u


class AbstractJoinedField(AbstractField):
    """f(x, u), one state (n,) and one u (m,) per call.

    `residual`, `norm`, `regularization` and `info` belong to the field of joined points.

    Attributes:
        whole: the field of the points (x, u), of dimension n + m.
    """

    whole: KernelField | FeatureField

    @property
    @abc.abstractmethod
    def _example(self) -> str:
        """An expression for a field of x alone, for error messages."""

    @property
    def kernel(self) -> AbstractJoinedKernel:
        """The kernel K of joined points."""
        K = self.whole.kernel
        assert isinstance(K, AbstractJoinedKernel)
        return K

    @property
    def points(self) -> Float[Array, "M n"]:
        """The states zⱼ of the kernel sum, shape (M, n); random features have none."""
        return self._expansion.points[..., : self.dimension]

    @property
    def coefficients(self) -> Float[Array, "M n"]:
        """The coefficients aⱼ of the kernel sum, shape (M, n)."""
        return self._expansion.coefficients

    @property
    def _expansion(self) -> KernelField:
        if isinstance(self.whole, KernelField):
            return self.whole
        raise AttributeError("a field of random features has weights, field.whole, and no points.")

    @property
    def residual(self) -> Float[Array, "..."]:
        """The residual yᵢ − f(xᵢ, uᵢ) at the training data, as for `KernelField`."""
        return self.whole.residual

    @property
    def norm(self) -> Float[Array, ""]:
        """The norm of f minus its known part in the RKHS of K, shape ()."""
        return self.whole.norm

    @property
    def regularization(self) -> Float[Array, ""]:
        """The λ of the fit, shape ()."""
        return self.whole.regularization

    @property
    def offset(self) -> Float[Array, ""]:
        """The constant of the potential, shape ()."""
        return self.whole.offset

    @property
    def info(self) -> SolverInfo:
        """The outcome of the solver."""
        return self.whole.info

    @property
    def dimension(self) -> int:
        return self.kernel.outputs(self.whole.dimension)

    @property
    def _next(self) -> str:
        return (
            f"field(x, u), .evaluate(X, U), {self._example}, hk.simulate(field, x0, ts, inputs=u)"
        )

    @property
    def takes_inputs(self) -> bool:
        """True: a velocity needs u too. `hk.simulate` reads this attribute."""
        return True

    def __call__(
        self, x: Num[ArrayLike, " n"], u: Num[ArrayLike, " m"] | None = None
    ) -> Float[Array, " n"]:
        """The velocity f(x, u), shape (n,).

        Raises:
            ValueError: u is missing, or x or u has another shape.
        """
        s = self.join(x, u)
        learned, mean = self.whole._velocity(s), self.whole.mean
        return learned if mean is None else learned + mean(s).astype(learned.dtype)

    def join(self, x: Any, u: Any) -> Float[Array, " d"]:
        """The joined point (x, u), shape (n + m,).

        Raises:
            ValueError: u is missing, or x or u has another shape.
        """
        self._check_single()
        name = self.kernel.input_name
        if u is None:
            raise ValueError(
                f"a {type(self).__name__} needs its {name}: field(x, u), and hk.simulate(field, "
                f"x0, ts, inputs=u). A field of x alone is {self._example}."
            )
        n, m = self.dimension, self.kernel.input_count
        u = _column(require.floating(u, "u"), 0, m)
        shapes = np.shape(x), u.shape
        if shapes != ((n,), (m,)):
            swapped = " x and u are swapped." if shapes == ((m,), (n,)) else ""
            raise ValueError(
                f"x has shape {shapes[0]} and u {shapes[1]}; one state ({n},) and its {name} "
                f"({m},) are needed, field(x, u).{swapped}"
            )
        x = self._state(x)
        return jnp.concatenate([x, u.astype(x.dtype)])

    @follow_data
    def evaluate(
        self, X: Num[ArrayLike, "N n"], U: Num[ArrayLike, "N m"] | None = None
    ) -> Float[Array, "N n"]:
        """The velocities, shape (N, n), at states (N, n) with inputs or parameters (N, m).

        Raises:
            ValueError: U is missing, or a shape does not fit.
        """
        self._check_single()
        X = require.points(X, "X").astype(self.offset.dtype)
        n, m = self.dimension, self.kernel.input_count
        if X.shape[1] != n:
            is_swapped = getattr(U, "shape", None) == (len(X), n)
            swapped = " X and U are swapped." if is_swapped else ""
            raise ValueError(f"X has {X.shape[1]} coordinates and the field {n}.{swapped}")
        inputs = None if U is None else _column(require.floating(U, "U"), 1, m).astype(X.dtype)
        if inputs is None or inputs.shape != (len(X), m):
            raise ValueError(
                f"field.evaluate(X, U) needs the {self.kernel.input_name} of every state, shape "
                f"({len(X)}, {m}); got {None if inputs is None else inputs.shape}."
            )
        S, mean = jnp.concatenate([X, inputs], axis=1), self.whole.mean
        learned = self.whole._velocities(S)
        return learned if mean is None else learned + map_states(mean, S).reshape(len(S), n)

    def part(self, which: int | str) -> "AbstractJoinedField":
        """KeyError: only a field of x alone has parts."""
        raise KeyError(f"no part {which!r}: the parts are those of {self._example}.part(…).")

    def _term(self, kernel: Sum, position: int) -> "AbstractJoinedField":
        return self.part(position)


class ControlledField(AbstractJoinedField):
    """f(x, u) = f(x) + G(x) u, one state (n,) and its inputs (m,) per call.

    The potential, the Hamiltonian and the dissipation belong to the drift f(x); `residual`, `norm`,
    `regularization` and `info` belong to f(x, u). A prior mean may be any function of x and u. The
    drift is then f(x, 0), and the input matrix is ∂f/∂u at u = 0.

    Attributes:
        whole: the field of the points (x, u), of dimension n + m.
    """

    @property
    def inputs(self) -> Float[Array, "M m"]:
        """The inputs uⱼ at `points`, shape (M, m)."""
        return self._expansion.points[..., self.dimension :]

    @property
    def mean(self) -> Callable[..., Any] | None:
        """The prior mean of the drift, x (n,) -> (n,)."""
        return self.drift.mean

    @property
    def _example(self) -> str:
        return "field.drift"

    def part(self, which: int | str) -> Any:
        """The part of the drift with this position or name, `field.drift.part(which)`.

        Raises:
            KeyError: the drift has no such part (with the choices).
        """
        return self.drift.part(which)

    @property
    def drift(self) -> KernelField | FeatureField:
        """The drift f as a field: `field.drift(x)`, `field.drift.hamiltonian(x)`."""
        return fix_inputs(self.whole, self.dimension, None)

    def input_matrix(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n m"]:
        """The input matrix G(x), shape (n, m)."""
        x = self._state(x)
        # Forward mode drops all terms without u, so the cost is that of G(x) alone.
        return jax.jacfwd(lambda u: self(x, u))(jnp.zeros(self.kernel.input_count, x.dtype))

    @property
    def potential(self) -> Scalar:
        """The potential of the drift.

        Raises:
            AttributeError: the structure has no potential (with the reason).
        """
        return self.drift.potential

    def _laws(self) -> list[tuple[Any, Float[Array, " m"]]]:
        return self.drift._laws()

    def unanchored_potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The potential of the drift, without the constant of `anchored`."""
        return self.drift.unanchored_potential(x)

    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        return self.drift._velocities(X)

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.drift._velocity(x)

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return self.drift._learned_potential(x)


class FamilyField(AbstractJoinedField):
    """f(x; θ), one state (n,) and the parameters θ (p,) of a member per call.

    `field.at(θ)` is a member: an ordinary field of K, with a Hamiltonian if K has one.

    Attributes:
        whole: the field of the points (x, θ), of dimension n + p.
    """

    @property
    def parameters(self) -> Float[Array, "M p"]:
        """The parameters θⱼ at `points`, shape (M, p)."""
        return self._expansion.points[..., self.dimension :]

    @property
    def mean(self) -> Callable[..., Any] | None:
        """The prior mean, a function of the points (x, θ)."""
        return self.whole.mean

    @property
    def _example(self) -> str:
        return "field.at(θ)"

    def at(self, theta: Num[ArrayLike, " p"]) -> "KernelField | MemberField":
        """The member with the parameters θ, an ordinary field of K.

        The residual of the member is empty, since the data belong to all members. λ and `info`
        belong to the fit. JAX does not recompile for new values of θ.

        Args:
            theta: θ, shape (p,).

        Raises:
            ValueError: θ has another shape, or is not finite.
        """
        self._check_single()
        K: Any = self.kernel
        p = K.input_count
        theta = _column(require.floating(theta, "θ"), 0, p)
        require.shape(theta, "θ has", "the θ of one member", (p,))
        theta = require.finite(theta, "θ").astype(self.offset.dtype)
        terms = tuple(
            fix_inputs(
                dataclasses.replace(self._expansion, kernel=t, mean=None), self.dimension, theta
            )
            for t in K.terms
        )
        mean = fix_inputs(self.whole.mean, self.dimension, theta)
        if len(terms) == 1:
            return dataclasses.replace(terms[0], mean=mean)
        return MemberField(K.state_kernel, terms, self.offset, mean)  # pyright: ignore

    @property
    def potential(self) -> Scalar:
        """AttributeError: each member has a potential of its own, `field.at(θ).potential`."""
        raise AttributeError(
            "a family has no one potential: each member has its own, field.at(θ).potential, and "
            "field.at(θ).hamiltonian where the structure has one."
        )

    def _laws(self) -> list[tuple[Any, Float[Array, " m"]]]:
        raise AttributeError("each system of a family has its own law: field.at(theta).law(r, r0).")

    def unanchored_potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """AttributeError: each member has a potential of its own."""
        return self.potential(x)

    @property
    def hamiltonian(self) -> Scalar:
        """AttributeError: each member has its own Hamiltonian, `field.at(θ).hamiltonian`."""
        return self.potential

    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        raise AttributeError("a family needs states and parameters: field.evaluate(X, Θ).")

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        raise AttributeError("a family needs a state and parameters: field(x, θ).")

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return self.potential(x)


class MemberField(AbstractField):
    """The member of a family with several terms, Σᵢ Σⱼ kᵢ(θ, θⱼ) Kᵢ(x, zⱼ) aⱼ.

    The terms share their points. Each term has its own coefficients.

    Attributes:
        kernel: the sum of the Kᵢ.
        terms: the field of each Kᵢ.
        offset: the constant of the potential, shape ().
        mean: the prior mean at θ, x (n,) -> (n,); None if it is zero.
    """

    kernel: Sum
    terms: tuple[KernelField, ...]
    offset: Float[Array, ""]
    mean: Callable[..., Any] | None = None

    @property
    def dimension(self) -> int:
        return self.terms[0].dimension

    @property
    def points(self) -> Float[Array, "M n"]:
        """The points zⱼ of all terms, shape (M, n)."""
        return self.terms[0].points

    @property
    def residual(self) -> Float[Array, "..."]:
        """An empty array, since the data belong to all members."""
        return self.terms[0].residual

    @property
    def norm(self) -> Float[Array, ""]:
        """The norm (Σᵢ ‖fᵢ‖²)^½ of the terms, shape ()."""
        return root(sum((t.norm**2 for t in self.terms[1:]), start=self.terms[0].norm ** 2))

    @property
    def regularization(self) -> Float[Array, ""]:
        """The λ of the fit, shape ()."""
        return self.terms[0].regularization

    @property
    def info(self) -> SolverInfo:
        """The outcome of the solver."""
        return self.terms[0].info

    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return sum((t._velocity(x) for t in self.terms), jnp.zeros_like(x))

    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        return sum((t._velocities(X) for t in self.terms), jnp.zeros_like(X))

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return sum((t._learned_potential(x) for t in self.terms), jnp.zeros((), x.dtype))

    def _term(self, kernel: Sum, position: int) -> Any:
        return self.terms[position]


def fix_inputs(part: Any, n: int, u: Float[Array, " m"] | None) -> Any:
    """The field or mean `part` of points (x, u) at a fixed u, as a function of x.

    If u is None, the result is the drift of a `Controlled` kernel, at u = 0.
    """
    if isinstance(part, FieldSum):
        terms = [fix_inputs(term, n, u) for term in part.terms]
        kept = tuple(term for term in terms if term is not None)
        return FieldSum(kept) if kept else None
    if isinstance(part, KnownPart):
        if part.mean is None or not part.of_inputs:
            return part.mean
        if u is None:
            # The attribute `drift` of the mean, if there is one, may have a potential.
            drift = getattr(part.mean, "drift", None)
            return AtInputs(part.mean, jnp.zeros(part.count)) if drift is None else drift
        at = getattr(part.mean, "at", None)
        return AtInputs(part.mean, u) if at is None else at(u)
    if isinstance(part, KernelField):
        K, points, values = part.kernel, part.points, part.value_points
        assert isinstance(K, AbstractJoinedKernel)
        member = dataclasses.replace(
            part,
            kernel=K.state_kernel,
            points=points[..., :n],
            value_points=None if values is None else values[..., :n],
            mean=fix_inputs(part.mean, n, u),
        )
        if u is None:
            return member
        A = K.coefficients_at(u, points[..., n:], part.coefficients)
        bare = dataclasses.replace(member, coefficients=A, residual=jnp.zeros((0, n), A.dtype))
        square = jnp.sum(A * placed_product(K.state_kernel, bare.points, bare.points, A))  # aᵀGa
        return dataclasses.replace(bare, norm=root(square))
    if isinstance(part, FeatureField):
        assert isinstance(part.features, ControlledFeatures)
        features = part.features.drift
        return dataclasses.replace(
            part,
            kernel=part.kernel.state_kernel,
            features=features,
            weights=part.weights[..., : features.columns],
            residual=part.residual[..., :n],
            mean=fix_inputs(part.mean, n, u),
        )
    return part


def learned_field(field: Any, mean: Any) -> Any:
    """The field of a solver plus the known part; a function of (x, u) for a joined kernel."""
    if mean is not None:
        field = dataclasses.replace(field, mean=mean)
    if not isinstance(field.kernel, AbstractJoinedKernel):
        return field
    field_type = FamilyField if field.kernel.input_name == "parameters" else ControlledField
    return field_type(whole=field)  # pyright: ignore[reportCallIssue]


def known_of(field: AbstractField) -> Any:
    """The prior mean of a field, as a function of the points of the solver, x or (x, u)."""
    return field.whole.mean if isinstance(field, AbstractJoinedField) else field.mean
