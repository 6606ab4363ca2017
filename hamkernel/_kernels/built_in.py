"""The built-in kernels: radial kernels k = φ(s) with s = ‖(x − z)/ℓ‖², and functions of products.

The diagonal of a Gram pairs every point with itself, so the second derivatives of k at x = z must
be exact. A smooth kernel is a smooth function φ of the SQUARED distance s, and

    ∂x ∂zᵀ k = −2φ′(s) I/ℓ² − 4φ″(s) ddᵀ,     d = (x − z)/ℓ².

A kernel written with the distance √s gives NaN at x = z, or a wrong block after the usual repairs.
"""

import abc
import functools
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Bounds,
    Invariance,
    Spectrum,
    bounds_of_length,
    divide,
    log_per_coordinate,
    one_point,
)
from hamkernel._kernels.symmetry import is_diagonal, is_orthogonal, is_permutation
from hamkernel._machine import orthonormal


def squared_distance(x: Float[Array, " n"], z: Float[Array, " n"], cut: bool) -> Float[Array, ""]:
    """‖x − z‖² as x·x + z·z − 2 x·z, which under two vmaps is one matrix product.

    We put the factor −2 outside, so that the derivative of exp(−s/2) needs no extra pass over all
    pairs.

    With `cut` we set values below the rounding error of this formula to zero, but keep their
    derivatives. On the diagonal of the Gram one unit in the last place is a distance of 1e-8, to
    which Matérn-3/2 is sensitive.
    """
    halves = x @ x / 2 + z @ z / 2
    s = -2 * (x @ z - halves)
    if not cut:
        return s
    noise = 16 * jnp.finfo(s.dtype).eps * halves
    return s - jax.lax.stop_gradient(jnp.where(s < noise, s, jnp.zeros_like(s)))


