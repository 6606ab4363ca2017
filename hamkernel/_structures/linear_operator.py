"""Fields L u with a linear differential operator L of the caller, of any order."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import Invariance, Point, Points
from hamkernel._machine import precise_jit
from hamkernel._show import call, text
from hamkernel._structures.structure import AbstractStructure

Potential = Callable[[Float[Array, " n"]], Float[Array, ""]]


class StructuredByOperator(AbstractStructure):
    """K(x, z) = L_x L_z k(x, z): fields f = L u for a linear operator L on functions u.

    We apply the operator to k twice, in z and then in x:

        vᵀ(L_z k)(x) = v · operator(z ↦ k(x, z), z),    K(x, z) v = operator(x ↦ vᵀ(L_z k)(x), x).

    An operator of order p therefore takes derivatives of k of order 2p.
    """

    operator: Callable[[Potential, Float[Array, " n"]], Any]

    field_parity: ClassVar[int] = 0
    operator_invariance: ClassVar[Invariance] = Invariance.NONE
    symplectic: ClassVar[bool] = False
    no_potential: ClassVar[str | None] = None

    def __repr__(self) -> str:
        return call("Structured", [repr(self.kernel), text(self.operator)])

    def _apply(self, u: Potential, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The value (L u)(x) in the dtype of x."""
        value = self.operator(u, x)
        name, cure = "the operator of Structured", "It is, for example, jax.grad(u)(x)."
        require.shape(value, f"{name} returned", "the field at one state", x.shape, cure=cure)
        return require.floating(value, name).astype(x.dtype)

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        return u @ self.expansion(x, z[None], v[None])

    def potential(self, x: Point, Z: Points, A: Points) -> Float[Array, ""]:
        def covariance(z, a):  # Cov(u(x), a·f(z))
            return a @ self._apply(lambda z: self.kernel(x, z), z)

        return jax.vmap(covariance)(Z, A).sum()

    def potential_covariance(self, x: Point, z: Point) -> Float[Array, ""]:
        return self.kernel(x, z)

    def expansion(self, x: Point, Z: Points, A: Points) -> Point:
        return self._apply(lambda x: self.potential(x, Z, A), x)

    def average_over(self, maps: Any) -> AbstractStructure:
        raise TypeError(
            "the symmetry of an operator (u, x) is not known: if the operator has the symmetry, "
            "put Invariant inside, Structured(Invariant(k, maps), operator)."
        )

    def check_dimension(self, n: int) -> None:
        with require.traceable("the operator of Structured"):
            state = jax.ShapeDtypeStruct((n,), jnp.result_type(float))
            jax.eval_shape(lambda x: self.expansion(x, x[None], x[None]), state)

    def check_points(self, X: Float[Array, "N n"]) -> None:
        super().check_points(X)
        if not (require.is_concrete(X, self) and jnp.asarray(X).is_fully_addressable):
            return
        error, size, blocks, change = (np.asarray(a) for a in _values(self, X[:8]))
        if not (np.isfinite(blocks).all() and np.isfinite(size).all()):
            raise ValueError(
                "K(x, x) is NaN or infinite: the operator of Structured is not defined at every "
                "state of the data, or the kernel has too few derivatives for it. An operator of "
                "order p needs 2p derivatives of k, which Gaussian has for every p."
            )
        rounding = 1e4 * np.finfo(X.dtype).eps
        if (error > rounding * size).any():
            raise ValueError(
                "the operator of Structured is not linear in u: operator(2u - 3w, x) and "
                f"2 operator(u, x) - 3 operator(w, x) differ by {error.max():.3g}, of values up to "
                f"{size.max():.3g}. Every term must contain u once; a known term belongs in mean."
            )
        if (change > 0.1 * np.abs(blocks).max(axis=(1, 2))).any():
            raise ValueError(
                "K(x, x) is not the limit of K(x, x + h): the kernel is too rough for the operator "
                "of Structured. An operator of order p needs 2p derivatives of k on the diagonal, "
                "which Gaussian has for every p."
            )


@precise_jit
def _values(K: StructuredByOperator, X: Float[Array, "N n"]) -> tuple[Array, Array, Array, Array]:
    """The error of linearity, its scale, K(x, x), and |K(x, x + h) − K(x, x)|, for each point.

    h is 1e-4 standard deviations of the states. If the lengthscale l is a hundredth of them, a
    smooth kernel changes by (h/l)² = 1e-4 over h. A kernel that is too rough changes by its size.
    """
    h = 1e-4 * jnp.std(X, axis=0)

    def values(x):
        u, w = (lambda y: K.kernel(X[0], y)), (lambda y: K.kernel(x + h, y))
        both = K._apply(lambda y: 2 * u(y) - 3 * w(y), x)
        terms = 2 * K._apply(u, x), -3 * K._apply(w, x)
        error, size = both - sum(terms), jnp.abs(jnp.stack(terms))
        basis = jnp.eye(len(x), dtype=x.dtype)

        def block(z):
            return jax.vmap(lambda v: K.expansion(x, z[None], v[None]))(basis).T

        here = block(x)
        return jnp.abs(error).max(), size.max(), here, jnp.abs(block(x + h) - here).max()

    return jax.lax.map(values, X)
