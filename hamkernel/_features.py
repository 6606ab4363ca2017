"""Random Fourier features of structured kernels.

The potential u is a sum of waves and f = B∇u, so the structure is exact for any number of
frequencies. Only the kernel is approximate.

Source: Smith & Egeland (2024), arXiv 2404.07703, for the odd symplectic case.
"""

import abc
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from hamkernel._kernels.base import AbstractScalarKernel, ScalarSum, Scaled, Spectrum
from hamkernel._kernels.parts import GroupParts, Laws, Shared, alike
from hamkernel._kernels.symmetry import Symmetrised, symmetry_removed
from hamkernel._structures.base import AbstractMatrixKernel, Sum
from hamkernel._structures.friction import Friction, damped_coordinates
from hamkernel._structures.joined import Controlled, KnownMatrix
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import AbstractPotentialKernel, DivergenceFree, Separable


class Waves(eqx.Module):
    """The waves a cos(ω·x), the first `cosines` of them, and a sin(ω·x), with amplitudes a."""

    frequencies: Float[Array, "w n"]
    amplitudes: Float[Array, " w"]
    cosines: int = eqx.field(static=True)

    def __init__(self, terms: tuple[Spectrum, ...]):
        cosines = [s for s in terms if s.parity >= 0]
        both = cosines + [s for s in terms if s.parity <= 0]
        self.frequencies = jnp.concatenate([s.frequencies for s in both])
        self.amplitudes = jnp.sqrt(jnp.concatenate([s.weights for s in both]))
        self.cosines = sum(len(s.weights) for s in cosines)

    def values(self, x: Float[Array, " n"]) -> Float[Array, " w"]:
        phase = self.frequencies @ x
        cosines, sines = jnp.cos(phase[: self.cosines]), jnp.sin(phase[self.cosines :])
        return self.amplitudes * jnp.concatenate([cosines, sines])

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n w"]:
        phase = self.frequencies @ x
        slopes = jnp.concatenate([-jnp.sin(phase[: self.cosines]), jnp.cos(phase[self.cosines :])])
        return self.frequencies.T * (self.amplitudes * slopes)[None]

    def slope(self, x: Float[Array, " n"], w: Float[Array, " w"]) -> Float[Array, " n"]:
        """The gradient of the sum of waves with weights w."""
        return self.gradients(x) @ w


class PartWaves(eqx.Module):
    """The features of a `Shared` kernel times a factor `scale`; they are exact, not random."""

    kernel: Shared
    scale: Float[Array, ""]

    @property
    def amplitudes(self) -> Float[Array, " w"]:
        return jnp.ones(self.kernel.columns)  # `values` contains the amplitude of a law

    def values(self, x: Float[Array, " n"]) -> Float[Array, " w"]:
        return jnp.sqrt(self.scale).astype(x.dtype) * self.kernel.features(x)

    def law_values(self, r: Float[Array, "..."]) -> Float[Array, " w"]:
        """The features of one law at r."""
        r = self.kernel.point(r)
        return jnp.sqrt(self.scale).astype(r.dtype) * self.kernel.law(r)

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n w"]:
        return jnp.sqrt(self.scale).astype(x.dtype) * self.kernel.gradients(x)

    def slope(self, x: Float[Array, " n"], w: Float[Array, " w"]) -> Float[Array, " n"]:
        return jnp.sqrt(self.scale).astype(x.dtype) * Laws((self.kernel,)).slope(x, w)


