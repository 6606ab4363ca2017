"""Kernels of the scaled distance, k(x, z) = φ(s) with s = ‖(x − z)/ℓ‖².

A structured kernel meets every point with itself, so the second derivatives of k at x = z must
be exact. They are when φ is differentiated with respect to s, the SQUARED distance, in which a
smooth kernel is smooth: ∂x ∂zᵀ k = −2φ′(s) I/ℓ² − 4φ″(s) ddᵀ with d = (x − z)/ℓ². A kernel
written with the distance √s gives NaN there, or, after the usual repairs, a wrong block.
"""

import abc
import functools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Bounds,
    Invariance,
    bounds_of_length,
    divided,
    log_per_coordinate,
)
from hamkernel._kernels.symmetry import is_diagonal, is_orthogonal

_LENGTH = "It is a length in the units of the states."


def squared_distance(x: Float[Array, " n"], z: Float[Array, " n"], cut: bool) -> Float[Array, ""]:
    """‖x − z‖² as x·x + z·z − 2 x·z, which under two vmaps is one matrix product.

    The factor −2 stands outside, so that the derivative of exp(−s/2) needs no pass over all pairs
    for it.

    With `cut`, what lies below the rounding of the product form is zero: on the Gram's diagonal its
    noise of one unit in the last place would be a distance of 1e-8, which Matérn-3/2 can feel.
    Only the value is cut; derivatives are those of the exact expression.
    """
    halves = x @ x / 2 + z @ z / 2
    s = -2 * (x @ z - halves)
    if not cut:
        return s
    noise = 16 * jnp.finfo(s.dtype).eps * halves
    return s - jax.lax.stop_gradient(jnp.where(s < noise, s, jnp.zeros_like(s)))


class AbstractRadialKernel(AbstractScalarKernel):
    """k(x, z) = φ(‖(x − z)/ℓ‖²), ℓ a number or one lengthscale per coordinate."""

    log_lengthscale: eqx.AbstractVar[Float[Array, "..."]]
    # Whether the rounding of s at zero is felt by φ and must be cut off, which takes a quarter of
    # the time of a product with the Gram.
    cuts_rounding: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        """φ(s), smooth at s = 0 as often as the kernel may be differentiated."""

    @property
    def lengthscale(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_lengthscale)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        x, z = divided(x, self.lengthscale), divided(z, self.lengthscale)
        return self.profile(squared_distance(x, z, cut=self.cuts_rounding))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """A lengthscale far below the spacing or above the extent changes nothing but rounding."""
        if name == "log_lengthscale":
            return bounds_of_length(self.log_lengthscale, X, 0.3, 30.0)
        return super().bounds(name, X, amplitude)

    @property
    def invariance(self) -> Invariance:
        return Invariance.TRANSLATION

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        """A lengthscale for each coordinate allows changes of sign, one for all every rotation."""
        return is_orthogonal(S) and (self.log_lengthscale.ndim == 0 or is_diagonal(S))


class Gaussian(AbstractRadialKernel):
    """The Gaussian kernel, k(x, z) = exp(−‖(x − z)/ℓ‖²/2).

    Args:
        lengthscale: ℓ > 0, the paper's σ, in the units of the states; a number, or an array
            (n,) with one for each coordinate.

    Raises:
        ValueError: a lengthscale is not positive and finite.

    Source: Smith & Egeland (2023), section 4.
    """

    log_lengthscale: Float[Array, "..."]
    cuts_rounding: ClassVar[bool] = False

    def __init__(self, lengthscale: ArrayLike = 1.0):
        self.log_lengthscale = log_per_coordinate(lengthscale, "lengthscale", _LENGTH)

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.exp(-0.5 * s)


