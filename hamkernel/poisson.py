"""Ready-made tensors Π(x) for `hk.Poisson(k, tensor)`: fields f = Π(x)∇H.

    hk.Poisson(k, hk.poisson.rigid_body)            # angular momenta of a body, n = 3
    hk.Poisson(k, hk.poisson.lotka_volterra)        # two populations, n = 2
    hk.Poisson(k, hk.poisson.charged_particle(B))   # in a magnetic field, n = 4 or 6

Each is a function x (n,) -> (n, n), which a saved field stores by name. Any such function of your
own will do.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import call, text

__all__ = ["charged_particle", "lotka_volterra", "rigid_body"]


class RigidBodyTensor(eqx.Module):
    """Π(L) v = L × v: the free rigid body, L̇ = L × ∇H(L), L the angular momentum in the body.

    n = 3. The Casimir is |L|². ∇H is the angular velocity.
    """

    def __repr__(self) -> str:
        return "rigid_body"

    def __call__(self, x: Float[Array, "3"]) -> Float[Array, "3 3"]:
        return _cross(require.point(x, 3, "the state of rigid_body"))


class LotkaVolterraTensor(eqx.Module):
    """Π(x, y) = [[0, −xy], [xy, 0]]: prey x and predators y, n = 2.

    With H = δx − γ log x + βy − α log y it gives ẋ = αx − βxy and ẏ = δxy − γy. In the logarithms
    of the populations Π is J, up to its sign, and H is far easier to learn.
    """

    def __repr__(self) -> str:
        return "lotka_volterra"

    def __call__(self, x: Float[Array, "2"]) -> Float[Array, "2 2"]:
        prey, predators = require.point(x, 2, "the state of lotka_volterra")
        product = prey * predators
        zero = jnp.zeros_like(product)
        return jnp.stack([jnp.stack([zero, -product]), jnp.stack([product, zero])])


class ChargedParticleTensor(eqx.Module):
    """Π(q, p) = [[0, I], [−I, F(q)]], F v = v × B: a charge in a magnetic field B, as e·B.

    p is the kinetic momentum mq̇, so that H = |p|²/(2m) + U(q) contains no vector potential.
    """

    field: Any  # numbers, which are static, or a function of q
    constant: tuple[float, ...] | None = eqx.field(static=True)

    def __repr__(self) -> str:
        return call(
            "charged_particle", [text(self.field if self.constant is None else self.constant)]
        )

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
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
        magnetic_field: e·B, the charge times the field: one number for motion in a plane normal to
            the field, n = 4; three for motion in space, n = 6; or a function of the position q that
            returns as many. Numbers are fixed; the arrays of an Equinox module are tuned.

    Returns:
        Π, for `hk.Poisson(k, hk.poisson.charged_particle(2.0))`. p is the KINETIC momentum mq̇.

    Raises:
        ValueError: the field has another number of components, or is not finite. TypeError: it is
            traced by JAX, as a state is where `charged_particle` itself is given as the tensor.

    Source: Littlejohn (1979), J. Math. Phys. 20, 2445, eq. (5).
    """
    if not require.is_concrete(magnetic_field):
        raise TypeError(
            "charged_particle makes a tensor and is not one itself: give it the magnetic field, "
            "hk.Poisson(k, hk.poisson.charged_particle(1.0))."
        )
    if callable(magnetic_field):
        return ChargedParticleTensor(as_pytree(magnetic_field), None)
    array = np.atleast_1d(np.asarray(require.floating(magnetic_field, "the magnetic field"), float))
    if array.shape not in ((1,), (3,)) or not np.isfinite(array).all():
        raise ValueError(
            f"the magnetic field is {magnetic_field!r}; one finite number for motion in a plane, or"
            " three for motion in space, is needed."
        )
    return ChargedParticleTensor(None, tuple(array.tolist()))
