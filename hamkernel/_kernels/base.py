"""Scalar kernels on one pair of points, k(x, z) -> (), and their algebra.

You write a kernel once, for one pair of points. `jax.vmap` makes the Gram, and automatic
differentiation makes every structured kernel. Write kernels with *products* of their arguments:
`x @ z` under two vmaps becomes one matrix product, while `jnp.sum((x - z) ** 2)` becomes an
(N, M, n) array and runs many times slower.
"""

import abc
import enum
import functools
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel import _require as require
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import describe, exponential, join_terms, put_in_brackets, text

Point = Float[Array, " n"]
Points = Float[Array, "M n"]
Bounds = tuple[ArrayLike, ArrayLike]  # the lower and the upper bound of a hyperparameter


def one_point(x: ArrayLike) -> Float[Array, " n"]:
    """`x` as a float array of shape (n,). We refuse a batch, which would give a wrong number."""
    x = require.floating(x, "the point")
    if x.ndim != 1:
        raise ValueError(
            f"the point has shape {x.shape}; a kernel takes one pair of points of shape (n,). Use "
            "jax.vmap for many, or hk.gram for a Gram."
        )
    return x


def divide(x: Point, scale: Float[Array, "..."], name: str = "lengthscale") -> Point:
    """x/scale in the dtype of x, for one point and a scale of shape () or (n,)."""
    x = one_point(x)
    if scale.ndim and scale.shape != x.shape:
        raise ValueError(
            f"the kernel has {scale.size} {name}s and the point has shape {x.shape}: "
            "give one number, or one for each coordinate that the kernel sees."
        )
    return x / scale.astype(x.dtype)


def log_per_coordinate(value: ArrayLike, name: str, cure: str = "") -> Float[Array, "..."]:
    """The logarithm of a positive hyperparameter, shape () or (n,)."""
    array = require.positive(value, name, cure)
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; it must be a number or a vector (n,).")
    return jnp.log(array)


def bounds_by_value(name: str, leaf: Any) -> Bounds:
    """Bounds around the stored value of a hyperparameter whose meaning is unknown.

    A logarithm may change by three decades, any other number by ten times its size and at least 10.
    """
    value = np.asarray(leaf)
    reach = np.log(1e3) if name.startswith("log_") else 10 * np.maximum(1.0, np.abs(value))
    return value - reach, value + reach


def bounds_of_length(
    leaf: Any, X: Float[np.ndarray, "N n"], spacings: float, extents: float
) -> Bounds:
    """Bounds of the logarithm of a length: `spacings` spacings and `extents` extents of the data.

    We take the spacing of N points in an extent L as L/N, in any dimension, since points on a few
    trajectories lie close together along them. An extent of 0 counts as 1.
    """
    ranges = np.ptp(X, axis=0)
    extent = ranges if leaf.ndim > 0 else np.asarray(np.linalg.norm(ranges))
    extent = np.where(extent > 0, extent, 1.0)
    return np.log(spacings * extent / max(len(X), 2)), np.log(extents * extent)


class Invariance(enum.Flag):
    """The symmetries that a kernel declares, which allow cheaper formulas.

    REFLECTION: k(−x, −z) = k(x, z). TRANSLATION: k(x + c, z + c) = k(x, z), which for a symmetric
    real kernel implies REFLECTION. A sum or product has the symmetries that all its terms have.
    """

    NONE = 0
    REFLECTION = 1
    TRANSLATION = 3


def _identity(x: Float[Array, " n"]) -> Float[Array, "n n"]:
    return jnp.eye(len(x), dtype=x.dtype)


