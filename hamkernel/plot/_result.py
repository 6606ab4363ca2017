"""One figure of the result of `learn`."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from hamkernel import _require as require
from hamkernel.plot._learned import band
from hamkernel.plot._style import BLUE, COLORS, DATA, coordinate, legend
from hamkernel.plot._time import fitted, index_of_run

if TYPE_CHECKING:
    from hamkernel._learned.result import Learned
    from hamkernel._runs.runs import Runs
    from hamkernel._weak.lagrangian import LearnedLagrangian

_STATES = 120  # at which a law is drawn
_PATH = 400  # states of a path at which deviations are drawn


def result(learned: Learned, run: int = 0, held_out: Runs | None = None) -> Figure:
    """Draw a learned field on one page: fit, residuals, law and free run.

    Above, the fitted path of one run with its residuals in units of the noise, as in `fitted`.
    Below on the left, for two coordinates, the force ṗ at rest over q in its bands of 50 and 90 %,
    without inputs; for more, the residuals of all runs beside the normal density that they should
    have. Below on the right a free run over data that were not learned from, if there are any; else
    for two coordinates all runs in the plane, for more how uncertain the field is along the runs.

    Args:
        learned: the result of `hk.learn`.
        run: the run above, counted from 0, or from the end if negative.
        held_out: runs that were not learned from; a free run of the first is drawn.

    Returns:
        The Matplotlib figure; `figure.savefig("learned.png")` writes it.

    Raises:
        ValueError: there is no such run. TypeError, ValueError: `held_out` does not fit, as in
            `learned.score`.
    """
    import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

    require.no_tracers("hk.plot.result", "Draw outside.", learned)
    n = learned.runs.dimension
    heights = [0.8 + (1.7 if n <= 4 else 1.2) * n, 3.4]
    figure = plt.figure(figsize=(9.2, sum(heights)), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=heights)
    above, below = halves
    fitted(learned, run, above.subplots(n, 2, sharex=True, width_ratios=[3, 2]))
    left, right = below.subplots(1, 2)
    posterior = None if learned.observations is None else learned.posterior
    if n == 2 and posterior is not None:
        _force(left, learned, posterior)
    else:
        _histogram(left, learned)
    if held_out is not None:
        _free_run(right, learned, held_out)
    elif n == 2 or posterior is None:
        _plane(right, learned)
    else:
        _uncertainty(right, learned, posterior)
    return figure


def machine(learned: LearnedLagrangian, run: int = 0) -> Figure:
    """Draw a learned Lagrangian on one page: positions, and inertia and gravity along the run.

    One row for each joint i: its position over time, measured and smoothed; the inertia M_ii and
    the gravity ∂V/∂q_i at the positions of the run, over q_i, each in its band of two deviations.

    Args:
        learned: the result of `hk.learn` with a `Lagrangian`.
        run: the run, counted from 0, or from the end if negative.

    Returns:
        The Matplotlib figure; `figure.savefig("learned.png")` writes it.

    Raises:
        ValueError: there is no such run.
    """
    import matplotlib.pyplot as plt  # starts a backend, so only where a figure must be made

    require.no_tracers("hk.plot.machine", "Draw outside.", learned)
    run = index_of_run(run, len(learned.runs))
    field, path, m = learned.field, np.asarray(learned.states[run]), learned.field.features.count
    t, q = learned.runs.times[run], path[:, :m]
    shown = q[np.linspace(0, len(q) - 1, min(_STATES, len(q))).astype(int)]

    def laws(q):
        M, M_deviation = field.mass_matrix(q), field.mass_matrix_deviation(q)
        return jnp.diag(M), jnp.diag(M_deviation), field.gravity(q), field.gravity_deviation(q)

    inertia, inertia_off, gravity, gravity_off = map(np.asarray, jax.lax.map(laws, shown))
    figure, rows = plt.subplots(
        m, 3, figsize=(9.6, 1.2 + 1.8 * m), layout="constrained", squeeze=False
    )
    names = learned.runs.names or [f"$q_{{{i + 1}}}$" for i in range(m)]
    for i, (left, middle, right) in enumerate(rows):
        left.plot(t, learned.runs.states[run][:, i], ".", color=DATA, ms=3, label="measured")
        left.plot(t, q[:, i], color=BLUE, linewidth=1.0, label="smoothed")
        left.set(ylabel=names[i])
        order = np.argsort(shown[:, i])
        for ax, values, off, name in (
            (middle, inertia, inertia_off, f"$M_{{{i + 1}{i + 1}}}$"),
            (right, gravity, gravity_off, rf"$\partial V/\partial q_{{{i + 1}}}$"),
        ):
            low, high = ((values + s * off)[order, i] for s in (-2, 2))
            ax.fill_between(shown[order, i], low, high, color=BLUE, alpha=0.2, linewidth=0)
            ax.plot(shown[order, i], values[order, i], color=BLUE, linewidth=1.2)
            ax.set(ylabel=name, xlabel=names[i] if i == m - 1 else "")
        for ax in (left, middle, right):
            ax.grid(True, color="0.92", linewidth=0.6)
    rows[0, 0].set_title(f"run {run}", fontsize="small")
    for ax, name in ((rows[0, 1], "inertia"), (rows[0, 2], "gravity")):
        ax.set_title(f"{name}, ± 2 standard deviations", fontsize="small")
    rows[-1, 0].set_xlabel("time $t$")
    legend(rows[0, 0])
    return figure


def thumbnail(learned: Learned) -> str:
    """The first coordinate of the first run, measured and fitted, as a small image of HTML.

    A notebook shows it below the summary of a result.
    """
    figure = Figure(figsize=(4.6, 1.7), layout="constrained")
    ax = figure.subplots()
    t = learned.runs.times[0]
    ax.plot(t, np.asarray(learned.runs.states[0])[:, 0], ".", color=DATA, ms=4, label="measured")
    ax.plot(t, np.asarray(learned.states[0])[:, 0], color=BLUE, linewidth=1.2, label="fitted")
    ax.set(xlabel="time $t$", ylabel=_labels(learned)[0])
    legend(ax, fontsize="x-small")
    return image(figure, "first run", 80)


def image(figure: Figure, text: str, dpi: int = 120) -> str:
    """An <img> of HTML that holds the figure itself."""
    content = io.BytesIO()
    figure.savefig(content, dpi=dpi, format="png")
    data = base64.b64encode(content.getvalue()).decode()
    return f'<img alt="{text}" src="data:image/png;base64,{data}">'


def _labels(learned: Learned) -> list[str]:
    """The names of the columns of the log, else q and p."""
    n = learned.runs.dimension
    return list(learned.runs.names or (coordinate(c, n) for c in range(n)))


def _inputs(learned: Learned, count: int) -> tuple[Any, ...]:
    """Inputs that are zero at so many states, or the first run's parameters."""
    if learned.runs.parameters is not None:
        return (jnp.tile(learned.runs.parameters[0][None], (count, 1)),)
    m = learned.runs.input_count
    return (jnp.zeros((count, m)),) if m else ()


