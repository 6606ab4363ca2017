"""Whether a learned field may be used: one row for each question, and one warning.

Each function below answers one question about a `FitQuality` and returns a `Diagnostic`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Float

from hamkernel._kernels.transforms import Select, Warp
from hamkernel._learned.whiteness import FALSE_ALARMS, Whiteness
from hamkernel._runs.sensors import Timing
from hamkernel._runs.table import Diagnostic, Diagnostics
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.friction import damped_coordinates, frictions

# The change of a field, relative to its size, at which iterations end. It may leave residuals of as
# much of the states: 40 runs of a double pendulum without noise end with some of 1e-5, 2.4 times
# the noise found.
SETTLED = 1e-4
_SWING = 5.0  # samples in a swing: with fewer noise and motion cannot be told apart
# The error of free runs over that of a constant, below which correlated residuals do not decide.
# Where viscous friction is missing it is .35 and .37, of a spiral that grows .34, of limit cycles
# .73 to 1, and .04 of one that a wrong field follows (`tests/benchmarks/verdicts.py`, seeds 0 and
# 1). It is .01 where few landmarks leave a field of eight coordinates
# 1.3 % off (`tests/benchmarks/capacity.py chain`). Three runs that lose energy and never cross can
# be followed without friction: dry friction that is missing left .006, see `_LOSSY`.
_CLOSE = 0.1
# The same error, below which free runs follow the log. Sensor noise of s of the motion leaves about
# s of right fields, and from s = .5 on the noise decides.
FOLLOWED = 0.5
# The share of the speed that is process noise, below which correlated innovations do not decide
# where free runs follow: .020 on a real pendulum, where rollouts of a second are right to .05 rad.
# Friction that is missing left .037, limit cycles .053, drives that were not logged .037 and .044.
_SMALL = 0.03
# Coordinates whose sizes differ by as much may need a lengthscale each. Five runs of a double
# pendulum, with angles of .5 and momenta of 3: log p rises by 576 and the field error falls from 7
# to 2 % (`tests/test_verdicts.py`).
_APART = 3.0
FEW = 10  # degrees of freedom, from which σ is known to a fifth
# The share of the forces above which a missing one decides. Friction of the share s takes 2πs of
# the energy of an oscillator in each swing: a tenth.
_LOSSY = 0.1 / (2 * np.pi)
# The same of a force outside the structure, which may be no friction. Counts of predators and prey,
# whose logarithms alone are Hamiltonian, have .30 to .34 in eight logs, limit cycles .38 to .45 in
# three (`tests/benchmarks/verdicts.py`), and sensors whose errors are correlated .03 to .12.
_FOREIGN = 0.2


LARGE_GAIN = 10  # of log p: the odds are e¹⁰ to one


class MissingForce(NamedTuple):
    """A force that the kernel lacks, or may lack.

    Attributes:
        gain: by how much the force raises log p; 0 where nothing asked.
        share: the RMS of the force over that of the rates of the momenta, along the runs; 0 where
            the gain is small.
    """

    gain: float = 0.0
    share: float = 0.0

    @property
    def is_there(self) -> bool:
        """Whether the gain is large."""
        return self.gain > LARGE_GAIN


class FitQuality(NamedTuple):
    """How well the field follows the runs.

    Attributes:
        names: the names of the coordinates, those of the columns of the log if it has any.
        noise: σ of each coordinate, shape (n,), NaN where it was never measured.
        scale: the standard deviations of the coordinates, shape (n,).
        is_noise_known: whether the caller gave the noise.
        kept: the share of each run that the field was learned from, shape (R,).
        dropped: the parts that the field was not learned from, each as run, first sample, and the
            sample after the last.
        misfit: the misfit of each run and coordinate, in units of the noise, shape (R, n).
        core: the deviation of the middle half of the residuals over that of all, by coordinate,
            shape (n,); one for normal residuals, NaN where there are none.
        chi_squared: χ² per degree of freedom, of the fit without process noise if q was estimated.
        free: the degrees of freedom of that fit.
        remaining: the degrees of freedom that the fit leaves, process noise included.
        white: how white the innovations are.
        process: q if it was estimated, shape (n,); None where it was given.
        share: the largest share of the speed of a coordinate that is process noise, averaged over a
            swing.
        impulse: the largest jump by a push, over the standard deviation of the coordinate.
        pushed: the parts in which something pushed the system, as those that were dropped.
        count: the number of iterations.
        settled: whether they ended by themselves.
        swing: how many samples there are in a swing.
        driven: whether there are inputs.
        few: the number of landmarks if more would help but were not taken, because a number was
            given or more would take too long; else 0.
        between: how inputs go on in a likelier way than was said; "" if they do not.
        friction: viscous and dry friction that the kernel lacks.
        inertia: forces that are quadratic in the velocities and that the kernel lacks.
        structure: a force outside the structure, where neither of these is missing.
        has_momenta: whether half of the coordinates are momenta, on which friction can act.
        has_friction: whether the kernel has a `Friction`.
        is_curve: whether the momentum is one function of the position in the data.
        energies: how far the energies of the runs are apart, in standard deviations of one energy;
            None where runs of one energy can determine the field.
        timing: how residuals grow with the speed; None where that cannot be told.
        free_run: the error of free runs over that of a constant, over two swings or fewer.
    """

    names: Sequence[str]
    noise: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, " n"]
    is_noise_known: bool
    kept: Float[np.ndarray, " R"]
    dropped: tuple[tuple[int, int, int], ...]
    misfit: Float[np.ndarray, "R n"]
    core: Float[np.ndarray, " n"]
    chi_squared: float
    free: float
    remaining: float
    white: Whiteness
    process: Float[np.ndarray, " n"] | None
    share: float
    impulse: float
    pushed: tuple[tuple[int, int, int], ...]
    count: int
    settled: bool
    swing: float
    driven: bool
    few: int = 0
    between: str = ""
    friction: MissingForce = MissingForce()
    inertia: MissingForce = MissingForce()
    structure: MissingForce = MissingForce()
    has_momenta: bool = False
    has_friction: bool = False
    is_curve: bool = False
    energies: float | None = None
    timing: Timing | None = None
    free_run: float = 0.0

    @property
    def is_resolved(self) -> bool:
        """Whether landmarks are the limit, and leave less than a hundredth of the motion.

        The residuals are then errors of the landmarks, neither normal nor white. Of 400 runs of a
        double pendulum they are 2e-4 of the motion (`tests/benchmarks/capacity.py double 400`).
        """
        return bool(self.few and np.nanmax(self.noise / self.scale) < NEGLIGIBLE)

    @property
    def is_exact(self) -> bool:
        """Whether residuals are as small as those of a settled field without noise.

        A noise that is given is meant, however small.
        """
        size = np.sqrt(self.chi_squared) * np.nanmax(self.noise / self.scale)
        return not self.is_noise_known and bool(size < SETTLED)

    @property
    def is_disturbed(self) -> bool:
        """Whether process noise was found."""
        return self.process is not None and bool(self.process.any())


def diagnostics(
    fit: FitQuality, K: AbstractMatrixKernel, X: Float[np.ndarray, "N d"]
) -> Diagnostics:
    """The table for a fit with the kernel K of runs that pass the points X."""
    if not fit.kept.any():
        return Diagnostics((_parts_left_out(fit),))
    rows = [
        _free_run(fit),  # first, so that a warning begins with it: users see this failure
        _settling(fit),
        _noise_against_motion(fit),
        _outliers(fit),
        degrees_of_freedom(fit),
        _force(fit),  # a cause with a cure, before its symptoms
        _chi_squared(fit),
        _whiteness(fit, K),
        _process_noise(fit),
        _pushes(fit),
        _parts_left_out(fit),
        _landmarks(fit),
        _samples_per_swing(fit),
        _timing(fit),
        _curve(fit),
        _energies(fit),
        lengthscales(K, fit.scale, fit.names),
        rest_speed(K, X, len(fit.scale)),
    ]
    return Diagnostics(tuple(row for row in rows if row is not None))


def diagnostics_of_rows(fit: FitQuality, scatter: float) -> Diagnostics:
    """The table for a field that two solves with weak rows found, see `laws.py`."""
    rows = [_scatter(scatter), _noise_against_motion(fit), _free_run(fit), degrees_of_freedom(fit)]
    return Diagnostics((*rows, _samples_per_swing(fit)))


def _scatter(scatter: float) -> Diagnostic:
    """Whether rows scatter about the law as the noise of the samples says they should."""
    # Of 10 and 30 Lennard-Jones particles rows scatter 1.0 to 1.15 times as much.
    return Diagnostic(
        "rows",
        f"{scatter:.2f} times the noise",
        "1.5",
        scatter < 1.5,
        f"what is left of the rows is {scatter:.2g} times what noise of the samples makes of them",
        "Bands are as much wider. Likely causes: a force that is no law of these parts, such as "
        "friction or another species; samples too far apart for the motion.",
        decides=scatter > 5.0,
    )


def _settling(fit: FitQuality) -> Diagnostic:
    """Whether the iterations ended by themselves."""
    return Diagnostic(
        "iterations",
        f"{fit.count}, {'settled' if fit.settled else 'still moving'}",
        "settled",
        fit.settled,
        f"noise, objective and field {'stand still' if fit.settled else 'still move'} after "
        f"{fit.count} iterations",
        f"iterations={2 * fit.count} goes on; a kernel closer to the truth and shorter runs help.",
        decides=True,
    )


def _noise_against_motion(fit: FitQuality) -> Diagnostic:
    """Whether the field explains most of the motion: where learning failed, .9 to 1.1 are found.

    From ten coordinates on a tenth of them may hardly move: in one film of 30 particles one of 120
    coordinates moved by less than the noise, and the law was right to some thousandths.
    """
    share = np.nan_to_num(fit.noise / fit.scale)
    n = len(share)
    c = int(np.argsort(share)[n - 1 - n // 10])
    return Diagnostic(
        "noise",
        f"{share[c]:.2g} of the motion",
        "0.5",
        bool(share[c] < 0.5),
        f"the field explains {'the runs' if share[c] < 0.5 else 'little of the runs'}: the noise "
        f"of coordinate {fit.names[c]} is {fit.noise[c]:.3g}, and its smoothed path varies by "
        f"{fit.scale[c]:.3g}",
        "Look for a sample that is no measurement, a jump, a structure that the motion does not "
        f"have, or one lengthscale for coordinates of different sizes (hk.Gaussian(np.ones({n})) "
        "has one for each).",
        decides=True,
    )


def _free_run(fit: FitQuality) -> Diagnostic:
    """Whether the field predicts its own runs better than a constant does."""
    closer = f"{1 / max(fit.free_run, 1e-9):.2g} times closer than a constant"
    only = "only " if fit.free_run >= FOLLOWED else ""
    return Diagnostic(
        "free run",
        f"{fit.free_run:.2g} of the error of a constant",
        f"{FOLLOWED}",
        fit.free_run < FOLLOWED,
        f"free runs of the field follow the log {only}{closer}"
        if fit.free_run < 1
        else "free runs of the field are no better than saying that nothing moves",
        "Look at hk.plot.fitted; the motion may not have this structure, or be pushed at random.",
        decides=fit.free_run >= 1,
    )


def _outliers(fit: FitQuality) -> Diagnostic | None:
    """Whether σ is the noise of most samples.

    `core` is 1 for normal residuals and 1.28 for those of a quantised sensor. With one sample in
    eight written as zero it is .1 to .3.
    """
    core = np.where(fit.noise > SETTLED * fit.scale, fit.core, np.nan)
    if fit.is_noise_known or not np.isfinite(core).any():
        return None
    c = int(np.nanargmin(core))
    return Diagnostic(
        "outliers",
        f"robust deviation {core[c]:.2g} of the noise",
        "0.5",
        bool(core[c] > 0.5),
        "most residuals are as large as the noise that was found"
        if core[c] > 0.5
        else f"a few samples of coordinate {fit.names[c]} are far off, and the noise found is "
        "theirs",
        "Look at learned.residuals for samples that are no measurements, such as the zeros of a "
        "dropout, and write NaN for them.",
        decides=not fit.is_resolved,
    )


def degrees_of_freedom(fit: FitQuality) -> Diagnostic:
    """Whether there is enough to find the noise from: σ is known to 1/√(2ν)."""
    few = not fit.is_noise_known and fit.remaining < FEW
    return Diagnostic(
        "degrees of freedom",
        f"{max(fit.remaining, 0.0):.1f}",
        f"{FEW}",
        not few,
        f"the runs leave {max(fit.remaining, 0.0):.1f} degrees of freedom"
        + (": noise and field are a guess" if few else ""),
        "Log more samples, or pass noise=….",
        decides=True,
    )


def _chi_squared(fit: FitQuality) -> Diagnostic:
    """Whether the structure alone explains the runs at the noise."""
    passes = explains(fit.chi_squared, fit.free)
    run, c = divmod(int(np.nanargmax(fit.misfit)), fit.misfit.shape[1])
    return Diagnostic(
        "chi squared",
        f"{fit.chi_squared:.3g}",
        f"{_chi_squared_limit(fit.free):.3g}",
        passes or fit.is_exact or (fit.is_disturbed and not fit.is_noise_known),
        f"χ² is {fit.chi_squared:.3g} per degree of freedom at the noise "
        f"{'given' if fit.is_noise_known else 'found'}; residuals are largest in coordinate "
        f"{fit.names[c]} of run {run}, {fit.misfit[run, c]:.2g} standard deviations",
        f"Likely causes: {missing_force(fit)}; (q, q̇) given where (q, p) is needed (masses=True "
        "finds the ratios of masses); a wrong unit; a jump or push in a run.",
        decides=not fit.is_disturbed,
    )


def _chi_squared_limit(free: float) -> float:
    # The standard deviation of χ²/ν is √(2/ν). We allow five of them, and a tenth for the curvature
    # that a linearisation misses.
    return float(1.1 + 5 * np.sqrt(2 / max(free, 1.0)))


def explains(chi_squared: float, free: float) -> bool:
    """Whether χ² per degree of freedom is what noise of the given size leaves."""
    return bool(chi_squared <= _chi_squared_limit(free))


def _whiteness(fit: FitQuality, K: AbstractMatrixKernel) -> Diagnostic:
    """Whether the residuals of the prediction are independent from sample to sample."""
    white, c = fit.white, int(np.argmax(np.abs(fit.white.neighbours)))
    passes = fit.is_exact or not white.is_refuted
    wider = f", bands {white.widening**0.5:.2g} times wider" if white.widening > 1 else ""
    causes = "what the process noise stands for, which is a force and not white"
    is_small_force = 0 < fit.share < _SMALL and fit.free_run < FOLLOWED
    if fit.share == 0:
        causes = missing_force(fit)
    if np.nanmax(fit.scale) > _APART * np.nanmin(fit.scale) and has_one_lengthscale(K):
        causes = f"one lengthscale for coordinates of other sizes, give {len(fit.scale)}; {causes}"
    if fit.between:
        causes = f"inputs go on otherwise, between='{fit.between}' is likelier; {causes}"
    elif fit.driven:
        causes = f"inputs that act at other times than logged (delay='fit'); {causes}"
    return Diagnostic(
        "whiteness",
        f"p = {white.probability:.2g}{wider}",
        f"p = {FALSE_ALARMS}, or 1.2 times",
        passes,
        f"the innovations are {'not ' if white.is_refuted else ''}white: the correlation of "
        f"neighbours is {white.neighbours[c]:.2f} in coordinate {fit.names[c]}",
        f"Likely causes: {causes}; sensors that are filtered or resampled.",
        decides=not (fit.is_resolved or fit.free_run < _CLOSE or is_small_force),
    )


# Process noise and pushes below this share of the motion change no rollout that anyone would draw.
NEGLIGIBLE = 0.01


def _process_noise(fit: FitQuality) -> Diagnostic | None:
    """Whether w in ẋ = f + w stands for much of the motion."""
    if fit.process is None:
        return None
    silent = not fit.is_disturbed or fit.share < NEGLIGIBLE
    return Diagnostic(
        "process noise",
        f"{fit.share:.2g} of the speed",
        f"{NEGLIGIBLE}",
        silent,
        "the structure alone explains the runs"
        if not fit.is_disturbed
        else f"process noise of intensity {_numbers(fit.process)} in units of the states over √time"
        " makes the runs likelier",
        f"Likely causes: {missing_force(fit)};"
        + (" inputs that act at other times than logged (delay='fit');" if fit.driven else "")
        + " stiction; a flexible part. learned.disturbance is w; process_noise=0 learns without.",
    )


def _pushes(fit: FitQuality) -> Diagnostic:
    """Whether there are intervals with a w much larger than that of the rest."""
    return Diagnostic(
        "pushes",
        f"{len(fit.pushed)}, of {fit.impulse:.2g} of the motion",
        f"{NEGLIGIBLE}",
        not fit.pushed or fit.impulse < NEGLIGIBLE,
        f"something pushed the system in {len(fit.pushed)} parts of the runs",
        "learned.pushed names the samples. Look there for a hand, a stop, a cable, inputs that "
        "were not applied, or a force that the kernel cannot have.",
    )


def _parts_left_out(fit: FitQuality) -> Diagnostic:
    """Whether the field follows all parts of the runs."""
    share = float(1 - fit.kept.mean())
    nothing = not fit.kept.any()
    return Diagnostic(
        "parts left out",
        f"{share:.0%}",
        "0%",
        not (fit.dropped or nothing),
        "nothing was learned: no field of this kernel that was found follows any run"
        if nothing
        else f"the field is learned from {1 - share:.0%} of the samples",
        "learned.dropped names the samples. Look at hk.plot.smoothing(runs) for a jump, another "
        "system, too few samples a swing, or a mean that is wrong.",
        decides=nothing,
    )


def _landmarks(fit: FitQuality) -> Diagnostic:
    """Whether more landmarks would make the runs likelier."""
    return Diagnostic(
        "landmarks",
        f"{fit.few} are too few" if fit.few else "enough",
        "log p stands still",
        not fit.few,
        f"the field is limited by its {fit.few} landmarks"
        if fit.few
        else "more landmarks would not help",
        f"solver=hk.Nystrom(max_points={2 * fit.few}) takes two to four times as long. Until then "
        "noise, process noise and pushes may stand for what the landmarks cannot say.",
    )


def _force(fit: FitQuality) -> Diagnostic:
    """Whether a force that the kernel lacks would make the runs likelier."""
    missing = max(fit.friction, fit.inertia, fit.structure, key=lambda force: force.gain)
    shown = f", {missing.share:.0%} of the forces" if missing.is_there else ""
    # Errors of sensors that are correlated look like a smaller foreign force.
    silent, usable = (_FOREIGN, _FOREIGN) if missing is fit.structure else (NEGLIGIBLE, _LOSSY)
    return Diagnostic(
        "missing force",
        f"log p + {missing.gain:.0f}{shown}",
        f"log p + {LARGE_GAIN}",
        not missing.is_there or missing.share < silent,
        f"the runs are likelier with {missing_force(fit)}"
        if missing.is_there
        else "no force is missing",
        "Add the term; until then gains and the rest of the field may be wrong by more than their "
        "bands.",
        decides=missing.share > usable,
    )


def missing_force(fit: FitQuality) -> str:
    """The force that the kernel lacks, or may lack, with the kernel to add."""
    friction, inertia = fit.friction.gain, fit.inertia.gain
    if fit.inertia.is_there and inertia > 3 * friction:  # see `missing_inertia`
        return (
            "a mass matrix that depends on the positions, as that of links (log p + "
            f"{inertia:.0f}): velocities are no momenta there; give the kinetic energy in "
            "mean, with p = M(q) v"
        )
    # `Friction` acts on each momentum by itself.
    joints = "; joints between links have a kernel of their own, in the docstring of hk.Friction"
    joints = joints if fit.misfit.shape[1] > 2 else ""
    if fit.friction.is_there:
        return (
            f"friction (log p + {friction:.0f}): add hk.Friction() to the drift, "
            f"hk.Sum(energy=…, friction=hk.Friction()){joints}"
        )
    if fit.structure.is_there:
        return (
            f"a field outside the structure (log p + {fit.structure.gain:.0f}): take coordinates "
            "in which the structure holds, such as logarithms of counts, or "
            "hk.Sum(energy=…, rest=hk.CurlFree(…))"
        )
    if friction < 0:  # which was looked for
        return "another force, or too few landmarks (more: solver=hk.Nystrom(max_points=…))"
    if fit.has_friction:
        return f"friction of another form (hk.Friction(stribeck=…), another rest_speed{joints})"
    if fit.has_momenta:
        return (
            "friction (add hk.Friction() to the drift, or with measured momenta take "
            f"hk.PortHamiltonian{joints})"
        )
    return "friction or another force (add hk.CurlFree)"


def _samples_per_swing(fit: FitQuality) -> Diagnostic:
    """Whether the samples are dense enough to tell noise from motion."""
    poor = fit.swing < _SWING and not np.nanmax(fit.noise / fit.scale) < 0.5
    return Diagnostic(
        "sampling",
        f"{fit.swing:.1f} samples a swing",
        f"{_SWING:.0f}",
        not poor,
        f"there are {fit.swing:.1f} samples a swing",
        "Sample faster: with fewer than five, noise and motion cannot be told apart.",
    )


def _timing(fit: FitQuality) -> Diagnostic | None:
    """Whether residuals grow with the speed, as those of times that are off do."""
    if fit.timing is None:
        return None
    return Diagnostic(
        "timing",
        f"{fit.timing.share:.0%} of the variance",
        "20%",
        not fit.timing.is_off,
        "residuals are larger where the states move faster, as if times were off by "
        f"{fit.timing.off:.2g}"
        if fit.timing.is_off
        else "residuals do not grow with the speed",
        "Log the times at which the sensors measure, rather than those at which samples arrive; a "
        "noise that grows with the motion looks alike.",
    )


def _curve(fit: FitQuality) -> Diagnostic | None:
    """Whether the data pass each position with one velocity alone."""
    if not fit.is_curve:
        return None
    return Diagnostic(
        "one curve",
        "yes",
        "no",
        False,
        "the momentum is one function of the position in all runs, which say nothing of the field "
        "beside that curve",
        "Log a run that passes a position with another velocity. A system without inertia looks "
        "like this, such as heat or a capacitor that discharges, and has no Hamiltonian: learn the "
        "rate of the position alone, hk.learn(hk.CurlFree(k), runs) with n = 1.",
        decides=True,
    )


def _energies(fit: FitQuality) -> Diagnostic | None:
    """Whether runs in the plane differ in energy.

    Along a level of H every field of φ(H) with φ′ = 1 there moves alike, so runs of one energy do
    not tell the field at other energies. Two runs of a pendulum with noise of .01 are released from
    angles of 1.2 and 1.2 (1 − δ). For δ = 0, .01, .02 and .1 their energies are .15, 3.4, 7.7 and
    42 deviations apart, and the median error of the field inside the larger orbit is 2.6, 2.3, 1.5
    and 1.0 of its own deviations. With noise of .05 and δ = 0, .02, .05 and .1 energies are .19,
    1.3, 3.5 and 7.6 apart, errors 1.5, 1.5, 1.1 and .8 (`tests/benchmarks/verdicts.py --energies`).
    """
    if fit.energies is None:
        return None
    passes = fit.energies > 5
    return Diagnostic(
        "energies",
        f"{fit.energies:.2g} deviations apart",
        "5",
        passes,
        "the runs have different energies"
        if passes
        else "the runs have one energy to within its uncertainty; at other energies the field and "
        "its bands rest on the kernel alone",
        "Log runs of other energies. If H = U(q) + T(p), say so with the kernel "
        "hk.Symplectic(hk.Select(k, 0) + hk.Select(k, 1)), which one orbit determines.",
    )


def lengthscales(
    K: AbstractMatrixKernel, scale: Float[np.ndarray, " n"], names: Sequence[str]
) -> Diagnostic | None:
    """Whether one lengthscale serves coordinates whose sizes differ by a factor of more than 300.

    The field of a pendulum with noise of 1 % has an error of .004 for factors of 3 to 100, and of
    .44 for a factor of 1000.
    """
    least, largest = float(np.nanmin(scale)), float(np.nanmax(scale))
    if not largest > 300 * least > 0:
        return None

    single = has_one_lengthscale(K)
    return Diagnostic(
        "lengthscales",
        "one" if single else "one for each coordinate",
        "sizes within 300",
        not single,
        f"the states vary by {least:.2g} in coordinate {names[int(np.nanargmin(scale))]} and by "
        f"{largest:.2g} in coordinate {names[int(np.nanargmax(scale))]}"
        + (", and the kernel has one lengthscale for both" if single else ""),
        f"Give each coordinate its own, hk.Gaussian(np.ones({len(scale)})), or take units in which "
        "all are near one.",
    )


def has_one_lengthscale(K: AbstractMatrixKernel) -> bool:
    """Whether a kernel of all coordinates has one lengthscale for all of them."""

    def is_on_some(node: object) -> bool:
        return isinstance(node, Select | Warp)

    paths, _ = tree_flatten_with_path(K.state_kernel, is_leaf=is_on_some)
    return any(keystr(path).endswith(".log_lengthscale") and not leaf.shape for path, leaf in paths)


def rest_speed(K: AbstractMatrixKernel, X: Float[np.ndarray, "N d"], n: int) -> Diagnostic | None:
    """Whether dry friction fades over much of the momenta in X.

    On a drive of at most .25 m/s a rest speed of .1 left the drift 27 % off for 3.7 %, and a free
    run of 12 s 20 mm for 2.7 (`tests/benchmarks/machines.py`).
    """
    for part in frictions(K):
        fastest = float(np.abs(X[:, list(damped_coordinates(part.damped, n))]).max())
        if part.rest_speed and 0 < fastest < 10 * part.rest_speed:
            return Diagnostic(
                "rest speed",
                f"{part.rest_speed:.3g}",
                f"{fastest / 10:.3g}",
                False,
                f"the rest_speed of hk.Friction is {part.rest_speed:.3g} and the largest momentum "
                f"{fastest:.3g}, so that dry friction looks like a viscous one",
                f"Leave it out, or take hk.Friction(rest_speed={fastest / 100:.2g}).",
            )
    return None


def _numbers(values: Float[np.ndarray, " n"]) -> str:
    return "(" + ", ".join(f"{v:.2g}" for v in values) + ")"
