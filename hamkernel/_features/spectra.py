"""Random frequencies of shift-invariant scalar kernels.

Bochner: k(x, z) = κ(x − z) is the mean of cos(ω·(x − z)) over its spectral measure, so that with F
frequencies drawn from it k(x, z) ≈ Σ_r c_r cos(ω_r·(x − z)), to F^(−1/2).

Frequencies are smooth functions of the hyperparameters and of base samples that depend on the key
alone, so fits are differentiable and losses comparable between steps. α of RationalQuadratic and
the lengthscale of Periodic change the law of the base samples: there the derivative is that of the
measure, right in the mean over keys but not the exact slope for one key.

Source: Rahimi & Recht (2007); Yu et al. (2016).
"""

import functools
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._kernels.base import AbstractScalarKernel, ScalarProduct, ScalarSum, Scaled, divided
from hamkernel._kernels.dot_products import Periodic
from hamkernel._kernels.radial import Gaussian, Matern, RationalQuadratic
from hamkernel._kernels.symmetry import Symmetrised
from hamkernel._kernels.transforms import Select
from hamkernel._machine import orthonormal
from hamkernel._structures.controlled import Constant


class Spectrum(eqx.Module):
    """Draws from a spectral measure: k(x, z) ≈ Σ_r c_r cos(ω_r·(x − z)), or its even or odd part.

    Attributes:
        frequencies: ω_r in radians per unit of the states, shape (F, n).
        weights: c_r > 0, shape (F,); their sum is k(x, x) of the shift-invariant kernel.
        parity: +1 for the even part, −1 for the odd part, 0 for all.
    """

    frequencies: Float[Array, "F n"]
    weights: Float[Array, " F"]
    parity: int = eqx.field(static=True)


@functools.singledispatch
def spectra(
    k: AbstractScalarKernel, n: int, count: int, key: Key[Array, ""], dtype: Any
) -> tuple[Spectrum, ...]:
    """`count` frequencies for each term of the kernel, a tuple of `Spectrum`.

    Terms are what remains when products of sums are expanded.

    Args:
        k: sums, products, scalings, selections and parities of Gaussian, Matern,
            RationalQuadratic and Periodic.
        n: the number of coordinates.
        count: F, for each term.
        key: the random key.
        dtype: of the frequencies.

    Raises:
        TypeError: another kernel.
    """
    fn = getattr(k, "fn", None)
    name = getattr(getattr(fn, "func", fn), "__name__", "")
    raise TypeError(
        f"RandomFeatures cannot draw frequencies for {type(k).__name__}{name and f' ({name})'}: "
        "that takes a shift-invariant kernel with a known spectral density. Use Gaussian, Matern, "
        "RationalQuadratic or Periodic, their sums, products, multiples and Select, or another "
        "solver, hk.Cholesky() or hk.Nystrom()."
    )


def _one(frequencies: Float[Array, "F n"], weights: Float[Array, " F"] | None = None):
    """One term; `weights` are relative to those of a kernel with k(x, x) = 1."""
    F = len(frequencies)
    weights = jnp.ones(F, frequencies.dtype) if weights is None else weights
    return (Spectrum(frequencies, weights / F, parity=0),)