def orthogonal_normal(
    key: Key[Array, ""], count: int, n: int, dtype: Any
) -> Float[Array, "count n"]:
    """Standard normal vectors, orthogonal within each block of n and otherwise independent.

    Orthogonality reduces the variance of means over a block. On the paper's pendulum it reduces the
    error by a quarter.

    Source: Yu et al. (2016), "Orthogonal random features".
    """
    directions, lengths = jax.random.split(key)
    blocks = -(-count // n)
    # The upper triangular factor has a positive diagonal, so the directions are uniform.
    Q, _ = orthonormal(jax.random.normal(directions, (blocks, n, n), dtype))
    rows = Q.reshape(blocks * n, n)[:count]
    return rows * jnp.linalg.norm(jax.random.normal(lengths, (count, n), dtype), axis=1)[:, None]


def log_length(lengthscale: ArrayLike) -> Float[Array, "..."]:
    """The logarithm of a lengthscale of the states."""
    cure = "It is a length in the units of the states."
    return log_per_coordinate(lengthscale, "lengthscale", cure)


class AbstractRadialKernel(AbstractScalarKernel):
    """A kernel k(x, z) = φ(‖(x − z)/ℓ‖²), with one lengthscale ℓ or one for each coordinate."""

    log_lengthscale: eqx.AbstractVar[Float[Array, "..."]]
    # Whether φ is sensitive to rounding of s near zero, so that `squared_distance` must cut it off.
    # The cut takes a quarter of the time of a product with the Gram.
    cuts_rounding: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        """The profile φ(s), with as many derivatives at s = 0 as the kernel has."""

    @abc.abstractmethod
    def widths(self, key: Key[Array, ""], count: int, dtype: Any) -> Float[Array, "count 1"] | None:
        """Random √w such that φ(s) is the mean of exp(−w s/2); None for w = 1.

        Every such φ is a mixture of Gaussians.
        """

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        """Frequencies √w ζ/ℓ with normal vectors ζ and random widths √w."""
        # With s = ‖(x − z)/ℓ‖², φ(s) is the mean of exp(−w s/2) over w. Each exp(−w s/2) is the
        # mean of cos(ω·(x − z)) over ω = √w ζ/ℓ, ζ ~ N(0, I).
        normal, mixture = jax.random.split(key)
        widths = self.widths(mixture, count, dtype)
        base = orthogonal_normal(key if widths is None else normal, count, n, dtype)
        base = base if widths is None else base * widths
        frequencies = jax.vmap(divide, in_axes=(0, None))(base, self.lengthscale)
        return (Spectrum(frequencies, jnp.full(count, 1 / count, dtype)),)

    @property
    def lengthscale(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_lengthscale)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        x, z = divide(x, self.lengthscale), divide(z, self.lengthscale)
        return self.profile(squared_distance(x, z, cut=self.cuts_rounding))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """Bounds of .3 spacings and 30 extents. Beyond them a lengthscale only changes rounding."""
        if name == "log_lengthscale":
            return bounds_of_length(self.log_lengthscale, X, 0.3, 30.0)
        return super().bounds(name, X, amplitude)

    @property
    def invariance(self) -> Invariance:
        return Invariance.TRANSLATION

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        """Whether S is orthogonal; with one lengthscale for each coordinate, also diagonal."""
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
        self.log_lengthscale = log_length(lengthscale)

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.exp(-0.5 * s)

    def widths(self, key: Key[Array, ""], count: int, dtype: Any) -> None:
        return None


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

    Products with more than 1000 points, as in `field.evaluate` and `gram_operator`, have NaN second
    derivatives in reverse mode, as in `jax.hessian`, if two points coincide. Use forward mode,
    `jax.jacfwd(jax.jacfwd(f))`.

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
        self.log_lengthscale = log_length(lengthscale)
        self.nu = nu

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        return _matern(round(self.nu - 0.5), 2 * self.nu * s)

    def widths(self, key: Key[Array, ""], count: int, dtype: Any) -> Float[Array, "count 1"]:
        """√w = √(2ν/χ²), so that frequencies have Student's t distribution with 2ν degrees."""
        half_square = jax.random.gamma(key, self.nu, (count, 1), dtype)  # χ²_{2ν}/2
        return jnp.sqrt(self.nu / half_square)


# Let ψ_p(t) be the Matérn function of order p + 1/2 at r = √t. The identity
# d/dr [r^ν K_ν(r)] = −r^ν K_{ν−1}(r) (DLMF 10.29.4) gives
#     ψ_p′(t) = −ψ_{p−1}(t) / (4p − 2).
# A custom_jvp that calls itself is therefore exact to every order and never divides by the
# distance. Only ψ_0 = e^(−r) has a derivative that grows like 1/r. It multiplies components of
# x − z, which vanish faster, so we may set it to 0 at r = 0.
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _matern(p: int, t: Float[Array, ""]) -> Float[Array, ""]:
    # Beyond `far` e^(−r) underflows to zero; at `far` the polynomial is still finite.
    far = -1.2 * math.log(float(jnp.finfo(t.dtype).tiny))
    r = jnp.sqrt(jnp.clip(t, 0.0, far**2))
    polynomial = jnp.zeros_like(t)
    # p!/(2p)! Σᵢ (p + i)!/(i! (p − i)!) (2r)^(p − i), Rasmussen & Williams (2006), eq. 4.16, where
    # (p + i)!/(i! (p − i)!) p! = C(p, i) · (p + i)!/p! · p!.
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
    """The derivative d/dt e^(−√t) = −e^(−√t)/(2√t), with 0 in place of −∞ at t = 0."""
    apart = t > 0
    r = jnp.sqrt(jnp.where(apart, t, jnp.ones_like(t)))
    return jnp.where(apart, -jnp.exp(-r) / (2 * r), jnp.zeros_like(t))


class RationalQuadratic(AbstractRadialKernel):
    """The rational quadratic kernel, k(x, z) = (1 + ‖(x − z)/ℓ‖²/(2α))^(−α).

    This is a mixture of Gaussian kernels of many lengthscales. For α → ∞ it is the Gaussian.

    Args:
        alpha: α > 0, dimensionless.
        lengthscale: ℓ > 0 in the units of the states; a number, or an array (n,).

    Raises:
        ValueError: a hyperparameter is not positive and finite.

    Source: Rasmussen & Williams (2006), eq. 4.19.
    """

    log_alpha: Float[Array, ""]
    log_lengthscale: Float[Array, "..."]
    cuts_rounding: ClassVar[bool] = True  # for small α a negative s gives log of a negative

    def __init__(self, alpha: ArrayLike = 1.0, lengthscale: ArrayLike = 1.0):
        self.log_alpha = jnp.log(require.positive_scalar(alpha, "alpha"))
        self.log_lengthscale = log_length(lengthscale)

    @property
    def alpha(self) -> Float[Array, ""]:
        return jnp.exp(self.log_alpha)

    def profile(self, s: Float[Array, ""]) -> Float[Array, ""]:
        alpha = self.alpha.astype(s.dtype)
        return jnp.exp(-alpha * jnp.log1p(s / (2 * alpha)))

    def widths(self, key: Key[Array, ""], count: int, dtype: Any) -> Float[Array, "count 1"]:
        """√w = √(g/α) with g ~ Gamma(α): φ(s) is the mean of exp(−(g/α) s/2)."""
        alpha = self.alpha.astype(dtype)
        # We draw log g: for small α the sample g underflows to 0, where √ has no derivative.
        log_g = jax.random.loggamma(key, alpha, (count, 1), dtype)
        return jnp.exp((log_g - jnp.log(alpha)) / 2)


class Polynomial(AbstractScalarKernel):
    """The polynomial kernel, k(x, z) = (x·z + c)^d.

    The potentials are the polynomials of degree ≤ d, so the kernel can represent a Hamiltonian of
    degree d exactly. The kernel is not shift-invariant: choose coordinates with a meaningful
    origin.

    Args:
        degree: d ≥ 1, an integer; fixed, not trained.
        offset: c > 0, in squared units of the states.

    Raises:
        ValueError: `degree` or `offset` is not positive, or `offset` not finite.
        TypeError: `degree` is no integer.

    Source: Rasmussen & Williams (2006), section 4.2.2.
    """

    log_offset: Float[Array, ""]
    degree: int = eqx.field(static=True)

    def __init__(self, degree: int = 4, offset: ArrayLike = 1.0):
        self.log_offset = jnp.log(require.positive_scalar(offset, "offset"))
        self.degree = require.count(degree, "degree")

    @property
    def offset(self) -> Float[Array, ""]:
        return jnp.exp(self.log_offset)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        product = one_point(x) @ one_point(z)
        return (product + self.offset.astype(product.dtype)) ** self.degree

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        square = np.mean(np.sum(X**2, axis=1)) or 1.0
        return np.log(1e-4 * square), np.log(1e4 * square)

    @property
    def invariance(self) -> Invariance:
        return Invariance.REFLECTION

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        return is_orthogonal(S)


class Periodic(AbstractScalarKernel):
    """The periodic kernel, k(x, z) = exp(−2 Σₐ sin²(π(xₐ − zₐ)/Tₐ)/ℓₐ²).

    This is the Gaussian kernel of the points (cos, sin) on circles: sin² of half an angle is a
    quarter of the squared chord.

    Args:
        period: T > 0 in the units of the states; a number, or an array (n,). `tune` trains T too.
            If T is known, such as 2π, pass `tune(..., frozen="period")`.
        lengthscale: ℓ > 0, dimensionless; a number, or an array (n,).

    Raises:
        ValueError: a hyperparameter is not positive and finite.

    Source: Rasmussen & Williams (2006), eq. 4.31, there of period 2π; first in MacKay (1998).
    """

    log_period: Float[Array, "..."]
    log_lengthscale: Float[Array, "..."]

    def __init__(self, period: ArrayLike = 1.0, lengthscale: ArrayLike = 1.0):
        self.log_period = log_per_coordinate(period, "period")
        self.log_lengthscale = log_per_coordinate(lengthscale, "lengthscale")

    @property
    def period(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_period)

    @property
    def lengthscale(self) -> Float[Array, "..."]:
        return jnp.exp(self.log_lengthscale)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        x, z = one_point(x), one_point(z)
        weight = divide(divide(jnp.ones_like(x), self.lengthscale), self.lengthscale)
        # Σ 2 sin²(θ/2)/ℓ² = Σ (1 − cos θ)/ℓ², and cos(a − b) is a product of features.
        return jnp.exp(self._features(x) @ (jnp.tile(weight, 2) * self._features(z)) - weight.sum())

    def _features(self, x: Float[Array, " n"]) -> Float[Array, " 2*n"]:
        angle = divide(2 * jnp.pi * x, self.period, "period")
        return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)])

    @property
    def invariance(self) -> Invariance:
        return Invariance.TRANSLATION

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        alike = self.log_lengthscale.ndim == self.log_period.ndim == 0
        return is_permutation(S) and (alike or is_diagonal(S))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        if name == "log_lengthscale":
            # Lengths on a circle of radius 1. Below 1/64 the Fourier series of `spectra` is too
            # long.
            return np.log(max(0.6 / len(X), 1 / 64)), np.log(60.0)
        return bounds_of_length(self.log_period, X, 2.0, 10.0)

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        """Harmonics 2πj/T with the probabilities of the Fourier series of the kernel.

        exp((cos θ − 1)/ℓ²) = Σ_j p_j cos jθ with p_j = exp(−1/ℓ²) I_j(1/ℓ²). We compute the p_j by
        a discrete Fourier transform of M = 1024 samples; for ℓ ≥ 1/64 its aliasing is below
        rounding. The integers j have no derivative in ℓ. The weights p_j(ℓ)/p_j therefore have the
        value 1 and the derivative of the measure.
        """
        lengthscale, M = self.lengthscale.astype(dtype), 1024
        lengthscale = require.value(
            lengthscale,
            require.host_array(lengthscale) < 1 / 64,
            "RandomFeatures of a Periodic kernel needs a lengthscale (dimensionless) of at least "
            "1/64.",
        )
        concentration = divide(divide(jnp.ones(n, dtype), lengthscale), lengthscale)  # (n,)
        circle = jnp.cos(2 * jnp.pi * jnp.arange(M, dtype=dtype) / M) - 1
        samples = jnp.exp(concentration[:, None] * circle[None])
        probability = jnp.fft.fftshift(jnp.fft.fft(samples).real, axes=1) / M  # j ≥ −M/2
        fixed = jax.lax.stop_gradient(probability)
        cumulative = jnp.cumsum(fixed, axis=1)
        # A sample of zero would draw a harmonic whose probability underflows, and lead to 0/0.
        uniform = jax.random.uniform(key, (n, count), dtype, minval=jnp.finfo(dtype).tiny)
        index = jax.vmap(jnp.searchsorted)(cumulative, uniform * cumulative[:, -1:])  # (n, F)
        ratio = jnp.take_along_axis(probability, index, 1) / jnp.take_along_axis(fixed, index, 1)
        harmonic = (index - M // 2).astype(dtype).T  # (F, n)
        frequencies = jax.vmap(lambda j: divide(2 * jnp.pi * j, self.period, "period"))(harmonic)
        return (Spectrum(frequencies, jnp.prod(ratio, axis=0) / count),)


class Constant(AbstractScalarKernel):
    """The constant kernel, k(x, z) = 1. Its functions are the constants."""

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return jnp.ones((), one_point(x).dtype)

    @property
    def invariance(self) -> Invariance:
        return Invariance.TRANSLATION

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        return (frozenset(),)

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        """The single frequency 0, which is exact."""
        return (Spectrum(jnp.zeros((1, n), dtype), jnp.ones(1, dtype), parity=1),)