class Descriptor(NamedTuple):
    """A map d of points and a kernel κ of its values, k(x, z) = κ(d(x), d(z)).

    The derivatives of k follow from the derivatives of κ and the Jacobian of d. We compute this
    Jacobian once for each point.

    Attributes:
        map: d.
        kernel: κ.
        directions: x -> the matrix whose columns are the directions of differentiation at x.
        jacobian: the Jacobian of d; None for automatic differentiation in forward mode.
        point_data: a function c(x) such that k, for every κ, depends on x through c(x) alone; None
            if c is d.
    """

    map: Callable[[Float[Array, " n"]], Float[Array, " m"]]
    kernel: "AbstractScalarKernel"
    directions: Callable[[Float[Array, " n"]], Float[Array, "n n"]] = _identity
    jacobian: Callable[[Float[Array, " n"]], Float[Array, "m n"]] | None = None
    point_data: Callable[[Float[Array, " n"]], Float[Array, " s"]] | None = None

    def value_and_jacobian(
        self, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """The value d(x) and the derivatives of d along the directions."""
        jacobian = self.jacobian or jax.jacfwd(self.map)
        return self.map(x), jacobian(x) @ self.directions(x)


class Spectrum(eqx.Module):
    """Draws from a spectral measure: k(x, z) ≈ Σ_r c_r cos(ω_r·(x − z)), or its even or odd part.

    By Bochner's theorem k(x, z) = κ(x − z) is the mean of cos(ω·(x − z)) over the spectral measure
    of k. A sum over F frequencies drawn from the measure has a relative error of order F^(−1/2).

    The frequencies are smooth functions of the hyperparameters and of base samples, which depend on
    the key alone. Fits are therefore differentiable, and losses comparable between steps. Two
    hyperparameters change the distribution of the base samples: α of a rational quadratic kernel,
    and the lengthscale of a periodic one. Their derivatives are right in the mean over keys, but
    not for one key.

    Attributes:
        frequencies: ω_r in radians per unit of the states, shape (F, n).
        weights: c_r > 0, shape (F,); their sum is k(x, x) of the shift-invariant kernel.
        parity: +1 for the even part, −1 for the odd part, 0 for k itself.

    Source: Rahimi & Recht (2007).
    """

    frequencies: Float[Array, "F n"]
    weights: Float[Array, " F"]
    parity: int = eqx.field(static=True, default=0)


Spectra = tuple[Spectrum, ...]  # one for each term


class AbstractScalarKernel(eqx.Module):
    """A positive definite function k(x, z) -> () of two points of shape (n,).

    Every inexact array leaf is an unconstrained real, and `hamkernel.tune` trains it. A positive
    hyperparameter θ is stored as `log_θ`; the property `θ` returns its value.
    """

    def __repr__(self) -> str:
        return describe(self, positional=("kernel",))

    def __hash__(self) -> int:
        # Arrays have no hash. Equal kernels have equal structure, so we hash the structure.
        return hash(jax.tree.structure(self))

    @abc.abstractmethod
    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        """The value k(x, z) for one pair of points, shape ()."""

    @property
    def invariance(self) -> Invariance:
        """The known transformations of both arguments that leave k unchanged."""
        return Invariance.NONE

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        """The coordinates that each term of an additive kernel may depend on."""
        return (frozenset(range(n)),)

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        """Whether k(Sx, Sz) = k(x, z) is known for ALL values of the hyperparameters.

        Lengthscales that happen to be equal do not count, since training changes them.
        """
        identity = np.eye(len(S))
        if np.array_equal(S, identity):
            return True
        return np.array_equal(S, -identity) and Invariance.REFLECTION in self.invariance

    def summands(self, reflection: bool) -> "tuple[AbstractScalarKernel, ...]":
        """The inner kernels in which k is linear, so that a mean over linear maps may act on them.

        If `reflection` is true, x -> −x is the only map.
        """
        return ()

    def through_descriptor(self, n: int) -> Descriptor | None:
        """The descriptor of k on points of n coordinates; None if k has none."""
        return None

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        """`count` random frequencies for each term of the kernel on n coordinates.

        The terms are those of the kernel with all products of sums expanded.

        Raises:
            TypeError: no spectral density of the kernel is known, or it is not shift-invariant.
        """
        fn = getattr(self, "fn", None)
        name = getattr(getattr(fn, "func", fn), "__name__", "")
        raise TypeError(
            f"RandomFeatures cannot draw frequencies for {type(self).__name__}"
            f"{name and f' ({name})'}: a shift-invariant kernel with a known spectral density is "
            "needed. Use Gaussian, Matern, RationalQuadratic or Periodic, their sums, products, "
            "multiples and Select, or another solver, hk.Cholesky() or hk.Nystrom()."
        )

    @property
    def has_amplitude(self) -> bool:
        """Whether a trained factor multiplies all of k; by default as `self.kernel`."""
        inner = getattr(self, "kernel", None)
        return isinstance(inner, AbstractScalarKernel) and inner.has_amplitude

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        """The lower and upper bound of the array `name`, as stored, for `tune`.

        Args:
            name: an attribute, such as `log_lengthscale`.
            X: the data in the coordinates of the arguments of k.
            amplitude: the factor of k that gives fields of the size of the velocities.
        """
        return bounds_by_value(name, getattr(self, name))

    def transform_inputs(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N m"]:
        """The data in the coordinates of the arguments of the inner kernels."""
        return X

    def __add__(self, other: Any) -> "ScalarSum":
        if not callable(other):
            return NotImplemented
        return ScalarSum(_terms(ScalarSum, self) + _terms(ScalarSum, as_scalar_kernel(other)))

    def __radd__(self, other: Any) -> "AbstractScalarKernel":
        if isinstance(other, int | float) and other == 0:
            return self  # so that the built-in sum(kernels) works
        return as_scalar_kernel(other) + self if callable(other) else NotImplemented

    def __mul__(self, other: Any) -> "AbstractScalarKernel":
        if callable(other):
            other = as_scalar_kernel(other)
            return ScalarProduct(_terms(ScalarProduct, self) + _terms(ScalarProduct, other))
        return Scaled(self, other)

    def __rmul__(self, other: Any) -> "AbstractScalarKernel":
        return as_scalar_kernel(other) * self if callable(other) else Scaled(self, other)


def _terms(
    cls: "type[ScalarSum] | type[ScalarProduct]", kernel: AbstractScalarKernel
) -> tuple[AbstractScalarKernel, ...]:
    """The terms of `kernel` if it is a `cls`, so that (a + b) + c is one sum of three."""
    return kernel.terms if isinstance(kernel, cls) else (kernel,)


class ScalarSum(AbstractScalarKernel):
    """k₁(x, z) + k₂(x, z) + …"""  # noqa: D415

    terms: tuple[AbstractScalarKernel, ...]

    def __repr__(self) -> str:
        return join_terms("+", [repr(k) for k in self.terms])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return sum((k(x, z) for k in self.terms[1:]), start=self.terms[0](x, z))

    @property
    def invariance(self) -> Invariance:
        return common_invariance(self.terms)

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        return tuple(support for k in self.terms for support in k.supports(n))

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        return all(k.is_unchanged_by(S) for k in self.terms)

    def summands(self, reflection: bool) -> tuple[AbstractScalarKernel, ...]:
        return self.terms

    def through_descriptor(self, n: int) -> Descriptor | None:
        """The descriptors of all terms, concatenated; a term without one has the point itself."""
        descriptors = [k.through_descriptor(n) for k in self.terms]
        if not any(descriptors):
            return None
        completed = [
            d or Descriptor(lambda x: x, k) for d, k in zip(descriptors, self.terms, strict=True)
        ]
        point = jax.ShapeDtypeStruct((n,), jnp.result_type(float))
        # We pass lambdas: JAX compares functions, and methods of traced kernels have no `==`.
        lengths = tuple(jax.eval_shape(lambda x, d=d: d.map(x), point).size for d in completed)

        def jacobian(x):
            return jnp.concatenate(
                [d._replace(directions=_identity).value_and_jacobian(x)[1] for d in completed]
            )

        return Descriptor(
            lambda x: jnp.concatenate([d.map(x) for d in completed]),
            _SideBySide(tuple(d.kernel for d in completed), lengths),
            jacobian=jacobian,
            point_data=lambda x: jnp.concatenate([(d.point_data or d.map)(x) for d in completed]),
        )

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        return tuple(itertools.chain.from_iterable(_term_spectra(self, n, count, key, dtype)))

    @property
    def has_amplitude(self) -> bool:
        return all(k.has_amplitude for k in self.terms)


class _SideBySide(AbstractScalarKernel):
    """The kernel Σᵢ kᵢ(xᵢ, zᵢ), where x is the concatenation of the pieces xᵢ."""

    terms: tuple[AbstractScalarKernel, ...]
    lengths: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: Point, z: Point) -> Float[Array, ""]:
        ends = np.cumsum(self.lengths)[:-1]
        pieces = zip(self.terms, jnp.split(x, ends), jnp.split(z, ends), strict=True)
        return sum((k(a, b) for k, a, b in pieces), jnp.zeros((), x.dtype))


class ScalarProduct(AbstractScalarKernel):
    """k₁(x, z) k₂(x, z) …"""  # noqa: D415

    terms: tuple[AbstractScalarKernel, ...]

    def __repr__(self) -> str:
        return join_terms("*", [_as_factor(k) for k in self.terms])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return math.prod((k(x, z) for k in self.terms[1:]), start=self.terms[0](x, z))

    @property
    def invariance(self) -> Invariance:
        return common_invariance(self.terms)

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        first, *rest = (k.supports(n) for k in self.terms)
        for factor in rest:  # expand the product of the sums
            first = tuple(a | b for a in first for b in factor)
        return first

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        return all(k.is_unchanged_by(S) for k in self.terms)

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        """Sums of the frequencies of the factors: the measure of a product is the convolution."""
        factors = _term_spectra(self, n, count, key, dtype)
        if any(s.parity for factor in factors for s in factor):
            raise TypeError(
                "RandomFeatures cannot take a product with an even or odd kernel inside. Put the "
                "parity around the structure, for example hk.Odd(hk.Symplectic(k1 * k2))."
            )

        def convolve(a: Spectrum, b: Spectrum) -> Spectrum:
            weights = len(a.weights) * a.weights * b.weights
            return Spectrum(a.frequencies + b.frequencies, weights)

        return tuple(functools.reduce(convolve, term) for term in itertools.product(*factors))

    @property
    def has_amplitude(self) -> bool:
        return any(k.has_amplitude for k in self.terms)


def _term_spectra(
    kernel: ScalarSum | ScalarProduct, n: int, count: int, key: Key[Array, ""], dtype: Any
) -> list[Spectra]:
    """The spectra of the terms, drawn independently."""
    keys = jax.random.split(key, len(kernel.terms))
    return [t.spectra(n, count, key, dtype) for t, key in zip(kernel.terms, keys, strict=True)]


def common_invariance(terms: Iterable[Any]) -> Invariance:
    """The symmetries that all scalar or matrix-valued kernels in `terms` have."""
    common = Invariance.TRANSLATION
    for kernel in terms:
        common &= kernel.invariance
    return common


class Scaled(AbstractScalarKernel):
    """c k(x, z) with c > 0; made by `2.0 * k`."""

    kernel: AbstractScalarKernel
    log_scale: Float[Array, ""]

    def __init__(self, kernel: AbstractScalarKernel, scale: ArrayLike):
        self.kernel = kernel
        self.log_scale = jnp.log(require.positive_scalar(scale, "the scale of a kernel"))

    def __repr__(self) -> str:
        return f"{exponential(self.log_scale)} * {_as_factor(self.kernel)}"

    @property
    def scale(self) -> Float[Array, ""]:
        return jnp.exp(self.log_scale)

    def bounds(self, name: str, X: Float[np.ndarray, "N n"], amplitude: float) -> Bounds:
        return np.log(1e-5 * amplitude), np.log(1e5 * amplitude)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        value = self.kernel(x, z)
        return self.scale.astype(value.dtype) * value

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        return self.kernel.supports(n)

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        return self.kernel.is_unchanged_by(S)

    def summands(self, reflection: bool) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,)

    def through_descriptor(self, n: int) -> Descriptor | None:
        inner = self.kernel.through_descriptor(n)
        if inner is None:
            return None
        return inner._replace(kernel=eqx.tree_at(lambda k: k.kernel, self, inner.kernel))

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        inner, scale = self.kernel.spectra(n, count, key, dtype), self.scale.astype(dtype)
        return tuple(Spectrum(s.frequencies, scale * s.weights, s.parity) for s in inner)

    @property
    def has_amplitude(self) -> bool:
        # `tune` does not train a factor that is None.
        return self.log_scale is not None or self.kernel.has_amplitude


