"""Scalar kernels of transformed points: `Warp`, and `Select` for some of the coordinates."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from hamkernel import _require as require
from hamkernel._kernels.base import (
    AbstractScalarKernel,
    Descriptor,
    Invariance,
    Spectrum,
    as_scalar_kernel,
    one_point,
)
from hamkernel._kernels.functions import as_pytree
from hamkernel._show import call, text


class Warp(AbstractScalarKernel):
    """k(fn(x), fn(z)): a kernel on warped coordinates, such as an angle as (cos, sin).

    Args:
        kernel: a scalar kernel on the warped coordinates, shape (m,).
        fn: a smooth map (n,) -> (m,), written with jax.numpy. `tune` trains the array leaves of an
            Equinox module. Define `fn` once: JAX treats a new lambda as a new function and compiles
            again. A fit refuses data at which `fn` or its derivative is not finite, such as inverse
            distances of two atoms in one place. A field is NaN at such states.
        equivariant: whether the maps of a symmetry only permute the entries of `fn`, as a
            permutation of like atoms permutes the distances between atoms. `Invariant` then takes
            its mean in the warped coordinates, over |G| terms instead of |G|².

    Raises:
        TypeError: `kernel` is not a scalar kernel, or `fn` not a function.
        ValueError: when called, if `fn` does not return a vector, or is not equivariant as
            declared.

    Example: `Warp(Gaussian(1.0), lambda x: jnp.array([jnp.cos(x[0]), jnp.sin(x[0]), x[1]]))`
    for a state (angle, momentum) on a cylinder. `CurlFree(Warp(Matern(2.5, 10.0), fn))` with the
    inverse distances between atoms as `fn`, averaged over the permutations of like atoms, is the
    force field sGDML of Chmiela et al. (2018).
    """

    kernel: AbstractScalarKernel
    fn: Callable[[Float[Array, " n"]], Any]
    equivariant: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        kernel: Any,
        fn: Callable[[Array], Array | Sequence[Array]],
        equivariant: bool = False,
    ):
        if not callable(fn) or isinstance(fn, AbstractScalarKernel):
            raise TypeError(
                f"Warp needs a kernel and then a map (n,) -> (m,), Warp(k, fn); got {fn!r} as map."
            )
        self.kernel = as_scalar_kernel(kernel)
        self.fn = as_pytree(fn)
        self.equivariant = bool(equivariant)

    def __repr__(self) -> str:
        said = ["equivariant=True"] if self.equivariant else []
        return call("Warp", [repr(self.kernel), f"fn={text(self.fn)}", *said])

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return self.kernel(self.warp(x), self.warp(z))

    def through_descriptor(self, n: int) -> Descriptor:
        return Descriptor(self.warp, self.kernel)

    def warp(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """The vector fn(x)."""
        x = one_point(x)
        with require.traceable("the map of Warp"):
            warped = self.fn(x)
        warped = jnp.stack(warped) if isinstance(warped, list | tuple) else warped
        if jnp.ndim(warped) != 1:
            raise ValueError(
                f"the map of Warp returned shape {jnp.shape(warped)} for a point of shape "
                f"{jnp.shape(x)}; a vector (m,) is needed. Return, for example, jnp.array([...])."
            )
        # Parameters of the map may be more precise than the data.
        return require.floating(warped, "the value of the map of Warp").astype(x.dtype)

    def image(self, S: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"] | None:
        """The permutation P with fn(Sx) = P fn(x); None if the map is not declared equivariant.

        Raises:
            ValueError: there is no such permutation.
        """
        if not self.equivariant or not require.is_concrete(self.fn):
            return None
        # Entries of an analytic map that agree at four generic points agree everywhere.
        probes = np.cos(1.0 + np.arange(4.0 * len(S))).reshape(4, -1)
        with jax.ensure_compile_time_eval():
            here, there = (self.transform_inputs(points).T for points in (probes, probes @ S.T))
        apart = np.abs(there[:, None] - here[None]).max(axis=2)  # (m, m)
        P = np.eye(len(here))[apart.argmin(axis=1)]
        close = apart.min(axis=1).max() <= 1e-5 * np.abs(here).max()  # float32 without x64
        if not (close and (P.sum(axis=0) == 1).all()):
            raise ValueError(
                "Warp(..., equivariant=True) says that the maps of a symmetry permute the entries "
                f"of fn(x), and with S = {np.round(S, 3).tolist()} the entries of fn(Sx) are no "
                "permutation of them. Leave out equivariant=True: Invariant then takes the mean "
                "over both arguments, which is right for every map."
            )
        return P

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        image = self.image(S)
        is_symmetric = image is not None and self.kernel.is_unchanged_by(image)
        return is_symmetric or super().is_unchanged_by(S)

    def transform_inputs(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N m"]:
        return np.asarray(jax.vmap(self.warp)(jnp.asarray(X)))


class Select(AbstractScalarKernel):
    """A kernel on some of the coordinates, k(x[dims], z[dims]).

    `Select(k, (0, 1)) + Select(k, (2, 3))` is the kernel of H(q, p) = U(q) + T(p) for two
    degrees of freedom.

    Args:
        kernel: a scalar kernel on len(dims) coordinates.
        dims: distinct coordinates, integers ≥ 0.

    Raises:
        TypeError: `kernel` is not a scalar kernel.
        ValueError: `dims` are no distinct integers ≥ 0, or, when called, the points have fewer
            coordinates.
    """

    kernel: AbstractScalarKernel
    dims: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, kernel: Any, dims: Any):
        self.kernel = as_scalar_kernel(kernel)
        self.dims = require.coordinates(dims, "dims, the second argument of Select,")

    def __call__(self, x: Float[Array, " n"], z: Float[Array, " n"]) -> Float[Array, ""]:
        return self.kernel(self._select(x), self._select(z))

    def _select(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        x = one_point(x)
        if max(self.dims) >= len(x):
            raise ValueError(
                f"Select has coordinates {self.dims} and the point has {len(x)}: "
                "coordinates are counted from 0."
            )
        # We use slices, not a gather: their derivative is a pad, which XLA can fuse.
        first, last = self.dims[0], self.dims[-1]
        if self.dims == tuple(range(first, last + 1)):
            return x[first : last + 1]
        return jnp.concatenate([x[d : d + 1] for d in self.dims])

    @property
    def invariance(self) -> Invariance:
        return self.kernel.invariance

    def supports(self, n: int) -> tuple[frozenset[int], ...]:
        inner = self.kernel.supports(len(self.dims))
        return tuple(frozenset(self.dims[i] for i in support) for support in inner)

    def is_unchanged_by(self, S: Float[np.ndarray, "n n"]) -> bool:
        inside = list(self.dims)
        outside = [i for i in range(len(S)) if i not in inside]
        apart = not S[np.ix_(inside, outside)].any()
        return apart and self.kernel.is_unchanged_by(S[np.ix_(inside, inside)])

    def summands(self, reflection: bool) -> tuple[AbstractScalarKernel, ...]:
        return (self.kernel,) if reflection else ()  # −x selected is −(x selected)

    def spectra(self, n: int, count: int, key: Key[Array, ""], dtype: Any) -> tuple[Spectrum, ...]:
        if max(self.dims) >= n:
            raise ValueError(f"Select has coordinates {self.dims} and the points have {n}, from 0.")
        inner, columns = self.kernel.spectra(len(self.dims), count, key, dtype), list(self.dims)

        def embed(frequencies):
            return jnp.zeros((len(frequencies), n), dtype).at[:, columns].set(frequencies)

        return tuple(Spectrum(embed(s.frequencies), s.weights, s.parity) for s in inner)

    def transform_inputs(self, X: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N m"]:
        return X[:, list(self.dims)]