def _force(ax: Axes, learned: Learned, posterior: Any) -> None:
    """The force at p = 0 over the positions that were visited, with its band."""
    visited = np.concatenate([np.asarray(x)[:, 0] for x in learned.states])
    q = np.linspace(visited.min(), visited.max(), _STATES)
    states = np.stack([q, np.zeros(_STATES)], axis=1)
    means, deviations = map(np.asarray, posterior.evaluate(states, *_inputs(learned, _STATES)))
    band(q, means[:, 1], deviations[:, 1], ax=ax, xlabel=_labels(learned)[0], show_legend=False)
    ax.locator_params(axis="x", nbins=6)
    ax.axhline(0.0, color="0.7", linewidth=0.8, zorder=1)
    marks = {"color": DATA, "ms": 7, "linestyle": "none", "label": "fitted positions"}
    ax.plot(visited, np.zeros_like(visited), "|", transform=ax.get_xaxis_transform(), **marks)
    largest = np.max(deviations[:, 1])
    ax.set(ylabel=r"$\dot{p}$", title=f"force at rest, standard deviation up to {largest:.2g}")
    legend(ax)
    ax.title.set_fontsize("small")


def _histogram(ax: Axes, learned: Learned) -> None:
    """All residuals beside the normal density."""
    z = np.concatenate([np.asarray(r).ravel() for r in learned.residuals])
    z = np.clip(z[np.isfinite(z)], -5, 5)
    ax.hist(
        z, np.linspace(-5, 5, 41).tolist(), density=True, color=DATA, label="residuals of all runs"
    )
    at = np.linspace(-5, 5, 201)
    normal = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    ax.plot(at, normal, color=COLORS["true"], linewidth=1.2, label="normal")
    ax.set(xlabel=r"residual / $\sigma$", ylabel="density", yticks=[])
    legend(ax)