class JointWaves(eqx.Module):
    """The features of a sum of `Shared` kernels: the features of all terms, concatenated."""

    terms: tuple[PartWaves, ...]

    @property
    def amplitudes(self) -> Float[Array, " w"]:
        return jnp.concatenate([term.amplitudes for term in self.terms])

    def values(self, x: Float[Array, " n"]) -> Float[Array, " w"]:
        groups = self._groups()
        return jnp.concatenate([laws.features(x) * scales for laws, scales in groups])

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n w"]:
        groups = self._groups()
        return jnp.concatenate(
            [laws.gradients(x) * scales[None] for laws, scales in groups], axis=1
        )

    def slope(self, x: Float[Array, " n"], w: Float[Array, " w"]) -> Float[Array, " n"]:
        groups = self._groups()
        ends = np.cumsum([len(scales) for _, scales in groups])[:-1]
        pieces = zip(groups, jnp.split(w, ends), strict=True)
        return sum((laws.slope(x, scales * w) for (laws, scales), w in pieces), jnp.zeros_like(x))

    def _groups(self) -> list[tuple[Laws, Float[Array, " w"]]]:
        """Neighbouring terms whose kernels are alike, with the factors of their features."""
        groups = [self.terms[at] for at in alike([term.kernel for term in self.terms])]
        return [
            (
                Laws(tuple(term.kernel for term in group)),
                jnp.concatenate([jnp.sqrt(term.scale) * term.amplitudes for term in group]),
            )
            for group in groups
        ]


class GroupWaves(eqx.Module):
    """The means Σ_g χ(g) wave(gx)/|G| of waves over a finite group, for the mean of a kernel."""

    waves: Waves
    matrices: Float[Array, "G n n"]
    characters: Float[Array, " G"]

    @property
    def amplitudes(self) -> Float[Array, " w"]:
        return self.waves.amplitudes

    def values(self, x: Float[Array, " n"]) -> Float[Array, " w"]:
        matrices, characters = self._constants()
        return characters @ jax.vmap(self.waves.values)(matrices @ x) / len(characters)

    def gradients(self, x: Float[Array, " n"]) -> Float[Array, "n w"]:
        matrices, characters = self._constants()
        # ∂/∂x wave(gx) = gᵀ(∇wave)(gx)
        slopes = jax.vmap(self.waves.gradients)(matrices @ x)  # (G, n, w) at g x
        return jnp.einsum("g,gba,gbw->aw", characters, matrices, slopes) / len(characters)

    def slope(self, x: Float[Array, " n"], w: Float[Array, " w"]) -> Float[Array, " n"]:
        return self.gradients(x) @ w

    def _constants(self) -> tuple[Float[Array, "G n n"], Float[Array, " G"]]:
        """The matrices and characters of the group, without derivatives."""
        return jax.lax.stop_gradient((self.matrices, self.characters))


def waves_of(
    k: AbstractScalarKernel, n: int, count: int, key: Key[Array, ""], dtype: Any
) -> "Basis":
    """The features of a scalar kernel: waves with its spectrum and symmetry, or `Shared` laws."""
    shared = part_waves(k)
    if shared is not None:
        return shared
    unsymmetrised = symmetry_removed(k)
    if unsymmetrised is None or unsymmetrised.parity is not None:  # `spectra` knows the parity
        return Waves(k.spectra(n, count, key, dtype))
    group = unsymmetrised.group(n)
    return GroupWaves(
        Waves(unsymmetrised.kernel.spectra(n, count, key, dtype)),
        jnp.asarray(np.stack([g.matrix for g in group]), dtype),
        jnp.asarray([g.character for g in group], dtype),
    )


def part_waves(k: AbstractScalarKernel) -> PartWaves | JointWaves | None:
    """The features of `Shared` kernels, their multiples, means and sums; None for others."""
    terms = part_terms(k)
    waves = tuple(term for term in terms if term is not None)
    if len(waves) < len(terms):
        return None
    return waves[0] if len(waves) == 1 else JointWaves(waves)


def part_terms(k: AbstractScalarKernel, scale: Any = 1.0) -> list[PartWaves | None]:
    """The features of each `Shared` term of a kernel, and None for each other term."""
    if isinstance(k, Shared):
        return [PartWaves(k, jnp.asarray(scale))]
    if isinstance(k, Scaled):
        return part_terms(k.kernel, scale * k.scale)
    if isinstance(k, ScalarSum):
        return [waves for term in k.terms for waves in part_terms(term, scale)]
    if isinstance(k, Symmetrised):
        return [waves and _over_group(waves, k) for waves in part_terms(k.kernel, scale)]
    return [None]