def _as_factor(kernel: AbstractScalarKernel) -> str:
    return put_in_brackets(repr(kernel)) if isinstance(kernel, ScalarSum) else repr(kernel)


class UserKernel(AbstractScalarKernel):
    """Any callable (x, z) -> scalar: a function, an Equinox module, another library's kernel.

    `tune` trains the array leaves of a module like hyperparameters of the built-in kernels. We
    assume that the callable depends on every coordinate and has no invariance.
    """

    fn: Callable[..., Any]

    def __init__(self, fn: Callable[..., Any]):
        self.fn = as_pytree(pair_function(fn))

    def __repr__(self) -> str:
        fn = getattr(self.fn, "__self__", self.fn)  # the tinygp kernel of a bound `evaluate`
        bare = type(fn).__repr__ is eqx.Module.__repr__  # this repr shows no values
        return describe(fn) if bare else text(fn)

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        with require.traceable(f"the kernel {_name(self.fn)}"):
            value = self.fn(x, z)
        value = require.floating(value, f"the value of the kernel {_name(self.fn)}")
        cure = "Write the kernel for one pair of points: the library adds the vmap."
        subject = f"the kernel {_name(self.fn)} returned an array of"
        require.shape(value, subject, "a scalar", (), cure=cure)
        # Parameters of the kernel may be more precise than the data.
        return value.astype(require.floating(x, "the point").dtype)


