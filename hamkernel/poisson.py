"""Ready-made tensors Π(x) for `hk.Poisson(k, tensor)`: fields f = Π(x)∇H.

    hk.Poisson(k, hk.poisson.rigid_body)            # angular momenta of a body, n = 3
    hk.Poisson(k, hk.poisson.lotka_volterra)        # two populations, n = 2
    hk.Poisson(k, hk.poisson.charged_particle(B))   # in a magnetic field, n = 4 or 6

A tensor is a function x (n,) -> (n, n); `Poisson` also takes functions of your own. `save` stores
the tensors of this module by name.
"""

from hamkernel._structures.custom_operator import charged_particle, lotka_volterra, rigid_body

__all__ = ["charged_particle", "lotka_volterra", "rigid_body"]