def _over_group(waves: PartWaves, mean: Symmetrised) -> PartWaves:
    """The features of the mean of `waves` over the group of `mean`."""
    law = waves.kernel
    parts = GroupParts(law.parts, mean.maps, mean.characters)
    centres = None if law.centres is None else np.asarray(law.centres)
    return PartWaves(Shared(law.kernel, parts, centres, law.laws), waves.scale)


def laws_of(waves: Any) -> list[tuple[PartWaves, slice]]:
    """The `Shared` laws among the features, with the positions of their weights."""
    terms = waves.terms if isinstance(waves, JointWaves) else (waves,)
    laws, start = [], 0
    for term in terms:
        stop = start + len(term.amplitudes)
        if isinstance(term, PartWaves):
            ends = np.linspace(start, stop, term.kernel.law_count + 1).astype(int).tolist()
            laws += [(term, slice(*both)) for both in itertools.pairwise(ends)]
        start = stop
    return laws


def is_of_parts(K: AbstractMatrixKernel) -> bool:
    """Whether all terms of K are `Shared` laws, friction, or constant input matrices.

    Their features are exact.
    """
    if isinstance(K, Controlled):
        return is_of_parts(K.drift) and K.has_constant_matrix
    if isinstance(K, UnknownMasses):
        return is_of_parts(K.kernel)
    if isinstance(K, Sum):
        potentials = [term for term in K.terms if not isinstance(term, Friction)]
        return bool(potentials) and all(map(is_of_parts, potentials))
    return isinstance(K, AbstractPotentialKernel) and part_waves(K.kernel) is not None


Basis = Waves | GroupWaves | PartWaves | JointWaves


class AbstractFeatures(eqx.Module):
    """Features φ_r of a structured kernel: Σ_r φ_r(x) φ_r(z)ᵀ ≈ K(x, z).

    Each φ_r is a field with exactly the structure of K.
    """

    @property
    @abc.abstractmethod
    def columns(self) -> int:
        """The number r of features."""

    @abc.abstractmethod
    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        """The matrix with the columns φ_r(x)."""

    @abc.abstractmethod
    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        """The field Σ_r w_r φ_r(x), computed without the matrix `rows`."""

    def potential(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, ""]:
        """The potential of `field`; AttributeError if there is none."""
        raise AttributeError(f"{type(self).__name__} have no potential.")

    def laws(self) -> list[tuple[PartWaves, slice]]:
        """The `Shared` laws, with the positions of their weights."""
        return []

    def __call__(self, X: Float[Array, "t n"]) -> Float[Array, "t n r"]:
        # With `Shared` laws one state at a time: parts times centres take much memory.
        return jax.lax.map(self.rows, X) if self.laws() else jax.vmap(self.rows)(X)


class PotentialFeatures(AbstractFeatures):
    """The features φ = B∇(wave) of a structure B∇u."""

    structure: AbstractPotentialKernel
    waves: Basis

    @property
    def columns(self) -> int:
        return len(self.waves.amplitudes)

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        return self.structure.apply(x, self.waves.gradients(x))

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        return self.structure.apply(x, self.waves.slope(x, w))

    def potential(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, ""]:
        return self.waves.values(x) @ w

    def laws(self) -> list[tuple[PartWaves, slice]]:
        return laws_of(self.waves)


class FrictionFeatures(AbstractFeatures):
    """The exact features φ = F(x_i) e_i of `Friction`, for each damped coordinate i."""

    friction: Friction
    dimension: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        return len(self._coordinates)

    @property
    def _coordinates(self) -> Int[np.ndarray, " r"]:
        return np.asarray(damped_coordinates(self.friction.damped, self.dimension))

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        return jnp.diag(self.friction.curve(x))[:, self._coordinates]

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        return self.rows(x) @ w