def _normal(key: Key[Array, ""], count: int, n: int, dtype: Any) -> Float[Array, "F n"]:
    """Standard normal vectors, independent but for directions orthogonal in blocks of n.

    Means over a block then have less variance (Yu et al. (2016), "Orthogonal random features"): a
    quarter less error on the pendulum of the paper.
    """
    directions, lengths = jax.random.split(key)
    blocks = -(-count // n)
    # With a positive diagonal of U the directions are uniform.
    Q, _ = orthonormal(jax.random.normal(directions, (blocks, n, n), dtype))
    rows = Q.reshape(blocks * n, n)[:count]
    return rows * jnp.linalg.norm(jax.random.normal(lengths, (count, n), dtype), axis=1)[:, None]


def _over_lengthscale(base: Float[Array, "F n"], lengthscale: Float[Array, "..."]):
    return jax.vmap(divided, in_axes=(0, None))(base, lengthscale)


@spectra.register
def _(k: Gaussian, n: int, count: int, key, dtype):
    """Normal with variance 1/ℓ²."""
    return _one(_over_lengthscale(_normal(key, count, n, dtype), k.lengthscale))


@spectra.register
def _(k: Matern, n: int, count: int, key, dtype):
    """Student's t with 2ν degrees of freedom and scale 1/ℓ: normal over √(χ²/2ν)."""
    normal, chi = jax.random.split(key)
    base = _normal(normal, count, n, dtype)
    half_square = jax.random.gamma(chi, k.nu, (count, 1), dtype)  # χ²_{2ν}/2
    return _one(_over_lengthscale(base * jnp.sqrt(k.nu / half_square), k.lengthscale))


@spectra.register
def _(k: RationalQuadratic, n: int, count: int, key, dtype):
    """(1 + s/2α)^(−α) is the mean of exp(−(g/α) s/2) over g ~ Gamma(α): normals of random width."""
    normal, mixture = jax.random.split(key)
    base = _normal(normal, count, n, dtype)
    alpha = k.alpha.astype(dtype)
    # The logarithm, since for small α the sample underflows, and √ has no derivative at 0.
    log_g = jax.random.loggamma(mixture, alpha, (count, 1), dtype)
    return _one(_over_lengthscale(base * jnp.exp((log_g - jnp.log(alpha)) / 2), k.lengthscale))


_HARMONICS = 1024


@spectra.register
def _(k: Periodic, n: int, count: int, key, dtype):
    """Harmonics 2πj/T with the probabilities of the Fourier series of the kernel.

    exp((cos θ − 1)/ℓ²) = Σ_j p_j cos jθ with p_j = exp(−1/ℓ²) I_j(1/ℓ²), here by a discrete
    Fourier transform, whose aliasing is below rounding for ℓ ≥ 1/64. An integer j has no
    derivative in ℓ; the weights p_j(ℓ)/p_j have the value 1 and the derivative of the measure.
    """
    lengthscale = k.lengthscale.astype(dtype)
    lengthscale = require.value(
        lengthscale,
        require.on_host(lengthscale) < 1 / 64,
        "RandomFeatures of a Periodic kernel needs a lengthscale (dimensionless) of at least 1/64.",
    )
    zero = jnp.zeros(n, dtype)
    concentration = divided(divided(zero + 1, lengthscale), lengthscale)  # (n,)
    circle = jnp.cos(2 * jnp.pi * jnp.arange(_HARMONICS, dtype=dtype) / _HARMONICS) - 1
    samples = jnp.exp(concentration[:, None] * circle[None])
    probability = jnp.fft.fftshift(jnp.fft.fft(samples).real, axes=1) / _HARMONICS  # j ≥ −M/2
    fixed = jax.lax.stop_gradient(probability)
    cumulative = jnp.cumsum(fixed, axis=1)
    # Never zero: it would draw a harmonic whose probability underflows, and then 0/0.
    uniform = jax.random.uniform(key, (n, count), dtype, minval=jnp.finfo(dtype).tiny)
    uniform = uniform * cumulative[:, -1:]
    index = jax.vmap(jnp.searchsorted)(cumulative, uniform)  # (n, F)
    ratio = jnp.take_along_axis(probability, index, 1) / jnp.take_along_axis(fixed, index, 1)
    harmonic = (index - _HARMONICS // 2).astype(dtype).T  # (F, n)
    frequencies = jax.vmap(lambda j: divided(2 * jnp.pi * j, k.period, "period"))(harmonic)
    return _one(frequencies, jnp.prod(ratio, axis=0))


@spectra.register
def _(k: Constant, n: int, count: int, key, dtype):
    """The one frequency 0, exactly."""
    return (Spectrum(jnp.zeros((1, n), dtype), jnp.ones(1, dtype), parity=1),)


@spectra.register
def _(k: Scaled, n: int, count: int, key, dtype):
    inner = spectra(k.kernel, n, count, key, dtype)
    return tuple(
        Spectrum(s.frequencies, k.scale.astype(dtype) * s.weights, s.parity) for s in inner
    )


@spectra.register
def _(k: ScalarSum, n: int, count: int, key, dtype):
    keys = jax.random.split(key, len(k.terms))
    parts = (spectra(t, n, count, key, dtype) for t, key in zip(k.terms, keys, strict=True))
    return tuple(itertools.chain.from_iterable(parts))


@spectra.register
def _(k: ScalarProduct, n: int, count: int, key, dtype):
    """The measure of a product is the convolution: frequencies add."""
    keys = jax.random.split(key, len(k.terms))
    factors = [spectra(t, n, count, key, dtype) for t, key in zip(k.terms, keys, strict=True)]
    if any(s.parity for factor in factors for s in factor):
        raise TypeError(
            "RandomFeatures cannot take a product with an even or odd kernel inside. Give the "
            "parity to the whole, for example hk.Odd(hk.Symplectic(k1 * k2))."
        )
    return tuple(functools.reduce(_multiplied, term) for term in itertools.product(*factors))


def _multiplied(a: Spectrum, b: Spectrum) -> Spectrum:
    return Spectrum(a.frequencies + b.frequencies, len(a.weights) * a.weights * b.weights, parity=0)


@spectra.register
def _(k: Select, n: int, count: int, key, dtype):
    if max(k.dims) >= n:
        raise ValueError(f"Select has coordinates {k.dims} and the points have {n}, from 0.")
    inner = spectra(k.kernel, len(k.dims), count, key, dtype)
    return tuple(
        Spectrum(
            jnp.zeros((count, n), dtype).at[:, list(k.dims)].set(s.frequencies),
            s.weights,
            s.parity,
        )
        for s in inner
    )


@spectra.register
def _(k: Symmetrised, n: int, count: int, key, dtype):
    inner = spectra(k.kernel, n, count, key, dtype)
    if k.parity is None or any(s.parity == -k.parity for s in inner):
        raise TypeError(
            "RandomFeatures takes one group for all of a structure, around all of its terms: "
            "hk.Odd(K), hk.Reversible(K), hk.Symplectic(hk.Invariant(k1 + k2, maps)). For others "
            "use hk.Cholesky() or hk.Nystrom()."
        )
    return tuple(Spectrum(s.frequencies, s.weights, k.parity) for s in inner)
