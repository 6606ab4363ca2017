"""Kernels of joined points (x, u): a state x together with its inputs or parameters u.

u contains the inputs of `Controlled`, or the parameters of a member of a `Family`. Points have
n + m coordinates and fields n components; `outputs` returns n.

Fields with inputs are f(x, u) = f(x) + G(x) u. If the drift f and the input matrix G have
independent priors, the kernel of two joined points is

    K((x, u), (x′, u′)) = K_f(x, x′) + Σᵢⱼ uᵢ u′ⱼ K_g,ij(x, x′),        shape (n, n).
"""

import abc
import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Invariance,
    Point,
    Points,
    Scaled,
    as_scalar_kernel,
)
from hamkernel._kernels.built_in import Constant
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._show import describe
from hamkernel._structures.base import AbstractMatrixKernel, Sum, matrix_kernel

JointPoint = Float[Array, " d"]  # (x, u), d = n + m
JointPoints = Float[Array, "M d"]


class AbstractJoinedKernel(AbstractMatrixKernel):
    """A kernel of points (x, u), u of shape (m,).

    Attributes:
        count: the number m; None until the data determine m.
        inner: the name, in error messages, of the part that may have a symmetry.
    """

    count: eqx.AbstractVar[int | None]
    inner: eqx.AbstractClassVar[str]

    symplectic: ClassVar[bool] = False  # a flow changes only x
    takes_inputs: ClassVar[bool] = True

    @property
    @abc.abstractmethod
    def state_kernel(self) -> AbstractMatrixKernel:
        """The kernel of fields of x alone: of the drift, or of a member."""

    @abc.abstractmethod
    def with_states(self, K: AbstractMatrixKernel) -> "AbstractJoinedKernel":
        """This kernel with `state_kernel` replaced by K."""

    @abc.abstractmethod
    def check_identified(self, U: Float[np.ndarray, "N m"]) -> None:
        """Raise a ValueError if data with the inputs U do not determine how f depends on u."""

    @property
    def known_matrix(self) -> Any:
        """The `KnownMatrix` G if the field contains a known G u; else None."""
        return None

    def coefficients_at(self, u: Float[Array, " m"], U: Float[Array, "M m"], A: Points) -> Points:
        """The coefficients b with Σⱼ K((x, u), (zⱼ, uⱼ)) aⱼ = Σⱼ K_states(x, zⱼ) bⱼ.

        For `Controlled` we take the drift, u = 0, so b = a.
        """
        return A

    def with_count(self, count: int) -> "AbstractJoinedKernel":
        """This kernel with m = `count`."""
        return dataclasses.replace(self, count=count)

    @property
    def no_potential(self) -> str | None:
        return self.state_kernel.no_potential

    @property
    def has_hamiltonian(self) -> bool:
        """Whether the fields of x alone have a Hamiltonian."""
        return self.state_kernel.has_hamiltonian

    def dissipated_power(self, x: Point, slope: Point) -> Float[Array, ""]:
        return self.state_kernel.dissipated_power(x, slope)

    def outputs(self, inputs: int) -> int:
        return inputs - self.input_count

    @property
    def input_count(self) -> int:
        """The number m of inputs or parameters; a ValueError if m is not known yet."""
        if self.count is None:
            raise ValueError(
                f"the number of {self.input_name} of this {type(self).__name__} kernel is not "
                f"known: pass them, hk.fit(K, X, Y, {self.input_name}=U), or make the kernel with "
                "count=1."
            )
        return self.count

    def split(self, s: Any) -> tuple[Any, Any]:
        """The pair (X, U) of joined points, or (x, u) of one point."""
        n = self.outputs(s.shape[-1])
        return s[..., :n], s[..., n:]

    def child_inputs(
        self, child: Any, X: Float[np.ndarray, "N d"], amplitude: float
    ) -> tuple[Float[np.ndarray, "N _"], float]:
        """The data in the coordinates of the part `child`, and a plausible amplitude of this part.

        Both set the bounds of the hyperparameters of the part. By default its coordinates are the
        states.
        """
        return self.split(X)[0], amplitude

    def check_dimension(self, n: int) -> None:
        """Raise a ValueError if points (x, u) of n coordinates cannot have this structure."""
        if self.outputs(n) < 1:
            raise ValueError(
                f"points (x, u) with {self.input_count} {self.input_name} have no coordinates left."
            )
        self.state_kernel.check_dimension(self.outputs(n))

    def check_points(self, X: Float[Array, "N d"]) -> None:
        self.check_dimension(X.shape[1])
        self.state_kernel.check_points(self.split(X)[0])

    def with_parity(self, parity: int) -> AbstractMatrixKernel:
        raise TypeError(f"Odd and Even belong inside: give them to {self.inner}(Odd(K), …).")

    def average_over(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(
            f"a symmetry belongs inside: give it to {self.inner}(Invariant(K, maps), …)."
        )

    @property
    def invariance(self) -> Invariance:
        return Invariance.NONE

    def __radd__(self, other: Any) -> Any:
        if isinstance(other, AbstractMatrixKernel):
            return Sum(other, self)  # raises with the reason why there is no such sum
        return super().__radd__(other)


class InputMatrix(eqx.Module):
    """The prior of an unknown input matrix G(x), shape (n, m), for `Controlled`.

    The entries in the rows `acts_on` are independent functions in the RKHS of one scalar kernel.
    The other rows are zero: a torque, for example, acts on momenta and not on positions.

    Args:
        kernel: a scalar kernel, for a G that depends on the state; or a positive number, the prior
            variance of the entries of a constant G, in squared units of velocity per input.
        acts_on: the coordinates on which inputs act, counted from 0; all if None.

    Raises:
        TypeError: `kernel` is neither a kernel nor a number.
        ValueError: the variance is not positive, or `acts_on` are no coordinates.

    Example: `hk.Controlled(K, inputs=hk.InputMatrix(hk.Gaussian(2.0), acts_on=(1,)))`.
    """

    kernel: AbstractScalarKernel
    acts_on: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(self, kernel: Any, acts_on: Any = None):
        if callable(kernel):
            self.kernel = as_scalar_kernel(kernel)
        else:
            variance = require.positive_scalar(kernel, "the variance of a constant input matrix")
            self.kernel = Scaled(Constant(), variance)
        self.acts_on = None if acts_on is None else require.coordinates(acts_on, "acts_on")

    def __repr__(self) -> str:
        return describe(self, positional=("kernel",))

    def rows(self, n: int, dtype: Any) -> Float[Array, " n"]:
        """The vector with 1 for the nonzero rows of G and 0 for the others."""
        if self.acts_on is None:
            return jnp.ones(n, dtype)
        return jnp.zeros(n, dtype).at[np.asarray(self.acts_on)].set(1.0)


class KnownMatrix(eqx.Module):
    """A known constant input matrix G, stored as Python numbers, which `tune` does not train."""

    entries: tuple[tuple[float, ...], ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        return repr([list(row) for row in self.entries])

    @property
    def matrix(self) -> np.ndarray:
        """The matrix G, shape (n, m)."""
        return np.asarray(self.entries)


class Controlled(AbstractJoinedKernel):
    """The kernel of fields with inputs, f(x, u) = f(x) + G(x) u, with f in the RKHS of K.

    Pass the inputs of each point to `fit`, `tune` and the losses: `hk.fit(K, X, Y, λ, inputs=U)`
    with U of shape (N, m). The result is `field(x, u)`. `field.drift(x)` is f, an ordinary field of
    K with its Hamiltonian, and `field.input_matrix(x)` is G.

    For a field that depends on time, take u = t, or u = (cos ωt, sin ωt). The field is then
    f(x) + G(x) u(t); simulate it by `hk.simulate(field, x0, ts, inputs=lambda t: jnp.array([t]))`.

    Vary every input: the data cannot distinguish a constant input from the drift, and `fit` refuses
    a constant input unless G is known.

    Args:
        drift: K, the structured kernel of f.
        inputs: an `InputMatrix`, if G is unknown; or a known constant G, an array (n, m).
        count: the number m of inputs; if None, `fit` takes m from the data.

    Raises:
        TypeError: `drift` is not matrix-valued, or `inputs` is neither an `InputMatrix` nor an
            array.
        ValueError: a known G is no finite matrix.

    Example: `hk.Controlled(hk.PortHamiltonian(k), inputs=hk.InputMatrix(1.0, acts_on=(1,)))`.

    Source: Beckers et al. (2022) for the process; Castañeda et al. (2021) for the kernel of a
        function that is affine in u.
    """

    drift: AbstractMatrixKernel
    inputs: InputMatrix | KnownMatrix
    count: int | None = eqx.field(static=True)

    input_name: ClassVar[str] = "inputs"
    inner: ClassVar[str] = "the drift: Controlled"

    def __init__(self, drift: AbstractMatrixKernel, inputs: Any, count: int | None = None):
        self.drift = matrix_kernel(drift, "the drift of Controlled", "Controlled(Symplectic(k), …)")
        if self.drift.takes_inputs:
            raise TypeError(
                f"the drift of Controlled is a {type(self.drift).__name__}, which takes inputs or "
                "parameters itself: give all inputs to one Controlled."
            )
        if isinstance(inputs, InputMatrix | KnownMatrix):
            self.inputs = inputs
        elif callable(inputs) or isinstance(inputs, str):
            raise TypeError(
                "inputs must be hk.InputMatrix(k, acts_on=(1,)), for an unknown input matrix, or a "
                f"known one as an array (n, m); got {inputs!r}. If G(x) is a known function, fit"
                " with mean=lambda x, u: G(x) @ u, and pass an array of zeros here."
            )
        else:
            self.inputs = KnownMatrix(_entries(inputs))
        G = self.inputs
        self.count = G.matrix.shape[1] if isinstance(G, KnownMatrix) else count

    @property
    def state_kernel(self) -> AbstractMatrixKernel:
        """The kernel of the drift."""
        return self.drift

    def with_states(self, K: AbstractMatrixKernel) -> "Controlled":
        return Controlled(K, self.inputs, self.count)

    @property
    def known_matrix(self) -> KnownMatrix | None:
        return self.inputs if isinstance(self.inputs, KnownMatrix) else None

    @property
    def has_constant_matrix(self) -> bool:
        """Whether the input matrix is known, or unknown and constant."""
        k = None if isinstance(self.inputs, KnownMatrix) else self.inputs.kernel
        return k is None or isinstance(k.kernel if isinstance(k, Scaled) else k, Constant)

    @property
    def conserves(self) -> bool:
        """False: the inputs do work."""
        return False

    def check_identified(self, U: Float[np.ndarray, "N m"]) -> None:
        """Raise a ValueError if a combination of the inputs is the same at all points."""
        if self.known_matrix is not None:
            return
        rank = int(np.linalg.matrix_rank(U - U.mean(axis=0)))
        if rank < U.shape[1]:
            raise ValueError(
                f"the inputs, less their means, have rank {rank} and there are {U.shape[1]}: a "
                "combination of inputs is the same at all points, so the data cannot distinguish "
                "its effect from the drift. Vary every input on its own, leave out inputs that "
                "repeat others, or give a known matrix, Controlled(K, inputs=G)."
            )

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        (x, inputs), (z, other_inputs) = self.split(x), self.split(z)
        drift = self.drift.form(x, u, z, v)
        if isinstance(self.inputs, KnownMatrix):
            return drift
        rows = self.inputs.rows(len(x), x.dtype)
        return drift + (inputs @ other_inputs) * self.inputs.kernel(x, z) * ((u * rows) @ v)

    def expansion(self, x: JointPoint, Z: JointPoints, A: Points) -> Point:
        (x, u), (Z, U) = self.split(x), self.split(Z)
        drift = self.drift.expansion(x, Z, A)
        if isinstance(self.inputs, KnownMatrix):
            return drift
        row = jax.vmap(self.inputs.kernel, in_axes=(None, 0))(x, Z)
        G = A.T @ (row[:, None] * U)  # (n, m)
        return drift + self.inputs.rows(len(x), x.dtype) * (G @ u)

    def potential(self, x: JointPoint, Z: JointPoints, A: Points) -> Float[Array, ""]:
        return self.drift.potential(self.split(x)[0], self.split(Z)[0], A)

    def potential_covariance(self, x: JointPoint, z: JointPoint) -> Float[Array, ""]:
        return self.drift.potential_covariance(self.split(x)[0], self.split(z)[0])

    def centre(self, Z: Float[Array, "M d"]) -> Float[Array, " d"] | None:
        states, inputs = self.split(Z)
        centre, G = self.drift.centre(states), self.inputs
        shifts = isinstance(G, KnownMatrix) or Invariance.TRANSLATION in G.kernel.invariance
        if centre is None or not shifts:
            return None
        return jnp.concatenate([centre, jnp.zeros_like(inputs[0])])

    def check_dimension(self, n: int) -> None:
        """Raise a ValueError if points (x, u) of n coordinates cannot have this structure."""
        super().check_dimension(n)
        n = self.outputs(n)
        if isinstance(self.inputs, KnownMatrix):
            if len(self.inputs.matrix) != n:
                raise ValueError(
                    f"the known input matrix has shape {self.inputs.matrix.shape} and states have "
                    f"{n} coordinates: (n, m) is needed."
                )
        elif self.inputs.acts_on is not None and max(self.inputs.acts_on) >= n:
            raise ValueError(
                f"acts_on = {self.inputs.acts_on} names a coordinate that does not exist: the "
                f"states have {n}, counted from 0."
            )

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        input_kernels = (self.inputs.kernel,) if isinstance(self.inputs, InputMatrix) else ()
        return (*self.drift.scalar_kernels, *input_kernels)


def _entries(matrix: Any) -> tuple[tuple[float, ...], ...]:
    array = np.asarray(require.floating(matrix, "the known input matrix"), float)
    if array.ndim != 2 or not np.isfinite(array).all():
        raise ValueError(
            f"the known input matrix has shape {array.shape}; a finite array (n, m), one column "
            "for each input, is needed, such as [[0.0], [1.0]]."
        )
    return tuple(tuple(row) for row in array.tolist())