class DivergenceFreeFeatures(AbstractFeatures):
    """The features φ = e_a ∂_b(wave) − e_b ∂_a(wave) of `DivergenceFree`, for each pair a < b."""

    waves: Basis
    dimension: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        return len(self.waves.amplitudes) * self.dimension * (self.dimension - 1) // 2

    def _pairs(self) -> Float[Array, "n P n"]:
        # Let M = ∂x ∂zᵀ k of the waves. The entry (a, a) of Σ_{a<b} φφᵀ is Σ_{b≠a} M_bb, that is
        # tr M − M_aa, and the entry (a, b) is −M_ba. So Σ φφᵀ = tr(M) I − Mᵀ, as in
        # `DivergenceFree`.
        a, b = np.triu_indices(self.dimension, 1)
        pairs = np.zeros((self.dimension, len(a), self.dimension))
        pairs[a, np.arange(len(a)), b] = 1.0
        pairs[b, np.arange(len(a)), a] = -1.0
        return jnp.asarray(pairs, self.waves.amplitudes.dtype)

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        rows = jnp.einsum("apb,bw->apw", self._pairs(), self.waves.gradients(x))
        return rows.reshape(self.dimension, -1)

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        pairs = self._pairs()
        slopes = w.reshape(pairs.shape[1], -1) @ self.waves.gradients(x).T  # (P, n)
        return jnp.einsum("apb,pb->a", pairs, slopes)


class SeparableFeatures(AbstractFeatures):
    """The features φ = e_a (wave) of `Separable`, for each component a."""

    waves: Basis
    dimension: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        return len(self.waves.amplitudes) * self.dimension

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        return jnp.kron(jnp.eye(self.dimension, dtype=x.dtype), self.waves.values(x)[None])

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        return w.reshape(self.dimension, -1) @ self.waves.values(x)


