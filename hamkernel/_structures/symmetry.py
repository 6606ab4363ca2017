"""Kernels of fields with a symmetry: odd, even, reversible ones, and any finite group.

The SCALAR kernel inside a structure is averaged over the group, so that the potential has the
symmetry, and with it the field: where B(Sx) = ± S B(x) Sᵀ, a potential with u(Sx) = u(x) gives
f(Sx) = ± S f(x).
"""

from typing import Any, overload

from hamkernel._kernels.base import AbstractScalarKernel, as_scalar_kernel
from hamkernel._kernels.symmetry import linear_maps, symmetrised, time_reversal
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel


def Odd(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the odd fields with the structure of K, f(−x) = −f(x).

    The SCALAR kernel inside is symmetrised: a field B∇u is odd when u is even. Exact for every
    kernel; twice the cost of K if k(−x, −z) = k(x, z) is known, else four times. A sum is
    symmetrised part by part.

    Args:
        K: a structured kernel whose B does not depend on x.

    Raises:
        TypeError: K is not matrix-valued.

    Source: Smith & Egeland (2023), section 4, there for k(x, z) = g(x − z).
    """
    return matrix_kernel(K, "the argument of Odd", "Odd(Symplectic(k))").with_parity(-1)


def Even(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the even fields with the structure of K, f(−x) = f(x).

    As `Odd`, with an odd potential: H(−x) = −H(x).

    Raises:
        TypeError: K is not matrix-valued.
    """
    return matrix_kernel(K, "the argument of Even", "Even(Symplectic(k))").with_parity(+1)


def Reversible(K: AbstractMatrixKernel) -> AbstractMatrixKernel:
    """The kernel of the reversible fields J∇H: H(q, −p) = H(q, p), whose motions may run backwards.

    With S = diag(I, −I) they obey f(Sx) = −S f(x). True for every H = T(p) + U(q) with an even T;
    false with friction, in magnetic fields and in rotating frames. Twice the cost of K if
    k(Sx, Sz) = k(x, z) is known, else four times. `Reversible(Odd(K))` is both, with a group of
    four.

    Args:
        K: `Symplectic(k)`, an odd or even one, or a sum of them.

    Raises:
        TypeError: K is not matrix-valued, or its fields are not J∇H.

    Example: `hk.Reversible(hk.Odd(hk.Symplectic(hk.Gaussian(2.0))))` for a pendulum.
    """
    K = matrix_kernel(K, "the argument of Reversible", "Reversible(Symplectic(k))")
    if not K.symplectic:
        raise TypeError(
            f"the fields of {type(K).__name__} are not reversible: time reversal holds for J∇H, "
            "Reversible(Symplectic(k)), and not with friction, magnetic fields or in rotating "
            "frames. In a sum say it of the part: Reversible(Symplectic(k)) + CurlFree(k)."
        )
    return K.averaged((time_reversal,))


@overload
def Invariant(k: AbstractMatrixKernel, maps: Any) -> AbstractMatrixKernel: ...
@overload
def Invariant(k: Any, maps: Any) -> AbstractScalarKernel: ...


def Invariant(k: Any, maps: Any) -> Any:
    """The kernel of the functions that a finite group of linear maps leaves unchanged.

    H(Sx) = H(x) for every S that the maps generate: the mean (1/|G|²) Σ k(gx, hz) over both
    arguments, right for every k. Where k(Sx, Sz) = k(x, z) is known one side is enough, at |G|
    times the cost of k in place of |G|²: an orthogonal S and one lengthscale for all coordinates,
    or an S that only changes signs.

    Inside `Symplectic` a map with SᵀJS = J gives fields f(Sx) = S f(x), one with SᵀJS = −J
    reversible ones, f(Sx) = −S f(x); another one is an error there.

    Args:
        k: a scalar kernel, or a structure, inside which the scalar kernels are averaged.
        maps: generators of the group, (n, n) arrays or linear functions x -> S x. The group is
            closed from them, and may have up to 64 elements.

    Returns:
        A scalar kernel, or a structure where one was given.

    Raises:
        TypeError: `k` is no kernel, or `maps` no list of maps. ValueError: a matrix is not square;
            when called: a map is not linear or of another dimension, the group does not close, or
            a structure does not allow the map.

    Example: `hk.Symplectic(hk.Invariant(hk.Gaussian(1.0), [rotation, mirror]))`.
    """
    given = linear_maps(maps)
    if isinstance(k, AbstractMatrixKernel):
        return k.averaged(given)
    return symmetrised(as_scalar_kernel(k), given, (1.0,) * len(given))
