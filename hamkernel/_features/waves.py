"""Waves: the functions whose products make a shift-invariant scalar kernel.

With frequencies ω_r and weights c_r of a scalar kernel (`spectra.py`),

    k(x, z) ≈ Σ_r c_r cos(ω_r·(x − z)) = Σ_r c_r [cos ω_r·x cos ω_r·z + sin ω_r·x sin ω_r·z]

is the kernel of the functions u(x) = Σ_r √c_r (α_r cos ω_r·x + β_r sin ω_r·x). An even kernel keeps
the cosines alone, an odd one the sines.

Source: Rahimi & Recht (2007).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from hamkernel._features.spectra import Spectrum, spectra
from hamkernel._kernels.base import AbstractScalarKernel
from hamkernel._kernels.symmetry import symmetry_removed


class Waves(eqx.Module):
    """amplitude·cos(ω·x) for the first `cosines` waves, amplitude·sin(ω·x) for the others."""

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


class GroupWaves(eqx.Module):
    """Means of waves over a finite group, Σ_g χ(g) wave(g x)/|G|: features of the mean kernel."""

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
        slopes = jax.vmap(self.waves.gradients)(matrices @ x)  # (G, n, w) at g x
        return jnp.einsum("g,gba,gbw->aw", characters, matrices, slopes) / len(characters)

    def _constants(self) -> tuple[Float[Array, "G n n"], Float[Array, " G"]]:
        """The group, which is not differentiated."""
        return jax.lax.stop_gradient((self.matrices, self.characters))


def waves_of(
    k: AbstractScalarKernel, n: int, count: int, key: Key[Array, ""], dtype: Any
) -> Waves | GroupWaves:
    """Waves with the spectrum of a scalar kernel, and with its symmetry."""
    found = symmetry_removed(k)
    if found is None or found.parity is not None:  # which `Spectrum` knows
        return Waves(spectra(k, n, count, key, dtype))
    group = found.group(n)
    return GroupWaves(
        Waves(spectra(found.kernel, n, count, key, dtype)),
        jnp.asarray(np.stack([g.matrix for g in group]), dtype),
        jnp.asarray([g.character for g in group], dtype),
    )