def pair_function(fn: Callable[..., Any]) -> Callable[..., Any]:
    """The function of one pair of points: `fn`, or the method `evaluate` of a tinygp kernel.

    A tinygp kernel returns a Gram when called, so we do not call the kernel itself.
    """
    families = {cls.__module__.partition(".")[0] for cls in type(fn).__mro__}
    return getattr(fn, "evaluate", fn) if "tinygp" in families else fn


def _name(fn: Callable[..., Any]) -> str:
    fn = getattr(fn, "func", fn)
    return getattr(fn, "__name__", type(fn).__name__)


def as_scalar_kernel(k: Any) -> AbstractScalarKernel:
    """`k` itself if it is an `AbstractScalarKernel`; else a `UserKernel` with this callable.

    Raises:
        TypeError: `k` is not callable, or is a matrix-valued kernel.
    """
    if isinstance(k, AbstractScalarKernel):
        return k
    if isinstance(k, type) or not callable(k):
        raise TypeError(
            f"a scalar kernel is needed, a callable (x, z) -> scalar; got {k!r}. "
            "For a built-in one write, for example, hk.Gaussian(lengthscale=1.0)."
        )
    if getattr(k, "matrix_valued", False):
        raise TypeError(
            f"a scalar kernel is needed; got the matrix-valued {type(k).__name__}. "
            "Scalar kernels are added inside a structure, Symplectic(k1 + k2), and structures to "
            "structures, Symplectic(k1) + CurlFree(k2)."
        )
    return UserKernel(k)
