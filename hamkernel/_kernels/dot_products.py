"""Kernels of the dot product of (features of) the points."""

import equinox as eqx
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
    one_point,
)
from hamkernel._kernels.symmetry import is_diagonal, is_orthogonal, is_permutation


class Polynomial(AbstractScalarKernel):
    """The polynomial kernel, k(x, z) = (x·z + c)^d.

    Its potentials are the polynomials of degree ≤ d, so a Hamiltonian of degree d is learned
    exactly. Not shift-invariant: state the data in coordinates whose origin means something.

    Args:
        degree: d ≥ 1, an integer; fixed, not trained.
        offset: c > 0, in squared units of the states.

    Raises:
        ValueError: `degree` or `offset` is not positive, or `offset` not finite. TypeError:
            `degree` is not whole.

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

    It is the Gaussian kernel on the circle: sin² of half an angle is a quarter of the squared
    chord between (cos, sin) pairs, so the sum is a dot product of features.

    Args:
        period: T > 0 in the units of the states; a number, or an array (n,). It is trained like
            every hyperparameter: where it is known, such as 2π, say `tune(..., frozen="period")`.
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
        weight = divided(divided(jnp.ones_like(x), self.lengthscale), self.lengthscale)
        # Σ 2 sin²(θ/2)/ℓ² = Σ (1 − cos θ)/ℓ², and cos(a − b) is a product of features.
        return jnp.exp(self._features(x) @ (jnp.tile(weight, 2) * self._features(z)) - weight.sum())

    def _features(self, x: Float[Array, " n"]) -> Float[Array, " 2*n"]:
        angle = divided(2 * jnp.pi * x, self.period, "period")
        return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)])

    @property
    def invariance(self) -> Invariance:
        return Invariance.TRANSLATION

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        alike = self.log_lengthscale.ndim == self.log_period.ndim == 0
        return is_permutation(S) and (alike or is_diagonal(S))

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        if name == "log_lengthscale":
            # On a circle of radius 1; below 1/64 random features need too long a Fourier series.
            return np.log(max(0.6 / len(X), 1 / 64)), np.log(60.0)
        return bounds_of_length(self.log_period, X, 2.0, 10.0)