def _plane(ax: Axes, learned: Learned) -> None:
    """All runs and their fitted paths in the plane of the first coordinate and its partner."""
    n = learned.runs.dimension
    i, j = 0, min(n // 2, n - 1)
    for r, (x, path) in enumerate(zip(learned.runs.states, learned.states, strict=True)):
        points = np.asarray(x)[:, [i, j]]
        name = ("measured", "fitted") if r == 0 else (None, None)
        style = {"color": DATA, "ms": 3, "mec": "black", "mew": 0.3}
        if np.isfinite(points).all(axis=1).any():
            ax.plot(*points.T, "o", label=name[0], zorder=3, **style)
        ax.plot(*np.asarray(path)[:, [i, j]].T, color=BLUE, linewidth=1.2, label=name[1])
    labels = _labels(learned)
    ax.set(xlabel=labels[i], ylabel=labels[j], title="all runs")
    ax.title.set_fontsize("small")
    ax.grid(True, color="0.92", linewidth=0.6)
    legend(ax)


def _uncertainty(ax: Axes, learned: Learned, posterior: Any) -> None:
    """The deviation of the field along the runs, over the root mean square of its speed."""
    n = learned.runs.dimension
    states = np.concatenate([np.asarray(x) for x in learned.states])
    states = states[np.linspace(0, len(states) - 1, min(_PATH, len(states))).astype(int)]
    means, deviations = map(np.asarray, posterior.evaluate(states, *_inputs(learned, len(states))))
    speeds = np.sqrt((means**2).mean(axis=0))
    shares = 100 * deviations / np.where(speeds > 0, speeds, 1.0)
    ax.boxplot(shares, whis=(5, 95), showfliers=False, medianprops={"color": BLUE})
    ax.set_xticks(range(1, n + 1), _labels(learned))
    ax.set(ylabel="standard deviation / speed", yscale="log", title="uncertainty along the runs")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g} %")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.title.set_fontsize("small")


def _free_run(ax: Axes, learned: Learned, held_out: Runs) -> None:
    """The first coordinate of a run that was not learned from, and its free run."""
    score = learned.score(held_out, draws=0)
    t, x = np.asarray(score.times[0]), np.asarray(held_out.states[0])[:, 0]
    style = {"color": DATA, "ms": 4, "mec": "black", "mew": 0.4}
    ax.plot(t, x, "o", label="measured", **style)
    ax.plot(t, np.asarray(score.predictions[0])[:, 0], color=BLUE, linewidth=1.4, label="free run")
    first = min(score.first, max(len(t) // 2, 1)) - 1
    ax.axvspan(t[0], t[first], color="0.9", linewidth=0, label="start fitted here", zorder=0)
    ax.set(xlabel="time $t$", ylabel=_labels(learned)[0])
    ax.set_title(f"held out: error {float(score.rmse[0]):.3g} after the first samples")
    ax.title.set_fontsize("small")
    ax.set_xlim(t[0], t[-1])
    ax.grid(True, color="0.92", linewidth=0.6)
    legend(ax)
