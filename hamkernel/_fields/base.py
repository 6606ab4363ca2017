"""Learned vector fields."""

import abc
import math
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, Num

from hamkernel import _require as require
from hamkernel._fields.kinetic import Kinetic
from hamkernel._kernels.functions import as_pytree
from hamkernel._machine import EqualToItself, follow_data, full_precision, precise_jit
from hamkernel._show import Shown, describe, has_arrays, text
from hamkernel._sizes import sizes
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.joined import AbstractJoinedKernel, KnownMatrix
from hamkernel._structures.laws import undetermined_terms

Field = TypeVar("Field", bound="AbstractField")
Mean = Callable[..., Float[Array, " n"]]
Scalar = Callable[[Num[ArrayLike, " n"]], Float[Array, ""]]


class AbstractField(Shown, EqualToItself, eqx.Module):
    """A learned vector field x -> f(x), one state of shape (n,) per call.

    A field is a PyTree and a pure function, so `jax.jit(field)`, `jax.vmap(field)(X)`,
    `jax.jacfwd(field)` and `jax.export` work.
    """

    kernel: eqx.AbstractVar[AbstractMatrixKernel]
    residual: eqx.AbstractVar[Float[Array, "..."]]
    norm: eqx.AbstractVar[Float[Array, ""]]
    regularization: eqx.AbstractVar[Float[Array, ""]]
    offset: eqx.AbstractVar[Float[Array, ""]]
    info: eqx.AbstractVar["SolverInfo"]
    mean: eqx.AbstractVar[Callable[..., Any] | None]

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        name, arrays = type(self).__name__, (self.offset, self.norm, self.regularization)
        if not has_arrays(arrays) or not require.is_concrete(arrays):
            return f"{name}: no numbers yet", [("kernel", text(self.kernel))]
        rows = [("kernel", text(self.kernel))]
        if self.mean is not None:
            rows.append(("mean", text(self.mean)))
        if self.offset.shape:
            rows.append(("next", "jax.vmap(lambda f: …)(fields)"))
            return f"{math.prod(self.offset.shape)} fields, a batch of {name}", rows
        if self.residual.size or self.info.residual_norm is not None:
            rows.append(("residual", f"{text(self.residual_norm)}, the norm over all data"))
        rows += [
            ("norm", f"{text(self.norm)} in the RKHS"),
            ("lambda", text(self.regularization)),
            ("solver", self.info.words),
            ("next", self._next),
        ]
        return f"{name} of {self.dimension} coordinates", rows

    @property
    def _next(self) -> str:
        potential = ", .hamiltonian(x)" if self.kernel.has_hamiltonian else ""
        return f"field(x), .evaluate(X){potential}, hk.simulate(field, x0, ts)"

    @property
    @abc.abstractmethod
    def dimension(self) -> int:
        """n, the number of coordinates of a state."""

    @property
    def residual_norm(self) -> Float[Array, ""]:
        """‖y − f(X)‖ over all the training data, in units of Y, shape ().

        A fit to a stream keeps this norm, but no residuals.
        """
        norm_of_stream = self.info.residual_norm
        return jnp.linalg.norm(self.residual) if norm_of_stream is None else norm_of_stream

    def __call__(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        """The velocity f(x), including the prior mean."""
        x = self._state(x)
        learned = self._velocity(x)
        if self.mean is None:
            return learned
        return learned + full_precision(self.mean)(x).astype(learned.dtype)

    @abc.abstractmethod
    def _velocity(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The velocity without the prior mean."""

    @full_precision
    def unanchored_potential(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The potential without `offset`, so that its constant is arbitrary."""
        self.kernel.check_potential()
        x = self._state(x)
        learned = self._learned_potential(x)
        if self.mean is None:
            return learned
        return learned + potential_of(self.mean, self.kernel)(x).astype(learned.dtype)

    @abc.abstractmethod
    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """The potential without the prior mean."""

    @follow_data
    def evaluate(self, X: Num[ArrayLike, "N n"]) -> Float[Array, "N n"]:
        """The velocities at many states, shape (N, n): `jax.vmap(field)(X)` in bounded memory.

        Args:
            X: states, shape (N, n).

        Raises:
            ValueError: the shape does not fit.
        """
        self._check_single()
        X = require.points(X, "X").astype(self.offset.dtype)
        require.one_system("X has", X.shape[1], "the field", self.dimension)
        learned = self._velocities(X)
        return learned if self.mean is None else learned + map_states(self.mean, X)

    @abc.abstractmethod
    def _velocities(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        """The velocities at many checked states, without the prior mean."""

    def score(
        self,
        X: Num[ArrayLike, "N n"],
        Y: Num[ArrayLike, "N n"],
        U: Num[ArrayLike, "N m"] | None = None,
    ) -> Float[Array, ""]:
        """R² = 1 − Σ‖yᵢ − f(xᵢ)‖²/Σ‖yᵢ − ȳ‖² on held-out velocities yᵢ, shape ().

        R² is 1 for a perfect field, 0 for the constant field ȳ, and negative for a worse field.

        Args:
            X: states, shape (N, n).
            Y: measured velocities, shape (N, n); NaN where a component was not measured.
            U: inputs or parameters, shape (N, m), if the field has them.

        Raises:
            ValueError: a shape does not fit.
        """
        velocities = self.evaluate(*(X,) if U is None else (X, U))
        measured = require.points(Y, "Y").astype(velocities.dtype)
        require.shape(measured, "Y has", "one velocity for each state in X", velocities.shape)
        spread = measured - jnp.nanmean(measured, axis=0, keepdims=True)
        return 1 - jnp.nansum((measured - velocities) ** 2) / jnp.nansum(spread**2)

    def part(self: Field, which: int | str) -> Field:
        """The field of one term of a sum of kernels, by position or name.

        The parts add up to the field minus its prior mean, and the squares of their norms to the
        square of its norm. A part does not inherit the anchor of the field. `residual` and `info`
        belong to the complete fit. If the kernel is not a sum, part 0 is the field itself, with its
        mean and anchor.

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
        """The field of one term of the sum `kernel`."""

    @property
    def potential(self) -> Scalar:
        """The potential u with f = B∇u, x (n,) -> (); `anchored` sets its constant.

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

        Velocities determine H up to a constant, which `anchored` sets. H need not be conserved (see
        `dissipation`).

        Raises:
            AttributeError: the field is not Hamiltonian by construction (with the reason).
        """
        if not self.kernel.has_hamiltonian:
            raise AttributeError(
                f"a field of the kernel {type(self.kernel).__name__} is not Hamiltonian by "
                "construction, so it has no learned Hamiltonian. Use Symplectic(k). If the kernel "
                "is a sum with a Symplectic term, ask the part, by position or name, such as "
                "field.part(0).hamiltonian(x). For CurlFree use field.potential(x)."
            )
        return self.potential

    @full_precision
    def law(self, r: Num[ArrayLike, "..."], r0: Any = None, which: int = 0) -> Float[Array, ""]:
        """The law w of `hk.Shared` at r, such as a pair potential at a distance, shape ().

        The data do not determine the constant of w. With `r0` the result is w(r) − w(r₀).

        Args:
            r: a distance of `hk.pairs`, a difference of `hk.neighbours`, or one point of your own
                parts, shape (d,). Use `jax.vmap(field.law)(r)` for many.
            r0: an argument at which the law is zero; None for the constant of the smallest norm.
            which: the position of the law in the kernel, if there are several.

        Raises:
            AttributeError: no part of the kernel is `Shared`.
            IndexError: there is no such law.
        """
        laws = self._laws()
        if not laws:
            raise AttributeError(
                "the field has no law: no term of its kernel is hk.Shared(k, parts). For the "
                "potential of the whole field use field.potential(x)."
            )
        # `_law_at` is compiled: JAX would else compile each operation of jax.vmap(field.law)(r).
        zero = None if r0 is None else require.floating(r0, "r0")
        return _law_at(*laws[which], require.floating(r, "r"), zero)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The changes of the laws of `hk.Shared` that change no velocity, a sentence for each.

        A constant in a law changes no velocity. Neither does a linear term if its sum over the
        parts is constant, or equals the sum over the parts of another law.
        """
        return undetermined_terms(self.kernel, self.dimension)

    def _laws(self) -> list[tuple[Any, Float[Array, " m"]]]:
        """The features of each shared law, with their weights."""
        return []

    def dissipation(self, x: Num[ArrayLike, " n"]) -> Float[Array, ""]:
        """The dissipated power at x, −dH/dt = ∇HᵀR∇H along the field, shape ().

        The power is ≥ 0 for `PortHamiltonian`, zero if H is conserved, and of any sign for an
        operator of your own.

        Raises:
            AttributeError: the field has no Hamiltonian.
            ValueError: x is no state (n,).
        """
        slope = jax.grad(self.hamiltonian)(self._state(x))
        return self.kernel.dissipated_power(self._state(x), slope)

    def _check_single(self) -> None:
        if self.offset.shape:
            raise ValueError(
                f"this is a batch of {self.offset.size} fields, and a method needs one: "
                "jax.vmap(lambda f: f(x))(fields)."
            )

    def _state(self, x: Num[ArrayLike, " n"]) -> Float[Array, " n"]:
        self._check_single()
        return require.point(x, self.dimension).astype(self.offset.dtype)

    def anchored(self: Field, x0: Num[ArrayLike, " n"], value: ArrayLike = 0.0) -> Field:
        """The same field with the constant of its potential set so that u(x₀) = value.

        Args:
            x0: a state, shape (n,), for example the equilibrium.
            value: u(x₀), in units of energy.

        Raises:
            AttributeError: the structure has no potential.
            ValueError: x0 is no finite state, or the value no finite number.
        """
        self._check_single()
        require.shape(value, "value has", "one number", ())
        anchor = require.floating(value, "value").astype(self.offset.dtype)
        x0 = require.point(x0, self.dimension, "x0")
        offset = anchor - self.unanchored_potential(x0)
        offset = require.value(
            offset,
            require.not_finite(offset),
            "x0, value and the field must be finite, and one of them is not. A field is NaN if a "
            "fit with throw=False failed.",
        )
        return eqx.tree_at(lambda field: field.offset, self, offset)

    @property
    def is_separable(self) -> bool:
        """Whether the kernel implies H(q, p) = T(p) + U(q), which explicit integrators need.

        True for a symplectic kernel whose scalar kernels are sums of `Select`s, each of which takes
        only q or only p. The prior mean must be zero, or have a true attribute `is_separable`.
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


@precise_jit
def _law_at(waves: Any, weights: Float[Array, " m"], r: Array, r0: Array | None) -> Array:
    waves_at_r = waves.law_values(r) if r0 is None else waves.law_values(r) - waves.law_values(r0)
    return waves_at_r.astype(weights.dtype) @ weights


class FieldSum(eqx.Module):
    """The sum of fields, x -> Σ f(x), such as two prior means."""

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


class KnownPart(eqx.Module):
    """The known part of a field of points (x, u): the prior mean plus G u for a known matrix G."""

    mean: Callable[..., Any] | None
    matrix: KnownMatrix | None
    count: int = eqx.field(static=True)
    of_inputs: bool = eqx.field(static=True)  # whether the mean is a function of x and u

    def __call__(self, s: Float[Array, " d"]) -> Float[Array, " n"]:
        x, u = s[: -self.count], s[-self.count :]
        value_of_inputs = jnp.zeros_like(x)
        if self.matrix is not None:
            value_of_inputs = jnp.asarray(self.matrix.matrix, x.dtype) @ u
        if self.mean is None:
            return value_of_inputs
        value = self.mean(x, u) if self.of_inputs else self.mean(x)
        return value_of_inputs + value.astype(x.dtype)


class AtInputs(eqx.Module):
    """The function x -> f(x, u) for a fixed u."""

    field: Callable[..., Any]
    u: Float[Array, " m"]

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.field(x, self.u.astype(x.dtype))


def known_part(K: AbstractMatrixKernel, mean: Any, n: int, dtype: Any) -> Any:
    """The prior mean at the points of K, plus G u if K has a known input matrix G.

    Args:
        K: the kernel.
        mean: x (n,) -> (n,); for a joined kernel also x, u -> (n,).
        n: the number of coordinates of a state.
        dtype: the dtype of the states.

    Returns:
        A PyTree that maps one point to one velocity; None if the prior mean is zero.

    Raises:
        TypeError, ValueError: the mean does not map one state to one velocity.
    """
    if not isinstance(K, AbstractJoinedKernel):
        if mean is None:
            return None
        require.velocity(mean, jnp.zeros(n, dtype), "mean")
        return as_pytree(mean)
    matrix = K.known_matrix
    if mean is None:
        return None if matrix is None else KnownPart(None, matrix, K.input_count, of_inputs=False)
    x = jnp.zeros(n, dtype)
    of_inputs = getattr(mean, "takes_inputs", False) or require.takes_two(mean)
    at_zero = AtInputs(mean, jnp.zeros(K.input_count, dtype)) if of_inputs else mean
    require.velocity(at_zero, x, "mean")
    return KnownPart(as_pytree(mean), matrix, K.input_count, of_inputs)


def potential_of(field: Callable[..., Any], kernel: AbstractMatrixKernel) -> Scalar:
    """The potential u with `field` = B∇u for the B of `kernel`.

    Raises:
        AttributeError: no potential is known (with the reason).
    """
    if isinstance(field, FieldSum):
        parts = [potential_of(term, kernel) for term in field.terms]
        return lambda x: sum((part(x) for part in parts[1:]), start=parts[0](x))
    if isinstance(field, AbstractField):
        if Sum(kernel, field.kernel).no_potential is None:
            return field.potential
    elif callable(getattr(field, "hamiltonian", None)):
        if kernel.symplectic or (isinstance(field, Kinetic) and field.is_of_velocities):
            return field.hamiltonian  # type: ignore[attr-defined]
    name = getattr(getattr(field, "func", field), "__name__", type(field).__name__)
    structure = type(kernel).__name__
    if isinstance(field, AbstractField):
        why = f"was learned with {type(field.kernel).__name__}: learn both with one structure."
    elif hasattr(field, "hamiltonian"):
        why = (
            f"has a Hamiltonian H with f = J∇H, and {structure} makes fields B∇u with another B: "
            "use Symplectic(k), or learn from velocities alone."
        )
    else:
        why = (
            "has no attribute hamiltonian: pass a system of hk.systems, a field learned with the "
            "same structure, or, for Symplectic, an object of yours with a method hamiltonian(x)."
        )
    raise AttributeError(
        f"the mean, {name}, has no potential of the structure {structure}, so neither has the "
        f"field. The mean {why}"
    )


def map_states(fn: Callable[..., Any], X: Float[Array, "N n"]) -> Float[Array, "N *out"]:
    """The values fn(x) at the states X, in bounded memory, in the dtype of X."""
    return jax.lax.map(lambda x: jnp.asarray(fn(x)).astype(X.dtype), X, batch_size=sizes().states)


def root(square: Float[Array, ""]) -> Float[Array, ""]:
    """√square; zero with zero derivative if `square` ≤ 0, by rounding or for data of zeros."""
    nothing = square <= 0
    return jnp.where(nothing, 0.0, jnp.sqrt(jnp.where(nothing, jnp.ones_like(square), square)))


def _potential_of(field, x):
    # The field is an argument, so that its arrays are leaves of the potential and not constants.
    return field.unanchored_potential(x) + field.offset


class SolverInfo(eqx.Module):
    """The outcome of a solver. Attributes that do not apply to the solver are None.

    Attributes:
        solver: the name of the solver.
        landmarks: the number of points that carry the field, shape ().
        rank: the rank of the low-rank Gram Ĝ of the solver or of its preconditioner, shape ().
        truncation: trace(G − Ĝ)/(Nλ) for the low-rank Gram Ĝ of the training data, shape (). The
            fitted values with Ĝ and with G differ by at most this fraction of the residual.
        residual_norm: ‖y − f(X)‖ after a fit to a stream, to 1e-8 of ‖y‖, shape ().
        iterations: the number of iterations of conjugate gradients, shape ().
        relative_residual: ‖y − (G + NλI)a‖/‖y‖ of the final coefficients a, shape (). Far from the
            training data the relative error of a field can be 250 times larger.
    """

    solver: str = eqx.field(static=True)
    landmarks: Int[Array, ""] | None = None
    rank: Int[Array, ""] | None = None
    truncation: Float[Array, ""] | None = None
    residual_norm: Float[Array, ""] | None = None
    iterations: Int[Array, ""] | None = None
    relative_residual: Float[Array, ""] | None = None

    def __repr__(self) -> str:
        return describe(self)

    @property
    def words(self) -> str:
        """The attributes in words: `Cholesky, relative residual 8.9e-16`."""
        numbers = {name: v for name, v in vars(self).items() if v is not None and name != "solver"}
        return ", ".join(
            [self.solver, *(f"{k.replace('_', ' ')} {text(v)}" for k, v in numbers.items())]
        )
