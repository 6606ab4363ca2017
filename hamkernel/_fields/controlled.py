"""A learned field with inputs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._fields.base import AbstractField, SolverInfo
from hamkernel._fields.kernel_field import KernelField
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.controlled import Controlled


class ControlledField(AbstractField):
    """f(x, u) = f(x) + G(x) u, one state (n,) and its inputs (m,) per call.

    The potential, the Hamiltonian and the dissipation are those of the drift; `residual`, `norm`,
    `regularization` and `info` belong to the whole.

    Attributes:
        kernel: the controlled kernel K.
        points: zⱼ, shape (M, n).
        inputs: uⱼ at the points, shape (M, m).
        coefficients: aⱼ, shape (M, n).
        residual: yᵢ − f(xᵢ, uᵢ) at the training data, shape (N, n).
        norm: ‖(f, G)‖ in the RKHS of K, shape ().
        regularization: the λ of the fit, shape ().
        offset: the constant in the potential of the drift, shape ().
        info: how the solver went.
    """

    kernel: Controlled
    points: Float[Array, "M n"]
    inputs: Float[Array, "M m"]
    coefficients: Float[Array, "M n"]
    residual: Float[Array, "N n"]
    norm: Float[Array, ""]
    regularization: Float[Array, ""]
    offset: Float[Array, ""]
    info: SolverInfo
    mean: Callable[..., Any] | None = None  # none yet with inputs, see `fit`

    @property
    def drift(self) -> KernelField:
        """f, a field of its own: `field.drift(x)`, `field.drift.hamiltonian(x)`."""
        return KernelField(
            kernel=self.kernel.drift,
            points=self.points,
            coefficients=self.coefficients,
            residual=self.residual,
            norm=self.norm,
            regularization=self.regularization,
            offset=self.offset,
            info=self.info,
        )

    @property
    def dimension(self) -> int:
        return self.points.shape[-1]

    @property
    def takes_inputs(self) -> bool:
        """That a velocity needs u as well: `hk.simulate` asks."""
        return True

    def __call__(
        self, x: Num[ArrayLike, " n"], u: Num[ArrayLike, " m"] | None = None
    ) -> Float[Array, " n"]:
        """The velocity f(x) + G(x) u.

        Raises:
            ValueError: u is missing, or x or u has another shape.
        """
        if u is None:
            raise ValueError(
                "this field needs its inputs: field(x, u), and hk.simulate(field, x0, ts, "
                "inputs=u). Without inputs it is field.drift(x)."
            )
        x, u = self._pair(x, u)
        return self.drift(x) + self.input_matrix(x) @ u

    def _pair(self, x: Any, u: Any) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        n, m = self.dimension, self.inputs.shape[-1]
        shapes = jnp.shape(x), jnp.shape(u)
        if shapes != ((n,), (m,)):
            swapped = " x and u are swapped." if shapes == ((m,), (n,)) else ""
            raise ValueError(
                f"x has shape {shapes[0]} and u {shapes[1]}; one state ({n},) and its inputs "
                f"({m},) are needed, field(x, u).{swapped}"
            )
        return self._state(x), require.floating(u, "u").astype(self.offset.dtype)

    def input_matrix(self, x: Num[ArrayLike, " n"]) -> Float[Array, "n m"]:
        """The input matrix G(x), shape (n, m)."""
        x = self._state(x)
        return self.kernel.input_matrix(x, self.points, self.coefficients, self.inputs)

    def evaluate(
        self, X: Num[ArrayLike, "N n"], U: Num[ArrayLike, "N m"] | None = None
    ) -> Float[Array, "N n"]:
        """The velocities at many states with their inputs, shapes (N, n) and (N, m).

        Raises:
            ValueError: the inputs are missing, or a shape does not fit.
        """
        drift = self.drift.evaluate(X)
        inputs = None if U is None else require.points(U, "U")
        if inputs is None or inputs.shape != (len(drift), self.inputs.shape[-1]):
            raise ValueError(
                f"field.evaluate(X, U) needs the inputs of every state, shape ({len(drift)}, "
                f"{self.inputs.shape[-1]}); got {None if inputs is None else inputs.shape}."
            )
        X = require.points(X, "X").astype(self.offset.dtype)
        matrices = jax.vmap(self.input_matrix)(X)
        return drift + jnp.einsum("iam,im->ia", matrices, inputs.astype(self.offset.dtype))

    def _evaluated(self, X: Float[Array, "N n"]) -> Float[Array, "N n"]:
        return self.drift._evaluated(X)

    def _learned(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.drift._learned(x)

    def _learned_potential(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        return self.drift._learned_potential(x)

    def _term(self, kernel: Sum, position: int) -> "ControlledField":
        raise KeyError("the parts are those of the drift: field.drift.part(…).")


def with_inputs(K: AbstractMatrixKernel, field: Any) -> Any:
    """The field itself; of a controlled kernel that of x and u, in place of joined points."""
    if not isinstance(K, Controlled):
        return field
    n = field.coefficients.shape[-1]
    return ControlledField(
        kernel=K,
        points=field.points[..., :n],
        inputs=field.points[..., n:],
        coefficients=field.coefficients,
        residual=field.residual,
        norm=field.norm,
        regularization=field.regularization,
        offset=field.offset,
        info=field.info,
    )
