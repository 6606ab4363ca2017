"""Families of systems, f(x; θ), as kernels of the joined points (x, θ).

A member of the family is the field at one θ. With the kernel

    K((x, θ), (z, ϑ)) = k(θ, ϑ) K(x, z)

the members are fields of K, with all its structure, and k is the correlation between two members.
Data of some members therefore inform the fit of the others. Families with different k can be added.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Invariance,
    Point,
    Points,
    as_scalar_kernel,
)
from hamkernel._kernels.built_in import Constant
from hamkernel._show import call, join_terms
from hamkernel._structures.base import AbstractMatrixKernel, Sum, matrix_kernel, total
from hamkernel._structures.joined import AbstractJoinedKernel, JointPoint, JointPoints


class AbstractFamily(AbstractJoinedKernel):
    """The kernel Σᵢ kᵢ(θ, ϑ) Kᵢ(x, z) of a family, with one term or several."""

    input_name: ClassVar[str] = "parameters"
    inner: ClassVar[str] = "the members: Family"

    terms: eqx.AbstractVar[tuple["Family", ...]]

    @property
    def state_kernel(self) -> AbstractMatrixKernel:
        """The kernel K of the members; for several terms the sum of their kernels."""
        first, *rest = (term.member for term in self.terms)
        return Sum(first, *rest) if rest else first

    def with_states(self, K: AbstractMatrixKernel) -> "AbstractFamily":
        """ValueError: a family has a state kernel in each term, so we cannot replace one."""
        raise ValueError(
            "the kernel of the members cannot be replaced in a family: name it inside, as in "
            "hk.Family(hk.UnknownMasses(K, masses), k)."
        )

    @property
    def conserves(self) -> bool:
        """Whether every member conserves its H."""
        return self.state_kernel.conserves

    def check_identified(self, U: Float[np.ndarray, "N p"]) -> None:
        """Raise a ValueError if a coordinate of θ is the same at all points."""
        fixed = np.flatnonzero((U == U[:1]).all(axis=0))
        if fixed.size == U.shape[1]:
            raise ValueError(
                f"all {len(U)} points have the parameters {U[0].tolist()}, so the data contain one "
                "system and no family. Add data of other members, or fit without parameters, with "
                "the kernel inside of Family."
            )
        if fixed.size:
            i = int(fixed[0])
            raise ValueError(
                f"parameters[:, {i}] is {U[0, i]:g} at all points, so the data do not show how the "
                "field depends on it: leave it out, or add data of other members."
            )

    def form(self, x: Array, u: Array, z: Array, v: Array) -> Float[Array, ""]:
        (x, theta), (z, other_theta) = self.split(x), self.split(z)
        return total(
            [t.parameters(theta, other_theta) * t.member.form(x, u, z, v) for t in self.terms]
        )

    def expansion(self, x: JointPoint, Z: JointPoints, A: Points) -> Point:
        (x, theta), (Z, T) = self.split(x), self.split(Z)
        return total([t.member.expansion(x, Z, t.coefficients_at(theta, T, A)) for t in self.terms])

    def potential(self, x: JointPoint, Z: JointPoints, A: Points) -> Float[Array, ""]:
        self.check_potential()
        (x, theta), (Z, T) = self.split(x), self.split(Z)
        return total([t.member.potential(x, Z, t.coefficients_at(theta, T, A)) for t in self.terms])

    def potential_covariance(self, x: JointPoint, z: JointPoint) -> Float[Array, ""]:
        self.check_potential()
        (x, theta), (z, other_theta) = self.split(x), self.split(z)
        return total(
            [
                t.parameters(theta, other_theta) * t.member.potential_covariance(x, z)
                for t in self.terms
            ]
        )

    def centre(self, Z: Float[Array, "M d"]) -> Float[Array, " d"] | None:
        states, T = self.split(Z)
        centre = self.state_kernel.centre(states)
        if centre is None:
            return None
        shifts = all(Invariance.TRANSLATION in t.parameters.invariance for t in self.terms)
        return jnp.concatenate([centre, T.mean(axis=0) if shifts else jnp.zeros_like(T[0])])

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        """The scalar kernels of the members, functions of states."""
        return self.state_kernel.scalar_kernels

    def __add__(self, other: Any) -> Any:
        if not isinstance(other, AbstractMatrixKernel):
            return NotImplemented
        return FamilySum(self.terms + _family_terms(other))

    def __radd__(self, other: Any) -> Any:
        if isinstance(other, AbstractMatrixKernel):
            return FamilySum(_family_terms(other) + self.terms)
        return super().__radd__(other)


class Family(AbstractFamily):
    """A family of systems: K((x, θ), (z, ϑ)) = k(θ, ϑ) K(x, z).

    The parameters θ, shape (p,), distinguish the members: a length, a load, the coefficients of a
    potential, the time. Pass the θ of each point: `hk.fit(hk.Family(K, k), X, Y, λ, parameters=Θ)`
    with Θ of shape (N, p). The result is `field(x, θ)`. `field.at(θ)` is one member, an ordinary
    field of K.

    The terms of a sum may depend on θ in different ways, H = T(p) + U(q; θ):

        T, U = hk.Symplectic(hk.Select(k, (1,))), hk.Symplectic(hk.Select(k, (0,)))
        K = hk.Family(T) + hk.Family(U, hk.Gaussian(1.0))

    If both terms depend on θ, give each its own k. With one k for T + U the error of an unmeasured
    pendulum was .0051, with two .0039 (`tests/benchmarks/families.py`).

    Between measured members a family interpolates, and is more accurate than a separate model for
    each member. Outside the range of measured θ it is no better than separate models, and the
    deviation of `hk.condition` grows to the prior deviation over a lengthscale of k. This deviation
    is too small if the field changes faster with θ outside the range than inside, as 1/θ² does
    towards zero. Choose a θ with which the field changes at a uniform rate.

    For a drive of known frequency use `Controlled` with u = (cos ωt, sin ωt) instead, since the
    field is linear in u.

    Args:
        member: K, the structured kernel of each member.
        parameters: k, a scalar kernel of θ, without an amplitude, since K has one. The range of θ
            is a good first lengthscale. If None, all members are the same.
        count: the number p of parameters; if None, `fit` takes p from the data.

    Raises:
        TypeError: `member` is not matrix-valued, or takes inputs or parameters; or `parameters` is
            no scalar kernel.

    Source: Bonilla, Chai & Williams (2008); Álvarez, Rosasco & Lawrence (2012): the intrinsic model
        of coregionalisation, with k(θ, ϑ) instead of a matrix.
    """

    member: AbstractMatrixKernel
    parameters: AbstractScalarKernel
    count: int | None = eqx.field(static=True)

    def __init__(self, member: AbstractMatrixKernel, parameters: Any = None, count=None):
        self.member = matrix_kernel(member, "the members of Family", "Family(Symplectic(k), …)")
        if self.member.takes_inputs:
            raise TypeError(
                f"the members of a family are fields of states alone, and {type(member).__name__} "
                "takes inputs or parameters: put all of them into the θ of one Family."
            )
        self.parameters = Constant() if parameters is None else as_scalar_kernel(parameters)
        self.count = count

    def __repr__(self) -> str:
        shared = isinstance(self.parameters, Constant)
        return call("Family", [repr(self.member), *([] if shared else [repr(self.parameters)])])

    @property
    def terms(self) -> tuple["Family", ...]:
        return (self,)

    def coefficients_at(self, u: Float[Array, " p"], U: Float[Array, "M p"], A: Points) -> Points:
        """The coefficients aⱼ k(θ, θⱼ) of the member θ."""
        return A * jax.vmap(self.parameters, in_axes=(None, 0))(u, U)[:, None]

    def child_inputs(
        self, child: Any, X: Float[np.ndarray, "N d"], amplitude: float
    ) -> tuple[Float[np.ndarray, "N _"], float]:
        """The data of K are states, the data of k are parameters.

        Only the product of their amplitudes is identified, so k gets none if K has one.
        """
        states, T = self.split(X)
        if child is self.member:
            return states, amplitude
        scaled = any(k.has_amplitude for k in self.member.scalar_kernels)
        return T, 1.0 if scaled else amplitude


class FamilySum(AbstractFamily):
    """The sum Σᵢ kᵢ(θ, ϑ) Kᵢ(x, z) of families; made by `+`."""

    terms: tuple["Family", ...]
    count: int | None = eqx.field(static=True)

    def __init__(self, terms: tuple["Family", ...], count: int | None = None):
        counts = {t.count for t in terms if t.count is not None}
        if len(counts) > 1:
            raise ValueError(
                f"the families in a sum have {sorted(counts)} parameters: all need the same θ."
            )
        self.count = counts.pop() if counts and count is None else count
        self.terms = tuple(Family(t.member, t.parameters, self.count) for t in terms)

    def __repr__(self) -> str:
        return join_terms("+", [repr(t) for t in self.terms])

    def child_inputs(
        self, child: Any, X: Float[np.ndarray, "N d"], amplitude: float
    ) -> tuple[Float[np.ndarray, "N d"], float]:
        """The joined points, since the terms are kernels of joined points."""
        return X, amplitude


def _family_terms(K: AbstractMatrixKernel) -> tuple["Family", ...]:
    """The terms of a family. Any other kernel becomes a family of equal members."""
    return K.terms if isinstance(K, AbstractFamily) else (Family(K),)
