"""Pictures of fields, trajectories, energies and searches.

Every function draws on the Matplotlib axes `ax`, or on new ones if None, and returns them. Pass
several curves as a mapping from names to arrays. A name in `COLORS` has the same colour in every
picture; the colours stay distinct for colour-blind readers and in grey.
"""

from hamkernel.plot._learned import band, comparison, deviation, ensemble, hamiltonian, loss_surface
from hamkernel.plot._phase import (
    crossings,
    phase_portrait,
    plane_slice,
    poincare_section,
    trajectories,
)
from hamkernel.plot._result import machine, result, thumbnail
from hamkernel.plot._style import COLORS
from hamkernel.plot._time import energy_drift, fitted, smoothing, trajectory_error

__all__ = [
    "COLORS",
    "band",
    "comparison",
    "crossings",
    "deviation",
    "energy_drift",
    "ensemble",
    "fitted",
    "hamiltonian",
    "loss_surface",
    "machine",
    "phase_portrait",
    "plane_slice",
    "poincare_section",
    "result",
    "smoothing",
    "thumbnail",
    "trajectories",
    "trajectory_error",
]