class Matern(AbstractRadialKernel):
    """The Matérn kernel of half-integer smoothness ν = p + 1/2, p ≥ 1.

    k(x, z) = p!/(2p)! e^(−r) Σᵢ (p + i)!/(i! (p − i)!) (2r)^(p − i), with r² = 2ν ‖(x − z)/ℓ‖².

    Args:
        nu: 1.5, 2.5, 3.5, …; fixed, not trained. A field of this kernel is differentiable
            ⌈ν⌉ − 2 times, so 2.5 is the roughest whose flow has a continuous Jacobian.
        lengthscale: ℓ > 0 in the units of the states; a number, or an array (n,).

    Raises:
        ValueError: `nu` is 1/2, whose second derivative at x = z does not exist, or no
            half-integer; a lengthscale is not positive and finite.

    Where more than 1000 points are multiplied, as in `field.evaluate` and `gram_operator`, second
    derivatives at points that coincide are NaN once one of the two is in reverse mode, as in
    `jax.hessian`; `jax.jacfwd(jax.jacfwd(f))` is right.

    Source: Rasmussen & Williams (2006), eq. 4.16.
    """

    log_lengthscale: Float[Array, "..."]
    nu: float = eqx.field(static=True)
    cuts_rounding: ClassVar[bool] = True  # φ is a function of √s

    def __init__(self, nu: float = 2.5, lengthscale: ArrayLike = 1.0):
        nu = float(nu)
        if nu == 0.5:
            raise ValueError(
                "Matern(nu=0.5) is not differentiable at x = z, so its structured kernels do not "
                "exist: their blocks are the second derivatives of k. Use nu=1.5 or larger."
            )
        if not (nu > 0.5 and nu % 1 == 0.5):  # refuses NaN and inf as well
            raise ValueError(f"Matern needs nu = 1.5, 2.5, 3.5, ...; got {nu}.")
        self.log_lengthscale = log_per_coordinate(lengthscale, "lengthscale", _LENGTH)
        self.nu = nu

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        return _matern(round(self.nu - 0.5), 2 * self.nu * s)


# With ψ_p(t) the Matérn function of order p + 1/2 at r = √t, the identity
# d/dr [r^ν K_ν(r)] = −r^ν K_{ν−1}(r) (DLMF 10.29.4) gives  ψ_p′(t) = −ψ_{p−1}(t) / (4p − 2):
# the derivative of a Matérn function is a smoother multiple of the next rougher one, so a
# custom_jvp that calls itself is exact to every order and never divides by the distance. Only
# the last, ψ_0 = e^(−r), has a derivative that grows like 1/r. It multiplies components of
# x − z that vanish faster, so the value 0 at r = 0 gives the limit of the whole expression.
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _matern(p: int, t: Float[Array, ""]) -> Float[Array, ""]:
    far = -1.2 * math.log(float(jnp.finfo(t.dtype).tiny))  # e^(−r) is zero, the polynomial finite
    r = jnp.sqrt(jnp.clip(t, 0.0, far**2))
    polynomial = jnp.zeros_like(t)
    for i in range(p + 1):  # Horner's scheme in 2r, the highest power first
        ways = math.comb(p, i) * math.perm(p + i, i) * math.factorial(p)
        polynomial = polynomial * (2 * r) + ways / math.factorial(2 * p)
    return polynomial * jnp.exp(-r)


@_matern.defjvp
def _matern_jvp(p, primals, tangents):
    (t,), (dt,) = primals, tangents
    slope = _matern(p - 1, t) / -(4 * p - 2) if p > 0 else _rough_slope(t)
    return _matern(p, t), slope * dt


def _rough_slope(t: Float[Array, ""]) -> Float[Array, ""]:
    """d/dt e^(−√t) = −e^(−√t)/(2√t), and 0 in place of −∞ at t = 0."""
    apart = t > 0
    r = jnp.sqrt(jnp.where(apart, t, jnp.ones_like(t)))
    return jnp.where(apart, -jnp.exp(-r) / (2 * r), jnp.zeros_like(t))


class RationalQuadratic(AbstractRadialKernel):
    """The rational quadratic kernel, k(x, z) = (1 + ‖(x − z)/ℓ‖²/(2α))^(−α).

    A mixture of Gaussians of many lengthscales; α → ∞ gives the Gaussian.

    Args:
        alpha: α > 0, dimensionless.
        lengthscale: ℓ > 0 in the units of the states; a number, or an array (n,).

    Raises:
        ValueError: a hyperparameter is not positive and finite.

    Source: Rasmussen & Williams (2006), eq. 4.19.
    """

    log_alpha: Float[Array, ""]
    log_lengthscale: Float[Array, "..."]
    cuts_rounding: ClassVar[bool] = True  # or a small α makes it log of a negative

    def __init__(self, alpha: ArrayLike = 1.0, lengthscale: ArrayLike = 1.0):
        self.log_alpha = jnp.log(require.positive_scalar(alpha, "alpha"))
        self.log_lengthscale = log_per_coordinate(lengthscale, "lengthscale", _LENGTH)

    @property
    def alpha(self) -> Float[Array, ""]:
        return jnp.exp(self.log_alpha)

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        alpha = self.alpha.astype(s.dtype)
        return jnp.exp(-alpha * jnp.log1p(s / (2 * alpha)))
