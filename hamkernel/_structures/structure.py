"""What a structure made from one scalar kernel is."""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from hamkernel._kernels.base import AbstractScalarKernel, Invariance, as_scalar_kernel
from hamkernel._kernels.groups import LinearMap
from hamkernel._kernels.symmetry import symmetrised, symmetry_removed, with_parity
from hamkernel._show import call, described
from hamkernel._structures.base import AbstractMatrixKernel


class AbstractStructure(AbstractMatrixKernel):
    """A structure made from one scalar kernel k."""

    kernel: AbstractScalarKernel = eqx.field(converter=as_scalar_kernel)
    # 1 if the fields have the parity of the functions of k, −1 if the other; a derivative flips it.
    field_parity: eqx.AbstractClassVar[int]
    # Of the operator: TRANSLATION where B is constant, REFLECTION where B(−x) = B(x).
    operator_invariance: eqx.AbstractClassVar[Invariance]

    def __repr__(self) -> str:
        found = symmetry_removed(self.kernel)
        if found is None or found.parity is None:
            return described(self, positional=("kernel",))
        symmetry = "Odd" if self.field_parity * found.parity < 0 else "Even"
        return call(symmetry, [repr(eqx.tree_at(lambda K: K.kernel, self, found.kernel))])

    def with_parity(self, parity: int) -> "AbstractStructure":
        if Invariance.REFLECTION not in self.operator_invariance:
            raise TypeError(
                f"the fields of {type(self).__name__} have no parity with any potential: its "
                "operator B(x) is another one at -x."
            )
        kernel = with_parity(self.kernel, self.field_parity * parity)
        return eqx.tree_at(lambda K: K.kernel, self, kernel)

    def averaged(self, maps: tuple[LinearMap, ...]) -> "AbstractStructure":
        kernel = symmetrised(self.kernel, maps, (1.0,) * len(maps))
        return eqx.tree_at(lambda K: K.kernel, self, kernel)

    def shares_potential(self, other: AbstractMatrixKernel) -> bool:
        """By what the operators hold: two with arrays, which are trained, are never the same."""
        if type(self) is not type(other):
            return False
        (own, tree), (others, other_tree) = (jax.tree.flatten(_operator(K)) for K in (self, other))
        return tree == other_tree and not any(map(eqx.is_array, own)) and own == others

    @abc.abstractmethod
    def carried(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"] | None:
        """T such that what k(x, Sz) in place of k(x, z) makes of a is the same of Sz and Ta."""

    @property
    def scalar_kernels(self) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance & self.operator_invariance


def _operator(K: AbstractMatrixKernel) -> dict[str, Any]:
    """What a structure has beside its scalar kernel."""
    fields = dataclasses.fields(K)
    return {field.name: getattr(K, field.name) for field in fields if field.name != "kernel"}


def row(k: AbstractScalarKernel, x: Float[Array, " n"], Z: Float[Array, "M n"]):
    return jax.vmap(k, in_axes=(None, 0))(x, Z)


def mixed(k: AbstractScalarKernel, x, u, z, v) -> Float[Array, ""]:
    """uᵀ [∂x ∂zᵀ k(x, z)] v, forward in both arguments.

    For k(x, z) = φ(s) this is φ″(s) ds(u) ds(v) + φ′(s) dds(u, v): in a Gram an entry costs a few
    multiplications, since what belongs to one point or to the pair alone is made once.
    """

    def slope(x):
        return jax.jvp(lambda z: k(x, z), (z,), (v,))[1]

    return jax.jvp(slope, (x,), (u,))[1]
