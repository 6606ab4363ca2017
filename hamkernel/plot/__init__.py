"""Pictures of fields, trajectories, energies and searches.

Every function draws on the Matplotlib axes `ax`, or on new ones if None, and returns them. Pass
several curves as a mapping from names to arrays. A name in `COLORS` has the same colour in every
picture; the colours stay distinct for colour-blind readers and in grey.
"""

from hamkernel.plot._comparison import comparison
from hamkernel.plot._contours import hamiltonian, loss_surface
from hamkernel.plot._phase import phase_portrait, plane_slice, trajectories
from hamkernel.plot._poincare import crossings, poincare_section
from hamkernel.plot._runs import fitted, smoothing
from hamkernel.plot._style import COLORS
from hamkernel.plot._time import energy_drift, trajectory_error
from hamkernel.plot._uncertainty import band, deviation, ensemble

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
    "phase_portrait",
    "plane_slice",
    "poincare_section",
    "smoothing",
    "trajectories",
    "trajectory_error",
]
