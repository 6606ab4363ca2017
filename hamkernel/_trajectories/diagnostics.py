"""Whether what was learned explains the runs, and what to say where it does not."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._trajectories.runs import Runs

# χ² per degree of freedom has the standard deviation √(2/ν); five of them, and a tenth for the
# curvature that a linearisation misses.
_SIGMAS, _CURVATURE = 5.0, 0.1

# Noise of half the motion or more: where learning failed, it was found 0.9 to 1.1 times the motion.
_ALL_NOISE = 0.5

# Of the states: what a field that is not yet exact leaves, and averages of samples without noise.
NEGLIGIBLE = 1e-3
_FEW = 10  # degrees of freedom, from which σ is known to a fifth


class FitQuality(NamedTuple):
    """How well the field follows the runs.

    Attributes:
        kept: the share of each run that it was learned from, shape (R,).
        misfit: of each run and coordinate, in units of the noise, shape (R, n).
        chi_squared: per degree of freedom.
        free: the degrees of freedom.
        count: of iterations.
        settled: whether they ended by themselves.
    """

    kept: Float[np.ndarray, " R"]
    misfit: Float[np.ndarray, "R n"]
    chi_squared: float
    free: float
    count: int
    settled: bool


def diagnose(
    fit: FitQuality, noise: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"], given: bool
) -> bool:
    """Warn of what is wrong, and say whether learning converged.

    Args:
        fit: how well the field follows the runs.
        noise: that of each coordinate, NaN where it was never measured.
        scale: the standard deviations of the coordinates.
        given: whether the noise was given.
    """
    warn_of_dropped(fit.kept)
    if not fit.kept.any():
        return False
    explained = explains(fit.chi_squared, fit.free)
    if given and not explained:
        warn_of_misfit(fit.chi_squared, fit.misfit)
        return fit.settled
    left = np.sqrt(fit.chi_squared) * np.nanmax(noise / scale)
    converged = fit.settled and (explained or bool(left < NEGLIGIBLE))
    said = not given and (warn_of_few(fit.free) or warn_of_noise(noise, scale))
    if not (converged or said):
        warn_of_unsettled(fit.count, fit.chi_squared, explained)
    return converged


def explains(chi_squared: float, free: float) -> bool:
    """Whether χ² per degree of freedom is what noise of the given size leaves."""
    return bool(chi_squared <= 1 + _CURVATURE + _SIGMAS * np.sqrt(2 / max(free, 1.0)))


def warn_of_misfit(chi_squared: float, misfit: Float[np.ndarray, "R n"]) -> None:
    """Say that the structure does not explain the runs at the noise that was given, and where."""
    causes = (
        "Likely causes, in order: a part of the motion that the kernel cannot have, such as "
        "friction (add hk.CurlFree, or take hk.PortHamiltonian); (q, q̇) given where (q, p) is "
        "needed (p = m q̇, in one scale; masses=True finds their ratios); a wrong unit; a jump or "
        "push in a run."
    )
    run, c = np.unravel_index(np.nanargmax(misfit), misfit.shape)
    require.warn(
        f"the structure does not explain the runs: χ² is {chi_squared:.3g} per degree of freedom "
        f"at the noise given, and should be 1. The residuals are largest in coordinate {c} of run "
        f"{run}, {misfit[run, c]:.2g} standard deviations. {causes}"
    )


def warn_of_noise(noise: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"]) -> bool:
    """Say where nearly all of the motion was taken for noise, and whether it was."""
    share = np.nan_to_num(noise / scale)
    c = int(np.argmax(share))
    if share[c] < _ALL_NOISE:
        return False
    require.warn(
        f"the field explains little of the runs: the noise found in coordinate {c} is "
        f"{noise[c]:.3g}, and its states vary by {scale[c]:.3g} (standard deviations). Causes: "
        "fewer than about five samples a swing, one lengthscale for coordinates of different sizes "
        f"(hk.Gaussian(np.ones({len(noise)})) has one for each), a jump in a run, a structure that "
        "the motion does not have, or sensors that are indeed so noisy. If you know the noise, "
        "pass noise=…; see hk.plot.fitted."
    )
    return True


def warn_of_few(free: float) -> bool:
    """Say that the noise is a guess, and whether it is: σ is known to 1/√(2ν)."""
    if free >= _FEW:
        return False
    require.warn(
        f"the runs leave {max(free, 0.0):.1f} degrees of freedom to find the noise from, which "
        f"takes {_FEW} or more: noise and field are a guess. Log more samples, or pass noise=…."
    )
    return True


def warn_of_unsettled(count: int, chi_squared: float, explained: bool) -> None:
    """Say that the iterations did not end where the field explains the runs."""
    why = f"residuals are {np.sqrt(chi_squared):.2g} times the noise found"
    require.warn(
        f"learning did not converge in {count} iterations: "
        f"{'noise or objective still move' if explained else why}; see .history and "
        "hk.plot.fitted. More samples a swing help, shorter runs, or a kernel closer to the truth."
    )


def warn_of_dropped(kept: np.ndarray) -> None:
    """Name the runs that the field is not learned from."""
    lost = [f"{r} ({1 - share:.0%})" for r, share in enumerate(kept) if share < 1]
    if not kept.any():
        require.warn(
            "nothing was learned: no field of this kernel that was found follows any run. Causes: "
            "too few samples a swing, a mean that is wrong, or a structure that the motion does "
            "not have. Look at hk.plot.smoothing(runs)."
        )
    elif lost:
        more = f" and {len(lost) - 5} more" if len(lost) > 5 else ""
        require.warn(
            f"dropped from run {', '.join(lost[:5])}{more}: the field does not follow the samples "
            "there (a χ² above 25 times the median, or a tangent above 1e4). Look at these runs: a "
            "jump, another system, or chaos with samples too far apart."
        )


def check_identifiable(runs: Runs, mean: Callable[[Array], Array] | None) -> None:
    """A coordinate that no run measured must be known through a mean, of the points (x, u)."""
    never = ~np.any([np.isfinite(np.asarray(x)).any(axis=0) for x in runs.states], axis=0)
    if not never.any():
        return
    which = ", ".join(str(c) for c in np.flatnonzero(never))
    if mean is None:
        raise ValueError(
            f"coordinate {which} was measured in no run. From the others alone it is known only up "
            "to any change of coordinates, p -> g(q, p), so there is nothing to learn it from. "
            "Say how it moves the others: mean=lambda x: jnp.array([x[1] / m, 0.0]) for q̇ = p/m "
            "and K a kernel for the rest, such as hk.Symplectic(hk.Select(k, 0)) for ṗ = -U'(q). "
            "Or log it."
        )
    d = runs.dimension + runs.input_count
    points = np.random.default_rng(0).standard_normal((8, d))
    with require.traceable("mean"):
        D = np.asarray(jax.vmap(jax.jacfwd(mean))(jnp.asarray(points)))  # (8, n, d)
    blind = [c for c in np.flatnonzero(never) if not np.abs(D[:, ~never, c]).max() > 0]
    if blind:
        raise ValueError(
            f"coordinate {blind[0]} was measured in no run, and the velocities of the mean do not "
            "depend on it: give a mean that says how it moves the others, such as q̇ = p/m."
        )
