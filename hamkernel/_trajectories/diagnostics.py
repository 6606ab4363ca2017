"""Whether the learned field explains the runs, and the warnings where it does not."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._kernels.transforms import Select, Warp
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.friction import damped_coordinates, frictions
from hamkernel._trajectories.preprocessing import Preprocessed
from hamkernel._trajectories.runs import Runs

# The change of a field, relative to its size, at which iterations end. It may leave residuals of as
# much of the states: 40 runs of a double pendulum without noise end with some of 1e-5, 2.4 times
# the noise found.
SETTLED = 1e-4
_SWING = 5.0  # samples in a swing: with fewer noise and motion cannot be told apart
_FEW = 10  # degrees of freedom, from which σ is known to a fifth


class Whiteness(NamedTuple):
    """The correlation of innovations from sample to sample, and what it costs.

    Attributes:
        probability: the probability that white innovations are as correlated, by the test of Ljung
            and Box; 1 where there are too few.
        peak: the largest value of their spectra 1 + 2 Σ_k (1 − k/11) r_k cos(kω), k = 1 to 10; 1
            where they are white.
        neighbours: the correlation of innovations at lag one, by coordinate, shape (n,).
    """

    probability: float
    peak: float
    neighbours: Float[np.ndarray, " n"]

    @property
    def is_enough(self) -> bool:
        """Whether the innovations are as good as white.

        False alarms are 5 % of logs. The noise of a part of the motion that is in one frequency is
        as much larger as the spectrum there; up to 1.44, a deviation of 1.2, at least 90 % lies
        inside of two of the deviations that are said, for 95 %. Of 2e5 innovations a correlation of
        .01 would be significant.
        """
        return self.probability >= 0.05 or self.peak < 1.44

    @property
    def widening(self) -> float:
        """The factor on the variance of noise in the posterior, the peak of the spectrum.

        A field that varies along the runs with one frequency meets the noise at that frequency. On
        the log of a drive with friction, cogging and late inputs the root of the peak is 3.0, 2.4
        and 2.5 for three models. With an Ornstein-Uhlenbeck disturbance, which whitens the
        innovations and needs a state more, the deviation of the gain is 2.8, 2.6 and 3.0 times as
        large, and the gain as wrong (`tests/benchmarks/disturbances.py`).

        It does not stand for forces that repeat with the state, which are no scatter: of a drive
        with cogging .23 of the drift are inside two deviations (`tests/benchmarks/machines.py`). A
        covariance from the scores of blocks of the runs, the sandwich of Liang and Zeger, would not
        either: it is about the field that the kernel comes nearest to. With a term of the kernel
        for them, whose force and length were given, it is .92.
        """
        return 1.0 if self.is_enough else self.peak


class FitQuality(NamedTuple):
    """How well the field follows the runs.

    Attributes:
        kept: the share of each run that the field was learned from, shape (R,).
        dropped: the parts that the field was not learned from, each as run, first sample, and the
            sample after the last.
        misfit: the misfit of each run and coordinate, in units of the noise, shape (R, n).
        chi_squared: χ² per degree of freedom, of the fit without process noise if q was estimated.
        free: the degrees of freedom of that fit.
        remaining: the degrees of freedom that the fit leaves, process noise included.
        white: how white the innovations are.
        process: q if it was estimated, shape (n,); None where it was given.
        needed: whether it was estimated, and the runs are likelier with it.
        count: of iterations.
        settled: whether they ended by themselves.
        swing: how many samples there are in a swing.
        driven: whether there are inputs.
        pushed: the parts in which something pushed the system, as those that were dropped.
        few: the number of landmarks if more would help but were not taken, because a number was
            given or more would take too long; else 0.
        between: how inputs go on in a likelier way than was said; "" if they do not.
        gained: by how much friction in the kernel raises log p; 0 where that was not computed.
        bent: the same of forces that are quadratic in the velocities.
        has_momenta: whether half of the coordinates are momenta, on which friction can act.
        has_friction: whether the kernel has a `Friction`.
    """

    kept: Float[np.ndarray, " R"]
    dropped: tuple[tuple[int, int, int], ...]
    misfit: Float[np.ndarray, "R n"]
    chi_squared: float
    free: float
    remaining: float
    white: Whiteness
    process: Float[np.ndarray, " n"] | None
    needed: bool
    count: int
    settled: bool
    swing: float
    driven: bool
    pushed: tuple[tuple[int, int, int], ...] = ()
    few: int = 0
    between: str = ""
    gained: float = 0.0
    bent: float = 0.0
    has_momenta: bool = False
    has_friction: bool = False

    @property
    def is_disturbed(self) -> bool:
        """Whether process noise was found."""
        return self.needed


def diagnose(
    fit: FitQuality, noise: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"], given: bool
) -> bool:
    """Warn of what is wrong, and return whether learning converged.

    Args:
        fit: how well the field follows the runs.
        noise: that of each coordinate, NaN where it was never measured.
        scale: the standard deviations of the coordinates.
        given: whether the noise was given.
    """
    warn_of_dropped(fit)
    if not fit.kept.any():
        return False
    warn_of_landmarks(fit)
    warn_of_pushes(fit)
    left = np.sqrt(fit.chi_squared) * np.nanmax(noise / scale)
    within = not given and bool(left < SETTLED)
    explained = fit.is_disturbed or within or explains(fit.chi_squared, fit.free)
    if given and not explains(fit.chi_squared, fit.free):
        warn_of_misfit(fit)
    elif fit.is_disturbed:
        warn_of_process(fit)
    said = not given and (warn_of_few(fit.remaining) or warn_of_noise(noise, scale, fit.swing))
    converged = fit.settled and explained and fit.white.is_enough
    if not (converged or said):
        if not fit.settled or not (explained or given):
            warn_of_unsettled(fit, explained)
        if not fit.white.is_enough:
            warn_of_correlation(fit)
    return converged


def explains(chi_squared: float, free: float) -> bool:
    """Whether χ² per degree of freedom is what noise of the given size leaves."""
    # Its standard deviation is √(2/ν): five of them, and a tenth for the curvature that a
    # linearisation misses.
    return bool(chi_squared <= 1.1 + 5 * np.sqrt(2 / max(free, 1.0)))


def _lacked(fit: FitQuality) -> str:
    """The forces that the kernel may lack, with the kernel to add, in words."""
    if fit.bent > max(_FEW, 3 * fit.gained):  # see `gain_of_inertia`
        return (
            "a mass matrix that depends on the positions, as that of links: with forces quadratic "
            f"in the velocities log p would be {fit.bent:.0f} larger. Velocities are no "
            "momenta there; give the kinetic energy in mean, with p = M(q) v"
        )
    # `Friction` acts on each momentum by itself.
    joints = "; joints between links have a kernel of their own, in the docstring of hk.Friction"
    joints = joints if fit.misfit.shape[1] > 2 else ""
    if fit.gained > _FEW:
        return (
            f"friction, with which log p would be {fit.gained:.0f} larger: add hk.Friction() to "
            f"the drift, hk.Sum(energy=…, friction=hk.Friction()){joints}; until then gains and "
            "the rest of the field may be wrong by more than their bands"
        )
    if fit.has_friction:
        such = f"friction of another form (hk.Friction(stribeck=…), another rest_speed{joints})"
    elif fit.has_momenta:
        such = (
            "friction (add hk.Friction() to the drift, or with measured momenta take "
            f"hk.PortHamiltonian{joints})"
        )
    else:
        such = "friction or another force (add hk.CurlFree)"
    return f"a part of the motion that the kernel cannot have, such as {such}"


def warn_in_advance(
    K: AbstractMatrixKernel, data: Preprocessed, X: Float[np.ndarray, "N d"], count: int
) -> None:
    """Warn of what can be seen before learning begins with `count` landmarks on the states X."""
    warn_of_cost(data, count)
    warn_of_rest_speed(K, X, len(data.scale))
    warn_of_units(K, data.scale)


def warn_of_units(K: AbstractMatrixKernel, scale: Float[np.ndarray, " n"]) -> None:
    """Warn of one lengthscale for coordinates whose sizes differ by more than 300.

    With noise of a hundredth, the field of a pendulum has an error of .004 where they differ by 3
    to 100, and of .44 at 1000.
    """
    least, most = float(np.nanmin(scale)), float(np.nanmax(scale))
    if not most > 300 * least > 0:
        return

    def is_on_some(node: object) -> bool:
        return isinstance(node, Select | Warp)

    paths, _ = tree_flatten_with_path(K.of_states, is_leaf=is_on_some)
    if any(keystr(path).endswith(".log_lengthscale") and not leaf.shape for path, leaf in paths):
        require.warn(
            f"the states vary by {least:.2g} in coordinate {np.nanargmin(scale)} and by {most:.2g} "
            f"in coordinate {np.nanargmax(scale)} (standard deviations), and the kernel has one "
            "lengthscale for both: a field that bends along the one is straight along the other, "
            "and Grams are singular to rounding. Give each coordinate its own, "
            f"hk.Gaussian(np.ones({len(scale)})), or take units in which both are near one."
        )


def warn_of_cost(data: Preprocessed, count: int) -> None:
    """Say what learning will cost, if that is much: 2 rows · columns² operations an iteration."""
    n = len(data.scale)
    rows = n * sum(len(run.times) for run in data.runs)
    seconds = 2 * rows * (count * n) ** 2 / 1e10  # by one core, which took 1.6 s for 19 billion
    minutes = 5 * seconds / 60  # 4 or 5 iterations are the rule
    if minutes < 1:
        return
    fewer = max(int(count / minutes**0.5), 1)
    require.warn(
        f"learning will take about {seconds:.0f} s an iteration, and 4 to 8 iterations: "
        f"{rows} measured numbers on {count} landmarks, {count * n} columns. It works; "
        f"solver=hk.Nystrom(max_points={fewer}) takes a minute and finds a smoother field, and "
        "fewer samples or known parts (mean=) take less too."
    )


def warn_of_rest_speed(K: AbstractMatrixKernel, X: Float[np.ndarray, "N d"], n: int) -> None:
    """Warn of a `Friction` whose dry force fades over much of the momenta in X.

    On a drive of at most .25 m/s a rest speed of .1 left the drift 27 % off for 3.7 %, and a free
    run of 12 s 20 mm for 2.7 (`tests/benchmarks/machines.py`).
    """
    for part in frictions(K):
        fastest = float(np.abs(X[:, list(damped_coordinates(part.damped, n))]).max())
        if part.rest_speed and 0 < fastest < 10 * part.rest_speed:
            require.warn(
                f"the rest_speed of hk.Friction is {part.rest_speed:.3g} and the largest momentum "
                f"of the runs {fastest:.3g}: dry friction then looks like a viscous one. Leave it "
                "out, or take a hundredth of that momentum: "
                f"hk.Friction(rest_speed={fastest / 100:.2g})."
            )


def warn_of_misfit(fit: FitQuality) -> None:
    """Warn that the structure does not explain the runs at the given noise, and where."""
    run, c = np.unravel_index(np.nanargmax(fit.misfit), fit.misfit.shape)
    where = (
        f"The residuals are largest in coordinate {c} of run {run}, {fit.misfit[run, c]:.2g} "
        "standard deviations."
    )
    if fit.process is not None and fit.is_disturbed:  # the path follows the samples
        where = f"Process noise that would explain them is {_numbers(fit.process)}; it is used."
    require.warn(
        f"the structure does not explain the runs: χ² is {fit.chi_squared:.3g} per degree of "
        f"freedom at the noise given, and should be 1. {where} Likely causes, in order: "
        f"{_lacked(fit)}; (q, q̇) given where (q, p) is needed (p = m q̇, in one scale; masses=True "
        "finds their ratios); a wrong unit; a jump or push in a run."
    )


def warn_of_process(fit: FitQuality) -> None:
    """Warn that the structure is not the whole truth, and that process noise was added."""
    assert fit.process is not None
    timing = " inputs that act at other times than logged (delay='fit');" if fit.driven else ""
    causes = f"Likely causes, in order: {_lacked(fit)};{timing} stiction, or a flexible part."
    require.warn(
        "the structure alone does not explain the runs: with process noise, ẋ = f + w of intensity "
        f"{_numbers(fit.process)} in units of the states over √time, they are likelier, and it is "
        "used. What w stands for is in .disturbance. Bands are those of the field without it: a "
        f"force that goes with the state may lie outside. {causes} process_noise=0 learns without."
    )


def warn_of_correlation(fit: FitQuality) -> None:
    """Warn that the innovations are not white, and say what to try.

    What a disturbance may stand for is said once, by `warn_of_process`. In four logs out of four,
    of a cantilever, a rotary and a double pendulum and of heat, that was the cause, no sensor.
    """
    white, c = fit.white, int(np.argmax(np.abs(fit.white.neighbours)))
    timing = (
        "inputs that act at other times than logged, or go on otherwise in between (between=); "
        if fit.driven
        else ""
    )
    if fit.between:
        timing = f"inputs that go on otherwise, between='{fit.between}' is likelier; {timing}"
    lacks = f"{_lacked(fit)}; "
    if fit.is_disturbed:
        lacks = "what the process noise stands for, which is a force and not white; "
    more = "; process_noise=None" if fit.process is None else ""
    require.warn(
        f"the innovations are not white (p = {white.probability:.2g} by Ljung and Box; the "
        f"correlation of neighbours is {white.neighbours[c]:.2f} in coordinate {c}): what the "
        "field and the noise leave is known in part from the samples before. Bands are widened by "
        f"{fit.white.widening**0.5:.2g} for it, and may still be too narrow. Likely causes, in "
        f"order: {timing}{lacks}sensors that are filtered or resampled{more}."
    )


def _numbers(values: Float[np.ndarray, " n"]) -> str:
    return "(" + ", ".join(f"{v:.2g}" for v in values) + ")"


def warn_of_noise(
    noise: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"], swing: float
) -> bool:
    """Warn where nearly all of the motion was taken for noise; return whether it was."""
    share = np.nan_to_num(noise / scale)
    c = int(np.argmax(share))
    if share[c] < 0.5:  # where learning failed, noise was found .9 to 1.1 times the motion
        return False
    few = f"{swing:.1f} samples a swing, where five or more are needed; " if swing < _SWING else ""
    require.warn(
        f"the field explains little of the runs: the noise found in coordinate {c} is "
        f"{noise[c]:.3g}, and its states vary by {scale[c]:.3g} (standard deviations). Causes: "
        f"{few}one lengthscale for coordinates of different sizes "
        f"(hk.Gaussian(np.ones({len(noise)})) has one for each), a jump in a run, a structure that "
        "the motion does not have, or sensors that are indeed so noisy. If you know the noise, "
        "pass noise=…; see hk.plot.fitted."
    )
    return True


def warn_of_few(free: float) -> bool:
    """Warn that the noise is a guess; return whether it is: σ is known to 1/√(2ν)."""
    if free >= _FEW:
        return False
    require.warn(
        f"the runs leave {max(free, 0.0):.1f} degrees of freedom to find the noise from, which "
        f"takes {_FEW} or more: noise and field are a guess. Log more samples, or pass noise=…."
    )
    return True


def warn_of_unsettled(fit: FitQuality, explained: bool) -> None:
    """Warn that the iterations ended before the field explains the runs."""
    low, high = np.nanmin(fit.misfit), np.nanmax(fit.misfit)
    misfits = f"the misfits, by run and coordinate, are {low:.2f} to {high:.2f}"
    if explained and high < 1.5:  # a field that still moves a little, and explains its run
        require.warn(
            f"learning did not settle in {fit.count} iterations: noise or objective still move. "
            f"The result is usable: {misfits}, where 1 is right. iterations={2 * fit.count} goes "
            "on."
        )
        return
    why = (
        f"{misfits}, where 1 is right"
        if explained
        else f"the residuals are {np.sqrt(fit.chi_squared):.2g} times the noise found"
    )
    few = f" More samples a swing help, there are {fit.swing:.1f}." if fit.swing < _SWING else ""
    require.warn(
        f"learning did not converge in {fit.count} iterations: {why}. Do not trust the field where "
        f"hk.plot.fitted shows that it leaves the samples; see .history. A kernel closer to the "
        f"truth helps, or shorter runs; iterations={2 * fit.count} goes on.{few}"
    )


def warn_of_dropped(fit: FitQuality) -> None:
    """Name the samples that the field is not learned from."""
    if not fit.kept.any():
        require.warn(
            "nothing was learned: no field of this kernel that was found follows any run. Causes: "
            "too few samples a swing, a mean that is wrong, or a structure that the motion does "
            "not have. Look at hk.plot.smoothing(runs)."
        )
    elif fit.dropped:
        require.warn(
            f"dropped: samples {_parts(fit.dropped)}. The field does not follow them (a χ² "
            "above 25 times the median, or a tangent above 1e4). Look there: a jump, another "
            "system, or chaos with samples too far apart."
        )


def warn_of_landmarks(fit: FitQuality) -> None:
    """Say that the field is limited by its landmarks, and what more of them cost."""
    if fit.few:
        require.warn(
            f"the field is limited by its {fit.few} landmarks: the runs are likelier with more. "
            f"solver=hk.Nystrom(max_points={2 * fit.few}) takes two to four times as long. Until "
            "then noise, process noise and pushes may stand for what the landmarks cannot say."
        )


def warn_of_pushes(fit: FitQuality) -> None:
    """Name the samples where w is not that of all others."""
    if fit.pushed:
        require.warn(
            f"pushed: samples {_parts(fit.pushed)}. Something that neither the log nor the field "
            "has moved the system there, by more than three deviations of the process noise of all "
            "other samples, and the field is hardly learned from them; .disturbance has how much. "
            "Look there: a hand, a stop, a cable, a sensor at its end, inputs that were not "
            "applied, or a force that the kernel cannot have."
        )


def _parts(parts: tuple[tuple[int, int, int], ...]) -> str:
    named = [f"{a} to {b - 1} of run {r}" for r, a, b in parts[:5]]
    more = f" and {len(parts) - 5} more parts" if len(parts) > 5 else ""
    return ", ".join(named) + more


def check_identifiable(runs: Runs, mean: Callable[[Array], Array] | None) -> None:
    """Raise unless a mean of the points (x, u) determines each coordinate that no run measured."""
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


def whiteness(z: Float[np.ndarray, "S L+1 n"], counts: Float[np.ndarray, "S L+1 n"]) -> Whiteness:
    """How white the innovations z are, by segment, sample and coordinate.

    The first n measured entries of a segment know its start, and say nothing here.
    """
    S, n = len(z), z.shape[2]
    seen = counts > 0
    used = seen & (np.cumsum(seen.reshape(S, -1), axis=1).reshape(z.shape) > n)
    statistic, lags, peak, neighbours = 0.0, 0, 1.0, np.zeros(n)
    k = np.arange(1, 11)
    waves = np.cos(np.linspace(0, np.pi, 45)[:, None] * k[None]) * (1 - k / 11)[None]
    for c in range(n):
        r, pairs = autocorrelations([z[s, used[s, :, c], c] for s in range(S)])
        neighbours[c] = r[0]
        # From 20 pairs on a correlation is nearly normal.
        r, pairs = r[pairs >= 20], pairs[pairs >= 20]
        statistic += ljung_box(int(used[:, :, c].sum()), r, pairs)
        lags += len(r)
        peak = max(peak, float((1 + 2 * waves[:, : len(r)] @ r).max()))
    probability = float(gammaincc(lags / 2, statistic / 2)) if lags else 1.0
    return Whiteness(probability, peak, neighbours)


def autocorrelations(
    series: list[Float[np.ndarray, " T"]],
) -> tuple[Float[np.ndarray, " 10"], Float[np.ndarray, " 10"]]:
    """The autocorrelations of series of mean zero at lags 1 to 10, and the pairs at each lag.

    Both values of a pair are of one series. Where nothing varies there are no pairs.
    """
    total = sum(float(z @ z) for z in series)
    if total == 0:
        return np.zeros(10), np.zeros(10)
    pairs = [[(z[k:], z[:-k]) for z in series if len(z) > k] for k in range(1, 11)]
    counts = np.array([sum(len(a) for a, _ in each) for each in pairs], float)
    sums = np.array([sum(float(a @ b) for a, b in each) for each in pairs])
    return sums / total, counts


def ljung_box(N: int, r: Float[np.ndarray, " K"], counts: Float[np.ndarray, " K"]) -> float:
    """Ljung and Box's statistic of N values, N (N + 2) Σ_k r_k²/N_k.

    N_k are the pairs at lag k, none of them of two series: N − k for a single one.
    """
    return float(N * (N + 2) * (r**2 / counts).sum())
