"""Example systems with a known Hamiltonian, and noisy data sampled from them.

A system is a field, like a learned one: `system(x)` is the velocity of one state,
`jax.vmap(system)(X)` the velocities of many, and `system.hamiltonian(x)` the energy. States are
x = (q₁…q_m, p₁…p_m), velocities ẋ = J∇H with J = [[0, I], [−I, 0]]. Any consistent units will do;
the docstrings name SI units.

Positive parameters are stored as logarithms (`log_mass`), and properties (`mass`) return their
values. Signed parameters are stored as they are. Every array leaf is therefore an unconstrained
real, with respect to which you may differentiate.

A system defines only H. Its field is J∇H, or Π(x)∇H for `RigidBody`, `LotkaVolterra` and
`ChargedParticle`. `Damped` and `Driven` add friction and inputs to a system, as in
`Driven(Damped(Pendulum(), 0.1), [[0.0], [1.0]])`. Call a driven system as `system(x, u)`.
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
