"""`Score`: how well a learned field predicts runs, beside two models that know no physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hamkernel import _require as require
from hamkernel._learned.diagnostics import FEW
from hamkernel._learned.free_run import Stretches, pad_stretches, predictions
from hamkernel._machine import precise_jit
from hamkernel._runs.flow import integrate, steps_for, stiffness
from hamkernel._runs.preprocessing import Preprocessed, preprocess, sample_points
from hamkernel._runs.runs import Runs
from hamkernel._show import Shown
from hamkernel._show import numbers as number

_STEPS = 12  # of Levenberg and Marquardt; starts at smoothed states usually need 4


class Score(Shown, eqx.Module):
    """The errors of free runs of a learned field, beside two baselines.

    A free run begins at the state that fits the first few samples best, and uses no later sample.
    The root mean squares are over the later samples. Both baselines use the same first samples:
    `persistence` repeats the last of them, and `linear` is a free run of the linear model
    ẋ = A x + B u + c, fitted by least squares to the runs from which the field was learned. Free
    runs that leave every bound have infinite errors.

    Attributes:
        rmse: the root mean square of predicted − measured, in units of the states, shape (n,); NaN
            where nothing was measured.
        persistence: the same root mean square for the last known sample, shape (n,).
        linear: the same root mean square for the linear model, shape (n,).
        lead: the advantage of the field over the linear model, shape (): the difference of their
            means of (error/scale)², in standard errors. Below 2 the samples do not decide.
        coverage: the share of samples inside the 95 % band of the posterior, sensor noise and
            process noise included, shape (); NaN without bands. Correct bands contain about .95.
        predictions: the free run of each run at its times, shape (T, n).
        times: the times of each run, shape (T,).
        errors: predicted − measured, (T, n), NaN where nothing was measured or it was known.
        scale: the standard deviations of the coordinates in the learned runs, shape (n,).
        first: the number of samples that each free run knows.
    """

    rmse: Float[Array, " n"]
    persistence: Float[Array, " n"]
    linear: Float[Array, " n"]
    lead: Float[Array, ""]
    coverage: Float[Array, ""]
    predictions: tuple[Float[Array, "T n"], ...]
    times: tuple[Float[Array, " T"], ...]
    errors: tuple[Float[Array, "T n"], ...]
    scale: Float[Array, " n"]
    first: int = eqx.field(static=True)

    @property
    def text(self) -> str:
        """The verdict in one sentence."""
        error, still, linear = (
            float(jnp.sqrt(jnp.nanmean((rmse / self.scale) ** 2)))
            for rmse in (self.rmse, self.persistence, self.linear)
        )
        count = sum(int((~jnp.isnan(e)).sum()) for e in self.errors)
        if count < FEW:
            return (
                f"was compared with {count} numbers, too few to judge it: off by "
                f"{number(self.rmse)}, a linear model by {number(self.linear)}"
            )
        if not error < still:
            return (
                f"is worse than saying that nothing moves: off by {number(self.rmse)}, where the "
                f"last known sample is off by {number(self.persistence)}"
            )
        if abs(float(self.lead)) < 2:
            return (
                "follows the runs, and these samples do not tell it from a linear model "
                f"({number(self.rmse)} for {number(self.linear)})"
            )
        if not error < linear:
            return f"is worse than a linear model ({number(self.rmse)} for {number(self.linear)})"
        if not np.isfinite(linear):
            return f"follows the runs to {number(self.rmse)}; a linear model leaves every bound"
        ratio = linear / max(error, 1e-300)
        by_coordinate = np.asarray(self.linear) / np.maximum(np.asarray(self.rmse), 1e-300)
        best = int(np.nanargmax(by_coordinate))
        # Noise of one sensor may hide how well another coordinate is predicted.
        more = f", and {by_coordinate[best]:.3g} times in coordinate {best}"
        return f"follows the runs {ratio:.3g} times better than a linear model" + (
            more if by_coordinate[best] > 3 * ratio else ""
        )

    def horizon(self, error: ArrayLike) -> Float[Array, " R"]:
        """The time for which the free run of each run stays within `error`, shape (R,).

        The time runs from the first sample to the last sample before any error is larger.

        Args:
            error: a bound in units of the states, one number or shape (n,).

        Raises:
            ValueError: the error is not positive.
        """
        bound = np.asarray(require.positive(error, "error"))
        out = []
        for t, e in zip(self.times, self.errors, strict=True):
            t, off = np.asarray(t), np.abs(np.asarray(e)) > bound
            beyond = np.flatnonzero(off.any(axis=1))
            out.append((t[beyond[0] - 1] if len(beyond) else t[-1]) - t[0])
        return jnp.asarray(out)

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        rows = [
            ("error of free runs", f"{number(self.rmse)}, root mean square"),
            ("last sample stays", number(self.persistence)),
            ("linear model", number(self.linear)),
        ]
        if np.isfinite(float(self.coverage)):
            rows.append(("inside 95 % bands", f"{float(self.coverage):.0%}"))
        return f"The field {self.text}.", rows


class _Linear(eqx.Module):
    """ẋ = A x + B u + c."""

    matrix: Float[Array, "n d"]
    constant: Float[Array, " n"]

    def __call__(self, s: Float[Array, " d"]) -> Float[Array, " n"]:
        return self.matrix @ s + self.constant


class _Disturbed(eqx.Module):
    """The disturbed field f(x, u) + w as a function of (x, u, w)."""

    field: Any
    count: int = eqx.field(static=True)  # the number of coordinates of (x, u)

    def __call__(self, s: Float[Array, " k"]) -> Float[Array, " n"]:
        return self.field(s[: self.count]) + s[self.count :]


def compute_score(
    field: Callable[[Array], Array],
    mean: Callable[[Array], Array] | None,
    training: Preprocessed,
    runs: Runs,
    first: int,
    noise: Float[np.ndarray, " n"],
    process_noise: Float[np.ndarray, " n"],
    sample: Callable[..., Any] | None = None,
    draws: int = 0,
) -> Score:
    """The score of a field on `runs`; see `AbstractLearned.score`.

    Args:
        field: the velocities of the points (x, u).
        mean: the known part of the field, which determines coordinates that were not measured.
        training: the runs from which the field was learned.
        runs: the runs to predict.
        first: the number of samples that each free run knows.
        noise: the standard deviation of the sensor noise, NaN where nothing was measured.
        process_noise: the intensity of the process noise.
        sample: the fields drawn from the posterior, as `Posterior.sample`; None for no bands.
        draws: the number of these fields.
    """
    scale = training.scale
    deviation = np.maximum(np.where(np.isfinite(noise), noise, scale), 1e-6 * scale)
    part = _as_stretches(runs, [run.path[0] for run in preprocess(runs, mean).runs])
    known_counts = [min(first, max(len(t) // 2, 1)) for t in runs.host_arrays()[0]]

    def free(field: Any) -> tuple[_Starts, np.ndarray]:
        starts = _fit_starts(field, part, known_counts, deviation, scale)
        return starts, predictions(field, part._replace(starts=starts.states), scale)

    starts, predicted = free(field)
    _, linear = free(_linear(*sample_points(training)))
    measured = part.measured
    later = np.arange(part.spans.shape[1]) >= np.array(known_counts)[:, None]
    judged = np.where(later[..., None], measured, np.nan)
    last = np.stack([_last(y[:k]) for y, k in zip(measured, known_counts, strict=True)])[:, None]
    coverage = np.nan
    if sample is not None:
        bands = _draws(field, sample, training, part, starts, noise, process_noise, draws)
        low, high = np.quantile(bands, [0.025, 0.975], axis=0)
        inside = (low <= judged) & (judged <= high)
        coverage = float(inside[np.isfinite(judged)].mean())
    times = runs.host_arrays()[0]
    return Score(
        rmse=_root_mean_square(predicted - judged),
        persistence=_root_mean_square(last - judged),
        linear=_root_mean_square(linear - judged),
        lead=_lead(((predicted - judged) / scale) ** 2, ((linear - judged) / scale) ** 2),
        coverage=jnp.asarray(coverage),
        predictions=tuple(jnp.asarray(x[: len(t)]) for x, t in zip(predicted, times, strict=True)),
        times=tuple(map(jnp.asarray, times)),
        errors=tuple(
            jnp.asarray(e[: len(t)]) for e, t in zip(predicted - judged, times, strict=True)
        ),
        scale=jnp.asarray(scale),
        first=first,
    )


def _as_stretches(runs: Runs, starts: list[np.ndarray]) -> Stretches:
    """The runs as stretches, each with an interval of no length before its first sample."""
    parts = []
    for r, (t, x) in enumerate(zip(*runs.host_arrays(), strict=True)):
        inputs = runs.input_lines(r, t)
        before = np.repeat(inputs[:1, :1], 2, axis=1)
        spans = np.concatenate([[0.0], np.diff(t)])
        parts.append((starts[r], spans, np.concatenate([before, inputs]), x))
    return pad_stretches(parts)


def _last(measured: Float[np.ndarray, "k n"]) -> Float[np.ndarray, " n"]:
    """The last sample of each coordinate; NaN where there is none."""
    out = np.full(measured.shape[1], np.nan)
    for y in measured:
        out = np.where(np.isfinite(y), y, out)
    return out


def _root_mean_square(error: Float[np.ndarray, "S L n"]) -> Float[Array, " n"]:
    counts = np.isfinite(error) | np.isinf(error)
    total = np.where(counts, error, 0.0) ** 2
    count = counts.sum((0, 1))
    return jnp.asarray(np.where(count, np.sqrt(total.sum((0, 1)) / np.maximum(count, 1)), np.nan))


def _lead(
    field: Float[np.ndarray, "S L n"], linear: Float[np.ndarray, "S L n"]
) -> Float[Array, ""]:
    """The mean difference of the squared errors `linear` − `field` in units of its standard error.

    Where two predictions are close, the difference of their squared errors is twice the noise times
    the distance of the predictions, and the noise of samples is independent.
    """
    with np.errstate(invalid="ignore"):  # of inf − inf
        gains = linear - field
        gains = gains[~np.isnan(gains)]
        deviation = gains.std() / np.sqrt(gains.size) if gains.size else np.nan
        mean = gains.mean() if gains.size else np.nan
        return jnp.asarray(mean / np.maximum(deviation, np.finfo(float).tiny))


def _linear(X: Float[np.ndarray, "N d"], Y: Float[np.ndarray, "N n"]) -> _Linear:
    A = np.linalg.lstsq(np.column_stack([X, np.ones(len(X))]), Y, rcond=None)[0].T
    return _Linear(jnp.asarray(A[:, :-1]), jnp.asarray(A[:, -1]))


class _Starts(NamedTuple):
    """The states at which free runs begin, and the roots of their covariances."""

    states: Float[np.ndarray, "S n"]
    roots: Float[np.ndarray, "S n n"]


def _fit_starts(field: Any, part: Stretches, known_counts: list[int], deviation, scale) -> _Starts:
    """The starts from which the field passes the first samples most closely.

    We minimise by steps of Levenberg and Marquardt. The prior standard deviation of a start is
    three times the scale of its coordinate: without a prior, a momentum that was never measured may
    be undetermined.
    """
    L = max(known_counts)
    judged = np.where(
        np.arange(L)[:, None] < np.array(known_counts)[:, None, None], part.measured[:, :L], np.nan
    )
    steps = jnp.asarray(steps_for(part.spans[:, :L], _stiffness(field, part, scale)))
    rest = jnp.asarray(part.spans[:, :L]), steps, jnp.asarray(part.inputs[:, :L])
    S, n = part.starts.shape
    prior = np.eye(n) / 9  # in units of `scale`, as all below

    def linearise(y):
        path = integrate(field, jnp.asarray(part.starts + scale * y), *rest)
        tangents, J = np.asarray(path.across), []
        for i in range(L):
            J.append(tangents[:, i] @ (J[-1] if J else np.diag(scale)))
        r = np.where(np.isfinite(judged), judged - np.asarray(path.x)[:, 1:], 0.0) / deviation
        J = np.where(np.isfinite(judged)[..., None], np.stack(J, 1), 0.0) / deviation[:, None]
        squares = (r**2).sum((1, 2)) + (y**2).sum(1) / 9
        # A path that is not finite does not constrain its start.
        finite = np.isfinite(squares) & (np.abs(J).max((1, 2, 3)) < 1e100)
        r = np.where(finite[:, None, None], r, 0.0)
        J = np.where(finite[:, None, None, None], J, 0.0)
        H, gradient = np.einsum("slki,slkj->sij", J, J), np.einsum("slki,slk->si", J, r)
        return np.where(finite, squares, np.inf), H + prior, gradient - y / 9

    y, damping = np.zeros((S, n)), np.full(S, 1e-3)
    least, H, gradient = linearise(y)
    for _ in range(_STEPS):
        D = np.einsum("s,sii->si", damping, H)[:, :, None] * np.eye(n)
        there = y + np.linalg.solve(H + D, gradient[..., None])[..., 0]
        trial = linearise(there)
        better = trial[0] < least
        y = np.where(better[:, None], there, y)
        least = np.where(better, trial[0], least)
        H = np.where(better[:, None, None], trial[1], H)
        gradient = np.where(better[:, None], trial[2], gradient)
        damping = np.where(better, damping / 10, damping * 10)
    values, vectors = np.linalg.eigh(H)
    roots = vectors / np.sqrt(np.maximum(values, 1 / 9))[:, None]
    return _Starts(part.starts + scale * y, scale[:, None] * roots)


def _stiffness(field: Any, part: Stretches, scale: Float[np.ndarray, " n"]) -> float:
    return stiffness(field, np.concatenate([part.starts, part.inputs[:, 0, 0]], axis=1), scale)


def _draws(
    field: Any,
    sample: Callable[..., Any],
    training: Preprocessed,
    part: Stretches,
    starts: _Starts,
    noise: Float[np.ndarray, " n"],
    process_noise: Float[np.ndarray, " n"],
    draws: int,
) -> Float[np.ndarray, "draws S L n"]:
    """Free runs of draws of the posterior with both kinds of noise."""
    n, (S, L) = part.starts.shape[1], part.spans.shape
    everywhere = np.concatenate([*(run.path for run in training.runs), starts.states])
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    margin = 0.2 * np.where(high > low, high - low, 1.0)
    of_field, of_start, of_w, of_noise = jax.random.split(jax.random.key(0), 4)
    region = np.stack([low - margin, high + margin])
    fields = sample(of_field, draws, region)
    lengths = np.maximum(part.spans, np.finfo(float).tiny)[None, ..., None]
    w = np.asarray(jax.random.normal(of_w, (draws, S, L, n))) * process_noise
    w = np.where(lengths > 1e-300, w / np.sqrt(lengths), 0.0)
    z = np.asarray(jax.random.normal(of_start, (draws, S, n)))
    x = starts.states + np.einsum("sij,dsj->dsi", starts.roots, z)
    inputs = np.broadcast_to(part.inputs, (draws, *part.inputs.shape))
    inputs = np.concatenate([inputs, np.repeat(w[:, :, :, None], 2, axis=3)], axis=-1)
    steps = jnp.asarray(steps_for(part.spans, _stiffness(field, part, training.scale)))
    spans, d = jnp.asarray(part.spans), n + part.inputs.shape[-1]

    @precise_jit
    @jax.vmap
    def run(field, x, inputs):
        joint_field = getattr(field, "whole", field)
        return integrate(_Disturbed(joint_field, d), x, spans, steps, inputs).x[:, 1:]

    out = np.asarray(run(fields, jnp.asarray(x), jnp.asarray(inputs)))
    out = np.where(np.isfinite(out), out, np.inf)
    return out + np.nan_to_num(noise) * np.asarray(jax.random.normal(of_noise, out.shape))
