"""Fields B(x)∇H with the caller's operator B, and Poisson systems, whose B is antisymmetric."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import Invariance, as_scalar_kernel
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import call, text
from hamkernel._structures.linear_operator import StructuredByOperator
from hamkernel._structures.structure import (
    AbstractPotentialKernel,
    AbstractStructure,
    check_symmetries,
)

Operator = Callable[[Float[Array, " n"]], Any]


class AbstractCustomOperator(AbstractPotentialKernel):
    """A structure whose B(x) is the caller's function, stored in the attribute named by `role`."""

    role: AbstractClassVar[str]
    name: AbstractClassVar[str]  # the public name of the structure

    operator_invariance: ClassVar[Invariance] = Invariance.NONE
    symplectic: ClassVar[bool] = False
    has_hamiltonian: ClassVar[bool] = True

    def _check_values(self, matrices: Float[np.ndarray, "N n n"], X: Float[Array, "N n"]) -> None:
        """Raise a ValueError unless B at the points X has the property of the structure."""

    def apply(self, x: Float[Array, " n"], v: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        return self._matrix(x) @ v

    def apply_transpose(self, x: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        return v @ self._matrix(x)

    def _matrix(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The matrix B(x) in the dtype of x."""
        value, n = getattr(self, self.role)(x), len(x)
        name = f"the {self.role} of {self.name}"
        value = require.floating(value, f"the value of {name}")
        cure = "Write it for one state, and return jnp.array([[...], [...]])."
        require.shape(value, f"{name} returned", "a matrix for each state", (n, n), cure=cure)
        return value.astype(x.dtype)

    def check_dimension(self, n: int) -> None:
        with require.traceable(f"the {self.role} of {self.name}"):
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
                f"{text(getattr(self, self.role))} of {self.name} is NaN or infinite at "
                f"X[{int(bad.argmax())}]: it must be defined at every state of the data."
            )
        self._check_values(matrices, X)
        check_symmetries(self, X[:16])  # more than one point, since B may be zero at one


class StructuredByMatrix(AbstractCustomOperator):
    """K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ: fields f = B(x)∇H for an operator B of the caller."""

    operator: Operator

    role: ClassVar[str] = "operator"
    name: ClassVar[str] = "Structured"
    conserves: ClassVar[bool] = False

    def __repr__(self) -> str:
        return call("Structured", [repr(self.kernel), text(self.operator)])


def Structured(kernel: Any, operator: Callable[..., Any]) -> AbstractStructure:
    """The kernel of the fields f = L u, with a linear operator L of your own on a potential u.

        operator(x) -> (n, n)        f(x) = B(x)∇u(x),    K(x, z) = B(x) [∂x ∂zᵀ k(x, z)] B(z)ᵀ
        operator(u, x) -> (n,)       f(x) = (L u)(x),     K(x, z) = L_x L_z k(x, z)

    The rest of the library works with both forms: `tune` trains the arrays in the operator, and
    `save` stores them. `load` needs the kernel again, since the file does not contain its code.
    Fields B(x)∇u have `.hamiltonian(x)` and `.dissipation(x)` = −∇HᵀB∇H, and are faster. Fields L u
    have `.potential(x)`.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        operator: a function written with jax.numpy. With one argument it is B, with two L. In L, u
            is a function (n,) -> () that `jax.grad`, `jax.hessian` and so on differentiate, to any
            order p for which k has 2p derivatives. The value must be linear in u. `tune` trains the
            array leaves of an Equinox module; store positive numbers as `log_…`.

    Raises:
        TypeError: `kernel` is not a scalar kernel, or `operator` not a function.
        ValueError: with data, if the operator returns another shape, or is not finite at the data;
            if L is not linear in u; or if k is too rough for L.

    Example: friction that grows with the height of a pendulum, and the flow of a vorticity,

        class Draught(eqx.Module):
            log_strength: jax.Array = jnp.log(jnp.array(0.1))

            def __call__(self, x):
                r = jnp.exp(self.log_strength) * (1 - jnp.cos(x[0]))
                return jnp.array([[0.0, 1.0], [-1.0, -r]])

        field = hk.fit(hk.Structured(hk.Gaussian(1.0), Draught()), X, Y)
        field.hamiltonian(x), field.dissipation(x)

        def flow(u, x):  # J∇(u − Δu)
            return J @ jax.grad(lambda x: u(x) - jnp.trace(jax.hessian(u)(x)))(x)

        field = hk.fit(hk.Structured(hk.Gaussian(1.0), flow), X, Y)
    """
    function = _operator_function(operator, "Structured", "operator")
    made_by: Any = StructuredByOperator if require.takes_two(operator) else StructuredByMatrix
    return made_by(as_scalar_kernel(kernel), function)


class Poisson(AbstractCustomOperator):
    """K(x, z) = Π(x) [∂x ∂zᵀ k(x, z)] Π(z)ᵀ: Poisson systems f = Π(x)∇H, Π antisymmetric.

    n may be even or odd. Every field conserves H, dH/dt = ∇HᵀΠ∇H = 0, and the Casimirs C with
    Π(x)∇C = 0. `field.hamiltonian(x)` is H, which is known up to functions of the Casimirs. Π need
    not satisfy the Jacobi identity.

    `hk.poisson` has the tensors `rigid_body` (n = 3), `lotka_volterra` (n = 2), and
    `charged_particle(B)` (n = 4 or 6). If H is harder to learn than f, use `Separable`: for
    Lotka-Volterra, for example, H contains logarithms of the populations and f does not.

    Args:
        kernel: the scalar kernel k: one of the library, or any callable (x, z) -> ().
        tensor: Π, a function x (n,) -> (n, n) written with jax.numpy. `tune` trains the array
            leaves of an Equinox module.

    Raises:
        TypeError: `kernel` is not a scalar kernel, or `tensor` not a function.
        ValueError: with data, if Π is not an (n, n) array, or not antisymmetric at the data.

    Source: Hu, Ortega & Yin (2024), arXiv 2403.10070 and 2504.13396.
    """

    tensor: Operator

    role: ClassVar[str] = "tensor"
    name: ClassVar[str] = "Poisson"
    conserves: ClassVar[bool] = True

    def __init__(self, kernel: Any, tensor: Operator):
        self.kernel = as_scalar_kernel(kernel)
        self.tensor = _operator_function(tensor, "Poisson", "tensor")

    def _check_values(self, matrices, X) -> None:
        size = np.abs(matrices).max(axis=(1, 2))
        symmetric = np.abs(matrices + np.swapaxes(matrices, 1, 2)).max(axis=(1, 2)) / 2
        # By rounding in float32 the symmetric part is 1e-7 of Π. If a sign is wrong, it is 1.
        worst = int(np.argmax(symmetric - 1e-6 * size))
        if symmetric[worst] > 1e-6 * size[worst]:
            raise ValueError(
                f"the tensor of Poisson is not antisymmetric: at X[{worst}] = "
                f"{np.round(np.asarray(X[worst]), 4).tolist()} its symmetric part is as large as "
                f"{symmetric[worst]:.3g}, beside entries of {size[worst]:.3g}. Energy would not be "
                "conserved. For B(x) with friction use Structured(k, operator) or PortHamiltonian."
            )


def _operator_function(fn: Any, whose: str, name: str) -> Operator:
    if fn is charged_particle:
        raise TypeError(_NO_TENSOR)
    if isinstance(fn, type) or not callable(fn):
        raise TypeError(
            f"{whose}(k, {name}) needs a function x (n,) -> (n, n) as {name}; got {fn!r}. A "
            "constant matrix M is `lambda x: M`."
        )
    return as_pytree(fn)


_NO_TENSOR = (
    "charged_particle is a function that makes a tensor: call it with the magnetic field, "
    "hk.Poisson(k, hk.poisson.charged_particle(1.0))."
)


class _AbstractTensor(eqx.Module):
    """A tensor Π of this library."""

    @abc.abstractmethod
    def _value(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The matrix Π(x) at one state."""

    def __call__(self, *x: Float[Array, " n"]) -> Float[Array, "n n"]:
        if len(x) != 1 or jnp.ndim(x[0]) == 0:
            raise TypeError(
                f"{self!r} is a tensor, a function of one state (n,), and takes no parameters: "
                f"write hk.Poisson(k, hk.poisson.{self!r}), without brackets after the name."
            )
        return self._value(x[0])


class RigidBodyTensor(_AbstractTensor):
    """The tensor Π(L) v = L × v of the free rigid body, L̇ = L × ∇H(L), n = 3.

    L is the angular momentum in the frame of the body, and ∇H the angular velocity. |L|² is a
    Casimir.
    """

    def __repr__(self) -> str:
        return "rigid_body"

    def _value(self, x: Float[Array, "3"]) -> Float[Array, "3 3"]:
        return _cross(require.point(x, 3, "the state of rigid_body"))


class LotkaVolterraTensor(_AbstractTensor):
    """The tensor Π(x, y) = [[0, −xy], [xy, 0]] of prey x and predators y, n = 2.

    H = δx − γ log x + βy − α log y gives ẋ = αx − βxy and ẏ = δxy − γy. With the logarithms of the
    populations as states, Π is −J, and H is easier to learn.
    """

    def __repr__(self) -> str:
        return "lotka_volterra"

    def _value(self, x: Float[Array, "2"]) -> Float[Array, "2 2"]:
        prey, predators = require.point(x, 2, "the state of lotka_volterra")
        product = prey * predators
        zero = jnp.zeros_like(product)
        return jnp.stack([jnp.stack([zero, -product]), jnp.stack([product, zero])])


class ChargedParticleTensor(_AbstractTensor):
    """The tensor Π(q, p) = [[0, I], [−I, F(q)]] of a charge in a magnetic field, F v = v × B.

    B is the charge times the field. p is the kinetic momentum mq̇, so H = |p|²/(2m) + U(q) contains
    no vector potential.
    """

    field: Any  # B as a function of q; None if B is constant
    constant: tuple[float, ...] | None = eqx.field(static=True)  # the components of a constant B

    def __repr__(self) -> str:
        return call(
            "charged_particle", [text(self.field if self.constant is None else self.constant)]
        )

    def _value(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        n = len(x)
        if n not in (4, 6):
            raise ValueError(
                f"charged_particle is for states (q, p) in the plane, n = 4, or in space, n = 6; "
                f"got n = {n}."
            )
        half = n // 2
        needed = 1 if n == 4 else 3
        B = self.field(x[:half]) if self.constant is None else jnp.asarray(self.constant, x.dtype)
        B = jnp.asarray(B, x.dtype).reshape(-1)
        if B.size != needed:
            raise ValueError(
                f"the magnetic field has {B.size} components and states of n = {n} coordinates "
                f"need {needed}: one for motion in a plane, n = 4, three for motion in space, 6."
            )
        one = jnp.eye(half, dtype=x.dtype)
        turn = B[0] * jnp.asarray([[0.0, 1.0], [-1.0, 0.0]], x.dtype) if n == 4 else -_cross(B)
        return jnp.concatenate(
            [
                jnp.concatenate([jnp.zeros_like(one), one], axis=1),
                jnp.concatenate([-one, turn], axis=1),
            ]
        )


def _cross(a: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of v ↦ a × v."""
    zero = jnp.zeros_like(a[0])
    rows = [[zero, -a[2], a[1]], [a[2], zero, -a[0]], [-a[1], a[0], zero]]
    return jnp.stack([jnp.stack(row) for row in rows])


rigid_body = RigidBodyTensor()
lotka_volterra = LotkaVolterraTensor()


def charged_particle(
    magnetic_field: ArrayLike | Callable[[Array], Any] = 1.0,
) -> ChargedParticleTensor:
    """The tensor of a charge in a magnetic field: q̇ = ∂H/∂p, ṗ = −∂H/∂q + ∂H/∂p × B.

    Args:
        magnetic_field: e·B, the charge times the field. One number for motion in a plane normal to
            the field, n = 4; three numbers for motion in space, n = 6. Or a function of the
            position q that returns these numbers. Numbers are fixed; `tune` trains the arrays of an
            Equinox module.

    Returns:
        Π, for `hk.Poisson(k, hk.poisson.charged_particle(2.0))`. p is the KINETIC momentum mq̇.

    Raises:
        ValueError: the field has another number of components, or is not finite.
        TypeError: JAX traces the field, as in `hk.Poisson(k, charged_particle)` without a call.

    Source: Littlejohn (1979), J. Math. Phys. 20, 2445, eq. (5).
    """
    if not require.is_concrete(magnetic_field):
        raise TypeError(_NO_TENSOR)
    if callable(magnetic_field):
        return ChargedParticleTensor(as_pytree(magnetic_field), None)
    array = np.atleast_1d(np.asarray(require.floating(magnetic_field, "the magnetic field"), float))
    if array.shape not in ((1,), (3,)) or not np.isfinite(array).all():
        raise ValueError(
            f"the magnetic field is {magnetic_field!r}; one finite number for motion in a plane, or"
            " three for motion in space, is needed."
        )
    return ChargedParticleTensor(None, tuple(array.tolist()))
