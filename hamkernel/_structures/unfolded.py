"""Sums over a group turned into sums over its images of the points."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hamkernel._kernels.symmetry import symmetry_removed
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.structure import AbstractStructure


def unfolded(
    K: AbstractMatrixKernel, Z: Float[Array, "M n"], A: Float[Array, "M n"]
) -> tuple[AbstractMatrixKernel, Float[Array, "L n"], Float[Array, "L n"]]:
    """A kernel, points and coefficients with the expansion of K, Z, A, without its group.

    A one-sided mean over |G| maps is a sum over |G| times the points: with B(hz)ᵀ = ± h B(z)ᵀ hᵀ

        Σⱼ ∂x ∂zᵀ k(x, hzⱼ) B(zⱼ)ᵀ aⱼ = ± Σⱼ (∂x ∂₂ᵀ k)(x, hzⱼ) B(hzⱼ)ᵀ h⁻ᵀ aⱼ.

    In a sum over many pairs this is cheaper than all terms at once, which fill the registers.
    K, Z and A themselves where K is of another form.
    """
    if not isinstance(K, AbstractStructure):
        return K, Z, A
    found = symmetry_removed(K.kernel)
    n = Z.shape[1]
    if found is None or not found.is_one_sided(n):
        return K, Z, A
    group = found.group(n)
    carried = [K.carried(h.matrix) for h in group]
    known = [T for T in carried if T is not None]
    if len(known) < len(group):
        return K, Z, A
    images = jnp.concatenate([jax.vmap(h)(Z) for h in group])
    pairs = zip(group, known, strict=True)
    moved = [jax.vmap(h._replace(matrix=h.character * T))(A) for h, T in pairs]
    K = eqx.tree_at(lambda K: K.kernel, K, found.kernel)
    return K, images, jnp.concatenate(moved) / len(group)
