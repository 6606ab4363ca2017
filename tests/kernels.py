"""The scalar kernels that the tests run over, each beside its formula in NumPy and SciPy.

None of the formulas is the library's: Matérn comes from Bessel functions, periodic from sines, and
everything else is written with differences of points where the library has products.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gamma, kv

import hamkernel as hk

Formula = Callable[[np.ndarray, np.ndarray], Any]


@dataclasses.dataclass(frozen=True)
class Case:
    """A kernel for points of any even dimension, and what is known of it.

    Attributes:
        make: n -> the kernel, as a user would write it.
        formula: n -> k(x, z) in NumPy.
        mixed: n -> ∂x ∂zᵀ k(x, z) in NumPy; None if only differences of the formula can tell.
        stationary: k(x + c, z + c) = k(x, z).
        reflective: k(−x, −z) = k(x, z).
        builtin: every part is the library's, so that it adapts to the dtype of the points.
        smoothness: how often ∂x ∂zᵀ k may be differentiated further at x = z.
    """

    name: str
    make: Callable[[int], Any]
    formula: Callable[[int], Formula]
    mixed: Callable[[int], Formula] | None = None
    stationary: bool = False
    reflective: bool = False
    builtin: bool = True
    smoothness: float = np.inf

    def __str__(self) -> str:
        return self.name


def halves(n: int) -> tuple[list[int], list[int]]:
    return list(range(n // 2)), list(range(n // 2, n))


def widths(n: int) -> np.ndarray:
    return 0.8 + 0.9 * np.arange(n) / n


def radial(profile, lengthscale):
    """Value and mixed derivative of φ(s), s = ‖(x − z)/ℓ‖², from s -> (φ, φ′, φ″).

    With d = (x − z)/ℓ²: ∂x k = 2φ′d, so ∂x ∂zᵀ k = −2φ′ diag(1/ℓ²) − 4φ″ddᵀ.
    """

    def value(x, z):
        return profile(np.sum(((x - z) / lengthscale) ** 2))[0]

    def mixed(x, z):
        d = (x - z) / lengthscale**2 * np.ones(len(x))
        _, first, second = profile(np.sum(((x - z) / lengthscale) ** 2))
        outer = 4 * second * np.outer(d, d) if d.any() else 0.0
        return -2 * first * np.eye(len(x)) / lengthscale**2 - outer

    return value, mixed


def gaussian_profile(s):
    value = np.exp(-s / 2)
    return value, -value / 2, value / 4


def rational_profile(alpha):
    def profile(s):
        base = 1 + s / (2 * alpha)
        second = (alpha + 1) / (4 * alpha) * base ** (-alpha - 2)
        return base**-alpha, -(base ** (-alpha - 1)) / 2, second

    return profile


def matern_profile(nu):
    """By (1/u) d/du [u^ν K_ν(u)] = −u^(ν−1) K_(ν−1)(u), DLMF 10.29.4, at u² = 2νs."""

    def bessel(order, u):
        if u == 0:
            return 2 ** (order - 1) * gamma(order) if order > 0 else np.nan
        return u**order * kv(order, u)

    def profile(s):
        u, scale = np.sqrt(2 * nu * s), 2 ** (1 - nu) / gamma(nu)
        return (
            scale * bessel(nu, u),
            -scale * nu * bessel(nu - 1, u),
            scale * nu**2 * bessel(nu - 2, u),
        )

    return profile


def polynomial(degree, offset):
    def value(x, z):
        return (x @ z + offset) ** degree

    def mixed(x, z):
        base = x @ z + offset
        curved = (degree - 1) * base ** (degree - 2) * np.outer(z, x) if degree > 1 else 0.0
        return degree * (base ** (degree - 1) * np.eye(len(x)) + curved)

    return value, mixed


def periodic(period, lengthscale):
    def value(x, z):
        return np.exp(-2 * np.sum((np.sin(np.pi * (x - z) / period) / lengthscale) ** 2))

    return value


# What a user might bring: a function, a lambda, a partial and a module with arrays. The first
# two are not shift-invariant, the last two have no invariance at all.
def fourth_power(x, z):
    return (1.0 + x @ z) ** 4


exponential = lambda x, z: jnp.exp(x @ z / 4)  # noqa: E731


def modulated(w, x, z):
    def amplitude(x):
        return 1.0 + jnp.tanh(x @ w)

    return amplitude(x) * amplitude(z) * jnp.exp(-((x - z) @ (x - z)) / 2)


def modulated_formula(w):
    def amplitude(x):
        return 1 + np.tanh(w @ x)

    return lambda x, z: amplitude(x) * amplitude(z) * np.exp(-np.sum((x - z) ** 2) / 2)


class Features(eqx.Module):
    """k(x, z) = ψ(x)·ψ(z) with ψ(x) = tanh(Wx + b), three features for each coordinate."""

    weight: jax.Array
    bias: jax.Array

    def __init__(self, n: int):
        weight, bias = feature_arrays(n)
        self.weight, self.bias = jnp.asarray(weight), jnp.asarray(bias)

    def __call__(self, x, z):
        return jnp.tanh(self.weight @ x + self.bias) @ jnp.tanh(self.weight @ z + self.bias)


def feature_arrays(n):
    rng = np.random.default_rng(3)
    return rng.normal(size=(3 * n, n)) / np.sqrt(n), rng.normal(size=3 * n)


def features_formula(n):
    weight, bias = feature_arrays(n)
    return lambda x, z: np.tanh(weight @ x + bias) @ np.tanh(weight @ z + bias)


def slope(n: int) -> np.ndarray:
    return np.linspace(0.3, -0.5, n)


def bend(x):
    """A diffeomorphism without symmetry, for `Warp`."""
    return x + 0.3 * jnp.cos(x)


def _gaussian_radial(n):
    return radial(gaussian_profile, widths(n))


def _added(*makers):
    return lambda n: lambda x, z: sum(make(n)(x, z) for make in makers)


def _selected(n):
    q, p = halves(n)
    left, right = radial(gaussian_profile, 1.1)[0], polynomial(3, 0.7)[0]
    return lambda x, z: left(x[q], z[q]) + right(x[p], z[p])


def _bent(n):
    inner = radial(gaussian_profile, 1.2)[0]
    return lambda x, z: inner(x + 0.3 * np.cos(x), z + 0.3 * np.cos(z))


def _matern(nu, lengthscale=1.2):
    value, mixed = radial(matern_profile(nu), lengthscale)
    return Case(
        f"matern{nu}",
        lambda n: hk.Matern(nu, lengthscale),
        lambda n: value,
        lambda n: mixed,
        stationary=True,
        reflective=True,
        smoothness=np.ceil(nu) - 2,
    )


CASES = [
    Case(
        "gaussian",
        lambda n: hk.Gaussian(1.3),
        lambda n: radial(gaussian_profile, 1.3)[0],
        lambda n: radial(gaussian_profile, 1.3)[1],
        stationary=True,
        reflective=True,
    ),
    Case(
        "gaussian_ard",
        lambda n: hk.Gaussian(widths(n)),
        lambda n: _gaussian_radial(n)[0],
        lambda n: _gaussian_radial(n)[1],
        stationary=True,
        reflective=True,
    ),
    _matern(1.5),
    _matern(2.5),
    _matern(3.5),
    _matern(4.5, 0.9),
    Case(
        "rational_quadratic",
        lambda n: hk.RationalQuadratic(alpha=1.4, lengthscale=1.1),
        lambda n: radial(rational_profile(1.4), 1.1)[0],
        lambda n: radial(rational_profile(1.4), 1.1)[1],
        stationary=True,
        reflective=True,
    ),
    Case(
        "polynomial",
        lambda n: hk.Polynomial(degree=4, offset=1.0),
        lambda n: polynomial(4, 1.0)[0],
        lambda n: polynomial(4, 1.0)[1],
        reflective=True,
    ),
    Case(
        "periodic",
        lambda n: hk.Periodic(period=4.1, lengthscale=1.2),
        lambda n: periodic(4.1, 1.2),
        stationary=True,
        reflective=True,
    ),
    Case(
        "periodic_ard",
        lambda n: hk.Periodic(period=6 * widths(n), lengthscale=widths(n)[::-1]),
        lambda n: periodic(6 * widths(n), widths(n)[::-1]),
        stationary=True,
        reflective=True,
    ),
    Case(
        "sum",
        lambda n: hk.Gaussian(1.3) + hk.Polynomial(2, 0.5) + hk.Matern(3.5, 1.2),
        _added(
            lambda n: radial(gaussian_profile, 1.3)[0],
            lambda n: polynomial(2, 0.5)[0],
            lambda n: radial(matern_profile(3.5), 1.2)[0],
        ),
        _added(
            lambda n: radial(gaussian_profile, 1.3)[1],
            lambda n: polynomial(2, 0.5)[1],
            lambda n: radial(matern_profile(3.5), 1.2)[1],
        ),
        reflective=True,
        smoothness=2,
    ),
    Case(
        "scaled_product",
        lambda n: 2.5 * hk.Gaussian(1.3) * hk.Polynomial(2, 0.5),
        lambda n: (
            lambda x, z: 2.5 * radial(gaussian_profile, 1.3)[0](x, z) * polynomial(2, 0.5)[0](x, z)
        ),
        reflective=True,
    ),
    Case("warp", lambda n: hk.Warp(hk.Gaussian(1.2), bend), _bent),
    Case(
        "select",
        lambda n: (
            hk.Select(hk.Gaussian(1.1), halves(n)[0])
            + hk.Select(hk.Polynomial(3, 0.7), halves(n)[1])
        ),
        _selected,
        reflective=True,
    ),
    Case(
        "function",
        lambda n: fourth_power,
        lambda n: polynomial(4, 1.0)[0],
        lambda n: polynomial(4, 1.0)[1],
        builtin=False,
    ),
    Case(
        "lambda",
        lambda n: exponential,
        lambda n: lambda x, z: np.exp(x @ z / 4),
        lambda n: lambda x, z: np.exp(x @ z / 4) * (np.eye(n) / 4 + np.outer(z, x) / 16),
        builtin=False,
    ),
    Case(
        "partial",
        lambda n: functools.partial(modulated, jnp.asarray(slope(n))),
        lambda n: modulated_formula(slope(n)),
        builtin=False,
    ),
    Case("module", Features, features_formula, builtin=False),
]
BY_NAME = {case.name: case for case in CASES}


def difference_mixed(value: Formula, x: np.ndarray, z: np.ndarray, step: float = 2e-3):
    """∂x ∂zᵀ of a formula by central differences of order 6, good to 1e-9."""
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    stencil = [(s * i, s * w) for i, w in weights.items() for s in (1, -1)]
    basis = step * np.eye(len(x))
    return np.array(
        [
            [
                sum(u * v * value(x + i * a, z + j * b) for i, u in stencil for j, v in stencil)
                for b in basis
            ]
            for a in basis
        ]
    ) / (step**2)


def mixed(case: Case, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """∂x ∂zᵀ k(x, z) without any automatic differentiation."""
    if case.mixed is not None:
        return np.asarray(case.mixed(len(x))(x, z))
    return difference_mixed(case.formula(len(x)), x, z)


def canonical(n: int) -> np.ndarray:
    """J = [[0, I], [−I, 0]]."""
    zero, one = np.zeros((n // 2, n // 2)), np.eye(n // 2)
    return np.block([[zero, one], [-one, zero]])
