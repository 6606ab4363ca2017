"""Learned vector fields."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, Num

from hamkernel import _require as require
from hamkernel._gram.dense import centred
from hamkernel._gram.operator import placed_product
from hamkernel._show import described
from hamkernel._structures.base import AbstractMatrixKernel, Sum

Field = TypeVar("Field", bound="AbstractField")
Scalar = Callable[[Num[ArrayLike, " n"]], Float[Array, ""]]


class AbstractField(eqx.Module):
    """A learned vector field x -> f(x), one state of shape (n,) per call.

    It is a PyTree and a pure function: `jax.jit(field)`, `jax.vmap(field)(X)`, `jax.jacfwd(field)`
    and `jax.export` work on it.
    """

    kernel: eqx.AbstractVar[AbstractMatrixKernel]
    residual: eqx.AbstractVar[Float[Array, "..."]]
    norm: eqx.AbstractVar[Float[Array, ""]]
    regularization: eqx.AbstractVar[Float[Array, ""]]
    offset: eqx.AbstractVar[Float[Array, ""]]
    info: eqx.AbstractVar["SolverInfo"]
    mean: eqx.AbstractVar[Callable[..., Any] | None]

    def __repr__(self) -> str:
        return described(self)

    # jax.jit(field) looks up the function it compiles by hash and equality. Arrays have no hash and
    # traced ones no equality, so here a field is equal to itself only.
    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""

    @property
    def residual_norm(self) -> Float[Array, ""]:
        """‖y − f(X)‖ over all the training data, in units of Y, shape ().

        Known after a fit to a stream too, which keeps no residuals.
        """
        kept = self.info.residual_norm
        return jnp.linalg.norm(self.residual) if kept is None else kept

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """The velocity f(x), that of the mean included."""
        x = self._state(x)
        learned = self._learned(x)
        return learned if self.mean is None else learned + self.mean(x).astype(learned.dtype)

    @abc.abstractmethod
    def _learned(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The velocity without that of the mean."""

    def unanchored_potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The potential with the constants that the representer and the mean give it."""
        self.kernel.check_potential()
        x = self._state(x)
        learned = self._learned_potential(x)
        if self.mean is None:
            return learned
        return learned + potential_of(self.mean, self.kernel)(x).astype(learned.dtype)

    @abc.abstractmethod
    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """The potential without that of the mean."""

    def evaluate(self, X: Num[ArrayLike, "N n"]) -> Float[Array, "N n"]:
        """The velocities at many states, as `jax.vmap(field)(X)` but in bounded memory.

        Args:
            X: states, shape (N, n).

        Raises:
            ValueError: the shape does not fit.
        """
        self._check_single()
        X = require.points(X, "X").astype(self.offset.dtype)
        if X.shape[1] != self.dimension:
            raise ValueError(f"X has {X.shape[1]} coordinates and the field {self.dimension}.")
        learned = self._evaluated(X)
        return learned if self.mean is None else learned + at_points(self.mean, X)

    @abc.abstractmethod
    def _evaluated(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        """`evaluate`, without the mean, for states that have been checked."""

    def part(self: Field, which: int | str) -> Field:
        """The field of one term of a sum of kernels, by position or name.

        The parts add up to the field less its mean, and the squares of their norms to that of its
        norm; an anchor of the whole is not theirs. `residual` and `info` are those of the whole
        fit.

        Raises:
            KeyError: there is no such part (with the choices).
        """
        self._check_single()
        if isinstance(self.kernel, Sum):
            return self._term(self.kernel, self.kernel.position(which))
        if which == 0:
            return self
        raise KeyError(f"no part {which!r}: {type(self.kernel).__name__} is not a sum.")

    @abc.abstractmethod
    def _term(self: Field, kernel: Sum, position: int) -> Field:
        """`part` where the kernel is a sum."""

    @property
    def potential(self) -> Scalar:
        """The function u with f = B∇u, x (n,) -> (), with the constant set by `anchored`.

        Raises:
            AttributeError: the structure has no potential (with the reason).
        """
        self.kernel.check_potential()
        if self.mean is not None:
            potential_of(self.mean, self.kernel)
        return jax.tree_util.Partial(_potential_of, self)

    @property
    def hamiltonian(self) -> Scalar:
        """The learned Hamiltonian H with f = B∇H, x (n,) -> (); B = J, J − R, Π(x) or your own.

        Velocities determine H up to a constant: see `anchored`. That there is one does not say
        that it is conserved: see `dissipation`.

        Raises:
            AttributeError: the field is not Hamiltonian by construction (with the reason).
        """
        if not self.kernel.has_hamiltonian:
            raise AttributeError(
                f"a field of the kernel {type(self.kernel).__name__} is not Hamiltonian by "
                "construction, so it has no learned Hamiltonian. Use Symplectic(k); for a sum "
                "that contains one ask that part, by position or name, such as "
                "field.part(0).hamiltonian(x); for CurlFree see field.potential(x)."
            )
        return self.potential

    def dissipation(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The power that is lost at x, −dH/dt = ∇HᵀR∇H along the field, shape ().

        Not negative with `PortHamiltonian`, zero where H is conserved, and of any sign with an
        operator of your own.

        Raises:
            AttributeError: the field has no Hamiltonian. ValueError: x is no state (n,).
        """
        slope = jax.grad(self.hamiltonian)(self._state(x))
        return self.kernel.dissipated(self._state(x), slope)

    def _check_single(self) -> None:
        if self.offset.shape:
            raise ValueError(
                f"this is a batch of {self.offset.size} fields: jax.vmap(lambda f: f(x))(fields)."
            )

    def _state(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        self._check_single()
        return require.point(x, self.dimension).astype(self.offset.dtype)

    def anchored(self: Field, x0: Num[ArrayLike, " n"], value: ArrayLike = 0.0) -> Field:
        """The same field with the constant of its potential set so that u(x₀) = value.

        Args:
            x0: a state, shape (n,), for example the equilibrium.
            value: the potential there, in units of energy.

        Raises:
            AttributeError: the structure has no potential. ValueError: x0 is no finite state, or
                the value no finite number.
        """
        self._check_single()
        if jnp.shape(value) != ():
            raise ValueError(f"value has shape {jnp.shape(value)}; one number is needed.")
        there = require.floating(value, "value").astype(self.offset.dtype)
        x0 = require.point(x0, self.dimension, "x0")
        offset = there - self.unanchored_potential(x0)
        offset = require.value(
            offset,
            require.not_finite(offset),
            "x0 and value must be finite, and the field, which is NaN where a fit with throw=False "
            "failed: one of them is not.",
        )
        return eqx.tree_at(lambda field: field.offset, self, offset)

    @property
    def is_separable(self) -> bool:
        """Whether H(q, p) = T(p) + U(q) follows from the kernel, as explicit integrators need.

        True for a symplectic kernel whose scalar kernels are sums of `Select`s, each on q alone
        or on p alone, and a mean that says it of itself.
        """
        if self.mean is not None and not getattr(self.mean, "is_separable", False):
            return False
        n = self.dimension
        q, p = frozenset(range(n // 2)), frozenset(range(n // 2, n))
        return self.kernel.symplectic and all(
            support <= q or support <= p
            for k in self.kernel.scalar_kernels
            for support in k.supports(n)
        )


class FieldSum(eqx.Module):
    """x -> Σ f(x) of fields, such as a mean and what is added to it."""

    terms: tuple[Callable[..., Any], ...]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        total = self.terms[0](x)
        for term in self.terms[1:]:
            total = total + term(x).astype(total.dtype)
        return total

    @property
    def is_separable(self) -> bool:
        """Whether H = T(p) + U(q) for every term."""
        return all(getattr(term, "is_separable", False) for term in self.terms)


def potential_of(field: Callable[..., Any], kernel: AbstractMatrixKernel) -> Scalar:
    """The potential u with `field` = B∇u for the B of `kernel`; AttributeError if none is known."""
    if isinstance(field, FieldSum):
        parts = [potential_of(term, kernel) for term in field.terms]
        return lambda x: sum((part(x) for part in parts[1:]), start=parts[0](x))
    if isinstance(field, AbstractField):
        if Sum(kernel, field.kernel).no_potential is None:
            return field.potential
    elif kernel.symplectic and callable(getattr(field, "hamiltonian", None)):
        return field.hamiltonian  # type: ignore[attr-defined]
    raise AttributeError(
        f"the mean, {type(field).__name__}, has no potential of this structure, so neither has the "
        "field. A mean with a Hamiltonian is one of hk.systems, a field learned with the same "
        "structure, or, for Symplectic, an object of yours with a method hamiltonian(x)."
    )


_BATCH = 1024  # states at which a mean is evaluated at once


def at_points(fn: Callable[..., Any], X: Float[Array, "N n"]) -> Float[Array, "N *out"]:
    """fn(x) at many states, in bounded memory, in their dtype."""
    return jax.lax.map(lambda x: jnp.asarray(fn(x)).astype(X.dtype), X, batch_size=_BATCH)


def root(square: Float[Array, ""]) -> Float[Array, ""]:
    """√square, zero with a derivative of zero where rounding or zero data leave no square."""
    nothing = square <= 0
    return jnp.where(nothing, 0.0, jnp.sqrt(jnp.where(nothing, jnp.ones_like(square), square)))


def _potential_of(field, x):
    # With the field as an argument, so that a potential is a PyTree and its arrays no constants.
    return field.unanchored_potential(x) + field.offset


class SolverInfo(eqx.Module):
    """How a field was found. What does not apply to the solver is None.

    Attributes:
        solver: the name of the solver.
        landmarks: the number of points that carry the field, shape ().
        rank: of the low-rank Gram that was solved with, or that preconditioned, shape ().
        truncation: trace(G − Ĝ)/(Nλ) for that low-rank Gram Ĝ of the training data, shape (). The
            fitted values of Ĝ differ from those of G by at most this fraction of the residual.
        residual_norm: ‖y − f(X)‖ of a stream, whose residual is not kept, good to 1e-8 of ‖y‖,
            shape ().
        iterations: of conjugate gradients, shape ().
        relative_residual: ‖y − (G + NλI)a‖/‖y‖ of the coefficients, computed at the end, shape ().
            It is about the training data: far from them a field was up to 250 times worse.
    """

    solver: str = eqx.field(static=True)
    landmarks: Int[Array, ""] | None = None
    rank: Int[Array, ""] | None = None
    truncation: Float[Array, ""] | None = None
    residual_norm: Float[Array, ""] | None = None
    iterations: Int[Array, ""] | None = None
    relative_residual: Float[Array, ""] | None = None

    def __repr__(self) -> str:
        return described(self)


class KernelField(AbstractField):
    """f(x) = Σⱼ K(x, zⱼ) aⱼ, the minimiser of the regularised least squares.

    After energies the potential has the values Σₑ bₑ k(·, sₑ) besides, and a prior mean is added.
    Evaluating f or its potential costs O(M n) for M points.

    Attributes:
        kernel: K.
        points: zⱼ, shape (M, n): the data, or the landmarks of a low-rank solver.
        coefficients: aⱼ, shape (M, n).
        residual: yᵢ − f(xᵢ) at the training data, shape (N, n); of shape (0, n) after a fit to a
            stream, which is not kept; of other observations that of each row, in its own units,
            shape (D,).
        norm: ‖f‖ in the RKHS of K, of f less its mean, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant in the potential, shape ().
        info: how the solver went.
        value_points: sₑ, shape (E, n); None without energies.
        value_coefficients: bₑ, shape (E,); None without energies.
        mean: the prior mean, x (n,) -> (n,), which is added; None if it is zero.
    """

    kernel: AbstractMatrixKernel
    points: Float[Array, "M n"]
    coefficients: Float[Array, "M n"]
    residual: Float[Array, "..."]
    norm: Float[Array, ""]
    regularization: Float[Array, ""]
    offset: Float[Array, ""]
    info: SolverInfo = SolverInfo("none")
    value_points: Float[Array, "E n"] | None = None
    value_coefficients: Float[Array, " E"] | None = None
    mean: Callable[..., Any] | None = None

    @property
    def dimension(self) -> int:
        return self.points.shape[-1]

    def _learned(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        field = _expansion(self.kernel, x, self.points, self.coefficients)
        S, b = self.value_points, self.value_coefficients
        return field if S is None or b is None else field + _of_values(self.kernel, x, S, b)

    def _evaluated(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        fields = placed_product(self.kernel, X, self.points, self.coefficients)
        S, b = self.value_points, self.value_coefficients
        if S is None or b is None:
            return fields
        return fields + _values_at_points(self.kernel, X, S, b)

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        potential = _potential(self.kernel, x, self.points, self.coefficients)
        S, b = self.value_points, self.value_coefficients
        return potential if S is None or b is None else potential + _values(self.kernel, x, S, b)

    def _term(self, kernel: Sum, position: int) -> "KernelField":
        term, Z, A = kernel.terms[position], self.points, self.coefficients
        square = jnp.sum(A * placed_product(term, Z, Z, A))  # ‖f‖² = aᵀGa
        bare = dataclasses.replace(self, kernel=term, offset=jnp.zeros_like(self.offset), mean=None)
        S, b = self.value_points, self.value_coefficients
        if S is not None and b is not None:  # 2 aᵀG_av b + bᵀG_vv b
            at = dataclasses.replace(bare, coefficients=2 * A)
            square = square + b @ at_points(at._learned_potential, S)
        return dataclasses.replace(bare, norm=root(square))


@eqx.filter_jit
def _expansion(
    K: AbstractMatrixKernel, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> Float[Array, " n"]:
    """f(x) = Σⱼ K(x, zⱼ) aⱼ through the potential, without (n, n) blocks."""
    x, Z = centred(K, x, Z)
    return K.expansion(x, Z, A)


@eqx.filter_jit
def _potential(
    K: AbstractMatrixKernel, x: Float[Array, " n"], Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> Float[Array, ""]:
    """The potential of `_expansion`."""
    x, Z = centred(K, x, Z)
    return K.potential(x, Z, A)


def _value_potential(
    K: AbstractMatrixKernel, x: Float[Array, " n"], S: Float[Array, "E n"], b: Float[Array, " E"]
) -> Float[Array, ""]:
    """Σₑ bₑ k(x, sₑ)."""
    x, S = centred(K, x, S)
    return b @ jax.vmap(K.potential_covariance, in_axes=(None, 0))(x, S)


def _value_field(
    K: AbstractMatrixKernel, x: Float[Array, " n"], S: Float[Array, "E n"], b: Float[Array, " E"]
) -> Float[Array, " n"]:
    """The field of `_value_potential`.

    Its component along v is Cov(vᵀf(x), Σ bₑ u(sₑ)), the values at sₑ of the potential of K(·, x)v:
    linear in v, so that its gradient is the field, and B need not be known.
    """
    x, S = centred(K, x, S)

    def along(v):
        return b @ jax.vmap(lambda s: K.potential(s, x[None], v[None]))(S)

    return jax.grad(along)(jnp.zeros_like(x))


@eqx.filter_jit
def _values_at_points(K, X, S, b):
    return at_points(lambda x: _value_field(K, x, S, b), X)


_of_values, _values = eqx.filter_jit(_value_field), eqx.filter_jit(_value_potential)
