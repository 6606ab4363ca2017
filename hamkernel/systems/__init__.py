"""Example systems with a known Hamiltonian, and noisy data sampled from them.

A system is a field, like a learned one: `system(x)` is the velocity of one state,
`jax.vmap(system)` that of many, and `system.hamiltonian(x)` the energy. States are
x = (q₁…q_m, p₁…p_m), velocities ẋ = J∇H with J = [[0, I], [−I, 0]]. Units are free but must agree;
those named below are SI.

Positive parameters are stored as logarithms (`log_mass`) and read through properties (`mass`),
signed ones as they are: every array leaf is an unconstrained real, and everything is
differentiable with respect to it.

A system states only H, and the field follows from it: J∇H, or Π(x)∇H for `RigidBody`,
`LotkaVolterra` and `ChargedParticle`. Friction and inputs come from modules that wrap a system,
as in `Driven(Damped(Pendulum(), 0.1), [[0.0], [1.0]])`; call a driven system as `system(x, u)`.
"""

from hamkernel.systems._base import AbstractHamiltonianSystem, Damped, Driven, sample
from hamkernel.systems._bodies import (
    AbstractPoissonSystem,
    ChargedParticle,
    Kepler,
    LotkaVolterra,
    NBody,
    PointVortices,
    RigidBody,
)
from hamkernel.systems._mechanisms import (
    Acrobot,
    CartPole,
    DoublePendulum,
    Duffing,
    HarmonicOscillator,
    HenonHeiles,
    Pendulum,
    SpringChain,
)

__all__ = [
    "AbstractHamiltonianSystem",
    "AbstractPoissonSystem",
    "Acrobot",
    "CartPole",
    "ChargedParticle",
    "Damped",
    "DoublePendulum",
    "Driven",
    "Duffing",
    "HarmonicOscillator",
    "HenonHeiles",
    "Kepler",
    "LotkaVolterra",
    "NBody",
    "Pendulum",
    "PointVortices",
    "RigidBody",
    "SpringChain",
    "sample",
]
