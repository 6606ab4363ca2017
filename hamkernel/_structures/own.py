"""Fields B(x)∇H with an operator of the caller's; where it is antisymmetric, Poisson systems."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, Invariance, as_scalar_kernel
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import text
from hamkernel._structures.maps import check_symmetries
from hamkernel._structures.operators import AbstractPotentialKernel

Operator = Callable[[Float[Array, " n"]], Any]
_FEW = 16  # points at which a symmetry of B is checked: one would do, but for zeros
_SYMMETRIC = 1e-6  # of Π at the data: rounding in float32 leaves 1e-7, a wrong sign 1


class AbstractOwnOperator(AbstractPotentialKernel):
    """B(x) is a function of the caller's, the attribute that `role` names."""

    role: AbstractClassVar[str]

    operator_invariance: ClassVar[Invariance] = Invariance.NONE
    symplectic: ClassVar[bool] = False
    has_hamiltonian: ClassVar[bool] = True

    @abc.abstractmethod
    def _check_values(self, matrices: Float[np.ndarray, "N n n"], X: Float[Array, "N n"]) -> None:
        """ValueError unless B(x) is what the structure asks for at these points."""

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return self._matrix(x) @ v

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return v @ self._matrix(x)

    def _matrix(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """B(x), in the dtype of x."""
        value, n = getattr(self, self.role)(x), len(x)
        name = f"{self.role} of {type(self).__name__}"
        if jnp.shape(value) != (n, n):
            raise ValueError(
                f"the {name} returned shape {jnp.shape(value)} for a state of shape ({n},); an "
                f"array of shape ({n}, {n}) is needed, such as jnp.array([[...], [...]]). It was "
                "written for states of another dimension, or for many at once."
            )
        return require.floating(value, f"the {name}").astype(x.dtype)

    def check_dimension(self, n: int) -> None:
        with require.traceable(f"the {self.role} of {type(self).__name__}"):
            state = jax.ShapeDtypeStruct((n,), jnp.result_type(float))
            jax.eval_shape(lambda x: self.operator_at(x), state)

    def check_points(self, X: Float[Array, "N n"]) -> None:
        self.check_dimension(X.shape[1])
        if not require.is_concrete(X, self):
            return
        matrices = np.asarray(jax.vmap(self.operator_at)(X))
        bad = ~np.isfinite(matrices).all(axis=(1, 2))
        if bad.any():
            raise ValueError(
                f"{text(getattr(self, self.role))} of {type(self).__name__} is NaN or infinite at "
                f"X[{int(bad.argmax())}]: it must be defined at every state of the data."
            )
        self._check_values(matrices, X)
        check_symmetries(self, X[:_FEW])


class Structured(AbstractOwnOperator):
    """K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ: fields f = B(x)∇H for an operator B of your own.

    The rest of the library works with it: `tune` tunes the arrays in B, a field has its
    `.hamiltonian(x)` and its `.dissipation(x)` = −∇HᵀB∇H, and `save` keeps the arrays. As with
    kernels of your own, `load` needs the kernel again, since the file does not contain its code.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        operator: B, a function x (n,) -> (n, n) written with jax.numpy. The array leaves of an
            Equinox module are trained; store what is positive as `log_…`.

    Raises:
        TypeError: `kernel` is not a scalar kernel, or `operator` not a function. ValueError, with
            data: it does not return an (n, n) array, or is not finite there.

    Example: friction that grows with the height of a pendulum,

        class Draught(eqx.Module):
            log_strength: jax.Array = jnp.log(jnp.array(0.1))

            def __call__(self, x):
                r = jnp.exp(self.log_strength) * (1 - jnp.cos(x[0]))
                return jnp.array([[0.0, 1.0], [-1.0, -r]])

        field = hk.fit(hk.Structured(hk.Gaussian(1.0), Draught()), X, Y)
        field.hamiltonian(x), field.dissipation(x)
    """

    kernel: AbstractScalarKernel
    operator: Operator

    role: ClassVar[str] = "operator"
    conserves: ClassVar[bool] = False

    def __init__(self, kernel: Any, operator: Operator):
        self.kernel = as_scalar_kernel(kernel)
        self.operator = _checked(operator, "Structured", "operator")

    def _check_values(self, matrices, X) -> None:
        del matrices, X


class Poisson(AbstractOwnOperator):
    """K(x, z) = Π(x) [∂x ∂zᵀ k(x, z)] Π(z)ᵀ: Poisson systems f = Π(x)∇H, Π antisymmetric.

    Any n, even or odd: dH/dt = ∇HᵀΠ∇H = 0, and every field conserves the Casimirs C, Π(x)∇C = 0.
    `field.hamiltonian(x)` is H, known up to functions of the Casimirs. Π need not satisfy the
    Jacobi identity.

    Ready-made tensors in `hk.poisson`: `rigid_body` (n = 3), `lotka_volterra` (n = 2), and
    `charged_particle(B)` (n = 4 or 6). Where H is harder than f, structure loses: Lotka-Volterra in
    populations is easier for `Separable`, since H has their logarithms.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        tensor: Π, a function x (n,) -> (n, n) written with jax.numpy. The array leaves of an
            Equinox module are trained.

    Raises:
        TypeError: `kernel` is not a scalar kernel, or `tensor` not a function. ValueError, with
            data: Π is not an (n, n) array, or not antisymmetric there.

    Source: Hu, Ortega & Yin (2024), arXiv 2403.10070 and 2504.13396.
    """

    kernel: AbstractScalarKernel
    tensor: Operator

    role: ClassVar[str] = "tensor"
    conserves: ClassVar[bool] = True

    def __init__(self, kernel: Any, tensor: Operator):
        self.kernel = as_scalar_kernel(kernel)
        self.tensor = _checked(tensor, "Poisson", "tensor")

    def _check_values(self, matrices, X) -> None:
        size = np.abs(matrices).max(axis=(1, 2))
        symmetric = np.abs(matrices + np.swapaxes(matrices, 1, 2)).max(axis=(1, 2)) / 2
        worst = int(np.argmax(symmetric - _SYMMETRIC * size))
        if symmetric[worst] > _SYMMETRIC * size[worst]:
            raise ValueError(
                f"the tensor of Poisson is not antisymmetric: at X[{worst}] = "
                f"{np.round(np.asarray(X[worst]), 4).tolist()} its symmetric part is as large as "
                f"{symmetric[worst]:.3g}, beside entries of {size[worst]:.3g}. Energy would not be "
                "conserved. For B(x) with friction use Structured(k, operator) or PortHamiltonian."
            )


def _checked(fn: Any, whose: str, name: str) -> Operator:
    if isinstance(fn, type) or not callable(fn):
        raise TypeError(
            f"{whose}(k, {name}) needs a function x (n,) -> (n, n) as {name}; got {fn!r}. A "
            "constant matrix M is `lambda x: M`."
        )
    return as_pytree(fn)
