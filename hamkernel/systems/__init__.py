"""Example systems with a known Hamiltonian, and noisy data sampled from them.

A system is a field like a learned one: `system(x)` is the velocity of one state, `jax.vmap(system)`
that of many, and `system.hamiltonian(x)` the energy. States are x = (q₁…q_m, p₁…p_m), velocities
ẋ = J∇H with J = [[0, I], [−I, 0]]. Units are free but must agree; those named below are SI.

Positive parameters are stored as logarithms (`log_mass`) and read through properties (`mass`),
signed ones as they are: every array leaf is an unconstrained real, and everything is
differentiable with respect to it.

A system only states H, and the field follows from it here and nowhere else. What is not J∇H, such
as damping, is to be added by a module that wraps a system, not by one that overrides its field.
"""

from hamkernel.systems._base import AbstractHamiltonianSystem
from hamkernel.systems._mechanisms import DoublePendulum, Kepler, NBody, PointVortices
from hamkernel.systems._oscillators import (
    Duffing,
    HarmonicOscillator,
    HenonHeiles,
    Pendulum,
    SpringChain,
)
from hamkernel.systems._sample import sample

__all__ = [
    "AbstractHamiltonianSystem",
    "DoublePendulum",
    "Duffing",
    "HarmonicOscillator",
    "HenonHeiles",
    "Kepler",
    "NBody",
    "Pendulum",
    "PointVortices",
    "SpringChain",
    "sample",
]
