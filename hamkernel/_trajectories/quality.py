"""Quality of a fit: the numbers from which the diagnostics of `learn` are made."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel._learned.diagnostics import FOLLOWED, FitQuality
from hamkernel._learned.free_run import error_over_constant, stretches_of_swings
from hamkernel._learned.whiteness import whiteness
from hamkernel._machine import compiled_by_size
from hamkernel._runs.preprocessing import (
    PreprocessedRun,
    decide,
    sample_points,
    time_of_swing,
)
from hamkernel._runs.runs import Runs
from hamkernel._runs.sensors import is_on_a_curve, timing
from hamkernel._structures.friction import frictions
from hamkernel._trajectories.iteration import End, asks_for_landmarks, initial_loss, noisy_counts
from hamkernel._trajectories.kalman import smoothed_path
from hamkernel._trajectories.search import missing_friction, missing_inertia, missing_structure
from hamkernel._trajectories.segments import Piece

# The p of whiteness below which we ask for missing forces. In 13 logs like that of
# `tests/benchmarks/verdicts.py "dry friction"`, which lack friction, p was 9e-18 to .1.
_SUSPICIOUS = 0.3


def quality(
    runs: Runs,
    end: End,
    misfit: Float[np.ndarray, "R n"],
    z: Float[np.ndarray, "S L+1 n"],
    process: Float[np.ndarray, " n"],
    states: list[np.ndarray],
) -> FitQuality:
    """The quality of the fit of a field to runs; `z` are the innovations by segment."""
    now, data = end.now, end.task.data
    times, samples = runs.host_arrays()
    noise = np.exp(np.asarray(now.model.log_noise))
    kept, pieces = np.zeros(len(data.runs)), list(zip(end.task.pieces, now.good, strict=True))
    for (r, start, stop), good in pieces:
        kept[r] += good * (stop - start) / len(data.runs[r].times)
    speed = np.sqrt(np.mean(sample_points(data)[1] ** 2, axis=0))
    spacing = np.median(np.concatenate([np.diff(t) for t in times]))
    swing = time_of_swing(data) / spacing
    period = np.maximum(swing, 1.0) * spacing
    dropped = _samples([piece for piece, good in pieces if not good], end, times)
    residuals = [x - path for x, path in zip(samples, states, strict=True)]
    logged = [np.where(np.isfinite(r.states), r.states, r.path) for r in data.runs]
    timed = kept.any() and not (dropped or process.any())
    noisy = noisy_counts(end).any((0, 1))
    return FitQuality(
        names=runs.coordinate_names,
        noise=noise,
        scale=data.scale,
        is_noise_known=False,
        kept=kept,
        dropped=dropped,
        core=_core(residuals),
        share=float(np.max(process / np.sqrt(period) / np.maximum(speed, 1e-300))),
        impulse=_largest_push(end),
        pushed=_samples(_push_intervals(end), end, times),
        is_curve=runs.inputs is None and is_on_a_curve(logged, noise),
        free_run=_free_run(end, kept, swing * spacing),
        timing=timing(times, [np.where(noisy, r, np.nan) for r in residuals], states)
        if timed
        else None,
        misfit=misfit,
        **chi_squared(end, z),
        remaining=now.free,
        white=whiteness(z, noisy_counts(end)),
        process=process,
        count=len(end.history),
        settled=end.settled,
        swing=float(swing),
        driven=runs.inputs is not None,
        has_momenta=runs.dimension % 2 == 0,
        has_friction=bool(frictions(now.field.kernel)),
    )


def chi_squared(end: End, z: Float[np.ndarray, "S K n"]) -> dict[str, Any]:
    """χ² of the innovations z per degree of freedom, and the degrees of freedom.

    We judge the innovations and not the residuals, since a path with process noise follows the
    samples.
    """
    free = float((np.asarray(end.now.rows.counts) > 0).sum())
    mean = float((z**2).sum()) / max(free, 1.0)
    return {"chi_squared": mean if np.isfinite(mean) else np.inf, "free": free}


def energies(field: Any, fit: FitQuality, paths: list[Float[np.ndarray, "T n"]]) -> float | None:
    """How far the energies of the runs are apart, in standard deviations of one energy.

    A run of N samples with noise σ determines its energy to |σ ∇H|/√N. Only runs in the plane are
    asked: six runs of one energy determine Hénon and Heiles's field as well as runs of many. None
    is asked either where the kernel has no function φ(H) of the energy, or where process noise
    changes the energy.
    """
    K, n = field.kernel, len(fit.scale)
    if n != 2 or not K.conserves or K.takes_inputs or field.mean is not None:
        return None
    if fit.driven or fit.is_disturbed or fit.pushed:
        return None
    if all(len(support) == 1 for k in K.scalar_kernels for support in k.supports(n)):
        return None
    paths = [x for x, share in zip(paths, fit.kept, strict=True) if share > 0]
    if len(paths) == 1:
        return 0.0
    some = np.array([x[np.linspace(0, len(x) - 1, 8).astype(int)] for x in paths])
    noise = np.diag(np.nan_to_num(fit.noise))  # the noise of each coordinate in turn
    around = some[:, :, None, None] + np.stack([noise, -noise], 1)  # runs, samples, n, signs, n
    plus, minus = np.moveaxis(np.asarray(_energies(field, jnp.asarray(around))), -1, 0)
    change = np.sum(((plus - minus) / 2) ** 2, axis=2)
    one = np.mean(np.mean(change, axis=1) / np.array([len(x) for x in paths])) ** 0.5
    return float(np.std(np.mean(plus + minus, axis=(1, 2)) / 2) / one)


@compiled_by_size
def _energies(field: Any, X: Float[Array, "*shape n"]) -> Float[Array, "*shape"]:
    return jnp.vectorize(field.hamiltonian, signature="(n)->()")(X)


def with_causes(fit: FitQuality, runs: Runs, end: End) -> FitQuality:
    """The quality with the forces that the kernel may lack, which warnings then name."""
    now, task, used = end.now, end.task, len(end.now.field.points)
    args = now.model, now.field.points, now.rows, task.start_deviation
    if (task.capped and used >= task.quick) or not fit.white.is_enough:
        fit = fit._replace(few=used * asks_for_landmarks(end))
    if fit.has_momenta and (fit.is_disturbed or fit.white.probability < _SUSPICIOUS):
        fit = fit._replace(
            friction=missing_friction(*args, task.data),
            inertia=missing_inertia(*args, task.data, task.mean),
        )
        if not (fit.friction.is_there or fit.inertia.is_there):
            fit = fit._replace(structure=missing_structure(*args, task.data))
    if fit.white.is_enough:
        return fit
    return fit._replace(between=likelier_between(runs, end))


def likelier_between(runs: Runs, end: End) -> str:
    """The likeliest `between` of the inputs; "" if the runs have it already."""
    if runs.inputs is None or isinstance(runs.delay, str):
        return ""
    task, model = end.task, end.now.model
    any_way = runs.going_on("auto", runs.delay)
    chosen, _ = decide(
        any_way, task.data, lambda data: initial_loss(task._replace(data=data), model)
    )
    return chosen.between if chosen.between != runs.between else ""


def disturbances(
    end: End, times: list[np.ndarray], is_disturbed: bool
) -> tuple[Float[Array, "T n"], ...]:
    """The smoothed disturbance w of each run, from each time to the next."""
    task, now = end.task, end.now
    w = np.zeros(now.rows.drive.shape)
    if is_disturbed:
        args = now.field.points, now.rows, task.start_deviation
        w = np.asarray(smoothed_path(now.model, now.field.coefficients, *args).disturbance)
    out = []
    for of_run, run, t in zip(join_runs(w, end, 0.0), task.data.runs, times, strict=True):
        i = np.searchsorted(run.times, t - t[0], "right") - 1
        out.append(jnp.asarray(of_run[np.clip(i, 0, len(of_run) - 1)]))
    return tuple(out)


def _push_intervals(end: End) -> list[Piece]:
    """The intervals in which something pushed the system, from one sample to the next."""
    sizes = np.asarray(end.now.rows.pushed)
    return [
        Piece(r, start + int(i), start + int(i) + 1)
        for s, (r, start, stop) in enumerate(end.task.pieces)
        for i in np.flatnonzero(sizes[s, : stop - start - 1] > 1)
    ]


def _core(residuals: list[np.ndarray]) -> Float[np.ndarray, " n"]:
    """A robust standard deviation of the residuals over their RMS; NaN where nothing was measured.

    The robust one is 1.4826 = 1/Φ⁻¹(3/4) times the median of |residual|, so the ratio is 1 for
    normal residuals. The RMS stands in place of σ, since process noise makes residuals smaller.
    """
    R = np.concatenate(residuals)
    measured = np.isfinite(R).any(axis=0)
    R, out = R[:, measured], np.full(R.shape[1], np.nan)
    rms = np.sqrt(np.nanmean(R**2, axis=0))
    out[measured] = 1.4826 * np.nanmedian(np.abs(R), axis=0) / np.where(rms > 0, rms, 1.0)
    return out


def _free_run(end: End, kept: Float[np.ndarray, " R"], swing: float) -> float:
    """The error of free runs over two swings between pushes, relative to that of a constant.

    From a ratio of `FOLLOWED` on, we take the smallest over two, one and half a swing: no field
    predicts a pendulum that is balanced upright for a whole swing. On three simulated logs of
    animals in weather, which no field predicts, the ratios are 1.02 to 1.5
    (`tests/test_verdicts.py`).
    """
    scale, least = end.task.data.scale, np.inf
    parts = _parts_between_pushes(end, kept)
    if not parts:
        return np.inf
    runs, paths = [run for run, _ in parts], [path for _, path in parts]
    for count in (2.0, 1.0, 0.5):
        part = stretches_of_swings(runs, paths, swing, count)
        least = min(least, error_over_constant(end.now.field, part, scale))
        if least < FOLLOWED:
            break
    return least


def _parts_between_pushes(
    end: End, kept: Float[np.ndarray, " R"]
) -> list[tuple[PreprocessedRun, Float[np.ndarray, "T n"]]]:
    """The kept runs with their paths, cut where something pushed the system.

    No field predicts a push. A hand on a real pendulum left .84 of the deviation of the motion to
    free runs of one second, and the 20 others were .01 to .25 off.
    """
    pushes = sorted(_push_intervals(end))
    parts = []
    for r, (run, path) in enumerate(zip(end.task.data.runs, end.now.paths, strict=True)):
        cuts = [start for pushed_run, start, _ in pushes if pushed_run == r]
        ends = zip([0, *(cut + 1 for cut in cuts)], [*cuts, len(path) - 1], strict=True)
        for part in (slice(first, last + 1) for first, last in ends if first < last and kept[r]):
            parts.append((run.part(part), path[part]))
    return parts


def _largest_push(end: End) -> float:
    """The largest jump ∫w dt within one pushed interval, over the deviation of its coordinate."""
    pushed = np.asarray(end.now.rows.pushed) > 1
    if not np.any(pushed):
        return 0.0
    task, now = end.task, end.now
    args = now.field.points, now.rows, task.start_deviation
    w = np.asarray(smoothed_path(now.model, now.field.coefficients, *args).disturbance)
    jump = np.abs(w[:, : pushed.shape[1]]) * np.asarray(now.rows.spans)[..., None]
    return float((jump / task.data.scale)[pushed].max())


def _samples(
    pieces: list[Piece], end: End, times: list[np.ndarray]
) -> tuple[tuple[int, int, int], ...]:
    """(run, first sample, last sample + 1) of each piece; pieces that touch are joined."""
    out: list[tuple[int, int, int]] = []
    for r, start, stop in sorted(pieces):
        t, at = times[r] - times[r][0], end.task.data.runs[r].times
        first = int(np.searchsorted(t, at[start])) if start else 0
        last = int(np.searchsorted(t, at[stop])) if stop < len(at) else len(t)
        if out and out[-1][0] == r and out[-1][2] == first:
            first = out.pop()[1]
        out.append((r, first, last))
    return tuple(out)


def join_runs(
    values: np.ndarray, end: End, empty: float = np.nan
) -> list[Float[np.ndarray, "T n"]]:
    """Values by segment, joined to runs; `empty` where no segment is."""
    out = [np.full(run.path.shape, empty) for run in end.task.data.runs]
    for s, ((r, start, stop), good) in enumerate(zip(end.task.pieces, end.now.good, strict=True)):
        if good:
            part = values[s, : stop - start]
            out[r][start : start + len(part)] = part
    return out