class ControlledFeatures(AbstractFeatures):
    """The features of the drift, and uⱼ e_a (wave)(x) for each input j and each coordinate a.

    Attributes:
        drift: the features of the drift.
        waves: the features of the input matrix; None if the matrix is known.
        acts_on: the coordinates on which inputs act.
        count: the number m of inputs; points are (x, u).
    """

    drift: AbstractFeatures
    waves: Basis | None
    acts_on: tuple[int, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        waves = 0 if self.waves is None else len(self.waves.amplitudes)
        return self.drift.columns + len(self.acts_on) * self.count * waves

    def rows(self, x: Float[Array, " d"]) -> Float[Array, "n r"]:
        x, u = x[: -self.count], x[-self.count :]
        drift = self.drift.rows(x)
        if self.waves is None:
            return drift
        directions = jnp.eye(len(x), dtype=x.dtype)[:, np.asarray(self.acts_on)]  # (n, a)
        gains = jnp.kron(directions, jnp.kron(u, self.waves.values(x))[None])
        return jnp.concatenate([drift, gains], axis=1)

    def field(self, x: Float[Array, " d"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        x, u = x[: -self.count], x[-self.count :]
        r = self.drift.columns
        drift = self.drift.field(x, w[:r])
        if self.waves is None:
            return drift
        gains = w[r:].reshape(len(self.acts_on), self.count, -1) @ self.waves.values(x)  # (a, m)
        return drift.at[np.asarray(self.acts_on)].add(gains @ u)

    def potential(self, x: Float[Array, " d"], w: Float[Array, " r"]) -> Float[Array, ""]:
        return self.drift.potential(x[: -self.count], w[: self.drift.columns])

    def laws(self) -> list[tuple[PartWaves, slice]]:
        return self.drift.laws()


class MassFeatures(AbstractFeatures):
    """The features S⁻¹ φ(Sy) of `UnknownMasses`, for the features φ of its kernel."""

    masses: UnknownMasses
    features: AbstractFeatures

    @property
    def columns(self) -> int:
        return self.features.columns

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        return self.masses.to_velocities(self.features.rows(self.masses.to_momenta(x)).T).T

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        return self.masses.to_velocities(self.features.field(self.masses.to_momenta(x), w))

    def potential(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, ""]:
        return self.features.potential(self.masses.to_momenta(x), w)

    def laws(self) -> list[tuple[PartWaves, slice]]:
        return self.features.laws()


class SumFeatures(AbstractFeatures):
    """The features of a sum of kernels: the features of all terms, concatenated."""

    terms: tuple[AbstractFeatures, ...]

    @property
    def columns(self) -> int:
        return sum(term.columns for term in self.terms)

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "n r"]:
        return jnp.concatenate([term.rows(x) for term in self.terms], axis=1)

    def field(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, " n"]:
        return sum(
            (t.field(x, w[self.slice(i)]) for i, t in enumerate(self.terms)), jnp.zeros_like(x)
        )

    def potential(self, x: Float[Array, " n"], w: Float[Array, " r"]) -> Float[Array, ""]:
        return sum(
            (t.potential(x, w[self.slice(i)]) for i, t in enumerate(self.terms)),
            jnp.zeros((), x.dtype),
        )

    def laws(self) -> list[tuple[PartWaves, slice]]:
        starts = np.cumsum([0, *(term.columns for term in self.terms)])
        return [
            (waves, slice(start + at.start, start + at.stop))
            for start, term in zip(starts, self.terms, strict=False)
            for waves, at in term.laws()
        ]

    def slice(self, index: int) -> slice:
        """The positions of the weights of one term."""
        start = sum(term.columns for term in self.terms[:index])
        return slice(start, start + self.terms[index].columns)


def features(
    K: AbstractMatrixKernel, n: int, count: int, key: Key[Array, ""], dtype: Any
) -> AbstractFeatures:
    """The features of a structured kernel: random Fourier features, or those of `Shared` laws.

    Args:
        K: a structure, or a sum of structures, on shift-invariant scalar kernels.
        n: the number of coordinates of a point, inputs included.
        count: the number of frequencies for each term of each scalar kernel.
        key: the random key.
        dtype: the dtype of the features.

    Raises:
        TypeError: a scalar kernel has no known spectral density, or the structure is unknown.
    """
    # We dispatch on the type of K, so that structures do not depend on features.
    if isinstance(K, Controlled):
        return _controlled_features(K, n, count, key, dtype)
    if isinstance(K, Sum):
        keys = jax.random.split(key, len(K.terms))
        pairs = zip(K.terms, keys, strict=True)
        return SumFeatures(tuple(features(term, n, count, key, dtype) for term, key in pairs))
    if isinstance(K, Friction):
        return FrictionFeatures(K, n)
    if isinstance(K, UnknownMasses):
        return MassFeatures(K, features(K.kernel, n, count, key, dtype))
    if not isinstance(K, Separable | DivergenceFree | AbstractPotentialKernel):
        raise TypeError(
            f"RandomFeatures does not know the structure {type(K).__name__}. Use Symplectic, "
            "CurlFree, DivergenceFree, Separable or sums of them, or another solver."
        )
    waves = waves_of(K.kernel, n, count, key, dtype)
    if isinstance(K, AbstractPotentialKernel):
        return PotentialFeatures(K, waves)
    return (DivergenceFreeFeatures if isinstance(K, DivergenceFree) else SeparableFeatures)(
        waves, n
    )


def _controlled_features(K: Controlled, n: int, count: int, key: Key[Array, ""], dtype: Any):
    n, inputs = K.outputs(n), K.input_count
    of_drift, of_matrix = jax.random.split(key)
    drift, G = features(K.drift, n, count, of_drift, dtype), K.inputs
    if isinstance(G, KnownMatrix):
        return ControlledFeatures(drift, None, (), inputs)
    acts_on = tuple(range(n)) if G.acts_on is None else G.acts_on
    return ControlledFeatures(
        drift, waves_of(G.kernel, n, count, of_matrix, dtype), acts_on, inputs
    )
