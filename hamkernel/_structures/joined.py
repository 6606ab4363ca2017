"""Kernels of joined points (x, u): a state x, and what is given beside it.

That is what was applied, the inputs of `Controlled`, or which member of a family it was, the
parameters of `Family`. Points have n + m coordinates and fields n components, and everything
downstream asks a kernel for its `outputs`.
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
from hamkernel._kernels.base import Invariance, Points, one_point
from hamkernel._kernels.symmetry import LinearMap
from hamkernel._structures.base import AbstractMatrixKernel, Sum


class AbstractJoinedKernel(AbstractMatrixKernel):
    """A kernel of points (x, u), u of shape (m,).

    Attributes:
        count: m; None until the data says it.
        given: the name of u in `fit`: "inputs" or "parameters".
        inner: what has a symmetry, and where to say it.
    """

    count: eqx.AbstractVar[int | None]
    given: eqx.AbstractClassVar[str]
    inner: eqx.AbstractClassVar[str]

    symplectic: ClassVar[bool] = False  # a flow moves the states alone
    takes_inputs: ClassVar[bool] = True

    @property
    @abc.abstractmethod
    def of_states(self) -> AbstractMatrixKernel:
        """The kernel of fields of x alone: that of the drift, or of a member."""

    @abc.abstractmethod
    def check_identified(self, U: Float[np.ndarray, "N m"]) -> None:
        """ValueError if data with these u cannot say how the field depends on u."""

    @property
    def known_matrix(self) -> Any:
        """The `KnownMatrix` G, where the field contains G u and the kernel learns the rest."""
        return None

    def coefficients_at(self, u: Float[Array, " m"], U: Float[Array, "M m"], A: Points) -> Points:
        """The coefficients with which `of_states` makes the field at u of those of joined points.

        For `Controlled` u is zero, and these are the same.
        """
        return A

    def with_count(self, count: int) -> "AbstractJoinedKernel":
        """This kernel with m = `count`."""
        return dataclasses.replace(self, count=count)

    @property
    def no_potential(self) -> str | None:
        return self.of_states.no_potential

    @property
    def has_hamiltonian(self) -> bool:
        """Whether the fields of x alone have a Hamiltonian."""
        return self.of_states.has_hamiltonian

    def dissipated(self, x: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, ""]:
        return self.of_states.dissipated(x, slope)

    def outputs(self, inputs: int) -> int:
        return inputs - self.input_count

    @property
    def input_count(self) -> int:
        """m; ValueError while nobody has said it."""
        if self.count is None:
            raise ValueError(
                f"this {type(self).__name__} kernel does not know how many {self.given} there are: "
                f"give them, hk.fit(K, X, Y, {self.given}=U), or say count=1 when it is made."
            )
        return self.count

    def split(self, s: Any) -> tuple[Any, Any]:
        """X and U of joined points, or x and u of one."""
        n = self.outputs(s.shape[-1])
        return s[..., :n], s[..., n:]

    def seen_by(
        self, child: Any, X: Float[np.ndarray, "N d"], amplitude: float
    ) -> tuple[Float[np.ndarray, "N _"], float]:
        """The data in the coordinates of a part of this kernel, and a plausible factor of it.

        They set the bounds of the hyperparameters of the part, which are states by default.
        """
        return self.split(X)[0], amplitude

    def __call__(self, x: Float[Array, " d"], z: Float[Array, " d"]) -> Float[Array, "n n"]:
        """The block for two joined points (x, u)."""
        x, z = require.same_space(one_point(x)[None], one_point(z)[None])
        self.check_points(x)
        basis = jnp.eye(self.outputs(x.shape[1]), dtype=x.dtype)
        columns = jax.vmap(self.form, in_axes=(None, None, None, 0))
        return jax.vmap(columns, in_axes=(None, 0, None, None))(x[0], basis, z[0], basis)

    def check_dimension(self, n: int) -> None:
        """`n` counts the coordinates of u, too."""
        if self.outputs(n) < 1:
            raise ValueError(
                f"points (x, u) with {self.input_count} {self.given} have no coordinates left."
            )
        self.of_states.check_dimension(self.outputs(n))

    def check_points(self, X: Float[Array, "N d"]) -> None:
        self.check_dimension(X.shape[1])
        self.of_states.check_points(self.split(X)[0])

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        return False

    def with_parity(self, parity: int) -> AbstractMatrixKernel:
        raise TypeError(f"say the symmetry of {self.inner}(Odd(K), …).")

    def averaged(self, maps: tuple[LinearMap, ...]) -> AbstractMatrixKernel:
        raise TypeError(f"say the symmetry of {self.inner}(Invariant(K, maps), …).")

    @property
    def invariance(self) -> Invariance:
        return Invariance.NONE

    def __radd__(self, other: Any) -> Any:
        if isinstance(other, AbstractMatrixKernel):
            return Sum(other, self)  # which says why there is none
        return super().__radd__(other)
